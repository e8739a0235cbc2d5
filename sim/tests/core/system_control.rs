//! The registers of the NVIC and the system control block.

use sim::machine::Stop;

use crate::program::{MAIN, Program, STACK};
use crate::thumb::*;

/// Writes `value` to `address` and reads it back.
fn written(address: u32, value: u32) -> u32 {
    Program::new(&[str(1, 0, 0), ldr(2, 0, 0)]).set(0, address).set(1, value).run().r(2)
}

#[test]
fn enable_bits_are_set_and_cleared_by_ones() {
    let program = Program::new(&[str(1, 0, 0), str(2, 3, 0), ldr(4, 0, 0), ldr(5, 3, 0)])
        .set(0, 0xE000_E100)
        .set(1, 0xF000_000F)
        .set(2, 0x8000_0001)
        .set(3, 0xE000_E180)
        .run();
    assert_eq!((program.r(4), program.r(5)), (0x7000_000E, 0x7000_000E));
}

#[test]
fn pending_bits_are_set_and_cleared_by_ones() {
    let program = Program::new(&[str(1, 0, 0), str(2, 3, 0), ldr(4, 0, 0), ldr(5, 3, 0)])
        .set(0, 0xE000_E200)
        .set(1, 0xF000_000F)
        .set(2, 0x8000_0001)
        .set(3, 0xE000_E280)
        .run();
    assert_eq!((program.r(4), program.r(5)), (0x7000_000E, 0x7000_000E));
}

#[test]
fn a_priority_has_two_bits() {
    assert_eq!(written(0xE000_E400, 0xFFFF_FFFF), 0xC0C0_C0C0);
    assert_eq!(written(0xE000_E41C, 0x1234_5678), 0x0000_4040);
    assert_eq!(written(0xE000_ED1C, 0xFFFF_FFFF), 0xC000_0000);
    assert_eq!(written(0xE000_ED20, 0xFFFF_FFFF), 0xC0C0_0000);
}

#[test]
fn the_core_says_it_is_a_cortex_m0() {
    assert_eq!(written(0xE000_ED00, 0), 0x410C_C200);
}

#[test]
fn there_is_no_vector_table_offset() {
    assert_eq!(written(0xE000_ED08, 0x2000_0000), 0);
}

#[test]
fn alignment_rules_are_fixed() {
    assert_eq!(written(0xE000_ED14, 0), 0x208);
}

#[test]
fn sleep_configuration_keeps_three_bits() {
    assert_eq!(written(0xE000_ED10, 0xFFFF_FFFF), 0x16);
}

#[test]
fn narrow_accesses_are_refused() {
    let mut program = Program::new(&[0x7801]).set(0, 0xE000_E400);
    assert!(matches!(program.stop(), Stop::Fault(_)));
}

#[test]
fn a_reset_request_needs_its_key() {
    assert_eq!(written(0xE000_ED0C, 0x1234_0004), 0xFA05_0000);
    let mut program = Program::new(&[str(1, 0, 0)]).set(0, 0xE000_ED0C).set(1, 0x05FA_0004).set(13, 0x2000_0800);
    assert_eq!(program.stop(), Stop::Reset);
    program.machine.reset();
    assert_eq!((program.r(15), program.r(13), program.r(0)), (MAIN, STACK, 0));
    assert!(program.cycles() > 0, "time goes on");
}

#[test]
fn the_state_register_tells_what_is_pending_and_active() {
    let program = Program::new(&[CPSID, str(1, 0, 0), ldr(2, 0, 0), str(3, 0, 0), ldr(4, 0, 0)])
        .set(0, 0xE000_ED04)
        .set(1, 1 << 28 | 1 << 26)
        .set(3, 1 << 27 | 1 << 25)
        .run();
    assert_eq!(program.r(2), 1 << 28 | 1 << 26 | 14 << 12);
    assert_eq!(program.r(4), 0);
    let program = Program::new(&[SVC]).handler(11, &[ldr(4, 0, 0), BX_LR]).set(0, 0xE000_ED04).run();
    assert_eq!(program.r(4), 11);
}
