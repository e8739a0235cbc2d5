//! What receivers say over a serial line, taken apart.
//!
//! # nRF Sniffer for 802.15.4
//! Lines of text. It takes `sleep`, `channel N` and `receive`, each ended by `\r\n`, and says for each frame
//! `received: HEX power: DBM lqi: N time: MICROSECONDS`. The hexadecimal ends with the two bytes of the check sequence,
//! which its radio has checked and overwritten: they are made anew. Its echo and its prompt are text like any other and
//! mean nothing, as long as they are text and have none of a frame's words. (NordicSemiconductor/nRF-Sniffer-for-802.15.4,
//! `nrf802154_sniffer.py`.)
//!
//! # OpenMote
//! HDLC frames, of two firmwares. OpenWSN's `03oos_sniffer` sends `P`, two bytes of its own id, the frame and the channel
//! (openwsn-fw, `openserial_printSniffedPacket`). The OpenMote sniffer sends an Ethernet header of type 0x809A, the
//! frame, zeros up to 60 bytes, the power and a byte of which bit 7 says that the check sequence fitted
//! (imec-idlab/OpenMote-CC2538-Sniffer, `SnifferCommon.cpp`; the power is 73 dB off, CC2538 user's guide 23.10.3).
//!
//! What can go wrong: a digit that changes on the way from the nRF Sniffer is a changed frame whose check sequence fits, for
//! its own is lost; USB checks what it carries. An OpenWSN sniffer whose radio overwrites the check sequence hands over damaged frames as if they
//! were sound. As soon as one right check sequence came from a receiver, all are looked at.

use lighthouse_mote::frame::{self, fcs};

use serde::Serialize;

use crate::capture::with_check;
use crate::hdlc::Decoder;

/// How well a receiver heard a frame; what it does not say is none.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct Signal {
    /// Received power, dBm.
    pub rssi_dbm: Option<i16>,
    /// Link quality, 0 ..= 255, of the receiver's own making.
    pub lqi: Option<u8>,
}

/// Why something is no frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Damage {
    /// The receiver found the check sequence wrong.
    Fcs,
    /// The receiver's protocol does not have it.
    Line,
    /// HDLC's check sequence or stuffing is wrong.
    Hdlc,
}

/// What came over the line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Item {
    /// A frame with its check sequence.
    Frame(Vec<u8>, Signal),
    /// Something that should have been one.
    Bad(Damage, Vec<u8>),
}

/// The receivers there are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum Kind {
    /// An nRF52840 with Nordic's nRF Sniffer for 802.15.4
    Nrf,
    /// An OpenMote with OpenWSN's sniffer or the OpenMote sniffer
    Openmote,
}

impl Kind {
    /// As the JSON names it.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Nrf => "nrf",
            Self::Openmote => "openmote",
        }
    }

    /// What it wants to be told before it listens on a channel.
    #[must_use]
    pub fn greeting(self, channel: u8) -> Vec<u8> {
        match self {
            // An empty line first ends whatever half a command stands there.
            Self::Nrf => format!("\r\nsleep\r\nchannel {channel}\r\nreceive\r\n").into_bytes(),
            // Its channel is compiled in.
            Self::Openmote => Vec::new(),
        }
    }

    /// An ear for it.
    #[must_use]
    pub fn ear(self) -> Ear {
        match self {
            Self::Nrf => Ear::Nrf(Lines::default()),
            Self::Openmote => Ear::Openmote { decoder: Decoder::default(), has_check: false },
        }
    }
}

/// Makes frames of bytes.
#[derive(Debug)]
pub enum Ear {
    /// Of lines.
    Nrf(Lines),
    /// Of HDLC frames.
    Openmote {
        /// Undoes HDLC.
        decoder: Decoder,
        /// A right check sequence came: all are looked at.
        has_check: bool,
    },
}

impl Ear {
    /// Takes bytes as they come.
    pub fn hear(&mut self, bytes: &[u8], mut take: impl FnMut(Item)) {
        match self {
            Self::Nrf(lines) => bytes.iter().for_each(|byte| lines.hear(*byte, &mut take)),
            Self::Openmote { decoder, has_check } => {
                for byte in bytes {
                    let item = match decoder.take(*byte) {
                        None => continue,
                        Some(Ok(payload)) => openmote(&payload, has_check),
                        Some(Err(bytes)) => Some(Item::Bad(Damage::Hdlc, bytes)),
                    };
                    item.into_iter().for_each(&mut take);
                }
            }
        }
    }
}

