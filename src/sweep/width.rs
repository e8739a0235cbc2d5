//! The eight flash widths, in shares of the half turn.
//!
//! What can go wrong: a receiver changes every width by the same few microseconds. Absolute bins then lie; only the
//! search, which knows nothing else yet, relies on them, and generously.

use crate::time::Span;

/// One flash width step, 10.4167 us, is 1/800 of the half turn (1/120 s).
const WIDTH_STEPS_PER_HALF_TURN: u32 = 800;
/// The shortest flash, 62.5 us, in steps.
pub(super) const WIDTH_BASE_STEPS: u32 = 6;
/// The shortest and longest width that may be a flash of a receiver not known yet, in steps: 62.5 us - 10 us, and
/// 135.4 us + 10 us.
const WIDTH_ACCEPTED_STEPS: (u32, u32) = (5, 14);
/// The longest width accepted as a sweep, in steps: 41.7 us. Real sweeps stay under 20 us.
pub(super) const SWEEP_STEPS: u32 = 4;

/// Lengths that pulses are compared with, in ticks; worked out when the half turn changes.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Units {
    /// One half turn.
    pub(super) half_turn: u32,
    /// Two: one turn of a rotor.
    pub(super) turn: u32,
    /// One step of the flash widths.
    pub(super) step: i32,
}

impl Units {
    /// For a half turn of `ticks_q8 / 256` ticks, at most `HalfTurn::MAX_TICKS`.
    pub(super) fn of(ticks_q8: u32) -> Self {
        let half_turn = (ticks_q8 + (1 << 7)) >> 8;
        Self { half_turn, turn: (ticks_q8 + (1 << 6)) >> 7, step: step(half_turn) as i32 }
    }

    /// Whether `width` may be a flash for a receiver of which nothing is known.
    pub(super) fn is_sync(&self, width: Span) -> bool {
        is_sync(self.half_turn, width)
    }
}

/// A step of the widths, for a half turn of at most 2^20 ticks.
fn step(half_turn: u32) -> u32 {
    // 2^20 / 800 = 1310.72, the reciprocal of the steps in a half turn; at most 2^20 ticks by 2^11.
    const STEP_Q20: u32 = (1 << 20) / WIDTH_STEPS_PER_HALF_TURN;
    (half_turn * STEP_Q20 + (1 << 19)) >> 20
}

/// Whether `width` may be a flash for a receiver of which nothing is known, of a half turn of at most 2^20 ticks.
#[inline(never)]
pub(super) fn is_sync(half_turn: u32, width: Span) -> bool {
    let step = step(half_turn);
    width.0 >= step * WIDTH_ACCEPTED_STEPS.0 && width.0 <= step * WIDTH_ACCEPTED_STEPS.1
}
