//! The two computing stages between their queues: light to sightings, sightings to reports and their frames.
//!
//! What can go wrong: a queue is full because the stage behind it is slow. What does not fit is dropped and counted,
//! except the news that the cycle was lost, which is owed until it fits: without it the solver would trust angles of
//! an unknown age.

use core::sync::atomic::{AtomicU16, Ordering};

use lighthouse_mote::chain::{Classifier, Config, Seen, Sighting, Solver};
use lighthouse_mote::frame::{self, Header};
use lighthouse_mote::time::Ticks;

use crate::queue::{Queue, Reader, Writer};
use crate::radio::{self, Frame};
use crate::capture;

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

    /// Takes every pulse there is; true when the solver has something to do.
    pub fn run(&mut self, config: &Config) -> bool {
        let mut any = false;
        while let Some(pulse) = self.pulses.next() {
            if let Some(sighting) = self.classifier.pulse(config, pulse) {
                self.pass_on(sighting);
                any = true;
            }
        }
        any
    }

    /// Notices a long darkness at `now`, after every pulse before it; true when the solver has something to do.
    pub fn expire(&mut self, config: &Config, now: Ticks) -> bool {
        let any = self.run(config);
        let Some(sighting) = self.classifier.expire(config, now) else { return any };
        self.pass_on(sighting);
        true
    }

    fn pass_on(&mut self, sighting: Sighting) {
        // What is owed comes first, or the news would be of the wrong angles.
        if let Some(owed) = self.owed
            && self.sent(&owed)
        {
            self.owed = None;
        }
        if self.owed.is_some() || !self.sent(&sighting) {
            LOST.store(LOST.load(Ordering::Relaxed).wrapping_add(1), Ordering::Relaxed);
            if sighting.seen == Seen::Lost {
                self.owed = Some(sighting);
            }
        }
    }

    /// Whether there was room. Not inlined: it is large, and called twice.
    #[inline(never)]
    fn sent(&mut self, sighting: &Sighting) -> bool {
        self.sightings.push(*sighting)
    }
}

/// The second stage.
pub struct Solve {
    solver: Solver,
    sightings: Reader<Sighting, SIGHTINGS>,
    frames: Writer<Frame, { radio::FRAMES }>,
    header: Header,
    reports_lost: u16,
}

impl Solve {
    /// Reads `sightings`, writes `frames` as `header` says, its sequence the first.
    pub fn new(
        sightings: Reader<Sighting, SIGHTINGS>,
        frames: Writer<Frame, { radio::FRAMES }>,
        header: Header,
    ) -> Self {
        Self { solver: Solver::default(), sightings, frames, header, reports_lost: 0 }
    }

    /// Takes every sighting there is; true when the radio has something to do.
    pub fn run(&mut self, config: &Config) -> bool {
        let mut any = false;
        while let Some(sighting) = self.sightings.oldest() {
            if sighting.seen == Seen::Lost {
                defmt::warn!("light lost; edges {=u16}, pulses {=u16}", sighting.edges_lost, sighting.pulses_lost);
            }
            let report = self.solver.step(config, *sighting);
            self.sightings.pop();
            let Some(mut report) = report else { continue };
            let losses = &mut report.losses;
            losses.edges = losses.edges.wrapping_add(capture::lost());
            losses.sweeps = losses.sweeps.wrapping_add(LOST.load(Ordering::Relaxed));
            losses.reports = self.reports_lost.wrapping_add(radio::lost());
            if self.frames.push(Frame(frame::emit(self.header, &report))) {
                self.header.sequence = self.header.sequence.wrapping_add(1);
                any = true;
            } else {
                self.reports_lost = self.reports_lost.wrapping_add(1);
            }
        }
        any
    }
}
