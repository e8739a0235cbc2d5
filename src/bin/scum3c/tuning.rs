//! The oscillators' codes, tuned to the lighthouse: its rotors are the only crystal around.
//!
//! | oscillator | counted by | aim | reached by |
//! |---|---|---|---|
//! | 20 MHz (core, stamps, log) | the measured half turn | 10 MHz +- 0.15 % | its fine code |
//! | radio (LC) | the analog counters over six half turns | the channel +- 40 ppm | coarse, mid and fine, as one code |
//! | 2 MHz (chips on the air) | the same | 2 MHz +- 80 ppm | three codes |
//!
//! Six half turns are 50 ms, whatever the clock. Aims and steps are those of the SCuM-3C test code (`optical.c:95-258`),
//! which counts against an optical programmer's pulses.
//!
//! What can go wrong: an oscillator that does not reach its aim stays at the end of its codes. Without light nothing is
//! tuned, and the typical codes are off by percents: a listener has to search for a mote that never saw light. A step
//! of the 20 MHz oscillator changes every span at once: the cycle may be lost and found again.

use core::sync::atomic::{AtomicU32, Ordering::Relaxed};

use lighthouse_mote::time::Span;

use crate::bring_up;
use crate::memory::opaque;
use crate::oscillators::{CHANGED, CHIP_CLOCK, HF_FINE, flip, shift};
use crate::pac::{analog, scb};

/// A half turn at 10 MHz, ticks: 20 MHz halved, 120 half turns a second.
const HALF_TURN: i32 = 83_333;
/// 2,000,000 +- 3000 counts in 100 ms (`optical.c`), in ticks of a half turn.
const HF_TOLERANCE: i32 = 125;
/// One fine code is 6000 counts of 2,000,000 (`optical.c`), so 250 ticks of a half turn: 2^8, nearly.
const HF_STEP_BITS: u32 = 8;
/// Half turns of a count: 50 ms.
const COUNTED: u32 = 6;

/// The radio's oscillator over 50 ms, divided by 960, in what the lighthouse application sends on: half of 250,187
/// (`lighthouse_app.c:33`).
const LC_APPLICATION: i32 = 125_093;
/// The same on channel 11 of IEEE 802.15.4: 2405 MHz.
const LC_CHANNEL_11: i32 = 125_260;
/// From one channel to the next, 5 MHz: 260.42 counts, in 1/256.
const LC_CHANNEL_Q8: i32 = 66_667;
/// 40 ppm, what IEEE 802.15.4 allows at 2.4 GHz, less one count.
const LC_TOLERANCE: i32 = 4;
/// An eighth of the distance never overshoots where a code is less than 8 counts, 150 kHz: assumed.
const LC_STEP_BITS: u32 = 3;
/// The last code whose coarse part has five bits.
const LC_LAST: i32 = 1819;
/// 2 MHz over 50 ms.
const CHIP_CLOCK_COUNTS: i32 = 100_000;
/// Beyond this the coarse code moves, else the fine, else the superfine one: half of 600, 80 and 15 (`optical.c`).
const CHIP_CLOCK_LIMITS: [i32; 3] = [300, 40, 7];

/// Ticks of a count, 0 while there is no light to count by. Written by [`light`].
static WINDOW: AtomicU32 = AtomicU32::new(0);

/// A second has passed with the rotors' half turn at `half_turn` ticks, if they were seen.
#[cold]
#[inline(never)]
pub fn light(half_turn: Option<Span>) {
    let ticks = half_turn.map_or(0, |half_turn| half_turn.0);
    let error = ticks as i32 - HALF_TURN;
    let mut window = ticks * COUNTED;
    if ticks != 0 && error.abs() > HF_TOLERANCE {
        // A higher code is a slower clock.
        if shift(&HF_FINE, (error + (1 << (HF_STEP_BITS - 1))) >> HF_STEP_BITS) {
            // What was measured is no longer so.
            window = 0;
        }
    }
    if CHANGED.load(Relaxed) {
        // `idle` has something to do.
        scb::SCR.write(0);
    }
    WINDOW.store(window, Relaxed);
}

/// Lets changed codes take effect. For `idle`: it takes milliseconds, and anything may come in between.
pub fn apply() {
    if CHANGED.load(Relaxed) {
        CHANGED.store(false, Relaxed);
        bring_up::write_chain();
    }
}

