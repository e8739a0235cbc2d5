//! What the input must hold for a room to come of it, in the order in which it is looked at.
//!
//! What can go wrong: see [`Trouble`]; each has the number that it was judged by.

use nalgebra::{Matrix3, SymmetricEigen, Vector3};

use super::model::{Fitted, length, median, sub};
use super::observation::{Sighting, TruthSample};
use super::pairing::rotors;
use super::path::Path;
use super::refine::{Data, Fit, Guess, Point};
use super::trouble::Trouble;
use super::{Options, Station};

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
/// No two clocks differ by more: crystals do by 100 ppm, and a log that takes a mote's oscillator for steady by some 500.
pub const MOST_DRIFT: f64 = 1e-3;
/// At least this share of either station's sightings must be.
pub(super) const EXPLAINED_SHARE: f64 = 0.7;
/// Truth is a mirror image when that leaves less than this much of the residuals.
const MIRRORED_SHARE: f64 = 0.5;

pub(super) fn numbers(sightings: &[Sighting], truth: &[TruthSample]) -> Result<(), Trouble> {
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

pub(super) fn seen(sightings: &[Sighting]) -> Result<(), Trouble> {
    match rotors().find(|&(station, axis)| !sightings.iter().any(|s| s.station == station && s.axis == axis)) {
        Some((station, axis)) => Err(Trouble::NeverSeen { station, axis }),
        None => Ok(()),
    }
}

pub(super) fn paired(sightings: &[Sighting], points: &[Point]) -> Result<(), Trouble> {
    for (station, axis) in rotors() {
        let paired = points.iter().filter(|p| p.station == station && p.axis == axis).count();
        if paired < LEAST_PER_ROTOR {
            let seen = sightings.iter().filter(|s| s.station == station && s.axis == axis).count();
            return Err(Trouble::TooFew { station, axis, seen, paired, needed: LEAST_PER_ROTOR });
        }
    }
    Ok(())
}

pub(super) fn duration(points: &[Point], options: &Options) -> Result<(), Trouble> {
    let length_s = points.last().map_or(0.0, |last| last.at_s) - points.first().map_or(0.0, |first| first.at_s);
    match options.offset_search_s {
        Some(searched) if length_s < LEAST_S => Err(Trouble::TooShort { length_s, needed_s: LEAST_S, searched }),
        _ => Ok(()),
    }
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

pub(super) fn places(path: &Path, options: &Options) -> Result<(), Trouble> {
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

/// Median residual, radians, and the share of each station's sightings that are explained.
pub(super) fn explained_share(data: &Data<'_>, guess: &Guess) -> (f64, [f64; 2]) {
    let of = |station: usize| -> Vec<f64> {
        let own = data.points.iter().filter(|point| point.station == station);
        own.map(|point| data.residual(guess, point).abs()).collect()
    };
    let stations = [of(0), of(1)];
    let share = |own: &Vec<f64>| own.iter().filter(|residual| **residual < EXPLAINED).count() as f64 / own.len() as f64;
    let shares = stations.each_ref().map(share);
    (median(&mut stations.concat()), shares)
}

/// A mirror image is looked for always: from far away it is explained to within a degree too. `mirrored` is the median of
/// its residuals, radians.
pub(super) fn explained(data: Data<'_>, guess: &Guess, mirrored: Option<f64>) -> Result<(), Trouble> {
    let (middle, shares) = explained_share(&data, guess);
    if let Some(mirrored) = mirrored.filter(|mirrored| *mirrored < MIRRORED_SHARE * middle) {
        return Err(Trouble::Mirrored { median_deg: middle.to_degrees(), mirrored_deg: mirrored.to_degrees() });
    }
    // One station alone is enough to mislead a mote.
    let share = shares[0].min(shares[1]);
    if share < EXPLAINED_SHARE {
        return Err(Trouble::Unexplained { median_deg: middle.to_degrees(), share });
    }
    Ok(())
}

pub(super) fn offset(fit: &Fit, options: &Options) -> Result<(), Trouble> {
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

pub(super) fn stations(path: &Path, fit: &Fit, options: &Options) -> Result<(), Trouble> {
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
    let found = fit.guess.stations.each_ref().map(Fitted::pose);
    match options.before.and_then(|before| exchanged(&found, &before)) {
        Some((distance_m, exchanged_m)) => Err(Trouble::Swapped { distance_m, exchanged_m }),
        None => Ok(()),
    }
}

/// Whether each station stands where the other stood before: the mean distances from the places before, as they are and
/// exchanged, metres.
pub fn exchanged(stations: &[Station; 2], before: &[Vector3<f64>; 2]) -> Option<(f64, f64)> {
    let distance = |s: usize, t: usize| (stations[s].position - before[t]).norm();
    let distance_m = 0.5 * (distance(0, 0) + distance(1, 1));
    let exchanged_m = 0.5 * (distance(0, 1) + distance(1, 0));
    (exchanged_m < 0.5 * distance_m).then_some((distance_m, exchanged_m))
}
