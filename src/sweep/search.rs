//! The search for the cycle, at no assumed clock rate.
//!
//! What can go wrong: other light makes two pairs of the right widths and distances by chance; the lock then finds no
//! flash where it predicts one and gives up by itself.

use super::{HalfTurn, Status, width};
use crate::pulse::Pulse;
use crate::time::{Span, Ticks};

/// Four half turns over the gap between the flashes of A and B, which is to be 350 to 450 us: 343.6 and 456.6 us.
const GAP_RATIO: (u32, u32) = (73, 97);
/// The longest gap that can be one between two stations at all: half turn >> this. Twice the farthest that is allowed.
const FARTHEST_GAP_SHIFT: u32 = 3;
/// How unequal two gaps of the same pair may be while searching: half turn >> this, 16 us.
const SEARCH_SHIFT: u32 = 9;
/// Pulses remembered while searching: two pairs of flashes, and what may shine between them.
const SEARCH_DEPTH: usize = 8;
/// Eight pulses of V1 light last 150 to 640 times as long as their longest, which is a flash: 22 to 67 ms over 52 to
/// 145 us. Eight of V2 take two to four of its 18 to 21 ms turns, and no pulse outlasts 20 us: 1,800 times and more.
const V2_RATIO_LOG2: u32 = 10;
/// Under this ratio no pulse can be a flash or a sweep of eight that follow each other.
const WIDEST_RATIO: u32 = 100;
/// A last pulse this many ticks ago is no light at any clock: four of the longest half turns.
const NO_LIGHT: u32 = 4 * HalfTurn::MAX_TICKS;

/// Flashes that may be a cycle, by their ages; the newest, of age 0, is the last of them.
pub(super) struct Found {
    /// The half turn, in ticks.
    pub(super) length: u32,
    /// A's flash of the last slot but one, and B's. Of a lone train: its only one, twice.
    pub(super) first_a: usize,
    pub(super) first_b: usize,
    /// A's flash of the last slot. Of a lone train: the newest.
    pub(super) second_a: usize,
}

impl Found {
    /// Only one flash per slot was seen.
    pub(super) fn is_lone(&self) -> bool {
        self.second_a == 0
    }
}

/// The pulses seen while there is no cycle yet.
#[derive(Debug, Clone)]
pub(super) struct Search {
    pulses: [Pulse; SEARCH_DEPTH],
    /// Where the newest is.
    newest: usize,
    /// How many there are.
    len: usize,
    /// Two pairs of flashes were seen whose gap is that of no two stations.
    misspaced: bool,
}

impl Default for Search {
    fn default() -> Self {
        let none = Pulse { start: Ticks(0), width: Span(0) };
        Self { pulses: [none; SEARCH_DEPTH], newest: 0, len: 0, misspaced: false }
    }
}

impl Search {
    pub(super) fn clear(&mut self) {
        self.len = 0;
        self.misspaced = false;
    }

    /// Forgets pulses that are no light any more: when the counter has wrapped they would look new.
    pub(super) fn expire(&mut self, now: Ticks) {
        if self.is_over(now) {
            self.clear();
        }
    }

    fn is_over(&self, now: Ticks) -> bool {
        now.since(self.pulse(0).start).0 > NO_LIGHT
    }

    /// The pulse that came `age` before the newest.
    pub(super) fn pulse(&self, age: usize) -> Pulse {
        self.pulses[self.newest.wrapping_sub(age) % SEARCH_DEPTH]
    }

    /// Looks for two pairs of flashes, A B ... A B, one half turn apart; or for three single ones, where `may_be_lone`.
    #[inline(never)]
    pub(super) fn step(&mut self, newest: Pulse, may_be_lone: bool) -> Option<Found> {
        self.newest = self.newest.wrapping_add(1);
        self.pulses[self.newest % SEARCH_DEPTH] = newest;
        self.len = (self.len + 1).min(SEARCH_DEPTH);
        let mut lone = None;
        // From the oldest on.
        for second_a in (1..self.len).rev() {
            let gap = newest.start.since(self.pulse(second_a).start).0;
            for first_a in (second_a + 1..self.len).rev() {
                let length = self.pulse(second_a).start.since(self.pulse(first_a).start).0;
                if !(HalfTurn::MIN_TICKS..=HalfTurn::MAX_TICKS).contains(&length) {
                    continue;
                }
                let tolerance = length >> SEARCH_SHIFT;
                let is_flash = |pulse: Pulse| width::is_sync(length, pulse.width);
                if !is_flash(self.pulse(first_a)) || !is_flash(self.pulse(second_a)) || !is_flash(newest) {
                    continue;
                }
                if gap.abs_diff(length) <= tolerance && may_be_lone {
                    lone = Some(Found { length, first_a: second_a, first_b: second_a, second_a: 0 });
                }
                if gap > length >> FARTHEST_GAP_SHIFT {
                    continue;
                }
                for first_b in (second_a + 1..first_a).rev() {
                    let first_gap = self.pulse(first_b).start.since(self.pulse(first_a).start).0;
                    if first_gap.abs_diff(gap) > tolerance || !is_flash(self.pulse(first_b)) {
                        continue;
                    }
                    if 4 * length >= gap * GAP_RATIO.0 && 4 * length <= gap * GAP_RATIO.1 {
                        return Some(Found { length, first_a, first_b, second_a });
                    }
                    self.misspaced = true;
                }
            }
        }
        lone
    }

    /// What the pulses of late look like. Asked for rarely, so that no pulse pays for it.
    pub(super) fn status(&self, now: Ticks) -> Status {
        let newest = self.pulse(0).start;
        if self.len == 0 || self.is_over(now) {
            return Status::NoLight;
        }
        if self.misspaced {
            return Status::Spacing;
        }
        if self.len < SEARCH_DEPTH {
            return Status::Searching;
        }
        let length = newest.since(self.pulse(SEARCH_DEPTH - 1).start).0;
        let longest = (0..self.len).fold(0, |longest, age| self.pulse(age).width.0.max(longest));
        // In whole multiples, which take no division.
        if length >> V2_RATIO_LOG2 > longest {
            Status::V2
        } else if length < longest.min(u32::MAX / WIDEST_RATIO) * WIDEST_RATIO {
            Status::Widths
        } else {
            Status::Searching
        }
    }
}
