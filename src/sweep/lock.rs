//! The cycle, once found: from flash to flash by dead reckoning.
//!
//! Each rotor flashes once per turn, and its flashes wander little against each other, so each has its own prediction:
//! where the rotor's next flash begins. Rise and fall of a flash are both held against it, and the nearer one moves it:
//! a receiver that sees the light come on late still sees it go off in time. One flash moves it by at most half a
//! microsecond, two in a row that agree as far as they say.
//!
//! The fall also tells the data bit: place and skip are known from the cycle, the receiver's bias from the flashes
//! before.
//!
//! What can go wrong: a flash is missing (its place is predicted), a pulse fits no window (it is no light of ours), the
//! flashes contradict the place in the cycle (after a few, the place is forgotten and found again).

use super::search::Found;
use super::width::{Units, WIDTH_BASE_STEPS};
use super::{Axis, Closed, Config, Counts, HalfTurn, Light, Stamp, Station, Sweep, Sync};
use crate::pulse::Pulse;
use crate::time::{Span, Ticks};

/// log2 of the half turns between two measurements of the half turn: from 1 up to this, one more each time. A longer
/// base costs less and says more.
const BASE_LOG2: u32 = 4;
/// The most that one flash moves its prediction: half turn >> this, 0.5 us, 0.011 degrees.
const SLEW_SHIFT: u32 = 14;
/// How far a flash may be from its prediction: half turn >> this, 4 us; more where the prediction is old.
const TOLERANCE_SHIFT: u32 = 11;
/// The same for a lock that is new: 32 us.
const FRESH_SHIFT: u32 = 8;
/// Slots without any flash that the prediction is as good as new for.
const SURE_SLOTS: u32 = 4;
/// What a flash that cannot be adds to the doubt about the place in the cycle; one that can be takes 1 off.
const CONTRADICTION: u32 = 3;
/// At this much doubt the place is forgotten: no single pulse, nor any four, get there.
const DOUBT: u32 = 16;
/// Slots with both flashes, one after the other, whose skips must make sense before the place is believed.
const PATTERN: u32 = 4;
/// Slots with one flash each and without any skip, until the station is believed to be the only one. Data bits that
/// look like that in a pair of stations must repeat 0011 all the while.
const SINGLE: u32 = 12;
/// Slots that two flash trains may take to make sense.
const PATIENCE: u32 = 64;
/// The bias is learnt from one flash per cycle, 1/2^3 of it each time.
const BIAS_SHIFT: u32 = 3;
/// A sweep this near to where its rotor's last one was need not be compared: half turn >> this, 2.8 degrees.
const NEAR_SHIFT: u32 = 6;

/// How much is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) enum Phase {
    /// Nothing.
    #[default]
    Dark,
    /// Two flash trains, not yet which slot is which.
    Pair,
    /// One flash train.
    Train,
    /// One flash train that skips: one of a pair of stations, not known which. [`Lock::slot`] is as if it were A.
    Nameless,
    /// All.
    Locked,
}

/// What the slot that ended last has left to be asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum Rest {
    #[default]
    Nothing,
    Dark,
    Sweep,
}

