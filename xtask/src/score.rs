//! Fixes held against the truth.
//!
//! The protocol is the recordings' own: a row counts when its truth is good and it lies outside
//! the window on which stations were fitted; coverage is the part of those rows that have a fix.
//! A fix belongs to a row when the mote reported it for that row's sweep: the time it says is that
//! of the sweep, or within `WINDOW_S` after. Nothing later is looked at, so a method that waits for better light is not
//! rewarded for it.
//!
//! Motion capture takes a while, and a log holds what had come by then: the truth of a row may be where the mote was some
//! milliseconds before. `calibrate` finds that inside the window for fitting, and only there; then fixes are held against
//! the truth of so much later, and against the truth as written besides.
//!
//! # What can go wrong
//! A mote that keeps silent where it is unsure gets small errors and small coverage: the two are
//! only worth anything together. Without a single fix the errors are not numbers, and are written
//! as such.

use std::fmt;

use lighthouse_mote::frame::{Header, Report};

use crate::light::{HALF_TURN_S, Light};
use crate::quantile::quantile;
use crate::recording::{Recording, Row};

/// How long after its sweep a fix may still be reported for it, seconds: less than a half turn, so
/// that the next sweep's fix is not taken for this one's.
const WINDOW_S: f64 = 0.005;
/// A mote stamps the middle of a laser's pulse to whole ticks.
const SAME_CYCLES: u64 = 8;
/// Truth is joined by a line over no longer than this, seconds.
const JOIN_S: f64 = 0.1;

/// One fix as the mote reported it.
#[derive(Clone, Debug, PartialEq)]
pub struct FixRow {
    /// Mote cycle after boot at which the fix was reported.
    pub cycle: u64,
    /// Mote cycle at which its newest angle was seen: where the mote then was is what it reports.
    pub sighted: u64,
    /// The same in seconds of nominal mote time.
    pub seconds: f64,
    /// Where the mote says it is, metres.
    pub position: [f64; 3],
    /// How far apart the two stations' rays pass, metres.
    pub mismatch_m: f64,
    /// Age of the oldest angle that went in, seconds.
    pub age_s: f64,
    /// Number of the report, which wraps.
    pub sequence: u16,
    /// Where the mote was, metres, where that is known.
    pub truth: Option<[f64; 3]>,
}

impl FixRow {
    /// What a frame that went out at `cycle` says of a sighting at cycle `sighted`, true second `seconds`.
    pub fn of(header: Header, report: &Report, cycle: u64, sighted: u64, seconds: f64) -> Self {
        Self {
            cycle,
            sighted,
            seconds,
            position: report.position.map(f64::from),
            mismatch_m: f64::from(report.mismatch),
            age_s: f64::from(report.age) * HALF_TURN_S,
            sequence: header.sequence,
            truth: None,
        }
    }

    /// Distance from the truth, metres.
    pub fn error_m(&self) -> Option<f64> {
        let truth = self.truth?;
        Some(length(difference(self.position, truth)))
    }
}

/// How late a recording's truth is: at the time of a sweep it tells where the mote was before.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Late {
    /// By how much at [`Late::at_s`], seconds.
    pub late_s: f64,
    /// When that is, seconds of nominal mote time.
    pub at_s: f64,
    /// By how much it grows, seconds per second.
    pub drift: f64,
}

impl Late {
    /// When a truth was written that tells where the mote was at `seconds` of nominal mote time.
    pub fn after(&self, seconds: f64) -> f64 {
        seconds + self.late_s + self.drift * (seconds - self.at_s)
    }

    /// When the mote was where a truth that was written at `seconds` says.
    pub fn before(&self, seconds: f64) -> f64 {
        // A thousandth at most of what is milliseconds.
        seconds - self.late_s - self.drift * (seconds - self.at_s)
    }
}

impl fmt::Display for Late {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:.1} ms later", 1e3 * self.late_s)?;
        if self.drift == 0.0 {
            return Ok(());
        }
        write!(f, " in the middle of the calibrate window and {:+.0} ppm of the time since", 1e6 * self.drift)
    }
}

/// How good a run was.
#[derive(Clone, Debug, PartialEq)]
pub struct Score {
    /// Instants at which a fix was due.
    pub scored: usize,
    /// Of those, with a fix.
    pub fixed: usize,
    /// Mean absolute error per axis, centimetres.
    pub mae_cm: [f64; 3],
    /// 95th percentile of the absolute error per axis, centimetres.
    pub p95_cm: [f64; 3],
    /// Root mean square of the distance to the truth, centimetres.
    pub rms3d_cm: f64,
    /// Mean distance to the truth, centimetres.
    pub mean3d_cm: f64,
}

