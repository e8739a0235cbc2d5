//! The system timer.

use crate::board::NOTES;
use crate::program::Program;
use crate::thumb::*;

const CSR: u32 = 0xE000_E010;

/// r0: the timer; r1: the reload value; r2: the control value.
fn timer(reload: u32, control: u32, then: &[u16]) -> Program {
    let start = [str(1, 0, 4), str(1, 0, 8), str(2, 0, 0)];
    Program::new(&[&start[..], then].concat()).set(0, CSR).set(1, reload).set(2, control).set(6, NOTES)
}

#[test]
fn the_counter_goes_down_once_a_cycle_and_starts_again() {
    let program = timer(9, 1, &[ldr(3, 0, 8), NOP, ldr(4, 0, 8), NOP, NOP, NOP, NOP, ldr(5, 0, 8)]).run();
    assert_eq!((program.r(3), program.r(4), program.r(5)), (8, 5, 9));
}

#[test]
fn the_flag_is_set_at_zero_and_cleared_by_reading() {
    let program = timer(3, 1, &[NOP, NOP, NOP, NOP, ldr(3, 0, 0), 0xF3BF, 0x8F4F]).run();
    assert_eq!(program.r(3), 0x0001_0005);
    let program = timer(100, 1, &[ldr(3, 0, 0)]).run();
    assert_eq!(program.r(3), 5);
}

#[test]
fn the_interrupt_comes_every_reload_plus_one_cycles() {
    let mut program = timer(999, 3, &[WFI, b(-3)]).handler(15, &[adds(5, 1), BX_LR]);
    program.machine.run_until(1_000_010);
    let pended = program.machine.core.statistics.of(15);
    assert_eq!(pended.count, 1000);
    assert_eq!(pended.worst_latency, 16);
}

#[test]
fn a_write_to_the_counter_clears_it_and_the_flag() {
    let program = timer(3, 1, &[NOP, NOP, NOP, NOP, str(1, 0, 8), ldr(3, 0, 0)]).run();
    assert_eq!(program.r(3) >> 16, 0);
}

#[test]
fn a_stopped_timer_keeps_its_value() {
    let program = timer(50, 1, &[movs(3, 0), str(3, 0, 0), ldr(4, 0, 8), NOP, NOP, ldr(5, 0, 8)]).run();
    assert_eq!(program.r(4), program.r(5));
    assert!(program.r(4) > 40);
}

#[test]
fn there_is_no_reference_clock() {
    assert_eq!(timer(1, 0, &[ldr(3, 0, 12)]).run().r(3) >> 31, 1);
}
