//! Frames onto the air, one at a time, without ever waiting in a loop.
//!
//! ```text
//! off --frame--> settling --alarm--> sending --done--> off
//!  \--behind a health frame--> counting --alarm--> off
//! ```
//!
//! The order of the register writes is that of the SCuM-3C test code (`lighthouse.c:378-411`): supplies, frame,
//! oscillator, at least 50 us, send. Unlike there, the supplies go off afterwards. The oscillator is free-running and is
//! counted now and then (see [`tuning`](crate::tuning)), where the silence on the air is longest.
//!
//! What can go wrong: a frame that comes while the oscillator is counted waits up to 50 ms; the controller never says that it is done (it is reset and the report counted).

use core::sync::atomic::{AtomicU16, Ordering, fence};

use lighthouse_mote::frame::{Aligned, HEALTH_LEN};
use lighthouse_mote::time::Span;

use crate::mote::queue::Reader;
use crate::mote::stages::FRAMES;
use crate::pac::{analog, rf};
use crate::rf_timer::{self, Alarm};
use crate::tuning::Lc;
use crate::watchdog;

/// Supplies and frame need 50 us before the send (`radio.c:176`): 1000 ticks are that even at twice 10 MHz.
const SETTLE: Span = Span(1000);
/// A frame of 54 + 6 bytes takes 1.92 ms at 250 kbit/s: 65536 ticks are 6.5 ms at 10 MHz.
const PATIENCE: Span = Span(1 << 16);

/// Supplies of oscillator and power amplifier on, divider off (`lighthouse.c:381`).
const SUPPLIES_TX: u32 = 0x28;
/// Supplies of oscillator and divider on: nothing is radiated (`radio.c`, the bits of register 10).
const SUPPLIES_COUNT: u32 = 0x48;
/// All supplies off.
const SUPPLIES_OFF: u32 = 0;
/// Polyphase filter off, mixers off (`radio.c:183`).
const RECEIVER_OFF: u32 = 0x6;

/// Reports the controller did not send. Written at the radio's priority alone.
static LOST: AtomicU16 = AtomicU16::new(0);

/// Reports given up by the radio so far, wrapping.
pub fn lost() -> u16 {
    LOST.load(Ordering::Relaxed)
}

/// What the radio is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum State {
    Off,
    Settling,
    Sending,
    Counting,
}

/// The transmitter and its queue.
pub struct Radio {
    state: State,
    lc: Lc,
    /// The oldest is the one on the air; the controller's DMA reads it there, on a word (`radio.c`, radio_tx_buffer).
    frames: Reader<Aligned, FRAMES>,
}

impl Radio {
    /// Off, for `channel` as [`Lc::new`].
    pub fn new(frames: Reader<Aligned, FRAMES>, channel: u8) -> Self {
        rf::CONTROL.write(rf::RESET);
        rf::INT_CLEAR.write(rf::ALL);
        rf::ERROR_CLEAR.write(rf::ALL);
        rf::INT_CONFIG.write(rf::TX_SEND_DONE);
        supplies_off();
        Self { state: State::Off, lc: Lc::new(channel), frames }
    }

    /// The controller's interrupt, or a frame has come.
    #[inline(never)]
    pub fn step(&mut self) {
        let done = rf::INT.read();
        rf::INT_CLEAR.write(done);
        if done & rf::TX_SEND_DONE != 0 && self.state == State::Sending {
            watchdog::alive();
            self.rest();
        }
        if self.state == State::Off
            && let Some(frame) = self.frames.oldest()
        {
            self.load(frame);
            self.state = State::Settling;
        }
    }

    /// The alarm: settled, or too late.
    pub fn alarm(&mut self) {
        match self.state {
            State::Off => {}
            State::Settling => {
                rf::CONTROL.write(rf::TX_SEND);
                rf_timer::arm(Alarm::Radio, PATIENCE);
                self.state = State::Sending;
            }
            State::Sending => {
                LOST.store(LOST.load(Ordering::Relaxed).wrapping_add(1), Ordering::Relaxed);
                rf::CONTROL.write(rf::RESET);
                self.rest();
                self.step();
            }
            State::Counting => {
                self.lc.tune();
                supplies_off();
                self.state = State::Off;
                self.step();
            }
        }
    }

    /// Is done with the frame on the air.
    #[inline(never)]
    fn rest(&mut self) {
        rf_timer::disarm(Alarm::Radio);
        supplies_off();
        let told = self.frames.oldest().is_some_and(|frame| is_health(frame.bytes().len()));
        self.frames.pop();
        self.state = State::Off;
        if told
            && self.frames.oldest().is_none()
            && let Some(window) = self.lc.count()
        {
            analog::REG10.write(SUPPLIES_COUNT);
            rf_timer::arm(Alarm::Radio, window);
            self.state = State::Counting;
        }
    }

    /// Everything up to the send.
    fn load(&self, frame: &Aligned) {
        analog::REG10.write(SUPPLIES_TX);
        analog::REG16.write(RECEIVER_OFF);
        // The controller reads the frame behind the compiler's back.
        fence(Ordering::SeqCst);
        rf::TX_DATA_ADDR.write(frame.bytes().as_ptr().expose_provenance() as u32);
        rf::TX_PACK_LEN.write(frame.bytes().len() as u32);
        rf::CONTROL.write(rf::TX_LOAD);
        self.lc.apply();
        rf_timer::arm(Alarm::Radio, SETTLE);
    }
}

/// Whether a frame of that length is a health frame, sealed or not.
#[inline(always)]
fn is_health(len: usize) -> bool {
    #[cfg(feature = "security")]
    let len = if len == HEALTH_LEN + lighthouse_mote::frame::secured::OVERHEAD { HEALTH_LEN } else { len };
    len == HEALTH_LEN
}

fn supplies_off() {
    analog::REG10.write(SUPPLIES_OFF);
}
