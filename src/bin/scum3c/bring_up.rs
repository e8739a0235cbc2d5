//! The chip from its boot ROM's state to the mote's: clocks, supplies, pins, transmitter.
//!
//! Nearly everything hangs on one shift register of 1216 bits, the analog scan chain. Its image is a constant but for
//! two words, the codes of the oscillators that [`tuning`](crate::tuning) moves. Bit numbers and settings are those of
//! the SCuM-3C test code for the lighthouse (`lighthouse.c:24-200` and the functions of `scm3c_hw_interface.c` it
//! calls): HCLK and radio timer from the 20 MHz oscillator, halved.
//!
//! What can go wrong: there is no way to read the chain back. The last one written counts, as a whole.

use crate::memory::opaque;
use crate::oscillators::{self, flip};
use crate::pac::analog;

/// Typical 20 MHz (`scm3c_hw_interface.c`, INIT_HF_CLOCK_COARSE); the fine code is tuned.
const HF_COARSE: u32 = 3;
/// The 2 MHz chip clock's first two coarse codes (`scm3c_hw_interface.c`); the other three are tuned.
const CHIP_CLOCK: [u32; 2] = [31, 31];
/// Typical 16 MHz intermediate frequency (`lighthouse.h`, IF_COARSE_LH and _FINE_LH); the receiver is never on.
const IF_COARSE: u32 = 22;
const IF_FINE: u32 = 18;
/// Core supply (`lighthouse.c:57`).
const VDDD: u32 = 63;
/// Always-on supply: lower makes fewer optical glitches (`lighthouse.c:59`).
const ALWAYS_ON: u32 = 120;
/// Transmitter: oscillator current, amplifier and oscillator supplies (`lighthouse.c:144-200`).
const LC_CURRENT: u32 = 100;
const PA_SUPPLY: u32 = 63;
const LO_SUPPLY: u32 = 64;
/// Pins that are read: 3 (optical output) and 8 to 15 (external interrupts among them).
const INPUTS: u32 = 0xff08;
/// Pins that are driven.
const OUTPUTS: u32 = 0xd0ff;
/// Which of the chip's signals each row of four pins carries (`lighthouse.c:64-67`).
const INPUT_BANKS: [u32; 4] = [0, 0, 1, 0];
const OUTPUT_BANKS: [u32; 4] = [0, 6, 0, 0];
/// Transmitted chips are IEEE 802.15.4 (`lighthouse.c:180`).
const CHIPS_15_4: u32 = 0x80;

/// Where the enables of pins 0 to 15 sit in the chain (`scm3c_hw_interface.c:284-321`).
const OUTPUT_ENABLE: [u32; 16] =
    [1131, 1133, 1135, 1137, 1140, 1142, 1144, 1146, 1115, 1117, 1119, 1121, 1124, 1126, 1128, 1130];
const INPUT_ENABLE: [u32; 16] =
    [1132, 1134, 1136, 1138, 1139, 1141, 1143, 1145, 1116, 1118, 1120, 1122, 1123, 1125, 1127, 1129];

/// Bits that are simply one.
#[rustfmt::skip]
const ONES: [u32; 33] = [
    // The radio's and the auxiliary supplies obey analog register 10 (:324-360).
    505, 507, 509, 510, 511, 512, 515, 516, 914,
    // HCLK from the 20 MHz oscillator, divided by 2: bit 51, and bit 52, which is inverted and so stands for zero.
    1147, 51, 52,
    // Radio timer from the same, its divider passed by.
    1151, 36,
    // Low-frequency clock off; chip clock from the 2 MHz oscillator, on, its divider passed by; 32 kHz on.
    553, 1156, 1114, 41, 623,
    // Counters obey the analog registers.
    2, 3, 4, 5, 6, 7, 8,
    // Tone spacing of the modulation, and the dummy bit above it.
    1000, 1001, 1002, 1003,
    // Mixers and polyphase filter obey analog register 16 (`lighthouse.c`, radio_init_rx_MF_lighthouse).
    744, 745, 746,
];

/// The word with the fine code of the 20 MHz oscillator: bits 870 to 874, the lowest first, the highest inverted.
const HF_WORD: usize = 27;
const HF_SHIFT: u32 = 21;
const HF_INVERTED: u32 = 16;
/// The word with the codes of the chip clock: five of five bits, each lowest bit first (:1340).
const CHIP_CLOCK_WORD: usize = 34;
const CHIP_CLOCK_SHIFTS: [u32; 3] = [16, 11, 6];

