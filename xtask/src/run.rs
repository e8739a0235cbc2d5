//! The main job: the firmware as it would be flashed, in the virtual mote, under light of a simulated room or of a
//! recording, held against the truth.
//!
//! What can go wrong: everything that is asked for is read and checked before the first build; a mote that faults stops
//! the run with the place in the code; `target/run` is replaced only by a complete run.

mod microbit;

use std::collections::VecDeque;
use std::io::{IsTerminal, Write};
use std::num::NonZeroU32;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use lighthouse_mote::frame::{self, Header, Message, Report};
use serde_json::{Value, json};
use sim::mote::{Load, Mote};
use sim::scum3c::SentFrame;
use sim::world::{EventKind, Scene, World};
use xtask::calib::Calibration;
use xtask::calibrate::lateness::{self, Lateness};
use xtask::light::{HALF_TURN_S, Light, LightConfig};
use xtask::listen::simulate;
use xtask::output::{self, Run};
use xtask::pcap;
use xtask::recording::Recording;
use xtask::reference::{Method, Room};
use xtask::score::{self, FixRow, Late, Place, Score};
use xtask::svg::Span;

use crate::firmware;
use crate::log::Log;
use crate::process::root;
use microbit::Stamps;

/// What the run may be told.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// Which mote: the virtual SCuM-3C, or beside it an emulated board whose fixes must be the same to the bit
    #[arg(long, value_enum, default_value_t = Board::Scum3c)]
    board: Board,
    /// Play the light of a recording instead of a simulated room: the folder with recording.toml and sweeps.csv
    #[arg(long, value_name = "DIR")]
    recording: Option<PathBuf>,
    /// The room to bake into the mote [default: calib/default.toml, or the recording's own stations]
    #[arg(long, value_name = "FILE", env = "LIGHTHOUSE_CALIB")]
    calib: Option<PathBuf>,
    /// Seconds of mote time in the simulated room
    #[arg(long, default_value_t = 30.0, conflicts_with = "recording", value_parser = seconds)]
    seconds: f64,
    /// Which of the endlessly many simulated walks
    #[arg(long, default_value_t = 1, conflicts_with = "recording")]
    seed: u64,
    /// Which photodiode of the recording plays the mote's
    #[arg(long, default_value_t = 0, requires = "recording")]
    sensor: u32,
    /// Where the results go
    #[arg(long, value_name = "DIR", default_value = "target/run")]
    out: PathBuf,
}

/// What can be run on this computer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Board {
    /// The virtual SCuM-3C
    Scum3c,
    /// And in QEMU a micro:bit, which is played what the SCuM-3C stamped
    Microbit,
}

impl Arguments {
    /// Both boards in the light of the default room, as a check.
    pub(crate) fn both_boards() -> Self {
        Self {
            board: Board::Microbit,
            recording: None,
            calib: None,
            seconds: 20.0,
            seed: 1,
            sensor: 0,
            out: "target/run-microbit".into(),
        }
    }
}

fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(seconds) if (0.5..=86_400.0).contains(&seconds) => Ok(seconds),
        Ok(seconds) => Err(format!("{seconds} is not in 0.5 ..= 86400")),
        Err(error) => Err(error.to_string()),
    }
}

/// How often the mote is looked at, seconds of its time.
const LOOK_S: f64 = 0.05;
/// A recording is scored sweep by sweep.
const EVERY_SWEEP: &str = "report_every_half_turns = 1";
/// The mote without its tracker.
const PLAIN: &str = "report_every_half_turns = 1\nestimate = \"fix\"";
/// How a row of the table is called that holds fixes against the truth as the recording has it, where others do not.
const AS_WRITTEN: &str = "truth as written";
/// How often the line with its state is written anew where nobody watches, seconds of mote time.
const LINE_S: f64 = 5.0;
/// The same on a terminal, in wall time.
const REDRAW: Duration = Duration::from_millis(100);
/// Longest silence of the mote's last frame: what is on its way when the light ends still comes out, seconds.
const TAIL_S: f64 = 0.05;

/// All that was asked for, read and checked.
#[derive(Clone)]
struct Prepared {
    source: Source,
    calib: PathBuf,
    calibration: Calibration,
}

/// Where the light comes from.
#[derive(Clone)]
enum Source {
    World {
        world: Box<World>,
        sweeps: Vec<u64>,
    },
    Recording {
        recording: Box<Recording>,
        light: Box<Light>,
        next: usize,
        /// Where the mote was, at the time when it was there.
        truth: Vec<Place>,
        /// How late the recording has that, as the room's calibration found; none where it did not.
        late: Option<Late>,
    },
}

