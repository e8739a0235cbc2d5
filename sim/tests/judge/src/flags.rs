//! Every data-processing instruction on the edges of its operands, with every carry.

use core::arch::asm;

use crate::Digest;
use crate::console::say;

const EDGES: [u32; 15] = [0, 1, 2, 3, 30, 31, 32, 33, 64, 255, 256, 0x7FFF_FFFF, 0x8000_0000, 0x8000_0001, 0xFFFF_FFFF];

macro_rules! sweep {
    ($($instruction:literal)*) => {
        $({
            let mut digest = Digest::default();
            for a in EDGES {
                for b in EDGES {
                    for flags in [0, 0x2000_0000, 0xD000_0000, 0xF000_0000u32] {
                        let (result, after): (u32, u32);
                        // SAFETY: only the named registers change.
                        unsafe {
                            asm!(
                                "msr apsr, {flags}",
                                $instruction,
                                "mrs {after}, apsr",
                                inout("r0") a => result,
                                in("r1") b,
                                flags = in(reg) flags,
                                after = out(reg) after,
                            );
                        }
                        digest.add(result);
                        digest.add(after);
                    }
                }
            }
            say($instruction, &[digest.0]);
        })*
    };
}

/// Runs this part.
pub fn run() {
    sweep! {
        "adds r0, r0, r1" "subs r0, r0, r1" "adcs r0, r1" "sbcs r0, r1" "rsbs r0, r1, #0" "cmp r0, r1" "cmn r0, r1"
        "adds r0, #255" "subs r0, #255" "adds r0, r1, #7" "subs r0, r1, #7" "cmp r0, #255" "movs r0, #0" "movs r0, r1"
        "lsls r0, r1" "lsrs r0, r1" "asrs r0, r1" "rors r0, r1"
        "lsls r0, r1, #1" "lsls r0, r1, #31" "lsrs r0, r1, #1" "lsrs r0, r1, #32" "asrs r0, r1, #1" "asrs r0, r1, #32"
        "ands r0, r1" "orrs r0, r1" "eors r0, r1" "bics r0, r1" "mvns r0, r1" "tst r0, r1" "muls r0, r1, r0"
        "sxtb r0, r1" "sxth r0, r1" "uxtb r0, r1" "uxth r0, r1" "rev r0, r1" "rev16 r0, r1" "revsh r0, r1"
        "add r0, r1" "mov r0, r1"
    }
    conditions();
}

fn conditions() {
    macro_rules! taken {
        ($flags:expr, $($branch:literal)*) => {{
            let mut mask = 0u32;
            $({
                let taken: u32;
                // SAFETY: only the named registers change.
                unsafe {
                    asm!(
                        "msr apsr, {flags}",
                        concat!($branch, " 2f"),
                        "movs {taken}, #0",
                        "b 3f",
                        "2: movs {taken}, #1",
                        "3:",
                        flags = in(reg) $flags,
                        taken = out(reg) taken,
                    );
                }
                mask = mask << 1 | taken;
            })*
            mask
        }};
    }
    for flags in 0..16u32 {
        let mask =
            taken!(flags << 28, "beq" "bne" "bcs" "bcc" "bmi" "bpl" "bvs" "bvc" "bhi" "bls" "bge" "blt" "bgt" "ble");
        say("conditions", &[flags, mask]);
    }
}
