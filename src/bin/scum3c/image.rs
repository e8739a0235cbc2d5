//! Whether the program in memory is the one that was sent.
//!
//! The programmer writes length and CRC-32 behind the program (`docs/flashing.md`); a Teensy checks nothing on the way,
//! so this is where a byte that went wrong is noticed.
//!
//! What can go wrong: the byte is in what runs up to here; then nobody says anything. An image that no programmer
//! packed has no length, and is not checked. A program that fits badly still runs and says so in every health frame:
//! one wrong byte seldom stops it, and a mote that is silent tells nobody.

use core::hint::black_box;

use crate::memory::opaque;
use crate::pac::image::{CRC, LENGTH};

/// CRC-32 of IEEE 802.3, reflected.
const POLYNOMIAL: u32 = 0xedb8_8320;
/// The longest program: up to the two words.
const LONGEST: u32 = 0xfff8;

/// What the check found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, defmt::Format)]
pub enum Image {
    /// Nothing to hold it against.
    Unchecked,
    /// As sent.
    Sound,
    /// Not as sent.
    Damaged,
}

/// Checks it, bit by bit and word by word: 0.2 s at 10 MHz. To be called before anything writes to the code RAM.
pub fn check() -> Image {
    let length = LENGTH.read();
    if length == 0 {
        return Image::Unchecked;
    }
    if length > LONGEST || !length.is_multiple_of(4) {
        return Image::Damaged;
    }
    // The program begins at 0, which the compiler takes for no address at all where it knows it.
    let mut word = black_box(core::ptr::null::<u32>());
    let mut crc = !0_u32;
    for _ in 0..length / 4 {
        // SAFETY: the code RAM is readable from 0 up to `LONGEST`, and nobody writes it.
        crc ^= unsafe { word.read_volatile() };
        word = word.wrapping_add(1);
        let mut bits = 32;
        while bits != 0 {
            bits = opaque(bits - 1);
            let odd = crc & 1 != 0;
            crc = opaque(crc >> 1);
            if odd {
                crc ^= POLYNOMIAL;
            }
        }
    }
    if !crc == CRC.read() { Image::Sound } else { Image::Damaged }
}
