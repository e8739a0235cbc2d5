//! Instants and lengths on the mote's own clock.
//!
//! The rate is in no type, because the mote does not know it: an RC oscillator is off by percents and drifts.
//! Every conversion to an angle or to seconds goes through the measured half turn of the rotor.
//!
//! ```
//! use lighthouse_mote::time::{Span, Ticks};
//!
//! // The counter wraps between a flash and the laser that follows it, and nobody notices.
//! let (flash, laser) = (Ticks(u32::MAX - 20_000), Ticks(25_065));
//! assert_eq!(laser.since(flash), Span(45_066));
//! assert_eq!(flash.after(Span(45_066)), laser);
//! // Of two instants less than half a wrap apart, the sign says which was first.
//! assert_eq!(flash.offset_from(laser), -45_066);
//! ```
//!
//! What can go wrong: the 32-bit counter wraps (every 6.6 min at 10.82 MHz), so instants have no order; only the
//! length from one to another means something, and only up to one wrap.

/// An instant: a reading of the free-running 32-bit tick counter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Ticks(pub u32);

/// A length of time in ticks, 0 ..= 2^32 - 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Span(pub u32);

impl Ticks {
    /// The length from `earlier` to `self`, right across a wrap of the counter.
    #[must_use]
    #[inline]
    pub const fn since(self, earlier: Ticks) -> Span {
        Span(self.0.wrapping_sub(earlier.0))
    }

    /// The instant `span` later.
    #[must_use]
    #[inline]
    pub const fn after(self, span: Span) -> Ticks {
        Ticks(self.0.wrapping_add(span.0))
    }

    /// The instant `span` earlier.
    #[must_use]
    #[inline]
    pub const fn before(self, span: Span) -> Ticks {
        Ticks(self.0.wrapping_sub(span.0))
    }

    /// The signed distance from `other` to `self`: negative when `self` is the earlier.
    ///
    /// Right while the two are less than half a wrap (2^31 ticks) apart.
    #[must_use]
    #[inline]
    pub const fn offset_from(self, other: Ticks) -> i32 {
        self.0.wrapping_sub(other.0) as i32
    }
}