/// The radio's oscillator.
pub struct Lc {
    /// Coarse, mid and fine in one (`scm3c_hw_interface.c:1532-1566`).
    code: i32,
    /// The same as registers 7 and 8 take it.
    registers: [u32; 2],
    /// Counts of 50 ms to be reached.
    target: i32,
    /// How many more chances to count are let pass.
    rest: u8,
}

impl Lc {
    /// Where the lighthouse application starts (`lighthouse.h`, LC_CODE_LH).
    const FIRST: i32 = 680;
    /// While it is right, it is counted once a minute.
    const REST: u8 = 60;

    /// For `channel` 11 ..= 26, or the application's own frequency.
    pub fn new(channel: u8) -> Self {
        let target = match channel.checked_sub(11) {
            Some(above) => LC_CHANNEL_11 + ((i32::from(above) * LC_CHANNEL_Q8) >> 8),
            None => LC_APPLICATION,
        };
        let mut lc = Self { code: Self::FIRST, registers: [0; 2], target, rest: 0 };
        lc.encode();
        lc
    }

    /// Lets the code take effect.
    #[inline(always)]
    pub fn apply(&self) {
        let [low, high] = self.registers;
        analog::REG7.write(low);
        analog::REG8.write(high);
    }

    /// Each part of the code mirrored, the last bit of the mirrored fine part apart (:1471-1531).
    #[inline(never)]
    fn encode(&mut self) {
        let (mut coarse, mut mid, mut fine) = (19, 0, self.code as u32);
        while fine >= 140 {
            fine = opaque(fine - 140);
            coarse += 1;
        }
        while fine >= 23 {
            fine = opaque(fine - 23);
            mid += 3;
        }
        if fine > 15 {
            fine += 1;
        }
        let fine = flip(fine);
        self.registers = [(fine & 0xf) << 12 | flip(mid) << 6 | flip(coarse), fine >> 4];
    }

    /// Starts a count with oscillator and divider on, where there is a reason; how long it is to last.
    pub fn count(&mut self) -> Option<Span> {
        let window = WINDOW.load(Relaxed);
        if window == 0 {
            return None;
        }
        if self.rest != 0 {
            self.rest -= 1;
            return None;
        }
        self.apply();
        analog::REG0.write(analog::COUNTERS_RESET);
        analog::REG0.write(analog::COUNTERS_RUN);
        Some(Span(window))
    }

    /// Ends the count and moves the codes of radio and chip clock by what it says.
    #[inline(never)]
    pub fn tune(&mut self) {
        analog::REG0.write(analog::COUNTERS_STOP);
        let window = WINDOW.load(Relaxed) as i32;
        if window == 0 {
            // The light went, or the clock was moved meanwhile.
            return;
        }
        let read = |low: u32, high: u32| (low | high << 16) as i32;
        let hf = read(analog::COUNT_HF.read(), analog::COUNT_HF_HIGH.read());
        let lc = read(analog::COUNT_LC.read(), analog::COUNT_LC_HIGH.read());
        let chips = read(analog::COUNT_2M.read(), analog::COUNT_2M_HIGH.read());
        // How much longer it lasted than it should have: handlers come when they can. Radio over 20 MHz is 1/8.0,
        // chip clock 1/10.
        let late = hf - 2 * window;
        let slow = self.target + (late >> 3) - lc;
        self.rest = Self::REST;
        if slow.abs() > LC_TOLERANCE {
            let steps = slow >> LC_STEP_BITS;
            let code = (self.code + if steps == 0 { 1 } else { steps }).clamp(0, LC_LAST);
            // At the end of its codes it is left there for a while.
            if code != self.code {
                self.code = code;
                self.encode();
                self.rest = 0;
            }
        }
        let fast = chips - CHIP_CLOCK_COUNTS - ((late * 13) >> 7);
        for (code, limit) in CHIP_CLOCK.iter().zip(CHIP_CLOCK_LIMITS) {
            if fast.abs() > limit {
                // A higher code is a slower clock.
                if shift(code, fast.signum()) {
                    self.rest = 0;
                }
                break;
            }
        }
    }
}
