//! Thumb instructions, as far as they move the stack pointer or the program counter.
//!
//! Numbers of encodings are those of the ARMv7-M Architecture Reference Manual, A7.7, of which ARMv6-M is a part.
//!
//! What can go wrong: an instruction that moves the stack pointer in a way that is not here. The ways compilers use are;
//! the others are [`Effect::Unknown`].

/// What an instruction does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Effect {
    /// Nothing of the kind, or it gives stack back.
    None,
    /// Takes so many bytes of stack.
    Takes(u32),
    /// May go on there and not come back.
    Goes(u32),
    /// Calls what is there.
    Calls(u32),
    /// Calls whatever is in a register.
    CallsThroughRegister,
    /// Cannot be told.
    Unknown(&'static str),
}

/// Bytes of an instruction that begins with `code`.
pub(super) fn length(code: u16) -> u32 {
    if code >> 11 >= 0b11101 { 4 } else { 2 }
}

/// What the instruction `[first, second]` at `at` does; `before` are the first halves of those before it in its function,
/// `word` reads a word of the program.
pub(super) fn effect([first, second]: [u16; 2], at: u32, before: &[u16], word: impl Fn(u32) -> Option<u32>) -> Effect {
    if length(first) == 4 { wide(first, second, at) } else { narrow(first, at, before, word) }
}

fn narrow(code: u16, at: u32, before: &[u16], word: impl Fn(u32) -> Option<u32>) -> Effect {
    let register = code >> 3 & 15;
    match code {
        // PUSH T1.
        _ if code & 0xfe00 == 0xb400 => Effect::Takes((code & 0x1ff).count_ones() * 4),
        // SUB (SP minus immediate) T1.
        _ if code & 0xff80 == 0xb080 => Effect::Takes(u32::from(code & 0x7f) * 4),
        // ADD (SP plus register) T2: a frame too large for an immediate. Its size comes from a literal: LDR T1.
        _ if code & 0xff87 == 0x4485 => {
            let literal = before.iter().rev().take(3).position(|before| before >> 8 == 0x48 | register);
            let value = literal.and_then(|back| {
                let code = before[before.len() - 1 - back];
                // Those between are narrow, or the place is not known.
                let between = before.iter().rev().take(back).all(|between| length(*between) == 2);
                let from = at - 2 * (back as u32 + 1);
                between.then(|| word(((from + 4) & !3) + u32::from(code & 0xff) * 4)).flatten()
            });
            match value.map(|value| value as i32) {
                Some(value) if value < 0 => Effect::Takes(value.unsigned_abs()),
                Some(_) => Effect::None,
                None => Effect::Unknown("a register of unknown value is added to the stack pointer"),
            }
        }
        // MOV T1 to SP: right behind a SUB T1 from r7, the frame's own pointer, it gives back.
        _ if code & 0xff87 == 0x4685 => {
            let from_frame = before.iter().rev().take(3).any(|before| before & 0xfe3f == 0x1e38 | register);
            if register == 7 || from_frame {
                Effect::None
            } else {
                Effect::Unknown("the stack pointer is set from a register")
            }
        }
        // BLX T1.
        _ if code & 0xff87 == 0x4780 => Effect::CallsThroughRegister,
        // BX T1: a return, through LR or what was just popped.
        _ if code & 0xff87 == 0x4700 => {
            let popped = before.last().is_some_and(|last| *last == 0xbc00 | 1 << register);
            if register == 14 || popped { Effect::None } else { Effect::Unknown("a jump through a register") }
        }
        // B T2, B T1; conditions 14 and 15 are UDF and SVC.
        _ if code & 0xf800 == 0xe000 => Effect::Goes(jump(at, i32::from(code & 0x7ff), 11)),
        _ if code & 0xf000 == 0xd000 && code >> 8 & 15 < 14 => Effect::Goes(jump(at, i32::from(code & 0xff), 8)),
        _ => Effect::None,
    }
}

fn wide(first: u16, second: u16, at: u32) -> Effect {
    let (first, second) = (u32::from(first), u32::from(second));
    let immediate8 = second & 0xff;
    match first {
        // PUSH T2: STMDB SP!.
        0xe92d => Effect::Takes(second.count_ones() * 4),
        // PUSH T3: STR with writeback below SP, and STRD T1 alike, in words.
        0xf84d if second & 0x0f00 == 0x0d00 => Effect::Takes(immediate8),
        0xe96d => Effect::Takes(immediate8 * 4),
        // VPUSH T1, T2.
        0xed2d | 0xed6d => Effect::Takes(immediate8 * 4),
        // SUB (SP minus immediate) T2, T3.
        0xf1ad | 0xf5ad if second & 0x8f00 == 0x0d00 => Effect::Takes(modified(first, second)),
        0xf2ad | 0xf6ad if second & 0x8f00 == 0x0d00 => {
            Effect::Takes((first >> 10 & 1) << 11 | (second >> 12 & 7) << 8 | immediate8)
        }
        // SUB (SP minus register) T1; MOV T3 to SP.
        0xebad if second & 0x0f00 == 0x0d00 => Effect::Unknown("a register is taken off the stack pointer"),
        0xea4f | 0xea5f if second & 0x0f00 == 0x0d00 => Effect::Unknown("the stack pointer is set from a register"),
        // LDR T3, T4 to PC; from SP it is a return.
        _ if first & 0xff70 == 0xf850 && second >> 12 == 15 && first & 15 != 13 => {
            Effect::Unknown("a jump through memory")
        }
        // BL T1.
        _ if first & 0xf800 == 0xf000 && second & 0xd000 == 0xd000 => Effect::Calls(far(first, second, at)),
        // B T4.
        _ if first & 0xf800 == 0xf000 && second & 0xd000 == 0x9000 => Effect::Goes(far(first, second, at)),
        // B T3; conditions 14 and 15 are other instructions.
        _ if first & 0xf800 == 0xf000 && second & 0xd000 == 0x8000 && first >> 6 & 15 < 14 => {
            let offset = (first >> 10 & 1) << 19
                | (second >> 11 & 1) << 18
                | (second >> 13 & 1) << 17
                | (first & 0x3f) << 11
                | second & 0x7ff;
            Effect::Goes(jump(at, offset as i32, 20))
        }
        _ => Effect::None,
    }
}

