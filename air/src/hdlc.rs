//! HDLC's flags, byte stuffing and check sequence (RFC 1662), with nothing in front of the payload: what the nRF52840-DK
//! programmer wants, and what an OpenWSN mote says.
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

/// Bytes of a frame at most, stuffing undone: what goes on longer has lost its flag.
const LONGEST: usize = 512;

/// Frames out of a stream that may begin anywhere.
#[derive(Debug, Default)]
pub struct Decoder {
    bytes: Vec<u8>,
    escaped: bool,
    /// A flag was seen.
    inside: bool,
}

impl Decoder {
    /// The payload once its frame is complete; as an error what was no frame.
    pub fn take(&mut self, byte: u8) -> Option<Result<Vec<u8>, Vec<u8>>> {
        match byte {
            FLAG => {
                let (inside, escaped) = (self.inside, self.escaped);
                (self.inside, self.escaped) = (true, false);
                let mut bytes = std::mem::take(&mut self.bytes);
                if bytes.is_empty() && !escaped {
                    // Flags may follow each other.
                    return None;
                }
                let Some((payload, check)) = bytes.split_last_chunk::<2>() else { return Some(Err(bytes)) };
                if !inside || escaped || Crc::<u16>::new(&CRC_16_IBM_SDLC).checksum(payload).to_le_bytes() != *check {
                    return Some(Err(bytes));
                }
                bytes.truncate(bytes.len() - 2);
                return Some(Ok(bytes));
            }
            ESCAPE if !self.escaped => self.escaped = true,
            byte => {
                self.bytes.push(if self.escaped { byte ^ ESCAPED } else { byte });
                self.escaped = false;
            }
        }
        if self.bytes.len() < LONGEST {
            return None;
        }
        self.inside = false;
        Some(Err(std::mem::take(&mut self.bytes)))
    }
}

#[cfg(test)]
mod tests {
    use super::{Decoder, encode};

    fn decoded(bytes: &[u8]) -> Vec<Result<Vec<u8>, Vec<u8>>> {
        let mut decoder = Decoder::default();
        bytes.iter().filter_map(|byte| decoder.take(*byte)).collect()
    }

    #[test]
    fn what_was_stuffed_comes_out_and_what_was_damaged_does_not() {
        let all: Vec<u8> = (0..=255).collect();
        let stream = [&b"from the middle"[..], &encode(&all), &encode(b"two"), &encode(b"three")[1..]].concat();
        let out = decoded(&stream);
        let good: Vec<_> = out.iter().flatten().map(Vec::as_slice).collect();
        assert_eq!(good, [&all[..], b"two", b"three"]);
        assert_eq!(out[0], Err(b"from the middle".to_vec()));
        let mut flipped = encode(b"two");
        flipped[2] ^= 1;
        assert!(decoded(&flipped)[0].is_err());
        assert!(decoded(&[0x7E, 0x7D, 0x7E])[0].is_err(), "an escape that escapes nothing");
        assert_eq!(decoded(&[1; 2000]).len(), 3, "no frame is that long");
    }

    #[test]
    fn a_frame_is_stuffed_and_carries_its_check_sequence() {
        // 0x906E is the catalogue's check value of this CRC for "123456789".
        assert_eq!(encode(b"123456789"), b"\x7e123456789\x6e\x90\x7e");
        assert_eq!(encode(&[0x7E, 0x7D])[..5], [0x7E, 0x7D, 0x5E, 0x7D, 0x5D]);
    }
}
