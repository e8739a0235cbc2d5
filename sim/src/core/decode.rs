//! From halfwords to operations.
//!
//! An instruction is decoded once and kept, so everything that only depends on its bits and its address is worked out
//! here: branch targets, literal addresses, the base-in-list rule.
//!
//! What can go wrong: encodings the architecture calls UNPREDICTABLE decode as [`Op::Undefined`], so they fault.

/// One decoded instruction. `d` is the destination, `n` and `m` the operands, `t` the register moved.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[expect(missing_docs, reason = "the variants are the instructions of the ARMv6-M manual")]
pub enum Op {
    /// Not decoded yet.
    Unknown,
    Undefined,
    Movs {
        d: u8,
        m: u8,
    },
    LslImm {
        d: u8,
        m: u8,
        shift: u8,
    },
    LsrImm {
        d: u8,
        m: u8,
        shift: u8,
    },
    AsrImm {
        d: u8,
        m: u8,
        shift: u8,
    },
    AddReg {
        d: u8,
        n: u8,
        m: u8,
    },
    SubReg {
        d: u8,
        n: u8,
        m: u8,
    },
    AddImm {
        d: u8,
        n: u8,
        imm: u8,
    },
    SubImm {
        d: u8,
        n: u8,
        imm: u8,
    },
    MovImm {
        d: u8,
        imm: u8,
    },
    CmpImm {
        n: u8,
        imm: u8,
    },
    And {
        d: u8,
        m: u8,
    },
    Eor {
        d: u8,
        m: u8,
    },
    LslReg {
        d: u8,
        m: u8,
    },
    LsrReg {
        d: u8,
        m: u8,
    },
    AsrReg {
        d: u8,
        m: u8,
    },
    Adc {
        d: u8,
        m: u8,
    },
    Sbc {
        d: u8,
        m: u8,
    },
    RorReg {
        d: u8,
        m: u8,
    },
    Tst {
        n: u8,
        m: u8,
    },
    Rsb {
        d: u8,
        n: u8,
    },
    CmpReg {
        n: u8,
        m: u8,
    },
    Cmn {
        n: u8,
        m: u8,
    },
    Orr {
        d: u8,
        m: u8,
    },
    Mul {
        d: u8,
        m: u8,
    },
    Bic {
        d: u8,
        m: u8,
    },
    Mvn {
        d: u8,
        m: u8,
    },
    AddHigh {
        d: u8,
        m: u8,
    },
    AddToSp {
        m: u8,
    },
    /// Adds what the program counter reads as.
    AddConstant {
        d: u8,
        value: u32,
    },
    AddPc {
        m: u8,
    },
    Mov {
        d: u8,
        m: u8,
    },
    MovToSp {
        m: u8,
    },
    MovPc {
        m: u8,
    },
    Bx {
        m: u8,
    },
    Blx {
        m: u8,
    },
    /// ADR, and MOV from the program counter.
    Constant {
        d: u8,
        value: u32,
    },
    LdrLiteral {
        t: u8,
        address: u32,
    },
    StrReg {
        t: u8,
        n: u8,
        m: u8,
    },
    StrhReg {
        t: u8,
        n: u8,
        m: u8,
    },
    StrbReg {
        t: u8,
        n: u8,
        m: u8,
    },
    LdrsbReg {
        t: u8,
        n: u8,
        m: u8,
    },
    LdrReg {
        t: u8,
        n: u8,
        m: u8,
    },
    LdrhReg {
        t: u8,
        n: u8,
        m: u8,
    },
    LdrbReg {
        t: u8,
        n: u8,
        m: u8,
    },
    LdrshReg {
        t: u8,
        n: u8,
        m: u8,
    },
    StrImm {
        t: u8,
        n: u8,
        offset: u16,
    },
    LdrImm {
        t: u8,
        n: u8,
        offset: u16,
    },
    StrbImm {
        t: u8,
        n: u8,
        offset: u16,
    },
    LdrbImm {
        t: u8,
        n: u8,
        offset: u16,
    },
    StrhImm {
        t: u8,
        n: u8,
        offset: u16,
    },
    LdrhImm {
        t: u8,
        n: u8,
        offset: u16,
    },
    AddSpTo {
        d: u8,
        offset: u16,
    },
    AdjustSp {
        offset: i16,
    },
    Sxth {
        d: u8,
        m: u8,
    },
    Sxtb {
        d: u8,
        m: u8,
    },
    Uxth {
        d: u8,
        m: u8,
    },
    Uxtb {
        d: u8,
        m: u8,
    },
    Rev {
        d: u8,
        m: u8,
    },
    Rev16 {
        d: u8,
        m: u8,
    },
    Revsh {
        d: u8,
        m: u8,
    },
    Push {
        list: u16,
    },
    Pop {
        list: u16,
    },
    PopReturn {
        list: u16,
    },
    Stm {
        n: u8,
        list: u16,
    },
    Ldm {
        n: u8,
        list: u16,
        writeback: bool,
    },
    Cps {
        mask: bool,
    },
    Bkpt {
        immediate: u8,
    },
    Svc,
    Nop,
    Wfe,
    Wfi,
    Sev,
    Beq {
        target: u32,
    },
    Bne {
        target: u32,
    },
    Bcs {
        target: u32,
    },
    Bcc {
        target: u32,
    },
    Bmi {
        target: u32,
    },
    Bpl {
        target: u32,
    },
    Bvs {
        target: u32,
    },
    Bvc {
        target: u32,
    },
    Bhi {
        target: u32,
    },
    Bls {
        target: u32,
    },
    Bge {
        target: u32,
    },
    Blt {
        target: u32,
    },
    Bgt {
        target: u32,
    },
    Ble {
        target: u32,
    },
    B {
        target: u32,
    },
    Bl {
        target: u32,
    },
    Msr {
        n: u8,
        special: u8,
    },
    Mrs {
        d: u8,
        special: u8,
    },
    Barrier,
}

