//! From sweeps and truth to a room that can be flown: `cargo xtask calibrate`.
//!
//! Sweeps come from a recording, from captured frames of a mote that sends its angles, or from a [`session`] at known
//! places; truth from motion capture ([`truth`]) or from those places. `gather` brings both together, [`solve`] makes a
//! room of them, `account` puts that into figures, [`judgement`] says whether to trust it, [`room`] writes it down in the
//! project's own format and [`report`] draws it.
//!
//! # Design
//! Everything that is asked for is read before anything is solved, and every file appears whole or not at all. A room
//! file that this tool wrote is replaced, and the one before stays beside it as `.toml~`; a file of anybody else's is
//! not touched without `--force`. What stands under `[mote]` is the user's and is carried over, and so are the stations'
//! serial numbers and whose factory terms are used. A room that cannot be
//! trusted leaves a report and no room file.
//!
//! # What can go wrong
//! See each part; each way has a name and the numbers that show it.

mod account;
mod gather;
pub mod judgement;
pub mod lateness;
pub mod live;
pub mod points;
pub mod report;
pub mod room;
pub mod session;
pub mod simulate;
pub mod solve;
pub mod sweeps;
pub mod truth;

use std::fs::{self, File};
use std::io::{self, BufRead, BufReader, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow, bail, ensure};
use serde_json::json;

use crate::calib::schema::{self, Calibration};
use crate::whole;
use judgement::Grade;
use solve::{Choice, Options, Rotor, Solution};

/// What a calibration may be told.
#[derive(clap::Args, Clone, Debug)]
#[command(group = clap::ArgGroup::new("from").required(true))]
pub struct Arguments {
    /// Sweeps and truth of a walk: a recording's folder, or a capture (pcap, pcapng) of a mote that sends angles
    #[arg(long, value_name = "DIR|FILE", group = "from")]
    pub recording: Option<PathBuf>,
    /// No motion capture: a list of five or more known places, to which you are led one by one
    #[arg(long, value_name = "FILE", group = "from")]
    pub points: Option<PathBuf>,
    /// Where the mote was: a CSV file with time_s, x_m, y_m, z_m, or what OptiTrack's Motive exports
    #[arg(long, value_name = "FILE", conflicts_with = "points")]
    pub truth: Option<PathBuf>,
    /// Which body of a Motive export is the mote
    #[arg(long, value_name = "NAME", requires = "truth")]
    pub body: Option<String>,
    /// How far apart the clocks of sweeps and --truth may be, seconds, either way
    #[arg(long, value_name = "SECONDS", default_value_t = 60.0, requires = "truth", value_parser = apart)]
    pub offset: f64,
    /// Which photodiode of the recording plays the mote's
    #[arg(long, value_name = "NUMBER", default_value_t = 0, conflicts_with = "points")]
    pub sensor: u32,
    /// Where angles come from: a capture that grows, a pipe, or - for the standard input
    #[arg(long, value_name = "FILE", conflicts_with_all = ["simulate", "recording"])]
    pub frames: Option<PathBuf>,
    /// Try a session without hardware, in a virtual room around the places
    #[arg(long, conflicts_with = "recording")]
    pub simulate: bool,
    /// Whether factory terms of the rotors are fitted; auto: if light held out of the fit gets better
    #[arg(long, value_enum, default_value = "auto")]
    pub factory: Factory,
    /// For the draws of the search
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Where the room goes
    #[arg(short, long, value_name = "FILE", default_value = "calib/lab.toml")]
    pub output: PathBuf,
    /// Where the report goes [default: target/calibrate/report.html]
    #[arg(long, value_name = "FILE")]
    pub report: Option<PathBuf>,
    /// Write the room even if it cannot be trusted, and over a file that this did not write
    #[arg(long)]
    pub force: bool,
}

/// Whether factory terms are fitted.
#[derive(clap::ValueEnum, Clone, Copy, Debug, PartialEq, Eq)]
pub enum Factory {
    /// If light held out of the fit gets better.
    Auto,
    /// No.
    Never,
    /// Whatever comes of it.
    Always,
}

fn apart(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(seconds) if (0.0..=3600.0).contains(&seconds) => Ok(seconds),
        Ok(seconds) => Err(format!("{seconds} is not in 0 ..= 3600")),
        Err(error) => Err(error.to_string()),
    }
}

/// Whom the tool talks to.
pub struct Person<'a> {
    /// What is typed.
    pub input: &'a mut dyn BufRead,
    /// What is read.
    pub output: &'a mut dyn Write,
    /// Whether both are a terminal.
    pub terminal: bool,
}

/// Somebody who may stop reading: the room is worth having all the same.
struct Leaving<W>(W);

