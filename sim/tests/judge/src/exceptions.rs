//! Supervisor calls, PendSV, and interrupts pended by software at different priorities.

use core::arch::{asm, naked_asm};
use core::sync::atomic::{AtomicU32, Ordering::Relaxed};

use crate::console::say;
use crate::sequences;

const ISER: usize = 0xE000_E100;
const ICER: usize = 0xE000_E180;
const ISPR: usize = 0xE000_E200;
const ICPR: usize = 0xE000_E280;
const IPR: usize = 0xE000_E400;
const SYST_CSR: usize = 0xE000_E010;
const CPUID: usize = 0xE000_ED00;
const ICSR: usize = 0xE000_ED04;
const CCR: usize = 0xE000_ED14;
const SHPR2: usize = 0xE000_ED1C;
const SHPR3: usize = 0xE000_ED20;
/// QEMU shows RETTOBASE, which ARMv6-M does not have.
const RETTOBASE: u32 = 1 << 11;
const PENDSVSET: u32 = 1 << 28;
const PENDSVCLR: u32 = 1 << 27;
const PENDSTSET: u32 = 1 << 26;

static ORDER: [AtomicU32; 16] = [const { AtomicU32::new(0) }; 16];
static NEXT: AtomicU32 = AtomicU32::new(0);
static PEND_INSIDE: [AtomicU32; 48] = [const { AtomicU32::new(0) }; 48];

/// Writes a register of the system control space.
pub fn write(address: usize, value: u32) {
    // SAFETY: a register of the system control space.
    unsafe { (address as *mut u32).write_volatile(value) }
}

fn read(address: usize) -> u32 {
    // SAFETY: a register of the system control space.
    unsafe { (address as *const u32).read_volatile() }
}

macro_rules! special {
    ($register:literal) => {{
        let value: u32;
        // SAFETY: reading a special register changes nothing.
        unsafe { asm!(concat!("mrs {}, ", $register), out(reg) value) };
        value
    }};
}

fn barrier() {
    // SAFETY: barriers change nothing.
    unsafe { asm!("dsb", "isb") }
}

fn note(word: u32) {
    let at = NEXT.load(Relaxed);
    if let Some(place) = ORDER.get(at as usize) {
        place.store(word, Relaxed);
    }
    NEXT.store(at + 1, Relaxed);
}

fn tell(name: &str) {
    let count = (NEXT.load(Relaxed) as usize).min(ORDER.len());
    let mut words = [0; 16];
    for (word, place) in words.iter_mut().zip(&ORDER) {
        *word = place.load(Relaxed);
    }
    say(name, &words[..count]);
    NEXT.store(0, Relaxed);
}

fn handle() {
    let number = special!("ipsr");
    note(number);
    let inside = PEND_INSIDE[(number & 63) as usize % 48].load(Relaxed);
    if inside != 0 {
        PEND_INSIDE[number as usize].store(0, Relaxed);
        write(ISPR, inside);
        barrier();
        note(number | 0x100);
    }
}

/// Handles external interrupts, PendSV and SysTick.
#[unsafe(naked)]
pub unsafe extern "C" fn interrupt() {
    naked_asm!("mov r0, lr", "mrs r1, msp", "push {{r4, lr}}", "bl {inner}", "pop {{r4, pc}}", inner = sym interrupted)
}

extern "C" fn interrupted(return_value: u32, main_stack: *mut u32) {
    if !sequences::witness(return_value, frame_of(return_value, main_stack)) {
        handle();
    }
}

/// Where the exception entry put what it saved.
pub fn frame_of(return_value: u32, main_stack: *mut u32) -> *mut u32 {
    if return_value & 4 == 0 { main_stack } else { special!("psp") as *mut u32 }
}

/// Handles supervisor calls: doubles the caller's r0 and notes its frame.
#[unsafe(naked)]
pub unsafe extern "C" fn supervisor_call() {
    naked_asm!("mov r0, lr", "mrs r1, msp", "push {{r4, lr}}", "bl {inner}", "pop {{r4, pc}}", inner = sym inner)
}

extern "C" fn inner(return_value: u32, main_stack: *mut u32) {
    let frame = frame_of(return_value, main_stack);
    if sequences::witness(return_value, frame) {
        return;
    }
    // SAFETY: the frame is where the exception entry put it.
    unsafe {
        note(return_value);
        note(frame.add(1).read());
        note(frame.add(7).read());
        note(frame as u32 & 7);
        frame.write(frame.read().wrapping_mul(2));
    }
    handle();
}

fn supervisor(a: u32, b: u32) -> u32 {
    let result;
    // SAFETY: the handler changes r0 in the frame and nothing else.
    unsafe { asm!("svc 0", inout("r0") a => result, in("r1") b) };
    result
}

