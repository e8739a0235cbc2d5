//! What is known of every mote, from the frames that were heard.
//!
//! [`Swarm`] takes frames as they come, from any number of receivers, at times that the caller names: a recording is
//! shown by the same code as the air. Every view (terminal, page, JSON lines, broker) shows a [`Snapshot`] of it or
//! passes on its [`Event`]s, and none keeps a state of its own. Both serialise to JSON whose fields `docs/listening.md`
//! lists; a field is added, never renamed or given another unit, while [`FORMAT`] stays.
//!
//! # Design
//! A frame that several receivers heard counts once: it is the same mote, the same sequence and the same bytes. Gaps in
//! the sequence are losses, until a late frame fills them.
//!
//! Who speaks is told by more than the mote id, for somebody will flash two motes alike. Frames of one id whose sequences
//! or clocks do not continue each other are separate voices. When the older voice is heard again after the newer one,
//! there are two motes and both are flagged; when it falls silent, the mote has started anew. Where there is a key, of two
//! motes that count far apart only the one ahead is believed ([`crate::trust`]), and it is flagged.
//!
//! What can go wrong: more motes than fit; the one that was silent longest is forgotten. Memory does not grow.

use std::collections::{BTreeMap, VecDeque};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

pub use air::receiver::Signal;

use air::receiver::Damage;
use anyhow::Result;
use lighthouse_mote::frame::{
    self, Angles, Factory, Header, Health, Level, Lock, Message, Reject, Rejects, Report, Reset,
};
use serde::Serialize;

use crate::calib::{Calibration, schema};
use crate::light::HALF_TURN_S;
use crate::trust::{self, Guard, Refusal};

/// Of the JSON: raised when a field changes its meaning.
pub const FORMAT: u32 = 1;
/// Motes that are kept: four times the swarm this is measured with.
pub const MOTES: usize = 4096;
/// Receivers that are kept.
pub const SOURCES: usize = 64;
/// Motes that are not believed, of which is told at a time.
pub const REFUSED: usize = 8;
/// Points of a mote's trail: 25 s of them.
pub const TRAIL: usize = 256;
/// Shortest time between two points of a trail, seconds.
const TRAIL_EVERY_S: f64 = 0.1;
/// Voices of one id at a time.
const VOICES: usize = 4;
/// How far back a frame is still known, in sequences: other receivers are late by less.
const REMEMBERED: i16 = 64;
/// Frames a mote can send in a second, with room: each of 120 sweeps a report.
const FASTEST_PER_S: f64 = 250.0;
/// A mote's clock may run ahead of the arrivals by so much before it looks like another mote's, seconds.
const CLOCK_SLACK_S: f64 = 2.0;
/// A frame that fills a gap is older than the newest by no more, seconds.
const LATE_S: f64 = 10.0;
/// Ticks wrap; over a longer silence they say nothing, seconds: 2^31 of them at 12 MHz.
const CLOCK_HOLDS_S: f64 = 170.0;
/// A mote whose older voice is silent so long after a newer one began has started anew, seconds: twice the time between
/// health frames, and some.
const RESTART_S: f64 = 2.5;
/// Arrivals from which a rate is made, and how far back they may lie, seconds.
const ARRIVALS: usize = 64;
const RATE_OVER_S: f64 = 3.0;

/// The kind of a source whose motes are simulated.
pub const SIMULATION: &str = "simulation";

/// Everything that was heard, shared between the ear and the views.
pub type Shared = Arc<Mutex<Swarm>>;

/// The swarm, whoever else stumbled over it.
pub fn lock(shared: &Shared) -> MutexGuard<'_, Swarm> {
    shared.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Which receiver: an index into [`Snapshot::sources`].
pub type SourceId = usize;

/// Why something that was received is not shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Cause {
    /// The length is not that of its kind.
    Length,
    /// The frame check sequence does not fit.
    Fcs,
    /// Another network's frame type, addressing or destination.
    Header,
    /// Another protocol's payload.
    Magic,
    /// A version this program does not know.
    Version,
    /// A kind of report this program does not know.
    Kind,
    /// The source address is not the mote id.
    Mote,
    /// Level or stations that make no sense.
    Level,
    /// A code that means nothing.
    Code,
    /// Something between frames that the receiver's protocol does not have.
    Line,
    /// An HDLC frame whose check sequence or stuffing is wrong.
    Hdlc,
    /// A record of a capture that cannot be read.
    Capture,
    /// The message integrity code does not fit: forged, or another room's key.
    Mic,
    /// A frame sent once more, or an old one.
    Replayed,
    /// Without a message integrity code where one is asked for.
    Unsecured,
    /// With one, and nobody gave us the key.
    NoKey,
}

impl Cause {
    /// All of them, in the order in which they are shown.
    pub const ALL: [Self; 16] = [
        Self::Length,
        Self::Fcs,
        Self::Header,
        Self::Magic,
        Self::Version,
        Self::Kind,
        Self::Mote,
        Self::Level,
        Self::Code,
        Self::Line,
        Self::Hdlc,
        Self::Capture,
        Self::Mic,
        Self::Replayed,
        Self::Unsecured,
        Self::NoKey,
    ];

    /// For people: what it was.
    #[must_use]
    pub fn words(self) -> &'static str {
        match self {
            Self::Length => "not the length of a report",
            Self::Fcs => "check sequence wrong",
            Self::Header => "another network's frame",
            Self::Magic => "another protocol's payload",
            Self::Version => "unknown version",
            Self::Kind => "unknown kind of report",
            Self::Mote => "source is not the mote id",
            Self::Level => "level makes no sense",
            Self::Code => "code means nothing",
            Self::Line => "bad bytes from the receiver",
            Self::Hdlc => "HDLC check sequence wrong",
            Self::Capture => "damaged capture record",
            Self::Mic => "integrity code wrong",
            Self::Replayed => "replayed",
            Self::Unsecured => "no integrity code",
            Self::NoKey => "no key to check it with",
        }
    }
}