const _: () = assert!(size_of::<Op>() == 8);

/// Whether an instruction that begins with `first` has a second halfword.
pub fn is_wide(first: u16) -> bool {
    first >= 0xE800
}

/// Decodes the instruction at `address`; `second` is the halfword after it, whatever it is.
pub fn decode(address: u32, first: u16, second: u16) -> Op {
    let low = |shift: u16| (first >> shift & 7) as u8;
    let imm5 = (first >> 6 & 31) as u8;
    let imm8 = first as u8;
    let pc = address.wrapping_add(4);
    let (d, m) = (low(0), low(3));
    match first >> 11 {
        0b00000 if imm5 == 0 => Op::Movs { d, m },
        0b00000 => Op::LslImm { d, m, shift: imm5 },
        0b00001 => Op::LsrImm { d, m, shift: if imm5 == 0 { 32 } else { imm5 } },
        0b00010 => Op::AsrImm { d, m, shift: if imm5 == 0 { 32 } else { imm5 } },
        0b00011 => match first >> 9 & 3 {
            0 => Op::AddReg { d, n: m, m: low(6) },
            1 => Op::SubReg { d, n: m, m: low(6) },
            2 => Op::AddImm { d, n: m, imm: low(6) },
            _ => Op::SubImm { d, n: m, imm: low(6) },
        },
        0b00100 => Op::MovImm { d: low(8), imm: imm8 },
        0b00101 => Op::CmpImm { n: low(8), imm: imm8 },
        0b00110 => Op::AddImm { d: low(8), n: low(8), imm: imm8 },
        0b00111 => Op::SubImm { d: low(8), n: low(8), imm: imm8 },
        0b01000 if first >> 10 & 1 == 0 => data_processing(first, d, m),
        0b01000 => special_data(first, pc),
        0b01001 => Op::LdrLiteral { t: low(8), address: (pc & !3).wrapping_add(u32::from(imm8) * 4) },
        0b01010 | 0b01011 => load_store_register(first, d, m, low(6)),
        0b01100 => Op::StrImm { t: d, n: m, offset: u16::from(imm5) * 4 },
        0b01101 => Op::LdrImm { t: d, n: m, offset: u16::from(imm5) * 4 },
        0b01110 => Op::StrbImm { t: d, n: m, offset: u16::from(imm5) },
        0b01111 => Op::LdrbImm { t: d, n: m, offset: u16::from(imm5) },
        0b10000 => Op::StrhImm { t: d, n: m, offset: u16::from(imm5) * 2 },
        0b10001 => Op::LdrhImm { t: d, n: m, offset: u16::from(imm5) * 2 },
        0b10010 => Op::StrImm { t: low(8), n: 13, offset: u16::from(imm8) * 4 },
        0b10011 => Op::LdrImm { t: low(8), n: 13, offset: u16::from(imm8) * 4 },
        0b10100 => Op::Constant { d: low(8), value: (pc & !3).wrapping_add(u32::from(imm8) * 4) },
        0b10101 => Op::AddSpTo { d: low(8), offset: u16::from(imm8) * 4 },
        0b10110 | 0b10111 => miscellaneous(first, d, m),
        0b11000 | 0b11001 if imm8 == 0 => Op::Undefined,
        0b11000 => Op::Stm { n: low(8), list: u16::from(imm8) },
        0b11001 => Op::Ldm { n: low(8), list: u16::from(imm8), writeback: imm8 >> low(8) & 1 == 0 },
        0b11010 | 0b11011 => conditional_branch(first, pc),
        0b11100 => Op::B { target: pc.wrapping_add_signed(i32::from((first << 5) as i16) >> 4) },
        0b11110 => wide(first, second, pc),
        _ => Op::Undefined,
    }
}