/// Runs the firmware and writes down what came of it.
pub(crate) fn run(arguments: &Arguments) -> Result<()> {
    let out = root().join(&arguments.out);
    output::ensure_replaceable(&out)?;
    let prepared = prepare(arguments)?;
    let plain = match &prepared.source {
        Source::World { .. } => None,
        Source::Recording { .. } => Some(Session::new(PLAIN, prepared.clone(), arguments)?.play(false, None)?),
    };
    let mote = if plain.is_some() { EVERY_SWEEP } else { "" };
    let calib = prepared.calib.clone();
    let mut stamps = (arguments.board == Board::Microbit).then(Stamps::default);
    let mut run = Session::new(mote, prepared, arguments)?.play(true, stamps.as_mut())?;
    if let Some(plain) = plain {
        let written = plain.others.into_iter().find(|(name, _)| name == AS_WRITTEN);
        let after = run.others.iter().position(|(name, _)| name == AS_WRITTEN).map(|at| at + 1);
        if let Some(((name, score), after)) = written.zip(after) {
            run.others.insert(after, (format!("each fix as it is, {name}"), score));
        }
        run.others.insert(0, ("each fix as it is".to_string(), plain.score));
    }
    if let Some(folder) = out.parent() {
        std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    }
    output::write(&out, &run)?;
    println!("\n{}", output::table(&run));
    println!("written to {}: fixes.csv frames.pcap trajectory.svg summary.json", arguments.out.display());
    if let Some(stamps) = stamps {
        let fixes = microbit::follow(&stamps, &run.frames, &calib, mote, run.seconds)?;
        println!("microbit: {fixes} fixes, every one the same as the SCuM-3C's to the bit");
    }
    Ok(())
}

/// Reads and checks all that was asked for.
fn prepare(arguments: &Arguments) -> Result<Prepared> {
    let Some(dir) = &arguments.recording else {
        let named = arguments.calib.clone();
        let calib = named.clone().unwrap_or_else(|| root().join(firmware::DEFAULT_CALIB));
        let calibration = firmware::room(&calib)?;
        let scene = scene(arguments, named.as_deref(), &calibration)?;
        let mut world = Box::new(World::new(&scene, arguments.seed));
        world.keep_log();
        return Ok(Prepared { source: Source::World { world, sweeps: Vec::new() }, calib, calibration });
    };
    let recording = Recording::open(dir)?.sensor(arguments.sensor)?;
    let calib = arguments.calib.clone().unwrap_or_else(|| recording.stations.clone());
    let calibration = firmware::room(&calib)?;
    let light = Light::rebuild(&recording, &LightConfig::of(&recording))?;
    println!("{}", light.findings);
    let room = calib.display().to_string();
    let late = match lateness::of(&room, &calibration, &recording)? {
        Lateness::Found(found) => {
            let late = found.on(&recording, &light);
            println!("the truth is late, as {room} says, found within the calibrate window: it is taken {late}");
            Some(late)
        }
        Lateness::OfAnother => {
            println!("{room}: its {} is of another recording or window, and is not applied", lateness::KEY);
            None
        }
        Lateness::None => None,
    };
    let mut truth = score::recorded_truth(&recording, &light);
    for place in &mut truth {
        place.0 = late.unwrap_or_default().before(place.0);
    }
    Ok(Prepared {
        source: Source::Recording { recording: Box::new(recording), light: Box::new(light), next: 0, truth, late },
        calib,
        calibration,
    })
}

/// The default scene, with the stations and a path of the named room if there is one.
fn scene(arguments: &Arguments, named: Option<&Path>, calibration: &Calibration) -> Result<Scene> {
    let scene = match named {
        Some(named) => simulate::scene(&named.display().to_string(), calibration)?,
        None => Scene::default(),
    };
    Ok(Scene { length_s: arguments.seconds, ..scene })
}

/// A mote in the light, and what it has said so far.
struct Session {
    mote: Mote,
    source: Source,
    mote_hz: f64,
    length_s: f64,
    fixes: Vec<FixRow>,
    frames: Vec<pcap::Frame>,
    truth: Vec<Place>,
    garbled: u64,
    losses: frame::Losses,
    missing: u64,
    /// Of the last frame, whatever its kind.
    sequence: Option<u16>,
    edges: VecDeque<(u64, bool)>,
    started: Load,
    elf: Vec<u8>,
    calib: PathBuf,
    calibration: Calibration,
}

