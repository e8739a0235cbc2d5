//! The analog configuration registers: power for the radio, the calibration counters, and the scan chain.
//!
//! Thirty-one 16-bit registers, one every 0x40000 bytes. Writing and reading are two different sets of wires: a write
//! configures, a read answers with a counter or with what the receiver measured, so reading register 10 gives a half
//! of the LC count and never what was written there.
//!
//! What can go wrong: software that reads, modifies and writes one of these registers writes a counter into it. Only
//! register 22 reads back, because the public SDK relies on it.
//!
//! # Note
//! Modelled: the counters (0), the LC frequency (7, 8) as far as a change cuts a transmission, the radio's LDOs (10),
//! the modulation source (11), mixer and polyphase (16), the scan chain (22). The others keep what is written and do
//! nothing. Without [`Oscillators`] the clocks are as the configuration says, whatever the codes.

use super::oscillators::Oscillators;
use super::refusal::Why;
use super::scan_chain::{ScanChain, WORDS};
use std::num::NonZeroU32;

/// Bytes from one register to the next (SCuM-3C test code, memory_map.h:18-21).
const STRIDE: u32 = 0x4_0000;
/// Registers 0 to 30.
const REGISTERS: usize = 31;

const COUNTERS: usize = 0;
const LC_LOW: usize = 7;
const LC_HIGH: usize = 8;
const LDO: usize = 10;
const MODULATION: usize = 11;
const MIXER: usize = 16;
const SCAN: usize = 22;
/// IF estimate, raw chips low and high, link quality, clock recovery (SCuM-3C test code, radio.c).
const RECEIVER: [usize; 5] = [16, 17, 18, 21, 25];

/// Register 0: all counters held at zero, holding their count, running (SCuM-3C test code, radio.c).
const COUNTERS_RESET: u16 = 0x0000;
const COUNTERS_STOP: u16 = 0x007F;
const COUNTERS_RUN: u16 = 0x3FFF;

/// Register 10: LO and PA on under software control (SCuM-3C test code, radio.c: AUX_EN inverted, DIV_EN, PA_EN, IF_EN,
/// LO_EN, PA_MUX, IF_MUX, LO_MUX from bit 7 down).
const LDO_TX: u16 = 0x0028;
/// The divider's supply, without which the LC counter stands still.
const LDO_DIV: u16 = 0x0040;
const LDO_LO: u16 = 0x0008;
/// The power amplifier's supply.
const LDO_PA: u16 = 0x0020;
/// Register 10: LO and IF on under software control (SCuM-3C test code, radio.c).
const LDO_RX: u16 = 0x0018;
/// Register 11: 802.15.4 chips modulate the transmitter (SCuM-3C test code, lighthouse.c:144-200: analog_cfg<183>).
const MODULATION_15_4: u16 = 0x0080;
/// Register 16: polyphase off, mixers off (SCuM-3C test code, radio.c).
const MIXER_TX: u16 = 0x0006;
/// Register 16: polyphase on, mixers on (SCuM-3C test code, radio.c).
const MIXER_RX: u16 = 0x0001;
/// The least time from switching the transmitter on, or tuning it, to sending (SCuM-3C test code, radio.c: "at least
/// ~50 us"; lighthouse.c:378-411 tunes last and waits then).
const SETTLE_US: u64 = 50;

/// The HF clock is divided by two to make HCLK (SCuM-3C test code, lighthouse.c: HCLK divider 2).
const HF_PER_CYCLE: u64 = 2;

/// What the free-running oscillators do, other than the one that makes HCLK. Defaults are the calibration targets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Clocks {
    /// The 32 kHz oscillator, Hz.
    pub lf_hz: u32,
    /// The 2 MHz RC oscillator, Hz (target 200,000 counts in 100 ms).
    pub rc2m_hz: u32,
    /// The LC tank after its divider by 960, Hz (target 250,187 counts in 100 ms).
    pub lc_div_hz: u32,
    /// The intermediate-frequency clock, Hz (target 1,600,000 counts in 100 ms).
    pub if_hz: u32,
}

