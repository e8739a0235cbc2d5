//! Light to pulses, in two interrupt handlers of a few dozen cycles.
//!
//! The receiver's output is wired to pins 8 and 9. Line [`RISE`] is active while it is high, line [`FALL`] while it is
//! low: both are level sensitive, so exactly one of them is enabled at any time, and each handler hands over to the
//! other. Rises and falls therefore alternate by construction, and only the fall, which completes a pulse, pays for
//! the queue.
//!
//! The queue is made of relaxed atomics and two compiler fences: on one core the order of the instructions is the order
//! of the accesses, and a general queue with its barriers takes 12 cycles more.
//!
//! Cycles by the Cortex-M0's table, entry and return not counted: rise 33, fall 59, of which 8 and 10 until the stamp.
//!
//! What can go wrong: a pulse shorter than the rise handler ends late (its fall waits for the handler to return); the
//! queue is full (the whole pulse is dropped and both its edges counted, and what comes until all that waits is done is not
//! even seen). Whoever masks one of the two lines, or all
//! interrupts, delays a stamp: nothing in this binary does outside start-up. In particular RTIC's `lock` and `spawn`
//! do, so neither is used.

use core::sync::atomic::{AtomicU16, AtomicU32, Ordering, compiler_fence};

use lighthouse_mote::pulse::Pulse;
use lighthouse_mote::time::Ticks;

use crate::mote::stages::Pulses;
use crate::pac::{Interrupt, nvic};

/// The line that is active in the light.
const RISE: u32 = Interrupt::GPIO8.bit();
/// The line that is active in the dark.
const FALL: u32 = Interrupt::GPIO9.bit();
/// Pended to have [`look_again`] called when there is nothing else left to do.
const AGAIN: u32 = Interrupt::SOFT15.bit();
/// Both: to be left alone by everyone else.
pub const EDGES: u32 = RISE | FALL;

/// Pulses in the queue: a power of two, so that its index is a mask. Three pulses come in 8.3 ms.
const LEN: usize = 16;

/// The queue. Every field has one writer. The counters come first, where one instruction reaches them.
#[repr(C)]
struct Queue {
    /// The rise waiting for its fall. [`Capture`]'s.
    rise: AtomicU32,
    /// Pulses ever written, wrapping. [`Capture`]'s.
    written: AtomicU32,
    /// Pulses ever read, wrapping. [`Reader`]'s.
    read: AtomicU32,
    /// Edges dropped because there was no room, wrapping. [`Capture`]'s.
    lost: AtomicU16,
    /// Rise and fall of each pulse. [`Capture`]'s.
    pulses: [[AtomicU32; 2]; LEN],
}

static QUEUE: Queue = Queue {
    rise: AtomicU32::new(0),
    written: AtomicU32::new(0),
    read: AtomicU32::new(0),
    lost: AtomicU16::new(0),
    pulses: [const { [const { AtomicU32::new(0) }; 2] }; LEN],
};

/// Pulses written and not yet read; modulo twice the length, so that a count that is wrong, for a bit of it has flipped,
/// is a few pulses lost or read again. More than [`LEN`] only then.
#[inline(always)]
fn waiting(written: u32, read: u32) -> u32 {
    written.wrapping_sub(read) % (2 * LEN as u32)
}

/// Counts the two edges of a pulse. A call, for the compiler else makes every other pulse jump.
#[cold]
#[inline(never)]
fn lose() {
    QUEUE.lost.store(lost().wrapping_add(2), Ordering::Relaxed);
}

/// Where both lines are closed, has [`look_again`] called when there is nothing else left to do.
#[inline(always)]
pub fn catch_up() {
    if nvic::ISER.read() & EDGES == 0 {
        nvic::ISPR.write(AGAIN);
    }
}

/// Everything that was waiting has been done: waits for light again. Where there is light already, its pulse is cut short.
pub fn look_again() {
    open(RISE);
}

/// Edges dropped so far, wrapping.
pub fn lost() -> u16 {
    QUEUE.lost.load(Ordering::Relaxed)
}

/// The writer's end, for the two handlers; they have one priority and cannot interrupt each other.
pub struct Capture(());

/// The reader's end.
pub struct Reader {
    most: u32,
}

/// Waits for light; to be called once, while interrupts are off.
///
/// RTIC enables both lines before `init`; in the dark [`FALL`] is active already.
pub fn start() -> (Capture, Reader) {
    nvic::ICER.write(FALL);
    nvic::ISER.write(RISE);
    (Capture(()), Reader { most: 0 })
}

impl Capture {
    /// The light has come on.
    #[inline(always)]
    pub fn rise(&mut self, at: Ticks) {
        nvic::ICER.write(RISE);
        open(FALL);
        QUEUE.rise.store(at.0, Ordering::Relaxed);
    }

    /// The light has gone off: a pulse is complete.
    ///
    /// Where there is no room for the pulse, both lines stay closed until [`look_again`]: light that storms would otherwise
    /// leave the processor to these two handlers and what reads their queue.
    #[inline(always)]
    pub fn fall(&mut self, at: Ticks) {
        nvic::ICER.write(FALL);
        let written = QUEUE.written.load(Ordering::Relaxed);
        if waiting(written, QUEUE.read.load(Ordering::Relaxed)) >= LEN as u32 {
            return lose();
        }
        open(RISE);
        let [rise, fall] = &QUEUE.pulses[written as usize % LEN];
        rise.store(QUEUE.rise.load(Ordering::Relaxed), Ordering::Relaxed);
        fall.store(at.0, Ordering::Relaxed);
        compiler_fence(Ordering::Release);
        QUEUE.written.store(written.wrapping_add(1), Ordering::Relaxed);
    }
}

impl Pulses for Reader {
    #[inline(always)]
    fn is_empty(&self) -> bool {
        waiting(QUEUE.written.load(Ordering::Relaxed), QUEUE.read.load(Ordering::Relaxed)) == 0
    }

    fn most(&self) -> u8 {
        self.most as u8
    }

    #[inline(always)]
    fn next(&mut self) -> Option<Pulse> {
        let read = QUEUE.read.load(Ordering::Relaxed);
        let waiting = waiting(QUEUE.written.load(Ordering::Relaxed), read);
        if waiting == 0 {
            return None;
        }
        if waiting > self.most {
            self.most = waiting;
        }
        compiler_fence(Ordering::Acquire);
        let [rise, fall] = &QUEUE.pulses[read as usize % LEN];
        let start = Ticks(rise.load(Ordering::Relaxed));
        let pulse = Pulse { start, width: Ticks(fall.load(Ordering::Relaxed)).since(start) };
        compiler_fence(Ordering::Release);
        QUEUE.read.store(read.wrapping_add(1), Ordering::Relaxed);
        Some(pulse)
    }
}

/// Opens a line. What it left pending from before is void; if it is active again already, it pends itself anew.
#[inline(always)]
fn open(line: u32) {
    nvic::ICPR.write(line);
    nvic::ISER.write(line);
}
