//! Reports as IEEE 802.15.4 data frames, and back.
//!
//! One truth for the mote that sends and the listener that reads. All numbers are little-endian. Of the three kinds,
//! this is the fix; the others share bytes 0..17, the sequence and the check with it ([`Health`], [`Angles`]).
//!
//! | bytes | what |
//! |---|---|
//! | 0..2 | frame control 0x9841: data, PAN id compressed, 2006, short addresses |
//! | 2 | MAC sequence: low byte of the report's sequence |
//! | 3..5 | PAN id |
//! | 5..7 | destination: 0xffff, everyone |
//! | 7..9 | source: the mote id |
//! | 9..11 | `LM`: ours |
//! | 11 | version, [`VERSION`] |
//! | 12 | kind: 1 a fix, 2 health, 3 angles |
//! | 13..15 | mote id |
//! | 15..17 | sequence of reports of any kind, wrapping |
//! | 17..21 | time of the fix, mote ticks, wrapping |
//! | 21..25 | measured half turn, ticks, Q8: 8.333 ms on any mote |
//! | 25..37 | x, y, z in metres, I16F16 |
//! | 37..39 | epipolar mismatch in metres, U0F16, saturating |
//! | 39..41 | age of the oldest angle used, in half turns, U8F8, saturating |
//! | 41 | bits 0, 1: stations A, B gave an angle lately; bits 4, 5: level, 0 none to 3 full |
//! | 42..48 | velocity x, y, z in m/s, I6F10, saturating |
//! | 48..54 | standard deviation of x, y, z in metres, U0F16, saturating |
//! | 54..56 | edges lost: a full queue, or an edge without a partner |
//! | 56..58 | pulses that fit no window |
//! | 58..60 | sweeps outside the field of view, or lost to a full queue |
//! | 60..62 | fixes and sweeps refused: geometry, mismatch, innovation |
//! | 62..64 | reports lost: a full queue, a radio that does not answer |
//! | 64..66 | FCS |
//!
//! ```
//! use fixed::types::I16F16;
//! use lighthouse_mote::frame::{Header, LEN, Level, Message, Reject, Report, emit, parse};
//!
//! let header = Header { pan: 0x4c48, mote: 7, sequence: 300 };
//! let position = [0.5, 1.0, -0.25].map(I16F16::from_num);
//! let report = Report { position, stations: 3, level: Level::Full, ..Report::default() };
//! let mut frame: [u8; LEN] = emit(header, &report);
//! assert_eq!(parse(&frame), Ok((header, Message::Fix(report))));
//! // A bit that flips on the air is seen.
//! frame[30] ^= 4;
//! assert_eq!(parse(&frame), Err(Reject::Fcs));
//! ```
//!
//! What can go wrong: bytes that are not ours. [`parse`] names what is off and never panics.

mod angles;
mod health;
#[cfg(feature = "security")]
pub mod secured;

use fixed::types::{I6F10, I16F16, U0F16, U8F8};

pub use self::angles::{ANGLES, ANGLES_LEN, Angles, Measured, emit_angles, emit_angles_into};
pub use self::health::{Factory, HEALTH_LEN, Health, Lock, Rejects, Reset, Station, emit_health, emit_health_into};
pub use crate::track::Level;

/// The format described in the module documentation.
pub const VERSION: u8 = 1;
/// Bytes of a whole fix frame, FCS included.
pub const LEN: usize = 66;

/// Data frame, PAN id compression, frame version 2006, short addresses both (IEEE 802.15.4-2006, 7.2.1.1).
const FRAME_CONTROL: u16 = 0x9841;
/// Everyone in the PAN (IEEE 802.15.4-2006, 7.2.1.4).
const BROADCAST: u16 = 0xffff;
const MAGIC: [u8; 2] = *b"LM";
const KIND_FIX: u8 = 1;
const KIND_HEALTH: u8 = 2;
const KIND_ANGLES: u8 = 3;
/// Where the level stands in its byte.
const LEVEL_SHIFT: u32 = 4;

