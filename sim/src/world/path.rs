//! Where the mote is, at any true time.
//!
//! Position is a formula of time and not a list of points: the moment a laser plane meets a moving mote is the
//! solution of an equation, and its solver asks for positions in between. The formula also costs no memory in a run
//! of 24 h.
//!
//! What can go wrong: a hand-held path fills its box and rarely reaches the corners; scenes that need a corner should
//! go there in a `Line`.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::noise::{Noise, Purpose};

/// Waves per axis of a hand-held path.
const WAVES: usize = 4;

/// The waves' rates against each other: no two in a simple ratio, so that the path does not repeat.
const RATES: [f64; WAVES] = [1.0, 1.618, 2.414, 3.303];

/// How the mote moves.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub enum Path {
    /// Lies in one place.
    Still {
        /// In the world, metres.
        at_m: [f64; 3],
    },
    /// Runs to and fro between two places at constant speed, as on a rail.
    Line {
        /// Where it is at time 0, metres.
        from_m: [f64; 3],
        /// Where it turns, metres.
        to_m: [f64; 3],
        /// Metres per second.
        speed_m_per_s: f64,
    },
    /// Carried in a hand: smooth, never the same again, inside a box. The seed chooses which.
    HandHeld {
        /// The box's lowest corner, metres.
        low_m: [f64; 3],
        /// The box's highest corner, metres.
        high_m: [f64; 3],
        /// Metres per second, over minutes; to a few percent.
        mean_speed_m_per_s: f64,
    },
}

impl Path {
    /// Whether the numbers make a path.
    #[must_use]
    pub fn is_fit(&self) -> bool {
        let finite = |corners: [[f64; 3]; 2]| corners.as_flattened().iter().all(|m| m.is_finite());
        match *self {
            Path::Still { at_m } => finite([at_m; 2]),
            Path::Line { from_m, to_m, speed_m_per_s } => {
                finite([from_m, to_m]) && from_m != to_m && speed_m_per_s.is_finite() && speed_m_per_s >= 0.0
            }
            Path::HandHeld { low_m, high_m, mean_speed_m_per_s } => {
                finite([low_m, high_m])
                    && low_m != high_m
                    && low_m.iter().zip(high_m).all(|(low, high)| *low <= high)
                    && mean_speed_m_per_s.is_finite()
                    && mean_speed_m_per_s >= 0.0
            }
        }
    }
}

/// A path made definite by a seed.
#[derive(Debug, Clone)]
pub(super) enum Walk {
    Still(Vector3<f64>),
    Line { from: Vector3<f64>, way: Vector3<f64>, leg_s: f64 },
    Waves { centre: Vector3<f64>, waves: Box<[[Wave; WAVES]; 3]> },
}

#[derive(Debug, Clone, Copy)]
pub(super) struct Wave {
    amplitude_m: f64,
    rate_rad_per_s: f64,
    phase_rad: f64,
}

impl Walk {
    pub(super) fn new(path: &Path, seed: u64) -> Walk {
        match *path {
            Path::Still { at_m } => Walk::Still(at_m.into()),
            Path::Line { from_m, to_m, speed_m_per_s } => {
                let way = Vector3::from(to_m) - Vector3::from(from_m);
                Walk::Line { from: from_m.into(), way, leg_s: way.norm() / speed_m_per_s }
            }
            Path::HandHeld { low_m, high_m, mean_speed_m_per_s } => {
                let (low, high) = (Vector3::from(low_m), Vector3::from(high_m));
                let half = (high - low) / 2.0;
                let mut noise = Noise::new(seed, Purpose::Path);
                let mut waves = [half.x, half.y, half.z].map(|half_m| Wave::draw(half_m, &mut noise));
                // Time scales speed, so the speed at unit rates says how fast time must run.
                let unit = mean_speed(&waves);
                for wave in waves.as_flattened_mut() {
                    wave.rate_rad_per_s *= mean_speed_m_per_s / unit;
                }
                Walk::Waves { centre: low + half, waves: Box::new(waves) }
            }
        }
    }

