//! The whole path without a board: edges in, reports out.
//!
//! A mote runs it in two halves, so that a long computation never delays the understanding of light:
//! [`Classifier`] at the higher priority, [`Solver`] at the lower, a queue between. [`Chain`] is both in a row, for
//! host tests and replay: the same code as on the mote.
//!
//! What can go wrong: every stage drops what it cannot use and counts it; the counts travel in each report.

use fixed::types::{I6F10, I16F16, U0F16, U8F8};

use crate::edge::Edge;
use crate::frame::{Level, Losses, Report};
use crate::sweep::{Closed, HalfTurn, Light, Sweep};
use crate::time::Ticks;
use crate::{angle, fix, pulse, sweep, track};

/// Everything that is configured: the tolerances, the stations' factory terms, the room, the rate.
#[derive(Debug, Clone)]
pub struct Config {
    /// How light is understood.
    pub sweep: sweep::Config,
    /// The rotors' factory terms.
    pub angle: angle::Config,
    /// The room as the solver wants it, and the age rule.
    pub fix: fix::Config,
    /// How the mote may move.
    pub track: track::Config,
    /// The room as the tracker wants it.
    pub room: track::Room,
    /// What is reported.
    pub estimate: Estimate,
    /// At most one report per this many half turns (8.333 ms); 1 reports at every sweep, 120 a second.
    pub report_every_half_turns: u16,
}

/// Whose position is reported.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Estimate {
    /// The tracker's, which takes one angle at a time, started by a fix.
    #[default]
    Track,
    /// Each fix as it is, where the four newest angles give one.
    Fix,
}

/// What the solving half needs to hear of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Sighting {
    /// What was seen.
    pub seen: Seen,
    /// Edges without a partner so far, wrapping.
    pub edges_lost: u16,
    /// Pulses that were turned away so far, wrapping.
    pub pulses_lost: u16,
}

/// A laser, the lack of one, or the end of the cycle.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Seen {
    /// A laser passed.
    Sweep(Sweep),
    /// A half turn without a laser; the cycle goes on.
    Nothing {
        /// When that was clear.
        at: Ticks,
        /// The half turn as measured last.
        half_turn: HalfTurn,
    },
    /// The cycle was lost: every angle known so far is of an unknown age.
    Lost,
}

/// The first half: edges to sightings.
#[derive(Debug, Clone, Default)]
pub struct Classifier {
    pulse: pulse::State,
    sweep: sweep::State,
}

impl Classifier {
    /// Takes one edge.
    #[inline]
    pub fn step(&mut self, config: &Config, edge: Edge) -> Option<Sighting> {
        let pulse = pulse::step(&mut self.pulse, edge)?;
        self.pulse(config, pulse)
    }

    /// Takes one pulse, where a board's capture already pairs the edges.
    #[inline]
    pub fn pulse(&mut self, config: &Config, pulse: pulse::Pulse) -> Option<Sighting> {
        let pulses = &self.pulse;
        sweep::step_then(&config.sweep, &mut self.sweep, pulse, |sweeps, light| {
            let seen = match light {
                Some(Light::Sweep(sweep)) => Seen::Sweep(sweep),
                Some(Light::Lost) => Seen::Lost,
                Some(Light::Sync(_)) | None => closed(sweeps, pulse.start)?,
            };
            Some(Sighting { seen, edges_lost: pulses.lost(), pulses_lost: sweeps.counts().turned_away })
        })
    }

    /// Notices that no light comes; to be called at least once per quarter wrap of the counter, and as often as
    /// reports shall go on in the dark. `now` is later than every edge.
    pub fn expire(&mut self, config: &Config, now: Ticks) -> Option<Sighting> {
        if sweep::expire(&config.sweep, &mut self.sweep, now).is_some() {
            return self.sighting(Seen::Lost);
        }
        let seen = closed(&mut self.sweep, now)?;
        self.sighting(seen)
    }

