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
//! `grid` finds what the timestamps stand for and when every half turn began; `play` lays edges on that grid.
//!
//! # What can go wrong
//! A row may not fit the grid (a reflection taken for a sweep, a mislabelled pulse): it is played
//! at its nearest slot all the same, for a mote has to live with such light. A row whose sweep
//! would fall among the syncs cannot be played; it is counted. Where no row tells of light for
//! longer than `silence_s` there is none: the syncs stop and come back.

mod grid;
mod play;

use std::fmt;

use anyhow::{Result, ensure};

use crate::recording::{Recording, Row, Station};
use grid::Found;
use play::Play;

/// Half turns per second of a 60 Hz rotor.
pub const HALF_TURNS_HZ: f64 = 120.0;
/// Half a turn, seconds.
pub const HALF_TURN_S: f64 = 1.0 / HALF_TURNS_HZ;
/// Slots in a cycle, after which the same rotor sweeps again.
const SLOTS: i64 = 4;
/// B's sync comes this part of a half turn after A's: 20,000 of 400,000 ticks at 48 MHz.
const B_AFTER_A: f64 = 0.05;
/// How far a row may lie from the grid and still be called on it, in half turns: 83 us.
const ON_GRID: f64 = 0.01;
/// The fastest clock that SCuM-3C runs on; a faster recording is played on this one.
const SCUM_HCLK_HZ: f64 = 10_000_000.0;
/// A clock this fast is not a mote's; 20 MHz is known not to work.
const FASTEST_MOTE_HZ: f64 = 12_000_000.0;

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

/// Part of a half turn from the start of a slot to the sync of the station.
fn sync_offset(station: Station) -> f64 {
    match station {
        Station::A => 0.0,
        Station::B => B_AFTER_A,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::quantile::quantile;
    use crate::recording::tests::shared_recording;
    use crate::recording::{Axis, Kind};

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
