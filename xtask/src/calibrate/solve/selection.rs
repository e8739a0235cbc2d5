//! Which parameters the model gets: each only while sweeps that were left out of the fit become more predictable by it.
//!
//! What can go wrong: a recording too short to hold blocks of it out; its scatter says so.

use super::check::MOST_DRIFT;
use super::held_out::judge;
use super::model::TERMS;
use super::refine::{Data, Fit, Free, TUKEY};
use super::solution::HeldOut;
use super::{Choice, Options};

/// Terms stay when sweeps that were left out become more predictable by this share.
const WORTH: f64 = 0.01;
/// A drift is looked at from so many of its own standard deviations on.
const DRIFT_SIGMAS: f64 = 5.0;
/// Rounds of the fit that finds it.
const ROUNDS: usize = 8;

/// What is fitted besides the poses, and how good that is on what was left out.
pub(super) fn choose(
    data: Data<'_>,
    poses: &Fit,
    free: Free,
    options: &Options,
    evidence: &mut Vec<String>,
    progress: &mut dyn FnMut(&str, f64),
) -> (Free, HeldOut) {
    let limit = poses.scatter.map(|station| station.map(|scatter| TUKEY * scatter));
    let mut chosen = free;
    progress("holding blocks out", 0.0);
    let mut held_out = judge(data, poses.guess, chosen, &limit);
    let mut weigh = |what: &str, wider: Free, choice: Choice, chosen: &mut Free, held_out: &mut HeldOut| {
        let other = judge(data, poses.guess, wider, &limit);
        let better = other.scatter < (1.0 - WORTH) * held_out.scatter;
        let fitted = better || choice == Choice::Always;
        evidence.push(format!(
            "{what} {}: sweeps left out of the fit scatter by {:.3} mrad without and {:.3} mrad with, and place the mote \
             to {:.2} and {:.2} cm.",
            if fitted { "are fitted" } else { "are left alone" },
            1000.0 * held_out.scatter,
            1000.0 * other.scatter,
            100.0 * held_out.mean_3d_m,
            100.0 * other.mean_3d_m,
        ));
        if fitted {
            (*chosen, *held_out) = (wider, other);
        }
        fitted
    };
    if options.late && !chosen.offset {
        let wider = Free { offset: true, ..chosen };
        weigh("Delays of the truth", wider, Choice::Auto, &mut chosen, &mut held_out);
    }
    let known = options.factory.map(|terms| terms.is_some());
    match options.fit_factory {
        Choice::Never => {}
        _ if known == [true; 2] => {}
        choice => {
            for (part, terms, what) in
                [(0.2, 1, "Rotor phases"), (0.4, 2, "Rotor tilts"), (0.6, TERMS, "Rotors' once-per-turn terms")]
            {
                progress("holding blocks out", part);
                let wider = Free { terms: known.map(|known| if known { 0 } else { terms }), ..chosen };
                if !weigh(what, wider, choice, &mut chosen, &mut held_out) {
                    break;
                }
            }
        }
    }
    if options.late || chosen.offset {
        progress("holding blocks out", 0.7);
        let wider = Free { offset: true, drift: true, ..chosen };
        let fit = data.fit(poses.guess, wider, ROUNDS);
        // Blocks of time share their errors, so a drift that is not many of its deviations is none.
        if (DRIFT_SIGMAS * fit.drift_sd..=MOST_DRIFT).contains(&fit.guess.drift.abs()) {
            weigh("Offset and drift of the truth's clock", wider, Choice::Auto, &mut chosen, &mut held_out);
        }
    }
    if options.fit_lever_arm != Choice::Never && !options.attitudes.is_empty() {
        progress("holding blocks out", 0.8);
        let wider = Free { lever: true, ..chosen };
        weigh(
            "The photodiode's three coordinates on the body",
            wider,
            options.fit_lever_arm,
            &mut chosen,
            &mut held_out,
        );
    }
    match known {
        [true, true] => evidence.push("Factory terms are the ones given.".to_string()),
        [true, false] => evidence.push("Station A's factory terms are the ones given.".to_string()),
        [false, true] => evidence.push("Station B's factory terms are the ones given.".to_string()),
        [false, false] => {}
    }
    if known != [true; 2] && options.fit_factory == Choice::Never {
        evidence.push("Factory terms are not fitted, as asked.".to_string());
    }
    if options.attitudes.is_empty() && options.fit_lever_arm != Choice::Never {
        evidence.push(
            "The truth does not say how the body is turned, so where the photodiode sits on it cannot be told from \
             where the stations are: what the truth tracks should be the photodiode."
                .to_string(),
        );
    }
    (chosen, held_out)
}
