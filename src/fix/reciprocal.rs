//! One over a parallax: a short table of straight lines, and one step of Newton's.
//!
//! The Cortex-M0 has no divider. The argument is normalised by the bake so that it lies in [1/8, 2); each of 120 cells
//! 1/64 wide holds the line `base - slope * argument` that fits best in the mean.
//! The relative error of a line is at most (1/64/argument)^2 / 8: 2e-3 at 1/8, and r (2 - r argument) squares it. What
//! remains is rounding: the argument to Q19, 1e-5 at 0.2; the factor to Q16, 1.5e-5; the result to Q14.

use super::layout::LEAST;

/// log2 of the cells per unit.
const CELL_BITS: u32 = 6;
/// Cells below 1/8, which are left out.
const FIRST: usize = (LEAST * (1u32 << CELL_BITS) as f64) as usize;
/// Cells from 1/8 to 2.
const CELLS: usize = (2 << CELL_BITS) - FIRST;
/// From the Q30 argument to the Q20 that the slopes multiply.
const COARSE: u32 = 10;

static LINES: ([u32; CELLS], [u16; CELLS]) = lines();

/// 1 / argument in Q14, rounded, for an argument in Q30; nothing below `least`, which is positive.
#[inline(always)]
pub(super) fn reciprocal(argument: i32, least: i32) -> Option<i32> {
    if argument < least {
        return None;
    }
    let cell = (argument as usize >> (30 - CELL_BITS)).wrapping_sub(FIRST);
    let (base, slope) = (*LINES.0.get(cell)?, *LINES.1.get(cell)?);
    let argument = argument as u32;
    // Q12, at most 8.
    let guess = base.wrapping_sub(u32::from(slope).wrapping_mul(argument >> COARSE)) >> 16;
    // Q19 by Q12: near 1 in Q31, and so is two less it.
    let factor = (argument >> 11).wrapping_mul(guess).wrapping_neg();
    // Q12 by Q16.
    Some((guess.wrapping_mul(factor.wrapping_add(1 << 14) >> 15).wrapping_add(1 << 13) >> 14) as i32)
}

/// The bases and the slopes.
const fn lines() -> ([u32; CELLS], [u16; CELLS]) {
    let mut table = ([0; CELLS], [0; CELLS]);
    let mut cell = 0;
    while cell < CELLS {
        let width = 1.0 / (1u32 << CELL_BITS) as f64;
        let left = (FIRST + cell) as f64 * width;
        let right = left + width;
        let middle = left + width / 2.0;
        // Q28 over Q20 leaves Q8.
        // At most 2^14 at 1/8.
        let slope = (256.0 / (left * right) + 0.5) as u16;
        // Simpson's mean of 1/x, so that the line has no bias in its cell.
        let mean = (1.0 / left + 4.0 / middle + 1.0 / right) / 6.0;
        let base = (mean + middle * slope as f64 / 256.0) * (1u32 << 28) as f64;
        table.0[cell] = (base + 0.5) as u64 as u32;
        table.1[cell] = slope;
        cell += 1;
    }
    table
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_parallax_has_its_reciprocal() {
        let least = 1 << 27;
        let mut worst = 0.0f64;
        for argument in (least..=i32::MAX - 4096).step_by(4099) {
            let x = f64::from(argument) / f64::from(1 << 30);
            let found = reciprocal(argument, least).expect("an argument in range");
            // Half a unit of the Q14; the line's error at the ends of its cell, squared; the roundings on the way, of
            // the argument to Q19, of the factor to Q16 and of the guess to Q12.
            let line = (1.0 / 64.0 / x).powi(2) / 4.5;
            let bound = 0.51 / 16384.0 + ((line + x / 4096.0).powi(2) + 1.0 / 524_288.0 / x + 1.0 / 65_536.0) / x;
            worst = worst.max((f64::from(found) / 16384.0 - 1.0 / x).abs() / bound);
        }
        assert!(worst <= 1.0, "{worst}");
    }

    #[test]
    fn too_little_parallax_has_none() {
        for argument in [0, -1, i32::MIN, (1 << 27) - 1] {
            assert_eq!(reciprocal(argument, 1 << 27), None);
        }
        assert!(reciprocal(1 << 27, 1 << 27).is_some());
    }
}
