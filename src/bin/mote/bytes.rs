//! Frames as a stream of bytes, for boards that send them over a wire: each behind a byte with its length.
//!
//! What can go wrong: a listener that comes late does not know where a frame begins. It looks for a length behind which
//! the check sequence fits.

use lighthouse_mote::frame::Aligned;

use super::queue::Reader;
use super::stages::FRAMES;

/// The bytes of the frames that wait.
pub struct Bytes {
    frames: Reader<Aligned, FRAMES>,
    /// Of the oldest, its length among them.
    sent: usize,
}

impl Bytes {
    /// From the next frame on.
    pub const fn new(frames: Reader<Aligned, FRAMES>) -> Self {
        Self { frames, sent: 0 }
    }

    /// The next byte, if a frame waits.
    pub fn next(&mut self) -> Option<u8> {
        let frame = self.frames.oldest()?.bytes();
        // A frame has at most 127 bytes (IEEE 802.15.4-2006, 6.4.1).
        let byte = self.sent.checked_sub(1).map_or(Some(frame.len() as u8), |at| frame.get(at).copied());
        self.sent += 1;
        if self.sent > frame.len() {
            self.sent = 0;
            self.frames.pop();
        }
        byte
    }
}
