//! How this chip goes down: the breadcrumb is left, and the chip resets.
//!
//! | end | what is left | what the next health frame says |
//! |---|---|---|
//! | panic | the line | `Panic`, the line |
//! | HardFault | the program counter | `Fault`, the program counter |
//! | a fault within a fault, a stack that ran over | RESETREAS: lock-up resets the chip (PS 5.3) | `Fault`, 0 |
//! | hang | RESETREAS: watchdog | `Watchdog`, 0 |
//!
//! What can go wrong: no reset clears RAM (PS 5.3), but one by power dip or watchdog may leave it damaged.

use core::panic::PanicInfo;
use core::sync::atomic::{AtomicBool, Ordering};

use cortex_m_rt::{ExceptionFrame, exception};

use crate::cause::{Boot, Cause};
use crate::mote::crumb::{Crumb, Kind};

// SAFETY: `.uninit` is ordinary RAM that start-up leaves alone (cortex-m-rt's link.x); any bits are a valid `Crumb`.
#[unsafe(link_section = ".uninit.crumb")]
static CRUMB: Crumb = Crumb::new();

/// Reads what the last run left; to be called once.
pub fn boot(cause: Cause) -> Boot {
    Boot::of(cause, &CRUMB)
}

#[panic_handler]
fn panic(info: &PanicInfo) -> ! {
    static AGAIN: AtomicBool = AtomicBool::new(false);
    cortex_m::interrupt::disable();
    let (file, line) = info.location().map_or(("?", 0), |location| (location.file(), location.line()));
    // The log panics where it is taken already: then that was the first panic, and this one has nothing to add.
    if !AGAIN.swap(true, Ordering::Relaxed) {
        CRUMB.leave(Kind::Panic, line);
        defmt::error!("panic at {=str}:{=u32}", file, line);
    }
    cortex_m::peripheral::SCB::sys_reset()
}

// SAFETY: the handler touches no memory of the interrupted code; it writes its atomics and resets.
#[exception]
unsafe fn HardFault(frame: &ExceptionFrame) -> ! {
    CRUMB.leave(Kind::HardFault, frame.pc());
    cortex_m::peripheral::SCB::sys_reset()
}
