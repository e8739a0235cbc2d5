//! The cycle, once found: from flash to flash by dead reckoning.
//!
//! What can go wrong: a flash is missing (its place is predicted), a pulse fits no window (it is no light of ours), the
//! skip pattern contradicts the place in the cycle (after a few times in a row, the pattern is right).

use super::width::{Units, WIDTH_BASE_STEPS};
use super::{Axis, Config, HalfTurn, Light, Stamp, Station, Sweep, Sync};
use crate::pulse::Pulse;
use crate::time::{Span, Ticks};

/// The half turn estimate moves by 1/2^2 of what each whole cycle says.
const HALF_TURN_GAIN_SHIFT: u32 = 2;
/// Single cycles that the half turn is first learnt from: a tenth of the first error is left by then.
const TRAINING: u8 = 8;
/// Slots in a cycle.
const SLOTS: u8 = 4;
/// A flash pattern that contradicts the place in the cycle this often in a row means the place is wrong.
const CONTRADICTIONS: u8 = 3;

/// A flash as it was seen in the current slot.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Flash {
    start: Ticks,
    width: Span,
}

/// The cycle, followed by dead reckoning from flash to flash.
#[derive(Debug, Clone)]
pub(super) struct Lock {
    pub(super) half_turn: HalfTurn,
    units: Units,
    /// From A's flash to B's.
    gap: u32,
    /// A's flash of the current slot, seen or predicted.
    slot_start: Ticks,
    /// 0 ..= 3, once the skip pattern has been seen to turn over.
    slot: Option<u8>,
    flashes: [Option<Flash>; 2],
    swept: bool,
    /// A slot has ended without a sweep since this was last asked.
    dark: bool,
    dark_slots: u16,
    contradictions: u8,
    /// Whether A skipped in the last slot where both flashes were seen, and whether that was the slot before.
    last_skip: Option<(bool, u8)>,
    /// A's last seen flash of a cycle's measuring slot, and how many slots ago that was.
    measured: Option<(Ticks, u8)>,
    /// How often the half turn has been learnt, saturating.
    measures: u8,
}

impl Lock {
    pub(super) fn new(a: &Pulse, b: &Pulse, half_turn: HalfTurn) -> Self {
        let mut lock = Self {
            half_turn,
            units: Units::of(half_turn),
            gap: b.start.since(a.start).0,
            slot_start: a.start,
            slot: None,
            flashes: [Some(Flash { start: a.start, width: a.width }), Some(Flash { start: b.start, width: b.width })],
            swept: false,
            dark: false,
            dark_slots: 0,
            contradictions: 0,
            last_skip: None,
            measured: Some((a.start, 0)),
            measures: 0,
        };
        lock.read_pattern();
        lock
    }

    /// Moves on to the slot that `now` lies in; false when the light has been gone too long.
    pub(super) fn follow(&mut self, config: &Config, now: Ticks) -> bool {
        let window = self.units.half_turn.0 >> config.window_shift;
        let slot_end = self.units.half_turn.0 - window;
        loop {
            let into = now.offset_from(self.slot_start);
            // A pulse may start a little before the slot it belongs to; far before means the counter went half round.
            if into < slot_end as i32 {
                return into >= -(2 * window as i32);
            }
            self.dark_slots = if self.flashes == [None, None] { self.dark_slots + 1 } else { 0 };
            if self.dark_slots > config.coast_half_turns {
                return false;
            }
            self.slot_start = self.slot_start.after(self.units.half_turn);
            self.slot = self.slot.map(|slot| (slot + 1) % SLOTS);
            self.flashes = [None, None];
            self.dark = !self.swept;
            self.swept = false;
            self.last_skip = self.last_skip.map(|(skip, age)| (skip, age.saturating_add(1)));
            self.measured = self.measured.map(|(at, age)| (at, age.saturating_add(1)));
        }
    }

    /// Whether a slot has ended without a sweep since the last time.
    pub(super) fn take_dark(&mut self) -> bool {
        core::mem::take(&mut self.dark)
    }

    pub(super) fn place(&mut self, config: &Config, pulse: Pulse) -> Option<Light> {
        let window = self.units.half_turn.0 >> config.window_shift;
        let into = pulse.start.offset_from(self.slot_start);
        if into.unsigned_abs() <= window {
            return self.flash(Station::A, pulse);
        }
        if into.abs_diff(self.gap as i32) <= window {
            return self.flash(Station::B, pulse);
        }
        self.sweep(config, pulse)
    }

