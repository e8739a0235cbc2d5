//! The radio controller: a packet is loaded from data RAM, then sent.
//!
//! The chip does not say no. A program that sends without loading, too early after switching the transmitter on, or
//! while a frame is in the air, sees nothing wrong and is not heard. Here every such attempt is written down as a
//! [`Refusal`] with its cycle and reason, and nothing is transmitted.
//!
//! # Design
//! The controller has no view of RAM. TX_LOAD leaves a [`Dma`] request for whoever owns the RAM; the answer may come
//! at once or later, but before TX_SEND.
//!
//! # Note
//! Where the public sources are silent, this is what the model does:
//! - TX_LOAD takes one core cycle per byte ("some delay" before sending: SCuM-3C test code, radio.c).
//! - A packet is gone once sent; sending again needs loading again.
//! - The frame is delivered as it was loaded, its last two bytes being the FCS. Whether the chip overwrites them with
//!   its own is not known; software that loads a right FCS is right either way.
//! - An INT flag is latched, and a pulse reaches the RFTIMER, only if INT_CONFIG enables it at that moment. ERROR is
//!   always latched; ERROR_CONFIG decides whether it interrupts.
//! - Overflow is the error of a bad length or load, cutoff that of a bad send.
//! - The layout of STATUS is not published: reading it faults.
//! - Nothing is ever received. RX_START only makes the radio busy until RX_STOP or RESET.

use super::refusal::{Refusal, Why};
use crate::bus::Dma;
use std::collections::VecDeque;
use std::num::NonZeroU32;

const CONTROL: u32 = 0x00;
const STATUS: u32 = 0x04;
const TX_DATA_ADDR: u32 = 0x08;
const TX_PACK_LEN: u32 = 0x0C;
const INT: u32 = 0x10;
const INT_CONFIG: u32 = 0x14;
const INT_CLEAR: u32 = 0x18;
const ERROR: u32 = 0x1C;
const ERROR_CONFIG: u32 = 0x20;
const ERROR_CLEAR: u32 = 0x24;

/// Bits of CONTROL (SCuM-3C test code, memory_map.h:59-63).
const TX_LOAD: u32 = 0x01;
const TX_SEND: u32 = 0x02;
const RX_START: u32 = 0x04;
const RX_STOP: u32 = 0x08;
const RESET: u32 = 0x10;

/// Bits of INT; INT_CONFIG enables the interrupt in the same place and the RFTIMER pulse five places up
/// (SCuM-3C test code, memory_map.h:38-47, 67-71).
const LOAD_DONE: u32 = 0x01;
const SFD_DONE: u32 = 0x02;
const SEND_DONE: u32 = 0x04;
const PULSE_SHIFT: u32 = 5;
const INT_CONFIG_BITS: u32 = 0x3FF;

/// Bits of ERROR (SCuM-3C test code, memory_map.h:75-79).
const TX_OVERFLOW: u32 = 0x01;
const TX_CUTOFF: u32 = 0x02;
const ERROR_BITS: u32 = 0x1F;

/// IEEE 802.15.4 at 2.4 GHz: 250 kbit/s.
const BYTE_US: u64 = 32;
/// IEEE 802.15.4 at 2.4 GHz: four preamble bytes and the start-of-frame delimiter.
const SFD_BYTES: u64 = 5;
/// The length byte.
const LENGTH_BYTES: u64 = 1;
/// IEEE 802.15.4: the longest frame, FCS included, bytes.
const LONGEST: u32 = 127;
/// Assumed, see the module's note.
const LOAD_CYCLES_PER_BYTE: u64 = 1;

/// How many refusals are kept; all are counted.
const KEPT_REFUSALS: usize = 1024;

/// A frame that left the antenna whole.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SentFrame {
    /// The frame after its length byte, the two bytes of FCS included, as it was loaded.
    pub bytes: Vec<u8>,
    /// The core cycle of TX_SEND, when the preamble begins.
    pub start_cycle: u64,
    /// The core cycle at which the last bit has left.
    pub end_cycle: u64,
}

/// What the analog part can do at the moment.
#[derive(Debug, Clone, Copy)]
pub(super) struct Readiness {
    pub(super) send: Result<(), Why>,
    pub(super) receive: Result<(), Why>,
}

#[derive(Debug, Clone)]
enum Load {
    Empty,
    Asked { dma: Dma, taken: bool, due: u64 },
    Moving { bytes: Vec<u8>, due: u64 },
    Ready(Vec<u8>),
}

