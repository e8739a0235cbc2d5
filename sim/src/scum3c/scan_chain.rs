//! The analog scan chain: 1216 bits that choose the chip's clocks, supplies and pads, shifted in one by one.
//!
//! # Design
//! The chip takes whatever is loaded. Here a load is held against what the lighthouse set-up needs, bit by bit, and what
//! is wrong is said; a mote whose chain is wrong can neither see nor send.
//!
//! What can go wrong: a bit that the public sources set and nobody documents may be needed or not. Needed is here what
//! `lighthouse.c:24-200` sets or clears by number and the supplies and currents that it chooses; the codes of the
//! oscillators are the firmware's to choose.

use super::refusal::{Needed, NeededCode, Why};

/// The scan chain's length.
pub(super) const BITS: usize = 1216;
/// Words of 32 bits in the scan chain.
pub(super) const WORDS: usize = BITS / 32;
/// Bits of register 22 (SCuM-3C test code, scm3c_hw_interface.c:1289-1333). The data bit is inverted.
const SCAN_IN: u16 = 0x01;
const PHI1: u16 = 0x02;
const PHI2: u16 = 0x04;
const LOAD: u16 = 0x08;

/// Every bit that the lighthouse set-up needs (SCuM-3C test code, lighthouse.c:24-200 and what it calls in
/// scm3c_hw_interface.c, lines as given).
pub const NEEDED: &[Needed] = &{
    const fn one(bit: u16, what: &'static str) -> Needed {
        Needed { bit, value: true, what }
    }
    const fn zero(bit: u16, what: &'static str) -> Needed {
        Needed { bit, value: false, what }
    }
    [
        // lighthouse.c:75-106.
        one(1147, "the core runs on the 20 MHz oscillator"),
        one(1151, "the radio timer runs on the 20 MHz oscillator"),
        one(36, "the radio timer's divider is passed by"),
        one(553, "the low-frequency clock is off"),
        zero(57, "the core's clock is halved"),
        zero(56, "the core's clock is halved"),
        zero(55, "the core's clock is halved"),
        zero(54, "the core's clock is halved"),
        zero(53, "the core's clock is halved"),
        one(52, "the core's clock is halved"),
        one(51, "the core's clock is halved"),
        zero(50, "the core's clock is halved"),
        one(1156, "chips are sent by the 2 MHz oscillator"),
        one(41, "the chip clock's divider is passed by"),
        one(1114, "the 2 MHz oscillator is on"),
        one(623, "the 32 kHz oscillator is on"),
        one(2, "the counters obey ANALOG_CFG 0"),
        one(3, "the counters obey ANALOG_CFG 0"),
        one(4, "the counters obey ANALOG_CFG 0"),
        one(5, "the counters obey ANALOG_CFG 0"),
        one(6, "the counters obey ANALOG_CFG 0"),
        one(7, "the counters obey ANALOG_CFG 0"),
        one(8, "the counters obey ANALOG_CFG 0"),
        // init_ldo_control, :324-360.
        zero(501, "the supplies obey ANALOG_CFG 10"),
        zero(502, "the supplies obey ANALOG_CFG 10"),
        zero(503, "the supplies obey ANALOG_CFG 10"),
        zero(504, "the supplies obey ANALOG_CFG 10"),
        one(505, "the supplies obey ANALOG_CFG 10"),
        zero(506, "the supplies obey ANALOG_CFG 10"),
        one(507, "the supplies obey ANALOG_CFG 10"),
        zero(508, "the supplies obey ANALOG_CFG 10"),
        one(509, "the supplies obey ANALOG_CFG 10"),
        one(510, "the supplies obey ANALOG_CFG 10"),
        one(511, "the supplies obey ANALOG_CFG 10"),
        one(512, "the supplies obey ANALOG_CFG 10"),
        zero(513, "the supplies obey ANALOG_CFG 10"),
        zero(514, "the supplies obey ANALOG_CFG 10"),
        one(515, "the supplies obey ANALOG_CFG 10"),
        one(516, "the supplies obey ANALOG_CFG 10"),
        one(914, "the supplies obey ANALOG_CFG 10"),
        // lighthouse.c:144-200.
        one(1000, "the modulation's tones are 1 MHz apart"),
        one(1001, "the modulation's tones are 1 MHz apart"),
        one(1002, "the modulation's tones are 1 MHz apart"),
        one(1003, "the modulation's tones are 1 MHz apart"),
        zero(964, "the core controls the local oscillator"),
        zero(1081, "the core controls the divider"),
        // radio_init_rx_MF_lighthouse: who switches the mixers, in phase and in quadrature, and the polyphase filter.
        one(744, "the mixers obey ANALOG_CFG 16"),
        one(745, "the mixers obey ANALOG_CFG 16"),
        one(746, "the polyphase filter obeys ANALOG_CFG 16"),
        // GPI_enables, GPO_enables, :284-321; enables of outputs are active low.
        one(INPUT_8, "pad 8 is read"),
        one(INPUT_9, "pad 9 is read"),
        zero(1137, "pad 3 is driven by the optical receiver"),
        one(1115, "pad 8 is not driven"),
        one(1117, "pad 9 is not driven"),
        // GPI_control, GPO_control, :208-280: which signals a row of four pads carries.
        one(265, "pads 8 to 11 interrupt"),
        zero(266, "pads 8 to 11 interrupt"),
        zero(245, "pads 0 to 3 carry the optical receiver's output"),
        zero(246, "pads 0 to 3 carry the optical receiver's output"),
        zero(247, "pads 0 to 3 carry the optical receiver's output"),
        zero(248, "pads 0 to 3 carry the optical receiver's output"),
    ]
};
/// The codes that the lighthouse set-up chooses (lighthouse.c:57-59, 144-200), where scm3c_hw_interface.c puts them.
pub const NEEDED_CODES: &[NeededCode] = &[
    // :510, the two highest bits inverted.
    NeededCode {
        bits: &[797, 796, 795, 794, 793, 792, 791],
        inverted: 0b110_0000,
        value: 63,
        what: "the core's supply",
    },
    // :557, likewise; the highest bit is a later chip's, elsewhere.
    NeededCode {
        bits: &[929, 928, 927, 926, 925, 924, 557],
        inverted: 0b110_0000,
        value: 120,
        what: "the always-on supply",
    },
    // :1568, the upper half at the end of word 30, the lower at the beginning of word 31.
    NeededCode {
        bits: &[995, 994, 993, 992, 991, 990, 989, 988],
        inverted: 0,
        value: 100,
        what: "the radio's oscillator's current",
    },
    // :1591 and :1598, seven bits of word 30 each, from 2^13 and from 2^5 on.
    NeededCode {
        bits: &[978, 977, 976, 975, 974, 973, 972],
        inverted: 0b111_1111,
        value: 63,
        what: "the power amplifier's supply",
    },
    NeededCode {
        bits: &[986, 985, 984, 983, 982, 981, 980],
        inverted: 0b111_1111,
        value: 64,
        what: "the radio's oscillator's supply",
    },
];
const INPUT_8: u16 = 1116;
const INPUT_9: u16 = 1118;

