//! A room, turned into the integers of the solver.
//!
//! Host only. build.rs and xtask include this file by path. It uses nothing but `std` and its neighbour `solver`: in
//! xtask and tests that is `lighthouse_mote::fix`, in build.rs it is `calib/solver.rs`, the same files compiled once
//! more. So what is measured here is the very arithmetic that runs on the mote.
//!
//! The bake scatters points over the declared volume, looks at them through both stations with and without noise,
//! and from what it sees chooses which station's ray to walk along, which row of the other to divide by, the unit of
//! length and every Q format. It then runs the integer solver against least squares in f64 and keeps the best.
//!
//! It looks beyond the volume as well, without noise, so that whatever the solver lets through comes out right up to
//! half as far again as the farthest corner.
//!
//! What can go wrong: a room no choice can serve is a [`Refusal`], with the number that broke a limit.

#![allow(dead_code, unreachable_pub, reason = "each includer uses a part of it")]

#[path = "quantise/form.rs"]
mod form;
#[path = "quantise/lines.rs"]
mod lines;
#[path = "quantise/plan.rs"]
mod plan;
#[path = "quantise/sight.rs"]
mod sight;

pub use sight::Dice;

use super::solver::{self, Angle, Calib};
use form::{ROWS, form};
use plan::{Divide, Plan};
use sight::{Range, Sight, Sights, V, beyond, dot, length, mean, minus, scatter};

/// Where a station is and how it is turned.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Station {
    /// World to station, the paper's R: c = R (p - position), with c.z ahead and c.x, c.y across.
    pub rotation: [[f64; 3]; 3],
    /// Of the station in the world, metres.
    pub position: [f64; 3],
}

/// Two stations and the box the mote stays in.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Room {
    /// A and B.
    pub stations: [Station; 2],
    /// Smallest corner of the declared volume, metres.
    pub min: [f64; 3],
    /// Largest corner of the declared volume, metres.
    pub max: [f64; 3],
}

/// How far the integers are from least squares in f64, over the part of the volume that both stations see: the worse of
/// with and without 0.2 deg of noise on each angle, at points that the choice was not made on.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Measured {
    /// Root mean square distance, millimetres.
    pub rms_mm: f64,
    /// Largest distance, millimetres.
    pub max_mm: f64,
    /// Largest mean error of an axis, micrometres.
    pub bias_um: f64,
    /// Share of the fixes turned away.
    pub rejected: f64,
}

/// The solver's numbers and how well they do.
#[derive(Debug, Clone, PartialEq)]
pub struct Baked {
    /// The numbers for the solver.
    pub calib: Calib,
    /// Which form was chosen and why.
    pub choice: String,
    /// What it achieves.
    pub measured: Measured,
    /// How many times the errors that a fast form may have it was allowed: 1, or [`GENERAL_SLACK`] where no fast one
    /// keeps to them.
    pub slack: f64,
    /// Where no track can begin.
    pub out_of_reach: OutOfReach,
}

/// What of the volume is too far away for a track to begin, [`TRACK_REACH_M`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OutOfReach {
    /// As a share of what both stations see.
    pub share: f64,
    /// How far ahead of the farther station the nearest point of the volume is, metres.
    pub nearest_m: f64,
}

/// Why a room cannot be served.
#[derive(Debug, Clone, PartialEq)]
pub struct Refusal {
    /// What was measured and which limit it broke.
    pub reason: String,
    /// The number in question.
    pub number: f64,
    /// What those plans achieve that fit into integers; each is off by more than [`GENERAL_SLACK`] times what is allowed.
    pub measured: Vec<Measured>,
}

impl core::fmt::Display for Refusal {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "{}: {}", self.reason, self.number)
    }
}

impl std::error::Error for Refusal {}

fn refuse<T>(reason: impl Into<String>, number: f64) -> Result<T, Refusal> {
    Err(Refusal { reason: reason.into(), number, measured: vec![] })
}

impl Measured {
    /// Whether the errors are at most `slack` times what the fast form must keep, at a mean range in metres. A number that
    /// is none is not.
    #[must_use]
    pub fn keeps(&self, slack: f64, range: f64) -> bool {
        let within = |error: f64, per_m: f64| error <= slack * per_m * range;
        within(self.rms_mm, RMS_MM_PER_M) && within(self.max_mm, MAX_MM_PER_M) && within(self.bias_um, BIAS_UM_PER_M)
    }
}

impl Baked {
    /// The same with what was tried in vain.
    fn because(mut self, reasons: &[String]) -> Baked {
        if !reasons.is_empty() {
            self.choice += &format!(" ({})", reasons.join("; "));
        }
        self
    }

    /// The calibration as a Rust expression, for `const CALIB: lighthouse_mote::fix::Calib = ...;`.
    #[must_use]
    pub fn emit(&self) -> String {
        format!(
            "{{\n#[allow(unused_imports)]\nuse lighthouse_mote::fix::{{Calib, Fast, General, Linear, Lines, Row, Scene, Weight}};\nCalib::{}\n}}",
            // Debug hides the one reference.
            format!("{:#?}", self.calib).replace("lines: ", "lines: &")
        )
    }
}

