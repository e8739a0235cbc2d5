//! A frame as the radio's memory access wants it.
//!
//! In 802.15.4 mode the radio adds preamble and start delimiter before, and the CRC after. What it reads from memory is
//! the length byte (PHR) and the PSDU without its last two bytes; the length counts those two all the same
//! (PCNF0.CRCINC). `lighthouse_mote::frame::emit` writes them too: they are dropped here and made again by the radio,
//! with the same polynomial, so there is one thing less that both ends have to agree on and no mode to switch.
//!
//! What can go wrong: a frame longer than 127 bytes cannot be sent (802.15.4-2006, 6.4.1); it is refused.

/// Bytes of PHR and the longest PSDU (IEEE 802.15.4-2006, 6.4.1, aMaxPHYPacketSize).
pub const MAX_PSDU: usize = 127;
/// Bytes of the frame check sequence, the radio's to write.
const FCS: usize = 2;

/// What the radio reads: the length, then as many bytes less two.
#[derive(Debug)]
pub struct Psdu([u8; 1 + MAX_PSDU]);

impl Psdu {
    /// Nothing to send.
    pub const fn new() -> Self {
        Self([0; 1 + MAX_PSDU])
    }

    /// Takes a frame that ends in its FCS; false if it is none that can be sent.
    pub fn load(&mut self, frame: &[u8]) -> bool {
        let [phr, psdu @ ..] = &mut self.0;
        let Some((body, _)) = frame.split_last_chunk::<FCS>() else { return false };
        let (Ok(length), Some(place)) = (u8::try_from(frame.len()), psdu.get_mut(..body.len())) else { return false };
        if frame.len() > MAX_PSDU {
            return false;
        }
        *phr = length;
        place.copy_from_slice(body);
        true
    }

    /// The bytes, length first.
    pub const fn bytes(&self) -> &[u8] {
        &self.0
    }
}