#[derive(Debug, Clone)]
struct Sending {
    frame: SentFrame,
    sfd_at: Option<u64>,
}

#[derive(Debug, Clone)]
pub(super) struct RfController {
    address: u32,
    len: u32,
    interrupts: u32,
    interrupt_config: u32,
    errors: u32,
    error_config: u32,
    load: Load,
    sending: Option<Sending>,
    receiving: bool,
    frames: VecDeque<SentFrame>,
    refusals: Vec<Refusal>,
    refused: u64,
}

impl RfController {
    pub(super) fn new() -> Self {
        Self {
            address: 0,
            len: 0,
            interrupts: 0,
            interrupt_config: 0,
            errors: 0,
            error_config: 0,
            load: Load::Empty,
            sending: None,
            receiving: false,
            frames: VecDeque::new(),
            refusals: Vec::new(),
            refused: 0,
        }
    }

    pub(super) fn line(&self) -> bool {
        self.interrupts & self.interrupt_config != 0 || self.errors & self.error_config != 0
    }

    pub(super) fn take_dma(&mut self) -> Option<Dma> {
        match &mut self.load {
            Load::Asked { dma, taken, .. } if !*taken => {
                *taken = true;
                Some(*dma)
            }
            _ => None,
        }
    }

    /// The bytes asked for; returns the pulses for the RFTIMER.
    pub(super) fn give_dma(&mut self, bytes: &[u8], now: u64) -> u32 {
        let Load::Asked { dma, due, .. } = self.load else {
            return 0;
        };
        if bytes.len() != dma.len as usize {
            self.load = Load::Empty;
            self.refuse(now, Why::NotInRam { dma });
            return 0;
        }
        self.load = Load::Moving { bytes: bytes.to_vec(), due };
        self.advance(now)
    }

    pub(super) fn take_frames(&mut self) -> VecDeque<SentFrame> {
        std::mem::take(&mut self.frames)
    }

    pub(super) fn refusals(&self) -> &[Refusal] {
        &self.refusals
    }

    pub(super) fn refused(&self) -> u64 {
        self.refused
    }

    pub(super) fn is_sending(&self) -> bool {
        self.sending.is_some()
    }

    /// Writes down that it was not done.
    pub(super) fn refuse(&mut self, cycle: u64, why: Why) {
        self.errors |= error_bit(why);
        self.refused += 1;
        if self.refusals.len() < KEPT_REFUSALS {
            self.refusals.push(Refusal { cycle, why });
        }
    }

    /// Latches what is enabled; returns the pulse for the RFTIMER, if that is enabled.
    fn event(&mut self, bit: u32) -> u32 {
        self.interrupts |= bit & self.interrupt_config;
        bit & self.interrupt_config >> PULSE_SHIFT
    }

    pub(super) fn next_event(&self) -> u64 {
        let load = match self.load {
            Load::Moving { due, .. } => due,
            _ => u64::MAX,
        };
        let send = match &self.sending {
            Some(Sending { sfd_at: Some(sfd_at), .. }) => *sfd_at,
            Some(Sending { frame, .. }) => frame.end_cycle,
            None => u64::MAX,
        };
        load.min(send)
    }

    /// Lets what is due by `cycle` happen; returns the pulses for the RFTIMER.
    pub(super) fn advance(&mut self, cycle: u64) -> u32 {
        let mut pulses = 0;
        if let Load::Moving { bytes, due } = &mut self.load
            && *due <= cycle
        {
            self.load = Load::Ready(std::mem::take(bytes));
            pulses |= self.event(LOAD_DONE);
        }
        if let Some(sending) = &mut self.sending
            && sending.sfd_at.is_some_and(|at| at <= cycle)
        {
            sending.sfd_at = None;
            pulses |= self.event(SFD_DONE);
        }
        if let Some(Sending { frame, .. }) = self.sending.take_if(|sending| sending.frame.end_cycle <= cycle) {
            self.frames.push_back(frame);
            pulses |= self.event(SEND_DONE);
        }
        pulses
    }

    /// Loses the frame in the air, if there is one.
    pub(super) fn cut(&mut self, cycle: u64, why: Why) {
        if self.sending.take().is_some() {
            self.refuse(cycle, why);
        }
    }