impl Default for Clocks {
    fn default() -> Self {
        Self { lf_hz: 32_768, rc2m_hz: 2_000_000, lc_div_hz: 2_501_870, if_hz: 16_000_000 }
    }
}

/// Rates now, Hz.
#[derive(Debug, Clone, Copy)]
struct Rates {
    lf_hz: f64,
    rc2m_hz: f64,
    lc_div_hz: f64,
    if_hz: f64,
}

/// The radio's oscillator is counted divided by 480 * 2 (SCuM-3C test code, optical.c).
const LC_DIVIDER: f64 = 960.0;

/// Counts since the last reset, with their fractions.
#[derive(Debug, Clone, Copy, Default)]
struct Counts {
    lf: f64,
    rc2m: f64,
    lc: f64,
    intermediate: f64,
    hf: u64,
}

#[derive(Debug, Clone)]
pub(super) struct AnalogCfg {
    clocks: Clocks,
    hclk_hz: NonZeroU32,
    written: [u16; REGISTERS],
    oscillators: Option<Oscillators>,
    rates: Rates,
    counted_to: u64,
    counts: Counts,
    /// Cycles with the LO powered, those with the PA powered too.
    powered: Powered,
    scan: ScanChain,
    transmitter_on_since: Option<u64>,
    receiver_on_since: Option<u64>,
}

/// How long the radio was powered, in core cycles.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Powered {
    /// The local oscillator, whatever else.
    pub oscillator: u64,
    /// Of those, with the power amplifier.
    pub amplifier: u64,
}

impl AnalogCfg {
    pub(super) fn new(clocks: Clocks, hclk_hz: NonZeroU32, oscillators: Option<Oscillators>) -> Self {
        let mut analog = Self {
            clocks,
            hclk_hz,
            written: [0; REGISTERS],
            oscillators,
            rates: Rates { lf_hz: 0.0, rc2m_hz: 0.0, lc_div_hz: 0.0, if_hz: 0.0 },
            counted_to: 0,
            counts: Counts::default(),
            powered: Powered::default(),
            scan: ScanChain::new(),
            transmitter_on_since: None,
            receiver_on_since: None,
        };
        analog.retune();
        analog
    }

    /// The rates follow the codes.
    fn retune(&mut self) {
        let Clocks { lf_hz, rc2m_hz, lc_div_hz, if_hz } = self.clocks;
        let chain = self.scan.loaded();
        self.rates = Rates {
            lf_hz: lf_hz.into(),
            rc2m_hz: self.oscillators.map_or(rc2m_hz.into(), |chip| chip.chip_clock_hz(chain)),
            lc_div_hz: self
                .oscillators
                .map_or(lc_div_hz.into(), |chip| chip.lc_hz(self.written[LC_LOW], self.written[LC_HIGH]) / LC_DIVIDER),
            if_hz: self.oscillators.map_or(if_hz.into(), |chip| chip.if_hz(chain)),
        };
    }

    /// A new chain has taken effect: the core runs on the 20 MHz oscillator where all is well.
    fn reclock(&mut self) {
        let hz = self.oscillators.map(|chip| chip.hf_hz(self.scan.loaded()) / HF_PER_CYCLE as f64);
        if let Some(hclk_hz) =
            hz.filter(|_| self.scan.wrong().is_empty()).and_then(|hz| NonZeroU32::new(hz.round() as u32))
        {
            self.hclk_hz = hclk_hz;
        }
    }

    /// The radio's own rate, Hz.
    pub(super) fn lc_hz(&self) -> f64 {
        self.rates.lc_div_hz * LC_DIVIDER
    }

    /// The 2 MHz oscillator, Hz.
    pub(super) fn chip_clock_hz(&self) -> f64 {
        self.rates.rc2m_hz
    }

    /// How long the radio was powered, to `cycle`.
    pub(super) fn powered(&mut self, cycle: u64) -> Powered {
        self.count(cycle);
        self.powered
    }

