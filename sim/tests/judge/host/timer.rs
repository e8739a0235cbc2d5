//! The nRF51's TIMER0 as far as the judge's program uses it, and nothing else.
//!
//! What can go wrong: it takes a core cycle for one instruction, so it only tells the truth with uniform timing.

use sim::bus::{Bus, BusFault, Size};

const TIMER0: u32 = 0x4000_8000;
const NANOSECONDS_PER_INSTRUCTION: u64 = 1024;

/// The timer's registers.
#[derive(Default)]
pub(crate) struct Timer {
    started: Option<u64>,
    captured: u32,
}

impl Bus for Timer {
    fn read(&mut self, address: u32, _: Size, _: u64) -> Result<u32, BusFault> {
        match address - TIMER0 {
            0x540 => Ok(self.captured),
            _ => Err(BusFault { address, why: "not a register of the timer" }),
        }
    }

    fn write(&mut self, address: u32, _: Size, _: u32, cycle: u64) -> Result<(), BusFault> {
        match address.wrapping_sub(TIMER0) {
            0x000 => self.started = Some(cycle),
            0x040 => {
                let instructions = self.started.map_or(0, |started| cycle - started);
                self.captured = (instructions * NANOSECONDS_PER_INSTRUCTION * 2 / 125) as u32;
            }
            0x508 | 0x510 => {}
            _ => {
                return Err(BusFault { address, why: "not a register of the timer" });
            }
        }
        Ok(())
    }

    fn lines(&self) -> u32 {
        0
    }

    fn next_event(&self) -> u64 {
        u64::MAX
    }

    fn advance(&mut self, _: u64) {}
}
