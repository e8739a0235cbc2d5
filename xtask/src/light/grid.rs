//! When every half turn began, from the rows alone.
//!
//! What `timestamp_ticks` stands for is not written down and differs between recordings, so three readings are tried: the
//! timestamp is the sync, the middle between sync and sweep, or the sweep. The right one puts sweeps of different kinds
//! on one grid. When none does, the rows are a log, written some time after the sweep, and each is given the newest slot
//! of its kind that was over.
//!
//! The grid is a line fitted every quarter second to the rows around it, each counting by how well it agrees with the
//! others.
//!
//! What can go wrong: too few rows, or rows without a rhythm. There is then no grid.

use super::{ON_GRID, SLOTS, Stamp, sync_offset};
use crate::quantile::quantile;
use crate::recording::{Axis, Kind, Row, Station};

/// Slots between two points of the fitted grid: a quarter of a second.
const KNOT: i64 = 30;
/// Slots to each side that a point of the grid is fitted to: half a second.
const REACH: i64 = 60;

/// The slot of the cycle in which `kind` sweeps.
fn slot_of(kind: Kind) -> i64 {
    let first = match kind.station {
        Station::B => 0,
        Station::A => 2,
    };
    first + i64::from(kind.axis == Axis::El)
}

/// One row as it bears on the grid: a time that should be the start of a slot.
#[derive(Clone, Copy)]
struct Sight {
    time: f64,
    slot: i64,
}

impl Sight {
    /// Number of the half turn, counted from `from`, that this sight must be nearest to.
    fn number(&self, from: i64, start: f64, half_turn: f64) -> i64 {
        let ahead = (self.time - start) / half_turn;
        let cycles = (ahead + (from - self.slot) as f64) / SLOTS as f64;
        self.slot + SLOTS * cycles.round() as i64
    }
}

/// When every half turn began, in timestamp ticks.
pub(super) struct Grid {
    first: i64,
    knots: Vec<f64>,
    half_turn: f64,
}

impl Grid {
    /// Fits the grid to sights in the order of their rows; `gate` is how far from where the last
    /// ones say, in half turns, one may lie and still be believed.
    fn fit(sights: &[Sight], half_turn: f64, gate: f64) -> Option<Self> {
        let anchor = Self::anchor(sights, half_turn, gate)?;
        let believed = Self::follow(sights, anchor, half_turn, gate);
        let (first, last) = (believed.first()?.0, believed.iter().map(|b| b.0).max()?);
        let mut knots = Vec::new();
        let mut at = first;
        loop {
            knots.push(Self::smooth(&believed, at, half_turn));
            if at > last {
                break;
            }
            at += KNOT;
        }
        let sane = knots.windows(2).all(|pair| ((pair[1] - pair[0]) / (KNOT as f64 * half_turn) - 1.0).abs() < 0.02);
        sane.then_some(Self { first, knots, half_turn })
    }

    /// The early sight that most of its neighbours agree with.
    fn anchor(sights: &[Sight], half_turn: f64, gate: f64) -> Option<Sight> {
        let early = &sights[..sights.len().min(100)];
        let agree = |a: &Sight| {
            let near = |s: &&Sight| {
                let number = s.number(a.slot, a.time, half_turn);
                (s.time - a.time - (number - a.slot) as f64 * half_turn).abs() < gate * half_turn
            };
            early.iter().filter(near).count()
        };
        early.iter().max_by_key(|s| agree(s)).copied()
    }

    /// Numbers the sights, dropping those that stand apart from where the others lead.
    fn follow(sights: &[Sight], anchor: Sight, half_turn: f64, gate: f64) -> Vec<(i64, f64)> {
        // An RC clock wanders by hundreds of ppm, so the gate widens with the time since the last.
        const WANDER: f64 = 3e-4;
        let (mut number, mut start) = (anchor.slot, anchor.time);
        let mut believed = Vec::new();
        for sight in sights {
            let n = sight.number(number, start, half_turn);
            let gap = (n - number) as f64;
            let expected = start + gap * half_turn;
            let off = sight.time - expected;
            if off.abs() > half_turn * (gate + WANDER * gap.abs()) {
                continue;
            }
            believed.push((n, sight.time));
            if n > number {
                let trust = (0.1 + gap / 600.0).min(1.0);
                (number, start) = (n, expected + trust * off);
            }
        }
        believed
    }

