//! Everything on the SCuM-3C that is neither core nor memory.
//!
//! Addresses and interrupt numbers are the chip's, so that the very program that is flashed runs here. Light comes in
//! as edges at exact cycles, frames and log bytes go out with theirs, and what silicon would have ignored is written
//! down as a refusal.
//!
//! # Design
//! Each peripheral is a plain state machine in its own file; this one wires them: RFTIMER compares command the radio,
//! radio events trigger RFTIMER captures, the analog registers power the transmitter.
//!
//! The radio reads packets from a RAM that the machine owns, through [`Bus::take_dma`] and [`Bus::give_dma`]. A machine
//! must not advance past `next_event`, or a load and a send that the RFTIMER fires may leave no time for the answer.
//!
//! # Note
//! All registers are words. The chip's own sources never access them otherwise, and its peripheral bus has no byte
//! strobes to do it with; bytes and half-words fault.
//!
//! Not modelled, and therefore silent: a scan chain that is loaded while a frame is in the air, whose chips the 2 MHz
//! oscillator times; interrupt lines other than 6, 7, 12 and 13 (the debounced GPIO3 line 1, the optical-calibration lines 2
//! and 11, and the ADC, UART, raw-chip and GPIO10 lines). The optical receiver reaches pads 8 and 9 whatever bank the scan
//! chain chose, but no line where their inputs are not enabled.

mod adc;
mod analog_cfg;
mod failure;
mod gpio;
mod oscillators;
mod refusal;
mod rf_controller;
mod rftimer;
mod scan_chain;
mod uart;

use crate::bus::{Bus, BusFault, Dma, Size};
use analog_cfg::AnalogCfg;
use gpio::Gpio;
use rf_controller::{Readiness, RfController};
use rftimer::RfTimer;
use std::collections::VecDeque;
use std::num::NonZeroU32;
use uart::Uart;

pub use analog_cfg::{Clocks, Powered};
pub use failure::Failure;
pub use gpio::EdgeError;
pub use oscillators::Oscillators;
pub use refusal::{Needed, NeededCode, Refusal, Why};
pub use rf_controller::SentFrame;
pub use rftimer::Ratio;
pub use scan_chain::{NEEDED, NEEDED_CODES};

/// Interrupt number of the radio controller (SCuM-3C test code, cm0dsasm.s:43-58, as all of these).
pub const IRQ_RF: u32 = 6;
/// Interrupt number of the radio timer.
pub const IRQ_RFTIMER: u32 = 7;
/// Interrupt number of pad 8, asserted while it is high: while there is light.
pub const IRQ_GPIO8_HIGH: u32 = 12;
/// Interrupt number of pad 9, asserted while it is low: in the dark.
pub const IRQ_GPIO9_LOW: u32 = 13;

/// Base addresses (SCuM-3C test code, memory_map.h:10-21).
const RF: u32 = 0x4000_0000;
const DMA_BASE: u32 = 0x4100_0000;
const RFTIMER: u32 = 0x4200_0000;
const ADC: u32 = 0x5000_0000;
const UART: u32 = 0x5100_0000;
const ANALOG_CFG: u32 = 0x5200_0000;
const GPIO: u32 = 0x5300_0000;
/// Each peripheral has 16 MB of the address space.
const BASE: u32 = 0xFF00_0000;
/// Where received packets would be stored, offset from the DMA base (SCuM-3C test code, memory_map.h:186).
const DMA_RX_ADDR: u32 = 0x14;

/// What differs from mote to mote.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Config {
    /// The true rate of the core clock at power-on, Hz.
    pub hclk_hz: NonZeroU32,
    /// How fast the radio timer counts.
    pub ratio: Ratio,
    /// The other oscillators.
    pub clocks: Clocks,
    /// Lets the oscillators answer their codes, in place of `clocks` and, from the first good scan chain on, `hclk_hz`.
    pub oscillators: Option<Oscillators>,
}