impl From<Reject> for Cause {
    fn from(reject: Reject) -> Self {
        match reject {
            Reject::Length => Self::Length,
            Reject::Fcs => Self::Fcs,
            Reject::Header => Self::Header,
            Reject::Magic => Self::Magic,
            Reject::Version => Self::Version,
            Reject::Kind => Self::Kind,
            Reject::Mote => Self::Mote,
            Reject::Level => Self::Level,
            Reject::Code => Self::Code,
        }
    }
}

impl From<Damage> for Cause {
    fn from(damage: Damage) -> Self {
        match damage {
            Damage::Fcs => Self::Fcs,
            Damage::Line => Self::Line,
            Damage::Hdlc => Self::Hdlc,
        }
    }
}

impl From<Refusal> for Cause {
    fn from(refusal: Refusal) -> Self {
        match refusal {
            Refusal::NotOurs(reject) => reject.into(),
            Refusal::Unsecured => Self::Unsecured,
            Refusal::NoKey => Self::NoKey,
            Refusal::Forged => Self::Mic,
            Refusal::Duplicate | Refusal::Replayed { .. } => Self::Replayed,
        }
    }
}

/// Who speaks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
pub struct Key {
    /// The personal area network.
    pub pan: u16,
    /// The mote's short address.
    pub mote: u16,
    /// 0, but for further motes that use the same address.
    pub twin: u8,
}

/// `4c48/1`: PAN in hexadecimal, mote in decimal; `4c48/1.1` for the first other mote with that id.
impl std::fmt::Display for Key {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:04x}/{}", self.pan, self.mote)?;
        if self.twin > 0 {
            write!(f, ".{}", self.twin)?;
        }
        Ok(())
    }
}

/// What came of one thing that was received.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum Event {
    /// A position.
    Fix(Fix),
    /// How a mote is.
    Health(HealthNews),
    /// Angles as measured.
    Angles(AnglesNews),
    /// Something that is not shown.
    Reject(Rejected),
}

/// Who, when, through which receiver.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Origin {
    /// Seconds since the start of the listening or, of a capture, of its first frame.
    pub time_s: f64,
    /// Name of the receiver that had it first.
    pub source: String,
    /// [`Key`] as text.
    pub key: String,
    /// The personal area network.
    pub pan: u16,
    /// The mote's short address.
    pub mote: u16,
    /// 0, but for further motes that use the same address.
    pub twin: u8,
    /// Number of the report, wrapping at 65536.
    pub sequence: u16,
    /// How well it was heard.
    #[serde(flatten)]
    pub signal: Signal,
}

/// A position and how good it is. What is unknown is null.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Fix {
    /// Whose.
    #[serde(flatten)]
    pub origin: Origin,
    /// Time of the fix in ticks of the mote, wrapping.
    pub mote_ticks: u32,
    /// How much is known: `none`, `angles`, `tracked`, `full`.
    pub level: &'static str,
    /// World x, y, z, metres; none below `tracked`.
    pub position_m: Option<[f64; 3]>,
    /// World x, y, z, metres per second; likewise.
    pub velocity_m_per_s: Option<[f64; 3]>,
    /// Standard deviation per axis, metres; none where the mote does not say.
    pub sd_m: Option<[f64; 3]>,
    /// How far the two stations' rays pass each other, metres.
    pub mismatch_m: f64,
    /// Age of the oldest angle used, seconds.
    pub angle_age_s: f64,
    /// Stations that gave an angle lately: A, B.
    pub stations_seen: [bool; 2],
}

/// How a mote is.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct HealthNews {
    /// Whose.
    #[serde(flatten)]
    pub origin: Origin,
    /// What it says.
    #[serde(flatten)]
    pub condition: Condition,
}

/// Angles as measured.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct AnglesNews {
    /// Whose.
    #[serde(flatten)]
    pub origin: Origin,
    /// The sweeps, oldest first.
    pub sweeps: Vec<Sweep>,
}

/// One laser plane that passed.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Sweep {
    /// When, ticks of the mote, wrapping.
    pub mote_ticks: u32,
    /// `A` or `B`.
    pub station: char,
    /// `azimuth` or `elevation`.
    pub axis: &'static str,
    /// From straight ahead, radians, before any factory term.
    pub angle_rad: f64,
}

/// Something that is not shown.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Rejected {
    /// When, as in [`Origin::time_s`].
    pub time_s: f64,
    /// Name of the receiver.
    pub source: String,
    /// Why.
    pub cause: Cause,
    /// The bytes in hexadecimal, 127 of them at most.
    pub bytes: String,
}

/// What a health frame says, for people.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Condition {
    /// `no_light`, `searching`, `locked`, `one_station`, `spacing`, `widths`, `v2`.
    pub lock: &'static str,
    /// Why there is no lock, a sentence; none when locked.
    pub lock_reason: Option<&'static str>,
    /// The rate of its clock as measured by the light, Hz; none without a lock.
    pub clock_hz: Option<f64>,
    /// Seconds since it started.
    pub uptime_s: u32,
    /// Why it last started: `power_on`, `requested`, `fault`, `panic`, `watchdog`, `damaged_image`.
    pub reset: &'static str,
    /// Program counter of a fault, line of a panic.
    pub reset_detail: Option<u32>,
    /// Stations A and B as it knows them.
    pub stations: [StationNews; 2],
    /// What it turned away since start-up, by cause, each wrapping at 65536.
    pub rejects: BTreeMap<&'static str, u16>,
    /// The most that ever waited in its queues of pulses, sightings and reports.
    pub waiting: [u8; 3],
}

/// A station as a mote knows it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct StationNews {
    /// Serial number as the station sends it; none while unknown.
    pub id: Option<u32>,
    /// Channel of the station: `A`, `B`, `C`; none while unknown.
    pub mode: Option<char>,
    /// Its own fault flags, 0 when well.
    pub faults: u8,
    /// Not the one in the room's file: the stations may have been swapped.
    pub is_stranger: bool,
    /// Whose factory terms are in use: `file`, `awaited`, `received`.
    pub factory: &'static str,
    /// Flashes understood, wrapping.
    pub flashes: u16,
    /// Sweeps understood of the azimuth and the elevation rotor, wrapping.
    pub sweeps: [u16; 2],
    /// How much longer than nominal its flashes look, seconds.
    pub width_bias_s: f64,
}