    /// The start of half turn `at`: a line through the sights around it, each counting less the
    /// further it lies from the line (Tukey's biweight).
    fn smooth(believed: &[(i64, f64)], at: i64, half_turn: f64) -> f64 {
        let mut reach = REACH;
        let near = loop {
            let from = believed.partition_point(|b| b.0 < at - reach);
            let to = believed.partition_point(|b| b.0 <= at + reach);
            let near = &believed[from.min(to)..to];
            let span = near.last().map_or(0, |b| b.0) - near.first().map_or(0, |b| b.0);
            if near.len() == believed.len() || (near.len() >= 8 && span >= REACH) {
                break near;
            }
            reach *= 2;
        };
        let base = near[0].1;
        let points: Vec<(f64, f64)> =
            near.iter().map(|&(n, t)| ((n - at) as f64, t - base - (n - near[0].0) as f64 * half_turn)).collect();
        let mut weights = vec![1.0; points.len()];
        let mut level = 0.0;
        for _ in 0..6 {
            let (mut w, mut wx, mut wy, mut wxx, mut wxy) = (0.0, 0.0, 0.0, 0.0, 0.0);
            for (&(x, y), &k) in points.iter().zip(&weights) {
                w += k;
                wx += k * x;
                wy += k * y;
                wxx += k * x * x;
                wxy += k * x * y;
            }
            let det = w * wxx - wx * wx;
            let slope = if det > 0.0 { (w * wxy - wx * wy) / det } else { 0.0 };
            level = (wy - slope * wx) / w;
            let off = |&(x, y): &(f64, f64)| y - level - slope * x;
            let mut sizes: Vec<f64> = points.iter().map(|p| off(p).abs()).collect();
            let reach = (4.685 * 1.4826 * quantile(&mut sizes, 0.5)).max(2.0);
            for (point, weight) in points.iter().zip(&mut weights) {
                let part = (off(point) / reach).powi(2);
                *weight = if part < 1.0 { (1.0 - part).powi(2) } else { 0.0 };
            }
        }
        base + level + (at - near[0].0) as f64 * half_turn
    }

    /// When half turn `number` began; beyond the ends the nearest slope goes on.
    pub(super) fn start(&self, number: i64) -> f64 {
        let (knot, part) = self.place(number);
        let next = self.knots.get(knot + 1).copied();
        let next = next.unwrap_or(self.knots[knot] + KNOT as f64 * self.half_turn);
        self.knots[knot] + part * (next - self.knots[knot])
    }

    /// How long half turn `number` lasted.
    pub(super) fn length(&self, number: i64) -> f64 {
        self.start(number + 1) - self.start(number)
    }

    fn place(&self, number: i64) -> (usize, f64) {
        let last = self.knots.len().saturating_sub(2) as i64;
        let knot = (number - self.first).div_euclid(KNOT).clamp(0, last);
        (knot as usize, (number - self.first - knot * KNOT) as f64 / KNOT as f64)
    }

    /// How many half turns after the first one `time` is, in parts of one.
    pub(super) fn number_at(&self, time: f64) -> f64 {
        let last = self.knots.len().saturating_sub(2);
        let knot = self.knots.partition_point(|&k| k <= time).saturating_sub(1).min(last);
        let start = self.first + knot as i64 * KNOT;
        start as f64 + (time - self.start(start)) / self.length(start)
    }

    /// The half turn of a sight's slot that begins nearest to it.
    fn number_of(&self, sight: &Sight) -> i64 {
        let cycles = (self.number_at(sight.time) - sight.slot as f64) / SLOTS as f64;
        sight.slot + SLOTS * cycles.round() as i64
    }
}

/// The meaning of the timestamps and the grid that follows from it.
pub(super) struct Found {
    pub(super) stamp: Stamp,
    pub(super) grid: Grid,
    /// Per row: the half turn it belongs to and how far off the grid it is, in half turns.
    pub(super) numbers: Vec<(i64, f64)>,
}

impl Found {
    pub(super) fn search(rows: &[Row], nominal: f64) -> Option<Self> {
        [(Stamp::Sync, 0.0), (Stamp::Middle, 0.5), (Stamp::Sweep, 1.0)]
            .into_iter()
            .filter_map(|(stamp, part)| Self::stamped(rows, nominal, stamp, part))
            .max_by(|a, b| a.0.total_cmp(&b.0))
            .filter(|(agreeing, _)| *agreeing > 0.5)
            .map(|(_, found)| found)
            .or_else(|| Self::logged(rows, nominal))
    }

