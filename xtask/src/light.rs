//! Light as the stations must have sent it, rebuilt around recorded sweeps.
//!
//! A recording keeps, of each half turn, only how long after its station's sync the laser came by.
//! A mote needs everything else too: both syncs of every half turn, as edges, at the rate of the
//! recorded clock. All of it follows from the order of the V1 cycle, once it is known when the
//! half turns began:
//!
//! | slot | A's sync, at 0 | B's sync, at 0.05 T | sweeps |
//! |---|---|---|---|
//! | 0 | az, skip | az | B az |
//! | 1 | el, skip | el | B el |
//! | 2 | az | az, skip | A az |
//! | 3 | el | el, skip | A el |
//!
//! T is the half turn, 8.333 ms. When the slots began is found in the rows themselves: each row,
//! taken back by what it measured, is the sync of a slot whose number within the cycle is known.
//!
//! # Design
//! What `timestamp_ticks` stands for is not written down and differs between recordings, so three
//! readings are tried: the timestamp is the sync, the middle between sync and sweep, or the sweep.
//! The right one puts sweeps of different kinds on one grid. When none does, the rows are a log,
//! written some time after the sweep, and each is given the newest slot of its kind that was over.
//!
//! The grid is a line fitted every quarter second to the rows around it, each counting by how well it
//! agrees with the others. The syncs follow that smooth grid, to the nearest tick; the sweep comes
//! the recorded number of ticks after its own sync, exactly. So the recorded sweeps keep their
//! jitter and the recorded clock keeps its drift, while the syncs have no jitter of their own.
//!
//! # What can go wrong
//! A row may not fit the grid (a reflection taken for a sweep, a mislabelled pulse): it is played
//! at its nearest slot all the same, for a mote has to live with such light. A row whose sweep
//! would fall among the syncs cannot be played; it is counted. Where no row tells of light for
//! longer than `silence_s` there is none: the syncs stop and come back.

use std::fmt;

use anyhow::{Result, ensure};

use crate::recording::{Axis, Kind, Recording, Row, Station};

/// Half turns per second of a 60 Hz rotor.
const HALF_TURNS_HZ: f64 = 120.0;
/// Slots in a cycle, after which the same rotor sweeps again.
const SLOTS: i64 = 4;
/// B's sync comes this part of a half turn after A's: 20,000 of 400,000 ticks at 48 MHz.
const B_AFTER_A: f64 = 0.05;
/// Unit of the sync widths as a part of a half turn: 10.417 us of 8.333 ms.
const WIDTH_UNIT: f64 = 1.0 / 800.0;
/// The longest sync, with axis, data and skip bits all set: (6 + 1 + 2 + 4) units.
const LONGEST_SYNC: f64 = 13.0 * WIDTH_UNIT;
/// A sweep must keep this far from syncs to be a pulse of its own, as a part of a half turn.
const GUARD: f64 = 0.005;
/// How far a row may lie from the grid and still be called on it, in half turns: 83 us.
const ON_GRID: f64 = 0.01;
/// The fastest clock that SCuM-3C runs on; a faster recording is played on this one.
const SCUM_HCLK_HZ: f64 = 10_000_000.0;
/// A clock this fast is not a mote's; 20 MHz is known not to work.
const FASTEST_MOTE_HZ: f64 = 12_000_000.0;
/// Slots between two points of the fitted grid: a quarter of a second.
const KNOT: i64 = 30;
/// Slots to each side that a point of the grid is fitted to: half a second.
const REACH: i64 = 60;

/// How to play a recording.
#[derive(Clone, Debug)]
pub struct LightConfig {
    /// Rate of the mote's clock for the nominal rate of the recording's; the recorded clock's own
    /// error and drift are kept on top.
    pub mote_hz: f64,
    /// When the first edge rises, seconds of mote time after boot.
    pub start_s: f64,
    /// How long syncs come before the first sweep and after each silence, and go on after the
    /// last sweep before one, seconds.
    pub lead_s: f64,
    /// A gap between sweeps longer than this is dark, seconds.
    pub silence_s: f64,
    /// How long the laser line lights the photodiode, microseconds.
    pub sweep_us: f64,
}

