//! How a board goes down that has nothing of its own to do then: the breadcrumb is left, and the chip resets.
//!
//! What can go wrong: a panic while the log is taken. It logs once more, which panics: then that was the first one, and
//! the second has nothing to add.

use core::panic::PanicInfo;
use core::sync::atomic::{AtomicBool, Ordering};

use cortex_m_rt::{ExceptionFrame, exception};

use crate::mote::crumb::{Crumb, Kind};

/// What is left.
// SAFETY: `.uninit` is ordinary RAM that start-up leaves alone (cortex-m-rt's link.x); any bits are a valid `Crumb`.
#[unsafe(link_section = ".uninit.crumb")]
pub static CRUMB: Crumb = Crumb::new();

#[panic_handler]
fn panic(info: &PanicInfo) -> ! {
    static PANICKED: AtomicBool = AtomicBool::new(false);
    cortex_m::interrupt::disable();
    let (file, line) = info.location().map_or(("?", 0), |location| (location.file(), location.line()));
    // A load and a store: some cores have no swap, and nothing interrupts this.
    if !PANICKED.load(Ordering::Relaxed) {
        PANICKED.store(true, Ordering::Relaxed);
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
