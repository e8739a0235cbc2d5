//! Cycles, counted by hand from the manual's table.

use sim::core::cycles::{Multiplier, Timing};
use sim::machine::Config;

use crate::board::NOW;
use crate::program::{MAIN, Program, config};
use crate::thumb::*;

const DATA: u32 = 0x2000_0100;

/// The cycles of a program that runs straight into its breakpoint.
fn cost(code: &[u16]) -> u64 {
    Program::new(code).set(0, DATA).set(1, DATA).set(7, (MAIN + 2 * code.len() as u32) | 1).run().cycles() - 1
}

#[test]
fn every_instruction_costs_what_the_manual_says() {
    for (code, cycles, name) in [
        (&[movs(2, 1)][..], 1, "movs"),
        (&[0x4351], 1, "muls"),
        (&[ldr(2, 0, 0)], 2, "ldr"),
        (&[str(2, 0, 0)], 2, "str"),
        (&[0x7802], 2, "ldrb"),
        (&[0xC83C], 5, "ldm of four"),
        (&[0xC03C], 5, "stm of four"),
        (&[0xB43C], 5, "push of four"),
        (&[0xB43C, 0xBC3C], 10, "push and pop of four"),
        (&[b(-1)], 3, "b"),
        (&[0xF000, 0xF800], 4, "bl"),
        (&[0x4738], 3, "bx"),
        (&[0x47B8], 3, "blx"),
        (&[mov(15, 7)], 3, "mov to pc"),
        (&[0xF3EF, 0x8200], 4, "mrs"),
        (&[0xF382, 0x8800], 4, "msr"),
        (&[0xF3BF, 0x8F4F], 4, "dsb"),
        (&[0xF3BF, 0x8F5F], 4, "dmb"),
        (&[0xF3BF, 0x8F6F], 4, "isb"),
        (&[CPSID], 1, "cps"),
        (&[NOP], 1, "nop"),
        (&[SEV], 1, "sev"),
        (&[SEV, WFE], 3, "sev and wfe"),
        (&[0xB480, 0xBD00], 2 + 5, "push and pop of pc"),
    ] {
        assert_eq!(cost(code), cycles, "{name}");
    }
}

#[test]
fn a_conditional_branch_costs_three_cycles_only_if_taken() {
    assert_eq!(Program::new(&[0xD0FF]).flags(0b0100).run().cycles() - 1, 3);
    assert_eq!(Program::new(&[0xD0FF]).flags(0).run().cycles() - 1, 1);
}

#[test]
fn a_small_multiplier_takes_32_cycles() {
    let config = Config { timing: Timing::CortexM0(Multiplier::Small), ..config() };
    assert_eq!(Program::with(config, &[0x4351]).run().cycles() - 1, 32);
}

#[test]
fn a_loop_of_2000_rounds_is_6003_instructions_and_10001_cycles() {
    // ldr r0, =2000; movs r1, #0; loop: adds r1, r1, #1; subs r0, r0, #1; bne loop
    let program =
        Program::new(&[ldr_literal(0, 3), movs(1, 0), adds(1, 1), subs(0, 1), 0xD1FC]).data(&[(MAIN + 16, 2000)]).run();
    assert_eq!(program.r(1), 2000);
    assert_eq!(program.machine.instructions(), 2 + 3 * 2000 + 1);
    assert_eq!(program.cycles(), 2 + 1 + 2000 * (1 + 1) + 1999 * 3 + 1 + 1);
}

#[test]
fn an_interrupt_is_handled_sixteen_cycles_after_its_line_rises() {
    let program =
        Program::new(&[b(-2)]).handler(16, &[ldr(1, 0, 0)]).set(0, NOW).enable(1).timetable(&[(300, 1)]).run();
    let awake_by = 2;
    assert!((300 + 16..=300 + 16 + awake_by).contains(&(u64::from(program.r(1)) - 1)), "{}", program.r(1));
    assert!(program.machine.core.statistics.of(16).worst_latency <= 18);
}

#[test]
fn an_interrupt_wakes_a_sleeping_core_in_exactly_sixteen_cycles() {
    let program =
        Program::new(&[WFI, NOP]).handler(16, &[ldr(1, 0, 0)]).set(0, NOW).enable(1).timetable(&[(5000, 1)]).run();
    assert_eq!(program.r(1), 5000 + 16 + 1);
    assert_eq!(program.machine.sleep_cycles(), 5000 - 2);
}

#[test]
fn uniform_timing_counts_instructions() {
    let config = Config { timing: Timing::Uniform, ..config() };
    let program = Program::with(config, &[0xB43C, 0xBC3C, WFI, b(-1)])
        .handler(16, &[0xB500])
        .enable(1)
        .timetable(&[(100, 1)])
        .run();
    assert_eq!(program.cycles(), program.machine.instructions() + program.machine.sleep_cycles());
}
