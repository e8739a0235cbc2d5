//! A recording of real sweeps, read strictly.
//!
//! A recording is a folder: `recording.toml` says what was recorded, `sweeps.csv` holds one row
//! per sweep that a mote once saw. Whatever is built on it (light to replay, scores to compare) is
//! only as good as its rows, so nothing is guessed and nothing is skipped: the first value that
//! cannot be right stops the reading.
//!
//! # What can go wrong
//! A file or column that is missing, a cell that is not a number, a station or axis nobody knows,
//! a photodiode beyond those declared, a clock that runs backwards, a table without rows. Each
//! error names the file, the line, the column and the value as written.

use std::fmt;
use std::fs;
use std::ops::Range;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow, bail, ensure};
use serde::Deserialize;
use toml::Spanned;

/// The only kind of recording there is so far.
const KIND: &str = "sweeps";
/// File that says what was recorded.
const ABOUT: &str = "recording.toml";
/// File with a row per sweep.
const SWEEPS: &str = "sweeps.csv";
/// Both, which together are what was recorded and how it is divided.
pub const FILES: [&str; 2] = [ABOUT, SWEEPS];
/// The columns that `sweeps.csv` must have, in any order; others are ignored.
const COLUMNS: [&str; 9] = [
    "timestamp_ticks",
    "sensor",
    "station",
    "axis",
    "sync_to_sweep_ticks",
    "truth_x_m",
    "truth_y_m",
    "truth_z_m",
    "truth_ok",
];

/// One of the two stations; A is the one whose sync comes first in every half turn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Station {
    /// The first of the two sync pulses.
    A,
    /// The second, a twentieth of a half turn later.
    B,
}

/// Which of a station's two rotors swept.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Axis {
    /// Azimuth: the rotor with a vertical axis.
    Az,
    /// Elevation: the rotor with a horizontal axis.
    El,
}

/// What a sweep measured: one axis of one station. There are four of them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Kind {
    /// The station that swept.
    pub station: Station,
    /// The rotor that swept.
    pub axis: Axis,
}

impl Kind {
    /// Position in an array of four: A az, A el, B az, B el.
    pub fn index(self) -> usize {
        2 * self.station as usize + self.axis as usize
    }
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let station = if self.station == Station::A { "A" } else { "B" };
        let axis = if self.axis == Axis::Az { "az" } else { "el" };
        write!(f, "{station} {axis}")
    }
}

/// One recorded sweep.
#[derive(Clone, Debug, PartialEq)]
pub struct Row {
    /// Line in `sweeps.csv`, counted from 1, for messages.
    pub line: usize,
    /// When, on the recording mote's clock. Which instant of the sweep this is differs between
    /// recordings; `light` finds out.
    pub timestamp: u64,
    /// Which photodiode saw it.
    pub sensor: u32,
    /// What was measured.
    pub kind: Kind,
    /// From the rising edge of that station's own sync to the sweep.
    pub sync_to_sweep: u32,
    /// Where the mote was, metres.
    pub truth: [f64; 3],
    /// Whether `truth` can be trusted here.
    pub truth_ok: bool,
}

/// A recording, complete and checked.
#[derive(Clone, Debug)]
pub struct Recording {
    /// The folder it came from.
    pub dir: PathBuf,
    /// Nominal rate of the recording clock; the light knows better.
    pub clock_hz: f64,
    /// How many photodiodes the recording mote had.
    pub photodiodes: u32,
    /// File with the stations' poses.
    pub stations: PathBuf,
    /// Rows in this half-open range of timestamps are for fitting and are never scored.
    pub calibrate: Range<u64>,
    /// The sweeps in the order of their timestamps.
    pub rows: Vec<Row>,
}

/// `recording.toml` as written.
#[derive(Deserialize)]
struct About {
    kind: Spanned<String>,
    clock_hz: Spanned<f64>,
    photodiodes: Spanned<u32>,
    stations: Spanned<String>,
    calibrate: Spanned<[u64; 2]>,
}