/// The cycle, followed by dead reckoning from flash to flash.
#[derive(Debug, Clone, Default)]
#[repr(C)]
pub(super) struct Lock {
    // In the order of need: a Cortex-M0 reaches the first 31 words cheaply.
    pub(super) phase: Phase,
    /// 0 ..= 3; before the place is known, only its lowest bit means something.
    slot: u32,
    /// Where the flashes of the slots of either parity begin, `[slot & 1][station]`.
    next: [[Ticks; 2]; 2],
    units: Units,
    pub(super) half_turn: HalfTurn,
    /// How far a flash may be from its prediction.
    tolerance: u32,
    /// Stations that flashed in this slot, a bit each.
    seen: u32,
    /// By how much the last flash has moved its prediction.
    moved: i32,
    /// How far the last flash of each station was off.
    off: [i32; 2],
    /// By how much more each station's last flash was lengthened than usual, and how much that changes.
    spread: [i32; 2],
    noise: [u32; 2],
    /// By how much the receiver lengthens each station's flashes, Q3.
    pub(super) bias_q3: [i32; 2],
    doubt: u32,
    rest: Rest,
    /// The width of the sweep that this slot gave; 0 for none yet.
    chosen: u32,
    /// The width of the best sweep that waits for the end of the slot; 0 for none.
    held: u32,
    held_after: u32,
    held_at: Ticks,
    /// Where each slot's sweep was in the last cycle, after its flash; 0 where that is not known.
    after: [u32; 4],
    width: [u32; 4],
    /// Slots, a bit each, that had no sweep in the last cycle.
    missed: u32,
    pub(super) dark_slots: u32,
    measured: Ticks,
    /// Half turns since then.
    measured_age: u32,
    measured_of: usize,
    /// How often the half turn has been learnt.
    measures: u32,
    /// 2 where only A exists, which then sweeps in every slot; 0 otherwise.
    first_slot: u32,
    /// The sweep that was chosen when its slot ended.
    late: Option<Sweep>,
    // What the pattern is read from.
    slots: u32,
    /// The newest skips, one bit per slot, and how many of them there are in a row.
    skips: u32,
    run: u32,
    ever_skipped: bool,
    widths: [u32; 2],
    narrowest: [u32; 2],
    widest: [u32; 2],
}

impl Lock {
    /// Begins anew with what the search has found; the receiver is still the same.
    pub(super) fn start(&mut self, found: &Found) {
        let half_turn = found.half_turn;
        let [a, b] = found.newer;
        let first = [a.start, b.start];
        let units = Units::of(half_turn.ticks_q8());
        *self = Self {
            phase: if found.is_lone { Phase::Train } else { Phase::Pair },
            next: [first, first.map(|start| start.after(Span(units.half_turn)))],
            units,
            half_turn,
            seen: if found.is_lone { 1 } else { 3 },
            bias_q3: self.bias_q3,
            measured: if found.is_lone { a.start } else { b.start },
            measured_of: usize::from(!found.is_lone),
            ..Self::default()
        };
        self.tolerance = units.half_turn >> FRESH_SHIFT;
        let widths = |pulses: [Pulse; 2]| pulses.map(|pulse| pulse.width.0);
        if found.is_lone {
            self.widths = [a.width.0, found.older[0].width.0];
            self.narrowest = self.widths;
            self.widest = self.widths;
        } else {
            self.compare(widths(found.older));
            self.compare(widths(found.newer));
        }
    }

    /// Whether a better cycle is to be looked for among the pulses that this one has no use for.
    pub(super) fn is_doubtful(&self) -> bool {
        match self.phase {
            Phase::Dark => true,
            Phase::Train | Phase::Nameless => true,
            Phase::Pair | Phase::Locked => self.dark_slots > SURE_SLOTS,
        }
    }

    /// Forgets the cycle; what is known of the receiver stays.
    pub(super) fn end(&mut self) {
        self.phase = Phase::Dark;
        self.rest = Rest::Nothing;
    }

    pub(super) fn width_bias(&self, station: Station) -> Option<i16> {
        let bias = self.bias_q3[station as usize] >> BIAS_SHIFT;
        let share = i16::try_from(self.half_turn.share(Span(bias.unsigned_abs()))).unwrap_or(i16::MAX);
        (self.units.step != 0).then_some(if bias < 0 { -share } else { share })
    }

    /// Moves on to the slot that `now` lies in; false when the light has been gone too long.
    #[inline]
    pub(super) fn follow(&mut self, config: &Config, now: Ticks) -> bool {
        let window = self.units.half_turn >> config.window_shift;
        let slot_end = self.units.half_turn - window;
        loop {
            let into = now.offset_from(self.next[(self.slot & 1) as usize][Station::A as usize]);
            // A pulse may start a little before the slot it belongs to; far before means the counter went half round.
            if into < slot_end as i32 {
                return into >= -(2 * window as i32);
            }
            if !self.advance(config) {
                return false;
            }
        }
    }

