//! Frames as the nRF52840-DK programmer wants them: HDLC's flags, byte stuffing and check sequence (RFC 1662), with
//! nothing in front of the payload.
//!
//! Source: PisterLab/scum-sdk, scum_programmer/nrf-fw/hdlc.c. What can go wrong there: a frame whose check sequence is
//! wrong is dropped in silence, and nobody answers.

use crc::{CRC_16_IBM_SDLC, Crc};

/// Before and after a frame.
pub const FLAG: u8 = 0x7E;
/// Announces a byte that is not what it seems.
const ESCAPE: u8 = 0x7D;
/// What an announced byte is changed by.
const ESCAPED: u8 = 0x20;

/// The frame of `payload`: check sequence over the payload before stuffing, its low byte first.
#[must_use]
pub fn encode(payload: &[u8]) -> Vec<u8> {
    let fcs = Crc::<u16>::new(&CRC_16_IBM_SDLC).checksum(payload).to_le_bytes();
    let mut frame = vec![FLAG];
    for &byte in payload.iter().chain(&fcs) {
        match byte {
            FLAG | ESCAPE => frame.extend([ESCAPE, byte ^ ESCAPED]),
            _ => frame.push(byte),
        }
    }
    frame.push(FLAG);
    frame
}

#[cfg(test)]
mod tests {
    use super::encode;

    #[test]
    fn a_frame_is_stuffed_and_carries_its_check_sequence() {
        // 0x906E is the catalogue's check value of this CRC for "123456789".
        assert_eq!(encode(b"123456789"), b"\x7e123456789\x6e\x90\x7e");
        assert_eq!(encode(&[0x7E, 0x7D])[..5], [0x7E, 0x7D, 0x5E, 0x7D, 0x5D]);
    }
}
