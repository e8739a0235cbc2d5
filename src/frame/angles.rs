//! Kind 3: angles as measured, for whoever calibrates a room.
//!
//! | bytes | what |
//! |---|---|
//! | 0..17 | as in every frame; kind 3 |
//! | 17..21 | measured half turn, ticks, Q8 |
//! | 21.. | 1 to 8 sweeps of 8 bytes |
//! | last 2 | FCS |
//!
//! A sweep's eight bytes:
//!
//! | bytes | what |
//! |---|---|
//! | 0..4 | when the laser passed, mote ticks, wrapping |
//! | 4 | bit 0: station B; bit 1: elevation |
//! | 5..8 | time since the station's flash as a share of the half turn, 2^20 units: half of that is straight ahead |
//!
//! ```
//! use lighthouse_mote::frame::{ANGLES_LEN, Angles, Header, Measured, Message, emit_angles, parse};
//! use lighthouse_mote::sweep::{Axis, Station};
//!
//! let header = Header { pan: 0x4c48, mote: 7, sequence: 302 };
//! let mut angles = Angles { half_turn_q8: 90_167 << 8, ..Angles::default() };
//! // Straight ahead is half of 2^20.
//! let ahead = Measured { time: 1_000, station: Station::B, axis: Axis::Elevation, share: 1 << 19 };
//! angles.sweeps.push(ahead).expect("room for eight");
//! let mut bytes = [0; ANGLES_LEN];
//! let frame = emit_angles(header, &angles, &mut bytes);
//! assert_eq!(frame.len(), 21 + 8 + 2);
//! assert_eq!(parse(frame), Ok((header, Message::Angles(angles))));
//! ```
//!
//! What can go wrong: a share beyond 24 bits, 16 half turns, is no sweep; it saturates. The length tells how many sweeps
//! there are, and no other length is taken.

use heapless::Vec;

use super::{Aligned, Header, Reader, Reject, Writer, envelope, seal};
use crate::sweep::{Axis, Station, Sweep};

/// Sweeps in a frame, at most: two cycles of the four rotors, in 87 bytes of the 127 that a frame may have.
pub const ANGLES: usize = 8;
/// Bytes before the sweeps.
const BEFORE: usize = 21;
/// Bytes of a sweep.
const EACH: usize = 8;
/// Bytes of the longest angles frame, FCS included.
pub const ANGLES_LEN: usize = BEFORE + ANGLES * EACH + 2;
/// The largest share that is held.
const SHARE_MAX: u32 = (1 << 24) - 1;

/// One laser plane that passed, before any factory term.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Measured {
    /// When it passed, mote ticks, wrapping.
    pub time: u32,
    /// Whose laser.
    pub station: Station,
    /// Which rotor.
    pub axis: Axis,
    /// Time since the station's flash, 2^20 units per half turn; at most 24 bits.
    pub share: u32,
}

impl From<&Sweep> for Measured {
    fn from(sweep: &Sweep) -> Self {
        let share = sweep.half_turn.share(sweep.since_sync).min(SHARE_MAX);
        Self { time: sweep.at.0, station: sweep.station, axis: sweep.axis, share }
    }
}

/// Sweeps as measured.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Angles {
    /// The measured half turn in ticks, Q8.
    pub half_turn_q8: u32,
    /// In the order of their times.
    pub sweeps: Vec<Measured, ANGLES>,
}

/// Bytes of a frame of `count` sweeps, FCS included.
const fn len(count: usize) -> usize {
    BEFORE + count * EACH + 2
}

/// How many sweeps a frame of `len` bytes holds.
pub(super) fn count(len: usize) -> Option<usize> {
    (1..=ANGLES).find(|count| self::len(*count) == len)
}

/// Writes the whole frame, FCS included, to the beginning of `bytes`; gives that part of it. Nothing where there are no
/// sweeps.
#[must_use]
pub fn emit_angles<'a>(header: Header, angles: &Angles, bytes: &'a mut [u8; ANGLES_LEN]) -> &'a [u8] {
    if angles.sweeps.is_empty() {
        return &[];
    }
    let mut to = Writer { bytes: &mut *bytes, at: 0 };
    envelope(&mut to, header, super::KIND_ANGLES);
    to.put(angles.half_turn_q8.to_le_bytes());
    for sweep in &angles.sweeps {
        to.put(sweep.time.to_le_bytes());
        let [low, middle, high, _] = sweep.share.min(SHARE_MAX).to_le_bytes();
        to.put([sweep.station as u8 | (sweep.axis as u8) << 1, low, middle, high]);
    }
    let Some(frame) = bytes.get_mut(..len(angles.sweeps.len())) else { return &[] };
    seal(frame);
    frame
}

/// The same where it is to be; false where there are no sweeps.
#[inline(never)]
pub fn emit_angles_into(frame: &mut Aligned, header: Header, angles: &Angles) -> bool {
    let Some(bytes) = frame.take::<ANGLES_LEN>() else { return false };
    let len = emit_angles(header, angles, bytes).len();
    frame.len = len as u32;
    len > 0
}

/// What follows the envelope.
pub(super) fn parse(from: &mut Reader<'_>, count: usize) -> Result<Angles, Reject> {
    let mut angles = Angles { half_turn_q8: from.u32(), sweeps: Vec::new() };
    for _ in 0..count {
        let time = from.u32();
        let [rotor, low, middle, high] = from.take();
        let (station, axis) = match rotor {
            0 => (Station::A, Axis::Azimuth),
            1 => (Station::B, Axis::Azimuth),
            2 => (Station::A, Axis::Elevation),
            3 => (Station::B, Axis::Elevation),
            _ => return Err(Reject::Code),
        };
        let share = u32::from_le_bytes([low, middle, high, 0]);
        angles.sweeps.push(Measured { time, station, axis, share }).map_err(|_| Reject::Length)?;
    }
    Ok(angles)
}
