//! The places of a calibration without motion capture.
//!
//! ```toml
//! seconds = 3                      # to look at each place; 3 if left out
//!
//! [[point]]
//! name = "corner of the desk"
//! position = [0.0, 0.0, 0.0]       # metres, in the frame that you choose
//!
//! [[sheet]]                        # the four corners of a sheet of paper, at each height
//! name = "A4"
//! size = [0.297, 0.210]            # along x and y
//! corner = [0.0, 0.0]              # where its corner of smallest x and y lies; [0, 0] if left out
//! heights = [0.0, 0.1]
//! ```
//!
//! What can go wrong: too few places, places in one plane, two of one name or in one spot, a size in millimetres. Each
//! complaint names file, line, field and value.

use std::path::Path;

use anyhow::{Context, Result, anyhow, bail, ensure};
use nalgebra::{Matrix3, Vector3};
use serde::Deserialize;
use toml::Spanned;

/// The fewest places: each gives four angles, and two poses with a phase per rotor are sixteen unknowns; the fifth tells
/// how well they fit.
pub const FEWEST: usize = 5;
/// No room is larger, metres.
const FARTHEST_M: f64 = 100.0;
/// Places nearer than this are one place, metres: as well as a hand puts a mote.
const APART_M: f64 = 0.005;
/// Places must leave the plane that fits them best by this much on average, metres: in one plane a station's position
/// and its phases cannot be told apart.
const DEPTH_M: f64 = 0.01;

/// A list for somebody who has none.
const EXAMPLE: &str = "\
[[sheet]]                  # the corners of a sheet of A4: on the table, and on a box of 10 cm
name = \"A4\"
size = [0.297, 0.210]      # metres
heights = [0.0, 0.1]
";

/// A known place.
#[derive(Clone, Debug, PartialEq)]
pub struct Point {
    /// What a person calls it.
    pub name: String,
    /// Metres.
    pub position: Vector3<f64>,
}

