//! How late a recording's truth is, as a room that was calibrated on it says.
//!
//! A log holds of motion capture what had come by then: where the mote was some milliseconds before. How many is found
//! within the window for fitting, and so is by how much that grows: truth and sweeps are from two clocks. Both stand in the
//! room's provenance, beside the hashes of what they were found on. They are properties of that recording and of no other,
//! so whoever scores the same recording takes its truth so much later.
//!
//! What can go wrong: the recording, or its window, is another one by now. Then its truth is taken as it is written,
//! and that is said.

use std::str::FromStr;

use anyhow::{Result, anyhow, ensure};

use super::gather::hash;
use super::solve::{LATEST_S, MOST_DRIFT, Solution};
use crate::calib::schema::Calibration;
use crate::light::{HALF_TURNS_HZ, Light};
use crate::recording::{self, Recording};
use crate::score::Late;

/// The key in the provenance.
pub const KEY: &str = "truth_late_ms";
/// Beside it, where it grows: by how much, and the timestamp at which it is that much.
const DRIFT: &str = "truth_drift_ppm";
const AT: &str = "truth_late_at_ticks";
/// The solver finds none beyond, milliseconds.
const LATEST_MS: f64 = 1e3 * LATEST_S;
/// Nor beyond that, ppm.
const MOST_PPM: f64 = 1e6 * MOST_DRIFT;

/// How late the truth of a recording is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Found {
    /// Seconds.
    pub late_s: f64,
    /// By how much that grows in a second, and at which timestamp it is [`Found::late_s`].
    pub drift: Option<(f64, u64)>,
}

impl Found {
    /// What a solution found in the window of a recording, seconds counted from the first row there; none where it found
    /// its truth to be in time.
    pub fn of(solution: &Solution, recording: &Recording, light: &Light) -> Option<Self> {
        let within = |timestamp: u64| recording.calibrate.is_empty() || recording.calibrate.contains(&timestamp);
        let first = recording.rows.iter().find(|row| within(row.timestamp))?;
        let since = (solution.middle_s * ticks_per_s(light)).round() as u64;
        let drift = solution.drift.map(|drift| (drift, first.timestamp + since));
        (solution.offset_s != 0.0).then_some(Self { late_s: solution.offset_s, drift })
    }

    /// The same in the time of the mote that the recording's light is played to.
    pub fn on(&self, recording: &Recording, light: &Light) -> Late {
        let (Some((drift, ticks)), Some(row), Some(played)) = (self.drift, recording.rows.first(), light.rows.first())
        else {
            return Late { late_s: self.late_s, ..Late::default() };
        };
        let since_s = (ticks as f64 - row.timestamp as f64) / recording.clock_hz;
        let drift = drift * recording.clock_hz / ticks_per_s(light);
        Late { late_s: self.late_s, at_s: light.seconds(played.cycle) + since_s, drift }
    }

    /// As it stands in a room's provenance.
    pub(super) fn written(&self) -> Vec<(String, toml::Value)> {
        let hundredths = |value: f64| toml::Value::from((100.0 * value).round() / 100.0);
        let mut rows = vec![(KEY.to_string(), hundredths(1e3 * self.late_s))];
        if let Some((drift, ticks)) = self.drift {
            rows.push((DRIFT.to_string(), hundredths(1e6 * drift)));
            rows.push((AT.to_string(), (ticks as i64).into()));
        }
        rows
    }
}

/// Of the recording's clock in a true second.
fn ticks_per_s(light: &Light) -> f64 {
    HALF_TURNS_HZ * light.findings.half_turn[1]
}

/// What a room says of a recording.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Lateness {
    /// Nothing: its truth is not late, or nobody looked.
    None,
    /// Found on this very recording and window.
    Found(Found),
    /// Found on another one.
    OfAnother,
}

