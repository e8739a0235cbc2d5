//! The cycle, once found: from flash to flash by dead reckoning.
//!
//! Each rotor flashes once per turn, and its flashes wander little against each other, so each has its own prediction:
//! where the rotor's next flash begins. Rise and fall of a flash are both held against it, and the nearer one moves it:
//! a receiver that sees the light come on late still sees it go off in time. One flash moves it by at most half a
//! microsecond, two in a row that agree as far as they say.
//!
//! The fall also tells the data bit: place and skip are known from the cycle, the receiver's bias from the flashes
//! before. Of a flash that is far off, the width does.
//!
//! The half turn is measured over eight of them, from where both stations' flashes are, and taken for what it will be
//! over the next eight: it drifts as it did.
//!
//! What can go wrong: a flash is missing (its place is predicted), a pulse fits no window (it is no light of ours), the
//! flashes contradict the place in the cycle (after a few, the place is forgotten and found again).

mod laser;
mod place;

use laser::{Rest, Rotor};

use super::search::{Found, Search};
use super::width::{Units, WIDTH_BASE_STEPS};
use super::{Axis, COAST_HALF_TURNS, Cause, Config, HalfTurn, Rejects, Station, Sync};
use crate::time::{Span, Ticks};

/// How far from its predicted place a flash may rise: half turn >> this, 65 us.
const WINDOW_SHIFT: u32 = 7;
/// log2 of the half turns between two measurements of the half turn: from 1 up to this, one more each time. A longer
/// base costs less and says more.
const BASE_LOG2: u32 = 3;
/// The most that one measurement changes the half turn: half turn >> this, 0.02 %. A clock that drifts 1 % a minute is a
/// tenth of that off.
const OFF_SHIFT: u32 = 12;
/// The drift is learnt from what it did not foretell, 1/2^5 of it each time: within 2 s, and hardly any noise with it.
const DRIFT_SHIFT: u32 = 5;
/// The most that one flash moves its prediction: half turn >> this, 0.5 us, 0.011 degrees.
const SLEW_SHIFT: u32 = 14;
/// By how much more a flash may be off for each slot without any: half turn >> this, 4 us, a rate that is 0.05 % off.
const WIDER_SHIFT: u32 = 11;
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
/// Slots that two flash trains may take to make sense.
const PATIENCE: u32 = 64;
/// The bias is learnt from one flash per cycle, 1/2^3 of it each time.
const BIAS_SHIFT: u32 = 3;

/// How much is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Default)]
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
    /// Which slot is which; not yet a half turn measured over more than one.
    Placed,
    /// All.
    Locked,
}

/// One station's flashes.
#[derive(Debug, Clone, Copy, Default)]
#[repr(C)]
struct Train {
    /// Where its flash of this slot begins, and that of the next: each rotor has its own prediction.
    next: Ticks,
    later: Ticks,
    /// 1 where it has flashed in this slot.
    seen: u32,
    /// By how much the receiver lengthens its flashes, Q3.
    bias_q3: i32,
    /// By how much more its last flash was lengthened than usual, and how much that changes.
    spread: i32,
    noise: u32,
    /// How far the last flash of each rotor was off, by the lowest bit of the slot.
    off: [i32; 2],
    /// Flashes understood.
    syncs: u32,
}

/// The cycle, followed by dead reckoning from flash to flash.
#[derive(Debug, Clone, Default)]
#[repr(C)]
pub(super) struct Lock {
    // In the order of need: a Cortex-M0 reaches the first 31 words cheaply, and of single bytes the first 31.
    pub(super) phase: Phase,
    /// What the slot that ended last has left to be asked for.
    rest: Rest,
    /// 2 where only A exists, which then sweeps in every slot; 0 otherwise.
    first_slot: u8,
    /// 0 ..= 3; before the place is known, only its lowest bit means something.
    slot: u32,
    units: Units,
    /// Where everything is known and nothing new: off by this much is too far for a flash. 0 otherwise.
    near: u32,
    trains: [Train; 2],
    /// The width of the sweep that this slot gave; 0 for none yet.
    chosen: u32,
    doubt: u32,
    /// By how much the last flash has moved its prediction.
    moved: i32,
    pub(super) dark_slots: u32,
    /// Slots that are yet to end before the half turn is measured, in the one after.
    unmeasured: u32,
    /// The width of the best sweep that waits for the end of the slot; 0 for none.
    held: u32,
    pub(super) half_turn: HalfTurn,
    /// How far a flash may be from its prediction.
    tolerance: u32,
    /// log2 of the half turns that the next measurement takes; 1 before the first.
    base_log2: u32,
    rotors: [Rotor; 4],
    held_after: u32,
    held_at: Ticks,
    measured: Ticks,
    /// By how much the half turn grows from one measurement to the next, Q8; 0 until two over the full base.
    drift_q8: i32,
    /// The sweep that was chosen when its slot ended.
    late_slot: u32,
    late_after: u32,
    late_at: Ticks,
    // What the pattern is read from.
    slots: u32,
    /// The skips that agree with `slot`, less those that do not; the same for the slot after it.
    votes: [i32; 2],
    ever_skipped: bool,
    widths: [u32; 2],
    narrowest: [u32; 2],
    widest: [u32; 2],
}

