//! Why the chip started: the bits of RESETREAS in words.
//!
//! Bits add up until they are cleared, and bring-up clears them, so there is one cause at a time; but where the reset
//! pin's bit is set, others may be set for no reason (erratum 136), so it counts alone.

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
