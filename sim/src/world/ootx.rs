//! OOTX: what a station says about itself, one bit with every sync pulse.
//!
//! The length of a sync pulse carries a data bit. Strung together the bits make a frame that repeats for ever:
//! 17 zeros and a one to find the start, then 16-bit words each closed by a one, so that 17 zeros never occur inside.
//! A frame of 33 bytes is 358 bits, 3 s of light.
//!
//! What can go wrong: a mote that misses a single sync loses the frame it was in; the terms travel as half floats, so
//! what a mote reads differs from the rotor's truth by up to 2^-11 of it.

use half::f16;
use serde::{Deserialize, Serialize};

use super::rotor::Rotor;

/// Zeros before the one that starts a frame.
pub const PREAMBLE_ZEROS: usize = 17;

/// The length of the info block, bytes.
pub const INFO_BYTES: usize = 33;

/// What a station's info block holds beside the terms of its rotors.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Info {
    /// The serial number of the station.
    pub id: u32,
    /// The firmware version, 10 bits.
    pub firmware: u16,
    /// The version of the block's layout, 6 bits; 6 on every V1 station.
    pub protocol: u8,
    /// How often the rotors lost their lock.
    pub unlock_count: u8,
    /// The hardware version.
    pub hardware: u8,
    /// The direction of gravity as the station feels it, x y z, 127 = 1 g.
    pub acceleration: [i8; 3],
    /// The channel: 0 is A, 1 is b, 2 is c.
    pub mode: u8,
    /// The station's own fault flags, 0 when well.
    pub faults: u8,
}

impl Default for Info {
    fn default() -> Self {
        Info {
            id: 0,
            firmware: 1,
            protocol: 6,
            unlock_count: 0,
            hardware: 1,
            acceleration: [0, 127, 0],
            mode: 0,
            faults: 0,
        }
    }
}

impl Info {
    /// The 33 bytes of the block, little-endian and packed; azimuth before elevation in every pair.
    #[must_use]
    pub fn block(&self, azimuth: &Rotor, elevation: &Rotor) -> [u8; INFO_BYTES] {
        let mut block = [0; INFO_BYTES];
        let mut put = |at: usize, bytes: &[u8]| block[at..at + bytes.len()].copy_from_slice(bytes);
        put(0, &(self.firmware << 6 | u16::from(self.protocol & 0x3f)).to_le_bytes());
        put(2, &self.id.to_le_bytes());
        let pairs = [
            (6, azimuth.phase_rad, elevation.phase_rad),
            (10, azimuth.tilt_rad, elevation.tilt_rad),
            (16, azimuth.curve, elevation.curve),
            (23, azimuth.gibbous_phase_rad, elevation.gibbous_phase_rad),
            (27, azimuth.gibbous_magnitude_rad, elevation.gibbous_magnitude_rad),
        ];
        for (at, first, second) in pairs {
            put(at, &f16::from_f64(first).to_le_bytes());
            put(at + 2, &f16::from_f64(second).to_le_bytes());
        }
        put(14, &[self.unlock_count, self.hardware]);
        put(20, &self.acceleration.map(|g| g.to_le_bytes()[0]));
        put(31, &[self.mode, self.faults]);
        block
    }
}

/// The bits of one frame around `payload`, in the order they are sent.
///
/// Length, payload (padded to whole words) and CRC-32 follow the preamble; bytes travel highest bit first. The CRC is
/// over the payload without its padding, as recorded frames have it.
///
/// # Panics
/// When the payload does not fit the 16-bit length.
#[must_use]
pub fn frame(payload: &[u8]) -> Vec<bool> {
    let length = u16::try_from(payload.len()).expect("an OOTX payload is at most 65535 bytes");
    let mut bytes = length.to_le_bytes().to_vec();
    bytes.extend_from_slice(payload);
    bytes.resize(bytes.len().next_multiple_of(2), 0);
    bytes.extend_from_slice(&crc32(payload).to_le_bytes());

    let mut bits = vec![false; PREAMBLE_ZEROS];
    bits.push(true);
    for word in bytes.chunks(2) {
        bits.extend(word.iter().flat_map(|byte| (0..8).rev().map(move |n| byte >> n & 1 == 1)));
        bits.push(true);
    }
    bits
}