impl LightConfig {
    /// The usual way to play `recording`: tick for tick, unless no mote runs as fast as that.
    pub fn of(recording: &Recording) -> Self {
        let tick_for_tick = recording.clock_hz <= FASTEST_MOTE_HZ;
        Self {
            mote_hz: if tick_for_tick { recording.clock_hz } else { SCUM_HCLK_HZ },
            start_s: 0.020,
            lead_s: 0.100,
            silence_s: 1.0,
            sweep_us: 8.0,
        }
    }
}

/// Why a row gives no laser pulse.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unplayable {
    /// Its sweep would fall among the syncs or outside its half turn.
    AmongSyncs,
    /// Another row has the same slot and says something else.
    SlotTaken,
}

/// What became of one row.
#[derive(Clone, Debug, PartialEq)]
pub struct PlayedRow {
    /// Mote cycle of the row's timestamp.
    pub cycle: u64,
    /// Mote cycle of the middle of its laser pulse.
    pub laser: Result<u64, Unplayable>,
    /// The same sweep written down once more: its pulse is an earlier row's.
    pub repeat: bool,
    /// Whether the row agrees with the grid.
    pub on_grid: bool,
    /// Half turn around this row, in the ticks of `sync_to_sweep`.
    pub half_turn: f64,
}

/// What a recording's timestamps turned out to be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stamp {
    /// The rise of the station's own sync.
    Sync,
    /// Midway between the sync and the sweep.
    Middle,
    /// The sweep.
    Sweep,
    /// When the row was written down, some time after the sweep.
    Log,
}

/// What was found out about the recording on the way.
#[derive(Clone, Debug)]
pub struct Findings {
    /// What the timestamps are.
    pub stamp: Stamp,
    /// Half turn in timestamp ticks: least, median and greatest over the recording.
    pub half_turn: [f64; 3],
    /// Distance of the rows that fit from the grid, microseconds: median and 99th percentile. In a
    /// log, how long after its sweep a row was written.
    pub residual_us: [f64; 2],
    /// Rows that fit the grid.
    pub on_grid: usize,
    /// Rows that do not; played at the nearest slot all the same.
    pub off_grid: usize,
    /// Rows that repeat an earlier one.
    pub repeats: usize,
    /// Rows whose sweep would fall among the syncs.
    pub among_syncs: usize,
    /// Rows whose slot another row has.
    pub slot_taken: usize,
    /// Dark gaps: mote time at which they begin and how long they last, seconds.
    pub silences: Vec<(f64, f64)>,
    /// Half turns that were played.
    pub slots: usize,
}

/// Edges to play into a mote, and where each row went.
#[derive(Clone, Debug)]
pub struct Light {
    /// Edges in mote cycles after boot, strictly later one by one; rise and fall take turns and
    /// the first one rises.
    pub edges: Vec<(u64, bool)>,
    /// One for each row of the recording, in its order.
    pub rows: Vec<PlayedRow>,
    /// Nominal rate of the mote's clock.
    pub mote_hz: f64,
    /// What was found out.
    pub findings: Findings,
}

impl Light {
    /// Rebuilds the light around the rows of one photodiode.
    pub fn rebuild(recording: &Recording, config: &LightConfig) -> Result<Self> {
        let rows = &recording.rows;
        let place = recording.dir.display();
        ensure!(
            rows.iter().all(|row| row.sensor == rows[0].sensor),
            "{place}: a mote has one photodiode; choose one of the {} before rebuilding its light",
            recording.photodiodes
        );
        let nominal = recording.clock_hz / HALF_TURNS_HZ;
        let found = Found::search(rows, nominal)
            .ok_or_else(|| anyhow::anyhow!("{place}: the {} rows do not show when the half turns began", rows.len()))?;
        Ok(Play::new(rows, nominal, &found, config, recording.clock_hz).light())
    }

