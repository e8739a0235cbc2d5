//! What the clocks of the truth and of the mote differ by, without a guess.
//!
//! # Design
//! At the right offset a rotor's tangents are a projective function of the place: seven numbers, linear in the
//! tangents. For each offset on a grid that function is fitted per rotor, outliers doubted, and what it leaves over
//! compared. Poses come only after: a grid step costs four small linear systems.
//!
//! What can go wrong: a motion that repeats itself fits at several offsets; all of them are returned, best first, and
//! the poses decide.

use nalgebra::{SMatrix, SVector};

use super::model::{V3, median, scale, sub};
use super::observation::Sighting;
use super::path::Path;

/// Step of the grid, seconds: a hand changes its mind a few times a second at most.
const STEP_S: f64 = 0.04;
/// Sightings per rotor and offset.
const SAMPLE: usize = 200;
/// At these angles tangents say more about noise than about the place, radians.
const STEEP: f64 = 1.2;
/// Of the sightings that can be paired at the best offset, so many must be.
const LEAST_SHARE: f64 = 0.4;
/// Unknowns per rotor.
const N: usize = 7;

/// The offsets (truth clock less mote clock) within `range` at which the places explain the angles best, best first.
pub(super) fn candidates(
    sightings: &[Sighting],
    path: &Path,
    range: (f64, f64),
    most: usize,
    progress: &mut dyn FnMut(&str, f64),
) -> Vec<f64> {
    let rotors: Vec<Vec<&Sighting>> = (0..4)
        .map(|rotor| {
            let own = |s: &&Sighting| 2 * s.station + s.axis == rotor && s.angle.abs() < STEEP;
            let own: Vec<&Sighting> = sightings.iter().filter(own).collect();
            let count = SAMPLE.min(own.len());
            (0..count).map(|k| own[k * own.len() / count]).collect()
        })
        .collect();
    let places = path.places();
    let middle: V3 = std::array::from_fn(|k| median(&mut places.iter().map(|place| place[k]).collect::<Vec<_>>()));
    let size = median(&mut places.iter().map(|place| super::model::length(sub(*place, middle))).collect::<Vec<_>>());
    let steps = ((range.1 - range.0) / STEP_S).ceil().max(1.0) as usize;
    let step = (range.1 - range.0) / steps as f64;
    let mut scores: Vec<(f64, f64, usize)> = Vec::with_capacity(steps + 1);
    for k in 0..=steps {
        if k % 64 == 0 {
            progress("looking for the offset of the clocks", k as f64 / steps as f64);
        }
        let offset = range.0 + step * k as f64;
        let (mut score, mut paired, mut counted) = (0.0, 0, 0);
        for rotor in &rotors {
            let pairs: Vec<(V3, f64)> = rotor
                .iter()
                .filter_map(|s| {
                    Some((scale(sub(path.at(s.at_s + offset)?, middle), 1.0 / size.max(1e-6)), s.angle.tan()))
                })
                .collect();
            paired += pairs.len();
            if let Some(left) = left_over(&pairs) {
                score += left.ln();
                counted += 1;
            }
        }
        if counted > 0 {
            scores.push((offset, score / f64::from(counted), paired));
        }
    }
    let most_paired = scores.iter().map(|score| score.2).max().unwrap_or(0);
    scores.retain(|score| score.2 as f64 >= LEAST_SHARE * most_paired as f64);
    let mut order: Vec<usize> = (0..scores.len()).collect();
    order.sort_by(|&a, &b| scores[a].1.total_cmp(&scores[b].1));
    let mut found: Vec<f64> = Vec::new();
    for index in order {
        let offset_s = scores[index].0;
        // One from each valley: not beside a better one.
        if found.iter().all(|other| (other - offset_s).abs() > 8.0 * STEP_S) {
            found.push(offset_s);
        }
        if found.len() == most {
            break;
        }
    }
    found
}

/// The median of what the best projective function leaves of the tangents; none for too few.
fn left_over(pairs: &[(V3, f64)]) -> Option<f64> {
    if pairs.len() < 4 * N {
        return None;
    }
    let row = |(p, t): &(V3, f64)| [p[0], p[1], p[2], 1.0, -t * p[0], -t * p[1], -t * p[2]];
    let mut solution: Option<[f64; N]> = None;
    let mut residuals = vec![0.0; pairs.len()];
    let mut scatter = f64::INFINITY;
    for _ in 0..4 {
        let mut square = SMatrix::<f64, N, N>::identity() * (1e-4 * pairs.len() as f64);
        let mut right = SVector::<f64, N>::zeros();
        for (k, pair) in pairs.iter().enumerate() {
            let row = row(pair);
            let weight = if solution.is_some() { 1.0 / (1.0 + (residuals[k] / (2.0 * scatter)).powi(2)) } else { 1.0 };
            for i in 0..N {
                right[i] += weight * row[i] * pair.1;
                for j in 0..N {
                    square[(i, j)] += weight * row[i] * row[j];
                }
            }
        }
        let found = square.cholesky()?.solve(&right);
        let solved: [f64; N] = std::array::from_fn(|k| found[k]);
        for (residual, pair) in residuals.iter_mut().zip(pairs) {
            let row = row(pair);
            let depth = 1.0 + (0..3).map(|k| pair.0[k] * solved[4 + k]).sum::<f64>();
            let algebraic = pair.1 - (0..N).map(|k| row[k] * solved[k]).sum::<f64>();
            *residual = (algebraic / depth.abs().max(0.2)).abs();
        }
        solution = Some(solved);
        scatter = median(&mut residuals.clone()).max(1e-6);
    }
    Some(scatter)
}
