//! A program that does everything a Cortex-M0 can be asked to do, and says what came out.
//!
//! Each part prints lines of hexadecimal words by semihosting. Whoever runs it compares the lines with another's.
//!
//! What can go wrong: nothing here may depend on addresses of the host, on real time, or on UNPREDICTABLE behaviour.
#![no_std]
#![no_main]

mod console;
mod exceptions;
mod faults;
mod flags;
mod memory;
mod sequences;
mod software;
mod startup;
#[path = "../../../../src/bin/bench/timer.rs"]
mod timer;

use console::{exit, say};

/// A running digest of words, so that a thousand results fit one line.
pub struct Digest(u32);

impl Default for Digest {
    fn default() -> Self {
        Self(0x811C_9DC5)
    }
}

impl Digest {
    /// Takes in one more word.
    pub fn add(&mut self, word: u32) {
        self.0 = (self.0.rotate_left(5) ^ word).wrapping_mul(0x9E37_79B1);
    }

    /// What it has come to.
    pub fn value(&self) -> u32 {
        self.0
    }
}

/// The instructions that fit into so many ticks, rounded: ticks of 62.5 ns, 1024 ns for an instruction.
pub fn instructions(ticks: u32) -> u32 {
    ((u64::from(ticks) * 1000 + 8192) / 16384) as u32
}

fn measured(name: &str, part: fn()) {
    let before = timer::now();
    part();
    let after = timer::now();
    say(name, &[instructions(after.wrapping_sub(before))]);
}

fn main() -> ! {
    timer::start();
    measured("flags took", flags::run);
    measured("memory took", memory::run);
    measured("software took", software::run);
    measured("exceptions took", exceptions::run);
    faults::run();
    sequences::run();
    exit(0)
}
