//! Sweep time to angle: the ratio to the measured half turn, plus the rotor's factory terms.
//!
//! A rotor turns 180 degrees per half turn, so `time since sync / half turn` is the angle whatever the rate of the
//! mote's clock: the lighthouse is the crystal.
//!
//! The factory terms are those of the room's file, or, where it asks for that, those that the station itself sends; until
//! they have come the file's are used ([`Factory`]).
//!
//! ```
//! use lighthouse_mote::angle::{self, Config, FIELD_OF_VIEW, State};
//! use lighthouse_mote::sweep::{Axis, HalfTurn, Station, Sweep};
//! use lighthouse_mote::time::{Span, Ticks};
//!
//! // The same direction, 45 degrees, on a clock of 10 MHz and on one that is 20 % slow.
//! let mut state = State::default();
//! for half_turn_ticks in [83_332, 66_668] {
//!     let sweep = Sweep {
//!         station: Station::A,
//!         axis: Axis::Azimuth,
//!         at: Ticks(7),
//!         since_sync: Span(half_turn_ticks / 4 * 3),
//!         half_turn: HalfTurn::from_ticks_q8(half_turn_ticks << 8).expect("a clock that the arithmetic holds"),
//!     };
//!     let bearing = angle::step(&Config::default(), &mut state, sweep).expect("in view");
//!     assert!(bearing.angle.0.abs_diff(FIELD_OF_VIEW / 4 * 3) <= 2);
//!     // 67.5 degrees to the side no station shines.
//!     let beyond = Sweep { since_sync: Span(half_turn_ticks / 8 * 7), ..sweep };
//!     assert_eq!(angle::step(&Config::default(), &mut state, beyond), None);
//! }
//! assert_eq!(state.outside(), 2);
//! ```
//!
//! What can go wrong: a pulse that was no sweep gives an angle outside the rotor's field of view; it is rejected here.
//! A station that sends terms beyond anything seen is not believed ([`received`]).

mod factory;

pub use factory::Rotor;

use crate::ootx::Block;
use crate::sweep::{Axis, HALF_TURN_BITS, HalfTurn, Station, Sweep};
use crate::time::Ticks;

/// The field of view of a Lighthouse V1 rotor to either side of straight ahead: 60 degrees, in [`Angle`] units.
///
/// Source: the stations light 120 degrees; on the 2020 recording, rows beyond it are reflections.
pub const FIELD_OF_VIEW: i32 = (1 << HALF_TURN_BITS) / 3;

/// A rotor angle: 2^20 units per half turn (180 degrees), zero straight ahead, factory phase included.
///
/// One unit is 3.0 urad. tan(azimuth) = c.x / c.z and tan(elevation) = c.y / c.z in the station's frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Angle(pub i32);

/// The factory terms of every rotor, `[station][axis]`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Config {
    rotors: [[Rotor; 2]; 2],
    /// No rotor has a term but its phase, which saves looking at each sweep's.
    phase_only: bool,
    /// The stations whose own terms count once they have come.
    received: [bool; 2],
}

/// Whose factory terms are in use for a station.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Factory {
    /// Those of the room's file, as it wants it.
    #[default]
    File = 0,
    /// Those of the room's file, until the station's own have come.
    Awaited = 1,
    /// The station's own.
    Received = 2,
}

impl Config {
    /// `rotors` indexed by [`Station`] and [`Axis`].
    #[must_use]
    pub const fn new(rotors: [[Rotor; 2]; 2]) -> Self {
        let [[az_a, el_a], [az_b, el_b]] = &rotors;
        let phase_only = az_a.is_phase() && el_a.is_phase() && az_b.is_phase() && el_b.is_phase();
        Self { rotors, phase_only, received: [false; 2] }
    }

    /// The same, but that the stations marked are asked for their own terms, A and B.
    #[must_use]
    pub const fn with_received(self, stations: [bool; 2]) -> Self {
        Self { received: stations, ..self }
    }

    /// Whether any station is asked for its own terms.
    #[must_use]
    #[inline(always)]
    pub const fn asks(&self) -> bool {
        let [a, b] = self.received;
        a || b
    }
}

/// The newest angle of every rotor, and how many sweeps were turned away.
#[derive(Debug, Clone, Default)]
pub struct State {
    outside: u16,
    newest: [[i32; 2]; 2],
    received: [Option<[Rotor; 2]>; 2],
}

impl State {
    /// Sweeps outside the field of view since start-up, wrapping.
    #[must_use]
    pub const fn outside(&self) -> u16 {
        self.outside
    }

    /// Whose factory terms are in use for `station`.
    #[must_use]
    pub const fn factory(&self, config: &Config, station: Station) -> Factory {
        match (config.received[station as usize], &self.received[station as usize]) {
            (false, _) => Factory::File,
            (true, None) => Factory::Awaited,
            (true, Some(_)) => Factory::Received,
        }
    }
}

/// The azimuth and the elevation rotor as their station describes them; `None` where a term is beyond what any station
/// has, or no number.
#[must_use]
pub fn received(block: &Block) -> Option<[Rotor; 2]> {
    let azimuth = Rotor::received(&block.terms(Axis::Azimuth))?;
    let elevation = Rotor::received(&block.terms(Axis::Elevation))?;
    Some([azimuth, elevation])
}

/// From now on these are the rotors of `station`, if it is asked for its own terms at all.
#[inline]
pub fn receive(config: &Config, state: &mut State, station: Station, rotors: [Rotor; 2]) {
    if config.received[station as usize] {
        state.received[station as usize] = Some(rotors);
    }
}

/// One angle of one rotor, and when it was seen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Bearing {
    /// Whose rotor.
    pub station: Station,
    /// Which rotor.
    pub axis: Axis,
    /// The ideal angle.
    pub angle: Angle,
    /// When the laser passed.
    pub at: Ticks,
    /// The half turn at that time: the unit of every age.
    pub half_turn: HalfTurn,
}

/// Turns one sweep into a bearing; `None` outside the field of view.
#[inline]
pub fn step(config: &Config, state: &mut State, sweep: Sweep) -> Option<Bearing> {
    // A share beyond 2^31 turns negative here, and stays outside the field of view.
    let measured = (sweep.half_turn.share(sweep.since_sync) as i32).wrapping_sub(1 << (HALF_TURN_BITS - 1));
    let (station, axis) = (sweep.station as usize, sweep.axis as usize);
    let received = if config.received[station] { state.received[station].as_ref() } else { None };
    let rotor = &received.unwrap_or(&config.rotors[station])[axis];
    let phase_only = config.phase_only && config.received == [false; 2];
    let ideal = if phase_only {
        measured.wrapping_add(rotor.phase)
    } else {
        factory::ideal(rotor, measured, state.newest[station][1 - axis])
    };
    if !(-FIELD_OF_VIEW..=FIELD_OF_VIEW).contains(&ideal) {
        state.outside = state.outside.wrapping_add(1);
        return None;
    }
    if !phase_only {
        state.newest[station][axis] = ideal;
    }
    Some(Bearing {
        station: sweep.station,
        axis: sweep.axis,
        angle: Angle(ideal),
        at: sweep.at,
        half_turn: sweep.half_turn,
    })
}