/// What nobody reads counts as written.
fn unread<T>(done: io::Result<T>, as_written: T) -> io::Result<T> {
    done.or_else(|error| if error.kind() == io::ErrorKind::BrokenPipe { Ok(as_written) } else { Err(error) })
}

impl<W: Write> Write for Leaving<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        unread(self.0.write(bytes), bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        unread(self.0.flush(), ())
    }
}

/// Calibrates for the person at the terminal.
pub fn calibrate(arguments: &Arguments) -> Result<()> {
    let terminal = io::stdout().is_terminal();
    let (mut stdin, mut stdout) = (io::stdin().lock(), Leaving(io::stdout()));
    if arguments.frames.as_deref() == Some(Path::new("-")) {
        drop(stdin);
        // The standard input brings frames, so the person is asked at the terminal itself.
        let tty = File::open("/dev/tty").context("--frames -: there is no terminal to press Enter at")?;
        let person = Person { input: &mut BufReader::new(tty), output: &mut stdout, terminal };
        return run(arguments, person);
    }
    let terminal = terminal && io::stdin().is_terminal();
    run(arguments, Person { input: &mut stdin, output: &mut stdout, terminal })
}

/// Calibrates.
pub fn run(arguments: &Arguments, mut person: Person<'_>) -> Result<()> {
    let earlier = earlier(&arguments.output, arguments.force)?;
    let page = arguments.report.clone().unwrap_or_else(|| root().join("target/calibrate/report.html"));
    for file in [&arguments.output, &page] {
        let folder = whole::folder(file);
        fs::create_dir_all(folder).with_context(|| format!("{}: cannot be made", folder.display()))?;
        ensure!(!file.is_dir(), "{}: is a folder", file.display());
        whole::writable(file)?;
    }
    let mut gathered = match (&arguments.recording, &arguments.points) {
        (Some(recording), _) => gather::walk(arguments, recording)?,
        (None, Some(points)) => gather::visit(arguments, points, &mut person)?,
        (None, None) => bail!("nothing to calibrate from: --recording or --points"),
    };
    let factory = own_terms(earlier.as_ref(), &mut gathered.notes);
    writeln!(person.output, "{}", gathered.title)?;
    for note in &gathered.notes {
        writeln!(person.output, "  {note}")?;
    }
    let options = Options {
        seed: arguments.seed,
        offset_search_s: gathered.apart_s.map(|apart| (-apart, apart)),
        fit_factory: match arguments.factory {
            Factory::Auto => Choice::Auto,
            Factory::Never => Choice::Never,
            Factory::Always => Choice::Always,
        },
        attitudes: gathered.attitudes.clone(),
        factory,
        late: gathered.recorded.is_some(),
        before: earlier.as_ref().map(gather::stood).or(gathered.stood).filter(|_| !arguments.force),
        ..Options::default()
    };
    let mut progress = Progress::new(person.output, person.terminal);
    let solved =
        solve::solve(&gathered.sightings, &gathered.truth, &options, &mut |what, part| progress.show(what, part));
    progress.end();
    let solution = solved.map_err(|trouble| anyhow!("{}: {trouble}", gathered.title))?;

    let figures = account::figures(&solution, &gathered);
    let judgement = figures.judge();
    let provenance = account::provenance(&gathered, &solution, &figures, &judgement.sentence);
    let path: Vec<[f64; 3]> = account::path(&solution, gathered.places);
    let mut mote = earlier.as_ref().map_or_else(|| Ok(room::usual_mote()), |_| room::mote_of(&arguments.output))?;
    if !gathered.places {
        // Averages of a place say nothing of one sweep.
        mote.insert("angle_noise_mrad".to_string(), room::angle_noise_mrad(&solution.held_out).into());
    }
    let name = arguments.output.display().to_string();
    let said = gathered.notes.len();
    let told = told(earlier.as_ref(), &solution, &mut gathered.notes);
    let room = room::write(&name, &solution.stations, &told, &path, &mote, &provenance)?;

    let evidence: Vec<String> = solution.evidence.iter().chain(&gathered.notes).cloned().collect();
    let facts = account::facts(&gathered, &solution, &figures, &room);
    let html = report::html(&report::Report {
        title: &gathered.title,
        judgement: &judgement,
        figures: &figures,
        stations: &solution.stations,
        residuals: &solution.residuals,
        path: &path,
        places: gathered.places,
        evidence: &evidence,
        facts: &facts,
        provenance: &provenance,
        room: &room,
    });
    whole::write(&page, html.as_bytes())?;
    let summary = json!({
        "held_out_mm": 1000.0 * figures.held_out_m,
        "sweeps": figures.rotors.iter().map(|rotor| rotor.paired).sum::<usize>(),
        "condition": figures.condition,
        "truth_late_ms": account::late(&gathered, &solution).map(|late| 1000.0 * late.late_s),
        "truth_drift_ppm": solution.drift.map(|drift| 1e6 * drift),
        "verdict": judgement.sentence,
    });
    whole::json(&page.with_extension("json"), &summary)?;
    let out = &mut person.output;
    writeln!(out, "{}", account::table(&figures, &facts))?;
    for sentence in &solution.evidence {
        writeln!(out, "{sentence}")?;
    }
    for note in &gathered.notes[said..] {
        writeln!(out, "{note}")?;
    }
    writeln!(out, "\n{}\nreport: {}", judgement.sentence, page.display())?;
    ensure!(
        judgement.grade != Grade::Refused || arguments.force,
        "{name}: not written, because it would mislead a mote; see the report, or use --force"
    );
    let kept = whole::replace(&arguments.output, room.text.as_bytes())?;
    let kept = kept.map_or(String::new(), |kept| format!(" (the one before is {})", kept.display()));
    writeln!(out, "room: {name}{kept}\nnext: cargo xtask bake {name}; cargo xtask run --calib {name}")?;
    Ok(())
}