/// One receiver.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SourceNews {
    /// What it is called: a port, a file.
    pub name: String,
    /// `nrf`, `openmote`, `capture`, `simulation`, `replay`.
    pub kind: &'static str,
    /// `waiting`, `open`, `ended`.
    pub state: SourceState,
    /// What is to be said of its state; empty when all is well.
    pub note: String,
    /// Frames it handed over, good or not.
    pub frames: u64,
    /// Those of them, and other things, that were rejected.
    pub rejected: u64,
    /// Bytes that belong to no frame.
    pub bad_bytes: u64,
    /// How often it went away.
    pub unplugged: u64,
}

/// Whether a receiver is there.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum SourceState {
    /// Not there, or silent since it was opened; it is tried again.
    Waiting,
    /// Frames may come.
    Open,
    /// It has said all.
    Ended,
}

/// The room, for views.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RoomNews {
    /// The file it comes from.
    pub name: String,
    /// The declared volume's lowest corner, metres; none where none is declared.
    pub min_m: Option<[f64; 3]>,
    /// Its highest corner.
    pub max_m: Option<[f64; 3]>,
    /// Stations A and B.
    pub stations: [StationPose; 2],
}

/// Where a station is.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct StationPose {
    /// `A` or `B`.
    pub name: char,
    /// World x, y, z, metres.
    pub position_m: [f64; 3],
    /// World to station, row by row: c = R (p - position); x right, y up, z where it looks.
    pub rotation: [[f64; 3]; 3],
    /// Serial number, if the file knows it.
    pub id: Option<u32>,
}

impl RoomNews {
    /// The room of a calibration file.
    ///
    /// # Errors
    /// It cannot be read; file, line and field are named.
    pub fn open(path: &Path) -> Result<Self> {
        Ok(Self::of(&path.display().to_string(), &schema::open(path)?))
    }

    /// The same from what was read already.
    #[must_use]
    pub fn of(name: &str, calibration: &Calibration) -> Self {
        let pose = |index: usize, name| {
            let station = &calibration.stations[index];
            StationPose { name, position_m: station.position, rotation: station.rotation, id: station.id }
        };
        Self {
            name: name.to_owned(),
            min_m: calibration.room.map(|room| room.min),
            max_m: calibration.room.map(|room| room.max),
            stations: [pose(0, 'A'), pose(1, 'B')],
        }
    }
}

/// One mote, as views show it. What is unknown is null.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MoteNews {
    /// [`Key`] as text: unique.
    pub key: String,
    /// The personal area network.
    pub pan: u16,
    /// The mote's short address.
    pub mote: u16,
    /// 0, but for further motes that use the same address.
    pub twin: u8,
    /// Another mote uses the same address.
    pub is_conflict: bool,
    /// Frames of this address with older counters rise as another mote's would, and are refused: there is one, or somebody
    /// sends old ones again.
    pub has_refused_twin: bool,
    /// Indices into [`Snapshot::sources`]: who heard it in the last seconds, the best first.
    pub sources: Vec<SourceId>,
    /// Of the last frame.
    #[serde(flatten)]
    pub signal: Signal,
    /// Seconds since its last frame.
    pub silent_s: f64,
    /// Sequence of its newest frame.
    pub sequence: u16,
    /// Its last report; none before the first.
    pub fix: Option<MoteFix>,
    /// Its last health frame.
    pub condition: Option<Condition>,
    /// Reports of positions a second, lately.
    pub fixes_per_s: f64,
    /// Frames heard, each once.
    pub frames: u64,
    /// Frames not heard, from gaps in the sequence.
    pub lost: u64,
    /// Frames heard again, by another receiver as a rule.
    pub duplicates: u64,
    /// Frames that came after a later one.
    pub late: u64,
    /// Times it started anew while being listened to.
    pub restarts: u64,
    /// What it lost itself since start-up, each wrapping at 65536; none before the first report.
    pub own_losses: Option<OwnLosses>,
    /// Where it was: seconds, x, y, z in metres; oldest first.
    pub trail: Vec<[f32; 4]>,
}

/// The last report.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct MoteFix {
    /// Seconds ago.
    pub ago_s: f64,
    /// Of its frame; other frames may have come after it.
    pub sequence: u16,
    /// `none`, `angles`, `tracked`, `full`.
    pub level: &'static str,
    /// World x, y, z, metres; none below `tracked`.
    pub position_m: Option<[f64; 3]>,
    /// World x, y, z, metres per second; likewise.
    pub velocity_m_per_s: Option<[f64; 3]>,
    /// The length of that.
    pub speed_m_per_s: Option<f64>,
    /// Standard deviation per axis, metres; none where the mote does not say.
    pub sd_m: Option<[f64; 3]>,
    /// How far the two stations' rays pass each other, metres.
    pub mismatch_m: f64,
    /// Age of the oldest angle used, seconds.
    pub angle_age_s: f64,
    /// Stations that gave an angle lately: A, B.
    pub stations_seen: [bool; 2],
}

/// What a mote lost between light and air.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct OwnLosses {
    /// Edges.
    pub edges: u16,
    /// Pulses that fit no window.
    pub pulses: u16,
    /// Sweeps outside the field of view.
    pub sweeps: u16,
    /// Fixes and sweeps refused.
    pub fixes: u16,
    /// Reports.
    pub reports: u16,
}

/// A mote that is not believed, for its frames are older than others of its id: it counts anew, or is another's twin, or its
/// old frames are sent again.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RefusedMote {
    /// [`Key`] as text.
    pub key: String,
    /// The personal area network.
    pub pan: u16,
    /// The mote's short address.
    pub mote: u16,
    /// Newer frames come between those that are refused.
    pub is_twin: bool,
    /// Counter of the last that was refused.
    pub counter: u32,
    /// The largest that was believed.
    pub latest: u32,
    /// How many were refused, each with a larger counter than the one before.
    pub frames: u64,
    /// Seconds since the last.
    pub silent_s: f64,
    /// For people: what it was, and what to do.
    pub note: String,
}

