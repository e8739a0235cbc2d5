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
/// Cells from the left edge to the right; the edges lie at +-60.03 deg.
const CELLS: usize = 683;
/// Added to an angle to count from the left edge.
const LEFT: i32 = (CELLS as i32) << (CELL_BITS - 1);
/// One in the Q28 of the result.
const ONE: f64 = (1u32 << 28) as f64;

static TABLE: [(i32, i32); CELLS] = table();

/// tan(angle) + [`HALF`] in Q28, or nothing outside the field of view (+-60.03 deg).
#[inline(always)]
pub(super) fn tan(angle: i32) -> Option<i32> {
    let from_left = angle.wrapping_add(LEFT) as u32;
    let &(base, slope) = TABLE.get((from_left >> CELL_BITS) as usize)?;
    Some(base.wrapping_add(slope.wrapping_mul(from_left as i32)))
}

const fn table() -> [(i32, i32); CELLS] {
    let mut table = [(0, 0); CELLS];
    let mut cell = 0;
    while cell < CELLS {
        let width = (1u32 << CELL_BITS) as f64;
        let left = cell as f64 * width;
        let radians = core::f64::consts::PI / HALF_TURN;
        let at_left = tangent((left - LEFT as f64) * radians) * ONE;
        let at_right = tangent((left + width - LEFT as f64) * radians) * ONE;
        let at_middle = tangent((left + width / 2.0 - LEFT as f64) * radians) * ONE;
        let slope = round((at_right - at_left) / width);
        // Simpson's mean of the curve, so that the line has no bias in its cell.
        let mean = (at_left + 4.0 * at_middle + at_right) / 6.0;
        let base = mean - slope as f64 * (left + width / 2.0) + HALF as f64;
        // The true base may leave i32; what counts is the sum modulo 2^32.
        table[cell] = (round(base) as i32, slope as i32);
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
        assert_eq!(tan(349_696), None);
        assert_eq!(tan(-349_697), None);
        assert_eq!(tan(i32::MIN), None);
        assert_eq!(tan(i32::MAX), None);
    }
}
