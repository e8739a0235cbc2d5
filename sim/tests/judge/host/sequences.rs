//! Instruction sequences nobody wrote.
//!
//! Every sequence is a function that may do anything to r0 to r6, r8 to r12 and the flags, reads and writes the memory
//! r7 points at, and uses the stack in pairs. r5 is the one it forms addresses in.
//!
//! In between they do what makes exceptions: supervisor calls, PendSV and any external line pended, with priorities of
//! any kind, masked or not, on either stack, waiting for them or not; and one sequence in sixteen faults. The clock
//! interrupts besides, at an instruction that nobody chose.
//!
//! What can go wrong: an UNPREDICTABLE instruction may differ between two right implementations, so none is made.
//! QEMU's Cortex-M0 keeps a Q flag that ARMv6-M does not have, so bit 27 of the flags is never written.

const SEQUENCES: usize = 255;
/// One in so many faults.
const FAULTY: usize = 16;
const SEQUENCE_BYTES: usize = 512;
const STATE_WORDS: usize = 14;
const FLAGS: u32 = 0xF000_0000;
const LONGEST: usize = 190;
const LINK: u16 = 14;

struct Dice(u64);

impl Dice {
    fn roll(&mut self) -> u32 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 32) as u32
    }

    fn below(&mut self, limit: u16) -> u16 {
        (self.roll() % u32::from(limit)) as u16
    }

    fn pick<T: Copy>(&mut self, from: &[T]) -> T {
        from[usize::from(self.below(from.len() as u16))]
    }

    /// A low register that may be written.
    fn d(&mut self) -> u16 {
        self.below(7)
    }

    /// A low register that may be read.
    fn m(&mut self) -> u16 {
        self.below(8)
    }

    /// Any register that may be written.
    fn any_d(&mut self) -> u16 {
        self.pick(&[0, 1, 2, 3, 4, 5, 6, 8, 9, 10, 11, 12, LINK])
    }

    fn word(&mut self) -> u32 {
        let word = self.roll();
        match self.below(4) {
            0 => self.pick(&[0, 1, 31, 32, 33, 0x7FFF_FFFF, 0x8000_0000, u32::MAX]),
            1 => word & 0xFF,
            _ => word,
        }
    }
}

/// What the judge's program expects at the address where it looks for sequences.
pub(crate) fn blob(seed: u64, runs: u32) -> Vec<u8> {
    let mut dice = Dice(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1);
    let mut blob = (SEQUENCES as u32).to_le_bytes().to_vec();
    blob.extend(runs.to_le_bytes());
    for n in 0..SEQUENCES {
        let faults = n % FAULTY == FAULTY - 1;
        let end = blob.len() + SEQUENCE_BYTES;
        blob.extend(u32::from(faults).to_le_bytes());
        blob.extend((dice.roll() & FLAGS).to_le_bytes());
        for _ in 1..STATE_WORDS {
            blob.extend(dice.word().to_le_bytes());
        }
        for half in sequence(&mut dice, faults) {
            blob.extend(half.to_le_bytes());
        }
        assert!(blob.len() <= end, "a sequence is too long for its place");
        blob.resize(end, 0);
    }
    blob
}

fn sequence(dice: &mut Dice, faults: bool) -> Vec<u16> {
    let mut code = vec![0xB500]; // push {lr}
    while code.len() < LONGEST {
        match dice.below(8) {
            0 => skip(dice, &mut code),
            1 => exception(dice, &mut code),
            2 if faults => fault(dice, &mut code),
            _ => group(dice, &mut code),
        }
    }
    code.extend([0xB662, 0xBD00]); // cpsie i; pop {pc}
    code
}

/// A branch forward over one to three groups.
fn skip(dice: &mut Dice, code: &mut Vec<u16>) {
    let kind = dice.below(16);
    let at = code.len();
    code.push(0);
    if kind == 15 {
        code.push(0);
    }
    for _ in 0..=dice.below(3) {
        group(dice, code);
    }
    let halfwords = (code.len() - at) as u16;
    match kind {
        0..14 => code[at] = 0xD000 | kind << 8 | halfwords.wrapping_sub(2) & 0xFF,
        14 => code[at] = 0xE000 | halfwords.wrapping_sub(2) & 0x7FF,
        _ => (code[at], code[at + 1]) = (0xF000, 0xF800 | (halfwords - 2)),
    }
}

