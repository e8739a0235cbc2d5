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
//! nothing. The scan chain is only remembered: the model has its clocks and pads as the lighthouse set-up leaves them.

use super::rf_controller::Why;
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
/// Register 11: 802.15.4 chips modulate the transmitter (SCuM-3C test code, lighthouse.c:144-200: analog_cfg<183>).
const MODULATION_15_4: u16 = 0x0080;
/// Register 16: polyphase off, mixers off (SCuM-3C test code, radio.c).
const MIXER_TX: u16 = 0x0006;
/// The least time from switching the transmitter on to sending (SCuM-3C test code, radio.c: "at least ~50 us").
const SETTLE_US: u64 = 50;

/// The HF clock is divided by two to make HCLK (SCuM-3C test code, lighthouse.c: HCLK divider 2).
const HF_PER_CYCLE: u64 = 2;

/// The scan chain's length.
pub(super) const SCAN_BITS: usize = 1216;
/// Words of 32 bits in the scan chain.
const SCAN_WORDS: usize = SCAN_BITS / 32;
/// Bits of register 22 (SCuM-3C test code, scm3c_hw_interface.c:1289-1333). The data bit is inverted.
const SCAN_IN: u16 = 0x01;
const SCAN_PHI1: u16 = 0x02;
const SCAN_PHI2: u16 = 0x04;
const SCAN_LOAD: u16 = 0x08;

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

#[derive(Debug, Clone)]
struct ScanChain {
    /// A ring: `newest` is where the bit shifted in last lies, older bits follow it.
    shift: [bool; SCAN_BITS],
    newest: usize,
    sampled: Option<bool>,
    last: u16,
    loaded: [u32; SCAN_WORDS],
    loads: u64,
}

impl ScanChain {
    fn new() -> Self {
        Self { shift: [false; SCAN_BITS], newest: 0, sampled: None, last: 0, loaded: [0; SCAN_WORDS], loads: 0 }
    }

    fn write(&mut self, value: u16) {
        let rising = value & !self.last;
        self.last = value;
        // Two phases: phi2 opens the first half of each stage, phi1 the second.
        if rising & SCAN_PHI2 != 0 {
            self.sampled = Some(value & SCAN_IN == 0);
        }
        if rising & SCAN_PHI1 != 0
            && let Some(bit) = self.sampled.take()
        {
            self.newest = self.newest.checked_sub(1).unwrap_or(SCAN_BITS - 1);
            self.shift[self.newest] = bit;
        }
        if rising & SCAN_LOAD != 0 {
            self.loads += 1;
            self.loaded = [0; SCAN_WORDS];
            for position in 0..SCAN_BITS {
                if self.shift[(self.newest + position) % SCAN_BITS] {
                    self.loaded[position / 32] |= 0x8000_0000 >> (position % 32);
                }
            }
        }
    }
}

#[derive(Debug, Clone)]
pub(super) struct AnalogCfg {
    clocks: Clocks,
    hclk_hz: NonZeroU32,
    written: [u16; REGISTERS],
    counted_to: u64,
    /// Femtoseconds the counters have run.
    ran_fs: u128,
    /// Femtoseconds the counters have run with LO and divider powered.
    lc_ran_fs: u128,
    hf_count: u64,
    scan: ScanChain,
    transmitter_on_since: Option<u64>,
}

impl AnalogCfg {
    pub(super) fn new(clocks: Clocks, hclk_hz: NonZeroU32) -> Self {
        Self {
            clocks,
            hclk_hz,
            written: [0; REGISTERS],
            counted_to: 0,
            ran_fs: 0,
            lc_ran_fs: 0,
            hf_count: 0,
            scan: ScanChain::new(),
            transmitter_on_since: None,
        }
    }

    pub(super) fn hclk_hz(&self) -> NonZeroU32 {
        self.hclk_hz
    }

    pub(super) fn set_hclk_hz(&mut self, hclk_hz: NonZeroU32, cycle: u64) {
        self.count(cycle);
        self.hclk_hz = hclk_hz;
    }

