//! A calibration as the Rust source that a board's binary includes.
//!
//! What can go wrong: a room that the fixed-point solver cannot hold; it is refused with the number that breaks.

use super::quantise::{self, Baked, OutOfReach, Room, TRACK_REACH_M};
use super::schema::{
    Calibration, Error, Estimate, Mote, Name, RoomBox, Rotor, SEALED_HALF_TURNS, Send, Station, SweepEdge,
};
use super::volume::{reach, shared_view};

/// Milliseconds of a half turn.
const HALF_TURN_MS: f64 = 1000.0 / 120.0;
/// Units of [`lighthouse_mote::angle::Angle`] in a radian: 2^20 in pi.
const ANGLE_UNITS_PER_RAD: f64 = (1u32 << 20) as f64 / std::f64::consts::PI;

/// A room that declares no volume is tried at these shares of its reach: the widest that the fast form holds at its best,
/// or else the widest that any can.
const SHARES: [f64; 5] = [1.0, 0.85, 0.7, 0.6, 0.5];

/// A room as the solver holds it.
#[derive(Debug, Clone)]
pub struct Held {
    /// The volume: the declared one, or the widest that could be held.
    #[allow(dead_code, reason = "the build only wants the numbers")]
    pub volume: RoomBox,
    /// The solver's numbers.
    pub baked: Baked,
}

impl Held {
    /// Whether it is as exact as a room can be: the fast form, at its best.
    #[must_use]
    pub fn is_exact(&self) -> bool {
        self.baked.slack <= 1.0
    }

    /// What whoever flies this room ought to know, if anything.
    #[must_use]
    #[allow(dead_code, reason = "not everybody who bakes flies")]
    pub fn warning(&self, mote: &Mote) -> Option<String> {
        let OutOfReach { share, .. } = self.baked.out_of_reach;
        (mote.estimate == Estimate::Track && share > 0.0).then(|| {
            format!(
                "{:.1} % of the room lies {TRACK_REACH_M} m or more ahead of a station, where no track begins",
                100.0 * share
            )
        })
    }
}

/// Quantises the room.
///
/// # Errors
/// The stations share no view, the solver cannot hold the room, or no track could begin in it.
pub fn bake(file: &str, calibration: &Calibration) -> Result<Held, Error> {
    let stations = &calibration.stations;
    let refuse = |field: &str, what: String| Error { file: file.to_string(), line: 0, field: field.to_string(), what };
    let hold = |volume: RoomBox| {
        let RoomBox { min, max } = volume;
        let pose = |station: Station| quantise::Station { rotation: station.rotation, position: station.position };
        let baked = quantise::bake(&Room { stations: stations.map(pose), min, max })
            .map_err(|refusal| refuse("room", format!("cannot be represented: {refusal}")))?;
        let OutOfReach { share, nearest_m } = baked.out_of_reach;
        if share >= 1.0 && calibration.mote.estimate == Estimate::Track {
            return Err(refuse(
                "room",
                format!(
                    "no track could begin in it: its nearest point is {nearest_m:.2} m ahead of a station, of at most \
                     {TRACK_REACH_M}; estimate = \"fix\" under [mote] does without"
                ),
            ));
        }
        Ok(Held { volume, baked })
    };
    if let Some(volume) = calibration.room {
        return hold(volume);
    }
    let mut widest = Err(refuse(
        "station",
        "the two stations light no common point; declare [room], or check the rotations".to_string(),
    ));
    for share in SHARES {
        let Some(volume) = shared_view(stations, share * reach(stations)) else { continue };
        let held = hold(volume);
        if held.as_ref().is_ok_and(Held::is_exact) {
            return held;
        }
        if widest.is_err() {
            widest = held;
        }
    }
    widest
}

/// The factory terms of one rotor in angle units: phase, tan(tilt), gibbous sine and cosine.
#[must_use]
pub fn rotor(rotor: &Rotor) -> [i32; 4] {
    let units = |rad: f64| (rad * ANGLE_UNITS_PER_RAD).round() as i32;
    let (sin, cos) = rotor.gibphase.sin_cos();
    [units(rotor.phase), units(rotor.tilt.tan()), units(rotor.gibmag * cos), units(rotor.gibmag * sin)]
}

/// A station as the tracker wants it: its axes right, up, forward in the world, Q15, and its position, Q24 m.
#[must_use]
pub fn pose(station: &Station) -> ([[i32; 3]; 3], [i32; 3]) {
    let fixed = |value: f64, bits: i32| (value * f64::powi(2.0, bits)).round() as i32;
    (station.rotation.map(|row| row.map(|entry| fixed(entry, 15))), station.position.map(|axis| fixed(axis, 24)))
}

/// The tracker's settings as source: the usual ones, but for the noise where the room says its own, Q18 radians.
fn track(calibration: &Calibration) -> String {
    const USUAL: &str = "lighthouse_mote::track::Config::HAND_HELD";
    match calibration.mote.angle_noise_mrad {
        None => USUAL.to_string(),
        Some(mrad) => {
            let noise = (mrad * 1e-3 * f64::from(1u32 << 18)).round() as i32;
            format!("lighthouse_mote::track::Config {{ noise: {noise}, ..{USUAL} }}")
        }
    }
}

