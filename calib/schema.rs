//! What a calibration file may say, and the one reader of it.
//!
//! Used by build.rs and by xtask from this same file. Everything is SI. A key that nobody knows is an error, so that a
//! typo never means a default.
//!
//! Factory terms have two sources: this file, and the stations, which send their own with every flash (OOTX).
//! `factory = "received"` under `[mote]` asks both stations for theirs, under `[station.A]` that one alone; until they
//! have come, the file's are used, which are zero where it gives none. A file that gives terms and asks as well says
//! `source = "received"` in `[station.A.factory]`. `"file"` is the default, and undoes `[mote]`'s wish for one station.
//!
//! `id = 3200290360` under `[station.A]` is the serial number that station must have: a mote that hears another one says
//! so, for the stations may have been swapped.
//!
//! `lone = "A"` or `"B"` under `[mote]` says whose flashes they are when only one station of a pair has been seen since
//! the start; the light does not tell.
//!
//! `sweep_edge = "rise"` under `[mote]` is for receivers whose fall comes at any time: a laser then passes when its pulse
//! rises, and not in the middle of it. `shortest_sweep_us`, 1 where nothing is said, is the shortest pulse of a laser.
//!
//! What can go wrong: every complaint names the file, the line, the field and the value.

#[path = "schema/table.rs"]
mod table;

use std::fmt;
use std::ops::Range;
use std::path::{Path, PathBuf};

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::key::{self, Key};
use table::{At, Source, Table, parse, root, shown};

/// A measured room.
#[derive(Debug, Clone)]
pub struct Calibration {
    /// Where the numbers come from, as (key, text), sorted by key; free text.
    pub provenance: Vec<(String, String)>,
    /// Stations A and B.
    pub stations: [Station; 2],
    /// Where the mote may be, if declared.
    pub room: Option<RoomBox>,
    /// What the mote is told besides.
    pub mote: Mote,
}

/// One station.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Station {
    /// World to station: c = R (p - position).
    pub rotation: [[f64; 3]; 3],
    /// In the world, metres.
    pub position: [f64; 3],
    /// Factory terms of the azimuth and the elevation rotor.
    pub factory: [Rotor; 2],
    /// Whose factory terms are to be used; that of [`Mote`] where nothing is said.
    pub source: Option<FactorySource>,
    /// The serial number, if the room's file knows it.
    pub id: Option<u32>,
}

/// Whose factory terms a mote uses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum FactorySource {
    /// `"file"`: those of the room's file.
    #[default]
    File,
    /// `"received"`: those that the station sends, and those of the file until they have come.
    Received,
}

impl FactorySource {
    /// As a room file has it.
    #[must_use]
    #[allow(dead_code, reason = "for those who write rooms")]
    pub const fn name(self) -> &'static str {
        match self {
            Self::File => "file",
            Self::Received => "received",
        }
    }
}

/// The factory calibration of one rotor, radians.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Rotor {
    /// Ideal angle minus measured angle, straight ahead.
    pub phase: f64,
    /// Tilt of the laser plane.
    pub tilt: f64,
    /// Curve of the laser plane: read so that a file may hold all that a station sends, and not applied. It is tiny, and the
    /// public implementations disagree about its sign.
    pub curve: f64,
    /// Phase of the once-per-turn term.
    pub gibphase: f64,
    /// Magnitude of the once-per-turn term.
    pub gibmag: f64,
}

/// An axis-aligned box in the world, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RoomBox {
    /// The corner of the smallest coordinates.
    pub min: [f64; 3],
    /// The corner of the largest.
    pub max: [f64; 3],
}

/// Settings of the mote itself.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mote {
    /// Short address, 0 ..= 0xFFFD.
    pub id: u16,
    /// PAN id, 0 ..= 0xFFFE.
    pub pan: u16,
    /// Whose position is reported.
    pub estimate: Estimate,
    /// At most one report per so many half turns (8.333 ms).
    pub report_every_half_turns: u16,
    /// Which half turns these are; see [`Mote::sends`] where nothing is said.
    pub send: Option<Send>,
    /// Only a mote that has moved so far since its last report says so, metres; 0: every report goes out.
    pub moved_m: f64,
    /// One that rests reports once in so many seconds.
    pub heartbeat_s: f64,
    /// The oldest angle a fix may use, ms.
    pub max_angle_age_ms: f64,
    /// Standard deviation of one angle in this room, mrad, calibration errors included; none for the tracker's usual one.
    pub angle_noise_mrad: Option<f64>,
    /// Whose factory terms are used, where a station says nothing else.
    pub factory: FactorySource,
    /// Who flashes, if only one station of the pair is seen from the start.
    pub lone: Option<Name>,
    /// The shortest pulse of a laser that counts, us.
    pub shortest_sweep_us: f64,
    /// Which moment of a laser's pulse is the sweep.
    pub sweep_edge: SweepEdge,
    /// The room's key: frames then prove who made them. See `key.rs`.
    pub key: Option<Key>,
}