fn mask(masked: bool) {
    // SAFETY: nothing here depends on the mask.
    unsafe { if masked { asm!("cpsid i") } else { asm!("cpsie i") } }
}

/// Runs this part.
pub fn run() {
    write(ISER, 0xFFFF_FFFF);
    registers();
    calls();
    alignment();
    process_stack();
    order();
    nesting();
    masking();
    sleeping();
    write(ICER, 0xFFFF_FFFF);
}

fn registers() {
    say("cpuid", &[read(CPUID), read(CCR), read(SYST_CSR)]);
    write(IPR, 0xFFFF_FFFF);
    write(IPR + 28, 0x1234_5678);
    write(SHPR2, 0xFFFF_FFFF);
    write(SHPR3, 0xFFFF_0000);
    say("priorities", &[read(IPR), read(IPR + 28), read(SHPR2), read(SHPR3), read(ISER), read(ICER)]);
    for address in [IPR, IPR + 28, SHPR2, SHPR3] {
        write(address, 0);
    }
}

fn calls() {
    let result = supervisor(21, 0xABCD);
    say("supervisor call", &[result]);
    tell("its frame");
}

fn alignment() {
    // SAFETY: the stack is balanced.
    unsafe {
        asm!(
            "push {{r4}}", "movs r0, #3", "cmp r0, #3", "svc 1", "pop {{r4}}",
            "push {{r3, r4}}", "movs r0, #3", "cmp r0, #4", "svc 1", "pop {{r3, r4}}",
            out("r0") _, out("r1") _, out("r2") _, out("r3") _,
            out("r12") _, out("lr") _,
        );
    }
    tell("aligned frames");
}

fn process_stack() {
    let mut stack = [0u64; 64];
    let top = stack.as_mut_ptr_range().end;
    let control: u32;
    // SAFETY: the process stack is large enough, and the main stack comes back before anything else uses it.
    unsafe {
        asm!(
            "msr psp, {top}", "msr control, {two}", "isb", "movs r0, #5", "movs r1, #6", "cmp r0, r1", "svc 2",
            "mrs {control}, control", "msr control, {zero}", "isb",
            top = in(reg) top, two = in(reg) 2, zero = in(reg) 0, control = out(reg) control,
            out("r0") _, out("r1") _,
        );
    }
    say("process stack", &[control, special!("control")]);
    tell("its frame");
}

fn order() {
    for (name, priorities, system) in [
        ("equal priorities", 0, 0),
        ("last first", 0x0040_80C0, 0),
        ("system last", 0x4040_8080, 0xC0C0_0000),
        ("system first", 0x8080_C040, 0x4000_0000),
    ] {
        write(IPR, priorities);
        write(SHPR3, system);
        mask(true);
        write(ISPR, 0x8000_000F);
        write(ICSR, PENDSVSET | PENDSTSET);
        say("pending", &[read(ICSR) & !RETTOBASE, read(ISPR)]);
        mask(false);
        barrier();
        tell(name);
    }
    mask(true);
    write(ISPR, 0xFF);
    write(ICPR, 0xF0);
    write(ICSR, PENDSVSET);
    write(ICSR, PENDSVCLR);
    write(ICER, 0x3);
    mask(false);
    barrier();
    tell("some withdrawn");
    write(ICPR, 0xFFFF_FFFF);
    write(ISER, 0x3);
    tell("nothing left");
}

fn nesting() {
    // Line 0 is patient and pends 1, 2 and 3 inside; 2 is the most urgent and pends 1 again.
    for priorities in [0x8000_40C0, 0xC000_40C0, 0x4000_C080, 0x0000_0000, 0xC0C0_C000] {
        write(IPR, priorities);
        PEND_INSIDE[16].store(0b1110, Relaxed);
        PEND_INSIDE[18].store(0b1010, Relaxed);
        write(ISPR, 1);
        barrier();
        tell("nested");
    }
    write(SHPR2, 0x8000_0000);
    PEND_INSIDE[11].store(0b0110, Relaxed);
    write(IPR, 0x00C0_4000);
    say("call doubles", &[supervisor(1, 2)]);
    tell("call interrupted");
    write(SHPR2, 0);
}

fn masking() {
    write(IPR, 0);
    mask(true);
    write(ISPR, 2);
    barrier();
    note(special!("primask"));
    mask(false);
    barrier();
    note(special!("primask"));
    tell("masked");
    write(ICER, 2);
    write(ISPR, 2);
    barrier();
    note(0);
    write(ISER, 2);
    barrier();
    tell("enabled later");
}

fn sleeping() {
    mask(true);
    write(ISPR, 4);
    // SAFETY: an interrupt is pending, so the sleep ends.
    unsafe { asm!("wfi") };
    note(0);
    mask(false);
    barrier();
    tell("woken while masked");
}
