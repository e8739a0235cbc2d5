//! A recording as it grows, and its replay.
//!
//! A folder with `air.pcapng` (every frame as it was heard, for Wireshark and for [`Recording`]), `fixes.csv`, `health.csv`
//! and `room.toml` (the room as it was then). Everything is appended in whole blocks and rows, four times a second and
//! at least every `PENDING` bytes, so that a program that is killed loses a quarter of a second, and every
//! `SYNC` it is made sure that the disk has it, so that a computer that loses its power loses no more than that.
//!
//! What can go wrong: a folder that holds something already; it is not touched. A disk that is full: an error that names the
//! file, and each file ends with its last whole block or row.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{BufReader, ErrorKind};
use std::path::{Path, PathBuf};
use std::thread::{sleep, spawn};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use air::capture;
use anyhow::{Context, Result, ensure};
use pcap_file::DataLink;
use pcap_file::pcapng::PcapNgWriter;
use pcap_file::pcapng::blocks::enhanced_packet::EnhancedPacketBlock;
use pcap_file::pcapng::blocks::interface_description::{InterfaceDescriptionBlock, InterfaceDescriptionOption};

use super::model::{self, Cause, Event, Shared, SourceId, SourceState};
use super::output::{FixRow, Growing, HealthRow, Sink, Table};
use super::source::{Desk, Heard, as_heard, from_its_beginning, seconds};
use crate::trust;

/// Bytes that may wait for the next writing.
const PENDING: usize = 1 << 18;
/// How often frames are written, and how often the disk is asked to be sure.
const WRITE: Duration = Duration::from_millis(250);
const SYNC: Duration = Duration::from_secs(10);
/// The frames.
const AIR: &str = "air.pcapng";
/// The room, if one was given.
const ROOM: &str = "room.toml";
/// Times are in nanoseconds.
const NANOSECONDS: u8 = 9;
/// The longest frame and its TAP header.
const SNAPLEN: u32 = 127 + 28;

/// A recording that grows.
pub struct Recorder {
    dir: PathBuf,
    shared: Shared,
    started: Duration,
    file: Growing,
    air: PcapNgWriter<Vec<u8>>,
    interfaces: BTreeMap<SourceId, u32>,
    fixes: Table,
    health: Table,
    written: Instant,
    synced: Instant,
}

impl Recorder {
    /// Begins one in a folder that is empty or not there; `room` is copied there.
    ///
    /// # Errors
    /// The folder holds something, or nothing can be made there.
    pub fn create(dir: &Path, room: Option<&Path>, shared: Shared) -> Result<Self> {
        vacant(dir)?;
        let name = dir.display();
        fs::create_dir_all(dir).with_context(|| format!("{name}: cannot be made"))?;
        if let Some(room) = room {
            let text = fs::read_to_string(room).with_context(|| room.display().to_string())?;
            let text = trust::with_key_in_place(room, &text);
            Growing::create(&dir.join(ROOM))?.append(text.as_bytes())?;
        }
        let file = Growing::create(&dir.join(AIR))?;
        let now = Instant::now();
        let mut recorder = Self {
            dir: dir.to_owned(),
            shared,
            started: SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default(),
            file,
            air: PcapNgWriter::new(Vec::new()).context("a capture in memory")?,
            interfaces: BTreeMap::new(),
            fixes: Table::create(&dir.join("fixes.csv"))?,
            health: Table::create(&dir.join("health.csv"))?,
            written: now,
            synced: now,
        };
        recorder.write()?;
        Ok(recorder)
    }

    fn interface(&mut self, source: SourceId) -> Result<u32> {
        if let Some(interface) = self.interfaces.get(&source) {
            return Ok(*interface);
        }
        let name = model::lock(&self.shared).source(source).map_or_else(String::new, |source| source.name.clone());
        let options = vec![
            InterfaceDescriptionOption::IfName(Cow::Owned(name)),
            InterfaceDescriptionOption::IfTsResol(NANOSECONDS),
        ];
        let block = InterfaceDescriptionBlock { linktype: DataLink::IEEE802_15_4_TAP, snaplen: SNAPLEN, options };
        self.air.write_pcapng_block(block).context("a block in memory")?;
        let interface = self.interfaces.len() as u32;
        self.interfaces.insert(source, interface);
        Ok(interface)
    }

    fn write(&mut self) -> Result<()> {
        let bytes = std::mem::take(self.air.get_mut());
        self.file.append(&bytes)?;
        self.fixes.write()?;
        self.health.write()?;
        self.written = Instant::now();
        Ok(())
    }

    fn sync(&mut self) -> Result<()> {
        self.file.sync()?;
        self.fixes.sync()?;
        self.health.sync()?;
        self.synced = Instant::now();
        Ok(())
    }
}

