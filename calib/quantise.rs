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

use super::solver::{self, Angle, Calib, Fast, General, Linear, Lines, Row, Scene, WEIGHTS, Weight};

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
}

/// Why a room cannot be served.
#[derive(Debug, Clone, PartialEq)]
pub struct Refusal {
    /// What was measured and which limit it broke.
    pub reason: String,
    /// The number in question.
    pub number: f64,
}

impl core::fmt::Display for Refusal {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "{}: {}", self.reason, self.number)
    }
}

impl std::error::Error for Refusal {}

fn refuse<T>(reason: impl Into<String>, number: f64) -> Result<T, Refusal> {
    Err(Refusal { reason: reason.into(), number })
}

impl Baked {
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
/// Mismatch that the gate lets through, metres per metre of mean range: 0.12 m at 1.6 m, twelve times what 0.2 deg of
/// noise makes, because a mote that moves adds its own.
const GATE: f64 = 0.12 / 1.6;
/// The gate of a small room, metres.
const GATE_MIN: f64 = 0.12;
/// The general form serves rooms with little parallax somewhere; it is allowed this many times the error.
const GENERAL_SLACK: f64 = 4.0;
/// Share of the volume in which the general form may be blind.
const BLIND: f64 = 0.05;
/// How far outside the volume a point must come out right if it comes out at all, in times the farthest corner.
const BEYOND: f64 = 1.5;
/// The rows of a station.
const ROWS: [&str; 2] = ["azimuth", "elevation"];
/// Noise of an angle for which the bake optimises, degrees.
const NOISE_DEG: f64 = 0.2;
/// Slants of the index of the table that are tried, times a typical baseline d3.
const SLANTS: [f64; 14] = [0.0, 0.15, 0.3, 0.45, 0.6, 0.75, 0.9, 1.05, 1.2, 1.4, 1.6, 1.8, 2.1, 2.5];
/// Points that the choice is made on.
const POINTS: usize = 4000;
/// Points that the chosen form is verified on, half of them with noise.
pub const VERIFIED: usize = 20_000;
/// Share by which every measured range is widened before it must fit.
const MARGIN: f64 = 0.04;
/// Angle units per degree.
const DEGREE: f64 = 1_048_576.0 / 180.0;
/// Half the field of view, angle units.
const FIELD: f64 = 60.0 * DEGREE;

type V = [f64; 3];

fn dot(a: V, b: V) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn times(m: [V; 3], v: V) -> V {
    m.map(|row| dot(row, v))
}

fn transposed(m: [V; 3]) -> [V; 3] {
    [0, 1, 2].map(|i| [m[0][i], m[1][i], m[2][i]])
}

fn minus(a: V, b: V) -> V {
    [0, 1, 2].map(|i| a[i] - b[i])
}

fn length(v: V) -> f64 {
    dot(v, v).sqrt()
}

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

/// xorshift64*: the same room always bakes to the same numbers.
struct Dice(u64);

impl Dice {
    fn unit(&mut self) -> f64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 11) as f64 / (1u64 << 53) as f64
    }

    fn gauss(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.unit()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.unit()).cos()
    }
}

/// Four angles seen at a point of the volume.
struct Sight {
    angles: [i32; 4],
    /// Their tangents.
    image: [f64; 4],
    /// The least-squares position.
    answer: V,
}

/// Solves the n equations `a x = b` by elimination; a little is added to the diagonal so that it always can.
fn solve<const N: usize>(mut a: [[f64; N]; N], mut b: [f64; N]) -> [f64; N] {
    let trace: f64 = (0..N).map(|i| a[i][i]).sum();
    for (i, row) in a.iter_mut().enumerate() {
        row[i] += 1e-12 * trace + f64::MIN_POSITIVE;
    }
    for i in 0..N {
        let pivot = (i..N).max_by(|&j, &k| a[j][i].abs().total_cmp(&a[k][i].abs())).unwrap_or(i);
        a.swap(i, pivot);
        b.swap(i, pivot);
        for j in i + 1..N {
            let f = a[j][i] / a[i][i];
            let (upper, lower) = a.split_at_mut(j);
            for (x, y) in lower[0].iter_mut().zip(&upper[i]).skip(i) {
                *x -= f * y;
            }
            b[j] -= f * b[i];
        }
    }
    for i in (0..N).rev() {
        let known: f64 = (i + 1..N).map(|k| a[i][k] * b[k]).sum();
        b[i] = (b[i] - known) / a[i][i];
    }
    b
}

