//! One angle at a time to a position, a velocity, and how sure of both.
//!
//! A fix needs four angles that belong together; a mote in a hand rarely has them at once. Each sweep alone says that
//! the mote lies in one plane through its station, and the tracker takes each plane as it comes: an extended Kalman
//! filter over position and velocity in world coordinates, in 32-bit integers.
//!
//! ```
//! use lighthouse_mote::angle::Angle;
//! use lighthouse_mote::sweep::{Axis, Station};
//! use lighthouse_mote::track::{self, Level, PER_HALF_TURN, State, Step, Sweep};
//!
//! mod room {
//!     // What build.rs made of calib/default.toml.
//!     include!(concat!(env!("OUT_DIR"), "/calib.rs"));
//! }
//!
//! // A fix that is 3 cm off begins the track; what the stations see at 0.5, 1.0, 0.5 m mends it.
//! let (config, room) = (&room::CONFIG.track, &room::CONFIG.room);
//! let truth = [1 << 15, 1 << 16, 1 << 15];
//! let mut state = State::default();
//! assert!(track::start(config, room, &mut state, [truth[0], truth[1], truth[2] + 1966], 66));
//! let sweep = |station, axis, angle| Sweep { station, axis, angle: Angle(angle), elapsed: PER_HALF_TURN as u16 };
//! let cycle = [
//!     sweep(Station::B, Axis::Azimuth, 102_300),
//!     sweep(Station::B, Axis::Elevation, -14_620),
//!     sweep(Station::A, Axis::Azimuth, -70_542),
//!     sweep(Station::A, Axis::Elevation, 21_162),
//! ];
//! for sweep in cycle.iter().cycle().take(240) {
//!     assert_eq!(track::step(config, room, &mut state, sweep), Step::Believed);
//! }
//! let found = track::report(config, &state, 0);
//! assert_eq!(found.level, Level::Full);
//! assert!((0..3).all(|axis| found.position[axis].abs_diff(truth[axis]) <= 66), "1 mm: {found:?}");
//! // The same sweep by way of a mirror.
//! assert_eq!(track::step(config, room, &mut state, &sweep(Station::B, Axis::Azimuth, 142_300)), Step::Refused);
//! ```
//!
//! # Design
//! - Given the measured tangent x, the plane `(r1 - x r3) . (p - station) = 0` is linear in p: the step is exact
//!   however far off the estimate is, and only the weight depends on it.
//! - The innovation is formed modulo 2^32, which is 4 m: its terms may overflow, their sum does not on a track that is
//!   not metres off. [`start`] therefore wants a fix in both stations' view, and a rotor that is refused again and
//!   again ends the track.
//! - Covariances are Q32 m^2. One step shifts them to 17 significant bits, so every product fits 32 bits: the
//!   Cortex-M0 multiplies 32 x 32 -> 32 in one instruction and anything wider in fifty. The gain is kept divided by the
//!   root of the innovation's variance, in Q16 m, so that products of it are Q32 as they come.
//! - The full 6 x 6 covariance is kept. Where only the position has one and the velocity's gain follows the position's,
//!   a step costs half and the mean error inside the calibrate window of the 2020 recording is 1.4 times as large; a
//!   position alone, without velocity, errs twice as far.
//! - Covariances advance in whole half turns, the position in 1/256 of one: sweeps come about one half turn apart, and
//!   a whole number needs no shift.
//!
//! # What can go wrong
//! - A reflection is a wrong plane. The gate refuses what lies too far off for the uncertainty of the moment.
//! - A wrong track refuses every right plane. When one rotor has been refused for long enough the track is given up, and
//!   so it is when none was heard or when it knows too little; [`start`] begins anew. It cannot lock itself out.
//! - One station alone does not see depth well: the standard deviation grows, and the track ends before it is of no use.

mod filter;
mod root;

#[cfg(test)]
mod tests;
#[cfg(test)]
mod twin;

pub use root::square_root;

use nalgebra::{Matrix3, Vector3};

use crate::angle::Angle;
use crate::fix;
use crate::sweep::{Axis, Station};

/// Units of time per half turn of a rotor (8.333 ms): 32.6 us each.
pub const PER_HALF_TURN: u32 = 256;

/// Half turns per second: two per turn of a 60 Hz rotor.
const HALF_TURNS_PER_S: f64 = 120.0;