impl Default for Config {
    /// The lighthouse set-up as intended: HCLK and RFTIMER at 10 MHz, all else on target.
    fn default() -> Self {
        Self { hclk_hz: NOMINAL_HCLK_HZ, ratio: Ratio::ONE, clocks: Clocks::default(), oscillators: None }
    }
}

/// HF at 20 MHz divided by 2 (SCuM-3C test code, lighthouse.c).
const NOMINAL_HCLK_HZ: NonZeroU32 = NonZeroU32::new(10_000_000).unwrap();

/// The devices of one mote.
#[derive(Debug, Clone)]
pub struct Scum3c {
    config: Config,
    /// What does not work, and until when.
    failure: Option<(Failure, u64)>,
    now: u64,
    next_event: u64,
    rf: RfController,
    rftimer: RfTimer,
    uart: Uart,
    analog: AnalogCfg,
    gpio: Gpio,
    rx_address: u32,
}

impl Scum3c {
    /// A mote at power-on, in the dark.
    pub fn new(config: Config) -> Self {
        Self {
            config,
            failure: None,
            now: 0,
            next_event: u64::MAX,
            rf: RfController::new(),
            rftimer: RfTimer::new(config.ratio),
            uart: Uart::default(),
            analog: AnalogCfg::new(config.clocks, config.hclk_hz, config.oscillators),
            gpio: Gpio::default(),
            rx_address: 0,
        }
    }

    /// Changes the true rate of the core clock from `cycle` on. A frame in the air keeps the end it was given.
    pub fn set_hclk_hz(&mut self, hclk_hz: NonZeroU32, cycle: u64) {
        self.advance(cycle);
        self.analog.set_hclk_hz(hclk_hz, self.now);
    }

    /// The true rate of the core clock now, Hz.
    pub fn hclk_hz(&self) -> NonZeroU32 {
        self.analog.hclk_hz()
    }

    /// The true rate of the radio's oscillator now, powered or not, Hz.
    pub fn lc_hz(&self) -> f64 {
        self.analog.lc_hz()
    }

    /// The true rate of the 2 MHz oscillator now, Hz.
    pub fn chip_clock_hz(&self) -> f64 {
        self.analog.chip_clock_hz()
    }

    /// How long the radio was powered so far.
    pub fn powered(&mut self) -> Powered {
        self.analog.powered(self.now)
    }

    /// Lets the radio timer stand as if it had been started `ticks` earlier, alarms included, from `cycle` on.
    pub fn age_timer(&mut self, ticks: u32, cycle: u64) {
        self.advance(cycle);
        self.rftimer.age(ticks, self.now);
        self.schedule();
    }

    /// Puts every device but the light back to what it is at power-on. Time goes on; what fails still fails.
    pub fn power_cycle(&mut self, cycle: u64) {
        self.advance(cycle);
        let hclk_hz = self.analog.hclk_hz();
        let fresh = Self::new(Config { hclk_hz, ..self.config });
        *self = Self {
            failure: self.failure,
            now: self.now,
            gpio: std::mem::take(&mut self.gpio),
            // What was on air and in the log before is not undone.
            uart: std::mem::take(&mut self.uart),
            ..fresh
        };
        self.schedule();
    }

    /// Lets something fail from `cycle` until `until`.
    pub fn fail(&mut self, failure: Failure, cycle: u64, until: u64) {
        self.advance(cycle);
        self.failure = Some((failure, until));
        if failure == Failure::Timer {
            self.rftimer.hold(true, self.now);
        }
        self.schedule();
    }

    fn fails(&self, what: Failure) -> bool {
        self.failure.is_some_and(|(failure, _)| failure == what)
    }

    fn mend(&mut self) {
        if let Some((failure, until)) = self.failure
            && until <= self.now
        {
            self.failure = None;
            if failure == Failure::Timer {
                self.rftimer.hold(false, self.now);
            }
        }
    }

