//! Bits to blocks: what a station says is heard whole, or not at all.
#![cfg_attr(target_os = "none", no_std, no_main)]

#[cfg(target_os = "none")]
mod harness;

use lighthouse_mote::ootx::{
    BLOCK_BYTES, Block, Config, FRAME_BITS, Flaw, Half, Outcome, PREAMBLE_ZEROS, State, gap, step,
};
use lighthouse_mote::sweep::{Axis, Station};

/// Every frame is read.
const CONFIG: Config = Config { rest_bits: 0, ids: [None, None] };

/// Bytes that no two places share.
const BLOCK: Block = {
    let mut bytes = [0; BLOCK_BYTES];
    let mut at = 0;
    while at < BLOCK_BYTES {
        bytes[at] = (at as u8).wrapping_mul(37) ^ 0x5a;
        at += 1;
    }
    Block::new(bytes)
};

/// What follows the preamble, byte by byte: length, block, padding, CRC.
fn sent(block: &Block) -> [u8; 40] {
    let mut crc = !0u32;
    for byte in block.bytes() {
        crc ^= u32::from(*byte);
        for _ in 0..8 {
            crc = if crc & 1 == 1 { crc >> 1 ^ 0xedb8_8320 } else { crc >> 1 };
        }
    }
    let mut bytes = [0; 40];
    bytes[0] = BLOCK_BYTES as u8;
    bytes[2..35].copy_from_slice(block.bytes());
    bytes[36..].copy_from_slice(&(!crc).to_le_bytes());
    bytes
}

/// Bit `at` of a frame around `bytes`.
fn bit(bytes: &[u8; 40], at: u16) -> bool {
    match at.checked_sub(u16::from(PREAMBLE_ZEROS) + 1) {
        None => at == u16::from(PREAMBLE_ZEROS),
        Some(at) => match (at / 17, at % 17) {
            (_, 16) => true,
            (word, bit) => bytes[usize::from(2 * word + bit / 8)] >> (7 - bit % 8) & 1 == 1,
        },
    }
}

/// The padding of the block: bits 8 to 15 of its last word.
const PADDING: core::ops::Range<u16> = 18 + 17 * 17 + 8..18 + 17 * 17 + 16;

/// Hears one frame and gives the last outcome, some bits of it changed by `change`: `None` is a bit that was missed.
fn hear(state: &mut State, change: impl Fn(u16, bool) -> Option<bool>) -> Option<Outcome> {
    let bytes = sent(&BLOCK);
    let mut last = None;
    for at in 0..FRAME_BITS {
        match change(at, bit(&bytes, at)) {
            Some(bit) => {
                last = step(&CONFIG, state, bit).or(last);
            }
            None => gap(state, 1),
        }
    }
    last
}

