//! What the core refuses, and what happens then.

use sim::machine::{Config, Stop};

use crate::program::{MAIN, Program, STACK, config};
use crate::thumb::*;

fn fault_of(mut program: Program) -> (u32, u32, &'static str) {
    match program.stop() {
        Stop::Fault(fault) => (fault.pc, fault.address, fault.why),
        other => panic!("{other}"),
    }
}

#[test]
fn an_unaligned_access_is_refused_in_every_width() {
    for code in [ldr(0, 1, 0), str(0, 1, 0), 0x8808, 0x8008, 0xC901, 0xC101] {
        let (pc, address, why) = fault_of(Program::new(&[NOP, code]).set(1, 0x2000_0101));
        assert_eq!((pc, address, why), (MAIN + 2, 0x2000_0101, "unaligned access"), "{code:#06x}");
    }
}

#[test]
fn an_address_nobody_owns_is_refused_with_the_reason_of_the_bus() {
    let (pc, address, why) = fault_of(Program::new(&[ldr(0, 1, 4)]).set(1, 0x6000_0000));
    assert_eq!((pc, address, why), (MAIN, 0x6000_0004, "no such register"));
    assert_eq!(fault_of(Program::new(&[str(0, 1, 0)]).set(1, 0x2001_0000)).1, 0x2001_0000);
    assert_eq!(fault_of(Program::new(&[ldr(0, 1, 0)]).set(1, 0xE000_1000)).1, 0xE000_1000);
}

#[test]
fn an_access_that_faults_leaves_its_registers() {
    let mut program = Program::new(&[0xCB03]).set(0, 7).set(3, 0x2000_FFFC);
    program.stop();
    assert_eq!((program.r(3), program.r(15)), (0x2000_FFFC, MAIN));
}

#[test]
fn undefined_instructions_are_refused() {
    for code in [&[UDF][..], &[0xF7F0, 0xA000], &[0xE800, 0x0000], &[0xB100], &[0xBF08], &[0xFBB0, 0xF0F1], &[0xB400]] {
        let (pc, _, why) = fault_of(Program::new(code));
        assert_eq!((pc, why), (MAIN, "undefined instruction"), "{code:04x?}");
    }
}

#[test]
fn a_branch_without_the_thumb_bit_is_refused_where_it_lands() {
    for code in [0x4700, 0x4780] {
        let (pc, _, why) = fault_of(Program::new(&[code]).set(0, MAIN + 4));
        assert_eq!((pc, why), (MAIN + 4, "branch to an address without the Thumb bit"));
    }
}

#[test]
fn running_where_there_is_no_memory_is_refused() {
    let (pc, _, why) = fault_of(Program::new(&[0x4700]).set(0, 0x4000_0001));
    assert_eq!((pc, why), (0x4000_0000, "nothing to execute at this address"));
    let (pc, ..) = fault_of(Program::new(&[0x4700]).set(0, 0xFFFF_FFF9));
    assert_eq!(pc, 0xFFFF_FFF8, "exception returns mean nothing in Thread mode");
}

#[test]
fn a_breakpoint_without_a_debugger_is_refused() {
    let config = Config { stop_at_breakpoints: false, ..config() };
    assert_eq!(fault_of(Program::with(config, &[])).2, "BKPT without a debugger");
}

#[test]
fn a_supervisor_call_that_cannot_be_taken_is_refused() {
    assert_eq!(fault_of(Program::new(&[CPSID, SVC])).0, MAIN + 2);
}

#[test]
fn a_hard_fault_handler_runs_if_faults_are_not_fatal() {
    let config = Config { fault_is_fatal: false, ..config() };
    // The handler steps over the instruction: ldr r0, [sp, #24]; adds r0, #2; str r0, [sp, #24]
    let program = Program::with(config, &[ldr(2, 1, 0), movs(3, 3)])
        .handler(3, &[0x9806, adds(0, 2), 0x9006, 0xF3EF, 0x8405, BX_LR])
        .set(1, 0x2000_0001)
        .run();
    assert_eq!((program.r(2), program.r(3), program.r(4)), (0, 3, 3));
    let fault = program.machine.last_fault().expect("the fault is remembered");
    assert_eq!((fault.pc, fault.address), (MAIN, 0x2000_0001));
}

#[test]
fn a_fault_in_the_hard_fault_handler_locks_up() {
    let config = Config { fault_is_fatal: false, ..config() };
    let mut program = Program::with(config, &[UDF]).handler(3, &[NOP, UDF]);
    let Stop::Lockup(fault) = program.stop() else { panic!("no lockup") };
    assert_eq!(fault.pc, 0x400 + 3 * 0x40 + 2);
    assert!(matches!(program.stop(), Stop::Lockup(_)), "and stays so");
}

#[test]
fn a_fault_with_no_memory_for_its_frame_locks_up() {
    let config = Config { fault_is_fatal: false, ..config() };
    let mut program = Program::with(config, &[UDF]).handler(3, &[]).set(13, 0x1FFF_FFF0);
    assert!(matches!(program.stop(), Stop::Lockup(_)));
}

#[test]
fn a_supervisor_call_with_no_memory_for_its_frame_is_a_hard_fault() {
    let config = Config { fault_is_fatal: false, ..config() };
    let mut program = Program::with(config, &[SVC]).handler(11, &[]).handler(3, &[movs(1, 5)]).set(13, 0x1FFF_FFF0);
    assert!(matches!(program.stop(), Stop::Breakpoint { .. }));
    assert_eq!((program.r(1), program.machine.core.registers.ipsr), (5, 3));
}

#[test]
fn a_return_value_without_meaning_is_refused() {
    let (_, address, why) = fault_of(Program::new(&[SVC]).handler(11, &[0x4720]).set(4, 0xFFFF_FFFB));
    assert_eq!((address, why), (0xFFFF_FFFB, "not an exception return value"));
    let (_, _, why) = fault_of(Program::new(&[SVC]).handler(11, &[0x4720]).set(4, 0xFFFF_FFF1));
    assert_eq!(why, "exception return to the wrong mode");
}

#[test]
fn a_fault_says_where_and_why() {
    let mut program = Program::new(&[ldr(0, 1, 0)]).set(1, 2);
    assert_eq!(program.stop().to_string(), "fault at pc 0x00000100, address 0x00000002, cycle 0: unaligned access");
}

#[test]
fn going_on_after_a_fatal_fault_enters_the_handler() {
    let mut program = Program::new(&[UDF]).handler(3, &[movs(1, 1)]);
    assert!(matches!(program.stop(), Stop::Fault(_)));
    assert!(matches!(program.stop(), Stop::Breakpoint { .. }));
    assert_eq!((program.r(1), program.r(13)), (1, STACK - 32));
}
