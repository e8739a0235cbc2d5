//! One over a parallax, from a table of straight lines.
//!
//! The Cortex-M0 has no divider. The argument is normalised by the bake so that it lies in [1/8, 2); each of 480 cells
//! 1/256 wide holds the line `base - slope * argument` that fits best in the mean.
//! The relative error of a line is (1/256/argument)^2 / 13 RMS: 2.8e-5 at 0.2, 1.1e-6 at 1; rounding to Q14 adds
//! 1.8e-5 absolute.

use super::layout::LEAST;

/// log2 of the cells per unit.
const CELL_BITS: u32 = 8;
/// Cells from 0 to 2; the first 32, below 1/8, are empty.
const CELLS: usize = 2 << CELL_BITS;
/// From the Q30 argument to the Q20 that the slopes multiply.
const COARSE: u32 = 10;

static TABLE: [(u32, u32); CELLS] = table();

/// 1 / argument in Q14, rounded, for an argument in Q30; nothing below `least`, which is positive.
#[inline(always)]
pub(super) fn reciprocal(argument: i32, least: i32) -> Option<i32> {
    if argument < least {
        return None;
    }
    let &(base, slope) = TABLE.get(argument as usize >> (30 - CELL_BITS))?;
    Some((base.wrapping_sub(slope.wrapping_mul(argument as u32 >> COARSE)) >> 14) as i32)
}

const fn table() -> [(u32, u32); CELLS] {
    let mut table = [(0, 0); CELLS];
    let mut cell = (LEAST * (1u32 << CELL_BITS) as f64) as usize;
    while cell < CELLS {
        let width = 1.0 / (1u32 << CELL_BITS) as f64;
        let left = cell as f64 * width;
        let right = left + width;
        let middle = left + width / 2.0;
        // Q28 over Q20 leaves Q8.
        let slope = (256.0 / (left * right) + 0.5) as u32;
        // Simpson's mean of 1/x, so that the line has no bias in its cell, and half of the unit that the shift drops.
        let mean = (1.0 / left + 4.0 / middle + 1.0 / right) / 6.0;
        let base = (mean + middle * slope as f64 / 256.0) * (1u32 << 28) as f64 + (1u32 << 13) as f64;
        table[cell] = ((base + 0.5) as u64 as u32, slope);
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
            // Half a unit of the Q14, and the line's error at the ends of its cell.
            let bound = 0.55 / 16384.0 + (1.0 / 256.0 / x).powi(2) / 4.5 / x;
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
