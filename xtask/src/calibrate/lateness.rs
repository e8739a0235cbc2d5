//! How late a recording's truth is, as a room that was calibrated on it says.
//!
//! A log holds of motion capture what had come by then: where the mote was some milliseconds before. How many is found
//! within the window for fitting and stands in the room's provenance, beside the hashes of what it was found on. It is a
//! property of that recording and of no other, so whoever scores the same recording takes its truth so much later.
//!
//! What can go wrong: the recording, or its window, is another one by now. Then its truth is taken as it is written,
//! and that is said.

use anyhow::{Result, ensure};

use super::gather::hash;
use super::solve::LATEST_S;
use crate::calib::schema::Calibration;
use crate::recording::{self, Recording};

/// The key in the provenance.
pub const KEY: &str = "truth_late_ms";
/// The solver finds none beyond, milliseconds.
const LATEST_MS: f64 = 1e3 * LATEST_S;

/// What a room says of a recording.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Lateness {
    /// Nothing: its truth is not late, or nobody looked.
    None,
    /// Found on this very recording and window, seconds.
    Found(f64),
    /// Found on another one.
    OfAnother,
}

/// What `room`, read from the file `name`, says of `recording`.
///
/// # Errors
/// The provenance holds no number of milliseconds, or the recording's files cannot be read.
pub fn of(name: &str, room: &Calibration, recording: &Recording) -> Result<Lateness> {
    let said = |wanted: &str| room.provenance.iter().find(|(key, _)| key == wanted).map(|(_, value)| value.as_str());
    let Some(written) = said(KEY) else { return Ok(Lateness::None) };
    let late_ms = written.parse::<f64>().ok().filter(|ms| ms.abs() <= LATEST_MS);
    ensure!(late_ms.is_some(), "{name}: provenance.{KEY}: {written} is not in {} ..= {LATEST_MS}", -LATEST_MS);
    let named = |digits: &str| {
        let inputs = room.provenance.iter().filter(|(key, _)| key.starts_with("input_"));
        inputs.map(|(_, value)| value).any(|value| value.contains(digits))
    };
    for file in recording::FILES {
        if !named(&hash(&recording.dir.join(file))?) {
            return Ok(Lateness::OfAnother);
        }
    }
    Ok(late_ms.map_or(Lateness::None, |ms| Lateness::Found(1e-3 * ms)))
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
        assert_eq!(of("room.toml", &found, &recording).unwrap(), Lateness::Found(1e-3 * 14.53));
        assert_eq!(of("room.toml", &room(""), &recording).unwrap(), Lateness::None);
        for (late, shown) in [("1453", "1453"), ("nan", "nan"), ("\"late\"", "\"late\"")] {
            let said = of("room.toml", &room(&format!("truth_late_ms = {late}")), &recording).unwrap_err().to_string();
            assert_eq!(said, format!("room.toml: provenance.truth_late_ms: {shown} is not in -100 ..= 100"));
        }
        // Rows that were for fitting are scored now, or the other way round.
        std::fs::write(dir.join(recording::FILES[0]), about.replace("10]", "11]")).unwrap();
        assert_eq!(of("room.toml", &found, &recording).unwrap(), Lateness::OfAnother);
    }
}
