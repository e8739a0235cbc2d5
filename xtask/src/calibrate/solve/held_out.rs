//! How good a model is on light it was not fitted to: the recording in blocks of time, each left out once.
//!
//! Blocks and not random sightings: neighbours in time share their errors, and a model that learns them would look
//! good.
//!
//! What can go wrong: a mote that only once went to some corner; that block is an extrapolation and says so.

use nalgebra::{Matrix3, Vector3};

use super::model::{Fitted, V3, add, dot, length, median, scale, sub};
use super::refine::{Data, Free, Guess, Point};
use super::solution::HeldOut;
use crate::reference::ideal;

/// Blocks.
pub(super) const FOLDS: usize = 5;
/// Four angles make a place when they come within this, seconds: six cycles would be too old, three still a cycle
/// with some sweeps missing.
const TOGETHER_S: f64 = 0.1;
/// Rounds of a fit that begins beside its end.
const ROUNDS: usize = 4;

/// Fits with each block left out, and looks at what was left out; residuals count as at most `limit` per rotor.
pub(super) fn judge(data: Data<'_>, guess: Guess, free: Free, limit: &[[f64; 2]; 2]) -> HeldOut {
    let block = data.points.len().div_ceil(FOLDS).max(1);
    let mut squares = [[(0.0, 0usize); 2]; 2];
    let (mut clipped, mut rejected) = (0.0, 0);
    let mut errors = Vec::new();
    for left_out in 0..FOLDS {
        let within = |k: usize| k / block == left_out;
        let (out, rest): (Vec<_>, Vec<_>) = data.points.iter().enumerate().partition(|(k, _)| within(*k));
        let points = |some: Vec<(usize, &Point)>| some.into_iter().map(|(_, point)| *point).collect::<Vec<_>>();
        let (out, rest) = (points(out), points(rest));
        let fitted = Data { points: &rest, ..data }.fit(guess, free, ROUNDS).guess;
        let mut newest: [Option<(Point, bool)>; 4] = [None; 4];
        for point in out {
            let residual = data.residual(&fitted, &point).abs();
            let most = limit[point.station][point.axis];
            clipped += residual.min(most).powi(2);
            let kept = residual < most;
            if kept {
                let sum = &mut squares[point.station][point.axis];
                *sum = (sum.0 + residual * residual, sum.1 + 1);
            } else {
                rejected += 1;
            }
            newest[2 * point.station + point.axis] = Some((point, kept));
            let [Some(a), Some(b), Some(c), Some(d)] = newest else { continue };
            let four = [a, b, c, d];
            if four.iter().all(|(other, _)| point.at_s - other.at_s <= TOGETHER_S) {
                newest = [None; 4];
                if four.iter().all(|(_, kept)| *kept) {
                    errors.extend(error(&data, &fitted, four.map(|(point, _)| point)));
                }
            }
        }
    }
    let count = data.points.len().max(1) as f64;
    let places = errors.len();
    HeldOut {
        folds: FOLDS,
        rms: squares.map(|station| station.map(|(sum, n)| (sum / n as f64).sqrt())),
        scatter: (clipped / count).sqrt(),
        rejected_share: f64::from(rejected) / count,
        places,
        mean_3d_m: errors.iter().sum::<f64>() / places as f64,
        median_3d_m: median(&mut errors),
    }
}

/// How far from the truth four angles meet. Each plane is first moved by how far the mote went since, so that what
/// remains is the room's error and not the motion's.
fn error(data: &Data<'_>, guess: &Guess, four: [Point; 4]) -> Option<f64> {
    let places = four.map(|point| data.position(guess, &point));
    let truth = places[3];
    let mut square = Matrix3::zeros();
    let mut right = Vector3::zeros();
    for (k, (point, place)) in four.iter().zip(places).enumerate() {
        let station = &guess.stations[point.station];
        let angle = undone(station, point.axis, point.angle, four[k ^ 1].angle);
        let (sin, cos) = angle.sin_cos();
        let n: V3 = sub(scale(station.rotation[point.axis], cos), scale(station.rotation[2], sin));
        let moved = sub(truth, place);
        let weight = length(sub(place, station.position)).powi(-2);
        let n_ = Vector3::from(n);
        square += n_ * n_.transpose() * weight;
        right += n_ * dot(n, add(station.position, moved)) * weight;
    }
    let found: V3 = square.cholesky()?.solve(&right).into();
    Some(length(sub(found, truth)))
}

/// The ideal angle of a measured one.
fn undone(station: &Fitted, axis: usize, measured: f64, other: f64) -> f64 {
    let pose = station.pose();
    ideal(&pose.factory[axis], measured, (other + pose.factory[1 - axis].phase).tan())
}
