//! defmt over the serial port, without ever delaying an edge.
//!
//! Taking the log masks every interrupt line except the two edges, which never log, so an encoder is enough for all
//! and the stamps do not feel it. Bytes go to a ring; `idle` carries them to the port, one byte time after the other.
//! Writing faster would fill the port's FIFO, and a full FIFO is believed to stall the bus, interrupts and all.
//!
//! What can go wrong: the ring is full and the rest of a frame is dropped. The encoding (rzcobs) recovers at the next
//! frame. A line logged between `idle` looking and sleeping waits for the next interrupt.

use core::cell::UnsafeCell;
use core::sync::atomic::{AtomicU8, AtomicU16, AtomicU32, Ordering};

use lighthouse_mote::time::{Span, Ticks};

use crate::capture::EDGES;
use crate::pac::{nvic, scb, uart};
use crate::{crash, rf_timer};

/// 10 bits at 38,400 baud and 10 MHz are 2,604 ticks; both rates come from the same oscillator.
const BYTE_TIME: Span = Span(2800);

/// Bytes of the ring, a power of two; a frame is about 20.
const RING: usize = 512;

static BYTES: [AtomicU8; RING] = [const { AtomicU8::new(0) }; RING];
/// Bytes ever written, wrapping. Advanced by the holder of the log alone.
static WRITTEN: AtomicU16 = AtomicU16::new(0);
/// Bytes ever read, wrapping. Advanced by [`drain`] alone.
static READ: AtomicU16 = AtomicU16::new(0);
/// When the last byte went to the port. Touched by [`drain`] alone.
static SENT_AT: AtomicU32 = AtomicU32::new(0);

defmt::timestamp!("{=u32}", rf_timer::now().0);

#[defmt::global_logger]
struct Log;

struct State {
    taken: bool,
    /// The lines to enable again.
    lines: u32,
    encoder: defmt::Encoder,
}

struct Cell(UnsafeCell<State>);

// SAFETY: the state is touched between `acquire` and `release` only, where no other code that logs can run: one core,
// all lines but the edges' masked, and the edge handlers never log. Taking it twice in one context ends in a reset.
unsafe impl Sync for Cell {}

static STATE: Cell = Cell(UnsafeCell::new(State { taken: false, lines: 0, encoder: defmt::Encoder::new() }));

// SAFETY: `acquire` excludes every other context, as said at `Cell`.
unsafe impl defmt::Logger for Log {
    fn acquire() {
        // The edge handlers swap their own bits at any moment: these are neither saved, cleared nor restored.
        let lines = nvic::ISER.read() & !EDGES;
        nvic::ICER.write(!EDGES);
        // The masking holds from the next instruction on (ARM AN321, 4.6).
        cortex_m::asm::dsb();
        cortex_m::asm::isb();
        // SAFETY: no other context can be inside, as said at `Cell`; the reference ends with this function.
        let state = unsafe { &mut *STATE.0.get() };
        if state.taken {
            crash::reset(crash::Kind::Log, 0);
        }
        state.taken = true;
        state.lines = lines;
        state.encoder.start_frame(put);
    }

    unsafe fn flush() {
        drain();
    }

    unsafe fn release() {
        // SAFETY: the caller holds the log, so as in `acquire`.
        let state = unsafe { &mut *STATE.0.get() };
        state.encoder.end_frame(put);
        state.taken = false;
        let lines = state.lines;
        scb::SCR.write(0);
        nvic::ISER.write(lines);
    }

    unsafe fn write(bytes: &[u8]) {
        // SAFETY: the caller holds the log, so as in `acquire`.
        let state = unsafe { &mut *STATE.0.get() };
        state.encoder.write(bytes, put);
    }
}

/// Puts what fits into the ring. Not inlined: the encoder calls it in many places.
#[inline(never)]
fn put(bytes: &[u8]) {
    let read = READ.load(Ordering::Relaxed);
    let mut written = WRITTEN.load(Ordering::Relaxed);
    for &byte in bytes {
        if usize::from(written.wrapping_sub(read)) == RING {
            break;
        }
        if let Some(place) = BYTES.get(usize::from(written) % RING) {
            place.store(byte, Ordering::Relaxed);
        }
        written = written.wrapping_add(1);
    }
    WRITTEN.store(written, Ordering::Relaxed);
}

/// Carries the ring to the port; from then on a handler returns into sleep, until one logs. For `idle`.
///
/// Waking `idle` several times per sweep only to find an empty ring would cost a thirtieth of all cycles.
pub fn carry() {
    loop {
        // Handlers must return to the loop in `drain`, or it would stand still.
        scb::SCR.write(0);
        drain();
        scb::SCR.write(scb::SLEEP_ON_EXIT);
        // A handler that logged before that has had its word overwritten.
        if READ.load(Ordering::Relaxed) == WRITTEN.load(Ordering::Relaxed) {
            return;
        }
    }
}

/// The same for last words.
pub fn drain() {
    loop {
        let read = READ.load(Ordering::Relaxed);
        if read == WRITTEN.load(Ordering::Relaxed) {
            return;
        }
        let sent_at = Ticks(SENT_AT.load(Ordering::Relaxed));
        while rf_timer::now().since(sent_at) < BYTE_TIME {}
        if let Some(byte) = BYTES.get(usize::from(read) % RING) {
            uart::TX_DATA.write(u32::from(byte.load(Ordering::Relaxed)));
        }
        READ.store(read.wrapping_add(1), Ordering::Relaxed);
        SENT_AT.store(rf_timer::now().0, Ordering::Relaxed);
    }
}
