//! From sweeps and truth to a room that can be flown: `cargo xtask calibrate`.
//!
//! Sweeps come from a recording, from captured frames of a mote that sends its angles, or from a [`session`] at known
//! places; truth from motion capture ([`truth`]) or from those places. [`solve`] makes a room of them, [`judgement`]
//! says whether to trust it, [`room`] writes it down in the project's own format and [`report`] draws it.
//!
//! # Design
//! Everything that is asked for is read before anything is solved, and every file appears whole or not at all. A room
//! file that this tool wrote is replaced, and the one before stays beside it as `.toml~`; a file of anybody else's is
//! not touched without `--force`. What stands under `[mote]` is the user's and is carried over. A room that cannot be
//! trusted leaves a report and no room file.
//!
//! # What can go wrong
//! See each part; each way has a name and the numbers that show it.

pub mod capture;
pub mod judgement;
pub mod lateness;
pub mod live;
mod motive;
pub mod points;
pub mod report;
pub mod room;
pub mod session;
pub mod simulate;
pub mod solve;
pub mod sweeps;
pub mod truth;

use std::fmt::Write as _;
use std::fs::{self, File};
use std::io::{BufRead, BufReader, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow, bail, ensure};
use nalgebra::Vector3;
use sha2::{Digest, Sha256};

use crate::calib::schema::{self, Calibration};
use crate::light::{Light, LightConfig, quantile};
use crate::recording::Recording;
use crate::reference::{Method, Room as ReferenceRoom};
use judgement::{Figures, Grade, OUTSIDE, Outside, RotorFigures, length};
use session::{Measured, Session, Source};
use simulate::Simulated;
use solve::{Attitude, Choice, Options, Rotor, Sighting, Solution, TruthSample};

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

/// Calibrates for the person at the terminal.
pub fn calibrate(arguments: &Arguments) -> Result<()> {
    let (mut stdin, mut stdout) = (std::io::stdin().lock(), std::io::stdout());
    let terminal = stdout.is_terminal();
    if arguments.frames.as_deref() == Some(Path::new("-")) {
        drop(stdin);
        // The standard input brings frames, so the person is asked at the terminal itself.
        let tty = File::open("/dev/tty").context("--frames -: there is no terminal to press Enter at")?;
        let person = Person { input: &mut BufReader::new(tty), output: &mut stdout, terminal };
        return run(arguments, person);
    }
    let terminal = terminal && std::io::stdin().is_terminal();
    run(arguments, Person { input: &mut stdin, output: &mut stdout, terminal })
}

/// Everything there is to solve.
struct Gathered {
    title: String,
    sightings: Vec<Sighting>,
    truth: Vec<TruthSample>,
    attitudes: Vec<Attitude>,
    /// Half the range in which the clocks' offset is searched; none when they are one clock.
    apart_s: Option<f64>,
    notes: Vec<String>,
    facts: Vec<(String, String)>,
    inputs: Vec<(String, String)>,
    /// Where the stations stood, metres, as what was read says.
    stood: Option<[Vector3<f64>; 2]>,
    /// Sweeps and truth of one log; the light is for scoring outside its window for fitting.
    recorded: Option<(Recording, Light)>,
    /// What the answer should be.
    simulated: Option<Simulated>,
    places: bool,
}