/// Whose turn it is in a slot, and about which axis.
fn turn(slot: u32) -> (Station, Axis) {
    let station = if slot & 2 == 0 { Station::B } else { Station::A };
    (station, if slot & 1 == 0 { Axis::Azimuth } else { Axis::Elevation })
}

impl Lock {
    /// Begins anew with what the search has found; the receiver is still the same.
    pub(super) fn start(&mut self, search: &Search, found: &Found) {
        let is_lone = found.is_lone();
        let (a, b) = (search.pulse(found.second_a), search.pulse(0));
        let [older_a, older_b] = [found.first_a, found.first_b].map(|age| search.pulse(age).width.0);
        self.learn_half_turn(found.length << 8);
        let half_turn = Span(self.units.half_turn);
        for (train, flash) in self.trains.iter_mut().zip([a, b]) {
            *train = Train {
                next: flash.start,
                later: flash.start.after(half_turn),
                seen: 1,
                bias_q3: train.bias_q3,
                syncs: train.syncs,
                ..Train::default()
            };
        }
        self.trains[Station::B as usize].seen = u32::from(!is_lone);
        self.first_slot = 0;
        self.forget_place();
        (self.slot, self.moved, self.dark_slots) = (0, 0, 0);
        (self.base_log2, self.drift_q8) = (1, 0);
        self.restart();
        self.tolerance = half_turn.0 >> FRESH_SHIFT;
        if is_lone {
            self.phase = Phase::Train;
            self.widths = [b.width.0, older_a];
            self.narrowest = self.widths;
            self.widest = self.widths;
        } else {
            self.slot = 3;
            self.compare([older_a, older_b]);
            self.slot = 0;
            self.compare([a.width.0, b.width.0]);
        }
    }

    /// Takes a half turn of `ticks_q8 / 256` ticks, if it can be one.
    #[inline(never)]
    fn learn_half_turn(&mut self, ticks_q8: u32) {
        if let Some(half_turn) = HalfTurn::from_ticks_q8(ticks_q8) {
            self.half_turn = half_turn;
            self.units = Units::of(ticks_q8);
        }
    }

    /// Whether a better cycle is to be looked for among the pulses that this one has no use for.
    pub(super) fn is_doubtful(&self) -> bool {
        match self.phase {
            Phase::Dark => true,
            Phase::Train | Phase::Nameless => true,
            Phase::Pair | Phase::Placed | Phase::Locked => self.dark_slots > SURE_SLOTS,
        }
    }

    /// Forgets the cycle; what is known of the receiver stays.
    pub(super) fn end(&mut self) {
        self.phase = Phase::Dark;
        self.rest = Rest::Nothing;
    }

    #[inline(never)]
    pub(super) fn width_bias(&self, station: Station) -> Option<i16> {
        let bias = self.trains[station as usize].bias_q3 >> BIAS_SHIFT;
        let share = i16::try_from(self.half_turn.share(Span(bias.unsigned_abs()))).unwrap_or(i16::MAX);
        (self.units.step != 0).then_some(if bias < 0 { -share } else { share })
    }

    /// Flashes understood, by station.
    pub(super) fn syncs(&self) -> [u16; 2] {
        self.trains.map(|train| train.syncs as u16)
    }

