//! Four angles to one position: the direct linear transform (DLT) of the paper, solved in integers.
//!
//! Two stations see the mote along two rays. Their projection matrices P = [R | -R t] give four linear equations
//! for the three coordinates; the answer is the inhomogeneous least-squares one. A Cortex-M0 has a 32-bit multiplier
//! and nothing else, so everything about the room is worked out before, by `calib/quantise.rs`, and arrives here as
//! a [`Calib`]: a plain value, meant to be a `const`, so that the compiler folds its numbers and shifts into the code.
//!
//! ```
//! use lighthouse_mote::angle::{Angle, Bearing};
//! use lighthouse_mote::fix::{self, State};
//! use lighthouse_mote::sweep::{Axis, HalfTurn, Station};
//! use lighthouse_mote::time::Ticks;
//!
//! mod room {
//!     // What build.rs made of calib/default.toml.
//!     include!(concat!(env!("OUT_DIR"), "/calib.rs"));
//! }
//!
//! // Where the stations see 0.5, 1.0, 0.5 m, one rotor after another.
//! let half_turn = HalfTurn::from_ticks_q8(83_333 << 8).expect("10 MHz");
//! let seen = [
//!     (Station::B, Axis::Azimuth, 102_300),
//!     (Station::B, Axis::Elevation, -14_620),
//!     (Station::A, Axis::Azimuth, -70_542),
//!     (Station::A, Axis::Elevation, 21_162),
//! ];
//! let mut state = State::default();
//! let fixes: Vec<fix::Fix> = (0..).zip(seen).filter_map(|(slot, (station, axis, angle))| {
//!     let bearing = Bearing { station, axis, angle: Angle(angle), at: Ticks(slot * 83_333), half_turn };
//!     fix::step(&room::CONFIG.fix, &mut state, bearing)
//! }).collect();
//! let [fix] = fixes[..] else { panic!("the fourth angle gives the fix") };
//! // Within 0.3 mm: 20 of 2^-16 m.
//! let error = |axis: usize, truth: i32| fix.position[axis].abs_diff(truth);
//! assert!(error(0, 1 << 15) <= 20 && error(1, 1 << 16) <= 20 && error(2, 1 << 15) <= 20, "{fix:?}");
//! assert_eq!(fix.age.0, 3 * 83_333);
//! ```
//!
//! What can go wrong: an angle is too old (the mote has moved since), the rays pass each other too far (one of them is
//! a reflection), they are too close to parallel. Each means no fix, never a stale or a wild one; each is counted.

mod fast;
mod general;
mod layout;
mod reciprocal;
mod solve;
mod tan;
mod walk;

pub use crate::angle::Angle;
pub use layout::{Calib, Fast, General, HALF, LEAST, Linear, Lines, Reject, Row, Scene, Solution, WEIGHTS, Weight};
pub use solve::solve;
pub use tan::tan;

use crate::angle::Bearing;
use crate::sweep::HalfTurn;
use crate::time::{Span, Ticks};

/// The room and the age rule.
#[derive(Debug, Clone)]
pub struct Config {
    /// The room.
    pub calib: Calib,
    /// The oldest an angle may be, in half turns; 12 is 100 ms.
    pub max_age_half_turns: u16,
}

impl Config {
    fn max_age(&self, half_turn: HalfTurn) -> u32 {
        half_turn.span().0.saturating_mul(u32::from(self.max_age_half_turns))
    }
}

/// The newest angle of each rotor, and what was refused.
#[derive(Debug, Clone, Default)]
pub struct State {
    /// Indexed az A, el A, az B, el B.
    newest: [Option<(Angle, Ticks)>; 4],
    refused: Refused,
}

/// Fixes refused since start-up, wrapping.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Refused {
    /// The rays were too close to parallel, met outside the room, or an angle was out of view.
    pub geometry: u16,
    /// The rays missed each other.
    pub mismatch: u16,
}

/// A position and how good it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Fix {
    /// World x, y, z in metres, Q16.
    pub position: [i32; 3],
    /// How far the two rays pass each other, in metres, Q16.
    pub mismatch: i32,
    /// When its newest angle was seen.
    pub at: Ticks,
    /// How much older its oldest angle is.
    pub age: Span,
    /// The half turn at that time.
    pub half_turn: HalfTurn,
}

impl State {
    /// Fixes refused since start-up.
    #[must_use]
    pub const fn refused(&self) -> Refused {
        self.refused
    }

    /// How much older than `now` the oldest of the four angles is; the longest span where one is missing.
    #[must_use]
    pub fn age(&self, now: Ticks) -> Span {
        let ages = self.newest.iter().map(|newest| newest.map_or(Span(u32::MAX), |(_, at)| now.since(at)));
        ages.fold(Span(0), Span::max)
    }

    /// Which stations gave an angle that is not too old at `now`: bit 0 A, bit 1 B.
    #[must_use]
    pub fn stations(&self, config: &Config, now: Ticks, half_turn: HalfTurn) -> u8 {
        let oldest = config.max_age(half_turn);
        let mut seen = 0;
        for (bit, angles) in [1, 2].into_iter().zip(self.newest.chunks_exact(2)) {
            if angles.iter().flatten().any(|(_, at)| now.since(*at).0 <= oldest) {
                seen |= bit;
            }
        }
        seen
    }

    /// Drops every angle: their ages are no longer known.
    pub fn forget(&mut self) {
        self.newest = [None; 4];
    }
}

/// Takes one bearing; gives the fix that it completes.
#[inline]
pub fn step(config: &Config, state: &mut State, bearing: Bearing) -> Option<Fix> {
    note(state, bearing);
    newest(config, state, bearing.at, bearing.half_turn)
}

/// Remembers one bearing without solving anything.
#[inline]
pub fn note(state: &mut State, bearing: Bearing) {
    if let Some(slot) = state.newest.get_mut(2 * bearing.station as usize + bearing.axis as usize) {
        *slot = Some((bearing.angle, bearing.at));
    }
}

/// The fix from the newest angle of each rotor, if none is too old at `now`.
#[inline]
pub fn newest(config: &Config, state: &mut State, now: Ticks, half_turn: HalfTurn) -> Option<Fix> {
    let [az_a, el_a, az_b, el_b] = state.newest;
    let known = [az_a?, el_a?, az_b?, el_b?];
    let age = state.age(now);
    if age.0 > config.max_age(half_turn) {
        return None;
    }
    match solve(&config.calib, &known.map(|(angle, _)| angle)) {
        Ok(Solution { position, mismatch }) => Some(Fix { position, mismatch, at: now, age, half_turn }),
        Err(reject) => {
            let count = match reject {
                Reject::FieldOfView | Reject::Geometry => &mut state.refused.geometry,
                Reject::Mismatch => &mut state.refused.mismatch,
            };
            *count = count.wrapping_add(1);
            None
        }
    }
}

#[cfg(test)]
mod tests;
