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

mod held_out;
mod model;
mod offset;
mod path;
mod pose;
mod refine;
pub mod rooms;
mod trouble;

#[cfg(test)]
mod tests;

use nalgebra::{Matrix3, SymmetricEigen, UnitQuaternion, Vector3};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

pub use crate::calib::schema::Rotor;
pub use crate::reference::Pose as Station;
pub use trouble::Trouble;

use held_out::{Judged, judge};
use model::{Fitted, TERMS, length, median, sub};
use path::Path;
use pose::Sight;
use refine::{Data, Fit, Free, Guess, Point, TUKEY};

/// One sweep as the mote timed it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sighting {
    /// When the laser passed, seconds of the mote's clock, a half turn being 1/120 s.
    pub at_s: f64,
    /// 0 is A.
    pub station: usize,
    /// 0 is azimuth, 1 elevation.
    pub axis: usize,
    /// As measured, radians from straight ahead: ticks * pi / half turn - pi / 2, factory terms still in.
    pub angle: f64,
}

/// Where the mote was.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TruthSample {
    /// When, seconds of the truth's clock.
    pub at_s: f64,
    /// In the world, metres.
    pub position: Vector3<f64>,
}

/// How the tracked body was turned.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Attitude {
    /// When, seconds of the truth's clock.
    pub at_s: f64,
    /// Body to world.
    pub rotation: UnitQuaternion<f64>,
}

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
    /// Factory terms that are known, as those a station broadcasts; then none are fitted.
    pub factory: Option<[[Rotor; 2]; 2]>,
    /// Where the stations stood before, metres, to notice that A and B were exchanged.
    pub before: Option<[Vector3<f64>; 2]>,
    /// Whether the truth may be late although it is written on the mote's clock: motion capture takes a while, and a
    /// log of both holds what had come by then.
    pub late: bool,
}

