//! Reports to radio frames and back: what is ours comes through whole, what is not is named.
#![cfg_attr(target_os = "none", no_std, no_main)]

#[cfg(target_os = "none")]
mod harness;

use fixed::types::{I6F10, I16F16, U0F16, U8F8};
use lighthouse_mote::frame::{
    ANGLES, ANGLES_LEN, Angles, Factory, HEALTH_LEN, Header, Health, LEN, Level, Lock, Losses, Measured, Message,
    Reject, Rejects, Report, Reset, Station, VERSION, emit, emit_angles, emit_health, fcs, parse,
};
use lighthouse_mote::sweep;

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

fn health() -> Health {
    let station = Station {
        id: 0x1234_5678,
        good: 3,
        bad: 255,
        mode: 1,
        faults: 9,
        width_bias: -7,
        factory: Factory::Received,
        is_stranger: true,
    };
    Health {
        uptime: 86_400,
        half_turn_q8: 90_167 << 8,
        lock: Lock::V2,
        reset: Reset::Fault,
        reset_detail: 0x0000_4f3e,
        syncs: [0x0101, 0x0202],
        sweeps: [[0x0303, 0x0404], [0x0505, 0x0606]],
        rejects: Rejects { edges: 0x0707, locks: 0xfefe, ..Rejects::default() },
        waiting: [11, 12, 13],
        stations: [Station::default(), station],
    }
}

/// `count` sweeps, the rotors in turn.
fn angles(count: usize) -> Angles {
    let mut angles = Angles { half_turn_q8: 75_000 << 8, ..Angles::default() };
    for n in 0..count as u32 {
        let station = if n & 1 == 0 { sweep::Station::A } else { sweep::Station::B };
        let axis = if n & 2 == 0 { sweep::Axis::Azimuth } else { sweep::Axis::Elevation };
        let _ = angles.sweeps.push(Measured { time: 0xffff_0000 + n, station, axis, share: 0x07_1234 + n });
    }
    angles
}

/// The bytes with the one at `at` changed, and the frame check sequence made right again.
fn changed<const L: usize>(mut bytes: [u8; L], at: usize, byte: u8) -> [u8; L] {
    bytes[at] = byte;
    let check = fcs(&bytes[..L - 2]).to_le_bytes();
    bytes[L - 2..].copy_from_slice(&check);
    bytes
}

