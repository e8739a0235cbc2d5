//! A scene: everything there is to say about a room of light, in one value that can be written down.
//!
//! A run's report holds its scene and its seed, and the two make the same light again. Times are true seconds since
//! the mote's power-on; the world frame is the calibration's.
//!
//! A scene file names what differs from the default; a station named in it must bring its pose.
//!
//! ```
//! use sim::world::Scene;
//! use sim::world::scene::Unfit;
//!
//! let scene: Scene = toml::from_str("[receiver]\nsync_dropout = 0.05")?;
//! assert_eq!(scene.receiver.sync_dropout, 0.05);
//! assert_eq!(scene.station_a, Scene::default().station_a);
//!
//! let beyond: Scene = toml::from_str("[receiver]\nsync_dropout = 5")?;
//! assert_eq!(beyond.check(), Err(Unfit("a dropout is not within 0 to 1")));
//! # Ok::<(), toml::de::Error>(())
//! ```
//!
//! What can go wrong: numbers that describe no room; [`Scene::check`] refuses them and says which.

use serde::{Deserialize, Serialize};

use super::clock::Clock;
use super::ootx::Info;
use super::path::Path;
use super::receiver::{Interference, LineFault, Mirror, Receiver, Strobe};
use super::rotor::Rotor;
use super::slot::Timing;
use super::station::{Optics, Station};

/// A room of light around one mote.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Scene {
    /// When the stations are switched off, seconds.
    pub length_s: f64,
    /// How the mote moves.
    pub path: Path,
    /// The mote's clock.
    pub clock: Clock,
    /// The mote's eye.
    pub receiver: Receiver,
    /// How the rotors are driven.
    pub timing: Timing,
    /// What the stations have in common.
    pub optics: Optics,
    /// Light from strangers.
    pub interference: Interference,
    /// The station that flashes first.
    pub station_a: Station,
    /// The station that flashes second.
    pub station_b: Station,
    /// Planes that reflect the sweeps.
    pub mirrors: Vec<Mirror>,
    /// Motion capture in the same room.
    pub strobes: Vec<Strobe>,
    /// When the line from the receiver to the chip is not well.
    pub line_faults: Vec<LineFault>,
}

/// Stations A and B as they stood for the SCuM recording "take5" of 2020: poses and phases from a refit of that
/// recording. Their serial numbers are made up.
fn take5() -> [Station; 2] {
    let phase = |phase_rad| Rotor { phase_rad, ..Rotor::default() };
    [
        Station {
            rotation: [
                [-0.996768590, 0.080301131, 0.002026208],
                [0.080157929, 0.995992190, -0.039677005],
                [-0.005204195, -0.039386376, -0.999210503],
            ],
            position_m: [0.259609, 0.992558, 1.627112],
            azimuth: phase(0.046615),
            elevation: phase(0.055583),
            info: Info { id: 0xa000_0001, mode: 0, ..Info::default() },
            ..Station::default()
        },
        Station {
            rotation: [
                [-0.998495012, -0.049356295, -0.023909556],
                [-0.050814630, 0.996603172, 0.064807334],
                [0.020629689, 0.065924755, -0.997611318],
            ],
            position_m: [0.825604, 0.992643, 1.619665],
            azimuth: phase(0.015264),
            elevation: phase(0.020820),
            info: Info { id: 0xb000_0002, mode: 1, ..Info::default() },
            ..Station::default()
        },
    ]
}

impl Default for Scene {
    /// The paper's rig: two stations 0.57 m apart, a mote carried by hand half a metre to a metre before them, and
    /// the clock of a chip without a crystal.
    fn default() -> Self {
        let [station_a, station_b] = take5();
        Scene {
            length_s: 86_400.0,
            path: Path::HandHeld { low_m: [0.25, 0.8, 0.6], high_m: [0.85, 1.3, 1.1], mean_speed_m_per_s: 0.27 },
            clock: Clock::default(),
            receiver: Receiver::default(),
            // What differs from one sweep to the next on the 2020 recording: 0.48 to 0.70 mrad per rotor.
            timing: Timing { angle_noise_deg: 0.035, ..Timing::default() },
            optics: Optics::default(),
            interference: Interference::default(),
            station_a,
            station_b,
            mirrors: Vec::new(),
            strobes: Vec::new(),
            line_faults: Vec::new(),
        }
    }
}

