//! The calibration's solver held against OpenCV's on simulated rooms.
//!
//! A solver that is worse than OpenCV's is an error.
//!
//! What can go wrong: no Python, or no way to get its packages. That is said, and is no failure: the solver's own
//! accuracy is asserted by a test that needs neither.

use std::panic::resume_unwind;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicU64, Ordering};

use anyhow::{Context, Result, ensure};
use serde_json::{Value, json};
use xtask::calibrate::solve::rooms::{Kind, Simulated, simulate};
use xtask::calibrate::solve::{Choice, Options, Station, solve};

use crate::process::{root, run};

/// Simulates rooms, solves them, and has OpenCV solve them too.
pub(crate) fn oracle(rooms: u64) -> Result<()> {
    let folder = root().join("target/oracle");
    std::fs::create_dir_all(&folder).with_context(|| folder.display().to_string())?;
    let (next, done) = (AtomicU64::new(0), AtomicU64::new(0));
    let work = || {
        let mut solved = Vec::new();
        loop {
            let seed = next.fetch_add(1, Ordering::Relaxed);
            if seed >= rooms {
                return solved;
            }
            solved.push((seed, room(seed)));
            let done = 1 + done.fetch_add(1, Ordering::Relaxed);
            if done.is_multiple_of(100) {
                println!("{done} of {rooms} rooms");
            }
        }
    };
    let workers = std::thread::available_parallelism().map_or(1, usize::from);
    let mut solved: Vec<(u64, Value)> = std::thread::scope(|scope| {
        let workers: Vec<_> = (0..workers).map(|_| scope.spawn(work)).collect();
        let joined = workers.into_iter().map(|worker| worker.join().unwrap_or_else(|panic| resume_unwind(panic)));
        joined.flatten().collect()
    });
    ensure!(solved.len() as u64 == rooms, "{} of {rooms} rooms were solved", solved.len());
    solved.sort_by_key(|room| room.0);
    let solved: Vec<Value> = solved.into_iter().map(|room| room.1).collect();
    let file = folder.join("rooms.json");
    let text = json!({ "noise_rad": Kind::ORACLE.noise, "rooms": solved }).to_string();
    std::fs::write(&file, text).with_context(|| file.display().to_string())?;

    let python = folder.join("venv/bin/python");
    if let Err(reason) = install(&folder, &python) {
        println!("skipped: OpenCV for Python cannot be installed here: {reason:#}");
        return Ok(());
    }
    let summary = folder.join(format!("summary-{rooms}.json"));
    run(Command::new(&python).arg(root().join("tests/oracle/opencv.py")).arg(&file).arg(&summary))
}

/// A Python of our own with OpenCV.
fn install(folder: &Path, python: &Path) -> Result<()> {
    let wanted = root().join("tests/oracle/requirements.txt");
    let quiet = |command: &mut Command| run(command.stdout(Stdio::null()).stderr(Stdio::null()));
    if !python.is_file() {
        quiet(Command::new("python3").args(["-m", "venv"]).arg(folder.join("venv")))?;
    }
    quiet(Command::new(python).args(["-m", "pip", "install", "-q", "--retries", "1", "-r"]).arg(wanted))
}

fn room(seed: u64) -> Value {
    let Simulated { stations, sightings, truth } = simulate(&Kind::ORACLE, seed);
    let options = Options { seed, fit_factory: Choice::Never, ..Options::default() };
    let solved = solve(&sightings, &truth, &options, &mut |_, _| {}).ok();
    let places: Vec<[f64; 3]> = truth.iter().map(|sample| sample.position.into()).collect();
    let station = |s: usize| {
        let angles = |axis: usize| sightings.iter().filter(move |x| (x.station, x.axis) == (s, axis)).map(|x| x.angle);
        json!({
            "true": pose(&stations[s]),
            "solved": solved.as_ref().map(|solved| pose(&solved.stations[s])),
            "angles": angles(0).zip(angles(1)).map(|(az, el)| [az, el]).collect::<Vec<_>>(),
        })
    };
    json!({ "places": places, "stations": [station(0), station(1)] })
}

fn pose(station: &Station) -> Value {
    let rows: Vec<[f64; 3]> = station.rotation.row_iter().map(|row| row.transpose().into()).collect();
    json!({ "rotation": rows, "position": station.position.as_slice() })
}
