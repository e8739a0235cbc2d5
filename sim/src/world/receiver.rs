//! The photodiode and its comparator: what of the light becomes edges.
//!
//! The receiver sees intensity and no sender: pulses that overlap are one pulse. It stretches or shortens what it
//! sees, jitters every edge, misses some pulses, and rings at strangers such as remote controls.
//!
//! What can go wrong: a bias moves the falling edge alone, so it shifts the middle of a sweep by half of it; real
//! receivers move both edges by shares nobody has measured.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::noise::Noise;

/// What is wrong with the receiver.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Receiver {
    /// Added to the width of every sync flash, microseconds. Recorded photodiodes: 0 to -10.4, steady for each.
    pub sync_width_bias_us: f64,
    /// Added to the width of every sweep, microseconds.
    pub sweep_width_bias_us: f64,
    /// Deviation of every edge, gaussian, microseconds.
    pub jitter_us: f64,
    /// Probability that a sync flash is missed.
    pub sync_dropout: f64,
    /// Probability that a sweep is missed.
    pub sweep_dropout: f64,
    /// Shorter light than this is not noticed, microseconds.
    pub min_width_us: f64,
    /// Where the photodiode looks; without it, everywhere.
    pub facing: Option<Facing>,
}

impl Default for Receiver {
    fn default() -> Self {
        Receiver {
            sync_width_bias_us: -2.0,
            sweep_width_bias_us: 0.0,
            jitter_us: 0.5,
            sync_dropout: 0.05,
            sweep_dropout: 0.05,
            min_width_us: 0.5,
            facing: None,
        }
    }
}

/// A photodiode held in one direction.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Facing {
    /// Where it looks, in the world; any length.
    pub normal: [f64; 3],
    /// Light from further to the side is lost, degrees.
    pub max_incidence_deg: f64,
}

/// Infrared that comes from no station: pulses at random times.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Interference {
    /// Pulses per second.
    pub rate_per_s: f64,
    /// The shortest, microseconds.
    pub shortest_us: f64,
    /// The longest, microseconds.
    pub longest_us: f64,
}

impl Default for Interference {
    fn default() -> Self {
        Interference { rate_per_s: 0.0, shortest_us: 1.0, longest_us: 200.0 }
    }
}

/// A plane that sends the sweeps to the mote a second time, from elsewhere.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Mirror {
    /// A point of the plane, metres.
    pub point_m: [f64; 3],
    /// Out of the shining side; any length.
    pub normal: [f64; 3],
    /// Probability that a reflected sweep is bright enough to be seen.
    pub probability: f64,
}

/// A stretch of light at the photodiode, true seconds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Pulse {
    pub(super) rise_s: f64,
    pub(super) fall_s: f64,
}

impl Receiver {
    /// The most an edge comes early, seconds.
    pub(super) fn earliest_s(&self) -> f64 {
        super::noise::SIGMA_LIMIT * self.jitter_us * 1e-6
    }

    pub(super) fn sync(&self, light: Pulse, noise: &mut Noise) -> Option<Pulse> {
        self.receive(light, self.sync_width_bias_us, self.sync_dropout, noise)
    }

    pub(super) fn sweep(&self, light: Pulse, noise: &mut Noise) -> Option<Pulse> {
        self.receive(light, self.sweep_width_bias_us, self.sweep_dropout, noise)
    }

    /// Draws the same count of numbers whether or not the pulse is seen.
    fn receive(&self, light: Pulse, bias_us: f64, dropout: f64, noise: &mut Noise) -> Option<Pulse> {
        let missed = noise.uniform() < dropout;
        let rise_s = light.rise_s + noise.gaussian() * self.jitter_us * 1e-6;
        let fall_s = light.fall_s + (bias_us + noise.gaussian() * self.jitter_us) * 1e-6;
        (!missed && fall_s > rise_s).then_some(Pulse { rise_s, fall_s })
    }

    /// Whether light that comes from `from` reaches a photodiode at `at`.
    pub(super) fn faces(&self, at: Vector3<f64>, from: Vector3<f64>) -> bool {
        self.facing.is_none_or(|facing| {
            let (normal, to) = (Vector3::from(facing.normal), from - at);
            normal.dot(&to) >= normal.norm() * to.norm() * libm::cos(facing.max_incidence_deg.to_radians())
        })
    }
}

impl Mirror {
    /// The place behind the plane where `p` seems to be.
    pub(super) fn image(&self, p: Vector3<f64>) -> Vector3<f64> {
        let normal = Vector3::from(self.normal);
        p - normal * (2.0 * self.height(p) / normal.norm_squared())
    }

    /// Whether a place is on the shining side.
    pub(super) fn shows(&self, p: Vector3<f64>) -> bool {
        self.height(p) > 0.0
    }

    fn height(&self, p: Vector3<f64>) -> f64 {
        (p - Vector3::from(self.point_m)).dot(&Vector3::from(self.normal))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_image_is_as_far_behind_the_mirror_as_the_thing_before_it() {
        let wall = Mirror { point_m: [1.0, 0.0, 0.0], normal: [-2.0, 0.0, 0.0], probability: 1.0 };
        let image = wall.image(Vector3::new(0.25, 3.0, 4.0));
        assert!((image - Vector3::new(1.75, 3.0, 4.0)).norm() < 1e-12);
        assert!(wall.shows(Vector3::zeros()) && !wall.shows(image));
    }

    #[test]
    fn a_photodiode_is_blind_behind() {
        let facing = Facing { normal: [0.0, 0.0, 1.0], max_incidence_deg: 70.0 };
        let receiver = Receiver { facing: Some(facing), ..Receiver::default() };
        let sees = |from: [f64; 3]| receiver.faces(Vector3::zeros(), from.into());
        assert!(sees([0.0, 0.0, 2.0]) && sees([1.0, 0.0, 0.5]));
        assert!(!sees([1.0, 0.0, 0.2]) && !sees([0.0, 0.0, -1.0]));
    }
}
