//! Frames onto the air: IEEE 802.15.4 at 250 kbit/s, listen before talk, one interrupt per try.
//!
//! ```text
//! off --frame--> waiting --alarm--> trying --disabled, sent--> off
//!                    ^                  |
//!                    '--disabled, busy--'
//! ```
//!
//! A try runs by itself (PS 6.20, SHORTS): receiver up, channel assessed, and if it is clear, transmitter up, frame
//! sent, off; if it is not, off. Either end is one DISABLED event, and which one it was the events CCABUSY and PHYEND
//! say.
//!
//! The crystal runs from start-up on: the radio needs it (PS 6.20).
//!
//! What can go wrong: the channel is busy five times (`csma`), or the radio does not come to its end in
//! [`PATIENCE`]. It is then switched off and on, which resets all its registers (PS 6.20, POWER). Either way the
//! frame is given up and counted. An alarm that never comes (a bit of [`State`] has flipped) leaves it waiting for ever:
//! the watchdog sees that no frame gets done with.

use core::sync::atomic::{AtomicU16, Ordering, fence};

use lighthouse_mote::frame::Aligned;
use lighthouse_mote::time::Span;
use nrf_pac::radio::{regs, vals};
use nrf_pac::{FICR, RADIO};

use crate::channel::Channel;
use crate::clock::{self, Alarm, TICKS_PER_US};
use crate::csma::Csma;
use crate::mote::queue::Reader;
use crate::mote::stages::FRAMES;
use crate::psdu::{MAX_PSDU, Psdu};
use crate::watchdog::{self, Stage};

/// Both ramps are at most 0.14 ms each, assessment 0.128 ms (PS 6.20.15.8, 6.20.12.4), and the longest frame is 133
/// bytes of 32 us, 4.3 ms.
const PATIENCE: Span = Span(10_000 * TICKS_PER_US);
/// x^16 + x^12 + x^5 + 1 (IEEE 802.15.4-2006, 7.2.1.9), bit n for x^n (PS 6.20, CRCPOLY).
const CRC_POLYNOMIAL: u32 = 0x1_1021;
/// The start delimiter (IEEE 802.15.4-2006, 6.3.2).
const START_DELIMITER: u8 = 0xa7;

/// Frames that did not get out. Written at the radio's priority alone.
static LOST: AtomicU16 = AtomicU16::new(0);

/// Frames given up by the radio so far, wrapping.
pub fn lost() -> u16 {
    LOST.load(Ordering::Relaxed)
}

/// What the radio is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum State {
    Off,
    Waiting,
    Trying,
}

/// The radio and its queue.
pub struct Radio {
    state: State,
    frames: Reader<Aligned, FRAMES>,
    psdu: &'static mut Psdu,
    channel: Channel,
    csma: Csma,
}

impl Radio {
    /// Off, to send on `channel`.
    pub fn new(frames: Reader<Aligned, FRAMES>, psdu: &'static mut Psdu, channel: Channel) -> Self {
        configure(channel);
        // The chip's own number (PS 4.4, DEVICEID): no two motes throw the same dice.
        let csma = Csma::new(FICR.deviceid(0).read());
        Self { state: State::Off, frames, psdu, channel, csma }
    }

    /// The radio's interrupt, or a frame has come.
    pub fn step(&mut self) {
        if RADIO.events_disabled().read() != 0 {
            RADIO.events_disabled().write_value(0);
            let _ = RADIO.events_disabled().read();
            if self.state == State::Trying {
                self.tried();
            }
        }
        while self.state == State::Off
            && let Some(frame) = self.frames.oldest()
        {
            let fits = self.psdu.load(frame.bytes());
            self.frames.pop();
            if fits {
                let us = self.csma.begin();
                self.wait(us);
            } else {
                self.give_up();
            }
        }
    }

    /// The alarm: time to listen, or patience is over.
    pub fn alarm(&mut self) {
        match self.state {
            State::Off => {}
            State::Waiting => self.attempt(),
            State::Trying => {
                configure(self.channel);
                self.give_up();
                self.step();
            }
        }
    }