impl Session {
    /// A mote whose settings are those of the room but for the lines in `mote`.
    fn new(mote: &str, prepared: Prepared, arguments: &Arguments) -> Result<Self> {
        let Prepared { source, calib, calibration } = prepared;
        let elf = firmware::scum3c(&calib, mote)?;
        let (mote_hz, length_s) = match &source {
            Source::World { world, .. } => {
                let clock = &world.scene().clock;
                // Two boards are to hear the light out.
                let tail_s = if arguments.board == Board::Microbit { TAIL_S } else { 0.0 };
                (clock.nominal_hz * (1.0 + clock.error), arguments.seconds + tail_s)
            }
            Source::Recording { light, .. } => {
                let last = light.edges.last().map_or(0, |edge| edge.0);
                (light.mote_hz, light.seconds(last) + TAIL_S)
            }
        };
        let hclk = NonZeroU32::new(mote_hz.round() as u32).context("the mote's clock stands still")?;
        Ok(Self {
            mote: Mote::boot(&elf, hclk)?,
            source,
            mote_hz,
            length_s,
            fixes: Vec::new(),
            frames: Vec::new(),
            truth: Vec::new(),
            garbled: 0,
            losses: frame::Losses::default(),
            missing: 0,
            sequence: None,
            edges: VecDeque::new(),
            started: Load::default(),
            elf,
            calib,
            calibration,
        })
    }

    /// Plays all of the light; in silence unless `aloud`.
    fn play(mut self, aloud: bool, mut stamps: Option<&mut Stamps>) -> Result<Run> {
        let look_s = if stamps.is_some() { microbit::LOOK_S } else { LOOK_S };
        let wall = Instant::now();
        let mut live = Live::new(self.length_s);
        let mut log = Log::new(&self.elf)?;
        let mut second = 0.0;
        while second < self.length_s {
            second = (second + look_s).min(self.length_s);
            let cycle = self.cycle(second);
            self.light_until(cycle)?;
            if let Source::World { world, .. } = &self.source {
                self.mote.set_hclk_hz(world.clock_hz(second - look_s / 2.0));
            }
            match &mut stamps {
                Some(stamps) => stamps.run_until(&mut self.mote, cycle)?,
                None => self.mote.run_until(cycle)?,
            }
            if self.started.cycles == 0 {
                // Bring-up is no part of the load.
                self.started = self.mote.load();
            }
            for sent in self.mote.take_frames().collect::<Vec<_>>() {
                self.hear(sent)?;
            }
            let bytes = self.mote.take_log();
            for line in log.read(&bytes) {
                if aloud {
                    live.say(&line);
                }
            }
            if matches!(self.source, Source::World { .. }) {
                let place = self.truth_at(cycle);
                self.truth.extend(place.map(|place| (second, place)));
            }
            if aloud {
                live.show(second, &self.fixes, &self.losses);
            }
        }
        if aloud {
            live.end();
        }
        let stopped = self.mote.load();
        ensure!(
            self.mote.machine.bus.refused() == 0,
            "the radio refused: {:?}",
            self.mote.machine.bus.refusals().first()
        );
        self.finish(stopped, wall.elapsed())
    }

    fn cycle(&self, second: f64) -> u64 {
        match &self.source {
            Source::World { world, .. } => world.cycle(second),
            Source::Recording { .. } => (second * self.mote_hz) as u64,
        }
    }

    fn seconds(&self, cycle: u64) -> f64 {
        match &self.source {
            Source::World { world, .. } => world.seconds(cycle),
            Source::Recording { light, .. } => light.seconds(cycle),
        }
    }

    fn truth_at(&self, cycle: u64) -> Option<[f64; 3]> {
        match &self.source {
            Source::World { world, .. } => Some(world.truth(cycle)),
            Source::Recording { light, truth, .. } => score::place_at(truth, light.seconds(cycle)),
        }
    }

    /// Queues the light up to and including `cycle`.
    fn light_until(&mut self, cycle: u64) -> Result<()> {
        loop {
            if self.edges.is_empty() {
                let next = match &mut self.source {
                    Source::World { world, .. } => world.next_edge().map(|edge| (edge.cycle, edge.level)),
                    Source::Recording { light, next, .. } => {
                        *next += 1;
                        light.edges.get(*next - 1).copied()
                    }
                };
                self.edges.extend(next);
            }
            match self.edges.front() {
                Some(&(at, level)) if at <= cycle => {
                    self.mote.push_edge(at, level)?;
                    self.edges.pop_front();
                }
                _ => break,
            }
        }
        if let Source::World { world, sweeps } = &mut self.source {
            let log = world.take_log();
            sweeps.extend(
                log.iter()
                    .filter(|event| event.seen && matches!(event.kind, EventKind::Sweep { .. }))
                    .map(|event| event.cycle),
            );
        }
        Ok(())
    }

