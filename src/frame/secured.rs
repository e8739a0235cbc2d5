//! Frames that prove who made them: IEEE 802.15.4-2006 security level 1, MIC-32, by AES-CCM* under the room's key.
//!
//! Everybody may read them; nobody without the key can make one, change one or send one a second time. A frame grows by
//! nine bytes:
//!
//! | bytes | what |
//! |---|---|
//! | 0..2 | frame control 0x9849: as in any frame, security enabled |
//! | 2..9 | as in any frame |
//! | 9 | security control 1: level MIC-32, key known without being named (7.6.2.2) |
//! | 10..14 | frame counter: larger in every frame of a mote under one key |
//! | 14.. | the payload as it was, from `LM` on |
//! | last 6..2 | MIC over everything before it |
//! | last 2 | FCS |
//!
//! The nonce is the mote's extended address, the counter and the level (7.6.3.2). Motes have short addresses; the extended
//! one is made of PAN and mote id, [`address`], so that no two motes of a room use a nonce twice.
//!
//! ```
//! use lighthouse_mote::frame::secured::{Key, OVERHEAD, Open};
//! use lighthouse_mote::frame::{Aligned, Header, LEN, Report, emit_into};
//!
//! let key = Key::new(b"sixteen bytes ..");
//! let mut frame = Aligned::BLANK;
//! emit_into(&mut frame, Header { pan: 0x4c48, mote: 7, sequence: 0 }, &Report::default());
//! let plain = frame;
//! assert!(key.seal(&mut frame, 1024));
//! assert_eq!(frame.bytes().len(), LEN + OVERHEAD);
//!
//! let (claim, opened) = key.open(frame.bytes()).expect("made with this key");
//! assert_eq!((claim.mote, claim.counter, opened), (7, 1024, plain));
//! assert_eq!(Key::new(b"another key .. .").open(frame.bytes()), Err(Open::Forged));
//! ```
//!
//! What can go wrong: two motes with one id, or a mote whose counter starts again, use a nonce twice; the second frame is
//! then refused as replayed, and whoever hears both learns what helps to forge one. A forger who guesses is right once in
//! 2^32 frames, 50 days of a channel that carries nothing else.

use aes::Aes128;
use ccm::aead::AeadInOut;
use ccm::consts::{U4, U13};
use ccm::{Ccm, KeyInit, Tag};

use super::{Aligned, BROADCAST, FRAME_CONTROL, MAX_LEN, Reject, fcs, seal};

/// Bytes of a key.
pub const KEY_LEN: usize = 16;
/// MIC-32 (7.6.2.2.1).
pub const LEVEL: u8 = 1;
/// Bytes before the auxiliary header.
const HEADER: usize = 9;
/// Bytes of security control and frame counter.
const AUXILIARY: usize = 5;
/// Bytes of the integrity code.
const MIC: usize = 4;
/// Bytes of the FCS.
const FCS: usize = 2;
/// Bytes that a frame grows by.
pub const OVERHEAD: usize = AUXILIARY + MIC;
/// Bytes of the longest secured frame.
pub const MAX_SECURED_LEN: usize = MAX_LEN + OVERHEAD;
/// Security enabled (7.2.1.1.2).
const SECURED: u16 = 1 << 3;

/// The room's key, ready to be used. It shows itself to nobody.
#[derive(Clone)]
pub struct Key {
    ccm: Ccm<Aes128, U4, U13>,
}

impl core::fmt::Debug for Key {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("Key")
    }
}

/// What a secured frame says before anybody has checked it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Claim {
    /// The personal area network.
    pub pan: u16,
    /// The mote.
    pub mote: u16,
    /// The frame counter.
    pub counter: u32,
}

/// The extended address of a mote, highest byte first: 02 4C 48 00, PAN, mote. Locally administered, so nobody's.
#[must_use]
pub const fn address(pan: u16, mote: u16) -> [u8; 8] {
    let ([pan_high, pan_low], [mote_high, mote_low]) = (pan.to_be_bytes(), mote.to_be_bytes());
    [0x02, b'L', b'H', 0, pan_high, pan_low, mote_high, mote_low]
}

/// Address, counter and level, highest byte first (7.6.3.2).
#[must_use]
pub const fn nonce(address: [u8; 8], counter: u32, level: u8) -> [u8; 13] {
    let [a, b, c, d, e, f, g, h] = address;
    let [i, j, k, l] = counter.to_be_bytes();
    [a, b, c, d, e, f, g, h, i, j, k, l, level]
}

