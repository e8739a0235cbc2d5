//! What is left of a crash: a breadcrumb in memory that no start-up clears, and a reset.
//!
//! A mote in the field has nobody watching; it starts again and says at the next boot what happened. [`Boot`] is kept
//! as long as the mote runs, for whoever comes to ask.
//!
//! What can go wrong: after power-on the breadcrumb is noise, which the magic word tells apart. No reset clears RAM (PS
//! 5.3), but one by power dip or watchdog may leave it damaged.

use core::panic::PanicInfo;
use core::sync::atomic::{AtomicBool, AtomicU32, Ordering};

use cortex_m_rt::{ExceptionFrame, exception};

use crate::cause::Cause;

/// Says that the words beside it were written by [`reset`] and not by power-on.
const MAGIC: u32 = 0x4c69_6768;

/// What kind of end it was.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// A panic; `at` is the line.
    Panic = 1,
    /// A HardFault; `at` is the program counter.
    HardFault = 2,
}

/// What was left.
#[derive(Debug, Clone, Copy, defmt::Format)]
pub struct Crash {
    /// Crashes since power-on.
    pub count: u32,
    /// The last one's [`Kind`].
    pub kind: u32,
    /// Where.
    pub at: u32,
}

/// How this run began.
#[derive(Debug, Clone, Copy, defmt::Format)]
pub struct Boot {
    /// What started the chip.
    pub cause: Cause,
    /// The crash before, if there was one.
    pub crash: Option<Crash>,
}

struct Crumb {
    magic: AtomicU32,
    count: AtomicU32,
    kind: AtomicU32,
    at: AtomicU32,
}

// SAFETY: `.uninit` is ordinary RAM that start-up leaves alone (cortex-m-rt's link.x); any bits are a valid `Crumb`.
#[unsafe(link_section = ".uninit.crumb")]
static CRUMB: Crumb =
    Crumb { magic: AtomicU32::new(0), count: AtomicU32::new(0), kind: AtomicU32::new(0), at: AtomicU32::new(0) };

/// Reads what the last run left; to be called once.
pub fn boot(cause: Cause) -> Boot {
    let written = CRUMB.magic.swap(0, Ordering::Relaxed) == MAGIC;
    if cause == Cause::Power {
        CRUMB.count.store(0, Ordering::Relaxed);
    }
    let crash = (written && cause != Cause::Power).then(|| Crash {
        count: CRUMB.count.load(Ordering::Relaxed),
        kind: CRUMB.kind.load(Ordering::Relaxed),
        at: CRUMB.at.load(Ordering::Relaxed),
    });
    Boot { cause, crash }
}

/// Leaves the breadcrumb.
fn leave(kind: Kind, at: u32) {
    CRUMB.count.store(CRUMB.count.load(Ordering::Relaxed).wrapping_add(1), Ordering::Relaxed);
    CRUMB.kind.store(kind as u32, Ordering::Relaxed);
    CRUMB.at.store(at, Ordering::Relaxed);
    CRUMB.magic.store(MAGIC, Ordering::Release);
}

#[panic_handler]
fn panic(info: &PanicInfo) -> ! {
    static AGAIN: AtomicBool = AtomicBool::new(false);
    cortex_m::interrupt::disable();
    let (file, line) = info.location().map_or(("?", 0), |location| (location.file(), location.line()));
    // The log panics where it is taken already: then that was the first panic, and this one has nothing to add.
    if !AGAIN.swap(true, Ordering::Relaxed) {
        leave(Kind::Panic, line);
        defmt::error!("panic at {=str}:{=u32}", file, line);
    }
    cortex_m::peripheral::SCB::sys_reset()
}

// SAFETY: the handler touches no memory of the interrupted code; it writes its atomics and resets.
#[exception]
unsafe fn HardFault(frame: &ExceptionFrame) -> ! {
    leave(Kind::HardFault, frame.pc());
    cortex_m::peripheral::SCB::sys_reset()
}
