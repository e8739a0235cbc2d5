//! What stands on a serial line between a receiver and the computer: its own words and frames, maimed by the input, and
//! anything else.
//!
//! However the bytes are cut into pieces the same comes of them; every byte is in a frame, in what is counted as bad, or in
//! what the receiver says of other things; and damage costs no line or frame but those that it touches.
#![no_main]

use air::hdlc::{self, Decoder, FLAG, encode};
use air::receiver::{Damage, Item, Kind, Signal};
use libfuzzer_sys::fuzz_target;
use lighthouse_mote::frame::{Header, Report, emit, fcs, parse};

/// Longest line that may hold a frame, and longest frame of HDLC: `air`'s own limits.
const LONGEST: usize = 512;
/// Most bytes of a frame on the air.
const LONGEST_FRAME: usize = 127;
const BEGINS: &[u8] = b"received:";

fuzz_target!(|bytes: &[u8]| {
    let Some(([how, cut], rest)) = bytes.split_first_chunk::<2>() else { return };
    let kind = if how & 1 == 0 { Kind::Nrf } else { Kind::Openmote };
    let stream = match how >> 1 & 1 {
        0 => rest.to_vec(),
        _ => spoken(kind, rest),
    };
    let whole = hear(kind, [&stream[..]]);
    assert_eq!(whole, hear(kind, stream.chunks(usize::from(*cut) + 1)), "cut into pieces");
    for item in &whole {
        if let Item::Frame(frame, _) = item {
            assert!(frame.len() <= LONGEST_FRAME);
            let _ = parse(frame);
        }
    }
    match kind {
        Kind::Nrf => lines(&stream, &whole),
        Kind::Openmote => stuffed(&stream),
    }
});

fn hear<'a>(kind: Kind, pieces: impl IntoIterator<Item = &'a [u8]>) -> Vec<Item> {
    let mut items = Vec::new();
    let mut ear = kind.ear();
    for piece in pieces {
        ear.hear(piece, |item| items.push(item));
    }
    items
}

/// Frames as the receiver says them, with what the input does to them: which byte of which becomes what, or goes.
fn spoken(kind: Kind, mut orders: &[u8]) -> Vec<u8> {
    let mut stream = Vec::new();
    let mut expected = Vec::new();
    for sequence in 0..8 {
        let frame = emit(Header { pan: 0x4C48, mote: 9, sequence }, &Report::default());
        let said = say(kind, &frame, sequence);
        // A third of them are left alone.
        let damage = if sequence % 3 == 1 { None } else { orders.split_first_chunk::<3>() };
        let Some((&[what, at, value], rest)) = damage else {
            expected.push((stream.len(), frame));
            stream.extend(said);
            continue;
        };
        orders = rest;
        let at = (usize::from(at) | usize::from(what & 1) << 8) % said.len();
        let mut said = said;
        match what >> 1 & 3 {
            0 => said[at] = value,
            1 => said[at] ^= value,
            2 => drop(said.remove(at)),
            _ => said.insert(at, value),
        }
        stream.extend(said);
    }
    let items = hear(kind, [&stream[..]]);
    for (at, frame) in expected {
        // What stands before it may have lost its end; a frame of HDLC has its own beginning.
        if kind == Kind::Nrf && at > 0 && stream[at - 1] != b'\n' {
            continue;
        }
        let is_it = |item: &Item| matches!(item, Item::Frame(heard, _) if *heard == frame);
        assert!(items.iter().any(is_it), "lost beside a damaged one: {items:?}");
    }
    stream
}

fn say(kind: Kind, frame: &[u8], sequence: u16) -> Vec<u8> {
    match kind {
        Kind::Nrf => {
            let hex: String = frame[..frame.len() - 2].iter().map(|byte| format!("{byte:02x}")).collect();
            format!("received: {hex}ffff power: -61 lqi: 180 time: {sequence}\r\n").into_bytes()
        }
        // OpenWSN's and the OpenMote sniffer's.
        Kind::Openmote if sequence & 1 == 0 => encode(&[b"P\x01\x02", frame, &[20]].concat()),
        Kind::Openmote => encode(&[&[0xFF; 6][..], &[2; 6], &[0x80, 0x9A], frame, &[200, 0xE4]].concat()),
    }
}

/// Each line by itself comes to the same, and accounts for its bytes.
fn lines(stream: &[u8], whole: &[Item]) {
    let mut apart = Vec::new();
    for line in stream.split_inclusive(|byte| *byte == b'\n') {
        let items = hear(Kind::Nrf, [line]);
        let (text, is_whole) = line.strip_suffix(b"\n").map_or((line, false), |text| (text, true));
        let mut counted = 0;
        for item in &items {
            match item {
                Item::Bad(damage, bytes) => {
                    assert_eq!(*damage, Damage::Line);
                    counted += bytes.len();
                }
                Item::Frame(frame, Signal { rssi_dbm: _, lqi }) => {
                    assert!(lqi.is_some() && fcs(frame) == 0, "{item:?}");
                    // Two digits for each byte, and the words.
                    counted += BEGINS.len() + 2 * frame.len();
                }
            }
        }
        assert!(counted <= text.len(), "{items:?}");
        if text.len() >= LONGEST {
            // All but what still waits for its end.
            let waits = if is_whole { 0 } else { text.len() % LONGEST };
            assert_eq!(counted, text.len() - waits);
        } else if is_whole {
            let begun = text.windows(BEGINS.len()).filter(|window| *window == BEGINS).count();
            assert!(items.len() >= begun, "{begun} begun: {items:?}");
            let is_text = text.iter().all(|byte| matches!(byte, b' '..=b'~' | b'\r' | b'\t' | 0x08 | 0x0C | 0x1B));
            assert!(is_text || items.iter().any(|item| matches!(item, Item::Bad(..))), "{text:?}: {items:?}");
        } else {
            assert!(items.is_empty(), "it may go on: {items:?}");
        }
        apart.extend(items);
    }
    assert_eq!(apart, whole);
}

/// What HDLC's decoder says accounts for every byte between flags, and what stuffing it undoes is stuffed as it was.
fn stuffed(stream: &[u8]) {
    let mut decoder = Decoder::default();
    let mut since = 0;
    for &byte in stream {
        // An escape is two bytes that become one.
        since += usize::from(byte != FLAG);
        match decoder.take(byte) {
            None => assert!(byte != FLAG || since == 0, "{since} bytes gone"),
            Some(Ok(payload)) => {
                assert!(payload.len() + 2 <= since && since <= 2 * (payload.len() + 2));
                let mut again = Decoder::default();
                let out: Vec<_> = hdlc::encode(&payload).into_iter().filter_map(|byte| again.take(byte)).collect();
                assert_eq!(out, [Ok(payload)]);
                since = 0;
            }
            Some(Err(bytes)) => {
                assert!(bytes.len() <= since && since <= 2 * bytes.len() + 1);
                since = 0;
            }
        }
    }
    assert!(since <= 2 * LONGEST, "{since} bytes kept");
}
