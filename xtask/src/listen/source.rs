//! Where frames come from: receivers on serial ports, captures, simulated motes. Each runs in its own thread and says
//! what it hears into one queue.
//!
//! What can go wrong: a receiver is unplugged, is another's, sends rubbish. None of that ends anything: it is written
//! beside the receiver's name, and a port is tried again every second. A damaged capture ends where the damage is.

use std::collections::BTreeSet;
use std::fs::File;
use std::io::{ErrorKind, Read, Seek};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::SyncSender;
use std::thread::{sleep, spawn};
use std::time::{Duration, Instant};

use air::capture::{self, Record};
use air::receiver::{Item, Kind};
use anyhow::{Context, Result, ensure};
use serialport::SerialPortInfo;

use super::model::{self, Cause, Shared, Signal, SourceId, SourceState};
use crate::flash::line::{Line, Trouble};
use crate::flash::port::{self, SEGGER};

/// How captures begin, in either order of bytes: pcap with microseconds, with nanoseconds, pcapng.
const MAGIC: [u32; 5] = [0xa1b2_c3d4, 0xd4c3_b2a1, 0xa1b2_3c4d, 0x4d3c_b2a1, 0x0a0d_0d0a];

/// What a source says.
#[derive(Debug, Clone, PartialEq)]
pub enum Heard {
    /// A frame with its check sequence, heard so many seconds after the start.
    Frame(SourceId, f64, Vec<u8>, Signal),
    /// Something that is none.
    Bad(SourceId, f64, Cause, Vec<u8>),
    /// How the source is now, and why.
    State(SourceId, SourceState, String),
}

/// How long a receiver may take to say something before the thread looks around.
const LOOK: Duration = Duration::from_millis(200);
/// How long after a port went away it is tried again, and how often new ports are looked for.
const AGAIN: Duration = Duration::from_secs(1);
/// Both receivers' own; USB does not mind.
const BAUD: u32 = 115_200;

/// What every source needs.
#[derive(Debug, Clone)]
pub struct Desk {
    /// The motes.
    pub shared: Shared,
    /// Where to say it.
    pub to: SyncSender<Heard>,
    /// Time zero.
    pub started: Instant,
    /// Set when all is over.
    pub enough: Arc<AtomicBool>,
}

impl Desk {
    /// Seconds since the start.
    #[must_use]
    pub fn now_s(&self) -> f64 {
        self.started.elapsed().as_secs_f64()
    }

    pub(super) fn add(&self, name: &str, kind: &'static str) -> SourceId {
        model::lock(&self.shared).add_source(name, kind)
    }

    pub(super) fn is_over(&self) -> bool {
        self.enough.load(Ordering::Relaxed)
    }

    /// False when nobody listens any more.
    pub(super) fn say(&self, heard: Heard) -> bool {
        self.to.send(heard).is_ok() && !self.is_over()
    }

    pub(super) fn state(&self, source: SourceId, state: SourceState, note: impl Into<String>) {
        let _ = self.to.send(Heard::State(source, state, note.into()));
    }
}

/// Which receiver is behind a USB vendor and product.
///
/// Nordic's own sniffer firmware is 1915:154a and 1915:154b; on a development kit the debugger's port is 1366. OpenBase
/// has an FT232R (0403:6001), OpenMote-B an FT2232H (0403:6010).
fn which(vendor: u16, product: u16) -> Option<Kind> {
    match (vendor, product) {
        (0x1915, 0x154A | 0x154B) | (SEGGER, _) => Some(Kind::Nrf),
        (0x0403, 0x6001 | 0x6010) => Some(Kind::Openmote),
        _ => None,
    }
}

/// The receivers that are plugged in: port and kind.
///
/// # Errors
/// The system does not tell its ports.
pub fn receivers() -> Result<Vec<(String, Kind)>> {
    Ok(among(&port::all()?))
}

/// The receivers among `ports`: of a kit's debugger the first port, of a serial converter each.
#[must_use]
pub fn among(ports: &[SerialPortInfo]) -> Vec<(String, Kind)> {
    let found = port::boards(ports, which);
    let (nrf, others): (Vec<_>, Vec<_>) = found.into_iter().partition(|board| board.what == Kind::Nrf);
    port::first_of_each(nrf).into_iter().chain(others).map(|board| (board.port, board.what)).collect()
}

