//! Frames onto the air, one at a time, without ever waiting in a loop.
//!
//! ```text
//! off --frame--> settling --alarm--> sending --done--> off
//! ```
//!
//! The order of the register writes is that of the SCuM-3C test code (`lighthouse.c:378-411`): supplies, frame,
//! oscillator, at least 50 us, send. Unlike there, the supplies go off afterwards.
//!
//! What can go wrong: the oscillator is free-running and its code is only right for one chip at one temperature, so a
//! listener may have to search; the controller never says that it is done (it is reset and the report counted).

use core::sync::atomic::{AtomicU16, Ordering, fence};

use lighthouse_mote::frame::Aligned;
use lighthouse_mote::time::Span;

use crate::pac::{analog, rf};
use crate::queue::{Queue, Reader};
use crate::rf_timer::{self, Alarm};
use crate::watchdog;

/// Supplies and frame need 50 us before the send (`radio.c:176`): 1000 ticks are that even at twice 10 MHz.
const SETTLE: Span = Span(1000);
/// A frame of 54 + 6 bytes takes 1.92 ms at 250 kbit/s: 65536 ticks are 6.5 ms at 10 MHz.
const PATIENCE: Span = Span(1 << 16);

/// Supplies of oscillator and power amplifier on, divider off (`lighthouse.c:381`).
const SUPPLIES_TX: u32 = 0x28;
/// All supplies off.
const SUPPLIES_OFF: u32 = 0;
/// Polyphase filter off, mixers off (`radio.c:183`).
const RECEIVER_OFF: u32 = 0x6;

/// Where the oscillator of the radio stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Channel {
    /// 0 ..= 31.
    pub coarse: u8,
    /// 0 ..= 31.
    pub mid: u8,
    /// 0 ..= 31.
    pub fine: u8,
}

impl Channel {
    /// What the test code sends on (`lighthouse.c`, LC_FREQCHANGE of send_lh_packet); each chip needs its own.
    pub const DEFAULT: Self = Self { coarse: 23, mid: 20, fine: 0 };

    /// As registers 7 and 8: each code mirrored, the last bit of the mirrored fine code apart
    /// (`scm3c_hw_interface.c:1471-1531`).
    const fn registers(self) -> (u32, u32) {
        let fine = self.fine.reverse_bits() as u32;
        let mid = self.mid.reverse_bits() as u32;
        let coarse = self.coarse.reverse_bits() as u32;
        ((fine & 0x78) << 9 | mid << 3 | coarse >> 3, fine >> 7)
    }
}

/// Reports the controller did not send. Written at the radio's priority alone.
static LOST: AtomicU16 = AtomicU16::new(0);

/// Reports given up by the radio so far, wrapping.
pub fn lost() -> u16 {
    LOST.load(Ordering::Relaxed)
}

/// Frames that may wait, the one on the air among them.
pub const FRAMES: usize = 4;
/// The memory for them, where the controller's DMA can read it: on a word (`radio.c`, radio_tx_buffer).
pub type Frames = Queue<Aligned, FRAMES>;

/// What the radio is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum State {
    Off,
    Settling,
    Sending,
}

/// The transmitter and its queue.
pub struct Radio {
    state: State,
    /// The oldest is the one on the air.
    frames: Reader<Aligned, FRAMES>,
}

impl Radio {
    /// Off.
    pub fn new(frames: Reader<Aligned, FRAMES>) -> Self {
        rf::CONTROL.write(rf::RESET);
        rf::INT_CLEAR.write(rf::ALL);
        rf::ERROR_CLEAR.write(rf::ALL);
        rf::INT_CONFIG.write(rf::TX_SEND_DONE);
        supplies_off();
        Self { state: State::Off, frames }
    }

    /// The controller's interrupt, or a frame has come.
    pub fn step(&mut self) {
        let done = rf::INT.read();
        rf::INT_CLEAR.write(done);
        if done & rf::TX_SEND_DONE != 0 && self.state == State::Sending {
            watchdog::feed();
            self.rest();
        }
        if self.state == State::Off
            && let Some(frame) = self.frames.oldest()
        {
            load(frame);
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
        }
    }

    /// Is done with the frame on the air.
    fn rest(&mut self) {
        rf_timer::disarm(Alarm::Radio);
        supplies_off();
        self.frames.pop();
        self.state = State::Off;
    }
}

/// Everything up to the send.
fn load(frame: &Aligned) {
    analog::REG10.write(SUPPLIES_TX);
    analog::REG16.write(RECEIVER_OFF);
    // The controller reads the frame behind the compiler's back.
    fence(Ordering::SeqCst);
    rf::TX_DATA_ADDR.write(frame.bytes().as_ptr().expose_provenance() as u32);
    rf::TX_PACK_LEN.write(frame.bytes().len() as u32);
    rf::CONTROL.write(rf::TX_LOAD);
    let (most, last) = const { Channel::DEFAULT.registers() };
    analog::REG7.write(most);
    analog::REG8.write(last);
    rf_timer::arm(Alarm::Radio, SETTLE);
}

fn supplies_off() {
    analog::REG10.write(SUPPLIES_OFF);
}
