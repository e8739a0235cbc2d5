//! Instruction sequences that the host made up and put into flash.
//!
//! The first word there says how many; each then has a fixed length: the initial flags and registers r0 to r6 and r8
//! to r12, then code that is called like a function. r7 points at memory the code may use.

use core::arch::naked_asm;

use crate::Digest;
use crate::console::say;

const BLOB: *const u32 = 0x2_0000 as *const u32;
const STATE_WORDS: usize = 14;
const SEQUENCE_WORDS: usize = 128;
const SCRATCH_WORDS: usize = 64;

/// Runs this part.
pub fn run() {
    let mut scratch = [0u32; SCRATCH_WORDS];
    // SAFETY: the host put the number of sequences there.
    let count = unsafe { BLOB.read_volatile() } as usize;
    for index in 0..count {
        for (word, i) in scratch.iter_mut().zip(0u32..) {
            *word = i.wrapping_mul(0x0101_4F3D) ^ index as u32;
        }
        let mut state = [0; STATE_WORDS];
        let start = BLOB.wrapping_add(1 + index * SEQUENCE_WORDS);
        for (word, i) in state.iter_mut().zip(0..) {
            // SAFETY: the host put the initial state there.
            *word = unsafe { start.wrapping_add(i).read_volatile() };
        }
        state[8] = scratch.as_mut_ptr() as u32;
        let code = start.wrapping_add(STATE_WORDS) as u32 | 1;
        // SAFETY: the code keeps the stack balanced and writes only to the scratch memory.
        unsafe { call(code, state.as_mut_ptr()) };
        let mut digest = Digest::default();
        scratch.iter().for_each(|&word| digest.add(word));
        state[8] = digest.0;
        say("sequence", &state);
    }
}

/// Loads flags and registers from the state, runs the code, and stores them back.
#[unsafe(naked)]
unsafe extern "C" fn call(code: u32, state: *mut u32) {
    naked_asm!(
        "push {{r4, r5, r6, r7, lr}}",
        "mov r4, r8",
        "mov r5, r9",
        "mov r6, r10",
        "mov r7, r11",
        "push {{r1, r4, r5, r6, r7}}",
        "push {{r0}}",
        "movs r2, #36",
        "adds r2, r1, r2",
        "ldmia r2!, {{r3, r4, r5, r6, r7}}",
        "mov r8, r3",
        "mov r9, r4",
        "mov r10, r5",
        "mov r11, r6",
        "mov r12, r7",
        "adr r0, 2f",
        "adds r0, #1",
        "mov lr, r0",
        "ldr r0, [r1]",
        "msr apsr, r0",
        "mov r0, r1",
        "ldr r1, [r0, #8]",
        "ldr r2, [r0, #12]",
        "ldr r3, [r0, #16]",
        "ldr r4, [r0, #20]",
        "ldr r5, [r0, #24]",
        "ldr r6, [r0, #28]",
        "ldr r7, [r0, #32]",
        "ldr r0, [r0, #4]",
        "pop {{pc}}",
        ".p2align 2",
        "2:",
        "push {{r0, r1}}",
        "mrs r0, apsr",
        "ldr r1, [sp, #8]",
        "str r0, [r1]",
        "pop {{r0}}",
        "str r0, [r1, #4]",
        "pop {{r0}}",
        "str r0, [r1, #8]",
        "str r2, [r1, #12]",
        "str r3, [r1, #16]",
        "str r4, [r1, #20]",
        "str r5, [r1, #24]",
        "str r6, [r1, #28]",
        "str r7, [r1, #32]",
        "mov r2, r8",
        "mov r3, r9",
        "mov r4, r10",
        "mov r5, r11",
        "mov r6, r12",
        "adds r1, #36",
        "stmia r1!, {{r2, r3, r4, r5, r6}}",
        "pop {{r1, r4, r5, r6, r7}}",
        "mov r8, r4",
        "mov r9, r5",
        "mov r10, r6",
        "mov r11, r7",
        "pop {{r4, r5, r6, r7, pc}}",
    )
}
