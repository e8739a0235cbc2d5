//! What OptiTrack's Motive exports.
//!
//! The first line holds pairs of a key and a value; then come rows that say of each column what it belongs to (`Rigid
//! Body`, `Marker`), its name, its id and what it is (`Rotation`, `Position`); a row that begins with `Frame`; and a row
//! per frame, blank where a body was lost. Versions differ in how many rows stand between, so each is found by what it
//! holds. A body's rotation, where it is exported as a quaternion, tells how
//! the photodiode sits on it.
//!
//! What can go wrong: several bodies and none chosen, a body that is not there, positions that are not in the room's
//! frame, a unit that nobody knows. Each complaint names file, line and value, and the bodies there are.

use anyhow::{Result, anyhow, bail, ensure};
use nalgebra::{Quaternion, UnitQuaternion};

use super::samples::{Samples, Truth, rows};
use crate::calibrate::solve::Attitude;

/// How such a file begins.
const FIRST: &str = "Format Version";
/// What a column may belong to.
const BODY: &str = "Rigid Body";
const KINDS: [&str; 3] = [BODY, "Marker", "Rigid Body Marker"];
/// Length units and how many make a metre.
const UNITS: [(&str, f64); 3] = [("Meters", 1.0), ("Centimeters", 100.0), ("Millimeters", 1000.0)];

/// How far the length of a written quaternion may be from 1: six decimals and a little.
const UNIT: f64 = 1e-3;

/// Whether Motive wrote it.
pub(super) fn is_motive(text: &str) -> bool {
    text.starts_with(FIRST) || text.starts_with(&format!("\"{FIRST}"))
}

/// Something that was tracked, and the columns of its place.
#[derive(Clone, Debug)]
struct Tracked {
    kind: String,
    name: String,
    columns: [usize; 3],
    /// Of the quaternion's X, Y, Z, W, where they are exported.
    rotation: Option<[usize; 4]>,
}

/// Reads the export.
pub(super) fn read(name: &str, text: &str, body: Option<&str>) -> Result<Truth> {
    let mut rows = rows(name, text);
    let mut head = Vec::new();
    // The rows above the frames: six in all versions known, so a file that goes on is not one.
    let (frame_line, axes) = loop {
        let row = rows.next().filter(|_| head.len() < 20);
        let row = row.ok_or_else(|| anyhow!("{name}: no line begins with `Frame`: this is no table of frames"))?;
        let (line, row) = row?;
        if row.get(0).is_some_and(|cell| cell.starts_with("Frame")) {
            break (line, row);
        }
        head.push((line, row));
    };
    let per_metre = per_metre(name, &head)?;
    let time = axes
        .iter()
        .position(|cell| cell.starts_with("Time"))
        .ok_or_else(|| anyhow!("{name}:{frame_line}: column `Time (Seconds)` is missing"))?;
    let tracked = tracked(name, &head, &axes)?;
    let chosen = choose(name, &tracked, body)?;
    let columns: [String; 3] = std::array::from_fn(|axis| {
        format!("{} (`{}`, Position {})", chosen.columns[axis] + 1, chosen.name, ["X", "Y", "Z"][axis])
    });
    let mut samples = Samples::new(name, per_metre);
    let mut attitudes = Vec::new();
    for row in rows {
        let (line, row) = row?;
        let cell = |column: usize| row.get(column).unwrap_or("");
        let place = std::array::from_fn(|axis| (columns[axis].as_str(), cell(chosen.columns[axis])));
        if !samples.push(line, ("Time (Seconds)", cell(time)), place)? {
            continue;
        }
        let turned = chosen.rotation.map(|columns| columns.map(|column| cell(column).parse::<f64>().ok()));
        if let (Some([Some(x), Some(y), Some(z), Some(w)]), Some(sample)) = (turned, samples.samples.last()) {
            let turn = Quaternion::new(w, x, y, z);
            ensure!(
                (turn.norm() - 1.0).abs() < UNIT,
                "{name}:{line}: the rotation of `{}`: X, Y, Z, W `{x}, {y}, {z}, {w}` is no quaternion of length 1",
                chosen.name
            );
            attitudes.push(Attitude { at_s: sample.at_s, rotation: UnitQuaternion::from_quaternion(turn) });
        }
    }
    let what = format!("the {} `{}` of a Motive export", chosen.kind.to_lowercase(), chosen.name);
    Ok(Truth { samples: samples.samples, attitudes, lost: samples.lost, what })
}

