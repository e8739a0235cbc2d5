//! Captures that somebody damaged, and files that never were any.
//!
//! What a reader of a few lines finds is found, no more and no less: so many frames, so many that are none, and whether it
//! ends where it should. However the bytes come in pieces the same comes of them, and nobody waits for bytes that are not
//! needed.
#![no_main]

use std::io::Read;

use air::capture::{records, tap_header, with_check};
use libfuzzer_sys::fuzz_target;

/// As `air` has them from libpcap and Wireshark.
const LONGEST_FRAME: usize = 1 << 18;
const LONGEST_BLOCK: usize = 1 << 24;

fuzz_target!(|bytes: &[u8]| {
    let Some(([how, piece], rest)) = bytes.split_first_chunk::<2>() else { return };
    let bytes = match how & 3 {
        0 => rest.to_vec(),
        1 => damaged(classic(how >> 2 & 3), rest),
        _ => damaged(newer(how >> 2 & 3), rest),
    };
    let (read, says) = read(&bytes[..]);
    let (again, same) = self::read(Pieces { bytes: &bytes, most: usize::from(*piece) + 1 });
    assert_eq!((&read, &says), (&again, &same), "in pieces");
    let found = if bytes.starts_with(&[0x0A, 0x0D, 0x0D, 0x0A]) { walk_newer(&bytes) } else { walk_classic(&bytes) };
    let Some(found) = found else {
        assert!(read.is_empty() && says.is_some(), "{read:?}");
        return;
    };
    match says {
        None => assert!(found.is_whole && read == found.frames, "{read:?}, {found:?}"),
        Some(says) => assert!(!found.is_whole && read == found.frames, "{says}: {read:?}, {found:?}"),
    }
});

/// What is in each record, and the complaint at the end.
fn read(from: impl Read) -> (Vec<Option<Vec<u8>>>, Option<String>) {
    let mut read = Vec::new();
    let ended = records("air", from, |record| {
        read.push(record.frame.as_deref().map(<[u8]>::to_vec));
        true
    });
    (read, ended.err().map(|error| format!("{error:#}")))
}

/// Bytes that come so many at a time.
struct Pieces<'a> {
    bytes: &'a [u8],
    most: usize,
}

impl Read for Pieces<'_> {
    fn read(&mut self, to: &mut [u8]) -> std::io::Result<usize> {
        let most = self.most.min(to.len());
        self.bytes.read(&mut to[..most])
    }
}

const FRAME: &[u8] = b"\x41\x88\x07\xCD\xAB\xFF\xFF\x01\x00light\x12\x34";

/// As a sniffer of link type `link` hands a frame over.
fn sniffed(link: u8) -> (u32, Vec<u8>) {
    match link {
        0 => (195, FRAME.to_vec()),
        1 => (230, FRAME.to_vec()),
        _ => (283, [&tap_header(Some(-60.0), Some(7))[..], FRAME].concat()),
    }
}

fn words(words: &[u32]) -> Vec<u8> {
    words.iter().flat_map(|word| word.to_le_bytes()).collect()
}

fn classic(link: u8) -> Vec<u8> {
    let (link, data) = sniffed(link);
    let mut bytes = words(&[0xA1B2_C3D4, 0x0004_0002, 0, 0, 65_535, link]);
    for n in 0..4 {
        bytes.extend(words(&[n, n, data.len() as u32, data.len() as u32]));
        bytes.extend(&data);
    }
    bytes
}

fn block(kind: u32, body: &[u8]) -> Vec<u8> {
    let mut body = body.to_vec();
    body.resize(body.len().next_multiple_of(4), 0);
    let length = words(&[12 + body.len() as u32]);
    [words(&[kind]), length.clone(), body, length].concat()
}

fn newer(link: u8) -> Vec<u8> {
    let (link, data) = sniffed(link);
    let length = data.len() as u32;
    // A time zone, a name and a resolution of nanoseconds.
    let options = *b"\x0a\x00\x04\x00\0\0\x0e\x10\x02\x00\x04\x00roof\x09\x00\x01\x00\x09\0\0\0\0\0\0\0";
    let mut bytes = block(0x0A0D_0D0A, &words(&[0x1A2B_3C4D, 1, u32::MAX, u32::MAX]));
    bytes.extend(block(1, &[words(&[link, 0]), options.to_vec()].concat()));
    for n in 0..2 {
        bytes.extend(block(6, &[words(&[0, n, n, length, length]), data.clone()].concat()));
    }
    bytes.extend(block(3, &[words(&[length]), data.clone()].concat()));
    bytes.extend(block(2, &[words(&[0, 1, 2, length, length]), data].concat()));
    bytes
}