/// Calibrates.
pub fn run(arguments: &Arguments, mut person: Person<'_>) -> Result<()> {
    let earlier = earlier(&arguments.output, arguments.force)?;
    let page = arguments.report.clone().unwrap_or_else(|| root().join("target/calibrate/report.html"));
    for file in [&arguments.output, &page] {
        let folder = folder(file);
        fs::create_dir_all(folder).with_context(|| format!("{}: cannot be made", folder.display()))?;
        ensure!(!file.is_dir(), "{}: is a folder", file.display());
    }
    let mut gathered = match (&arguments.recording, &arguments.points) {
        (Some(recording), _) => walk(arguments, recording)?,
        (None, Some(points)) => visit(arguments, points, &mut person)?,
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
        before: earlier.as_ref().map(stood).or(gathered.stood).filter(|_| !arguments.force),
        ..Options::default()
    };
    let mut progress = Progress::new(person.output, person.terminal);
    let solved =
        solve::solve(&gathered.sightings, &gathered.truth, &options, &mut |what, part| progress.show(what, part));
    progress.end();
    let solution = solved.map_err(|trouble| anyhow!("{}: {trouble}", gathered.title))?;

    let figures = figures(&solution, &gathered);
    let judgement = figures.judge();
    let provenance = provenance(&gathered, &solution, &figures, &judgement.sentence);
    let path: Vec<[f64; 3]> = path(&solution, gathered.places);
    let mut mote = earlier.as_ref().map_or_else(|| Ok(room::usual_mote()), |_| room::mote_of(&arguments.output))?;
    if !gathered.places {
        // Averages of a place say nothing of one sweep.
        mote.insert("angle_noise_mrad".to_string(), room::angle_noise_mrad(&solution.held_out).into());
    }
    let name = arguments.output.display().to_string();
    let room = room::write(&name, &solution.stations, &path, &mote, &provenance)?;

    let evidence: Vec<String> = solution.evidence.iter().chain(&gathered.notes).cloned().collect();
    let facts = facts(&gathered, &solution, &figures, &room);
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
    write_whole(&page, html.as_bytes())?;
    let out = &mut person.output;
    writeln!(out, "{}", table(&figures, &facts))?;
    for sentence in &solution.evidence {
        writeln!(out, "{sentence}")?;
    }
    writeln!(out, "\n{}\nreport: {}", judgement.sentence, page.display())?;
    ensure!(
        judgement.grade != Grade::Refused || arguments.force,
        "{name}: not written, because it would mislead a mote; see the report, or use --force"
    );
    let kept = replace(&arguments.output, room.text.as_bytes())?;
    let kept = kept.map_or(String::new(), |kept| format!(" (the one before is {})", kept.display()));
    writeln!(out, "room: {name}{kept}\nnext: cargo xtask bake {name}; cargo xtask run --calib {name}")?;
    Ok(())
}

fn stood(room: &Calibration) -> [Vector3<f64>; 2] {
    room.stations.map(|station| Vector3::from(station.position))
}

/// The root of the repository.
fn root() -> &'static Path {
    let xtask = Path::new(env!("CARGO_MANIFEST_DIR"));
    xtask.parent().unwrap_or(xtask)
}

fn folder(file: &Path) -> &Path {
    file.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."))
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
fn own_terms(earlier: Option<&Calibration>, notes: &mut Vec<String>) -> Option<[[Rotor; 2]; 2]> {
    let room = earlier.filter(|room| room.received() == [true; 2])?;
    let terms = room.stations.map(|station| station.factory);
    if terms.as_flattened().iter().any(|rotor| *rotor != Rotor::default()) {
        notes.push("factory = \"received\": the stations' own terms are taken from the room before".to_string());
        return Some(terms);
    }
    notes.push(
        "factory = \"received\", but the room before lacks the stations' own terms: what is fitted instead will not go \
         with what motes receive; write them under [station.A.factory] and [station.B.factory] first"
            .to_string(),
    );
    None
}

/// Writes a file whole: beside its place first, then renamed into it.
pub fn write_whole(path: &Path, bytes: &[u8]) -> Result<()> {
    let name = path.display();
    let failed = || format!("{name}: cannot be written");
    let mut builder = tempfile::Builder::new();
    // A temporary file is its owner's alone; this one is to stay, as any other.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    let mut file = builder.prefix(".calibrate-").tempfile_in(folder(path)).with_context(failed)?;
    file.write_all(bytes).and_then(|()| file.as_file().sync_all()).with_context(failed)?;
    file.persist(path).with_context(|| format!("{name}: cannot be put in its place"))?;
    Ok(())
}

/// Writes a file whole and keeps what was there as `.toml~`; returns where.
fn replace(path: &Path, bytes: &[u8]) -> Result<Option<PathBuf>> {
    let mut kept = None;
    if path.exists() {
        let mut name = path.as_os_str().to_owned();
        name.push("~");
        let old = PathBuf::from(name);
        let before = fs::read(path).with_context(|| format!("{}: cannot be read", path.display()))?;
        write_whole(&old, &before)?;
        kept = Some(old);
    }
    write_whole(path, bytes)?;
    Ok(kept)
}

/// SHA-256 of a file, as hexadecimal digits.
fn hash(path: &Path) -> Result<String> {
    let bytes = fs::read(path).with_context(|| format!("{}: cannot be read", path.display()))?;
    Ok(hex(&Sha256::digest(bytes)))
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut out, byte| {
        let _ = write!(out, "{byte:02x}");
        out
    })
}