/// The chain as loaded: bit n at `0x8000_0000 >> (n % 32)` of word n / 32.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Chain(pub(super) [u32; WORDS]);

impl Chain {
    pub(super) fn bit(&self, bit: usize) -> bool {
        self.0[bit / 32] & 0x8000_0000 >> (bit % 32) != 0
    }

    /// The bits there, the first the lowest; those with a set bit in `inverted` mean the opposite.
    fn code(&self, bits: impl IntoIterator<Item = usize>, inverted: u32) -> u32 {
        bits.into_iter().enumerate().fold(0, |code, (n, bit)| code | u32::from(self.bit(bit)) << n) ^ inverted
    }

    /// Coarse and fine code of the 20 MHz oscillator (:1098-1128).
    pub(super) fn hf_codes(&self) -> (u32, u32) {
        (self.code([860, 861, 875, 876, 877], 0b11100), self.code(870..875, 0b10000))
    }

    /// The third coarse, the fine and the superfine code of the 2 MHz oscillator (:1340).
    pub(super) fn chip_clock_codes(&self) -> [u32; 3] {
        [1099, 1104, 1109].map(|first| self.code(first..first + 5, 0))
    }

    /// The fine code of the intermediate frequency's clock (:1064-1095).
    pub(super) fn if_fine(&self) -> u32 {
        self.code((433..438).rev(), 0)
    }

