//! Who a mote is: a block in the image that the programmer overwrites, so that one build serves every mote of a room.
//!
//! | bytes | what |
//! |---|---|
//! | 0..8 | [`MAGIC`]: where the block is |
//! | 8 | version of this layout, [`VERSION`] |
//! | 9 | IEEE 802.15.4 channel, 11 ..= 26; 0: what the board sends on by itself |
//! | 10..12 | mote id, the short address |
//! | 12..14 | PAN id |
//! | 14..16 | [`Reads`]: what the firmware takes from here, so that nobody sets what is not heeded |
//!
//! Little-endian, 16 bytes, on a word, once in an image.
//!
//! ```
//! use lighthouse_mote::identity::{Identity, LEN, MAGIC, READS_ADDRESS, emit, parse};
//!
//! // What a programmer does with an image: look for the block, keep what the firmware reads, put another mote there.
//! let built = Identity { mote: 1, pan: 0x4c48, channel: 0 };
//! let mut image = [&[0xff; 40][..], &emit(built, READS_ADDRESS)].concat();
//! let at = image.windows(MAGIC.len()).position(|bytes| bytes == MAGIC).expect("an image of ours");
//! let block: &mut [u8; LEN] = (&mut image[at..at + LEN]).try_into().expect("the whole block");
//! let (identity, reads) = parse(block).expect("of this version");
//! *block = emit(Identity { mote: 7, ..identity }, reads);
//! assert_eq!(parse(block), Some((Identity { mote: 7, ..built }, READS_ADDRESS)));
//! ```
//!
//! What can go wrong: a compiler that knows the block's value and folds it into the code; [`Block::read`] hides the
//! block from it, and a test boots an overwritten image.

use core::hint::black_box;

/// How a block begins.
pub const MAGIC: [u8; 8] = *b"LHmoteID";
/// The layout in the module documentation.
pub const VERSION: u8 = 1;
/// Bytes of a block.
pub const LEN: usize = 16;

/// What a firmware takes from its block, a bit each.
pub type Reads = u16;
/// The mote id and the PAN id.
pub const READS_ADDRESS: Reads = 1;
/// The channel.
pub const READS_CHANNEL: Reads = 2;

/// Who a mote is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Identity {
    /// Short address, 0 ..= 0xFFFD.
    pub mote: u16,
    /// PAN id, 0 ..= 0xFFFE.
    pub pan: u16,
    /// IEEE 802.15.4 channel, 11 ..= 26; 0: what the board sends on by itself.
    pub channel: u8,
}

/// The block as it lies in the image. A binary keeps one as a `#[used] static`.
#[repr(C, align(4))]
pub struct Block {
    magic: [u8; 8],
    version: u8,
    channel: u8,
    mote: u16,
    pan: u16,
    reads: Reads,
}

const _: () = assert!(size_of::<Block>() == LEN);

impl Block {
    /// Who the mote is unless a programmer says otherwise, and what of it the firmware reads.
    #[must_use]
    pub const fn new(identity: Identity, reads: Reads) -> Self {
        let Identity { mote, pan, channel } = identity;
        Self { magic: MAGIC, version: VERSION, channel, mote, pan, reads }
    }

    /// What the block says now.
    #[must_use]
    pub fn read(&'static self) -> Identity {
        let &Self { mote, pan, channel, .. } = black_box(self);
        Identity { mote, pan, channel }
    }
}

/// The block of an image, for those who overwrite it; `None` if the bytes are none of this version.
#[must_use]
pub fn parse(bytes: &[u8; LEN]) -> Option<(Identity, Reads)> {
    let [m0, m1, m2, m3, m4, m5, m6, m7, version, channel, mote0, mote1, pan0, pan1, reads0, reads1] = *bytes;
    if [m0, m1, m2, m3, m4, m5, m6, m7] != MAGIC || version != VERSION {
        return None;
    }
    let identity =
        Identity { mote: u16::from_le_bytes([mote0, mote1]), pan: u16::from_le_bytes([pan0, pan1]), channel };
    Some((identity, u16::from_le_bytes([reads0, reads1])))
}

/// A block as bytes: what [`parse`] takes apart.
#[must_use]
pub fn emit(identity: Identity, reads: Reads) -> [u8; LEN] {
    let [m0, m1, m2, m3, m4, m5, m6, m7] = MAGIC;
    let ([mote0, mote1], [pan0, pan1], [reads0, reads1]) =
        (identity.mote.to_le_bytes(), identity.pan.to_le_bytes(), reads.to_le_bytes());
    [m0, m1, m2, m3, m4, m5, m6, m7, VERSION, identity.channel, mote0, mote1, pan0, pan1, reads0, reads1]
}

/// How the place begins where a programmer says at which frame counter a mote is to start.
pub const COUNTER_MAGIC: [u8; 8] = *b"LHcountr";
/// Bytes of that place: [`COUNTER_MAGIC`], and the counter, little-endian.
pub const COUNTER_LEN: usize = 12;

/// The first frame counter, in images whose frames are secured. A binary keeps one as a `#[used] static`.
///
/// A programmer writes [`first_counter`]; no image is programmed twice with the same one.
#[repr(C, align(4))]
pub struct FirstCounter {
    magic: [u8; 8],
    first: u32,
}

const _: () = assert!(size_of::<FirstCounter>() == COUNTER_LEN);

impl FirstCounter {
    /// Zero until a programmer says otherwise.
    #[must_use]
    #[allow(clippy::new_without_default, reason = "it is for a static")]
    pub const fn new() -> Self {
        Self { magic: COUNTER_MAGIC, first: 0 }
    }

    /// What the place says now.
    #[must_use]
    pub fn read(&'static self) -> u32 {
        let &Self { first, .. } = black_box(self);
        first
    }
}

/// The counter to begin with for a mote that is programmed now: minutes since 2025 began (UTC), times 1024. A mote that
/// sends no more than 17 frames a second never overtakes it; it lasts until 2032.
#[must_use]
pub const fn first_counter(unix_seconds: u64) -> u32 {
    let minutes = unix_seconds.saturating_sub(1_735_689_600) / 60;
    if minutes >= 1 << 22 { u32::MAX } else { (minutes as u32) << 10 }
}
