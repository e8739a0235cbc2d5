//! Pulses to sync flashes and laser sweeps of two synchronised stations.
//!
//! Every 33.3 ms cycle has four slots of one half turn each. In a slot station A flashes first and station B
//! 417 us later; the one whose flash does not say *skip* then sweeps, about its azimuth in even slots and its
//! elevation in odd ones (the 2020 paper, Fig. 3):
//!
//! ```text
//! slot      0            1            2            3
//! A    skip az      skip el           az           el
//! B         az           el      skip az      skip el
//! sweep   B az         B el         A az         A el
//! ```
//!
//! A flash lasts 62.5 us + 10.4 (axis) + 20.8 (data) + 41.7 (skip). Receivers shorten or lengthen every flash alike,
//! by up to 10 us, so the absolute width tells less than the two flashes of a slot against each other: only one of
//! them has the long skip bit. The axis follows from the place in the cycle.
//!
//! No clock rate is assumed anywhere. The search looks for two pairs of flashes whose distance is 18 to 24 times
//! their inner gap; that distance is the half turn, and every later window is a share of it.
//!
//! What can go wrong: flashes are lost (the cycle goes on by dead reckoning, up to [`Config::coast_half_turns`]),
//! something shines between (it fits no window and is counted), the light goes (the lock is given up and says so).

mod half_turn;
mod lock;
mod search;
mod width;

pub use half_turn::{HALF_TURN_BITS, HalfTurn};
pub use width::nearest_width;

use lock::Lock;
use search::Search;

use crate::pulse::Pulse;
use crate::time::{Span, Ticks};

/// Which of the two synchronised stations: A flashes first in every slot.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Station {
    /// The first flash of each slot.
    A = 0,
    /// The second.
    B = 1,
}

/// Which rotor of a station.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Axis {
    /// Sweeps left to right: tan = c.x / c.z.
    Azimuth = 0,
    /// Sweeps bottom to top: tan = c.y / c.z.
    Elevation = 1,
}

/// A flash that was understood.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Sync {
    /// Who flashed.
    pub station: Station,
    /// Whose turn it is.
    pub axis: Axis,
    /// This station does not sweep in this slot.
    pub skip: bool,
    /// One bit of the station's own calibration frame.
    pub data: bool,
}

/// A laser plane that passed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Sweep {
    /// Whose laser.
    pub station: Station,
    /// Which rotor.
    pub axis: Axis,
    /// When it passed.
    pub at: Ticks,
    /// How long after the rise of that station's own flash.
    pub since_sync: Span,
    /// The half turn as measured up to now.
    pub half_turn: HalfTurn,
}

/// What a pulse, or its absence, turned out to be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Light {
    /// A flash.
    Sync(Sync),
    /// A sweep.
    Sweep(Sweep),
    /// The cycle was lost: every angle known so far is of an unknown age.
    Lost,
}

/// The tolerances, all as shares of the half turn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Config {
    /// How far from its predicted place a flash may rise: half turn >> this. 7 is 65 us.
    pub window_shift: u32,
    /// How many half turns the cycle is carried on without any flash. 48 is 0.4 s.
    pub coast_half_turns: u16,
    /// The shortest sweep pulse, in units of 1/8192 half turn (1.02 us). Real ones last 1.5 to 20 us.
    pub shortest_sweep: u32,
    /// Which moment of a laser's pulse is the sweep.
    pub stamp: Stamp,
}

/// The moment of a laser's pulse that counts as the sweep.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Stamp {
    /// Half way between both edges: where the middle of the laser line was, whatever its width.
    #[default]
    Middle,
    /// The rise, for receivers with one good edge.
    Rise,
}

impl Config {
    /// The values named in the field documentation.
    pub const DEFAULT: Self = Self { window_shift: 7, coast_half_turns: 48, shortest_sweep: 1, stamp: Stamp::Middle };
}

impl Default for Config {
    fn default() -> Self {
        Self::DEFAULT
    }
}

/// How often each thing was understood or turned away, since start-up, wrapping.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Counts {
    /// Flashes understood.
    pub syncs: u16,
    /// Sweeps understood.
    pub sweeps: u16,
    /// Pulses that fit no window.
    pub strays: u16,
    /// Times the cycle was lost.
    pub locks_lost: u16,
}

/// Where in the light the mote is.
#[derive(Debug, Clone, Default)]
pub struct State {
    search: Search,
    lock: Option<Lock>,
    counts: Counts,
}

impl State {
    /// What was counted so far.
    #[must_use]
    pub const fn counts(&self) -> Counts {
        self.counts
    }

    /// The half turn, if the latest slot was left without a sweep; said once per slot.
    #[inline]
    pub fn dark_slot(&mut self) -> Option<HalfTurn> {
        let lock = self.lock.as_mut()?;
        lock.take_dark().then_some(lock.half_turn)
    }

    /// The measured half turn, while the cycle is locked.
    #[must_use]
    pub fn half_turn(&self) -> Option<HalfTurn> {
        self.lock.as_ref().map(|lock| lock.half_turn)
    }
}

/// Takes one pulse; says what it was, if anything.
#[inline]
pub fn step(config: &Config, state: &mut State, pulse: Pulse) -> Option<Light> {
    if let Some(lock) = &mut state.lock {
        if lock.follow(config, pulse.start) {
            let light = lock.place(config, pulse);
            match light {
                Some(Light::Sync(_)) => state.counts.syncs = state.counts.syncs.wrapping_add(1),
                Some(Light::Sweep(_)) => state.counts.sweeps = state.counts.sweeps.wrapping_add(1),
                _ => state.counts.strays = state.counts.strays.wrapping_add(1),
            }
            return light;
        }
        state.give_up();
        state.lock = state.search.step(pulse);
        return Some(Light::Lost);
    }
    state.lock = state.search.step(pulse);
    None
}

/// Says whether the light has been gone too long, where no pulse comes to say so; `now` is later than every pulse.
///
/// To be called at least once per quarter wrap of the counter: a darkness of a whole wrap must not look short.
#[inline]
pub fn expire(config: &Config, state: &mut State, now: Ticks) -> Option<Light> {
    let lock = state.lock.as_mut()?;
    if lock.follow(config, now) {
        return None;
    }
    state.give_up();
    Some(Light::Lost)
}

impl State {
    fn give_up(&mut self) {
        self.lock = None;
        self.search = Search::default();
        self.counts.locks_lost = self.counts.locks_lost.wrapping_add(1);
    }
}