impl RefusedMote {
    fn of(behind: trust::Behind, now_s: f64) -> Self {
        let trust::Behind { pan, mote, is_twin, counter, latest, frames, at_s } = behind;
        let key = Key { pan, mote, twin: 0 }.to_string();
        let why =
            if is_twin { "another mote says that it is this one" } else { "it counts anew, or another has its id" };
        let note = format!(
            "frames of {key} are refused, counter {counter} after {latest}: {why}, or old ones are sent again; \
             program it again with an id of its own"
        );
        Self { key, pan, mote, is_twin, counter, latest, frames, silent_s: now_s - at_s, note }
    }

    fn is_recent(&self) -> bool {
        self.silent_s <= trust::STREAM_S
    }
}

/// All that is known at one moment.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Snapshot {
    /// [`FORMAT`].
    pub format: u32,
    /// Seconds since the start, as in [`Origin::time_s`].
    pub time_s: f64,
    /// The room, if one is known.
    pub room: Option<RoomNews>,
    /// The receivers.
    pub sources: Vec<SourceNews>,
    /// Frames handed over by all receivers, good or not, duplicates included.
    pub frames: u64,
    /// Frames that more than one receiver heard, counted once for each further receiver.
    pub duplicates: u64,
    /// What was rejected, by cause; causes that never occurred are left out.
    pub rejects: BTreeMap<Cause, u64>,
    /// Motes whose frames are refused for their counters, although these rise; [`REFUSED`] of them, twins first, then those
    /// that were heard last.
    pub refused_motes: Vec<RefusedMote>,
    /// Motes that were forgotten for want of room.
    pub forgotten: u64,
    /// The motes, by PAN, address and twin.
    pub motes: Vec<MoteNews>,
}

impl Snapshot {
    /// Of the motes that are being refused now, in a line, however many there are.
    #[must_use]
    pub fn refusals(&self) -> Option<String> {
        let mut now = self.refused_motes.iter().filter(|refused| refused.is_recent());
        let first = now.next()?;
        Some(match now.count() {
            0 => first.note.clone(),
            others => format!("{}; and so are {others} others or more", first.note),
        })
    }
}

/// Everything that was heard. See the module.
#[derive(Debug, Default)]
pub struct Swarm {
    now_s: f64,
    room: Option<RoomNews>,
    sources: Vec<SourceNews>,
    frames: u64,
    duplicates: u64,
    rejects: BTreeMap<Cause, u64>,
    forgotten: u64,
    ids: BTreeMap<(u16, u16), Vec<Voice>>,
    voices: usize,
    /// Who is believed.
    guard: Guard,
    /// The same for motes that are simulated: they count from zero each time, and nobody's counters are theirs.
    simulated: Guard,
}

impl Swarm {
    /// Nothing heard yet.
    #[must_use]
    pub fn new(room: Option<RoomNews>) -> Self {
        Self { room, ..Self::default() }
    }

    /// Believes frames under the room's key alone, if there is one.
    pub fn under(&mut self, key: Option<[u8; 16]>) {
        (self.guard, self.simulated) = (Guard::new(key), Guard::new(key));
    }

    /// Who decides which frames from the air are believed.
    pub(super) fn guard_mut(&mut self) -> &mut Guard {
        &mut self.guard
    }

    /// A receiver of that name, known from now on. Beyond [`SOURCES`] they share the last place.
    pub fn add_source(&mut self, name: &str, kind: &'static str) -> SourceId {
        if self.sources.len() >= SOURCES {
            return SOURCES - 1;
        }
        self.sources.push(SourceNews {
            name: name.to_owned(),
            kind,
            state: SourceState::Waiting,
            note: String::new(),
            frames: 0,
            rejected: 0,
            bad_bytes: 0,
            unplugged: 0,
        });
        self.sources.len() - 1
    }

    /// The receiver's own account, to be changed by whoever runs it.
    pub fn source(&mut self, source: SourceId) -> Option<&mut SourceNews> {
        self.sources.get_mut(source)
    }

    /// The room, if one is known.
    #[must_use]
    pub fn room(&self) -> Option<&RoomNews> {
        self.room.as_ref()
    }

    /// The time of whatever comes next; never runs backwards.
    pub fn pass(&mut self, now_s: f64) {
        if now_s > self.now_s {
            self.now_s = now_s;
        }
    }

    /// A frame, check sequence included. None if it was heard already.
    pub fn hear(&mut self, at_s: f64, source: SourceId, bytes: &[u8], signal: Signal) -> Option<Event> {
        let is_simulated = self.sources.get(source).is_some_and(|source| source.kind == SIMULATION);
        let guard = if is_simulated { &mut self.simulated } else { &mut self.guard };
        let opened = match guard.hear(at_s, source, bytes) {
            // Another receiver has heard it.
            Err(Refusal::Duplicate) => {
                self.pass(at_s);
                self.frames += 1;
                self.duplicates += 1;
                if let Some(source) = self.sources.get_mut(source) {
                    source.frames += 1;
                }
                return None;
            }
            opened => opened.map_err(Cause::from),
        };
        self.take(at_s, source, bytes, signal, opened)
    }

    /// The same where the frame was taken apart elsewhere: `bytes` are as they were on the air.
    pub fn take(
        &mut self,
        at_s: f64,
        source: SourceId,
        bytes: &[u8],
        signal: Signal,
        opened: Result<(Header, Message), Cause>,
    ) -> Option<Event> {
        self.pass(at_s);
        self.frames += 1;
        if let Some(source) = self.sources.get_mut(source) {
            source.frames += 1;
        }
        match opened {
            Err(cause) => Some(self.reject(at_s, source, cause, bytes)),
            Ok((header, message)) => self.accept(at_s, source, signal, header, &message, digest(bytes)),
        }
    }

