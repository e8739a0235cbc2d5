//! Whether a solved room can be trusted, in one sentence, and why.
//!
//! What can go wrong: a fit can be tight and wrong where the mote was never carried. So what counts most is light that
//! the fit has not seen.

use std::fmt;

use super::session::ROTORS;
use crate::score::Late;

/// What is known of one rotor.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RotorFigures {
    /// Sweeps that had a truth.
    pub paired: usize,
    /// Of the kept ones, RMS residual, degrees.
    pub rms_deg: f64,
    /// Median absolute residual, degrees.
    pub median_deg: f64,
    /// Part that was turned away.
    pub rejected: f64,
    /// RMS residual on parts that were held out of the fit, degrees.
    pub held_out_deg: f64,
}

/// The numbers on which a judgement rests.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Figures {
    /// In the order of [`ROTORS`].
    pub rotors: [RotorFigures; 4],
    /// Condition number of the fit's scaled unknowns.
    pub condition: f64,
    /// Mean 3-D error on parts that were held out of the fit, metres.
    pub held_out_m: f64,
    /// On the recording outside its window for fitting.
    pub outside: Option<Outside>,
    /// Median distance from the stations to the path, metres.
    pub distance_m: f64,
}

/// Places from four angles each outside the window for fitting, held against where the mote was midway through them.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Outside {
    /// Mean 3-D error, metres.
    pub mean_m: f64,
    /// Part of the rows with a place.
    pub share: f64,
    /// By how much the truth was taken later, as found within the window.
    pub late: Option<Late>,
    /// Mean 3-D error where it is not, metres.
    pub as_written_m: f64,
}

/// What those are called.
pub const OUTSIDE: &str = "mean error outside the fitted window";

impl Outside {
    /// The figures for people.
    pub fn words(&self) -> String {
        let share = format!("reflections and all, for {:.1} % of its rows", 100.0 * self.share);
        match self.late {
            None => format!("{}, {share}", length(self.mean_m)),
            Some(late) => format!(
                "{}, {share}, with the truth taken {late}; {} with the truth as written",
                length(self.mean_m),
                length(self.as_written_m)
            ),
        }
    }
}

/// How much to rely on it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Grade {
    /// Fly it.
    Trusted,
    /// It may do.
    Doubtful,
    /// It will mislead.
    Refused,
}

/// The judgement.
#[derive(Clone, Debug, PartialEq)]
pub struct Judgement {
    /// How much to rely on it.
    pub grade: Grade,
    /// What speaks against it, worst first.
    pub against: Vec<String>,
    /// All in one sentence.
    pub sentence: String,
}

impl fmt::Display for Judgement {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.sentence)
    }
}

/// A residual beyond the first is doubtful, beyond the second no calibration, degrees. Real recordings agree with the
/// rotors' model to 3 mrad, 0.17 degrees, RMS.
const RESIDUAL_DEG: [f64; 2] = [0.35, 1.0];
/// The same for the part of the sweeps turned away: real light has a few percent of reflections.
const REJECTED: [f64; 2] = [0.15, 0.4];
/// The same for the 3-D error on held-out light, as a part of the distance: the 2020 run's 1 cm at 0.8 m is 0.012.
const ERROR: [f64; 2] = [0.025, 0.08];
/// A millimetre is good enough, however near the stations.
const GOOD_M: f64 = 0.001;
/// The same for the condition number of the scaled unknowns.
const CONDITION: [f64; 2] = [1e4, 1e7];
/// Fewer sweeps of a rotor than this tell little of it; the least that a place gives is four.
const FEW: [usize; 2] = [20, 5];

