//! A solution in figures and in words: for the judgement, for the room's own file, for the terminal.
//!
//! What can go wrong: nothing. What was not measured is left out.

use std::fmt::Write as _;

use nalgebra::Vector3;

use super::gather::Gathered;
use super::judgement::{Figures, OUTSIDE, Outside, RotorFigures, length};
use super::lateness::Found;
use super::solve::Solution;
use super::{TOOL, room, session};
use crate::quantile::quantile;
use crate::reference::{Method, Room as ReferenceRoom};
use crate::score::Late;

pub(super) fn figures(solution: &Solution, gathered: &Gathered) -> Figures {
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
        let late = late(gathered, solution).map(|found| found.on(recording, light));
        let score = method.score_midway(recording, light, &late.unwrap_or_default());
        let as_written = method.score_midway(recording, light, &Late::default());
        Outside {
            mean_m: score.mean3d_cm / 100.0,
            share: score.coverage(),
            late,
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

/// By how much the truth is late, where it is in one log with the sweeps and that was fitted.
pub(super) fn late(gathered: &Gathered, solution: &Solution) -> Option<Found> {
    let (recording, light) = gathered.recorded.as_ref()?;
    Found::of(solution, recording, light)
}

/// The drift of two clocks for people.
fn drift_words(drift: f64) -> String {
    format!("{:+.1} ppm", 1e6 * drift)
}

/// Where the kept sweeps were, in the order of time; each place once where they are places.
pub(super) fn path(solution: &Solution, places: bool) -> Vec<[f64; 3]> {
    let mut path: Vec<[f64; 3]> = solution.residuals.iter().filter(|r| r.kept).map(|r| r.position.into()).collect();
    if places {
        path.dedup();
    }
    path
}

pub(super) fn provenance(
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
        if let Some(drift) = solution.drift {
            say("time_drift", format!("truth's clock against the rotors {}", drift_words(drift)));
        }
    }
    if let Some(arm) = solution.lever_arm {
        let [x, y, z] = arm.into();
        say("lever_arm", format!("({x:.4}, {y:.4}, {z:.4}) m on the tracked body"));
    }
    rows.extend(late(gathered, solution).iter().flat_map(Found::written));
    rows
}

pub(super) fn facts(
    gathered: &Gathered,
    solution: &Solution,
    figures: &Figures,
    room: &room::Room,
) -> Vec<(String, String)> {
    let mut facts = gathered.facts.clone();
    let place = |p: [f64; 3]| format!("({:.3}, {:.3}, {:.3}) m", p[0], p[1], p[2]);
    for (name, station) in ["station A", "station B"].into_iter().zip(&solution.stations) {
        facts.push((name.to_string(), place(station.position.into())));
    }
    facts.push(("median distance to a station".to_string(), length(figures.distance_m)));
    if gathered.apart_s.is_some() {
        facts.push(("truth's clock less the mote's".to_string(), format!("{:.4} s", solution.offset_s)));
    } else if let Some(late) = late(gathered, solution) {
        facts.push(("how late the truth is".to_string(), format!("{:.1} ms", 1000.0 * late.late_s)));
    }
    if let Some(drift) = solution.drift {
        facts.push(("the truth's clock against the rotors".to_string(), drift_words(drift)));
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
pub(super) fn table(figures: &Figures, facts: &[(String, String)]) -> String {
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
