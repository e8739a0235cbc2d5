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

use crate::ootx::{Half, Terms};
use crate::sweep::HALF_TURN_BITS;

/// One rotor, all in [`Angle`](super::Angle) units: 2^20 in pi.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Rotor {
    /// The constant term; real stations have up to 0.06 rad.
    pub phase: i32,
    /// tan(tilt); real stations have up to 0.006 rad. At most 0.02 rad is held.
    pub tilt: i32,
    /// gibmag cos(gibphase): what goes with sin(ideal). Real stations have up to 0.02 rad, at most 0.03 is held.
    pub gibbous_sin: i32,
    /// gibmag sin(gibphase): what goes with cos(ideal).
    pub gibbous_cos: i32,
}

impl Rotor {
    /// The rotor that a station describes; `None` where a term is beyond what any station has, or no number.
    #[must_use]
    pub(super) fn received(terms: &Terms) -> Option<Self> {
        let within = |half: Half, limit: i32| units(half).filter(|value| value.abs() <= limit);
        let (phase, tilt) = (within(terms.phase, PHASE_LIMIT)?, within(terms.tilt, TILT_LIMIT)?);
        let gibmag = within(terms.gibmag, GIBMAG_LIMIT)?;
        let (sin, cos) = any_sin_cos(units(terms.gibphase)?);
        let times = |factor: i32| (gibmag * factor + (1 << (Q - 1))) >> Q;
        Some(Self { phase, tilt: tilt + third_of_cube(tilt), gibbous_sin: times(cos), gibbous_cos: times(sin) })
    }

    /// Nothing but the constant term.
    pub(super) const fn is_phase(&self) -> bool {
        self.tilt == 0 && self.gibbous_sin == 0 && self.gibbous_cos == 0
    }
}

/// The largest terms that a station is believed to have, 0.2, 0.015 and 0.025 rad, rounded up: two and a half times, and
/// a quarter more than, what real ones have; beyond, four rounds leave more than 20 urad. Stations
/// seen in the field have at most 0.06, 0.006 and 0.017.
const PHASE_LIMIT: i32 = milliradians(200);
const TILT_LIMIT: i32 = milliradians(15);
const GIBMAG_LIMIT: i32 = milliradians(25);

/// In angle units, rounded up.
const fn milliradians(milliradians: i32) -> i32 {
    // 2^20 / pi / 1000 = 333.772.
    (milliradians * 333_773).div_euclid(1000) + 1
}

/// A half float of radians in angle units, to the nearest; `None` from 8 rad on.
fn units(half: Half) -> Option<i32> {
    /// 2^20 / pi, the angle units of a radian, Q2: with the 11 bits of a half float's mantissa it takes 32.
    const PER_RAD_Q2: u32 = 1_335_088;
    // The value is mantissa * 2^(shift - 24).
    let (mantissa, shift) = half.parts().filter(|(_, shift)| *shift <= 16)?;
    let magnitude = ((mantissa.unsigned_abs() * PER_RAD_Q2 + (1 << (25 - shift))) >> (26 - shift)) as i32;
    Some(if mantissa < 0 { -magnitude } else { magnitude })
}

/// Sine and cosine in Q14 of any angle.
fn any_sin_cos(angle: i32) -> (i32, i32) {
    const RIGHT_ANGLE_BITS: u32 = HALF_TURN_BITS - 1;
    let quadrant = (angle + (1 << (RIGHT_ANGLE_BITS - 1))) >> RIGHT_ANGLE_BITS;
    let (sin, cos) = sin_cos(angle - (quadrant << RIGHT_ANGLE_BITS));
    match quadrant & 3 {
        0 => (sin, cos),
        1 => (cos, -sin),
        2 => (-sin, -cos),
        _ => (-cos, sin),
    }
}

/// Rounds of the iteration. Each shrinks the error by what gibmag and tilt make together: 0.065^5 rad, 1.2 urad, is left.
const ROUNDS: u32 = 4;
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
        (rotor.tilt * tan(sin, cos) + (1 << (Q - 1))) >> Q
    };
    let mut ideal = straight;
    for _ in 0..ROUNDS {
        let (sin, cos) = sin_cos(ideal);
        // Every amplitude is under 2^15 and every factor at most 2^14, so two of them fit.
        let lean = (tilted * cos + (1 << (Q - 1))) >> Q;
        let gibbous = rotor.gibbous_cos * cos + rotor.gibbous_sin * sin;
        let terms = lean - third_of_cube(lean) - ((gibbous + (1 << (Q - 1))) >> Q);
        ideal = straight.wrapping_add(terms);
    }
    ideal
}

/// A third of the cube of a small angle, at most 0.036 rad: what its tangent has more and its arc tangent less.
fn third_of_cube(angle: i32) -> i32 {
    // 13 / 2^42 is 1 / (3 (2^20 / pi)^2) within 1.3 %, of at most five units.
    let cube_q10 = ((angle * angle) >> 10) * angle;
    ((cube_q10 >> 10) * 13 + (1 << 21)) >> 22
}

