//! A calibration as the Rust source that a board's binary includes.
//!
//! What can go wrong: a room that the fixed-point solver cannot hold; it is refused with the number that breaks.

use super::quantise::{self, Baked, Room};
use super::schema::{Calibration, Error, RoomBox, Rotor, Station};
use super::volume::shared_view;

/// Milliseconds of a half turn.
const HALF_TURN_MS: f64 = 1000.0 / 120.0;
/// Units of [`lighthouse_mote::angle::Angle`] in a radian: 2^20 in pi.
const ANGLE_UNITS_PER_RAD: f64 = (1u32 << 20) as f64 / std::f64::consts::PI;

/// The declared volume, or the one both stations light.
///
/// # Errors
/// The stations share no view.
pub fn volume(file: &str, calibration: &Calibration) -> Result<RoomBox, Error> {
    calibration.room.or_else(|| shared_view(&calibration.stations)).ok_or_else(|| Error {
        file: file.to_string(),
        line: 1,
        field: "station".to_string(),
        what: "the two stations light no common point; declare [room], or check the rotations".to_string(),
    })
}

/// Quantises the room.
///
/// # Errors
/// The stations share no view, or the solver cannot hold the room.
pub fn bake(file: &str, calibration: &Calibration) -> Result<Baked, Error> {
    let RoomBox { min, max } = volume(file, calibration)?;
    let pose = |station: Station| quantise::Station { rotation: station.rotation, position: station.position };
    quantise::bake(&Room { stations: calibration.stations.map(pose), min, max }).map_err(|refusal| Error {
        file: file.to_string(),
        line: 1,
        field: "room".to_string(),
        what: format!("cannot be represented: {} ({})", refusal.reason, refusal.number),
    })
}

/// The factory terms of one rotor in angle units: phase, tan(tilt), gibbous sine and cosine.
#[must_use]
pub fn rotor(rotor: &Rotor) -> [i32; 4] {
    let units = |rad: f64| (rad * ANGLE_UNITS_PER_RAD).round() as i32;
    let (sin, cos) = rotor.gibphase.sin_cos();
    [units(rotor.phase), units(rotor.tilt.tan()), units(rotor.gibmag * cos), units(rotor.gibmag * sin)]
}

/// The age rule in whole half turns, at least one.
#[must_use]
pub fn max_age_half_turns(calibration: &Calibration) -> u16 {
    (calibration.mote.max_angle_age_ms / HALF_TURN_MS).round().max(1.0) as u16
}

/// The constants that a binary includes.
///
/// # Errors
/// As [`bake`].
pub fn source(file: &str, calibration: &Calibration) -> Result<String, Error> {
    let solver = bake(file, calibration)?.emit();
    let mote = calibration.mote;
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
    Ok(format!(
        "/// The room, as baked from `{file}`.
pub const CONFIG: lighthouse_mote::chain::Config = lighthouse_mote::chain::Config {{
    sweep: lighthouse_mote::sweep::Config::DEFAULT,
    angle: lighthouse_mote::angle::Config {{ rotors: [{}, {}] }},
    fix: lighthouse_mote::fix::Config {{ calib: {solver}, max_age_half_turns: {max_age} }},
    report_every_half_turns: {every},
}};
/// The personal area network.
pub const PAN: u16 = {pan};
/// The mote's short address.
pub const MOTE: u16 = {id};
",
        rotors[0],
        rotors[1],
        every = mote.report_every_half_turns,
        pan = mote.pan,
        id = mote.id,
    ))
}
