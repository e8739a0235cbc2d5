//! The photodiode and its comparator: what of the light becomes edges.
//!
//! The receiver sees intensity and no sender: pulses that overlap are one pulse. It stretches or shortens what it
//! sees, jitters every edge, misses some pulses, and rings at strangers such as remote controls and the strobes of
//! motion capture. Behind it is a line to the chip, which can be stuck or oscillate.
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
    /// How the bias of flashes changes, microseconds per second of true time: a receiver that warms up.
    pub sync_width_drift_us_per_s: f64,
    /// Deviation of every edge, gaussian, microseconds.
    pub jitter_us: f64,
    /// Besides, every edge moves by up to this, evenly spread, microseconds.
    pub even_jitter_us: f64,
    /// Probability that a sync flash is missed.
    pub sync_dropout: f64,
    /// Probability that a sweep is missed.
    pub sweep_dropout: f64,
    /// Shorter light than this is not noticed, microseconds.
    pub min_width_us: f64,
    /// Where the photodiode looks; without it, everywhere.
    pub facing: Option<Facing>,
    /// How weak light is missed; without it, none is for being weak.
    pub sensitivity: Option<Sensitivity>,
}

impl Default for Receiver {
    fn default() -> Self {
        Receiver {
            sync_width_bias_us: -2.0,
            sweep_width_bias_us: 0.0,
            sync_width_drift_us_per_s: 0.0,
            jitter_us: 0.5,
            even_jitter_us: 0.0,
            sync_dropout: 0.05,
            sweep_dropout: 0.05,
            min_width_us: 0.5,
            facing: None,
            sensitivity: None,
        }
    }
}

/// A comparator's threshold against light that falls with the square of the distance and, on a photodiode that
/// looks elsewhere, with the cosine of the incidence.
///
/// A model with two free numbers: nobody has published the chip's curve in a form to take them from.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sensitivity {
    /// Light that falls straight on is at the threshold from here, metres.
    pub reach_m: f64,
    /// Deviation of the light from pulse to pulse, gaussian, as a share of it.
    pub spread: f64,
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

/// Infrared that comes from a motion-capture system: bursts at a steady rate, which slide over the flashes for being
/// locked to another crystal.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Strobe {
    /// Bursts per second.
    pub rate_hz: f64,
    /// How long each lasts, microseconds: an exposure, 250 to 1,000.
    pub burst_us: f64,
    /// When the first begins, true seconds.
    pub first_s: f64,
    /// None begins from here on, true seconds.
    pub to_s: f64,
}

impl Strobe {
    /// The bursts that begin from `from_s` until just before `to_s`.
    pub(super) fn bursts(&self, from_s: f64, to_s: f64) -> impl Iterator<Item = Pulse> + use<> {
        square(self.first_s, self.rate_hz, self.burst_us * 1e-6, from_s.max(self.first_s), to_s.min(self.to_s))
    }
}

/// Something is wrong with the line from the receiver to the chip for a while.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LineFault {
    /// From this true time on, seconds.
    pub from_s: f64,
    /// Until just before this true time, seconds.
    pub to_s: f64,
    /// What the line does.
    pub line: Line,
}

/// What a line does that is not well.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum Line {
    /// Says light, whatever there is.
    StuckHigh,
    /// Says dark, whatever there is.
    StuckLow,
    /// Oscillates, whatever there is.
    Storm {
        /// Periods, of one rise and one fall, per second.
        hz: f64,
    },
}

impl LineFault {
    /// What the fault adds that begins from `from_s` until just before `to_s`.
    pub(super) fn pulses(&self, from_s: f64, to_s: f64) -> Vec<Pulse> {
        match self.line {
            Line::StuckHigh if (from_s..to_s).contains(&self.from_s) => {
                vec![Pulse { rise_s: self.from_s, fall_s: self.to_s }]
            }
            Line::Storm { hz } => {
                square(self.from_s, hz, 0.5 / hz, from_s.max(self.from_s), to_s.min(self.to_s)).collect()
            }
            Line::StuckHigh | Line::StuckLow => Vec::new(),
        }
    }

