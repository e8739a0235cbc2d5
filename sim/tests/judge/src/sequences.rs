//! Instruction sequences that the host made up and put into flash.
//!
//! The first words there say how many, and how often each is to run; each then has a fixed length: what kind it is, the
//! initial flags and registers r0 to r6 and r8 to r12, then code that is called like a function. r7 points at memory the
//! code may use. Every further run begins with what the one before left.
//!
//! While one runs, every exception is witnessed: its number, its return value and all that was saved go into the digest.
//! TIMER1 interrupts each run at another instruction.

use core::arch::naked_asm;
use core::sync::atomic::{AtomicU32, Ordering::Relaxed};

use crate::console::say;
use crate::exceptions::write;
use crate::{Digest, instructions, timer};

const BLOB: *const u32 = 0x2_0000 as *const u32;
const HEADER_WORDS: usize = 2;
const STATE_WORDS: usize = 14;
const SEQUENCE_WORDS: usize = 128;
/// The code's own 64, and the process stack.
const SCRATCH_WORDS: usize = 128;
/// The kind of a sequence that faults. QEMU counts some faulting instructions and some not, so none is interrupted by
/// the clock and none counted.
const FAULTS: u32 = 1;

const ISER: usize = 0xE000_E100;
const ICER: usize = 0xE000_E180;
const ICPR: usize = 0xE000_E280;
const IPR: usize = 0xE000_E400;
const SHPR2: usize = 0xE000_ED1C;
const SHPR3: usize = 0xE000_ED20;

const TIMER1: usize = 0x4000_9000;
const TASKS_START: usize = 0x000;
const TASKS_STOP: usize = 0x004;
const TASKS_CLEAR: usize = 0x00C;
const EVENTS_COMPARE0: usize = 0x140;
const INTENSET: usize = 0x304;
const BITMODE: usize = 0x508;
const PRESCALER: usize = 0x510;
const CC0: usize = 0x540;
/// External line 9.
const TIMER1_EXCEPTION: u32 = 16 + 9;

static WITNESSES: AtomicU32 = AtomicU32::new(0);
static SEEN: AtomicU32 = AtomicU32::new(0);
static EXCEPTIONS: AtomicU32 = AtomicU32::new(0);

/// Takes an exception into the digest, if a sequence runs; whether it does.
pub fn witness(return_value: u32, frame: *mut u32) -> bool {
    if WITNESSES.load(Relaxed) == 0 {
        return false;
    }
    let number: u32;
    // SAFETY: reading a special register changes nothing.
    unsafe { core::arch::asm!("mrs {}, ipsr", out(reg) number) };
    let mut digest = Digest(SEEN.load(Relaxed));
    digest.add(number);
    digest.add(return_value);
    for word in 0..8 {
        // SAFETY: the frame is where the exception entry put it.
        digest.add(unsafe { frame.add(word).read() });
    }
    SEEN.store(digest.value(), Relaxed);
    EXCEPTIONS.store(EXCEPTIONS.load(Relaxed) + 1, Relaxed);
    if number == TIMER1_EXCEPTION {
        write(TIMER1 + EVENTS_COMPARE0, 0);
    }
    true
}

/// Runs this part.
pub fn run() {
    let mut scratch = [0u32; SCRATCH_WORDS];
    // SAFETY: the host put the number of sequences and of their runs there.
    let (count, runs) = unsafe { (BLOB.read_volatile() as usize, BLOB.add(1).read_volatile()) };
    write(TIMER1 + BITMODE, 3);
    write(TIMER1 + PRESCALER, 0);
    write(TIMER1 + INTENSET, 1 << 16);
    let mut took = 0;
    for index in 0..count {
        let start = BLOB.wrapping_add(HEADER_WORDS + index * SEQUENCE_WORDS);
        // SAFETY: the host put the kind there.
        let kind = unsafe { start.read_volatile() };
        let mut state = [0; STATE_WORDS];
        for (word, i) in state.iter_mut().zip(1..) {
            // SAFETY: the host put the initial state there.
            *word = unsafe { start.wrapping_add(i).read_volatile() };
        }
        let code = start.wrapping_add(1 + STATE_WORDS) as u32 | 1;
        SEEN.store(Digest::default().value(), Relaxed);
        EXCEPTIONS.store(0, Relaxed);
        for run in 0..runs {
            for (word, i) in scratch.iter_mut().zip(0u32..) {
                *word = i.wrapping_mul(0x0101_4F3D) ^ index as u32;
            }
            state[8] = scratch.as_mut_ptr() as u32;
            let before = timer::now();
            begin(kind, state[1] ^ state[2] ^ run);
            // SAFETY: the code keeps the stack balanced and writes only to the scratch memory.
            unsafe { call(code, state.as_mut_ptr()) };
            end();
            if kind != FAULTS {
                took += instructions(timer::now().wrapping_sub(before));
            }
            let mut digest = Digest(SEEN.load(Relaxed));
            scratch.iter().for_each(|&word| digest.add(word));
            SEEN.store(digest.value(), Relaxed);
        }
        state[8] = SEEN.load(Relaxed);
        say("sequence", &state);
        say("exceptions", &[EXCEPTIONS.load(Relaxed)]);
    }
    say("sequences took", &[took]);
}

/// Every interrupt may come, from the timer at a moment made of `dice`.
fn begin(kind: u32, dice: u32) {
    WITNESSES.store(1, Relaxed);
    write(ISER, 0xFFFF_FFFF);
    if kind != FAULTS {
        // Within 256 instructions of 1024 ns, at the middle of one: 16.384 ticks of 62.5 ns each.
        let instruction = dice.wrapping_mul(0x9E37_79B1) >> 24;
        write(TIMER1 + CC0, (instruction * 16384 + 8192) / 1000);
        write(TIMER1 + TASKS_CLEAR, 1);
        write(TIMER1 + TASKS_START, 1);
    }
}

fn end() {
    write(TIMER1 + TASKS_STOP, 1);
    write(TIMER1 + EVENTS_COMPARE0, 0);
    write(ICER, 0xFFFF_FFFF);
    write(ICPR, 0xFFFF_FFFF);
    for register in 0..8 {
        write(IPR + 4 * register, 0);
    }
    write(SHPR2, 0);
    write(SHPR3, 0);
    WITNESSES.store(0, Relaxed);
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