type Head = [(usize, csv::StringRecord)];

/// Reads the pairs of the first line.
fn per_metre(name: &str, head: &Head) -> Result<f64> {
    let value = |key: &str| {
        let cells: Vec<&str> = head.first().map(|(_, row)| row.iter().collect()).unwrap_or_default();
        cells.chunks(2).find(|pair| pair[0] == key).and_then(|pair| pair.get(1).map(|value| (*value).to_string()))
    };
    if let Some(space) = value("Coordinate Space") {
        ensure!(
            space == "Global",
            "{name}:1: Coordinate Space: `{space}`; a place in the room needs `Global`: export again"
        );
    }
    let unit = value("Length Units").ok_or_else(|| anyhow!("{name}:1: Length Units: missing"))?;
    UNITS.iter().find(|(known, _)| *known == unit).map(|(_, per_metre)| *per_metre).ok_or_else(|| {
        let known: Vec<&str> = UNITS.iter().map(|(known, _)| *known).collect();
        anyhow!("{name}:1: Length Units: `{unit}` is none of {}", known.join(", "))
    })
}

/// Everything that has a position.
fn tracked(name: &str, head: &Head, axes: &csv::StringRecord) -> Result<Vec<Tracked>> {
    let kinds = head.iter().position(|(_, row)| row.iter().any(|cell| KINDS.contains(&cell)));
    let kinds = kinds.ok_or_else(|| anyhow!("{name}: no column belongs to a rigid body or a marker"))?;
    let (Some((_, names)), Some((_, whats))) = (head.get(kinds + 1), head.last()) else {
        bail!("{name}: the rows with the columns' names are missing");
    };
    let mut found: Vec<Tracked> = Vec::new();
    let kinds_row = &head[kinds].1;
    for (column, kind) in kinds_row.iter().enumerate().filter(|(_, kind)| KINDS.contains(kind)) {
        let axis = ["X", "Y", "Z"].iter().position(|axis| axes.get(column) == Some(axis));
        let (Some(axis), Some("Position"), Some(named)) = (axis, whats.get(column), names.get(column)) else {
            continue;
        };
        match found.iter_mut().find(|tracked| tracked.kind == kind && tracked.name == named) {
            Some(tracked) => tracked.columns[axis] = column,
            None => found.push(Tracked { kind: kind.into(), name: named.into(), columns: [column; 3], rotation: None }),
        }
    }
    for tracked in found.iter_mut().filter(|tracked| tracked.kind == BODY) {
        let is = |column: &usize, axis: &str| {
            kinds_row.get(*column) == Some(BODY)
                && names.get(*column) == Some(tracked.name.as_str())
                && whats.get(*column) == Some("Rotation")
                && axes.get(*column) == Some(axis)
        };
        let columns: Vec<usize> =
            ["X", "Y", "Z", "W"].iter().filter_map(|a| (0..axes.len()).find(|c| is(c, a))).collect();
        tracked.rotation = columns.try_into().ok();
    }
    found.retain(|tracked| tracked.columns[0] != tracked.columns[1] && tracked.columns[1] != tracked.columns[2]);
    ensure!(!found.is_empty(), "{name}: no rigid body and no marker has the columns Position X, Y, Z");
    Ok(found)
}