/// Reads sweeps and truth of a walk.
fn walk(arguments: &Arguments, from: &Path) -> Result<Gathered> {
    let name = from.file_name().map_or_else(|| from.display().to_string(), |name| name.to_string_lossy().into_owned());
    let truth = arguments.truth.as_deref().map(|file| truth::open(file, arguments.body.as_deref())).transpose()?;
    let mut inputs = Vec::new();
    let mut input = |path: &Path| -> Result<()> {
        inputs.push((path.display().to_string(), hash(path)?));
        Ok(())
    };
    let (sweeps, own, recorded) = if from.is_dir() {
        let recording = Recording::open(from)?.sensor(arguments.sensor)?;
        input(&from.join("recording.toml"))?;
        input(&from.join("sweeps.csv"))?;
        let light = Light::rebuild(&recording, &LightConfig::of(&recording))?;
        let (sweeps, own) = sweeps::of_recording(&recording, &light);
        (sweeps, own, Some((recording, light)))
    } else {
        ensure!(from.exists(), "{}: there is no such recording", from.display());
        input(from)?;
        (sweeps::of_capture(from)?, Vec::new(), None)
    };
    if let Some(file) = &arguments.truth {
        input(file)?;
    }
    let mut notes = sweeps.notes;
    if let Some((recording, _)) = recorded.as_ref().filter(|(recording, _)| recording.photodiodes > 1) {
        notes.push(format!("photodiode {} of {}: a mote has one", arguments.sensor, recording.photodiodes));
    }
    let facts = vec![("half turn".to_string(), format!("{:.1} ticks", sweeps.half_turn_ticks))];
    let (truth, attitudes, apart_s, recorded) = match truth {
        Some(truth) => {
            notes.push(format!(
                "truth is {}: {} places over {:.1} s, {} rows without one",
                truth.what,
                truth.samples.len(),
                truth.length_s(),
                truth.lost
            ));
            (truth.samples, truth.attitudes, Some(arguments.offset), None)
        }
        None => {
            ensure!(
                recorded.is_some(),
                "{}: a capture does not say where the mote was: add --truth, or use --points",
                from.display()
            );
            ensure!(
                !own.is_empty(),
                "{}: no row to fit on has a truth that can be trusted; add --truth",
                from.join("sweeps.csv").display()
            );
            (own, Vec::new(), None, recorded)
        }
    };
    // A recording's own stations, in another frame perhaps: good enough to notice that A and B changed places.
    let stood = recorded.as_ref().and_then(|(recording, _)| Some(stood(&schema::open(&recording.stations).ok()?)));
    Ok(Gathered {
        title: format!("Calibration from {name}"),
        stood,
        sightings: sweeps.sightings,
        truth,
        attitudes,
        apart_s,
        notes,
        facts,
        inputs,
        recorded,
        simulated: None,
        places: false,
    })
}

/// Leads a person through the known places.
fn visit(arguments: &Arguments, file: &Path, person: &mut Person<'_>) -> Result<Gathered> {
    let points = points::open(file)?;
    let stem = file.file_stem().map_or_else(|| "points".into(), |stem| stem.to_string_lossy().into_owned());
    let simulated = arguments.simulate.then(|| Simulated::around(&points.points, arguments.seed, person.terminal));
    let mut live;
    let mut played = simulated;
    let source: &mut dyn Source = match (&mut played, &arguments.frames) {
        (Some(simulated), _) => simulated,
        (None, Some(frames)) => {
            live = live::Live::open(frames)?;
            &mut live
        }
        (None, None) => bail!("--points needs to know where angles come from: --frames FILE, or --simulate to try it"),
    };
    // A simulated session and a real one never share a folder.
    let kind = if arguments.simulate { "simulated" } else { "points" };
    let page = arguments.report.as_deref().map(folder);
    let folder = page.map_or_else(|| root().join("target/calibrate"), Path::to_path_buf).join(format!("{kind}-{stem}"));
    let mut session =
        Session { folder: folder.clone(), input: person.input, output: person.output, terminal: person.terminal };
    let measured = session.run(&points, source)?;
    let (sightings, truth) = session::averages(&measured);
    let mut inputs = vec![(file.display().to_string(), hash(file)?)];
    inputs.push((format!("{} places in {}", measured.len(), folder.display()), hash_of_places(&measured)));
    let names: Vec<&str> = measured.iter().map(|m| m.point.name.as_str()).collect();
    let notes = vec![format!("{} places: {}", names.len(), names.join(", "))];
    let what = if arguments.simulate { "a simulated session" } else { "a session" };
    Ok(Gathered {
        title: format!("Calibration from {what} at the places of {stem}"),
        stood: None,
        sightings,
        truth,
        attitudes: Vec::new(),
        apart_s: None,
        notes,
        facts: Vec::new(),
        inputs,
        recorded: None,
        simulated: played,
        places: true,
    })
}