    /// Sweeps understood, by station and axis.
    pub(super) fn sweeps(&self) -> [[u16; 2]; 2] {
        let [b_azimuth, b_elevation, a_azimuth, a_elevation] = self.rotors.map(|rotor| rotor.sweeps as u16);
        [[a_azimuth, a_elevation], [b_azimuth, b_elevation]]
    }

    /// Moves on to the slot that `now` lies in; false when the light has been gone too long.
    #[inline]
    pub(super) fn follow(&mut self, now: Ticks) -> bool {
        loop {
            let half_turn = self.units.half_turn;
            let window = half_turn >> WINDOW_SHIFT;
            let into = now.offset_from(self.trains[Station::A as usize].next);
            // A pulse may start a little before the slot it belongs to; far before means the counter went half round.
            if into < (half_turn - window) as i32 {
                return into >= -(2 * window as i32);
            }
            if !self.advance() {
                return false;
            }
        }
    }

    /// Ends the slot; false when the light has been gone too long.
    #[inline(never)]
    fn advance(&mut self) -> bool {
        self.rest = Rest::Nothing;
        if self.chosen == 0 && self.is_placed() {
            self.close_unchosen();
        }
        self.chosen = 0;
        if self.trains[0].seen & self.trains[1].seen != 0 && self.near != 0 {
            self.dark_slots = 0;
        } else if !self.advance_oddly() {
            return false;
        }
        if self.unmeasured == 0 {
            self.measure();
        }
        self.unmeasured -= 1;
        let turn = Span(self.units.turn);
        for train in &mut self.trains {
            (train.next, train.later) = (train.later, train.next.after(turn));
            train.seen = 0;
        }
        self.slot = (self.slot + 1) & 3 | u32::from(self.first_slot);
        true
    }

    /// The same where a flash is missing or the lock is not sure yet.
    #[cold]
    #[inline(never)]
    fn advance_oddly(&mut self) -> bool {
        let half_turn = self.units.half_turn;
        let seen = self.trains.map(|train| train.seen);
        if seen == [0; 2] {
            self.dark_slots += 1;
            if self.dark_slots > COAST_HALF_TURNS {
                return false;
            }
            if self.dark_slots > SURE_SLOTS {
                let wider = self.tolerance + (half_turn >> WIDER_SHIFT);
                self.tolerance = wider.min(half_turn >> WINDOW_SHIFT);
            }
        } else {
            self.dark_slots = 0;
            let base = half_turn >> TOLERANCE_SHIFT;
            if self.tolerance > base {
                self.tolerance = (self.tolerance - self.tolerance / 4).max(base);
            }
        }
        // What is hidden moves with what was seen last.
        for train in self.trains.iter_mut().filter(|train| train.seen == 0) {
            train.next = Ticks(train.next.0.wrapping_add_signed(self.moved));
        }
        self.moved = 0;
        self.set_near();
        if self.phase == Phase::Pair {
            self.slots += 1;
            if self.slots > PATIENCE {
                return false;
            }
        }
        // Stations are 350 to 450 us apart, 34 to 43 steps. Where these are not, 32 to 48, a bit has flipped, and what is hidden
        // would never be found again.
        let [a, b] = &self.trains;
        let least = (self.units.step as u32) << 5;
        b.next.since(a.next).0.wrapping_sub(least) <= least / 2 || self.first_slot != 0 || !self.is_placed()
    }

    /// To be called where the phase, the tolerance or the half turn has changed.
    #[inline(never)]
    fn set_near(&mut self) {
        let base = self.units.half_turn >> TOLERANCE_SHIFT;
        self.near = if self.phase == Phase::Locked && self.tolerance <= base { base + 1 } else { 0 };
    }

    /// Learns the half turn from where the flashes of both stations are and were, seen or not: a flash that is missing has
    /// moved with the others.
    #[cold]
    #[inline(never)]
    fn measure(&mut self) {
        let base_log2 = self.base_log2;
        let is_sure = base_log2 == BASE_LOG2;
        if is_sure || self.dark_slots == 0 {
            // 2^n half turns in ticks are one half turn in Qn, and both stations count.
            let seen_q8 = self.at().since(self.measured).0 << (7 - base_log2);
            let ticks_q8 = self.half_turn.ticks_q8();
            let mut off = seen_q8.wrapping_sub(ticks_q8) as i32;
            if is_sure {
                let most = (ticks_q8 >> OFF_SHIFT) as i32;
                off = off.clamp(-most, most);
                // What was seen was so half a base ago, and is to hold for the next.
                self.drift_q8 += off >> DRIFT_SHIFT;
                off += self.drift_q8;
            }
            self.learn_half_turn(ticks_q8.wrapping_add_signed(off));
            self.base_log2 = (base_log2 + 1).min(BASE_LOG2);
            if self.phase == Phase::Placed {
                self.phase = Phase::Locked;
            }
        }
        self.restart();
        self.set_near();
    }

