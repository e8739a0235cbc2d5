//! The same filter in f64, the textbook way: what the fixed-point one is measured against.

use super::{Config, Step};

pub(super) type Vector = [f64; 3];
type Matrix = [[f64; 3]; 3];

/// A station in f64: rows right, up, forward; metres.
#[derive(Debug, Clone, Copy)]
pub(super) struct Station {
    pub rotation: Matrix,
    pub position: Vector,
}

impl Station {
    /// World to station.
    pub(super) fn see(&self, point: Vector) -> Vector {
        let away: Vector = std::array::from_fn(|i| point[i] - self.position[i]);
        self.rotation.map(|row| dot(row, away))
    }

    /// The ideal angle under which it sees `point`, radians.
    pub(super) fn angle(&self, axis: usize, point: Vector) -> f64 {
        let seen = self.see(point);
        seen[axis].atan2(seen[2])
    }
}

pub(super) fn dot(a: Vector, b: Vector) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Position and velocity (metres and half turns), covariances, doubts.
#[derive(Debug, Clone, Default)]
pub(super) struct Twin {
    pub tracking: bool,
    pub position: Vector,
    velocity: Vector,
    pp: Matrix,
    pv: Matrix,
    vv: Matrix,
    believed: f64,
    refused: [[u16; 2]; 2],
}

impl Twin {
    pub(super) fn start(&mut self, config: &Config, position: Vector, mismatch: f64) {
        if self.tracking || mismatch.abs() > f64::from(config.start_mismatch) / 65536.0 {
            return;
        }
        *self = Self { tracking: true, position, ..Self::default() };
        for i in 0..3 {
            self.pp[i][i] = (f64::from(config.start_position) / 65536.0).powi(2);
            self.vv[i][i] = (f64::from(config.start_velocity) / 16_777_216.0).powi(2);
        }
    }

    /// One angle in radians, `elapsed` half turns after the one before.
    pub(super) fn step(
        &mut self,
        config: &Config,
        stations: &[Station; 2],
        which: usize,
        axis: usize,
        angle: f64,
        elapsed: f64,
    ) -> Step {
        if !self.tracking {
            return Step::Idle;
        }
        self.believed += elapsed;
        self.tracking = self.believed <= f64::from(config.lost_after) / 256.0;
        if !self.tracking {
            return Step::Lost;
        }

        let q32 = 2f64.powi(32);
        for i in 0..3 {
            self.position[i] += self.velocity[i] * elapsed.min(16.0);
            self.vv[i][i] += f64::from(config.agility) / q32 * elapsed;
        }
        for i in 0..3 {
            for j in 0..3 {
                self.pp[i][j] += elapsed * (self.pv[i][j] + self.pv[j][i] + elapsed * self.vv[i][j]);
            }
        }
        for i in 0..3 {
            for j in 0..3 {
                self.pv[i][j] += elapsed * self.vv[i][j];
            }
        }
        self.tracking = self.pp[0][0] + self.pp[1][1] + self.pp[2][2] <= f64::from(config.variance_limit) / q32;
        if !self.tracking {
            return Step::Lost;
        }

        let station = &stations[which];
        let tangent = angle.tan();
        let normal: Vector = std::array::from_fn(|i| station.rotation[axis][i] - tangent * station.rotation[2][i]);
        let seen = station.see(self.position);
        let innovation = tangent * seen[2] - seen[axis];
        let noise = f64::from(config.noise) / 262_144.0 * seen[2] * (1.0 + tangent * tangent);
        let ph: Vector = self.pp.map(|row| dot(row, normal));
        let vh: Vector = std::array::from_fn(|i| (0..3).map(|j| self.pv[j][i] * normal[j]).sum());
        let variance = dot(ph, normal) + noise * noise;
        let gate = f64::from(config.gate) / 8192.0;
        if innovation.abs() >= 0.125 || seen[2] <= 0.0 || innovation * innovation > gate * gate * variance {
            self.refused[which][axis] += 1;
            self.tracking = self.refused[which][axis] < config.doubt_count;
            return if self.tracking { Step::Refused } else { Step::Lost };
        }
        self.believed = 0.0;
        self.refused[which][axis] = if innovation.abs() > 0.025 { config.doubtful } else { 0 };
        for i in 0..3 {
            self.position[i] += ph[i] * innovation / variance;
            self.velocity[i] += vh[i] * innovation / variance;
            for j in 0..3 {
                self.pp[i][j] -= ph[i] * ph[j] / variance;
                self.pv[i][j] -= ph[i] * vh[j] / variance;
                self.vv[i][j] -= vh[i] * vh[j] / variance;
            }
        }
        Step::Believed
    }

    /// The position, where it is claimed.
    pub(super) fn fix(&self, config: &Config) -> Option<Vector> {
        let limit = (f64::from(config.sd_limit) / 65536.0).powi(2);
        (self.tracking && (0..3).all(|i| self.pp[i][i] <= limit)).then_some(self.position)
    }
}