    /// Queues a change of the optical level to happen at `cycle`, which must be later than that of the edge before.
    ///
    /// # Errors
    /// It is not, or already past.
    pub fn push_edge(&mut self, cycle: u64, level: bool) -> Result<(), EdgeError> {
        self.gpio.push_edge(cycle, level, self.now)?;
        self.schedule();
        Ok(())
    }

    /// The frames that have left since the last call, oldest first.
    pub fn take_frames(&mut self) -> VecDeque<SentFrame> {
        self.rf.take_frames()
    }

    /// What the radio was told to do and did not: the first 1024 of [`refused`](Self::refused).
    pub fn refusals(&self) -> &[Refusal] {
        self.rf.refusals()
    }

    /// How often the radio refused.
    pub fn refused(&self) -> u64 {
        self.rf.refused()
    }

    /// The bytes written to the UART since the last call.
    pub fn take_uart(&mut self) -> Vec<u8> {
        self.uart.take()
    }

    /// How many bytes were written to the UART while another was still on the wire, and might be lost on silicon.
    pub fn early_uart_bytes(&self) -> u64 {
        self.uart.early()
    }

    /// The optical level now.
    pub fn light(&self) -> bool {
        self.gpio.level()
    }

    /// The scan chain as last loaded: bit n at `0x8000_0000 >> (n % 32)` of word n / 32.
    pub fn scan_chain(&self) -> &[u32; 38] {
        self.analog.scan_chain()
    }

    /// How often the scan chain was loaded.
    pub fn scan_loads(&self) -> u64 {
        self.analog.scan_loads()
    }

    fn schedule(&mut self) {
        let rf = if self.fails(Failure::Radio) { u64::MAX } else { self.rf.next_event() };
        let mended = self.failure.map_or(u64::MAX, |(_, until)| until);
        self.next_event = self.rftimer.next_event().min(rf).min(self.gpio.next_event()).min(mended);
    }

    fn command_radio(&mut self, bits: u32) {
        let ready =
            Readiness { send: self.analog.ready_to_send(self.now), receive: self.analog.ready_to_receive(self.now) };
        self.rf.command(bits, self.now, ready, self.analog.hclk_hz());
    }

    fn write_analog(&mut self, offset: u32, value: u32) -> Result<(), &'static str> {
        let (tuned, loads) = (self.analog.lc_code(), self.analog.scan_loads());
        self.analog.write(offset, value, self.now)?;
        if self.analog.scan_loads() != loads {
            for &why in self.analog.scan_wrong() {
                self.rf.refuse(self.now, why);
            }
        }
        if self.rf.is_sending() {
            if self.analog.transmitter().is_err() {
                self.rf.cut(self.now, Why::CutOff);
            } else if self.analog.lc_code() != tuned {
                self.rf.cut(self.now, Why::Retuned);
            }
        }
        Ok(())
    }

    fn read_word(&mut self, address: u32) -> Result<u32, &'static str> {
        let offset = address & !BASE;
        match address & BASE {
            RF => self.rf.read(offset),
            DMA_BASE if offset == DMA_RX_ADDR => Ok(self.rx_address),
            DMA_BASE => Err("no DMA register here"),
            RFTIMER => self.rftimer.read(offset, self.now),
            ADC => Err(adc::refusal(offset)),
            UART => self.uart.read(offset),
            ANALOG_CFG => self.analog.read(offset, self.now),
            GPIO => self.gpio.read(offset),
            _ => Err("no peripheral here"),
        }
    }

    fn write_word(&mut self, address: u32, value: u32) -> Result<(), &'static str> {
        let offset = address & !BASE;
        match address & BASE {
            RF if RfController::is_control(offset) => self.command_radio(value),
            RF => self.rf.write(offset, value)?,
            DMA_BASE if offset == DMA_RX_ADDR => self.rx_address = value,
            DMA_BASE => return Err("no DMA register here"),
            RFTIMER => {
                self.rftimer.write(offset, value, self.now)?;
                if self.fails(Failure::Timer) {
                    self.rftimer.hold(true, self.now);
                }
            }
            ADC => return Err(adc::refusal(offset)),
            UART => self.uart.write(offset, value, self.now)?,
            ANALOG_CFG => self.write_analog(offset, value)?,
            GPIO => self.gpio.write(offset, value)?,
            _ => return Err("no peripheral here"),
        }
        Ok(())
    }
}

