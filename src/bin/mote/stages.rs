//! The two computing stages between their queues: light to sightings, sightings to reports and their frames.
//!
//! What can go wrong: a queue is full because the stage behind it is slow. What does not fit is dropped and counted,
//! except the news that the cycle was lost, which is owed until it fits: without it the solver would trust angles of
//! an unknown age.

use core::marker::PhantomData;
use core::sync::atomic::{AtomicU16, Ordering};

use lighthouse_mote::chain::{Batch, Classifier, Config, Estimate, Listener, Seen, Sighting, Solver, Understood};
use lighthouse_mote::frame::{self, Aligned, Header, Report, Reset};
use lighthouse_mote::identity::Identity;
use lighthouse_mote::pulse::Pulse;
use lighthouse_mote::sweep::HalfTurn;
use lighthouse_mote::time::{Span, Ticks};

use super::queue::{Queue, Reader, Writer};
#[cfg(feature = "security")]
use super::seal::{Due, Seal};

/// What the stages need of a board.
pub trait Board {
    /// The end of the capture where its pulses come out.
    type Pulses: Pulses;

    /// Who this mote is, read from where no bit of data memory can flip it.
    fn identity() -> Identity;

    /// The room's key, if it has one; from the same place, for the same reason.
    #[cfg(feature = "security")]
    fn key() -> Option<&'static [u8; 16]> {
        None
    }

    /// Edges that became no pulse so far, wrapping.
    fn edges_lost() -> u16;

    /// Frames that the radio gave up so far, wrapping.
    fn frames_lost() -> u16 {
        0
    }
}

/// Pulses from the capture, the oldest first.
pub trait Pulses {
    /// The oldest not yet read.
    fn next(&mut self) -> Option<Pulse>;

    /// Whether there is none to read.
    fn is_empty(&self) -> bool;

    /// The most that ever waited.
    fn most(&self) -> u8;
}

impl<const N: usize> Pulses for Reader<Pulse, N> {
    #[inline(always)]
    fn next(&mut self) -> Option<Pulse> {
        let pulse = self.oldest().copied();
        self.pop();
        pulse
    }

    #[inline(always)]
    fn is_empty(&self) -> bool {
        self.oldest().is_none()
    }

    fn most(&self) -> u8 {
        self.most()
    }
}

/// Sightings between the stages: 67 ms at 120 sweeps a second.
const SIGHTINGS: usize = 8;

/// Sightings dropped because the queue was full. Written by [`Classify`] alone.
static LOST: AtomicU16 = AtomicU16::new(0);

/// What the first stage tells of itself, once a second.
#[derive(Debug, Clone, Copy)]
struct Told {
    understood: Understood,
    /// Seconds since start-up.
    uptime: u32,
    /// The most pulses that ever waited.
    pulses_waiting: u8,
}

/// Room for what was told: it is read before there is more.
const TOLD: usize = 2;

/// Frames that may wait, the one on the air among them: as many as are made in 50 ms, for which a radio may be occupied
/// with its own clock, where every sweep is reported.
pub const FRAMES: usize = 8;

/// The memory between the tasks.
pub struct Queues {
    sightings: Queue<Sighting, SIGHTINGS>,
    tales: Queue<Told, TOLD>,
    /// Where a transmitter can read it: on a word.
    air: Queue<Aligned, FRAMES>,
}

impl Queues {
    /// Empty.
    pub const fn new() -> Self {
        Self { sightings: Queue::new(), tales: Queue::new(), air: Queue::new() }
    }

    /// Both stages, from `pulses` to the frames that are to be sent; `reset` goes into every health frame.
    #[inline(always)]
    pub fn wire<B: Board>(
        &'static mut self,
        pulses: B::Pulses,
        reset: (Reset, u32),
    ) -> (Classify<B>, Solve<B>, Reader<Aligned, FRAMES>) {
        let (to_solve, sightings) = self.sightings.split();
        let (to_tell, tales) = self.tales.split();
        let (to_radio, frames) = self.air.split();
        let solve = Solve::new(sightings, tales, Frames::new(to_radio), reset);
        (Classify::new(pulses, to_solve, to_tell), solve, frames)
    }
}

/// The first stage.
pub struct Classify<B: Board> {
    classifier: Classifier,
    pulses: B::Pulses,
    out: Out,
    tales: Writer<Told, TOLD>,
    uptime: u32,
}

impl<B: Board> Classify<B> {
    /// Reads `pulses`, writes `sightings` and `tales`.
    fn new(pulses: B::Pulses, sightings: Writer<Sighting, SIGHTINGS>, tales: Writer<Told, TOLD>) -> Self {
        let out = Out { sightings, owed: None };
        Self { classifier: Classifier::default(), pulses, out, tales, uptime: 0 }
    }