/// Inhomogeneous least squares over x p3 - p1 and y p3 - p2 of both stations, P = [R | -R position].
fn least_squares(room: &Room, image: &[f64; 4]) -> V {
    let (mut normal, mut right) = ([[0.0; 3]; 3], [0.0; 3]);
    for (station, pair) in room.stations.iter().zip(image.chunks(2)) {
        for (axis, &x) in pair.iter().enumerate() {
            let r = station.rotation;
            let row = [0, 1, 2].map(|i| x * r[2][i] - r[axis][i]);
            let d = dot(row, station.position);
            for i in 0..3 {
                right[i] += row[i] * d;
                for j in 0..3 {
                    normal[i][j] += row[i] * row[j];
                }
            }
        }
    }
    solve(normal, right)
}

impl Sight {
    /// What both stations see of `point`, with `noise` degrees on each angle; nothing if one of them does not see it.
    fn of(room: &Room, point: V, mut noise: impl FnMut() -> f64) -> Option<Sight> {
        let mut angles = [0.0; 4];
        for (station, pair) in room.stations.iter().zip(angles.chunks_mut(2)) {
            let c = times(station.rotation, minus(point, station.position));
            pair[0] = (c[0] / c[2]).atan().to_degrees() * DEGREE;
            pair[1] = (c[1] / c[2]).atan().to_degrees() * DEGREE;
            if c[2] <= 0.0 || pair.iter().any(|a| a.abs() > FIELD) {
                return None;
            }
        }
        let angles = angles.map(|a| (a + DEGREE * noise()).round());
        if angles.iter().any(|a| a.abs() > FIELD) {
            return None;
        }
        let image = angles.map(|a| (a / DEGREE).to_radians().tan());
        let angles = angles.map(|a| a as i32);
        Some(Sight { angles, image, answer: least_squares(room, &image) })
    }
}

/// Sights of points outside the volume, without noise, up to [`BEYOND`] times as far from each station.
fn beyond(room: &Room, count: usize, dice: &mut Dice) -> Vec<Sight> {
    let corner = |k: usize| [0, 1, 2].map(|i| if k >> i & 1 == 0 { room.min[i] } else { room.max[i] });
    let far = room.stations.map(|s| BEYOND * Range::of((0..8).map(|k| length(minus(corner(k), s.position)))).max);
    let sight = |_| {
        let first = (dice.unit() < 0.5) as usize;
        let station = room.stations[first];
        let image = [0, 1].map(|_| (120.0 * (dice.unit() - 0.5)).to_radians().tan());
        let depth = far[first] * 0.02f64.powf(dice.unit());
        let c = [image[0] * depth, image[1] * depth, depth];
        let from_station = times(transposed(station.rotation), c);
        let point = [0, 1, 2].map(|i| station.position[i] + from_station[i]);
        let near = room.stations.iter().zip(far).all(|(s, far)| length(minus(point, s.position)) < far);
        if near { Sight::of(room, point, || 0.0) } else { None }
    };
    (0..count).filter_map(sight).collect()
}

/// `count` sights over the volume, with `noise` degrees on each angle; only where both stations see the point.
fn scatter(room: &Room, count: usize, noise: f64, dice: &mut Dice) -> Result<Vec<Sight>, Refusal> {
    let mut found = Vec::with_capacity(count);
    let mut tries = 0;
    while found.len() < count {
        tries += 1;
        if tries > 1000 * count {
            return refuse("hardly a point of the volume is seen by both stations; points found", found.len() as f64);
        }
        let point = [0, 1, 2].map(|i| room.min[i] + (room.max[i] - room.min[i]) * dice.unit());
        found.extend(Sight::of(room, point, || noise * dice.gauss()));
    }
    Ok(found)
}

/// The least and the greatest of what was seen.
#[derive(Clone, Copy)]
struct Range {
    min: f64,
    max: f64,
}

