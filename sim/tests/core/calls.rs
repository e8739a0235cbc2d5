//! Calling one function of a program from outside.

use sim::elf::LoadError;
use sim::machine::{CallError, Config, Machine, NoDevices, Stop};

use crate::program::{MAIN, Program, STACK};
use crate::thumb::*;

#[test]
fn a_call_gives_the_result_and_counts_exactly() {
    // adds r0, r0, r1; bx lr
    let mut program = Program::new(&[0x1840, BX_LR]);
    let call = program.machine.call(MAIN | 1, &[40, 2]).expect("it returns");
    assert_eq!((call.r0, call.instructions, call.cycles, call.stack_bytes), (42, 2, 1 + 3, 0));
}

#[test]
fn a_call_measures_how_deep_the_stack_went() {
    // push {r4, lr}; sub sp, #24; add sp, #24; pop {r4, pc}
    let mut program = Program::new(&[0xB510, 0xB086, 0xB006, 0xBD10]);
    let call = program.machine.call(MAIN, &[]).expect("it returns");
    assert_eq!((call.stack_bytes, call.instructions), (32, 4));
    assert_eq!(call.cycles, 3 + 1 + 1 + 6);
}

#[test]
fn a_call_leaves_the_registers_and_lets_time_pass() {
    let mut program = Program::new(&[movs(0, 1), BX_LR]).set(0, 77).set(14, 0x123);
    let call = program.machine.call(MAIN, &[]).expect("it returns");
    assert_eq!((program.r(0), program.r(14), program.r(13), program.r(15)), (77, 0x123, STACK, MAIN));
    assert_eq!(program.cycles(), call.cycles);
}

#[test]
fn a_call_that_faults_says_so() {
    let mut program = Program::new(&[UDF]);
    assert!(matches!(program.machine.call(MAIN, &[]), Err(CallError::Stopped(Stop::Fault(_)))));
    let mut program = Program::new(&[b(-2)]);
    program.machine.call_limit = 1000;
    assert_eq!(program.machine.call(MAIN, &[]), Err(CallError::Stopped(Stop::Deadline)));
    assert_eq!(program.machine.call(MAIN, &[0; 5]), Err(CallError::TooManyArguments));
}

#[test]
fn a_file_that_is_no_program_is_refused() {
    let mut machine = Machine::new(Config::default(), NoDevices);
    assert!(matches!(machine.load_elf(b"hello"), Err(LoadError::Unreadable(_))));
}

fn elf(machine: u16, address: u32) -> Vec<u8> {
    let mut file = b"\x7FELF\x01\x01\x01\0\0\0\0\0\0\0\0\0".to_vec();
    for half in [2, machine] {
        file.extend(half.to_le_bytes());
    }
    for word in [1u32, 0, 52, 0, 0] {
        file.extend(word.to_le_bytes());
    }
    for half in [52u16, 32, 1, 40, 0, 0] {
        file.extend(half.to_le_bytes());
    }
    for word in [1u32, 84, address, address, 4, 4, 5, 4] {
        file.extend(word.to_le_bytes());
    }
    file.extend([1, 2, 3, 4]);
    file
}

#[test]
fn a_program_for_another_machine_or_without_room_is_refused() {
    let mut machine = Machine::new(Config::default(), NoDevices);
    assert_eq!(machine.load_elf(&elf(62, 0)), Err(LoadError::WrongMachine { machine: 62 }));
    let refused = machine.load_elf(&elf(40, 0xFFFE));
    assert_eq!(refused, Err(LoadError::OutsideMemory { address: 0xFFFE, bytes: 4 }));
    assert!(machine.load_elf(&elf(40, 0x40)).is_ok());
    assert_eq!(machine.read_word(0x40), Some(0x0403_0201));
}