    /// Counts something that is not shown: a frame, or what was to be one.
    pub fn reject(&mut self, at_s: f64, source: SourceId, cause: Cause, bytes: &[u8]) -> Event {
        self.pass(at_s);
        *self.rejects.entry(cause).or_default() += 1;
        if let Some(source) = self.sources.get_mut(source) {
            source.rejected += 1;
        }
        let bytes = hex::encode(&bytes[..bytes.len().min(127)]);
        Event::Reject(Rejected { time_s: at_s, source: self.name(source), cause, bytes })
    }

    fn name(&self, source: SourceId) -> String {
        self.sources.get(source).map_or_else(String::new, |source| source.name.clone())
    }

    fn accept(
        &mut self,
        at_s: f64,
        source: SourceId,
        signal: Signal,
        header: Header,
        message: &Message,
        digest: u64,
    ) -> Option<Event> {
        let id = (header.pan, header.mote);
        let said = Said { at_s, sequence: header.sequence, digest, clock: Reading::of(message) };
        let voices = self.ids.entry(id).or_default();
        let fits = |voice: &Voice| voice.fit(&said);
        let best = voices
            .iter()
            .enumerate()
            .filter_map(|(index, voice)| Some((fits(voice)?, index)))
            .min_by(|(one, _), (other, _)| one.order().total_cmp(&other.order()));
        let (index, fit) = match best {
            Some((fit, index)) => (index, fit),
            None => {
                if voices.len() >= VOICES
                    && let Some(oldest) = oldest(voices)
                {
                    voices.remove(oldest);
                    self.voices -= 1;
                }
                // The first voice of an id is a mote. Another may be the same mote after a restart, until the first is
                // heard again.
                voices.push(Voice::new(&said, voices.is_empty()));
                self.voices += 1;
                (voices.len() - 1, Fit::First)
            }
        };
        if let Fit::Again = fit {
            let voice = &mut voices[index];
            voice.duplicates += 1;
            voice.heard_by(source, at_s, signal);
            self.duplicates += 1;
            return None;
        }
        voices[index].say(&said, fit);
        settle(voices, index, at_s);
        // Whoever took another's place stands where that one stood.
        let index = voices.iter().position(|voice| voice.knows(&said)).unwrap_or(0);
        let twin = voices.iter().take(index).filter(|voice| voice.is_mote).count() as u8;
        let voice = &mut voices[index];
        voice.heard_by(source, at_s, signal);
        voice.learn(at_s, message, matches!(fit, Fit::Late(_)));
        let key = Key { pan: header.pan, mote: header.mote, twin };
        if self.voices > MOTES {
            self.forget();
        }
        let origin = Origin {
            time_s: at_s,
            source: self.name(source),
            key: key.to_string(),
            pan: key.pan,
            mote: key.mote,
            twin,
            sequence: header.sequence,
            signal,
        };
        Some(match message {
            Message::Fix(report) => Event::Fix(fix(origin, report)),
            Message::Health(health) => Event::Health(HealthNews { origin, condition: condition(health) }),
            Message::Angles(angles) => Event::Angles(AnglesNews { origin, sweeps: sweeps(angles) }),
        })
    }

    /// Drops the voice that was silent longest.
    fn forget(&mut self) {
        let longest = self
            .ids
            .iter()
            .filter_map(|(id, voices)| oldest(voices).map(|index| (voices[index].heard_s, *id, index)))
            .min_by(|one, other| one.0.total_cmp(&other.0));
        if let Some((_, id, index)) = longest
            && let Some(voices) = self.ids.get_mut(&id)
        {
            voices.remove(index);
            self.voices -= 1;
            self.forgotten += 1;
            if voices.is_empty() {
                self.ids.remove(&id);
            }
        }
    }

    /// All that is known now, with at most so many points of each trail, the newest.
    #[must_use]
    pub fn snapshot(&self, trail: usize) -> Snapshot {
        let mut motes = Vec::with_capacity(self.voices);
        for (&(pan, mote), voices) in &self.ids {
            let doubts = self.doubts(pan, mote, voices);
            for (twin, voice) in voices.iter().filter(|voice| voice.is_mote).enumerate() {
                let key = Key { pan, mote, twin: twin as u8 };
                motes.push(voice.news(key, doubts, self.now_s, trail));
            }
        }
        let mut refused_motes: Vec<_> = self.guard.behind().map(|behind| RefusedMote::of(behind, self.now_s)).collect();
        refused_motes
            .sort_by(|one, other| other.is_twin.cmp(&one.is_twin).then(one.silent_s.total_cmp(&other.silent_s)));
        refused_motes.truncate(REFUSED);
        Snapshot {
            format: FORMAT,
            time_s: self.now_s,
            room: self.room.clone(),
            sources: self.sources.clone(),
            frames: self.frames,
            duplicates: self.duplicates,
            rejects: self.rejects.clone(),
            refused_motes,
            forgotten: self.forgotten,
            motes,
        }
    }

    /// The mote of that key alone.
    #[must_use]
    pub fn mote(&self, pan: u16, mote: u16, twin: u8, trail: usize) -> Option<MoteNews> {
        let voices = self.ids.get(&(pan, mote))?;
        let doubts = self.doubts(pan, mote, voices);
        let voice = voices.iter().filter(|voice| voice.is_mote).nth(twin.into())?;
        Some(voice.news(Key { pan, mote, twin }, doubts, self.now_s, trail))
    }

    fn doubts(&self, pan: u16, mote: u16, voices: &[Voice]) -> Doubts {
        let refused = self.guard.behind_of(pan, mote).map(|behind| RefusedMote::of(behind, self.now_s));
        Doubts {
            is_conflict: voices.iter().filter(|voice| voice.is_mote).count() > 1,
            has_refused_twin: refused.is_some_and(|refused| refused.is_twin && refused.is_recent()),
        }
    }
}