impl Range {
    fn of(values: impl Iterator<Item = f64>) -> Range {
        let none = Range { min: f64::INFINITY, max: f64::NEG_INFINITY };
        values.fold(none, |r, v| Range { min: r.min.min(v), max: r.max.max(v) })
    }

    fn and(self, other: Range) -> Range {
        Range { min: self.min.min(other.min), max: self.max.max(other.max) }
    }

    fn magnitude(self) -> f64 {
        self.max.max(-self.min) * (1.0 + MARGIN)
    }
}

fn mean(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let n = values.len() as f64;
    values.sum::<f64>() / n
}

/// Which row of the other station is divided by.
#[derive(Clone, Copy, PartialEq)]
enum Divide {
    /// This one: azimuth or elevation.
    Row(usize),
    /// Whichever has the larger parallax.
    Larger,
}

/// One way to use the four equations.
#[derive(Clone, Copy)]
struct Plan {
    /// The station whose ray is walked along.
    first: usize,
    divide: Divide,
}

/// What the stations see: points to choose by, and more to fit the weights to.
struct Sights {
    clean: Vec<Sight>,
    noisy: Vec<Sight>,
    wild: Vec<Sight>,
    /// Points anywhere in view of both, without noise.
    beyond: Vec<Sight>,
}

/// The quantities of the closed form for one sight, in metres.
struct Seen {
    x1: f64,
    y1: f64,
    x2: f64,
    y2: f64,
    v3: f64,
    a3: f64,
    a4: f64,
    d3: f64,
    d4: f64,
    m: f64,
    mismatch: f64,
    w: f64,
    z: f64,
    u: V,
    aside: [f64; 2],
}

/// A plan with its matrices: R21 with its rows in the plan's order, t likewise, the sign such that parallax is positive.
struct Frame {
    first: Station,
    order: [u32; 4],
    r21: [V; 3],
    t: V,
}

impl Frame {
    fn new(room: &Room, first: usize, [k3, k4]: [usize; 2]) -> Frame {
        let (one, two) = (room.stations[first], room.stations[1 - first]);
        // Column j of R21 = R2 R1^T is R2 times row j of R1.
        let r21 = transposed(one.rotation.map(|row| times(two.rotation, row)));
        let t = times(two.rotation, minus(one.position, two.position));
        let (a, b) = (2 * first as u32, 2 * (1 - first as u32));
        Frame {
            first: one,
            order: [a, a + 1, b + k3 as u32, b + k4 as u32],
            r21: [r21[k3], r21[k4], r21[2]],
            t: [t[k3], t[k4], t[2]],
        }
    }

    fn flip(&mut self) {
        self.r21 = self.r21.map(|row| row.map(|x| -x));
        self.t = self.t.map(|x| -x);
    }

    fn see(&self, sight: &Sight) -> Seen {
        let [x1, y1, x2, y2] = self.order.map(|k| sight.image[k as usize]);
        let [r1, r2, r3] = self.r21;
        let u = [x1, y1, 1.0];
        let [v1, v2, v3] = times(self.r21, u);
        let (a3, a4) = (x2 * v3 - v1, y2 * v3 - v2);
        let (d3, d4) = (self.t[0] - x2 * self.t[2], self.t[1] - y2 * self.t[2]);
        let m = a4 / a3;
        let mismatch = d4 - m * d3;
        let g1 = [0, 1].map(|i| x2 * r3[i] - r1[i]);
        let g2 = [0, 1].map(|i| y2 * r3[i] - r2[i]);
        let h = [0, 1].map(|i| g2[i] - m * g1[i]);
        let scale = 1.0 + m * m + h[0] * h[0] + h[1] * h[1];
        let w = (g1[0] * h[0] + g1[1] * h[1] - m) / scale;
        Seen {
            x1,
            y1,
            x2,
            y2,
            v3,
            a3,
            a4,
            d3,
            d4,
            m,
            mismatch,
            w,
            z: (d3 - mismatch * w) / a3,
            u,
            aside: [h[0] / scale, h[1] / scale],
        }
    }
}