    /// From here on the half turn is to be measured anew.
    fn restart(&mut self) {
        (self.measured, self.unmeasured) = (self.at(), 1 << self.base_log2);
    }

    /// Where the flashes of this slot are: the sum of both.
    fn at(&self) -> Ticks {
        Ticks(self.trains[0].next.0.wrapping_add(self.trains[1].next.0))
    }

    /// The flash that a pulse is, of the slot that [`Lock::follow`] has found: whose, and how long after it should.
    #[inline]
    pub(super) fn flash_at(&self, start: Ticks) -> Option<(Station, i32)> {
        let window = self.units.half_turn >> WINDOW_SHIFT;
        let is_near = |rise: i32| rise.wrapping_add_unsigned(window) as u32 <= 2 * window;
        let rise = start.offset_from(self.trains[Station::A as usize].next);
        if is_near(rise) {
            return Some((Station::A, rise));
        }
        let rise = start.offset_from(self.trains[Station::B as usize].next);
        is_near(rise).then_some((Station::B, rise))
    }

    /// A flash of `station` with the data bit `data`, in this slot.
    #[inline]
    pub(super) fn sync(&self, station: Station, data: bool) -> Sync {
        let (sweeping, axis) = turn(self.slot);
        Sync { station, axis, skip: station != sweeping, data }
    }

    /// The data bit of a flash, and how much later it falls than one with that bit should.
    #[inline(always)]
    fn read(&self, station: Station, rise: i32, width: u32) -> (bool, i32) {
        // Bit 0 is the axis, bit 1 the skip; the skip is four steps.
        let code = (self.slot ^ (station as u32 * 2) ^ 2) as i32;
        let step = self.units.step;
        let bare = step * (WIDTH_BASE_STEPS as i32 + code + (code & 2));
        let fall = rise.wrapping_add_unsigned(width) - bare - (self.trains[station as usize].bias_q3 >> BIAS_SHIFT);
        let data = fall > step;
        (data, if data { fall - 2 * step } else { fall })
    }

    /// A pulse that rises `rise` after the station's next flash should; gives its data bit.
    #[inline(never)]
    pub(super) fn flash(
        &mut self,
        config: &Config,
        counts: &mut Rejects,
        station: Station,
        rise: i32,
        width: u32,
    ) -> Option<bool> {
        let step = self.units.step;
        let (data, fall) = self.read(station, rise, width);
        let (rise_off, fall_off) = (rise.unsigned_abs(), fall.unsigned_abs());
        let mut off = rise;
        let mut far = rise_off;
        if fall_off < rise_off {
            off = fall;
            far = fall_off;
        }
        let train = &mut self.trains[station as usize];
        let near = self.near;
        if train.noise >= near || far >= near || fall_off > (step + (step as u32 >> 1) as i32) as u32 || train.seen != 0
        {
            return self.flash_oddly(config, counts, station, rise, width);
        }
        train.seen = 1;
        train.syncs += 1;
        let earlier = core::mem::replace(&mut train.off[self.slot as usize & 1], off);
        let slew = (self.units.half_turn >> SLEW_SHIFT) as i32;
        let mut moved = (off + 1) >> 1;
        if far > 2 * slew as u32 && (off ^ earlier < 0 || earlier.unsigned_abs() <= 2 * slew as u32) {
            moved = if off < 0 { -slew } else { slew };
        }
        train.next = Ticks(train.next.0.wrapping_add_signed(moved));
        self.moved = moved;
        // Once the receiver is known, a flash per cycle is enough to hear of it.
        if self.slot == station as u32 {
            train.hear(fall - rise, step, false);
        }
        if self.doubt != 0 {
            self.doubt -= 1;
        }
        Some(data)
    }