/// Whether an address is one mote's.
#[derive(Debug, Clone, Copy)]
struct Doubts {
    is_conflict: bool,
    has_refused_twin: bool,
}

fn digest(bytes: &[u8]) -> u64 {
    let mut hasher = DefaultHasher::new();
    bytes.hash(&mut hasher);
    hasher.finish()
}

fn oldest(voices: &[Voice]) -> Option<usize> {
    let silent = |index: &usize| voices[*index].heard_s;
    (0..voices.len()).min_by(|one, other| silent(one).total_cmp(&silent(other)))
}

/// Decides what a voice that is no mote yet is, after the one at `spoke` was heard: a twin, or the mote started anew.
fn settle(voices: &mut Vec<Voice>, spoke: usize, at_s: f64) {
    if voices.len() < 2 {
        return;
    }
    // Another voice that speaks between two frames of this one is another mote, once that happens again.
    for (other, voice) in voices.iter_mut().enumerate() {
        if other != spoke && !voice.is_mote && voice.news >= 2 {
            voice.interrupted += 1;
        }
    }
    if let Some(twin) = voices.iter_mut().find(|voice| !voice.is_mote && voice.interrupted >= 2 && voice.news >= 3) {
        twin.is_mote = true;
        return;
    }
    let speaking = &voices[spoke];
    if speaking.is_mote || speaking.news < 3 || at_s - speaking.began_s < RESTART_S {
        return;
    }
    // The one whose silence began last before the new voice did: it has become this one.
    let began_s = speaking.began_s;
    let before = (0..voices.len())
        .filter(|index| *index != spoke && voices[*index].is_mote && voices[*index].fresh_s <= began_s)
        .max_by(|one, other| voices[*one].fresh_s.total_cmp(&voices[*other].fresh_s));
    let Some(before) = before else {
        voices[spoke].is_mote = true;
        return;
    };
    let mut new = voices[spoke].clone();
    new.follow(&voices[before]);
    voices[before] = new;
    voices.remove(spoke);
}

/// What a frame says of who sent it.
#[derive(Debug, Clone, Copy)]
struct Said {
    at_s: f64,
    sequence: u16,
    digest: u64,
    clock: Reading,
}

/// A reading of the mote's clock.
#[derive(Debug, Clone, Copy)]
enum Reading {
    /// Ticks, and ticks a second; 0 while unknown.
    Ticks(u32, f64),
    /// Seconds since it started, whole ones.
    Uptime(u32),
    None,
}

impl Reading {
    fn of(message: &Message) -> Self {
        match message {
            Message::Fix(report) => Self::Ticks(report.time, clock_hz(report.half_turn_q8).unwrap_or(0.0)),
            Message::Health(health) => Self::Uptime(health.uptime),
            Message::Angles(angles) => angles
                .sweeps
                .last()
                .map_or(Self::None, |last| Self::Ticks(last.time, clock_hz(angles.half_turn_q8).unwrap_or(0.0))),
        }
    }
}

/// Ticks a second from a half turn of 8.333 ms; none for zero.
fn clock_hz(half_turn_q8: u32) -> Option<f64> {
    (half_turn_q8 > 0).then(|| f64::from(half_turn_q8) / 256.0 / HALF_TURN_S)
}

/// How a frame continues a voice.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Fit {
    /// It begins one.
    First,
    /// It was heard already.
    Again,
    /// It comes after the newest, so many sequences later; how far the clock is off, seconds.
    Next(i16, f64),
    /// It fills a gap; how far the clock is off, seconds.
    Late(f64),
}

impl Fit {
    /// The smaller, the likelier.
    fn order(self) -> f64 {
        match self {
            Self::Again => -1.0,
            Self::First => 0.0,
            // Between clocks that fit alike, the nearer sequence.
            Self::Next(ahead, off_s) => off_s + 1e-4 * f64::from(ahead),
            Self::Late(off_s) => off_s + 0.01,
        }
    }
}

/// One transmitter, as far as frames tell.
#[derive(Debug, Clone)]
struct Voice {
    /// Shown. Else it may be another's restart.
    is_mote: bool,
    began_s: f64,
    heard_s: f64,
    /// When its last frame came that was none of the late ones.
    fresh_s: f64,
    newest: u16,
    /// Of the last sequences, oldest first.
    known: VecDeque<(u16, u64)>,
    ticks: Option<(f64, u32, f64)>,
    uptime: Option<(f64, u32)>,
    /// Frames since it began, and how often another voice was heard between two of them.
    news: u64,
    interrupted: u64,
    frames: u64,
    lost: u64,
    duplicates: u64,
    late: u64,
    restarts: u64,
    signal: Signal,
    ears: Vec<(SourceId, f64, Signal)>,
    arrivals: VecDeque<f64>,
    /// When it came, its sequence, what it says.
    fix: Option<(f64, u16, Report)>,
    health: Option<Health>,
    trail: VecDeque<[f32; 4]>,
}

impl Voice {
    fn new(said: &Said, is_mote: bool) -> Self {
        Self {
            is_mote,
            began_s: said.at_s,
            heard_s: said.at_s,
            fresh_s: said.at_s,
            newest: said.sequence,
            known: VecDeque::new(),
            ticks: None,
            uptime: None,
            news: 0,
            interrupted: 0,
            frames: 0,
            lost: 0,
            duplicates: 0,
            late: 0,
            restarts: 0,
            signal: Signal::default(),
            ears: Vec::new(),
            arrivals: VecDeque::new(),
            fix: None,
            health: None,
            trail: VecDeque::new(),
        }
    }

    fn knows(&self, said: &Said) -> bool {
        self.known.iter().rev().any(|known| *known == (said.sequence, said.digest))
    }