    /// Whether pads 8 and 9 are read.
    pub(super) fn reads(&self) -> (bool, bool) {
        (self.bit(INPUT_8.into()), self.bit(INPUT_9.into()))
    }
}

#[derive(Debug, Clone)]
pub(super) struct ScanChain {
    /// A ring: `newest` is where the bit shifted in last lies, older bits follow it.
    shift: [bool; BITS],
    newest: usize,
    sampled: Option<bool>,
    last: u16,
    loaded: Chain,
    loads: u64,
    /// Bits shifted in since the last load.
    shifted: u32,
    /// What is wrong with what was loaded last.
    wrong: Vec<Why>,
}

impl ScanChain {
    pub(super) fn new() -> Self {
        Self {
            shift: [false; BITS],
            newest: 0,
            sampled: None,
            last: 0,
            loaded: Chain([0; WORDS]),
            loads: 0,
            shifted: 0,
            wrong: vec![Why::NotConfigured],
        }
    }

    /// The chain as last loaded.
    pub(super) fn loaded(&self) -> &Chain {
        &self.loaded
    }

    /// How often it was loaded.
    pub(super) fn loads(&self) -> u64 {
        self.loads
    }

    /// What was last written to register 22.
    pub(super) fn last(&self) -> u16 {
        self.last
    }

    /// What is wrong with the chain as it is.
    pub(super) fn wrong(&self) -> &[Why] {
        &self.wrong
    }

    /// Whether this write loaded.
    pub(super) fn write(&mut self, value: u16) -> bool {
        let rising = value & !self.last;
        self.last = value;
        // Two phases: phi2 opens the first half of each stage, phi1 the second.
        if rising & PHI2 != 0 {
            self.sampled = Some(value & SCAN_IN == 0);
        }
        if rising & PHI1 != 0
            && let Some(bit) = self.sampled.take()
        {
            self.newest = self.newest.checked_sub(1).unwrap_or(BITS - 1);
            self.shift[self.newest] = bit;
            self.shifted = self.shifted.saturating_add(1);
        }
        if rising & LOAD != 0 {
            self.load();
        }
        rising & LOAD != 0
    }

