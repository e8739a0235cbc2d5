//! Recordings of real light, from `cargo xtask calibrate` to the firmware in the virtual mote: as exact as was asked for.

#[path = "calibrate/recordings.rs"]
mod recordings;

use std::path::Path;
use std::process::Command;
use std::sync::{Mutex, MutexGuard, PoisonError};

use recordings::{recording, shown};
use serde_json::Value;

/// Images are built one after another: each replaces the one before.
static BUILDING: Mutex<()> = Mutex::new(());

fn building() -> MutexGuard<'static, ()> {
    BUILDING.lock().unwrap_or_else(PoisonError::into_inner)
}

/// What a person types, and what is printed.
fn xtask(words: &[&str]) -> String {
    let mut command = Command::new(env!("CARGO_BIN_EXE_xtask"));
    command.args(words).env_remove("LIGHTHOUSE_CALIB").env_remove("LIGHTHOUSE_MOTE");
    let output = command.output().expect("the tool runs");
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{words:?}: {said}\n{}", String::from_utf8_lossy(&output.stderr));
    said
}

/// The firmware in the light of a recording, with `more` arguments: figures by name, and what was printed.
fn flown(recording: &Path, home: &Path, more: &[&str]) -> (Value, String) {
    let out = home.join("run");
    let said = xtask(&[&["run", "--recording", shown(recording), "--out", shown(&out)], more].concat());
    println!("{}", said.split_once("Recording").map_or("", |(_, table)| table));
    let text = std::fs::read_to_string(out.join("summary.json")).expect("a summary");
    (serde_json::from_str(&text).expect("figures"), said)
}

/// Calibrates on the recording's window and flies in the room that came of it.
fn calibrated_and_flown(recording: &Path, home: &Path) -> (Value, String) {
    let [room, page] = ["lab.toml", "report.html"].map(|name| home.join(name));
    let said = xtask(&["calibrate", "--recording", shown(recording), "-o", shown(&room), "--report", shown(&page)]);
    assert!(said.contains("This calibration can be trusted"), "{said}");
    flown(recording, home, &["--calib", shown(&room)])
}

fn number(figures: &Value, key: &str) -> f64 {
    figures[key].as_f64().unwrap_or(f64::NAN)
}

#[test]
fn the_run_of_the_2020_paper_meets_its_targets_in_the_room_calibrated_on_its_window() {
    let Some(take5) = recording("scum-take5") else { return };
    let (_one, home) = (building(), tempfile::tempdir().expect("a folder"));
    let (figures, said) = calibrated_and_flown(&take5, home.path());
    // The targets are those of the truth as written.
    let written = &figures["others"]["truth as written"];
    for (axis, limit_cm) in [0.45, 0.28, 0.85].into_iter().enumerate() {
        let error_cm = written["mae_cm"][axis].as_f64().expect("a figure");
        assert!(error_cm <= limit_cm, "axis {axis}: {error_cm} cm");
    }
    assert!(number(written, "rms3d_cm") <= 2.5 && number(written, "coverage") >= 0.95, "{said}");
    // Its clock loses on the rotors. Eight parts of the whole recording, each by itself, are late by 30 ms at the beginning
    // and early by 8 to 19 ms at the end, on a line of -425 ppm; the window is a quarter of it.
    let drift_ppm = number(&figures, "truth_drift_ppm");
    assert!((drift_ppm + 425.0).abs() < 75.0, "{drift_ppm} ppm");
    // What is left of it on the rows that were not fitted: 70 ppm over the minute before the window are 4 ms.
    let left_ms = number(&figures, "truth_late_ms_by_scored_rows") - number(&figures, "truth_late_ms");
    assert!(left_ms.abs() < 4.2, "{left_ms} ms");
    // 30 ms at 0.34 m/s are a centimetre.
    assert!(number(&figures, "mean3d_cm") < 0.75 && number(written, "mean3d_cm") > 0.9, "{said}");
}

#[test]
fn the_flight_calibrated_on_its_first_half_is_followed_in_its_second() {
    let Some(flight) = recording("crazyflie-lh1-flight") else { return };
    let (_one, home) = (building(), tempfile::tempdir().expect("a folder"));
    let (figures, said) = calibrated_and_flown(&flight, home.path());
    assert!(number(&figures, "mean3d_cm") <= 0.65 && number(&figures, "coverage") >= 0.95, "{said}");
    // How late the truth is, was found in the first half, and that its clock loses 55 ppm on the rotors. With that, the
    // second by itself says 13.5; at 0.52 m/s the difference is half a millimetre.
    let late_ms = number(&figures, "truth_late_ms");
    assert!((late_ms - 14.5).abs() < 0.5, "{late_ms} ms");
    assert!((number(&figures, "truth_late_ms_by_scored_rows") - late_ms).abs() < 1.5, "{said}");
    let drift_ppm = number(&figures, "truth_drift_ppm");
    assert!((drift_ppm + 55.0).abs() < 10.0, "{drift_ppm} ppm");
    // And what comes of it without is there for everybody to see.
    let written = &figures["others"]["truth as written"];
    assert!(said.contains("\ntruth as written ") && written["scored"] == figures["scored"], "{said}");
    assert!(number(written, "mean3d_cm") > number(&figures, "mean3d_cm") && number(written, "mean3d_cm") < 0.85);
}

#[test]
fn the_flight_with_the_stations_as_given_is_followed_without_any_fitting() {
    let Some(flight) = recording("crazyflie-lh1-flight") else { return };
    let (_one, home) = (building(), tempfile::tempdir().expect("a folder"));
    let (figures, said) = flown(&flight, home.path(), &[]);
    assert!(number(&figures, "mean3d_cm") <= 2.4 && number(&figures, "coverage") >= 0.95, "{said}");
    assert_eq!(figures["truth_late_ms"], Value::Null, "nobody has said so");
}
