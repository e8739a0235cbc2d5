//! What is left of a crash: a breadcrumb in memory that no start-up clears, and a reset.
//!
//! A mote in the field has nobody watching; it starts again and says at the next boot what happened.
//!
//! What can go wrong: the chip is RAM only, so a reset that also drops the code RAM leaves the mote silent until it is
//! booted again; whether a core reset does is not documented. After power-on the breadcrumb is noise, which the magic
//! word tells apart.

use core::panic::PanicInfo;
use core::sync::atomic::{AtomicU32, Ordering};

use cortex_m_rt::{ExceptionFrame, exception};
use lighthouse_mote::frame::Reset;

use crate::uart_log;

/// Says that the words beside it were written by [`reset`] and not by power-on.
const MAGIC: u32 = 0x4c69_6768;

/// What kind of end it was.
#[derive(Debug, Clone, Copy, PartialEq, Eq, defmt::Format)]
pub enum Kind {
    /// A panic; `at` is the line.
    Panic = 1,
    /// A HardFault; `at` is the program counter.
    HardFault = 2,
    /// The log was taken while it was taken.
    Log = 3,
    /// No frame left for seconds.
    Watchdog = 4,
    /// An exception that nobody handles.
    Stray = 5,
}

/// What was left.
#[derive(Debug, Clone, Copy, defmt::Format)]
pub struct Crash {
    /// Resets of this kind since power-on.
    pub count: u32,
    /// The last one's [`Kind`].
    pub kind: u32,
    /// Where.
    pub at: u32,
}

impl Crash {
    /// As a health frame says it.
    pub const fn reset(&self) -> Reset {
        match self.kind {
            kind if kind == Kind::HardFault as u32 => Reset::Fault,
            kind if kind == Kind::Watchdog as u32 => Reset::Watchdog,
            _ => Reset::Panic,
        }
    }
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

/// The crash before this boot, if there was one; after power-on there was none.
pub fn last() -> Option<Crash> {
    if CRUMB.magic.load(Ordering::Relaxed) != MAGIC {
        CRUMB.count.store(0, Ordering::Relaxed);
        return None;
    }
    CRUMB.magic.store(0, Ordering::Relaxed);
    Some(Crash {
        count: CRUMB.count.load(Ordering::Relaxed),
        kind: CRUMB.kind.load(Ordering::Relaxed),
        at: CRUMB.at.load(Ordering::Relaxed),
    })
}

/// Leaves the breadcrumb and starts again.
#[cold]
#[inline(never)]
pub fn reset(kind: Kind, at: u32) -> ! {
    CRUMB.count.store(CRUMB.count.load(Ordering::Relaxed).wrapping_add(1), Ordering::Relaxed);
    CRUMB.kind.store(kind as u32, Ordering::Relaxed);
    CRUMB.at.store(at, Ordering::Relaxed);
    CRUMB.magic.store(MAGIC, Ordering::Release);
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

// SAFETY: as for `HardFault`. A supervisor call that nobody wrote would otherwise loop above every other priority.
#[exception]
unsafe fn DefaultHandler(line: i16) -> ! {
    reset(Kind::Stray, line as u32)
}