    /// What CONTROL is told, by software or by the RFTIMER. `ready` says what the analog part can do.
    pub(super) fn command(&mut self, bits: u32, cycle: u64, ready: Readiness, hclk_hz: NonZeroU32) {
        if bits & RESET != 0 {
            self.cut(cycle, Why::Reset);
            self.load = Load::Empty;
            self.receiving = false;
        }
        if bits & TX_LOAD != 0 {
            self.load(cycle);
        }
        if bits & TX_SEND != 0
            && let Err(why) = self.send(cycle, ready.send, hclk_hz)
        {
            self.refuse(cycle, why);
        }
        if bits & RX_START != 0 {
            if self.is_sending() {
                self.refuse(cycle, Why::Sending);
            } else if let Err(why) = ready.receive {
                self.refuse(cycle, why);
            } else {
                self.receiving = true;
            }
        }
        if bits & RX_STOP != 0 {
            self.receiving = false;
        }
    }

    fn load(&mut self, cycle: u64) {
        if self.is_sending() {
            return self.refuse(cycle, Why::Sending);
        }
        self.load = Load::Empty;
        if self.len == 0 || self.len > LONGEST {
            return self.refuse(cycle, Why::BadLength { len: self.len });
        }
        let dma = Dma { address: self.address, len: self.len };
        let due = cycle.saturating_add(u64::from(self.len) * LOAD_CYCLES_PER_BYTE);
        self.load = Load::Asked { dma, taken: false, due };
    }

    fn send(&mut self, cycle: u64, ready: Result<(), Why>, hclk_hz: NonZeroU32) -> Result<(), Why> {
        if self.is_sending() {
            return Err(Why::Sending);
        }
        if self.receiving {
            return Err(Why::Receiving);
        }
        match self.load {
            Load::Empty => return Err(Why::NotLoaded),
            Load::Asked { .. } | Load::Moving { .. } => return Err(Why::StillLoading),
            Load::Ready(_) => ready?,
        }
        if let Load::Ready(bytes) = std::mem::replace(&mut self.load, Load::Empty) {
            let after = |sent: u64| cycle.saturating_add(cycles(sent * BYTE_US, hclk_hz));
            let all = SFD_BYTES + LENGTH_BYTES + bytes.len() as u64;
            self.sending = Some(Sending {
                sfd_at: Some(after(SFD_BYTES)),
                frame: SentFrame { bytes, start_cycle: cycle, end_cycle: after(all) },
            });
        }
        Ok(())
    }

    pub(super) fn read(&self, offset: u32) -> Result<u32, &'static str> {
        match offset {
            CONTROL | INT_CLEAR | ERROR_CLEAR => Err("this RF controller register can only be written"),
            STATUS => Err("the layout of the RF controller's STATUS is not published"),
            TX_DATA_ADDR => Ok(self.address),
            TX_PACK_LEN => Ok(self.len),
            INT => Ok(self.interrupts),
            INT_CONFIG => Ok(self.interrupt_config),
            ERROR => Ok(self.errors),
            ERROR_CONFIG => Ok(self.error_config),
            _ => Err("no RF controller register here"),
        }
    }

    /// Writes any register but CONTROL, which is a [`command`](Self::command).
    pub(super) fn write(&mut self, offset: u32, value: u32) -> Result<(), &'static str> {
        match offset {
            STATUS | INT | ERROR => return Err("this RF controller register can only be read"),
            TX_DATA_ADDR => self.address = value,
            TX_PACK_LEN => self.len = value,
            INT_CONFIG => self.interrupt_config = value & INT_CONFIG_BITS,
            INT_CLEAR => self.interrupts &= !value,
            ERROR_CONFIG => self.error_config = value & ERROR_BITS,
            ERROR_CLEAR => self.errors &= !value,
            _ => return Err("no RF controller register here"),
        }
        Ok(())
    }

    /// Whether `offset` is the register that takes commands.
    pub(super) fn is_control(offset: u32) -> bool {
        offset == CONTROL
    }
}

/// The bit of ERROR that tells of it.
fn error_bit(why: Why) -> u32 {
    match why {
        Why::BadLength { .. } | Why::NotInRam { .. } => TX_OVERFLOW,
        Why::ScanLength { .. } | Why::ScanBit { .. } | Why::ScanCode { .. } => 0,
        Why::NoReceiver { .. } | Why::ReceiverOff { .. } => 0,
        _ => TX_CUTOFF,
    }
}

/// True microseconds in core cycles, to the nearest.
fn cycles(us: u64, hclk_hz: NonZeroU32) -> u64 {
    (us * u64::from(hclk_hz.get()) + 500_000) / 1_000_000
}

#[cfg(test)]
mod tests {
    use super::*;

    const HCLK_HZ: NonZeroU32 = NonZeroU32::new(10_000_000).unwrap();
    const READY: Readiness = Readiness { send: Ok(()), receive: Ok(()) };

