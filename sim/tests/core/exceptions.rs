//! Entry, return, who interrupts whom, and sleep.
//!
//! Handlers write their mark to the board's notes: r6 holds the address of the notes, r7 that of the lines.

use sim::core::cycles::{EXCEPTION_ENTRY, EXCEPTION_RETURN, TAIL_CHAIN};
use sim::core::nvic::{FIRST_IRQ, PENDSV, SVCALL};
use sim::machine::Stop;

use crate::board::{LINES, NOTES, NOW};
use crate::program::{MAIN, Program, STACK};
use crate::thumb::*;

const ISPR: u32 = 0xE000_E200;
const ICPR: u32 = 0xE000_E280;
const IPR0: u32 = 0xE000_E400;
const ICSR: u32 = 0xE000_ED04;
const SCR: u32 = 0xE000_ED10;
const SHPR3: u32 = 0xE000_ED20;
const PENDSVSET: u32 = 1 << 28;
const IRQ0: u32 = 16;
const IRQ1: u32 = 17;

fn noting(main: &[u16]) -> Program {
    Program::new(main).set(6, NOTES).set(7, LINES)
}

/// A handler that notes `mark` and lowers all lines.
fn note(mark: u16) -> Vec<u16> {
    vec![movs(0, mark), str(0, 6, 0), movs(0, 0), str(0, 7, 0), BX_LR]
}

#[test]
fn a_supervisor_call_stacks_eight_registers_and_returns_to_the_next_instruction() {
    let handler = [mov(4, 14), mov(5, 13), movs(0, 9), BX_LR];
    let mut program = Program::new(&[SVC, movs(3, 3)]).handler(11, &handler).flags(0b1010);
    for n in [0, 1, 2, 12, 14] {
        program = program.set(n, 0x100 + u32::from(n));
    }
    let program = program.run();
    assert_eq!(program.r(4), 0xFFFF_FFF9);
    let frame = STACK - 32;
    assert_eq!(program.r(5), frame);
    let stacked: Vec<u32> = (0..8).map(|i| program.at(frame + 4 * i)).collect();
    assert_eq!(stacked, [0x100, 0x101, 0x102, 0, 0x10C, 0x10E, MAIN + 2, 0xA100_0000]);
    assert_eq!((program.r(0), program.r(3), program.r(13), program.nzcv()), (0x100, 3, STACK, 0b0010));
}

#[test]
fn a_frame_is_aligned_to_eight_bytes_and_the_padding_is_taken_back() {
    let program = Program::new(&[SVC]).handler(11, &[mov(5, 13), BX_LR]).set(13, STACK - 4).run();
    assert_eq!(program.r(5), STACK - 40);
    assert_eq!(program.at(STACK - 40 + 28) >> 9 & 1, 1);
    assert_eq!(program.r(13), STACK - 4);
}

#[test]
fn an_exception_on_the_process_stack_is_handled_on_the_main_stack() {
    let program = Program::new(&[0xF380, 0x8809, movs(1, 2), 0xF381, 0x8814, SVC, mov(3, 13)])
        .handler(11, &[mov(4, 14), mov(5, 13), BX_LR])
        .set(0, 0x2000_0800)
        .run();
    assert_eq!((program.r(4), program.r(5), program.r(3)), (0xFFFF_FFFD, STACK, 0x2000_0800));
    assert_eq!(program.at(0x2000_0800 - 8), MAIN + 12);
}

#[test]
fn entry_and_return_cost_what_the_module_of_cycles_says() {
    let program = Program::new(&[SVC]).handler(11, &[BX_LR]).run();
    assert_eq!(program.cycles(), 1 + u64::from(EXCEPTION_ENTRY) + 3 + u64::from(EXCEPTION_RETURN) + 1);
}

#[test]
fn a_second_pending_exception_is_entered_without_going_back_to_the_stack() {
    // Both are pended while masked; the handlers follow each other.
    let program = noting(&[CPSID, str(0, 1, 0), CPSIE, NOP])
        .handler(IRQ0, &[ldr(3, 4, 0), str(3, 6, 0), BX_LR])
        .handler(IRQ1, &[ldr(3, 4, 0), str(3, 6, 0), BX_LR])
        .set(0, 3)
        .set(1, ISPR)
        .set(4, NOW)
        .enable(3)
        .run();
    let [first, second] = program.notes() else { panic!("two handlers ran") };
    assert_eq!(second - first, 2 + 2 + 3 + TAIL_CHAIN);
    assert_eq!(program.r(13), STACK);
}