    fn flash(&mut self, station: Station, pulse: Pulse) -> Option<Light> {
        if !self.units.is_sync(pulse.width) || self.flashes[station as usize].is_some() {
            return None;
        }
        self.flashes[station as usize] = Some(Flash { start: pulse.start, width: pulse.width });
        match station {
            Station::A => {
                self.slot_start = pulse.start;
                self.measure(pulse.start);
            }
            Station::B => match self.flashes[Station::A as usize] {
                Some(a) => {
                    let gap = pulse.start.since(a.start).0;
                    self.gap = self.gap.wrapping_add_signed((gap.wrapping_sub(self.gap) as i32) / 8);
                    self.read_pattern();
                }
                None => self.slot_start = pulse.start.before(Span(self.gap)),
            },
        }
        let (sweeping, axis) = self.turn()?;
        let skip = station != sweeping;
        let bare = self.units.width_step * (WIDTH_BASE_STEPS + axis as u32 + 4 * u32::from(skip));
        let data = pulse.width.0 > bare + self.units.width_step;
        Some(Light::Sync(Sync { station, axis, skip, data }))
    }

    /// Whose turn it is, and about which axis.
    fn turn(&self) -> Option<(Station, Axis)> {
        Some(match self.slot? {
            0 => (Station::B, Axis::Azimuth),
            1 => (Station::B, Axis::Elevation),
            2 => (Station::A, Axis::Azimuth),
            _ => (Station::A, Axis::Elevation),
        })
    }

    /// Learns the half turn from two flashes of A that are whole cycles apart: one at first, four later, when a longer
    /// base costs less and says more.
    fn measure(&mut self, at: Ticks) {
        let (cycles_log2, gain_shift) = if self.measures < TRAINING { (0, HALF_TURN_GAIN_SHIFT) } else { (2, 1) };
        let base = SLOTS << cycles_log2;
        match self.measured {
            Some((_, age)) if age < base => return,
            Some((earlier, age)) if age == base => {
                // Four half turns in ticks are one half turn in Q2.
                let seen_q8 = at.since(earlier).0 << (6 - cycles_log2);
                let step = (seen_q8.wrapping_sub(self.half_turn.ticks_q8()) as i32) >> gain_shift;
                let ticks_q8 = self.half_turn.ticks_q8().wrapping_add_signed(step);
                if let Some(half_turn) = HalfTurn::from_ticks_q8(ticks_q8) {
                    self.half_turn = half_turn;
                    self.units = Units::of(half_turn);
                }
                self.measures = self.measures.saturating_add(1);
            }
            _ => {}
        }
        self.measured = Some((at, 0));
    }

    /// Holds the two flashes of this slot against each other: which of them skips?
    fn read_pattern(&mut self) {
        let [Some(a), Some(b)] = self.flashes else { return };
        let step = self.units.width_step;
        let a_skips = if a.width.0 > b.width.0 + step {
            true
        } else if b.width.0 > a.width.0 + step {
            false
        } else {
            return;
        };
        match self.slot {
            Some(slot) if (slot < 2) == a_skips => self.contradictions = 0,
            Some(_) => {
                self.contradictions += 1;
                if self.contradictions >= CONTRADICTIONS {
                    self.contradictions = 0;
                    self.slot = None;
                }
            }
            None => {
                // The turn-over from one station to the other opens slots 0 and 2.
                if let Some((before, 1)) = self.last_skip
                    && before != a_skips
                {
                    self.slot = Some(if a_skips { 0 } else { 2 });
                }
            }
        }
        self.last_skip = Some((a_skips, 0));
    }

    fn sweep(&mut self, config: &Config, pulse: Pulse) -> Option<Light> {
        let (station, axis) = self.turn()?;
        let shortest = (self.units.half_turn.0 * config.shortest_sweep) >> 13;
        if self.swept || pulse.width.0 > self.units.sweep_width_max || pulse.width.0 < shortest {
            return None;
        }
        let sync = match (station, self.flashes[station as usize]) {
            (_, Some(flash)) => flash.start,
            (Station::A, None) => self.slot_start,
            (Station::B, None) => self.slot_start.after(Span(self.gap)),
        };
        let at = match config.stamp {
            Stamp::Middle => pulse.start.after(Span(pulse.width.0 / 2)),
            Stamp::Rise => pulse.start,
        };
        let since_sync = at.since(sync);
        // The rotor lights 30 to 150 degrees. Two degrees more to either side leave room for its factory phase: the
        // angle stage knows that and draws the exact line.
        let half_turn = self.units.half_turn.0;
        if since_sync.0 < (half_turn >> 5) * 5 || since_sync.0 > (half_turn >> 5) * 27 {
            return None;
        }
        self.swept = true;
        Some(Light::Sweep(Sweep { station, axis, at, since_sync, half_turn: self.half_turn }))
    }
}