    fn asked(len: u32) -> RfController {
        let mut rf = RfController::new();
        rf.write(INT_CONFIG, 0x3FF).unwrap();
        rf.write(TX_DATA_ADDR, 0x2000_0100).unwrap();
        rf.write(TX_PACK_LEN, len).unwrap();
        rf.command(TX_LOAD, 0, READY, HCLK_HZ);
        rf
    }

    fn loaded(len: u32) -> RfController {
        let mut rf = asked(len);
        rf.give_dma(&vec![0x5A; len as usize], 0);
        rf.advance(u64::from(len));
        rf
    }

    fn whys(rf: &RfController) -> Vec<Why> {
        rf.refusals().iter().map(|refusal| refusal.why).collect()
    }

    #[test]
    fn loading_asks_for_the_packet_once_and_says_when_it_is_done() {
        let mut rf = asked(9);
        assert_eq!(rf.take_dma(), Some(Dma { address: 0x2000_0100, len: 9 }));
        assert_eq!(rf.take_dma(), None);
        assert_eq!(rf.give_dma(&[1; 9], 0), 0);
        assert_eq!(rf.next_event(), 9);
        assert_eq!(rf.advance(9), LOAD_DONE);
        assert_eq!(rf.read(INT), Ok(LOAD_DONE));
        assert!(rf.line());
        rf.write(INT_CLEAR, LOAD_DONE).unwrap();
        assert!(!rf.line());
    }

    #[test]
    fn a_packet_that_comes_late_is_loaded_when_it_comes() {
        let mut rf = asked(9);
        assert_eq!(rf.next_event(), u64::MAX);
        assert_eq!(rf.give_dma(&[1; 9], 5_000), LOAD_DONE);
        rf.command(TX_SEND, 5_001, READY, HCLK_HZ);
        assert!(rf.is_sending());
    }

    #[test]
    fn a_frame_takes_32_us_a_byte_with_six_bytes_before_it() {
        let mut rf = loaded(11);
        rf.command(TX_SEND, 1_000, READY, HCLK_HZ);
        assert_eq!(rf.next_event(), 1_000 + 1_600);
        assert_eq!(rf.advance(2_600), SFD_DONE);
        let end_cycle = 1_000 + (6 + 11) * 320;
        assert_eq!(rf.next_event(), end_cycle);
        assert!(rf.take_frames().is_empty());
        assert_eq!(rf.advance(end_cycle), SEND_DONE);
        assert_eq!(rf.take_frames(), [SentFrame { bytes: vec![0x5A; 11], start_cycle: 1_000, end_cycle }]);
        assert_eq!(rf.next_event(), u64::MAX);
        assert_eq!(rf.refused(), 0);
    }

    #[test]
    fn the_airtime_is_true_time_whatever_the_clock() {
        let mut rf = loaded(2);
        rf.command(TX_SEND, 0, READY, NonZeroU32::new(10_820_000).unwrap());
        rf.advance(rf.next_event());
        assert_eq!(rf.next_event(), 2_770); // 8 * 32 us * 10.82 MHz = 2769.92
    }

    #[test]
    fn sending_what_is_not_loaded_or_already_sent_is_refused() {
        let mut rf = RfController::new();
        rf.command(TX_SEND, 3, READY, HCLK_HZ);
        assert_eq!(rf.refusals(), [Refusal { cycle: 3, why: Why::NotLoaded }]);
        assert_eq!(rf.read(ERROR), Ok(TX_CUTOFF));
        assert!(!rf.line());
        rf.write(ERROR_CONFIG, TX_CUTOFF).unwrap();
        assert!(rf.line());
        rf.write(ERROR_CLEAR, TX_CUTOFF).unwrap();
        assert!(!rf.line());
        let mut rf = loaded(9);
        rf.command(TX_SEND, 10, READY, HCLK_HZ);
        rf.advance(100_000);
        rf.command(TX_SEND, 100_000, READY, HCLK_HZ);
        assert_eq!(whys(&rf), [Why::NotLoaded]);
        assert_eq!(rf.take_frames().len(), 1);
    }

    #[test]
    fn sending_in_the_middle_of_a_load_is_refused() {
        let mut rf = asked(9);
        rf.command(TX_SEND, 0, READY, HCLK_HZ);
        rf.give_dma(&[0; 9], 0);
        rf.command(TX_SEND, 8, READY, HCLK_HZ);
        assert_eq!(whys(&rf), [Why::StillLoading, Why::StillLoading]);
    }