/// When the mote sends, as source.
fn send(mote: &Mote) -> String {
    let when = match mote.sends() {
        Send::Slotted => "Slotted",
        Send::Jittered => "Jittered",
        Send::Steady => "Steady",
    };
    let moved = (mote.moved_m * 65_536.0).round() as u32;
    let heartbeat = (mote.heartbeat_s * 1000.0 / HALF_TURN_MS).round() as u16;
    // A build without the feature seals nothing.
    let ahead = match mote.key {
        Some(_) => "if cfg!(feature = \"security\") { lighthouse_mote::send::SEALING_HALF_TURNS } else { 0 }",
        None => "0",
    };
    format!(
        "lighthouse_mote::send::Config {{ when: lighthouse_mote::send::When::{when}, moved_q16: {moved}, \
         heartbeat_half_turns: {heartbeat}, ahead_half_turns: {ahead} }}"
    )
}

/// The shortest pulse of a laser in 1/8192 half turns.
#[must_use]
pub fn shortest_sweep(us: f64) -> u32 {
    (us * 8.192 / HALF_TURN_MS).round() as u32
}

/// The age rule in whole half turns, at least one.
#[must_use]
pub fn max_age_half_turns(calibration: &Calibration) -> u16 {
    (calibration.mote.max_angle_age_ms / HALF_TURN_MS).round().max(1.0) as u16
}

/// A text as the rest of a line: nothing in it ends that line.
fn in_line(text: &str) -> String {
    text.replace(|c: char| c.is_control() || matches!(c, '\u{2028}' | '\u{2029}'), " ")
}

/// The constants that a binary includes.
///
/// # Errors
/// As [`bake`] and [`source_of`].
#[allow(dead_code, reason = "the build looks at what is held first")]
pub fn source(file: &str, calibration: &Calibration) -> Result<String, Error> {
    source_of(file, calibration, &bake(file, calibration)?)
}

/// The same of a room that is held already.
///
/// # Errors
/// Slots too near each other for a room with a key.
pub fn source_of(file: &str, calibration: &Calibration, held: &Held) -> Result<String, Error> {
    let solver = held.baked.emit();
    let mote = calibration.mote;
    if mote.key.is_some() && mote.sends() == Send::Slotted && mote.report_every_half_turns < SEALED_HALF_TURNS {
        let what = format!(
            "{}; where the room has a key, \"slotted\" takes {SEALED_HALF_TURNS} or more",
            mote.report_every_half_turns
        );
        let field = "mote.report_every_half_turns".to_string();
        return Err(Error { file: file.to_string(), line: 0, field, what });
    }
    let rotors = calibration.stations.map(|station| {
        let [az, el] = station.factory.each_ref().map(|terms| {
            let [phase, tilt, sin, cos] = rotor(terms);
            format!(
                "lighthouse_mote::angle::Rotor {{ phase: {phase}, tilt: {tilt}, gibbous_sin: {sin}, gibbous_cos: {cos} }}"
            )
        });
        format!("[{az}, {el}]")
    });
    let max_age = max_age_half_turns(calibration);
    let poses = calibration.stations.map(|station| {
        let ([right, up, forward], position) = pose(&station);
        let column = |[x, y, z]: [i32; 3]| format!("{x}, {y}, {z}");
        format!(
            "lighthouse_mote::track::Pose {{ axes: nalgebra::Matrix3::from_array_storage(nalgebra::ArrayStorage([[{}], \
             [{}], [{}]])), position: nalgebra::Vector3::new({}) }}",
            column(right),
            column(up),
            column(forward),
            column(position)
        )
    });
    let provenance: String = calibration
        .provenance
        .iter()
        .map(|(key, value)| format!("// {}: {}\n", in_line(key), in_line(value)))
        .collect();
    Ok(format!(
        "{provenance}/// The room, as baked from `{}`.
pub const CONFIG: lighthouse_mote::chain::Config = lighthouse_mote::chain::Config {{
    sweep: lighthouse_mote::sweep::Config {{
        lone: {lone},
        shortest_sweep: {shortest_sweep},
        stamp: lighthouse_mote::sweep::Stamp::{stamp},
    }},
    ootx: lighthouse_mote::ootx::Config {{ ids: {ids:?}, ..lighthouse_mote::ootx::Config::DEFAULT }},
    angle: lighthouse_mote::angle::Config::new([{}, {}]).with_received({received:?}),
    fix: lighthouse_mote::fix::Config {{ calib: {solver}, max_age_half_turns: {max_age} }},
    track: {track},
    room: lighthouse_mote::track::Room {{ stations: [{}, {}] }},
    estimate: lighthouse_mote::chain::Estimate::{estimate},
    report_every_half_turns: {every},
    send: {send},
}};
/// The personal area network.
pub const PAN: u16 = {pan};
/// The mote's short address.
pub const MOTE: u16 = {id};
/// The room's key: frames then prove who made them.
#[allow(dead_code, reason = \"a build without the feature has no use for it\")]
pub const KEY: Option<[u8; 16]> = {key:?};
",
        in_line(file),
        rotors[0],
        rotors[1],
        poses[0],
        poses[1],
        estimate = match mote.estimate {
            Estimate::Track => "Track",
            Estimate::Fix => "Fix",
            Estimate::Angles => "Angles",
        },
        track = track(calibration),
        send = send(&mote),
        every = mote.report_every_half_turns,
        pan = mote.pan,
        id = mote.id,
        key = mote.key.map(|key| key.0),
        received = calibration.received(),
        lone = match mote.lone {
            None => "None",
            Some(Name::A) => "Some(lighthouse_mote::sweep::Station::A)",
            Some(Name::B) => "Some(lighthouse_mote::sweep::Station::B)",
        },
        shortest_sweep = shortest_sweep(mote.shortest_sweep_us),
        stamp = match mote.sweep_edge {
            SweepEdge::Middle => "Middle",
            SweepEdge::Rise => "Rise",
        },
        ids = calibration.stations.map(|station| station.id),
    ))
}
