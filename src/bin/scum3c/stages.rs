//! The two computing stages between their queues: light to sightings, sightings to reports and their frames.
//!
//! What can go wrong: a queue is full because the stage behind it is slow. What does not fit is dropped and counted,
//! except the news that the cycle was lost, which is owed until it fits: without it the solver would trust angles of
//! an unknown age.

use core::sync::atomic::{AtomicU16, Ordering};

use lighthouse_mote::chain::{Classifier, Config, Seen, Sighting, Solver};
use lighthouse_mote::frame::{self, Aligned, Header, Report};
use lighthouse_mote::time::Ticks;

use crate::capture;
use crate::queue::{Queue, Reader, Writer};
use crate::radio;

/// Sightings between the stages: 67 ms at 120 sweeps a second.
const SIGHTINGS: usize = 8;
/// The memory for them.
pub type Sightings = Queue<Sighting, SIGHTINGS>;

/// Sightings dropped because the queue was full. Written by [`Classify`] alone.
static LOST: AtomicU16 = AtomicU16::new(0);

/// The first stage.
pub struct Classify {
    classifier: Classifier,
    pulses: capture::Reader,
    sightings: Writer<Sighting, SIGHTINGS>,
    owed: Option<Sighting>,
}

impl Classify {
    /// Reads `pulses`, writes `sightings`.
    pub fn new(pulses: capture::Reader, sightings: Writer<Sighting, SIGHTINGS>) -> Self {
        Self { classifier: Classifier::default(), pulses, sightings, owed: None }
    }

    /// Takes the oldest pulse.
    ///
    /// One at a time, as every pulse pends the task that calls this: what a loop would keep ready costs more than the
    /// rare second call.
    #[inline(always)]
    pub fn run(&mut self, config: &Config) -> Done {
        let passed_on = match self.pulses.next() {
            Some(pulse) => match self.classifier.pulse(config, pulse) {
                Some(sighting) => self.pass_on(sighting),
                None => false,
            },
            None => false,
        };
        Done { passed_on, more: !self.pulses.is_empty() }
    }

    /// Notices a long darkness at `now`; true when the solver has something to do. Where a pulse waits there is none.
    pub fn expire(&mut self, config: &Config, now: Ticks) -> bool {
        if !self.pulses.is_empty() {
            return false;
        }
        let Some(sighting) = self.classifier.expire(config, now) else { return false };
        self.pass_on(sighting)
    }

    #[inline(always)]
    fn pass_on(&mut self, sighting: Sighting) -> bool {
        // What is owed comes first, or the news would be of the wrong angles.
        if self.owed.is_some() || !self.sightings.push(sighting) {
            self.owe(sighting);
        }
        true
    }

    #[cold]
    #[inline(never)]
    fn owe(&mut self, sighting: Sighting) {
        if let Some(owed) = self.owed
            && self.sightings.push(owed)
        {
            self.owed = None;
        }
        if self.owed.is_some() || !self.sightings.push(sighting) {
            LOST.store(LOST.load(Ordering::Relaxed).wrapping_add(1), Ordering::Relaxed);
            if sighting.seen == Seen::Lost {
                self.owed = Some(sighting);
            }
        }
    }
}

/// What became of one entry of a queue.
#[derive(Debug, Clone, Copy)]
pub struct Done {
    /// The stage behind has something to do.
    pub passed_on: bool,
    /// This one has more to do.
    pub more: bool,
}

/// The second stage.
pub struct Solve {
    solver: Solver,
    sightings: Reader<Sighting, SIGHTINGS>,
    frames: Writer<Aligned, { radio::FRAMES }>,
    header: Header,
    reports_lost: u16,
}

impl Solve {
    /// Reads `sightings`, writes `frames` as `header` says, its sequence the first.
    pub fn new(
        sightings: Reader<Sighting, SIGHTINGS>,
        frames: Writer<Aligned, { radio::FRAMES }>,
        header: Header,
    ) -> Self {
        Self { solver: Solver::default(), sightings, frames, header, reports_lost: 0 }
    }

    /// Takes the oldest sighting; one at a time as [`Classify::run`].
    #[inline(always)]
    pub fn run(&mut self, config: &Config) -> Done {
        let Some(&sighting) = self.sightings.oldest() else { return Done { passed_on: false, more: false } };
        if sighting.seen == Seen::Lost {
            defmt::warn!("light lost; edges {=u16}, pulses {=u16}", sighting.edges_lost, sighting.pulses_lost);
        }
        let report = self.solver.step(config, sighting);
        self.sightings.pop();
        let passed_on = match report {
            Some(report) => self.send(report),
            None => false,
        };
        Done { passed_on, more: self.sightings.oldest().is_some() }
    }

    /// Makes a frame of a report; whether there was room for it.
    #[inline(never)]
    fn send(&mut self, mut report: Report) -> bool {
        let losses = &mut report.losses;
        losses.edges = losses.edges.wrapping_add(capture::lost());
        losses.sweeps = losses.sweeps.wrapping_add(LOST.load(Ordering::Relaxed));
        losses.reports = self.reports_lost.wrapping_add(radio::lost());
        let sent = self.frames.fill(|frame| frame::emit_into(frame, self.header, &report));
        let count = if sent { &mut self.header.sequence } else { &mut self.reports_lost };
        *count = count.wrapping_add(1);
        sent
    }
}
