//! The room and the mote as baked by build.rs: `CONFIG`, `MOTE`, `PAN`.

use lighthouse_mote::identity::{Block, Identity, Reads};

include!(concat!(env!("OUT_DIR"), "/calib.rs"));

/// Who this mote is until a programmer overwrites it. A binary keeps one as a `#[used] static`.
pub const fn identity(reads: Reads) -> Block {
    Block::new(Identity { mote: MOTE, pan: PAN, channel: 0 }, reads)
}
