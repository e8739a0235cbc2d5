//! A solved room in the project's own format.
//!
//! # Design
//! What is written is read back by the one reader and baked before it takes its place: a file that is there can be
//! flown. The declared volume is where the path went and some margin, the widest of a few that the fast solver can
//! hold; a mote knows no walls, so it may well be asked about places a little farther than where it was carried.
//!
//! What can go wrong: a room that no solver can hold, factory terms that are none. Both are refused before anything is
//! written.

use std::fmt::Write as _;
use std::path::Path;

use anyhow::{Context, Result, anyhow};

use super::solve::{HeldOut, Station};
use crate::calib::firmware::{self, Held};
use crate::calib::schema::{self, Calibration, Estimate, FactorySource, Mote, RoomBox, Rotor};

/// Margins around the path that are tried, as parts of its longest side: the widest first.
const MARGINS: [f64; 6] = [0.5, 0.35, 0.25, 0.15, 0.08, 0.03];
/// The least margin of the widest, metres: as far as an arm turns aside without thinking.
const ASIDE_M: f64 = 0.2;

/// A room that can be flown.
#[derive(Clone, Debug)]
pub struct Room {
    /// The file's text.
    pub text: String,
    /// What it says, as its reader has it.
    pub calibration: Calibration,
    /// What it bakes to.
    pub held: Held,
    /// How much further than the path the volume goes, metres; none where the reader chose the volume itself.
    pub margin_m: Option<f64>,
}

/// What a room file says of a station besides what is measured.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Told {
    /// Its serial number.
    pub id: Option<u32>,
    /// Whose factory terms motes use.
    pub source: Option<FactorySource>,
}

impl Told {
    /// Of the stations of a room.
    #[must_use]
    pub fn of(room: &Calibration) -> [Told; 2] {
        room.stations.map(|station| Told { id: station.id, source: station.source })
    }
}

/// Writes the room of `stations` around the places where the mote was; `file` is for complaints.
///
/// # Errors
/// The room cannot be held, whatever its volume.
pub fn write(
    file: &str,
    stations: &[Station; 2],
    told: &[Told; 2],
    path: &[[f64; 3]],
    mote: &toml::Table,
    provenance: &[(String, toml::Value)],
) -> Result<Room> {
    let (min, max) =
        extent(path).ok_or_else(|| anyhow!("{file}: no sweep was kept, so there is no room around them"))?;
    let longest = (0..3).map(|axis| max[axis] - min[axis]).fold(0.0, f64::max);
    let mut widest: Option<Room> = None;
    let mut refusal = None;
    let boxes = MARGINS.iter().map(|part| {
        let margin = part * longest.max(ASIDE_M / MARGINS[0]);
        let rounded =
            |value: f64, up: bool| if up { (value * 100.0).ceil() / 100.0 } else { (value * 100.0).floor() / 100.0 };
        let volume =
            RoomBox { min: min.map(|x| rounded(x - margin, false)), max: max.map(|x| rounded(x + margin, true)) };
        (Some(volume), Some(margin))
    });
    for (volume, margin_m) in boxes.chain([(None, None)]) {
        let text = text(stations, told, volume.as_ref(), mote, provenance);
        let calibration = schema::read(file, &text).context("the solved room cannot be written down")?;
        match firmware::bake(file, &calibration) {
            Ok(held) => {
                let is_exact = held.is_exact();
                let room = Room { text, calibration, held, margin_m };
                if is_exact {
                    return Ok(room);
                }
                widest.get_or_insert(room);
            }
            Err(error) => {
                refusal.get_or_insert(error);
            }
        }
    }
    widest.ok_or_else(|| match refusal {
        Some(error) => anyhow!("{error}"),
        None => anyhow!("{file}: the room cannot be held"),
    })
}