    fn load(&mut self) {
        self.loads += 1;
        self.loaded = Chain([0; WORDS]);
        for position in 0..BITS {
            if self.shift[(self.newest + position) % BITS] {
                self.loaded.0[position / 32] |= 0x8000_0000 >> (position % 32);
            }
        }
        self.wrong.clear();
        // More fall out at its end, as those of one that was broken off.
        if (self.shifted as usize) < BITS {
            self.wrong.push(Why::ScanLength { bits: self.shifted });
        }
        self.shifted = 0;
        let wrong = NEEDED.iter().filter(|needed| self.loaded.bit(needed.bit.into()) != needed.value);
        self.wrong.extend(wrong.map(|&needed| Why::ScanBit { needed }));
        for &needed in NEEDED_CODES {
            let is = self.loaded.code(needed.bits.iter().map(|bit| usize::from(*bit)), needed.inverted);
            if is != needed.value {
                self.wrong.push(Why::ScanCode { needed, is });
            }
        }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A chain with what is needed and nothing else.
    pub(in super::super) fn needed() -> [u32; WORDS] {
        let mut words = [0; WORDS];
        let mut set = |bit: u16| words[usize::from(bit) / 32] |= 0x8000_0000 >> (bit % 32);
        NEEDED.iter().filter(|needed| needed.value).for_each(|needed| set(needed.bit));
        for NeededCode { bits, inverted, value, .. } in NEEDED_CODES {
            let ones = (0..bits.len()).filter(|n| (value ^ inverted) >> n & 1 != 0);
            ones.for_each(|n| set(bits[n]));
        }
        words
    }

    /// What is written to register 22 to load `words` (SCuM-3C test code, scm3c_hw_interface.c:1289-1333).
    pub(in super::super) fn writes(words: &[u32; WORDS]) -> Vec<u16> {
        let bits = words.iter().rev().flat_map(|word| (0..32).map(move |bit| word >> bit & 1 != 0));
        let each =
            bits.map(|bit| if bit { 0x20 } else { 0x21 }).flat_map(|data| [data, data, data | 4, data, data | 2]);
        each.chain([0x28, 0x20]).collect()
    }

    fn loaded(writes: impl IntoIterator<Item = u16>) -> ScanChain {
        let mut chain = ScanChain::new();
        for value in writes {
            chain.write(value);
        }
        chain
    }

    #[test]
    fn a_chain_with_all_that_is_needed_is_not_complained_of() {
        assert_eq!(ScanChain::new().wrong(), [Why::NotConfigured]);
        let chain = loaded(writes(&needed()));
        assert_eq!(chain.wrong(), []);
        assert_eq!(chain.loads(), 1);
        assert_eq!(chain.loaded().reads(), (true, true));
    }

    #[test]
    fn every_needed_bit_that_is_wrong_is_named() {
        for &needed in NEEDED {
            let mut words = self::needed();
            words[usize::from(needed.bit) / 32] ^= 0x8000_0000 >> (needed.bit % 32);
            assert_eq!(loaded(writes(&words)).wrong(), [Why::ScanBit { needed }]);
        }
    }

    #[test]
    fn every_needed_code_with_a_wrong_bit_is_named_with_what_it_is() {
        for &needed in NEEDED_CODES {
            for (n, &bit) in needed.bits.iter().enumerate() {
                let mut words = self::needed();
                words[usize::from(bit) / 32] ^= 0x8000_0000 >> (bit % 32);
                assert_eq!(loaded(writes(&words)).wrong(), [Why::ScanCode { needed, is: needed.value ^ 1 << n }]);
            }
        }
    }

    /// Word 30 as scm3c_hw_interface.c:1568-1600 makes it, word 31 likewise.
    #[test]
    fn the_transmitters_codes_are_read_where_the_test_code_packs_them() {
        let (current, amplifier, oscillator) = (100u32, 63u32, 64u32);
        let mut words = self::needed();
        words[30] &= !(0xF | 0xFE000 | 0xFE0);
        words[30] |= current >> 4 | (!amplifier & 0x7F) << 13 | (!oscillator & 0x7F) << 5;
        words[31] = words[31] & 0x0FFF_FFFF | (current & 0xF) << 28;
        assert_eq!(words, self::needed());
    }

    #[test]
    fn a_chain_that_is_too_short_is_refused() {
        let whole = writes(&needed());
        let short = loaded(whole[5..].iter().copied());
        assert_eq!(short.wrong()[0], Why::ScanLength { bits: 1215 });
    }

    #[test]
    fn what_was_half_written_before_falls_out_at_the_end() {
        let whole = writes(&needed());
        // Broken off within a bit: its half is written over.
        for half in [5, 500, 502, 503, 504, 3000] {
            let again = loaded(whole[..half].iter().chain(&whole).copied());
            assert_eq!(again.wrong(), [], "{half}");
        }
        // One bit too many at the end, and every bit stands one further.
        let (bits, load) = whole.split_at(whole.len() - 2);
        let long = loaded(bits.iter().chain(&bits[..5]).chain(load).copied());
        assert!(long.wrong().len() > 10, "{:?}", long.wrong());
    }

    #[test]
    fn codes_are_read_where_they_are_written() {
        let mut words = [0; WORDS];
        // Fine 17 is 1 and the inverted 16; coarse 3 is two bits and three inverted zeros.
        for bit in [860, 861, 875, 876, 877, 870] {
            words[bit / 32] |= 0x8000_0000 >> (bit % 32);
        }
        let flip5 = |code: u32| code.reverse_bits() >> 27;
        words[34] = flip5(21) << 16 | flip5(15) << 11 | flip5(14) << 6;
        let chain = Chain(words);
        assert_eq!(chain.hf_codes(), (3, 17));
        assert_eq!(chain.chip_clock_codes(), [21, 15, 14]);
    }

    proptest! {
        #[test]
        fn what_is_shifted_into_the_scan_chain_is_what_gets_loaded(asc in any::<[u32; 16]>(), seed in any::<u32>()) {
            let mut words = [seed; WORDS];
            words[..16].copy_from_slice(&asc);
            let mut all = writes(&words);
            let load = all.split_off(all.len() - 2);
            let mut chain = loaded(all);
            prop_assert_eq!(chain.loads(), 0);
            prop_assert!(chain.write(load[0]) && !chain.write(load[1]));
            prop_assert_eq!(chain.loads(), 1);
            prop_assert_eq!(chain.loaded().0, words);
        }
    }
}