/// Quantises x kx + y ky + k into a sum in `q` with kx and ky in `q_k`: what rounding takes from kx and ky on the
/// mean it gives back through the constant.
fn linear([kx, ky, k]: V, [q, q_k]: [i32; 2], [x, y]: [f64; 2], half: f64) -> Linear {
    let (ix, iy) = (fixed(kx, q_k), fixed(ky, q_k));
    let lost = (kx - unfixed(ix, q_k)) * x + (ky - unfixed(iy, q_k)) * y;
    Linear { x: ix, y: iy, one: fixed(k + lost + half, q) }
}

/// Which epipolar line a sight is on: m, made blind to the mismatch by `slant` (per metre).
struct Line {
    slant: f64,
    low: f64,
    width: f64,
}

impl Line {
    fn at(&self, s: &Seen) -> f64 {
        s.m + self.slant * s.mismatch
    }
}

/// As `fixed`, in 16 bits. What does not fit is cut: the error that this makes is measured like any other.
fn short(value: f64, q: i32) -> i16 {
    fixed(value, q).clamp(i16::MIN.into(), i16::MAX.into()) as i16
}

/// W and E over the epipolar lines, by local regression.
fn weights(seen: &[Seen], line: &Line, gate: f64, q_aside: i32) -> [Weight; WEIGHTS] {
    let &Line { low, width, .. } = line;
    let mut by_m: Vec<(f64, &Seen)> =
        seen.iter().filter(|s| s.mismatch.abs() < gate).map(|s| (line.at(s), s)).collect();
    by_m.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut table = [Weight { x: 0, m: 0, one: 0, aside: [0; 2] }; WEIGHTS];
    for (k, entry) in table.iter_mut().enumerate() {
        let centre = low + (k as f64 + 0.5) * width;
        // All sights of the entry, or the 300 nearest if they are fewer.
        let mut from = by_m.partition_point(|s| s.0 < centre - width / 2.0);
        let mut to = by_m.partition_point(|s| s.0 < centre + width / 2.0);
        while to - from < 80.min(by_m.len()) {
            let left = from.checked_sub(1).map_or(f64::INFINITY, |i| centre - by_m[i].0);
            let right = by_m.get(to).map_or(f64::INFINITY, |s| s.0 - centre);
            if left < right { from -= 1 } else { to += 1 }
        }
        let sights = &by_m[from..to];
        let (mut a, mut b) = ([[0.0; 2]; 2], [[0.0; 2]; 2]);
        for (at, s) in sights {
            let row = [1.0, at - centre];
            let weight = s.mismatch.powi(2);
            for i in 0..2 {
                for (b, aside) in b.iter_mut().zip(s.aside) {
                    b[i] += weight * row[i] * aside;
                }
                for j in 0..2 {
                    a[i][j] += weight * row[i] * row[j];
                }
            }
        }
        let aside = b.map(|b| solve(a, b)[0]);
        let middle = mean(sights.iter().map(|(_, s)| s.m));
        let (mut a, mut b) = ([[0.0; 3]; 3], [0.0; 3]);
        for (_, s) in sights {
            let row = [1.0, s.x2, s.m - middle];
            let weight = (s.mismatch / s.a3).powi(2) * dot(s.u, s.u);
            // What the table gets wrong of E along the ray, W can put right.
            let wrong = [aside[0] - s.aside[0], aside[1] - s.aside[1], 0.0];
            let w = s.w + s.a3 * dot(wrong, s.u) / dot(s.u, s.u);
            for i in 0..3 {
                b[i] += weight * row[i] * w;
                for j in 0..3 {
                    a[i][j] += weight * row[i] * row[j];
                }
            }
        }
        let [one, x, m] = solve(a, b);
        *entry = Weight {
            x: short(x, 14),
            m: short(m, 14),
            one: fixed(one - m * middle, 29) + (1 << 13),
            aside: aside.map(|e| short(e, q_aside)),
        };
    }
    table
}

/// RMS distance in metres that the table of weights makes, everything else exact.
fn weights_error(seen: &[&Seen], line: &Line, table: &[Weight; WEIGHTS], q_aside: i32) -> f64 {
    let square = |s: &&Seen| {
        let entry = (line.at(s) - line.low) / line.width;
        let Some(weight) = table.get(entry as usize) else {
            return 1.0;
        };
        let w = unfixed(weight.x.into(), 14) * s.x2 + unfixed(weight.m.into(), 14) * s.m;
        let along = (w + unfixed(weight.one, 29) - s.w) / s.a3;
        let [x, y] = [0, 1].map(|k| unfixed(weight.aside[k].into(), q_aside) - s.aside[k]);
        let error = [x - along * s.u[0], y - along * s.u[1], along];
        dot(error, error) * s.mismatch.powi(2)
    };
    mean(seen.iter().map(square)).sqrt()
}