fn group(dice: &mut Dice, code: &mut Vec<u16>) {
    match dice.below(24) {
        0 | 1 => code.push(dice.below(3) << 11 | dice.below(32) << 6 | dice.m() << 3 | dice.d()),
        2 | 3 => code.push(0x1800 | dice.below(4) << 9 | dice.m() << 6 | dice.m() << 3 | dice.d()),
        4 | 5 => code.push(0x2000 | dice.below(4) << 11 | dice.d() << 8 | dice.below(256)),
        6..=10 => code.push(0x4000 | dice.below(16) << 6 | dice.m() << 3 | dice.d()),
        11 => high(dice, code),
        12 => fixed_offset(dice, code),
        13 => register_offset(dice, code),
        14 => code.push(dice.pick(&[0x4800, 0xA000, 0xA800]) | dice.d() << 8 | dice.below(8)),
        15 => on_the_stack(dice, code),
        16 => push_and_pop(dice, code),
        17 => multiple(dice, code),
        18 | 19 => {
            code.push(dice.pick(&[0xB200, 0xB240, 0xB280, 0xB2C0, 0xBA00, 0xBA40, 0xBAC0]) | dice.m() << 3 | dice.d())
        }
        20 => branch_by_register(dice, code),
        21 => special(dice, code),
        _ => code.extend_from_slice(dice.pick(&[
            &[0xBF00][..],
            &[0xBF10],
            &[0xBF40],
            &[0xB672],
            &[0xB662],
            &[0xF3BF, 0x8F4F],
            &[0xF3BF, 0x8F5F],
            &[0xF3BF, 0x8F6F],
        ])),
    }
}

fn high(dice: &mut Dice, code: &mut Vec<u16>) {
    let d = dice.any_d();
    let operation = dice.below(3);
    let m = match operation {
        1 => dice.pick(&[8, 9, 10, 11, 12, 13, LINK]),
        _ => dice.below(16),
    };
    code.push(0x4400 | operation << 8 | (d & 8) << 4 | m << 3 | d & 7);
}

fn fixed_offset(dice: &mut Dice, code: &mut Vec<u16>) {
    let operation = dice.pick(&[0x6000, 0x6800, 0x7000, 0x7800, 0x8000, 0x8800]);
    code.push(operation | dice.below(32) << 6 | 7 << 3 | dice.d());
}

fn register_offset(dice: &mut Dice, code: &mut Vec<u16>) {
    let operation = dice.below(8);
    let width = [4, 2, 1, 1, 4, 2, 1, 2][usize::from(operation)];
    let offset = dice.below(252 / width) * width;
    let operands = dice.pick(&[7 << 6 | 5 << 3, 5 << 6 | 7 << 3]);
    code.extend([0x2500 | offset, 0x5000 | operation << 9 | operands | dice.d()]);
}

fn on_the_stack(dice: &mut Dice, code: &mut Vec<u16>) {
    let words = 1 + dice.below(20);
    let offset = dice.below(words);
    code.push(0xB080 | words);
    code.push(0x9000 | dice.m() << 8 | offset);
    code.push(0x9800 | dice.d() << 8 | offset);
    if dice.below(2) == 0 {
        code.push(0xB000 | words);
    } else {
        // movs r5, #4 words; add sp, r5
        code.extend([0x2500 | words << 2, 0x44AD]);
    }
}

fn push_and_pop(dice: &mut Dice, code: &mut Vec<u16>) {
    let list = 1 + dice.below(127);
    let mut pop = list;
    while dice.below(2) == 0 {
        pop = (pop << 1 | pop >> 6) & 0x7F;
    }
    code.extend([0xB400 | list, 0xBC00 | pop]);
}

fn multiple(dice: &mut Dice, code: &mut Vec<u16>) {
    let mut list = 1 + dice.below(255);
    if list & 0x1F != 0 {
        list &= !0x20;
    }
    code.extend([0x463D, 0x3500 | (dice.below(48) * 4), 0xC500 | list]);
    let list = 1 + dice.below(127);
    code.extend([0x463D, 0x3500 | (dice.below(48) * 4), 0xCD00 | list]);
}

/// MOV r5, pc; ADDS r5, #3; BX or BLX r5: to the next instruction.
fn branch_by_register(dice: &mut Dice, code: &mut Vec<u16>) {
    code.extend([0x467D, 0x3503, dice.pick(&[0x4728, 0x47A8])]);
}

