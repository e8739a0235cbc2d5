//! Any bytes at all as a frame: read or refused, and what is read is written back as it was.
#![no_main]

use libfuzzer_sys::fuzz_target;
use lighthouse_mote::frame::{ANGLES_LEN, Header, Message, Report, emit, emit_angles, emit_health, fcs, parse};

/// Bytes of a frame that say who sends it, the kind of report left out (`frame`'s table).
const ADDRESSED: usize = 12;
/// Bytes until the report itself.
const HEADED: usize = 17;

fuzz_target!(|bytes: &[u8]| {
    read(bytes);
    // Chance finds neither a check sequence nor a header: given those, the rest is reached.
    read(&checked(bytes.to_vec()));
    let Some((kind, rest)) = bytes.split_first() else { return };
    let sound = emit(Header { pan: 0x4C48, mote: 1, sequence: 7 }, &Report::default());
    let mut headed = sound[..HEADED].to_vec();
    headed[ADDRESSED] = *kind;
    headed.extend(rest);
    read(&checked(headed));
});

fn checked(mut bytes: Vec<u8>) -> Vec<u8> {
    bytes.extend(fcs(&bytes).to_le_bytes());
    bytes
}

fn read(bytes: &[u8]) {
    let Ok((header, message)) = parse(bytes) else { return };
    let again = match &message {
        Message::Fix(report) => emit(header, report).to_vec(),
        Message::Health(health) => emit_health(header, health).to_vec(),
        Message::Angles(angles) => emit_angles(header, angles, &mut [0; ANGLES_LEN]).to_vec(),
    };
    assert_eq!(again, bytes, "{header:?} {message:?}");
}