impl Score {
    /// The figures of `errors` (fix less truth, metres), out of `scored` instants.
    pub fn of_errors(scored: usize, errors: &[[f64; 3]]) -> Self {
        let count = errors.len() as f64;
        let mut axes: [Vec<f64>; 3] =
            std::array::from_fn(|axis| errors.iter().map(|e| 100.0 * e[axis].abs()).collect());
        let distances: Vec<f64> = errors.iter().map(|e| 100.0 * length(*e)).collect();
        Self {
            scored,
            fixed: errors.len(),
            mae_cm: std::array::from_fn(|axis| axes[axis].iter().sum::<f64>() / count),
            p95_cm: std::array::from_fn(|axis| quantile(&mut axes[axis], 0.95)),
            rms3d_cm: (distances.iter().map(|d| d * d).sum::<f64>() / count).sqrt(),
            mean3d_cm: distances.iter().sum::<f64>() / count,
        }
    }

    /// Instants with a fix, of those at which one was due.
    pub fn coverage(&self) -> f64 {
        self.fixed as f64 / self.scored as f64
    }

    /// Scores the fixes, in the order of their cycles, of a mote that saw `light`.
    pub fn of_recording(recording: &Recording, light: &Light, fixes: &[FixRow]) -> Self {
        Self::of_rows(recording, light, fixes, |_, row| row.truth)
    }

    /// The same rows and fixes, but each fix is held against where the mote was when its newest angle was seen, with a
    /// truth that is late.
    pub fn of_late_truth(recording: &Recording, light: &Light, fixes: &[FixRow], late: &Late) -> Self {
        let places = recorded_truth(recording, light);
        let then = |fix: &FixRow| place_at(&places, late.after(fix.seconds));
        Self::of_rows(recording, light, fixes, |fix, row| then(fix).unwrap_or(row.truth))
    }

    fn of_rows(
        recording: &Recording,
        light: &Light,
        fixes: &[FixRow],
        truth: impl Fn(&FixRow, &Row) -> [f64; 3],
    ) -> Self {
        let mut scored = 0;
        let mut errors = Vec::new();
        for (row, played) in recording.rows.iter().zip(&light.rows) {
            if !recording.scored(row) {
                continue;
            }
            scored += 1;
            // A log writes a row some time after the sweep, with the truth of that time.
            let fix = played
                .laser
                .ok()
                .and_then(|laser| reported_for(fixes, laser, laser.max(played.cycle), window(light.mote_hz)));
            errors.extend(fix.map(|fix| difference(fix.position, truth(fix, row))));
        }
        Self::of_errors(scored, &errors)
    }

    /// Scores the fixes, in the order of their cycles, of a mote that saw sweeps at the cycles
    /// `sweeps` and was told to report once in `every_s`; `truth` says where it was at any cycle.
    pub fn of_simulation(
        sweeps: &[u64],
        fixes: &[FixRow],
        mote_hz: f64,
        every_s: f64,
        truth: impl Fn(u64) -> [f64; 3],
    ) -> Self {
        let window = window(mote_hz).max((every_s * mote_hz) as u64);
        let errors: Vec<[f64; 3]> = sweeps
            .iter()
            .filter_map(|&sweep| reported_for(fixes, sweep, sweep, window))
            .map(|fix| difference(fix.position, truth(fix.sighted)))
            .collect();
        Self::of_errors(sweeps.len(), &errors)
    }
}

/// [`WINDOW_S`] in cycles.
fn window(mote_hz: f64) -> u64 {
    (WINDOW_S * mote_hz) as u64
}

/// The fix of a sweep whose row was written at `row`: the newest one by then that is no older than
/// the sweep, or else the first one within `window` after.
fn reported_for(fixes: &[FixRow], sweep: u64, row: u64, window: u64) -> Option<&FixRow> {
    let from = fixes.partition_point(|fix| fix.sighted + SAME_CYCLES < sweep);
    let by = fixes.partition_point(|fix| fix.cycle <= row);
    if by > from {
        return fixes.get(by - 1);
    }
    fixes.get(from).filter(|fix| fix.sighted <= row + window)
}

/// A place at a time: seconds of mote time, metres.
pub type Place = (f64, [f64; 3]);

