//! What the stations say of themselves, out of the flashes of the sightings.
//!
//! What can go wrong: flashes are missed. The time between those that were seen tells how many; the CRC tells whether
//! that was right.

use super::{Flashes, Seen, Sighting};
use crate::sweep::{HalfTurn, Station};
use crate::time::{Span, Ticks};
use crate::{ootx, sweep};

/// What the stations say about themselves, out of the bits of their flashes.
#[derive(Debug, Clone, Default)]
pub struct Ears {
    pub(super) ears: [Ear; 2],
    /// Half turns to go by before the stations are listened to again.
    rest: u16,
}

/// What is heard of one station.
#[derive(Debug, Clone, Default)]
pub(super) struct Ear {
    pub(super) ootx: ootx::State,
    /// The slot of its latest flash.
    at: Option<Ticks>,
    /// Who it said it is, since the cycle was found.
    pub(super) known: Option<Known>,
}

/// A station, as it said itself.
#[derive(Debug, Clone, Copy)]
pub(super) struct Known {
    pub(super) id: u32,
    pub(super) mode: u8,
    pub(super) faults: u8,
}

impl Ears {
    /// Takes one sighting; `told` is given every block that it completes. [`Solver::step`](super::Solver::step) does the
    /// same within.
    pub fn hear(&mut self, config: &ootx::Config, sighting: &Sighting, told: impl FnMut(Station, &ootx::Block)) {
        if sighting.seen == Seen::Lost {
            self.forget();
        } else if !self.rests() {
            self.listen(config, sighting.seen, sighting.flashes, told);
        }
    }

    /// Whether nobody listens in this half turn, one more of which has gone by.
    #[inline]
    pub(super) fn rests(&mut self) -> bool {
        if self.rest == 0 {
            return false;
        }
        self.rest -= 1;
        true
    }

    /// Hands the bits of the flashes to the stations' frames, and takes note of who says what.
    #[inline]
    pub(super) fn listen(
        &mut self,
        config: &ootx::Config,
        seen: Seen,
        flashes: Flashes,
        mut told: impl FnMut(Station, &ootx::Block),
    ) {
        // About when the slot began: where there was no sweep, its end is known, or a little later.
        let (slot, half_turn) = match seen {
            Seen::Sweep(sweep) => (sweep.at.before(sweep.since_sync), sweep.half_turn),
            Seen::Nothing { at, half_turn } => (at.before(half_turn.span()), half_turn),
            Seen::Lost => return,
        };
        for (station, ear) in [Station::A, Station::B].into_iter().zip(&mut self.ears) {
            let Some(bit) = flashes.data(station) else { continue };
            if let Some(block) = ear.hear(config, bit, slot, half_turn) {
                told(station, &block);
            }
        }
        if self.ears.iter().all(|ear| ear.ootx.is_resting()) {
            self.rest = config.rest_bits;
            self.ears.iter_mut().for_each(|ear| {
                ear.ootx.restart();
                ear.at = None;
            });
        }
    }

    /// Whether a station said that it is not who the room's file expects.
    pub(super) fn hear_a_stranger(&self, config: &ootx::Config) -> bool {
        let is_stranger =
            |(station, ear): (Station, &Ear)| ear.known.is_some_and(|known| config.is_stranger(station, known.id));
        [Station::A, Station::B].into_iter().zip(&self.ears).any(is_stranger)
    }

    /// Who flashes may be others, from now on.
    pub(super) fn forget(&mut self) {
        self.rest = 0;
        self.ears.iter_mut().for_each(Ear::forget);
    }
}

impl Ear {
    /// Takes the bit of the flash in the slot that began at `at`; gives the block that it completes.
    fn hear(&mut self, config: &ootx::Config, bit: bool, at: Ticks, half_turn: HalfTurn) -> Option<ootx::Block> {
        // Good to a twentieth of a half turn nearly always, so rounding tells how many slots went by; the CRC, the rest.
        let half_turns = half_turn.span().0;
        let since = self.at.replace(at).map(|before| at.since(before));
        if since.is_none_or(|since| since.0 > half_turns + half_turns / 2) {
            ootx::gap(&mut self.ootx, missed(since, half_turn));
        }
        let Some(ootx::Outcome::Good(block)) = ootx::step(config, &mut self.ootx, bit) else { return None };
        self.known = Some(Known { id: block.id(), mode: block.mode(), faults: block.faults() });
        Some(block)
    }

    fn forget(&mut self) {
        self.ootx.restart();
        self.at = None;
        self.known = None;
    }
}

/// Flashes missed between two that were seen, or ever since; 255 for more.
#[cold]
#[inline(never)]
fn missed(since: Option<Span>, half_turn: HalfTurn) -> u8 {
    let slots = since.map_or(u32::MAX, |since| {
        half_turn.share(since).saturating_add(1 << (sweep::HALF_TURN_BITS - 1)) >> sweep::HALF_TURN_BITS
    });
    u8::try_from(slots.saturating_sub(1)).unwrap_or(u8::MAX)
}