/// What a frame claims, if it is a secured one of ours by its looks; its MIC is for [`Key::open`].
///
/// # Errors
/// What shows that it is not. A plain frame is [`Reject::Header`].
pub fn claim(bytes: &[u8]) -> Result<Claim, Reject> {
    if !(HEADER + AUXILIARY + MIC + FCS..=MAX_SECURED_LEN).contains(&bytes.len()) {
        return Err(Reject::Length);
    }
    if fcs(bytes) != 0 {
        return Err(Reject::Fcs);
    }
    let Some([f0, f1, _, p0, p1, d0, d1, m0, m1, control, c0, c1, c2, c3]) = bytes.first_chunk() else {
        return Err(Reject::Length);
    };
    let word = |low: &u8, high: &u8| u16::from_le_bytes([*low, *high]);
    if word(f0, f1) != FRAME_CONTROL | SECURED || word(d0, d1) != BROADCAST || *control != LEVEL {
        return Err(Reject::Header);
    }
    Ok(Claim { pan: word(p0, p1), mote: word(m0, m1), counter: u32::from_le_bytes([*c0, *c1, *c2, *c3]) })
}

impl Key {
    /// Of these bytes, first byte first.
    #[must_use]
    pub fn new(bytes: &[u8; KEY_LEN]) -> Self {
        Self { ccm: Ccm::new(bytes.into()) }
    }

    /// Secures a plain frame where it is; false, and nothing done, where it is none.
    ///
    /// `counter` must be larger than in every frame of this mote under this key before.
    #[inline(never)]
    #[must_use]
    pub fn seal(&self, frame: &mut Aligned, counter: u32) -> bool {
        let plain = frame.len as usize;
        let Some(payload_end) = plain.checked_sub(FCS) else { return false };
        let (mic_at, len) = (payload_end + AUXILIARY, plain + OVERHEAD);
        let Some(bytes) = frame.room.get_mut(..len) else { return false };
        let Some(&[f0, f1, _, p0, p1, _, _, m0, m1]) = bytes.first_chunk::<HEADER>() else { return false };
        let control = u16::from_le_bytes([f0, f1]);
        if control != FRAME_CONTROL || payload_end < HEADER {
            return false;
        }
        bytes.copy_within(HEADER..payload_end, HEADER + AUXILIARY);
        let [c0, c1, c2, c3] = counter.to_le_bytes();
        let [low, high] = (control | SECURED).to_le_bytes();
        if let Some([first, second, .., at, b0, b1, b2, b3]) = bytes.first_chunk_mut::<{ HEADER + AUXILIARY }>() {
            (*first, *second) = (low, high);
            (*at, *b0, *b1, *b2, *b3) = (LEVEL, c0, c1, c2, c3);
        }
        let address = address(u16::from_le_bytes([p0, p1]), u16::from_le_bytes([m0, m1]));
        let Some((signed, rest)) = bytes.split_at_mut_checked(mic_at) else { return false };
        let nonce = nonce(address, counter, LEVEL).into();
        let Ok(mic) = self.ccm.encrypt_inout_detached(&nonce, signed, (&mut [][..]).into()) else { return false };
        for (place, byte) in rest.iter_mut().zip(mic) {
            *place = byte;
        }
        seal(bytes);
        frame.len = len as u32;
        true
    }

    /// Checks a secured frame; gives what it claims, now believed, and the plain frame that it was made of.
    ///
    /// # Errors
    /// [`Open::Forged`] where the MIC does not fit, otherwise what shows that it is no secured frame of ours.
    pub fn open(&self, bytes: &[u8]) -> Result<(Claim, Aligned), Open> {
        let claim = claim(bytes).map_err(Open::Reject)?;
        let nonce = nonce(address(claim.pan, claim.mote), claim.counter, LEVEL).into();
        let (signed, tail) = bytes.split_at_checked(bytes.len() - MIC - FCS).ok_or(Open::Reject(Reject::Length))?;
        let mic: Tag<U4> = (*tail.first_chunk::<MIC>().ok_or(Open::Reject(Reject::Length))?).into();
        self.ccm.decrypt_inout_detached(&nonce, signed, (&mut [][..]).into(), &mic).map_err(|_| Open::Forged)?;
        let mut plain = Aligned::BLANK;
        let len = bytes.len() - OVERHEAD;
        let payload = signed.get(HEADER + AUXILIARY..).unwrap_or(&[]);
        if let Some(room) = plain.room.get_mut(..len) {
            let header = signed.iter().take(HEADER).chain(payload);
            room.iter_mut().zip(header).for_each(|(place, byte)| *place = *byte);
            if let Some(control) = room.first_chunk_mut() {
                *control = FRAME_CONTROL.to_le_bytes();
            }
            seal(room);
            plain.len = len as u32;
        }
        Ok((claim, plain))
    }
}

/// Why a frame was not opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Open {
    /// The MIC is not what the key makes of the frame.
    Forged,
    /// No secured frame of ours.
    Reject(Reject),
}

#[cfg(test)]
mod tests {
    use ccm::consts::U8;
    use proptest::prelude::*;

    use super::*;
    use crate::frame::{Header, Message, Report, emit_health_into, emit_into, parse};

    const BYTES: [u8; 16] =
        [0xC0, 0xC1, 0xC2, 0xC3, 0xC4, 0xC5, 0xC6, 0xC7, 0xC8, 0xC9, 0xCA, 0xCB, 0xCC, 0xCD, 0xCE, 0xCF];

