//! The breadcrumb: left before the core is reset, and read after.
//!
//! What can go wrong: the chip is RAM only, so a reset that also drops the code RAM leaves the mote silent until it is
//! booted again; whether a core reset does is not documented.

use crate::mote::crumb::Crumb;
pub use crate::mote::crumb::{Crash, Kind};

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
