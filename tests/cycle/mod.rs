//! The light of two synchronised stations, pulse by pulse, in integers: a Cortex-M0 makes it as exactly as a host.
//!
//! The unit of the stations is 1/48 us, as in their own firmware: 400,000 to the half turn, 20,000 from A's flash to
//! B's, 3,000 for the shortest flash and 500 per width step. [`Cycle`] stamps it with the counter of a mote whose
//! clock, start and angles are free.

#![allow(dead_code, reason = "each test takes the part it needs")]

use lighthouse_mote::pulse::Pulse;
use lighthouse_mote::sweep::{Axis, Station, Sync};
use lighthouse_mote::time::{Span, Ticks};

/// The half turn in 1/48 us: 8.333 ms.
pub(crate) const HALF_TURN: u64 = 400_000;
/// From A's flash to B's, in 1/48 us: 417 us.
const GAP: u64 = 20_000;
/// A sweep lights the diode for 10 us.
const SWEEP_WIDTH: u64 = 480;
/// Pulses in a slot: A's flash, B's flash, the sweep.
pub(crate) const PULSES_PER_SLOT: u32 = 3;

/// What a pulse of the cycle is, and what the mote should say it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Truth {
    /// A flash with these bits.
    Sync(Sync),
    /// The sweep of this rotor.
    Sweep(Station, Axis),
}

/// Two stations that a mote at rest sees with its own clock.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Cycle {
    /// The mote's clock in Hz.
    pub(crate) clock: u32,
    /// What its counter reads as slot 0 begins.
    pub(crate) start: u32,
    /// From a station's flash to the middle of its sweep, in 1/48 us, `[station][axis]`; 200,000 is straight ahead.
    pub(crate) sweep_after: [[u32; 2]; 2],
}

impl Cycle {
    /// A mote with the clock of the chip, somewhere in front of both stations.
    pub(crate) const TYPICAL: Self =
        Self { clock: 10_820_000, start: 1_000, sweep_after: [[230_000, 180_000], [150_000, 210_000]] };
    /// The same, at x 0.5, y 1.0, z 0.5 m of the default room: the ideal angles -70542, 21162, 102300, -14620 (2^-20 half
    /// turns), less the room's phases, from 200,000 straight ahead.
    pub(crate) const IN_THE_ROOM: Self =
        Self { sweep_after: [[167_155, 200_996], [237_081, 191_772]], ..Self::TYPICAL };

    /// Pulse `index` of slot `slot`: 0 is A's flash, 1 is B's, 2 the sweep.
    pub(crate) fn pulse(&self, slot: u32, index: u32) -> (Truth, Pulse) {
        let (sweeping, axis) = match slot % 4 {
            0 => (Station::B, Axis::Azimuth),
            1 => (Station::B, Axis::Elevation),
            2 => (Station::A, Axis::Azimuth),
            _ => (Station::A, Axis::Elevation),
        };
        let flash_at = |station| u64::from(slot) * HALF_TURN + GAP * station as u64;
        let flash = |station: Station| {
            // Both stations spell their bits at different paces, so that every pair of bits comes by.
            let data = (slot >> (2 + station as u32)) & 1 == 1;
            let sync = Sync { station, axis, skip: station != sweeping, data };
            (Truth::Sync(sync), flash_at(station), width(sync))
        };
        let (truth, at, width) = match index {
            0 => flash(Station::A),
            1 => flash(Station::B),
            _ => {
                let after = self.sweep_after[sweeping as usize][axis as usize];
                (Truth::Sweep(sweeping, axis), flash_at(sweeping) + u64::from(after) - SWEEP_WIDTH / 2, SWEEP_WIDTH)
            }
        };
        let (start, end) = (self.ticks(at), self.ticks(at + width));
        (truth, Pulse { start, width: end.since(start) })
    }

    /// Every pulse of `slots` whole slots from `first` on.
    pub(crate) fn pulses(self, first: u32, slots: u32) -> impl Iterator<Item = (Truth, Pulse)> {
        (0..slots * PULSES_PER_SLOT).map(move |n| self.pulse(first + n / PULSES_PER_SLOT, n % PULSES_PER_SLOT))
    }

    /// What the counter reads `at` 1/48 us after slot 0 began.
    pub(crate) fn ticks(&self, at: u64) -> Ticks {
        Ticks(self.start).after(self.span(at))
    }

    /// How many whole ticks `length` 1/48 us are.
    pub(crate) fn span(&self, length: u64) -> Span {
        Span((length * u64::from(self.clock) / 48_000_000) as u32)
    }
}

/// The width of a flash in 1/48 us: 62.5 us, and 10.4 for the axis, 20.8 for the data bit, 41.7 for the skip.
pub(crate) fn width(sync: Sync) -> u64 {
    3_000 + 500 * sync.axis as u64 + 1_000 * u64::from(sync.data) + 2_000 * u64::from(sync.skip)
}
