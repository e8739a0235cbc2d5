//! Edges on the grid.
//!
//! The syncs follow the smooth grid, to the nearest tick; the sweep comes the recorded number of ticks after its own sync,
//! exactly. So the recorded sweeps keep their jitter and the recorded clock keeps its drift, while the syncs have no
//! jitter of their own.
//!
//! What can go wrong: a row that cannot be played; [`Unplayable`] says why, and it is counted.

use super::grid::Found;
use super::{
    B_AFTER_A, Findings, HALF_TURNS_HZ, Light, LightConfig, ON_GRID, PlayedRow, SLOTS, Stamp, Unplayable, sync_offset,
};
use crate::quantile::quantile;
use crate::recording::{Row, Station};

/// Unit of the sync widths as a part of a half turn: 10.417 us of 8.333 ms.
const WIDTH_UNIT: f64 = 1.0 / 800.0;
/// The longest sync, with axis, data and skip bits all set: (6 + 1 + 2 + 4) units.
const LONGEST_SYNC: f64 = 13.0 * WIDTH_UNIT;
/// A sweep must keep this far from syncs to be a pulse of its own, as a part of a half turn.
const GUARD: f64 = 0.005;

/// Width of a station's sync in a slot, as a part of a half turn; data bits are all zero.
fn sync_width(station: Station, slot: i64) -> f64 {
    let slot = slot.rem_euclid(SLOTS);
    let axis = slot % 2;
    let a_sweeps = slot >= 2;
    let skip = (station == Station::A) != a_sweeps;
    (6 + axis + 4 * i64::from(skip)) as f64 * WIDTH_UNIT
}

/// A recording on its way into edges.
pub(super) struct Play<'a> {
    rows: &'a [Row],
    nominal: f64,
    found: &'a Found,
    config: &'a LightConfig,
    /// Mote cycles per timestamp tick.
    scale: f64,
    /// Half turns to play, one range per stretch of light.
    stretches: Vec<(i64, i64)>,
}

impl<'a> Play<'a> {
    pub(super) fn new(rows: &'a [Row], nominal: f64, found: &'a Found, config: &'a LightConfig, clock_hz: f64) -> Self {
        let slots = |seconds: f64| (seconds * HALF_TURNS_HZ).ceil() as i64;
        let lead = slots(config.lead_s);
        let mut numbers: Vec<i64> = found.numbers.iter().map(|n| n.0).collect();
        numbers.sort_unstable();
        let mut stretches: Vec<(i64, i64)> = Vec::new();
        for number in numbers {
            match stretches.last_mut() {
                Some((_, last)) if number - *last <= slots(config.silence_s) => *last = number,
                _ => stretches.push((number, number)),
            }
        }
        for stretch in &mut stretches {
            *stretch = (stretch.0 - lead, stretch.1 + lead);
        }
        // Leads that meet leave nothing dark between them.
        let mut joined: Vec<(i64, i64)> = Vec::new();
        for (from, to) in stretches {
            match joined.last_mut() {
                Some((_, last)) if from <= *last + 1 => *last = to,
                _ => joined.push((from, to)),
            }
        }
        let scale = config.mote_hz / clock_hz;
        Self { rows, nominal, found, config, scale, stretches: joined }
    }

    /// When half turn `number` began, on the clock of the sweeps. A log's timestamps are on a clock
    /// of their own, while its sweeps are in exact parts of a half turn, so there it is exact too.
    fn start(&self, number: i64) -> f64 {
        match self.found.stamp {
            Stamp::Log => number as f64 * self.nominal,
            _ => self.found.grid.start(number),
        }
    }

    /// How long half turn `number` lasted, on the clock of the sweeps.
    fn length(&self, number: i64) -> f64 {
        self.start(number + 1) - self.start(number)
    }

    /// A timestamp on the clock of the sweeps.
    fn time(&self, timestamp: u64) -> f64 {
        match self.found.stamp {
            Stamp::Log => self.found.grid.number_at(timestamp as f64) * self.nominal,
            _ => timestamp as f64,
        }
    }

    /// Mote cycle of a time on the clock of the sweeps.
    fn cycle(&self, time: f64) -> u64 {
        let origin = self.start(self.stretches[0].0);
        let start = self.config.start_s * self.config.mote_hz;
        (start + (time - origin) * self.scale).round().max(0.0) as u64
    }

    /// Mote cycle at which `station`'s sync in half turn `number` rises.
    fn sync(&self, station: Station, number: i64) -> u64 {
        self.cycle(self.start(number) + sync_offset(station) * self.length(number))
    }