    /// Ends the slot; false when the light has been gone too long.
    #[inline(never)]
    fn advance(&mut self, config: &Config) -> bool {
        if self.phase == Phase::Locked {
            self.close_sweeps();
        }
        let parity = (self.slot & 1) as usize;
        if self.seen == 0 {
            self.dark_slots += 1;
            if self.dark_slots > u32::from(config.coast_half_turns) {
                return false;
            }
            if self.dark_slots > SURE_SLOTS {
                let wider = self.tolerance + (self.units.half_turn >> SLEW_SHIFT) * 2;
                self.tolerance = wider.min(self.units.half_turn >> config.window_shift);
            }
            self.run = 0;
        } else {
            self.dark_slots = 0;
            let base = self.units.half_turn >> TOLERANCE_SHIFT;
            if self.tolerance > base {
                self.tolerance = (self.tolerance - self.tolerance / 4).max(base);
            }
            if self.seen != 3 {
                // The hidden station moves with the other.
                let hidden = &mut self.next[parity][(self.seen & 1) as usize];
                *hidden = Ticks(hidden.0.wrapping_add_signed(self.moved));
                if self.phase == Phase::Pair {
                    self.run = 0;
                }
            }
            self.measure(parity);
        }
        self.measured_age += 1;
        if self.phase == Phase::Pair {
            self.slots += 1;
            if self.slots > PATIENCE {
                return false;
            }
        }
        for next in &mut self.next[parity] {
            *next = next.after(Span(self.units.turn));
        }
        self.slot = (self.slot + 1) & 3 | self.first_slot;
        self.seen = 0;
        true
    }

    /// Learns the half turn from two flashes of one station that are whole cycles apart.
    fn measure(&mut self, parity: usize) {
        let base_log2 = (self.measures + 1).min(BASE_LOG2);
        let base = 1 << base_log2;
        if self.measured_age < base {
            return;
        }
        // The one that is seen, or the clearly sharper one.
        let other = 1 - self.measured_of;
        let is_only = self.seen >> self.measured_of & 1 == 0;
        let is_sharper = self.seen == 3 && self.noise[other] < self.noise[self.measured_of] / 2;
        let of = if is_only || is_sharper { other } else { self.measured_of };
        let at = self.next[parity][of];
        if self.measured_age == base && self.measured_of == of {
            let length = at.since(self.measured).0;
            // 2^n half turns in ticks are one half turn in Qn.
            let seen_q8 = length << (8 - base_log2);
            let off = seen_q8.wrapping_sub(self.half_turn.ticks_q8()) as i32;
            let ticks_q8 = self.half_turn.ticks_q8().wrapping_add_signed(off >> u32::from(base_log2 == BASE_LOG2));
            if let Some(half_turn) = HalfTurn::from_ticks_q8(ticks_q8) {
                self.half_turn = half_turn;
                self.units = Units::of(ticks_q8);
            }
            self.measures = (self.measures + 1).min(BASE_LOG2);
        }
        self.measured = at;
        self.measured_of = of;
        self.measured_age = 0;
    }

    /// Says what a pulse is that [`Lock::follow`] has found the slot of.
    #[inline]
    pub(super) fn place(&mut self, config: &Config, counts: &mut Counts, pulse: Pulse) -> Option<Light> {
        let window = self.units.half_turn >> config.window_shift;
        let next = self.next[(self.slot & 1) as usize];
        let after_a = pulse.start.offset_from(next[Station::A as usize]);
        let after_b = pulse.start.offset_from(next[Station::B as usize]);
        let (station, rise) =
            if after_a.unsigned_abs() <= window { (Station::A, after_a) } else { (Station::B, after_b) };
        if rise.unsigned_abs() <= window {
            return self.flash(config, counts, station, rise, pulse.width.0);
        }
        self.laser(config, counts, pulse)
    }

    /// Whose turn it is, and about which axis.
    fn turn(&self) -> (Station, Axis) {
        let station = if self.slot & 2 == 0 { Station::B } else { Station::A };
        (station, if self.slot & 1 == 0 { Axis::Azimuth } else { Axis::Elevation })
    }