/// What `room`, read from the file `name`, says of `recording`.
///
/// # Errors
/// The provenance holds no number of milliseconds, of ppm or of ticks, or the recording's files cannot be read.
pub fn of(name: &str, room: &Calibration, recording: &Recording) -> Result<Lateness> {
    let said = |wanted: &str| room.provenance.iter().find(|(key, _)| key == wanted).map(|(_, value)| value.as_str());
    let within = |key: &str, written: &str, most: f64| {
        let value = written.parse::<f64>().ok().filter(|value| value.abs() <= most);
        value.ok_or_else(|| anyhow!("{name}: provenance.{key}: {written} is not in {} ..= {most}", -most))
    };
    let Some(written) = said(KEY) else { return Ok(Lateness::None) };
    let late_s = 1e-3 * within(KEY, written, LATEST_MS)?;
    let drift = match (said(DRIFT), said(AT)) {
        (None, _) => None,
        (Some(ppm), at) => {
            let ticks = at.and_then(|ticks| u64::from_str(ticks).ok());
            ensure!(ticks.is_some(), "{name}: provenance.{AT}: {} is no timestamp", at.unwrap_or("nothing"));
            Some(1e-6 * within(DRIFT, ppm, MOST_PPM)?).zip(ticks)
        }
    };
    let named = |digits: &str| {
        let inputs = room.provenance.iter().filter(|(key, _)| key.starts_with("input_"));
        inputs.map(|(_, value)| value).any(|value| value.contains(digits))
    };
    for file in recording::FILES {
        if !named(&hash(&recording.dir.join(file))?) {
            return Ok(Lateness::OfAnother);
        }
    }
    Ok(Lateness::Found(Found { late_s, drift }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calib::schema;

    #[test]
    fn a_lateness_is_that_of_one_recording_and_one_window() {
        let home = tempfile::tempdir().unwrap();
        let dir = home.path();
        let about =
            "kind = \"sweeps\"\nclock_hz = 1e7\nphotodiodes = 1\nstations = \"stations.toml\"\ncalibrate = [5, 10]\n";
        let rows = "timestamp_ticks,sensor,station,axis,sync_to_sweep_ticks,truth_x_m,truth_y_m,truth_z_m,truth_ok\n\
                    100,0,A,el,48476,0.5,1.0,-0.8,1\n";
        std::fs::write(dir.join("stations.toml"), "").unwrap();
        std::fs::write(dir.join(recording::FILES[0]), about).unwrap();
        std::fs::write(dir.join(recording::FILES[1]), rows).unwrap();
        let recording = Recording::open(dir).unwrap();
        let room = |late: &str| {
            let hashes = recording::FILES.map(|file| hash(&dir.join(file)).unwrap());
            let provenance = format!(
                "[provenance]\n{late}\ninput_1 = \"a, SHA-256 {}\"\ninput_2 = \"b, SHA-256 {}\"\n",
                hashes[0], hashes[1]
            );
            let text = include_str!("../../../calib/default.toml");
            let at = text.find("[provenance]").unwrap();
            let end = at + 1 + text[at + 1..].find("\n[").unwrap();
            schema::read("room.toml", &[&text[..at], &provenance, &text[end..]].concat()).unwrap()
        };
        let found = room("truth_late_ms = 14.53");
        let late_s = 1e-3 * 14.53;
        assert_eq!(of("room.toml", &found, &recording).unwrap(), Lateness::Found(Found { late_s, drift: None }));
        let drifts = room("truth_late_ms = 14.53\ntruth_drift_ppm = -425.5\ntruth_late_at_ticks = 900");
        let drift = Some((1e-6 * -425.5, 900));
        assert_eq!(of("room.toml", &drifts, &recording).unwrap(), Lateness::Found(Found { late_s, drift }));
        assert_eq!(of("room.toml", &room(""), &recording).unwrap(), Lateness::None);
        for (late, shown) in [("1453", "1453"), ("nan", "nan"), ("\"late\"", "\"late\"")] {
            let said = of("room.toml", &room(&format!("truth_late_ms = {late}")), &recording).unwrap_err().to_string();
            assert_eq!(said, format!("room.toml: provenance.truth_late_ms: {shown} is not in -100 ..= 100"));
        }
        for (drift, says) in [
            ("truth_drift_ppm = 1001\ntruth_late_at_ticks = 900", "truth_drift_ppm: 1001 is not in -1000 ..= 1000"),
            ("truth_drift_ppm = 10\ntruth_late_at_ticks = -9", "truth_late_at_ticks: -9 is no timestamp"),
            ("truth_drift_ppm = 10", "truth_late_at_ticks: nothing is no timestamp"),
        ] {
            let room = room(&format!("truth_late_ms = 1.0\n{drift}"));
            let said = of("room.toml", &room, &recording).unwrap_err().to_string();
            assert_eq!(said, format!("room.toml: provenance.{says}"));
        }
        // Rows that were for fitting are scored now, or the other way round.
        std::fs::write(dir.join(recording::FILES[0]), about.replace("10]", "11]")).unwrap();
        assert_eq!(of("room.toml", &found, &recording).unwrap(), Lateness::OfAnother);
    }
}