    /// Whether the frame can be the same transmitter's.
    fn fit(&self, said: &Said) -> Option<Fit> {
        let ahead = said.sequence.wrapping_sub(self.newest).cast_signed();
        if ahead <= 0 && ahead > -REMEMBERED {
            if let Some((_, digest)) = self.known.iter().rev().find(|known| known.0 == said.sequence) {
                return (*digest == said.digest).then_some(Fit::Again);
            }
            return self.clock_off(said, -LATE_S).map(Fit::Late);
        }
        let most = f64::from(REMEMBERED) + FASTEST_PER_S * (said.at_s - self.fresh_s).max(0.0);
        if ahead <= 0 || f64::from(ahead) > most {
            return None;
        }
        self.clock_off(said, 0.0).map(|off_s| Fit::Next(ahead, off_s))
    }

    /// How far the frame's clock is from where this one's would be, seconds; 0 where nothing can be said, none where it
    /// cannot be the same. A frame may come late, so the mote's clock may have gone on by less than the listener's, but
    /// by no less than `least_s`, and not by more.
    fn clock_off(&self, said: &Said, least_s: f64) -> Option<f64> {
        let (passed_s, on_s, rounding_s) = match (said.clock, self.ticks, self.uptime) {
            (Reading::Ticks(ticks, hz), Some((at_s, before, hz_before)), _) => {
                let hz = if hz > 0.0 { hz } else { hz_before };
                let passed_s = said.at_s - at_s;
                if hz <= 0.0 || passed_s.abs() > CLOCK_HOLDS_S {
                    return Some(0.0);
                }
                (passed_s, f64::from(ticks.wrapping_sub(before).cast_signed()) / hz, 0.0)
            }
            (Reading::Uptime(uptime), _, Some((at_s, before))) => {
                (said.at_s - at_s, f64::from(uptime) - f64::from(before), 1.0)
            }
            _ => return Some(0.0),
        };
        let fits = on_s >= least_s - rounding_s && on_s <= passed_s.max(0.0) + CLOCK_SLACK_S + rounding_s;
        fits.then(|| ((on_s - passed_s).abs() - rounding_s).max(0.0))
    }

    /// Keeps the books of sequences and clocks.
    fn say(&mut self, said: &Said, fit: Fit) {
        match fit {
            Fit::Next(ahead, _) => {
                self.lost += ahead.unsigned_abs() as u64 - 1;
                self.newest = said.sequence;
            }
            Fit::Late(_) => {
                self.late += 1;
                self.lost = self.lost.saturating_sub(1);
            }
            Fit::First | Fit::Again => {}
        }
        self.frames += 1;
        self.news += 1;
        self.heard_s = said.at_s;
        if self.known.len() >= REMEMBERED as usize {
            self.known.pop_front();
        }
        self.known.push_back((said.sequence, said.digest));
        if !matches!(fit, Fit::Late(_)) {
            self.fresh_s = said.at_s;
            match said.clock {
                Reading::Ticks(ticks, hz) => self.ticks = Some((said.at_s, ticks, hz)),
                Reading::Uptime(uptime) => self.uptime = Some((said.at_s, uptime)),
                Reading::None => {}
            }
        }
    }

    fn heard_by(&mut self, source: SourceId, at_s: f64, signal: Signal) {
        if let Some(ear) = self.ears.iter_mut().find(|ear| ear.0 == source) {
            *ear = (source, at_s, signal);
        } else if self.ears.len() < SOURCES {
            self.ears.push((source, at_s, signal));
        }
        self.signal = signal;
    }

    /// Takes over what the message says; of a late one only its place in the trail is lost.
    fn learn(&mut self, at_s: f64, message: &Message, late: bool) {
        match message {
            Message::Fix(report) => {
                if self.arrivals.len() >= ARRIVALS {
                    self.arrivals.pop_front();
                }
                self.arrivals.push_back(at_s);
                if late {
                    return;
                }
                self.fix = Some((at_s, self.newest, *report));
                let due = self.trail.back().is_none_or(|last| at_s - f64::from(last[0]) >= TRAIL_EVERY_S - 1e-3);
                if report.level >= Level::Tracked && due {
                    if self.trail.len() >= TRAIL {
                        self.trail.pop_front();
                    }
                    let [x, y, z] = report.position.map(|metres| f64::from(metres) as f32);
                    self.trail.push_back([at_s as f32, x, y, z]);
                }
            }
            Message::Health(health) if !late => self.health = Some(*health),
            Message::Health(_) | Message::Angles(_) => {}
        }
    }

    /// Goes on where `before` ended: the same mote, started anew or heard again after a gap in its clock.
    fn follow(&mut self, before: &Self) {
        let anew = match (self.uptime, before.uptime) {
            (Some((_, now)), Some((_, then))) => now < then,
            _ => self.newest.wrapping_sub(before.newest).cast_signed() < 0,
        };
        self.is_mote = true;
        self.frames += before.frames;
        self.lost += before.lost;
        self.duplicates += before.duplicates;
        self.late += before.late;
        self.restarts = before.restarts + u64::from(anew);
        let mut trail = before.trail.clone();
        trail.extend(&self.trail);
        while trail.len() > TRAIL {
            trail.pop_front();
        }
        self.trail = trail;
        self.health = self.health.or(before.health);
    }

    fn rate(&self, now_s: f64) -> f64 {
        let since = self.arrivals.iter().position(|at_s| now_s - at_s <= RATE_OVER_S);
        let Some(first) = since else { return 0.0 };
        let (Some(from), Some(to)) = (self.arrivals.get(first), self.arrivals.back()) else { return 0.0 };
        let span = to - from;
        let count = (self.arrivals.len() - first - 1) as f64;
        if span > 0.0 { count / span } else { 0.0 }
    }