#[test]
fn an_urgent_line_that_rises_during_stacking_goes_first() {
    let program = noting(&[b(-2)])
        .handler(IRQ0, &note(1))
        .handler(IRQ1, &[movs(0, 2), str(0, 6, 0)])
        .set(0, IPR0)
        .enable(3)
        .timetable(&[(100, 2), (108, 3)]);
    let program = program.priority(17, 1).enable(3).run();
    assert_eq!(program.notes(), [1, 2], "the later but more urgent line 0 is handled first");
    assert_eq!(program.machine.core.statistics.of(16).worst_latency, 10);
}

#[test]
fn a_more_urgent_line_interrupts_a_handler_and_an_equal_one_waits() {
    for (priority, order) in [(0x0000_4000, vec![1, 2, 3]), (0x0000_0000, vec![1, 3, 2])] {
        // IRQ1's handler notes 1, raises line 0, and notes 3; IRQ0's notes 2.
        let raise = [movs(0, 1), str(0, 6, 0), str(0, 7, 0), NOP, movs(0, 3), str(0, 6, 0), BX_LR];
        let program = noting(&[str(1, 0, 0), str(3, 2, 0), NOP])
            .handler(IRQ0, &note(2))
            .handler(IRQ1, &raise)
            .set(0, IPR0)
            .set(1, priority)
            .set(2, ISPR)
            .set(3, 2)
            .enable(3)
            .run();
        assert_eq!(program.notes(), order);
    }
}

#[test]
fn a_handler_that_is_interrupted_returns_to_handler_mode() {
    let program = noting(&[SVC])
        .handler(11, &[mov(4, 14), str(3, 2, 0), NOP, mov(5, 4), 0x4720])
        .handler(IRQ0, &[mov(0, 14), str(0, 6, 0), BX_LR])
        .set(2, ISPR)
        .set(3, 1)
        .enable(1);
    let program = program.priority(11, 3).enable(1).run();
    assert_eq!(program.notes(), [0xFFFF_FFF1]);
    assert_eq!((program.r(5), program.r(13)), (0xFFFF_FFF9, STACK));
}

#[test]
fn among_equals_the_lowest_number_goes_first() {
    let program = noting(&[CPSID, str(0, 1, 0), str(2, 3, 0), CPSIE, NOP])
        .handler(14, &note(14))
        .handler(IRQ0, &note(16))
        .handler(IRQ1, &note(17))
        .set(0, 3)
        .set(1, ISPR)
        .set(2, PENDSVSET)
        .set(3, ICSR)
        .enable(3)
        .run();
    assert_eq!(program.notes(), [14, 16, 17]);
}

#[test]
fn pendsv_waits_for_its_priority() {
    let program = noting(&[str(4, 5, 0), CPSID, str(0, 1, 0), str(2, 3, 0), CPSIE, NOP])
        .handler(14, &note(14))
        .handler(IRQ0, &note(16))
        .set(0, 1)
        .set(1, ISPR)
        .set(2, PENDSVSET)
        .set(3, ICSR)
        .set(4, 0xC0 << 16)
        .set(5, SHPR3)
        .enable(1)
        .run();
    assert_eq!(program.notes(), [16, 14]);
}

#[test]
fn a_masked_interrupt_waits_for_the_mask() {
    let program = noting(&[CPSID, str(0, 7, 0), str(5, 6, 0), CPSIE, NOP])
        .handler(IRQ0, &note(1))
        .set(0, 1)
        .set(5, 9)
        .enable(1)
        .run();
    assert_eq!(program.notes(), [9, 1]);
}

#[test]
fn a_disabled_line_pends_until_it_is_enabled() {
    let program = noting(&[str(0, 7, 0), movs(1, 0), str(1, 7, 0), str(5, 6, 0), str(0, 2, 0), NOP])
        .handler(IRQ0, &note(1))
        .set(0, 1)
        .set(2, 0xE000_E100)
        .set(5, 9)
        .run();
    assert_eq!(program.notes(), [9, 1]);
}

#[test]
fn a_line_that_stays_high_pends_again_when_its_handler_returns() {
    // The handler counts in r5, keeps it over the frame, and lowers the line the third time.
    let handler = [adds(5, 1), 0x2D03, 0xD101, movs(0, 0), str(0, 7, 0), BX_LR];
    let program = noting(&[str(0, 7, 0), NOP]).handler(IRQ0, &handler).set(0, 1).enable(1).run();
    assert_eq!(program.r(5), 3);
}

#[test]
fn a_pending_bit_cannot_be_cleared_while_its_line_is_high() {
    let program =
        noting(&[str(0, 7, 0), str(0, 1, 0), ldr(2, 1, 0), movs(3, 0), str(3, 7, 0), str(0, 1, 0), ldr(4, 1, 0)])
            .set(0, 1)
            .set(1, ICPR)
            .run();
    assert_eq!((program.r(2), program.r(4)), (1, 0));
}