    #[test]
    fn lengths_of_0_and_beyond_127_are_refused() {
        for len in [0, 128, u32::MAX] {
            let mut rf = asked(len);
            assert_eq!(whys(&rf), [Why::BadLength { len }]);
            assert_eq!(rf.read(ERROR), Ok(TX_OVERFLOW));
            assert_eq!(rf.take_dma(), None);
        }
        assert!(whys(&asked(1)).is_empty());
        assert!(whys(&asked(127)).is_empty());
    }

    #[test]
    fn a_packet_outside_ram_is_refused() {
        let mut rf = asked(9);
        rf.give_dma(&[0; 4], 0);
        assert_eq!(whys(&rf), [Why::NotInRam { dma: Dma { address: 0x2000_0100, len: 9 } }]);
    }

    #[test]
    fn sending_and_loading_while_a_frame_is_in_the_air_are_refused() {
        let mut rf = loaded(9);
        rf.command(TX_SEND, 100, READY, HCLK_HZ);
        rf.command(TX_SEND, 101, READY, HCLK_HZ);
        rf.command(TX_LOAD, 102, READY, HCLK_HZ);
        rf.command(RX_START, 103, READY, HCLK_HZ);
        assert_eq!(whys(&rf), [Why::Sending; 3]);
        rf.advance(100_000);
        assert_eq!(rf.take_frames().len(), 1);
    }

    #[test]
    fn sending_while_receiving_is_refused_until_the_receiver_stops() {
        let mut rf = loaded(9);
        rf.command(RX_START, 20, READY, HCLK_HZ);
        rf.command(TX_SEND, 21, READY, HCLK_HZ);
        assert_eq!(whys(&rf), [Why::Receiving]);
        rf.command(RX_STOP, 22, READY, HCLK_HZ);
        rf.command(TX_SEND, 23, READY, HCLK_HZ);
        assert!(rf.is_sending());
    }

    #[test]
    fn a_receiver_that_is_not_ready_does_not_run() {
        let mut rf = loaded(9);
        let off = Readiness { receive: Err(Why::NoReceiver { ldo: 0x28 }), ..READY };
        rf.command(RX_START, 20, off, HCLK_HZ);
        assert_eq!(
            rf.refusals()[0].to_string(),
            "cycle 20: ANALOG_CFG 10 (0x52280000): 0x28, not 0x18: LO and IF are not on"
        );
        rf.command(TX_SEND, 21, READY, HCLK_HZ);
        assert!(rf.is_sending());
    }

    #[test]
    fn a_transmitter_that_is_not_ready_keeps_the_packet() {
        let mut rf = loaded(9);
        let unsettled = Readiness { send: Err(Why::NotSettled { cycles: 7 }), ..READY };
        rf.command(TX_SEND, 20, unsettled, HCLK_HZ);
        assert_eq!(whys(&rf), [Why::NotSettled { cycles: 7 }]);
        rf.command(TX_SEND, 600, READY, HCLK_HZ);
        assert!(rf.is_sending());
    }

    #[test]
    fn a_reset_loses_the_frame_in_the_air() {
        let mut rf = loaded(9);
        rf.command(TX_SEND, 20, READY, HCLK_HZ);
        rf.command(RESET, 300, READY, HCLK_HZ);
        assert_eq!(whys(&rf), [Why::Reset]);
        rf.advance(1_000_000);
        assert!(rf.take_frames().is_empty());
    }

    #[test]
    fn events_that_are_not_enabled_neither_interrupt_nor_pulse() {
        let mut rf = asked(9);
        rf.write(INT_CONFIG, 0).unwrap();
        assert_eq!(rf.give_dma(&[0; 9], 100), 0);
        assert_eq!(rf.read(INT), Ok(0));
    }

    #[test]
    fn refusals_are_counted_beyond_those_kept() {
        let mut rf = RfController::new();
        for cycle in 0..5_000 {
            rf.command(TX_SEND, cycle, READY, HCLK_HZ);
        }
        assert_eq!((rf.refused(), rf.refusals().len()), (5_000, KEPT_REFUSALS));
    }

    #[test]
    fn wrong_directions_and_holes_fault() {
        let mut rf = RfController::new();
        for offset in [CONTROL, STATUS, INT_CLEAR, ERROR_CLEAR, 0x28, 2] {
            assert!(rf.read(offset).is_err());
        }
        for offset in [STATUS, INT, ERROR, 0x28, 2] {
            assert!(rf.write(offset, 0).is_err());
        }
    }
}
