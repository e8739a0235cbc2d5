//! The table of weights over the epipolar lines.
//!
//! What can go wrong: lines that fan out too far for the table; the room is refused.

use super::super::solver::{Lines, WEIGHTS, Weight};
use super::plan::Seen;
use super::sight::{Range, dot, mean, solve};
use super::{Refusal, fixed, refuse, unfixed};

/// Slants of the index of the table that are tried, times a typical baseline d3.
const SLANTS: [f64; 14] = [0.0, 0.15, 0.3, 0.45, 0.6, 0.75, 0.9, 1.05, 1.2, 1.4, 1.6, 1.8, 2.1, 2.5];

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
        // All sights of the entry, or the 80 nearest if they are fewer.
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

/// The lines of a row, from what is seen without noise, with noise, and with more of it.
pub(super) fn lines([calm, seen, wild]: [&[Seen]; 3], gate: f64, unit: f64, q_aside: i32) -> Result<Lines, Refusal> {
    let distance = mean(calm.iter().map(|s| s.d3.abs())).max(1e-3);
    let few: Vec<&Seen> = seen.iter().step_by(2).collect();
    let slants = SLANTS.into_iter().flat_map(|k| [k, -k]).map(|k| k / distance);
    let (mut best, mut least) = (None, f64::INFINITY);
    for slant in slants {
        let at = |s: &Seen| s.m + slant * s.mismatch;
        // As far as the gate lets m stray at a typical distance: m falls by mismatch / d3.
        let stray = if calm.iter().all(|s| s.d3 > 0.0) {
            gate * (slant - 1.0 / distance).abs()
        } else {
            gate * (slant.abs() + 1.0 / distance)
        };
        let calm = Range::of(calm.iter().map(at));
        let reach = Range::of(seen.iter().map(at));
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
        let error = weights_error(&few, &line, &weights(seen, &line, gate, q_aside), q_aside);
        if error < least {
            (best, least) = (Some((line, bits)), error);
        }
    }
    let Some((line, bits)) = best else {
        let slope = Range::of(seen.iter().map(|s| s.m)).magnitude();
        return refuse("the epipolar lines fan out too far; greatest slope, of at most 4", slope);
    };
    Ok(Lines {
        slant: fixed(line.slant * unit, 13),
        shift: (bits + 29) as u32,
        first: (line.low / line.width).round() as i32,
        weights: weights(wild, &line, gate, q_aside),
    })
}