    fn wait(&mut self, us: u32) {
        self.state = State::Waiting;
        if us == 0 {
            self.attempt();
        } else {
            clock::arm(Alarm::Radio, Span(us * TICKS_PER_US));
        }
    }

    /// Starts a try.
    fn attempt(&mut self) {
        self.state = State::Trying;
        RADIO.events_phyend().write_value(0);
        RADIO.events_ccabusy().write_value(0);
        RADIO.events_disabled().write_value(0);
        // The radio reads the frame behind the compiler's back; it lies in RAM, as EasyDMA wants (PS 4.6).
        fence(Ordering::SeqCst);
        RADIO.packetptr().write_value(self.psdu.bytes().as_ptr().expose_provenance() as u32);
        clock::arm(Alarm::Radio, PATIENCE);
        RADIO.tasks_rxen().write_value(1);
    }

    /// A try is over.
    fn tried(&mut self) {
        clock::disarm(Alarm::Radio);
        if RADIO.events_phyend().read() != 0 {
            self.done();
        } else if let Some(us) = self.csma.again() {
            self.wait(us);
        } else {
            self.give_up();
        }
    }

    fn give_up(&mut self) {
        LOST.store(LOST.load(Ordering::Relaxed).wrapping_add(1), Ordering::Relaxed);
        self.done();
    }

    /// Is done with a frame.
    fn done(&mut self) {
        self.state = State::Off;
        watchdog::moved(Stage::Radio);
    }
}

/// Resets the radio and sets it up, from whatever state.
fn configure(channel: Channel) {
    RADIO.power().write(|w| w.set_power(false));
    RADIO.power().write(|w| w.set_power(true));
    // PS 6.20.12: 802.15.4, channel k at 2405 + 5 (k - 11) MHz.
    RADIO.mode().write(|w| w.set_mode(vals::Mode::Ieee802154250kbit));
    RADIO.frequency().write(|w| w.set_frequency(channel.mhz_above_2400()));
    RADIO.txpower().write(|w| w.set_txpower(vals::Txpower::_0dBm));
    // PS 6.20.12: four zero bytes of preamble, the delimiter, an 8-bit length that counts the CRC, nothing else.
    RADIO.pcnf0().write(|w| {
        w.set_plen(vals::Plen::_32bitZero);
        w.set_lflen(8);
        w.set_crcinc(vals::Crcinc::Include);
    });
    RADIO.pcnf1().write(|w| {
        w.set_maxlen(MAX_PSDU as u8);
        w.set_endian(vals::Endian::Little);
    });
    RADIO.sfd().write(|w| w.set_sfd(START_DELIMITER));
    // PS 6.20.12: two bytes from behind the length on, the register zero before.
    RADIO.crccnf().write(|w| {
        w.set_len(vals::Len::Two);
        w.set_skipaddr(vals::Skipaddr::Ieee802154);
    });
    RADIO.crcpoly().write(|w| w.set_crcpoly(CRC_POLYNOMIAL));
    RADIO.crcinit().write(|w| w.set_crcinit(0));
    // PS 6.20, MODECNF0: fast ramps; between frames the middle frequency, as after reset.
    RADIO.modecnf0().write(|w| {
        w.set_ru(vals::Ru::Fast);
        w.set_dtx(vals::Dtx::Center);
    });
    // PS 6.20.12.4: a channel is busy that carries 802.15.4 (mode 2); its thresholds as after reset.
    RADIO.ccactrl().modify(|w| w.set_ccamode(vals::Ccamode::CarrierMode));
    // PS 6.20, SHORTS: the try as drawn above.
    RADIO.shorts().write(|w| {
        w.set_rxready_ccastart(true);
        w.set_ccabusy_disable(true);
        w.set_ccaidle_txen(true);
        w.set_txready_start(true);
        w.set_phyend_disable(true);
    });
    let mut disabled = regs::Int(0);
    disabled.set_disabled(true);
    RADIO.intenset().write_value(disabled);
}