/// What a port that somebody named is, if its USB numbers tell; an nRF Sniffer otherwise.
#[must_use]
pub fn kind_of(name: &str) -> Kind {
    let known = port::all().map(|ports| port::boards(&ports, which)).unwrap_or_default();
    known.into_iter().find(|board| board.port == name).map_or(Kind::Nrf, |board| board.what)
}

/// Listens to a receiver until it is enough, however often that is unplugged.
pub fn listen(desk: Desk, name: String, kind: Kind, channel: u8) {
    let source = desk.add(&name, kind.name());
    spawn(move || {
        let mut was_there = false;
        while !desk.is_over() {
            let gone = match hear(&desk, source, &name, kind, channel, &mut was_there) {
                Ok(()) => return,
                Err(gone) => gone,
            };
            let note = match gone {
                Trouble::NoPort(_) | Trouble::Gone(_) => "not plugged in".to_owned(),
                other => other.to_string(),
            };
            if std::mem::take(&mut was_there)
                && let Some(source) = model::lock(&desk.shared).source(source)
            {
                source.unplugged += 1;
            }
            desk.state(source, SourceState::Waiting, note);
            sleep(AGAIN);
        }
    });
}

fn hear(
    desk: &Desk,
    source: SourceId,
    name: &str,
    kind: Kind,
    channel: u8,
    was_there: &mut bool,
) -> Result<(), Trouble> {
    let mut line = Line::open(name, BAUD)?;
    line.send(&kind.greeting(channel))?;
    *was_there = true;
    desk.state(source, SourceState::Open, "");
    let mut ear = kind.ear();
    let mut bytes = [0; 4096];
    loop {
        let count = line.read(&mut bytes, LOOK)?;
        if desk.is_over() {
            return Ok(());
        }
        let now_s = desk.now_s();
        ear.hear(&bytes[..count], |item| {
            desk.say(match item {
                Item::Frame(bytes, signal) => Heard::Frame(source, now_s, bytes, signal),
                Item::Bad(cause, bytes) => Heard::Bad(source, now_s, cause.into(), bytes),
            });
        });
    }
}

/// Listens to every receiver that is plugged in now or later.
pub fn listen_to_all(desk: Desk, channel: u8) {
    spawn(move || {
        let mut known = BTreeSet::new();
        while !desk.is_over() {
            for (name, kind) in receivers().unwrap_or_default() {
                if known.insert(name.clone()) {
                    listen(desk.clone(), name, kind, channel);
                }
            }
            sleep(AGAIN);
        }
    });
}

/// A capture that can be read.
pub struct Capture {
    name: String,
    from: Box<dyn Read + Send>,
}

impl Capture {
    /// Opens one; `-` is the standard input.
    ///
    /// # Errors
    /// It cannot be opened, or is a file that is no capture.
    pub fn open(path: &Path) -> Result<Self> {
        let name = path.display().to_string();
        if name == "-" {
            return Ok(Self { name, from: Box::new(std::io::stdin()) });
        }
        let file = File::open(path).with_context(|| format!("{name}: cannot be read"))?;
        // A pipe is not looked into before its time.
        if file.metadata().is_ok_and(|about| !about.is_file() && !about.is_dir()) {
            return Ok(Self { name, from: Box::new(file) });
        }
        let file = from_its_beginning(&name, file)?;
        Ok(Self { name, from: Box::new(file) })
    }

    /// Reads it, as fast as it comes; its times are the capture's own.
    pub fn read(self, desk: Desk) {
        read_from(desk, self.name, self.from);
    }
}

