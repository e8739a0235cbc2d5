//! What a scene is judged by.
//!
//! What can go wrong: a mote that keeps silent makes no errors. Coverage and recovery stand beside them.

use std::collections::BTreeSet;

use lighthouse_mote::frame::Level;
use xtask::light::HALF_TURN_S;
use xtask::quantile::quantile;
use xtask::score::Score;

use super::list::Take;
use super::play::Played;
use super::reason::{Reason, said};
use crate::lit::Fix;

/// Nobody calls a fix wrong that is nearer than this, metres: the worst axis of the 2020 paper's own run had an RMS
/// error of 5.1 cm.
const NEAR_M: f64 = 0.05;
/// What the reported standard deviation cannot know, metres: the middle of a sweep shifted by half the receiver's width
/// bias, 5 us at most, is 1.9 mrad; within the room's depth, at 1 m and with 0.57 m between the stations, 3 to 6 mm, and
/// the quantised room 1 mm.
const UNKNOWABLE_M: f64 = 0.01;
/// Standard deviations that a user may rely on: beyond 5 a Gaussian puts one in two million, and all scenes together
/// have tens of thousands of fixes.
const SIGMAS: f64 = 5.0;
/// A mote that has just begun to see light need not give reasons yet, seconds.
const SETTLING_S: f64 = 1.0;
/// A good fix comes back by then, milliseconds.
pub(super) const RECOVERY_MS: f64 = 200.0;

/// The figures of a scene.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Figures {
    /// Fixes of level full, and of level tracked.
    pub(super) good: usize,
    pub(super) tracked: usize,
    /// Sweeps followed by a fix within a report interval, percent; by one of level full.
    pub(super) coverage: f64,
    pub(super) good_coverage: f64,
    /// Error of the fixes of level full, centimetres.
    pub(super) median_cm: f64,
    pub(super) p95_cm: f64,
    pub(super) worst_cm: f64,
    /// Largest error of a fix of level tracked, centimetres.
    pub(super) worst_tracked_cm: f64,
    /// Fixes of level full that are further off than [`bound_m`].
    pub(super) wrong_good: usize,
    /// Longest time from the end of a disturbance to a good fix, milliseconds; infinite where none came.
    pub(super) recovery_ms: f64,
    /// Longest time from the first light to a good fix, milliseconds; infinite where none came in some take.
    pub(super) first_fix_ms: f64,
    pub(super) locks_lost: u32,
    /// Edges that the mote says it lost; the most of all takes.
    pub(super) edges_lost: u16,
    /// Resets and stops.
    pub(super) crashes: u32,
    /// Frames other than fixes and health, and frames that cannot be read.
    pub(super) other_frames: u32,
    pub(super) garbled: u32,
    /// What the health frames give as reasons, from a second after the first light on.
    pub(super) reasons: Vec<Reason>,
    /// Takes whose health names none of the reasons that it should.
    pub(super) unsaid: usize,
}

/// What a scene can break.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Promise {
    /// The mote neither panics nor resets nor stops.
    NoCrash,
    /// No fix of level full is wrong.
    NoWrongGood,
    /// A good fix within [`RECOVERY_MS`] of the light's return.
    Recovery,
    /// Where no good fix can come for seconds, health names the reason.
    Reason,
}

impl std::fmt::Display for Promise {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::NoCrash => "crash",
            Self::NoWrongGood => "wrong-good",
            Self::Recovery => "recovery",
            Self::Reason => "reason",
        })
    }
}

/// How far off a fix may be that says it is good, metres.
pub(super) fn bound_m(sd_m: [f64; 3]) -> f64 {
    let sd = sd_m.iter().map(|sd| sd * sd).sum::<f64>().sqrt();
    NEAR_M.max(SIGMAS * sd + UNKNOWABLE_M)
}

impl Fix {
    pub(crate) fn error_m(&self) -> f64 {
        self.row.error_m().unwrap_or(f64::INFINITY)
    }

    pub(crate) fn is_good(&self) -> bool {
        self.level == Level::Full
    }

    pub(crate) fn is_wrong(&self) -> bool {
        self.error_m() > bound_m(self.sd_m)
    }
}