    /// Takes one frame from the air, as a listener would.
    fn hear(&mut self, sent: SentFrame) -> Result<()> {
        let micros = (1e6 * self.seconds(sent.start_cycle)) as u64;
        match frame::parse(&sent.bytes) {
            Ok((header, message)) => {
                if let Some(last) = self.sequence.replace(header.sequence) {
                    self.missing += u64::from(header.sequence.wrapping_sub(last).wrapping_sub(1));
                }
                if let Message::Fix(report) = message {
                    self.take(sent.start_cycle, header, report)?;
                }
            }
            Err(_) => self.garbled += 1,
        }
        self.frames.push(pcap::Frame { micros, bytes: sent.bytes });
        Ok(())
    }

    /// Takes one fix, sent at `cycle`.
    fn take(&mut self, cycle: u64, header: Header, report: Report) -> Result<()> {
        let sighted = self.mote.cycle_of(report.time).context("the mote's timer cannot be read")?;
        let row = FixRow::of(header, &report, cycle, sighted, self.seconds(sighted));
        self.fixes.push(FixRow { truth: self.truth_at(sighted), ..row });
        self.losses = report.losses;
        Ok(())
    }

    fn finish(self, stopped: Load, wall: Duration) -> Result<Run> {
        let calibration = &self.calibration;
        let room = Room::of(calibration);
        let every_s = f64::from(calibration.mote.report_every_half_turns) * HALF_TURN_S;
        let (held, truth, spans) = match &self.source {
            Source::World { world, sweeps } => (
                Held {
                    title: format!("Simulated room, {:.0} s by hand", self.length_s),
                    score: Score::of_simulation(sweeps, &self.fixes, self.mote_hz, every_s, |cycle| world.truth(cycle)),
                    others: Vec::new(),
                    more: Vec::new(),
                },
                self.truth,
                Vec::new(),
            ),
            Source::Recording { recording, light, truth, late, .. } => {
                let spans = light.calibrated(recording).map(|seconds| Span { seconds, label: "calibrate".to_string() });
                let held = Held::against(recording, light, &self.fixes, &room, late.as_ref())?;
                (held, truth.clone(), spans.into_iter().collect())
            }
        };
        let lost = self.missing
            + self.garbled
            + [self.losses.edges, self.losses.reports].iter().map(|count| u64::from(*count)).sum::<u64>();
        let instructions = (stopped.instructions - self.started.instructions) as f64 / self.length_s;
        Ok(Run {
            title: held.title,
            score: held.score,
            others: held.others,
            stations: room.marks(),
            spans,
            seconds: self.length_s,
            cpu_percent: stopped.percent_since(&self.started),
            lost,
            more: [
                ("mote_clock_hz".to_string(), json!(self.mote_hz.round())),
                ("instructions_per_second".to_string(), json!(instructions.round())),
                ("edges_lost".to_string(), json!(self.losses.edges)),
                ("pulses_in_no_window".to_string(), json!(self.losses.pulses)),
                ("sweeps_out_of_view".to_string(), json!(self.losses.sweeps)),
                ("fixes_refused".to_string(), json!(self.losses.fixes)),
                ("reports_lost".to_string(), json!(self.losses.reports)),
                ("frames_garbled".to_string(), json!(self.garbled)),
                ("room".to_string(), json!(self.calib.display().to_string())),
                ("times_real_time".to_string(), json!((self.length_s / wall.as_secs_f64()).round())),
            ]
            .into_iter()
            .chain(held.more)
            .collect(),
            fixes: self.fixes,
            frames: self.frames,
            truth,
        })
    }
}

/// What came of holding a mote's fixes against the truth.
struct Held {
    title: String,
    score: Score,
    others: Vec<(String, Score)>,
    more: Vec<(String, Value)>,
}