/// What stands before a frame of the nRF Sniffer's.
const BEGINS: &[u8] = b"received:";
/// What the nRF Sniffer says of nothing but a frame.
const WORDS: [&[u8]; 4] = [BEGINS, b"power:", b"lqi:", b"time:"];
/// Longest line of the nRF Sniffer: 127 bytes in hexadecimal and what stands around them is 320.
const LONGEST_LINE: usize = 512;
/// Most bytes of a frame: aMaxPHYPacketSize.
const LONGEST_FRAME: usize = 127;
/// Fewest: an acknowledgement without its check sequence, and that.
const SHORTEST_FRAME: usize = 5;

/// Lines as they grow.
#[derive(Debug, Default)]
pub struct Lines {
    line: Vec<u8>,
    /// The rest of a line too long is none either.
    overlong: bool,
}

impl Lines {
    fn hear(&mut self, byte: u8, take: &mut impl FnMut(Item)) {
        let ends = byte == b'\n';
        if !ends {
            self.line.push(byte);
            if self.line.len() < LONGEST_LINE {
                return;
            }
        }
        let line = std::mem::take(&mut self.line);
        match (ends, self.overlong) {
            (true, false) => nrf(&line, take),
            (true, true) if line.is_empty() => {}
            _ => take(Item::Bad(Damage::Line, line)),
        }
        self.overlong = !ends;
    }
}

/// One line: what stands before its first frame, and each frame, as more follow where an end of line was lost.
fn nrf(line: &[u8], take: &mut impl FnMut(Item)) {
    let mut rest = line;
    while let Some(at) = find(rest, BEGINS) {
        let (before, from) = rest.split_at(at);
        let length = find(&from[BEGINS.len()..], BEGINS).map_or(from.len(), |next| BEGINS.len() + next);
        let (one, after) = from.split_at(length);
        talk(before, take);
        take(received(&one[BEGINS.len()..]).unwrap_or_else(|| Item::Bad(Damage::Line, one.to_vec())));
        rest = after;
    }
    talk(rest, take);
}

fn find(bytes: &[u8], word: &[u8]) -> Option<usize> {
    bytes.windows(word.len()).position(|window| window == word)
}

/// Whether it means nothing. The prompt of a shell has escape sequences.
fn is_talk(bytes: &[u8]) -> bool {
    let is_text = bytes.iter().all(|byte| matches!(byte, b' '..=b'~' | b'\r' | b'\t' | 0x08 | 0x1B));
    is_text && WORDS.iter().all(|word| find(bytes, word).is_none())
}

fn talk(bytes: &[u8], take: &mut impl FnMut(Item)) {
    if !is_talk(bytes) {
        take(Item::Bad(Damage::Line, bytes.to_vec()));
    }
}

/// What stands behind [`BEGINS`].
fn received(rest: &[u8]) -> Option<Item> {
    let text = str::from_utf8(rest).ok()?;
    let mut words = text.split_ascii_whitespace();
    let bytes = hex::decode(words.next()?).ok()?;
    if !(SHORTEST_FRAME..=LONGEST_FRAME).contains(&bytes.len()) {
        return None;
    }
    let mut named = |name| if words.next()? == name { words.next()?.parse::<i64>().ok() } else { None };
    let (power, lqi, _time) = (named("power:")?, named("lqi:")?, named("time:")?);
    if !words.all(|word| is_talk(word.as_bytes())) {
        return None;
    }
    let signal = Signal { rssi_dbm: i16::try_from(power).ok(), lqi: u8::try_from(lqi.clamp(0, 255)).ok() };
    Some(Item::Frame(checked(bytes), signal))
}

/// The frame with its last two bytes made its check sequence, if they are not.
fn checked(bytes: Vec<u8>) -> Vec<u8> {
    if fcs(&bytes) == 0 {
        return bytes;
    }
    with_check(bytes.get(..bytes.len().saturating_sub(2)).unwrap_or(&[]))
}

/// What an OpenWSN mote calls a sniffed packet.
const SNIFFED: u8 = b'P';
/// Between the Ethernet addresses and the frame.
const ETHERNET_TYPE: [u8; 2] = [0x80, 0x9A];
const ETHERNET_HEADER: usize = 14;
/// What the OpenMote sniffer fills up to, the two bytes at the end included.
const ETHERNET_SHORTEST: usize = 60;
/// What the CC2538 adds to the power.
const RSSI_OFFSET_DB: i16 = 73;
/// The check sequence fitted.
const CHECKED: u8 = 0x80;