/// What was lost on the way from light to report, each counted since start-up, wrapping.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Losses {
    /// Edges lost to a full queue, or without a partner.
    pub edges: u16,
    /// Pulses that fit no window of the cycle.
    pub pulses: u16,
    /// Sweeps outside the field of view, or lost to a full queue.
    pub sweeps: u16,
    /// Fixes refused for their geometry or their mismatch, and sweeps that the tracker did not believe.
    pub fixes: u16,
    /// Reports lost to a full queue, or to a radio that did not answer.
    pub reports: u16,
}

/// One finished position and how good it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Report {
    /// The time of the position, in ticks of the mote: of its newest angle, or of a flash while it coasts.
    pub time: u32,
    /// The measured half turn in ticks, Q8: 8.333 ms.
    pub half_turn_q8: u32,
    /// World x, y, z in metres.
    pub position: [I16F16; 3],
    /// How far the rays of the two stations pass each other, in metres.
    pub mismatch: U0F16,
    /// Age of the oldest of the four newest angles, in half turns.
    pub age: U8F8,
    /// Stations that gave an angle lately. Bit 0: A. Bit 1: B.
    pub stations: u8,
    /// How much is known.
    pub level: Level,
    /// World x, y, z in metres per second.
    pub velocity: [I6F10; 3],
    /// Standard deviation of x, y, z in metres; zero where nobody says.
    pub sd: [U0F16; 3],
    /// What was lost so far.
    pub losses: Losses,
}

/// What a frame says.
#[derive(Debug, Clone, PartialEq, Eq)]
#[allow(clippy::large_enum_variant, reason = "a listener has room, and a mote only sends")]
pub enum Message {
    /// Where the mote is.
    Fix(Report),
    /// How the mote is.
    Health(Health),
    /// What the mote measured.
    Angles(Angles),
}

/// Who says it, and as which of its reports.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Header {
    /// The personal area network.
    pub pan: u16,
    /// The mote: its short address.
    pub mote: u16,
    /// Reports made before this one, wrapping.
    pub sequence: u16,
}

/// Why bytes are no report of ours.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Reject {
    /// Not the length of its kind.
    Length,
    /// The frame check sequence does not fit the bytes.
    Fcs,
    /// Another frame type, addressing or destination.
    Header,
    /// Another protocol's payload.
    Magic,
    /// A version this code does not know.
    Version,
    /// A kind of report this code does not know.
    Kind,
    /// The source address is not the mote id of the payload.
    Mote,
    /// Bits of the level or of the stations that mean nothing.
    Level,
    /// A code or a flag that means nothing.
    Code,
}

impl core::fmt::Display for Reject {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::Length => "not the length of a report",
            Self::Fcs => "frame check sequence wrong",
            Self::Header => "not a broadcast data frame with short addresses",
            Self::Magic => "payload does not begin with LM",
            Self::Version => "unknown version",
            Self::Kind => "unknown kind of report",
            Self::Level => "level and stations make no sense",
            Self::Code => "a code that means nothing",
            Self::Mote => "source address is not the mote id",
        })
    }
}

impl core::error::Error for Reject {}

/// CRC-16 of IEEE 802.15.4-2006, 7.2.1.9: x^16 + x^12 + x^5 + 1, least significant bit first, from zero.
///
/// A word at a time and without a table. The remainder of `x^16 X` is the low half of `(x^12 + x^5 + 1) Q`. The quotient Q
/// is X over `1 + a` with a = x^-4 + x^-11 + x^-16, whole powers of x alone, and 1 / (1 + a) = (1 + a) (1 + a^2) (1 + a^4)
/// up to a^8 = x^-32. Bits stand in reverse, so dividing by x shifts left.
#[must_use]
#[inline(always)]
pub fn fcs(bytes: &[u8]) -> u16 {
    let (words, rest) = bytes.as_chunks();
    let mut crc = 0;
    for word in words {
        let x = crc ^ u32::from_le_bytes(*word);
        let x = x ^ x << 4 ^ x << 11 ^ x << 16;
        let x = x ^ x << 8 ^ x << 22;
        let quotient = x ^ x << 16;
        crc = (quotient ^ quotient >> 5 ^ quotient >> 12) >> 16;
    }
    for byte in rest {
        // The same for the 8 highest bits of a word.
        let x = (crc ^ u32::from(*byte)) << 24;
        let quotient = x ^ x << 4;
        crc = crc >> 8 ^ (quotient ^ quotient >> 5 ^ quotient >> 12) >> 16;
    }
    crc as u16
}