    /// Nominal mote time of a cycle, seconds after boot.
    pub fn seconds(&self, cycle: u64) -> f64 {
        cycle as f64 / self.mote_hz
    }

    /// When the window of `recording` on which stations were fitted begins and ends, seconds of
    /// nominal mote time; none when no row lies in it.
    pub fn calibrated(&self, recording: &Recording) -> Option<[f64; 2]> {
        let within = |row: &Row| recording.calibrate.contains(&row.timestamp);
        let first = recording.rows.iter().position(within)?;
        let last = recording.rows.iter().rposition(within)?;
        Some([first, last].map(|row| self.seconds(self.rows[row].cycle)))
    }
}

impl fmt::Display for Findings {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let stamp = match self.stamp {
            Stamp::Sync => "the sync",
            Stamp::Middle => "midway between sync and sweep",
            Stamp::Sweep => "the sweep",
            Stamp::Log => "when the row was written down",
        };
        let [least, median, greatest] = self.half_turn;
        let dark: f64 = self.silences.iter().map(|(_, length)| length).sum();
        writeln!(f, "timestamps are {stamp}")?;
        writeln!(f, "half turn {median:.1} ticks ({least:.1} to {greatest:.1}), {} played", self.slots)?;
        writeln!(
            f,
            "rows on the grid {}, off it {}; distance median {:.1} us, p99 {:.1} us",
            self.on_grid, self.off_grid, self.residual_us[0], self.residual_us[1]
        )?;
        writeln!(
            f,
            "rows that repeat another {}; not playable: {} among the syncs, {} with their slot taken",
            self.repeats, self.among_syncs, self.slot_taken
        )?;
        write!(f, "dark gaps {}, {dark:.1} s in all", self.silences.len())
    }
}

/// The slot of the cycle in which `kind` sweeps.
fn slot_of(kind: Kind) -> i64 {
    let first = match kind.station {
        Station::B => 0,
        Station::A => 2,
    };
    first + i64::from(kind.axis == Axis::El)
}

/// Part of a half turn from the start of a slot to the sync of the station.
fn sync_offset(station: Station) -> f64 {
    match station {
        Station::A => 0.0,
        Station::B => B_AFTER_A,
    }
}

/// Width of a station's sync in a slot, as a part of a half turn; data bits are all zero.
fn sync_width(station: Station, slot: i64) -> f64 {
    let slot = slot.rem_euclid(SLOTS);
    let axis = slot % 2;
    let a_sweeps = slot >= 2;
    let skip = (station == Station::A) != a_sweeps;
    (6 + axis + 4 * i64::from(skip)) as f64 * WIDTH_UNIT
}

fn median(values: &mut [f64]) -> f64 {
    quantile(values, 0.5)
}