impl Recording {
    /// Reads and checks the folder `dir`.
    pub fn open(dir: &Path) -> Result<Self> {
        ensure!(dir.is_dir(), "{}: no such recording folder", dir.display());
        let about = dir.join(ABOUT);
        let text = read(&about)?;
        let path = about.display();
        let parsed: About = toml::from_str(&text).map_err(|e| {
            let line = e.span().map_or(1, |span| line_of(&text, span.start));
            let written = text.lines().nth(line - 1).unwrap_or("").trim();
            anyhow!("{path}:{line}: {} in `{written}`", e.message())
        })?;
        let at = |span: Range<usize>| line_of(&text, span.start);

        let kind = parsed.kind.get_ref();
        ensure!(
            kind == KIND,
            "{path}:{}: field kind: `{kind}` is not a kind of recording this can read; it reads `{KIND}`",
            at(parsed.kind.span())
        );
        let clock_hz = *parsed.clock_hz.get_ref();
        ensure!(
            clock_hz.is_finite() && clock_hz > 0.0,
            "{path}:{}: field clock_hz: `{clock_hz}` is not the rate of a clock",
            at(parsed.clock_hz.span())
        );
        let photodiodes = *parsed.photodiodes.get_ref();
        ensure!(
            photodiodes > 0,
            "{path}:{}: field photodiodes: `{photodiodes}`, but sweeps need at least one",
            at(parsed.photodiodes.span())
        );
        let [from, to] = *parsed.calibrate.get_ref();
        ensure!(
            from <= to,
            "{path}:{}: field calibrate: `[{from}, {to}]` ends before it begins",
            at(parsed.calibrate.span())
        );
        let name = parsed.stations.get_ref();
        let stations = dir.join(name);
        ensure!(
            stations.is_file(),
            "{path}:{}: field stations: `{name}`: there is no file {}",
            at(parsed.stations.span()),
            stations.display()
        );

        let rows = read_sweeps(&dir.join(SWEEPS), photodiodes)?;
        Ok(Self { dir: dir.to_owned(), clock_hz, photodiodes, stations, calibrate: from..to, rows })
    }

    /// The same recording as photodiode `sensor` alone saw it: a mote has one.
    pub fn sensor(&self, sensor: u32) -> Result<Self> {
        ensure!(
            sensor < self.photodiodes,
            "{}: there is no photodiode {sensor}; the recording has {} (0 to {})",
            self.dir.display(),
            self.photodiodes,
            self.photodiodes - 1
        );
        let rows: Vec<Row> = self.rows.iter().filter(|row| row.sensor == sensor).cloned().collect();
        ensure!(
            !rows.is_empty(),
            "{}: column sensor: photodiode `{sensor}` has no rows",
            self.dir.join(SWEEPS).display()
        );
        Ok(Self { rows, ..self.clone() })
    }

    /// Whether `row` counts in an accuracy figure: its truth is good and nothing was fitted on it.
    pub fn scored(&self, row: &Row) -> bool {
        row.truth_ok && !self.calibrate.contains(&row.timestamp)
    }
}

/// Line, counted from 1, of a byte offset in `text`.
fn line_of(text: &str, offset: usize) -> usize {
    text.bytes().take(offset).filter(|&b| b == b'\n').count() + 1
}

/// The text of a file, or an error that names it.
fn read(path: &Path) -> Result<String> {
    fs::read_to_string(path).with_context(|| format!("{}: cannot be read", path.display()))
}

/// Where each column of `COLUMNS` stands in a row.
type Places = [usize; COLUMNS.len()];

