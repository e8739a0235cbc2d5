//! From sweeps and truth to the poses of two stations, in double precision, without a first guess.
//!
//! Angles say how things lie to each other in a station's view; truth says where the mote was. This finds, in this
//! order: what the two clocks differ by (`offset`), where each station is by trying all ways it could be turned
//! (`pose`), and then everything at once with outliers weighed down (`refine`). Factory terms are fitted only as
//! far as they make sweeps predictable that were left out of the fit (`held_out`).
//!
//! # What can go wrong
//! The input may not hold what is asked of it: see [`Trouble`]. Every figure of a [`Solution`] that tells how good it
//! is comes from sweeps that were not fitted, except the residuals, which are the fit's own.

mod check;
mod held_out;
mod model;
mod observation;
mod offset;
mod pairing;
mod path;
mod pose;
mod refine;
pub mod rooms;
mod selection;
mod solution;
mod trouble;

#[cfg(test)]
mod tests;

use nalgebra::{Matrix3, Vector3};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

pub use crate::calib::schema::Rotor;
pub use crate::reference::Pose as Station;
pub use check::{LATEST_S, MOST_DRIFT, exchanged};
pub use observation::{Attitude, Sighting, TruthSample};
pub use solution::{HeldOut, Residual, RotorFit, Solution};
pub use trouble::Trouble;

use model::Fitted;
use pairing::{pair, thinned};
use path::Path;
use pose::Sight;
use refine::{Data, Free, Guess, Point};

/// Whether something is fitted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Choice {
    /// If sweeps that were left out say so.
    #[default]
    Auto,
    /// No.
    Never,
    /// Whatever they say.
    Always,
}

/// What the solver may be told.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// For the draw of sightings that the poses are searched with.
    pub seed: u64,
    /// Where the offset of the clocks (truth's less the mote's) is searched, seconds; none when they are one clock.
    pub offset_search_s: Option<(f64, f64)>,
    /// Phases, tilts and once-per-turn terms of the four rotors, each only where the ones before it were fitted.
    pub fit_factory: Choice,
    /// Where the photodiode is on the tracked body; needs `attitudes`.
    pub fit_lever_arm: Choice,
    /// How the tracked body was turned, in the order of time; may be empty.
    pub attitudes: Vec<Attitude>,
    /// Each station's factory terms where they are known, as those it broadcasts; its own are then not fitted.
    pub factory: [Option<[Rotor; 2]>; 2],
    /// Where the stations stood before, metres, to notice that A and B were exchanged.
    pub before: Option<[Vector3<f64>; 2]>,
    /// Whether the truth may be late although it is written on the mote's clock: motion capture takes a while, and a
    /// log of both holds what had come by then.
    pub late: bool,
}

/// A station whose sightings are not explained is looked for so many times more.
const AGAIN: usize = 3;
/// Offsets that are looked at closely.
const CANDIDATES: usize = 4;
/// Rounds of a fit from a searched pose.
const ROUNDS: usize = 8;

