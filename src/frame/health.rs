//! Kind 2: how a mote is, once a second.
//!
//! | bytes | what |
//! |---|---|
//! | 0..17 | as in every frame; kind 2 |
//! | 17..21 | uptime in seconds |
//! | 21..25 | measured half turn, ticks, Q8: the rate of the clock is 120 times that; 0 while there is none |
//! | 25 | [`Lock`] |
//! | 26 | [`Reset`] |
//! | 27..31 | detail of the reset: the program counter of a fault, the line of a panic, else 0 |
//! | 31..35 | flashes understood of A, B |
//! | 35..43 | sweeps understood of A azimuth, A elevation, B azimuth, B elevation |
//! | 43..67 | [`Rejects`], in the order of its fields |
//! | 67..70 | the most that ever waited in the queues of pulses, sightings, reports |
//! | 70..80 | station A: [`Station`] |
//! | 80..90 | station B |
//! | 90..92 | FCS |
//!
//! A station's ten bytes:
//!
//! | bytes | what |
//! |---|---|
//! | 0..4 | serial number, 0 while unknown |
//! | 4 | OOTX frames whose CRC fitted |
//! | 5 | OOTX frames that were dropped |
//! | 6 | mode: 0 A, 1 B, 2 C |
//! | 7 | faults as the station says, 0 when well |
//! | 8 | width bias, see [`Station::width_bias`] |
//! | 9 | bits 0, 1: [`Factory`]; bit 2: not the serial number of the room's file |
//!
//! Every count is since start-up and wraps. Rates are for the listener to make: two frames' counts over their uptimes.
//! A flash comes 120 times a second, a rotor sweeps 30 times.
//!
//! ```
//! use lighthouse_mote::frame::{HEALTH_LEN, Header, Health, Lock, Message, emit_health, parse};
//!
//! let header = Header { pan: 0x4c48, mote: 7, sequence: 301 };
//! let health = Health { uptime: 60, half_turn_q8: 90_167 << 8, lock: Lock::Locked, ..Health::default() };
//! let frame: [u8; HEALTH_LEN] = emit_health(header, &health);
//! let Ok((_, Message::Health(told))) = parse(&frame) else { panic!("a health frame") };
//! assert_eq!(told, health);
//! // 120 half turns are a second: the clock runs at 10.82 MHz.
//! assert_eq!(f64::from(told.half_turn_q8) / 256.0 * 120.0, 10_820_040.0);
//! ```
//!
//! What can go wrong: codes that mean nothing; they are refused.

use super::{Aligned, Header, Reader, Reject, Writer, code, envelope, seal};
pub use crate::angle::Factory;
pub use crate::sweep::Status as Lock;

/// Bytes of a whole health frame, FCS included.
pub const HEALTH_LEN: usize = 92;

code!(Lock: NoLight, Searching, Locked, OneStation, Spacing, Widths, V2);

/// Why the mote last started.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Reset {
    /// Power came.
    #[default]
    PowerOn = 0,
    /// Somebody asked for it.
    Requested = 1,
    /// The core faulted.
    Fault = 2,
    /// The program gave up.
    Panic = 3,
    /// The program hung.
    Watchdog = 4,
    /// Whatever the cause: the program in memory is not the one that was sent.
    Image = 5,
}

code!(Reset: PowerOn, Requested, Fault, Panic, Watchdog, Image);

code!(Factory: File, Awaited, Received);

/// What was turned away, by cause.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Rejects {
    /// Edges lost to a full queue, or without a partner.
    pub edges: u16,
    /// Pulses that fit no window of the cycle.
    pub strays: u16,
    /// Flashes at their place whose width is none.
    pub widths: u16,
    /// Pulses too short for any light of ours.
    pub short: u16,
    /// Pulses too long for a sweep, where one was due.
    pub long: u16,
    /// Sweeps after the first in their slot.
    pub second: u16,
    /// Sweeps outside the field of view.
    pub outside: u16,
    /// Fixes refused for their geometry.
    pub geometry: u16,
    /// Fixes refused for their mismatch.
    pub mismatch: u16,
    /// Sweeps that the tracker did not believe.
    pub disbelieved: u16,
    /// Reports lost to a full queue, or to a radio that did not answer.
    pub reports: u16,
    /// Times the cycle was lost.
    pub locks: u16,
}

