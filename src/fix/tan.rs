//! The tangent of a rotor angle, from a table of straight lines.
//!
//! Each cell of 2^10 angle units holds the line `base + slope * angle` that fits the tangent best in the mean, so one
//! multiplication serves, and the product may wrap: only the sum has to fit. The error is 1.7e-6 RMS over the field
//! of view and at most 1.6e-5, at its edge.

use super::layout::HALF;

/// Angle units per half turn.
const HALF_TURN: f64 = 1_048_576.0;
/// log2 of the width of a cell in angle units.
const CELL_BITS: u32 = 10;
/// Cells from straight ahead to the edge, which lies at 60.12 deg; the left half mirrors the right.
const CELLS: usize = 342;
/// One in the Q28 of the result.
const ONE: f64 = (1u32 << 28) as f64;

/// Two tables, because the end of one is no constant that this core can name in one instruction.
static BASES: [i32; CELLS] = lines().0;
static SLOPES: [u16; CELLS] = lines().1;

/// tan(angle) + [`HALF`] in Q28, or nothing outside the field of view (+-60.12 deg).
#[inline(always)]
pub fn tan(angle: i32) -> Option<i32> {
    let sign = angle >> 31;
    // The smallest angle has no opposite, and lies outside.
    let aside = (angle ^ sign).wrapping_sub(sign);
    let cell = (aside as u32 >> CELL_BITS) as usize;
    let (base, slope) = (*BASES.get(cell)?, *SLOPES.get(cell)?);
    let tangent = base.wrapping_add(i32::from(slope).wrapping_mul(aside));
    // One unit of Q28 more or less for a negative one is nothing.
    Some((tangent ^ sign).wrapping_add(HALF))
}

/// The bases and the slopes.
const fn lines() -> ([i32; CELLS], [u16; CELLS]) {
    let mut table = ([0; CELLS], [0; CELLS]);
    let mut cell = 0;
    while cell < CELLS {
        let width = (1u32 << CELL_BITS) as f64;
        let left = cell as f64 * width;
        let radians = core::f64::consts::PI / HALF_TURN;
        let at_left = tangent(left * radians) * ONE;
        let at_right = tangent((left + width) * radians) * ONE;
        let at_middle = tangent((left + width / 2.0) * radians) * ONE;
        let slope = round((at_right - at_left) / width);
        // Simpson's mean of the curve, so that the line has no bias in its cell.
        let mean = (at_left + 4.0 * at_middle + at_right) / 6.0;
        let base = mean - slope as f64 * (left + width / 2.0);
        // The true base may leave i32; what counts is the sum modulo 2^32.
        table.0[cell] = round(base) as i32;
        // At most 4 pi 2^8: the slope of the tangent at 60 deg.
        table.1[cell] = slope as u16;
        cell += 1;
    }
    table
}

const fn round(value: f64) -> i64 {
    if value < 0.0 { (value - 0.5) as i64 } else { (value + 0.5) as i64 }
}

/// tan by the Taylor series of sine and cosine; to 1e-15 below 61 deg.
const fn tangent(angle: f64) -> f64 {
    let (mut sine, mut cosine) = (0.0, 0.0);
    let mut term = 1.0;
    let mut power = 0;
    while power < 26 {
        cosine += term;
        term *= angle / (power + 1) as f64;
        sine += term;
        term *= -angle / (power + 2) as f64;
        power += 2;
    }
    sine / cosine
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_angle_in_view_has_its_tangent() {
        let (mut max, mut square) = (0.0f64, 0.0);
        let view = -349_525..=349_525;
        for angle in view.clone() {
            let exact = (f64::from(angle) * core::f64::consts::PI / HALF_TURN).tan();
            let found = tan(angle).expect("an angle in view");
            let error = f64::from(found - HALF) / ONE - exact;
            max = max.max(error.abs());
            square += error * error;
        }
        let rms = (square / view.count() as f64).sqrt();
        assert!(max < 1.2e-5, "{max}");
        assert!(rms < 1.7e-6, "{rms}");
    }

    #[test]
    fn the_field_of_view_ends_at_sixty_degrees() {
        assert_eq!(tan(350_208), None);
        assert_eq!(tan(-350_208), None);
        assert_eq!(tan(i32::MIN), None);
        assert_eq!(tan(i32::MAX), None);
    }
}
