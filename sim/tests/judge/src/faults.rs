//! What must fault, and where the fault says it was.
//!
//! What can go wrong: QEMU's Cortex-M0 lets CBZ and IT pass, which ARMv6-M does not have; they are left out.
//! It also counts an undefined instruction as executed, so nobody counts instructions here.

use core::arch::{asm, naked_asm};
use core::sync::atomic::{AtomicU32, Ordering::Relaxed};

use crate::console::say;
use crate::exceptions::frame_of;
use crate::sequences;

static RESUME: AtomicU32 = AtomicU32::new(0);
static FAULTED_AT: AtomicU32 = AtomicU32::new(0);
static FAULTED_PSR: AtomicU32 = AtomicU32::new(0);
static FAULTS: AtomicU32 = AtomicU32::new(0);

/// Goes on where the faulting code asked for it.
#[unsafe(naked)]
pub unsafe extern "C" fn hard_fault() {
    naked_asm!("mov r0, lr", "mrs r1, msp", "push {{r4, lr}}", "bl {inner}", "pop {{r4, pc}}", inner = sym inner)
}

extern "C" fn inner(return_value: u32, main_stack: *mut u32) {
    let frame = frame_of(return_value, main_stack);
    if sequences::witness(return_value, frame) {
        // SAFETY: the frame is where the exception entry put it, and the program counter in it that of the instruction.
        unsafe {
            let pc = frame.add(6).read();
            let wide = (pc as *const u16).read_volatile() >= 0xE800;
            frame.add(6).write(pc + if wide { 4 } else { 2 });
        }
        return;
    }
    // SAFETY: the frame is where the exception entry put it.
    unsafe {
        FAULTED_AT.store(frame.add(6).read(), Relaxed);
        FAULTED_PSR.store(frame.add(7).read(), Relaxed);
        frame.add(6).write(RESUME.load(Relaxed) & !1);
        frame.add(7).write(1 << 24);
    }
    FAULTS.store(FAULTS.load(Relaxed) + 1, Relaxed);
}

macro_rules! faulting {
    ($name:literal, $address:expr, $code:literal) => {{
        let (here, kept): (u32, u32);
        // SAFETY: whatever happens ends in the fault handler, which comes back to the label.
        unsafe {
            asm!(
                "adr r2, 3f", "str r2, [r3]", "adr r2, 2f", "movs r0, #77", "cmp r0, r0",
                ".p2align 2", "2:", $code, "nop", "nop", ".p2align 2", "3:",
                out("r0") kept, in("r1") $address, out("r2") here, in("r3") RESUME.as_ptr(), out("lr") _,
                out("r12") _,
            );
        }
        let at = FAULTED_AT.load(Relaxed).wrapping_sub(here);
        say($name, &[FAULTS.load(Relaxed), at, FAULTED_PSR.load(Relaxed), kept]);
    }};
}

/// Runs this part.
pub fn run() {
    let words = [1u32, 2];
    let odd = words.as_ptr() as u32 + 1;
    faulting!("unaligned ldr", odd, "ldr r0, [r1]");
    faulting!("unaligned ldrh", odd, "ldrh r0, [r1]");
    faulting!("unaligned str", odd, "str r0, [r1]");
    faulting!("unaligned ldm", odd, "ldmia r1!, {{r0}}");
    faulting!("no memory", 0x9000_0000u32, "ldr r0, [r1]");
    faulting!("no memory to write", 0x9000_0000u32, "str r0, [r1]");
    faulting!("udf", 0, "udf #0");
    faulting!("wide udf", 0, ".inst.w 0xF7F0A000");
    faulting!("division", 0, ".inst.w 0xFBB0F0F1");
    faulting!("aligned is fine", words.as_ptr(), "ldr r0, [r1]");
}