/// A calibrated room.
#[derive(Clone, Debug)]
pub struct Solution {
    /// A, then B.
    pub stations: [Station; 2],
    /// The truth's clock less the mote's, seconds; with one clock, by how much the truth is late.
    pub offset_s: f64,
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

/// Sightings per rotor, with truth, that a pose takes: six numbers and as many again to notice what is wrong.
const LEAST_PER_ROTOR: usize = 12;
/// A walk whose place in time is searched must be this long, seconds. Twelve free numbers and a minute to choose from
/// explain five seconds of another take to within a degree.
const LEAST_S: f64 = 10.0;
/// Spread of the places along their longest direction, standard deviation, metres. At 2 m, 2 cm are 10 mrad, three
/// times what angles scatter by.
const LEAST_SPREAD_M: f64 = 0.02;
/// Along the second longest, less than this much of the longest is a line.
const LINE_SHARE: f64 = 0.02;
/// Along the shortest, less than this is a plane. From 0.5 m of it at 1 m, 2 % leave what a phase of 0.05 rad does to
/// the angles within what they scatter by: the poses take it up, and are wrong above the plane.
const PLANE_SHARE: f64 = 0.02;
/// No two stations light more than this, metres.
const WIDEST_M: f64 = 50.0;
/// Light is found up to 6 m away; twice that, and something is wrong.
const FARTHEST_M: f64 = 15.0;
/// A station's place may be open by this much of its distance.
const OPEN_SHARE: f64 = 0.2;
/// A mote slower than this is at rest, m/s: motion capture's own noise moves it by less.
const REST_M_PER_S: f64 = 0.005;
/// The offset must be known to this, seconds: at 0.3 m/s, 1.5 mm.
const OFFSET_SD_S: f64 = 0.005;
/// Within this an angle counts as explained, radians: 1 degree.
const EXPLAINED: f64 = std::f64::consts::PI / 180.0;
/// A truth on the mote's own clock is no later than this, seconds: motion capture, network and radio take 10 to 30 ms.
pub const LATEST_S: f64 = 0.1;
/// At least this share of either station's sightings must be.
const EXPLAINED_SHARE: f64 = 0.7;
/// A station whose sightings are not explained is looked for so many times more.
const AGAIN: usize = 3;
/// Truth is a mirror image when that leaves less than this much of the residuals.
const MIRRORED_SHARE: f64 = 0.5;
/// Terms stay when sweeps that were left out become more predictable by this share.
const WORTH: f64 = 0.01;
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
    check_numbers(sightings, truth)?;
    let path = Path::of(truth);
    let mut sorted = sightings.to_vec();
    sorted.sort_by(|a, b| a.at_s.total_cmp(&b.at_s));
    check_seen(&sorted)?;
    check_places(&path, options)?;
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
        if let Err(few) = check_paired(&sorted, &points) {
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
            check_paired(&sorted, &[]).err().unwrap_or(Trouble::Unexplained { median_deg: 180.0, share: 0.0 })
        }));
    };

    let points = pair(&sorted, &path, guess.offset_s);
    check_paired(&sorted, &points)?;
    check_length(&points, options)?;
    progress("fitting the poses", 0.0);
    let mut poses = Data { points: &points, ..known }.fit(guess, free, ROUNDS);
    for _ in 0..AGAIN {
        let shares = explained(&Data { points: &points, ..known }, &poses.guess).1;
        if shares.iter().all(|share| *share >= EXPLAINED_SHARE) {
            break;
        }
        // Another draw, for a search may miss the one valley that explains.
        let Some(mut other) = place(&points, &path, poses.guess.offset_s, options, &mut random) else { break };
        let others = explained(&Data { points: &points, ..known }, &other).1;
        for s in 0..2 {
            if others[s] <= shares[s] {
                other.stations[s] = poses.guess.stations[s];
            }
        }
        poses = Data { points: &points, ..known }.fit(other, free, ROUNDS);
    }
    check_explained(Data { points: &points, ..known }, &poses.guess, options, &mut random)?;
    check_offset(&poses, options)?;

    let mut evidence = Vec::new();
    if options.offset_search_s.is_some() {
        evidence.push(format!(
            "The truth's clock is {:.4} s ahead of the mote's, known to {:.2} ms.",
            poses.guess.offset_s,
            1000.0 * poses.offset_sd
        ));
    }
    let (free, judged) = choose(Data { points: &points, ..known }, &poses, free, options, &mut evidence, progress);
    // The offset has moved a little: what lies beside a gap is decided anew.
    let points = pair(&sorted, &path, poses.guess.offset_s);
    check_paired(&sorted, &points)?;
    progress("fitting everything", 0.0);
    let fit = Data { points: &points, ..known }.fit(poses.guess, free, ROUNDS);
    check_offset(&fit, options)?;
    if free.offset && options.offset_search_s.is_none() {
        evidence.push(format!(
            "The truth is {:.1} ms late, known to {:.2} ms: at the time of a sweep it tells where the mote was before.",
            1000.0 * fit.guess.offset_s,
            1000.0 * fit.offset_sd
        ));
    }
    check_stations(&path, &poses, options)?;
    progress("done", 1.0);
    Ok(solution(Data { points: &points, ..known }, &fit, free, judged, evidence))
}

fn check_numbers(sightings: &[Sighting], truth: &[TruthSample]) -> Result<(), Trouble> {
    let bad = |what: String| Trouble::NotANumber { what };
    for (k, s) in sightings.iter().enumerate() {
        if !s.at_s.is_finite() || !s.angle.is_finite() {
            return Err(bad(format!("sighting {k}: {} s, {} rad", s.at_s, s.angle)));
        }
        if s.station > 1 || s.axis > 1 {
            return Err(bad(format!("sighting {k}: of station {} and axis {}, and", s.station, s.axis)));
        }
    }
    for (k, t) in truth.iter().enumerate() {
        if !t.at_s.is_finite() || !t.position.iter().all(|x| x.is_finite()) {
            return Err(bad(format!("truth sample {k}: {} s, {:?}", t.at_s, t.position.as_slice())));
        }
    }
    Ok(())
}