/// What a mote is told where nobody says otherwise.
pub fn usual_mote() -> toml::Table {
    let usual = Mote::default();
    let estimate = match usual.estimate {
        Estimate::Track => "track",
        Estimate::Fix => "fix",
        Estimate::Angles => "angles",
    };
    let mut mote = toml::Table::new();
    mote.insert("id".to_string(), i64::from(usual.id).into());
    mote.insert("pan".to_string(), i64::from(usual.pan).into());
    mote.insert("estimate".to_string(), estimate.into());
    mote.insert("report_every_half_turns".to_string(), i64::from(usual.report_every_half_turns).into());
    mote.insert("max_angle_age_ms".to_string(), usual.max_angle_age_ms.into());
    mote
}

/// No mote times a laser better than this, mrad: what the 2020 recording's angles differ by from one sweep to the next.
/// On the flight's calibrate window the tracker's error is within a twentieth of its least from 0.3 to 0.8.
const LEAST_NOISE_MRAD: f64 = 0.5;

/// How far light is believed, from how sweeps scatter that were not fitted.
pub fn angle_noise_mrad(held_out: &HeldOut) -> f64 {
    let rotors = held_out.rms.as_flattened();
    let noise = (rotors.iter().map(|rms| rms * rms).sum::<f64>() / rotors.len() as f64).sqrt();
    // Not a number: the most cautious.
    let mrad = if noise.is_nan() { f64::INFINITY } else { 1000.0 * noise };
    (100.0 * mrad.clamp(LEAST_NOISE_MRAD, schema::ANGLE_NOISE_LIMITS_MRAD.1)).round() / 100.0
}

/// What stands under `[mote]` in a room file.
pub fn mote_of(file: &Path) -> Result<toml::Table> {
    let name = file.display();
    let text = std::fs::read_to_string(file).with_context(|| format!("{name}: cannot be read"))?;
    let room: toml::Table = text.parse().with_context(|| name.to_string())?;
    Ok(room.get("mote").and_then(toml::Value::as_table).cloned().unwrap_or_default())
}

/// The box around the places.
pub fn extent(path: &[[f64; 3]]) -> Option<([f64; 3], [f64; 3])> {
    let first = *path.first()?;
    Some(path.iter().fold((first, first), |(min, max), place| {
        (std::array::from_fn(|axis| min[axis].min(place[axis])), std::array::from_fn(|axis| max[axis].max(place[axis])))
    }))
}

/// The file's text.
fn text(
    stations: &[Station; 2],
    told: &[Told; 2],
    volume: Option<&RoomBox>,
    mote: &toml::Table,
    provenance: &[(String, toml::Value)],
) -> String {
    let mut out = String::from(
        "# A room as measured by `cargo xtask calibrate`; calibrate again to replace it. What stands under [mote] is kept,\n\
         # and so are each station's id and whose factory terms are used.\n#\n# c = R (p - position); tan(az) = c.x / c.z, tan(el) = c.y / c.z; metres and radians.\n\n[provenance]\n",
    );
    for (key, value) in provenance {
        let _ = writeln!(out, "{key} = {value}");
    }
    let list = |values: [f64; 3], digits: usize| {
        let [x, y, z] = values.map(|value| decimal(value, digits));
        format!("[{x}, {y}, {z}]")
    };
    if let Some(RoomBox { min, max }) = volume {
        let _ = write!(
            out,
            "\n# Where the mote may be: what the fixed-point formats must hold.\n[room]\nmin = {}\nmax = {}\n",
            list(*min, 2),
            list(*max, 2)
        );
    }
    let _ = write!(out, "\n[mote]\n{mote}");
    for (name, (station, told)) in ["A", "B"].into_iter().zip(stations.iter().zip(told)) {
        let rows: Vec<String> = station.rotation.row_iter().map(|row| list([row[0], row[1], row[2]], 9)).collect();
        let _ = write!(
            out,
            "\n[station.{name}]\n{}rotation = [{}]\nposition = {}\n",
            told.id.map_or(String::new(), |id| format!("id = {id}\n")),
            rows.join(", "),
            list(station.position.into(), 6)
        );
        if let Some(source) = told.source {
            let _ = writeln!(out, "[station.{name}.factory]\nsource = \"{}\"", source.name());
        }
        for (axis, rotor) in ["az", "el"].into_iter().zip(&station.factory) {
            let Rotor { phase, tilt, curve, gibphase, gibmag } = rotor;
            let terms =
                [("phase", phase), ("tilt", tilt), ("curve", curve), ("gibphase", gibphase), ("gibmag", gibmag)];
            let mut terms = terms.into_iter().filter(|(_, value)| **value != 0.0).peekable();
            if terms.peek().is_some() {
                let _ = writeln!(out, "[station.{name}.factory.{axis}]");
            }
            for (key, value) in terms {
                let _ = writeln!(out, "{key} = {}", decimal(*value, 7));
            }
        }
    }
    out
}

