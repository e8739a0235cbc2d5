//! What there is to solve: sweeps and truth of a walk, or of a session at known places, and where they come from.
//!
//! What can go wrong: a file that is not there or not what it should be, a walk without truth. Nothing has been solved or
//! written by then.

use std::fs;
use std::path::Path;

use anyhow::{Context, Result, bail, ensure};
use nalgebra::Vector3;
use sha2::{Digest, Sha256};

use super::session::{self, Measured, Session, Source};
use super::simulate::Simulated;
use super::solve::{Attitude, Sighting, TruthSample};
use super::{Arguments, Person, live, points, root, sweeps, truth};
use crate::calib::schema::{self, Calibration};
use crate::light::{Light, LightConfig};
use crate::recording::Recording;
use crate::whole;

/// Everything there is to solve.
pub(super) struct Gathered {
    pub(super) title: String,
    pub(super) sightings: Vec<Sighting>,
    pub(super) truth: Vec<TruthSample>,
    pub(super) attitudes: Vec<Attitude>,
    /// Half the range in which the clocks' offset is searched; none when they are one clock.
    pub(super) apart_s: Option<f64>,
    pub(super) notes: Vec<String>,
    pub(super) facts: Vec<(String, String)>,
    pub(super) inputs: Vec<(String, String)>,
    /// Where the stations stood, metres, as what was read says.
    pub(super) stood: Option<[Vector3<f64>; 2]>,
    /// Sweeps and truth of one log; the light is for scoring outside its window for fitting.
    pub(super) recorded: Option<(Recording, Light)>,
    /// What the answer should be.
    pub(super) simulated: Option<Simulated>,
    pub(super) places: bool,
}

/// Where a room's stations stand, metres.
pub(super) fn stood(room: &Calibration) -> [Vector3<f64>; 2] {
    room.stations.map(|station| Vector3::from(station.position))
}

/// Reads sweeps and truth of a walk.
pub(super) fn walk(arguments: &Arguments, from: &Path) -> Result<Gathered> {
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
pub(super) fn visit(arguments: &Arguments, file: &Path, person: &mut Person<'_>) -> Result<Gathered> {
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
    let page = arguments.report.as_deref().map(whole::folder);
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

/// SHA-256 of a file, as hexadecimal digits.
pub(super) fn hash(path: &Path) -> Result<String> {
    let bytes = fs::read(path).with_context(|| format!("{}: cannot be read", path.display()))?;
    Ok(hex::encode(Sha256::digest(bytes)))
}

fn hash_of_places(measured: &[Measured]) -> String {
    let mut all = Sha256::new();
    for place in measured {
        all.update(place.point.name.as_bytes());
        for sighting in &place.sightings {
            all.update(format!("{:.6},{},{},{:.8}\n", sighting.at_s, sighting.station, sighting.axis, sighting.angle));
        }
    }
    hex::encode(all.finalize())
}