fn rotors() -> impl Iterator<Item = (usize, usize)> {
    (0..2).flat_map(|station| (0..2).map(move |axis| (station, axis)))
}

fn check_seen(sightings: &[Sighting]) -> Result<(), Trouble> {
    match rotors().find(|&(station, axis)| !sightings.iter().any(|s| s.station == station && s.axis == axis)) {
        Some((station, axis)) => Err(Trouble::NeverSeen { station, axis }),
        None => Ok(()),
    }
}

fn check_paired(sightings: &[Sighting], points: &[Point]) -> Result<(), Trouble> {
    for (station, axis) in rotors() {
        let paired = points.iter().filter(|p| p.station == station && p.axis == axis).count();
        if paired < LEAST_PER_ROTOR {
            let seen = sightings.iter().filter(|s| s.station == station && s.axis == axis).count();
            return Err(Trouble::TooFew { station, axis, seen, paired, needed: LEAST_PER_ROTOR });
        }
    }
    Ok(())
}

fn check_length(points: &[Point], options: &Options) -> Result<(), Trouble> {
    let length_s = points.last().map_or(0.0, |last| last.at_s) - points.first().map_or(0.0, |first| first.at_s);
    if options.offset_search_s.is_some() && length_s < LEAST_S {
        return Err(Trouble::TooShort { length_s, needed_s: LEAST_S });
    }
    Ok(())
}

/// Standard deviations along the three directions of the cloud, longest first.
fn extents(path: &Path) -> [f64; 3] {
    let count = path.places().len().max(1) as f64;
    let sum: Vector3<f64> = path.places().iter().map(|place| Vector3::from(*place)).sum();
    let middle = sum / count;
    let square: Matrix3<f64> = path
        .places()
        .iter()
        .map(|place| {
            let away = Vector3::from(*place) - middle;
            away * away.transpose()
        })
        .sum();
    let mut extents: [f64; 3] = SymmetricEigen::new(square / count).eigenvalues.map(|x| x.max(0.0).sqrt()).into();
    extents.sort_by(|a, b| b.total_cmp(a));
    extents
}

fn check_places(path: &Path, options: &Options) -> Result<(), Trouble> {
    let extents_m = extents(path);
    // Nearly all places are within two standard deviations to either side.
    if 4.0 * extents_m[0] > WIDEST_M {
        return Err(Trouble::Units { extent: 4.0 * extents_m[0] });
    }
    let speed_m_per_s = path.speed();
    if options.offset_search_s.is_some() && speed_m_per_s < REST_M_PER_S {
        return Err(Trouble::AtRest { speed_m_per_s });
    }
    if extents_m[0] < LEAST_SPREAD_M {
        return Err(Trouble::TooSmall { extent_m: extents_m[0], needed_m: LEAST_SPREAD_M });
    }
    if extents_m[1] < LINE_SHARE * extents_m[0] {
        return Err(Trouble::Collinear { extents_m });
    }
    if extents_m[2] < PLANE_SHARE * extents_m[0] {
        return Err(Trouble::Coplanar { extents_m });
    }
    Ok(())
}

fn pair(sightings: &[Sighting], path: &Path, offset_s: f64) -> Vec<Point> {
    let paired = |s: &Sighting| {
        path.at(s.at_s + offset_s)?;
        Some(Point { at_s: s.at_s, station: s.station, axis: s.axis, angle: s.angle })
    };
    sightings.iter().filter_map(paired).collect()
}

fn thinned(points: &[Point], most: usize) -> Vec<Point> {
    let mut thinned = Vec::with_capacity(most);
    for (station, axis) in rotors() {
        let own: Vec<&Point> = points.iter().filter(|p| p.station == station && p.axis == axis).collect();
        let count = own.len().min(most / 4);
        thinned.extend((0..count).map(|k| *own[k * own.len() / count]));
    }
    thinned
}