    /// A pulse that rises `rise` after the station's next flash should.
    #[inline(never)]
    fn flash(
        &mut self,
        config: &Config,
        counts: &mut Counts,
        station: Station,
        rise: i32,
        width: u32,
    ) -> Option<Light> {
        let bit = 1 << station as u32;
        let step = self.units.step;
        if self.seen & bit != 0 || width > 16 * step as u32 {
            counts.misfit();
            return None;
        }
        if self.phase != Phase::Locked {
            self.learn(config, counts, station, rise, width);
            return None;
        }
        let (sweeping, axis) = self.turn();
        let skip = station != sweeping;
        let bare = step * (WIDTH_BASE_STEPS as i32 + (self.slot & 1) as i32 + if skip { 4 } else { 0 });
        let mut fall = rise + width as i32 - bare - (self.bias_q3[station as usize] >> BIAS_SHIFT);
        let data = fall > step;
        if data {
            fall -= 2 * step;
        }
        let spread = fall - rise;
        let mut width_off = spread.unsigned_abs();
        let mut off = if fall.unsigned_abs() < rise.unsigned_abs() { fall } else { rise };
        let base = (self.units.half_turn >> TOLERANCE_SHIFT) as i32;
        // Once the receiver is known, a flash per cycle is enough to hear of it.
        let is_new = self.tolerance > base as u32;
        let is_told = self.slot == station as u32 || is_new;
        if is_told {
            let earlier = core::mem::replace(&mut self.spread[station as usize], spread);
            let noise = &mut self.noise[station as usize];
            // One odd flash later on makes no noisy station.
            *noise += spread.abs_diff(earlier).min((step << if is_new { 3 } else { 0 }) as u32) >> 3;
            *noise -= *noise >> 3;
        }
        if self.noise[station as usize] > base as u32 {
            off = self.settle(station, rise, fall);
            width_off = 0;
            self.off[station as usize] = off;
        }
        let earlier = core::mem::replace(&mut self.off[station as usize], off);
        let mut moved = (off + 1) >> 1;
        if off.unsigned_abs() > self.tolerance || fall.unsigned_abs() > (step + step / 2) as u32 {
            // Two in a row that say the same, of the right width, are where the flashes are now.
            let is_odd = width_off > step as u32 || off.abs_diff(earlier) > base as u32;
            if is_odd {
                counts.misfit();
                self.doubt += CONTRADICTION;
                if self.doubt >= DOUBT {
                    self.forget_place();
                }
                return None;
            }
            moved = off;
        } else if is_new {
            moved = off;
            self.bias_q3[station as usize] += spread * 4;
        } else {
            let slew = (self.units.half_turn >> SLEW_SHIFT) as i32;
            if moved.unsigned_abs() > slew as u32 && (off ^ earlier < 0 || earlier.unsigned_abs() <= 2 * slew as u32) {
                moved = moved.clamp(-slew, slew);
            }
            if is_told && spread.unsigned_abs() <= step as u32 {
                self.bias_q3[station as usize] += spread;
            }
        }
        self.doubt = self.doubt.saturating_sub(1);
        self.moved = moved;
        let next = &mut self.next[(self.slot & 1) as usize][station as usize];
        *next = Ticks(next.0.wrapping_add_signed(moved));
        self.seen |= bit;
        // A half turn that only the search has measured, from two flashes, may be off by as much as a flash.
        if self.measures == 0 {
            return None;
        }
        counts.sync(station);
        Some(Light::Sync(Sync { station, axis, skip, data }))
    }

    /// A station whose light is seen to come on late, each time by something else: only the falls tell where its flashes
    /// are. Its bias cannot be known and goes to zero; no rise is early.
    #[cold]
    #[inline(never)]
    fn settle(&mut self, station: Station, rise: i32, fall: i32) -> i32 {
        let leak = self.bias_q3[station as usize] / 2;
        self.bias_q3[station as usize] -= leak;
        let next = &mut self.next[(self.slot & 1) as usize][station as usize];
        *next = Ticks(next.0.wrapping_add_signed(leak >> BIAS_SHIFT));
        if rise < -self.units.step / 2 { rise } else { fall }
    }

    /// The place in the cycle is wrong: back to the pattern.
    #[cold]
    #[inline(never)]
    fn forget_place(&mut self) {
        self.phase = if self.first_slot == 0 { Phase::Pair } else { Phase::Train };
        (self.first_slot, self.slots, self.run, self.doubt) = (0, 0, 0, 0);
        (self.narrowest, self.widest, self.ever_skipped) = ([u32::MAX; 2], [0; 2], false);
        (self.after, self.held, self.chosen, self.rest) = ([0; 4], 0, 0, Rest::Nothing);
    }