/// The part of a scene that describes no room.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Unfit(
    /// What is wrong, for a person to read.
    pub &'static str,
);

impl core::fmt::Display for Unfit {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(self.0)
    }
}

impl core::error::Error for Unfit {}

impl Scene {
    /// The scene with a perfect receiver, perfect rotors' timing and a perfect clock: what is left is geometry.
    #[must_use]
    pub fn without_noise(self) -> Scene {
        Scene {
            receiver: Receiver {
                sync_width_bias_us: 0.0,
                sweep_width_bias_us: 0.0,
                sync_width_drift_us_per_s: 0.0,
                jitter_us: 0.0,
                even_jitter_us: 0.0,
                sync_dropout: 0.0,
                sweep_dropout: 0.0,
                ..self.receiver
            },
            timing: Timing { angle_noise_deg: 0.0, ..self.timing },
            clock: Clock { error: 0.0, drift_per_min: 0.0, wander: 0.0, ..self.clock },
            interference: Interference { rate_per_s: 0.0, ..self.interference },
            ..self
        }
    }

    /// The scene with all that happens in it `by_s` later. A drift of the receiver counts from power-on all the same.
    #[must_use]
    pub fn later(mut self, by_s: f64) -> Scene {
        for station in [&mut self.station_a, &mut self.station_b] {
            for occlusion in &mut station.occlusions {
                occlusion.from_s += by_s;
                occlusion.to_s += by_s;
            }
            if let Some(moved) = &mut station.moved {
                moved.at_s += by_s;
            }
        }
        for strobe in &mut self.strobes {
            strobe.first_s += by_s;
            strobe.to_s += by_s;
        }
        for fault in &mut self.line_faults {
            fault.from_s += by_s;
            fault.to_s += by_s;
        }
        self
    }