#[test]
fn a_short_pulse_is_not_lost() {
    let program =
        noting(&[b(-2)]).handler(IRQ0, &[movs(0, 1), str(0, 6, 0)]).enable(1).timetable(&[(200, 1), (201, 0)]).run();
    assert_eq!(program.notes(), [1]);
}

#[test]
fn sleep_ends_with_an_interrupt_and_goes_on_after_its_handler() {
    let program = noting(&[WFI, str(5, 6, 0)]).handler(IRQ0, &note(1)).set(5, 2).enable(1).timetable(&[(900, 1)]).run();
    assert_eq!(program.notes(), [1, 2]);
    assert_eq!(program.machine.sleep_cycles(), 898);
}

#[test]
fn sleep_ends_with_a_masked_interrupt_that_stays_pending() {
    let program = noting(&[CPSID, WFI, str(5, 6, 0), CPSIE, NOP])
        .handler(IRQ0, &note(1))
        .set(5, 2)
        .enable(1)
        .timetable(&[(900, 1)])
        .run();
    assert_eq!(program.notes(), [2, 1]);
}

#[test]
fn sleep_does_not_end_with_a_disabled_interrupt() {
    let mut program = noting(&[WFI]).timetable(&[(900, 1)]);
    assert_eq!(program.stop(), Stop::Deadline);
    assert!(program.machine.core.is_asleep());
    assert_eq!(program.machine.run_until(u64::MAX), Stop::Asleep);
}

#[test]
fn sleep_with_an_interrupt_already_pending_ends_at_once() {
    let program = noting(&[CPSID, str(0, 7, 0), WFI]).set(0, 1).enable(1).run();
    assert_eq!(program.machine.sleep_cycles(), 0);
}

#[test]
fn sleep_on_exit_goes_back_to_sleep_instead_of_the_program() {
    let mut program = noting(&[str(0, 1, 0), WFI, str(5, 6, 0)])
        .handler(IRQ0, &note(1))
        .set(0, 2)
        .set(1, SCR)
        .enable(1)
        .timetable(&[(500, 1), (900, 1)]);
    assert_eq!(program.stop(), Stop::Deadline);
    assert_eq!(program.notes(), [1, 1]);
    assert!(program.machine.core.is_asleep());
}

#[test]
fn wait_for_event_passes_once_after_an_event_and_then_sleeps() {
    let mut program = noting(&[SEV, WFE, str(5, 6, 0), WFE, str(5, 6, 0)]).set(5, 1);
    assert_eq!(program.stop(), Stop::Deadline);
    assert_eq!(program.notes(), [1]);
}

#[test]
fn wait_for_event_ends_when_a_disabled_interrupt_pends_if_so_configured() {
    let program =
        noting(&[str(0, 1, 0), WFE, str(5, 6, 0)]).set(0, 0x10).set(1, SCR).set(5, 1).timetable(&[(700, 1)]).run();
    assert_eq!(program.notes(), [1]);
    assert!(program.cycles() > 700);
}

#[test]
fn a_handler_sees_its_own_number() {
    let program = Program::new(&[SVC]).handler(11, &[0xF3EF, 0x8405, BX_LR]).run();
    assert_eq!(program.r(4), u32::from(SVCALL));
    assert_eq!(program.machine.core.registers.ipsr, 0);
}

#[test]
fn statistics_tell_how_often_how_late_and_how_long() {
    let program =
        noting(&[CPSID, str(0, 7, 0), NOP, NOP, CPSIE, NOP]).handler(IRQ0, &note(1)).set(0, 1).enable(1).run();
    let record = program.machine.core.statistics.of(FIRST_IRQ);
    assert_eq!(record.count, 1);
    assert_eq!(record.worst_own_cycles, 1 + 2 + 1 + 2 + 3);
    assert_eq!(record.worst_latency, u64::from(EXCEPTION_ENTRY) + 1 + 1 + 1);
    assert_eq!(program.machine.core.statistics.of(PENDSV).count, 0);
}

#[test]
fn own_cycles_do_not_count_what_preempted_them() {
    let long = [str(3, 2, 0), NOP, BX_LR];
    let program = noting(&[SVC]).handler(11, &long).handler(IRQ0, &note(1)).set(2, ISPR).set(3, 1);
    let program = program.priority(11, 3).enable(1).run();
    assert_eq!(program.notes(), [1]);
    assert_eq!(program.machine.core.statistics.of(SVCALL).worst_own_cycles, 2 + 1 + 3);
}