/// The moment of a laser's pulse that counts as the sweep.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum SweepEdge {
    /// `"middle"`: half way between both edges.
    #[default]
    Middle,
    /// `"rise"`, for receivers with one good edge.
    Rise,
}

/// Which of the two stations.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Name {
    /// `"A"`: the one that flashes first.
    A,
    /// `"B"`.
    B,
}

impl Calibration {
    /// Which of the stations are asked for their own factory terms.
    #[must_use]
    pub fn received(&self) -> [bool; 2] {
        self.stations.map(|station| station.source.unwrap_or(self.mote.factory) == FactorySource::Received)
    }
}

/// Which half turns a mote reports in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Send {
    /// `"slotted"`: those that are its own, by the common count of all motes that see station A.
    Slotted,
    /// `"jittered"`: by dice, half as far apart as asked for to one and a half times.
    Jittered,
    /// `"steady"`: every so many since the last.
    Steady,
}

impl Send {
    /// As a room file has it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Slotted => "slotted",
            Self::Jittered => "jittered",
            Self::Steady => "steady",
        }
    }
}

/// Half turns that have a number: the bits of a station's frame, which repeats.
pub const NUMBERED_HALF_TURNS: u16 = 358;
/// The least for `"slotted"` in a room with a key: a report is sealed for so many half turns
/// (`lighthouse_mote::send::SEALING_HALF_TURNS`).
pub const SEALED_HALF_TURNS: u16 = 5;

impl Mote {
    /// Which half turns it reports in.
    #[must_use]
    pub fn sends(&self) -> Send {
        self.send.unwrap_or(Send::Steady)
    }

    /// What serves best where there are other motes in the room: slots, unless it reports in all half turns or too
    /// rarely for them.
    #[must_use]
    #[allow(dead_code, reason = "flashing alone asks")]
    pub fn among_others(&self) -> Send {
        self.send.unwrap_or(match self.report_every_half_turns {
            0..=1 => Send::Steady,
            2..SEALED_HALF_TURNS if self.key.is_some() => Send::Jittered,
            2..=NUMBERED_HALF_TURNS => Send::Slotted,
            _ => Send::Jittered,
        })
    }
}

/// Whose position a mote reports.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Estimate {
    /// `"track"`: the tracker's.
    Track,
    /// `"fix"`: each fix as it is.
    Fix,
    /// `"angles"`: nobody's: the sweeps themselves go out, from which a room is calibrated.
    Angles,
}

impl Default for Mote {
    fn default() -> Self {
        Self {
            id: 1,
            pan: 0x4C48,
            estimate: Estimate::Track,
            report_every_half_turns: 8,
            send: None,
            moved_m: 0.0,
            heartbeat_s: 1.0,
            max_angle_age_ms: 100.0,
            angle_noise_mrad: None,
            factory: FactorySource::File,
            lone: None,
            shortest_sweep_us: 1.0,
            sweep_edge: SweepEdge::Middle,
            key: None,
        }
    }
}

/// What is wrong, and where.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Error {
    /// The file as it was named.
    pub file: String,
    /// Counted from 1; 0 where it is about the whole file.
    pub line: usize,
    /// The dotted path of the field; empty when the file does not parse at all.
    pub field: String,
    /// What is wrong with which value.
    pub what: String,
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.file)?;
        if self.line > 0 {
            write!(f, ":{}", self.line)?;
        }
        f.write_str(": ")?;
        if !self.field.is_empty() {
            write!(f, "{}: ", self.field)?;
        }
        f.write_str(&self.what)
    }
}

impl std::error::Error for Error {}

/// Reads a calibration file.
///
/// # Errors
/// The first thing wrong with it.
pub fn open(path: &Path) -> Result<Calibration, Error> {
    let file = path.display().to_string();
    let text = std::fs::read_to_string(path).map_err(|error| Error {
        file: file.clone(),
        line: 0,
        field: String::new(),
        what: format!("cannot be read: {error}"),
    })?;
    read(&file, &text)
}