    fn sighting(&self, seen: Seen) -> Option<Sighting> {
        Some(Sighting { seen, edges_lost: self.pulse.lost(), pulses_lost: self.sweep.counts().turned_away })
    }

    /// How often each kind of light was understood.
    #[must_use]
    pub fn counts(&self) -> sweep::Counts {
        self.sweep.counts()
    }
}

/// What the slot that has just ended has left to say.
#[inline]
fn closed(sweeps: &mut sweep::State, at: Ticks) -> Option<Seen> {
    Some(match sweeps.closed()? {
        Closed::Sweep(sweep) => Seen::Sweep(sweep),
        Closed::Dark(half_turn) => Seen::Nothing { at, half_turn },
    })
}

/// The second half: sightings to reports.
#[derive(Debug, Clone, Default)]
pub struct Solver {
    angle: angle::State,
    fix: fix::State,
    track: track::State,
    /// The latest sweep that the tracker heard of.
    heard: Option<Ticks>,
    disbelieved: u16,
    reported: Option<Ticks>,
}

/// Fraction bits of the tracker's time, 256 to a half turn, less than those of a share.
const TRACK_TIME_SHIFT: u32 = sweep::HALF_TURN_BITS - track::PER_HALF_TURN.ilog2();

impl Solver {
    /// Takes one sighting.
    #[inline]
    pub fn step(&mut self, config: &Config, sighting: Sighting) -> Option<Report> {
        let (at, half_turn) = match sighting.seen {
            Seen::Sweep(sweep) => {
                // A sweep out of view says nothing of the place, but the time of a report has come.
                if let Some(bearing) = angle::step(&config.angle, &mut self.angle, sweep) {
                    fix::note(&mut self.fix, bearing);
                    if config.estimate == Estimate::Track {
                        self.follow(config, bearing);
                    }
                } else if config.estimate == Estimate::Fix {
                    return None;
                }
                (sweep.at, sweep.half_turn)
            }
            Seen::Nothing { at, half_turn } => {
                if config.estimate == Estimate::Fix {
                    return None;
                }
                (at, half_turn)
            }
            Seen::Lost => {
                self.fix.forget();
                self.track = track::State::default();
                self.heard = None;
                self.reported = None;
                return None;
            }
        };
        if !self.is_due(config, at, half_turn) {
            return None;
        }
        self.report(config, sighting, at, half_turn)
    }

    /// Not inlined: it comes with one sighting in several, and what it needs would be made ready for all of them.
    #[inline(never)]
    fn report(&mut self, config: &Config, sighting: Sighting, at: Ticks, half_turn: HalfTurn) -> Option<Report> {
        let mut report = match config.estimate {
            Estimate::Track => self.tracked(config, at, half_turn)?,
            Estimate::Fix => self.fixed(config, at, half_turn)?,
        };
        self.reported = Some(at);
        report.time = at.0;
        report.half_turn_q8 = half_turn.ticks_q8();
        report.age = U8F8::from_bits(saturated(half_turn.share(self.fix.age(at)) >> TRACK_TIME_SHIFT));
        report.stations = self.fix.stations(&config.fix, at, half_turn);
        report.losses = Losses {
            edges: sighting.edges_lost,
            pulses: sighting.pulses_lost,
            sweeps: self.angle.outside(),
            fixes: self.fix.refused().wrapping_add(self.disbelieved),
            reports: 0,
        };
        Some(report)
    }

