//! The chip from its boot ROM's state to the mote's: clocks, supplies, pins, transmitter.
//!
//! Nearly everything hangs on one shift register of 1216 bits, the analog scan chain. Its image is a constant, written
//! once. Bit numbers and settings are those of the SCuM-3C test code for the lighthouse (`lighthouse.c:24-200` and the
//! functions of `scm3c_hw_interface.c` it calls): HCLK and radio timer from the 20 MHz oscillator, halved.
//!
//! What can go wrong: nothing here is calibrated. Every oscillator starts from a typical code: the clock is off by
//! percents, which the angles do not feel; chip clock and radio oscillator by as much, which a listener does. There is
//! no way to read the chain back.

use crate::pac::analog;

/// Typical 20 MHz (`scm3c_hw_interface.c`, INIT_HF_CLOCK_COARSE and _FINE).
const HF_COARSE: u32 = 3;
const HF_FINE: u32 = 17;
/// Typical 2 MHz chip clock: three coarse codes, fine, superfine (`lighthouse.h`, `scm3c_hw_interface.c`).
const CHIP_CLOCK: [u32; 5] = [31, 31, 21, 15, 15];
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
const ONES: [u32; 30] = [
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
];

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
        chain.field(870, 1, 4, HF_FINE);
        chain.field(874, 1, 1, !(HF_FINE >> 4));
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
        let mut code = 0;
        while code < 5 {
            chain.field(1089 + 5 * code as u32, 1, 5, CHIP_CLOCK[code]);
            code += 1;
        }
        // Words 30 and 31, lowest bit of each code last in the chain (:1568-1600).
        chain.field(995, -1, 8, LC_CURRENT);
        chain.field(978, -1, 7, !PA_SUPPLY);
        chain.field(986, -1, 7, !LO_SUPPLY);
        chain
    }

    /// Shifts the chain in, last word first, lowest bit first, and makes it take effect (:1289-1333).
    fn write(&self) {
        for word in self.0.iter().rev() {
            for bit in 0..32 {
                // Register 22: bit 0 data, inverted; bits 1 and 2 the two clock phases; bit 5 keeps the chips' own
                // shift register out of reset.
                let data = if word >> bit & 1 == 0 { 0x21 } else { 0x20 };
                analog::REG22.write(data);
                analog::REG22.write(data | 4);
                analog::REG22.write(data);
                analog::REG22.write(data | 2);
            }
        }
        analog::REG22.write(0x28);
        analog::REG22.write(0x20);
    }
}

/// Writes everything. About 6,000 stores: 10 ms at the clock the boot ROM leaves.
pub fn chip() {
    static MOTE: Chain = Chain::mote();
    analog::REG10.write(0);
    analog::REG11.write(CHIPS_15_4);
    MOTE.write();
}
