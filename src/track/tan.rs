//! The tangent of a rotor angle, from a table of straight lines.
//!
//! One word per line, so that a step costs 16 instructions here; the fix has finer and larger ones of its own.
//!
//! What can go wrong: an angle outside the field of view has no entry, and no answer.

/// Angle units per cell: 2^10, 0.176 deg; straight lines over it are within 1.6e-5 of the tangent.
const CELL_BITS: u32 = 10;
/// Cells to one side of straight ahead: 60.12 deg.
const SIDE: usize = 342;

/// tan(angle) in Q14, or nothing outside +-60.12 deg. `angle` is in 2^20 units per half turn.
#[inline]
pub(super) fn tan(angle: i32) -> Option<i32> {
    let from_left = angle.wrapping_add((SIDE << CELL_BITS) as i32).cast_unsigned();
    let line = *TABLE.get((from_left >> CELL_BITS) as usize)?;
    let along = from_left << (32 - CELL_BITS) >> (32 - CELL_BITS);
    let rise = ((line.cast_unsigned() & 0xffff) * along) >> 16;
    Some((line >> 16).wrapping_add(rise.cast_signed()))
}

/// Per cell: the tangent at its left in the upper half, Q14; 64 times the rise over it in the lower.
static TABLE: [i32; 2 * SIDE] = {
    let mut table = [0; 2 * SIDE];
    let mut cell = 0;
    while cell < table.len() {
        let left = rounded(tangent(cell));
        let rise = tangent(cell + 1) - tangent(cell);
        table[cell] = left * 65536 + rounded(64.0 * rise);
        cell += 1;
    }
    table
};

const fn rounded(value: f64) -> i32 {
    (value + if value < 0.0 { -0.5 } else { 0.5 }) as i32
}

/// The tangent at the left of a cell, Q14, by the Taylor series of sine and cosine, to 1e-14 below 61 deg.
const fn tangent(cell: usize) -> f64 {
    let angle = (cell as f64 - SIDE as f64) * (1u32 << CELL_BITS) as f64 * core::f64::consts::PI / (1u32 << 20) as f64;
    let (mut sine, mut cosine) = (0.0, 0.0);
    let mut term = 1.0;
    let mut i = 0;
    while i < 28 {
        match i % 4 {
            0 => cosine += term,
            1 => sine += term,
            2 => cosine -= term,
            _ => sine -= term,
        }
        i += 1;
        term *= angle / i as f64;
    }
    sine / cosine * (1u32 << 14) as f64
}