/// How the mote may move and how far light is believed. Times are in 1/256 half turns.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Config {
    /// Standard deviation of one angle, Q18 radians, factory and calibration errors included; below 2^11.
    pub noise: i32,
    /// How fast the velocity wanders: variance per half turn, Q32 (m / half turn)^2; below 2^17.
    pub agility: i32,
    /// The largest innovation that is believed, Q13 standard deviations; at most 4.
    pub gate: i32,
    /// Standard deviation of the position per axis at the start, Q16 m; below 2^13.
    pub start_position: i32,
    /// Standard deviation of the velocity per axis at the start, Q24 m / half turn; below 2^17.
    pub start_velocity: i32,
    /// The largest mismatch of a fix to start from, Q16 m.
    pub start_mismatch: i32,
    /// The track ends when no sweep was believed for this long; at least 17 half turns, and below 2^14.
    pub lost_after: u32,
    /// The track ends when the sweeps of one rotor were refused so many times in a row. A rotor sweeps once in 4 half
    /// turns, so 8 take at least 0.23 s.
    pub doubt_count: u16,
    /// While the sweeps of one rotor were refused so many times in a row the level is not [`Level::Full`]. A sweep that
    /// is believed although its plane lies 2.5 cm from the estimate leaves as much doubt.
    pub doubtful: u16,
    /// Above this speed the level is not [`Level::Full`], Q8 m/s, squared: who turns there is elsewhere before the gate
    /// can tell.
    pub quick: i32,
    /// A station counts as seen for this long after a sweep of it was believed.
    pub fresh: u32,
    /// The track ends when the variances of the three axes sum up to more than this, Q32 m^2; at most 0.3^2.
    pub variance_limit: i32,
    /// Above this standard deviation on any axis no position is claimed, Q16 m.
    pub sd_limit: i32,
}

impl Config {
    /// A mote in a hand, with angles as good as an uncompensated SCuM clock gives them.
    ///
    /// Noise: the 2020 recording scatters by 2.6 to 4.2 mrad about its room's poses, of which 0.5 mrad differ from one
    /// sweep to the next. Agility, gate and limits: least mean error at 95 % coverage on simulated paths that see light
    /// exactly when that recording does inside its calibrate window; within a tenth from half to twice the value.
    pub const HAND_HELD: Self = Self {
        noise: (0.0035 * Q18) as i32,
        agility: (1.0 / (HALF_TURNS_PER_S * HALF_TURNS_PER_S * HALF_TURNS_PER_S) * Q32) as i32,
        gate: (3.0 * Q13) as i32,
        start_position: (0.06 * Q16) as i32,
        start_velocity: (0.3 / HALF_TURNS_PER_S * Q24) as i32,
        start_mismatch: (0.02 * Q16) as i32,
        lost_after: 48 * PER_HALF_TURN,
        doubt_count: 8,
        doubtful: 2,
        quick: (0.9 * 0.9 * Q16) as i32,
        fresh: 24 * PER_HALF_TURN,
        variance_limit: (0.3 * 0.3 * Q32) as i32,
        sd_limit: (0.15 * Q16) as i32,
    };
}

const Q13: f64 = (1u64 << 13) as f64;
const Q16: f64 = (1u64 << 16) as f64;
const Q18: f64 = (1u64 << 18) as f64;
const Q24: f64 = (1u64 << 24) as f64;
const Q32: f64 = (1u64 << 32) as f64;

/// Where one station is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pose {
    /// The station's axes in the world as columns right, up, forward: the paper's R, transposed. Q15; entries at most
    /// 2^15 in size.
    pub axes: Matrix3<i32>,
    /// In the world, Q24 m, so within +-128 m.
    pub position: Vector3<i32>,
}

impl Pose {
    /// Whether it lights `position` (Q16 m): at most 8 m ahead and 63 deg to a side.
    #[inline(never)]
    fn lights(&self, position: [i32; 3]) -> bool {
        // Q10, so that a sum of three products with Q15 fits within 16 m.
        let mut away = [0; 3];
        for (away, (own, other)) in away.iter_mut().zip(position.iter().zip(&self.position)) {
            *away = (own >> 6).saturating_sub(other >> 14);
            if away.unsigned_abs() >= 1 << 14 {
                return false;
            }
        }
        let seen = self.axes.data.0.map(|row| {
            let products = row.iter().zip(&away).map(|(entry, axis)| entry.wrapping_mul(*axis) >> 2);
            products.fold(0, i32::wrapping_add) >> 13
        });
        let [right, up, ahead] = seen;
        (1..8 << 10).contains(&ahead) && right.abs() <= 2 * ahead && up.abs() <= 2 * ahead
    }
}