impl Sink for Recorder {
    fn frame(&mut self, heard: &Heard) -> Result<()> {
        let Heard::Frame(source, at_s, bytes, signal) = heard else { return Ok(()) };
        let interface_id = self.interface(*source)?;
        let mut data = capture::tap_header(signal.rssi_dbm.map(f32::from), signal.lqi);
        data.extend(bytes);
        let since = Duration::try_from_secs_f64(*at_s).unwrap_or_default();
        let block = EnhancedPacketBlock {
            interface_id,
            timestamp: self.started + since,
            original_len: data.len() as u32,
            data: Cow::Owned(data),
            options: Vec::new(),
        };
        self.air.write_pcapng_block(block).context("a block in memory")?;
        if self.air.get_ref().len() >= PENDING { self.write() } else { Ok(()) }
    }

    fn event(&mut self, event: &Event) -> Result<()> {
        match event {
            Event::Fix(fix) => self.fixes.row(&FixRow::from(fix)),
            Event::Health(news) => self.health.row(&HealthRow::from(news)),
            Event::Angles(_) | Event::Reject(_) => Ok(()),
        }
    }

    fn tick(&mut self) -> Result<()> {
        if self.written.elapsed() >= WRITE {
            self.write()?;
        }
        if self.synced.elapsed() >= SYNC {
            self.sync()?;
        }
        Ok(())
    }

    fn end(&mut self) -> Result<()> {
        self.write()?;
        self.sync()
    }

    fn note(&self) -> Option<String> {
        Some(format!("recording to {} ({:.1} MB)", self.dir.display(), self.file.length() as f64 / 1e6))
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        // Whoever waits for an error has called `end`.
        let _ = self.end();
    }
}

/// Whether a recording may be made there.
///
/// # Errors
/// It holds something, or is a file.
pub fn vacant(dir: &Path) -> Result<()> {
    let name = dir.display();
    match fs::read_dir(dir) {
        Ok(mut entries) => {
            ensure!(
                entries.next().is_none(),
                "{name}: holds something already and is not overwritten; name a new folder"
            );
        }
        Err(error) if error.kind() == ErrorKind::NotFound => {}
        Err(error) => return Err(error).with_context(|| format!("{name}: cannot be a recording's folder")),
    }
    Ok(())
}

/// The room of a recording, if it has one.
#[must_use]
pub fn room(dir: &Path) -> Option<PathBuf> {
    Some(dir.join(ROOM)).filter(|room| room.is_file())
}

/// A recording to show again.
pub struct Recording {
    name: String,
    file: File,
}

impl Recording {
    /// Opens one.
    ///
    /// # Errors
    /// There is none, or it is no capture.
    pub fn open(dir: &Path) -> Result<Self> {
        let path = dir.join(AIR);
        let name = path.display().to_string();
        let file = File::open(&path);
        let file = file.with_context(|| format!("{name}: cannot be read; is that the folder of a recording?"))?;
        let file = from_its_beginning(&name, file)?;
        Ok(Self { name, file })
    }

    /// Says all that it holds, so many times as fast as it happened; 0 as fast as possible.
    pub fn replay(self, desk: Desk, speed: f64) {
        let Self { name, file } = self;
        spawn(move || replay(&desk, &name, file, speed));
    }
}

fn replay(desk: &Desk, name: &str, file: File, speed: f64) {
    let mut sources = BTreeMap::new();
    let mut first = None;
    let ended = capture::records(name, BufReader::new(file), |record| {
        let (id, called) = record.interface;
        let source = *sources.entry(id).or_insert_with(|| {
            let source = desk.add(called.unwrap_or("unnamed"), "replay");
            desk.state(source, SourceState::Open, "");
            source
        });
        let at = record.at.unwrap_or_default();
        let at_s = seconds(*first.get_or_insert(at), at);
        if speed > 0.0 {
            let due_s = at_s / speed;
            while desk.now_s() < due_s && !desk.is_over() {
                sleep(Duration::try_from_secs_f64((due_s - desk.now_s()).clamp(0.0, 0.1)).unwrap_or_default());
            }
        }
        desk.say(as_heard(source, at_s, record))
    });
    let note = match ended {
        Ok(()) => String::new(),
        // What a program that was killed leaves.
        Err(error) => format!("breaks off: {error:#}"),
    };
    if sources.is_empty() || !note.is_empty() {
        let source = sources.values().next().copied().unwrap_or_else(|| desk.add(name, "replay"));
        sources.insert(u32::MAX, source);
        if !note.is_empty() {
            desk.say(Heard::Bad(source, 0.0, Cause::Capture, Vec::new()));
        }
    }
    for source in sources.values() {
        desk.state(*source, SourceState::Ended, note.clone());
    }
}