    /// Where the mote is at true time `t_s`, metres.
    pub(super) fn position(&self, t_s: f64) -> Vector3<f64> {
        match self {
            Walk::Still(at) => *at,
            Walk::Line { from, way, leg_s } => {
                let legs = libm::fmod(t_s / leg_s, 2.0);
                from + way * if legs <= 1.0 { legs } else { 2.0 - legs }
            }
            Walk::Waves { centre, waves } => {
                let [x, y, z] = waves.map(|axis| axis.iter().map(|wave| wave.offset(t_s)).sum::<f64>());
                centre + Vector3::new(x, y, z)
            }
        }
    }
}

impl Wave {
    /// The waves of one axis: slow ones wide, quick ones narrow, together never beyond `half_m`.
    fn draw(half_m: f64, noise: &mut Noise) -> [Wave; WAVES] {
        let mut waves = RATES.map(|rate| Wave {
            amplitude_m: noise.between(0.5, 1.5) / rate,
            rate_rad_per_s: rate * noise.between(0.9, 1.1),
            phase_rad: noise.between(0.0, core::f64::consts::TAU),
        });
        let sum: f64 = waves.iter().map(|wave| wave.amplitude_m).sum();
        waves.iter_mut().for_each(|wave| wave.amplitude_m *= half_m / sum);
        waves
    }

    fn offset(&self, t_s: f64) -> f64 {
        self.amplitude_m * libm::sin(self.rate_rad_per_s * t_s + self.phase_rad)
    }

    fn speed(&self, t_s: f64) -> f64 {
        self.amplitude_m * self.rate_rad_per_s * libm::cos(self.rate_rad_per_s * t_s + self.phase_rad)
    }
}

fn mean_speed(waves: &[[Wave; WAVES]; 3]) -> f64 {
    const SAMPLES: u32 = 1_000;
    let speed = |n: u32| {
        let t_s = f64::from(n) * 0.7;
        let [x, y, z] = waves.map(|axis| axis.iter().map(|wave| wave.speed(t_s)).sum::<f64>());
        Vector3::new(x, y, z).norm()
    };
    (0..SAMPLES).map(speed).sum::<f64>() / f64::from(SAMPLES)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const CARRIED: Path =
        Path::HandHeld { low_m: [0.25, 0.8, 0.6], high_m: [0.85, 1.3, 1.1], mean_speed_m_per_s: 0.27 };

    #[test]
    fn a_line_is_walked_to_and_fro() {
        let line = Path::Line { from_m: [0.0; 3], to_m: [0.0, 2.0, 0.0], speed_m_per_s: 0.5 };
        let walk = Walk::new(&line, 0);
        for (t_s, y) in [(0.0, 0.0), (1.0, 0.5), (4.0, 2.0), (5.0, 1.5), (8.0, 0.0), (9.0, 0.5)] {
            assert_eq!(walk.position(t_s).y, y);
        }
    }

    #[test]
    fn a_line_at_no_speed_stays_where_it_starts() {
        let line = Path::Line { from_m: [1.0; 3], to_m: [0.0, 2.0, 0.0], speed_m_per_s: 0.0 };
        assert_eq!(Walk::new(&line, 0).position(1e4), Vector3::from([1.0; 3]));
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]

        #[test]
        fn a_hand_stays_in_its_box(seed: u64, t_s in 0.0..86_400.0f64) {
            let p = Walk::new(&CARRIED, seed).position(t_s);
            prop_assert!((0.25..=0.85).contains(&p.x) && (0.8..=1.3).contains(&p.y) && (0.6..=1.1).contains(&p.z));
        }

        #[test]
        fn a_hand_moves_at_its_mean_speed(seed: u64) {
            let walk = Walk::new(&CARRIED, seed);
            let way: f64 = (0..6_000)
                .map(|n| f64::from(n) * 0.1)
                .map(|t_s| (walk.position(t_s + 0.1) - walk.position(t_s)).norm())
                .sum();
            prop_assert!((way / 600.0 - 0.27).abs() < 0.027, "{} m/s", way / 600.0);
        }
    }
}