fn special(dice: &mut Dice, code: &mut Vec<u16>) {
    if dice.below(2) == 0 {
        // movs r5, #flags; lsls r5, r5, #28; msr apsr, r5; or iapsr, eapsr, xpsr
        code.extend([0x2500 | dice.below(16), 0x072D, 0xF385, 0x8800 | dice.below(4)]);
    } else {
        code.extend([0xF3EF, 0x8000 | dice.any_d() << 8 | dice.pick(&[0, 1, 2, 3, 5, 6, 7, 8, 9, 16, 20])]);
    }
}

/// The address of a register of the system control space in r5, `0xE000_xx00`.
fn system_control(code: &mut Vec<u16>, page: u16) {
    // movs r5, #0xE0; lsls r5, r5, #16; adds r5, #page; lsls r5, r5, #8
    code.extend([0x25E0, 0x042D, 0x3500 | page, 0x022D]);
}

/// A few bits somewhere in r6.
fn bits(dice: &mut Dice, code: &mut Vec<u16>) {
    code.extend([0x2600 | dice.below(256), 0x0036 | dice.below(25) << 6]);
}

/// What makes an exception, or says which one comes first.
fn exception(dice: &mut Dice, code: &mut Vec<u16>) {
    match dice.below(8) {
        // With interrupts masked a supervisor call would be a fault.
        0 | 1 => code.extend([0xB662, 0xDF00 | dice.below(256)]),
        2 => {
            // PendSV: movs r6, #1; lsls r6, r6, #28; str r6, [r5, #4]
            system_control(code, 0xED);
            code.extend([0x2601, 0x0736, 0x606E]);
        }
        3 => {
            // Any lines: str r6, [r5]
            system_control(code, 0xE2);
            bits(dice, code);
            code.push(0x602E);
        }
        4 => {
            // Priorities of four lines: str r6, [r5, #4 n]
            system_control(code, 0xE4);
            bits(dice, code);
            code.push(0x602E | dice.below(8) << 6);
        }
        5 => {
            // Priorities of the supervisor call, or of PendSV and the system timer: str r6, [r5, #0x1C or #0x20]
            system_control(code, 0xED);
            bits(dice, code);
            code.push(dice.pick(&[0x61EE, 0x622E]));
        }
        6 => {
            // Waiting for what is masked and pending: cpsid i; str r6, [r5]; wfi; cpsie i. Or for an event: sev; wfe.
            if dice.below(2) == 0 {
                system_control(code, 0xE2);
                code.extend([0x2601 | dice.below(2), 0x0036 | dice.below(25) << 6]);
                code.extend([0x3601, 0xB672, 0x602E, 0xBF30, 0xB662]);
            } else {
                code.extend([0xBF40, 0xBF20]);
            }
        }
        _ => {
            // The process stack, in the scratch memory beyond the code's: mov r5, r7; adds r5, #0xF0 twice; msr psp, r5;
            // movs r5, #2; msr control, r5; isb; something; movs r5, #0; msr control, r5; isb
            code.extend([0x463D, 0x35F0, 0x35F0, 0xF385, 0x8809]);
            code.extend([0x2502, 0xF385, 0x8814, 0xF3BF, 0x8F6F]);
            code.extend([0xB662, 0xDF00 | dice.below(256)]);
            code.extend([0x2500, 0xF385, 0x8814, 0xF3BF, 0x8F6F]);
        }
    }
}

/// What no core of this kind can do; the handler goes on behind it.
fn fault(dice: &mut Dice, code: &mut Vec<u16>) {
    let register = dice.pick(&[0, 1, 2, 3, 4, 6]);
    let address = match dice.below(2) {
        // An odd address in the scratch memory: mov r5, r7; adds r5, #odd
        0 => [0x463D, 0x3501 | dice.below(60) << 1],
        // No memory: movs r5, #0x90; lsls r5, r5, #24
        _ => [0x2590, 0x062D],
    };
    match dice.below(4) {
        0 => code.push(0xDE00 | dice.below(256)),
        1 => code.extend([0xF7F0 | dice.below(16), 0xA000 | dice.below(4096)]),
        // str, strh, ldr, ldrh
        _ => {
            code.extend(address);
            code.push(dice.pick(&[0x6000, 0x8000, 0x6800, 0x8800]) | 5 << 3 | register);
        }
    }
}
