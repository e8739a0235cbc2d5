//! Light to pulses: stamped by hardware, fetched by one short interrupt handler.
//!
//! ```text
//! pin -> GPIOTE IN[0], light on  -> PPI 0 -> TIMER3 CAPTURE[0]  (when)
//!                                     \fork-> TIMER1 COUNT       (how many)
//! pin -> GPIOTE IN[1], light off -> PPI 1 -> TIMER3 CAPTURE[1]
//!                                     \fork-> TIMER2 COUNT
//!                       `-> interrupt
//! ```
//!
//! No program is in a stamp. An edge waits for the next 16 MHz clock, 62.5 ns at most, and a whole number of clocks from
//! there to the capture (PS 6.16), the same for both edges; so interrupts, the log's critical sections and flash waits
//! do not reach it. They only delay the handler, and that has until the next rise, 260 us or more in Lighthouse light,
//! before anything is overwritten.
//!
//! Nobody clears the event of the light's coming on: an event register that is set already stops no later event on its
//! way to the PPI (PS 6.1).
//!
//! A pin has one channel of GPIOTE at most (PS 6.10), and one channel that reports both edges could not say which it
//! was after two; hence the receiver's output comes to two pins.
//!
//! Each stamp register holds the newest edge only. The two counters say how many there were, so what was overwritten
//! is known exactly; `pairing` decides what is still a pulse. Stamps and counts are read until two counts in a row
//! agree: then no edge came between, and they belong together.
//!
//! A storm of edges (a broken wire, a lamp, D in place of E) must not starve the rest: with the queue full the handler
//! closes the gate, its own interrupt, and the classifier opens it a millisecond after it has caught up. The counters
//! count on, and what was not fetched is lost and known.
//!
//! What can go wrong: an edge that GPIOTE does not see (both levels shorter than its sampling) costs its pulse, or with
//! a second fall in the same handler's delay the next one too; a storm so fast that no two counts agree gives nothing
//! until it is over.

use core::sync::atomic::{AtomicU16, Ordering};

use lighthouse_mote::pulse::Pulse;
use lighthouse_mote::time::{Span, Ticks};
use nrf_pac::gpiote::vals::{Mode, Polarity};
use nrf_pac::gpiote::{regs::Int, vals};
use nrf_pac::timer::vals::{Bitmode, Mode as TimerMode};
use nrf_pac::{GPIOTE, PPI, TIMER1, TIMER2, TIMER3};

use crate::board::{self, Level, Pin, RECEIVER};
use crate::clock::{self, Alarm, TICKS_PER_US};
use crate::mote::queue::{self, Queue, Writer};
use crate::pairing::{Pairing, Sample};

/// GPIOTE channel, PPI channel and capture register of the light's coming on.
const RISE: usize = 0;
/// Those of its going off.
const FALL: usize = 1;
/// Looks at the counters before giving up for this time.
const LOOKS: u8 = 4;
/// How long the gate stays closed after the classifier has caught up: 15 pulses a millisecond are a storm.
const CLOSED_FOR: Span = Span(1000 * TICKS_PER_US);

/// Pulses between handler and classifier: 44 ms of light.
const PULSES: usize = 16;
/// The memory for them.
pub type Pulses = Queue<Pulse, PULSES>;
/// The reader's end.
pub type Reader = queue::Reader<Pulse, PULSES>;

/// Edges that became no pulse, wrapping. Written by [`Capture`] alone.
static LOST: AtomicU16 = AtomicU16::new(0);

/// Edges that became no pulse so far, wrapping.
pub fn lost() -> u16 {
    LOST.load(Ordering::Relaxed)
}

/// The writer's end, for the handler.
pub struct Capture {
    pairing: Pairing,
    pulses: Writer<Pulse, PULSES>,
    dropped: u16,
}

/// Both ends of `pulses`. Nothing comes before [`listen`].
pub fn split(pulses: &'static mut Pulses) -> (Capture, Reader) {
    let (pulses, reader) = pulses.split();
    (Capture { pairing: Pairing::default(), pulses, dropped: 0 }, reader)
}

