//! What the free-running oscillators of one chip make of their codes.
//!
//! Every chip is a little different: each oscillator misses its nominal rate by percents at the typical codes, and each
//! code moves it by a step that is the chip's own. A rate is monotone in each code; where one code ends and the next
//! begins (fine to mid, mid to coarse) the step is a little larger, as a ladder of switched capacitors has it.
//!
//! What can go wrong: this is a model. Steps are those the SCuM-3C test code writes beside its own calibration
//! (`optical.c:95-258`), how chips scatter is assumed, and so is the oscillators' being free of noise and temperature.

use super::scan_chain::Chain;

/// A part of a million.
const MILLION: f64 = 1e6;

/// One chip.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Oscillators {
    hf_ppm: i32,
    hf_step_ppm: i32,
    lc_ppm: i32,
    lc_step_hz: i32,
    lc_gap_milli: i32,
    chip_clock_ppm: i32,
    chip_clock_scale_ppm: i32,
    if_ppm: i32,
}

impl Oscillators {
    /// The 20 MHz oscillator at its typical codes (SCuM-3C test code, scm3c_hw_interface.c).
    const HF_HZ: f64 = 20e6;
    const HF_TYPICAL: (u32, u32) = (3, 17);
    /// Assumed: coarse steps overlap with the 32 fine ones.
    const HF_COARSE_PPM: f64 = 50_000.0;
    /// The radio's oscillator (optical.c: 2.4025 GHz) at the code the lighthouse application begins with.
    const LC_HZ: f64 = 2.4025e9;
    const LC_TYPICAL: f64 = 680.0;
    /// The 2 MHz oscillator at its typical codes (lighthouse.h) and what a code of each kind takes from it: about 1100,
    /// 150 and 25 counts of 200,000 (optical.c).
    const CHIP_CLOCK_HZ: f64 = 2e6;
    const CHIP_CLOCK_TYPICAL: [i32; 3] = [21, 15, 15];
    const CHIP_CLOCK_STEPS_PPM: [f64; 3] = [5500.0, 750.0, 125.0];
    /// The intermediate frequency's clock and its fine step, 2800 counts of 1,600,000 (optical.c).
    const IF_HZ: f64 = 16e6;
    const IF_TYPICAL: i32 = 18;
    const IF_STEP_PPM: f64 = 1750.0;

