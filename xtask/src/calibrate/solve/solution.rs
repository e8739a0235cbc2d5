//! A calibrated room, and what it leaves of every sweep.
//!
//! What can go wrong: figures of a fit are read as figures of a room. Only [`HeldOut`] is of sweeps that were not fitted.

use nalgebra::Vector3;

use super::model::{Fitted, median};
use super::refine::{Data, Fit, Free, TUKEY};
use crate::reference::Pose as Station;

/// A calibrated room.
#[derive(Clone, Debug)]
pub struct Solution {
    /// A, then B.
    pub stations: [Station; 2],
    /// The truth's clock less the mote's in the middle of the walk, seconds; with one clock, by how much the truth is late.
    pub offset_s: f64,
    /// When that is, seconds of the mote's clock.
    pub middle_s: f64,
    /// By how much it grows, seconds per second; none where that was not fitted.
    pub drift: Option<f64>,
    /// From what the truth tracks to the photodiode, in the body's axes, metres; none where it was not fitted.
    pub lever_arm: Option<Vector3<f64>>,
    /// Why each term was fitted or left alone, a sentence each.
    pub evidence: Vec<String>,
    /// Every sighting that has truth at its time, in the order of time.
    pub residuals: Vec<Residual>,
    /// By station and axis.
    pub per_rotor: [[RotorFit; 2]; 2],
    /// Condition number of the least squares, its unknowns scaled to one another.
    pub condition: f64,
    /// On sweeps that were not fitted.
    pub held_out: HeldOut,
}

/// What the solution leaves of one sighting.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Residual {
    /// As in the sighting.
    pub at_s: f64,
    /// 0 is A.
    pub station: usize,
    /// 0 is azimuth.
    pub axis: usize,
    /// As in the sighting, radians.
    pub measured: f64,
    /// What the solution makes of the truth, radians.
    pub predicted: f64,
    /// Measured less predicted, radians.
    pub residual: f64,
    /// Whether it counted.
    pub kept: bool,
    /// Where the photodiode was, metres.
    pub position: Vector3<f64>,
}

/// How one rotor's angles agree.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RotorFit {
    /// Sightings with truth.
    pub n: usize,
    /// Root mean square of those that counted, radians.
    pub rms: f64,
    /// Median of the absolute residual of all, radians.
    pub median_abs: f64,
    /// Share that did not count.
    pub rejected_share: f64,
}

/// Figures on blocks of time that were left out of the fit, each once.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HeldOut {
    /// How many blocks.
    pub folds: usize,
    /// Root mean square by station and axis, of sweeps that a fit would have kept, radians.
    pub rms: [[f64; 2]; 2],
    /// Root mean square of all of them, those that a fit would not have kept counting as its limit, radians.
    pub scatter: f64,
    /// Share of the others.
    pub rejected_share: f64,
    /// How many times four such sweeps came within 0.1 s and made a place.
    pub places: usize,
    /// Mean distance of those places from the truth, metres.
    pub mean_3d_m: f64,
    /// The median.
    pub median_3d_m: f64,
}

/// What a fit that came to rest says.
pub(super) fn of(data: Data<'_>, fit: &Fit, free: Free, held_out: HeldOut, evidence: Vec<String>) -> Solution {
    let mut residuals = Vec::with_capacity(data.points.len());
    for point in data.points {
        let residual = data.residual(&fit.guess, point);
        residuals.push(Residual {
            at_s: point.at_s,
            station: point.station,
            axis: point.axis,
            measured: point.angle,
            predicted: point.angle - residual,
            residual,
            kept: residual.abs() < TUKEY * fit.scatter[point.station][point.axis],
            position: data.position(&fit.guess, point).into(),
        });
    }
    let rotor = |station: usize, axis: usize| {
        let own: Vec<&Residual> = residuals.iter().filter(|r| r.station == station && r.axis == axis).collect();
        let kept: Vec<f64> = own.iter().filter(|r| r.kept).map(|r| r.residual * r.residual).collect();
        RotorFit {
            n: own.len(),
            rms: (kept.iter().sum::<f64>() / kept.len() as f64).sqrt(),
            median_abs: median(&mut own.iter().map(|r| r.residual.abs()).collect::<Vec<_>>()),
            rejected_share: 1.0 - kept.len() as f64 / own.len() as f64,
        }
    };
    let per_rotor = std::array::from_fn(|station| std::array::from_fn(|axis| rotor(station, axis)));
    Solution {
        stations: fit.guess.stations.each_ref().map(Fitted::pose),
        offset_s: fit.guess.offset_s,
        middle_s: fit.guess.middle_s,
        drift: free.drift.then_some(fit.guess.drift),
        lever_arm: free.lever.then(|| fit.guess.lever.into()),
        evidence,
        residuals,
        per_rotor,
        condition: fit.condition,
        held_out,
    }
}
