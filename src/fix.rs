//! Four angles to a position.
//!
//! What can go wrong: an angle is too old (the mote has moved since), the rays pass each other too far (one of them is
//! a reflection), the geometry is hopeless. Each means no fix, never a stale or a wild one; each is counted.

use crate::angle::{Angle, Bearing};
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

/// The newest angle of each rotor, and what was refused.
#[derive(Debug, Clone, Default)]
pub struct State {
    /// Indexed az A, el A, az B, el B.
    newest: [Option<(Angle, Ticks)>; 4],
    refused: u16,
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
    /// Fixes refused since start-up for geometry or mismatch, wrapping.
    #[must_use]
    pub const fn refused(&self) -> u16 {
        self.refused
    }

    /// Drops every angle: their ages are no longer known.
    pub fn forget(&mut self) {
        self.newest = [None; 4];
    }
}

/// Takes one bearing; gives the fix that it completes.
#[inline]
pub fn step(config: &Config, state: &mut State, bearing: Bearing) -> Option<Fix> {
    let newest = (bearing.angle, bearing.at);
    if let Some(slot) = state.newest.get_mut(2 * bearing.station as usize + bearing.axis as usize) {
        *slot = Some(newest);
    }
    let [az_a, el_a, az_b, el_b] = state.newest;
    let known = [az_a?, el_a?, az_b?, el_b?];
    let age = known.iter().map(|(_, at)| bearing.at.since(*at)).max()?;
    if age.0 > bearing.half_turn.span().0.saturating_mul(u32::from(config.max_age_half_turns)) {
        return None;
    }
    match solve(&config.calib, &known.map(|(angle, _)| angle)) {
        Ok(Solution { position, mismatch }) => {
            Some(Fix { position, mismatch, at: bearing.at, age, half_turn: bearing.half_turn })
        }
        Err(_) => {
            state.refused = state.refused.wrapping_add(1);
            None
        }
    }
}

/// placeholder
#[derive(Debug, Clone)]
pub struct Calib;
/// placeholder
pub struct Solution {
    /// p
    pub position: [i32; 3],
    /// m
    pub mismatch: i32,
}
/// placeholder
pub fn solve(_c: &Calib, _a: &[Angle; 4]) -> Result<Solution, ()> {
    Err(())
}
