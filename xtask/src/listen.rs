//! From the air to the desk: one mote or a swarm.
//!
//! One way: a [`source`] hands over frames (through [`air::receiver`] what a serial line says), [`model`] makes of them what is
//! known of every mote, and views show that: [`dashboard`] in a terminal, lines where there is none, [`web`] in browsers, and
//! [`output`], [`record`] and [`mqtt`] for other programs. [`simulate`] plays motes, [`measure`] weighs it all. `docs/listening.md` is
//! the manual.
//!
//! What can go wrong: see each part. Nothing that comes from the air or a receiver ends the listening.

use std::collections::BTreeMap;
use std::io::IsTerminal;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use air::receiver::Kind;
use anyhow::{Context, Result, ensure};
use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::flag;

mod counters;
pub mod dashboard;
pub mod measure;
pub mod model;
pub mod mqtt;
pub mod output;
pub mod record;
pub mod simulate;
pub mod source;
pub mod web;

use self::counters::Counters;
use self::dashboard::{Dashboard, Wish};
use self::model::{Cause, RoomNews, Shared, Snapshot, SourceId, SourceState, Swarm};
use self::mqtt::{Broker, Login, Mqtt};
use self::output::{JsonLines, ReaderGone, Sink, Table};
use self::record::Recorder;
use self::source::{Capture, Desk, Heard};
use self::web::Web;
use crate::calib::schema;
use crate::{trust, whole};

/// What listening may be told.
#[derive(clap::Args, Debug)]
pub struct Arguments {
    /// A receiver's serial port; more than one may be named [default: all that are plugged in, or motes are simulated]
    #[arg(long, value_name = "PORT")]
    port: Vec<String>,
    /// What is behind these ports [default: what USB says, or an nRF Sniffer]
    #[arg(long, value_name = "KIND")]
    receiver: Option<Kind>,
    /// IEEE 802.15.4 channel, 11 to 26: the one that the motes were flashed with; an nRF52840 sends on 26 unless told
    #[arg(long, default_value_t = 11, value_parser = clap::value_parser!(u8).range(11..=26))]
    channel: u8,
    /// A capture, pcap or pcapng, of link type 195, 230 or 283; `-` is the standard input
    #[arg(long, value_name = "FILE")]
    capture: Vec<PathBuf>,
    /// So many simulated motes: up to 8 run the firmware, more say where a simulated hand carries them
    #[arg(long, value_name = "MOTES", value_parser = clap::value_parser!(u16).range(1..=i64::from(simulate::MOST)))]
    simulate: Option<u16>,
    /// Reports a second of more than 8 simulated motes
    #[arg(long, value_name = "PER_S", default_value_t = 10.0, value_parser = rate, allow_negative_numbers = true)]
    rate: f64,
    /// The room: stations and walls for the views, and where simulated motes move
    #[arg(long, value_name = "FILE", env = "LIGHTHOUSE_CALIB", default_value = "calib/default.toml")]
    calib: PathBuf,
    /// Write everything into a new folder, as it goes: air.pcapng, fixes.csv, health.csv
    #[arg(long, value_name = "DIR")]
    record: Option<PathBuf>,
    /// Where the frame counters of a room with a key are kept, so that no frame is believed twice [default: beside the
    /// room's file, .counters]
    #[arg(long, value_name = "FILE")]
    counters: Option<PathBuf>,
    /// End after so long, seconds
    #[arg(long, value_name = "SECONDS", value_parser = rate, allow_negative_numbers = true)]
    seconds: Option<f64>,
    /// Weigh the listener for so many seconds instead, by itself: processor, memory and losses with `--simulate` motes [1000]
    #[arg(long, value_name = "SECONDS", value_parser = rate, conflicts_with_all = ["port", "capture", "record", "counters", "seconds", "csv", "json", "mqtt", "web", "summary"])]
    measure: Option<f64>,
    #[command(flatten)]
    views: Views,
}