    pub(super) fn light(&self) -> Light {
        let rows = self.place_rows();
        let mut lasers: Vec<(i64, u64)> = self
            .found
            .numbers
            .iter()
            .zip(&rows)
            .filter(|(_, row)| !row.repeat)
            .filter_map(|(&(number, _), row)| Some((number, row.laser.ok()?)))
            .collect();
        lasers.sort_unstable();
        let mut lasers = lasers.into_iter().peekable();
        let mut edges = Vec::new();
        let mut pulse = |rise: u64, width: f64| {
            edges.extend([(rise, true), (rise + width.round().max(1.0) as u64, false)]);
        };
        for number in self.stretches.iter().flat_map(|&(from, to)| from..=to) {
            let length = self.length(number) * self.scale;
            for station in [Station::A, Station::B] {
                pulse(self.sync(station, number), sync_width(station, number) * length);
            }
            while let Some((_, laser)) = lasers.next_if(|laser| laser.0 == number) {
                // The mote takes the middle of a laser's pulse; an even width has one to the tick.
                let half = (0.5 * self.config.sweep_us * 1e-6 * HALF_TURNS_HZ * length).round().max(1.0);
                pulse(laser - half as u64, 2.0 * half);
            }
        }
        let findings = self.findings(&rows);
        Light { edges, rows, mote_hz: self.config.mote_hz, findings }
    }

    /// Gives each row its laser pulse; where two want one slot, the one nearer the grid has it.
    fn place_rows(&self) -> Vec<PlayedRow> {
        let off = |row: usize| match self.found.stamp {
            Stamp::Log => 0.0,
            _ => self.found.numbers[row].1.abs(),
        };
        let mut order: Vec<usize> = (0..self.rows.len()).collect();
        order.sort_by(|&a, &b| {
            let number = |row: usize| self.found.numbers[row].0;
            number(a).cmp(&number(b)).then(off(a).total_cmp(&off(b))).then(a.cmp(&b))
        });
        let mut placed: Vec<Option<PlayedRow>> = vec![None; self.rows.len()];
        let mut taken: Option<(i64, u32)> = None;
        for index in order {
            let row = &self.rows[index];
            let (number, distance) = self.found.numbers[index];
            let half_turn = self.length(number);
            let part = f64::from(row.sync_to_sweep) / half_turn;
            let holder = taken.filter(|holder| holder.0 == number);
            let same = holder.is_some_and(|holder| holder.1 == row.sync_to_sweep);
            let laser = if holder.is_some() && !same {
                Err(Unplayable::SlotTaken)
            } else if !self.fits(row.kind.station, part) {
                Err(Unplayable::AmongSyncs)
            } else {
                taken = Some((number, row.sync_to_sweep));
                let ticks = f64::from(row.sync_to_sweep) * self.scale;
                Ok(self.sync(row.kind.station, number) + ticks.round() as u64)
            };
            placed[index] = Some(PlayedRow {
                cycle: self.cycle(self.time(row.timestamp)),
                laser,
                repeat: same,
                on_grid: match self.found.stamp {
                    Stamp::Log => same || distance < 2.0,
                    _ => distance.abs() < ON_GRID,
                },
                half_turn,
            });
        }
        placed.into_iter().flatten().collect()
    }

    /// Whether a sweep at `part` of a half turn after its sync is a pulse of its own.
    fn fits(&self, station: Station, part: f64) -> bool {
        let half = 0.5 * self.config.sweep_us * 1e-6 * HALF_TURNS_HZ;
        let (rise, fall) = (sync_offset(station) + part - half, sync_offset(station) + part + half);
        rise > B_AFTER_A + LONGEST_SYNC + GUARD && fall < 1.0 - GUARD
    }

    fn findings(&self, rows: &[PlayedRow]) -> Findings {
        let grid = &self.found.grid;
        let numbers = self.found.numbers.iter().map(|n| n.0);
        let mut lengths: Vec<f64> = numbers.map(|n| grid.length(n)).collect();
        let half_turn = [0.0, 0.5, 1.0].map(|q| quantile(&mut lengths, q));
        let us = 1e6 / HALF_TURNS_HZ;
        let mut offs: Vec<f64> = rows
            .iter()
            .zip(&self.found.numbers)
            .filter(|(row, _)| row.on_grid && !row.repeat)
            .map(|(_, number)| number.1.abs() * us)
            .collect();
        let count = |what: &dyn Fn(&PlayedRow) -> bool| rows.iter().filter(|row| what(row)).count();
        let seconds = |cycles: u64| cycles as f64 / self.config.mote_hz;
        Findings {
            stamp: self.found.stamp,
            half_turn,
            residual_us: [0.5, 0.99].map(|q| quantile(&mut offs, q)),
            on_grid: count(&|row| row.on_grid),
            off_grid: count(&|row| !row.on_grid),
            repeats: count(&|row| row.repeat),
            among_syncs: count(&|row| row.laser == Err(Unplayable::AmongSyncs)),
            slot_taken: count(&|row| row.laser == Err(Unplayable::SlotTaken)),
            silences: self
                .stretches
                .windows(2)
                .map(|pair| {
                    let from = self.cycle(self.start(pair[0].1 + 1));
                    let to = self.cycle(self.start(pair[1].0));
                    (seconds(from), seconds(to.saturating_sub(from)))
                })
                .collect(),
            slots: self.stretches.iter().map(|(from, to)| (to - from + 1) as usize).sum(),
        }
    }
}
