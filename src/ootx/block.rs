//! The block of an OOTX frame: 33 bytes, little-endian, packed.
//!
//! | bytes | what |
//! |---|---|
//! | 0..2 | firmware version (10 bits) above the version of this layout (6 bits) |
//! | 2..6 | serial number of the station |
//! | 6..10 | phase of the azimuth and the elevation rotor, half floats, rad |
//! | 10..14 | tilt of both, rad |
//! | 14 | how often the rotors lost their lock |
//! | 15 | hardware version |
//! | 16..20 | curve of both |
//! | 20..23 | acceleration x, y, z, 127 is 1 g |
//! | 23..27 | gibphase of both, rad |
//! | 27..31 | gibmag of both, rad |
//! | 31 | mode: 0 A, 1 B, 2 C |
//! | 32 | faults, 0 when well |
//!
//! Source: the public decoders of vive-diy-position-sensor and libsurvive; recorded blocks agree.
//!
//! What can go wrong: nothing; every pattern of bits is some block.

use crate::sweep::Axis;

/// Bytes of a block.
pub const BLOCK_BYTES: usize = 33;

/// What a station says about itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Block([u8; BLOCK_BYTES]);

/// The factory terms of one rotor, as sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Terms {
    /// Ideal angle minus measured angle, straight ahead, rad.
    pub phase: Half,
    /// Tilt of the laser plane, rad.
    pub tilt: Half,
    /// Curve of the laser plane.
    pub curve: Half,
    /// Phase of the once-per-turn term, rad.
    pub gibphase: Half,
    /// Magnitude of the once-per-turn term, rad.
    pub gibmag: Half,
}

impl Block {
    /// From its bytes.
    #[must_use]
    pub const fn new(bytes: [u8; BLOCK_BYTES]) -> Self {
        Self(bytes)
    }

    /// From its words, the last of them half padding.
    pub(super) fn of(words: &[u16]) -> Self {
        let mut bytes = [0; BLOCK_BYTES];
        for (at, byte) in bytes.iter_mut().enumerate() {
            let word = words.get(at / 2).copied().unwrap_or(0);
            *byte = if at & 1 == 0 { word as u8 } else { (word >> 8) as u8 };
        }
        Self(bytes)
    }

    /// As sent.
    #[must_use]
    pub const fn bytes(&self) -> &[u8; BLOCK_BYTES] {
        &self.0
    }

    const fn u16(&self, at: usize) -> u16 {
        u16::from_le_bytes([self.0[at], self.0[at + 1]])
    }

    /// Firmware version, 10 bits.
    #[must_use]
    pub const fn firmware(&self) -> u16 {
        self.u16(0) >> 6
    }

    /// Version of the block's layout, 6 bits: 6 on every V1 station.
    #[must_use]
    pub const fn protocol(&self) -> u8 {
        self.0[0] & 0x3f
    }

    /// Serial number of the station.
    #[must_use]
    pub const fn id(&self) -> u32 {
        u32::from_le_bytes([self.0[2], self.0[3], self.0[4], self.0[5]])
    }

    /// The factory terms of one rotor.
    #[must_use]
    pub const fn terms(&self, axis: Axis) -> Terms {
        let at = match axis {
            Axis::Azimuth => 0,
            Axis::Elevation => 2,
        };
        Terms {
            phase: Half(self.u16(6 + at)),
            tilt: Half(self.u16(10 + at)),
            curve: Half(self.u16(16 + at)),
            gibphase: Half(self.u16(23 + at)),
            gibmag: Half(self.u16(27 + at)),
        }
    }

    /// How often the rotors lost their lock.
    #[must_use]
    pub const fn unlock_count(&self) -> u8 {
        self.0[14]
    }

    /// Hardware version.
    #[must_use]
    pub const fn hardware(&self) -> u8 {
        self.0[15]
    }

    /// Gravity as the station feels it, x, y, z; 127 is 1 g.
    #[must_use]
    pub const fn acceleration(&self) -> [i8; 3] {
        [self.0[20] as i8, self.0[21] as i8, self.0[22] as i8]
    }

    /// The channel: 0 A, 1 B, 2 C.
    #[must_use]
    pub const fn mode(&self) -> u8 {
        self.0[31]
    }

    /// The station's own fault flags, 0 when well.
    #[must_use]
    pub const fn faults(&self) -> u8 {
        self.0[32]
    }
}

/// A half float as sent, IEEE 754 binary16: the mote has no floats to spare.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Half(pub u16);

impl Half {
    /// The value is exactly `mantissa * 2^(shift - 24)`, at most 2047 and 29; `None` for infinity and what is no number.
    #[must_use]
    pub const fn parts(self) -> Option<(i32, u32)> {
        let exponent = self.0 as u32 >> 10 & 0x1f;
        let fraction = (self.0 & 0x3ff) as i32;
        let (magnitude, shift) = match exponent {
            0 => (fraction, 0),
            31 => return None,
            _ => (fraction | 1 << 10, exponent - 1),
        };
        Some((if self.0 >> 15 == 0 { magnitude } else { -magnitude }, shift))
    }

    /// The value, exactly.
    #[must_use]
    pub fn to_f64(self) -> f64 {
        match self.parts() {
            // The exponent of a power of two stands above 52 bits, 1023 for one.
            Some((0, _)) if self.0 >> 15 != 0 => -0.0,
            Some((mantissa, shift)) => f64::from(mantissa) * f64::from_bits(u64::from(1023 - 24 + shift) << 52),
            None if self.0 & 0x3ff != 0 => f64::NAN,
            None if self.0 >> 15 == 0 => f64::INFINITY,
            None => f64::NEG_INFINITY,
        }
    }
}