fn hash_of_places(measured: &[Measured]) -> String {
    let mut all = Sha256::new();
    for place in measured {
        all.update(place.point.name.as_bytes());
        for sighting in &place.sightings {
            all.update(format!("{:.6},{},{},{:.8}\n", sighting.at_s, sighting.station, sighting.axis, sighting.angle));
        }
    }
    hex(&all.finalize())
}

fn figures(solution: &Solution, gathered: &Gathered) -> Figures {
    let rotors = std::array::from_fn(|index| {
        let (station, axis) = (index / 2, index % 2);
        let fit = &solution.per_rotor[station][axis];
        RotorFigures {
            paired: fit.n,
            rms_deg: fit.rms.to_degrees(),
            median_deg: fit.median_abs.to_degrees(),
            rejected: fit.rejected_share,
            held_out_deg: solution.held_out.rms[station][axis].to_degrees(),
        }
    });
    let recorded = gathered.recorded.as_ref().filter(|(recording, _)| !recording.calibrate.is_empty());
    let outside = recorded.map(|(recording, light)| {
        let method = Method::plain(ReferenceRoom { stations: solution.stations.clone() });
        let late_s = late_s(gathered, solution);
        let score = method.score_midway(recording, light, late_s.unwrap_or(0.0));
        let as_written = method.score_midway(recording, light, 0.0);
        Outside {
            mean_m: score.mean3d_cm / 100.0,
            share: score.coverage(),
            late_s,
            as_written_m: as_written.mean3d_cm / 100.0,
        }
    });
    let mut distances: Vec<f64> = solution
        .residuals
        .iter()
        .filter(|residual| residual.kept)
        .map(|residual| (residual.position - solution.stations[residual.station].position).norm())
        .collect();
    Figures {
        rotors,
        condition: solution.condition,
        held_out_m: solution.held_out.mean_3d_m,
        outside,
        distance_m: quantile(&mut distances, 0.5),
    }
}

/// By how much the truth is late, seconds, where it is on the mote's clock and that was fitted.
fn late_s(gathered: &Gathered, solution: &Solution) -> Option<f64> {
    (gathered.apart_s.is_none() && solution.offset_s != 0.0).then_some(solution.offset_s)
}

/// Where the kept sweeps were, in the order of time; each place once where they are places.
fn path(solution: &Solution, places: bool) -> Vec<[f64; 3]> {
    let mut path: Vec<[f64; 3]> = solution.residuals.iter().filter(|r| r.kept).map(|r| r.position.into()).collect();
    if places {
        path.dedup();
    }
    path
}

fn provenance(
    gathered: &Gathered,
    solution: &Solution,
    figures: &Figures,
    verdict: &str,
) -> Vec<(String, toml::Value)> {
    let today = time::OffsetDateTime::now_utc().date();
    let date = format!("{:04}-{:02}-{:02}", today.year(), u8::from(today.month()), today.day());
    let mut rows: Vec<(String, toml::Value)> = Vec::new();
    let mut say = |key: &str, value: String| rows.push((key.to_string(), value.into()));
    say("what", gathered.title.clone());
    say("date", date);
    say("tool", format!("{TOOL}, version {}", env!("CARGO_PKG_VERSION")));
    say("verdict", verdict.to_string());
    for (index, (name, hash)) in gathered.inputs.iter().enumerate() {
        say(&format!("input_{}", index + 1), format!("{name}, SHA-256 {hash}"));
    }
    for (name, rotor) in session::ROTORS.iter().zip(&figures.rotors) {
        let words = format!(
            "{:.3} deg RMS over {} sweeps, {:.1} % of them turned away",
            rotor.rms_deg,
            rotor.paired,
            100.0 * rotor.rejected
        );
        say(&format!("residual_{}", name.replace(' ', "_")), words);
    }
    say("held_out_mean_error", length(figures.held_out_m));
    if let Some(outside) = &figures.outside {
        say(&OUTSIDE.replace(' ', "_"), outside.words());
    }
    say("condition", format!("{:.0}", figures.condition));
    if gathered.apart_s.is_some() {
        say("time_offset", format!("truth's clock less the mote's {:.4} s", solution.offset_s));
    }
    if let Some(arm) = solution.lever_arm {
        let [x, y, z] = arm.into();
        say("lever_arm", format!("({x:.4}, {y:.4}, {z:.4}) m on the tracked body"));
    }
    if let Some(late_s) = late_s(gathered, solution) {
        rows.push((lateness::KEY.to_string(), ((1e5 * late_s).round() / 100.0).into()));
    }
    rows
}

