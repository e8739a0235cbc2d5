//! Less memory for the program: copying and clearing in 56 bytes, and loops that stay loops.
//!
//! The compiler asks for the former by name; compiler_builtins' own take 950 bytes to be fast on what is long. The longest
//! that the mote moves while light comes is a frame's header.
//!
//! What can go wrong: a stretch that is not whole words, or not on a word, goes byte by byte: four times as slow.

use core::arch::{asm, global_asm};

/// `value`, of which the compiler no longer knows anything: it cannot unroll a loop that counts with it, make a division
/// of a subtraction or a table of 1 KiB of a remainder.
#[inline(always)]
pub fn opaque(value: u32) -> u32 {
    let mut value = value;
    // SAFETY: no instruction at all.
    unsafe { asm!("/* {0} */", inout(reg) value, options(pure, nomem, nostack, preserves_flags)) };
    value
}

// SAFETY (of the whole): names, registers and results are those of the run-time ABI for the Arm architecture (4.3.4)
// and of C; r1 to r3 are the caller's to lose. From the end to the beginning, as only a count is then needed.
global_asm!(
    ".syntax unified",
    ".section .text.memory, \"ax\", %progbits",
    ".thumb_func",
    ".global __aeabi_memcpy, __aeabi_memcpy4, __aeabi_memcpy8, memcpy",
    ".thumb_set __aeabi_memcpy4, __aeabi_memcpy",
    ".thumb_set __aeabi_memcpy8, __aeabi_memcpy",
    ".thumb_set memcpy, __aeabi_memcpy",
    "__aeabi_memcpy:",
    "    movs r3, r0",
    "    orrs r3, r1",
    "    orrs r3, r2",
    "    lsls r3, r3, #30",
    "    bne 2f",
    "    b 1f",
    "0:  ldr r3, [r1, r2]",
    "    str r3, [r0, r2]",
    "1:  subs r2, #4",
    "    bpl 0b",
    "    bx lr",
    "3:  ldrb r3, [r1, r2]",
    "    strb r3, [r0, r2]",
    "2:  subs r2, #1",
    "    bpl 3b",
    "    bx lr",
    ".thumb_func",
    ".global __aeabi_memclr, __aeabi_memclr4, __aeabi_memclr8",
    ".thumb_set __aeabi_memclr4, __aeabi_memclr",
    ".thumb_set __aeabi_memclr8, __aeabi_memclr",
    "__aeabi_memclr:",
    "    movs r2, #0",
    "    movs r3, r0",
    "    orrs r3, r1",
    "    lsls r3, r3, #30",
    "    bne 2f",
    "    b 1f",
    "0:  str r2, [r0, r1]",
    "1:  subs r1, #4",
    "    bpl 0b",
    "    bx lr",
    "3:  strb r2, [r0, r1]",
    "2:  subs r1, #1",
    "    bpl 3b",
    "    bx lr",
);
