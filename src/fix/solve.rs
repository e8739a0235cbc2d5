//! Four angles to a position, in whichever form the room has.
//!
//! What can go wrong: [`Reject`] says it.

use super::layout::{Calib, Reject, Solution};
use super::{Angle, fast, general};

/// Finds the mote from `angles` = azimuth and elevation of station A, azimuth and elevation of station B.
///
/// # Errors
/// See [`Reject`].
#[inline(always)]
pub fn solve(calib: &Calib, angles: &[Angle; 4]) -> Result<Solution, Reject> {
    let raw = [angles[0].0, angles[1].0, angles[2].0, angles[3].0];
    match calib {
        Calib::Fast(fast) => fast::solve(fast, raw),
        Calib::General(general) => general::solve(general, raw),
    }
}
