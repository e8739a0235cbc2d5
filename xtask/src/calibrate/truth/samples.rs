//! Rows of a file of places, taken one after another, and the path that they make.
//!
//! What can go wrong: time that does not go on, a cell that is no number, a row half blank, a place out of reach. Each
//! complaint names file, line, column and value.

use anyhow::{Result, anyhow, bail, ensure};
use nalgebra::Vector3;

use crate::calibrate::solve::{Attitude, TruthSample};

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
