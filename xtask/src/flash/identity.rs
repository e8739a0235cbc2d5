//! One built program, another mote: the identity block of `lighthouse_mote::identity`, overwritten in the ELF file.
//!
//! What can go wrong: a program without such a block, with two, of another layout, or whose firmware does not heed what
//! is asked for. None of them is changed.

use std::fmt;

use lighthouse_mote::identity::{self, Identity, READS_ADDRESS, READS_CHANNEL, Reads};
use sim::elf::{self, LoadError};

/// What is to be different.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Change {
    /// Another mote id.
    pub mote: Option<u16>,
    /// Another PAN id.
    pub pan: Option<u16>,
    /// Another channel.
    pub channel: Option<u8>,
}

/// Why a program's identity cannot be read or changed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Fixed {
    /// The file is no program.
    Elf(LoadError),
    /// It has no block.
    None,
    /// It has several.
    Several(usize),
    /// A block of a layout that this program does not know.
    Version(u8),
    /// The firmware does not heed it.
    NotRead(&'static str),
}

impl fmt::Display for Fixed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Elf(error) => error.fmt(f),
            Self::None => write!(f, "the firmware has no identity block; its id is the one under [mote] in the room"),
            Self::Several(count) => write!(f, "the firmware has {count} identity blocks, and one is to be changed"),
            Self::Version(version) => {
                write!(f, "the firmware's identity block is of version {version}, not {}", identity::VERSION)
            }
            Self::NotRead(what) => write!(f, "this board's firmware does not take its {what} from the identity block"),
        }
    }
}

impl std::error::Error for Fixed {}

/// Who the mote is that would run this program.
///
/// # Errors
/// There is no such block, or not one.
pub fn read(elf: &[u8]) -> Result<Identity, Fixed> {
    find(elf).map(|(_, identity, _)| identity)
}

/// The program with another identity.
///
/// # Errors
/// There is no such block, or not one, or the firmware does not heed what is asked for.
pub fn patch(elf: &[u8], change: Change) -> Result<Vec<u8>, Fixed> {
    let mut patched = elf.to_vec();
    if change == Change::default() {
        return Ok(patched);
    }
    let (at, identity, reads) = find(elf)?;
    let asked = [
        (change.mote.is_some(), READS_ADDRESS, "mote id"),
        (change.pan.is_some(), READS_ADDRESS, "PAN id"),
        (change.channel.is_some(), READS_CHANNEL, "channel"),
    ];
    if let Some((_, _, what)) = asked.iter().find(|(asked, bit, _)| *asked && reads & bit == 0) {
        return Err(Fixed::NotRead(what));
    }
    let identity = Identity {
        mote: change.mote.unwrap_or(identity.mote),
        pan: change.pan.unwrap_or(identity.pan),
        channel: change.channel.unwrap_or(identity.channel),
    };
    patched[at..at + identity::LEN].copy_from_slice(&identity::emit(identity, reads));
    Ok(patched)
}

/// The program with its frame counter beginning at `first`, if its frames are secured; as it was if not.
///
/// # Errors
/// The file is no program, or has several such places.
pub fn count_from(elf: &[u8], first: u32) -> Result<Vec<u8>, Fixed> {
    let places = places(elf, &identity::COUNTER_MAGIC, identity::COUNTER_LEN)?;
    let mut patched = elf.to_vec();
    match places[..] {
        [] => Ok(patched),
        [at] => {
            let at = at + identity::COUNTER_MAGIC.len();
            patched[at..at + 4].copy_from_slice(&first.to_le_bytes());
            Ok(patched)
        }
        _ => Err(Fixed::Several(places.len())),
    }
}

/// Where in the file words of the program begin with `magic`.
fn places(elf: &[u8], magic: &[u8], len: usize) -> Result<Vec<usize>, Fixed> {
    let program = elf::read(elf).map_err(Fixed::Elf)?;
    let mut found = Vec::new();
    for segment in &program.segments {
        for (at, bytes) in segment.bytes.windows(len).enumerate() {
            if (segment.load_address as usize + at).is_multiple_of(4) && bytes.starts_with(magic) {
                found.push(segment.offset + at);
            }
        }
    }
    Ok(found)
}

/// The block: where in the file, and what it says.
fn find(elf: &[u8]) -> Result<(usize, Identity, Reads), Fixed> {
    let found = places(elf, &identity::MAGIC, identity::LEN)?;
    let [at] = found[..] else {
        return Err(if found.is_empty() { Fixed::None } else { Fixed::Several(found.len()) });
    };
    let bytes = &elf[at..at + identity::LEN];
    let block = bytes.first_chunk().and_then(identity::parse);
    let (identity, reads) = block.ok_or(Fixed::Version(bytes[identity::MAGIC.len()]))?;
    Ok((at, identity, reads))
}
