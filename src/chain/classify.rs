//! The first half: edges to sightings.
//!
//! What can go wrong: a flash ends a slot whose sweep was kept back. What that slot had is told then, with its own flashes.

use super::Config;
use crate::edge::Edge;
use crate::sweep::{Closed, HalfTurn, Station, Status, Sweep, Sync};
use crate::time::Ticks;
use crate::{pulse, sweep};

/// What the solving half needs to hear of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Sighting {
    /// What was seen.
    pub seen: Seen,
    /// The flashes of that half turn.
    pub flashes: Flashes,
    /// Pulses that were turned away so far, wrapping.
    pub pulses_lost: u16,
}

/// A laser, the lack of one, or the end of the cycle.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Seen {
    /// A laser passed.
    Sweep(Sweep),
    /// A half turn without a laser; the cycle goes on.
    Nothing {
        /// When that was clear.
        at: Ticks,
        /// The half turn as measured last.
        half_turn: HalfTurn,
    },
    /// The cycle was lost: every angle known so far is of an unknown age.
    Lost,
}

/// The flashes of one half turn, and the bit that each carries.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Flashes(
    /// Bits 0 and 1: A was seen, and its data bit; 2 and 3: the same of B.
    u8,
);

impl Flashes {
    #[inline]
    fn with(self, sync: Sync) -> Self {
        Self(self.0 | (1 | u8::from(sync.data) << 1) << (2 * sync.station as u32))
    }

    #[inline]
    fn take(&mut self) -> Self {
        core::mem::take(self)
    }

    /// The data bit of a station, if its flash was seen.
    pub(super) fn data(self, station: Station) -> Option<bool> {
        let bits = self.0 >> (2 * station as u32);
        (bits & 1 != 0).then_some(bits & 2 != 0)
    }
}

/// Who wants to hear of sightings.
pub trait Listener {
    /// Of a sweep that was told at once, as nearly all are; `sighting` makes its sighting.
    fn hear(&mut self, sighting: impl Fn() -> Sighting);

    /// Of anything else.
    fn hear_rarely(&mut self, sighting: &Sighting);
}

impl Listener for Option<Sighting> {
    fn hear(&mut self, sighting: impl Fn() -> Sighting) {
        *self = Some(sighting());
    }

    fn hear_rarely(&mut self, sighting: &Sighting) {
        *self = Some(*sighting);
    }
}

/// What a pulse led to.
enum Heard {
    Nothing,
    /// A sweep, of which was told.
    Told,
    /// The end of a slot with these flashes.
    Late(Flashes),
    /// The end of the cycle, in a slot with these.
    Lost(Flashes),
}

/// Tells who listens of a sweep; of what is rarer, whoever asked.
struct Tell<'a, L> {
    flashes: &'a mut Flashes,
    listener: &'a mut L,
}

impl<L: Listener> sweep::Then for Tell<'_, L> {
    type Out = Heard;

    #[inline(always)]
    fn laser(self, sweeps: &mut sweep::State, sweep: Sweep) -> Heard {
        let flashes = self.flashes.take();
        self.listener.hear(|| sighting(sweeps, Seen::Sweep(sweep), flashes));
        Heard::Told
    }

    #[inline(always)]
    fn flash(self, sweeps: &mut sweep::State, sync: Sync) -> Heard {
        let before = *self.flashes;
        *self.flashes = before.with(sync);
        if !sweeps.has_closed() {
            return Heard::Nothing;
        }
        // The slot that this flash ends had its own.
        *self.flashes = Flashes::default().with(sync);
        Heard::Late(before)
    }

    #[inline(always)]
    fn nothing(self, sweeps: &mut sweep::State) -> Heard {
        if sweeps.has_closed() { Heard::Late(self.flashes.take()) } else { Heard::Nothing }
    }

    #[inline(always)]
    fn lost(self, _: &mut sweep::State) -> Heard {
        Heard::Lost(self.flashes.take())
    }
}

/// What the first half knows of itself, for [`Solver::health`](super::Solver::health).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Understood {
    pub(super) status: Status,
    pub(super) half_turn_q8: u32,
    pub(super) counts: sweep::Counts,
    pub(super) width_bias: [Option<i16>; 2],
    pub(super) edges_lost: u16,
}

