//! Thumb encodings, as far as the tests need them.
//!
//! What can go wrong: operands are not checked; a register above 7 spills into its neighbour.

pub(crate) fn movs(d: u16, imm: u16) -> u16 {
    0x2000 | d << 8 | imm
}

pub(crate) fn adds(d: u16, imm: u16) -> u16 {
    0x3000 | d << 8 | imm
}

pub(crate) fn subs(d: u16, imm: u16) -> u16 {
    0x3800 | d << 8 | imm
}

/// LDR of the literal `words` words after the next aligned word.
pub(crate) fn ldr_literal(t: u16, words: u16) -> u16 {
    0x4800 | t << 8 | words
}

pub(crate) fn ldr(t: u16, n: u16, offset: u16) -> u16 {
    0x6800 | (offset / 4) << 6 | n << 3 | t
}

pub(crate) fn str(t: u16, n: u16, offset: u16) -> u16 {
    0x6000 | (offset / 4) << 6 | n << 3 | t
}

/// MOV of any registers.
pub(crate) fn mov(d: u16, m: u16) -> u16 {
    0x4600 | (d & 8) << 4 | m << 3 | d & 7
}

/// A branch by `halfwords` from where the program counter reads.
pub(crate) fn b(halfwords: i16) -> u16 {
    0xE000 | halfwords as u16 & 0x7FF
}

pub(crate) const BX_LR: u16 = 0x4770;
pub(crate) const BKPT: u16 = 0xBE00;
pub(crate) const NOP: u16 = 0xBF00;
pub(crate) const WFE: u16 = 0xBF20;
pub(crate) const WFI: u16 = 0xBF30;
pub(crate) const SEV: u16 = 0xBF40;
pub(crate) const SVC: u16 = 0xDF00;
pub(crate) const CPSIE: u16 = 0xB662;
pub(crate) const CPSID: u16 = 0xB672;
pub(crate) const UDF: u16 = 0xDE00;