/// RMS error that the fast form must keep, millimetres per metre of mean range: 0.1 mm at the 1.6 m of the paper.
const RMS_MM_PER_M: f64 = 0.1 / 1.6;
/// Largest error that the fast form must keep: 0.6 mm at 1.6 m.
const MAX_MM_PER_M: f64 = 0.6 / 1.6;
/// Mean error of an axis that it must keep: 10 um at 1.6 m.
const BIAS_UM_PER_M: f64 = 10.0 / 1.6;
/// Mismatch that the gate lets through, metres per metre of mean range: 0.12 m at 1.6 m, twelve times what 0.2 deg of
/// noise makes, because a mote that moves adds its own.
const GATE: f64 = 0.12 / 1.6;
/// The gate of a small room, metres.
const GATE_MIN: f64 = 0.12;
/// The general form serves rooms with little parallax somewhere; it is allowed this many times the error, and so is a
/// fast one that does better than it.
pub const GENERAL_SLACK: f64 = 4.0;
/// A track begins less than this ahead of both stations: `Pose::lights` of `src/track.rs`.
pub const TRACK_REACH_M: f64 = 8.0;
/// Noise of an angle for which the bake optimises, degrees.
const NOISE_DEG: f64 = 0.2;
/// Points that the choice is made on.
const POINTS: usize = 4000;
/// Points that the chosen form is verified on, half of them with noise.
pub const VERIFIED: usize = 20_000;

/// value * 2^q, rounded; modulo 2^32 where only a sum has to fit.
fn fixed(value: f64, q: i32) -> i32 {
    (value * 2f64.powi(q)).round() as i64 as i32
}

fn unfixed(value: i32, q: i32) -> f64 {
    f64::from(value) / 2f64.powi(q)
}

/// The largest q with |value| 2^q < 2^31.
fn q_for(value: f64) -> i32 {
    30 - value.abs().max(1e-9).log2().floor() as i32
}

/// Mean distance from both stations to what was seen, metres.
fn range(room: &Room, sights: &[Sight]) -> f64 {
    mean(sights.iter().map(|s| mean(room.stations.iter().map(|st| length(minus(s.answer, st.position))))))
}

fn run(calib: &Calib, angles: [i32; 4]) -> Option<V> {
    let solution = solver::solve(calib, &angles.map(Angle)).ok()?;
    Some(solution.position.map(|x| unfixed(x, 16)))
}

/// The mean error of `calib` per axis, metres, and its figures.
fn measure(calib: &Calib, sights: &[Sight]) -> (V, Measured) {
    let (mut bias, mut figures, mut fixes) = ([0.0; 3], Measured::default(), 0.0);
    for s in sights {
        let Some(found) = run(calib, s.angles) else {
            continue;
        };
        let error = minus(found, s.answer);
        bias = [0, 1, 2].map(|i| bias[i] + error[i]);
        figures.rms_mm += dot(error, error) * 1e6;
        figures.max_mm = figures.max_mm.max(length(error) * 1e3);
        fixes += 1.0;
    }
    figures.rms_mm = (figures.rms_mm / fixes).sqrt();
    figures.rejected = 1.0 - fixes / sights.len() as f64;
    (bias.map(|b| b / fixes), figures)
}

/// The figures of `calib` at points it was not chosen on, without and with noise: the worse of each.
fn verify(calib: &Calib, fresh: &[Vec<Sight>; 2]) -> Measured {
    let mut worst = Measured::default();
    for sights in fresh {
        let (bias, figures) = measure(calib, sights);
        worst.rms_mm = worst.rms_mm.max(figures.rms_mm);
        worst.max_mm = worst.max_mm.max(figures.max_mm);
        worst.rejected = worst.rejected.max(figures.rejected);
        worst.bias_um = bias.into_iter().map(|b| b.abs() * 1e6).fold(worst.bias_um, f64::max);
    }
    worst
}

/// Moves the origin so that the mean error over `sights` vanishes.
fn centred(mut calib: Calib, sights: &Sights) -> Calib {
    let biases = [&sights.clean, &sights.noisy].map(|s| measure(&calib, s).0);
    let scene = match &mut calib {
        Calib::Fast(fast) => &mut fast.scene,
        Calib::General(general) => &mut general.scene,
    };
    let q = scene.position_shift as i32 + 16;
    for (i, linear) in scene.world.iter_mut().enumerate() {
        let bias = (biases[0][i] + biases[1][i]) / 2.0;
        if bias.is_finite() {
            linear.one = linear.one.wrapping_sub(fixed(bias, q));
        }
    }
    calib
}