    fn news(&self, key: Key, doubts: Doubts, now_s: f64, trail: usize) -> MoteNews {
        let mut ears: Vec<_> = self.ears.iter().filter(|ear| now_s - ear.1 <= RATE_OVER_S).collect();
        ears.sort_by_key(|ear| std::cmp::Reverse(ear.2.rssi_dbm));
        MoteNews {
            key: key.to_string(),
            pan: key.pan,
            mote: key.mote,
            twin: key.twin,
            is_conflict: doubts.is_conflict,
            has_refused_twin: doubts.has_refused_twin,
            sources: ears.into_iter().map(|ear| ear.0).collect(),
            signal: self.signal,
            silent_s: now_s - self.heard_s,
            sequence: self.newest,
            fix: self.fix.as_ref().map(|(at_s, sequence, report)| mote_fix(now_s - at_s, *sequence, report)),
            condition: self.health.as_ref().map(condition),
            fixes_per_s: self.rate(now_s),
            frames: self.frames,
            lost: self.lost,
            duplicates: self.duplicates,
            late: self.late,
            restarts: self.restarts,
            own_losses: self.fix.as_ref().map(|(.., report)| {
                let frame::Losses { edges, pulses, sweeps, fixes, reports } = report.losses;
                OwnLosses { edges, pulses, sweeps, fixes, reports }
            }),
            trail: self.trail.iter().skip(self.trail.len().saturating_sub(trail)).copied().collect(),
        }
    }
}

/// A level as the JSON names it.
#[must_use]
pub fn level(level: Level) -> &'static str {
    match level {
        Level::None => "none",
        Level::Angles => "angles",
        Level::Tracked => "tracked",
        Level::Full => "full",
    }
}

fn mote_fix(ago_s: f64, sequence: u16, report: &Report) -> MoteFix {
    let known = report.level >= Level::Tracked;
    let velocity: [f64; 3] = report.velocity.map(f64::from);
    let sd: [f64; 3] = report.sd.map(f64::from);
    MoteFix {
        ago_s,
        sequence,
        level: level(report.level),
        position_m: known.then(|| report.position.map(f64::from)),
        velocity_m_per_s: known.then_some(velocity),
        speed_m_per_s: known.then(|| velocity.iter().map(|v| v * v).sum::<f64>().sqrt()),
        sd_m: (known && sd != [0.0; 3]).then_some(sd),
        mismatch_m: f64::from(report.mismatch),
        angle_age_s: f64::from(report.age) * HALF_TURN_S,
        stations_seen: [report.stations & 1 != 0, report.stations & 2 != 0],
    }
}

fn fix(origin: Origin, report: &Report) -> Fix {
    let MoteFix { level, position_m, velocity_m_per_s, sd_m, mismatch_m, angle_age_s, stations_seen, .. } =
        mote_fix(0.0, origin.sequence, report);
    Fix {
        origin,
        mote_ticks: report.time,
        level,
        position_m,
        velocity_m_per_s,
        sd_m,
        mismatch_m,
        angle_age_s,
        stations_seen,
    }
}

fn sweeps(angles: &Angles) -> Vec<Sweep> {
    use lighthouse_mote::sweep::{Axis, Station};
    let each = angles.sweeps.iter().map(|sweep| Sweep {
        mote_ticks: sweep.time,
        station: if sweep.station == Station::A { 'A' } else { 'B' },
        axis: if sweep.axis == Axis::Azimuth { "azimuth" } else { "elevation" },
        angle_rad: (f64::from(sweep.share) / f64::from(1u32 << 20) - 0.5) * std::f64::consts::PI,
    });
    each.collect()
}

/// Why there is no lock and what to do; none when there is one.
#[must_use]
pub fn lock_reason(lock: Lock) -> Option<&'static str> {
    match lock {
        Lock::Locked => None,
        Lock::NoLight => Some("no light reaches the photodiode"),
        Lock::Searching => Some("light, but not yet enough of it"),
        Lock::OneStation => Some("one station of two, and nothing says which"),
        Lock::Spacing => Some("two stations, but not set to modes A and B"),
        Lock::Widths => Some("pulses too long: sunlight, a lamp or a reflection"),
        Lock::V2 => Some("Lighthouse V2 stations, which have no flashes"),
    }
}

fn lock_name(lock: Lock) -> &'static str {
    match lock {
        Lock::NoLight => "no_light",
        Lock::Searching => "searching",
        Lock::Locked => "locked",
        Lock::OneStation => "one_station",
        Lock::Spacing => "spacing",
        Lock::Widths => "widths",
        Lock::V2 => "v2",
    }
}

fn condition(health: &Health) -> Condition {
    let stations = std::array::from_fn(|index| {
        let station = &health.stations[index];
        let known = station.id != 0;
        StationNews {
            id: known.then_some(station.id),
            mode: known.then(|| (b'A' + station.mode.min(25)) as char),
            faults: station.faults,
            is_stranger: station.is_stranger,
            factory: match station.factory {
                Factory::File => "file",
                Factory::Awaited => "awaited",
                Factory::Received => "received",
            },
            flashes: health.syncs[index],
            sweeps: health.sweeps[index],
            width_bias_s: f64::from(station.width_bias) / 25_600.0 * HALF_TURN_S,
        }
    });
    Condition {
        lock: lock_name(health.lock),
        lock_reason: lock_reason(health.lock),
        clock_hz: clock_hz(health.half_turn_q8),
        uptime_s: health.uptime,
        reset: match health.reset {
            Reset::PowerOn => "power_on",
            Reset::Requested => "requested",
            Reset::Fault => "fault",
            Reset::Panic => "panic",
            Reset::Watchdog => "watchdog",
            Reset::Image => "damaged_image",
        },
        reset_detail: (health.reset_detail != 0).then_some(health.reset_detail),
        stations,
        rejects: BTreeMap::from(by_name(&health.rejects)),
        waiting: health.waiting,
    }
}

/// What a mote turned away, by the names that every view has for it.
#[must_use]
pub fn by_name(rejects: &Rejects) -> [(&'static str, u16); 12] {
    [
        ("edges", rejects.edges),
        ("strays", rejects.strays),
        ("widths", rejects.widths),
        ("short", rejects.short),
        ("long", rejects.long),
        ("second", rejects.second),
        ("outside", rejects.outside),
        ("geometry", rejects.geometry),
        ("mismatch", rejects.mismatch),
        ("disbelieved", rejects.disbelieved),
        ("reports", rejects.reports),
        ("locks", rejects.locks),
    ]
}

#[cfg(test)]
#[path = "model_tests.rs"]
mod tests;