/// Begins to watch the pins; to be called once, when the receiver is ready and nobody drives them any more: GPIOTE
/// takes a pin that it watches for itself (PS 6.10).
pub fn listen() {
    for counter in [TIMER1, TIMER2] {
        counter.tasks_stop().write_value(1);
        // COUNT counts in counter mode only (PS 6.30).
        counter.mode().write(|w| w.set_mode(TimerMode::LowPowerCounter));
        counter.bitmode().write(|w| w.set_bitmode(Bitmode::_32bit));
        counter.tasks_clear().write_value(1);
        counter.tasks_start().write_value(1);
    }
    let (on, off) = match RECEIVER.lit() {
        Level::Low => (Polarity::HiToLo, Polarity::LoToHi),
        Level::High => (Polarity::LoToHi, Polarity::HiToLo),
    };
    watch(RISE, board::RISE, on);
    watch(FALL, board::FALL, off);
    for (channel, counter) in [(RISE, TIMER1), (FALL, TIMER2)] {
        // An event's and a task's address are those of their registers (PS 6.16).
        PPI.ch(channel).eep().write_value(GPIOTE.events_in(channel).as_ptr() as u32);
        PPI.ch(channel).tep().write_value(TIMER3.tasks_capture(channel).as_ptr() as u32);
        PPI.fork(channel).tep().write_value(counter.tasks_count().as_ptr() as u32);
        PPI.chenset().write(|w| w.set_ch(channel, true));
    }
    open();
}

/// CONFIG: event mode, port, pin, polarity (PS 6.10). Being configured may itself look like an edge.
fn watch(channel: usize, pin: Pin, polarity: vals::Polarity) {
    pin.release();
    GPIOTE.config(channel).write(|w| {
        w.set_mode(Mode::Event);
        w.set_port(pin.port1);
        w.set_psel(pin.number);
        w.set_polarity(polarity);
    });
    GPIOTE.events_in(channel).write_value(0);
}

/// Lets the light's going off interrupt; at once, if it has gone off meanwhile.
pub fn open() {
    GPIOTE.intenset(0).write_value(fall());
}

/// Does not.
fn close() {
    GPIOTE.intenclr(0).write_value(fall());
}

/// INTENSET, INTENCLR: bit IN[1] (PS 6.10); zeros do nothing.
fn fall() -> Int {
    let mut mask = Int(0);
    mask.set_in_(FALL, true);
    mask
}

impl Capture {
    /// The interrupt: the light has gone off.
    pub fn step(&mut self) {
        // First of all, so that a fall from here on interrupts again; read back, so that this one does not (PS 6.1).
        GPIOTE.events_in(FALL).write_value(0);
        let _ = GPIOTE.events_in(FALL).read();
        if let Some(sample) = sample()
            && let Some(pulse) = self.pairing.take(sample)
            && !self.pulses.push(pulse)
        {
            self.dropped = self.dropped.wrapping_add(2);
        }
        LOST.store(self.pairing.lost().wrapping_add(self.dropped), Ordering::Relaxed);
        if self.pulses.is_full() {
            close();
        }
    }
}

/// Every pulse has been read: if that was overdue, the handler may go on in a while.
pub fn caught_up() {
    if !GPIOTE.intenset(0).read().in_(FALL) {
        clock::arm(Alarm::Gate, CLOSED_FOR);
    }
}

/// Stamps and counts that belong together.
fn sample() -> Option<Sample> {
    let mut before = counts();
    for _ in 0..LOOKS {
        let rise = Ticks(TIMER3.cc(RISE).read());
        let fall = Ticks(TIMER3.cc(FALL).read());
        let after = counts();
        if after == before {
            let (rises, falls) = after;
            return Some(Sample { rises, falls, rise, fall });
        }
        before = after;
    }
    None
}

/// How often the light has come on and gone off.
fn counts() -> (u32, u32) {
    TIMER1.tasks_capture(0).write_value(1);
    TIMER2.tasks_capture(0).write_value(1);
    (TIMER1.cc(0).read(), TIMER2.cc(0).read())
}