impl Figures {
    /// The judgement.
    pub fn judge(&self) -> Judgement {
        let mut against: Vec<(Grade, String)> = Vec::new();
        let mut weigh = |value: f64, [doubtful, refused]: [f64; 2], words: String| {
            // What is not a number speaks against the fit as well.
            if value.is_nan() || value > refused {
                against.push((Grade::Refused, words));
            } else if value > doubtful {
                against.push((Grade::Doubtful, words));
            }
        };
        let scale = self.distance_m.max(GOOD_M / ERROR[0]);
        weigh(
            self.held_out_m / scale,
            ERROR,
            format!("on light held out of the fit the mean error is {}", length(self.held_out_m)),
        );
        if let Some(Outside { mean_m, .. }) = self.outside {
            weigh(
                mean_m / scale,
                ERROR,
                format!("on the recording outside the fitted window the mean error is {}", length(mean_m)),
            );
        }
        for (name, rotor) in ROTORS.iter().zip(&self.rotors) {
            if rotor.paired < FEW[0] {
                let few = if rotor.paired < FEW[1] { f64::INFINITY } else { 1.5 };
                weigh(few, [1.0, 2.0], format!("{name} was seen only {} times", rotor.paired));
                continue;
            }
            weigh(rotor.rms_deg, RESIDUAL_DEG, format!("{name} is off by {:.2} degrees RMS", rotor.rms_deg));
            let percent = 100.0 * rotor.rejected;
            weigh(rotor.rejected, REJECTED, format!("{percent:.0} % of the sweeps of {name} were turned away"));
        }
        weigh(
            self.condition,
            CONDITION,
            format!("the path hardly tells the unknowns apart (condition {:.0e})", self.condition),
        );
        against.sort_by_key(|(grade, _)| std::cmp::Reverse(*grade));
        let grade = against.first().map_or(Grade::Trusted, |(grade, _)| *grade);
        let against: Vec<String> = against.into_iter().map(|(_, words)| words).collect();
        let sentence = match grade {
            Grade::Trusted => format!("This calibration can be trusted: {}.", self.praise()),
            Grade::Doubtful => format!("This calibration is doubtful: {}.", against.join("; ")),
            Grade::Refused => format!("This calibration cannot be trusted: {}.", against.join("; ")),
        };
        Judgement { grade, against, sentence }
    }

    fn praise(&self) -> String {
        let worst = self.rotors.iter().map(|rotor| rotor.rms_deg).fold(0.0, f64::max);
        let rejected = self.rejected();
        let outside = match self.outside {
            Some(Outside { mean_m, share, .. }) => {
                format!(" ({} outside the fitted window, for {:.0} % of its rows)", length(mean_m), 100.0 * share)
            }
            None => String::new(),
        };
        format!(
            "light held out of the fit gives places {} off on average{outside}, no rotor's residual is over {worst:.2} \
             degrees RMS, and {:.1} % of the sweeps were turned away",
            length(self.held_out_m),
            100.0 * rejected
        )
    }

    /// Part of all sweeps that was turned away.
    pub fn rejected(&self) -> f64 {
        let all: usize = self.rotors.iter().map(|rotor| rotor.paired).sum();
        self.rotors.iter().map(|rotor| rotor.rejected * rotor.paired as f64).sum::<f64>() / all.max(1) as f64
    }
}

/// A length for people.
pub fn length(metres: f64) -> String {
    match metres {
        m if !m.is_finite() => "unknown".to_string(),
        m if m.abs() < 0.01 => format!("{:.1} mm", 1000.0 * m),
        m if m.abs() < 1.0 => format!("{:.1} cm", 100.0 * m),
        m => format!("{m:.2} m"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn good() -> Figures {
        let rotor = RotorFigures { paired: 400, rms_deg: 0.12, median_deg: 0.07, rejected: 0.03, held_out_deg: 0.13 };
        Figures { rotors: [rotor; 4], condition: 300.0, held_out_m: 0.009, outside: None, distance_m: 0.9 }
    }

    #[test]
    fn a_good_fit_is_trusted_and_the_sentence_says_why() {
        let judgement = good().judge();
        assert_eq!(judgement.grade, Grade::Trusted);
        assert_eq!(
            judgement.sentence,
            "This calibration can be trusted: light held out of the fit gives places 9.0 mm off on average, no rotor's \
             residual is over 0.12 degrees RMS, and 3.0 % of the sweeps were turned away."
        );
    }

    #[test]
    fn each_bad_number_is_named_and_the_worst_comes_first() {
        let mut figures = good();
        figures.rotors[2].rms_deg = 0.5;
        assert_eq!(figures.judge().grade, Grade::Doubtful);
        figures.held_out_m = 0.2;
        figures.rotors[3].rejected = 0.3;
        let judgement = figures.judge();
        assert_eq!(judgement.grade, Grade::Refused);
        assert_eq!(judgement.against.len(), 3);
        assert!(judgement.against[0].contains("20.0 cm") && judgement.sentence.contains("B az is off by 0.50"));
        assert!(judgement.sentence.contains("30 % of the sweeps of B el"), "{judgement}");
    }

    #[test]
    fn what_is_not_a_number_is_not_trusted() {
        for spoil in [
            |f: &mut Figures| f.held_out_m = f64::NAN,
            |f: &mut Figures| f.condition = f64::INFINITY,
            |f: &mut Figures| f.outside = Some(Outside { mean_m: f64::NAN, ..Outside::default() }),
            |f: &mut Figures| f.rotors[1].paired = 0,
            |f: &mut Figures| f.rotors[1].rms_deg = f64::NAN,
        ] {
            let mut figures = good();
            spoil(&mut figures);
            assert_eq!(figures.judge().grade, Grade::Refused, "{figures:?}");
        }
    }
}