/// The analog scan chain: 38 words, bit 0 the highest of the first.
struct Chain([u32; 38]);

impl Chain {
    const fn set(&mut self, bit: u32, value: bool) {
        let mask = 0x8000_0000 >> (bit % 32);
        let word = &mut self.0[(bit / 32) as usize];
        *word = if value { *word | mask } else { *word & !mask };
    }

    /// `width` bits of `code`, the lowest at `bit`, each next one `step` further.
    const fn field(&mut self, bit: u32, step: i32, width: u32, code: u32) {
        let mut n = 0;
        while n < width {
            self.set(bit.wrapping_add_signed(step * n as i32), code >> n & 1 != 0);
            n += 1;
        }
    }

    /// The mote's settings.
    const fn mote() -> Self {
        let mut chain = Self([0; 38]);
        let mut n = 0;
        while n < ONES.len() {
            chain.set(ONES[n], true);
            n += 1;
        }
        // Inverted bits are written as the complement of the code.
        chain.field(797, -1, 5, VDDD);
        chain.field(792, -1, 2, !(VDDD >> 5));
        chain.field(929, -1, 5, ALWAYS_ON);
        chain.field(924, 1, 1, !(ALWAYS_ON >> 5));
        chain.field(557, 1, 1, !(ALWAYS_ON >> 6));
        chain.field(860, 1, 2, HF_COARSE);
        chain.field(875, 1, 3, !(HF_COARSE >> 2));
        let mut row = 0;
        while row < 4 {
            chain.field(245 + 4 * row as u32, 1, 4, OUTPUT_BANKS[row]);
            chain.field(261 + 2 * row as u32, 1, 2, INPUT_BANKS[row]);
            row += 1;
        }
        let mut pin = 0;
        while pin < 16 {
            chain.set(OUTPUT_ENABLE[pin], OUTPUTS >> pin & 1 == 0);
            chain.set(INPUT_ENABLE[pin], INPUTS >> pin & 1 != 0);
            pin += 1;
        }
        // Five codes of five bits, lowest bit first in the chain, from bit 1089; bit 1114 above is their enable
        // (:1340).
        chain.field(1089, 1, 5, CHIP_CLOCK[0]);
        chain.field(1094, 1, 5, CHIP_CLOCK[1]);
        chain.field(431, -1, 5, IF_COARSE);
        chain.field(437, -1, 5, IF_FINE);
        // Words 30 and 31, lowest bit of each code last in the chain (:1568-1600).
        chain.field(995, -1, 8, LC_CURRENT);
        chain.field(978, -1, 7, !PA_SUPPLY);
        chain.field(986, -1, 7, !LO_SUPPLY);
        chain
    }
}

/// Shifts the chain in with the oscillators' codes as they are, last word first, lowest bit first, and makes it take
/// effect (:1289-1333). 40,000 cycles; only one at a time may do so.
#[inline(never)]
pub fn write_chain() {
    static MOTE: Chain = Chain::mote();
    for (index, &word) in MOTE.0.iter().enumerate().rev() {
        let mut word = word;
        if index == HF_WORD {
            word |= flip(oscillators::hf_fine() ^ HF_INVERTED) << HF_SHIFT;
        }
        if index == CHIP_CLOCK_WORD {
            for (code, shift) in oscillators::chip_clock().zip(CHIP_CLOCK_SHIFTS) {
                word |= flip(code) << shift;
            }
        }
        let mut bits = 32;
        while bits != 0 {
            bits = opaque(bits - 1);
            // Register 22: bit 0 data, inverted; bits 1 and 2 the two clock phases; bit 5 keeps the chips' own
            // shift register out of reset.
            let data = 0x20 | !word & 1;
            analog::REG22.write(data);
            analog::REG22.write(data | 4);
            analog::REG22.write(data);
            analog::REG22.write(data | 2);
            word >>= 1;
        }
    }
    analog::REG22.write(0x28);
    analog::REG22.write(0x20);
}

/// Writes everything: 10 ms at the clock the boot ROM leaves.
pub fn chip() {
    analog::REG10.write(0);
    analog::REG11.write(CHIPS_15_4);
    write_chain();
}