/// What a replay may be told.
#[derive(clap::Args, Debug)]
pub struct Replay {
    /// The folder that `listen --record` wrote
    dir: PathBuf,
    /// How many times as fast as it happened; 0: as fast as possible
    #[arg(long, default_value_t = 1.0, value_parser = speed, allow_negative_numbers = true)]
    speed: f64,
    /// The room whose key its frames are under [default: the room that was recorded]
    #[arg(long, value_name = "FILE", env = "LIGHTHOUSE_CALIB")]
    calib: Option<PathBuf>,
    #[command(flatten)]
    views: Views,
}

/// Who is to see it.
#[derive(clap::Args, Debug)]
struct Views {
    /// Fixes into a new CSV file
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Every event as a line of JSON on the standard output, and nothing else there
    #[arg(long)]
    json: bool,
    /// One retained topic per mote at this broker
    #[arg(long, value_name = "HOST[:PORT]", value_parser = mqtt::address)]
    mqtt: Option<(String, u16)>,
    /// What the topics begin with
    #[arg(long, value_name = "TOPIC", default_value = "lighthouse")]
    mqtt_prefix: String,
    /// What this gateway is called at the broker [default: the computer's name]
    #[arg(long, value_name = "NAME")]
    mqtt_gateway: Option<String>,
    /// Who to be at a broker that asks
    #[arg(long, value_name = "NAME", requires_all = ["mqtt", "mqtt_password"])]
    mqtt_user: Option<String>,
    /// A file whose first line is the password for that
    #[arg(long, value_name = "FILE", requires = "mqtt_user")]
    mqtt_password: Option<PathBuf>,
    /// A page for browsers at this address of this computer [default: 127.0.0.1:8015, or a free port]
    #[arg(long, value_name = "ADDRESS", value_parser = web::address)]
    web: Option<Option<SocketAddr>>,
    /// Lines instead of the dashboard, as where the output is no terminal
    #[arg(long)]
    plain: bool,
    /// Write what is known at the end as JSON
    #[arg(long, value_name = "FILE")]
    summary: Option<PathBuf>,
}

fn rate(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value > 0.0 && value <= 1e6 => Ok(value),
        Ok(value) => Err(format!("{value} is not above 0 and up to 1000000")),
        Err(error) => Err(error.to_string()),
    }
}

fn speed(text: &str) -> Result<f64, String> {
    if text.parse() == Ok(0.0) { Ok(0.0) } else { rate(text) }
}

/// What only the program around this can do.
pub struct Workshop<'a> {
    /// The root of the repository: a calibration that is not named is there.
    pub root: &'a Path,
    /// Builds the firmware for a room; the ELF file's bytes.
    pub build: &'a dyn Fn(&Path) -> Result<Vec<u8>>,
}

/// Frames that may wait to be looked at: a second of a swarm of a thousand.
const WAITING: usize = 16_384;
/// Frames that are looked at before anybody else may look at the motes.
const BATCH: usize = 1024;
/// How long to wait for one.
const PATIENCE: Duration = Duration::from_millis(20);
/// How often what was held back goes out.
const TICK: Duration = Duration::from_millis(50);
/// How often the dashboard is drawn.
const REDRAW: Duration = Duration::from_millis(150);
/// How often lines are printed instead, and of how many motes.
const LINES: Duration = Duration::from_secs(2);
const LINE_MOTES: usize = 10;
/// How many motes a newcomer sees.
const NEWCOMERS: u16 = 3;

