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
//! by up to 10 us. The place in the cycle is found from the two flashes of a slot against each other: only one of them
//! has the long skip bit. It gives axis and skip, so that the width has only the data bit to tell, and the receiver's
//! bias, which is learnt on the way.
//!
//! No clock rate is assumed anywhere. The search looks for two pairs of flashes whose distance is 18.3 to 24.2 times
//! their inner gap; that distance is the half turn, and every later window is a share of it.
//!
//! ```
//! use lighthouse_mote::pulse::Pulse;
//! use lighthouse_mote::sweep::{self, Axis, Config, Light, State, Station};
//! use lighthouse_mote::time::{Span, Ticks};
//!
//! // A third of a second on a clock of 10 MHz, which nobody tells the mote; both lasers pass straight ahead, for 10 us.
//! let pulse = |start, width| Pulse { start: Ticks(start), width: Span(width) };
//! let (mut state, mut sweeps) = (State::default(), Vec::new());
//! for slot in 0..40 {
//!     let (a, b) = (slot * 83_333, slot * 83_333 + 4_167);
//!     let axis = 104 * (slot & 1);
//!     let (skip_a, skip_b, sweeper) = if slot & 2 == 0 { (417, 0, b) } else { (0, 417, a) };
//!     let flashes = [pulse(a, 625 + axis + skip_a), pulse(b, 625 + axis + skip_b)];
//!     for pulse in flashes.into_iter().chain([pulse(sweeper + 41_667 - 50, 100)]) {
//!         if let Some(Light::Sweep(sweep)) = sweep::step(&Config::DEFAULT, &mut state, pulse) {
//!             sweeps.push(sweep);
//!         }
//!     }
//! }
//! let last = sweeps.last().expect("light enough");
//! assert_eq!((last.station, last.axis), (Station::A, Axis::Elevation));
//! assert!(last.since_sync.0.abs_diff(41_667) <= 1 && last.half_turn.span().0.abs_diff(83_333) <= 1);
//! assert_eq!((sweeps.len(), state.counts().turned_away), (32, 8), "found in slot 2, sure of its place in slot 8");
//! ```
//!
//! What can go wrong: flashes are lost (the cycle goes on by dead reckoning, up to [`COAST_HALF_TURNS`]),
//! something shines between (it fits no window and is counted; of several like
//! a sweep the longest is taken, when the slot ends), the light goes (the lock is given up and says so).

mod half_turn;
mod lock;
mod search;
mod width;

pub use half_turn::{HALF_TURN_BITS, HalfTurn};

use lock::{Lock, Phase};
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

/// What a slot without a sweep at once turns out to be when it ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Closed {
    /// There were several pulses that could have been the sweep, or one where none was expected: this is the best.
    Sweep(Sweep),
    /// There was none. The half turn as measured up to now.
    Dark(HalfTurn),
}

/// Whether light is understood, and why not. The numbers travel in health frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Status {
    /// No pulse for the longest four half turns that a clock can see, 2^22 ticks.
    #[default]
    NoLight = 0,
    /// There is light that may be a cycle, but not yet enough of it.
    Searching = 1,
    /// The cycle is known.
    Locked = 2,
    /// One flash per slot, with skips: one station of a pair, and nothing says which. See [`Config::lone`].
    OneStation = 3,
    /// Flashes of two stations that are not 350 to 450 us apart.
    Spacing = 4,
    /// Pulses that are too long for each other's distance to be flashes or sweeps.
    Widths = 5,
    /// Only pulses that are too short for each other's distance to be flashes: Lighthouse V2, which has none.
    V2 = 6,
}

/// How many half turns the cycle is carried on without any flash: 0.4 s.
pub const COAST_HALF_TURNS: u32 = 48;