/// Reads a calibration from `text`; `file` is for complaints.
///
/// # Errors
/// The first thing wrong with it.
pub fn read(file: &str, text: &str) -> Result<Calibration, Error> {
    let source = Source { file, text };
    calibration(source, &parse(source)?)
}

/// The same of a room whose key may be elsewhere: it is left out.
///
/// # Errors
/// The first other thing wrong with it.
#[allow(dead_code, reason = "recordings alone are without their keys")]
pub fn read_without_key(file: &str, text: &str) -> Result<Calibration, Error> {
    let source = Source { file, text };
    let mut parsed = parse(source)?;
    for (_, table) in parsed.get_mut().iter_mut().filter(|(name, _)| name.get_ref() == "mote") {
        if let DeValue::Table(mote) = table.get_mut() {
            mote.remove(KEY_FILE);
        }
    }
    calibration(source, &parsed)
}

/// The file that a room names for its key, and where in `text` it does.
#[must_use]
#[allow(dead_code, reason = "recordings alone are without their keys")]
pub fn key_file(text: &str) -> Option<(Range<usize>, PathBuf)> {
    let parsed = DeTable::parse(text).ok()?;
    let (_, table) = parsed.get_ref().iter().find(|(name, _)| name.get_ref() == "mote")?;
    let DeValue::Table(mote) = table.get_ref() else { return None };
    let (_, value) = mote.iter().find(|(name, _)| name.get_ref() == KEY_FILE)?;
    let DeValue::String(file) = value.get_ref() else { return None };
    Some((value.span(), PathBuf::from(file.as_ref())))
}

fn calibration(source: Source<'_>, parsed: &Spanned<DeTable<'_>>) -> Result<Calibration, Error> {
    let root = root(source, parsed);
    root.only(&["provenance", "station", "room", "mote"])?;
    let provenance = match root.table("provenance")? {
        Some(table) => table.texts()?,
        None => Vec::new(),
    };
    let both = root.need_table("station")?;
    both.only(&["A", "B"])?;
    let stations = [station(&both, "A")?, station(&both, "B")?];
    let room = root.table("room")?.map(|table| room(&table)).transpose()?;
    let mote = root.table("mote")?.map_or(Ok(Mote::default()), |table| mote(&table, Mote::default()))?;
    Ok(Calibration { provenance, stations, room, mote })
}

/// The words of a room file.
const FACTORY_SOURCES: [(&str, FactorySource); 2] =
    [(FactorySource::File.name(), FactorySource::File), (FactorySource::Received.name(), FactorySource::Received)];
const NAMES: [(&str, Name); 2] = [("A", Name::A), ("B", Name::B)];
const SWEEP_EDGES: [(&str, SweepEdge); 2] = [("middle", SweepEdge::Middle), ("rise", SweepEdge::Rise)];
const ESTIMATES: [(&str, Estimate); 3] =
    [("track", Estimate::Track), ("fix", Estimate::Fix), ("angles", Estimate::Angles)];

/// How far R R^T may be from the identity: nine printed decimals leave 1e-8, hand-typed numbers more.
const ROTATION_TOLERANCE: f64 = 1e-4;
/// No room is larger, metres.
const POSITION_LIMIT_M: f64 = 100.0;
/// The limits of the factory terms, radians; gibphase is any angle. Stations seen in the field have phases up to 0.06,
/// tilts up to 0.006, curves up to 0.007, gibmags up to 0.017; the mote's arithmetic holds tilt and gibmag to here.
const PHASE_LIMIT_RAD: f64 = 0.2;
const TILT_LIMIT_RAD: f64 = 0.02;
const CURVE_LIMIT_RAD: f64 = 0.1;
const GIBMAG_LIMIT_RAD: f64 = 0.03;
/// No angle is better than a fifth of a milliradian (the 2020 recording's jitter alone is half of one), and the tracker
/// holds less than 2^11 / 2^18 rad.
pub const ANGLE_NOISE_LIMITS_MRAD: (f64, f64) = (0.2, 7.8);

/// Longer pulses than the longest of these are flashes, us.
pub const SHORTEST_SWEEP_LIMITS_US: std::ops::RangeInclusive<f64> = 0.0..=50.0;