impl Figures {
    /// Judges all takes of a scene, told to report once in `every_s`.
    pub(super) fn of(takes: &[(&Take, &Played)], every_s: f64) -> Self {
        let fixes = || takes.iter().flat_map(|(_, played)| &played.fixes);
        let mut good: Vec<f64> = fixes().filter(|fix| fix.is_good()).map(|fix| 100.0 * fix.error_m()).collect();
        let tracked = || fixes().filter(|fix| fix.level == Level::Tracked);
        let scored: usize = takes.iter().map(|(_, played)| played.sweeps.len()).sum();
        let share = |wanted: fn(&Fix) -> bool| {
            let covered: usize = takes.iter().map(|(_, played)| covered(played, every_s, wanted)).sum();
            100.0 * covered as f64 / scored.max(1) as f64
        };
        let reasons: Vec<_> =
            takes.iter().map(|(take, played)| said(&played.health, take.first_light_s + SETTLING_S)).collect();
        let unsaid = takes.iter().zip(&reasons).filter(|((take, _), reasons)| {
            !take.reasons.is_empty() && !take.reasons.iter().any(|reason| reasons.contains(reason))
        });
        let most = |values: &mut dyn Iterator<Item = f64>| values.fold(f64::NAN, f64::max);
        let sum = |count: fn(&Played) -> u32| takes.iter().map(|(_, played)| count(played)).sum();
        Self {
            good: good.len(),
            tracked: tracked().count(),
            coverage: share(|_| true),
            good_coverage: share(Fix::is_good),
            worst_cm: most(&mut good.iter().copied()),
            median_cm: quantile(&mut good, 0.5),
            p95_cm: quantile(&mut good, 0.95),
            worst_tracked_cm: most(&mut tracked().map(|fix| 100.0 * fix.error_m())),
            wrong_good: fixes().filter(|fix| fix.is_good() && fix.is_wrong()).count(),
            recovery_ms: most(
                &mut takes
                    .iter()
                    .flat_map(|(take, played)| take.due_again_s.iter().map(|from_s| waited_ms(played, *from_s))),
            ),
            first_fix_ms: most(&mut takes.iter().map(|(take, played)| waited_ms(played, take.first_light_s))),
            locks_lost: sum(|played| played.locks_lost),
            edges_lost: takes.iter().map(|(_, played)| played.edges_lost).max().unwrap_or(0),
            crashes: sum(|played| played.resets + u32::from(played.halted.is_some())),
            other_frames: sum(|played| played.other_frames),
            garbled: sum(|played| played.garbled),
            unsaid: unsaid.count(),
            reasons: reasons.iter().flatten().copied().collect::<BTreeSet<_>>().into_iter().collect(),
        }
    }

    /// The promises that do not hold.
    pub(super) fn broken(&self) -> Vec<Promise> {
        [
            (Promise::NoCrash, self.crashes > 0),
            (Promise::NoWrongGood, self.wrong_good > 0),
            // Where nothing was due the time is no number, and not above.
            (Promise::Recovery, self.recovery_ms > RECOVERY_MS),
            (Promise::Reason, self.unsaid > 0),
        ]
        .into_iter()
        .filter_map(|(promise, broken)| broken.then_some(promise))
        .collect()
    }
}

/// Sweeps with a fix that `wanted` accepts, reported within `every_s`.
fn covered(played: &Played, every_s: f64, wanted: fn(&Fix) -> bool) -> usize {
    let rows: Vec<_> = played.fixes.iter().filter(|fix| wanted(fix)).map(|fix| fix.row.clone()).collect();
    Score::of_simulation(&played.sweeps, &rows, played.mote_hz, every_s, |_| [0.0; 3]).fixed
}

/// From `from_s` to the first fix that is good, right, and of light seen since.
fn waited_ms(played: &Played, from_s: f64) -> f64 {
    // The mote's stamp may lie a tick before the world's.
    let since = |fix: &&Fix| fix.row.seconds >= from_s - 1e-3 * HALF_TURN_S;
    let first = played.fixes.iter().filter(since).find(|fix| fix.is_good() && !fix.is_wrong());
    first.map_or(f64::INFINITY, |fix| 1e3 * (fix.sent_s - from_s))
}

#[cfg(test)]
mod tests {
    use super::*;
    use lighthouse_mote::frame::Losses;
    use xtask::score::FixRow;

    fn fix(sent_s: f64, error_m: f64, sd_m: f64, level: Level) -> Fix {
        let row = FixRow {
            cycle: (sent_s * 1e6) as u64,
            sighted: (sent_s * 1e6) as u64,
            seconds: sent_s,
            position: [error_m, 0.0, 0.0],
            mismatch_m: 0.0,
            age_s: 0.0,
            sequence: 0,
            truth: Some([0.0; 3]),
        };
        Fix { row, sent_s, level, sd_m: [sd_m, 0.0, 0.0], losses: Losses::default() }
    }

    #[test]
    fn a_fix_is_wrong_beyond_five_centimetres_and_beyond_what_it_says_of_itself() {
        assert!(!fix(0.0, 0.049, 0.0, Level::Full).is_wrong());
        assert!(fix(0.0, 0.051, 0.001, Level::Full).is_wrong());
        assert!(!fix(0.0, 0.1, 0.02, Level::Full).is_wrong());
        assert!(fix(0.0, 0.12, 0.02, Level::Full).is_wrong());
    }

    #[test]
    fn recovery_waits_for_a_fix_that_is_good_and_right() {
        let fixes = vec![
            fix(0.9, 0.0, 0.0, Level::Full),
            fix(1.1, 0.0, 0.0, Level::Tracked),
            fix(1.2, 0.3, 0.0, Level::Full),
            fix(1.25, 0.0, 0.0, Level::Full),
        ];
        let played = Played { fixes, ..Played::default() };
        assert!((waited_ms(&played, 1.0) - 250.0).abs() < 1e-6);
        assert_eq!(waited_ms(&played, 2.0), f64::INFINITY);
    }

    #[test]
    fn a_scene_breaks_the_promises_it_breaks_and_no_others() {
        let take = super::super::list::all().swap_remove(0).takes.swap_remove(0);
        let due = Take { due_again_s: vec![1.0], ..take.clone() };
        let played = Played { mote_hz: 1e6, fixes: vec![fix(1.1, 0.3, 0.0, Level::Full)], ..Played::default() };
        let of = |take: &Take| Figures::of(&[(take, &played)], 0.033).broken();
        assert_eq!(of(&take), [Promise::NoWrongGood]);
        assert_eq!(of(&due), [Promise::NoWrongGood, Promise::Recovery]);
        let silent = Played { resets: 1, ..Played::default() };
        assert_eq!(Figures::of(&[(&take, &silent)], 0.033).broken(), [Promise::NoCrash]);
    }
}
