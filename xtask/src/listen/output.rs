//! What is heard, as CSV and as JSON lines.
//!
//! Rows and lines are written whole: a program that is killed leaves a file that reads.
//!
//! What can go wrong: a full disk or a reader that has gone. The first is an error that names the file, which ends with what
//! was whole; the second ends the listening, as whoever types `| head` means it.

use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Seek, SeekFrom, Write};
use std::path::Path;

use anyhow::{Context, Result, bail, ensure};
use serde::Serialize;

use super::model::{Event, Fix, HealthNews};
use crate::whole::folder;

/// A way out.
pub trait Sink {
    /// Takes one event.
    ///
    /// # Errors
    /// It cannot be written.
    fn event(&mut self, event: &Event) -> Result<()>;

    /// Takes one frame as it was on the air, before the event that it makes.
    ///
    /// # Errors
    /// It cannot be written.
    fn frame(&mut self, _: &super::source::Heard) -> Result<()> {
        Ok(())
    }

    /// Is called several times a second: what was held back goes out.
    ///
    /// # Errors
    /// It cannot be written.
    fn tick(&mut self) -> Result<()>;

    /// Is called once, when the listening is over.
    ///
    /// # Errors
    /// It cannot be written.
    fn end(&mut self) -> Result<()> {
        Ok(())
    }

    /// What nobody should miss, once, where [`Sink::note`] is not before everybody's eyes.
    fn alarm(&mut self) -> Option<String> {
        None
    }

    /// One line about it, where there is something to say.
    fn note(&self) -> Option<String> {
        None
    }
}

/// A new file that grows by whole pieces.
#[derive(Debug)]
pub struct Growing {
    name: String,
    file: File,
    length: u64,
}

impl Growing {
    /// Makes it.
    ///
    /// # Errors
    /// It is there, or cannot be made.
    pub fn create(path: &Path) -> Result<Self> {
        vacant(path)?;
        let name = path.display().to_string();
        let file = OpenOptions::new().write(true).create_new(true).open(path);
        Ok(Self { file: file.with_context(|| format!("{name}: cannot be made"))?, name, length: 0 })
    }

    /// Puts a piece behind the others: all of it, or none.
    ///
    /// # Errors
    /// The disk is full.
    pub fn append(&mut self, piece: &[u8]) -> Result<()> {
        if let Err(error) = self.file.write_all(piece) {
            // As far as it came it is no piece.
            let _ = self.file.set_len(self.length).and_then(|()| self.file.seek(SeekFrom::Start(self.length)));
            return Err(error).with_context(|| self.unwritten());
        }
        self.length += piece.len() as u64;
        Ok(())
    }

    /// Waits until all of it is on the disk.
    ///
    /// # Errors
    /// The disk does not take it.
    pub fn sync(&self) -> Result<()> {
        self.file.sync_data().with_context(|| self.unwritten())
    }

    /// Bytes so far.
    #[must_use]
    pub fn length(&self) -> u64 {
        self.length
    }

    fn unwritten(&self) -> String {
        format!("{}: cannot be written", self.name)
    }
}

/// Whether a new file may be made there.
///
/// # Errors
/// There is one, or no folder for it.
pub fn vacant(path: &Path) -> Result<()> {
    let name = path.display();
    ensure!(path.symlink_metadata().is_err(), "{name}: is there already and is not overwritten");
    let folder = folder(path);
    ensure!(folder.is_dir(), "{name}: there is no folder {}", folder.display());
    Ok(())
}

/// Rows of a table, written whole.
#[derive(Debug)]
pub struct Table {
    name: String,
    file: Growing,
    rows: csv::Writer<Vec<u8>>,
    is_headed: bool,
}

impl Table {
    /// A new file.
    ///
    /// # Errors
    /// It is there, or cannot be made.
    pub fn create(path: &Path) -> Result<Self> {
        let file = Growing::create(path)?;
        Ok(Self { name: path.display().to_string(), file, rows: rows(true), is_headed: false })
    }

    /// Takes a row.
    ///
    /// # Errors
    /// It is no row.
    pub fn row(&mut self, row: &impl Serialize) -> Result<()> {
        self.is_headed = true;
        self.rows.serialize(row).with_context(|| self.name.clone())
    }

    /// Writes the rows so far.
    ///
    /// # Errors
    /// The disk is full.
    pub fn write(&mut self) -> Result<()> {
        let empty = rows(!self.is_headed);
        let bytes = std::mem::replace(&mut self.rows, empty).into_inner();
        let bytes = bytes.map_err(|error| error.into_error()).with_context(|| self.name.clone())?;
        if self.file.append(&bytes).is_err() {
            // Those that there is room for.
            for row in bytes.split_inclusive(|byte| *byte == b'\n') {
                self.file.append(row)?;
            }
        }
        Ok(())
    }

    /// Waits until what was written is on the disk.
    ///
    /// # Errors
    /// The disk does not take it.
    pub fn sync(&self) -> Result<()> {
        self.file.sync()
    }
}

fn rows(head: bool) -> csv::Writer<Vec<u8>> {
    csv::WriterBuilder::new().has_headers(head).from_writer(Vec::new())
}