/// One station as the mote knows it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Station {
    /// Its serial number, 0 while unknown.
    pub id: u32,
    /// OOTX frames whose CRC fitted, wrapping.
    pub good: u8,
    /// OOTX frames that were dropped, wrapping.
    pub bad: u8,
    /// Its channel: 0 A, 1 B, 2 C.
    pub mode: u8,
    /// Its own fault flags, 0 when well.
    pub faults: u8,
    /// How much longer than nominal its flashes look, in 1/32 of a width step: 1/25,600 half turn, 0.326 us. The
    /// largest, 41 us, stands for more.
    pub width_bias: i8,
    /// Whose factory terms are in use.
    pub factory: Factory,
    /// Its serial number is not the one in the room's file: the stations may have been swapped.
    pub is_stranger: bool,
}

/// How a mote is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Health {
    /// Seconds since start-up.
    pub uptime: u32,
    /// The measured half turn in ticks, Q8; 0 while there is none.
    pub half_turn_q8: u32,
    /// Whether the cycle is known.
    pub lock: Lock,
    /// Why the mote last started.
    pub reset: Reset,
    /// The program counter of a fault, the line of a panic, else 0.
    pub reset_detail: u32,
    /// Flashes understood of A and B, wrapping.
    pub syncs: [u16; 2],
    /// Sweeps understood, `[station][axis]`, wrapping.
    pub sweeps: [[u16; 2]; 2],
    /// What was turned away, wrapping.
    pub rejects: Rejects,
    /// The most that ever waited in the queues of pulses, sightings and reports.
    pub waiting: [u8; 3],
    /// Stations A and B.
    pub stations: [Station; 2],
}

/// Where a stranger is told.
const STRANGER: u8 = 1 << 2;

/// The whole frame, FCS included.
#[must_use]
pub fn emit_health(header: Header, health: &Health) -> [u8; HEALTH_LEN] {
    let mut frame = Aligned::BLANK;
    emit_health_into(&mut frame, header, health);
    frame.room.first_chunk().copied().unwrap_or([0; HEALTH_LEN])
}

/// The same where it is to be.
#[inline(never)]
pub fn emit_health_into(frame: &mut Aligned, header: Header, health: &Health) {
    let Some(bytes) = frame.take::<HEALTH_LEN>() else { return };
    let mut to = Writer { bytes: &mut *bytes, at: 0 };
    envelope(&mut to, header, super::KIND_HEALTH);
    to.put(health.uptime.to_le_bytes());
    to.put(health.half_turn_q8.to_le_bytes());
    to.put([health.lock as u8, health.reset as u8]);
    to.put(health.reset_detail.to_le_bytes());
    let [[az_a, el_a], [az_b, el_b]] = health.sweeps;
    let [syncs_a, syncs_b] = health.syncs;
    let Rejects {
        edges,
        strays,
        widths,
        short,
        long,
        second,
        outside,
        geometry,
        mismatch,
        disbelieved,
        reports,
        locks,
    } = health.rejects;
    for count in [
        syncs_a,
        syncs_b,
        az_a,
        el_a,
        az_b,
        el_b,
        edges,
        strays,
        widths,
        short,
        long,
        second,
        outside,
        geometry,
        mismatch,
        disbelieved,
        reports,
        locks,
    ] {
        to.put(count.to_le_bytes());
    }
    to.put(health.waiting);
    for station in &health.stations {
        to.put(station.id.to_le_bytes());
        to.put([station.good, station.bad, station.mode, station.faults]);
        to.put(station.width_bias.to_le_bytes());
        to.put([station.factory as u8 | if station.is_stranger { STRANGER } else { 0 }]);
    }
    seal(bytes);
}

/// What follows the envelope.
pub(super) fn parse(from: &mut Reader<'_>) -> Result<Health, Reject> {
    Ok(Health {
        uptime: from.u32(),
        half_turn_q8: from.u32(),
        lock: Lock::of_code(from.u8())?,
        reset: Reset::of_code(from.u8())?,
        reset_detail: from.u32(),
        syncs: [from.u16(), from.u16()],
        sweeps: [[from.u16(), from.u16()], [from.u16(), from.u16()]],
        rejects: Rejects {
            edges: from.u16(),
            strays: from.u16(),
            widths: from.u16(),
            short: from.u16(),
            long: from.u16(),
            second: from.u16(),
            outside: from.u16(),
            geometry: from.u16(),
            mismatch: from.u16(),
            disbelieved: from.u16(),
            reports: from.u16(),
            locks: from.u16(),
        },
        waiting: from.take(),
        stations: [station(from)?, station(from)?],
    })
}

fn station(from: &mut Reader<'_>) -> Result<Station, Reject> {
    let id = from.u32();
    let [good, bad, mode, faults] = from.take();
    let width_bias = i8::from_le_bytes(from.take());
    let flags = from.u8();
    let factory = Factory::of_code(flags & !STRANGER)?;
    Ok(Station { id, good, bad, mode, faults, width_bias, factory, is_stranger: flags & STRANGER != 0 })
}