/// CRC-32 (reflected 0x04C11DB7, start and end inverted).
#[must_use]
pub fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0, |crc, &byte| {
        (0..8).fold(crc ^ u32::from(byte), |crc, _| if crc & 1 == 1 { crc >> 1 ^ 0xedb8_8320 } else { crc >> 1 })
    })
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Reads the first whole frame out of a run of bits: the payload, or what is wrong.
    pub(crate) fn unframe(bits: &[bool]) -> Result<Vec<u8>, &'static str> {
        let start = bits
            .windows(PREAMBLE_ZEROS + 1)
            .position(|w| w[PREAMBLE_ZEROS] && !w[..PREAMBLE_ZEROS].contains(&true))
            .ok_or("no preamble")?;
        let mut words = bits[start + PREAMBLE_ZEROS + 1..].chunks_exact(17).map(|word| {
            let byte = |bits: &[bool]| bits.iter().fold(0u8, |byte, &bit| byte << 1 | u8::from(bit));
            if word[16] { Ok([byte(&word[..8]), byte(&word[8..16])]) } else { Err("a word without its one") }
        });
        let mut next = || words.next().ok_or("too short")?;
        let length = usize::from(u16::from_le_bytes(next()?));
        let mut payload = Vec::new();
        while payload.len() < length {
            payload.extend(next()?);
        }
        payload.truncate(length);
        let ([a, b], [c, d]) = (next()?, next()?);
        if u32::from_le_bytes([a, b, c, d]) == crc32(&payload) { Ok(payload) } else { Err("wrong CRC") }
    }

    #[test]
    fn the_crc_is_the_common_one() {
        assert_eq!(crc32(b"123456789"), 0xcbf4_3926);
    }

    #[test]
    fn an_info_block_takes_358_bits() {
        let block = Info::default().block(&Rotor::default(), &Rotor::default());
        assert_eq!(frame(&block).len(), 358);
    }

    #[test]
    fn the_info_block_has_every_field_in_its_place() {
        let azimuth = Rotor { phase_rad: 0.05, tilt_rad: -0.01, ..Rotor::default() };
        let elevation = Rotor { gibbous_magnitude_rad: 0.004, ..Rotor::default() };
        let info = Info { id: 0x1234_5678, firmware: 436, mode: 1, faults: 9, ..Info::default() };
        let block = info.block(&azimuth, &elevation);
        let half_at = |at: usize| f16::from_le_bytes([block[at], block[at + 1]]).to_f64();
        assert_eq!(u16::from_le_bytes([block[0], block[1]]), 436 << 6 | 6);
        assert_eq!(block[2..6], [0x78, 0x56, 0x34, 0x12]);
        assert!((half_at(6) - 0.05).abs() < 0.05 / 2048.0);
        assert!((half_at(10) + 0.01).abs() < 0.01 / 2048.0);
        assert!((half_at(29) - 0.004).abs() < 0.004 / 2048.0);
        assert_eq!(block[20..23], [0, 127, 0]);
        assert_eq!(block[31..], [1, 9]);
    }

    proptest! {
        #[test]
        fn a_frame_read_from_any_point_of_the_loop_gives_back_its_payload(
            payload in prop::collection::vec(any::<u8>(), 1..80), start in 0..2000usize,
        ) {
            let bits = frame(&payload);
            let heard: Vec<bool> = bits.iter().cycle().skip(start % bits.len()).take(2 * bits.len()).copied().collect();
            prop_assert_eq!(unframe(&heard), Ok(payload));
        }
    }
}