fn words_only(size: Size) -> Result<(), &'static str> {
    match size {
        Size::Word => Ok(()),
        Size::Byte | Size::Half => Err("peripheral registers are words"),
    }
}

impl Bus for Scum3c {
    fn read(&mut self, address: u32, size: Size, cycle: u64) -> Result<u32, BusFault> {
        self.advance(cycle);
        words_only(size).and_then(|()| self.read_word(address)).map_err(|why| BusFault { address, why })
    }

    fn write(&mut self, address: u32, size: Size, value: u32, cycle: u64) -> Result<(), BusFault> {
        self.advance(cycle);
        let done = words_only(size).and_then(|()| self.write_word(address, value));
        self.schedule();
        done.map_err(|why| BusFault { address, why })
    }

    fn lines(&self) -> u32 {
        let (reads_8, reads_9) = self.analog.pads_read();
        u32::from(self.rf.line()) << IRQ_RF
            | u32::from(self.rftimer.line()) << IRQ_RFTIMER
            | u32::from(self.gpio.level() && reads_8) << IRQ_GPIO8_HIGH
            | u32::from(!(self.gpio.level() && reads_9)) << IRQ_GPIO9_LOW
            | self.failure.map_or(0, |(failure, _)| failure.lines())
    }

    fn next_event(&self) -> u64 {
        self.next_event
    }

    fn advance(&mut self, cycle: u64) {
        while self.next_event <= cycle && self.next_event != u64::MAX {
            // What could not happen while something failed happens late.
            self.now = self.now.max(self.next_event);
            self.mend();
            self.gpio.advance(self.now);
            let pulses = if self.fails(Failure::Radio) { 0 } else { self.rf.advance(self.now) };
            self.rftimer.radio_events(pulses, self.now);
            let commands = self.rftimer.fire(self.now);
            if commands != 0 {
                self.command_radio(commands);
            }
            self.schedule();
        }
        self.now = self.now.max(cycle);
    }

    fn take_dma(&mut self) -> Option<Dma> {
        self.rf.take_dma()
    }

    fn give_dma(&mut self, bytes: &[u8]) {
        let pulses = self.rf.give_dma(bytes, self.now);
        self.rftimer.radio_events(pulses, self.now);
        self.schedule();
    }
}

#[cfg(test)]
mod tests {
    use super::scan_chain::tests::{needed, writes};
    use super::*;
    use proptest::prelude::*;

    const DARK: u32 = 1 << IRQ_GPIO9_LOW;
    const LIGHT: u32 = 1 << IRQ_GPIO8_HIGH;

    fn put(chip: &mut Scum3c, address: u32, value: u32, cycle: u64) {
        chip.write(address, Size::Word, value, cycle).unwrap();
    }

    fn get(chip: &mut Scum3c, address: u32, cycle: u64) -> u32 {
        chip.read(address, Size::Word, cycle).unwrap()
    }

    /// A chip whose scan chain is loaded, at cycle 0.
    fn chip() -> Scum3c {
        let mut chip = Scum3c::new(Config::default());
        load_chain(&mut chip, 0);
        chip
    }

    fn load_chain(chip: &mut Scum3c, cycle: u64) {
        for value in writes(&needed()) {
            put(chip, acfg(22), value.into(), cycle);
        }
    }

    fn acfg(register: u32) -> u32 {
        ANALOG_CFG + register * 0x4_0000
    }