    /// Reads timestamps as the instant at `part` of the way from sync to sweep; tells how much of
    /// the recording agrees, judged by neighbours of different kinds, for those of one kind agree
    /// under every reading.
    fn stamped(rows: &[Row], nominal: f64, stamp: Stamp, part: f64) -> Option<(f64, Self)> {
        let sync = |row: &Row| row.timestamp as f64 - part * f64::from(row.sync_to_sweep);
        let half_turn = cycle_length(rows, nominal, sync)? / SLOTS as f64;
        let sights: Vec<Sight> = rows
            .iter()
            .map(|row| Sight { time: sync(row) - sync_offset(row.kind.station) * half_turn, slot: slot_of(row.kind) })
            .collect();
        let (mut near, mut pairs) = (0, 0);
        for pair in sights.windows(2).filter(|p| p[0].slot != p[1].slot) {
            let n = pair[1].number(pair[0].slot, pair[0].time, half_turn) - pair[0].slot;
            if (1..=8).contains(&n) {
                let off = pair[1].time - pair[0].time - n as f64 * half_turn;
                near += usize::from(off.abs() < ON_GRID * half_turn);
                pairs += 1;
            }
        }
        let agreeing = near as f64 / f64::from(pairs.max(1));
        let grid = Grid::fit(&sights, half_turn, 2.0 * ON_GRID)?;
        let numbers = sights
            .iter()
            .map(|sight| {
                let number = grid.number_of(sight);
                (number, (sight.time - grid.start(number)) / half_turn)
            })
            .collect();
        Some((agreeing, Self { stamp, grid, numbers }))
    }

    /// Reads timestamps as the time of writing: each row is the newest sweep of its kind that was
    /// over. The sweeps are in nominal ticks, the timestamps on a clock of their own.
    fn logged(rows: &[Row], nominal: f64) -> Option<Self> {
        // The log is written in bursts with a jitter of a tenth of a half turn.
        const GATE: f64 = 0.3;
        let log = |row: &Row| row.timestamp as f64;
        let half_turn = cycle_length(rows, nominal, log)? / SLOTS as f64;
        let sweep = |row: &Row, half_turn: f64| {
            (sync_offset(row.kind.station) + f64::from(row.sync_to_sweep) / nominal) * half_turn
        };
        // A station's azimuth waits for its elevation, so the elevations tell the time; an
        // elevation that says the same as the one before is the same sweep once more.
        let mut said = [(0u32, f64::NEG_INFINITY); 4];
        let mut sights = Vec::new();
        for row in rows.iter().filter(|row| row.kind.axis == Axis::El) {
            let last = &mut said[row.kind.index()];
            let repeat = last.0 == row.sync_to_sweep && log(row) - last.1 < 3.0 * half_turn;
            if !repeat {
                *last = (row.sync_to_sweep, log(row));
                let time = log(row) - sweep(row, half_turn);
                sights.push(Sight { time, slot: slot_of(row.kind) });
            }
        }
        let mut grid = Grid::fit(&sights, half_turn, GATE)?;
        // The fit runs through the middle of the delays; no row is written before its sweep.
        let mut late: Vec<f64> = sights
            .iter()
            .map(|sight| {
                let near = grid.number_of(sight);
                sight.time - grid.start(near)
            })
            .collect();
        let earliest = quantile(&mut late, 0.01);
        grid.knots.iter_mut().for_each(|knot| *knot += earliest);
        let numbers = rows
            .iter()
            .map(|row| {
                let at = grid.number_at(log(row) - sweep(row, half_turn));
                let slot = slot_of(row.kind);
                let cycles = ((at - slot as f64 + GATE) / SLOTS as f64).floor();
                let number = slot + SLOTS * cycles as i64;
                (number, at - number as f64)
            })
            .collect();
        Some(Self { stamp: Stamp::Log, grid, numbers })
    }
}

/// The usual time between two sweeps of one kind that are one cycle apart.
fn cycle_length(rows: &[Row], nominal: f64, time: impl Fn(&Row) -> f64) -> Option<f64> {
    let cycle = SLOTS as f64 * nominal;
    let mut last: [Option<&Row>; 4] = [None; 4];
    let mut lengths = Vec::new();
    for row in rows {
        let previous = &mut last[row.kind.index()];
        if previous.is_some_and(|p| time(row) - time(p) < 0.75 * cycle) {
            continue;
        }
        if let Some(previous) = previous.replace(row) {
            let length = time(row) - time(previous);
            if length < 1.25 * cycle {
                lengths.push(length);
            }
        }
    }
    (lengths.len() >= 8).then(|| quantile(&mut lengths, 0.5))
}
