//! The whole path without a board: edges in, reports out.
//!
//! A mote runs it in two halves, so that a long computation never delays the understanding of light:
//! [`Classifier`] at the higher priority, [`Solver`] at the lower, a queue between. [`Chain`] is both in a row, for
//! host tests and replay: the same code as on the mote.
//!
//! ```
//! use lighthouse_mote::chain::{Chain, Config};
//! use lighthouse_mote::edge::Edge;
//! use lighthouse_mote::frame::{Level, Lock};
//! use lighthouse_mote::time::Ticks;
//! use sim::world::path::Path;
//! use sim::world::{Scene, World};
//!
//! mod room {
//!     // What build.rs made of calib/default.toml.
//!     include!(concat!(env!("OUT_DIR"), "/calib.rs"));
//! }
//! const CONFIG: Config = room::CONFIG;
//!
//! // Two seconds of light in that room, on a clock that is 4 % off.
//! let place = [0.5, 1.0, 0.7];
//! let scene = Scene { path: Path::Still { at_m: place }, length_s: 2.0, ..Scene::default() };
//! let (mut chain, mut reports, mut now) = (Chain::default(), Vec::new(), Ticks(0));
//! for change in World::new(&scene, 1).edges() {
//!     now = Ticks(change.cycle as u32);
//!     let edge = if change.level { Edge::rise(now) } else { Edge::fall(now) };
//!     reports.extend(chain.step(&CONFIG, edge));
//! }
//! let last = reports.last().expect("the cycle is found within half a second");
//! assert_eq!((last.level, last.stations), (Level::Full, 3));
//! let error = |axis: usize| (last.position[axis].to_num::<f64>() - place[axis]).abs();
//! assert!((0..3).all(|axis| error(axis) < 0.01), "1 cm: {:?}", last.position);
//! assert_eq!(chain.health(&CONFIG, now).lock, Lock::Locked);
//! ```
//!
//! What can go wrong: every stage drops what it cannot use and counts it; the counts travel in each report.

mod batch;
mod classify;
mod ears;

pub use batch::Batch;
pub use classify::{Classifier, Flashes, Listener, Seen, Sighting, Understood};
pub use ears::Ears;

use fixed::types::{I6F10, I16F16, U0F16, U8F8};

use crate::edge::Edge;
use crate::frame::{self, Health, Level, Losses, Rejects, Report};
use crate::send::{self, When};
use crate::sweep::{HalfTurn, Station};
use crate::time::{Span, Ticks};
use crate::{angle, fix, ootx, sweep, track};

/// Everything that is configured: the tolerances, the stations' factory terms, the room, the rate.
// The tracker's room comes first: an offset into it costs this core three instructions.
#[derive(Debug, Clone)]
#[repr(C)]
pub struct Config {
    /// The room as the tracker wants it.
    pub room: track::Room,
    /// How light is understood.
    pub sweep: sweep::Config,
    /// How often the stations are listened to, and who they should be.
    pub ootx: ootx::Config,
    /// The rotors' factory terms.
    pub angle: angle::Config,
    /// The room as the solver wants it, and the age rule.
    pub fix: fix::Config,
    /// How the mote may move.
    pub track: track::Config,
    /// What is reported.
    pub estimate: Estimate,
    /// At most one report per this many half turns (8.333 ms); 1 reports at every sweep, 120 a second.
    pub report_every_half_turns: u16,
    /// Which half turns these are, and which reports are worth it.
    pub send: send::Config,
}

/// Whose position is reported.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Estimate {
    /// The tracker's, which takes one angle at a time, started by a fix.
    #[default]
    Track,
    /// Each fix as it is, where the four newest angles give one.
    Fix,
    /// Nobody's: the sweeps themselves go out, from which a room is calibrated. See [`Batch`].
    Angles,
}

/// It is time for a report.
#[derive(Debug, Clone, Copy)]
pub struct Due {
    at: Ticks,
    half_turn: HalfTurn,
    pulses_lost: u16,
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
    ears: Ears,
    send: send::State,
}

