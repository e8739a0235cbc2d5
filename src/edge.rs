//! One change of the light, stamped: the only thing an interrupt handler makes.
//!
//! The deglitch rule lives with the reader of edges ([`crate::pulse`]): levels must alternate. A second rise means the
//! fall between was lost, so the newer rise counts; a second fall has no pulse to end and is dropped.
//!
//! ```
//! use lighthouse_mote::edge::Edge;
//! use lighthouse_mote::pulse::{self, Pulse, State};
//! use lighthouse_mote::time::{Span, Ticks};
//!
//! // The fall of the first pulse never came, that of the second came twice.
//! let edges = [Edge::rise(Ticks(1_000)), Edge::rise(Ticks(5_000)), Edge::fall(Ticks(5_940)), Edge::fall(Ticks(5_990))];
//! let mut state = State::default();
//! let pulses: Vec<Pulse> = edges.into_iter().filter_map(|edge| pulse::step(&mut state, edge)).collect();
//! assert_eq!(pulses, [Pulse { start: Ticks(5_000), width: Span(940) }]);
//! assert_eq!(state.lost(), 2);
//! ```
//!
//! What can go wrong: interrupt latency delays the stamp. A constant delay cancels in every span; its jitter does not.

use crate::time::Ticks;

/// One stamped change of the light level.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Edge {
    /// When the level changed, on the mote's counter.
    pub at: Ticks,
    /// The level after the change.
    pub level: Level,
}

/// The state of the optical line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Level {
    /// Light falls on the photodiode.
    Lit,
    /// It does not.
    Dark,
}

impl Edge {
    /// The light comes on at `at`.
    #[must_use]
    pub const fn rise(at: Ticks) -> Self {
        Self { at, level: Level::Lit }
    }

    /// The light goes off at `at`.
    #[must_use]
    pub const fn fall(at: Ticks) -> Self {
        Self { at, level: Level::Dark }
    }
}
