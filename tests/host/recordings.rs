//! The flashes of real stations: the right station, axis, data and skip for every one.
//!
//! How "right" is known. Station and axis are those of the 33.3 ms cycle, which a plain lattice over the whole
//! recording gives: it looks at the times of all flashes at once, and at no width. The skip follows from the cycle. The
//! data bits spell each station's calibration frame again and again, one bit per slot: the majority of the repetitions
//! makes one frame, whose CRC and identity prove it, and every single bit is then held against it.
//!
//! What can go wrong: the recordings are not there, which is said; the test is skipped.

use std::collections::BTreeMap;
use std::path::Path;

use sim::world::ootx::crc32;

use crate::pulse::Pulse;
use crate::sweep::{self, Axis, Light, Station, Sync};
use crate::time::{Span, Ticks};

/// A half turn at the recorders' 48 MHz.
const HALF_TURN: f64 = 400_000.0;
/// Bits of a frame of 33 bytes: 18 of preamble, then length, 17 words of payload and 2 of CRC, 17 each.
const FRAME: usize = 18 + 17 * (1 + 17 + 2);
/// Slots that the first lock may take: a quarter of a second, in the worse of the recordings.
const LOCKED: u32 = 32;
/// Pulses that begin within 100 us are of one flash; those of two stations are 417 us apart.
const SAME: u32 = 4_800;
/// The share of wrong or missing flashes that is allowed: 0.1 %.
const WRONG_PER: usize = 1_000;

/// The pulses of a recording, as the 32-bit counter of a mote stamps them.
pub(super) fn recording(name: &str) -> Option<Vec<Pulse>> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/vive-pulses").join(name);
    let Ok(text) = std::fs::read_to_string(&path) else {
        eprintln!("skipped: there is no {}", path.display());
        return None;
    };
    let number = |cell: &str| cell.trim().parse::<u64>().expect("a whole number") as u32;
    let pulse = |line: &str| {
        let (start, width) = line.split_once(',').expect("two columns");
        Pulse { start: Ticks(number(start)), width: Span(number(width)) }
    };
    Some(text.lines().skip(1).map(pulse).collect())
}

/// The slots since the beginning, as the times of all flashes of one rotor after the other tell: an independent
/// lattice whose length is refined over the whole recording.
fn lattice(pulses: &[Pulse]) -> (f64, f64) {
    // B's flash, or A's, whichever is steadier, ends up as the origin; both are folded together.
    let mut half_turn = HALF_TURN;
    let origin = f64::from(pulses[0].start.0);
    let flashes =
        || pulses.iter().filter(|pulse| pulse.width.0 > 2_400).map(move |pulse| f64::from(pulse.start.0) - origin);
    for _ in 0..4 {
        let (mut off, mut weight) = (0.0, 0.0);
        for at in flashes() {
            let slot = (at / half_turn).round();
            let rest = at - slot * half_turn;
            if rest.abs() < 8_000.0 {
                off += rest * slot;
                weight += slot * slot;
            }
        }
        half_turn += off / weight;
    }
    (origin, half_turn)
}

/// One flash as it was understood.
#[derive(Debug, Clone, Copy)]
struct Seen {
    slot: u32,
    sync: Sync,
}

/// Everything understood, how many flashes there were after the lock, and how many of them were not understood.
fn understood(pulses: &[Pulse]) -> (Vec<Seen>, usize, usize, sweep::Counts, sweep::State) {
    let (origin, half_turn) = lattice(pulses);
    let mut state = sweep::State::default();
    let mut seen = Vec::new();
    let (mut flashes, mut missing) = (0, 0);
    let mut begun: Option<(Ticks, bool)> = None;
    for pulse in pulses {
        let light = sweep::step(&sweep::Config::DEFAULT, &mut state, *pulse);
        let place = (f64::from(pulse.start.0) - origin) / half_turn;
        // Either station's flash lies within a gap and a half from the lattice of the other's.
        let slot = (place + 0.1).floor() as u32;
        let rest = place - f64::from(slot);
        let is_understood = if let Some(Light::Sync(sync)) = light {
            seen.push(Seen { slot, sync });
            true
        } else {
            false
        };
        if (seen.is_empty() && slot < LOCKED) || rest.abs() >= 0.07 {
            continue;
        }
        // Twice the same flash is one, seen by a second photodiode a little later.
        match &mut begun {
            Some((start, was_understood)) if pulse.start.since(*start).0 < SAME => *was_understood |= is_understood,
            _ => {
                missing += usize::from(begun.is_some_and(|(_, was_understood)| !was_understood));
                flashes += 1;
                begun = Some((pulse.start, is_understood));
            }
        }
    }
    missing += usize::from(begun.is_some_and(|(_, was_understood)| !was_understood));
    (seen, flashes, missing, state.counts(), state)
}