/// Listens until somebody says that it is enough.
///
/// # Errors
/// Something that was asked for cannot be had, or a file cannot be written.
pub fn listen(arguments: &Arguments, workshop: &Workshop<'_>) -> Result<()> {
    let here = arguments.calib.clone();
    let calib = Some(workshop.root.join(&here)).filter(|there| !here.is_file() && there.is_file()).unwrap_or(here);
    if let Some(seconds) = arguments.measure {
        return measure::measure(&calib, arguments.simulate.unwrap_or(1000), arguments.rate, seconds);
    }
    // What can be found out is, before anything is made.
    let calibration = schema::open(&calib)?;
    let captures = arguments.capture.iter().map(|path| Capture::open(path)).collect::<Result<Vec<_>>>()?;
    arguments.views.check()?;
    if let Some(dir) = &arguments.record {
        record::vacant(dir)?;
    }
    let room = RoomNews::of(&arguments.calib.display().to_string(), &calibration);
    let (mut desk, from) = desk(Some(room));
    let key = trust::key_of(&calibration)?;
    model::lock(&desk.shared).under(key);
    let explicit = !arguments.port.is_empty() || !captures.is_empty() || arguments.simulate.is_some();
    let newcomer = !explicit && source::receivers()?.is_empty();
    let motes = arguments.simulate.or(newcomer.then_some(NEWCOMERS));
    if newcomer {
        eprintln!(
            "No receiver is plugged in: {NEWCOMERS} simulated motes are shown until one is. \
             `--port NAME` listens to a port that does not tell what it is."
        );
    }
    let scene = motes.map(|_| simulate::scene(&arguments.calib.display().to_string(), &calibration)).transpose()?;
    // Nobody wants to wait for that with a picture in front of them.
    let elf = motes.filter(|motes| *motes <= simulate::VIRTUAL).map(|_| (workshop.build)(&calib)).transpose()?;
    // Simulated motes alone have no counters to keep.
    let hears_air = !arguments.port.is_empty() || !arguments.capture.is_empty() || arguments.simulate.is_none();
    let mut sinks: Vec<Box<dyn Sink>> = Vec::new();
    if key.is_some() && hears_air {
        let path = arguments.counters.clone().unwrap_or_else(|| calib.with_extension("counters"));
        sinks.push(Box::new(Counters::open(path, desk.shared.clone())?));
    }
    let views = arguments.views.sinks(&desk.shared)?;
    if let Some(dir) = &arguments.record {
        sinks.push(Box::new(Recorder::create(dir, Some(&calib), desk.shared.clone())?));
    }
    sinks.extend(views);
    desk.started = Instant::now();
    if let (Some(motes), Some(scene)) = (motes, &scene) {
        match &elf {
            Some(elf) => simulate::virtual_motes(desk.clone(), elf, scene, motes)?,
            None => {
                let swarm = simulate::Swarm::new(scene, calibration.mote.pan, motes, arguments.rate);
                simulate::swarm(desk.clone(), swarm.under(key));
            }
        }
    }
    for capture in captures {
        capture.read(desk.clone());
    }
    for port in &arguments.port {
        let kind = arguments.receiver.unwrap_or_else(|| source::kind_of(port));
        source::listen(desk.clone(), port.clone(), kind, arguments.channel);
    }
    if !explicit {
        source::listen_to_all(desk.clone(), arguments.channel);
    }
    // Captures have an end; receivers and simulated motes have none.
    let ends = !arguments.capture.is_empty() && arguments.port.is_empty() && motes.is_none();
    Session { desk, from, sinks, ends, until: arguments.seconds.map(Duration::from_secs_f64) }.run(&arguments.views)
}

/// Shows a recording again.
///
/// # Errors
/// There is none, or a file cannot be written.
pub fn replay(arguments: &Replay) -> Result<()> {
    let kept = record::room(&arguments.dir);
    let (room, key) = trust::of_recording(kept.as_deref(), arguments.calib.as_deref())?;
    let name = kept.unwrap_or_default().display().to_string();
    let (desk, from) = desk(room.map(|room| RoomNews::of(&name, &room)));
    model::lock(&desk.shared).under(key);
    let recording = record::Recording::open(&arguments.dir)?;
    arguments.views.check()?;
    let sinks = arguments.views.sinks(&desk.shared)?;
    recording.replay(desk.clone(), arguments.speed);
    Session { desk, from, sinks, ends: true, until: None }.run(&arguments.views)
}

/// Where sources put what they hear, and where that comes out.
#[must_use]
pub fn desk(room: Option<RoomNews>) -> (Desk, Receiver<Heard>) {
    let (to, from) = sync_channel(WAITING);
    let shared: Shared = Arc::new(Mutex::new(Swarm::new(room)));
    (Desk { shared, to, started: Instant::now(), enough: Arc::new(AtomicBool::new(false)) }, from)
}

