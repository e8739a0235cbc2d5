//! Light to pulses, in two interrupt handlers of a few dozen cycles.
//!
//! The receiver's output is wired to pins 8 and 9. Line [`RISE`] is active while it is high, line [`FALL`] while it is
//! low: both are level sensitive, so exactly one of them is enabled at any time, and each handler hands over to the
//! other. Rises and falls therefore alternate by construction, and only the fall, which completes a pulse, pays for
//! the queue.
//!
//! What can go wrong: a pulse shorter than the rise handler ends late (its fall waits for the handler to return); the
//! queue is full (the whole pulse is dropped and both its edges counted). Whoever masks one of the two lines, or all
//! interrupts, delays a stamp: nothing in this binary does outside start-up. In particular RTIC's `lock` and `spawn`
//! do, so neither is used.

use core::sync::atomic::{AtomicU16, Ordering};

use heapless::spsc::{Consumer, Producer, Queue};
use lighthouse_mote::edge::Edge;
use lighthouse_mote::time::Ticks;

use crate::pac::{Interrupt, nvic};

/// The line that is active in the light.
const RISE: u32 = Interrupt::GPIO8.bit();
/// The line that is active in the dark.
const FALL: u32 = Interrupt::GPIO9.bit();
/// Both: to be left alone by everyone else.
pub const EDGES: u32 = RISE | FALL;

/// Pulses in the queue, plus one: a power of two, so that its indices wrap by a mask.
const LEN: usize = 16;

/// Edges dropped because the queue was full. Written by the fall handler alone.
static LOST: AtomicU16 = AtomicU16::new(0);

/// Edges dropped so far, wrapping.
pub fn lost() -> u16 {
    LOST.load(Ordering::Relaxed)
}

/// One interval of light, as stamped.
#[derive(Debug, Clone, Copy)]
pub struct Lit {
    rise: Ticks,
    fall: Ticks,
}

impl Lit {
    /// As the edges it is made of.
    pub const fn edges(self) -> [Edge; 2] {
        [Edge::rise(self.rise), Edge::fall(self.fall)]
    }
}

/// The memory between the handlers and their reader.
pub type Pulses = Queue<Lit, LEN>;

/// What the two handlers share; they have one priority and cannot interrupt each other.
pub struct Capture {
    rise: Ticks,
    pulses: Producer<'static, Lit>,
}

/// The reader's end.
pub struct Reader(Consumer<'static, Lit>);

/// Splits the queue and waits for light, to be called while interrupts are off.
///
/// RTIC enables both lines before `init`; in the dark [`FALL`] is active already.
pub fn start(pulses: &'static mut Pulses) -> (Capture, Reader) {
    nvic::ICER.write(FALL);
    nvic::ISER.write(RISE);
    let (producer, consumer) = pulses.split();
    (Capture { rise: Ticks(0), pulses: producer }, Reader(consumer))
}

impl Capture {
    /// The light has come on.
    #[inline(always)]
    pub fn rise(&mut self, at: Ticks) {
        hand_over(RISE, FALL);
        self.rise = at;
    }

    /// The light has gone off: a pulse is complete.
    #[inline(always)]
    pub fn fall(&mut self, at: Ticks) {
        hand_over(FALL, RISE);
        // The queue divides by its length, which it has forgotten at compile time. Comparing it with a constant turns
        // a hundred cycles of division into a mask.
        let whole = self.pulses.capacity() == LEN - 1;
        if !whole || self.pulses.enqueue(Lit { rise: self.rise, fall: at }).is_err() {
            LOST.store(LOST.load(Ordering::Relaxed).wrapping_add(2), Ordering::Relaxed);
        }
    }
}

impl Reader {
    /// The oldest pulse not yet read.
    #[inline]
    pub fn next(&mut self) -> Option<Lit> {
        // As in `fall`.
        if self.0.capacity() == LEN - 1 { self.0.dequeue() } else { None }
    }
}

/// Closes the line that just fired and opens the other.
///
/// What the other line left pending from before is void; if it is active again already, it pends itself anew.
#[inline(always)]
fn hand_over(from: u32, to: u32) {
    nvic::ICER.write(from);
    nvic::ICPR.write(to);
    nvic::ISER.write(to);
}