/// Fraction bits of the tracker's time, 256 to a half turn, less than those of a share.
const TRACK_TIME_SHIFT: u32 = sweep::HALF_TURN_BITS - track::PER_HALF_TURN.ilog2();

impl Solver {
    /// Of the mote with that short address, which says when it sends.
    #[must_use]
    pub fn of_mote(mote: u16) -> Self {
        Self { send: send::State::new(mote), ..Self::default() }
    }

    /// Takes one sighting.
    pub fn step(&mut self, config: &Config, sighting: &Sighting) -> Option<Report> {
        let due = self.take(config, sighting)?;
        self.report(config, due)
    }

    /// The same up to the report, if it is time for one.
    #[inline(always)]
    pub fn take(&mut self, config: &Config, sighting: &Sighting) -> Option<Due> {
        let starts = !self.ears.rests() && self.listen(config, sighting.seen, sighting.flashes);
        let (at, before, half_turn) = match sighting.seen {
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
                (sweep.at, sweep.since_sync, sweep.half_turn)
            }
            Seen::Nothing { at, half_turn } => {
                if config.estimate == Estimate::Fix {
                    return None;
                }
                // About: where there was no sweep, its end is known, or a little later.
                (at, half_turn.span(), half_turn)
            }
            Seen::Lost => {
                self.fix.forget();
                self.track = track::State::default();
                self.heard = None;
                self.reported = None;
                self.ears.forget();
                self.send.forget();
                return None;
            }
        };
        let is_own = config.send.counts() && self.count(config, (at, before, half_turn), starts);
        let is_due = if config.send.when == When::Steady { self.is_due(config, at, half_turn) } else { is_own };
        is_due.then_some(Due { at, half_turn, pulses_lost: sighting.pulses_lost })
    }

    /// Counts half turns up to the one that began `before` ago at `at`; whether it is the mote's own.
    #[inline(always)]
    fn count(&mut self, config: &Config, light: (Ticks, Span, HalfTurn), starts: bool) -> bool {
        send::step(&config.send, config.report_every_half_turns, &mut self.send, light, starts)
    }

    /// Whether frames that were made ahead wait for a half turn of the mote's own ([`send::Config::ahead_half_turns`]).
    #[must_use]
    pub fn takes_turns(&self, config: &Config) -> bool {
        config.estimate != Estimate::Angles && self.send.takes_turns(&config.send)
    }

    /// Whether they are to go out now.
    #[must_use]
    pub fn is_turn(&self, config: &Config) -> bool {
        self.send.is_turn(&config.send, config.report_every_half_turns)
    }

    /// The report that is due, if there is something to report.
    ///
    /// Not inlined: it comes with one sighting in several, and what it needs would be made ready for all of them.
    #[inline(never)]
    pub fn report(&mut self, config: &Config, due: Due) -> Option<Report> {
        let Due { at, half_turn, pulses_lost } = due;
        // Stations that are not where the room's file has them make a wrong place look right.
        if self.ears.hear_a_stranger(&config.ootx) {
            return None;
        }
        let mut report = match config.estimate {
            Estimate::Track => self.tracked(config, at, half_turn)?,
            Estimate::Fix => self.fixed(config, at, half_turn)?,
            Estimate::Angles => return None,
        };
        self.reported = Some(at);
        report.time = at.0;
        report.half_turn_q8 = half_turn.ticks_q8();
        report.age = U8F8::from_bits(saturated(half_turn.share(self.fix.age(at)) >> TRACK_TIME_SHIFT));
        report.stations = self.fix.stations(&config.fix, at, half_turn);
        let refused = self.fix.refused();
        report.losses = Losses {
            edges: 0,
            pulses: pulses_lost,
            sweeps: self.angle.outside(),
            fixes: refused.geometry.wrapping_add(refused.mismatch).wrapping_add(self.disbelieved),
            reports: 0,
        };
        if config.send.moved_q16 != 0 && !self.send.is_news(&config.send, &report) {
            return None;
        }
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
                    let room = &config.room;
                    if !track::start(&config.track, room, &mut self.track, fix.position, fix.mismatch) {
                        self.disbelieved = self.disbelieved.wrapping_add(1);
                    }
                }
            }
        }
    }

    /// Hands the bits of the flashes to the stations' frames, and the rotors' terms on; whether station A's frame begins.
    #[inline(never)]
    fn listen(&mut self, config: &Config, seen: Seen, flashes: Flashes) -> bool {
        self.ears.listen(&config.ootx, seen, flashes, |station, block| {
            if config.angle.asks()
                && let Some(rotors) = angle::received(block)
            {
                angle::receive(&config.angle, &mut self.angle, station, rotors);
            }
        });
        config.send.when == When::Slotted
            && flashes.data(Station::A).is_some()
            && self.ears.ears[Station::A as usize].ootx.is_at_start()
    }

    /// How the mote is. Left to the board: uptime, reset, queues, and what it lost by itself.
    #[must_use]
    #[inline(never)]
    pub fn health(&self, config: &Config, understood: &Understood) -> Health {
        let Understood { status, half_turn_q8, counts, width_bias, edges_lost } = understood;
        let refused = self.fix.refused();
        let mut health = Health {
            half_turn_q8: *half_turn_q8,
            lock: *status,
            syncs: counts.syncs,
            sweeps: counts.sweeps,
            rejects: Rejects {
                edges: *edges_lost,
                strays: counts.strays,
                widths: counts.misfits,
                short: counts.too_short,
                long: counts.too_long,
                second: counts.seconds,
                outside: self.angle.outside(),
                geometry: refused.geometry,
                mismatch: refused.mismatch,
                disbelieved: self.disbelieved,
                reports: 0,
                locks: counts.locks_lost,
            },
            ..Health::default()
        };
        for (index, station) in [Station::A, Station::B].into_iter().enumerate() {
            let (told, ear, bias) = (&mut health.stations[index], &self.ears.ears[index], width_bias[index]);
            *told = frame::Station {
                good: ear.ootx.good(),
                bad: ear.ootx.bad(),
                width_bias: steps_q5(bias.unwrap_or(0)),
                factory: self.angle.factory(&config.angle, station),
                ..frame::Station::default()
            };
            if let Some(known) = ear.known {
                told.id = known.id;
                told.mode = known.mode;
                told.faults = known.faults;
                told.is_stranger = config.ootx.is_stranger(station, known.id);
            }
        }
        health
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

/// 2^-20 half turns as 1/32 width steps, of which there are 25,600 in a half turn: 2^20 / 25,600 is 1024 / 25.
fn steps_q5(bias: i16) -> i8 {
    ((i32::from(bias) * 25) >> 10).clamp(i32::from(i8::MIN), i32::from(i8::MAX)) as i8
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
    /// Of the mote with that short address.
    #[must_use]
    pub fn of_mote(mote: u16) -> Self {
        Self { solver: Solver::of_mote(mote), ..Self::default() }
    }

    /// Takes one edge; gives the report that it completes.
    pub fn step(&mut self, config: &Config, edge: Edge) -> Option<Report> {
        let sighting = self.classifier.step(config, edge)?;
        let report = self.solver.step(config, &sighting);
        self.complete(report)
    }

    /// Notices that no light comes; to be called at least once per quarter wrap of the counter.
    pub fn expire(&mut self, config: &Config, now: Ticks) -> Option<Report> {
        let sighting = self.classifier.expire(now)?;
        let report = self.solver.step(config, &sighting);
        self.complete(report)
    }

    /// Adds what only the first half knows.
    fn complete(&self, report: Option<Report>) -> Option<Report> {
        let mut report = report?;
        report.losses.edges = self.classifier.pulse.lost();
        Some(report)
    }

    /// How the mote is by `now`, which is later than every edge.
    #[must_use]
    pub fn health(&self, config: &Config, now: Ticks) -> Health {
        self.solver.health(config, &self.classifier.understood(now))
    }
}
