//! The search for the cycle, at no assumed clock rate.
//!
//! What can go wrong: other light makes two pairs of the right widths and distances by chance; the lock then finds no
//! flash where it predicts one and gives up by itself.

use super::HalfTurn;
use super::lock::Lock;
use super::width::Units;
use crate::pulse::Pulse;

/// Half turn over the gap between the flashes of A and B. 400,000 / 20,000 at 48 MHz for a cable-synced pair;
/// 18.5 to 23.8 for gaps of 350 to 450 us.
const GAP_RATIO: (u32, u32) = (18, 24);
/// How unequal two gaps of the same pair may be while searching: half turn >> this, 16 us.
const SEARCH_SHIFT: u32 = 9;
/// Pulses remembered while searching: two pairs of flashes, and what may shine between them.
const SEARCH_DEPTH: usize = 8;

/// The pulses seen while there is no cycle yet, newest last.
#[derive(Debug, Clone, Default)]
pub(super) struct Search {
    pulses: heapless::Deque<Pulse, SEARCH_DEPTH>,
}

impl Search {
    /// Looks for two pairs of flashes, A B ... A B, one half turn apart.
    pub(super) fn step(&mut self, newest: Pulse) -> Option<Lock> {
        if self.pulses.is_full() {
            self.pulses.pop_front();
        }
        let found = self.pair_up(newest);
        // Full was popped above, so there is room.
        let _ = self.pulses.push_back(newest);
        if found.is_some() {
            self.pulses.clear();
        }
        found
    }

    fn pair_up(&self, newest: Pulse) -> Option<Lock> {
        let (older, newer) = self.pulses.as_slices();
        let seen = || older.iter().chain(newer.iter());
        for (index, second_a) in seen().enumerate() {
            let gap = newest.start.since(second_a.start);
            for (first_index, first_a) in seen().enumerate().take(index) {
                let length = second_a.start.since(first_a.start);
                let Some(half_turn) = length.0.checked_mul(1 << 8).and_then(HalfTurn::from_ticks_q8) else {
                    continue;
                };
                if length.0 < gap.0.saturating_mul(GAP_RATIO.0) || length.0 > gap.0.saturating_mul(GAP_RATIO.1) {
                    continue;
                }
                let tolerance = length.0 >> SEARCH_SHIFT;
                let between = seen().skip(first_index + 1).take(index - first_index - 1);
                for first_b in between {
                    let first_gap = first_b.start.since(first_a.start);
                    if first_gap.0.abs_diff(gap.0) > tolerance {
                        continue;
                    }
                    let units = Units::of(half_turn);
                    if [first_a, first_b, second_a, &newest].iter().all(|pulse| units.is_sync(pulse.width)) {
                        return Some(Lock::new(second_a, &newest, half_turn));
                    }
                }
            }
        }
        None
    }
}