    /// Whether the numbers describe a room.
    ///
    /// # Errors
    /// The first part that does not.
    pub fn check(&self) -> Result<(), Unfit> {
        let share = |p: f64| (0.0..=1.0).contains(&p);
        let size = |x: f64| x.is_finite() && x >= 0.0;
        let seen = &self.receiver;
        let must = |fit: bool, why: &'static str| if fit { Ok(()) } else { Err(Unfit(why)) };
        must(size(self.length_s), "length_s is negative or no number")?;
        must(self.path.is_fit(), "the path has no extent, an inverted box or a speed that is no number")?;
        must(self.clock.is_fit(), "the clock could stop, or run at more than ten times its rate")?;
        must(size(seen.jitter_us) && seen.jitter_us <= 50.0, "jitter_us is not within 0 to 50")?;
        must(size(seen.even_jitter_us) && seen.even_jitter_us <= 50.0, "even_jitter_us is not within 0 to 50")?;
        must(seen.sync_width_drift_us_per_s.abs() <= 10.0, "sync_width_drift_us_per_s is beyond 10")?;
        must(
            seen.sensitivity.is_none_or(|s| s.reach_m > 0.0 && size(s.reach_m) && size(s.spread)),
            "the sensitivity reaches nowhere, or its spread is negative",
        )?;
        must(size(seen.min_width_us), "min_width_us is negative or no number")?;
        must(
            seen.sync_width_bias_us.is_finite() && seen.sync_width_bias_us.abs() <= 50.0,
            "sync_width_bias_us is beyond 50",
        )?;
        must(
            seen.sweep_width_bias_us.is_finite() && seen.sweep_width_bias_us.abs() <= 50.0,
            "sweep_width_bias_us is beyond 50",
        )?;
        must(share(seen.sync_dropout) && share(seen.sweep_dropout), "a dropout is not within 0 to 1")?;
        must(size(self.timing.first_sync_s) && self.timing.first_sync_s >= 1e-3, "first_sync_s is before 1 ms")?;
        must((350.0..=450.0).contains(&self.timing.sync_gap_us), "sync_gap_us is not within 350 to 450")?;
        must(self.timing.half_turn_error_ppm.abs() <= 1e5, "half_turn_error_ppm is beyond 100,000")?;
        must(
            size(self.timing.angle_noise_deg) && self.timing.angle_noise_deg <= 2.0,
            "angle_noise_deg is not within 0 to 2",
        )?;
        must(
            self.optics.half_field_deg > 0.0 && self.optics.half_field_deg <= 70.0,
            "half_field_deg is not within 0 to 70",
        )?;
        must(self.optics.reach_m > 0.0 && self.optics.line_mm > 0.0, "reach_m or line_mm is not positive")?;
        must(
            size(self.interference.rate_per_s) && self.interference.rate_per_s <= 1e5,
            "rate_per_s is not within 0 to 100,000",
        )?;
        must(
            self.interference.shortest_us > 0.0
                && self.interference.longest_us.is_finite()
                && self.interference.longest_us >= self.interference.shortest_us,
            "the interference is longest before it is shortest",
        )?;
        must(
            self.mirrors.iter().all(|m| share(m.probability) && share(m.alone)),
            "a mirror's probability is not within 0 to 1",
        )?;
        must(
            self.mirrors.iter().all(|m| m.gain[0] > 0.0 && size(m.gain[1]) && m.gain[1] >= m.gain[0]),
            "a mirror's gain is not positive, or upside down",
        )?;
        must(
            self.strobes
                .iter()
                .all(|s| s.rate_hz > 0.0 && s.burst_us > 0.0 && s.burst_us * 1e-6 * s.rate_hz < 1.0 && size(s.first_s)),
            "a strobe is never dark, or begins before time",
        )?;
        must(
            self.line_faults.iter().all(LineFault::is_fit),
            "a line fault ends before it begins, or storms at no rate",
        )?;
        must(self.mirrors.iter().all(|m| m.normal.iter().any(|&n| n != 0.0)), "a mirror has no normal")?;
        // Field, noise and factory terms together stay within the half turn, or a sweep would come before its flash.
        must(
            [&self.station_a, &self.station_b]
                .iter()
                .all(|station| station.azimuth.is_fit() && station.elevation.is_fit()),
            "a rotor strays by more than 0.1 rad",
        )?;
        let moved = [&self.station_a, &self.station_b].map(Station::after_its_move);
        must(
            self.station_a.is_rigid() && self.station_b.is_rigid() && moved.iter().flatten().all(Station::is_rigid),
            "a station's rotation is not a rotation",
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_scene_describes_a_room() {
        assert_eq!(Scene::default().check(), Ok(()));
        assert_eq!(Scene::default().without_noise().check(), Ok(()));
    }

    #[test]
    fn the_whole_default_box_is_in_the_field_of_both_stations() {
        let scene = Scene::default();
        let Path::HandHeld { low_m, high_m, .. } = scene.path else { panic!("the default path is hand-held") };
        for corner in 0..8 {
            let p: [f64; 3] = core::array::from_fn(|axis| if corner >> axis & 1 == 0 { low_m } else { high_m }[axis]);
            for station in [&scene.station_a, &scene.station_b] {
                let sight = station.sight(p.into());
                assert!(sight.in_field(&scene.optics) && sight.lit(&scene.optics), "corner {p:?}");
            }
        }
    }

    #[test]
    fn a_scene_survives_being_written_down() {
        let scene = Scene::default();
        let text = toml::to_string(&scene).expect("a scene can be written");
        assert_eq!(toml::from_str::<Scene>(&text), Ok(scene));
    }

    #[test]
    fn a_scene_file_names_only_what_differs_from_the_default() {
        let scene: Scene = toml::from_str("[receiver]\njitter_us = 5.0").expect("a part of a scene");
        assert_eq!(scene.receiver.jitter_us, 5.0);
        assert_eq!(scene.station_b, Scene::default().station_b);
    }

    #[test]
    fn a_room_that_cannot_be_is_refused_by_name() {
        let mut scene = Scene::default();
        scene.station_b.rotation[0][0] = 1.0;
        assert_eq!(scene.check(), Err(Unfit("a station's rotation is not a rotation")));
    }
}