fn facts(gathered: &Gathered, solution: &Solution, figures: &Figures, room: &room::Room) -> Vec<(String, String)> {
    let mut facts = gathered.facts.clone();
    let place = |p: [f64; 3]| format!("({:.3}, {:.3}, {:.3}) m", p[0], p[1], p[2]);
    for (name, station) in ["station A", "station B"].into_iter().zip(&solution.stations) {
        facts.push((name.to_string(), place(station.position.into())));
    }
    facts.push(("median distance to a station".to_string(), length(figures.distance_m)));
    if gathered.apart_s.is_some() {
        facts.push(("truth's clock less the mote's".to_string(), format!("{:.4} s", solution.offset_s)));
    } else if let Some(late_s) = late_s(gathered, solution) {
        facts.push(("how late the truth is".to_string(), format!("{:.1} ms", 1000.0 * late_s)));
    }
    if let Some(arm) = solution.lever_arm {
        facts.push(("photodiode on the tracked body".to_string(), place(arm.into())));
    }
    let volume = room.held.volume;
    let margin = room
        .margin_m
        .map_or("chosen from the stations' view".to_string(), |m| format!("the path and {} around it", length(m)));
    facts.push(("room".to_string(), format!("{} to {}: {margin}", place(volume.min), place(volume.max))));
    let choice = &room.held.baked.choice;
    let choice = choice.split_once(" (").map_or(choice.as_str(), |(choice, _)| choice);
    facts.push(("solver on the mote".to_string(), choice.to_string()));
    let measured = &room.held.baked.measured;
    let words = format!("{:.3} mm RMS, {:.2} mm at most", measured.rms_mm, measured.max_mm);
    facts.push(("its arithmetic against least squares in f64".to_string(), words));
    if let Some(simulated) = &gathered.simulated {
        let off = |n: usize| (Vector3::from(simulated.stations[n].position_m) - solution.stations[n].position).norm();
        facts.push((
            "stations against the simulated ones".to_string(),
            format!("A {} off, B {} off", length(off(0)), length(off(1))),
        ));
    }
    facts
}

/// The figures for the terminal.
fn table(figures: &Figures, facts: &[(String, String)]) -> String {
    let mut out = String::from("\nrotor | sweeps | turned away |  RMS deg | median deg | held out deg\n");
    out.push_str("------+--------+-------------+----------+------------+-------------\n");
    for (name, rotor) in session::ROTORS.iter().zip(&figures.rotors) {
        let _ = writeln!(
            out,
            "{name:5} | {:6} | {:9.1} % | {:8.3} | {:10.3} | {:12.3}",
            rotor.paired,
            100.0 * rotor.rejected,
            rotor.rms_deg,
            rotor.median_deg,
            rotor.held_out_deg
        );
    }
    out.push('\n');
    let mut rows = vec![("mean error, held out".to_string(), length(figures.held_out_m))];
    rows.extend(figures.outside.map(|outside| (OUTSIDE.to_string(), outside.words())));
    rows.push(("condition".to_string(), format!("{:.0}", figures.condition)));
    let rows: Vec<&(String, String)> = rows.iter().chain(facts).collect();
    let wide = rows.iter().map(|(key, _)| key.len()).max().unwrap_or(0);
    for (key, value) in rows {
        let _ = writeln!(out, "{key:wide$}  {value}");
    }
    out
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
