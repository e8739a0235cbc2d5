//! Sightings to frames full of angles.
//!
//! What can go wrong: sweeps become rare; what was gathered does not wait for more than a quarter of a second.

use super::{Seen, Sighting};
use crate::frame::{Angles, Measured};
use crate::time::{Span, Ticks};

/// Sweeps as measured, gathered until they fill a frame: [`Estimate::Angles`](super::Estimate::Angles).
#[derive(Debug, Clone, Default)]
pub struct Batch {
    angles: Angles,
}

impl Batch {
    /// The longest that a sweep waits, in half turns: 0.25 s.
    const PATIENCE: u32 = 30;

    /// Takes one sighting; gives the sweeps when they are a frame full, or one of them has waited long enough.
    pub fn step(&mut self, sighting: &Sighting) -> Option<Angles> {
        let (at, half_turn) = match &sighting.seen {
            Seen::Sweep(sweep) => {
                // Handed over below as soon as it is full, so there is room.
                let _ = self.angles.sweeps.push(Measured::from(sweep));
                (sweep.at, sweep.half_turn)
            }
            Seen::Nothing { at, half_turn } => (*at, *half_turn),
            // What was measured stays true.
            Seen::Lost => return self.hand_over(),
        };
        self.angles.half_turn_q8 = half_turn.ticks_q8();
        let oldest = Ticks(self.angles.sweeps.first()?.time);
        let patience = Span(half_turn.span().0.saturating_mul(Self::PATIENCE));
        if self.angles.sweeps.is_full() || at.since(oldest) > patience { self.hand_over() } else { None }
    }

    fn hand_over(&mut self) -> Option<Angles> {
        if self.angles.sweeps.is_empty() { None } else { Some(core::mem::take(&mut self.angles)) }
    }
}
