//! The console of test programs.

use sim::machine::{Config, Stop};

use crate::program::{Program, config};

const BLOCK: u32 = 0x2000_0200;
const TEXT: u32 = 0x2000_0300;
const ASK: u16 = 0xBEAB;

fn asking(operation: u32, parameter: u32) -> Program {
    let config = Config { semihosting: true, ..config() };
    Program::with(config, &[ASK]).set(0, operation).set(1, parameter).data(&[(TEXT, u32::from_le_bytes(*b":tt\0"))])
}

#[test]
fn the_console_opens_for_reading_writing_and_errors() {
    for (mode, handle) in [(0, 1), (4, 2), (8, 3)] {
        let block = [(BLOCK, TEXT), (BLOCK + 4, mode), (BLOCK + 8, 3)];
        assert_eq!(asking(1, BLOCK).data(&block).run().r(0), handle);
    }
}

#[test]
fn a_file_does_not_open() {
    let block = [(BLOCK, TEXT + 1), (BLOCK + 4, 0), (BLOCK + 8, 2)];
    assert_eq!(asking(1, BLOCK).data(&block).run().r(0), u32::MAX);
}

#[test]
fn output_and_errors_are_kept_apart() {
    for handle in [2, 3] {
        let block = [(BLOCK, handle), (BLOCK + 4, TEXT), (BLOCK + 8, 3)];
        let program = asking(5, BLOCK).data(&block).run();
        assert_eq!(program.r(0), 0);
        let console = &program.machine.semihosting;
        let (written, other) =
            if handle == 2 { (&console.output, &console.errors) } else { (&console.errors, &console.output) };
        assert_eq!((written.as_slice(), other.len()), (&b":tt"[..], 0));
    }
}

#[test]
fn characters_and_strings_are_output() {
    assert_eq!(asking(3, TEXT + 1).run().machine.semihosting.output, b"t");
    assert_eq!(asking(4, TEXT).run().machine.semihosting.output, b":tt");
}

#[test]
fn a_program_can_end_itself_with_and_without_a_code() {
    assert_eq!(asking(0x18, 0x2_0026).stop(), Stop::Exit(0));
    assert_eq!(asking(0x18, 0x2_0023).stop(), Stop::Exit(1));
    assert_eq!(asking(0x20, BLOCK).data(&[(BLOCK, 0x2_0026), (BLOCK + 4, 42)]).stop(), Stop::Exit(42));
}

#[test]
fn the_clock_counts_hundredths_of_a_second() {
    let mut program = asking(0x10, 0);
    program.machine.core.cycles = 123 * 100_000 + 50_000;
    program.machine.run_until(u64::MAX);
    assert_eq!(program.r(0), 123);
}

#[test]
fn an_operation_nobody_knows_and_a_block_outside_memory_answer_minus_one() {
    assert_eq!(asking(0x77, 0).run().r(0), u32::MAX);
    assert_eq!(asking(5, 0x9000_0000).run().r(0), u32::MAX);
}

#[test]
fn without_semihosting_the_instruction_is_a_breakpoint() {
    let mut program = Program::new(&[ASK]);
    assert!(matches!(program.stop(), Stop::Breakpoint { immediate: 0xAB, .. }));
}