    /// A flash while the place in the cycle is not known.
    #[cold]
    #[inline(never)]
    fn learn(&mut self, config: &Config, counts: &mut Counts, station: Station, rise: i32, width: u32) {
        if !self.units.is_sync(Span(width)) {
            counts.misfit();
            return;
        }
        let parity = (self.slot & 1) as usize;
        self.seen |= 1 << station as u32;
        self.moved = rise;
        self.noise[station as usize] += rise.unsigned_abs();
        let next = &mut self.next[parity][station as usize];
        *next = Ticks(next.0.wrapping_add_signed(rise));
        if self.phase == Phase::Pair {
            self.widths[station as usize] = width;
            // B comes second.
            if self.seen == 3 {
                self.compare(self.widths);
            }
        } else {
            self.next[parity][Station::B as usize] = *next;
            self.compare_turns(parity, width);
            if self.phase == Phase::Nameless
                && let Some(station) = config.lone
            {
                self.name(station);
            }
        }
    }

    /// Holds the two flashes of a slot against each other: only one of them skips.
    fn compare(&mut self, [a, b]: [u32; 2]) {
        if a.abs_diff(b) <= self.units.step as u32 / 2 {
            self.run = 0;
            return;
        }
        self.note_skip(a > b);
    }

    /// Holds the flashes of a rotor against each other: it skips every second turn, or it is alone and never does.
    fn compare_turns(&mut self, parity: usize, width: u32) {
        let step = self.units.step as u32;
        let earlier = core::mem::replace(&mut self.widths[parity], width);
        self.narrowest[parity] = self.narrowest[parity].min(width);
        self.widest[parity] = self.widest[parity].max(width);
        self.slots += 1;
        if width.abs_diff(earlier) >= 3 * step {
            self.ever_skipped = true;
            self.note_skip(width > earlier);
            return;
        }
        self.run = 0;
        if self.ever_skipped || self.slots < SINGLE {
            return;
        }
        // Data bits are two steps, the axis is one: only from the narrowest azimuth to the widest elevation is it three.
        for azimuth in 0..2 {
            if self.widest[1 - azimuth] > self.narrowest[azimuth] + 2 * step {
                self.first_slot = 2;
                self.lock(2 + u32::from(parity != azimuth));
            }
        }
    }

    /// Takes one more skip of A, or of a lone train, and looks for the cycle in the latest: skip, skip, sweep, sweep.
    fn note_skip(&mut self, skip: bool) {
        self.skips = self.skips << 1 | u32::from(skip);
        self.run += 1;
        if self.run < PATTERN {
            return;
        }
        let slot = match self.skips & 0xf {
            0b1001 => 0,
            0b0011 => 1,
            0b0110 => 2,
            0b1100 => 3,
            _ => return,
        };
        if self.phase == Phase::Pair {
            self.lock(slot);
        } else {
            self.set_slot(slot);
            self.phase = Phase::Nameless;
        }
    }

    fn set_slot(&mut self, slot: u32) {
        if (slot ^ self.slot) & 1 != 0 {
            self.next.swap(0, 1);
            self.widths.swap(0, 1);
        }
        self.slot = slot;
    }

    fn lock(&mut self, slot: u32) {
        self.set_slot(slot);
        self.phase = Phase::Locked;
        self.noise = [0; 2];
        self.tolerance = self.units.half_turn >> FRESH_SHIFT;
    }

    /// Says whose flashes the lone train is. The other station may be seen later.
    pub(super) fn name(&mut self, station: Station) {
        if self.phase != Phase::Nameless {
            return;
        }
        // A cable-synced pair's gap is a twentieth, 0.05; this is 0.0488, near enough for every window.
        let gap = (self.units.half_turn >> 5) + (self.units.half_turn >> 6) + (self.units.half_turn >> 9);
        for next in &mut self.next {
            let train = next[Station::A as usize];
            *next = match station {
                Station::A => [train, train.after(Span(gap))],
                Station::B => [train.before(Span(gap)), train],
            };
        }
        // B skips where A sweeps.
        self.lock(if station == Station::A { self.slot } else { self.slot ^ 2 });
        self.seen = 1 << station as u32;
    }