/// Gives an enum without data back from its number on the wire.
macro_rules! code {
    ($name:ident: $($variant:ident),+) => {
        impl $name {
            /// All of them, in the order of their codes.
            pub const ALL: &[Self] = &[$(Self::$variant),+];

            fn of_code(code: u8) -> Result<Self, Reject> {
                [$(Self::$variant),+].into_iter().find(|known| *known as u8 == code).ok_or(Reject::Code)
            }
        }
    };
}
use code;

/// Writes bytes one after another into a frame.
struct Writer<'a, const L: usize> {
    bytes: &'a mut [u8; L],
    at: usize,
}

impl<const L: usize> Writer<'_, L> {
    fn put<const N: usize>(&mut self, value: [u8; N]) {
        for byte in value {
            if let Some(place) = self.bytes.get_mut(self.at) {
                *place = byte;
            }
            self.at += 1;
        }
    }
}

/// Reads them back.
struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl Reader<'_> {
    fn take<const N: usize>(&mut self) -> [u8; N] {
        core::array::from_fn(|_| {
            let byte = self.bytes.get(self.at).copied().unwrap_or(0);
            self.at += 1;
            byte
        })
    }

    fn u8(&mut self) -> u8 {
        u8::from_le_bytes(self.take())
    }

    fn u16(&mut self) -> u16 {
        u16::from_le_bytes(self.take())
    }

    fn u32(&mut self) -> u32 {
        u32::from_le_bytes(self.take())
    }
}

/// Bytes 0..17, the same in every kind.
#[inline(always)]
fn envelope<const L: usize>(to: &mut Writer<'_, L>, header: Header, kind: u8) {
    to.put(FRAME_CONTROL.to_le_bytes());
    to.put([header.sequence as u8]);
    to.put(header.pan.to_le_bytes());
    to.put(BROADCAST.to_le_bytes());
    to.put(header.mote.to_le_bytes());
    to.put(MAGIC);
    to.put([VERSION, kind]);
    to.put(header.mote.to_le_bytes());
    to.put(header.sequence.to_le_bytes());
}

/// Writes the check sequence into the last two bytes.
fn seal(frame: &mut [u8]) {
    if let Some((body, check)) = frame.split_last_chunk_mut::<2>() {
        *check = fcs(body).to_le_bytes();
    }
}

/// Bytes of the longest frame.
pub const MAX_LEN: usize = if HEALTH_LEN > ANGLES_LEN { HEALTH_LEN } else { ANGLES_LEN };

/// Room for the longest frame, and for what securing it adds.
#[cfg(feature = "security")]
const ROOM: usize = secured::MAX_SECURED_LEN;
#[cfg(not(feature = "security"))]
const ROOM: usize = MAX_LEN;

/// A frame of any kind on a word, where it is cheap to check and a transmitter can read it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(C, align(4))]
pub struct Aligned {
    room: [u8; ROOM],
    len: u32,
}

impl Aligned {
    /// No frame yet.
    pub const BLANK: Self = Self { room: [0; ROOM], len: 0 };

    /// The frame, FCS included; empty while there is none.
    #[must_use]
    #[inline]
    pub fn bytes(&self) -> &[u8] {
        self.room.get(..self.len as usize).unwrap_or(&[])
    }

    /// The first `L` bytes, which are a frame from now on.
    #[inline(always)]
    fn take<const L: usize>(&mut self) -> Option<&mut [u8; L]> {
        self.len = L as u32;
        self.room.first_chunk_mut()
    }
}

/// The whole frame of a fix, FCS included.
#[must_use]
pub fn emit(header: Header, report: &Report) -> [u8; LEN] {
    let mut frame = Aligned::BLANK;
    emit_into(&mut frame, header, report);
    frame.room.first_chunk().copied().unwrap_or([0; LEN])
}