    fn switch_transmitter_on(chip: &mut Scum3c, cycle: u64) {
        put(chip, acfg(11), 0x80, cycle);
        put(chip, acfg(10), 0x28, cycle);
        put(chip, acfg(16), 0x6, cycle);
    }

    fn ask_for_load(chip: &mut Scum3c, len: u32, cycle: u64) {
        put(chip, RF + 0x8, 0x2000_0040, cycle);
        put(chip, RF + 0xC, len, cycle);
        put(chip, RF, 1, cycle);
    }

    fn answer(chip: &mut Scum3c) {
        if let Some(dma) = chip.take_dma() {
            let bytes: Vec<u8> = (0..dma.len as u8).collect();
            chip.give_dma(&bytes);
        }
    }

    #[test]
    fn the_dark_holds_line_13_and_the_light_line_12() {
        let mut chip = chip();
        assert_eq!(chip.lines(), DARK);
        chip.push_edge(100, true).unwrap();
        chip.push_edge(350, false).unwrap();
        assert_eq!(chip.next_event(), 100);
        chip.advance(99);
        assert_eq!(chip.lines(), DARK);
        chip.advance(100);
        assert_eq!(chip.lines(), LIGHT);
        assert_eq!(get(&mut chip, GPIO, 200), 0x308);
        assert_eq!(get(&mut chip, GPIO, 350), 0);
        assert_eq!(chip.lines(), DARK);
    }

    #[test]
    fn an_edge_in_the_present_is_taken_and_one_in_the_past_is_not() {
        let mut chip = chip();
        chip.advance(1_000);
        assert_eq!(chip.push_edge(999, true), Err(EdgeError::InThePast { cycle: 999, now: 1_000 }));
        chip.push_edge(1_000, true).unwrap();
        assert_eq!(chip.next_event(), 1_000);
        chip.advance(1_000);
        assert!(chip.light());
    }

    #[test]
    fn a_packet_goes_from_ram_to_the_air() {
        let mut chip = chip();
        put(&mut chip, RF + 0x14, 0x7, 0);
        switch_transmitter_on(&mut chip, 100);
        ask_for_load(&mut chip, 20, 200);
        assert_eq!(chip.take_dma(), Some(Dma { address: 0x2000_0040, len: 20 }));
        chip.give_dma(&[7; 20]);
        put(&mut chip, RF, 2, 600);
        chip.advance(600 + 1_600);
        assert_eq!(get(&mut chip, RF + 0x10, 2_200), 0x3);
        assert_eq!(chip.lines(), DARK | 1 << IRQ_RF);
        let end_cycle = 600 + 26 * 320;
        chip.advance(end_cycle);
        assert_eq!(chip.take_frames(), [SentFrame { bytes: vec![7; 20], start_cycle: 600, end_cycle }]);
        assert_eq!(get(&mut chip, RF + 0x10, end_cycle), 0x7);
        put(&mut chip, RF + 0x18, 0x7, end_cycle);
        assert_eq!(chip.lines(), DARK);
        assert_eq!(chip.refused(), 0);
    }

    #[test]
    fn sending_with_the_transmitter_off_or_cold_is_refused() {
        let mut chip = chip();
        ask_for_load(&mut chip, 9, 0);
        answer(&mut chip);
        put(&mut chip, RF, 2, 1_000);
        switch_transmitter_on(&mut chip, 2_000);
        put(&mut chip, RF, 2, 2_499);
        put(&mut chip, RF, 2, 2_500);
        chip.advance(10_000);
        assert_eq!(
            chip.refusals(),
            [
                Refusal { cycle: 1_000, why: Why::WrongLdos { ldo: 0 } },
                Refusal { cycle: 2_499, why: Why::NotSettled { cycles: 499 } },
            ]
        );
        assert_eq!(chip.take_frames().len(), 1);
        assert_eq!(get(&mut chip, RF + 0x1C, 10_000), 0x2);
    }