    /// What is wrong with the scan chain.
    pub(super) fn scan_wrong(&self) -> &[Why] {
        self.scan.wrong()
    }

    /// Whether pads 8 and 9 are read.
    pub(super) fn pads_read(&self) -> (bool, bool) {
        self.scan.loaded().reads()
    }

    pub(super) fn hclk_hz(&self) -> NonZeroU32 {
        self.hclk_hz
    }

    pub(super) fn set_hclk_hz(&mut self, hclk_hz: NonZeroU32, cycle: u64) {
        self.count(cycle);
        self.hclk_hz = hclk_hz;
    }

    /// The scan chain as last loaded, bit n at `0x8000_0000 >> (n % 32)` of word n / 32.
    pub(super) fn scan_chain(&self) -> &[u32; WORDS] {
        &self.scan.loaded().0
    }

    pub(super) fn scan_loads(&self) -> u64 {
        self.scan.loads()
    }

    /// Whether the transmitter is powered and modulated.
    pub(super) fn transmitter(&self) -> Result<(), Why> {
        if self.written[LDO] & !LDO_DIV != LDO_TX {
            return Err(Why::WrongLdos { ldo: self.written[LDO] });
        }
        if self.written[MIXER] != MIXER_TX {
            return Err(Why::WrongMixers { mixer: self.written[MIXER] });
        }
        if self.written[MODULATION] & MODULATION_15_4 == 0 {
            return Err(Why::NotModulated);
        }
        Ok(())
    }

    /// Whether a frame can be sent at `cycle`.
    pub(super) fn ready_to_send(&self, cycle: u64) -> Result<(), Why> {
        if let Some(&wrong) = self.scan.wrong().first() {
            return Err(wrong);
        }
        self.transmitter()?;
        self.settled(self.transmitter_on_since, cycle)
    }

    /// Whether the receiver can be started at `cycle`.
    pub(super) fn ready_to_receive(&self, cycle: u64) -> Result<(), Why> {
        if let Some(&wrong) = self.scan.wrong().first() {
            return Err(wrong);
        }
        if self.written[LDO] & !LDO_DIV != LDO_RX {
            return Err(Why::NoReceiver { ldo: self.written[LDO] });
        }
        if self.written[MIXER] != MIXER_RX {
            return Err(Why::ReceiverOff { mixer: self.written[MIXER] });
        }
        self.settled(self.receiver_on_since, cycle)
    }

    fn settled(&self, since: Option<u64>, cycle: u64) -> Result<(), Why> {
        let needed = (SETTLE_US * u64::from(self.hclk_hz.get())).div_ceil(1_000_000);
        let settled = since.map_or(0, |since| cycle.saturating_sub(since));
        if settled < needed {
            return Err(Why::NotSettled { cycles: settled });
        }
        Ok(())
    }

    /// The code that tunes the LC tank.
    pub(super) fn lc_code(&self) -> (u16, u16) {
        (self.written[LC_LOW], self.written[LC_HIGH])
    }

    fn count(&mut self, cycle: u64) {
        let cycles = cycle.saturating_sub(self.counted_to);
        self.counted_to = cycle;
        if self.written[LDO] & LDO_LO != 0 {
            self.powered.oscillator = self.powered.oscillator.saturating_add(cycles);
            if self.written[LDO] & LDO_PA != 0 {
                self.powered.amplifier = self.powered.amplifier.saturating_add(cycles);
            }
        }
        if self.written[COUNTERS] != COUNTERS_RUN {
            return;
        }
        let seconds = cycles as f64 / f64::from(self.hclk_hz.get());
        let Rates { lf_hz, rc2m_hz, lc_div_hz, if_hz } = self.rates;
        self.counts.lf += seconds * lf_hz;
        self.counts.rc2m += seconds * rc2m_hz;
        self.counts.intermediate += seconds * if_hz;
        if self.written[LDO] & (LDO_LO | LDO_DIV) == LDO_LO | LDO_DIV {
            self.counts.lc += seconds * lc_div_hz;
        }
        self.counts.hf = self.counts.hf.wrapping_add(cycles.wrapping_mul(HF_PER_CYCLE));
    }