    /// Takes the oldest pulse.
    ///
    /// One at a time, as every pulse pends the task that calls this: what a loop would keep ready costs more than the
    /// rare second call.
    #[inline(always)]
    pub fn run(&mut self, config: &Config) -> Done {
        let Self { classifier, pulses, out, .. } = self;
        let passed_on = pulses.next().is_some_and(|pulse| classifier.pulse_to(config, pulse, out));
        Done { passed_on, more: !pulses.is_empty() }
    }

    /// A second has passed: notices a long darkness at `now`, and tells how the light is understood.
    pub fn second(&mut self, now: Ticks) {
        self.uptime = self.uptime.wrapping_add(1);
        // Where a pulse waits, it is not dark.
        if self.pulses.is_empty()
            && let Some(sighting) = self.classifier.expire(now)
        {
            self.out.owe(&sighting);
        }
        let understood = self.classifier.understood(now);
        // Dropped where the second stage did not get to the one before: the next one says the same.
        let _ = self.tales.push(Told { understood, uptime: self.uptime, pulses_waiting: self.pulses.most() });
    }

    /// The rotors' half turn, while they are seen.
    pub fn half_turn(&self) -> Option<Span> {
        self.classifier.half_turn().map(HalfTurn::span)
    }
}

/// The way to the second stage.
struct Out {
    sightings: Writer<Sighting, SIGHTINGS>,
    owed: Option<Sighting>,
}

impl Listener for Out {
    #[inline(always)]
    fn hear(&mut self, sighting: impl Fn() -> Sighting) {
        // What is owed comes first, or the news would be of the wrong angles.
        match self.sightings.place() {
            // Made here and there, for what is made before has to be copied.
            Some(place) if self.owed.is_none() => place.put(sighting()),
            _ => self.owe(&sighting()),
        }
    }

    #[inline(always)]
    fn hear_rarely(&mut self, sighting: &Sighting) {
        self.owe(sighting);
    }
}

impl Out {
    /// The same, with all that may have to be done.
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

impl Done {
    /// Wakes whose turn it is: the stage behind, this one again.
    #[inline(always)]
    pub fn wake(self, behind: impl FnOnce(), again: impl FnOnce()) {
        if self.passed_on {
            behind();
        }
        if self.more {
            again();
        }
    }
}

/// The second stage.
pub struct Solve<B: Board> {
    solver: Solver,
    batch: Batch,
    sightings: Reader<Sighting, SIGHTINGS>,
    tales: Reader<Told, TOLD>,
    frames: Frames<B>,
    /// Why the mote started, and where it was then.
    reset: (Reset, u32),
    /// What is to be sealed next.
    #[cfg(feature = "security")]
    due: Due,
}

impl<B: Board> Solve<B> {
    /// Reads `sightings` and `tales`, writes `frames`; `reset` goes into every health frame.
    fn new(
        sightings: Reader<Sighting, SIGHTINGS>,
        tales: Reader<Told, TOLD>,
        frames: Frames<B>,
        reset: (Reset, u32),
    ) -> Self {
        let solver = Solver::of_mote(B::identity().mote);
        Self {
            solver,
            batch: Batch::default(),
            sightings,
            tales,
            frames,
            reset,
            #[cfg(feature = "security")]
            due: Due::Nothing,
        }
    }

    /// Secures every frame from now on.
    #[cfg(feature = "security")]
    pub fn under(mut self, seal: Option<Seal>) -> Self {
        self.frames.seal = seal;
        self
    }

    /// Takes the oldest sighting, or what was told where there is none; one at a time as [`Classify::run`].
    #[inline(always)]
    pub fn run(&mut self, config: &Config) -> Done {
        #[cfg(feature = "security")]
        if let Some(passed_on) = self.seal_what_is_due(config) {
            return Done { passed_on, more: true };
        }
        let Some(sighting) = self.sightings.oldest() else {
            let passed_on = self.is_free_to_tell() && self.tell(config);
            return Done { passed_on, more: false };
        };
        if sighting.seen == Seen::Lost {
            #[cfg(feature = "defmt")]
            defmt::warn!("light lost; edges {=u16}, pulses {=u16}", B::edges_lost(), sighting.pulses_lost);
        }
        let due = self.solver.take(config, sighting);
        let angles = if config.estimate == Estimate::Angles { self.batch.step(sighting) } else { None };
        self.sightings.pop();
        #[cfg(feature = "security")]
        if self.frames.seal.is_some() {
            // Out before anything is sealed again, which takes longer than a slot.
            let mut passed_on = self.solver.is_turn(config) && self.frames.release();
            if let Some(due) = due
                && let Some(report) = self.solver.report(config, due)
            {
                self.due = Due::Report(report);
            } else if let Some(angles) = angles {
                self.frames.waits = false;
                passed_on |= self.frames.put(|frame, header| {
                    frame::emit_angles_into(frame, header, &angles);
                });
            }
            let is_due = !matches!(self.due, Due::Nothing);
            return Done { passed_on, more: is_due || self.sightings.oldest().is_some() || self.is_free_to_tell() };
        }
        let passed_on = if let Some(due) = due
            && let Some(mut report) = self.solver.report(config, due)
        {
            let sent = self.frames.send(&mut report);
            // Behind a report there is the longest silence on the air.
            sent | self.tell(config)
        } else {
            angles.is_some_and(|angles| {
                self.frames.put(|frame, header| {
                    frame::emit_angles_into(frame, header, &angles);
                })
            })
        };
        Done { passed_on, more: self.sightings.oldest().is_some() || self.is_free_to_tell() }
    }

