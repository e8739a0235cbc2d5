//! What compiled code does: long arithmetic, floating point, sorting.

use core::hint::black_box;

use crate::Digest;
use crate::console::say;

/// The next number of a fixed sequence.
pub fn next(state: &mut u32) -> u32 {
    *state ^= *state << 13;
    *state ^= *state >> 17;
    *state ^= *state << 5;
    *state
}

/// Runs this part.
pub fn run() {
    say("integers", &[integers()]);
    say("floats", &[floats()]);
    say("sorting", &[sorting()]);
}

fn integers() -> u32 {
    let mut digest = Digest::default();
    let mut state = 0x1234_5678;
    for _ in 0..300 {
        let a = u64::from(next(&mut state)) << 32 | u64::from(next(&mut state));
        let b = u64::from(next(&mut state)) >> (state & 31) | 1;
        for value in [a.wrapping_mul(b), a / b, a % b, (a as i64 / (b as i64 + 1)) as u64, a >> (b & 63)] {
            digest.add(value as u32);
            digest.add((value >> 32) as u32);
        }
        digest.add((a as u32) / (b as u32 | 1));
        digest.add((a as u32).leading_zeros());
    }
    digest.0
}

fn floats() -> u32 {
    let mut digest = Digest::default();
    let mut state = 0x9ABC_DEF0;
    let mut sum = 0.0f32;
    let mut wide = 1.0f64;
    for _ in 0..300 {
        let a = f32::from_bits(next(&mut state) & 0x3FFF_FFFF | 0x2000_0000);
        let b = black_box(next(&mut state) as i32 as f32);
        sum += a * b - b / (a + 1.0);
        wide = wide * 1.000_1 + f64::from(a) / 3.0;
        digest.add(sum.to_bits());
        digest.add(wide.to_bits() as u32);
        digest.add((b < a) as u32);
        digest.add(b as i32 as u32);
    }
    digest.0
}

fn sorting() -> u32 {
    let mut state = 0x0BAD_5EED;
    let mut numbers = [0u32; 200];
    numbers.iter_mut().for_each(|number| *number = next(&mut state));
    numbers.sort_unstable();
    let mut digest = Digest::default();
    numbers.iter().for_each(|&number| digest.add(number));
    let bytes = numbers.map(|number| number as u8);
    digest.add(bytes.iter().fold(0, |crc: u32, &byte| {
        (0..8).fold(crc ^ u32::from(byte), |crc, _| if crc & 1 != 0 { crc >> 1 ^ 0xEDB8_8320 } else { crc >> 1 })
    }));
    digest.0
}