/// The one that was asked for, or the only one there is.
fn choose<'a>(name: &str, tracked: &'a [Tracked], body: Option<&str>) -> Result<&'a Tracked> {
    let list = |of: &[&Tracked]| of.iter().map(|t| format!("`{}`", t.name)).collect::<Vec<_>>().join(", ");
    let all: Vec<&Tracked> = tracked.iter().collect();
    if let Some(body) = body {
        let named: Vec<&Tracked> = all.iter().copied().filter(|tracked| tracked.name == body).collect();
        return match named[..] {
            // A marker may have its body's name; the body is meant.
            [only, ..] => Ok(only),
            [] => bail!("{name}: there is no body `{body}`; there are {}", list(&all)),
        };
    }
    let bodies: Vec<&Tracked> = all.iter().copied().filter(|tracked| tracked.kind == BODY).collect();
    match (&bodies[..], &all[..]) {
        ([only], _) | ([], [only]) => Ok(only),
        ([], several) | (several, _) => {
            bail!("{name}: which of these is the mote? Choose with --body: {}", list(several))
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;

    /// Two bodies in millimetres: a wand, and the mote, which was lost in the second and the third frame.
    const TWO: &str = "\
Format Version,1.22,Take Name,Take 5,Capture Frame Rate,120.000000,Rotation Type,Quaternion,Length Units,Millimeters,Coordinate Space,Global

,,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body Marker,Rigid Body Marker,Rigid Body Marker
,,wand,wand,wand,wand,wand,wand,wand,wand,mote,mote,mote,mote:1,mote:1,mote:1
,,A1,A1,A1,A1,A1,A1,A1,A1,B2,B2,B2,C3,C3,C3
,,Rotation,Rotation,Rotation,Rotation,Position,Position,Position,Error Per Marker,Position,Position,Position,Position,Position,Position
Frame,Time (Seconds),X,Y,Z,W,X,Y,Z,,X,Y,Z,X,Y,Z
0,0.000000,0,0,0,1,900,1,2,0.1,250,1000,-35.5,250,1001,-35.5
1,0.008333,0,0,0,1,900,1,2,0.1,,,,,,
2,0.016667,0,0,0,1,900,1,2,0.1
3,0.025000,,,,,,,,,251,1000,-35.5,250,1001,-35.5
";

    fn complaint(text: &str, body: Option<&str>) -> String {
        format!("{:#}", read("take.csv", text, body).expect_err("a bad file"))
    }

    #[test]
    fn the_chosen_one_of_two_bodies_is_read_in_metres_and_blanks_are_left_out() {
        let truth = read("take.csv", TWO, Some("mote")).unwrap();
        assert_eq!((truth.samples.len(), truth.lost), (2, 2));
        assert!((truth.samples[0].position - Vector3::new(0.250, 1.000, -0.0355)).norm() < 1e-12);
        assert_eq!(truth.samples[1].at_s, 0.025);
        let wand = read("take.csv", TWO, Some("wand")).unwrap();
        assert_eq!((wand.samples.len(), wand.lost, wand.attitudes.len()), (3, 1, 3));
        assert!(wand.attitudes[2].rotation.angle() < 1e-12 && truth.attitudes.is_empty());
        assert_eq!(wand.samples[0].position, Vector3::new(0.9, 0.001, 0.002));
        let marker = read("take.csv", TWO, Some("mote:1")).unwrap();
        assert_eq!(marker.samples[0].position.y, 1.001);
    }

    #[test]
    fn two_bodies_and_no_choice_is_a_question_with_their_names() {
        let said = complaint(TWO, None);
        assert_eq!(said, "take.csv: which of these is the mote? Choose with --body: `wand`, `mote`");
        let said = complaint(TWO, Some("moth"));
        assert_eq!(said, "take.csv: there is no body `moth`; there are `wand`, `mote`, `mote:1`");
    }

    #[test]
    fn what_is_wrong_with_an_export_is_said_with_line_column_and_value() {
        for (from, to, says) in [
            ("Millimeters", "Inches", "take.csv:1: Length Units: `Inches` is none of Meters, Centimeters, Millimeters"),
            ("Length Units", "Length", "take.csv:1: Length Units: missing"),
            ("Global", "Local", "take.csv:1: Coordinate Space: `Local`"),
            ("Frame,Time", "Fraem,Time", "take.csv: no line begins with `Frame`"),
            ("0.008333", "-1", "take.csv:9: column Time (Seconds): `-1` is not after `0` on line 8"),
            ("0,0,0,1,900", "0,0,2,1,900", "take.csv:8: the rotation of `wand`: X, Y, Z, W `0, 0, 2, 1` is no"),
            ("251,1000", "251,y", "take.csv:11: column 12 (`mote`, Position Y): `y` is no number"),
            ("251,1000", "251,", "take.csv:11: column 12 (`mote`, Position Y): blank"),
        ] {
            let body = if from.ends_with("900") { "wand" } else { "mote" };
            let said = complaint(&TWO.replacen(from, to, 1), Some(body));
            assert!(said.starts_with(says), "{to}: {said}");
        }
        assert!(complaint(&TWO.replace("Rigid Body", "Bone"), None).contains("no column belongs to"));
    }

    #[test]
    fn the_only_body_needs_no_choice() {
        let one = TWO.replacen(&"Rigid Body,".repeat(8), &",".repeat(8), 1);
        assert_eq!(read("take.csv", &one, None).unwrap().samples.len(), 2);
    }
}