    /// Seals one frame where one is due, so that none waits for another's sealing; whether the transmitter has something
    /// to do then.
    #[cfg(feature = "security")]
    #[inline(never)]
    fn seal_what_is_due(&mut self, config: &Config) -> Option<bool> {
        match core::mem::take(&mut self.due) {
            Due::Nothing => None,
            Due::Report(mut report) => {
                self.due = Due::Health;
                self.frames.waits = self.solver.takes_turns(config);
                Some(self.frames.send(&mut report))
            }
            Due::Health => Some(self.tell(config)),
        }
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
        let mut health = self.solver.health(config, &told.understood);
        health.uptime = told.uptime;
        (health.reset, health.reset_detail) = self.reset;
        health.waiting = [told.pulses_waiting, self.sightings.most(), self.frames.queue.most()];
        health.rejects.edges = health.rejects.edges.wrapping_add(B::edges_lost());
        health.rejects.reports = self.frames.lost();
        // Without a lock there is no turn to come.
        #[cfg(feature = "security")]
        {
            self.frames.waits = told.understood.is_locked() && self.solver.takes_turns(config);
        }
        self.tales.pop();
        self.frames.put(|frame, header| frame::emit_health_into(frame, header, &health))
    }
}

/// The way onto the air: frames made where the radio sends them from.
struct Frames<B: Board> {
    queue: Writer<Aligned, FRAMES>,
    /// Of the next frame.
    sequence: u16,
    lost: u16,
    #[cfg(feature = "security")]
    seal: Option<Seal>,
    /// What is sealed next waits for the mote's turn.
    #[cfg(feature = "security")]
    waits: bool,
    board: PhantomData<B>,
}

impl<B: Board> Frames<B> {
    /// Writes `queue`.
    const fn new(queue: Writer<Aligned, FRAMES>) -> Self {
        Self {
            queue,
            sequence: 0,
            lost: 0,
            #[cfg(feature = "security")]
            seal: None,
            #[cfg(feature = "security")]
            waits: false,
            board: PhantomData,
        }
    }

    /// Frames that there was no room for, or that the radio gave up, wrapping.
    fn lost(&self) -> u16 {
        self.lost.wrapping_add(B::frames_lost())
    }

    /// Has a frame made; whether one goes out. A sealed one may have to wait for the mote's turn.
    #[inline(always)]
    fn put(&mut self, emit: impl FnOnce(&mut Aligned, Header)) -> bool {
        let header = header::<B>(self.sequence);
        #[cfg(feature = "security")]
        if let Some(seal) = &mut self.seal
            && let Some(key) = B::key()
        {
            if self.queue.is_full() {
                // Not even made: what is lost has no number.
                self.lost = self.lost.wrapping_add(1);
                return false;
            }
            self.sequence = self.sequence.wrapping_add(1);
            let crowded = seal.make(key, |frame| emit(frame, header));
            // Where no turn came for it, the oldest goes out all the same: a mote is never silent for good.
            return if self.waits { crowded && self.release_one() } else { self.release() };
        }
        let sent = self.queue.fill(|frame| emit(frame, header));
        let count = if sent { &mut self.sequence } else { &mut self.lost };
        *count = count.wrapping_add(1);
        sent
    }

    /// Lets all sealed frames go out; whether there was one.
    #[cfg(feature = "security")]
    fn release(&mut self) -> bool {
        let mut any = false;
        while self.release_one() {
            any = true;
        }
        any
    }

    /// Lets the oldest sealed frame go out, or be lost where there is no room; whether there was one.
    #[cfg(feature = "security")]
    fn release_one(&mut self) -> bool {
        let Some(frame) = self.seal.as_mut().and_then(Seal::oldest) else { return false };
        if !self.queue.push(frame) {
            self.lost = self.lost.wrapping_add(1);
        }
        true
    }

    /// Makes a frame of a report, as [`Self::put`], with what was lost outside of the chain.
    #[inline(never)]
    fn send(&mut self, report: &mut Report) -> bool {
        let losses = &mut report.losses;
        losses.edges = losses.edges.wrapping_add(B::edges_lost());
        losses.sweeps = losses.sweeps.wrapping_add(LOST.load(Ordering::Relaxed));
        losses.reports = self.lost();
        self.put(|frame, header| frame::emit_into(frame, header, report))
    }
}

/// Who this mote is, read anew for each frame: a copy whose bits flip would give this mote's place as another's.
#[inline(never)]
fn header<B: Board>(sequence: u16) -> Header {
    let Identity { mote, pan, .. } = B::identity();
    Header { pan, mote, sequence }
}