    pub(super) fn read(&mut self, offset: u32, cycle: u64) -> Result<u32, &'static str> {
        let index = register(offset)?;
        if index == SCAN {
            return Ok(u32::from(self.scan.last()));
        }
        self.count(cycle);
        // Low half first (SCuM-3C test code, scm3c_hw_interface.c, read_counters_3B).
        let count = match index & !1 {
            0 => whole(self.counts.lf),
            4 => self.counts.hf as u32,
            6 => whole(self.counts.rc2m),
            10 => whole(self.counts.lc),
            12 => whole(self.counts.intermediate),
            _ if RECEIVER.contains(&index) => {
                return Err("what the receiver measures is not simulated");
            }
            _ => return Err("nobody knows what this ANALOG_CFG register reads as"),
        };
        Ok(if index % 2 == 0 { count & 0xFFFF } else { count >> 16 })
    }

    pub(super) fn write(&mut self, offset: u32, value: u32, cycle: u64) -> Result<(), &'static str> {
        let index = register(offset)?;
        let value = value as u16;
        if index == COUNTERS && !matches!(value, COUNTERS_RESET | COUNTERS_STOP | COUNTERS_RUN) {
            return Err("ANALOG_CFG register 0 is known to take 0x0000, 0x007F and 0x3FFF only");
        }
        self.count(cycle);
        let before = std::mem::replace(&mut self.written[index], value);
        match index {
            COUNTERS if value == COUNTERS_RESET => self.counts = Counts::default(),
            LDO | MIXER => {
                let on = |is: bool, since: Option<u64>| is.then(|| since.unwrap_or(cycle));
                self.transmitter_on_since = on(self.transmitter_powered(), self.transmitter_on_since);
                self.receiver_on_since = on(self.receiver_powered(), self.receiver_on_since);
            }
            LC_LOW | LC_HIGH => {
                self.retune();
                // An oscillator that goes elsewhere has to settle there.
                if value != before {
                    for since in [&mut self.transmitter_on_since, &mut self.receiver_on_since] {
                        *since = since.map(|_| cycle);
                    }
                }
            }
            SCAN if self.scan.write(value) => {
                self.reclock();
                self.retune();
            }
            _ => {}
        }
        Ok(())
    }

    fn transmitter_powered(&self) -> bool {
        self.written[LDO] & !LDO_DIV == LDO_TX && self.written[MIXER] == MIXER_TX
    }

    fn receiver_powered(&self) -> bool {
        self.written[LDO] & !LDO_DIV == LDO_RX && self.written[MIXER] == MIXER_RX
    }
}

/// What a counter of 32 bits shows. An edge is counted when it has come: a millionth is the arithmetic's own.
fn whole(count: f64) -> u32 {
    (count + 1e-6) as u64 as u32
}

fn register(offset: u32) -> Result<usize, &'static str> {
    let index = (offset / STRIDE) as usize;
    if !offset.is_multiple_of(STRIDE) || index >= REGISTERS {
        return Err("no ANALOG_CFG register here");
    }
    Ok(index)
}

#[cfg(test)]
mod tests {
    use super::super::scan_chain::tests::{needed, writes};
    use super::*;

    const HCLK_HZ: NonZeroU32 = NonZeroU32::new(10_000_000).unwrap();

    fn analog() -> AnalogCfg {
        loaded(None)
    }

    fn loaded(oscillators: Option<Oscillators>) -> AnalogCfg {
        let mut analog = AnalogCfg::new(Clocks::default(), HCLK_HZ, oscillators);
        for value in writes(&needed()) {
            put(&mut analog, SCAN, value.into(), 0);
        }
        analog
    }

