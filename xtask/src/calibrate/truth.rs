//! Where motion capture says the mote was.
//!
//! Two kinds of file: a `table`, and what OptiTrack's Motive exports (`motive`); `samples` is what either becomes. Blank
//! coordinates are moments at which the mote was lost: they give no sample, and nothing is put in their place.
//!
//! What can go wrong: a column missing or doubled, a cell that is no number, a row half blank, time that does not go
//! on, no sample at all. Each complaint names file, line, column and value.

mod motive;
mod samples;
mod table;

use std::path::Path;

use anyhow::{Context, Result, anyhow, ensure};

pub use samples::Truth;

/// Reads a table or a Motive export; `body` chooses among several bodies.
pub fn open(path: &Path, body: Option<&str>) -> Result<Truth> {
    let name = path.display().to_string();
    let bytes = std::fs::read(path).with_context(|| format!("{name}: cannot be read"))?;
    let text = String::from_utf8(bytes).map_err(|error| {
        let line = error.as_bytes()[..error.utf8_error().valid_up_to()].iter().filter(|b| **b == b'\n').count() + 1;
        anyhow!("{name}:{line}: is no text; export the take as CSV")
    })?;
    read(&name, &text, body)
}

/// Reads the text of a truth file; `name` is for complaints.
pub fn read(name: &str, text: &str, body: Option<&str>) -> Result<Truth> {
    let text = text.trim_start_matches('\u{feff}');
    let truth = if motive::is_motive(text) {
        motive::read(name, text, body)?
    } else {
        ensure!(body.is_none(), "{name}: is a table of one path, so there is no body to choose");
        table::read(name, text)?
    };
    ensure!(!truth.samples.is_empty(), "{name}: {} without one place: the mote was lost in every row", truth.what);
    Ok(truth)
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;

    fn complaint(text: &str) -> String {
        format!("{:#}", read("walk.csv", text, None).expect_err("a bad file"))
    }

    #[test]
    fn a_table_in_metres_and_one_in_millimetres_say_the_same() {
        let metres = read("walk.csv", "time_s,x_m,y_m,z_m\n0.5,0.1,-0.2,1.5\n0.6,,,\n0.7,0.2,0,0\n", None).unwrap();
        let other = "\u{feff}z_mm, y_mm, x_mm, note, time_s\n1500,-200,100,a,0.5\n,,,b,0.6\n0,0,200,c,0.7\n";
        let millimetres = read("walk.csv", other, None).unwrap();
        for truth in [&metres, &millimetres] {
            assert_eq!((truth.samples.len(), truth.lost), (2, 1));
            assert!((truth.samples[0].position - Vector3::new(0.1, -0.2, 1.5)).norm() < 1e-12);
            assert!((truth.length_s() - 0.2).abs() < 1e-12);
        }
    }

    #[test]
    fn what_is_wrong_with_a_table_is_said_with_line_column_and_value() {
        for (text, says) in [
            ("", "walk.csv: the file is empty"),
            ("time,x_m,y_m,z_m\n", "walk.csv:1: column time_s is missing; the header is `time,x_m,y_m,z_m`"),
            ("time_s,x_m,y_m\n", "walk.csv:1: column z_m is missing"),
            ("time_s,x_m,y_m,z_m\n0,1,2,3\n1,1,two,3\n", "walk.csv:3: column y_m: `two` is no number"),
            ("time_s,x_m,y_m,z_m\n0,1,2,nan\n", "walk.csv:2: column z_m: `nan` is no number"),
            ("time_s,x_m,y_m,z_m\n0,1,,3\n", "walk.csv:2: column y_m: blank, while"),
            ("time_s,x_m,y_m,z_m\n2,1,2,3\n\n2,1,2,3\n", "walk.csv:4: column time_s: `2` is not after `2` on line 2"),
            ("time_s,x_m,y_m,z_m\n0,1,2\n", "walk.csv:2: 3 cells where the header has 4 columns: `0,1,2`"),
            ("time_s,x_m,y_m,z_m\n0,1500,2,3\n", "walk.csv:2: column x_m: `1500` is 1500 m away"),
            ("time_s,x_m,y_m,z_m\n0,,,\n", "walk.csv: a table of places without one place"),
        ] {
            let said = complaint(text);
            assert!(said.starts_with(says), "{text:?}: {said}");
        }
        let said = read("walk.csv", "time_s,x_m,y_m,z_m\n0,1,2,3\n", Some("mote")).unwrap_err().to_string();
        assert!(said.contains("no body to choose"), "{said}");
    }
}
