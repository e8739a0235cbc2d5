//! The timetable of two Lighthouse V1 stations: who flashes and who sweeps.
//!
//! Rotors turn at 60 Hz and every half turn is a slot. Both stations open a slot with a sync flash, A first and B a
//! fixed gap later; the one that does not say "skip" sweeps the room in the rest of the slot. Four slots, 33.3 ms,
//! and it starts again: B azimuth, B elevation, A azimuth, A elevation.
//!
//! What can go wrong: the gap must outlast the longest flash (135.4 us), or the two merge into one.

use serde::{Deserialize, Serialize};

/// Half a turn of a 60 Hz rotor, seconds.
pub const HALF_TURN_S: f64 = 1.0 / 120.0;

/// The shortest sync flash: azimuth, data 0, no skip (3,000 ticks of 48 MHz).
const SYNC_US: f64 = 62.5;
/// Added to the flash when elevation is swept (500 ticks of 48 MHz).
const SYNC_AXIS_US: f64 = 500.0 / 48.0;
/// Added to the flash when the data bit is one (1,000 ticks of 48 MHz).
const SYNC_DATA_US: f64 = 1_000.0 / 48.0;
/// Added to the flash when the station will not sweep (2,000 ticks of 48 MHz).
const SYNC_SKIP_US: f64 = 2_000.0 / 48.0;

/// One of the two stations, by who flashes first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum StationId {
    /// Flashes first in every slot.
    A,
    /// Flashes second.
    B,
}

/// The angle a sweep measures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum Axis {
    /// Left to right: the plane turns about the station's y.
    Azimuth,
    /// Bottom to top: the plane turns about the station's x.
    Elevation,
}

/// How the rotors are driven.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Timing {
    /// When the first sync flash of A starts, seconds after the mote's power-on.
    pub first_sync_s: f64,
    /// From the start of A's flash to the start of B's, microseconds, 350 to 450.
    pub sync_gap_us: f64,
    /// How much longer than 1/120 s a half turn takes, parts per million.
    pub half_turn_error_ppm: f64,
    /// Deviation of a sweep's angle from where the plane should point, gaussian, degrees.
    pub angle_noise_deg: f64,
}

impl Default for Timing {
    fn default() -> Self {
        Timing { first_sync_s: 1e-3, sync_gap_us: 20_000.0 / 48.0, half_turn_error_ppm: 0.0, angle_noise_deg: 0.0 }
    }
}

impl Timing {
    /// The length of a slot, seconds.
    #[must_use]
    pub fn half_turn_s(&self) -> f64 {
        HALF_TURN_S * (1.0 + self.half_turn_error_ppm * 1e-6)
    }

    /// When a slot starts, seconds.
    #[must_use]
    pub fn start_s(&self, slot: u64) -> f64 {
        self.first_sync_s + slot as f64 * self.half_turn_s()
    }

    /// When a station's flash of a slot starts, seconds.
    #[must_use]
    pub fn sync_s(&self, slot: u64, station: StationId) -> f64 {
        match station {
            StationId::A => self.start_s(slot),
            StationId::B => self.start_s(slot) + self.sync_gap_us * 1e-6,
        }
    }
}

/// The axis of a slot and the station that sweeps it.
#[must_use]
pub const fn sweep_of(slot: u64) -> (StationId, Axis) {
    match slot % 4 {
        0 => (StationId::B, Axis::Azimuth),
        1 => (StationId::B, Axis::Elevation),
        2 => (StationId::A, Axis::Azimuth),
        _ => (StationId::A, Axis::Elevation),
    }
}

/// How long a sync flash lasts, microseconds.
#[must_use]
pub fn sync_width_us(axis: Axis, data: bool, skip: bool) -> f64 {
    let add = |is: bool, us: f64| if is { us } else { 0.0 };
    SYNC_US + add(axis == Axis::Elevation, SYNC_AXIS_US) + add(data, SYNC_DATA_US) + add(skip, SYNC_SKIP_US)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cycle_sweeps_each_axis_of_each_station_once() {
        let cycle: Vec<_> = (0..4).map(sweep_of).collect();
        for station in [StationId::A, StationId::B] {
            for axis in [Axis::Azimuth, Axis::Elevation] {
                assert_eq!(cycle.iter().filter(|&&slot| slot == (station, axis)).count(), 1);
            }
        }
        assert_eq!(sweep_of(1_000_000), sweep_of(0));
    }

    #[test]
    fn the_flashes_have_the_eight_widths_of_v1() {
        let ticks = |axis, data, skip| (sync_width_us(axis, data, skip) * 48.0).round() as u32;
        let widths = [Axis::Azimuth, Axis::Elevation].map(|axis| {
            [ticks(axis, false, false), ticks(axis, true, false), ticks(axis, false, true), ticks(axis, true, true)]
        });
        assert_eq!(widths, [[3000, 4000, 5000, 6000], [3500, 4500, 5500, 6500]]);
    }
}