/// Where the two stations are, A first. The tracker reaches 8 m from either.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Room {
    /// The stations' poses.
    pub stations: [Pose; 2],
}

/// One angle of one rotor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sweep {
    /// Whose laser.
    pub station: Station,
    /// Which rotor.
    pub axis: Axis,
    /// The ideal angle.
    pub angle: Angle,
    /// Time since the sweep of the previous call, 1/256 half turns, saturating at 2.1 s.
    pub elapsed: u16,
}

/// What became of one sweep.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Step {
    /// It moved the estimate.
    Believed = 0,
    /// The angle lies outside the table of tangents, +-60 deg: the track goes on as if there had been no sweep.
    OutOfView = 1,
    /// There is no track; [`start`] makes one.
    Idle = 2,
    /// Too far from where the track is; the track goes on without it.
    Refused = 3,
    /// The track ended, by age, doubt or uncertainty.
    Lost = 4,
}

/// How much is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub enum Level {
    /// No light.
    #[default]
    None,
    /// Light, but no position.
    Angles,
    /// A position carried over a gap, seen by one station only, or in quick motion.
    Tracked,
    /// A position seen by both stations lately.
    Full,
}

/// Position, velocity, how sure, at the time of the report.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Track {
    /// World x, y, z, Q16 m. Meaningless below [`Level::Tracked`].
    pub position: [i32; 3],
    /// World x, y, z, Q16 m/s.
    pub velocity: [i32; 3],
    /// Standard deviation of the position per axis, Q16 m.
    pub sd: [i32; 3],
    /// How much is known.
    pub level: Level,
}

/// Whether there is a track.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum Course {
    #[default]
    Idle,
    /// The latest sweep was believed.
    Steady,
    /// The latest sweep was not believed.
    Doubted,
}

/// What is known of one station's sweeps.
#[derive(Debug, Clone, Copy, Default)]
#[repr(C)]
struct Watch {
    /// The latest believed one.
    seen: u32,
    /// Per rotor: refused in a row.
    refused: [u16; 2],
}

/// The estimate and what is needed to doubt it. Times wrap after 38 h.
#[derive(Debug, Clone, Default)]
#[repr(C)]
pub struct State {
    estimate: filter::Estimate,
    course: Course,
    heard: bool,
    /// The latest call of [`step`], 1/256 half turns since some beginning.
    now: u32,
    /// The latest sweep within view.
    light: u32,
    /// The latest believed sweep.
    believed: u32,
    watch: [Watch; 2],
    /// Fixes in a row that were metres away.
    elsewhere: u16,
}

/// Begins a track at a fix: `position` in Q16 m, `mismatch` of its rays in Q16 m. True when it did.
///
/// Does nothing while a track is running, unless fix after fix is metres away: innovations are formed modulo 4 m, so a track that
/// many metres off may go on unrefused, and only a fix can tell. Does nothing either when the mismatch is too large to trust the fix, or where a
/// station's light does not reach.
pub fn start(config: &Config, room: &Room, state: &mut State, position: [i32; 3], mismatch: i32) -> bool {
    if mismatch.unsigned_abs() > config.start_mismatch.unsigned_abs() {
        return false;
    }
    // Nearly always the end of it, so asked before the light.
    let tracking = state.course != Course::Idle;
    if tracking && !state.estimate.is_elsewhere(position) {
        state.elsewhere = 0;
        return false;
    }
    if !room.stations.iter().all(|station| station.lights(position)) {
        return false;
    }
    let now = state.now;
    if tracking {
        state.elsewhere = state.elsewhere.saturating_add(1);
        if state.elsewhere < config.doubt_count {
            return false;
        }
    }
    *state = State {
        course: Course::Steady,
        heard: true,
        now,
        light: now,
        believed: now,
        watch: [Watch { seen: now, refused: [0; 2] }; 2],
        elsewhere: 0,
        estimate: filter::Estimate::at(position, config.start_position, config.start_velocity, now),
    };
    true
}

