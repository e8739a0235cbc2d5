//! The chip from reset to the mote's clock.
//!
//! What can go wrong: no crystal, or a dead one. The wait for it has no end of its own; the watchdog, started before,
//! makes one.

use nrf_pac::approtect::vals::Disable;
use nrf_pac::{APPROTECT, CLOCK, POWER};

use crate::cause::Cause;

/// Why this boot; also clears it, so that the next one knows (PS 5.3, RESETREAS: ones clear).
pub fn cause() -> Cause {
    let bits = POWER.resetreas().read();
    POWER.resetreas().write_value(bits);
    Cause::from_bits(bits.0)
}

/// Lets a debugger in after every reset: newer chips (build codes Fxx) lock it out unless the program says this (PS
/// 4.8). Older ones have nothing at that address. Without it no log would come after the first reset.
pub fn debugger() {
    APPROTECT.disable().write(|w| w.set_disable(Disable::SwDisable));
}

/// Starts the 32 MHz crystal and waits for it (PS 5.4). It is never stopped: edges are stamped by it, and the
/// radio needs it.
pub fn crystal() {
    CLOCK.events_hfclkstarted().write_value(0);
    CLOCK.tasks_hfclkstart().write_value(1);
    while CLOCK.events_hfclkstarted().read() == 0 {}
}