/// What is to be visited.
#[derive(Clone, Debug)]
pub struct Points {
    /// In the order of the file.
    pub points: Vec<Point>,
    /// How long to look at each, seconds.
    pub seconds: f64,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Written {
    seconds: Option<Spanned<f64>>,
    #[serde(default)]
    point: Vec<WrittenPoint>,
    #[serde(default)]
    sheet: Vec<Sheet>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct WrittenPoint {
    name: Spanned<String>,
    position: Spanned<[f64; 3]>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Sheet {
    name: Spanned<String>,
    size: Spanned<[f64; 2]>,
    #[serde(default)]
    corner: [f64; 2],
    heights: Spanned<Vec<f64>>,
}

/// Reads a list of places.
pub fn open(path: &Path) -> Result<Points> {
    let name = path.display().to_string();
    ensure!(path.exists(), "{name}: there is no such list of places; one to begin with:\n\n{EXAMPLE}");
    let text = std::fs::read_to_string(path).with_context(|| format!("{name}: cannot be read"))?;
    read(&name, &text)
}

/// Reads the text of a list; `file` is for complaints.
pub fn read(file: &str, text: &str) -> Result<Points> {
    let line = |offset: usize| text.bytes().take(offset).filter(|b| *b == b'\n').count() + 1;
    let written: Written = toml::from_str(text).map_err(|error| {
        let line = error.span().map_or(1, |span| line(span.start));
        let shown = text.lines().nth(line - 1).unwrap_or("").trim();
        anyhow!("{file}:{line}: {} in `{shown}`", error.message().trim_end())
    })?;
    let mut found: Vec<(usize, Point)> = Vec::new();
    for point in written.point {
        let at = line(point.position.span().start);
        found.push((at, Point { name: point.name.into_inner(), position: point.position.into_inner().into() }));
    }
    for sheet in written.sheet {
        let at = line(sheet.size.span().start);
        let [long, wide] = sheet.size.into_inner();
        ensure!(
            long > 0.0 && wide > 0.0 && long < FARTHEST_M && wide < FARTHEST_M,
            "{file}:{at}: sheet.size: `[{long}, {wide}]` is no size in metres"
        );
        let heights_at = line(sheet.heights.span().start);
        ensure!(!sheet.heights.get_ref().is_empty(), "{file}:{heights_at}: sheet.heights: `[]` has no height");
        for height in sheet.heights.get_ref() {
            for (number, (x, y)) in [(0.0, 0.0), (long, 0.0), (long, wide), (0.0, wide)].into_iter().enumerate() {
                let name = format!("{} corner {} at height {height}", sheet.name.get_ref(), number + 1);
                let position = Vector3::new(sheet.corner[0] + x, sheet.corner[1] + y, *height);
                found.push((heights_at, Point { name, position }));
            }
        }
    }
    for (index, (at, point)) in found.iter().enumerate() {
        let name = &point.name;
        ensure!(
            !name.trim().is_empty() && !name.contains(char::is_control),
            "{file}:{at}: name: `{}` is no name",
            name.escape_debug()
        );
        if let Some(far) = point.position.iter().find(|x| !x.is_finite() || x.abs() > FARTHEST_M) {
            bail!("{file}:{at}: `{name}`: position: `{far}` m is beyond {FARTHEST_M} m; positions are metres");
        }
        for (before, other) in &found[..index] {
            ensure!(other.name != *name, "{file}:{at}: name: `{name}` is also the place of line {before}");
            let apart = (other.position - point.position).norm();
            ensure!(
                apart >= APART_M,
                "{file}:{at}: `{name}`: position: {:.1} mm from `{}` of line {before}; that is one place",
                1000.0 * apart,
                other.name
            );
        }
    }
    let points: Vec<Point> = found.into_iter().map(|(_, point)| point).collect();
    ensure!(
        points.len() >= FEWEST,
        "{file}: {} places are too few: {FEWEST} are the least, eight at two heights are good",
        points.len()
    );
    let depth = depth(&points);
    ensure!(
        depth >= DEPTH_M,
        "{file}: all {} places lie within {:.1} mm of one plane; put some higher, by a hand's breadth or more",
        points.len(),
        1000.0 * depth
    );
    let seconds = match written.seconds {
        None => 3.0,
        Some(seconds) => {
            let value = *seconds.get_ref();
            ensure!(
                (0.5..=600.0).contains(&value),
                "{file}:{}: seconds: `{value}` is not in 0.5 ..= 600",
                line(seconds.span().start)
            );
            value
        }
    };
    Ok(Points { points, seconds })
}

/// RMS distance of the places from the plane that fits them best, metres.
fn depth(points: &[Point]) -> f64 {
    let count = points.len() as f64;
    let mean = points.iter().map(|point| point.position).sum::<Vector3<f64>>() / count;
    let spread: Matrix3<f64> = points.iter().map(|p| (p.position - mean) * (p.position - mean).transpose()).sum();
    (spread.symmetric_eigenvalues().min().max(0.0) / count).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_has_no_list_is_shown_one_that_serves() {
        let error = open(Path::new("no/points.toml")).unwrap_err().to_string();
        assert!(error.starts_with("no/points.toml: there is no such list") && error.ends_with(EXAMPLE), "{error}");
        assert_eq!(read("example", EXAMPLE).unwrap().points.len(), 8);
    }

    const DESK: &str = "\
seconds = 2
[[point]]
name = \"lamp\"
position = [0.4, 0.1, 0.3]

[[sheet]]
name = \"A4\"
size = [0.297, 0.210]
heights = [0.0, 0.1]
";

    fn complaint(text: &str) -> String {
        format!("{:#}", read("points.toml", text).expect_err("a bad file"))
    }

    #[test]
    fn a_sheet_at_two_heights_and_a_lamp_are_nine_places() {
        let read = read("points.toml", DESK).unwrap();
        assert_eq!((read.points.len(), read.seconds), (9, 2.0));
        assert_eq!(read.points[0].name, "lamp");
        let third = &read.points[3];
        assert_eq!((third.name.as_str(), third.position), ("A4 corner 3 at height 0", Vector3::new(0.297, 0.21, 0.0)));
    }

    #[test]
    fn what_is_wrong_with_a_list_is_said_with_line_field_and_value() {
        for (from, to, says) in [
            ("[0.4, 0.1, 0.3]", "[0.4, 0.1]", "points.toml:4: "),
            ("[0.4, 0.1, 0.3]", "[0.4, \"left\", 0.3]", "points.toml:4: invalid type: string \"left\""),
            ("[0.4, 0.1, 0.3]", "[400, 100, 300]", "points.toml:4: `lamp`: position: `400` m is beyond 100 m"),
            ("[0.4, 0.1, 0.3]", "[0.001, 0.0, 0.0]", "points.toml:9: `A4 corner 1 at height 0`: position: 1.0 mm from"),
            ("name = \"lamp\"", "nam = \"lamp\"", "points.toml:3: unknown field `nam`"),
            ("\"lamp\"", "\"\"", "points.toml:4: name: `` is no name"),
            ("[0.297, 0.210]", "[297, 210]", "points.toml:8: sheet.size: `[297, 210]` is no size in metres"),
            ("[0.0, 0.1]", "[]", "points.toml:9: sheet.heights: `[]`"),
            ("[0.0, 0.1]", "[0.1, 0.1]", "points.toml:9: name: `A4 corner 1 at height 0.1` is also"),
            ("seconds = 2", "seconds = 0", "points.toml:1: seconds: `0` is not in"),
            ("seconds = 2", "seconds = ", "points.toml:1: "),
        ] {
            let said = complaint(&DESK.replacen(from, to, 1));
            assert!(said.starts_with(says), "{to}: {said}");
        }
    }

    #[test]
    fn four_places_are_too_few_and_a_plane_is_too_flat() {
        let flat = DESK.replacen("[0.4, 0.1, 0.3]", "[0.4, 0.1, 0.0]", 1).replacen("[0.0, 0.1]", "[0.0]", 1);
        let said = complaint(&flat);
        assert!(said.starts_with("points.toml: all 5 places lie within 0.0 mm of one plane"), "{said}");
        let few =
            flat.split_once("[[point]]").unwrap().0.to_string() + "[[sheet]]" + flat.split_once("[[sheet]]").unwrap().1;
        assert!(
            complaint(&few).starts_with("points.toml: 4 places are too few: 5 are the least"),
            "{}",
            complaint(&few)
        );
        assert!(complaint("").starts_with("points.toml: 0 places"));
    }
}