#[cfg_attr(target_os = "none", defmt_test::tests)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_is_heard_with_its_last_bit() {
        let mut state = State::default();
        let bytes = sent(&BLOCK);
        for at in 0..FRAME_BITS - 1 {
            assert_eq!(step(&CONFIG, &mut state, bit(&bytes, at)), None);
        }
        assert_eq!(step(&CONFIG, &mut state, true), Some(Outcome::Good(BLOCK)));
        assert_eq!((state.good(), state.bad()), (1, 0));
    }

    #[test]
    fn frame_after_frame_is_heard() {
        let mut state = State::default();
        for heard in 1..=3 {
            assert_eq!(hear(&mut state, |_, bit| Some(bit)), Some(Outcome::Good(BLOCK)));
            assert_eq!((state.good(), state.bad()), (heard, 0));
        }
    }

    #[test]
    fn who_comes_in_the_middle_hears_the_next_frame() {
        for begin in [1, 17, 18, 100, 357] {
            let mut state = State::default();
            let first = hear(&mut state, |at, bit| (at >= begin).then_some(bit));
            assert!(!matches!(first, Some(Outcome::Good(_))));
            assert_eq!(hear(&mut state, |_, bit| Some(bit)), Some(Outcome::Good(BLOCK)));
        }
    }

    #[test]
    fn a_missed_bit_is_made_good_by_the_next_frame() {
        for missed in 18..FRAME_BITS {
            let mut state = State::default();
            let first = hear(&mut state, |at, bit| (at != missed).then_some(bit));
            // A closing one says nothing, nor does the length.
            assert!(first.is_none() || first == Some(Outcome::Good(BLOCK)));
            assert_eq!(hear(&mut state, |_, bit| Some(bit)), Some(Outcome::Good(BLOCK)), "bit {missed}");
            assert_eq!(state.bad(), 0);
        }
    }

    #[test]
    fn every_word_may_come_from_another_frame() {
        // One bit of every other word is missed, now of the even words and now of the odd.
        let mut state = State::default();
        hear(&mut state, |_, bit| Some(bit));
        let mut heard = None;
        for round in 0..2 {
            heard = heard.or(hear(&mut state, |at, bit| (at < 18 || at % 34 != 20 + 17 * round).then_some(bit)));
        }
        heard = heard.or(hear(&mut state, |at, bit| (at % 34 != 20).then_some(bit)));
        assert_eq!(heard, Some(Outcome::Good(BLOCK)));
        assert_eq!((state.good(), state.bad()), (2, 0));
    }

    #[test]
    fn a_wrong_bit_costs_the_frame_and_no_more() {
        for wrong in (0..FRAME_BITS).filter(|at| !PADDING.contains(at)) {
            let mut state = State::default();
            let changed = hear(&mut state, |at, bit| Some(bit ^ (at == wrong)));
            assert!(!matches!(changed, Some(Outcome::Good(_))), "bit {wrong}");
            let next = hear(&mut state, |_, bit| Some(bit));
            assert_eq!(next, Some(Outcome::Good(BLOCK)), "after bit {wrong}");
            assert_eq!(state.good(), 1);
        }
    }

    #[test]
    fn a_flaw_has_its_name() {
        let flaw = |wrong: u16| hear(&mut State::default(), |at, bit| Some(bit ^ (at == wrong)));
        assert_eq!(flaw(0), None);
        assert_eq!(flaw(18), Some(Outcome::Bad(Flaw::Length)));
        assert_eq!(flaw(18 + 16), Some(Outcome::Bad(Flaw::Framing)));
        assert_eq!(flaw(100), Some(Outcome::Bad(Flaw::Crc)));
        assert_eq!(flaw(350), Some(Outcome::Bad(Flaw::Crc)));
    }

    #[test]
    fn the_crc_is_over_the_block_without_its_padding() {
        let heard = hear(&mut State::default(), |at, bit| Some(bit ^ PADDING.contains(&at)));
        assert_eq!(heard, Some(Outcome::Good(BLOCK)));
    }

    #[test]
    fn a_bit_that_was_not_counted_costs_the_place_in_the_frame() {
        let mut state = State::default();
        let bytes = sent(&BLOCK);
        for at in (0..FRAME_BITS).filter(|at| *at != 60) {
            assert!(!matches!(step(&CONFIG, &mut state, bit(&bytes, at)), Some(Outcome::Good(_))));
        }
        assert_eq!(hear(&mut state, |_, bit| Some(bit)), Some(Outcome::Good(BLOCK)));
    }

    #[test]
    fn a_rest_is_slept_through_and_ended_when_told() {
        let config = Config { rest_bits: 1_000, ..CONFIG };
        let bytes = sent(&BLOCK);
        let frame =
            |state: &mut State| (0..FRAME_BITS).fold(None, |heard, at| step(&config, state, bit(&bytes, at)).or(heard));
        let mut state = State::default();
        assert_eq!(frame(&mut state), Some(Outcome::Good(BLOCK)));
        assert!(state.is_resting());
        gap(&mut state, 200);
        assert_eq!((frame(&mut state), frame(&mut state)), (None, None));
        // 1,000 bits end in the third frame; the fourth is the first whole one.
        assert_eq!((frame(&mut state), frame(&mut state)), (None, Some(Outcome::Good(BLOCK))));
        state.restart();
        assert!(!state.is_resting());
        assert_eq!(frame(&mut state), Some(Outcome::Good(BLOCK)));
    }

    #[test]
    fn a_long_darkness_starts_from_nothing() {
        let mut state = State::default();
        hear(&mut state, |at, bit| (at < 300).then_some(bit));
        gap(&mut state, u8::MAX);
        assert_eq!(hear(&mut state, |at, bit| (at >= 280).then_some(bit)), None);
        assert_eq!(hear(&mut state, |_, bit| Some(bit)), Some(Outcome::Good(BLOCK)));
    }

    #[test]
    fn every_field_stands_where_the_table_says() {
        let u16_at = |at: usize| u16::from_le_bytes([BLOCK.bytes()[at], BLOCK.bytes()[at + 1]]);
        let (azimuth, elevation) = (BLOCK.terms(Axis::Azimuth), BLOCK.terms(Axis::Elevation));
        assert_eq!(BLOCK.firmware() << 6 | u16::from(BLOCK.protocol()), u16_at(0));
        assert_eq!(BLOCK.id(), u32::from(u16_at(2)) | u32::from(u16_at(4)) << 16);
        for (half, at) in [(azimuth.phase, 6), (azimuth.tilt, 10), (azimuth.curve, 16), (azimuth.gibphase, 23)] {
            assert_eq!(half, Half(u16_at(at)));
        }
        for (half, at) in [(elevation.phase, 8), (elevation.tilt, 12), (elevation.curve, 18), (elevation.gibmag, 29)] {
            assert_eq!(half, Half(u16_at(at)));
        }
        let bytes = BLOCK.bytes();
        assert_eq!([BLOCK.unlock_count(), BLOCK.hardware(), BLOCK.mode(), BLOCK.faults()], {
            [bytes[14], bytes[15], bytes[31], bytes[32]]
        });
        assert_eq!(BLOCK.acceleration().map(|axis| axis as u8), bytes[20..23]);
    }

    #[test]
    fn a_half_float_is_a_whole_number_of_its_power_of_two() {
        for (half, parts) in [
            (0x0000, Some((0, 0))),
            (0x3c00, Some((1 << 10, 14))),
            (0xbc00, Some((-(1 << 10), 14))),
            (0x0001, Some((1, 0))),
            (0x0400, Some((1 << 10, 0))),
            (0x7bff, Some((2_047, 29))),
            (0x7c00, None),
            (0xfe00, None),
        ] {
            assert_eq!(Half(half).parts(), parts, "{half:#x}");
        }
    }

    #[test]
    fn a_station_is_a_stranger_only_where_another_was_named() {
        let config = Config { ids: [Some(7), None], ..CONFIG };
        assert!(!config.is_stranger(Station::A, 7));
        assert!(config.is_stranger(Station::A, 8));
        assert!(!config.is_stranger(Station::B, 8));
    }
}