impl Views {
    /// Whether what is asked for can be had, as far as can be said without making it.
    fn check(&self) -> Result<()> {
        if let Some(csv) = &self.csv {
            output::vacant(csv)?;
        }
        if let Some(broker) = self.broker()? {
            broker.check()?;
        }
        if let Some(path) = &self.summary {
            let folder = whole::folder(path);
            ensure!(folder.is_dir() && !path.is_dir(), "{}: no file can be made there", path.display());
        }
        Ok(())
    }

    fn broker(&self) -> Result<Option<Broker>> {
        let Some((host, port)) = self.mqtt.clone() else { return Ok(None) };
        let gateway = self.mqtt_gateway.clone().unwrap_or_else(computer);
        let login = self.mqtt_user.as_deref().zip(self.mqtt_password.as_deref());
        let login = login.map(|(name, file)| Login::read(name, file)).transpose()?;
        Ok(Some(Broker { host, port, prefix: self.mqtt_prefix.clone(), gateway, login }))
    }

    fn sinks(&self, shared: &Shared) -> Result<Vec<Box<dyn Sink>>> {
        let mut sinks: Vec<Box<dyn Sink>> = Vec::new();
        if let Some(csv) = &self.csv {
            sinks.push(Box::new(Table::create(csv)?));
        }
        if self.json {
            sinks.push(Box::new(JsonLines::new(std::io::stdout())));
        }
        if let Some(at) = self.web {
            let web = Web::open(at, shared.clone())?;
            eprintln!("Page: {}", web.url());
            sinks.push(Box::new(web));
        }
        // The last to end: it may have to wait for the network.
        if let Some(broker) = self.broker()? {
            sinks.push(Box::new(Mqtt::open(broker, shared.clone())?));
        }
        Ok(sinks)
    }
}

/// The name of this computer, as a topic may have it.
fn computer() -> String {
    let asked = std::process::Command::new("hostname").output();
    let name = asked.map(|asked| String::from_utf8_lossy(&asked.stdout).trim().to_owned()).unwrap_or_default();
    let name: String = name.chars().filter(|c| c.is_ascii_alphanumeric() || "-_.".contains(*c)).collect();
    if name.is_empty() { "gateway".to_owned() } else { name }
}

/// Listening, until it is over.
pub struct Session {
    /// The sources' side.
    pub desk: Desk,
    /// Ours.
    pub from: Receiver<Heard>,
    /// Ways out.
    pub sinks: Vec<Box<dyn Sink>>,
    /// Over when every source has ended.
    pub ends: bool,
    /// Over after so long.
    pub until: Option<Duration>,
}

impl Session {
    fn run(mut self, views: &Views) -> Result<()> {
        let mut view = if views.json {
            View::None
        } else if !views.plain && std::io::stdout().is_terminal() {
            View::Dashboard(Box::new(Dashboard::open()?))
        } else {
            View::Lines(Instant::now())
        };
        let enough = interrupts()?;
        let ended = self.listen(&mut view, &enough);
        // The terminal comes back before anything is said.
        drop(view);
        self.desk.enough.store(true, Ordering::Relaxed);
        // Whatever went wrong, all else is brought to its end.
        let mut wrong = Vec::new();
        let mut note = |done: Result<()>| match done {
            Err(error) if !error.is::<ReaderGone>() => {
                let error = format!("{error:#}");
                if !wrong.contains(&error) {
                    wrong.push(error);
                }
            }
            _ => {}
        };
        note(ended);
        for sink in &mut self.sinks {
            note(sink.end());
            say_alarm(sink.as_mut());
        }
        let all = model::lock(&self.desk.shared).snapshot(0);
        if let Some(path) = &views.summary {
            note(whole::json(path, &all));
        }
        let mut text = String::new();
        if !views.json {
            text += &closing(&all);
            text += "\n";
        }
        for line in self.sinks.iter().filter_map(|sink| sink.note()) {
            text += &format!("{line}\n");
        }
        match views.json {
            true => eprint!("{text}"),
            false => note(output::say(&mut std::io::stdout(), text.as_bytes())),
        }
        ensure!(wrong.is_empty(), "{}", wrong.join("\nerror: "));
        Ok(())
    }

