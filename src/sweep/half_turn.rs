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
        Some(Self { ticks_q8, reciprocal_q52: reciprocal_q52(ticks_q8) })
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

    /// `span` as a share of the half turn, 2^20 units per half turn, to two units up to four half
    /// turns and `MAX_TICKS`, to one part in 8192 beyond; saturates at 4095 half turns.
    #[must_use]
    #[inline]
    pub const fn share(self, span: Span) -> u32 {
        // span / (ticks_q8 / 2^8) * 2^20 = span * reciprocal * 2^(8 + 20 - 52)
        if span.0 <= Self::MAX_TICKS && span.0 >> 8 <= self.ticks_q8 >> 14 {
            // Up to four half turns, in 32 bits: the upper half of the reciprocal is 2^28 / ticks, and of the lower
            // half twelve bits are enough. The multiplier gives no more, and the 64-bit product costs five times that.
            let upper = span.0 * (self.reciprocal_q52 >> 16);
            let lower = (span.0 * (self.reciprocal_q52 >> 4 & 0xfff)) >> 12;
            return (upper + lower + (1 << 7)) >> 8;
        }
        self.long_share(span)
    }

    /// The same for longer spans, to one part in 8192: they are ages, not angles.
    #[cold]
    #[inline(never)]
    const fn long_share(self, span: Span) -> u32 {
        let mut short = span.0;
        let mut halvings = 0;
        while short > Self::MAX_TICKS || short >> 8 > self.ticks_q8 >> 14 {
            short >>= 1;
            halvings += 1;
        }
        let share = self.share(Span(short));
        if share > u32::MAX >> halvings { u32::MAX } else { share << halvings }
    }
}

/// 2^52 / `ticks_q8`, bit by bit, without its last four, which nobody needs: the core has no divider, and the 64-bit one
/// of the compiler costs twice the time and 900 bytes.
const fn reciprocal_q52(ticks_q8: u32) -> u32 {
    // 2^52 is 2^20, which is less than the divisor, with 32 zeros behind; the remainder stays under 2^28. A one that
    // is shifted out after 28 rounds ends the loop, which the compiler would unroll if it saw the end coming.
    let mut rest = 1 << 20;
    let mut quotient = 1u32 << 4;
    loop {
        let is_last = quotient >> 31 != 0;
        rest <<= 1;
        quotient <<= 1;
        if rest >= ticks_q8 {
            rest -= ticks_q8;
            quotient |= 1;
        }
        if is_last {
            return quotient << 4;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_share_is_the_ratio(ticks_q8 in HalfTurn::MIN_TICKS << 8..=HalfTurn::MAX_TICKS << 8, span in any::<u32>()) {
            let half_turn = HalfTurn::from_ticks_q8(ticks_q8).expect("in range");
            for span in [span, span >> 10, span % (ticks_q8 >> 8)] {
                let exact = f64::from(span) * 256.0 / f64::from(ticks_q8) * f64::from(1 << HALF_TURN_BITS);
                let share = f64::from(half_turn.share(Span(span)));
                let is_short = exact < f64::from(4 << HALF_TURN_BITS) && span <= HalfTurn::MAX_TICKS;
                let long = if is_short { 0.0 } else { exact / 8192.0 };
                let bound = 2.0 + exact * 2.0 / f64::from(half_turn.reciprocal_q52) + long;
                prop_assert!((share - exact.min(f64::from(u32::MAX))).abs() <= bound, "{} {}", share, exact);
            }
        }

        #[test]
        fn the_reciprocal_is_the_quotient(ticks_q8 in HalfTurn::MIN_TICKS << 8..=HalfTurn::MAX_TICKS << 8) {
            prop_assert_eq!(u64::from(reciprocal_q52(ticks_q8)), ((1u64 << 52) / u64::from(ticks_q8)) & !15);
        }
    }
}
