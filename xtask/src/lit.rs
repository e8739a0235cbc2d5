//! A mote in its light: the firmware's image in a world, run piece by piece, and what it says on air.
//!
//! What can go wrong: the mote stops, which is an answer and no error: who runs it says what it means.

use std::num::NonZeroU32;

use anyhow::{Context, Result};
use lighthouse_mote::frame::{self, Health, Level, Losses};
use sim::mote::{Halted, Mote};
use sim::world::{Edge, Scene, World};
use xtask::pcap;
use xtask::score::FixRow;
use xtask::trust::{Guard, Refusal};

/// A fix with what the mote said about it.
#[derive(Debug, Clone)]
pub(crate) struct Fix {
    pub(crate) row: FixRow,
    /// When it went on air, true seconds.
    pub(crate) sent_s: f64,
    pub(crate) level: Level,
    /// Per axis, metres.
    pub(crate) sd_m: [f64; 3],
    pub(crate) losses: Losses,
}

/// What one frame says.
#[derive(Debug, Clone)]
pub(crate) enum Said {
    Fix(Box<Fix>),
    Health(Box<Health>),
    /// A frame of another kind.
    Other,
    /// What cannot be read, or not be believed.
    Garbled,
}

/// A frame that was heard.
#[derive(Debug, Clone)]
pub(crate) struct Heard {
    /// When it went on air, true seconds.
    pub(crate) sent_s: f64,
    /// As it says, where it can be read.
    pub(crate) header: Option<frame::Header>,
    pub(crate) said: Said,
    pub(crate) bytes: Vec<u8>,
}

impl Heard {
    pub(crate) fn frame(&self) -> pcap::Frame {
        pcap::Frame { micros: (1e6 * self.sent_s) as u64, bytes: self.bytes.clone() }
    }
}

/// A mote and the light that it is in.
#[derive(Debug, Clone)]
pub(crate) struct Lit {
    pub(crate) world: World,
    pub(crate) mote: Mote,
    pub(crate) mote_hz: f64,
    /// The edge that was made and lies ahead.
    waiting: Option<Edge>,
    /// Who hears it, and the room's key.
    guard: Guard,
    key: Option<[u8; 16]>,
}

/// Light is handed over by so many cycles early: an instruction that has begun is finished, and an edge may fall into it.
const AHEAD: u64 = 64;

impl Lit {
    /// A mote with `elf` at power-on, in the light of `scene`.
    pub(crate) fn boot(elf: &[u8], scene: &Scene, seed: u64) -> Result<Self> {
        let world = World::new(scene, seed);
        let mote_hz = scene.clock.nominal_hz * (1.0 + scene.clock.error);
        let hclk = NonZeroU32::new(mote_hz.round() as u32).context("the mote's clock stands still")?;
        Ok(Self { world, mote: Mote::boot(elf, hclk)?, mote_hz, waiting: None, guard: Guard::new(None), key: None })
    }

    /// The same in a room with this key: who hears it believes what was sealed with it, once.
    pub(crate) fn heard_with(mut self, key: Option<[u8; 16]>) -> Self {
        (self.guard, self.key) = (Guard::new(key), key);
        self
    }

    /// Who hears it knows of no frame that was sealed before.
    pub(crate) fn forget_counters(&mut self) {
        self.guard = Guard::new(self.key);
    }

    /// Runs to a true time in seconds; says so where the mote stopped on the way.
    pub(crate) fn run_to(&mut self, second: f64) -> Result<Option<Halted>> {
        self.run_to_cycle(self.world.cycle(second))
    }

    /// The same to a cycle.
    pub(crate) fn run_to_cycle(&mut self, cycle: u64) -> Result<Option<Halted>> {
        while let Some(edge) = self.waiting.take().or_else(|| self.world.next_edge()) {
            if edge.cycle > cycle + AHEAD {
                self.waiting = Some(edge);
                break;
            }
            self.mote.push_edge(edge.cycle, edge.level)?;
        }
        Ok(self.mote.run_until(cycle).err())
    }

    /// The frames since the last call.
    pub(crate) fn hear(&mut self) -> Result<Vec<Heard>> {
        let sent: Vec<_> = self.mote.take_frames().collect();
        let mut all = Vec::with_capacity(sent.len());
        for sent in sent {
            let sent_s = self.world.seconds(sent.start_cycle);
            let (header, said) = match self.guard.open(&sent.bytes) {
                Ok((header, frame::Message::Fix(report))) => {
                    let sighted = self.mote.cycle_of(report.time).context("the mote's timer cannot be read")?;
                    let seconds = self.world.seconds(sighted);
                    let row = FixRow::of(header, &report, sent.start_cycle, sighted, seconds);
                    let row = FixRow { truth: Some(self.world.truth(sighted)), ..row };
                    let (level, sd_m, losses) = (report.level, report.sd.map(f64::from), report.losses);
                    (Some(header), Said::Fix(Box::new(Fix { row, sent_s, level, sd_m, losses })))
                }
                Ok((header, frame::Message::Health(health))) => (Some(header), Said::Health(Box::new(health))),
                Ok((header, _)) => (Some(header), Said::Other),
                Err(Refusal::NotOurs(frame::Reject::Kind) | Refusal::Unsecured | Refusal::NoKey) => (None, Said::Other),
                Err(_) => (None, Said::Garbled),
            };
            all.push(Heard { sent_s, header, said, bytes: sent.bytes });
        }
        Ok(all)
    }
}