/// A whole frame of a fix with the byte at `at` changed.
fn with_byte(at: usize, byte: u8) -> [u8; LEN] {
    changed(emit(HEADER, &report()), at, byte)
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
        assert_eq!(parse(&emit(HEADER, &report())), Ok((HEADER, Message::Fix(report()))));
        assert_eq!(
            parse(&emit(Header::default(), &Report::default())),
            Ok((Header::default(), Message::Fix(Report::default())))
        );
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
    fn health_comes_back_as_it_left() {
        for health in [health(), Health::default()] {
            assert_eq!(parse(&emit_health(HEADER, &health)), Ok((HEADER, Message::Health(health))));
        }
    }

    #[test]
    fn health_stands_where_the_table_says() {
        let bytes = emit_health(HEADER, &health());
        assert_eq!(bytes[..17], changed(emit(HEADER, &report()), 12, 2)[..17]);
        assert_eq!(bytes[17..21], 86_400_u32.to_le_bytes());
        assert_eq!(bytes[21..25], (90_167_u32 << 8).to_le_bytes());
        assert_eq!(bytes[25..31], [6, 2, 0x3e, 0x4f, 0, 0]);
        assert_eq!(bytes[31..45], [1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7]);
        assert_eq!(bytes[65..70], [0xfe, 0xfe, 11, 12, 13]);
        assert_eq!(bytes[70..80], [0; 10]);
        assert_eq!(bytes[80..90], [0x78, 0x56, 0x34, 0x12, 3, 255, 1, 9, 0xf9, 0b110]);
    }

    #[test]
    fn every_lock_has_its_code_and_no_other() {
        use Lock::{Locked, NoLight, OneStation, Searching, Spacing, V2, Widths};
        for (code, lock) in (0..).zip([NoLight, Searching, Locked, OneStation, Spacing, Widths, V2]) {
            let health = Health { lock, ..health() };
            assert_eq!(emit_health(HEADER, &health)[25], code);
            assert_eq!(parse(&emit_health(HEADER, &health)), Ok((HEADER, Message::Health(health))));
        }
    }

    #[test]
    fn a_code_that_means_nothing_is_named() {
        for (at, byte) in [(25, 7), (26, 6), (79, 3), (79, 8), (89, 0x80)] {
            assert_eq!(parse(&changed(emit_health(HEADER, &health()), at, byte)), Err(Reject::Code));
        }
        let mut bytes = [0; ANGLES_LEN];
        let _ = emit_angles(HEADER, &angles(ANGLES), &mut bytes);
        assert_eq!(parse(&changed(bytes, 25, 4)), Err(Reject::Code));
    }

    #[test]
    fn angles_come_back_however_many_there_are() {
        for count in 1..=ANGLES {
            let mut bytes = [0; ANGLES_LEN];
            let frame = emit_angles(HEADER, &angles(count), &mut bytes);
            assert_eq!(frame.len(), 23 + 8 * count);
            assert_eq!(parse(frame), Ok((HEADER, Message::Angles(angles(count)))));
        }
        assert!(emit_angles(HEADER, &angles(0), &mut [0; ANGLES_LEN]).is_empty());
    }

    #[test]
    fn angles_stand_where_the_table_says() {
        let mut bytes = [0; ANGLES_LEN];
        let frame = emit_angles(HEADER, &angles(4), &mut bytes);
        assert_eq!(frame[12..17], [3, 0xef, 0xbe, 0x02, 0x01]);
        assert_eq!(frame[17..21], (75_000_u32 << 8).to_le_bytes());
        assert_eq!(frame[21..29], [0x00, 0x00, 0xff, 0xff, 0, 0x34, 0x12, 0x07]);
        assert_eq!(frame[45..53], [0x03, 0x00, 0xff, 0xff, 3, 0x37, 0x12, 0x07]);
    }

    #[test]
    fn a_sweep_is_sent_as_its_share_of_the_half_turn() {
        let Some(half_turn) = sweep::HalfTurn::from_ticks_q8(80_000 << 8) else { panic!("in range") };
        let sweep = sweep::Sweep {
            station: sweep::Station::B,
            axis: sweep::Axis::Elevation,
            at: lighthouse_mote::time::Ticks(5),
            since_sync: lighthouse_mote::time::Span(40_000),
            half_turn,
        };
        let measured = Measured::from(&sweep);
        assert_eq!((measured.time, measured.station, measured.axis), (5, sweep.station, sweep.axis));
        assert!(measured.share.abs_diff(1 << 19) <= 1);
    }

    #[test]
    fn the_length_of_another_kind_is_named() {
        assert_eq!(parse(&with_byte(12, 2)), Err(Reject::Length));
        assert_eq!(parse(&with_byte(12, 3)), Err(Reject::Length));
        assert_eq!(parse(&changed(emit_health(HEADER, &health()), 12, 1)), Err(Reject::Length));
        assert_eq!(parse(&emit_health(HEADER, &health())[..HEALTH_LEN - 1]), Err(Reject::Length));
    }

    #[test]
    fn every_single_flipped_bit_is_found_in_every_kind() {
        let mut longest = [0; ANGLES_LEN];
        let _ = emit_angles(HEADER, &angles(ANGLES), &mut longest);
        let (mut fix, mut health) = (emit(HEADER, &report()), emit_health(HEADER, &health()));
        for bytes in [&mut fix[..], &mut health, &mut longest] {
            for bit in 0..bytes.len() * 8 {
                bytes[bit / 8] ^= 1 << (bit % 8);
                assert_eq!(parse(bytes), Err(Reject::Fcs));
                bytes[bit / 8] ^= 1 << (bit % 8);
            }
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
            assert_eq!(parse(&emit(HEADER, &report)), Ok((HEADER, Message::Fix(report))));
        }
        for byte in [0x04, 0x37, 0x43, 0xf0] {
            assert_eq!(parse(&with_byte(41, byte)), Err(Reject::Level));
        }
    }

    #[test]
    fn any_pan_is_taken() {
        assert_eq!(parse(&with_byte(3, 0)), Ok((Header { pan: 0x1200, ..HEADER }, Message::Fix(report()))));
    }

    #[test]
    fn all_zeros_are_no_report() {
        // Their frame check sequence is right: the polynomial starts from zero.
        assert_eq!(parse(&[0; LEN]), Err(Reject::Header));
    }
}
