//! Why the chip started: the bits of RESETREAS in words, and what a health frame makes of them.
//!
//! | end | what is left of it | what the next health frames say |
//! |---|---|---|
//! | panic | the breadcrumb | `Panic`, the line |
//! | HardFault | the breadcrumb | `Fault`, the program counter |
//! | a fault within a fault, a stack that ran over | RESETREAS: lock-up resets the chip (PS 5.3) | `Fault`, 0 |
//! | hang | RESETREAS: watchdog | `Watchdog`, 0 |
//!
//! What can go wrong: no reset clears RAM (PS 5.3), but one by power dip or watchdog may leave it damaged.
//!
//! Bits add up until they are cleared, and bring-up clears them, so there is one cause at a time; but where the reset
//! pin's bit is set, others may be set for no reason (erratum 136), so it counts alone.

use lighthouse_mote::frame::Reset;

use super::mote::crumb::{Crash, Crumb};

/// Why the chip started.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(target_os = "none", derive(defmt::Format))]
pub enum Cause {
    /// Power came, or came back after a dip: no bit at all.
    Power,
    /// The reset pin.
    Pin,
    /// The watchdog was not fed.
    Watchdog,
    /// A fault within a fault.
    Lockup,
    /// The program asked for it.
    Software,
    /// Something woke it from being off: the bits.
    Wake(u32),
}

impl Cause {
    /// From the register (PS 5.3, RESETREAS): pin 0, watchdog 1, software 2, lock-up 3, wake-ups above.
    pub const fn from_bits(bits: u32) -> Self {
        match bits {
            0 => Self::Power,
            _ if bits & 1 != 0 => Self::Pin,
            _ if bits & 1 << 1 != 0 => Self::Watchdog,
            _ if bits & 1 << 3 != 0 => Self::Lockup,
            _ if bits & 1 << 2 != 0 => Self::Software,
            _ => Self::Wake(bits),
        }
    }
}

/// How this run began.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(target_os = "none", derive(defmt::Format))]
pub struct Boot {
    /// What started the chip.
    pub cause: Cause,
    /// The crash before, if there was one.
    pub crash: Option<Crash>,
}

impl Boot {
    /// What `crumb` has to say about a start by `cause`; to be asked once. Where power was away, it is noise.
    pub fn of(cause: Cause, crumb: &Crumb) -> Self {
        if cause == Cause::Power {
            crumb.forget();
        }
        Self { cause, crash: crumb.take() }
    }

    /// As every health frame says it, and where it was. A crash explains the reset that it asked for.
    pub fn reset(&self) -> (Reset, u32) {
        match (self.crash, self.cause) {
            (Some(crash), _) => (crash.reset(), crash.at),
            (None, Cause::Power | Cause::Wake(_)) => (Reset::PowerOn, 0),
            (None, Cause::Pin | Cause::Software) => (Reset::Requested, 0),
            (None, Cause::Watchdog) => (Reset::Watchdog, 0),
            // A stack that ran over ends so: the fault handler had nowhere to stand.
            (None, Cause::Lockup) => (Reset::Fault, 0),
        }
    }
}
