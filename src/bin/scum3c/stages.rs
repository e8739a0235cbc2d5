//! The two computing stages between their queues: light to sightings, sightings to reports and their frames.
//!
//! What can go wrong: a queue is full because the stage behind it is slow. What does not fit is dropped and counted,
//! except the news that the cycle was lost, which is owed until it fits: without it the solver would trust angles of
//! an unknown age.

use core::sync::atomic::{AtomicU16, Ordering};

use lighthouse_mote::chain::{Batch, Classifier, Config, Estimate, Seen, Sighting, Solver, Understood};
use lighthouse_mote::frame::{self, Aligned, Header, Report, Reset};
use lighthouse_mote::identity::Identity;
use lighthouse_mote::sweep::HalfTurn;
use lighthouse_mote::time::{Span, Ticks};

use crate::queue::{Queue, Reader, Writer};
use crate::radio;
use crate::{capture, fault};

/// Sightings between the stages: 67 ms at 120 sweeps a second.
const SIGHTINGS: usize = 8;
/// The memory for them.
pub type Sightings = Queue<Sighting, SIGHTINGS>;

/// Sightings dropped because the queue was full. Written by [`Classify`] alone.
static LOST: AtomicU16 = AtomicU16::new(0);

/// What the first stage tells of itself, once a second.
#[derive(Debug, Clone, Copy)]
pub struct Told {
    understood: Understood,
    /// Seconds since start-up.
    uptime: u32,
    /// The most pulses that ever waited.
    pulses_waiting: u8,
}

/// Room for what was told: it is read before there is more.
const TOLD: usize = 2;
/// The memory for it.
pub type Tales = Queue<Told, TOLD>;

/// Half turns in a second: two per turn of a 60 Hz rotor.
const HALF_TURNS_PER_S: u32 = 120;

/// The first stage.
pub struct Classify {
    classifier: Classifier,
    pulses: capture::Reader,
    sightings: Writer<Sighting, SIGHTINGS>,
    owed: Option<Sighting>,
    tales: Writer<Told, TOLD>,
    uptime: u32,
}

