//! One over the square root of a positive number, without a division.
//!
//! A Cortex-M0 divides in software, 200 instructions and more; 48 straight lines in 11 bits are within 1/700.

/// 1 / sqrt(value) = `mantissa` * 2^-(18 + `shift`), 2^10 <= `mantissa` <= 2^11.
pub(super) struct Root {
    pub mantissa: i32,
    pub shift: u32,
}

/// The reciprocal of the square root of `value`, which is taken as 2^14 when it is smaller.
#[inline(always)]
pub(super) fn reciprocal_root(value: i32) -> Root {
    let value = value.cast_unsigned();
    let shift = pairs(value, 16);
    // The upper end of the 32 bits: 2^30 and more, in 64 cells of 2^26.
    let rest = value << (16 - 2 * shift);
    let along = (rest << 6) >> 16;
    let line = TABLE[(rest >> 26) as usize];
    Root { mantissa: ((line >> 16) - (((line & 0xffff) * along) >> 22)).cast_signed(), shift }
}

/// The square root of `value`, zero for a negative one: to 1/600 and one unit, rounded down.
///
/// Not inlined: a report wants three, and is rare.
#[must_use]
#[inline(never)]
pub fn square_root(value: i32) -> i32 {
    // What the reciprocal would take as 2^14 is made larger.
    let (value, back) = if value < 1 << 14 { (value.max(0) << 14, 7) } else { (value, 0) };
    let Root { mantissa, shift } = reciprocal_root(value);
    // 16 bits and 12.
    (value >> (2 * shift)).wrapping_mul(mantissa) >> (18 - shift + back)
}

/// By how many pairs of bits `value` has to be shifted to fit into `bits`, which are at least 16.
#[inline(always)]
pub(super) fn pairs(value: u32, bits: u32) -> u32 {
    let fits = |pairs: u32| value.checked_shr(bits + 2 * pairs).unwrap_or(0) == 0;
    if fits(3) {
        if fits(1) { u32::from(!fits(0)) } else { 2 + u32::from(!fits(2)) }
    } else if fits(5) {
        4 + u32::from(!fits(4))
    } else if fits(6) {
        6
    } else {
        7 + u32::from(!fits(7))
    }
}

/// Per cell: the value at its left in the upper half, 64 times the fall over it in the lower.
static TABLE: [u32; 64] = {
    let mut table = [0; 64];
    let mut cell = 0;
    while cell < 64 {
        // Below 2^14 as if it were that.
        let i = if cell < 16 { 16 } else { cell };
        // A chord lies above the curve by up to 0.094 / i^2 of it: half of that off on both sides.
        let chord = 1.0 - 0.047 / (i * i) as f64;
        let left = rooted(i as f64 * 1024.0) * chord;
        let right = rooted((i + 1) as f64 * 1024.0) * chord;
        table[cell] = (left + 0.5) as u32 * 65536 + ((left - right) * 64.0 + 0.5) as u32;
        cell += 1;
    }
    table
};

/// 2^18 / sqrt(value), by Newton's iteration.
const fn rooted(value: f64) -> f64 {
    let mut root = 256.0;
    let mut i = 0;
    while i < 32 {
        root = (root + value / root) / 2.0;
        i += 1;
    }
    (1u32 << 18) as f64 / root
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_magnitude_has_its_root() {
        // Every value of up to 2^20, then 4 million to either side of which no cell is left out.
        let small = 0..1 << 20;
        let large = (1 << 20..=i32::MAX).step_by(509);
        for value in small.chain(large).chain([i32::MAX]) {
            let exact = f64::from(value).sqrt();
            let found = f64::from(square_root(value));
            assert!(found <= exact * (1.0 + 1.0 / 600.0), "{value}: {found}, not {exact}");
            assert!(found >= exact * (1.0 - 1.0 / 600.0) - 1.0, "{value}: {found}, not {exact}");
        }
    }

    #[test]
    fn the_reciprocal_root_is_within_three_halves_of_a_thousandth() {
        for value in (1 << 14..1 << 30).step_by(40_001) {
            let Root { mantissa, shift } = reciprocal_root(value);
            let table = f64::from(mantissa) / f64::from(1 << 18) / f64::from(1 << shift);
            let ratio = table * f64::from(value).sqrt();
            assert!((ratio - 1.0).abs() < 1.5e-3, "{value}: {ratio}");
        }
    }

    #[test]
    fn nonsense_has_no_root() {
        assert_eq!(square_root(-1), 0);
        assert_eq!(square_root(i32::MIN), 0);
        assert_eq!(square_root(0), 0);
    }
}