/// The same where it is to be, which saves copies.
#[inline(always)]
pub fn emit_into(frame: &mut Aligned, header: Header, report: &Report) {
    let Some(bytes) = frame.take::<LEN>() else { return };
    let mut to = Writer { bytes: &mut *bytes, at: 0 };
    envelope(&mut to, header, KIND_FIX);
    to.put(report.time.to_le_bytes());
    to.put(report.half_turn_q8.to_le_bytes());
    for coordinate in report.position {
        to.put(coordinate.to_le_bytes());
    }
    to.put(report.mismatch.to_le_bytes());
    to.put(report.age.to_le_bytes());
    to.put([report.stations | (report.level as u8) << LEVEL_SHIFT]);
    for speed in report.velocity {
        to.put(speed.to_le_bytes());
    }
    for sd in report.sd {
        to.put(sd.to_le_bytes());
    }
    let Losses { edges, pulses, sweeps, fixes, reports } = report.losses;
    for count in [edges, pulses, sweeps, fixes, reports] {
        to.put(count.to_le_bytes());
    }
    seal(bytes);
}

/// Reads a whole frame, FCS included.
///
/// # Errors
/// The first thing that shows the bytes are no report of ours.
pub fn parse(bytes: &[u8]) -> Result<(Header, Message), Reject> {
    let angles = angles::count(bytes.len());
    if bytes.len() != LEN && bytes.len() != HEALTH_LEN && angles.is_none() {
        return Err(Reject::Length);
    }
    // The CRC over a frame and its own FCS is zero.
    if fcs(bytes) != 0 {
        return Err(Reject::Fcs);
    }
    let mut from = Reader { bytes, at: 0 };
    let control = from.u16();
    let mac_sequence = from.u8();
    let pan = from.u16();
    let destination = from.u16();
    let source = from.u16();
    if control != FRAME_CONTROL || destination != BROADCAST {
        return Err(Reject::Header);
    }
    if from.take() != MAGIC {
        return Err(Reject::Magic);
    }
    if from.u8() != VERSION {
        return Err(Reject::Version);
    }
    let kind = from.u8();
    let mote = from.u16();
    let sequence = from.u16();
    if mote != source {
        return Err(Reject::Mote);
    }
    if sequence as u8 != mac_sequence {
        return Err(Reject::Header);
    }
    let message = match (kind, angles) {
        (KIND_FIX, _) if bytes.len() == LEN => Message::Fix(fix(&mut from)?),
        (KIND_HEALTH, _) if bytes.len() == HEALTH_LEN => Message::Health(health::parse(&mut from)?),
        (KIND_ANGLES, Some(count)) => Message::Angles(angles::parse(&mut from, count)?),
        (KIND_FIX | KIND_HEALTH | KIND_ANGLES, _) => return Err(Reject::Length),
        _ => return Err(Reject::Kind),
    };
    Ok((Header { pan, mote, sequence }, message))
}

/// What follows the envelope of a fix.
fn fix(from: &mut Reader<'_>) -> Result<Report, Reject> {
    let mut report = Report {
        time: from.u32(),
        half_turn_q8: from.u32(),
        position: core::array::from_fn(|_| I16F16::from_le_bytes(from.take())),
        mismatch: U0F16::from_le_bytes(from.take()),
        age: U8F8::from_le_bytes(from.take()),
        stations: from.u8(),
        level: Level::None,
        velocity: core::array::from_fn(|_| I6F10::from_le_bytes(from.take())),
        sd: core::array::from_fn(|_| U0F16::from_le_bytes(from.take())),
        losses: Losses {
            edges: from.u16(),
            pulses: from.u16(),
            sweeps: from.u16(),
            fixes: from.u16(),
            reports: from.u16(),
        },
    };
    report.level = match report.stations >> LEVEL_SHIFT {
        0 => Level::None,
        1 => Level::Angles,
        2 => Level::Tracked,
        3 => Level::Full,
        _ => return Err(Reject::Level),
    };
    report.stations &= (1 << LEVEL_SHIFT) - 1;
    if report.stations > 3 {
        return Err(Reject::Level);
    }
    Ok(report)
}