    #[test]
    fn every_scan_bit_that_is_wrong_is_refused_when_it_is_loaded_and_when_a_frame_is_to_be_sent() {
        for &Needed { bit, value, what } in NEEDED {
            let mut words = needed();
            words[usize::from(bit) / 32] ^= 0x8000_0000 >> (bit % 32);
            let mut chip = Scum3c::new(Config::default());
            for value in writes(&words) {
                put(&mut chip, acfg(22), value.into(), 7);
            }
            switch_transmitter_on(&mut chip, 100);
            ask_for_load(&mut chip, 9, 200);
            answer(&mut chip);
            put(&mut chip, RF, 2, 1_000);
            let said: Vec<String> = chip.refusals().iter().map(Refusal::to_string).collect();
            let why =
                format!("ANALOG_CFG 22 (0x52580000): bit {bit} of the scan chain is not {}: {what}", u8::from(value));
            assert_eq!(said, [format!("cycle 7: {why}"), format!("cycle 1000: {why}")]);
        }
    }

    #[test]
    fn a_frame_that_is_sent_too_soon_after_tuning_is_refused() {
        let mut chip = chip();
        switch_transmitter_on(&mut chip, 0);
        ask_for_load(&mut chip, 9, 0);
        answer(&mut chip);
        put(&mut chip, acfg(7), 0x1234, 10_000);
        put(&mut chip, RF, 2, 10_499);
        put(&mut chip, RF, 2, 10_500);
        chip.advance(100_000);
        assert_eq!(chip.refusals(), [Refusal { cycle: 10_499, why: Why::NotSettled { cycles: 499 } }]);
        assert_eq!(chip.take_frames().len(), 1);
    }

    #[test]
    fn pads_that_are_not_read_see_no_light() {
        let mut chip = Scum3c::new(Config::default());
        chip.push_edge(100, true).unwrap();
        chip.advance(100);
        assert_eq!(chip.lines(), DARK);
    }

    #[test]
    fn receiving_before_the_receiver_was_set_up_is_refused() {
        let mut chip = Scum3c::new(Config::default());
        put(&mut chip, RF, 4, 10);
        assert_eq!(chip.refusals(), [Refusal { cycle: 10, why: Why::NotConfigured }]);
        let mut chip = super::tests::chip();
        put(&mut chip, RF, 4, 10);
        put(&mut chip, acfg(10), 0x18, 20);
        put(&mut chip, acfg(16), 0x1, 20);
        put(&mut chip, RF, 4, 30);
        put(&mut chip, RF, 4, 520);
        let whys: Vec<Why> = chip.refusals().iter().map(|refusal| refusal.why).collect();
        assert_eq!(whys, [Why::NoReceiver { ldo: 0 }, Why::NotSettled { cycles: 10 }]);
    }

    #[test]
    fn switching_off_or_retuning_in_mid_frame_loses_it() {
        for (register, value, why) in [(10, 0, Why::CutOff), (7, 0x1234, Why::Retuned)] {
            let mut chip = chip();
            switch_transmitter_on(&mut chip, 0);
            ask_for_load(&mut chip, 9, 0);
            answer(&mut chip);
            put(&mut chip, RF, 2, 1_000);
            put(&mut chip, acfg(register), value, 3_000);
            chip.advance(100_000);
            assert!(chip.take_frames().is_empty());
            assert_eq!(chip.refusals(), [Refusal { cycle: 3_000, why }]);
        }
    }