fn station(both: &Table<'_>, name: &str) -> Result<Station, Error> {
    let table = both.need_table(name)?;
    table.only(&["rotation", "position", "factory", "id"])?;
    let rotation: [[f64; 3]; 3] = table.need("rotation", |value, at| {
        let rows = at.array::<3>(value)?;
        let mut rotation = [[0.0; 3]; 3];
        for (row, value) in rotation.iter_mut().zip(rows) {
            *row = at.vector(value)?;
        }
        Ok(rotation)
    })?;
    table.check("rotation", rotation_flaw(&rotation))?;
    let position = table.need("position", |value, at| at.vector(value))?;
    let far = position.iter().find(|coordinate| coordinate.abs() > POSITION_LIMIT_M);
    table.check("position", far.map(|far| format!("{far} m is beyond {POSITION_LIMIT_M} m; positions are metres")))?;
    let mut factory = [Rotor::default(); 2];
    let mut source = None;
    if let Some(DeValue::String(_)) = table.get("factory").map(Spanned::get_ref) {
        source = table.optional("factory", |value, at| at.choice(value, &FACTORY_SOURCES))?;
    } else if let Some(terms) = table.table("factory")? {
        terms.only(&["source", "az", "el"])?;
        source = terms.optional("source", |value, at| at.choice(value, &FACTORY_SOURCES))?;
        for (rotor, axis) in factory.iter_mut().zip(["az", "el"]) {
            if let Some(terms) = terms.table(axis)? {
                *rotor = self::rotor(&terms)?;
            }
        }
    }
    let id = table.optional("id", |value, at| at.whole(value, u32::MAX))?;
    Ok(Station { rotation, position, factory, source, id })
}

fn rotor(terms: &Table<'_>) -> Result<Rotor, Error> {
    terms.only(&["phase", "tilt", "curve", "gibphase", "gibmag"])?;
    let small = |key: &str, limit: f64| -> Result<f64, Error> {
        let value = terms.optional(key, |value, at| at.number(value))?.unwrap_or(0.0);
        let flaw =
            (value.abs() > limit).then(|| format!("{value} rad is beyond {limit} rad; factory terms are small angles"));
        terms.check(key, flaw)?;
        Ok(value)
    };
    Ok(Rotor {
        phase: small("phase", PHASE_LIMIT_RAD)?,
        tilt: small("tilt", TILT_LIMIT_RAD)?,
        curve: small("curve", CURVE_LIMIT_RAD)?,
        gibphase: terms.optional("gibphase", |value, at| at.number(value))?.unwrap_or(0.0),
        gibmag: small("gibmag", GIBMAG_LIMIT_RAD)?,
    })
}

fn room(table: &Table<'_>) -> Result<RoomBox, Error> {
    table.only(&["min", "max"])?;
    let min: [f64; 3] = table.need("min", |value, at| at.vector(value))?;
    let max: [f64; 3] = table.need("max", |value, at| at.vector(value))?;
    let bad = (0..3).find(|&axis| max[axis] <= min[axis]);
    table.check("max", bad.map(|axis| format!("{} is not above min's {}", max[axis], min[axis])))?;
    Ok(RoomBox { min, max })
}

impl Mote {
    /// These settings with those of `text` instead: lines as they stand under `[mote]`; `name` is for complaints.
    ///
    /// # Errors
    /// The first thing wrong with it.
    pub fn with(self, name: &str, text: &str) -> Result<Mote, Error> {
        let source = Source { file: name, text };
        mote(&root(source, &parse(source)?), self)
    }
}

/// What names the room's key.
const KEY_FILE: &str = "key_file";