/// Both stations from nothing.
fn place(points: &[Point], path: &Path, offset_s: f64, options: &Options, random: &mut ChaCha8Rng) -> Option<Guess> {
    let mut station = |s: usize| {
        let own = points.iter().filter(|point| point.station == s);
        let sights: Vec<Sight> = own
            .map(|point| {
                let place = path.anywhere(point.at_s + offset_s).0;
                let phase = options.factory.map_or(0.0, |factory| factory[s][point.axis].phase);
                Sight { place, axis: point.axis, angle: point.angle + phase }
            })
            .collect();
        let mut found = pose::search(&sights, random)?.0;
        if let Some(factory) = options.factory {
            let known = Station { rotation: Matrix3::identity(), position: Vector3::zeros(), factory: factory[s] };
            found.terms = Fitted::of(&known).terms;
        }
        Some(found)
    };
    Some(Guess { stations: [station(0)?, station(1)?], offset_s, lever: [0.0; 3] })
}

fn left_over(data: &Data<'_>, guess: &Guess) -> f64 {
    data.scatter(guess).iter().flatten().map(|scatter| scatter.ln()).sum()
}

/// Median residual, radians, and the share of each station's sightings that are explained.
fn explained(data: &Data<'_>, guess: &Guess) -> (f64, [f64; 2]) {
    let of = |station: usize| -> Vec<f64> {
        let own = data.points.iter().filter(|point| point.station == station);
        own.map(|point| data.residual(guess, point).abs()).collect()
    };
    let stations = [of(0), of(1)];
    let share = |own: &Vec<f64>| own.iter().filter(|residual| **residual < EXPLAINED).count() as f64 / own.len() as f64;
    let shares = stations.each_ref().map(share);
    (median(&mut stations.concat()), shares)
}

fn check_explained(data: Data<'_>, guess: &Guess, options: &Options, random: &mut ChaCha8Rng) -> Result<(), Trouble> {
    let (middle, shares) = explained(&data, guess);
    // One station alone is enough to mislead a mote.
    let share = shares[0].min(shares[1]);
    // Always, for from far away a mirror image is explained to within a degree too.
    let few = thinned(data.points, 800);
    let path = data.path.mirrored();
    if let Some(mirrored) = place(&few, &path, guess.offset_s, options, random) {
        let data = Data { points: &few, path: &path, attitudes: &[] };
        let fit = data.fit(mirrored, Free::default(), 4);
        let (mirrored, _) = explained(&data, &fit.guess);
        if mirrored < MIRRORED_SHARE * middle {
            return Err(Trouble::Mirrored { median_deg: middle.to_degrees(), mirrored_deg: mirrored.to_degrees() });
        }
    }
    if share < EXPLAINED_SHARE {
        return Err(Trouble::Unexplained { median_deg: middle.to_degrees(), share });
    }
    Ok(())
}

fn check_offset(fit: &Fit, options: &Options) -> Result<(), Trouble> {
    let offset_s = fit.guess.offset_s;
    match options.offset_search_s {
        // Not a step of the search beyond: an offset at the very end is one that happens to be there.
        Some(searched) if offset_s < searched.0 - 0.1 || offset_s > searched.1 + 0.1 => {
            return Err(Trouble::OffsetAtEdge { offset_s, searched });
        }
        None if offset_s.abs() > LATEST_S => return Err(Trouble::TooLate { late_s: offset_s, latest_s: LATEST_S }),
        None if !options.late => return Ok(()),
        _ => {}
    }
    if fit.offset_sd > OFFSET_SD_S {
        return Err(Trouble::OffsetUnknown { sd_s: fit.offset_sd });
    }
    Ok(())
}

