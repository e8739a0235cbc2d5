//! The two computing stages between their queues: light to sightings, sightings to reports.
//!
//! What can go wrong: a queue is full because the stage behind it is slow. What does not fit is dropped and counted,
//! except the news that the cycle was lost, which is owed until it fits: without it the solver would trust angles of
//! an unknown age.

use core::sync::atomic::{AtomicU16, Ordering};

use heapless::spsc::{Consumer, Producer, Queue};
use lighthouse_mote::chain::{Classifier, Config, Seen, Sighting, Solver};
use lighthouse_mote::frame::Report;

use crate::{capture, clock, radio};

/// The memory between the stages: 7 sightings are 58 ms at 120 sweeps a second.
pub type Sightings = Queue<Sighting, 8>;
/// The memory between solver and radio: 3 reports.
pub type Reports = Queue<Report, 4>;

/// Sightings dropped because the queue was full. Written by [`Classify`] alone.
static LOST: AtomicU16 = AtomicU16::new(0);

/// The first stage.
pub struct Classify {
    classifier: Classifier,
    pulses: capture::Reader,
    sightings: Producer<'static, Sighting>,
    owed: Option<Sighting>,
}

/// What a run of the first stage found.
#[derive(Debug, Clone, Copy, Default)]
pub struct Run {
    /// There was light.
    pub light: bool,
    /// The solver has something to do.
    pub sightings: bool,
}

impl Classify {
    /// Reads `pulses`, writes `sightings`.
    pub fn new(pulses: capture::Reader, sightings: Producer<'static, Sighting>) -> Self {
        Self { classifier: Classifier::default(), pulses, sightings, owed: None }
    }

    /// Takes every pulse there is.
    pub fn run(&mut self, config: &Config) -> Run {
        let mut run = Run::default();
        while let Some(pulse) = self.pulses.next() {
            run.light = true;
            if let Some(sighting) = self.classifier.pulse(config, pulse) {
                self.pass_on(sighting);
                run.sightings = true;
            }
        }
        self.pulses.caught_up();
        run
    }

    /// Notices a long darkness; true when the solver has something to do.
    ///
    /// The clock is read before the queue: a pulse that comes between is light enough, and later than that time.
    pub fn expire(&mut self, config: &Config) -> bool {
        let now = clock::now();
        let run = self.run(config);
        if run.light {
            return run.sightings;
        }
        let Some(sighting) = self.classifier.expire(config, now) else { return false };
        self.pass_on(sighting);
        true
    }

    fn pass_on(&mut self, sighting: Sighting) {
        // What is owed comes first, or the news would be of the wrong angles.
        if let Some(owed) = self.owed
            && self.sightings.enqueue(owed).is_ok()
        {
            self.owed = None;
        }
        if self.owed.is_some() || self.sightings.enqueue(sighting).is_err() {
            LOST.store(LOST.load(Ordering::Relaxed).wrapping_add(1), Ordering::Relaxed);
            if sighting.seen == Seen::Lost {
                self.owed = Some(sighting);
            }
        }
    }
}

/// The second stage.
pub struct Solve {
    solver: Solver,
    sightings: Consumer<'static, Sighting>,
    reports: Producer<'static, Report>,
    reports_lost: u16,
}

impl Solve {
    /// Reads `sightings`, writes `reports`.
    pub fn new(sightings: Consumer<'static, Sighting>, reports: Producer<'static, Report>) -> Self {
        Self { solver: Solver::default(), sightings, reports, reports_lost: 0 }
    }

    /// Takes every sighting there is; true when the radio has something to do.
    pub fn run(&mut self, config: &Config) -> bool {
        let mut any = false;
        while let Some(sighting) = self.sightings.dequeue() {
            if sighting.seen == Seen::Lost {
                defmt::warn!("light lost; edges {=u16}, pulses {=u16}", capture::lost(), sighting.pulses_lost);
            }
            let Some(mut report) = self.solver.step(config, sighting) else { continue };
            let losses = &mut report.losses;
            losses.edges = losses.edges.wrapping_add(capture::lost());
            losses.sweeps = losses.sweeps.wrapping_add(LOST.load(Ordering::Relaxed));
            losses.reports = self.reports_lost.wrapping_add(radio::lost());
            if self.reports.enqueue(report).is_err() {
                self.reports_lost = self.reports_lost.wrapping_add(1);
            }
            any = true;
        }
        any
    }
}