fn data_processing(first: u16, d: u8, m: u8) -> Op {
    match first >> 6 & 15 {
        0 => Op::And { d, m },
        1 => Op::Eor { d, m },
        2 => Op::LslReg { d, m },
        3 => Op::LsrReg { d, m },
        4 => Op::AsrReg { d, m },
        5 => Op::Adc { d, m },
        6 => Op::Sbc { d, m },
        7 => Op::RorReg { d, m },
        8 => Op::Tst { n: d, m },
        9 => Op::Rsb { d, n: m },
        10 => Op::CmpReg { n: d, m },
        11 => Op::Cmn { n: d, m },
        12 => Op::Orr { d, m },
        13 => Op::Mul { d, m },
        14 => Op::Bic { d, m },
        _ => Op::Mvn { d, m },
    }
}

fn special_data(first: u16, pc: u32) -> Op {
    let m = (first >> 3 & 15) as u8;
    let d = (first & 7 | first >> 4 & 8) as u8;
    match (first >> 8 & 3, d, m) {
        (0, 15, 15) => Op::Undefined,
        (0, 15, _) => Op::AddPc { m },
        (0, 13, 15) => Op::Undefined,
        (0, _, 15) => Op::AddConstant { d, value: pc },
        (0, 13, _) => Op::AddToSp { m },
        (0, _, _) => Op::AddHigh { d, m },
        (1, 15, _) | (1, _, 15) => Op::Undefined,
        (1, _, _) => Op::CmpReg { n: d, m },
        (2, 15, 15) => Op::B { target: pc },
        (2, 15, _) => Op::MovPc { m },
        (2, 13, 15) => Op::Undefined,
        (2, _, 15) => Op::Constant { d, value: pc },
        (2, 13, _) => Op::MovToSp { m },
        (2, _, _) => Op::Mov { d, m },
        (_, _, 15) => Op::Undefined,
        _ if first & 7 != 0 => Op::Undefined,
        _ if first >> 7 & 1 == 0 => Op::Bx { m },
        _ => Op::Blx { m },
    }
}

fn load_store_register(first: u16, t: u8, n: u8, m: u8) -> Op {
    match first >> 9 & 7 {
        0 => Op::StrReg { t, n, m },
        1 => Op::StrhReg { t, n, m },
        2 => Op::StrbReg { t, n, m },
        3 => Op::LdrsbReg { t, n, m },
        4 => Op::LdrReg { t, n, m },
        5 => Op::LdrhReg { t, n, m },
        6 => Op::LdrbReg { t, n, m },
        _ => Op::LdrshReg { t, n, m },
    }
}