/// A file that begins as captures do.
///
/// # Errors
/// It cannot be read, or does not.
pub(super) fn from_its_beginning(name: &str, mut file: File) -> Result<File> {
    let mut magic = [0; 4];
    let is_long = match file.read_exact(&mut magic) {
        Err(error) if error.kind() == ErrorKind::UnexpectedEof => false,
        read => read.map(|()| true).with_context(|| format!("{name}: cannot be read"))?,
    };
    ensure!(is_long && MAGIC.contains(&u32::from_le_bytes(magic)), "{name}: is neither pcap nor pcapng");
    file.rewind().with_context(|| format!("{name}: cannot be read"))?;
    Ok(file)
}

/// Reads a capture from anything.
pub fn read_from(desk: Desk, name: String, from: impl Read + Send + 'static) {
    let source = desk.add(&name, "capture");
    spawn(move || {
        desk.state(source, SourceState::Open, "");
        let mut first = None;
        // One that has several interfaces is several receivers'; the first has the capture's own name.
        let mut interfaces: Vec<(u32, Option<String>, SourceId)> = Vec::new();
        let ended = capture::records(&name, from, |record| {
            let at_s = since(&mut first, desk.now_s(), record);
            let (id, called) = record.interface;
            let known = interfaces.iter().find(|known| known.0 == id && known.1.as_deref() == called);
            let source = match known {
                Some((_, _, source)) => *source,
                // A record that is damaged may name any.
                None if record.frame.is_none() => source,
                None => {
                    let source = match interfaces.is_empty() {
                        true => source,
                        false => {
                            let called = called.map_or_else(|| format!("interface {id}"), str::to_owned);
                            let further = desk.add(&format!("{name}: {called}"), "capture");
                            desk.state(further, SourceState::Open, "");
                            further
                        }
                    };
                    interfaces.push((id, called.map(str::to_owned), source));
                    source
                }
            };
            desk.say(as_heard(source, at_s, record))
        });
        for (_, _, further) in interfaces.iter().skip(1) {
            desk.state(*further, SourceState::Ended, "");
        }
        match ended {
            Ok(()) => desk.state(source, SourceState::Ended, ""),
            Err(error) => {
                let note = format!("{error:#}");
                let note = note.strip_prefix(&format!("{name}: ")).unwrap_or(&note).to_owned();
                desk.say(Heard::Bad(source, desk.now_s(), Cause::Capture, Vec::new()));
                desk.state(source, SourceState::Ended, note);
            }
        }
    });
}

/// A record as a source says it.
pub(super) fn as_heard(source: SourceId, at_s: f64, record: &Record<'_>) -> Heard {
    let signal = Signal { rssi_dbm: record.rssi_dbm.map(|dbm| dbm.round() as i16), lqi: record.lqi };
    match &record.frame {
        Some(frame) => Heard::Frame(source, at_s, frame.to_vec(), signal),
        None => Heard::Bad(source, at_s, Cause::Capture, Vec::new()),
    }
}

/// Seconds since the first frame of the capture, which came at `now_s`; that where the capture has no time.
fn since(first: &mut Option<(Duration, f64)>, now_s: f64, record: &Record<'_>) -> f64 {
    let Some(at) = record.at else { return now_s };
    let (first, from_s) = *first.get_or_insert((at, now_s));
    from_s + seconds(first, at)
}

/// Seconds from one time to another, which may lie before it. Of the difference: since 1970 so many seconds have passed
/// that 52 bits of them leave 0.24 us.
pub(super) fn seconds(from: Duration, to: Duration) -> f64 {
    let apart_s = from.abs_diff(to).as_secs_f64();
    if to < from { -apart_s } else { apart_s }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_capture_of_today_keeps_its_nanoseconds() {
        let begun = Duration::from_secs(1_760_000_000);
        let mut first = None;
        let mut at_s = |at| {
            let record = Record { at: Some(at), interface: (0, None), frame: None, rssi_dbm: None, lqi: None };
            since(&mut first, 0.0, &record)
        };
        assert_eq!(at_s(begun), 0.0);
        assert_eq!(at_s(begun + Duration::from_nanos(14_590_000)), 0.014_59);
        assert_eq!(at_s(begun + Duration::from_nanos(3_600_000_000_007)), 3_600.000_000_007);
        // What came before the first, as in captures of several receivers.
        assert_eq!(at_s(begun - Duration::from_nanos(250)), -250e-9);
    }
}
