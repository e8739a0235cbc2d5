//! The watchdog that the chip has not: the core's own timer interrupts at the edges' priority, which nothing else has, and
//! wants a frame to have left since it last did.
//!
//! What can go wrong: an edge handler that hangs, or a clock that stops, hangs the watchdog too.

use core::sync::atomic::{AtomicU32, Ordering};

use crate::crash::{Kind, reset};
use crate::pac::syst;

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
