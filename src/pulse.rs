//! Edges to pulses.
//!
//! ```
//! use lighthouse_mote::edge::Edge;
//! use lighthouse_mote::pulse::{self, State};
//! use lighthouse_mote::time::{Span, Ticks};
//!
//! // A flash of 62.5 us on a clock of 10 MHz, the counter wrapping in its middle.
//! let mut state = State::default();
//! assert_eq!(pulse::step(&mut state, Edge::rise(Ticks(u32::MAX - 299))), None);
//! let pulse = pulse::step(&mut state, Edge::fall(Ticks(325))).expect("the fall ends it");
//! assert_eq!((pulse.start, pulse.width), (Ticks(u32::MAX - 299), Span(625)));
//! ```
//!
//! What can go wrong: an edge is lost or doubled. Either costs at most the one pulse it belongs to, never the next,
//! and each is counted.

use crate::edge::{Edge, Level};
use crate::time::{Span, Ticks};

/// Light from one rise to the next fall.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Pulse {
    /// When the light came on.
    pub start: Ticks,
    /// For how long it stayed.
    pub width: Span,
}

/// The rise waiting for its fall, and what was lost so far.
#[derive(Debug, Clone, Default)]
pub struct State {
    rise: Option<Ticks>,
    lost: u16,
}

impl State {
    /// Edges that had no partner since start-up, wrapping.
    #[must_use]
    pub const fn lost(&self) -> u16 {
        self.lost
    }
}

/// Takes one edge; gives the pulse that it ends.
#[inline]
pub fn step(state: &mut State, edge: Edge) -> Option<Pulse> {
    match (edge.level, state.rise) {
        (Level::Lit, earlier) => {
            if earlier.is_some() {
                state.lost = state.lost.wrapping_add(1);
            }
            state.rise = Some(edge.at);
            None
        }
        (Level::Dark, Some(start)) => {
            state.rise = None;
            Some(Pulse { start, width: edge.at.since(start) })
        }
        (Level::Dark, None) => {
            state.lost = state.lost.wrapping_add(1);
            None
        }
    }
}