    fn put(analog: &mut AnalogCfg, index: usize, value: u32, cycle: u64) {
        analog.write(index as u32 * STRIDE, value, cycle).unwrap();
    }

    fn counted(analog: &mut AnalogCfg, index: u32, cycle: u64) -> u32 {
        let low = analog.read(index * STRIDE, cycle).unwrap();
        let high = analog.read((index + 1) * STRIDE, cycle).unwrap();
        low | high << 16
    }

    #[test]
    fn the_counters_reach_their_calibration_targets_in_100_ms() {
        let mut analog = analog();
        put(&mut analog, LDO, 0x68, 0);
        put(&mut analog, COUNTERS, 0, 5);
        put(&mut analog, COUNTERS, 0x3FFF, 1_000);
        put(&mut analog, COUNTERS, 0x007F, 1_001_000);
        for (index, target) in [(0, 3_276), (4, 2_000_000), (6, 200_000), (10, 250_187), (12, 1_600_000)] {
            assert_eq!(counted(&mut analog, index, 9_000_000), target, "register {index}");
        }
        put(&mut analog, COUNTERS, 0, 9_000_001);
        assert_eq!(counted(&mut analog, 4, 9_000_002), 0);
    }

    #[test]
    fn the_counters_follow_a_clock_that_drifts() {
        let mut analog = analog();
        put(&mut analog, COUNTERS, 0x3FFF, 0);
        analog.set_hclk_hz(NonZeroU32::new(20_000_000).unwrap(), 1_000_000);
        put(&mut analog, COUNTERS, 0x007F, 3_000_000);
        assert_eq!(counted(&mut analog, 6, 3_000_000), 400_000);
    }

    #[test]
    fn the_lc_counter_stands_still_without_its_divider() {
        let mut analog = analog();
        put(&mut analog, LDO, 0x28, 0);
        put(&mut analog, COUNTERS, 0x3FFF, 0);
        assert_eq!(counted(&mut analog, 10, 1_000_000), 0);
    }

    #[test]
    fn reading_register_10_gives_a_counter_and_not_what_was_written() {
        let mut analog = analog();
        put(&mut analog, LDO, 0x28, 0);
        assert_eq!(analog.read(LDO as u32 * STRIDE, 1), Ok(0));
    }

    #[test]
    fn the_transmitter_is_ready_50_us_after_it_is_switched_on() {
        let mut analog = analog();
        put(&mut analog, MODULATION, 0x80, 0);
        assert_eq!(analog.ready_to_send(0), Err(Why::WrongLdos { ldo: 0 }));
        put(&mut analog, LDO, 0x28, 1_000);
        assert_eq!(analog.ready_to_send(9_000), Err(Why::WrongMixers { mixer: 0 }));
        put(&mut analog, MIXER, 0x6, 10_000);
        assert_eq!(analog.ready_to_send(10_499), Err(Why::NotSettled { cycles: 499 }));
        assert_eq!(analog.ready_to_send(10_500), Ok(()));
        put(&mut analog, LDO, 0x28, 10_600);
        put(&mut analog, LDO, 0x68, 10_600);
        assert_eq!(analog.ready_to_send(10_600), Ok(()));
        put(&mut analog, LDO, 0x00, 10_700);
        put(&mut analog, LDO, 0x28, 10_800);
        assert_eq!(analog.ready_to_send(10_900), Err(Why::NotSettled { cycles: 100 }));
    }