/// The quotient in Q14, bit by bit: the core has no divider. Less than four, as within the field of view.
fn tan(sin: i32, cos: i32) -> i32 {
    let (mut rest, twice) = (sin.unsigned_abs(), 2 * cos.unsigned_abs());
    // A one that is shifted up 16 places ends the loop, which the compiler would unroll if it saw the end coming.
    let mut quotient = 1u32;
    while quotient >> (Q + 2) == 0 {
        quotient <<= 1;
        if rest >= twice {
            rest -= twice;
            quotient |= 1;
        }
        rest <<= 1;
    }
    let quotient = (quotient & ((1 << (Q + 2)) - 1)) as i32;
    if sin < 0 { -quotient } else { quotient }
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

    use half::f16;
    use proptest::prelude::*;

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

    /// What a rotor measures, as data/README of the recordings has it.
    fn measured([phase, tilt, gibphase, gibmag]: [f64; 4], ideal: f64, other: f64) -> f64 {
        ideal - phase - (other.tan() * f64::tan(tilt) * ideal.cos()).atan() + gibmag * (ideal + gibphase).sin()
    }

    /// A half float at most `limit` from zero: anywhere, at the limit, or tiny.
    fn half_about(limit: f64) -> impl Strategy<Value = f16> {
        let largest = f16::from_f64(limit).to_bits();
        let magnitude = prop_oneof![
            4 => (0.0..=limit).prop_map(f16::from_f64),
            2 => Just(f16::from_bits(largest)),
            1 => (0..=largest).prop_map(f16::from_bits),
        ];
        (magnitude, any::<bool>()).prop_map(|(half, negative)| if negative { -half } else { half })
    }

    /// A direction in the field of view, or its edge.
    fn degrees() -> impl Strategy<Value = f64> {
        prop_oneof![4 => -60.0..=60.0f64, 1 => Just(-60.0), 1 => Just(60.0)]
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 20_000, failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn received_terms_come_off_within_20_urad_over_the_field_of_view(
            terms in (half_about(0.1999), half_about(0.01499), half_about(7.0), half_about(0.02499)),
            degrees in degrees(), other in degrees(),
        ) {
            let (phase, tilt, gibphase, gibmag) = terms;
            let [phase, tilt, gibphase, gibmag] = [phase, tilt, gibphase, gibmag].map(|half| Half(half.to_bits()));
            let sent = Terms { phase, tilt, curve: Half(0x7e00), gibphase, gibmag };
            let rotor = Rotor::received(&sent).expect("plausible");
            let (true_ideal, other) = (degrees.to_radians(), other.to_radians());
            let measured = measured([phase, tilt, gibphase, gibmag].map(Half::to_f64), true_ideal, other);
            let whole = |rad: f64| (rad * UNITS_PER_RAD).round() as i32;
            let found = ideal(&rotor, whole(measured), whole(other));
            let error = f64::from(found) / UNITS_PER_RAD - true_ideal;
            prop_assert!(error.abs() < 20e-6, "{:.1} urad off", error * 1e6);
        }

        #[test]
        fn a_half_float_of_radians_is_the_nearest_angle_unit(bits in any::<u16>()) {
            let exact = Half(bits).to_f64() * UNITS_PER_RAD;
            match units(Half(bits)) {
                // 2^-20 of eight radians is rounded away besides.
                Some(units) => prop_assert!((f64::from(units) - exact).abs() <= 0.5 + exact.abs() * 1e-6),
                None => prop_assert!(!exact.is_finite() || exact.abs() >= 8.0 * UNITS_PER_RAD),
            }
        }
    }

    #[test]
    fn the_tangent_is_the_quotient() {
        for degree in -60..=60 {
            let (sin, cos) = sin_cos(((1 << HALF_TURN_BITS) * degree) / 180);
            assert_eq!(tan(sin, cos), (sin << Q) / cos, "{degree} deg");
        }
    }

    #[test]
    fn terms_beyond_any_station_are_not_believed() {
        let half = |value: f64| Half(f16::from_f64(value).to_bits());
        let fair =
            Terms { phase: half(0.06), tilt: half(0.005), gibphase: half(2.0), gibmag: half(0.01), ..Terms::default() };
        assert!(Rotor::received(&fair).is_some());
        for terms in [
            Terms { phase: half(-0.21), ..fair },
            Terms { tilt: half(0.016), ..fair },
            Terms { gibmag: half(-0.026), ..fair },
            Terms { gibphase: half(9.0), ..fair },
            Terms { phase: half(f64::NAN), ..fair },
            Terms { gibmag: half(f64::INFINITY), ..fair },
        ] {
            assert_eq!(Rotor::received(&terms), None, "{terms:?}");
        }
    }
}
