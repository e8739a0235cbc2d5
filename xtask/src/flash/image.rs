//! What a programmer sends: the whole code RAM of a SCuM-3C, 64 KiB, as the chip's boot loader copies it.
//!
//! | bytes | what |
//! |---|---|
//! | 0 .. length | the program from its vector table on, filled up to a word |
//! | length .. 0xFFF8 | zeros |
//! | 0xFFF8 .. 0xFFFC | `length`, little-endian |
//! | 0xFFFC .. 0x1_0000 | CRC-32 of the first `length` bytes, little-endian |
//!
//! Places and CRC (reflected 0x04C11DB7, initially and finally inverted: that of zip and Ethernet) are those of
//! PisterLab/scum-test-code: scm3c_hw_interface.c `crc_check`, teensy_uC_programmer.ino `insert_crc`. Its
//! `bootload.py` writes one less than the file's bytes as length and so leaves the last byte unguarded; here all bytes
//! are covered.
//!
//! What can go wrong: the program is larger than what is left, or wants to be loaded where no code RAM is. Both are
//! refused with the numbers.

use std::fmt;

use crc::{CRC_32_ISO_HDLC, Crc};
use sim::elf::{self, LoadError};

/// Bytes of code RAM, all of which are always sent.
pub const LEN: usize = 0x1_0000;
/// Where the length is.
pub const LENGTH_AT: usize = 0xFFF8;
/// Where the CRC is.
pub const CRC_AT: usize = 0xFFFC;

/// An image that can be sent.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Image(Vec<u8>);

/// Why there is no image, or why bytes are none.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Unfit {
    /// The file is no program for this chip.
    Elf(LoadError),
    /// A part of it does not fit below the last two words.
    TooLarge {
        /// Bytes from address 0 to the program's end.
        bytes: u64,
    },
    /// A part of it is to be loaded outside of code RAM.
    Outside {
        /// Where.
        address: u32,
        /// How much.
        bytes: usize,
    },
    /// Not [`LEN`] bytes.
    NotWhole {
        /// But so many.
        bytes: usize,
    },
    /// The length in the image is no length.
    Length(u32),
    /// The CRC in the image is not that of its bytes.
    Crc {
        /// In the image.
        said: u32,
        /// Of the bytes.
        is: u32,
    },
    /// Something behind the program that is not zero.
    Leftover {
        /// Where.
        address: usize,
    },
}

impl fmt::Display for Unfit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Elf(error) => error.fmt(f),
            Self::TooLarge { bytes } => write!(
                f,
                "the image is too large: {bytes} bytes, {} more than the {LENGTH_AT} that the code RAM holds",
                bytes - LENGTH_AT as u64
            ),
            Self::Outside { address, bytes } => {
                write!(f, "{bytes} bytes to load at {address:#010x}, which is outside of the code RAM")
            }
            Self::NotWhole { bytes } => write!(f, "{bytes} bytes, not {LEN}"),
            Self::Length(length) => write!(f, "the image says that {length} bytes are its program"),
            Self::Crc { said, is } => write!(f, "the image says CRC-32 {said:#010x}, its bytes have {is:#010x}"),
            Self::Leftover { address } => write!(f, "behind the program, at {address:#06x}, there is something"),
        }
    }
}

impl std::error::Error for Unfit {}

/// Packs the load segments of a linked program.
///
/// # Errors
/// It is none for this chip, or does not fit.
pub fn package(elf: &[u8]) -> Result<Image, Unfit> {
    let program = elf::read(elf).map_err(Unfit::Elf)?;
    let mut image = vec![0; LEN];
    let mut length = 0;
    for segment in &program.segments {
        let (address, bytes) = (segment.load_address, segment.bytes.len());
        if address as usize >= LEN {
            return Err(Unfit::Outside { address, bytes });
        }
        let end = address as usize + bytes;
        if end > LENGTH_AT {
            return Err(Unfit::TooLarge { bytes: end as u64 });
        }
        image[address as usize..end].copy_from_slice(segment.bytes);
        length = length.max(end);
    }
    let length = length.next_multiple_of(4);
    let crc = crc32(&image[..length]);
    image[LENGTH_AT..CRC_AT].copy_from_slice(&(length as u32).to_le_bytes());
    image[CRC_AT..].copy_from_slice(&crc.to_le_bytes());
    Ok(Image(image))
}

/// Checks what a programmer was sent, as the mote may at its start; returns the program's length in bytes.
///
/// # Errors
/// The first thing that is not as the module documentation says.
pub fn verify(image: &[u8]) -> Result<usize, Unfit> {
    if image.len() != LEN {
        return Err(Unfit::NotWhole { bytes: image.len() });
    }
    let word = |at: usize| image[at..].first_chunk().copied().map_or(0, u32::from_le_bytes);
    let length = word(LENGTH_AT);
    if length == 0 || length % 4 != 0 || length as usize > LENGTH_AT {
        return Err(Unfit::Length(length));
    }
    let (said, is) = (word(CRC_AT), crc32(&image[..length as usize]));
    if said != is {
        return Err(Unfit::Crc { said, is });
    }
    match image[length as usize..LENGTH_AT].iter().position(|&byte| byte != 0) {
        Some(at) => Err(Unfit::Leftover { address: length as usize + at }),
        None => Ok(length as usize),
    }
}

fn crc32(bytes: &[u8]) -> u32 {
    Crc::<u32>::new(&CRC_32_ISO_HDLC).checksum(bytes)
}

impl Image {
    /// All of it.
    #[must_use]
    pub fn bytes(&self) -> &[u8] {
        &self.0
    }

    /// Bytes of the program, as the image says.
    #[must_use]
    pub fn length(&self) -> usize {
        self.0[LENGTH_AT..].first_chunk().copied().map_or(0, u32::from_le_bytes) as usize
    }

    /// The CRC, as the image says.
    #[must_use]
    pub fn crc(&self) -> u32 {
        self.0[CRC_AT..].first_chunk().copied().map_or(0, u32::from_le_bytes)
    }
}