/// One HDLC payload; nothing if it is of another kind.
fn openmote(payload: &[u8], has_check: &mut bool) -> Option<Item> {
    let bad = || Some(Item::Bad(Damage::Line, payload.to_vec()));
    if payload.get(12..ETHERNET_HEADER) == Some(&ETHERNET_TYPE) {
        let Some((body, &[power, flags])) = payload[ETHERNET_HEADER..].split_last_chunk::<2>() else { return bad() };
        let power = i16::from(power.cast_signed()) - RSSI_OFFSET_DB;
        let signal = Signal { rssi_dbm: Some(power), lqi: Some(flags & !CHECKED) };
        let Some(frame) = ethernet(body, payload.len() == ETHERNET_SHORTEST) else { return bad() };
        return Some(match flags & CHECKED {
            0 => Item::Bad(Damage::Fcs, frame),
            _ => Item::Frame(frame, signal),
        });
    }
    match payload.split_first() {
        Some((&SNIFFED, [_, _, frame @ .., _channel])) => {
            if !(SHORTEST_FRAME..=LONGEST_FRAME).contains(&frame.len()) {
                return bad();
            }
            *has_check |= fcs(frame) == 0;
            let frame = if *has_check { frame.to_vec() } else { checked(frame.to_vec()) };
            Some(Item::Frame(frame, Signal::default()))
        }
        // Status, debugging and data of an OpenWSN mote.
        Some((b'A'..=b'Z', _)) => None,
        _ => bad(),
    }
}

/// The frame of the OpenMote sniffer, whose radio has checked it: with its check sequence, or without, or with zeros
/// behind it.
fn ethernet(body: &[u8], padded: bool) -> Option<Vec<u8>> {
    let fits = |length: &usize| {
        let with_it = body.get(..*length).unwrap_or(&[]);
        fcs(with_it) == 0
    };
    let zeros = if padded { body.iter().rev().take_while(|byte| **byte == 0).count() } else { 0 };
    let lengths = (body.len() - zeros).max(SHORTEST_FRAME)..=body.len();
    if body.len() < SHORTEST_FRAME || body.len() > LONGEST_FRAME {
        return None;
    }
    // A check sequence stays right with zeros behind it, and one that ends in zeros is right without them.
    let is_ours = |length: &usize| frame::parse(&body[..*length]).is_ok();
    let fitting: Vec<usize> = lengths.filter(fits).collect();
    match fitting.iter().find(|length| is_ours(length)).or(fitting.first()) {
        Some(length) => Some(body[..*length].to_vec()),
        None => Some(with_check(body)),
    }
}

#[cfg(test)]
mod tests {
    use lighthouse_mote::frame::{Header, Report, emit};
    use proptest::prelude::*;

    use super::*;
    use crate::hdlc::encode;

    fn frame() -> Vec<u8> {
        emit(Header { pan: 0x4C48, mote: 9, sequence: 77 }, &Report::default()).to_vec()
    }

    fn hear(kind: Kind, bytes: &[u8]) -> Vec<Item> {
        let mut items = Vec::new();
        kind.ear().hear(bytes, |item| items.push(item));
        items
    }

    /// As the nRF Sniffer says it: the check sequence is the radio's own.
    fn line(frame: &[u8]) -> String {
        let hex = hex::encode(&frame[..frame.len() - 2]);
        format!("received: {hex}6bc0 power: -52 lqi: 200 time: 34918572\r\n")
    }

    #[test]
    fn the_nrf_sniffers_lines_are_frames() {
        let said =
            format!("sleep\r\nchannel 11\r\nreceive\r\n{}\x1b[32muart:~$ \x1b[0m{}", line(&frame()), line(&frame()));
        let signal = Signal { rssi_dbm: Some(-52), lqi: Some(200) };
        assert_eq!(hear(Kind::Nrf, said.as_bytes()), vec![Item::Frame(frame(), signal); 2]);
    }

    #[test]
    fn a_line_that_is_none_is_counted_and_the_next_is_read() {
        let bad = [
            &b"received: 0 power: 1 lqi: 1 time: 1\n"[..],
            b"received: 0102030405zz power: 1 lqi: 1 time: 1\n",
            b"received: 010203040506 power: 1 time: 1\n",
            b"received: \xff\xfe\n",
            b"\x00\x80garbage\n",
            // One byte of what begins a frame, and of what ends the line before.
            b"recexved: 010203040506 power: 1 lqi: 1 time: 1\n",
            b"received: 010203040506 power: 1 lqi: 1 time: 1 \x80\n",
            b"received: 010203040506 power: 1 lqi: 1 time: 1 power: 2\n",
        ];
        for bad in bad {
            let items = hear(Kind::Nrf, &[bad, line(&frame()).as_bytes()].concat());
            let [Item::Bad(Damage::Line, _), Item::Frame(good, _)] = &items[..] else { panic!("{bad:?}: {items:?}") };
            assert_eq!(*good, frame());
        }
    }

    #[test]
    fn frames_whose_line_lost_its_end_are_all_read() {
        let said = line(&frame());
        let stream = [said.trim_end(), "\r", &said[..20], &said, &said].concat();
        let items = hear(Kind::Nrf, stream.as_bytes());
        let [Item::Frame(..), Item::Bad(Damage::Line, half), Item::Frame(..), Item::Frame(..)] = &items[..] else {
            panic!("{items:?}")
        };
        assert_eq!(half, &said.as_bytes()[..20]);
    }

