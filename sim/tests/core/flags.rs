//! Results and flags at their edges.

use crate::program::Program;

const N: u32 = 8;
const Z: u32 = 4;
const C: u32 = 2;
const V: u32 = 1;

/// Runs one instruction with r0 as destination or first operand and r1 as the other.
fn one(code: u16, r0: u32, r1: u32, flags: u32) -> (u32, u32) {
    let program = Program::new(&[code]).set(0, r0).set(1, r1).flags(flags).run();
    (program.r(0), program.nzcv())
}

const ADDS: u16 = 0x1840; // adds r0, r0, r1
const SUBS: u16 = 0x1A40;
const ADCS: u16 = 0x4148;
const SBCS: u16 = 0x4188;
const RSBS: u16 = 0x4248; // rsbs r0, r1, #0
const CMP: u16 = 0x4288;
const CMN: u16 = 0x42C8;
const LSLS: u16 = 0x4088;
const LSRS: u16 = 0x40C8;
const ASRS: u16 = 0x4108;
const RORS: u16 = 0x41C8;
const TST: u16 = 0x4208;
const MULS: u16 = 0x4348;
const MIN: u32 = 0x8000_0000;
const MAX: u32 = 0x7FFF_FFFF;

#[test]
fn an_addition_carries_out_of_the_top_and_overflows_into_the_sign() {
    assert_eq!(one(ADDS, u32::MAX, 1, 0), (0, Z | C));
    assert_eq!(one(ADDS, MAX, 1, 0), (MIN, N | V));
    assert_eq!(one(ADDS, MIN, MIN, 0), (0, Z | C | V));
    assert_eq!(one(ADDS, 1, 2, N | Z | C | V), (3, 0));
}

#[test]
fn a_subtraction_sets_carry_when_it_does_not_borrow() {
    assert_eq!(one(SUBS, 5, 5, 0), (0, Z | C));
    assert_eq!(one(SUBS, 4, 5, 0), (u32::MAX, N));
    assert_eq!(one(SUBS, MIN, 1, 0), (MAX, C | V));
    assert_eq!(one(SUBS, MAX, u32::MAX, 0), (MIN, N | V));
}

#[test]
fn add_with_carry_counts_the_carry_even_when_the_operands_alone_do_not_overflow() {
    assert_eq!(one(ADCS, u32::MAX, 0, C), (0, Z | C));
    assert_eq!(one(ADCS, MAX, 0, C), (MIN, N | V));
    assert_eq!(one(ADCS, u32::MAX, u32::MAX, C), (u32::MAX, N | C));
    assert_eq!(one(ADCS, 1, 1, 0), (2, 0));
}

#[test]
fn subtract_with_carry_borrows_one_more_when_carry_is_clear() {
    assert_eq!(one(SBCS, 5, 5, C), (0, Z | C));
    assert_eq!(one(SBCS, 5, 5, 0), (u32::MAX, N));
    assert_eq!(one(SBCS, 0, u32::MAX, 0), (0, Z));
    assert_eq!(one(SBCS, MIN, 0, 0), (MAX, C | V));
}

#[test]
fn a_negation_overflows_only_for_the_lowest_number() {
    assert_eq!(one(RSBS, 9, 0, 0), (0, Z | C));
    assert_eq!(one(RSBS, 9, 1, 0), (u32::MAX, N));
    assert_eq!(one(RSBS, 9, MIN, 0), (MIN, N | V));
}

#[test]
fn a_comparison_changes_flags_and_nothing_else() {
    assert_eq!(one(CMP, 3, 4, 0), (3, N));
    assert_eq!(one(CMP, MIN, MAX, 0), (MIN, C | V));
    assert_eq!(one(CMN, u32::MAX, 1, 0), (u32::MAX, Z | C));
    assert_eq!(one(TST, MIN, MIN, C | V), (MIN, N | C | V));
    assert_eq!(one(0x2805, 5, 0, 0), (5, Z | C));
}

