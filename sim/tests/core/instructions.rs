//! What every group of instructions does apart from flags.

use crate::program::{MAIN, Program, STACK};
use crate::thumb::*;

const DATA: u32 = 0x2000_0100;

#[test]
fn a_literal_is_counted_from_the_aligned_program_counter() {
    let at_even = Program::new(&[ldr_literal(0, 1)]).data(&[(MAIN + 8, 0x1234_5678)]).run();
    assert_eq!(at_even.r(0), 0x1234_5678);
    let at_odd = Program::new(&[NOP, ldr_literal(0, 1)]).data(&[(MAIN + 8, 0x8765_4321)]).run();
    assert_eq!(at_odd.r(0), 0x8765_4321);
}

#[test]
fn an_address_is_formed_from_the_aligned_program_counter() {
    assert_eq!(Program::new(&[NOP, 0xA002]).run().r(0), MAIN + 4 + 8);
}

#[test]
fn reading_the_program_counter_gives_the_instruction_plus_four() {
    assert_eq!(Program::new(&[NOP, mov(0, 15)]).run().r(0), MAIN + 6);
    assert_eq!(Program::new(&[0x4478]).set(0, 1).run().r(0), MAIN + 5);
}

#[test]
fn narrow_loads_extend_with_zeros_or_with_the_sign() {
    let load = |code: u16| Program::new(&[code]).data(&[(DATA, 0x8081_8283)]).set(1, DATA).run().r(0);
    assert_eq!(load(0x5688), 0xFFFF_FF83, "ldrsb r0, [r1, r2]");
    assert_eq!(load(0x5E88), 0xFFFF_8283, "ldrsh");
    assert_eq!(load(0x5C88), 0x83, "ldrb");
    assert_eq!(load(0x5A88), 0x8283, "ldrh");
    assert_eq!(load(0x5888), 0x8081_8283, "ldr");
    assert_eq!(load(0x78C8), 0x80, "ldrb #3");
    assert_eq!(load(0x8848), 0x8081, "ldrh #2");
}

#[test]
fn narrow_stores_leave_the_other_bytes() {
    let store =
        |code: u16| Program::new(&[code]).data(&[(DATA, 0x1111_1111)]).set(0, 0xAABB_CCDD).set(1, DATA).run().at(DATA);
    assert_eq!(store(0x5488), 0x1111_11DD, "strb r0, [r1, r2]");
    assert_eq!(store(0x5288), 0x1111_CCDD, "strh");
    assert_eq!(store(0x5088), 0xAABB_CCDD, "str");
    assert_eq!(store(0x7088), 0x11DD_1111, "strb #2");
    assert_eq!(store(0x8048), 0xCCDD_1111, "strh #2");
}

#[test]
fn the_stack_pointer_addresses_words() {
    let program = Program::new(&[0x9001, 0x9901, 0xAA02]).set(0, 77).run();
    assert_eq!((program.r(1), program.r(2)), (77, STACK + 8));
}

#[test]
fn the_stack_pointer_moves_by_words_and_drops_the_lowest_bits() {
    assert_eq!(Program::new(&[0xB083]).run().r(13), STACK - 12);
    assert_eq!(Program::new(&[0xB003]).run().r(13), STACK + 12);
    assert_eq!(Program::new(&[0x4485]).set(0, 7).run().r(13), STACK + 4);
    assert_eq!(Program::new(&[mov(13, 0)]).set(0, DATA + 3).run().r(13), DATA);
}

#[test]
fn push_and_pop_keep_the_lowest_register_at_the_lowest_address() {
    let program = Program::new(&[0xB507, 0xBC38]).set(0, 10).set(1, 11).set(2, 12).set(14, 99).run();
    assert_eq!([3, 4, 5, 13].map(|n| program.r(n)), [10, 11, 12, STACK - 4]);
    assert_eq!(program.at(STACK - 4), 99);
}

#[test]
fn pop_into_the_program_counter_branches() {
    let program = Program::new(&[0xB401, 0xBD00, movs(1, 1), movs(2, 2)]).set(0, MAIN + 7).run();
    assert_eq!((program.r(1), program.r(2), program.r(13)), (0, 2, STACK));
}

#[test]
fn a_multiple_load_writes_its_base_back_unless_it_loads_it() {
    let words = [(DATA, 1), (DATA + 4, 2), (DATA + 8, 3)];
    let program = Program::new(&[0xC90D]).data(&words).set(1, DATA).run();
    assert_eq!([0, 2, 3, 1].map(|n| program.r(n)), [1, 2, 3, DATA + 12]);
    let program = Program::new(&[0xC907]).data(&words).set(1, DATA).run();
    assert_eq!([0, 1, 2].map(|n| program.r(n)), [1, 2, 3]);
}

#[test]
fn a_multiple_store_keeps_its_old_base_when_that_is_the_lowest() {
    let program = Program::new(&[0xC007]).set(0, DATA).set(1, 5).set(2, 6).run();
    assert_eq!([0, 4, 8].map(|offset| program.at(DATA + offset)), [DATA, 5, 6]);
    assert_eq!(program.r(0), DATA + 12);
}

