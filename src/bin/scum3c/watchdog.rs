//! A mote that no longer speaks starts again.
//!
//! Whatever else it does, a mote sends a health frame a second: the radio timer counts, its alarm rings, both stages and
//! the transmitter do their work. So one count is enough: how often the core's own timer has come round since a frame
//! left. It comes round each 2^24 cycles, 1.7 s at 10 MHz, and runs whatever the radio timer does.
//!
//! The handler has the priority of the edges and the lowest exception number, so that not even a line that storms keeps
//! it waiting; it delays one edge in a thousand by 2 us at most.
//!
//! What can go wrong: interrupts are off for good, or the core is locked up. The chip has no watchdog of its own.

use core::sync::atomic::{AtomicU32, Ordering};

use crate::fault;
use crate::pac::systick;

/// Rounds without a frame: 3.4 to 5 s at 10 MHz, several health frames.
const PATIENCE: u32 = 3;

/// Rounds since a frame left.
static QUIET: AtomicU32 = AtomicU32::new(0);

/// Begins to watch.
pub fn start() {
    systick::RELOAD.write(0xff_ffff);
    systick::CONTROL.write(systick::ENABLE | systick::INTERRUPT | systick::CORE_CLOCK);
}

/// A frame has left.
pub fn feed() {
    QUIET.store(0, Ordering::Relaxed);
}

/// The core's timer has come round.
pub fn round() {
    let quiet = QUIET.load(Ordering::Relaxed) + 1;
    QUIET.store(quiet, Ordering::Relaxed);
    if quiet >= PATIENCE {
        fault::reset(fault::Kind::Watchdog, 0);
    }
}
