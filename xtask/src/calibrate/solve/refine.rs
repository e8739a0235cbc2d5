//! The least squares of all that is unknown at once, by Levenberg and Marquardt, with outliers weighed down.
//!
//! # Design
//! Each rotor's angles count by that rotor's own scatter, taken anew from the median between rounds. Cauchy's loss
//! first, which finds its way from far off, then Tukey's, which forgets outliers altogether.
//!
//! The `levenberg-marquardt` package wants another nalgebra; the loop is eighty lines.
//!
//! What can go wrong: data that do not tell some of the unknowns apart. The step is damped and ends somewhere; the
//! condition number and the standard deviations tell.

use nalgebra::{DMatrix, DVector, SymmetricEigen};

use super::model::{Fitted, PER_STATION, TERMS, V3, add, cross, dot, median};
use super::observation::Attitude;
use super::path::{Path, attitude};

/// All numbers that can be fitted: two stations, the clocks' offset and drift, the lever arm.
const ALL: usize = 2 * PER_STATION + SHARED;
const SHARED: usize = 5;
const OFFSET: usize = 2 * PER_STATION;
const DRIFT: usize = OFFSET + 1;
const LEVER: usize = DRIFT + 1;
/// How factory terms spread, radians: stations seen in the field have phases up to 0.06, tilts up to 0.006 and
/// once-per-turn terms up to 0.017.
const SPREAD: [f64; TERMS] = [0.05, 0.004, 0.01, 0.01];
/// Residual of a point behind its station, radians: as far as it can be.
const BEHIND: f64 = std::f64::consts::PI;
/// No rotor is better than this, radians: half a tick of a 10 MHz timer.
const LEAST_SCATTER: f64 = 2e-5;
/// Scatter over median of a Gaussian's absolute values.
const SCATTER_PER_MEDIAN: f64 = 1.4826;
/// Tukey's limit in scatters: 95 % as good as least squares where there are no outliers.
pub(super) const TUKEY: f64 = 4.685;
/// Cauchy's, likewise.
const CAUCHY: f64 = 2.385;

/// One sighting, paired.
#[derive(Clone, Copy, Debug)]
pub(super) struct Point {
    pub at_s: f64,
    pub station: usize,
    pub axis: usize,
    pub angle: f64,
}

/// What is fitted besides the poses.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Free {
    pub offset: bool,
    pub drift: bool,
    /// The first so many of [`TERMS`] of each station's rotors.
    pub terms: [usize; 2],
    pub lever: bool,
}

impl Free {
    fn columns(self) -> Vec<usize> {
        let station = |s: usize| {
            let terms = (0..2).flat_map(move |axis| (0..self.terms[s]).map(move |k| 6 + axis * TERMS + k));
            (0..6).chain(terms).map(move |k| s * PER_STATION + k)
        };
        let mut columns: Vec<usize> = station(0).chain(station(1)).collect();
        if self.offset {
            columns.push(OFFSET);
        }
        if self.drift {
            columns.push(DRIFT);
        }
        if self.lever {
            columns.extend(LEVER..ALL);
        }
        columns
    }
}

/// A room while it is being fitted.
#[derive(Clone, Copy, Debug)]
pub(super) struct Guess {
    pub stations: [Fitted; 2],
    /// Truth clock less mote clock in the middle of the walk, seconds.
    pub offset_s: f64,
    /// When that is, seconds of the mote's clock.
    pub middle_s: f64,
    /// By how much that grows, seconds per second.
    pub drift: f64,
    /// From what the truth tracks to the photodiode, in the body's axes, metres.
    pub lever: V3,
}

impl Guess {
    /// What the truth's clock says when the mote's says `at_s`, seconds.
    pub(super) fn truth_s(&self, at_s: f64) -> f64 {
        at_s + self.offset_s + self.drift * (at_s - self.middle_s)
    }
}

/// How outliers are weighed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Loss {
    Cauchy,
    Tukey,
}

impl Loss {
    /// Loss and weight of a residual in scatters.
    fn of(self, r: f64) -> (f64, f64) {
        match self {
            Loss::Cauchy => {
                let u = 1.0 + (r / CAUCHY).powi(2);
                (0.5 * CAUCHY * CAUCHY * u.ln(), 1.0 / u)
            }
            Loss::Tukey => {
                let u = (1.0 - (r / TUKEY).powi(2)).max(0.0);
                (TUKEY * TUKEY / 6.0 * (1.0 - u * u * u), u * u)
            }
        }
    }
}

/// What is known: sightings, and where the mote was.
#[derive(Clone, Copy)]
pub(super) struct Data<'a> {
    pub points: &'a [Point],
    pub path: &'a Path,
    pub attitudes: &'a [Attitude],
}

/// A fit that came to rest.
#[derive(Clone, Debug)]
pub(super) struct Fit {
    pub guess: Guess,
    /// Per rotor, radians.
    pub scatter: [[f64; 2]; 2],
    /// Of the unknowns scaled to one another.
    pub condition: f64,
    /// Standard deviations: of the stations' places, metres, of the offset, seconds, and of the drift.
    pub position_sd: [f64; 2],
    pub offset_sd: f64,
    pub drift_sd: f64,
}