#[test]
fn a_shift_left_by_register_gives_the_last_bit_out_and_nothing_beyond_32() {
    assert_eq!(one(LSLS, 3, 31, 0), (MIN, N | C));
    assert_eq!(one(LSLS, 3, 32, 0), (0, Z | C));
    assert_eq!(one(LSLS, 3, 33, C), (0, Z));
    assert_eq!(one(LSLS, 3, 255, C), (0, Z));
    assert_eq!(one(LSLS, MIN, 256, C | V), (MIN, N | C | V));
}

#[test]
fn a_shift_right_by_register_gives_the_last_bit_out_and_nothing_beyond_32() {
    assert_eq!(one(LSRS, MIN, 31, 0), (1, 0));
    assert_eq!(one(LSRS, MIN, 32, 0), (0, Z | C));
    assert_eq!(one(LSRS, MIN, 33, C), (0, Z));
    assert_eq!(one(LSRS, 6, 2, 0), (1, C));
}

#[test]
fn an_arithmetic_shift_beyond_31_leaves_the_sign_everywhere() {
    assert_eq!(one(ASRS, MIN, 31, 0), (u32::MAX, N));
    assert_eq!(one(ASRS, MIN, 32, 0), (u32::MAX, N | C));
    assert_eq!(one(ASRS, MIN, 200, 0), (u32::MAX, N | C));
    assert_eq!(one(ASRS, MAX, 40, C), (0, Z));
}

#[test]
fn a_rotation_by_a_multiple_of_32_moves_nothing_but_sets_carry_from_the_sign() {
    assert_eq!(one(RORS, 1, 1, 0), (MIN, N | C));
    assert_eq!(one(RORS, MIN, 32, 0), (MIN, N | C));
    assert_eq!(one(RORS, 1, 64, C), (1, 0));
    assert_eq!(one(RORS, 1, 0, C), (1, C));
}

#[test]
fn a_shift_by_a_constant_of_zero_means_32_to_the_right_and_none_to_the_left() {
    assert_eq!(one(0x0008, 9, MIN, C), (MIN, N | C));
    assert_eq!(one(0x0808, 9, MIN, 0), (0, Z | C));
    assert_eq!(one(0x1008, 9, MIN, 0), (u32::MAX, N | C));
    assert_eq!(one(0x0048, 9, MIN, 0), (0, Z | C));
    assert_eq!(one(0x0848, 9, 3, 0), (1, C));
    assert_eq!(one(0x1048, 9, u32::MAX - 1, C), (u32::MAX, N));
}

#[test]
fn a_product_keeps_the_low_word_and_leaves_carry_and_overflow() {
    assert_eq!(one(MULS, 0x1_0001, 0x1_0001, C | V), (0x2_0001, C | V));
    assert_eq!(one(MULS, MIN, 2, 0), (0, Z));
    assert_eq!(one(MULS, MIN, 3, 0), (MIN, N));
}

#[test]
fn logic_sets_sign_and_zero_and_leaves_carry_and_overflow() {
    assert_eq!(one(0x4008, 0xF0, 0x0F, C | V), (0, Z | C | V));
    assert_eq!(one(0x4048, MIN, 1, 0), (MIN | 1, N));
    assert_eq!(one(0x4308, 0, 0, C), (0, Z | C));
    assert_eq!(one(0x4388, 0xFF, 0x0F, V), (0xF0, V));
    assert_eq!(one(0x43C8, 0, 0, 0), (u32::MAX, N));
}

#[test]
fn every_condition_agrees_with_its_definition_for_every_flag_combination() {
    for flags in 0..16 {
        let (n, z, c, v) = (flags & N != 0, flags & Z != 0, flags & C != 0, flags & V != 0);
        let expected = [z, !z, c, !c, n, !n, v, !v, c && !z, !c || z, n == v, n != v, !z && n == v, z || n != v];
        for (condition, expected) in (0..).zip(expected) {
            let taken = Program::new(&[0xD000 | condition << 8, 0x2001]).flags(flags).run().r(0) == 0;
            assert_eq!(taken, expected, "condition {condition}, flags {flags:04b}");
        }
    }
}

#[test]
fn the_flags_can_be_written_and_read_in_combinations_no_result_has() {
    let program = Program::new(&[0xF380, 0x8800, 0xF3EF, 0x8100]).set(0, 0xF000_0000).run();
    assert_eq!((program.nzcv(), program.r(1)), (N | Z | C | V, 0xF000_0000));
}
