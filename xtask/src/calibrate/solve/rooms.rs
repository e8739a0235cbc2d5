//! Simulated rooms to be calibrated: what the solver is measured on, beside another one.
//!
//! What can go wrong: a cloud that a station would not light; it is drawn again.

use nalgebra::{Matrix3, Rotation3, Vector3};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal, Uniform};

use super::model::Fitted;
use super::observation::{Sighting, TruthSample};
use crate::calib::schema::Rotor;
use crate::reference::Pose as Station;

/// What rooms are like.
#[derive(Clone, Copy, Debug)]
pub struct Kind {
    /// Standard deviation of an angle, radians.
    pub noise: f64,
    /// Share of the sightings that are anything at all.
    pub outliers: f64,
    /// Times at which both stations were seen, both axes at once.
    pub instants: usize,
    /// Standard deviations of the rotors' phases and tilts, radians.
    pub factory: [f64; 2],
}

impl Kind {
    /// The rooms of `docs/calibration-oracle.md`: 0.2 degrees, one in ten wrong, ideal rotors.
    pub const ORACLE: Self =
        Self { noise: 0.2 * std::f64::consts::PI / 180.0, outliers: 0.1, instants: 400, factory: [0.0; 2] };
}

/// A room, and what was seen in it.
#[derive(Clone, Debug)]
pub struct Simulated {
    /// As they are.
    pub stations: [Station; 2],
    /// In the order of time.
    pub sightings: Vec<Sighting>,
    /// At the same times.
    pub truth: Vec<TruthSample>,
}

/// Seconds between two instants.
pub const EVERY_S: f64 = 4.0 / 120.0;
/// Farther to a side no rotor's light reaches, radians.
const REACH: f64 = 55.0 * std::f64::consts::PI / 180.0;

/// Room number `seed`: two stations 1 to 5 m from a hand-held cloud of 0.3 to 1.5 m by side, each turned towards it
/// within 20 degrees, any way up.
#[must_use]
pub fn simulate(kind: &Kind, seed: u64) -> Simulated {
    let mut random = Random(ChaCha8Rng::seed_from_u64(seed));
    loop {
        let middle = Vector3::from_fn(|_, _| random.between(-2.0, 2.0));
        let side = Vector3::from_fn(|_, _| random.between(0.3, 1.5));
        let waves: Vec<[f64; 2]> =
            (0..9).map(|k| [[0.35, 0.9, 1.7][k % 3] * random.between(0.8, 1.25), random.between(0.0, 7.0)]).collect();
        let at = |t: f64| {
            middle
                + Vector3::from_fn(|axis, _| {
                    let wave = |k: usize| (waves[3 * axis + k][0] * t + waves[3 * axis + k][1]).sin();
                    0.5 * side[axis] * (0.6 * wave(0) + 0.3 * wave(1) + 0.1 * wave(2))
                })
        };
        let times: Vec<f64> = (0..kind.instants).map(|k| k as f64 * EVERY_S).collect();
        let stations = [(); 2].map(|()| station(kind, &mut random, middle));
        let fitted = stations.each_ref().map(Fitted::of);
        let mut sightings = Vec::with_capacity(4 * times.len());
        let mut lit = true;
        for &at_s in &times {
            for (station, fitted) in fitted.iter().enumerate() {
                let c = fitted.see(at(at_s).into());
                for axis in 0..2 {
                    let angle = fitted.predict(axis, c).map_or(f64::INFINITY, |predicted| predicted.angle);
                    lit &= angle.abs() < REACH;
                    let angle = if random.between(0.0, 1.0) < kind.outliers {
                        random.between(-REACH, REACH)
                    } else {
                        angle + kind.noise * random.normal()
                    };
                    sightings.push(Sighting { at_s, station, axis, angle });
                }
            }
        }
        if lit {
            let truth = times.iter().map(|&at_s| TruthSample { at_s, position: at(at_s) }).collect();
            return Simulated { stations, sightings, truth };
        }
    }
}

fn station(kind: &Kind, random: &mut Random, middle: Vector3<f64>) -> Station {
    let away = random.direction();
    let position = middle + away * random.between(1.0, 5.0);
    let side = away.cross(&random.direction()).normalize();
    // Rows right, up, forward; forward is towards the middle.
    let towards = Matrix3::from_rows(&[side.transpose(), (-away).cross(&side).transpose(), (-away).transpose()]);
    let turn = random.direction() * random.between(0.0, 20f64.to_radians());
    let mut rotor = || Rotor {
        phase: kind.factory[0] * random.normal(),
        tilt: kind.factory[1] * random.normal(),
        ..Rotor::default()
    };
    let factory = [rotor(), rotor()];
    Station { rotation: Rotation3::new(turn).matrix() * towards, position, factory }
}

struct Random(ChaCha8Rng);

impl Random {
    fn between(&mut self, low: f64, high: f64) -> f64 {
        Uniform::new(low, high).map_or(low, |uniform| uniform.sample(&mut self.0))
    }

    fn normal(&mut self) -> f64 {
        StandardNormal.sample(&mut self.0)
    }

    fn direction(&mut self) -> Vector3<f64> {
        Vector3::from_fn(|_, _| self.normal()).normalize()
    }
}