/// One row to divide by and the sights for which it does.
struct Group {
    frame: Frame,
    calm: Vec<Seen>,
    seen: Vec<Seen>,
    wild: Vec<Seen>,
    beyond: Vec<Seen>,
}

impl Group {
    /// Everything is seen through one row, turned so that its parallax is positive.
    fn whole(room: &Room, first: usize, rows: [usize; 2], sights: &Sights) -> Result<Group, Refusal> {
        let mut frame = Frame::new(room, first, rows);
        if frame.see(&sights.clean[0]).a3 < 0.0 {
            frame.flip();
        }
        let see = |sights: &[Sight]| sights.iter().map(|s| frame.see(s)).collect::<Vec<_>>();
        let (calm, seen) = (see(&sights.clean), see(&sights.noisy));
        let (wild, beyond) = (see(&sights.wild), see(&sights.beyond));
        let least = Range::of(calm.iter().chain(&seen).map(|s| s.a3)).min;
        if least <= 0.0 {
            return refuse(format!("parallax in {} changes sign; its least", ROWS[rows[0]]), least);
        }
        Ok(Group { frame, calm, seen, wild, beyond })
    }

    /// The sights whose parallax is larger in this row than in the other, and at least `least`.
    fn part(room: &Room, first: usize, rows: [usize; 2], sights: &Sights, least: f64) -> Group {
        let frame = Frame::new(room, first, rows);
        let see = |sights: &[Sight]| {
            let seen = sights.iter().map(|s| frame.see(s));
            seen.filter(|s| s.a3.abs() >= s.a4.abs() && s.a3.abs() >= least).collect::<Vec<_>>()
        };
        let (calm, seen) = (see(&sights.clean), see(&sights.noisy));
        let (wild, beyond) = (see(&sights.wild), see(&sights.beyond));
        Group { frame, calm, seen, wild, beyond }
    }

    /// The lines of this group.
    fn lines(&self, gate: f64, unit: f64, q_aside: i32) -> Result<Lines, Refusal> {
        let distance = mean(self.calm.iter().map(|s| s.d3.abs())).max(1e-3);
        let few: Vec<&Seen> = self.seen.iter().step_by(2).collect();
        let slants = SLANTS.into_iter().flat_map(|k| [k, -k]).map(|k| k / distance);
        let (mut best, mut least) = (None, f64::INFINITY);
        for slant in slants {
            let at = |s: &Seen| s.m + slant * s.mismatch;
            // As far as the gate lets m stray at a typical distance: m falls by mismatch / d3.
            let stray = if self.calm.iter().all(|s| s.d3 > 0.0) {
                gate * (slant - 1.0 / distance).abs()
            } else {
                gate * (slant.abs() + 1.0 / distance)
            };
            let calm = Range::of(self.calm.iter().map(at));
            let reach = Range::of(self.seen.iter().map(at));
            let (low, high) = ((calm.min - stray).min(reach.min), (calm.max + stray).max(reach.max));
            let bits = ((high - low) / WEIGHTS as f64).log2().ceil() as i32;
            let width = 2f64.powi(bits);
            // Entries begin at whole multiples of their width.
            let low = (((low + high) / 2.0 / width).round() - WEIGHTS as f64 / 2.0) * width;
            let low = low.max(-4.0 + width);
            if low + width * WEIGHTS as f64 > 4.0 || reach.min < low || bits + 29 < 0 {
                continue;
            }
            let line = Line { slant, low, width };
            let error = weights_error(&few, &line, &weights(&self.seen, &line, gate, q_aside), q_aside);
            if error < least {
                (best, least) = (Some((line, bits)), error);
            }
        }
        let Some((line, bits)) = best else {
            let slope = Range::of(self.seen.iter().map(|s| s.m)).magnitude();
            return refuse("the epipolar lines fan out too far; greatest slope, of at most 4", slope);
        };
        Ok(Lines {
            slant: fixed(line.slant * unit, 13),
            shift: (bits + 29) as u32,
            first: (line.low / line.width).round() as i32,
            weights: weights(&self.wild, &line, gate, q_aside),
        })
    }
}