    /// Takes what comes and shows it, until somebody sets `enough` or wants to leave.
    ///
    /// # Errors
    /// A sink cannot be written.
    pub fn listen(&mut self, view: &mut View, enough: &AtomicBool) -> Result<()> {
        let mut ticked = Instant::now();
        let mut drawn: Option<Instant> = None;
        loop {
            let nobody_left = match self.from.recv_timeout(PATIENCE) {
                Ok(first) => {
                    self.take(first)?;
                    false
                }
                Err(RecvTimeoutError::Timeout) => self.ends && self.all_ended(),
                Err(RecvTimeoutError::Disconnected) => true,
            };
            let over = nobody_left
                || enough.load(Ordering::Relaxed)
                || self.until.is_some_and(|until| self.desk.started.elapsed() >= until);
            if !self.ends {
                model::lock(&self.desk.shared).pass(self.desk.now_s());
            }
            if over || ticked.elapsed() >= TICK {
                ticked = Instant::now();
                let mut done = Ok(());
                for sink in &mut self.sinks {
                    done = done.and(sink.tick());
                    if !matches!(view, View::Dashboard(_)) {
                        say_alarm(sink.as_mut());
                    }
                }
                done?;
            }
            if over {
                return Ok(());
            }
            if let View::Dashboard(dashboard) = view {
                if dashboard.typed()? == Wish::Leave {
                    return Ok(());
                }
                if drawn.is_none_or(|drawn| drawn.elapsed() >= REDRAW) {
                    drawn = Some(Instant::now());
                    let all = model::lock(&self.desk.shared).snapshot(dashboard::TRAIL);
                    let notes: Vec<String> = self.sinks.iter().filter_map(|sink| sink.note()).collect();
                    dashboard.draw(&all, &notes)?;
                }
            }
            if let View::Lines(printed) = view
                && printed.elapsed() >= LINES
            {
                *printed = Instant::now();
                let all = model::lock(&self.desk.shared).snapshot(0);
                let mut text = lines(&all);
                for note in self.sinks.iter().filter_map(|sink| sink.note()) {
                    text += &format!("  {note}\n");
                }
                output::say(&mut std::io::stdout(), text.as_bytes())?;
            }
        }
    }

    /// Takes one thing that was heard, and what else is there.
    fn take(&mut self, first: Heard) -> Result<()> {
        let mut next = Some(first);
        let mut events = Vec::new();
        let mut swarm = model::lock(&self.desk.shared);
        let mut heard = Vec::new();
        while let Some(one) = next {
            match &one {
                Heard::Frame(source, at_s, bytes, signal) => events.extend(swarm.hear(*at_s, *source, bytes, *signal)),
                Heard::Bad(source, at_s, cause, bytes) => {
                    events.push(swarm.reject(*at_s, *source, *cause, bytes));
                    bad_bytes(&mut swarm, *source, *cause, bytes.len());
                }
                Heard::State(source, state, note) => {
                    if let Some(source) = swarm.source(*source) {
                        source.state = *state;
                        source.note.clone_from(note);
                    }
                }
            }
            heard.push(one);
            next = if heard.len() < BATCH { self.from.try_recv().ok() } else { None };
        }
        drop(swarm);
        // What one cannot take the others do.
        let mut done = Ok(());
        for sink in &mut self.sinks {
            let frames = heard.iter().try_for_each(|one| sink.frame(one));
            done = done.and(frames.and_then(|()| events.iter().try_for_each(|event| sink.event(event))));
        }
        done
    }

    fn all_ended(&self) -> bool {
        let mut swarm = model::lock(&self.desk.shared);
        let mut count = 0;
        while let Some(source) = swarm.source(count) {
            if source.state != SourceState::Ended {
                return false;
            }
            count += 1;
        }
        count > 0
    }
}

