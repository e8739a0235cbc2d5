//! How this chip goes down: the breadcrumb is left, and the core is reset.
//!
//! The chip has no watchdog, so the core's own timer is one: it interrupts at the edges' priority, which nothing else has,
//! and wants a frame to have left since it last did.
//!
//! What can go wrong: the chip is RAM only, so a reset that also drops the code RAM leaves the mote silent until it is
//! booted again; whether a core reset does is not documented. An edge handler that hangs, or a clock that stops, hangs
//! the watchdog too.

use core::panic::PanicInfo;
use core::sync::atomic::{AtomicU32, Ordering};

use cortex_m_rt::{ExceptionFrame, exception};

use crate::mote::crumb::Crumb;
pub use crate::mote::crumb::{Crash, Kind};
use crate::pac::syst;
use crate::uart_log;

// SAFETY: `.uninit` is ordinary RAM that start-up leaves alone (cortex-m-rt's link.x); any bits are a valid `Crumb`.
#[unsafe(link_section = ".uninit.crumb")]
static CRUMB: Crumb = Crumb::new();

/// The crash before this boot, if there was one; after power-on there was none.
pub fn last() -> Option<Crash> {
    CRUMB.take()
}

/// Leaves the breadcrumb and starts again.
#[cold]
#[inline(never)]
pub fn reset(kind: Kind, at: u32) -> ! {
    CRUMB.leave(kind, at);
    cortex_m::peripheral::SCB::sys_reset()
}

/// Turns of the core's timer without a frame: 5 s at 10 MHz, where a health frame leaves every second, or, where nothing
/// is understood of the light, after two.
const PATIENCE: u32 = 3;

/// Turns since the last frame.
static SILENT: AtomicU32 = AtomicU32::new(0);

/// Starts the watchdog.
pub fn watch() {
    syst::RVR.write(syst::LONGEST);
    syst::CSR.write(syst::RUN);
}

/// A frame has left.
#[inline(always)]
pub fn alive() {
    SILENT.store(0, Ordering::Relaxed);
}

/// The core's timer has come round.
#[inline(always)]
pub fn turn() {
    let silent = SILENT.load(Ordering::Relaxed);
    if silent >= PATIENCE {
        reset(Kind::Watchdog, 0);
    }
    SILENT.store(silent + 1, Ordering::Relaxed);
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

// SAFETY: as for the fault. A supervisor call that nobody wrote would otherwise loop above every other priority.
#[exception]
unsafe fn DefaultHandler(number: i16) {
    reset(Kind::Stray, number as u32)
}