/// The Q format of the parallax: in the volume it fits; beyond it wraps at most once, which shows in the sign.
fn parallax_format(groups: &[Group]) -> i32 {
    let both = |s: &Seen| [s.a3, s.a4];
    let inside = groups.iter().flat_map(|g| g.seen.iter().chain(&g.calm));
    let outside = groups.iter().flat_map(|g| &g.beyond);
    let (inside, outside) = (Range::of(inside.flat_map(both)), Range::of(outside.flat_map(both)));
    q_for(inside.magnitude()).min(q_for(outside.magnitude()) + 1).min(32)
}

/// The numbers under `plan`, or why they do not fit.
fn form(room: &Room, plan: Plan, sights: &Sights) -> Result<Calib, Refusal> {
    let groups = match plan.divide {
        Divide::Row(row) => vec![Group::whole(room, plan.first, [row, 1 - row], sights)?],
        Divide::Larger => {
            let all = [[0, 1], [1, 0]].map(|rows| Group::part(room, plan.first, rows, sights, 0.0));
            // As small as the reciprocal takes.
            let least = solver::LEAST * 2f64.powi(30 - parallax_format(&all)) / (1.0 - 2.0 * MARGIN);
            let part = |rows| Group::part(room, plan.first, rows, sights, least);
            let groups = vec![part([0, 1]), part([1, 0])];
            let served: usize = groups.iter().map(|g| g.seen.len()).sum();
            let blind = 1.0 - served as f64 / sights.noisy.len() as f64;
            if blind > BLIND {
                return refuse("the rays are too close to parallel over a share of the volume of", blind);
            }
            if let Some(group) = groups.iter().find(|g| g.wild.len() < 300) {
                return refuse("too few points divide by the other row", group.wild.len() as f64);
            }
            groups
        }
    };
    let over = |f: &dyn Fn(&Seen) -> f64| Range::of(groups.iter().flat_map(|g| g.seen.iter().chain(&g.calm)).map(f));
    let centre = |f: &dyn Fn(&Seen) -> f64| {
        let all: Vec<f64> = groups.iter().flat_map(|g| &g.calm).map(f).collect();
        mean(all.into_iter())
    };
    let frame = &groups[0].frame;
    let gate = gate(room, &sights.clean);
    let (x1, y1) = (centre(&|s| s.x1), centre(&|s| s.y1));
    let (x2, y2) = (mean(groups[0].calm.iter().map(|s| s.x2)), mean(groups[0].calm.iter().map(|s| s.y2)));

    let least = over(&|s| s.a3.abs()).min * (1.0 - MARGIN);
    let q_a = parallax_format(&groups);
    if least * 2f64.powi(q_a - 30) < solver::LEAST {
        return refuse(
            "the parallax varies too much: its least, when its greatest is between 1 and 2",
            least * 2f64.powi(q_a - 30),
        );
    }

    // Beyond the volume every point must come out right, too, wherever its parallax lets it through.
    let positive = matches!(plan.divide, Divide::Row(_));
    let beyond = || groups.iter().flat_map(|g| &g.beyond);
    let passes = |s: &&Seen| s.a3.abs() >= least && !(positive && s.a3 < 0.0);
    let passing: Vec<&Seen> = beyond().filter(passes).collect();
    let out = |f: &dyn Fn(&Seen) -> f64| over(f).and(Range::of(passing.iter().map(|s| f(s))));

    // Length: baselines below 1 unit, Z / a3 below 2^32 in the product of N (Q16) and the reciprocal (Q14).
    let d = Range::of(beyond().flat_map(|s| [s.d3, s.d4])).and(over(&|s| s.d3)).and(over(&|s| s.d4));
    let d_max = d.magnitude();
    let z = over(&|s| s.z);
    if z.min <= 0.0 {
        return refuse("a point of the volume lies behind a station; its depth in metres", z.min);
    }
    let z_unit = (out(&|s| s.z).magnitude() / 2f64.powi(q_a - 28)).log2().ceil();
    let unit_shift = d_max.log2().ceil().max(z_unit).max(0.0) as i32;
    let unit = 2f64.powi(unit_shift);

    let v3 = out(&|s| s.v3);
    let depth_whole = ((v3.min + v3.max) / 2.0).round();
    let q_v = q_for((v3.max - depth_whole).max(depth_whole - v3.min) * (1.0 + MARGIN)).min(33);
    let depth_shift = q_v - (q_a - 15);
    let half = |shift: i32, q: i32| 2f64.powi(shift - 1 - q);
    let r3 = frame.r21[2];
    let depth = [r3[0], r3[1], r3[2] - depth_whole];
    let depth = linear(depth, [q_v, q_v - 15], [x1, y1], half(depth_shift, q_v));

    // tan() comes with half a Q15 unit, which whole multiples must give back.
    let excess = unfixed(solver::HALF, 28);
    let row = |r: V| {
        let whole = [0, 1].map(|i| -r[i].round());
        let given = (depth_whole + whole[0] + whole[1]) * excess;
        let rest = [-r[0] - whole[0], -r[1] - whole[1], -r[2] - given];
        let rest = linear(rest, [q_a, q_a - 15], [x1, y1], 0.0);
        Row { whole: whole.map(|x| x as i32), rest }
    };

    let baseline_depth = fixed(frame.t[2] / unit, 16);
    let lost = frame.t[2] / unit - unfixed(baseline_depth, 16);
    // m is cut to Q15, which makes the mismatch too large by half a unit of it times d3.
    let cut = match plan.divide {
        Divide::Row(_) => 2f64.powi(-16) * centre(&|s| s.d3) / unit,
        Divide::Larger => 0.0,
    };
    let baseline = [
        fixed(frame.t[0] / unit - lost * x2 + half(15, 31), 31),
        fixed(frame.t[1] / unit - lost * y2 + half(15, 31) - cut, 31),
    ];

    // Z in q_z, X and Y in q_x, their sum with R1^T in q_p.
    let to_world = transposed(frame.first.rotation);
    let axis = |i: usize, s: &Seen| frame.first.position[i] + s.z * dot(to_world[i], s.u);
    let reach = [0, 1, 2].map(|i| out(&|s| axis(i, s)).magnitude());
    let reach = reach.into_iter().fold(0.0, f64::max) / unit;
    let q_p = q_for(reach).min(32);
    let wide = out(&|s| s.x1 * s.z).magnitude().max(out(&|s| s.y1 * s.z).magnitude()) / unit;
    let q_x = (q_p + 1) / 2;
    let q_z = (q_for(wide) - 15).min(q_x);
    let position_shift = q_p - 16 - unit_shift;
    let (side_shift, z_shift) = (15 + q_z - q_x, 60 - q_a - q_z);
    if position_shift < 1 || side_shift < 1 || z_shift < 0 || depth_shift < 1 {
        return refuse("the room is too large for its formats; its reach in metres", reach * unit);
    }
    let corner = [centre(&|s| s.x1 * s.z), centre(&|s| s.y1 * s.z), centre(&|s| s.z)].map(|c| c / unit);
    let world_z = to_world.map(|r| fixed(r[2], q_p - q_z));
    let world = [0, 1, 2].map(|i| {
        let [kx, ky, kz] = to_world[i];
        // X, Y and Z are cut, not rounded.
        let cut = half(0, q_x) * (kx + ky) + half(0, q_z) * kz;
        let lost = (kz - unfixed(world_z[i], q_p - q_z)) * corner[2];
        let one = frame.first.position[i] / unit + cut + lost;
        linear([kx, ky, one], [q_p, q_p - q_x], [corner[0], corner[1]], half(position_shift, q_p))
    });

    let scene = Scene {
        order: frame.order,
        depth,
        depth_shift: depth_shift as u32,
        depth_whole: depth_whole as i32,
        whole_shift: (q_a - 28) as u32,
        least: fixed(least, q_a),
        baseline,
        baseline_depth,
        gate_shift: (gate / unit * 65536.0).log2().round() as u32,
        z_shift: z_shift as u32,
        side_shift: side_shift as u32,
        world,
        world_z,
        position_shift: position_shift as u32,
        unit_shift: unit_shift as u32,
    };
    let [r1, r2, _] = frame.r21;
    let lines = |group: &Group| group.lines(gate, unit, q_z - 1);
    match groups.as_slice() {
        [only] => {
            let far = [-r2[0], -r2[1], -r2[2] - depth_whole * excess];
            let far = linear(far, [q_a, q_a - 15], [x1, y1], half(15, q_a));
            Ok(Calib::Fast(Fast { scene, near: row(r1), far, lines: Box::leak(Box::new(lines(only)?)) }))
        }
        [first, second, ..] => {
            // A bake is done once or a few times by a program; its rooms may stay.
            let lines = Box::leak(Box::new([lines(first)?, lines(second)?]));
            Ok(Calib::General(General { scene, rows: [row(r1), row(r2)], lines }))
        }
        [] => refuse("no plan", 0.0),
    }
}