#[test]
fn extension_and_byte_reversal_work_on_their_part_of_the_word() {
    let one = |code: u16| Program::new(&[code]).set(1, 0x1234_89AB).run().r(0);
    assert_eq!(one(0xB208), 0xFFFF_89AB, "sxth");
    assert_eq!(one(0xB248), 0xFFFF_FFAB, "sxtb");
    assert_eq!(one(0xB288), 0x89AB, "uxth");
    assert_eq!(one(0xB2C8), 0xAB, "uxtb");
    assert_eq!(one(0xBA08), 0xAB89_3412, "rev");
    assert_eq!(one(0xBA48), 0x3412_AB89, "rev16");
    assert_eq!(one(0xBAC8), 0xFFFF_AB89, "revsh");
}

#[test]
fn high_registers_move_add_and_compare() {
    let program = Program::new(&[mov(8, 0), 0x4480, mov(1, 8), 0x4580]).set(0, 21).run();
    assert_eq!((program.r(8), program.r(1), program.nzcv()), (42, 42, 0b0010));
}

#[test]
fn branches_reach_both_ways_and_calls_remember_where_they_were() {
    let program = Program::new(&[b(1), BKPT, BKPT, movs(0, 1), b(-5)]).run();
    assert_eq!((program.r(0), program.r(15)), (1, MAIN + 4));
    let program = Program::new(&[0xF000, 0xF801, BKPT, movs(0, 2), BX_LR]).run();
    assert_eq!((program.r(0), program.r(14), program.r(15)), (2, MAIN + 5, MAIN + 6));
    let program = Program::new(&[0x4780, BKPT, movs(1, 3), BX_LR]).set(0, MAIN + 5).run();
    assert_eq!((program.r(1), program.r(14)), (3, MAIN + 3));
}

#[test]
fn a_far_call_uses_all_bits_of_its_offset() {
    let mut program = Program::new(&[0xF00F, 0xFEFE]);
    program.code(MAIN + 4 + 0xFDFC, &[]);
    program.stop();
    assert_eq!(program.r(15), MAIN + 4 + 0xFDFC + 2);
    let mut program = Program::new(&[]);
    program.code(0x8000, &[0xF7F8, 0xF87E]);
    program = program.set(15, 0x8000);
    program.stop();
    assert_eq!(program.r(15), MAIN + 2);
}

#[test]
fn writing_the_program_counter_ignores_the_thumb_bit() {
    let program = Program::new(&[mov(15, 0), movs(1, 1), movs(2, 2)]).set(0, MAIN + 4).run();
    assert_eq!((program.r(1), program.r(2)), (0, 2));
    let program = Program::new(&[0x4487, movs(1, 1), movs(2, 2)]).set(0, 0).run();
    assert_eq!((program.r(1), program.r(2)), (0, 2));
}

#[test]
fn special_registers_read_back_what_can_be_written() {
    let program = Program::new(&[0xF380, 0x8809, 0xF3EF, 0x8109]).set(0, DATA + 2).run();
    assert_eq!(program.r(1), DATA, "PSP without its lowest bits");
    let program = Program::new(&[0xF380, 0x8810, 0xF3EF, 0x8110]).set(0, 3).run();
    assert_eq!(program.r(1), 1, "PRIMASK");
    let program = Program::new(&[0xF380, 0x8809, 0xF381, 0x8814, 0xF3EF, 0x8214]).set(0, DATA).set(1, 3).run();
    assert_eq!((program.r(2), program.r(13)), (2, DATA), "CONTROL selects the process stack");
    assert_eq!(program.machine.core.registers.msp(), STACK);
}

#[test]
fn barriers_and_hints_do_nothing() {
    let before = Program::new(&[]).run();
    let after = Program::new(&[0xF3BF, 0x8F4F, 0xF3BF, 0x8F5F, 0xF3BF, 0x8F6F, NOP, 0xBF10, SEV]).run();
    assert_eq!((0..15).map(|n| before.r(n)).collect::<Vec<_>>(), (0..15).map(|n| after.r(n)).collect::<Vec<_>>());
}

#[test]
fn code_that_is_written_over_runs_as_written() {
    let patched = Program::new(&[0x8001, movs(2, 1), movs(2, 7)]).set(0, MAIN + 2).set(1, u32::from(movs(3, 9)));
    let patched = patched.run();
    assert_eq!((patched.r(2), patched.r(3)), (7, 9));
    let again = Program::new(&[movs(2, 1), 0x8001, 0x3401, 0x2C02, 0xD1FA]).set(0, MAIN).set(1, u32::from(adds(2, 41)));
    assert_eq!(again.run().r(2), 42);
}

#[test]
fn code_in_data_ram_runs() {
    let mut program = Program::new(&[0x4700]).set(0, DATA + 1);
    program.code(DATA, &[movs(1, 5), 0xF000, 0xF801, BKPT, movs(2, 6)]);
    let program = program.run();
    assert_eq!((program.r(1), program.r(2)), (5, 6));
}
