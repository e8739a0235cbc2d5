//! The whole path without a board: edges in, reports out.
//!
//! A mote runs it in two halves, so that a long computation never delays the understanding of light:
//! [`Classifier`] at the higher priority, [`Solver`] at the lower, a queue between. [`Chain`] is both in a row, for
//! host tests and replay: the same code as on the mote.
//!
//! What can go wrong: every stage drops what it cannot use and counts it; the counts travel in each report.

use fixed::types::{I16F16, U0F16, U8F8};

use crate::edge::Edge;
use crate::frame::{Losses, Report};
use crate::sweep::{Light, Station, Sweep};
use crate::time::Ticks;
use crate::{angle, fix, pulse, sweep};

/// Everything that is configured: the tolerances, the stations' factory terms, the room, the rate.
#[derive(Debug, Clone)]
pub struct Config {
    /// How light is understood.
    pub sweep: sweep::Config,
    /// The rotors' factory terms.
    pub angle: angle::Config,
    /// The room and the age rule.
    pub fix: fix::Config,
    /// At most one report per this many half turns (8.333 ms); 1 reports every fix, 120 a second.
    pub report_every_half_turns: u16,
}

/// What the solving half needs to hear of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Sighting {
    /// The sweep; `None` when the cycle was lost and every older angle with it.
    pub sweep: Option<Sweep>,
    /// Edges without a partner so far, wrapping.
    pub edges_lost: u16,
    /// Pulses that fit no window so far, wrapping.
    pub pulses_lost: u16,
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
        let light = sweep::step(&config.sweep, &mut self.sweep, pulse)?;
        self.sighting(light)
    }

    /// Notices a long darkness; to be called at least once per quarter wrap of the counter.
    pub fn expire(&mut self, config: &Config, now: Ticks) -> Option<Sighting> {
        let light = sweep::expire(&config.sweep, &mut self.sweep, now)?;
        self.sighting(light)
    }

    fn sighting(&self, light: Light) -> Option<Sighting> {
        let sweep = match light {
            Light::Sync(_) => return None,
            Light::Sweep(sweep) => Some(sweep),
            Light::Lost => None,
        };
        Some(Sighting { sweep, edges_lost: self.pulse.lost(), pulses_lost: self.sweep.counts().strays })
    }

    /// How often each kind of light was understood.
    #[must_use]
    pub fn counts(&self) -> sweep::Counts {
        self.sweep.counts()
    }
}

/// The second half: sightings to reports.
#[derive(Debug, Clone, Default)]
pub struct Solver {
    angle: angle::State,
    fix: fix::State,
    reported: Option<Ticks>,
}

impl Solver {
    /// Takes one sighting.
    #[inline]
    pub fn step(&mut self, config: &Config, sighting: Sighting) -> Option<Report> {
        let Some(sweep) = sighting.sweep else {
            self.fix.forget();
            self.reported = None;
            return None;
        };
        let bearing = angle::step(&config.angle, &mut self.angle, sweep)?;
        let fix = fix::step(&config.fix, &mut self.fix, bearing)?;
        if !self.is_due(config, &fix) {
            return None;
        }
        self.reported = Some(fix.at);
        Some(Report {
            time: fix.at.0,
            half_turn_q8: fix.half_turn.ticks_q8(),
            position: fix.position.map(I16F16::from_bits),
            mismatch: U0F16::from_bits(u16::try_from(fix.mismatch.unsigned_abs()).unwrap_or(u16::MAX)),
            // 2^20 units per half turn to Q8.
            age: U8F8::from_bits(u16::try_from(fix.half_turn.share(fix.age) >> 12).unwrap_or(u16::MAX)),
            stations: 1 << Station::A as u8 | 1 << Station::B as u8,
            losses: Losses {
                edges: sighting.edges_lost,
                pulses: sighting.pulses_lost,
                sweeps: self.angle.outside(),
                fixes: self.fix.refused(),
                reports: 0,
            },
        })
    }

    /// Half a half turn early counts as due, or the jitter of the light would halve the rate.
    fn is_due(&self, config: &Config, fix: &fix::Fix) -> bool {
        self.reported.is_none_or(|reported| {
            let half_turns = fix.at.since(reported).0.saturating_add(fix.half_turn.span().0 / 2);
            half_turns >= u32::from(config.report_every_half_turns).saturating_mul(fix.half_turn.span().0)
        })
    }
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

    /// Notices a long darkness; to be called at least once per quarter wrap of the counter.
    pub fn expire(&mut self, config: &Config, now: Ticks) {
        if let Some(sighting) = self.classifier.expire(config, now) {
            let _ = self.solver.step(config, sighting);
        }
    }
}