/// A number with so many digits after the point, and no sign before a zero.
fn decimal(value: f64, digits: usize) -> String {
    let text = format!("{value:.digits$}");
    if text.trim_start_matches('-').chars().all(|c| c == '0' || c == '.') { text.replace('-', "") } else { text }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reference;

    fn default_room() -> Calibration {
        schema::read("default.toml", include_str!("../../../calib/default.toml")).unwrap()
    }

    const UNTOLD: [Told; 2] = [Told { id: None, source: None }; 2];

    /// A walk through the middle of the default room.
    fn walk() -> Vec<[f64; 3]> {
        (0..200)
            .map(|n| f64::from(n) * 0.1)
            .map(|t| [0.5 + 0.3 * t.sin(), 1.0 + 0.2 * (1.3 * t).cos(), 0.8 + 0.2 * (0.7 * t).sin()])
            .collect()
    }

    #[test]
    fn what_is_written_reads_back_as_it_was_and_takes_the_fast_form() {
        let before = default_room();
        let stations = reference::Room::of(&before).stations;
        let notes = [("what".to_string(), "a \"quoted\" line\nand another".into())];
        let mut mote = usual_mote();
        mote.insert("id".to_string(), 23.into());
        mote.insert("estimate".to_string(), "fix".into());
        let told = [
            Told { id: Some(3_200_290_360), source: Some(FactorySource::Received) },
            Told { id: None, source: Some(FactorySource::File) },
        ];
        let room = write("lab.toml", &stations, &told, &walk(), &mote, &notes).unwrap();
        assert!(room.held.is_exact(), "{}", room.held.baked.choice);
        let after = schema::read("lab.toml", &room.text).unwrap();
        assert_eq!(after.mote, Mote { id: 23, estimate: Estimate::Fix, ..Mote::default() });
        assert_eq!(Told::of(&after), told);
        assert_eq!(
            after.stations.map(|station| schema::Station { id: None, source: None, ..station }),
            before.stations
        );
        assert_eq!(after.provenance.len(), 1);
        let volume = after.room.unwrap();
        for place in walk() {
            assert!((0..3).all(|k| volume.min[k] < place[k] - 0.1 && place[k] + 0.1 < volume.max[k]), "{volume:?}");
        }
    }

    #[test]
    fn a_path_that_passes_near_a_station_gets_a_volume_that_stops_before_it() {
        let stations = reference::Room::of(&default_room()).stations;
        let mut path = walk();
        // 20 cm below station A, which stands at 1.627.
        path.push([0.26, 1.0, 1.42]);
        let room = write("lab.toml", &stations, &UNTOLD, &path, &usual_mote(), &[]).unwrap();
        let volume = room.calibration.room.unwrap();
        assert!(volume.max[2] >= 1.42 && volume.max[2] < 1.627, "{volume:?}");
    }

    #[test]
    fn factory_terms_that_are_none_are_refused_by_name() {
        let mut stations = reference::Room::of(&default_room()).stations;
        stations[1].factory[0].phase = 0.7;
        let said = format!("{:#}", write("lab.toml", &stations, &UNTOLD, &walk(), &usual_mote(), &[]).unwrap_err());
        assert!(said.contains("station.B.factory.az.phase: 0.7"), "{said}");
    }
}