/// What the light alone does not tell, and what depends on the receiver.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Config {
    /// Who flashes, if only one of a pair of stations is seen from the start.
    pub lone: Option<Station>,
    /// The shortest sweep pulse, in units of 1/8192 half turn (1.02 us), up to 64. Real ones last 1.5 to 20 us.
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
    /// Both stations are seen, by a receiver with two good edges.
    pub const DEFAULT: Self = Self { lone: None, shortest_sweep: 1, stamp: Stamp::Middle };
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
    /// Flashes understood, by [`Station`].
    pub syncs: [u16; 2],
    /// Sweeps understood, by [`Station`] and [`Axis`].
    pub sweeps: [[u16; 2]; 2],
    /// Pulses that fit no window, and all pulses while there is no cycle.
    pub strays: u16,
    /// Pulses where a sweep could be, shorter than 1 us.
    pub too_short: u16,
    /// The same, longer than 41.7 us.
    pub too_long: u16,
    /// Pulses like a sweep in a slot that has a better one.
    pub seconds: u16,
    /// Pulses where a flash could be, that rise or fall at the wrong time.
    pub misfits: u16,
    /// Times the cycle was lost.
    pub locks_lost: u16,
    /// All pulses turned away: the five causes together.
    pub turned_away: u16,
}

/// Why a pulse was turned away.
#[derive(Debug, Clone, Copy)]
enum Cause {
    Stray,
    Short,
    Long,
    Second,
    Misfit,
}

/// Pulses turned away, each cause and all.
#[derive(Debug, Clone, Default)]
struct Rejects {
    causes: [u16; 5],
    all: u16,
}

impl Rejects {
    #[cold]
    #[inline(never)]
    fn turn_away(&mut self, cause: Cause) {
        let count = &mut self.causes[cause as usize];
        *count = count.wrapping_add(1);
        self.all = self.all.wrapping_add(1);
    }
}

/// Where in the light the mote is.
#[derive(Debug, Clone, Default)]
#[repr(C)]
pub struct State {
    lock: Lock,
    rejects: Rejects,
    locks_lost: u16,
    search: Search,
}

impl State {
    /// What was counted so far.
    #[must_use]
    #[inline]
    pub fn counts(&self) -> Counts {
        let [strays, too_short, too_long, seconds, misfits] = self.rejects.causes;
        Counts {
            syncs: self.lock.syncs(),
            sweeps: self.lock.sweeps(),
            strays,
            too_short,
            too_long,
            seconds,
            misfits,
            locks_lost: self.locks_lost,
            turned_away: self.rejects.all,
        }
    }

    /// Whether [`Self::closed`] has something to say.
    #[must_use]
    #[inline(always)]
    pub fn has_closed(&self) -> bool {
        self.lock.has_closed()
    }

    /// What the slot that ended last gave, if its sweep was not said at once; said once per slot.
    ///
    /// To be asked after every [`step`] that gave no sweep, and after [`expire`].
    #[inline]
    pub fn closed(&mut self) -> Option<Closed> {
        self.lock.take_closed()
    }

    /// The measured half turn, while the cycle is locked.
    #[must_use]
    pub fn half_turn(&self) -> Option<HalfTurn> {
        (self.lock.phase != Phase::Dark).then_some(self.lock.half_turn)
    }

    /// By how much the receiver lengthens the flashes of `station`, in 2^-20 half turns (7.9 ns). Outlives the lock; `None`
    /// before the first.
    #[must_use]
    pub fn width_bias(&self, station: Station) -> Option<i16> {
        self.lock.width_bias(station)
    }

    /// Why there is no lock, or that there is one. `now` is later than every pulse.
    #[must_use]
    pub fn status(&self, now: Ticks) -> Status {
        match (self.lock.phase, self.search.status(now)) {
            (Phase::Locked | Phase::Placed, _) => Status::Locked,
            (_, Status::Spacing) => Status::Spacing,
            (Phase::Nameless, _) => Status::OneStation,
            (Phase::Pair | Phase::Train, _) => Status::Searching,
            (Phase::Dark, status) => status,
        }
    }