impl Understood {
    /// Whether the cycle is known, and so reports are to be expected.
    #[must_use]
    pub const fn is_locked(&self) -> bool {
        matches!(self.status, Status::Locked)
    }
}

/// The first half: edges to sightings.
#[derive(Debug, Clone, Default)]
pub struct Classifier {
    pub(super) pulse: pulse::State,
    sweep: sweep::State,
    flashes: Flashes,
}

impl Classifier {
    /// Takes one edge.
    #[inline]
    pub fn step(&mut self, config: &Config, edge: Edge) -> Option<Sighting> {
        let pulse = pulse::step(&mut self.pulse, edge)?;
        self.pulse(config, pulse)
    }

    /// Takes one pulse, where a board's capture already pairs the edges.
    #[inline]
    pub fn pulse(&mut self, config: &Config, pulse: pulse::Pulse) -> Option<Sighting> {
        let mut told = None;
        self.pulse_to(config, pulse, &mut told);
        told
    }

    /// The same for who is waiting for its sighting; whether there was one.
    #[inline(always)]
    pub fn pulse_to(&mut self, config: &Config, pulse: pulse::Pulse, listener: &mut impl Listener) -> bool {
        let Self { sweep: sweeps, flashes, .. } = self;
        let sighting = match sweep::step_then(&config.sweep, sweeps, pulse, Tell { flashes, listener }) {
            Heard::Nothing => return false,
            Heard::Told => return true,
            Heard::Late(flashes) => late(sweeps, pulse.start, flashes),
            Heard::Lost(flashes) => lost(sweeps, flashes),
        };
        if let Some(sighting) = &sighting {
            listener.hear_rarely(sighting);
        }
        sighting.is_some()
    }

    /// Notices that no light comes; to be called at least once per quarter wrap of the counter, and as often as
    /// reports shall go on in the dark. `now` is later than every edge.
    pub fn expire(&mut self, now: Ticks) -> Option<Sighting> {
        if sweep::expire(&mut self.sweep, now).is_some() {
            return lost(&self.sweep, self.flashes.take());
        }
        // Where no slot has ended, its flashes are yet to be told of.
        if self.sweep.has_closed() { late(&mut self.sweep, now, self.flashes.take()) } else { None }
    }

    /// How often each kind of light was understood.
    #[must_use]
    pub fn counts(&self) -> sweep::Counts {
        self.sweep.counts()
    }

    /// The measured half turn, while the cycle is locked.
    #[must_use]
    pub fn half_turn(&self) -> Option<HalfTurn> {
        self.sweep.half_turn()
    }

    /// What is known by `now`, which is later than every pulse.
    #[must_use]
    #[inline(never)]
    pub fn understood(&self, now: Ticks) -> Understood {
        Understood {
            status: self.sweep.status(now),
            half_turn_q8: self.half_turn().map_or(0, HalfTurn::ticks_q8),
            counts: self.sweep.counts(),
            width_bias: [self.sweep.width_bias(Station::A), self.sweep.width_bias(Station::B)],
            edges_lost: self.pulse.lost(),
        }
    }
}

#[inline(always)]
fn sighting(sweeps: &sweep::State, seen: Seen, flashes: Flashes) -> Sighting {
    Sighting { seen, flashes, pulses_lost: sweeps.counts().turned_away }
}

/// What the slot that has just ended has left to say.
#[cold]
#[inline(never)]
fn late(sweeps: &mut sweep::State, at: Ticks, flashes: Flashes) -> Option<Sighting> {
    let seen = match sweeps.closed()? {
        Closed::Sweep(sweep) => Seen::Sweep(sweep),
        Closed::Dark(half_turn) => Seen::Nothing { at, half_turn },
    };
    Some(sighting(sweeps, seen, flashes))
}

#[cold]
#[inline(never)]
fn lost(sweeps: &sweep::State, flashes: Flashes) -> Option<Sighting> {
    Some(sighting(sweeps, Seen::Lost, flashes))
}
