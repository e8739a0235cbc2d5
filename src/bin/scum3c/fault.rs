//! How this chip goes down: a panic, a fault, an exception that has no handler.
//!
//! What can go wrong: a panic while the log is taken. It logs once more, and the log leaves the breadcrumb, of
//! [`Kind::Log`].

use core::panic::PanicInfo;

use cortex_m_rt::{ExceptionFrame, exception};

use crate::crash::{Kind, reset};
use crate::uart_log;

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

// SAFETY: as for the fault. A supervisor call that nobody wrote would otherwise loop above every other priority.
#[exception]
unsafe fn DefaultHandler(number: i16) {
    reset(Kind::Stray, number as u32)
}
