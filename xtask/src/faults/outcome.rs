//! What came of a harm.

use lighthouse_mote::frame::Reset;

use super::harm::{Harm, Kind};
use super::{Address, BACK_S, BITES_S, PAUSE_S, WRONG_S};
use crate::lit::{Heard, Said};
use crate::log::is_start;

/// A pause that clear light has by itself, seconds: 15 reports a second, some of whose pulses are lost.
const USUAL_S: f64 = 0.3;

/// What was seen of a run.
#[derive(Debug, Clone)]
pub(super) struct Seen {
    /// From when on good fixes are due, or when the last came, true seconds.
    good_s: f64,
    /// The longest time without a good fix since nothing fails any more, seconds.
    pub(super) pause_s: f64,
    /// Wrong fixes of level full, or any under another's name.
    pub(super) wrong: usize,
    /// From the first to the last of them, seconds.
    pub(super) wrong_s: f64,
    first_wrong_s: Option<f64>,
    /// Starts since the harm.
    pub(super) starts: usize,
    cause: Option<Reset>,
    /// The core will not go on by itself.
    pub(super) dead: bool,
    ours: Address,
}

impl Seen {
    pub(super) fn since(over_s: f64, ours: Address) -> Self {
        Self {
            good_s: over_s,
            pause_s: 0.0,
            wrong: 0,
            wrong_s: 0.0,
            first_wrong_s: None,
            starts: 0,
            cause: None,
            dead: false,
            ours,
        }
    }

    pub(super) fn hear(&mut self, all: Vec<Heard>) {
        for heard in all {
            let stranger = heard.header.is_some_and(|header| (header.pan, header.mote) != self.ours);
            match heard.said {
                Said::Fix(fix) if stranger || fix.is_good() => {
                    if stranger || fix.is_wrong() {
                        self.wrong += 1;
                        let first_s = *self.first_wrong_s.get_or_insert(heard.sent_s);
                        self.wrong_s = heard.sent_s - first_s;
                    } else if heard.sent_s > self.good_s {
                        self.pause_s = self.pause_s.max(heard.sent_s - self.good_s);
                        self.good_s = heard.sent_s;
                    }
                }
                // A flip in a frame that was made before is no cause.
                Said::Health(health) if !stranger => self.cause = Some(health.reset),
                _ => {}
            }
        }
    }

    pub(super) fn read(&mut self, line: &str) {
        self.starts += usize::from(is_start(line));
    }

    pub(super) fn close(&mut self, end_s: f64) {
        self.pause_s = self.pause_s.max(end_s - self.good_s);
    }

    /// What the mote says of its last start.
    pub(super) fn cause(&self) -> String {
        self.cause.map_or("none".to_string(), |cause| format!("{cause:?}"))
    }
}

/// What came of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Outcome {
    Correct,
    Transient,
    Detected,
    Wrong,
    Silent,
    Missed,
}

impl std::fmt::Display for Outcome {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(match self {
            Self::Correct => "correct",
            Self::Transient => "transient",
            Self::Detected => "detected",
            Self::Wrong => "WRONG",
            Self::Silent => "SILENT",
            Self::Missed => "MISSED",
        })
    }
}

impl Outcome {
    pub(super) fn of(harm: &Harm, seen: &Seen) -> Self {
        let said = seen.starts > 0 && seen.cause.is_some_and(|cause| cause != Reset::PowerOn);
        let harmed = matches!(harm.kind, Kind::Reset | Kind::BrownOut);
        // No frame leaves while one of these lasts.
        let bites = matches!(harm.kind, Kind::StormOfAll | Kind::Timer | Kind::Radio) && harm.long_s > BITES_S;
        let bitten = seen.starts > 0 && seen.cause == Some(Reset::Watchdog);
        if seen.wrong_s > WRONG_S {
            Self::Wrong
        } else if seen.dead || seen.pause_s > if harmed { BACK_S } else { PAUSE_S } {
            Self::Silent
        } else if bites && !bitten {
            Self::Missed
        } else if said {
            Self::Detected
        } else if seen.wrong > 0 || seen.pause_s > USUAL_S || (seen.starts > 0 && !harmed) {
            Self::Transient
        } else {
            Self::Correct
        }
    }

    /// What must not be.
    pub(super) fn is_bad(self) -> bool {
        matches!(self, Self::Wrong | Self::Silent | Self::Missed)
    }
}

#[cfg(test)]
mod tests {
    use super::super::harm::Ram;
    use super::*;

    #[test]
    fn a_run_is_judged_by_the_worst_of_it() {
        let harm = |kind| Harm::draw(kind, 0, 1, [4.0, 9.0], &Ram::some());
        let (flip, reset) = (harm(Kind::Flip), harm(Kind::Reset));
        let seen = Seen::since(5.0, (1, 2));
        assert_eq!(Outcome::of(&flip, &seen), Outcome::Correct);
        assert_eq!(Outcome::of(&flip, &Seen { pause_s: 2.0, ..seen.clone() }), Outcome::Transient);
        assert_eq!(Outcome::of(&reset, &Seen { pause_s: 2.0, ..seen.clone() }), Outcome::Silent);
        assert_eq!(Outcome::of(&flip, &Seen { pause_s: 8.0, ..seen.clone() }), Outcome::Silent);
        assert_eq!(Outcome::of(&flip, &Seen { wrong: 9, wrong_s: 1.1, ..seen.clone() }), Outcome::Wrong);
        let again = Seen { starts: 1, cause: Some(Reset::Watchdog), pause_s: 5.0, ..seen };
        assert_eq!(Outcome::of(&flip, &again), Outcome::Detected);
    }

    fn lasting(kind: Kind, long_s: f64) -> Harm {
        let mut harm = Harm::draw(kind, 0, 1, [4.0, 9.0], &Ram::some());
        harm.long_s = long_s;
        harm
    }

    #[test]
    fn what_keeps_every_frame_from_the_air_for_long_has_to_be_ended_by_the_watchdog() {
        let seen = Seen { pause_s: 2.0, ..Seen::since(5.0, (1, 2)) };
        let by = |cause| Seen { starts: 1, cause: Some(cause), ..seen.clone() };
        for kind in [Kind::StormOfAll, Kind::Timer, Kind::Radio] {
            let lasts = |long_s| lasting(kind, long_s);
            assert_eq!(Outcome::of(&lasts(7.0), &seen), Outcome::Transient);
            assert_eq!(Outcome::of(&lasts(8.0), &seen), Outcome::Missed);
            assert_eq!(Outcome::of(&lasts(8.0), &by(Reset::Fault)), Outcome::Missed);
            assert_eq!(Outcome::of(&lasts(8.0), &by(Reset::Watchdog)), Outcome::Detected);
            assert!(Outcome::Missed.is_bad());
        }
        // One line is one of many that the mote stands.
        assert_eq!(Outcome::of(&lasting(Kind::Storm, 9.0), &seen), Outcome::Transient);
    }
}