/// Mean distance from both stations to what was seen, metres.
fn range(room: &Room, sights: &[Sight]) -> f64 {
    mean(sights.iter().map(|s| mean(room.stations.iter().map(|st| length(minus(s.answer, st.position))))))
}

fn gate(room: &Room, sights: &[Sight]) -> f64 {
    (GATE * range(room, sights)).max(GATE_MIN)
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

/// Quantises `room`.
///
/// # Errors
/// Numbers that are no room (a matrix that is no rotation, an empty volume), a station inside the volume, lengths
/// beyond 100 m, a volume that the stations do not both see.
pub fn bake(room: &Room) -> Result<Baked, Refusal> {
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
    let mut dice = Dice(0x9e37_79b9_7f4a_7c15);
    let mut see = |count, noise| scatter(room, count, noise, &mut dice);
    let fresh = [see(VERIFIED / 2, 0.0)?, see(VERIFIED / 2, NOISE_DEG)?];
    let (clean, noisy) = (see(POINTS, 0.0)?, see(POINTS, NOISE_DEG)?);
    let mut wild = see(5 * POINTS, NOISE_DEG)?;
    wild.extend(see(2 * POINTS, 3.0 * NOISE_DEG)?);
    let beyond = beyond(room, 10 * POINTS, &mut dice);
    let sights = Sights { clean, noisy, wild, beyond };
    let range = range(room, &sights.clean);

    let mut reasons = vec![];
    for (name, divides, slack) in [
        ("fast", [Divide::Row(0), Divide::Row(1)].as_slice(), 1.0),
        ("general", [Divide::Larger].as_slice(), GENERAL_SLACK),
    ] {
        let mut best: Option<Baked> = None;
        for plan in [0, 1].into_iter().flat_map(|first| divides.iter().map(move |&divide| Plan { first, divide })) {
            let along = format!("along the ray of station {}", ["A", "B"][plan.first]);
            let by = match plan.divide {
                Divide::Row(row) => ROWS[row],
                Divide::Larger => "the larger parallax",
            };
            match form(room, plan, &sights) {
                Ok(calib) => {
                    let calib = centred(calib, &sights);
                    let (_, measured) = measure(&calib, &sights.noisy);
                    if best.as_ref().is_none_or(|b| measured.rms_mm < b.measured.rms_mm) {
                        let choice = format!("{name}: {along}, dividing by {by} of the other");
                        best = Some(Baked { calib, choice, measured });
                    }
                }
                Err(refusal) => reasons.push(format!("{name} {along}: {refusal}")),
            }
        }
        if let Some(mut best) = best {
            best.measured = verify(&best.calib, &fresh);
            let Measured { rms_mm, max_mm, .. } = best.measured;
            if rms_mm <= slack * RMS_MM_PER_M * range && max_mm <= slack * MAX_MM_PER_M * range {
                if !reasons.is_empty() {
                    best.choice += &format!(" ({})", reasons.join("; "));
                }
                return Ok(best);
            }
            reasons.push(format!("{name} form off by {rms_mm:.3} mm RMS, {max_mm:.2} at most"));
        }
    }
    refuse(format!("{}; mean range in metres", reasons.join("; ")), range)
}