    #[test]
    fn the_radio_is_ready_50_us_after_it_is_tuned() {
        let mut analog = analog();
        put(&mut analog, MODULATION, 0x80, 0);
        put(&mut analog, LC_LOW, 0x1234, 0);
        put(&mut analog, LDO, 0x28, 0);
        put(&mut analog, MIXER, 0x6, 0);
        // As it was: nothing has to settle.
        put(&mut analog, LC_LOW, 0x1234, 1_000);
        assert_eq!(analog.ready_to_send(1_000), Ok(()));
        for (register, cycle) in [(LC_LOW, 2_000), (LC_HIGH, 3_000)] {
            put(&mut analog, register, 1, cycle);
            assert_eq!(analog.ready_to_send(cycle + 499), Err(Why::NotSettled { cycles: 499 }));
            assert_eq!(analog.ready_to_send(cycle + 500), Ok(()));
        }
        put(&mut analog, LDO, 0x18, 10_000);
        put(&mut analog, MIXER, 0x1, 10_000);
        put(&mut analog, LC_LOW, 2, 20_000);
        assert_eq!(analog.ready_to_receive(20_000), Err(Why::NotSettled { cycles: 0 }));
    }

    #[test]
    fn without_the_modulation_source_nothing_can_be_sent() {
        let mut analog = analog();
        put(&mut analog, LDO, 0x28, 0);
        put(&mut analog, MIXER, 0x6, 0);
        assert_eq!(analog.ready_to_send(1_000), Err(Why::NotModulated));
    }

    #[test]
    fn registers_between_the_strides_and_beyond_the_last_fault() {
        let mut analog = analog();
        for offset in [4, STRIDE + 2, 31 * STRIDE, 0xFF_FFFC] {
            assert!(analog.read(offset, 0).is_err());
            assert!(analog.write(offset, 0, 0).is_err());
        }
        for index in [2, 3, 8, 9, 14, 15, 16, 19, 25, 30] {
            assert!(analog.read(index * STRIDE, 0).is_err(), "register {index}");
        }
        assert!(analog.write(0, 1, 0).is_err());
    }

    #[test]
    fn without_a_scan_chain_the_radio_neither_sends_nor_receives() {
        let mut analog = AnalogCfg::new(Clocks::default(), HCLK_HZ, None);
        put(&mut analog, MODULATION, 0x80, 0);
        put(&mut analog, LDO, 0x28, 0);
        put(&mut analog, MIXER, 0x6, 0);
        assert_eq!(analog.ready_to_send(1_000), Err(Why::NotConfigured));
        assert_eq!(analog.ready_to_receive(1_000), Err(Why::NotConfigured));
    }

    #[test]
    fn the_receiver_is_ready_50_us_after_it_is_switched_on() {
        let mut analog = analog();
        assert_eq!(analog.ready_to_receive(0), Err(Why::NoReceiver { ldo: 0 }));
        put(&mut analog, LDO, 0x18, 0);
        assert_eq!(analog.ready_to_receive(9_000), Err(Why::ReceiverOff { mixer: 0 }));
        put(&mut analog, MIXER, 0x1, 1_000);
        assert_eq!(analog.ready_to_receive(1_499), Err(Why::NotSettled { cycles: 499 }));
        assert_eq!(analog.ready_to_receive(1_500), Ok(()));
        assert_eq!(analog.ready_to_send(1_500), Err(Why::WrongLdos { ldo: 0x18 }));
    }

    #[test]
    fn the_time_the_radio_is_powered_is_kept() {
        let mut analog = analog();
        put(&mut analog, LDO, 0x28, 100);
        put(&mut analog, LDO, 0x48, 400);
        put(&mut analog, LDO, 0x00, 1_000);
        assert_eq!(analog.powered(5_000), Powered { oscillator: 900, amplifier: 300 });
    }

    #[test]
    fn the_clocks_of_a_chip_with_its_own_oscillators_follow_their_codes() {
        let chip = Oscillators::of(3);
        let mut analog = loaded(Some(chip));
        let (before, slower_word) = (analog.hclk_hz(), 870 / 32);
        let mut words = needed();
        words[slower_word] |= 0x8000_0000 >> (870 % 32);
        for value in writes(&words) {
            put(&mut analog, SCAN, value.into(), 0);
        }
        assert!(analog.hclk_hz() < before, "a higher fine code is slower");
        let radio = analog.lc_hz();
        put(&mut analog, LC_LOW, 0x1000, 0);
        assert!(analog.lc_hz() > radio, "a higher fine code is faster");
    }
}
