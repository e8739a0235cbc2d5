//! Where motion capture says the mote was.
//!
//! Two kinds of file: a table with the columns `time_s, x_m, y_m, z_m` (or `x_mm, y_mm, z_mm`), and what OptiTrack's
//! Motive exports, which `motive` reads. Blank coordinates are moments at which the mote was lost: they
//! give no sample, and nothing is put in their place.
//!
//! What can go wrong: a column missing or doubled, a cell that is no number, a row half blank, time that does not go
//! on, no sample at all. Each complaint names file, line, column and value.

use std::path::Path;

use anyhow::{Context, Result, anyhow, bail, ensure};
use nalgebra::Vector3;

use super::motive;
use super::solve::{Attitude, TruthSample};

/// Nobody carries a mote farther, metres; what lies beyond was written in other units.
const FARTHEST_M: f64 = 100.0;

/// A path as motion capture saw it.
#[derive(Clone, Debug)]
pub struct Truth {
    /// Where the mote was, in the order of time.
    pub samples: Vec<TruthSample>,
    /// How its body was turned, in the order of time; empty where the file does not say.
    pub attitudes: Vec<Attitude>,
    /// Rows in which it was lost.
    pub lost: usize,
    /// What was read, for people.
    pub what: String,
}

impl Truth {
    /// From the first sample to the last, seconds.
    pub fn length_s(&self) -> f64 {
        match (self.samples.first(), self.samples.last()) {
            (Some(first), Some(last)) => last.at_s - first.at_s,
            _ => 0.0,
        }
    }
}

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
        table(name, text)?
    };
    ensure!(!truth.samples.is_empty(), "{name}: {} without one place: the mote was lost in every row", truth.what);
    Ok(truth)
}

/// The rows of a table with their lines, counted from 1; empty lines are none. No cell holds a line break.
pub(super) fn rows<'a>(name: &'a str, text: &'a str) -> impl Iterator<Item = Result<(usize, csv::StringRecord)>> + 'a {
    let lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    lines.map(move |(index, line)| {
        let line_number = index + 1;
        if !line.contains('"') {
            return Ok((line_number, line.split(',').map(str::trim).collect()));
        }
        let mut reader = csv::ReaderBuilder::new().has_headers(false).trim(csv::Trim::All).from_reader(line.as_bytes());
        let mut row = csv::StringRecord::new();
        reader.read_record(&mut row).map_err(|error| anyhow!("{name}:{line_number}: {error}"))?;
        Ok((line_number, row))
    })
}

/// Collects samples and sees that each follows the one before.
pub(super) struct Samples<'a> {
    pub(super) name: &'a str,
    pub(super) per_metre: f64,
    pub(super) samples: Vec<TruthSample>,
    pub(super) lost: usize,
    last: Option<(f64, usize)>,
}

/// A cell with the name of its column.
pub(super) type Cell<'a> = (&'a str, &'a str);

impl<'a> Samples<'a> {
    pub(super) fn new(name: &'a str, per_metre: f64) -> Self {
        Self { name, per_metre, samples: Vec::new(), lost: 0, last: None }
    }

    /// Takes a row; says whether the mote was there.
    pub(super) fn push(&mut self, line: usize, time: Cell<'_>, place: [Cell<'_>; 3]) -> Result<bool> {
        let name = self.name;
        let number = |(column, cell): Cell<'_>| -> Result<f64> {
            match cell.parse::<f64>() {
                Ok(value) if value.is_finite() => Ok(value),
                _ => bail!("{name}:{line}: column {column}: `{cell}` is no number"),
            }
        };
        let at_s = number(time)?;
        if let Some((last, before)) = self.last {
            ensure!(
                at_s > last,
                "{name}:{line}: column {}: `{}` is not after `{last}` on line {before}: time does not go on",
                time.0,
                time.1
            );
        }
        self.last = Some((at_s, line));
        let blank = place.iter().filter(|cell| cell.1.is_empty()).count();
        if blank == 3 {
            self.lost += 1;
            return Ok(false);
        }
        if let Some((column, _)) = place.iter().find(|cell| cell.1.is_empty()) {
            bail!("{name}:{line}: column {column}: blank, while the row's other coordinates are not");
        }
        let mut position = Vector3::zeros();
        for (axis, cell) in place.into_iter().enumerate() {
            position[axis] = number(cell)? / self.per_metre;
            ensure!(
                position[axis].abs() <= FARTHEST_M,
                "{name}:{line}: column {}: `{}` is {:.0} m away; is the unit right?",
                cell.0,
                cell.1,
                position[axis]
            );
        }
        self.samples.push(TruthSample { at_s, position });
        Ok(true)
    }
}

/// Reads `time_s, x_m, y_m, z_m`, in any order and among other columns.
fn table(name: &str, text: &str) -> Result<Truth> {
    let mut rows = rows(name, text);
    let Some(header) = rows.next() else { bail!("{name}: the file is empty") };
    let (line, header) = header?;
    let places = |column: &str| header.iter().position(|cell| cell == column);
    let shown = || header.iter().collect::<Vec<_>>().join(",");
    let needed = |column: &str| {
        places(column).ok_or_else(|| {
            anyhow!(
                "{name}:{line}: column {column} is missing; the header is `{}`. Known: a table with time_s and x_m, \
                y_m, z_m (or x_mm, y_mm, z_mm), or what Motive exports",
                shown()
            )
        })
    };
    let time = needed("time_s")?;
    let units: [&str; 3] = if places("x_mm").is_some() { ["x_mm", "y_mm", "z_mm"] } else { ["x_m", "y_m", "z_m"] };
    let mut columns = [0; 3];
    for (column, unit) in columns.iter_mut().zip(units) {
        *column = needed(unit)?;
    }
    let mut samples = Samples::new(name, if units[0] == "x_mm" { 1000.0 } else { 1.0 });
    for row in rows {
        let (line, row) = row?;
        ensure!(
            row.len() == header.len(),
            "{name}:{line}: {} cells where the header has {} columns: `{}`",
            row.len(),
            header.len(),
            row.iter().collect::<Vec<_>>().join(",")
        );
        let cell = |column: usize| row.get(column).unwrap_or("");
        let place = std::array::from_fn(|axis| (units[axis], cell(columns[axis])));
        samples.push(line, ("time_s", cell(time)), place)?;
    }
    Ok(Truth {
        samples: samples.samples,
        attitudes: Vec::new(),
        lost: samples.lost,
        what: "a table of places".to_string(),
    })
}

#[cfg(test)]
mod tests {
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