    /// The scan chain as last loaded, bit n at `0x8000_0000 >> (n % 32)` of word n / 32.
    pub(super) fn scan_chain(&self) -> &[u32; SCAN_WORDS] {
        &self.scan.loaded
    }

    pub(super) fn scan_loads(&self) -> u64 {
        self.scan.loads
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
        self.transmitter()?;
        let needed = (SETTLE_US * u64::from(self.hclk_hz.get())).div_ceil(1_000_000);
        let settled = self.transmitter_on_since.map_or(0, |since| cycle.saturating_sub(since));
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
        if self.written[COUNTERS] != COUNTERS_RUN {
            return;
        }
        let fs = u128::from(cycles) * FS_PER_S / u128::from(self.hclk_hz.get());
        self.ran_fs = self.ran_fs.saturating_add(fs);
        if self.written[LDO] & (LDO_LO | LDO_DIV) == LDO_LO | LDO_DIV {
            self.lc_ran_fs = self.lc_ran_fs.saturating_add(fs);
        }
        self.hf_count = self.hf_count.wrapping_add(cycles.wrapping_mul(HF_PER_CYCLE));
    }

    pub(super) fn read(&mut self, offset: u32, cycle: u64) -> Result<u32, &'static str> {
        let index = register(offset)?;
        if index == SCAN {
            return Ok(u32::from(self.scan.last));
        }
        self.count(cycle);
        // Low half first (SCuM-3C test code, scm3c_hw_interface.c, read_counters_3B).
        let count = match index & !1 {
            0 => ticks(self.ran_fs, self.clocks.lf_hz),
            4 => self.hf_count as u32,
            6 => ticks(self.ran_fs, self.clocks.rc2m_hz),
            10 => ticks(self.lc_ran_fs, self.clocks.lc_div_hz),
            12 => ticks(self.ran_fs, self.clocks.if_hz),
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
        self.written[index] = value;
        match index {
            COUNTERS if value == COUNTERS_RESET => {
                self.ran_fs = 0;
                self.lc_ran_fs = 0;
                self.hf_count = 0;
            }
            LDO | MIXER if self.transmitter_powered() => {
                self.transmitter_on_since.get_or_insert(cycle);
            }
            LDO | MIXER => self.transmitter_on_since = None,
            SCAN => self.scan.write(value),
            _ => {}
        }
        Ok(())
    }

    fn transmitter_powered(&self) -> bool {
        self.written[LDO] & !LDO_DIV == LDO_TX && self.written[MIXER] == MIXER_TX
    }
}

const FS_PER_S: u128 = 1_000_000_000_000_000;

fn ticks(fs: u128, hz: u32) -> u32 {
    (fs.saturating_mul(u128::from(hz)) / FS_PER_S) as u32
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
    use super::*;
    use proptest::prelude::*;

    const HCLK_HZ: NonZeroU32 = NonZeroU32::new(10_000_000).unwrap();

    fn analog() -> AnalogCfg {
        AnalogCfg::new(Clocks::default(), HCLK_HZ)
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

    proptest! {
        #[test]
        fn what_is_shifted_into_the_scan_chain_is_what_gets_loaded(asc in any::<[u32; 16]>(), seed in any::<u32>()) {
            let mut words = [seed; SCAN_WORDS];
            words[..16].copy_from_slice(&asc);
            let mut analog = analog();
            for word in words.iter().rev() {
                for bit in 0..32 {
                    let data = if word >> bit & 1 == 0 { 0x21 } else { 0x20 };
                    for value in [data, data, data | 4, data, data | 2] {
                        put(&mut analog, SCAN, value, 0);
                    }
                }
            }
            prop_assert_eq!(analog.scan_loads(), 0);
            put(&mut analog, SCAN, 0x28, 0);
            put(&mut analog, SCAN, 0x20, 0);
            prop_assert_eq!(analog.scan_loads(), 1);
            prop_assert_eq!(analog.scan_chain(), &words);
        }
    }
}