    #[test]
    fn every_byte_of_a_line_too_long_is_counted() {
        for extra in [0, 1, LONGEST_LINE, 6000] {
            let long = ["received: ", &"ab".repeat(LONGEST_LINE), &"c".repeat(extra)].concat();
            let mut items = hear(Kind::Nrf, [&long, "\n", &line(&frame())].concat().as_bytes());
            assert!(matches!(items.pop(), Some(Item::Frame(..))), "{extra}");
            let bad = items.iter().map(|item| match item {
                Item::Bad(Damage::Line, bytes) if bytes.len() <= LONGEST_LINE => bytes.len(),
                other => panic!("{other:?}"),
            });
            assert_eq!(bad.sum::<usize>(), long.len());
        }
    }

    #[test]
    fn openwsns_packets_are_frames_with_or_without_their_check_sequence() {
        let packet = |frame: &[u8]| encode(&[b"P\x01\x02", frame, &[20]].concat());
        let overwritten = |frame: &[u8]| [&frame[..frame.len() - 2], &[0x55, 0xAA]].concat();
        let status = encode(b"S\x01\x02 all is well");
        let stream = [packet(&overwritten(&frame())), status, packet(&frame())].concat();
        assert_eq!(hear(Kind::Openmote, &stream), vec![Item::Frame(frame(), Signal::default()); 2]);
        // A receiver that has shown a right one is taken at its word.
        let stream = [packet(&frame()), packet(&overwritten(&frame()))].concat();
        let damaged = Item::Frame(overwritten(&frame()), Signal::default());
        assert_eq!(hear(Kind::Openmote, &stream)[1], damaged);
    }

    #[test]
    fn the_openmote_sniffers_packets_are_frames() {
        let packet = |frame: &[u8], flags: u8| {
            let mut bytes = [&[0xFF; 6][..], &[2; 6], &ETHERNET_TYPE, frame].concat();
            bytes.resize(bytes.len().max(ETHERNET_SHORTEST - 2), 0);
            bytes.extend([20u8.wrapping_neg(), flags]);
            encode(&bytes)
        };
        let signal = Signal { rssi_dbm: Some(-93), lqi: Some(100) };
        let bare = &frame()[..frame().len() - 2];
        assert_eq!(hear(Kind::Openmote, &packet(bare, CHECKED | 100)), [Item::Frame(frame(), signal)]);
        assert_eq!(hear(Kind::Openmote, &packet(&frame(), CHECKED | 100)), [Item::Frame(frame(), signal)]);
        let short = with_check(&[1, 2, 3, 4, 5, 6, 0]);
        assert_eq!(hear(Kind::Openmote, &packet(&short, CHECKED | 100)), [Item::Frame(short, signal)]);
        assert_eq!(hear(Kind::Openmote, &packet(bare, 100)), [Item::Bad(Damage::Fcs, frame())]);
    }

    proptest! {
        #[test]
        fn any_bytes_are_heard(bytes: Vec<u8>, cut in 0usize..64) {
            for kind in [Kind::Nrf, Kind::Openmote] {
                let whole = hear(kind, &bytes);
                // However they are cut into pieces.
                let mut pieces = Vec::new();
                let mut ear = kind.ear();
                for piece in bytes.chunks(cut + 1) {
                    ear.hear(piece, |item| pieces.push(item));
                }
                prop_assert_eq!(&whole, &pieces);
                for item in whole {
                    if let Item::Frame(bytes, _) = item {
                        prop_assert!(bytes.len() <= LONGEST_FRAME);
                        let _ = lighthouse_mote::frame::parse(&bytes);
                    }
                }
            }
        }

        #[test]
        fn any_payload_of_hdlc_is_heard(payload in prop::collection::vec(any::<u8>(), 0..300), kind in 0usize..3) {
            let mut payload = payload;
            match kind {
                0 => payload.insert(0, SNIFFED),
                1 if payload.len() >= 14 => payload[12..14].copy_from_slice(&ETHERNET_TYPE),
                _ => {}
            }
            for item in hear(Kind::Openmote, &encode(&payload)) {
                let (Item::Frame(bytes, _) | Item::Bad(_, bytes)) = item;
                prop_assert!(bytes.len() <= 512);
            }
        }

        #[test]
        fn any_text_is_heard(text in "(received: [0-9a-f]{0,300}( power: -?[0-9]{1,25}| lqi: [0-9]{1,4}| time: [0-9-]{1,12}|\n){0,4}\n){0,4}") {
            hear(Kind::Nrf, text.as_bytes());
        }
    }
}
