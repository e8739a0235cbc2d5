//! Which slot of the cycle is which, read from the widths of the flashes against each other.
//!
//! What can go wrong: data bits that look like skips; a place is believed when it leads the others by several.

use super::laser::Rest;
use super::{FRESH_SHIFT, Lock, Phase, Train};
use crate::sweep::{Cause, Config, Rejects, Station};
use crate::time::{Span, Ticks};

/// By how many skips one place in the cycle must lead the next likely before it is believed: two of each rotor, and two
/// more for each that contradicts. Four slots in a row have as many; lost flashes only make it take longer.
const LEAD: i32 = 4;
/// Slots with one flash each and without any skip, until the station is believed to be the only one. Data bits that
/// look like that in a pair of stations must repeat 0011 all the while.
const SINGLE: u32 = 12;

impl Lock {
    /// The place in the cycle is wrong: back to the pattern.
    #[cold]
    #[inline(never)]
    pub(super) fn forget_place(&mut self) {
        self.phase = if self.first_slot == 0 { Phase::Pair } else { Phase::Train };
        (self.near, self.first_slot, self.slots, self.votes, self.doubt) = (0, 0, 0, [0; 2], 0);
        (self.narrowest, self.widest, self.ever_skipped) = ([u32::MAX; 2], [0; 2], false);
        (self.held, self.chosen, self.rest) = (0, 0, Rest::Nothing);
        for rotor in &mut self.rotors {
            rotor.after = 0;
        }
    }

    /// A flash while the place in the cycle is not known.
    #[inline(never)]
    pub(super) fn learn(&mut self, config: &Config, counts: &mut Rejects, station: Station, rise: i32, width: u32) {
        let train = &mut self.trains[station as usize];
        if !self.units.is_sync(Span(width)) {
            counts.turn_away(Cause::Misfit);
            return;
        }
        train.seen = 1;
        train.noise += rise.unsigned_abs();
        train.next = Ticks(train.next.0.wrapping_add_signed(rise));
        self.moved = rise;
        if self.phase == Phase::Pair {
            self.widths[station as usize] = width;
            // B comes second.
            if self.trains[0].seen & self.trains[1].seen != 0 {
                self.compare(self.widths);
            }
        } else {
            self.compare_turns(width);
            if self.phase == Phase::Nameless
                && let Some(station) = config.lone
            {
                self.name(station);
            }
        }
    }

    /// Holds the two flashes of a slot against each other: only one of them skips. Alike, they say nothing.
    #[inline(never)]
    pub(super) fn compare(&mut self, [a, b]: [u32; 2]) {
        if a.abs_diff(b) > self.units.step as u32 / 2 {
            self.note_skip(a > b);
        }
    }

    /// Holds the flashes of a rotor against each other: it skips every second turn, or it is alone and never does.
    fn compare_turns(&mut self, width: u32) {
        let step = self.units.step as u32;
        let parity = (self.slot & 1) as usize;
        let earlier = core::mem::replace(&mut self.widths[parity], width);
        self.narrowest[parity] = self.narrowest[parity].min(width);
        self.widest[parity] = self.widest[parity].max(width);
        self.slots += 1;
        if width.abs_diff(earlier) >= 3 * step {
            self.ever_skipped = true;
            self.note_skip(width > earlier);
            return;
        }
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

    /// Takes one more skip of A, or of a lone train: it skips in the slots 0 and 1 and sweeps in 2 and 3, whichever those
    /// are.
    #[inline(never)]
    fn note_skip(&mut self, skip: bool) {
        let [here, next] = &mut self.votes;
        let slot = self.slot as i32 + if skip { 0 } else { 2 };
        *here += 1 - (slot & 2);
        *next += 1 - ((slot + 1) & 2);
        // The two other places say the contrary of these.
        let (mut here, mut next) = (*here, *next);
        for slot in self.slot..self.slot + 4 {
            if here - next.abs() >= LEAD {
                self.votes = [0; 2];
                if self.phase == Phase::Pair {
                    self.lock(slot & 3);
                } else {
                    self.set_slot(slot & 3);
                    self.phase = Phase::Nameless;
                }
                return;
            }
            (here, next) = (next, -here);
        }
    }

    fn set_slot(&mut self, slot: u32) {
        if (slot ^ self.slot) & 1 != 0 {
            self.widths.swap(0, 1);
        }
        self.slot = slot;
    }

    #[inline(never)]
    fn lock(&mut self, slot: u32) {
        self.set_slot(slot);
        self.phase = if self.base_log2 == 1 { Phase::Placed } else { Phase::Locked };
        for train in &mut self.trains {
            train.noise = 0;
        }
        self.tolerance = self.units.half_turn >> FRESH_SHIFT;
        self.near = 0;
    }

    /// Says whose flashes the lone train is. The other station may be seen later.
    pub(in crate::sweep) fn name(&mut self, station: Station) {
        if self.phase != Phase::Nameless {
            return;
        }
        // A cable-synced pair's gap is a twentieth, 0.05; this is 0.0488, near enough for every window.
        let half_turn = self.units.half_turn;
        let gap = Span((half_turn >> 5) + (half_turn >> 6) + (half_turn >> 9));
        let [a, b] = &mut self.trains;
        *b = Train { bias_q3: b.bias_q3, syncs: b.syncs, seen: 0, ..*a };
        match station {
            Station::A => (b.next, b.later) = (a.next.after(gap), a.later.after(gap)),
            Station::B => {
                (a.next, a.later) = (a.next.before(gap), a.later.before(gap));
                (a.seen, b.seen) = (0, a.seen);
            }
        }
        self.restart();
        // B skips where A sweeps.
        self.lock(if station == Station::A { self.slot } else { self.slot ^ 2 });
    }
}
