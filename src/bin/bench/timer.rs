//! Counts instructions in QEMU: the nRF51's TIMER0 at 16 MHz, where one instruction takes 1024 ns (`shift=10`).
//!
//! What can go wrong: 32 bits of ticks are 262 million instructions; nobody may count longer than that.

const TIMER0: usize = 0x4000_8000;
const TASKS_START: usize = 0x000;
const TASKS_CAPTURE0: usize = 0x040;
const BITMODE: usize = 0x508;
const PRESCALER: usize = 0x510;
const CC0: usize = 0x540;

fn write(offset: usize, value: u32) {
    // SAFETY: a register of the timer.
    unsafe { ((TIMER0 + offset) as *mut u32).write_volatile(value) }
}

/// Starts counting, over all 32 bits.
pub fn start() {
    write(BITMODE, 3);
    write(PRESCALER, 0);
    write(TASKS_START, 1);
}

/// Ticks since the start.
pub fn now() -> u32 {
    write(TASKS_CAPTURE0, 1);
    // SAFETY: a register of the timer.
    unsafe { ((TIMER0 + CC0) as *const u32).read_volatile() }
}
