//! Reports to radio frames and back: what is ours comes through whole, what is not is named.
#![cfg_attr(target_os = "none", no_std, no_main)]

#[cfg(target_os = "none")]
mod harness;

use fixed::types::{I6F10, I16F16, U0F16, U8F8};
use lighthouse_mote::frame::{Header, LEN, Level, Losses, Reject, Report, VERSION, emit, fcs, parse};

const HEADER: Header = Header { pan: 0x1234, mote: 0xbeef, sequence: 0x0102 };

fn report() -> Report {
    Report {
        time: 0xdead_beef,
        half_turn_q8: 90_167 << 8,
        position: [I16F16::from_bits(-1), I16F16::from_bits(98_304), I16F16::MIN],
        mismatch: U0F16::from_bits(655),
        age: U8F8::from_bits(900),
        stations: 3,
        level: Level::Tracked,
        velocity: [I6F10::from_bits(1), I6F10::from_bits(-1_024), I6F10::MIN],
        sd: [U0F16::from_bits(7), U0F16::from_bits(66), U0F16::MAX],
        losses: Losses { edges: 1, pulses: 2, sweeps: 3, fixes: 4, reports: u16::MAX },
    }
}

/// A whole frame with the byte at `at` changed, and the frame check sequence made right again.
fn with_byte(at: usize, byte: u8) -> [u8; LEN] {
    let mut bytes = emit(HEADER, &report());
    bytes[at] = byte;
    let check = fcs(&bytes[..LEN - 2]).to_le_bytes();
    bytes[LEN - 2..].copy_from_slice(&check);
    bytes
}

#[cfg_attr(target_os = "none", defmt_test::tests)]
mod tests {
    use super::*;

    #[test]
    fn the_fcs_has_the_check_value_of_its_standard() {
        // CRC-16/KERMIT is the same polynomial, order and start; its check value is in every CRC catalogue.
        assert_eq!(fcs(b"123456789"), 0x2189);
        assert_eq!(fcs(b""), 0);
    }

    #[test]
    fn a_report_comes_back_as_it_left() {
        assert_eq!(parse(&emit(HEADER, &report())), Ok((HEADER, report())));
        assert_eq!(parse(&emit(Header::default(), &Report::default())), Ok((Header::default(), Report::default())));
    }

    #[test]
    fn a_frame_begins_as_a_data_frame_of_802_15_4() {
        let bytes = emit(HEADER, &report());
        assert_eq!(bytes[..9], [0x41, 0x98, 0x02, 0x34, 0x12, 0xff, 0xff, 0xef, 0xbe]);
        assert_eq!(bytes[9..13], [b'L', b'M', VERSION, 1]);
    }

    #[test]
    fn the_numbers_stand_where_the_table_says() {
        let bytes = emit(HEADER, &report());
        assert_eq!(bytes[13..15], 0xbeef_u16.to_le_bytes());
        assert_eq!(bytes[15..17], 0x0102_u16.to_le_bytes());
        assert_eq!(bytes[17..21], 0xdead_beef_u32.to_le_bytes());
        assert_eq!(bytes[21..25], (90_167_u32 << 8).to_le_bytes());
        assert_eq!(bytes[25..29], (-1_i32).to_le_bytes());
        assert_eq!(bytes[33..37], i32::MIN.to_le_bytes());
        assert_eq!(bytes[37..39], 655_u16.to_le_bytes());
        assert_eq!(bytes[39..41], 900_u16.to_le_bytes());
        assert_eq!(bytes[41], 0x23);
        assert_eq!(bytes[44..46], (-1_024_i16).to_le_bytes());
        assert_eq!(bytes[48..50], 7_u16.to_le_bytes());
        assert_eq!(bytes[62..64], [0xff, 0xff]);
    }

    #[test]
    fn another_length_is_named() {
        let bytes = emit(HEADER, &report());
        assert_eq!(parse(&[]), Err(Reject::Length));
        assert_eq!(parse(&bytes[..LEN - 1]), Err(Reject::Length));
        let mut longer = [0; LEN + 1];
        longer[..LEN].copy_from_slice(&bytes);
        assert_eq!(parse(&longer), Err(Reject::Length));
    }

    #[test]
    fn every_single_flipped_bit_is_found() {
        for bit in 0..LEN * 8 {
            let mut bytes = emit(HEADER, &report());
            bytes[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(parse(&bytes), Err(Reject::Fcs));
        }
    }

    #[test]
    fn another_header_is_named() {
        assert_eq!(parse(&with_byte(0, 0x61)), Err(Reject::Header));
        assert_eq!(parse(&with_byte(1, 0x88)), Err(Reject::Header));
        assert_eq!(parse(&with_byte(5, 0x00)), Err(Reject::Header));
        // The MAC sequence is the low byte of ours.
        assert_eq!(parse(&with_byte(2, 0x03)), Err(Reject::Header));
    }

    #[test]
    fn another_payload_is_named() {
        assert_eq!(parse(&with_byte(9, b'X')), Err(Reject::Magic));
        assert_eq!(parse(&with_byte(10, b'X')), Err(Reject::Magic));
        assert_eq!(parse(&with_byte(11, VERSION + 1)), Err(Reject::Version));
        assert_eq!(parse(&with_byte(12, 9)), Err(Reject::Kind));
    }

    #[test]
    fn a_source_that_is_not_the_mote_is_named() {
        assert_eq!(parse(&with_byte(7, 0)), Err(Reject::Mote));
        assert_eq!(parse(&with_byte(13, 0)), Err(Reject::Mote));
    }

    #[test]
    fn every_level_comes_back_and_no_other() {
        for level in [Level::None, Level::Angles, Level::Tracked, Level::Full] {
            let report = Report { level, ..report() };
            assert_eq!(parse(&emit(HEADER, &report)), Ok((HEADER, report)));
        }
        for byte in [0x04, 0x37, 0x43, 0xf0] {
            assert_eq!(parse(&with_byte(41, byte)), Err(Reject::Level));
        }
    }

    #[test]
    fn any_pan_is_taken() {
        assert_eq!(parse(&with_byte(3, 0)), Ok((Header { pan: 0x1200, ..HEADER }, report())));
    }

    #[test]
    fn all_zeros_are_no_report() {
        // Their frame check sequence is right: the polynomial starts from zero.
        assert_eq!(parse(&[0; LEN]), Err(Reject::Header));
    }
}