    /// Hands the bearing to the tracker, and starts it where it does not run.
    fn follow(&mut self, config: &Config, bearing: angle::Bearing) {
        let elapsed = self.heard.map_or(0, |heard| elapsed(heard, bearing.at, bearing.half_turn));
        self.heard = Some(bearing.at);
        let sweep = track::Sweep {
            station: bearing.station,
            axis: bearing.axis,
            angle: bearing.angle,
            elapsed: saturated(elapsed),
        };
        match track::step(&config.track, &config.room, &mut self.track, &sweep) {
            track::Step::Believed => {}
            track::Step::Refused | track::Step::OutOfView => self.disbelieved = self.disbelieved.wrapping_add(1),
            track::Step::Idle | track::Step::Lost => {
                if let Some(fix) = fix::newest(&config.fix, &mut self.fix, bearing.at, bearing.half_turn) {
                    track::start(&config.track, &config.room, &mut self.track, fix.position, fix.mismatch);
                }
            }
        }
    }

    fn tracked(&mut self, config: &Config, at: Ticks, half_turn: HalfTurn) -> Option<Report> {
        // Nearly always the sweep itself.
        let since = self.heard.filter(|heard| *heard != at).map_or(0, |heard| elapsed(heard, at, half_turn));
        let track = track::report(&config.track, &self.track, since);
        if track.level < Level::Tracked {
            return None;
        }
        let fix = fix::newest(&config.fix, &mut self.fix, at, half_turn);
        if let Some(fix) = &fix {
            track::start(&config.track, &config.room, &mut self.track, fix.position, fix.mismatch);
        }
        Some(Report {
            position: track.position.map(I16F16::from_bits),
            // Q16 to Q10.
            velocity: track.velocity.map(|speed| I6F10::from_bits((speed >> 6).clamp(-0x8000, 0x7fff) as i16)),
            // The root of 32 bits has 16.
            sd: track.sd.map(|sd| U0F16::from_bits(sd as u16)),
            mismatch: mismatch(fix),
            level: track.level,
            ..Report::default()
        })
    }

    fn fixed(&mut self, config: &Config, at: Ticks, half_turn: HalfTurn) -> Option<Report> {
        let fix = fix::newest(&config.fix, &mut self.fix, at, half_turn)?;
        Some(Report {
            position: fix.position.map(I16F16::from_bits),
            mismatch: mismatch(Some(fix)),
            level: Level::Full,
            ..Report::default()
        })
    }

    /// Sweeps of neighbouring slots are a third to five thirds of a half turn apart, so half of one early counts as
    /// due, and with one half turn per report every sweep does.
    fn is_due(&self, config: &Config, at: Ticks, half_turn: HalfTurn) -> bool {
        let every = u32::from(config.report_every_half_turns);
        every <= 1
            || self.reported.is_none_or(|reported| {
                let half_turn = half_turn.span().0;
                at.since(reported).0.saturating_add(half_turn / 2) >= every.saturating_mul(half_turn)
            })
    }
}

/// From `earlier` to `later` in the tracker's units of time.
fn elapsed(earlier: Ticks, later: Ticks, half_turn: HalfTurn) -> u32 {
    half_turn.share(later.since(earlier)) >> TRACK_TIME_SHIFT
}

fn saturated(value: u32) -> u16 {
    u16::try_from(value).unwrap_or(u16::MAX)
}

/// The mismatch as reported: the largest where there is no fix.
fn mismatch(fix: Option<fix::Fix>) -> U0F16 {
    U0F16::from_bits(fix.map_or(u16::MAX, |fix| saturated(fix.mismatch.unsigned_abs())))
}

/// Both halves in a row.
#[derive(Debug, Clone, Default)]
pub struct Chain {
    classifier: Classifier,
    solver: Solver,
}

impl Chain {
    /// Takes one edge; gives the report that it completes.
    pub fn step(&mut self, config: &Config, edge: Edge) -> Option<Report> {
        let sighting = self.classifier.step(config, edge)?;
        self.solver.step(config, sighting)
    }

    /// Notices that no light comes; to be called at least once per quarter wrap of the counter.
    pub fn expire(&mut self, config: &Config, now: Ticks) -> Option<Report> {
        let sighting = self.classifier.expire(config, now)?;
        self.solver.step(config, sighting)
    }
}
