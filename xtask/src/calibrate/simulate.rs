//! A virtual room to try a session in, without a chip.
//!
//! Two stations look at the middle of the places from one side, a good way apart; their rotors have the phases of real
//! ones; each angle has noise, and now and then a reflection is taken for a sweep.
//!
//! What can go wrong: places so far apart that no station has them all in its field; the rotors then miss some, as real
//! ones would.

use std::time::Duration;

use anyhow::Result;
use nalgebra::{Matrix3, Vector3};
use sim::world::Axis;
use sim::world::rotor::Rotor;
use sim::world::station::{Optics, Station};

use super::points::Point;
use super::session::Source;
use super::solve::Sighting;
use crate::light::HALF_TURN_S;

/// Standard deviation of an angle, degrees: between a quiet station and what a SCuM chip's timer adds.
const NOISE_DEG: f64 = 0.05;
/// Share of the sweeps that are reflections.
const REFLECTIONS: f64 = 0.02;
/// How far off a reflection is at most, degrees.
const ASTRAY_DEG: f64 = 8.0;
/// Half turns that are simulated at a time: a tenth of a second.
const AT_ONCE: u64 = 12;

/// The room, and the mote in it.
#[derive(Debug)]
pub struct Simulated {
    /// A and B.
    pub stations: [Station; 2],
    at_m: Vector3<f64>,
    slot: u64,
    dice: fastrand::Rng,
    /// Whether to take as long as the light would.
    paced: bool,
}

impl Simulated {
    /// A room around the places.
    pub fn around(points: &[Point], seed: u64, paced: bool) -> Self {
        let middle = points.iter().map(|point| point.position).sum::<Vector3<f64>>() / points.len() as f64;
        let reach = points.iter().map(|point| (point.position - middle).norm()).fold(0.0, f64::max);
        // 1.5 m away, or far enough that the farthest place is 30 degrees off the middle.
        let scale = (reach / 0.577 / 1.5).max(1.0);
        let place = |from: [f64; 3], [az, el]: [f64; 2]| {
            let position = middle + scale * Vector3::from(from);
            let forward = (middle - position).normalize();
            let across = Vector3::z().cross(&forward).normalize();
            let rotation = Matrix3::from_columns(&[across, forward.cross(&across), forward]);
            let rotor = |phase_rad: f64| Rotor { phase_rad, ..Rotor::default() };
            Station {
                rotation: [0, 1, 2].map(|row| rotation.column(row).into_owned().into()),
                position_m: position.into(),
                azimuth: rotor(az),
                elevation: rotor(el),
                ..Station::default()
            }
        };
        // The phases of the recorded stations.
        let stations =
            [place([-0.8, -0.7, 1.0], [0.046_615, 0.055_583]), place([0.9, -0.6, 1.1], [0.015_264, 0.020_820])];
        Self { stations, at_m: middle, slot: 0, dice: fastrand::Rng::with_seed(seed), paced }
    }

    fn gauss(&mut self) -> f64 {
        (0..12).map(|_| self.dice.f64()).sum::<f64>() - 6.0
    }

    /// The sweep of the half turn at hand, if the mote sees it.
    fn sweep(&mut self) -> Option<Sighting> {
        let slot = self.slot;
        self.slot += 1;
        // B azimuth, B elevation, A azimuth, A elevation.
        let (station, axis) = (usize::from(slot % 4 < 2), (slot % 2) as usize);
        let of = if axis == 0 { Axis::Azimuth } else { Axis::Elevation };
        let sight = self.stations[station].sight(self.at_m);
        let (tan, other) = sight.tangents(of).filter(|_| sight.in_field(&Optics::default()))?;
        let noise = NOISE_DEG.to_radians() * self.gauss();
        let astray =
            if self.dice.f64() < REFLECTIONS { ASTRAY_DEG.to_radians() * (2.0 * self.dice.f64() - 1.0) } else { 0.0 };
        let angle = self.stations[station].rotor(of).measured(tan.atan(), other) + noise + astray;
        let at_s = HALF_TURN_S * (slot as f64 + 0.5 + angle / std::f64::consts::PI);
        Some(Sighting { at_s, station, axis, angle })
    }
}

impl Source for Simulated {
    fn begin(&mut self, point: &Point) -> Result<()> {
        self.at_m = point.position;
        Ok(())
    }

    fn next(&mut self) -> Result<Vec<Sighting>> {
        if self.paced {
            std::thread::sleep(Duration::from_secs_f64(AT_ONCE as f64 * HALF_TURN_S));
        }
        Ok((0..AT_ONCE).filter_map(|_| self.sweep()).collect())
    }
}