impl Held {
    /// Against that of a recording. Where its truth is known to be late, first against the truth of so much later, then
    /// against the truth as written.
    fn against(
        recording: &Recording,
        light: &Light,
        fixes: &[FixRow],
        room: &Room,
        late: Option<&Late>,
    ) -> Result<Self> {
        let mut methods = vec![("plain DLT in f64", Method::plain(room.clone()))];
        let authors = recording.dir.join("authors_poses.toml");
        if authors.exists() {
            methods.push(("the paper's method", Method::paper(Room::open(&authors)?)));
        }
        let name = recording.dir.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
        let title = format!("Recording {name}");
        let written = Score::of_recording(recording, light, fixes);
        let of_methods = methods.iter().map(|(name, method)| (*name, method.score(recording, light)));
        let speed = speed(&score::recorded_truth(recording, light));
        let mut more: Vec<_> = speed.map(|speed| ("speed_m_per_s".to_string(), json!(speed))).into_iter().collect();
        let Some(late) = late else {
            let others = of_methods.map(|(name, score)| (name.to_string(), score)).collect();
            return Ok(Self { title, score: written, others, more });
        };
        let of_late =
            methods.iter().map(|(name, method)| (name.to_string(), method.score_late(recording, light, late)));
        let as_written = of_methods.map(|(name, score)| (format!("{name}, {AS_WRITTEN}"), score));
        let others = of_late.chain([(AS_WRITTEN.to_string(), written)]).chain(as_written).collect();
        let tenths = |late_s: f64| json!((1e4 * late_s).round() / 10.0);
        more.push(("truth_late_ms".to_string(), tenths(late.late_s)));
        more.push(("truth_drift_ppm".to_string(), json!((1e6 * late.drift).round())));
        let later = Method::plain(room.clone()).later(recording, light, late);
        more.extend(later.map(|s| ("truth_late_ms_by_scored_rows".to_string(), tenths(late.late_s + s))));
        Ok(Self {
            title: format!("{title}, its truth taken {late}"),
            score: Score::of_late_truth(recording, light, fixes, late),
            others,
            more,
        })
    }
}

/// How fast the mote goes on average, m/s: from one tenth of a second to the next, as noise of the truth would add up
/// over less.
fn speed(truth: &[Place]) -> Option<f64> {
    const STEP_S: f64 = 0.1;
    let (first_s, last_s) = (truth.first()?.0, truth.last()?.0);
    let steps = ((last_s - first_s) / STEP_S) as u32;
    let at = |step: u32| score::place_at(truth, first_s + STEP_S * f64::from(step));
    let moved = (0..steps).filter_map(|step| {
        let (from, to) = (at(step)?, at(step + 1)?);
        Some((0..3).map(|axis| (to[axis] - from[axis]).powi(2)).sum::<f64>().sqrt())
    });
    let (sum, count) = moved.fold((0.0, 0), |(sum, count), moved| (sum + moved, count + 1));
    (count > 0).then(|| (1e3 * sum / f64::from(count) / STEP_S).round() / 1e3)
}

/// The one line that shows how it goes.
struct Live {
    terminal: bool,
    length_s: f64,
    drawn: Option<Instant>,
    next_line: f64,
}

impl Live {
    fn new(length_s: f64) -> Self {
        Self { terminal: std::io::stdout().is_terminal(), length_s, drawn: None, next_line: LINE_S.min(length_s) }
    }

    fn show(&mut self, second: f64, fixes: &[FixRow], losses: &frame::Losses) {
        let due = if self.terminal {
            self.drawn.is_none_or(|drawn| drawn.elapsed() >= REDRAW) || second >= self.length_s
        } else {
            second >= self.next_line
        };
        if !due {
            return;
        }
        self.drawn = Some(Instant::now());
        self.next_line = (self.next_line + LINE_S).min(self.length_s);
        let recent = fixes.iter().rev().take_while(|fix| second - fix.seconds < 1.0).count();
        let place = fixes.last().map_or("no fix yet".to_string(), |fix| {
            let [x, y, z] = fix.position;
            let error = fix.error_m().map_or("unknown".to_string(), |error| format!("{:.1} cm", 100.0 * error));
            format!("x {x:7.3}  y {y:7.3}  z {z:7.3} m   error {error:>8}")
        });
        let line = format!(
            "{second:6.1} / {:.1} s   {place}   {recent:3} fixes/s   lost {}",
            self.length_s,
            u32::from(losses.edges) + u32::from(losses.reports)
        );
        if self.terminal {
            print!("\r\x1b[2K{line}");
            // A terminal that is gone is no reason to stop.
            let _ = std::io::stdout().flush();
        } else {
            println!("{line}");
        }
    }

    fn say(&mut self, line: &str) {
        if self.terminal {
            print!("\r\x1b[2K");
        }
        println!("{line}");
    }

    fn end(&self) {
        if self.terminal {
            println!();
        }
    }
}