/// Takes one sweep.
///
/// Not inlined, and `bridge` hides where the state lies: the core reaches 32 words from a register, and the state
/// fills them. Told its address, the compiler counts from elsewhere and pays an instruction for each access.
#[inline(never)]
pub fn step(config: &Config, room: &Room, state: &mut State, sweep: &Sweep) -> Step {
    let now = state.now.wrapping_add(u32::from(sweep.elapsed));
    state.now = now;
    if state.course != Course::Steady {
        core::hint::cold_path();
        if state.course == Course::Idle {
            core::hint::cold_path();
            state.light = now;
            state.heard = true;
            return Step::Idle;
        }
        // Where the one before was believed, the gap since is looked at before it is carried over.
        if now.wrapping_sub(state.believed) >= config.lost_after {
            return lose(state);
        }
        state.course = Course::Steady;
    }
    let Some(spread) = state.estimate.predict(config, now) else {
        return bridge(config, room, state, sweep);
    };
    // A negative sum is nonsense, and large.
    if spread.cast_unsigned() > config.variance_limit.cast_unsigned() {
        return lose(state);
    }
    let Some(tangent) = fix::tan(sweep.angle.0) else {
        state.estimate.refuse();
        state.course = Course::Doubted;
        return Step::OutOfView;
    };
    // Q28 to Q14; the half is of another rounding.
    let tangent = tangent.wrapping_sub(fix::HALF) >> 14;
    let [a, b] = &room.stations;
    let pose = if sweep.station == Station::A { a } else { b };
    let plane = state.estimate.meet(config, pose, sweep.axis, tangent, spread);
    let watch = &mut state.watch[sweep.station as usize];
    let refused = &mut watch.refused[sweep.axis as usize];
    let Some(plane) = plane else {
        state.estimate.refuse();
        state.course = Course::Doubted;
        *refused = refused.wrapping_add(1);
        return if *refused < config.doubt_count { Step::Refused } else { lose(state) };
    };
    // Twice, because a choice of values costs seven instructions.
    *refused = 0;
    filter::home();
    if plane.is_leap {
        *refused = config.doubtful;
    }
    watch.seen = now;
    state.believed = now;
    state.estimate.learn(&plane);
    Step::Believed
}

/// Takes a sweep that comes after a gap too long for one stride.
#[cold]
#[inline(never)]
fn bridge(config: &Config, room: &Room, state: &mut State, sweep: &Sweep) -> Step {
    let state = core::hint::black_box(state);
    let now = state.now;
    if now.wrapping_sub(state.estimate.at) >= config.lost_after {
        return lose(state);
    }
    // Of what is out of view nothing is believed.
    let mut again = Sweep { angle: Angle(i32::MIN), elapsed: 0, ..*sweep };
    while !state.estimate.reaches(now) {
        state.now = state.estimate.stride();
        let outcome = step(config, room, state, &again);
        state.now = now;
        if outcome == Step::Lost {
            return lose(state);
        }
    }
    again.angle = sweep.angle;
    step(config, room, state, &again)
}

/// Ends the track.
#[cold]
#[inline(never)]
fn lose(state: &mut State) -> Step {
    state.course = Course::Idle;
    state.light = state.now;
    Step::Lost
}

/// What is known `elapsed` after the latest call of [`step`], in 1/256 half turns: the position carried on, the
/// standard deviation grown.
#[must_use]
pub fn report(config: &Config, state: &State, elapsed: u32) -> Track {
    let since = |then: u32| state.now.wrapping_sub(then).saturating_add(elapsed);
    let light = if state.heard && since(state.light) <= config.fresh { Level::Angles } else { Level::None };
    if state.course == Course::Idle || since(state.believed) > config.lost_after {
        return Track { level: light, ..Track::default() };
    }
    let (position, velocity, variance) = state.estimate.after(config, state.now.wrapping_add(elapsed));
    let sd = variance.map(root::square_root);
    let level = if sd.iter().any(|sd| *sd > config.sd_limit) {
        Level::Angles
    } else if state.watch.iter().all(|watch| since(watch.seen) <= config.fresh)
        && state.watch.iter().flat_map(|watch| &watch.refused).all(|refused| *refused < config.doubtful)
        && velocity.iter().map(|speed| (speed >> 8).wrapping_mul(speed >> 8)).fold(0, i32::wrapping_add) <= config.quick
    {
        Level::Full
    } else {
        Level::Tracked
    };
    Track { position, velocity, sd, level }
}