    /// The chip with this number.
    #[must_use]
    pub fn of(seed: u64) -> Self {
        let mut state = seed;
        let mut within = |low: i32, high: i32| {
            state = state.wrapping_add(0x9E37_79B9_7F4A_7C15);
            let mut z = (state ^ state >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
            z = (z ^ z >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
            low + ((z ^ z >> 31) % u64::from(low.abs_diff(high) + 1)) as i32
        };
        Self {
            hf_ppm: within(-30_000, 30_000),
            // About 3000 (optical.c: 6000 counts of 2,000,000), and below: wider steps would step over the aim.
            hf_step_ppm: within(2400, 2900),
            lc_ppm: within(-5000, 5000),
            lc_step_hz: within(85_000, 120_000),
            lc_gap_milli: within(0, 400),
            chip_clock_ppm: within(-30_000, 30_000),
            chip_clock_scale_ppm: within(950_000, 1_050_000),
            if_ppm: within(-30_000, 30_000),
        }
    }

    /// The 20 MHz oscillator, Hz.
    pub(super) fn hf_hz(&self, chain: &Chain) -> f64 {
        let (coarse, fine) = chain.hf_codes();
        let steps = f64::from(fine as i32 - Self::HF_TYPICAL.1 as i32) * f64::from(self.hf_step_ppm)
            + f64::from(coarse as i32 - Self::HF_TYPICAL.0 as i32) * Self::HF_COARSE_PPM;
        Self::HF_HZ * (1.0 + f64::from(self.hf_ppm) / MILLION) / (1.0 + steps / MILLION).max(0.1)
    }

    /// The radio's oscillator, Hz, from analog registers 7 and 8.
    pub(super) fn lc_hz(&self, low: u16, high: u16) -> f64 {
        let field = |at: u32| (u32::from(low) >> at & 0x1F).reverse_bits() >> 27;
        let (coarse, mid) = (field(0), field(6));
        let fine = (u32::from(low) >> 12 | (u32::from(high) & 1) << 4).reverse_bits() >> 27;
        let gap = f64::from(self.lc_gap_milli) / 1000.0;
        // A code steps over the fine DAC's 16, whose largest capacitor is small; three mids are 23 fines, six of those
        // and two fines a coarse one (scm3c_hw_interface.c:1532-1566).
        let fine = if fine > 15 { f64::from(fine) - 0.9 } else { f64::from(fine) };
        let code = f64::from(coarse as i32 - 19) * (140.0 + 7.0 * gap) + f64::from(mid) * (23.0 + gap) / 3.0 + fine;
        Self::LC_HZ * (1.0 + f64::from(self.lc_ppm) / MILLION) + (code - Self::LC_TYPICAL) * f64::from(self.lc_step_hz)
    }

    /// The 2 MHz oscillator, Hz.
    pub(super) fn chip_clock_hz(&self, chain: &Chain) -> f64 {
        let scale = f64::from(self.chip_clock_scale_ppm) / MILLION;
        let slower: f64 = chain
            .chip_clock_codes()
            .into_iter()
            .zip(Self::CHIP_CLOCK_TYPICAL)
            .zip(Self::CHIP_CLOCK_STEPS_PPM)
            .map(|((code, typical), step)| f64::from(code as i32 - typical) * step * scale)
            .sum();
        Self::CHIP_CLOCK_HZ * (1.0 + f64::from(self.chip_clock_ppm) / MILLION) / (1.0 + slower / MILLION).max(0.1)
    }

    /// The intermediate frequency's clock, Hz.
    pub(super) fn if_hz(&self, chain: &Chain) -> f64 {
        let slower = f64::from(chain.if_fine() as i32 - Self::IF_TYPICAL) * Self::IF_STEP_PPM;
        Self::IF_HZ * (1.0 + f64::from(self.if_ppm) / MILLION) / (1.0 + slower / MILLION).max(0.1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Registers 7 and 8 for a code (SCuM-3C test code, scm3c_hw_interface.c:1471-1566).
    fn registers(code: u32) -> (u16, u16) {
        let flip8 = |value: u32| u32::from((value as u8).reverse_bits());
        let (coarse, rest) = (code / 140 + 19, code % 140);
        let (mid, fine) = (rest / 23 * 3, rest % 23);
        let fine = flip8(fine + u32::from(fine > 15));
        (((fine & 0x78) << 9 | flip8(mid) << 3 | flip8(coarse) >> 3) as u16, (fine >> 7) as u16)
    }

    #[test]
    fn codes_reach_the_radio_in_the_order_of_its_registers() {
        let plain = Oscillators { lc_ppm: 0, lc_step_hz: 100_000, lc_gap_milli: 0, ..Oscillators::of(0) };
        for (code, at_hz) in [(680, 2.4025e9), (681, 2.4026e9), (560, 2.3905e9), (0, 2.3345e9)] {
            let (low, high) = registers(code);
            assert!((plain.lc_hz(low, high) - at_hz).abs() < 0.11e6, "{code}: {}", plain.lc_hz(low, high));
        }
    }

    proptest! {
        #[test]
        fn a_higher_code_is_a_faster_radio_on_every_chip(seed: u64) {
            let chip = Oscillators::of(seed);
            let rates: Vec<f64> = (0..1820).map(|code| {
                let (low, high) = registers(code);
                chip.lc_hz(low, high)
            }).collect();
            prop_assert!(rates.windows(2).all(|pair| pair[0] < pair[1]));
            // No step is wider than the tolerance of 40 ppm, 96 kHz, on both sides.
            prop_assert!(rates.windows(2).all(|pair| pair[1] - pair[0] < 192e3));
        }
    }
}
