//! The search for the cycle, at no assumed clock rate.
//!
//! What can go wrong: other light makes two pairs of the right widths and distances by chance; the lock then finds no
//! flash where it predicts one and gives up by itself.

use super::width::Units;
use super::{HalfTurn, Status};
use crate::pulse::Pulse;
use crate::time::Ticks;

/// Half turn over the gap between the flashes of A and B. 400,000 / 20,000 at 48 MHz for a cable-synced pair;
/// 18.5 to 23.8 for gaps of 350 to 450 us.
const GAP_RATIO: (u32, u32) = (18, 24);
/// The longest gap that can be one between two stations at all: half turn >> this. Twice the farthest that is allowed.
const FARTHEST_GAP_SHIFT: u32 = 3;
/// How unequal two gaps of the same pair may be while searching: half turn >> this, 16 us.
const SEARCH_SHIFT: u32 = 9;
/// Pulses remembered while searching: two pairs of flashes, and what may shine between them.
const SEARCH_DEPTH: usize = 8;
/// Eight pulses of V1 light last 150 to 640 times as long as their longest, which is a flash: 22 to 67 ms over 52 to
/// 145 us. Eight of V2 take two to four of its 18 to 21 ms turns, and no pulse outlasts 20 us: 1,800 times and more.
const V2_RATIO: u32 = 1024;
/// Under this ratio no pulse can be a flash or a sweep of eight that follow each other.
const WIDEST_RATIO: u32 = 100;
/// A last pulse this many ticks ago is no light at any clock: four of the longest half turns.
const NO_LIGHT: u32 = 4 * HalfTurn::MAX_TICKS;

/// Flashes that may be a cycle.
pub(super) struct Found {
    pub(super) half_turn: HalfTurn,
    /// Of the last slot but one: A's flash, B's. Of a lone train: one flash, twice.
    pub(super) older: [Pulse; 2],
    /// Of the last slot.
    pub(super) newer: [Pulse; 2],
    /// Only one flash per slot was seen.
    pub(super) is_lone: bool,
}

/// The pulses seen while there is no cycle yet, newest last.
#[derive(Debug, Clone, Default)]
pub(super) struct Search {
    pulses: heapless::Deque<Pulse, SEARCH_DEPTH>,
    /// Two pairs of flashes were seen whose gap is that of no two stations.
    misspaced: bool,
}

impl Search {
    pub(super) fn clear(&mut self) {
        self.pulses.clear();
        self.misspaced = false;
    }

    /// Looks for two pairs of flashes, A B ... A B, one half turn apart; or for three single ones, where `may_be_lone`.
    pub(super) fn step(&mut self, newest: Pulse, may_be_lone: bool) -> Option<Found> {
        if self.pulses.is_full() {
            self.pulses.pop_front();
        }
        let found = self.pair_up(newest, may_be_lone);
        // Full was popped above, so there is room.
        let _ = self.pulses.push_back(newest);
        if found.as_ref().is_some_and(|found| !found.is_lone) {
            self.clear();
        }
        found
    }

    fn pair_up(&mut self, newest: Pulse, may_be_lone: bool) -> Option<Found> {
        let (older, newer) = self.pulses.as_slices();
        let seen = || older.iter().chain(newer.iter());
        let mut lone = None;
        for (index, &second_a) in seen().enumerate() {
            let gap = newest.start.since(second_a.start).0;
            for (first_index, &first_a) in seen().enumerate().take(index) {
                let length = second_a.start.since(first_a.start).0;
                if !(HalfTurn::MIN_TICKS..=HalfTurn::MAX_TICKS).contains(&length) {
                    continue;
                }
                let tolerance = length >> SEARCH_SHIFT;
                let units = Units::of(length << 8);
                let are_flashes = |pulses: &[Pulse]| pulses.iter().all(|pulse| units.is_sync(pulse.width));
                if !are_flashes(&[first_a, second_a, newest]) {
                    continue;
                }
                if gap.abs_diff(length) <= tolerance {
                    lone = Some((length, second_a));
                }
                if gap > length >> FARTHEST_GAP_SHIFT {
                    continue;
                }
                for &first_b in seen().skip(first_index + 1).take(index - first_index - 1) {
                    if first_b.start.since(first_a.start).0.abs_diff(gap) > tolerance || !units.is_sync(first_b.width) {
                        continue;
                    }
                    if length < gap * GAP_RATIO.0 || length > gap * GAP_RATIO.1 {
                        self.misspaced = true;
                        continue;
                    }
                    let half_turn = HalfTurn::from_ticks_q8(length << 8)?;
                    return Some(Found {
                        half_turn,
                        older: [first_a, first_b],
                        newer: [second_a, newest],
                        is_lone: false,
                    });
                }
            }
        }
        let (length, second) = lone.filter(|_| may_be_lone)?;
        let half_turn = HalfTurn::from_ticks_q8(length << 8)?;
        Some(Found { half_turn, older: [second; 2], newer: [newest; 2], is_lone: true })
    }

    /// What the pulses of late look like. Asked for rarely, so that no pulse pays for it.
    pub(super) fn status(&self, now: Ticks) -> Status {
        let (Some(oldest), Some(newest)) = (self.pulses.front(), self.pulses.back()) else { return Status::NoLight };
        if now.since(newest.start).0 > NO_LIGHT {
            return Status::NoLight;
        }
        if self.misspaced {
            return Status::Spacing;
        }
        let length = newest.start.since(oldest.start).0;
        let longest = self.pulses.iter().map(|pulse| pulse.width.0).max().unwrap_or(0);
        if !self.pulses.is_full() {
            Status::Searching
        } else if length / V2_RATIO > longest {
            Status::V2
        } else if length / WIDEST_RATIO < longest {
            Status::Widths
        } else {
            Status::Searching
        }
    }
}
