//! What is left of a crash: a breadcrumb in memory that no start-up clears.
//!
//! A mote in the field has nobody watching; it starts again and says in every health frame what happened. The board
//! puts a [`Crumb`] into `.uninit`, leaves it as it goes down, and takes it as it comes up.
//!
//! What can go wrong: after power-on the breadcrumb is noise, which the magic word tells apart, but for one time in
//! 2^32. Where a reset damages memory, the word is damaged too or what it vouches for is wrong.

use core::sync::atomic::{AtomicU32, Ordering};

use lighthouse_mote::frame::Reset;

/// Says that the words beside it were written by [`Crumb::leave`] and not by power-on.
const MAGIC: u32 = 0x4c69_6768;

/// What kind of end it was.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Kind {
    /// A panic; `at` is the line.
    Panic = 1,
    /// A HardFault; `at` is the program counter.
    HardFault = 2,
    /// The log was taken while it was taken.
    Log = 3,
    /// Nothing was said for too long.
    Watchdog = 4,
    /// An interrupt or exception that has no handler; `at` is its number.
    Stray = 5,
}

/// What was left.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Crash {
    /// Crashes since power-on.
    pub count: u32,
    /// The last one's [`Kind`].
    pub kind: u32,
    /// Where.
    pub at: u32,
}

impl Crash {
    /// What health frames say of a start with this behind it, or after power-on: why, and where.
    pub fn told(crash: Option<Self>) -> (Reset, u32) {
        crash.map_or((Reset::PowerOn, 0), |crash| (crash.reset(), crash.at))
    }

    /// As a health frame says it.
    pub const fn reset(&self) -> Reset {
        match self.kind {
            kind if kind == Kind::HardFault as u32 || kind == Kind::Stray as u32 => Reset::Fault,
            kind if kind == Kind::Watchdog as u32 => Reset::Watchdog,
            _ => Reset::Panic,
        }
    }
}

/// The breadcrumb. Any bits are a valid one.
#[derive(Debug)]
pub struct Crumb {
    magic: AtomicU32,
    count: AtomicU32,
    kind: AtomicU32,
    at: AtomicU32,
}

impl Crumb {
    /// Nothing left.
    pub const fn new() -> Self {
        Self { magic: AtomicU32::new(0), count: AtomicU32::new(0), kind: AtomicU32::new(0), at: AtomicU32::new(0) }
    }

    /// The crash before this boot, if there was one; to be called once. After power-on there was none.
    pub fn take(&self) -> Option<Crash> {
        if self.magic.load(Ordering::Relaxed) != MAGIC {
            self.count.store(0, Ordering::Relaxed);
            return None;
        }
        self.magic.store(0, Ordering::Relaxed);
        Some(Crash {
            count: self.count.load(Ordering::Relaxed),
            kind: self.kind.load(Ordering::Relaxed),
            at: self.at.load(Ordering::Relaxed),
        })
    }

    /// Whatever is left is noise: power was away.
    pub fn forget(&self) {
        self.magic.store(0, Ordering::Relaxed);
    }

    /// Leaves it, for [`Self::take`] after the reset that is to follow.
    #[inline(always)]
    pub fn leave(&self, kind: Kind, at: u32) {
        self.count.store(self.count.load(Ordering::Relaxed).wrapping_add(1), Ordering::Relaxed);
        self.kind.store(kind as u32, Ordering::Relaxed);
        self.at.store(at, Ordering::Relaxed);
        self.magic.store(MAGIC, Ordering::Release);
    }
}
