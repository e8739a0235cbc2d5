//! The eight flash widths, in shares of the half turn.
//!
//! What can go wrong: a receiver changes every width by the same few microseconds. Absolute bins then lie; only the
//! search, which knows nothing else yet, relies on them, and generously.

use super::{Axis, HALF_TURN_BITS, HalfTurn};
use crate::time::Span;

/// One flash width step, 10.4167 us, is 1/800 of the half turn (1/120 s).
const WIDTH_STEPS_PER_HALF_TURN: u32 = 800;
/// The shortest flash, 62.5 us, in steps.
pub(super) const WIDTH_BASE_STEPS: u32 = 6;
/// Twice the shortest and longest width accepted as a flash, in steps: 62.5 us - 10 us, and 135.4 us + 10 us.
const WIDTH_ACCEPTED_HALF_STEPS: (u32, u32) = (10, 28);
/// Twice the longest width accepted as a sweep, in steps: 41.7 us. Real sweeps stay under 20 us.
const SWEEP_HALF_STEPS: u32 = 8;

/// The axis, data and skip bits whose nominal width is nearest to `width`, for a half turn of `half_turn`.
///
/// Right while the receiver changes widths by less than half a step, 5.2 us. `None` outside the eight bins.
#[must_use]
pub fn nearest_width(half_turn: HalfTurn, width: Span) -> Option<(Axis, bool, bool)> {
    if width >= half_turn.span() {
        return None;
    }
    let steps = (u64::from(half_turn.share(width)) * u64::from(WIDTH_STEPS_PER_HALF_TURN)
        + (1 << (HALF_TURN_BITS - 1)))
        >> HALF_TURN_BITS;
    let code = (steps as u32).checked_sub(WIDTH_BASE_STEPS)?;
    if code > 7 {
        return None;
    }
    let axis = if code & 1 == 0 { Axis::Azimuth } else { Axis::Elevation };
    Some((axis, code & 2 != 0, code & 4 != 0))
}

/// Lengths that every pulse is compared with, worked out when the half turn changes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Units {
    pub(super) half_turn: Span,
    pub(super) width_step: u32,
    sync_width: (u32, u32),
    pub(super) sweep_width_max: u32,
}

impl Units {
    pub(super) fn of(half_turn: HalfTurn) -> Self {
        // 2^20 / 800 = 1310.72, the reciprocal of the steps in a half turn.
        const STEP_Q20: u32 = (1 << 20) / WIDTH_STEPS_PER_HALF_TURN;
        // At most 2^20 ticks by 2^11.
        let half_step = (half_turn.span().0 * STEP_Q20) >> (20 + 1);
        Self {
            half_turn: half_turn.span(),
            width_step: 2 * half_step,
            sync_width: (half_step * WIDTH_ACCEPTED_HALF_STEPS.0, half_step * WIDTH_ACCEPTED_HALF_STEPS.1),
            sweep_width_max: half_step * SWEEP_HALF_STEPS,
        }
    }

    pub(super) fn is_sync(&self, width: Span) -> bool {
        width.0 >= self.sync_width.0 && width.0 <= self.sync_width.1
    }
}