fn check_stations(path: &Path, fit: &Fit, options: &Options) -> Result<(), Trouble> {
    let middle = std::array::from_fn(|k| median(&mut path.places().iter().map(|place| place[k]).collect::<Vec<_>>()));
    for (station, fitted) in fit.guess.stations.iter().enumerate() {
        let (distance_m, sd_m) = (length(sub(fitted.position, middle)), fit.position_sd[station]);
        if sd_m > OPEN_SHARE * distance_m {
            return Err(Trouble::Unsteady { station, sd_m, distance_m, extents_m: extents(path) });
        }
        if distance_m > FARTHEST_M {
            return Err(Trouble::TooFar { station, distance_m });
        }
    }
    if let Some(before) = options.before {
        let distance = |s: usize, t: usize| length(sub(fit.guess.stations[s].position, before[t].into()));
        let distance_m = 0.5 * (distance(0, 0) + distance(1, 1));
        let exchanged_m = 0.5 * (distance(0, 1) + distance(1, 0));
        if exchanged_m < 0.5 * distance_m {
            return Err(Trouble::Swapped { distance_m, exchanged_m });
        }
    }
    Ok(())
}

/// What is fitted besides the poses, and how good that is on what was left out.
fn choose(
    data: Data<'_>,
    poses: &Fit,
    free: Free,
    options: &Options,
    evidence: &mut Vec<String>,
    progress: &mut dyn FnMut(&str, f64),
) -> (Free, Judged) {
    let limit = poses.scatter.map(|station| station.map(|scatter| TUKEY * scatter));
    let mut chosen = free;
    progress("holding blocks out", 0.0);
    let mut judged = judge(data, poses.guess, chosen, &limit);
    let mut weigh = |what: &str, wider: Free, choice: Choice, chosen: &mut Free, judged: &mut Judged| {
        let other = judge(data, poses.guess, wider, &limit);
        let better = other.held_out.scatter < (1.0 - WORTH) * judged.held_out.scatter;
        let fitted = better || choice == Choice::Always;
        evidence.push(format!(
            "{what} {}: sweeps left out of the fit scatter by {:.3} mrad without and {:.3} mrad with, and place the mote \
             to {:.2} and {:.2} cm.",
            if fitted { "are fitted" } else { "are left alone" },
            1000.0 * judged.held_out.scatter,
            1000.0 * other.held_out.scatter,
            100.0 * judged.held_out.mean_3d_m,
            100.0 * other.held_out.mean_3d_m,
        ));
        if fitted {
            (*chosen, *judged) = (wider, other);
        }
        fitted
    };
    if options.late && !chosen.offset {
        let wider = Free { offset: true, ..chosen };
        weigh("Delays of the truth", wider, Choice::Auto, &mut chosen, &mut judged);
    }
    match (options.fit_factory, options.factory) {
        (_, Some(_)) | (Choice::Never, _) => {}
        (choice, None) => {
            for (part, terms, what) in
                [(0.2, 1, "Rotor phases"), (0.4, 2, "Rotor tilts"), (0.6, TERMS, "Rotors' once-per-turn terms")]
            {
                progress("holding blocks out", part);
                let wider = Free { terms, ..chosen };
                if !weigh(what, wider, choice, &mut chosen, &mut judged) {
                    break;
                }
            }
        }
    }
    if options.fit_lever_arm != Choice::Never && !options.attitudes.is_empty() {
        progress("holding blocks out", 0.8);
        let wider = Free { lever: true, ..chosen };
        weigh("The photodiode's three coordinates on the body", wider, options.fit_lever_arm, &mut chosen, &mut judged);
    }
    if options.factory.is_some() {
        evidence.push("Factory terms are the ones given.".to_string());
    } else if options.fit_factory == Choice::Never {
        evidence.push("Factory terms are not fitted, as asked.".to_string());
    }
    if options.attitudes.is_empty() && options.fit_lever_arm != Choice::Never {
        evidence.push(
            "The truth does not say how the body is turned, so where the photodiode sits on it cannot be told from \
             where the stations are: what the truth tracks should be the photodiode."
                .to_string(),
        );
    }
    (chosen, judged)
}

fn solution(data: Data<'_>, fit: &Fit, free: Free, judged: Judged, evidence: Vec<String>) -> Solution {
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
        lever_arm: free.lever.then(|| fit.guess.lever.into()),
        evidence,
        residuals,
        per_rotor,
        condition: fit.condition,
        held_out: judged.held_out,
    }
}