fn miscellaneous(first: u16, d: u8, m: u8) -> Op {
    let list = first & 0xFF;
    match first >> 6 & 0x3F {
        0b000000 | 0b000001 => Op::AdjustSp { offset: (first & 0x7F) as i16 * 4 },
        0b000010 | 0b000011 => Op::AdjustSp { offset: -((first & 0x7F) as i16 * 4) },
        0b001000 => Op::Sxth { d, m },
        0b001001 => Op::Sxtb { d, m },
        0b001010 => Op::Uxth { d, m },
        0b001011 => Op::Uxtb { d, m },
        0b010000..=0b010111 if first & 0x1FF == 0 => Op::Undefined,
        0b010000..=0b010111 => Op::Push { list: list | (first & 0x100) << 6 },
        0b110000..=0b110111 if first & 0x1FF == 0 => Op::Undefined,
        0b110000..=0b110011 => Op::Pop { list },
        0b110100..=0b110111 => Op::PopReturn { list },
        0b011001 if first & 0x2F == 0x22 => Op::Cps { mask: first & 0x10 != 0 },
        0b101000 => Op::Rev { d, m },
        0b101001 => Op::Rev16 { d, m },
        0b101011 => Op::Revsh { d, m },
        0b111000..=0b111011 => Op::Bkpt { immediate: first as u8 },
        0b111100..=0b111111 if first & 15 != 0 => Op::Undefined,
        0b111100..=0b111111 => match first >> 4 & 15 {
            2 => Op::Wfe,
            3 => Op::Wfi,
            4 => Op::Sev,
            _ => Op::Nop,
        },
        _ => Op::Undefined,
    }
}

fn conditional_branch(first: u16, pc: u32) -> Op {
    let target = pc.wrapping_add_signed(i32::from(first as u8 as i8) * 2);
    match first >> 8 & 15 {
        0 => Op::Beq { target },
        1 => Op::Bne { target },
        2 => Op::Bcs { target },
        3 => Op::Bcc { target },
        4 => Op::Bmi { target },
        5 => Op::Bpl { target },
        6 => Op::Bvs { target },
        7 => Op::Bvc { target },
        8 => Op::Bhi { target },
        9 => Op::Bls { target },
        10 => Op::Bge { target },
        11 => Op::Blt { target },
        12 => Op::Bgt { target },
        13 => Op::Ble { target },
        14 => Op::Undefined,
        _ => Op::Svc,
    }
}

fn wide(first: u16, second: u16, pc: u32) -> Op {
    if second & 0xD000 == 0xD000 {
        return Op::Bl { target: pc.wrapping_add_signed(branch_link_offset(first, second)) };
    }
    match (first, second) {
        (0xF380..=0xF38F, 0x8800..=0x88FF) if first & 15 != 13 && first & 15 != 15 => {
            Op::Msr { n: (first & 15) as u8, special: second as u8 }
        }
        (0xF3EF, 0x8000..=0x8FFF) if second >> 8 & 15 != 13 && second >> 8 & 15 != 15 => {
            Op::Mrs { d: (second >> 8 & 15) as u8, special: second as u8 }
        }
        (0xF3BF, 0x8F40..=0x8F6F) => Op::Barrier,
        _ => Op::Undefined,
    }
}

fn branch_link_offset(first: u16, second: u16) -> i32 {
    let bit = |half: u16, n: u32| u32::from(half >> n & 1);
    let s = bit(first, 10);
    let i1 = 1 ^ bit(second, 13) ^ s;
    let i2 = 1 ^ bit(second, 11) ^ s;
    let imm = s << 24 | i1 << 23 | i2 << 22 | u32::from(first & 0x3FF) << 12 | u32::from(second & 0x7FF) << 1;
    (imm << 7) as i32 >> 7
}