/// From `at`, `halves` further, a number of `bits` bits with a sign.
fn jump(at: u32, halves: i32, bits: u32) -> u32 {
    let halves = halves << (32 - bits) >> (32 - bits);
    at.wrapping_add(4).wrapping_add_signed(halves * 2)
}

/// S:I1:I2:imm10:imm11, in halves.
fn far(first: u32, second: u32, at: u32) -> u32 {
    let sign = first >> 10 & 1;
    let [i1, i2] = [13, 11].map(|bit| !(second >> bit ^ sign) & 1);
    jump(at, (sign << 23 | i1 << 22 | i2 << 21 | (first & 0x3ff) << 11 | second & 0x7ff) as i32, 24)
}

/// A modified immediate constant (A5.3.2).
fn modified(first: u32, second: u32) -> u32 {
    let byte = second & 0xff;
    let control = (first >> 10 & 1) << 4 | (second >> 12 & 7) << 1 | byte >> 7;
    match control {
        0 | 1 => byte,
        2 | 3 => byte << 16 | byte,
        4 | 5 => byte << 24 | byte << 8,
        6 | 7 => byte * 0x0101_0101,
        _ => (byte | 0x80).rotate_right(control),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Codes as an assembler gives them, at 0x100.
    fn at_100(codes: [u16; 2]) -> Effect {
        effect(codes, 0x100, &[], |_| None)
    }

    #[test]
    fn what_takes_stack_is_counted() {
        for (codes, bytes) in [
            // push {r4-r7, lr}; push {r7, lr}; sub sp, #508; sub sp, #8
            ([0xb5f0, 0], 20),
            ([0xb580, 0], 8),
            ([0xb0ff, 0], 508),
            ([0xb082, 0], 8),
            // push.w {r4-r11, lr}; str r8, [sp, #-4]!; strd r0, r1, [sp, #-8]!; vpush {d8-d9}
            ([0xe92d, 0x4ff0], 36),
            ([0xf84d, 0x8d04], 4),
            ([0xe96d, 0x0102], 8),
            ([0xed2d, 0x8b04], 16),
            // sub.w sp, sp, #516; sub.w sp, sp, #1024; subw sp, sp, #2047
            ([0xf2ad, 0x2d04], 516),
            ([0xf5ad, 0x6d80], 1024),
            ([0xf2ad, 0x7dff], 2047),
        ] {
            assert_eq!(at_100(codes), Effect::Takes(bytes), "{codes:04x?}");
        }
    }

    #[test]
    fn a_frame_too_large_for_an_immediate_is_a_literal() {
        // ldr r4, [pc, #8]; add sp, r4: the literal is at 0x10c.
        let literal =
            |value: i32| effect([0x44a5, 0], 0x102, &[0xb5f0, 0x4c02], move |at| (at == 0x10c).then_some(value as u32));
        assert_eq!(literal(-1032), Effect::Takes(1032));
        assert_eq!(literal(1032), Effect::None);
        assert!(matches!(at_100([0x44a5, 0]), Effect::Unknown(_)));
    }

    #[test]
    fn where_it_goes_on_is_known() {
        // bl and b.w by 0x1000 from 0x104; b by -4; bne by 4; bne.w by 0x1000.
        assert_eq!(at_100([0xf001, 0xf800]), Effect::Calls(0x1104));
        assert_eq!(at_100([0xf001, 0xb800]), Effect::Goes(0x1104));
        assert_eq!(at_100([0xe7fe, 0]), Effect::Goes(0x100));
        assert_eq!(at_100([0xd102, 0]), Effect::Goes(0x108));
        assert_eq!(at_100([0xf041, 0x8000]), Effect::Goes(0x1104));
        // bl backwards, by -0x100.
        assert_eq!(effect([0xf7ff, 0xff80], 0x200, &[], |_| None), Effect::Calls(0x104));
    }

    #[test]
    fn what_cannot_be_told_is_not_guessed() {
        // mov sp, r4; bx r3; sub.w sp, sp, r4; ldr.w pc, [r0]
        for codes in [[0x46a5, 0], [0x4718, 0], [0xebad, 0x0d04], [0xf8d0, 0xf000]] {
            assert!(matches!(at_100(codes), Effect::Unknown(_)), "{codes:04x?}");
        }
        // blx r3
        assert_eq!(at_100([0x4798, 0]), Effect::CallsThroughRegister);
        // bx lr; pop {r1} bx r1; subs r6, r7, #7 subs r6, #5 mov sp, r6
        assert_eq!(at_100([0x4770, 0]), Effect::None);
        assert_eq!(effect([0x4708, 0], 0x100, &[0xbc02], |_| None), Effect::None);
        assert_eq!(effect([0x46b5, 0], 0x100, &[0x1ffe, 0x3e05], |_| None), Effect::None);
    }
}