/// Reads the table of sweeps.
fn read_sweeps(path: &Path, photodiodes: u32) -> Result<Vec<Row>> {
    let text = read(path)?;
    let path = path.display().to_string();
    let mut lines = text.lines().enumerate();
    let (_, header) = lines.next().ok_or_else(|| anyhow!("{path}: the file is empty"))?;
    let names: Vec<&str> = header.trim_start_matches('\u{feff}').split(',').map(str::trim).collect();
    let mut places: Places = [0; COLUMNS.len()];
    for (place, column) in places.iter_mut().zip(COLUMNS) {
        *place = names
            .iter()
            .position(|name| *name == column)
            .ok_or_else(|| anyhow!("{path}:1: column {column} is missing; the header is `{header}`"))?;
    }
    let mut rows: Vec<Row> = Vec::new();
    for (index, line) in lines {
        if line.trim().is_empty() {
            continue;
        }
        let cells: Vec<&str> = line.split(',').map(str::trim).collect();
        ensure!(
            cells.len() == names.len(),
            "{path}:{}: {} cells where the header has {} columns: `{line}`",
            index + 1,
            cells.len(),
            names.len()
        );
        let row = Line { path: &path, number: index + 1, cells: &cells, places: &places }.row(photodiodes)?;
        if let Some(last) = rows.last() {
            ensure!(
                row.timestamp >= last.timestamp,
                "{path}:{}: column timestamp_ticks: `{}` is before `{}` on line {}: time runs backwards",
                row.line,
                row.timestamp,
                last.timestamp,
                last.line
            );
        }
        rows.push(row);
    }
    ensure!(!rows.is_empty(), "{path}: there is a header but not one row");
    Ok(rows)
}

/// One line of the table, with what an error must say about it.
struct Line<'a> {
    path: &'a str,
    number: usize,
    cells: &'a [&'a str],
    places: &'a Places,
}

