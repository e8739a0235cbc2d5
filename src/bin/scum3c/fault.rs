//! How this chip goes down: the breadcrumb is left, and the core is reset.
//!
//! What can go wrong: the chip is RAM only, so a reset that also drops the code RAM leaves the mote silent until it is
//! booted again; whether a core reset does is not documented.

use core::panic::PanicInfo;

use cortex_m_rt::{ExceptionFrame, exception};

use crate::mote::crumb::Crumb;
pub use crate::mote::crumb::{Crash, Kind};
use crate::uart_log;

// SAFETY: `.uninit` is ordinary RAM that start-up leaves alone (cortex-m-rt's link.x); any bits are a valid `Crumb`.
#[unsafe(link_section = ".uninit.crumb")]
static CRUMB: Crumb = Crumb::new();

/// The crash before this boot, if there was one; after power-on there was none.
pub fn last() -> Option<Crash> {
    CRUMB.take()
}

/// Leaves the breadcrumb and starts again.
pub fn reset(kind: Kind, at: u32) -> ! {
    CRUMB.leave(kind, at);
    cortex_m::peripheral::SCB::sys_reset()
}

#[panic_handler]
fn panic(info: &PanicInfo) -> ! {
    cortex_m::interrupt::disable();
    let (file, line) = info.location().map_or(("?", 0), |location| (location.file(), location.line()));
    defmt::error!("panic at {=str}:{=u32}", file, line);
    uart_log::drain();
    reset(Kind::Panic, line)
}

// SAFETY: the handler touches no memory of the interrupted code; it writes its atomics and resets.
#[exception]
unsafe fn HardFault(frame: &ExceptionFrame) -> ! {
    reset(Kind::HardFault, frame.pc())
}