/// What of the room lies farther ahead of a station than a track can begin.
fn out_of_reach(room: &Room, sights: &[Sight]) -> OutOfReach {
    let ahead = |s: &Sight| room.stations.map(|st| dot(st.rotation[2], minus(s.answer, st.position)));
    let farther: Vec<f64> = sights.iter().map(|s| ahead(s).into_iter().fold(0.0, f64::max)).collect();
    let beyond = farther.iter().filter(|m| **m >= TRACK_REACH_M).count();
    OutOfReach { share: beyond as f64 / sights.len() as f64, nearest_m: Range::of(farther.into_iter()).min }
}

/// Whether the numbers are a room at all.
fn check(room: &Room) -> Result<(), Refusal> {
    for station in room.stations {
        let p = station.position;
        if (0..3).all(|i| room.min[i] <= p[i] && p[i] <= room.max[i]) {
            return refuse("a station stands inside the volume; its x in metres", p[0]);
        }
        for far in p.into_iter().chain(room.min).chain(room.max) {
            if far.is_nan() || far.abs() > 100.0 {
                return refuse("a length of more than 100 m", far);
            }
        }
        let r = station.rotation;
        for i in 0..3 {
            for j in 0..3 {
                let error = dot(r[i], r[j]) - f64::from(u8::from(i == j));
                if error.is_nan() || error.abs() > 1e-4 {
                    return refuse("a rotation whose rows are not orthogonal unit vectors; off by", error);
                }
            }
        }
    }
    if let Some(i) = (0..3).find(|&i| room.min[i] >= room.max[i]) {
        return refuse("the volume is empty; its extent in metres", room.max[i] - room.min[i]);
    }
    Ok(())
}

/// Quantises `room`.
///
/// # Errors
/// Numbers that are no room (a matrix that is no rotation, an empty volume), a station inside the volume, lengths
/// beyond 100 m, a volume that the stations do not both see.
pub fn bake(room: &Room) -> Result<Baked, Refusal> {
    check(room)?;
    let mut dice = Dice(0x9e37_79b9_7f4a_7c15);
    let mut see = |count, noise| scatter(room, count, noise, &mut dice);
    let fresh = [see(VERIFIED / 2, 0.0)?, see(VERIFIED / 2, NOISE_DEG)?];
    let (clean, noisy) = (see(POINTS, 0.0)?, see(POINTS, NOISE_DEG)?);
    let mut wild = see(5 * POINTS, NOISE_DEG)?;
    wild.extend(see(2 * POINTS, 3.0 * NOISE_DEG)?);
    let beyond = beyond(room, 10 * POINTS, &mut dice);
    let sights = Sights { clean, noisy, wild, beyond };
    let range = range(room, &sights.clean);
    let out_of_reach = out_of_reach(room, &fresh[0]);
    let gate = (GATE * range).max(GATE_MIN);

    let mut reasons = vec![];
    let mut formed: Vec<Baked> = vec![];
    // Each round may also choose from those before.
    for (name, divides, slack) in [
        ("fast", [Divide::Row(0), Divide::Row(1)].as_slice(), 1.0),
        ("general", [Divide::Larger].as_slice(), GENERAL_SLACK),
        ("fast where it can", [Divide::Most(0), Divide::Most(1)].as_slice(), GENERAL_SLACK),
    ] {
        let mut round: Vec<(f64, Baked)> = vec![];
        for plan in [0, 1].into_iter().flat_map(|first| divides.iter().map(move |&divide| Plan { first, divide })) {
            let along = format!("{name}: along the ray of station {}", ["A", "B"][plan.first]);
            let by = match plan.divide {
                Divide::Row(row) | Divide::Most(row) => ROWS[row],
                Divide::Larger => "the larger parallax",
            };
            let choice = format!("{along}, dividing by {by} of the other");
            match form(room, plan, &sights, gate) {
                Ok(calib) => {
                    let calib = centred(calib, &sights);
                    let chosen_on = measure(&calib, &sights.noisy).1.rms_mm;
                    round
                        .push((chosen_on, Baked { calib, choice, measured: Measured::default(), slack, out_of_reach }));
                }
                Err(refusal) => reasons.push(format!("{choice}: {refusal}")),
            }
        }
        round.sort_by(|a, b| a.0.total_cmp(&b.0));
        for (_, mut baked) in round {
            baked.measured = verify(&baked.calib, &fresh);
            if slack == 1.0 && baked.measured.keeps(slack, range) {
                return Ok(baked.because(&reasons));
            }
            let Measured { rms_mm, max_mm, bias_um, .. } = baked.measured;
            reasons.push(format!(
                "{}: off by {rms_mm:.3} mm RMS, {max_mm:.2} at most, {bias_um:.1} um in the mean of an axis",
                baked.choice
            ));
            formed.push(baked);
        }
        let held = formed.iter().filter(|baked| slack > 1.0 && baked.measured.keeps(slack, range));
        if let Some(best) = held.min_by(|a, b| a.measured.rms_mm.total_cmp(&b.measured.rms_mm)) {
            return Ok(Baked { slack, ..best.clone() }.because(&reasons));
        }
    }
    let measured = formed.into_iter().map(|baked| baked.measured).collect();
    Err(Refusal { reason: format!("{}; mean range in metres", reasons.join("; ")), number: range, measured })
}