    /// What is left of light: a line that is stuck low or oscillates does not pass it on.
    pub(super) fn pass(&self, mut pulse: Pulse) -> Pulse {
        if self.line != Line::StuckHigh {
            let dark = self.from_s..self.to_s;
            if dark.contains(&pulse.rise_s) {
                pulse.rise_s = self.to_s;
            }
            if dark.contains(&pulse.fall_s) {
                pulse.fall_s = self.from_s;
            }
        }
        pulse
    }

    pub(super) fn is_fit(&self) -> bool {
        let rate = match self.line {
            Line::Storm { hz } => hz > 0.0 && hz <= 1e6,
            Line::StuckHigh | Line::StuckLow => true,
        };
        rate && self.from_s >= 0.0 && self.to_s > self.from_s && self.to_s.is_finite()
    }
}

/// Pulses of a steady rate since `first_s`, of which those that rise within `from_s..to_s`.
fn square(first_s: f64, hz: f64, width_s: f64, from_s: f64, to_s: f64) -> impl Iterator<Item = Pulse> {
    let nth = move |n: u64| first_s + n as f64 / hz;
    // One early, and those before `from_s` skipped: the division may round either way.
    let start = libm::ceil(((from_s - first_s) * hz).max(0.0)).max(1.0) as u64 - 1;
    (start..)
        .map(nth)
        .skip_while(move |rise_s| *rise_s < from_s)
        .take_while(move |rise_s| *rise_s < to_s)
        .map(move |rise_s| Pulse { rise_s, fall_s: rise_s + width_s })
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
    /// The least and the most of how much longer than the direct one's the reflected pulse is: stronger light is longer
    /// above the threshold.
    pub gain: [f64; 2],
    /// Probability that a bright reflection comes without the direct sweep: something else stands in its way.
    pub alone: f64,
}

impl Default for Mirror {
    fn default() -> Self {
        Mirror { point_m: [0.0; 3], normal: [0.0, 1.0, 0.0], probability: 1.0, gain: [1.0, 1.0], alone: 0.0 }
    }
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
        (super::noise::SIGMA_LIMIT * self.jitter_us + self.even_jitter_us) * 1e-6
    }

    pub(super) fn sync(&self, light: Pulse, noise: &mut Noise) -> Option<Pulse> {
        let drift_us = self.sync_width_drift_us_per_s * light.rise_s;
        self.receive(light, self.sync_width_bias_us + drift_us, self.sync_dropout, noise)
    }

    pub(super) fn sweep(&self, light: Pulse, noise: &mut Noise) -> Option<Pulse> {
        self.receive(light, self.sweep_width_bias_us, self.sweep_dropout, noise)
    }

    /// Draws the same count of numbers whether or not the pulse is seen.
    fn receive(&self, light: Pulse, bias_us: f64, dropout: f64, noise: &mut Noise) -> Option<Pulse> {
        let missed = noise.uniform() < dropout;
        let mut rise_s = light.rise_s + noise.gaussian() * self.jitter_us * 1e-6;
        let mut fall_s = light.fall_s + (bias_us + noise.gaussian() * self.jitter_us) * 1e-6;
        if self.even_jitter_us > 0.0 {
            rise_s += noise.between(-1e-6, 1e-6) * self.even_jitter_us;
            fall_s += noise.between(-1e-6, 1e-6) * self.even_jitter_us;
        }
        (!missed && fall_s > rise_s).then_some(Pulse { rise_s, fall_s })
    }

    /// Whether light from `from` is strong enough at `at`.
    pub(super) fn notices(&self, at: Vector3<f64>, from: Vector3<f64>, noise: &mut Noise) -> bool {
        self.sensitivity.is_none_or(|sensitivity| {
            let to = from - at;
            let cosine = self.facing.map_or(1.0, |facing| {
                let normal = Vector3::from(facing.normal);
                normal.dot(&to) / (normal.norm() * to.norm())
            });
            let light = cosine * sensitivity.reach_m * sensitivity.reach_m / to.norm_squared();
            light * (1.0 + sensitivity.spread * noise.gaussian()) >= 1.0
        })
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
        let wall = Mirror { point_m: [1.0, 0.0, 0.0], normal: [-2.0, 0.0, 0.0], ..Mirror::default() };
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