struct Normal {
    cost: f64,
    square: Vec<[f64; ALL]>,
    slope: [f64; ALL],
}

impl Data<'_> {
    /// The photodiode's place for a sighting, its velocity, and the body's turn.
    fn place(&self, guess: &Guess, point: &Point) -> (V3, V3, Option<[V3; 3]>) {
        let t = guess.truth_s(point.at_s);
        let (place, velocity) = self.path.anywhere(t);
        match attitude(self.attitudes, t) {
            Some(body) => (add(place, body.map(|row| dot(row, guess.lever))), velocity, Some(body)),
            None => (place, velocity, None),
        }
    }

    /// Where the photodiode was.
    pub(super) fn position(&self, guess: &Guess, point: &Point) -> V3 {
        self.place(guess, point).0
    }

    /// Measured less predicted, radians.
    pub(super) fn residual(&self, guess: &Guess, point: &Point) -> f64 {
        let station = &guess.stations[point.station];
        let c = station.see(self.position(guess, point));
        station.predict(point.axis, c).map_or(BEHIND, |predicted| point.angle - predicted.angle)
    }

    /// Scatter per rotor.
    pub(super) fn scatter(&self, guess: &Guess) -> [[f64; 2]; 2] {
        let mut residuals: [[Vec<f64>; 2]; 2] = Default::default();
        for point in self.points {
            residuals[point.station][point.axis].push(self.residual(guess, point).abs());
        }
        residuals.map(|station| {
            station.map(|mut axis| {
                let middle = median(&mut axis);
                if middle.is_nan() { BEHIND } else { (SCATTER_PER_MEDIAN * middle).max(LEAST_SCATTER) }
            })
        })
    }

    fn cost(&self, guess: &Guess, scatter: &[[f64; 2]; 2], loss: Loss, free: Free) -> f64 {
        let seen: f64 = self
            .points
            .iter()
            .map(|point| loss.of(self.residual(guess, point) / scatter[point.station][point.axis]).0)
            .sum();
        seen + prior(guess, free)
    }

    fn normal(&self, guess: &Guess, scatter: &[[f64; 2]; 2], loss: Loss, free: Free) -> Normal {
        let mut normal = Normal { cost: prior(guess, free), square: vec![[0.0; ALL]; ALL], slope: [0.0; ALL] };
        for point in self.points {
            let (s, axis) = (point.station, point.axis);
            let station = &guess.stations[s];
            let (place, velocity, body) = self.place(guess, point);
            let c = station.see(place);
            let Some(predicted) = station.predict(axis, c) else {
                normal.cost += loss.of(BEHIND / scatter[s][axis]).0;
                continue;
            };
            let residual = (point.angle - predicted.angle) / scatter[s][axis];
            let (cost, weight) = loss.of(residual);
            normal.cost += cost;
            if weight == 0.0 {
                continue;
            }
            // c turns with the station: turn x c; it moves against it.
            let by_turn = cross(c, predicted.by_point);
            let by_world: V3 =
                std::array::from_fn(|k| (0..3).map(|row| station.rotation[row][k] * predicted.by_point[row]).sum());
            let mut row = [0.0; 6 + TERMS + SHARED];
            let mut columns = [0; 6 + TERMS + SHARED];
            for k in 0..3 {
                row[k] = by_turn[k];
                row[3 + k] = -by_world[k];
            }
            for (k, column) in columns[..6].iter_mut().enumerate() {
                *column = s * PER_STATION + k;
            }
            for k in 0..TERMS {
                row[6 + k] = predicted.by_terms[k];
                columns[6 + k] = s * PER_STATION + 6 + axis * TERMS + k;
            }
            row[6 + TERMS] = dot(by_world, velocity);
            row[7 + TERMS] = row[6 + TERMS] * (point.at_s - guess.middle_s);
            for k in 0..3 {
                // The world's direction in the body's axes.
                row[8 + TERMS + k] = body.map_or(0.0, |body| (0..3).map(|w| by_world[w] * body[w][k]).sum());
            }
            for k in 0..SHARED {
                columns[6 + TERMS + k] = OFFSET + k;
            }
            let row = row.map(|entry| entry / scatter[s][axis]);
            for (i, &at) in columns.iter().enumerate() {
                let weighed = weight * row[i];
                normal.slope[at] += weighed * residual;
                let line = &mut normal.square[at];
                for (j, &column) in columns.iter().enumerate().skip(i) {
                    line[column] += weighed * row[j];
                }
            }
        }
        for s in 0..2 {
            for axis in 0..2 {
                for (k, spread) in SPREAD.iter().enumerate().take(free.terms[s]) {
                    let at = s * PER_STATION + 6 + axis * TERMS + k;
                    normal.square[at][at] += 1.0 / (spread * spread);
                    normal.slope[at] -= guess.stations[s].terms[axis][k] / (spread * spread);
                }
            }
        }
        normal
    }

    /// To the bottom from `guess`, at a given scatter.
    pub(super) fn descend(
        &self,
        mut guess: Guess,
        scatter: &[[f64; 2]; 2],
        loss: Loss,
        free: Free,
        steps: usize,
    ) -> (Guess, f64) {
        let columns = free.columns();
        let mut damping = 1e-4;
        let mut normal = self.normal(&guess, scatter, loss, free);
        let mut cost = normal.cost;
        for _ in 0..steps {
            let (square, slope) = compressed(&normal, &columns);
            let before = cost;
            let mut better = false;
            while damping < 1e8 {
                let mut damped = square.clone();
                for k in 0..columns.len() {
                    damped[(k, k)] += damping * square[(k, k)] + 1e-12;
                }
                let Some(factors) = damped.cholesky() else {
                    damping *= 10.0;
                    continue;
                };
                let next = moved(&guess, &columns, &factors.solve(&slope));
                let reached = self.cost(&next, scatter, loss, free);
                if reached < cost {
                    (guess, cost, better) = (next, reached, true);
                    damping = (damping * 0.1).max(1e-12);
                    break;
                }
                damping *= 10.0;
            }
            if !better || before - cost < 1e-7 * (1.0 + before.abs()) {
                break;
            }
            normal = self.normal(&guess, scatter, loss, free);
        }
        (guess, cost)
    }

    /// To the bottom from a guess that is about right, scatter and all.
    pub(super) fn fit(&self, guess: Guess, free: Free, rounds: usize) -> Fit {
        let mut guess = guess;
        for round in 0..rounds {
            let loss = if 2 * round < rounds { Loss::Cauchy } else { Loss::Tukey };
            let scatter = self.scatter(&guess);
            guess = self.descend(guess, &scatter, loss, free, 20).0;
        }
        let scatter = self.scatter(&guess);
        let columns = free.columns();
        let (square, _) = compressed(&self.normal(&guess, &scatter, Loss::Tukey, free), &columns);
        let scales: Vec<f64> = (0..columns.len()).map(|k| square[(k, k)].max(1e-300).sqrt()).collect();
        let scaled = DMatrix::from_fn(columns.len(), columns.len(), |i, j| square[(i, j)] / (scales[i] * scales[j]));
        let eigen = SymmetricEigen::new(scaled.clone());
        let condition = (eigen.eigenvalues.max() / eigen.eigenvalues.min().max(1e-300)).sqrt();
        let open = f64::INFINITY;
        let mut fit = Fit { guess, scatter, condition, position_sd: [open; 2], offset_sd: open, drift_sd: open };
        if let Some(inverse) = scaled.cholesky().map(|factors| factors.inverse()) {
            let variance = |k: usize| inverse[(k, k)] / (scales[k] * scales[k]);
            let at = |wanted: usize| columns.iter().position(|&column| column == wanted);
            fit.position_sd = std::array::from_fn(|s| {
                let places = (3..6).filter_map(|k| at(s * PER_STATION + k));
                places.map(variance).sum::<f64>().sqrt()
            });
            fit.offset_sd = at(OFFSET).map_or(0.0, |k| variance(k).sqrt());
            fit.drift_sd = at(DRIFT).map_or(0.0, |k| variance(k).sqrt());
        }
        fit
    }
}