    /// Says who flashes while the status is [`Status::OneStation`]; nothing otherwise. Sweeps follow from then on.
    pub fn name(&mut self, station: Station) {
        self.lock.name(station);
    }
}

/// Takes one pulse; says what it was, if anything.
#[inline]
pub fn step(config: &Config, state: &mut State, pulse: Pulse) -> Option<Light> {
    step_then(config, state, pulse, Say)
}

/// What a pulse turns out to be, and what comes of it: in each case by itself, so that none pays for what the others would
/// say. Methods, for those can be told to be inlined wherever they are called, and closures not.
pub(crate) trait Then: Sized {
    type Out;
    fn flash(self, state: &mut State, sync: Sync) -> Self::Out;
    fn laser(self, state: &mut State, sweep: Sweep) -> Self::Out;
    fn nothing(self, state: &mut State) -> Self::Out;
    fn lost(self, state: &mut State) -> Self::Out;
}

/// Just says it.
struct Say;

impl Then for Say {
    type Out = Option<Light>;

    fn flash(self, _: &mut State, sync: Sync) -> Option<Light> {
        Some(Light::Sync(sync))
    }

    fn laser(self, _: &mut State, sweep: Sweep) -> Option<Light> {
        Some(Light::Sweep(sweep))
    }

    fn nothing(self, _: &mut State) -> Option<Light> {
        None
    }

    fn lost(self, _: &mut State) -> Option<Light> {
        Some(Light::Lost)
    }
}

/// The same, and goes on with `then`.
#[inline(always)]
pub(crate) fn step_then<T: Then>(config: &Config, state: &mut State, pulse: Pulse, then: T) -> T::Out {
    let lock = &mut state.lock;
    let mut is_over = false;
    if lock.phase != Phase::Dark {
        if lock.follow(pulse.start) {
            match lock.flash_at(pulse.start) {
                Some((station, rise)) => {
                    if let Some(data) = lock.flash(config, &mut state.rejects, station, rise, pulse.width.0) {
                        let sync = lock.sync(station, data);
                        return then.flash(state, sync);
                    }
                }
                None => {
                    if let Some(sweep) = lock.laser(config, &mut state.rejects, pulse) {
                        return then.laser(state, sweep);
                    }
                }
            }
            if !lock.is_doubtful() {
                return then.nothing(state);
            }
        } else {
            is_over = true;
        }
    }
    if state.is_lost_by(pulse, is_over) { then.lost(state) } else { then.nothing(state) }
}

/// Says whether the light has been gone too long, where no pulse comes to say so; `now` is later than every pulse.
///
/// To be called at least once per quarter wrap of the counter: a darkness of a whole wrap must not look short.
#[inline]
pub fn expire(state: &mut State, now: Ticks) -> Option<Light> {
    if state.lock.phase == Phase::Dark {
        state.search.expire(now);
        return None;
    }
    if state.lock.follow(now) {
        return None;
    }
    state.give_up().then_some(Light::Lost)
}

impl State {
    /// Looks for a cycle, or for a better one; whether the one that was known is lost.
    #[cold]
    #[inline(never)]
    fn is_lost_by(&mut self, pulse: Pulse, is_over: bool) -> bool {
        let mut is_lost = is_over && self.give_up();
        let is_dark = self.lock.phase == Phase::Dark;
        if is_dark {
            self.rejects.turn_away(Cause::Stray);
        }
        if let Some(found) = self.search.step(pulse, is_dark) {
            is_lost |= self.give_up();
            self.lock.start(&self.search, &found);
        }
        is_lost
    }

    /// Whoever knew where the lasers were is told that the cycle is gone.
    #[inline(never)]
    fn give_up(&mut self) -> bool {
        let was_locked = self.lock.phase >= Phase::Placed;
        self.lock.end();
        self.search.clear();
        self.locks_lost = self.locks_lost.wrapping_add(u16::from(was_locked));
        was_locked
    }
}