/// The value below which the part `q` of `values` lies, between neighbours in proportion.
pub fn quantile(values: &mut [f64], q: f64) -> f64 {
    if values.is_empty() {
        return f64::NAN;
    }
    values.sort_by(f64::total_cmp);
    let place = q * (values.len() - 1) as f64;
    let below = place.floor() as usize;
    let above = (below + 1).min(values.len() - 1);
    values[below] + (values[above] - values[below]) * (place - below as f64)
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
struct Grid {
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
            let reach = (4.685 * 1.4826 * median(&mut sizes)).max(2.0);
            for (point, weight) in points.iter().zip(&mut weights) {
                let part = (off(point) / reach).powi(2);
                *weight = if part < 1.0 { (1.0 - part).powi(2) } else { 0.0 };
            }
        }
        base + level + (at - near[0].0) as f64 * half_turn
    }

    /// When half turn `number` began; beyond the ends the nearest slope goes on.
    fn start(&self, number: i64) -> f64 {
        let (knot, part) = self.place(number);
        let next = self.knots.get(knot + 1).copied();
        let next = next.unwrap_or(self.knots[knot] + KNOT as f64 * self.half_turn);
        self.knots[knot] + part * (next - self.knots[knot])
    }

    /// How long half turn `number` lasted.
    fn length(&self, number: i64) -> f64 {
        self.start(number + 1) - self.start(number)
    }

    fn place(&self, number: i64) -> (usize, f64) {
        let last = self.knots.len().saturating_sub(2) as i64;
        let knot = (number - self.first).div_euclid(KNOT).clamp(0, last);
        (knot as usize, (number - self.first - knot * KNOT) as f64 / KNOT as f64)
    }

    /// How many half turns after the first one `time` is, in parts of one.
    fn number_at(&self, time: f64) -> f64 {
        let last = self.knots.len().saturating_sub(2);
        let knot = self.knots.partition_point(|&k| k <= time).saturating_sub(1).min(last);
        let start = self.first + knot as i64 * KNOT;
        start as f64 + (time - self.start(start)) / self.length(start)
    }
}

/// The meaning of the timestamps and the grid that follows from it.
struct Found {
    stamp: Stamp,
    grid: Grid,
    /// Per row: the half turn it belongs to and how far off the grid it is, in half turns.
    numbers: Vec<(i64, f64)>,
}