fn prior(guess: &Guess, free: Free) -> f64 {
    let stations = guess.stations.iter().zip(free.terms);
    let terms = stations
        .flat_map(|(station, free)| station.terms.iter().flat_map(move |terms| terms.iter().zip(SPREAD).take(free)));
    terms.map(|(term, spread)| 0.5 * (term / spread).powi(2)).sum()
}

fn compressed(normal: &Normal, columns: &[usize]) -> (DMatrix<f64>, DVector<f64>) {
    let square = DMatrix::from_fn(columns.len(), columns.len(), |i, j| {
        let (low, high) = (columns[i].min(columns[j]), columns[i].max(columns[j]));
        normal.square[low][high]
    });
    (square, DVector::from_fn(columns.len(), |k, _| normal.slope[columns[k]]))
}

fn moved(guess: &Guess, columns: &[usize], step: &DVector<f64>) -> Guess {
    let mut by = [0.0; ALL];
    for (&column, step) in columns.iter().zip(step.iter()) {
        by[column] = *step;
    }
    let mut next = *guess;
    for (s, station) in next.stations.iter_mut().enumerate() {
        let own = &by[s * PER_STATION..(s + 1) * PER_STATION];
        *station = station.moved([own[0], own[1], own[2]], [own[3], own[4], own[5]]);
        for (terms, by) in station.terms.iter_mut().zip(own[6..].chunks(TERMS)) {
            for (term, by) in terms.iter_mut().zip(by) {
                *term += by;
            }
        }
    }
    next.offset_s += by[OFFSET];
    next.drift += by[DRIFT];
    next.lever = add(next.lever, [by[LEVER], by[LEVER + 1], by[LEVER + 2]]);
    next
}
