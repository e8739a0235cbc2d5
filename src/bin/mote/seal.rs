//! Frames under the room's key, and a counter that never comes back to where it was.
//!
//! The counter lives in memory that no start-up clears, so that a reset goes on counting. Power-off clears it; it then
//! begins where the programmer said, which is later each time ([`FirstCounter`]).
//!
//! A sealed frame is kept for the mote's turn, which it may have been made for ahead
//! ([`ahead_half_turns`](lighthouse_mote::send::Config::ahead_half_turns)).
//!
//! What can go wrong: power comes back to a mote whose program stayed, as an nRF52840's does, and nobody programmed it
//! again: its counter begins where it began before, and listeners refuse it as replayed until it has passed what they
//! know. After power-on the memory is noise; a counter is believed where its complement lies beside it.

use core::sync::atomic::{AtomicU32, Ordering};

use heapless::Deque;
use lighthouse_mote::frame::secured::{KEY_LEN, Key};
use lighthouse_mote::frame::{Aligned, Report};
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

/// What is sealed next: one frame at a time, and light and transmitter have their say between them.
#[derive(Debug, Clone, Copy, Default)]
pub enum Due {
    /// Nothing.
    #[default]
    Nothing,
    /// A report.
    Report(Report),
    /// A health frame behind a report, if a second has passed.
    Health,
}

/// Frames of one turn: a report and a health frame.
const TURN: usize = 2;

/// Secures one frame after the other, and keeps them.
///
/// The cipher is made of the key anew for each frame: kept in data memory, a bit of it that flips would make every frame a
/// forged one from then on, unseen by the watchdog, for frames leave.
pub struct Seal {
    counter: u32,
    kept: &'static Kept,
    /// One more than a turn's, which is more than there should be.
    frames: Deque<Aligned, { TURN + 1 }>,
}

impl Seal {
    /// From where it was or from where the programmer said, whichever is later.
    pub fn new(first: &'static FirstCounter, kept: &'static Kept) -> Self {
        let first = first.read();
        let counter = kept.counter().unwrap_or(first).max(first);
        Self { counter, kept, frames: Deque::new() }
    }

    /// Secures the frame that `emit` makes under `key` and keeps it; whether there are more than one turn's now, so that the oldest has
    /// to go.
    #[inline(always)]
    pub fn make(&mut self, key: &[u8; KEY_LEN], emit: impl FnOnce(&mut Aligned)) -> bool {
        let mut frame = Aligned::BLANK;
        emit(&mut frame);
        self.seal(key, &mut frame);
        let _ = self.frames.push_back(frame);
        self.frames.len() > TURN
    }

    /// The oldest one that was kept.
    pub fn oldest(&mut self) -> Option<Aligned> {
        self.frames.pop_front()
    }

    /// Secures a plain frame where it is.
    #[inline(never)]
    fn seal(&mut self, key: &[u8; KEY_LEN], frame: &mut Aligned) {
        let counter = self.counter;
        // Used up after 13 years of 10 frames a second: the frame stays plain, which listeners with a key refuse.
        let Some(next) = counter.checked_add(1) else { return };
        self.counter = next;
        self.kept.keep(next);
        let _ = Key::new(key).seal(frame, counter);
    }
}