/// Finds the room.
///
/// `progress` hears what is being done and how far it has come, 0 to 1.
///
/// # Errors
/// The first reason that the input cannot give a room.
pub fn solve(
    sightings: &[Sighting],
    truth: &[TruthSample],
    options: &Options,
    progress: &mut dyn FnMut(&str, f64),
) -> Result<Solution, Trouble> {
    check::numbers(sightings, truth)?;
    let path = Path::of(truth);
    let mut sorted = sightings.to_vec();
    sorted.sort_by(|a, b| a.at_s.total_cmp(&b.at_s));
    check::seen(&sorted)?;
    check::places(&path, options)?;
    let mut random = ChaCha8Rng::seed_from_u64(options.seed);
    let known = Data { points: &[], path: &path, attitudes: &options.attitudes };

    let offsets: Vec<f64> = match options.offset_search_s {
        None => vec![0.0],
        Some(range) => offset::candidates(&sorted, &path, range, CANDIDATES, progress),
    };
    let free = Free { offset: options.offset_search_s.is_some(), ..Free::default() };
    let mut best: Option<(f64, Guess)> = None;
    let mut trouble = None;
    for (tried, &offset_s) in offsets.iter().enumerate() {
        progress("looking for the stations", tried as f64 / offsets.len() as f64);
        let points = pair(&sorted, &path, offset_s);
        if let Err(few) = check::paired(&sorted, &points) {
            trouble = trouble.or(Some(few));
            continue;
        }
        let Some(guess) = place(&points, &path, offset_s, options, &mut random) else { continue };
        let few: Vec<Point> = thinned(&points, 800);
        let fit = Data { points: &few, ..known }.fit(guess, free, 4);
        let score = left_over(&Data { points: &few, ..known }, &fit.guess);
        if best.as_ref().is_none_or(|(least, _)| score < *least) {
            best = Some((score, fit.guess));
        }
    }
    let Some((_, guess)) = best else {
        return Err(trouble.unwrap_or_else(|| {
            check::paired(&sorted, &[]).err().unwrap_or(Trouble::Unexplained { median_deg: 180.0, share: 0.0 })
        }));
    };

    let points = pair(&sorted, &path, guess.offset_s);
    check::paired(&sorted, &points)?;
    check::duration(&points, options)?;
    progress("fitting the poses", 0.0);
    let mut poses = Data { points: &points, ..known }.fit(guess, free, ROUNDS);
    for _ in 0..AGAIN {
        let shares = check::explained_share(&Data { points: &points, ..known }, &poses.guess).1;
        if shares.iter().all(|share| *share >= check::EXPLAINED_SHARE) {
            break;
        }
        // Another draw, for a search may miss the one valley that explains.
        let Some(mut other) = place(&points, &path, poses.guess.offset_s, options, &mut random) else { break };
        let others = check::explained_share(&Data { points: &points, ..known }, &other).1;
        for s in 0..2 {
            if others[s] <= shares[s] {
                other.stations[s] = poses.guess.stations[s];
            }
        }
        poses = Data { points: &points, ..known }.fit(other, free, ROUNDS);
    }
    let data = Data { points: &points, ..known };
    let mirrored = mirrored(data, &poses.guess, options, &mut random);
    check::explained(data, &poses.guess, mirrored)?;
    check::offset(&poses, options)?;

    let mut evidence = Vec::new();
    if options.offset_search_s.is_some() {
        evidence.push(format!(
            "The truth's clock is {:.4} s ahead of the mote's, known to {:.2} ms.",
            poses.guess.offset_s,
            1000.0 * poses.offset_sd
        ));
    }
    let (free, held_out) =
        selection::choose(Data { points: &points, ..known }, &poses, free, options, &mut evidence, progress);
    // The offset has moved a little: what lies beside a gap is decided anew.
    let points = pair(&sorted, &path, poses.guess.offset_s);
    check::paired(&sorted, &points)?;
    progress("fitting everything", 0.0);
    let fit = Data { points: &points, ..known }.fit(poses.guess, free, ROUNDS);
    check::offset(&fit, options)?;
    if free.offset && options.offset_search_s.is_none() {
        evidence.push(format!(
            "The truth is {:.1} ms late, known to {:.2} ms: at the time of a sweep it tells where the mote was before.",
            1000.0 * fit.guess.offset_s,
            1000.0 * fit.offset_sd
        ));
    }
    if free.drift {
        evidence.push(format!(
            "That is so in the middle of the walk: the truth's clock gains {:.0} ppm on the rotors, known to {:.0} ppm.",
            1e6 * fit.guess.drift,
            1e6 * fit.drift_sd
        ));
    }
    check::stations(&path, &poses, options)?;
    progress("done", 1.0);
    Ok(solution::of(Data { points: &points, ..known }, &fit, free, held_out, evidence))
}

/// Both stations from nothing.
fn place(points: &[Point], path: &Path, offset_s: f64, options: &Options, random: &mut ChaCha8Rng) -> Option<Guess> {
    let mut station = |s: usize| {
        let own = points.iter().filter(|point| point.station == s);
        let sights: Vec<Sight> = own
            .map(|point| {
                let place = path.anywhere(point.at_s + offset_s).0;
                let phase = options.factory[s].map_or(0.0, |factory| factory[point.axis].phase);
                Sight { place, axis: point.axis, angle: point.angle + phase }
            })
            .collect();
        let mut found = pose::search(&sights, random)?.0;
        if let Some(factory) = options.factory[s] {
            let known = Station { rotation: Matrix3::identity(), position: Vector3::zeros(), factory };
            found.terms = Fitted::of(&known).terms;
        }
        Some(found)
    };
    let middle_s = points.first().zip(points.last()).map_or(0.0, |(first, last)| 0.5 * (first.at_s + last.at_s));
    Some(Guess { stations: [station(0)?, station(1)?], offset_s, middle_s, drift: 0.0, lever: [0.0; 3] })
}

fn left_over(data: &Data<'_>, guess: &Guess) -> f64 {
    data.scatter(guess).iter().flatten().map(|scatter| scatter.ln()).sum()
}

/// Median residual of the fit to the truth's mirror image, radians, if there is one: from far away that is explained to
/// within a degree too.
fn mirrored(data: Data<'_>, guess: &Guess, options: &Options, random: &mut ChaCha8Rng) -> Option<f64> {
    let few = thinned(data.points, 800);
    let path = data.path.mirrored();
    let mirrored = place(&few, &path, guess.offset_s, options, random)?;
    let data = Data { points: &few, path: &path, attitudes: &[] };
    let fit = data.fit(mirrored, Free::default(), 4);
    Some(check::explained_share(&data, &fit.guess).0)
}
