//! A table of pulses, read strictly and row by row: a long recording need not fit in memory.
//!
//! # What can go wrong
//! A file or column that is missing, a cell that is no whole number, time that runs backwards, a pulse that lasts past
//! the next one's rise (one line cannot rise while it is high; [`Table::open`] may be told to join them), a table without
//! rows. Each error names the file, the line, the column and the value as written.

use std::fs::File;
use std::path::Path;

use anyhow::{Context, Result, anyhow, bail, ensure};

/// The columns, in any order; others are ignored.
const COLUMNS: [&str; 2] = ["rise_ticks", "width_ticks"];

/// One pulse as recorded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pulse {
    /// When the light came on, ticks since whenever.
    pub rise: u64,
    /// For how long it stayed.
    pub width: u64,
    /// Its line in the file, from 1.
    pub line: u64,
}

impl Pulse {
    fn fall(&self) -> u64 {
        self.rise.saturating_add(self.width)
    }
}

/// An open table.
pub struct Table {
    path: String,
    reader: csv::Reader<File>,
    record: csv::StringRecord,
    bytes: u64,
    places: [usize; 2],
    columns: usize,
    joins: bool,
    joined: u64,
    /// Read, and not yet given: the next row may overlap it.
    held: Option<Pulse>,
    is_empty: bool,
}

impl Table {
    /// Opens it and reads the header. `joins`: pulses that overlap become one.
    ///
    /// # Errors
    /// No such file, or a column is missing.
    pub fn open(path: &Path, joins: bool) -> Result<Self> {
        let name = path.display().to_string();
        ensure!(!path.is_dir(), "{name}: is a folder, not a table of pulses");
        let file = File::open(path).with_context(|| format!("{name}: cannot be read"))?;
        let bytes = file.metadata().with_context(|| format!("{name}: cannot be read"))?.len();
        let mut reader = csv::ReaderBuilder::new().flexible(true).trim(csv::Trim::All).from_reader(file);
        let header = reader
            .headers()
            .map_err(|error| anyhow!("{name}:1: {error}; wanted is a table in CSV with {}", COLUMNS.join(" and ")))?;
        ensure!(!header.is_empty(), "{name}: the file is empty");
        let mut places = [0; 2];
        for (place, column) in places.iter_mut().zip(COLUMNS) {
            *place = header.iter().position(|name| name.trim_start_matches('\u{feff}') == column).ok_or_else(|| {
                let header = header.iter().collect::<Vec<_>>().join(",");
                anyhow!("{name}:1: column {column} is missing; the header is `{header}`")
            })?;
        }
        let columns = header.len();
        let record = csv::StringRecord::new();
        Ok(Self { path: name, reader, record, bytes, places, columns, joins, joined: 0, held: None, is_empty: true })
    }

    /// How much of the file has been read, 0 to 1.
    #[must_use]
    pub fn progress(&self) -> f64 {
        if self.bytes == 0 { 1.0 } else { self.reader.position().byte() as f64 / self.bytes as f64 }
    }

    /// Pulses that were joined to the one before.
    #[must_use]
    pub fn joined(&self) -> u64 {
        self.joined
    }

    /// The next pulse; `None` at the end.
    ///
    /// # Errors
    /// The first value that cannot be right.
    pub fn pulse(&mut self) -> Result<Option<Pulse>> {
        loop {
            let Some(next) = self.row()? else {
                ensure!(!self.is_empty, "{}: there is a header but not one row", self.path);
                return Ok(self.held.take());
            };
            self.is_empty = false;
            let Some(held) = self.held else {
                self.held = Some(next);
                continue;
            };
            if next.rise < held.rise {
                bail!(
                    "{}:{}: column rise_ticks: `{}` is before `{}` on line {}: time runs backwards",
                    self.path,
                    next.line,
                    next.rise,
                    held.rise,
                    held.line
                );
            }
            if next.rise >= held.fall() {
                self.held = Some(next);
                return Ok(Some(held));
            }
            if !self.joins {
                bail!(
                    "{}:{}: column width_ticks: `{}` lasts until {}, past the rise at {} on line {}; if two photodiodes \
                     share the line, --join makes such pulses one",
                    self.path,
                    held.line,
                    held.width,
                    held.fall(),
                    next.rise,
                    next.line
                );
            }
            self.joined += 1;
            let fall = held.fall().max(next.fall());
            self.held = Some(Pulse { width: fall - held.rise, ..held });
        }
    }

    fn row(&mut self) -> Result<Option<Pulse>> {
        let line_before = self.reader.position().line();
        match self.reader.read_record(&mut self.record) {
            Ok(true) => {}
            Ok(false) => return Ok(None),
            Err(error) => bail!("{}:{line_before}: {error}", self.path),
        }
        let line = self.record.position().map_or(line_before, csv::Position::line);
        ensure!(
            self.record.len() == self.columns,
            "{}:{line}: {} cells where the header has {} columns: `{}`",
            self.path,
            self.record.len(),
            self.columns,
            self.record.iter().collect::<Vec<_>>().join(",")
        );
        let number = |column: usize| {
            let cell = self.record.get(self.places[column]).unwrap_or("");
            cell.parse::<u64>().map_err(|_| {
                let what = if !cell.is_empty() && cell.bytes().all(|byte| byte.is_ascii_digit()) {
                    "is more than 64 bits hold"
                } else {
                    "is not a whole number of ticks"
                };
                anyhow!("{}:{line}: column {}: `{cell}` {what}", self.path, COLUMNS[column])
            })
        };
        Ok(Some(Pulse { rise: number(0)?, width: number(1)?, line }))
    }
}
