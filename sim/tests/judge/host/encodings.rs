//! Every encoding that ARMv6-M has (ARMv6-M ARM, A5 and A6.7), to see that each was executed.
//!
//! What can go wrong: an encoding that matches an earlier line of the table as well; each instruction is counted once,
//! for the first that it matches.

/// Mask, value and name; a wide instruction's first half is the upper one.
pub(crate) type Encoding = (u32, u32, &'static str);

/// Those of one half-word.
#[rustfmt::skip]
const NARROW: [Encoding; 86] = [
    (0xFFC0, 0x0000, "MOVS Rd, Rm"), (0xF800, 0x0000, "LSLS Rd, Rm, #n"), (0xF800, 0x0800, "LSRS Rd, Rm, #n"),
    (0xF800, 0x1000, "ASRS Rd, Rm, #n"),
    (0xFE00, 0x1800, "ADDS Rd, Rn, Rm"), (0xFE00, 0x1A00, "SUBS Rd, Rn, Rm"),
    (0xFE00, 0x1C00, "ADDS Rd, Rn, #3"), (0xFE00, 0x1E00, "SUBS Rd, Rn, #3"),
    (0xF800, 0x2000, "MOVS Rd, #8"), (0xF800, 0x2800, "CMP Rn, #8"),
    (0xF800, 0x3000, "ADDS Rd, #8"), (0xF800, 0x3800, "SUBS Rd, #8"),
    (0xFFC0, 0x4000, "ANDS"), (0xFFC0, 0x4040, "EORS"), (0xFFC0, 0x4080, "LSLS Rd, Rs"), (0xFFC0, 0x40C0, "LSRS Rd, Rs"),
    (0xFFC0, 0x4100, "ASRS Rd, Rs"), (0xFFC0, 0x4140, "ADCS"), (0xFFC0, 0x4180, "SBCS"), (0xFFC0, 0x41C0, "RORS"),
    (0xFFC0, 0x4200, "TST"), (0xFFC0, 0x4240, "RSBS"), (0xFFC0, 0x4280, "CMP Rn, Rm"), (0xFFC0, 0x42C0, "CMN"),
    (0xFFC0, 0x4300, "ORRS"), (0xFFC0, 0x4340, "MULS"), (0xFFC0, 0x4380, "BICS"), (0xFFC0, 0x43C0, "MVNS"),
    (0xFF78, 0x4468, "ADD Rd, SP, Rd"), (0xFF87, 0x4485, "ADD SP, Rm"), (0xFF00, 0x4400, "ADD Rd, Rm, any"),
    (0xFF00, 0x4500, "CMP Rn, Rm, any"), (0xFF00, 0x4600, "MOV Rd, Rm, any"),
    (0xFF87, 0x4700, "BX"), (0xFF87, 0x4780, "BLX"), (0xF800, 0x4800, "LDR Rt, label"),
    (0xFE00, 0x5000, "STR Rt, [Rn, Rm]"), (0xFE00, 0x5200, "STRH Rt, [Rn, Rm]"), (0xFE00, 0x5400, "STRB Rt, [Rn, Rm]"),
    (0xFE00, 0x5600, "LDRSB"), (0xFE00, 0x5800, "LDR Rt, [Rn, Rm]"), (0xFE00, 0x5A00, "LDRH Rt, [Rn, Rm]"),
    (0xFE00, 0x5C00, "LDRB Rt, [Rn, Rm]"), (0xFE00, 0x5E00, "LDRSH"),
    (0xF800, 0x6000, "STR Rt, [Rn, #n]"), (0xF800, 0x6800, "LDR Rt, [Rn, #n]"), (0xF800, 0x7000, "STRB Rt, [Rn, #n]"),
    (0xF800, 0x7800, "LDRB Rt, [Rn, #n]"), (0xF800, 0x8000, "STRH Rt, [Rn, #n]"), (0xF800, 0x8800, "LDRH Rt, [Rn, #n]"),
    (0xF800, 0x9000, "STR Rt, [SP, #n]"), (0xF800, 0x9800, "LDR Rt, [SP, #n]"),
    (0xF800, 0xA000, "ADR"), (0xF800, 0xA800, "ADD Rd, SP, #n"), (0xFF80, 0xB000, "ADD SP, #n"), (0xFF80, 0xB080, "SUB SP, #n"),
    (0xFFC0, 0xB200, "SXTH"), (0xFFC0, 0xB240, "SXTB"), (0xFFC0, 0xB280, "UXTH"), (0xFFC0, 0xB2C0, "UXTB"),
    (0xFF00, 0xB400, "PUSH"), (0xFF00, 0xB500, "PUSH with LR"),
    (0xFFFF, 0xB662, "CPSIE i"), (0xFFFF, 0xB672, "CPSID i"),
    (0xFFC0, 0xBA00, "REV"), (0xFFC0, 0xBA40, "REV16"), (0xFFC0, 0xBAC0, "REVSH"),
    (0xFF00, 0xBC00, "POP"), (0xFF00, 0xBD00, "POP with PC"), (0xFF00, 0xBE00, "BKPT"),
    (0xFFFF, 0xBF00, "NOP"), (0xFFFF, 0xBF10, "YIELD"), (0xFFFF, 0xBF20, "WFE"), (0xFFFF, 0xBF30, "WFI"),
    (0xFFFF, 0xBF40, "SEV"), (0xF800, 0xC000, "STM"), (0xF800, 0xC800, "LDM"),
    (0xFF00, 0xDE00, "UDF"), (0xFF00, 0xDF00, "SVC"), (0xF800, 0xE000, "B"),
    (0xFE00, 0xD000, "BEQ, BNE"), (0xFE00, 0xD200, "BCS, BCC"), (0xFE00, 0xD400, "BMI, BPL"), (0xFE00, 0xD600, "BVS, BVC"),
    (0xFC00, 0xD800, "BHI, BLS, BGE, BLT"), (0xFC00, 0xDC00, "BGT, BLE"),
];

/// Those of two.
const WIDE: [Encoding; 7] = [
    (0xFFFF_FFF0, 0xF3BF_8F40, "DSB"),
    (0xFFFF_FFF0, 0xF3BF_8F50, "DMB"),
    (0xFFFF_FFF0, 0xF3BF_8F60, "ISB"),
    (0xFFE0_D000, 0xF380_8000, "MSR"),
    (0xFFE0_D000, 0xF3E0_8000, "MRS"),
    (0xFFF0_F000, 0xF7F0_A000, "UDF.W"),
    (0xF800_D000, 0xF000_D000, "BL"),
];

/// How often each was executed.
#[derive(Default)]
pub(crate) struct Census {
    narrow: Vec<u64>,
    wide: Vec<u64>,
}

impl Census {
    pub(crate) fn new() -> Self {
        Self { narrow: vec![0; NARROW.len()], wide: vec![0; WIDE.len()] }
    }

    /// Counts the instruction of these half-words.
    pub(crate) fn count(&mut self, first: u16, second: u16) {
        let (table, counts, code) = if first >> 11 >= 0b11101 {
            (&WIDE[..], &mut self.wide, u32::from(first) << 16 | u32::from(second))
        } else {
            (&NARROW[..], &mut self.narrow, u32::from(first))
        };
        if let Some(n) = table.iter().position(|(mask, value, _)| code & mask == *value) {
            counts[n] += 1;
        }
    }

    /// Every encoding and how often it was executed.
    pub(crate) fn rows(&self) -> impl Iterator<Item = (&'static str, u64)> {
        let names = NARROW.iter().chain(&WIDE).map(|(_, _, name)| *name);
        names.zip(self.narrow.iter().chain(&self.wide).copied())
    }
}