    /// A pulse between the flashes.
    #[inline(never)]
    fn laser(&mut self, config: &Config, counts: &mut Counts, pulse: Pulse) -> Option<Light> {
        if self.phase != Phase::Locked || self.measures == 0 {
            counts.stray();
            return None;
        }
        let width = pulse.width.0;
        let half_turn = self.units.half_turn;
        if width > self.units.sweep_max() {
            counts.long();
            return None;
        }
        if width < (half_turn * config.shortest_sweep) >> 13 {
            counts.short();
            return None;
        }
        let (station, axis) = self.turn();
        let at = match config.stamp {
            Stamp::Middle => pulse.start.after(Span(width / 2)),
            Stamp::Rise => pulse.start,
        };
        let slot = self.slot as usize & 3;
        let after = at.since(self.next[slot & 1][station as usize]).0;
        // The rotor lights 30 to 150 degrees. Two degrees more to either side leave room for its factory phase: the
        // angle stage knows that and draws the exact line.
        if after.wrapping_sub((half_turn >> 5) * 5) > (half_turn >> 5) * 22 {
            counts.stray();
            return None;
        }
        if self.chosen != 0 {
            counts.second();
            // The wrong one was given away: compare the next time.
            if width > self.chosen + self.chosen / 2 {
                self.after[slot] = 0;
            }
            return None;
        }
        let apart = after.abs_diff(self.after[slot]);
        if apart > half_turn >> NEAR_SHIFT || 2 * width < self.width[slot] || self.held > width {
            self.hold(counts, at, after, width);
            return None;
        }
        self.choose(width, after);
        // Nobody asked for what the slot before has left; now it would come too late.
        self.rest = Rest::Nothing;
        counts.sweep(station, axis);
        Some(Light::Sweep(Sweep { station, axis, at, since_sync: Span(after), half_turn: self.half_turn }))
    }

    fn choose(&mut self, width: u32, after: u32) {
        let slot = self.slot as usize & 3;
        self.chosen = width;
        self.width[slot] = width;
        self.after[slot] = after;
    }

    /// Keeps the better of two until the slot ends: the clearly longer one, else the one nearer to the expected.
    #[cold]
    #[inline(never)]
    fn hold(&mut self, counts: &mut Counts, at: Ticks, after: u32, width: u32) {
        if self.held != 0 {
            counts.second();
            let expected = self.after[self.slot as usize & 3];
            let is_alike = width.abs_diff(self.held) <= self.held / 4;
            let is_better = if is_alike {
                expected != 0 && after.abs_diff(expected) < self.held_after.abs_diff(expected)
            } else {
                width > self.held
            };
            if !is_better {
                return;
            }
        }
        (self.held, self.held_after, self.held_at) = (width, after, at);
    }

    /// The slot ends: what waited is chosen, and where nothing came, soon nothing is expected.
    #[inline]
    fn close_sweeps(&mut self) {
        self.rest = Rest::Nothing;
        let bit = 1 << self.slot;
        if self.chosen == 0 {
            self.close_unchosen(bit);
        } else {
            self.missed &= !bit;
        }
        self.chosen = 0;
    }

    #[cold]
    #[inline(never)]
    fn close_unchosen(&mut self, bit: u32) {
        if self.held == 0 {
            self.rest = Rest::Dark;
            if self.missed & bit != 0 {
                self.after[self.slot as usize & 3] = 0;
            }
            self.missed |= bit;
            return;
        }
        let (station, axis) = self.turn();
        self.rest = Rest::Sweep;
        self.missed &= !bit;
        let (width, after) = (core::mem::take(&mut self.held), self.held_after);
        self.choose(width, after);
        self.late = Some(Sweep { station, axis, at: self.held_at, since_sync: Span(after), half_turn: self.half_turn });
    }

    /// What the slot that ended last has left; said once.
    #[inline]
    pub(super) fn take_closed(&mut self, counts: &mut Counts) -> Option<Closed> {
        if self.rest == Rest::Nothing {
            return None;
        }
        match core::mem::take(&mut self.rest) {
            Rest::Dark => Some(Closed::Dark(self.half_turn)),
            _ => {
                let sweep = self.late.take()?;
                counts.sweep(sweep.station, sweep.axis);
                Some(Closed::Sweep(sweep))
            }
        }
    }
}