    #[test]
    fn the_timer_loads_and_sends_by_itself_and_captures_the_radio() {
        let mut chip = chip();
        switch_transmitter_on(&mut chip, 0);
        put(&mut chip, RF + 0x8, 0x2000_0040, 0);
        put(&mut chip, RF + 0xC, 11, 0);
        put(&mut chip, RF + 0x14, 0x3E0, 0);
        put(&mut chip, RFTIMER, 0x7, 0);
        put(&mut chip, RFTIMER + 0x10, 5_000, 0);
        put(&mut chip, RFTIMER + 0x14, 6_000, 0);
        put(&mut chip, RFTIMER + 0x30, 0x5, 0);
        put(&mut chip, RFTIMER + 0x34, 0x9, 0);
        put(&mut chip, RFTIMER + 0x60, 0x9, 0);
        put(&mut chip, RFTIMER + 0x64, 0x11, 0);
        while chip.next_event() < 100_000 {
            chip.advance(chip.next_event());
            answer(&mut chip);
        }
        let end_cycle = 6_000 + 17 * 320;
        let bytes = (0..11).collect();
        assert_eq!(chip.take_frames(), [SentFrame { bytes, start_cycle: 6_000, end_cycle }]);
        assert_eq!(get(&mut chip, RFTIMER + 0x50, 100_000), 7_600);
        assert_eq!(u64::from(get(&mut chip, RFTIMER + 0x54, 100_000)), end_cycle);
        assert_eq!(get(&mut chip, RFTIMER + 0x70, 100_000), 0x300);
        assert_eq!(chip.lines(), DARK | 1 << IRQ_RFTIMER);
        assert_eq!(get(&mut chip, RF + 0x10, 100_000), 0);
    }

    #[test]
    fn logs_come_out_of_the_uart() {
        let mut chip = chip();
        for byte in b"ok" {
            put(&mut chip, UART, u32::from(*byte), 0);
        }
        assert_eq!(chip.take_uart(), b"ok");
        assert_eq!(chip.early_uart_bytes(), 1);
    }

    #[test]
    fn the_receive_address_and_the_output_pads_read_back() {
        let mut chip = chip();
        put(&mut chip, DMA_BASE + DMA_RX_ADDR, 0x2000_1000, 0);
        put(&mut chip, GPIO + 0x4_0000, 0x8001, 0);
        assert_eq!(get(&mut chip, DMA_BASE + DMA_RX_ADDR, 0), 0x2000_1000);
        assert_eq!(get(&mut chip, GPIO + 0x4_0000, 0), 0x8001);
    }

    #[test]
    fn addresses_nobody_owns_and_narrow_accesses_fault() {
        let mut chip = chip();
        for address in [0x4000_0028, 0x4100_0000, 0x4200_000C, ADC, 0x5100_0004, 0x5300_0004, 0x6000_0000, 0x4300_0000]
        {
            let fault = chip.read(address, Size::Word, 0).unwrap_err();
            assert_eq!(fault.address, address);
            assert!(!fault.why.is_empty());
            assert!(chip.write(address, Size::Word, 0, 0).is_err());
        }
        for size in [Size::Byte, Size::Half] {
            let fault = chip.read(RFTIMER + 4, size, 0).unwrap_err();
            assert_eq!(fault.why, "peripheral registers are words");
            assert!(chip.write(UART, size, 0, 0).is_err());
        }
    }

    #[test]
    fn time_that_runs_backwards_stands_still() {
        let mut chip = chip();
        put(&mut chip, RFTIMER, 0x5, 0);
        assert_eq!(get(&mut chip, RFTIMER + 4, 500), 500);
        assert_eq!(get(&mut chip, RFTIMER + 4, 400), 500);
    }

    fn any_address() -> impl Strategy<Value = u32> {
        let base = proptest::sample::select(vec![RF, DMA_BASE, RFTIMER, ADC, UART, ANALOG_CFG, GPIO]);
        prop_oneof![
            4 => (base.clone(), 0_u32..0x20).prop_map(|(base, word)| base + word * 4),
            2 => (0_u32..32).prop_map(acfg),
            1 => (base, 0_u32..0x100_0000).prop_map(|(base, offset)| base + offset),
            1 => any::<u32>(),
        ]
    }

    fn any_value() -> impl Strategy<Value = u32> {
        prop_oneof![any::<u32>(), 0_u32..0x100, proptest::sample::select(vec![0x3FFF, 0x7F, 0x28, 0x6, 0x80, u32::MAX]),]
    }

