//! Frames under the room's key, and a counter that never comes back to where it was.
//!
//! The counter lives in memory that no start-up clears, so that a reset goes on counting. Power-off clears it; it then
//! begins where the programmer said, which is later each time ([`FirstCounter`]).
//!
//! What can go wrong: power comes back to a mote whose program stayed, as an nRF52840's does, and nobody programmed it
//! again: its counter begins where it began before, and listeners refuse it as replayed until it has passed what they
//! know. After power-on the memory is noise; a counter is believed where its complement lies beside it.

use core::sync::atomic::{AtomicU32, Ordering};

use lighthouse_mote::frame::Aligned;
use lighthouse_mote::frame::secured::{KEY_LEN, Key};
use lighthouse_mote::identity::FirstCounter;

/// The counter of the next frame, and its complement. Any bits are a valid one.
#[derive(Debug)]
pub struct Kept {
    counter: AtomicU32,
    complement: AtomicU32,
}

impl Kept {
    /// Nothing kept.
    pub const fn new() -> Self {
        Self { counter: AtomicU32::new(0), complement: AtomicU32::new(0) }
    }

    /// The counter of the next frame, if there was one before.
    fn counter(&self) -> Option<u32> {
        let counter = self.counter.load(Ordering::Relaxed);
        (counter == !self.complement.load(Ordering::Relaxed)).then_some(counter)
    }

    fn keep(&self, counter: u32) {
        self.counter.store(counter, Ordering::Relaxed);
        self.complement.store(!counter, Ordering::Relaxed);
    }
}

/// Secures one frame after the other.
pub struct Seal {
    key: Key,
    counter: u32,
    kept: &'static Kept,
}

impl Seal {
    /// Under that key, from where it was or from where the programmer said, whichever is later.
    pub fn new(key: &[u8; KEY_LEN], first: &'static FirstCounter, kept: &'static Kept) -> Self {
        let first = first.read();
        Self { key: Key::new(key), counter: kept.counter().unwrap_or(first).max(first), kept }
    }

    /// Secures a plain frame where it is.
    #[inline(never)]
    pub fn seal(&mut self, frame: &mut Aligned) {
        let counter = self.counter;
        // Used up after 13 years of 10 frames a second: the frame stays plain, which listeners with a key refuse.
        let Some(next) = counter.checked_add(1) else { return };
        self.counter = next;
        self.kept.keep(next);
        let _ = self.key.seal(frame, counter);
    }
}
