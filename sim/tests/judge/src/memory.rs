//! Loads and stores of every width and kind.

use core::arch::asm;

use crate::Digest;
use crate::console::say;

/// Runs this part.
pub fn run() {
    let mut words = [0u32; 16];
    for (word, i) in words.iter_mut().zip(0u32..) {
        *word = i.wrapping_mul(0x0F1E_2D3C) ^ 0x80FF_7F01;
    }
    let base = words.as_mut_ptr();
    let mut digest = Digest::default();
    macro_rules! load {
        ($instruction:literal, $offsets:expr) => {
            for offset in $offsets {
                let value: u32;
                // SAFETY: the offset stays inside the array.
                unsafe { asm!($instruction, out("r0") value, in("r1") base, in("r2") offset) };
                digest.add(value);
            }
        };
    }
    load!("ldrb r0, [r1, r2]", 0..64);
    load!("ldrsb r0, [r1, r2]", 0..64);
    load!("ldrh r0, [r1, r2]", (0..64).step_by(2));
    load!("ldrsh r0, [r1, r2]", (0..64).step_by(2));
    load!("ldr r0, [r1, r2]", (0..64).step_by(4));
    load!("ldrb r0, [r1, #31]", 0..1);
    load!("ldrh r0, [r1, #62]", 0..1);
    load!("ldr r0, [r1, #60]", 0..1);
    say("loads", &[digest.0]);
    // SAFETY: all stores are inside the array.
    unsafe {
        asm!(
            "strb r0, [r1, r2]", "strh r0, [r1, r3]", "str r0, [r1, r4]",
            "strb r0, [r1, #31]", "strh r0, [r1, #62]", "str r0, [r1, #8]",
            in("r0") 0xDEAD_BEEFu32, in("r1") base, in("r2") 5, in("r3") 10, in("r4") 16,
        );
        asm!("stmia r1!, {{r0, r2, r3}}", "subs r0, r1, r4", inout("r0") 7 => _, inout("r1") base.add(8) => _, in("r2") 8, in("r3") 9, in("r4") base);
    }
    let (first, second, third, moved): (u32, u32, u32, *mut u32);
    // SAFETY: all loads are inside the array; the stack is balanced.
    unsafe {
        asm!(
            "ldmia r3!, {{r0, r1, r2}}", "push {{r0, r1, r2}}", "pop {{r0, r1}}", "pop {{r2}}",
            out("r0") first, out("r1") second, out("r2") third, inout("r3") base.add(7) => moved,
        );
    }
    let mut digest = Digest::default();
    words.iter().for_each(|&word| digest.add(word));
    say("stores", &[digest.0, first, second, third, (moved as u32).wrapping_sub(base as u32)]);
    let kept: u32;
    // SAFETY: the load is inside the array.
    unsafe { asm!("ldmia r1, {{r0, r1}}", out("r0") _, inout("r1") base => kept) };
    say("base in list", &[kept]);
}