    proptest! {
        #[test]
        fn no_sequence_of_accesses_panics_or_misses_an_event(
            hclk_hz in any::<NonZeroU32>(),
            start in prop_oneof![Just(0), Just(u64::MAX - 100_000)],
            accesses in proptest::collection::vec(
                (any_address(), any_value(), 0_u8..8, prop_oneof![0_u64..4, 0_u64..3_000]), 1..200),
        ) {
            let mut chip = Scum3c::new(Config { hclk_hz, ratio: Ratio::new(3, 7).unwrap(), ..Config::default() });
            let mut cycle = start;
            for (address, value, what, wait) in accesses {
                cycle = cycle.saturating_add(wait);
                match what {
                    0 => drop(chip.read(address, Size::Byte, cycle)),
                    1 => drop(chip.write(address, Size::Half, value, cycle)),
                    2 => drop(chip.push_edge(cycle.saturating_add(u64::from(value % 999)), value & 1 != 0)),
                    3 => chip.give_dma(&vec![0; value as usize % 200]),
                    4 => chip.set_hclk_hz(NonZeroU32::new(value).unwrap_or(hclk_hz), cycle),
                    5 | 6 => drop(chip.write(address, Size::Word, value, cycle)),
                    _ => drop(chip.read(address, Size::Word, cycle)),
                }
                if value & 2 != 0 {
                    answer(&mut chip);
                }
                chip.advance(cycle);
                prop_assert!(chip.next_event() > cycle || chip.next_event() == u64::MAX);
                chip.lines();
            }
        }
    }

    #[test]
    fn a_timer_that_fails_stands_still_whatever_it_is_told_and_then_goes_on() {
        let mut chip = Scum3c::new(Config::default());
        put(&mut chip, RFTIMER, 0x7, 0);
        chip.fail(Failure::Timer, 1_000, 5_000);
        put(&mut chip, RFTIMER, 0x3, 2_000);
        assert_eq!(get(&mut chip, RFTIMER + 4, 4_999), 1_000);
        assert_eq!(get(&mut chip, RFTIMER + 4, 6_000), 2_000);
    }

    #[test]
    fn a_radio_that_fails_is_done_when_it_works_again() {
        let mut chip = chip();
        put(&mut chip, RF + 0x14, 0x4, 0);
        switch_transmitter_on(&mut chip, 0);
        ask_for_load(&mut chip, 9, 1_000);
        answer(&mut chip);
        put(&mut chip, RF, 2, 2_000);
        chip.fail(Failure::Radio, 2_100, 1_000_000);
        chip.advance(999_999);
        assert_eq!(chip.lines(), DARK);
        chip.advance(1_000_000);
        assert_eq!(chip.lines(), DARK | 1 << IRQ_RF);
        assert_eq!(chip.take_frames().len(), 1);
    }

    #[test]
    fn lines_that_fail_are_active_for_as_long() {
        let mut chip = chip();
        chip.fail(Failure::Lines(1 << 3), 10, 20);
        assert_eq!(chip.lines(), DARK | 1 << 3);
        chip.advance(20);
        assert_eq!(chip.lines(), DARK);
    }

    #[test]
    fn power_that_comes_again_finds_new_devices_in_the_same_light() {
        let mut chip = chip();
        chip.push_edge(100, true).unwrap();
        chip.push_edge(900, false).unwrap();
        put(&mut chip, RFTIMER, 0x7, 0);
        chip.power_cycle(500);
        assert_eq!(get(&mut chip, RFTIMER + 4, 600), 0);
        // The scan chain is as new too: no pad is read.
        assert_eq!(chip.lines(), DARK);
        load_chain(&mut chip, 600);
        assert_eq!(chip.lines(), LIGHT);
        chip.advance(900);
        assert_eq!(chip.lines(), DARK);
    }
}
