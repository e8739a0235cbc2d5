//! The factory terms of a rotor, undone in fixed point.
//!
//! A rotor's laser plane is not quite where its angle says: with `other` the ideal angle of the station's other rotor,
//!
//! ```text
//! measured = ideal - phase - atan(tan(other) tan(tilt) cos(ideal)) + gibmag sin(ideal + gibphase)
//! ```
//!
//! (the public implementations agree on these terms; the tiny curve term is left out, they dispute its sign). The terms
//! are small, so a few rounds of `ideal = measured + phase + ...` undo them.
//!
//! What can go wrong: the other rotor has not been seen yet; its tangent then counts as zero.

use crate::sweep::HALF_TURN_BITS;

/// One rotor, all in [`Angle`](super::Angle) units: 2^20 in pi.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Rotor {
    /// The constant term; real stations have up to 0.06 rad.
    pub phase: i32,
    /// tan(tilt); real stations have up to 0.006 rad. At most 0.02 rad, where leaving out the atan costs 14 urad.
    pub tilt: i32,
    /// gibmag cos(gibphase): what goes with sin(ideal). Real stations have up to 0.02 rad, at most 0.03 is held.
    pub gibbous_sin: i32,
    /// gibmag sin(gibphase): what goes with cos(ideal).
    pub gibbous_cos: i32,
}

impl Rotor {
    /// Nothing but the constant term.
    pub(super) const fn is_phase(&self) -> bool {
        self.tilt == 0 && self.gibbous_sin == 0 && self.gibbous_cos == 0
    }
}

/// Rounds of the iteration. Each shrinks the error by gibmag: 0.03^4 rad, 0.8 urad, is left.
const ROUNDS: u32 = 3;
/// Fraction bits of sines and cosines.
const Q: u32 = 14;

/// The ideal angle that shows as `measured`, both in angle units; `other` is the ideal angle of the other rotor.
#[inline]
pub(super) fn ideal(rotor: &Rotor, measured: i32, other: i32) -> i32 {
    let straight = measured.wrapping_add(rotor.phase);
    if rotor.is_phase() {
        return straight;
    }
    let tilted = if rotor.tilt == 0 {
        0
    } else {
        let (sin, cos) = sin_cos(other);
        (rotor.tilt * ((sin << Q) / cos.max(1)) + (1 << (Q - 1))) >> Q
    };
    let mut ideal = straight;
    for _ in 0..ROUNDS {
        let (sin, cos) = sin_cos(ideal);
        // Every amplitude is under 2^15 and every factor at most 2^14, so three of them fit.
        let terms = (tilted - rotor.gibbous_cos) * cos - rotor.gibbous_sin * sin;
        ideal = straight.wrapping_add((terms + (1 << (Q - 1))) >> Q);
    }
    ideal
}

/// Sine and cosine in Q14 of an angle within the field of view; farther ones are taken as at its edge.
///
/// Least-squares polynomials in the square of the angle over 64 degrees: off by at most 8e-5 and 4e-5.
#[inline]
fn sin_cos(angle: i32) -> (i32, i32) {
    /// 64 degrees: the field of view and the largest phase.
    const EDGE: i32 = (1 << HALF_TURN_BITS) / 180 * 64;
    let t = angle.clamp(-EDGE, EDGE) >> 4; // Q16 half turns
    // Q18: at most 0.127. Unsigned, because at the edge the products below take all 32 bits.
    let w = (t * t) as u32 >> 14;
    let cos = 16_383 - ((w * (80_663 - ((w * 62_468) >> 18))) >> 18) as i32;
    let sin_over_t = 51_471 - ((w * (84_582 - ((w * 39_963) >> 18))) >> 18) as i32;
    ((t * sin_over_t) >> 16, cos)
}

#[cfg(test)]
mod tests {
    use super::*;

    const UNITS_PER_RAD: f64 = (1 << HALF_TURN_BITS) as f64 / core::f64::consts::PI;

    #[test]
    fn the_factory_terms_come_off_within_20_urad_over_the_field_of_view() {
        // (phase, tilt, gibphase, gibmag) rad: the largest terms of two measured stations, and the held limits.
        for (phase, tilt, gibphase, gibmag) in [
            (0.0179, -0.00526, 1.705, 0.01688),
            (0.0541, 0.00346, 0.553, -0.00673),
            (0.0541, -0.00255, -1.0996, -0.00864),
            (0.06, 0.02, 0.8, 0.0),
            (0.06, 0.0, 2.0, 0.03),
        ] {
            let whole = |rad: f64| (rad * UNITS_PER_RAD).round() as i32;
            let rotor = Rotor {
                phase: whole(phase),
                tilt: whole(f64::tan(tilt)),
                gibbous_sin: whole(gibmag * f64::cos(gibphase)),
                gibbous_cos: whole(gibmag * f64::sin(gibphase)),
            };
            for degree in -60..=60 {
                for other in [-60, -30, 0, 17, 60] {
                    let (true_ideal, other) = (f64::from(degree).to_radians(), f64::from(other).to_radians());
                    let measured = true_ideal - phase - (other.tan() * f64::tan(tilt) * true_ideal.cos()).atan()
                        + gibmag * (true_ideal + gibphase).sin();
                    let found = ideal(&rotor, whole(measured), whole(other));
                    let error = f64::from(found) / UNITS_PER_RAD - true_ideal;
                    assert!(error.abs() < 20e-6, "{:.1} urad off at {degree} deg", error * 1e6);
                }
            }
        }
    }
}