/// Where motion capture saw the recording mote, in nominal mote time; only what can be trusted.
pub fn recorded_truth(recording: &Recording, light: &Light) -> Vec<Place> {
    let rows = recording.rows.iter().zip(&light.rows).filter(|(row, _)| row.truth_ok);
    rows.map(|(row, played)| (light.seconds(played.cycle), row.truth)).collect()
}

/// The place at a time, on a line between those before and after; none where those are far apart in time.
pub fn place_at(places: &[Place], seconds: f64) -> Option<[f64; 3]> {
    let after = places.partition_point(|place| place.0 < seconds);
    let (t1, p1) = *places.get(after)?;
    if t1 == seconds {
        return Some(p1);
    }
    let (t0, p0) = *places.get(after.checked_sub(1)?)?;
    let part = (seconds - t0) / (t1 - t0);
    (t1 - t0 <= JOIN_S).then(|| std::array::from_fn(|axis| p0[axis] + part * (p1[axis] - p0[axis])))
}

fn difference(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|axis| a[axis] - b[axis])
}

fn length(v: [f64; 3]) -> f64 {
    v.iter().map(|x| x * x).sum::<f64>().sqrt()
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A fix at a cycle of a 1 MHz mote.
    pub(crate) fn fix(cycle: u64, position: [f64; 3]) -> FixRow {
        FixRow {
            cycle,
            sighted: cycle,
            seconds: cycle as f64 / 1e6,
            position,
            mismatch_m: 0.001,
            age_s: 0.02,
            sequence: cycle as u16,
            truth: None,
        }
    }

    #[test]
    fn errors_become_the_figures_of_the_table() {
        let score = Score::of_errors(4, &[[0.01, 0.0, 0.0], [-0.03, 0.04, 0.0]]);
        assert_eq!((score.scored, score.fixed, score.coverage()), (4, 2, 0.5));
        let near = |a: f64, b: f64| assert!((a - b).abs() < 1e-9, "{a} {b}");
        near(score.mae_cm[0], 2.0);
        near(score.mae_cm[1], 2.0);
        near(score.p95_cm[1], 3.8);
        near(score.mean3d_cm, 3.0);
        near(score.rms3d_cm, 13f64.sqrt());
    }

    #[test]
    fn no_fix_at_all_is_no_number() {
        let score = Score::of_errors(3, &[]);
        assert_eq!(score.coverage(), 0.0);
        assert!(score.mae_cm[0].is_nan() && score.p95_cm[2].is_nan() && score.rms3d_cm.is_nan());
    }

    #[test]
    fn a_fix_counts_for_its_own_sweep_only() {
        let fixes = [fix(1_000, [0.0; 3]), fix(9_000, [1.0; 3]), fix(9_100, [2.0; 3])];
        let cycle = |sweep, row| reported_for(&fixes, sweep, row, 5_000).map(|fix| fix.cycle);
        assert_eq!(cycle(900, 900), Some(1_000));
        assert_eq!(cycle(1_000, 1_000), Some(1_000));
        assert_eq!(cycle(1_010, 1_010), None, "an earlier fix is stale, the next too late");
        assert_eq!(cycle(8_000, 8_000), Some(9_000), "the first after the sweep");
        assert_eq!(cycle(8_000, 12_000), Some(9_100), "the newest when the row was written later");
        assert_eq!(cycle(9_110, 9_110), None);
    }

    #[test]
    fn a_simulated_run_is_scored_at_the_time_of_its_fixes() {
        let fixes = [fix(1_000, [0.5, 0.0, 0.0]), fix(2_000, [1.0, 0.0, 0.0])];
        let truth = |cycle: u64| [cycle as f64 / 2_000.0, 0.0, 0.0];
        let score = Score::of_simulation(&[990, 1_995, 7_900], &fixes, 1e6, 0.0, truth);
        assert_eq!((score.scored, score.fixed), (3, 2));
        assert_eq!(score.mae_cm, [0.0; 3]);
    }

    #[test]
    fn truth_is_interpolated_but_not_across_gaps() {
        let places = [(1.0, [0.0; 3]), (1.05, [1.0; 3]), (3.0, [2.0; 3])];
        assert_eq!(place_at(&places, 0.5), None);
        assert!((place_at(&places, 1.025).unwrap()[0] - 0.5).abs() < 1e-9);
        assert_eq!(place_at(&places, 2.0), None);
        assert_eq!(place_at(&places, 3.0), Some([2.0; 3]));
        assert_eq!(place_at(&places, 3.5), None);
    }
}
