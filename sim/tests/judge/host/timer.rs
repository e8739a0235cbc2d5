//! The nRF51's TIMER0 and TIMER1 as far as the judge's program uses them, and nothing else: one counts instructions, the
//! other interrupts.
//!
//! What can go wrong: they take a core cycle for one instruction, so they only tell the truth with uniform timing.

use sim::bus::{Bus, BusFault, Size};

const TIMER0: u32 = 0x4000_8000;
const TIMER1: u32 = 0x4000_9000;
const TIMER1_LINE: u32 = 9;
const NANOSECONDS_PER_INSTRUCTION: u64 = 1024;

/// The timers' registers.
pub(crate) struct Timer {
    started: Option<u64>,
    captured: u32,
    compare_ticks: u32,
    due: u64,
    compared: bool,
}

impl Default for Timer {
    fn default() -> Self {
        Self { started: None, captured: 0, compare_ticks: 0, due: u64::MAX, compared: false }
    }
}

impl Timer {
    fn start_second(&mut self, cycle: u64) {
        // QEMU's time at an access is after the instruction that makes it; the first instruction that begins later is the
        // one that is interrupted.
        let nanoseconds = u64::from(self.compare_ticks) * 125 / 2;
        self.due = cycle + 1 + nanoseconds.div_ceil(NANOSECONDS_PER_INSTRUCTION);
    }
}

impl Timer {
    /// Whether the second timer's moment has come by `cycle`.
    pub(crate) fn is_due(&self, cycle: u64) -> bool {
        self.due <= cycle
    }

    /// Lets it happen.
    pub(crate) fn fire(&mut self) {
        self.due = u64::MAX;
        self.compared = true;
    }
}

impl Bus for Timer {
    fn read(&mut self, address: u32, _: Size, _: u64) -> Result<u32, BusFault> {
        match address.wrapping_sub(TIMER0) {
            0x540 => Ok(self.captured),
            _ => Err(BusFault { address, why: "not a register of the timers" }),
        }
    }

    fn write(&mut self, address: u32, _: Size, value: u32, cycle: u64) -> Result<(), BusFault> {
        match (address & !0xFFF, address & 0xFFF) {
            (TIMER0, 0x000) => self.started = Some(cycle),
            (TIMER0, 0x040) => {
                let instructions = self.started.map_or(0, |started| cycle - started);
                self.captured = (instructions * NANOSECONDS_PER_INSTRUCTION * 2 / 125) as u32;
            }
            (TIMER1, 0x000) => self.start_second(cycle),
            (TIMER1, 0x004) => self.due = u64::MAX,
            (TIMER1, 0x140) => self.compared = value != 0,
            (TIMER1, 0x540) => self.compare_ticks = value,
            (TIMER0 | TIMER1, 0x508 | 0x510) | (TIMER1, 0x00C | 0x304) => {}
            _ => {
                return Err(BusFault { address, why: "not a register of the timers" });
            }
        }
        Ok(())
    }

    fn lines(&self) -> u32 {
        u32::from(self.compared) << TIMER1_LINE
    }

    // It is fired from outside, at the moment that QEMU does it.
    fn next_event(&self) -> u64 {
        u64::MAX
    }

    fn advance(&mut self, _: u64) {}
}