/// With what the input does to it: bytes that become others, at places as they are in the file; and where it ends.
fn damaged(mut bytes: Vec<u8>, mut orders: &[u8]) -> Vec<u8> {
    if let Some((&[low, high], rest)) = orders.split_first_chunk::<2>() {
        orders = rest;
        let length = usize::from(low) | usize::from(high) << 8;
        bytes.truncate(if high & 0x80 == 0 { length } else { bytes.len() });
    }
    while let Some((&[low, high, value], rest)) = orders.split_first_chunk::<3>() {
        orders = rest;
        let at = usize::from(low) | usize::from(high & 3) << 8;
        match bytes.get_mut(at) {
            Some(byte) => *byte = value,
            None => bytes.extend(rest.iter().take(usize::from(value))),
        }
    }
    bytes
}

/// What is in a capture.
#[derive(Debug, Default)]
struct Found {
    /// Of each record; none where it makes no sense.
    frames: Vec<Option<Vec<u8>>>,
    /// It ends where a record ends.
    is_whole: bool,
}

fn word(bytes: &[u8], at: usize, is_big: bool) -> Option<usize> {
    let bytes = *bytes.get(at..)?.first_chunk()?;
    Some(if is_big { u32::from_be_bytes(bytes) } else { u32::from_le_bytes(bytes) } as usize)
}

/// A record's frame with its check sequence. Outside: whether it is IEEE 802.15.4 at all.
fn frame(link: usize, data: &[u8]) -> Option<Option<Vec<u8>>> {
    match link {
        195 => Some(Some(data.to_vec())),
        230 => Some(Some(with_check(data))),
        283 => Some(tapped(data)),
        _ => None,
    }
}

fn tapped(data: &[u8]) -> Option<Vec<u8>> {
    let half = |at: usize| Some(usize::from(u16::from_le_bytes(*data.get(at..)?.first_chunk()?)));
    let length = half(2)?;
    let frame = data.get(length..)?;
    let (mut at, mut has_check) = (4, false);
    while at + 4 <= length {
        if half(at)? == 0 {
            has_check = *data.get(at + 4)? == 1;
        }
        at += 4 + half(at + 2)?.div_ceil(4) * 4;
    }
    Some(if has_check { frame.to_vec() } else { with_check(frame) })
}

fn walk_classic(bytes: &[u8]) -> Option<Found> {
    let is_big = match word(bytes, 0, true)? {
        0xA1B2_C3D4 | 0xA1B2_3C4D => true,
        0xD4C3_B2A1 | 0x4D3C_B2A1 => false,
        _ => return None,
    };
    let link = word(bytes, 20, is_big)?;
    let (mut at, mut found) = (24, Found::default());
    loop {
        found.is_whole = at == bytes.len();
        let Some(length) = word(bytes, at + 8, is_big).filter(|length| *length <= LONGEST_FRAME) else { break };
        let Some(data) = bytes.get(at + 16..).and_then(|data| data.get(..length)) else { break };
        let Some(frame) = frame(link, data) else { break };
        found.frames.push(frame);
        at += 16 + length;
    }
    Some(found)
}

fn walk_newer(bytes: &[u8]) -> Option<Found> {
    let (mut at, mut found, mut is_big, mut links) = (0, Found::default(), false, Vec::new());
    loop {
        found.is_whole = at == bytes.len();
        let rest = bytes.get(at..)?;
        if rest.starts_with(&[0x0A, 0x0D, 0x0D, 0x0A]) {
            is_big = match word(rest, 8, true) {
                Some(0x1A2B_3C4D) => true,
                Some(0x4D3C_2B1A) => false,
                _ => break,
            };
            links.clear();
        }
        let Some(length) = word(rest, 4, is_big) else { break };
        if length % 4 != 0 || !(12..=LONGEST_BLOCK).contains(&length) {
            break;
        }
        let Some(block) = rest.get(..length) else { break };
        if word(block, length - 4, is_big) != Some(length) {
            break;
        }
        let body = &block[8..length - 4];
        let word = |at| word(body, at, is_big);
        let half = |at: usize| {
            let bytes: [u8; 2] = *body.get(at..)?.first_chunk()?;
            Some(usize::from(if is_big { u16::from_be_bytes(bytes) } else { u16::from_le_bytes(bytes) }))
        };
        let with = |id: Option<usize>, data: Option<&[u8]>| match (id.and_then(|id| links.get(id)), data) {
            (Some(link), Some(data)) => frame(*link, data),
            _ => Some(None),
        };
        let captured = |at: usize| body.get(20..).and_then(|data| data.get(..word(at)?));
        let record = match self::word(block, 0, is_big)? {
            1 if body.len() < 8 => break,
            1 => {
                links.push(half(0).unwrap_or_default());
                None
            }
            2 => Some(with(half(0), captured(12))),
            3 => Some(with(Some(0), body.get(4..).and_then(|data| data.get(..word(0)?.min(data.len()))))),
            6 => Some(with(word(0), captured(12))),
            _ => None,
        };
        match record {
            Some(None) => break,
            Some(Some(frame)) => found.frames.push(frame),
            None => {}
        }
        at += length;
    }
    Some(found)
}
