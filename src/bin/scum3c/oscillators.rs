//! The codes of the oscillators as they are now.
//!
//! [`tuning`](crate::tuning) moves them; that of the radio's own oscillator is no part of the scan chain and stays there.
//!
//! What can go wrong: a code that is moved beyond its end stays at the end.

use core::sync::atomic::{AtomicBool, AtomicU8, Ordering::Relaxed};

use crate::memory::opaque;

/// The highest of a code of five bits.
const LAST: i32 = 31;
/// The fine code of the 20 MHz oscillator; INIT_HF_CLOCK_FINE of `scm3c_hw_interface.c` at first. Moved by [`shift`].
pub static HF_FINE: AtomicU8 = AtomicU8::new(17);
/// Coarse, fine and superfine code of the chip clock; RC2M_..._LH of `lighthouse.h` at first. Moved likewise.
pub static CHIP_CLOCK: [AtomicU8; 3] = [AtomicU8::new(21), AtomicU8::new(15), AtomicU8::new(15)];
/// The scan chain is to be written anew.
pub static CHANGED: AtomicBool = AtomicBool::new(false);

/// The fine code of the 20 MHz oscillator.
pub fn hf_fine() -> u32 {
    HF_FINE.load(Relaxed).into()
}

/// Coarse, fine and superfine code of the chip clock.
pub fn chip_clock() -> impl Iterator<Item = u32> {
    CHIP_CLOCK.iter().map(|code| code.load(Relaxed).into())
}

/// Five bits the other way round.
#[inline(never)]
pub fn flip(code: u32) -> u32 {
    let (mut code, mut flipped) = (code, 1);
    while flipped < 32 {
        flipped = opaque(flipped << 1 | code & 1);
        code >>= 1;
    }
    flipped - 32
}

/// Moves a code by `steps` as far as it goes; whether it did.
#[inline(never)]
pub fn shift(code: &AtomicU8, steps: i32) -> bool {
    let old = code.load(Relaxed);
    let new = (i32::from(old) + steps).clamp(0, LAST) as u8;
    code.store(new, Relaxed);
    if new != old {
        CHANGED.store(true, Relaxed);
    }
    new != old
}