fn mote(table: &Table<'_>, usual: Mote) -> Result<Mote, Error> {
    table.only(&[
        "id",
        "pan",
        "estimate",
        "report_every_half_turns",
        "send",
        "moved_m",
        "heartbeat_s",
        "max_angle_age_ms",
        "angle_noise_mrad",
        "factory",
        "lone",
        "shortest_sweep_us",
        "sweep_edge",
        KEY_FILE,
    ])?;
    let whole = |key: &str, usual: u16, max: u16| -> Result<u16, Error> {
        // No larger than `max`, so it fits.
        Ok(table.optional(key, |value, at| at.whole(value, max.into()))?.map_or(usual, |whole| whole as u16))
    };
    let max_angle_age_ms =
        table.optional("max_angle_age_ms", |value, at| at.number(value))?.unwrap_or(usual.max_angle_age_ms);
    let flaw =
        (!(10.0..=2000.0).contains(&max_angle_age_ms)).then(|| format!("{max_angle_age_ms} ms is not in 10 ..= 2000"));
    table.check("max_angle_age_ms", flaw)?;
    let angle_noise_mrad = table.optional("angle_noise_mrad", |value, at| at.number(value))?.or(usual.angle_noise_mrad);
    let flaw = angle_noise_mrad
        .filter(|noise| !(ANGLE_NOISE_LIMITS_MRAD.0..=ANGLE_NOISE_LIMITS_MRAD.1).contains(noise))
        .map(|noise| format!("{noise} mrad is not in {} ..= {}", ANGLE_NOISE_LIMITS_MRAD.0, ANGLE_NOISE_LIMITS_MRAD.1));
    table.check("angle_noise_mrad", flaw)?;
    let report_every_half_turns = whole("report_every_half_turns", usual.report_every_half_turns, 12_000)?;
    let flaw = (report_every_half_turns == 0).then(|| "0 would report without end; 1 reports every fix".to_string());
    table.check("report_every_half_turns", flaw)?;
    let sends = [Send::Slotted, Send::Jittered, Send::Steady].map(|send| (send.name(), send));
    let send = table.optional("send", |value, at| at.choice(value, &sends))?.or(usual.send);
    let flaw = (send == Some(Send::Slotted) && report_every_half_turns > NUMBERED_HALF_TURNS).then(|| {
        format!(
            "\"slotted\" repeats every {NUMBERED_HALF_TURNS} half turns, and report_every_half_turns is \
             {report_every_half_turns}; \"jittered\" or \"steady\""
        )
    });
    table.check("send", flaw)?;
    let number = |key: &str, usual: f64, limits: std::ops::RangeInclusive<f64>, unit: &str| -> Result<f64, Error> {
        let value = table.optional(key, |value, at| at.number(value))?.unwrap_or(usual);
        let flaw = (!limits.contains(&value))
            .then(|| format!("{value} {unit} is not in {} ..= {}", limits.start(), limits.end()));
        table.check(key, flaw)?;
        Ok(value)
    };
    let key = table.optional(KEY_FILE, self::key)?.or(usual.key);
    Ok(Mote {
        key,
        send,
        moved_m: number("moved_m", usual.moved_m, 0.0..=10.0, "m")?,
        // A 16-bit count of half turns.
        heartbeat_s: number("heartbeat_s", usual.heartbeat_s, 0.1..=540.0, "s")?,
        id: whole("id", usual.id, 0xFFFD)?,
        pan: whole("pan", usual.pan, 0xFFFE)?,
        estimate: table.optional("estimate", |value, at| at.choice(value, &ESTIMATES))?.unwrap_or(usual.estimate),
        report_every_half_turns,
        max_angle_age_ms,
        angle_noise_mrad,
        factory: table.optional("factory", |value, at| at.choice(value, &FACTORY_SOURCES))?.unwrap_or(usual.factory),
        lone: table.optional("lone", |value, at| at.choice(value, &NAMES))?.or(usual.lone),
        shortest_sweep_us: number("shortest_sweep_us", usual.shortest_sweep_us, SHORTEST_SWEEP_LIMITS_US, "us")?,
        sweep_edge: table
            .optional("sweep_edge", |value, at| at.choice(value, &SWEEP_EDGES))?
            .unwrap_or(usual.sweep_edge),
    })
}

fn rotation_flaw(r: &[[f64; 3]; 3]) -> Option<String> {
    for i in 0..3 {
        for j in 0..3 {
            let dot: f64 = (0..3).map(|k| r[i][k] * r[j][k]).sum();
            let want = if i == j { 1.0 } else { 0.0 };
            if (dot - want).abs() > ROTATION_TOLERANCE {
                return Some(format!("is no rotation: rows {i} and {j} multiply to {dot:.6}, not {want}"));
            }
        }
    }
    let cross =
        |a: [f64; 3], b: [f64; 3]| [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    let third = cross(r[0], r[1]);
    let determinant: f64 = (0..3).map(|k| third[k] * r[2][k]).sum();
    (determinant < 0.0).then(|| "is a mirror image: its determinant is -1".to_string())
}

/// The key in a file beside this one.
fn key(value: &Spanned<DeValue<'_>>, at: &At<'_>) -> Result<Key, Error> {
    let DeValue::String(name) = value.get_ref() else {
        return Err(at.error(value, format!("{} is no file", shown(value.get_ref()))));
    };
    let folder = Path::new(at.source.file).parent().unwrap_or(Path::new(""));
    key::open(&folder.join(name.as_ref())).map(Key).map_err(|error| at.error(value, error.to_string()))
}