/// The root of the repository.
fn root() -> &'static Path {
    let xtask = Path::new(env!("CARGO_MANIFEST_DIR"));
    xtask.parent().unwrap_or(xtask)
}

/// How the tool marks its own files, under `tool`.
const TOOL: &str = "cargo xtask calibrate";

/// The room that is to be replaced, if it is one of ours.
fn earlier(output: &Path, force: bool) -> Result<Option<Calibration>> {
    if !output.exists() {
        return Ok(None);
    }
    match schema::open(output) {
        Ok(room) if force || room.provenance.iter().any(|(key, value)| key == "tool" && value.contains(TOOL)) => {
            Ok(Some(room))
        }
        Err(_) if force => Ok(None),
        Ok(_) => bail!("{}: was not written by {TOOL}; name another file, or use --force", output.display()),
        Err(error) => bail!("{error}; name another file, or use --force to replace this one"),
    }
}

/// The stations' own factory terms, where the room that is to be replaced has motes use those that are received: poses
/// that were fitted with others would be wrong as soon as they come.
fn own_terms(earlier: Option<&Calibration>, notes: &mut Vec<String>) -> [Option<[Rotor; 2]>; 2] {
    let Some(room) = earlier else { return [None; 2] };
    let received = room.received();
    std::array::from_fn(|s| {
        let (name, terms) = (["A", "B"][s], room.stations[s].factory);
        if !received[s] {
            return None;
        }
        if terms.iter().any(|rotor| *rotor != Rotor::default()) {
            notes.push(format!("station {name}, factory = \"received\": its own terms are taken from the room before"));
            return Some(terms);
        }
        notes.push(format!(
            "station {name}, factory = \"received\", but the room before lacks its own terms: what is fitted instead will \
             not go with what motes receive; write them under [station.{name}.factory] first"
        ));
        None
    })
}

/// What the room that is to be replaced says of its stations, if they are still the same.
fn told(earlier: Option<&Calibration>, solution: &Solution, notes: &mut Vec<String>) -> [room::Told; 2] {
    let Some(room) = earlier else { return Default::default() };
    let told = room::Told::of(room);
    let ids = told.each_ref().map(|told| told.id);
    if ids == [None; 2] {
        return told;
    }
    if solve::exchanged(&solution.stations, &gather::stood(room)).is_some() {
        notes.push("the stations changed places, so their serial numbers are not kept".to_string());
        return told.map(|told| room::Told { id: None, ..told });
    }
    for (name, id) in ["A", "B"].into_iter().zip(ids) {
        notes.extend(id.map(|id| format!("station {name}'s serial number is {id}, as in the room before")));
    }
    told
}

/// The line that shows how far the solver is.
struct Progress<'a> {
    out: &'a mut dyn Write,
    terminal: bool,
    shown: Option<(String, Instant)>,
}

/// How often the line is written anew.
const REDRAW: Duration = Duration::from_millis(100);

impl<'a> Progress<'a> {
    fn new(out: &'a mut dyn Write, terminal: bool) -> Self {
        Self { out, terminal, shown: None }
    }

    fn show(&mut self, what: &str, part: f64) {
        let new = self.shown.as_ref().is_none_or(|(before, _)| before != what);
        let due = self.shown.as_ref().is_none_or(|(_, at)| at.elapsed() > REDRAW);
        // A terminal that is gone is no reason to stop.
        if self.terminal && (new || due) {
            let _ = write!(self.out, "\r\x1b[2K  {what} {:3.0} %", 100.0 * part);
            let _ = self.out.flush();
        } else if new {
            let _ = writeln!(self.out, "  {what}");
        } else {
            return;
        }
        self.shown = Some((what.to_string(), Instant::now()));
    }

    fn end(&mut self) {
        if self.terminal {
            let _ = write!(self.out, "\r\x1b[2K");
        }
    }
}