fn say_alarm(sink: &mut dyn Sink) {
    if let Some(alarm) = sink.alarm() {
        eprintln!("{alarm}");
    }
}

/// What Ctrl-C sets, and whoever asks the program to end. A second Ctrl-C does not wait.
fn interrupts() -> Result<Arc<AtomicBool>> {
    const AT_ONCE: i32 = 130;
    let enough = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM] {
        let again = flag::register_conditional_shutdown(signal, AT_ONCE, enough.clone());
        again.and_then(|_| flag::register(signal, enough.clone())).context("Ctrl-C cannot be waited for")?;
    }
    Ok(enough)
}

/// What belongs to no frame is counted in bytes too.
fn bad_bytes(swarm: &mut Swarm, source: SourceId, cause: Cause, count: usize) {
    if matches!(cause, Cause::Line | Cause::Hdlc)
        && let Some(source) = swarm.source(source)
    {
        source.bad_bytes += count as u64;
    }
}

/// How it is shown while it lasts.
pub enum View {
    /// In a terminal.
    Dashboard(Box<Dashboard>),
    /// In lines, last printed then.
    Lines(Instant),
    /// Not at all.
    None,
}

/// What is known, in lines.
#[must_use]
pub fn lines(all: &Snapshot) -> String {
    // Not `sum`, which is -0 of nothing.
    let rate = all.motes.iter().fold(0.0, |rate, mote| rate + mote.fixes_per_s);
    let lost: u64 = all.motes.iter().map(|mote| mote.lost).sum();
    let mut text = format!(
        "{:8.1} s  {} motes  {rate:.1} fixes/s  {lost} lost  {}\n",
        all.time_s,
        all.motes.len(),
        dashboard::rejects(all)
    );
    for source in all.sources.iter().filter(|source| !source.note.is_empty()) {
        text += &format!("  {} ({}): {}\n", source.name, source.kind, source.note);
    }
    for mote in all.motes.iter().take(LINE_MOTES) {
        let place = match mote.fix.as_ref().and_then(|fix| fix.position_m) {
            Some([x, y, z]) => format!("x {x:7.3}  y {y:7.3}  z {z:7.3} m"),
            None => "no position".to_owned(),
        };
        let level = mote.fix.as_ref().map_or("-", |fix| fix.level);
        let lock = mote.condition.as_ref().map_or("-", |condition| condition.lock_reason.unwrap_or("locked"));
        let conflict = match (mote.is_conflict, mote.has_refused_twin) {
            (true, _) => "  TWO MOTES WITH THIS ID",
            (false, true) => "  ANOTHER WITH THIS ID IS REFUSED",
            (false, false) => "",
        };
        let rate = mote.fixes_per_s;
        text += &format!("  {:10} {level:7} {place}  {rate:5.1}/s  {} lost  {lock}{conflict}\n", mote.key, mote.lost);
    }
    if all.motes.len() > LINE_MOTES {
        text += &format!("  and {} more\n", all.motes.len() - LINE_MOTES);
    }
    if let Some(refusals) = all.refusals() {
        text += &format!("  {refusals}\n");
    }
    text
}

/// What there was, when it is over.
fn closing(all: &Snapshot) -> String {
    let lost: u64 = all.motes.iter().map(|mote| mote.lost).sum();
    let conflicts: BTreeMap<_, _> =
        all.motes.iter().filter(|mote| mote.is_conflict).map(|mote| ((mote.pan, mote.mote), ())).collect();
    let mut text = format!("{} motes, {lost} frames lost, {}", all.motes.len(), dashboard::rejects(all));
    for (pan, mote) in conflicts.keys() {
        text += &format!("\nmore than one mote says that it is {pan:04x}/{mote}: give one of them another id");
    }
    for refused in &all.refused_motes {
        text += &format!("\n{}", refused.note);
    }
    for source in all.sources.iter().filter(|source| !source.note.is_empty()) {
        text += &format!("\n{} ({}): {}", source.name, source.kind, source.note);
    }
    text
}