/// The frame that repeats in one station's bits, from the majority: where it begins, and its bits.
fn frame(seen: &[Seen], station: Station) -> (usize, Vec<bool>) {
    let bits: BTreeMap<u32, bool> =
        seen.iter().filter(|seen| seen.sync.station == station).map(|seen| (seen.slot, seen.sync.data)).collect();
    let mut votes = vec![0i32; FRAME];
    for (slot, bit) in &bits {
        votes[*slot as usize % FRAME] += if *bit { 1 } else { -1 };
    }
    let start = (0..FRAME)
        .find(|start| (0..18).all(|n| (votes[(start + n) % FRAME] > 0) == (n == 17)))
        .expect("17 zeros and a one");
    (start, (0..FRAME).map(|n| votes[(start + n) % FRAME] > 0).collect())
}

/// The payload; checks every closing one, the length and the CRC.
fn payload(bits: &[bool]) -> Vec<u8> {
    let mut bytes = Vec::new();
    for word in bits[18..].chunks(17) {
        assert!(word[16], "a word without its one");
        bytes.extend(word[..16].chunks(8).map(|bits| bits.iter().fold(0u8, |byte, bit| byte << 1 | u8::from(*bit))));
    }
    assert_eq!(bytes[..2], [33, 0]);
    assert_eq!(bytes[36..40], crc32(&bytes[2..35]).to_le_bytes(), "the CRC");
    bytes[2..35].to_vec()
}

fn id(payload: &[u8]) -> u32 {
    u32::from_le_bytes([payload[2], payload[3], payload[4], payload[5]])
}

/// Every flash against the cycle and the frames; the identities of both stations.
///
/// `phase`: which slot of the cycle the recording begins in; a whole recording in any other would be wrong throughout.
fn judge(name: &str, phase: u32) -> Option<[u32; 2]> {
    let pulses = recording(name)?;
    let (seen, flashes, missing, counts, state) = understood(&pulses);
    let mut all_wrong = 0;
    let ids = [Station::A, Station::B].map(|station| {
        let (start, bits) = frame(&seen, station);
        let of: Vec<_> = seen.iter().filter(|seen| seen.sync.station == station).collect();
        let wrong = of.iter().filter(|seen| {
            let turn = (seen.slot + phase) % 4;
            let sweeping = if turn < 2 { Station::B } else { Station::A };
            let axis = if turn & 1 == 0 { Axis::Azimuth } else { Axis::Elevation };
            let data = bits[(seen.slot as usize + FRAME - start) % FRAME];
            seen.sync != Sync { station, axis, skip: sweeping != station, data }
        });
        let wrong = wrong.count();
        eprintln!("{name} {station:?}: {} syncs, {wrong} wrong, bias {:?}", of.len(), state.width_bias(station));
        all_wrong += wrong;
        id(&payload(&bits))
    });
    eprintln!("{name}: {} of {flashes} flashes, {missing} missing, {counts:?}", seen.len());
    let wrong = all_wrong + missing;
    assert!(wrong * WRONG_PER <= flashes, "{wrong} of {flashes} flashes were not understood");
    assert_eq!(counts.locks_lost, 0);
    Some(ids)
}

#[test]
fn the_flashes_of_one_visible_station_and_its_hidden_partner_are_understood() {
    if let Some(ids) = judge("hmd-one-station-visible.csv", 1) {
        assert_eq!(ids, [3_200_290_360, 3_275_443_681]);
    }
}

#[test]
fn the_flashes_of_two_visible_stations_are_understood() {
    if let Some(ids) = judge("tracker-two-stations.csv", 2) {
        assert_eq!(ids[1], 178_605_925);
    }
}