    /// The same for a flash that is not where it should be, of a new lock, of a station that is seen to come on late, or
    /// for what is no flash.
    #[cold]
    #[inline(never)]
    fn flash_oddly(
        &mut self,
        config: &Config,
        counts: &mut Rejects,
        station: Station,
        rise: i32,
        width: u32,
    ) -> Option<bool> {
        // Made anew: a bit of them may have flipped, and all that is off comes by here.
        self.units = Units::of(self.half_turn.ticks_q8());
        let Units { half_turn, step, .. } = self.units;
        let base = half_turn >> TOLERANCE_SHIFT;
        let train = &mut self.trains[station as usize];
        // No receiver lengthens a flash by two steps of its width: that is memory gone wrong.
        if train.bias_q3.unsigned_abs() >> (BIAS_SHIFT + 1) >= step as u32 {
            train.bias_q3 = 0;
        }
        let is_late = train.noise > base;
        // Wherever a flash is, its width tells the bit, unless its station is seen to come on late; or that is not known
        // yet, as long as no drift is.
        let from = if is_late || self.drift_q8 == 0 { rise } else { 0 };
        let (data, to) = self.read(station, from, width);
        let spread = to - from;
        let fall = rise + spread;
        let is_new = self.tolerance > base;
        let is_placed = self.is_placed();
        let train = &mut self.trains[station as usize];
        if train.seen != 0 || width > 16 * step as u32 {
            counts.turn_away(Cause::Misfit);
            return None;
        }
        if !is_placed {
            self.learn(config, counts, station, rise, width);
            return None;
        }
        let bias_q3 = train.bias_q3;
        if is_new || self.slot == station as u32 {
            train.hear(spread, step, is_new);
        }
        let learnt_q3 = core::mem::replace(&mut train.bias_q3, bias_q3);
        let mut width_off = spread.unsigned_abs();
        let mut off = if fall.unsigned_abs() < rise.unsigned_abs() { fall } else { rise };
        let mut earlier = train.off[self.slot as usize & 1];
        if is_late {
            off = self.settle(station, rise, fall);
            width_off = 0;
            earlier = off;
        }
        let train = &mut self.trains[station as usize];
        train.off[self.slot as usize & 1] = off;
        let mut moved = off;
        if off.unsigned_abs() > self.tolerance || to.unsigned_abs() > (step * 3) as u32 >> 1 {
            // Two in a row that say the same, of the right width, are where the flashes are now.
            if width_off > step as u32 || off.abs_diff(earlier) > base {
                counts.turn_away(Cause::Misfit);
                self.doubt += CONTRADICTION;
                if self.doubt >= DOUBT {
                    self.forget_place();
                }
                return None;
            }
        } else if is_new {
            train.bias_q3 += spread * 4;
        } else {
            train.bias_q3 += learnt_q3 - bias_q3;
            moved = (off + 1) >> 1;
        }
        self.doubt = self.doubt.saturating_sub(1);
        self.moved = moved;
        train.next = Ticks(train.next.0.wrapping_add_signed(moved));
        train.seen = 1;
        // A half turn that only the search has measured, from two flashes, may be off by as much as a flash.
        if self.phase != Phase::Locked {
            return None;
        }
        train.syncs += 1;
        Some(data)
    }

    /// A station whose light is seen to come on late, each time by something else: only the falls tell where its flashes
    /// are. Its bias cannot be known and goes to zero; no rise is early.
    fn settle(&mut self, station: Station, rise: i32, fall: i32) -> i32 {
        let train = &mut self.trains[station as usize];
        let leak = train.bias_q3 / 2;
        train.bias_q3 -= leak;
        train.next = Ticks(train.next.0.wrapping_add_signed(leak >> BIAS_SHIFT));
        if rise < -self.units.step / 2 { rise } else { fall }
    }

    fn is_placed(&self) -> bool {
        matches!(self.phase, Phase::Placed | Phase::Locked)
    }
}

impl Train {
    /// Learns from how much more than usual a flash was lengthened.
    #[inline(never)]
    fn hear(&mut self, spread: i32, step: i32, is_new: bool) {
        let step = step as u32;
        let earlier = core::mem::replace(&mut self.spread, spread);
        // One odd flash later on makes no noisy station.
        self.noise += spread.abs_diff(earlier).min(if is_new { step << 3 } else { step }) >> 3;
        self.noise -= self.noise >> 3;
        if spread.unsigned_abs() <= step {
            self.bias_q3 += spread;
        }
    }
}