impl Found {
    fn search(rows: &[Row], nominal: f64) -> Option<Self> {
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
                let at = grid.number_at(sight.time);
                let cycles = (at - sight.slot as f64) / SLOTS as f64;
                let number = sight.slot + SLOTS * cycles.round() as i64;
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
                let at = grid.number_at(sight.time);
                let cycles = (at - sight.slot as f64) / SLOTS as f64;
                let near = sight.slot + SLOTS * cycles.round() as i64;
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
    (lengths.len() >= 8).then(|| median(&mut lengths))
}

/// A recording on its way into edges.
struct Play<'a> {
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
    fn new(rows: &'a [Row], nominal: f64, found: &'a Found, config: &'a LightConfig, clock_hz: f64) -> Self {
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

    fn light(&self) -> Light {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::tests::shared_recording;

    /// A sweep read back from edges: when it rose, what kind it is, ticks since its own sync.
    #[derive(Debug, PartialEq)]
    struct Decoded {
        laser: u64,
        kind: Kind,
        ticks: u64,
    }

    /// A small decoder that knows the cycle: the widths say the slot, the laser comes after.
    fn decode(edges: &[(u64, bool)], half_turn: f64) -> Vec<Decoded> {
        let pulses: Vec<(u64, u64)> = edges
            .chunks(2)
            .map(|pair| {
                assert_eq!((pair[0].1, pair[1].1), (true, false));
                (pair[0].0, pair[1].0 - pair[0].0)
            })
            .collect();
        let mut out = Vec::new();
        let (mut syncs, mut bits): ([u64; 2], [i64; 2]) = ([0; 2], [0; 2]);
        let mut last = u64::MAX;
        for (rise, width) in pulses {
            let code = (width as f64 / half_turn * 800.0).round() as i64 - 6;
            if code >= 0 {
                let second = rise.wrapping_sub(last) < (0.1 * half_turn) as u64;
                syncs[usize::from(second)] = rise;
                bits[usize::from(second)] = code;
                last = rise;
            } else {
                assert_eq!(bits[0] & 1, bits[1] & 1, "both stations sweep the same axis");
                assert_eq!((bits[0] ^ bits[1]) & 4, 4, "one of the two skips");
                let station = if bits[0] & 4 == 0 { Station::A } else { Station::B };
                let axis = if bits[0] & 1 == 0 { Axis::Az } else { Axis::El };
                let laser = rise + width / 2;
                let ticks = laser - syncs[station as usize];
                out.push(Decoded { laser, kind: Kind { station, axis }, ticks });
            }
        }
        out
    }

    fn assert_alternates(light: &Light) {
        assert!(light.edges[0].1);
        for pair in light.edges.windows(2) {
            assert!(pair[0].0 < pair[1].0, "{pair:?}");
            assert_ne!(pair[0].1, pair[1].1);
        }
        assert!(!light.edges.last().unwrap().1);
    }

    /// Every row that has a pulse is read back as the same kind with the same ticks.
    fn assert_decodes_back(recording: &Recording, light: &Light, slack: f64) {
        let half_turn = light.mote_hz / HALF_TURNS_HZ;
        let decoded = decode(&light.edges, half_turn);
        let scale = light.mote_hz / recording.clock_hz;
        let mut played = 0;
        for (row, place) in recording.rows.iter().zip(&light.rows) {
            let Ok(laser) = place.laser else { continue };
            let at = decoded.binary_search_by_key(&laser, |d| d.laser).expect("a pulse per row");
            assert_eq!(decoded[at].kind, row.kind, "line {}", row.line);
            let ticks = f64::from(row.sync_to_sweep) * scale;
            assert!((decoded[at].ticks as f64 - ticks).abs() <= slack, "line {}", row.line);
            played += usize::from(!place.repeat);
        }
        assert_eq!(played, decoded.len());
    }

    /// A recording made here: a clock 3 % fast that drifts, a sweep in most slots.
    fn made(part: f64, clock_hz: f64) -> Recording {
        let kinds = [(Station::B, Axis::Az), (Station::B, Axis::El), (Station::A, Axis::Az), (Station::A, Axis::El)];
        let mut start = 5e9;
        let mut rows = Vec::new();
        for number in 0..2400u32 {
            let half_turn = clock_hz / 120.0 * (1.03 + 2e-4 * (f64::from(number) / 700.0).sin());
            let (station, axis) = kinds[number as usize % 4];
            let kind = Kind { station, axis };
            let angle = 0.5 + 0.2 * (f64::from(number) / 90.0 + kind.index() as f64).sin();
            let ticks = (angle * half_turn).round();
            let sync = start + sync_offset(station) * half_turn;
            let dark = (600..900).contains(&number);
            if number % 7 != 3 && !dark {
                rows.push(Row {
                    line: number as usize + 2,
                    timestamp: (sync + part * ticks).round() as u64,
                    sensor: 0,
                    kind,
                    sync_to_sweep: ticks as u32,
                    truth: [0.0; 3],
                    truth_ok: true,
                });
            }
            start += half_turn;
        }
        Recording {
            dir: "made".into(),
            clock_hz,
            photodiodes: 1,
            stations: "made/stations.toml".into(),
            calibrate: 0..0,
            rows,
        }
    }

    #[test]
    fn the_meaning_of_a_timestamp_is_found_in_the_light() {
        for (part, stamp) in [(0.0, Stamp::Sync), (0.5, Stamp::Middle), (1.0, Stamp::Sweep)] {
            let recording = made(part, 10e6);
            let light = Light::rebuild(&recording, &LightConfig::of(&recording)).unwrap();
            assert_eq!(light.findings.stamp, stamp);
            assert_eq!(light.findings.off_grid, 0, "{}", light.findings);
            assert!(light.findings.residual_us[1] < 5.0, "{}", light.findings);
            assert_alternates(&light);
            assert_decodes_back(&recording, &light, 0.0);
        }
    }

    #[test]
    fn the_first_edge_comes_after_boot_and_long_gaps_are_dark() {
        let recording = made(0.5, 10e6);
        let config = LightConfig { start_s: 0.5, ..LightConfig::of(&recording) };
        let light = Light::rebuild(&recording, &config).unwrap();
        assert_eq!(light.edges[0].0, 5_000_000);
        let [(from, length)] = light.findings.silences[..] else { panic!("{}", light.findings) };
        assert!((2.2..2.5).contains(&length), "300 slots less the lead on both sides: {length}");
        let lit = |&(cycle, _): &(u64, bool)| (from + 1e-3..from + length - 1e-3).contains(&light.seconds(cycle));
        assert!(!light.edges.iter().any(lit));
        let always = LightConfig { silence_s: 5.0, ..config };
        assert!(Light::rebuild(&recording, &always).unwrap().findings.silences.is_empty());
    }

    #[test]
    fn both_syncs_come_in_every_half_turn() {
        let recording = made(0.5, 10e6);
        let light = Light::rebuild(&recording, &LightConfig::of(&recording)).unwrap();
        let half_turn = light.mote_hz / HALF_TURNS_HZ;
        let syncs = light.edges.chunks(2).filter(|p| (p[1].0 - p[0].0) as f64 > 0.005 * half_turn);
        assert_eq!(syncs.count(), 2 * light.findings.slots);
    }

    #[test]
    fn a_sweep_among_the_syncs_is_counted_and_not_played() {
        let mut recording = made(0.5, 10e6);
        let row = &mut recording.rows[500];
        row.sync_to_sweep = 85_833;
        let light = Light::rebuild(&recording, &LightConfig::of(&recording)).unwrap();
        assert_eq!(light.findings.among_syncs, 1);
        assert_eq!(light.rows[500].laser, Err(Unplayable::AmongSyncs));
        assert_alternates(&light);
    }

    #[test]
    fn rows_of_several_photodiodes_are_refused() {
        let mut recording = made(0.5, 10e6);
        recording.rows[7].sensor = 1;
        let error = Light::rebuild(&recording, &LightConfig::of(&recording)).unwrap_err();
        assert!(error.to_string().contains("one photodiode"), "{error}");
    }

    #[test]
    fn rows_that_show_no_rhythm_are_refused() {
        let mut recording = made(0.5, 10e6);
        recording.rows.truncate(3);
        let error = Light::rebuild(&recording, &LightConfig::of(&recording)).unwrap_err();
        assert!(error.to_string().contains("3 rows"), "{error}");
    }

    #[test]
    fn the_paper_s_recording_is_on_one_grid_and_decodes_back_to_its_ticks() {
        let Some(recording) = shared_recording("scum-take5") else {
            return;
        };
        let light = Light::rebuild(&recording, &LightConfig::of(&recording)).unwrap();
        println!("{}", light.findings);
        assert_eq!(light.findings.stamp, Stamp::Middle);
        assert!((light.findings.half_turn[1] - 90_207.0).abs() < 10.0);
        assert!(light.findings.off_grid < 30);
        let [from, to] = light.calibrated(&recording).unwrap();
        assert!((to - from - 30.0).abs() < 1.0, "{from} s to {to} s");
        assert_alternates(&light);
        assert_decodes_back(&recording, &light, 0.0);
    }

    #[test]
    fn the_flight_s_log_is_laid_out_as_sweeps() {
        let Some(recording) = shared_recording("crazyflie-lh1-flight") else {
            return;
        };
        let recording = recording.sensor(0).unwrap();
        let light = Light::rebuild(&recording, &LightConfig::of(&recording)).unwrap();
        println!("{}", light.findings);
        assert_eq!(light.findings.stamp, Stamp::Log);
        // An elevation is written down at once, so its delay tells whether its slot is the right one.
        let mut delays: Vec<f64> = recording
            .rows
            .iter()
            .zip(&light.rows)
            .filter(|(row, place)| row.kind.axis == Axis::El && !place.repeat)
            .map(|(_, place)| light.seconds(place.cycle) - light.seconds(place.laser.unwrap()))
            .collect();
        let [early, late] = [0.005, 0.995].map(|q| quantile(&mut delays, q));
        assert!(early > -0.5e-3 && late < 2e-3, "{early} s to {late} s");
        assert_alternates(&light);
        assert_decodes_back(&recording, &light, 0.5);
    }
}