impl Line<'_> {
    fn row(&self, photodiodes: u32) -> Result<Row> {
        let sensor: u32 = self.number(1, "a whole number")?;
        if sensor >= photodiodes {
            return Err(self.wrong(1, &format!("beyond the {photodiodes} photodiode(s) of {ABOUT}")));
        }
        let sync_to_sweep: u32 = self.number(4, "a whole number")?;
        if sync_to_sweep == 0 {
            return Err(self.wrong(4, "no time at all"));
        }
        Ok(Row {
            line: self.number,
            timestamp: self.number(0, "a whole number")?,
            sensor,
            kind: Kind { station: self.station()?, axis: self.axis()? },
            sync_to_sweep,
            truth: [self.metres(5)?, self.metres(6)?, self.metres(7)?],
            truth_ok: self.flag(8)?,
        })
    }

    fn cell(&self, column: usize) -> &str {
        self.cells[self.places[column]]
    }

    fn wrong(&self, column: usize, what: &str) -> anyhow::Error {
        anyhow!("{}:{}: column {}: `{}` is {what}", self.path, self.number, COLUMNS[column], self.cell(column))
    }

    fn number<T: std::str::FromStr>(&self, column: usize, what: &str) -> Result<T> {
        self.cell(column).parse().map_err(|_| self.wrong(column, &format!("not {what}")))
    }

    fn metres(&self, column: usize) -> Result<f64> {
        let value: f64 = self.number(column, "a number")?;
        if !value.is_finite() {
            return Err(self.wrong(column, "not a place"));
        }
        Ok(value)
    }

    fn station(&self) -> Result<Station> {
        match self.cell(2) {
            "A" => Ok(Station::A),
            "B" => Ok(Station::B),
            _ => Err(self.wrong(2, "neither station A nor B")),
        }
    }

    fn axis(&self) -> Result<Axis> {
        match self.cell(3) {
            "az" => Ok(Axis::Az),
            "el" => Ok(Axis::El),
            _ => Err(self.wrong(3, "neither axis az nor el")),
        }
    }

    fn flag(&self, column: usize) -> Result<bool> {
        match self.cell(column) {
            "1" => Ok(true),
            "0" => Ok(false),
            _ => bail!(self.wrong(column, "neither 0 nor 1")),
        }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use tempfile::TempDir;

    const GOOD_ABOUT: &str = "kind = \"sweeps\"\nclock_hz = 10_000_000\nphotodiodes = 1\nstations = \"stations.toml\"\ncalibrate = [5, 10]\n";
    const HEADER: &str =
        "timestamp_ticks,sensor,station,axis,sync_to_sweep_ticks,truth_x_m,truth_y_m,truth_z_m,truth_ok\n";
    const ROW: &str = "100,0,A,el,48476,0.5,1.0,-0.8,1\n";

    /// A recording folder with the given files.
    fn folder(about: &str, sweeps: &str) -> TempDir {
        let dir = tempfile::tempdir().unwrap();
        fs::write(dir.path().join(ABOUT), about).unwrap();
        fs::write(dir.path().join(SWEEPS), sweeps).unwrap();
        fs::write(dir.path().join("stations.toml"), "").unwrap();
        dir
    }

    /// What opening it complains about.
    fn complaint(about: &str, sweeps: &str) -> String {
        let dir = folder(about, sweeps);
        format!("{:#}", Recording::open(dir.path()).expect_err("this recording is damaged"))
    }

    fn assert_says(message: &str, parts: &[&str]) {
        for part in parts {
            assert!(message.contains(part), "`{part}` is not in: {message}");
        }
    }

    /// A folder of the recordings that are not part of the project; says so when it is not there.
    pub(crate) fn shared_recording(name: &str) -> Option<Recording> {
        let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data").join(name);
        if !dir.is_dir() {
            eprintln!("skipped: there is no recording ../shared/data/{name} beside the project");
            return None;
        }
        Some(Recording::open(&dir).unwrap())
    }

    #[test]
    fn a_good_recording_opens() {
        let dir = folder(GOOD_ABOUT, &format!("{HEADER}{ROW}\n100,0,B,az,5,0,0,0,0\n"));
        let recording = Recording::open(dir.path()).unwrap();
        assert_eq!(recording.rows.len(), 2);
        assert_eq!(recording.rows[0].truth, [0.5, 1.0, -0.8]);
        assert_eq!(recording.rows[1].kind.index(), 2);
        assert_eq!(recording.rows[1].line, 4);
        assert!(recording.scored(&recording.rows[0]));
        assert!(!recording.scored(&recording.rows[1]));
    }

    #[test]
    fn columns_may_come_in_any_order() {
        let sweeps = "truth_ok,axis,station,note,sensor,timestamp_ticks,truth_x_m,truth_y_m,truth_z_m,sync_to_sweep_ticks\n1,az,B,hello,0,7,1,2,3,400\n";
        let recording = Recording::open(folder(GOOD_ABOUT, sweeps).path()).unwrap();
        assert_eq!(recording.rows[0].sync_to_sweep, 400);
        assert_eq!(recording.rows[0].truth, [1.0, 2.0, 3.0]);
        assert!(!recording.scored(&recording.rows[0]), "7 lies in the window of calibration");
    }

    #[test]
    fn a_missing_folder_or_file_is_named() {
        let dir = folder(GOOD_ABOUT, HEADER);
        let gone = dir.path().join("gone");
        assert_says(&format!("{:#}", Recording::open(&gone).unwrap_err()), &["gone", "no such recording folder"]);
        for (file, says) in
            [(ABOUT, "cannot be read"), (SWEEPS, "cannot be read"), ("stations.toml", "there is no file")]
        {
            let dir = folder(GOOD_ABOUT, &format!("{HEADER}{ROW}"));
            fs::remove_file(dir.path().join(file)).unwrap();
            assert_says(&format!("{:#}", Recording::open(dir.path()).unwrap_err()), &[file, says]);
        }
    }

    #[test]
    fn an_empty_table_is_refused() {
        assert_says(&complaint(GOOD_ABOUT, ""), &["sweeps.csv", "empty"]);
        assert_says(&complaint(GOOD_ABOUT, HEADER), &["sweeps.csv", "not one row"]);
    }

    #[test]
    fn a_missing_column_is_named() {
        let sweeps = HEADER.replace("axis,", "") + "100,0,A,48476,0.5,1.0,-0.8,1\n";
        assert_says(&complaint(GOOD_ABOUT, &sweeps), &["sweeps.csv:1", "column axis is missing"]);
    }

    #[test]
    fn a_short_row_is_named() {
        assert_says(
            &complaint(GOOD_ABOUT, &format!("{HEADER}{ROW}100,0,A,el\n")),
            &["sweeps.csv:3", "4 cells", "9 columns"],
        );
    }

    #[test]
    fn every_bad_cell_is_named_with_its_value() {
        let bad = [
            (0, "1e5", "timestamp_ticks", "not a whole number"),
            (0, "-3", "timestamp_ticks", "not a whole number"),
            (1, "1", "sensor", "beyond the 1 photodiode"),
            (2, "C", "station", "neither station A nor B"),
            (3, "yaw", "axis", "neither axis az nor el"),
            (4, "4847.5", "sync_to_sweep_ticks", "not a whole number"),
            (4, "0", "sync_to_sweep_ticks", "no time at all"),
            (5, "x", "truth_x_m", "not a number"),
            (6, "", "truth_y_m", "not a number"),
            (7, "NaN", "truth_z_m", "not a place"),
            (8, "yes", "truth_ok", "neither 0 nor 1"),
        ];
        for (column, value, name, says) in bad {
            let mut cells: Vec<&str> = ROW.trim().split(',').collect();
            cells[column] = value;
            let message = complaint(GOOD_ABOUT, &format!("{HEADER}{ROW}{}\n", cells.join(",")));
            assert_says(&message, &["sweeps.csv:3", &format!("column {name}"), &format!("`{value}`"), says]);
        }
    }

    #[test]
    fn time_that_runs_backwards_is_refused() {
        let sweeps = format!("{HEADER}{ROW}99,0,A,el,48476,0.5,1.0,-0.8,1\n");
        assert_says(
            &complaint(GOOD_ABOUT, &sweeps),
            &["sweeps.csv:3", "column timestamp_ticks", "`99`", "`100`", "backwards"],
        );
    }

    #[test]
    fn a_bad_description_is_named_with_its_value() {
        let sweeps = format!("{HEADER}{ROW}");
        let bad = [
            ("kind = \"sweeps\"", "kind = \"pulses\"", ":1", "field kind", "`pulses`"),
            ("clock_hz = 10_000_000", "clock_hz = -1.0", ":2", "field clock_hz", "`-1`"),
            ("clock_hz = 10_000_000", "clock_hz = \"fast\"", ":2", "expected", "fast"),
            ("clock_hz = 10_000_000", "", "recording.toml", "missing field", "clock_hz"),
            ("photodiodes = 1", "photodiodes = 0", ":3", "field photodiodes", "`0`"),
            ("[5, 10]", "[11, 10]", ":5", "field calibrate", "`[11, 10]`"),
            ("[5, 10]", "[5, 10", "recording.toml", "array", "[5, 10"),
        ];
        for (good, replaced, line, what, value) in bad {
            let message = complaint(&GOOD_ABOUT.replace(good, replaced), &sweeps);
            assert_says(&message, &["recording.toml", line, what, value]);
        }
    }

    #[test]
    fn a_photodiode_that_is_not_there_is_refused() {
        let dir = folder(GOOD_ABOUT, &format!("{HEADER}{ROW}"));
        let recording = Recording::open(dir.path()).unwrap();
        assert_eq!(recording.sensor(0).unwrap().rows.len(), 1);
        assert_says(&format!("{:#}", recording.sensor(4).unwrap_err()), &["no photodiode 4"]);
    }
}
