//! The measured half turn: the only clock that means anything.
//!
//! What can go wrong: a half turn outside the range that the arithmetic holds; it is not representable.

use crate::time::Span;

/// log2 of the shares in a half turn: 2^20, 3.0 urad each.
pub const HALF_TURN_BITS: u32 = 20;

/// The measured half turn of the rotors and its kept reciprocal.
///
/// Shared by every ratio between two estimates, so that the division is paid once per rotor turn and not per sweep.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct HalfTurn {
    ticks_q8: u32,
    reciprocal_q52: u32,
}

impl HalfTurn {
    /// The shortest half turn that the arithmetic holds, in ticks: a clock of 1 MHz.
    pub const MIN_TICKS: u32 = 1 << 13;
    /// The longest half turn that the arithmetic holds, in ticks: a clock of 125 MHz.
    pub const MAX_TICKS: u32 = 1 << 20;

    /// A half turn of `ticks_q8 / 256` ticks; `None` outside `MIN_TICKS ..= MAX_TICKS`.
    #[must_use]
    pub const fn from_ticks_q8(ticks_q8: u32) -> Option<Self> {
        if ticks_q8 < Self::MIN_TICKS << 8 || ticks_q8 > Self::MAX_TICKS << 8 {
            return None;
        }
        // MIN_TICKS keeps the quotient at most 2^52 / 2^21 = 2^31.
        let reciprocal_q52 = ((1u64 << 52) / ticks_q8 as u64) as u32;
        Some(Self { ticks_q8, reciprocal_q52 })
    }

    /// The length in ticks, Q8.
    #[must_use]
    pub const fn ticks_q8(self) -> u32 {
        self.ticks_q8
    }

    /// The length in whole ticks.
    #[must_use]
    pub const fn span(self) -> Span {
        Span((self.ticks_q8 + 128) >> 8)
    }

    /// `span` as a share of the half turn, 2^20 units per half turn, rounded; saturates at 4095 half turns.
    #[must_use]
    #[inline]
    pub const fn share(self, span: Span) -> u32 {
        // span / (ticks_q8 / 2^8) * 2^20 = span * reciprocal * 2^(8 + 20 - 52)
        let share = (span.0 as u64 * self.reciprocal_q52 as u64 + (1 << 23)) >> 24;
        if share > u32::MAX as u64 { u32::MAX } else { share as u32 }
    }
}