impl Classify {
    /// Reads `pulses`, writes `sightings` and `tales`.
    pub fn new(pulses: capture::Reader, sightings: Writer<Sighting, SIGHTINGS>, tales: Writer<Told, TOLD>) -> Self {
        Self { classifier: Classifier::default(), pulses, sightings, owed: None, tales, uptime: 0 }
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

    /// A second has passed: notices a long darkness at `now`, and tells how the light is understood.
    pub fn second(&mut self, config: &Config, now: Ticks) {
        self.uptime = self.uptime.wrapping_add(1);
        // Where a pulse waits, it is not dark.
        if self.pulses.is_empty()
            && let Some(sighting) = self.classifier.expire(config, now)
        {
            self.pass_on(sighting);
        }
        let understood = self.classifier.understood(now);
        // Dropped where the second stage did not get to the one before: the next one says the same.
        let _ = self.tales.push(Told { understood, uptime: self.uptime, pulses_waiting: self.pulses.most() });
    }

    /// A second by the rotors, while they are seen.
    pub fn second_in_ticks(&self) -> Option<Span> {
        let ticks = |half_turn: HalfTurn| Span(half_turn.span().0.saturating_mul(HALF_TURNS_PER_S));
        self.classifier.half_turn().map(ticks)
    }

    #[inline(always)]
    fn pass_on(&mut self, sighting: Sighting) -> bool {
        // What is owed comes first, or the news would be of the wrong angles.
        if self.owed.is_some() || !self.sightings.push(sighting) {
            self.owe(&sighting);
        }
        true
    }

    #[cold]
    #[inline(never)]
    fn owe(&mut self, sighting: &Sighting) {
        if let Some(owed) = self.owed
            && self.sightings.push(owed)
        {
            self.owed = None;
        }
        if self.owed.is_some() || !self.sightings.push(*sighting) {
            LOST.store(LOST.load(Ordering::Relaxed).wrapping_add(1), Ordering::Relaxed);
            if sighting.seen == Seen::Lost {
                self.owed = Some(*sighting);
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
    batch: Batch,
    sightings: Reader<Sighting, SIGHTINGS>,
    tales: Reader<Told, TOLD>,
    frames: Frames,
    /// Why the mote started, and where it was then.
    reset: (Reset, u32),
    /// Tales of a known cycle in a row, without a sighting.
    deaf: u32,
}

/// The classifier tells of a known cycle and sees something of it each second: more without a sighting, and one end of
/// their queue is not where the other is.
const MOST_DEAF: u32 = 3;

impl Solve {
    /// Reads `sightings` and `tales`, writes `frames`; `reset` goes into every health frame.
    pub fn new(
        sightings: Reader<Sighting, SIGHTINGS>,
        tales: Reader<Told, TOLD>,
        frames: Frames,
        reset: (Reset, u32),
    ) -> Self {
        Self { solver: Solver::default(), batch: Batch::default(), sightings, tales, frames, reset, deaf: 0 }
    }

    /// Takes the oldest sighting, or what was told where there is none; one at a time as [`Classify::run`].
    #[inline(always)]
    pub fn run(&mut self, config: &Config) -> Done {
        let Some(sighting) = self.sightings.oldest() else {
            let passed_on = self.is_free_to_tell() && self.tell(config);
            return Done { passed_on, more: false };
        };
        self.deaf = 0;
        if sighting.seen == Seen::Lost {
            defmt::warn!("light lost; edges {=u16}, pulses {=u16}", capture::lost(), sighting.pulses_lost);
        }
        let report = self.solver.step(config, *sighting);
        let angles = if config.estimate == Estimate::Angles { self.batch.step(sighting) } else { None };
        self.sightings.pop();
        let passed_on = match report {
            Some(report) => {
                let sent = self.frames.send(report);
                // Behind a report there is the longest silence on the air.
                sent | self.tell(config)
            }
            None => angles.is_some_and(|angles| {
                self.frames.put(|frame, header| {
                    frame::emit_angles_into(frame, header, &angles);
                })
            }),
        };
        Done { passed_on, more: self.sightings.oldest().is_some() || self.is_free_to_tell() }
    }

    /// Whether to tell without waiting for a report: none is to be expected, or none has come for a second.
    #[inline(always)]
    fn is_free_to_tell(&self) -> bool {
        self.tales.oldest().is_some_and(|told| !told.understood.is_locked() || self.tales.has_several())
    }

    /// Makes a frame of what the first stage told; whether it did.
    #[inline(never)]
    fn tell(&mut self, config: &Config) -> bool {
        let Some(told) = self.tales.oldest() else { return false };
        if told.understood.is_locked() {
            self.deaf += 1;
            if self.deaf > MOST_DEAF {
                fault::reset(fault::Kind::Watchdog, 1);
            }
        }
        let mut health = self.solver.health(config, &told.understood);
        health.uptime = told.uptime;
        (health.reset, health.reset_detail) = self.reset;
        health.waiting = [told.pulses_waiting, self.sightings.most(), self.frames.queue.most()];
        health.rejects.edges = health.rejects.edges.wrapping_add(capture::lost());
        health.rejects.reports = self.frames.lost();
        self.tales.pop();
        self.frames.put(|frame, header| frame::emit_health_into(frame, header, &health))
    }
}

/// The way onto the air: frames made where the radio sends them from.
pub struct Frames {
    queue: Writer<Aligned, { radio::FRAMES }>,
    /// Of the next frame.
    sequence: u16,
    lost: u16,
}

impl Frames {
    /// Writes `queue`.
    pub const fn new(queue: Writer<Aligned, { radio::FRAMES }>) -> Self {
        Self { queue, sequence: 0, lost: 0 }
    }

    /// Frames that there was no room for, or that the radio gave up, wrapping.
    fn lost(&self) -> u16 {
        self.lost.wrapping_add(radio::lost())
    }

    /// Has a frame made; whether there was room for it.
    #[inline(always)]
    fn put(&mut self, emit: impl FnOnce(&mut Aligned, Header)) -> bool {
        let header = header(self.sequence);
        let sent = self.queue.fill(|frame| emit(frame, header));
        let count = if sent { &mut self.sequence } else { &mut self.lost };
        *count = count.wrapping_add(1);
        sent
    }

    /// Makes a frame of a report; whether there was room for it.
    #[inline(never)]
    fn send(&mut self, mut report: Report) -> bool {
        let losses = &mut report.losses;
        losses.edges = losses.edges.wrapping_add(capture::lost());
        losses.sweeps = losses.sweeps.wrapping_add(LOST.load(Ordering::Relaxed));
        losses.reports = self.lost();
        self.put(|frame, header| frame::emit_into(frame, header, &report))
    }
}

/// Who this mote is, read anew for each frame: a copy whose bits flip would give this mote's place as another's.
#[inline(never)]
fn header(sequence: u16) -> Header {
    let Identity { mote, pan, .. } = crate::IDENTITY.read();
    Header { pan, mote, sequence }
}