/// A fix as a row; what is unknown is empty.
#[derive(Debug, Serialize)]
#[allow(missing_docs, reason = "as in `Fix`")]
pub struct FixRow<'a> {
    time_s: f64,
    source: &'a str,
    pan: u16,
    mote: u16,
    twin: u8,
    sequence: u16,
    level: &'static str,
    x_m: Option<f64>,
    y_m: Option<f64>,
    z_m: Option<f64>,
    vx_m_per_s: Option<f64>,
    vy_m_per_s: Option<f64>,
    vz_m_per_s: Option<f64>,
    sd_x_m: Option<f64>,
    sd_y_m: Option<f64>,
    sd_z_m: Option<f64>,
    mismatch_m: f64,
    angle_age_s: f64,
    station_a: bool,
    station_b: bool,
    mote_ticks: u32,
    rssi_dbm: Option<i16>,
    lqi: Option<u8>,
}

/// To a hundredth of a millimetre, and time to a microsecond: what is finer is noise.
fn rounded(value: f64, decimals: i32) -> f64 {
    let scale = 10f64.powi(decimals);
    (value * scale).round() / scale
}

impl<'a> From<&'a Fix> for FixRow<'a> {
    fn from(fix: &'a Fix) -> Self {
        let each = |three: Option<[f64; 3]>| match three {
            Some(three) => three.map(|value| Some(rounded(value, 5))),
            None => [None; 3],
        };
        let [x_m, y_m, z_m] = each(fix.position_m);
        let [vx_m_per_s, vy_m_per_s, vz_m_per_s] = each(fix.velocity_m_per_s);
        let [sd_x_m, sd_y_m, sd_z_m] = each(fix.sd_m);
        let origin = &fix.origin;
        Self {
            time_s: rounded(origin.time_s, 6),
            source: &origin.source,
            pan: origin.pan,
            mote: origin.mote,
            twin: origin.twin,
            sequence: origin.sequence,
            level: fix.level,
            x_m,
            y_m,
            z_m,
            vx_m_per_s,
            vy_m_per_s,
            vz_m_per_s,
            sd_x_m,
            sd_y_m,
            sd_z_m,
            mismatch_m: rounded(fix.mismatch_m, 5),
            angle_age_s: rounded(fix.angle_age_s, 5),
            station_a: fix.stations_seen[0],
            station_b: fix.stations_seen[1],
            mote_ticks: fix.mote_ticks,
            rssi_dbm: origin.signal.rssi_dbm,
            lqi: origin.signal.lqi,
        }
    }
}

/// A health frame as a row.
#[derive(Debug, Serialize)]
#[allow(missing_docs, reason = "as in `Condition`")]
pub struct HealthRow<'a> {
    time_s: f64,
    source: &'a str,
    pan: u16,
    mote: u16,
    twin: u8,
    sequence: u16,
    lock: &'static str,
    clock_hz: Option<f64>,
    uptime_s: u32,
    reset: &'static str,
    reset_detail: Option<u32>,
    station_a_id: Option<u32>,
    station_b_id: Option<u32>,
    flashes_a: u16,
    flashes_b: u16,
    rejects: u32,
}

impl<'a> From<&'a HealthNews> for HealthRow<'a> {
    fn from(news: &'a HealthNews) -> Self {
        let (origin, condition) = (&news.origin, &news.condition);
        let [a, b] = &condition.stations;
        Self {
            time_s: rounded(origin.time_s, 6),
            source: &origin.source,
            pan: origin.pan,
            mote: origin.mote,
            twin: origin.twin,
            sequence: origin.sequence,
            lock: condition.lock,
            clock_hz: condition.clock_hz.map(|hz| rounded(hz, 1)),
            uptime_s: condition.uptime_s,
            reset: condition.reset,
            reset_detail: condition.reset_detail,
            station_a_id: a.id,
            station_b_id: b.id,
            flashes_a: a.flashes,
            flashes_b: b.flashes,
            rejects: condition.rejects.values().map(|count| u32::from(*count)).sum(),
        }
    }
}

/// Fixes as CSV.
impl Sink for Table {
    fn event(&mut self, event: &Event) -> Result<()> {
        match event {
            Event::Fix(fix) => self.row(&FixRow::from(fix)),
            _ => Ok(()),
        }
    }

    fn tick(&mut self) -> Result<()> {
        self.write()
    }

    fn end(&mut self) -> Result<()> {
        self.write()?;
        self.sync()
    }
}

/// Every event as a line of JSON.
#[derive(Debug)]
pub struct JsonLines<W> {
    to: W,
    lines: Vec<u8>,
}

impl<W: Write> JsonLines<W> {
    /// Onto the standard output, for example.
    pub fn new(to: W) -> Self {
        Self { to, lines: Vec::new() }
    }
}

/// Whoever read the output has gone.
#[derive(Debug)]
pub struct ReaderGone;

impl std::fmt::Display for ReaderGone {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("whoever read the output has gone")
    }
}

impl std::error::Error for ReaderGone {}

/// Says something on the standard output.
///
/// # Errors
/// [`ReaderGone`], or it cannot be written.
pub fn say(to: &mut impl Write, text: &[u8]) -> Result<()> {
    match to.write_all(text).and_then(|()| to.flush()) {
        Err(error) if error.kind() == ErrorKind::BrokenPipe => bail!(ReaderGone),
        other => other.context("the standard output cannot be written"),
    }
}

impl<W: Write> Sink for JsonLines<W> {
    fn event(&mut self, event: &Event) -> Result<()> {
        serde_json::to_writer(&mut self.lines, event).context("an event that is no JSON")?;
        self.lines.push(b'\n');
        Ok(())
    }

    fn tick(&mut self) -> Result<()> {
        say(&mut self.to, &std::mem::take(&mut self.lines))
    }

    fn end(&mut self) -> Result<()> {
        self.tick()
    }
}