    fn plain(header: Header) -> Aligned {
        let mut frame = Aligned::BLANK;
        emit_into(&mut frame, header, &Report::default());
        frame
    }

    #[test]
    fn the_standard_s_own_beacon_has_the_standard_s_own_code() {
        // IEEE 802.15.4-2006, C.2.1: MIC-64, of which everything but the length of the code is as here.
        let frame = [
            0x08, 0xD0, 0x84, 0x21, 0x43, 0x01, 0x00, 0x00, 0x00, 0x00, 0x48, 0xDE, 0xAC, 0x02, 0x05, 0x00, 0x00, 0x00,
            0x55, 0xCF, 0x00, 0x00, 0x51, 0x52, 0x53, 0x54,
        ];
        let nonce = nonce([0xAC, 0xDE, 0x48, 0, 0, 0, 0, 1], 5, 2).into();
        let mic = Ccm::<Aes128, U8, U13>::new((&BYTES).into())
            .encrypt_inout_detached(&nonce, &frame, (&mut [][..]).into())
            .unwrap();
        assert_eq!(mic[..], [0x22, 0x3B, 0xC1, 0xEC, 0x84, 0x1A, 0xB5, 0x53]);
    }

    #[test]
    fn the_standard_s_own_command_is_ciphered_as_there() {
        // C.2.3: ENC-MIC-64. The same nonce and key with the payload encrypted.
        let header = [
            0x2B, 0xDC, 0x84, 0x21, 0x43, 0x02, 0x00, 0x00, 0x00, 0x00, 0x48, 0xDE, 0xAC, 0xFF, 0xFF, 0x01, 0x00, 0x00,
            0x00, 0x00, 0x48, 0xDE, 0xAC, 0x06, 0x05, 0x00, 0x00, 0x00, 0x01,
        ];
        let nonce = nonce([0xAC, 0xDE, 0x48, 0, 0, 0, 0, 1], 5, 6).into();
        let mut payload = [0xCE];
        let mic = Ccm::<Aes128, U8, U13>::new((&BYTES).into())
            .encrypt_inout_detached(&nonce, &header, (&mut payload[..]).into())
            .unwrap();
        assert_eq!(payload, [0xD8]);
        assert_eq!(mic[..], [0x4F, 0xDE, 0x52, 0x90, 0x61, 0xF9, 0xC6, 0xF1]);
    }

    #[test]
    fn every_bit_of_a_secured_frame_is_under_the_code() {
        let key = Key::new(&BYTES);
        let mut frame = plain(Header { pan: 0x4c48, mote: 7, sequence: 9 });
        assert!(key.seal(&mut frame, 1));
        let whole = frame.bytes().to_vec();
        for bit in 0..8 * (whole.len() - FCS) {
            let mut bytes = whole.clone();
            bytes[bit / 8] ^= 1 << (bit % 8);
            seal(&mut bytes);
            assert!(key.open(&bytes).is_err(), "bit {bit}");
        }
        let other = Key::new(&[7; 16]);
        assert_eq!(other.open(&whole), Err(Open::Forged));
    }

    #[test]
    fn what_is_no_plain_frame_is_left_as_it_is() {
        let key = Key::new(&BYTES);
        let mut blank = Aligned::BLANK;
        assert!(!key.seal(&mut blank, 1) && blank == Aligned::BLANK);
        let mut frame = plain(Header::default());
        assert!(key.seal(&mut frame, 1));
        let once = frame;
        assert!(!key.seal(&mut frame, 2) && frame == once);
        // A listener without a key refuses it by its header or its length.
        assert!(parse(frame.bytes()).is_err());
        assert_eq!(claim(plain(Header::default()).bytes()), Err(Reject::Header));
    }

    proptest! {
        #[test]
        fn a_secured_frame_comes_back_as_it_was(
            pan: u16, mote: u16, sequence: u16, counter: u32, bytes: [u8; 16], long: bool,
        ) {
            let header = Header { pan, mote, sequence };
            let mut frame = plain(header);
            if long {
                emit_health_into(&mut frame, header, &crate::frame::Health::default());
            }
            let before = frame;
            let key = Key::new(&bytes);
            prop_assert!(key.seal(&mut frame, counter));
            prop_assert_eq!(frame.bytes().len(), before.bytes().len() + OVERHEAD);
            let (claim, plain) = key.open(frame.bytes()).unwrap();
            prop_assert_eq!(claim, Claim { pan, mote, counter });
            prop_assert_eq!(plain.bytes(), before.bytes());
            let is_fix = matches!(parse(plain.bytes()), Ok((_, Message::Fix(_))));
            prop_assert_eq!(is_fix, !long);
        }

        #[test]
        fn arbitrary_bytes_open_nothing(bytes in prop::collection::vec(any::<u8>(), 0..140), sound: bool) {
            let mut bytes = bytes;
            if sound {
                seal(&mut bytes);
            }
            prop_assert!(Key::new(&BYTES).open(&bytes).is_err());
        }
    }
}
