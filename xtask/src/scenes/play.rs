//! One take: a mote from power-on in its light, and all that it said.
//!
//! What can go wrong: the mote stops or starts anew. Neither ends the take with an error: both are what a scene is there
//! to find.

use std::num::NonZeroU32;

use anyhow::{Context, Result};
use defmt_decoder::Table;
use lighthouse_mote::frame::{self, Health, Level};
use sim::mote::Mote;
use sim::world::{EventKind, World};
use xtask::pcap;
use xtask::score::{FixRow, Place};

use super::list::Take;
use crate::run::{HALF_TURN_S, Log};

/// How often the mote is looked at, seconds of its time.
const LOOK_S: f64 = 0.05;
/// When the timer is set, where a take says so: after bring-up, before the first light, seconds.
const AGE_AT_S: f64 = 0.03;
/// What the mote logs when the cycle is lost.
const LOCK_LOST: &str = "light lost";
/// What the mote logs when it starts.
const BOOTED: &str = "lighthouse mote";

/// A fix with what the mote said about it.
#[derive(Debug, Clone)]
pub(super) struct Fix {
    pub(super) row: FixRow,
    /// When it went on air, true seconds.
    pub(super) sent_s: f64,
    pub(super) level: Level,
    /// Per axis, metres.
    pub(super) sd_m: [f64; 3],
}

/// What came of a take.
#[derive(Debug, Default)]
pub(super) struct Played {
    pub(super) fixes: Vec<Fix>,
    pub(super) frames: Vec<pcap::Frame>,
    pub(super) truth: Vec<Place>,
    /// Cycles at which a sweep reached the mote.
    pub(super) sweeps: Vec<u64>,
    /// Cycles at which a sweep passed, whether or not it reached the mote.
    pub(super) passes: Vec<u64>,
    pub(super) mote_hz: f64,
    pub(super) locks_lost: u32,
    /// Edges that the mote says it lost, in its last report.
    pub(super) edges_lost: u16,
    /// Starts after the first.
    pub(super) resets: u32,
    /// Why the mote stopped, if it did.
    pub(super) halted: Option<String>,
    /// What the mote said of itself once a second, and when, true seconds.
    pub(super) health: Vec<(f64, Health)>,
    /// Frames of a kind that no scene asks for, and frames that cannot be read.
    pub(super) other_frames: u32,
    pub(super) garbled: u32,
    pub(super) log: Vec<String>,
}

/// What one frame says.
enum Heard {
    Fix(u16, frame::Report),
    Health(Box<Health>),
    Other,
    Garbled,
}

fn hear(bytes: &[u8]) -> Heard {
    match frame::parse(bytes) {
        Ok((header, frame::Message::Fix(report))) => Heard::Fix(header.sequence, report),
        Ok((_, frame::Message::Health(health))) => Heard::Health(Box::new(health)),
        Ok(_) => Heard::Other,
        Err(frame::Reject::Kind) => Heard::Other,
        Err(_) => Heard::Garbled,
    }
}

/// Runs `elf` through the take.
pub(super) fn play(elf: &[u8], strings: &'static Table, take: &Take) -> Result<Played> {
    let mut world = World::new(&take.scene, take.seed);
    world.keep_log();
    let clock = &take.scene.clock;
    let mote_hz = clock.nominal_hz * (1.0 + clock.error);
    let hclk = NonZeroU32::new(mote_hz.round() as u32).context("the mote's clock stands still")?;
    let mut mote = Mote::boot(elf, hclk)?;
    let mut log = Log::of(strings);
    let mut played = Played { mote_hz, ..Played::default() };
    let mut boots = 0;
    let mut waiting = None;
    if let Some(wrap_s) = take.wrap_s {
        mote.run_until(world.cycle(AGE_AT_S))?;
        let zero = mote.cycle_of(0).context("the mote's timer cannot be read")?;
        // The timer has then counted so many ticks; wrapping them to zero is the point.
        mote.age_timer(((world.cycle(wrap_s) - zero) as u32).wrapping_neg());
    }
    let mut second = take.wrap_s.map_or(0.0, |_| AGE_AT_S);
    while second < take.scene.length_s && played.halted.is_none() {
        second = (second + LOOK_S).min(take.scene.length_s);
        let cycle = world.cycle(second);
        mote.set_hclk_hz(world.clock_hz(second - LOOK_S / 2.0));
        while let Some(edge) = waiting.take().or_else(|| world.next_edge()) {
            if edge.cycle > cycle {
                waiting = Some(edge);
                break;
            }
            mote.push_edge(edge.cycle, edge.level)?;
        }
        for event in world.take_log() {
            if matches!(event.kind, EventKind::Sweep { .. }) {
                played.passes.push(event.cycle);
                if event.seen {
                    played.sweeps.push(event.cycle);
                }
            }
        }
        played.halted = mote.run_until(cycle).err().map(|halted| halted.to_string());
        for sent in mote.take_frames().collect::<Vec<_>>() {
            let sent_s = world.seconds(sent.start_cycle);
            match hear(&sent.bytes) {
                Heard::Fix(sequence, report) => {
                    played.edges_lost = report.losses.edges;
                    let sighted = mote.cycle_of(report.time).context("the mote's timer cannot be read")?;
                    let row = FixRow {
                        cycle: sent.start_cycle,
                        sighted,
                        seconds: world.seconds(sighted),
                        position: report.position.map(f64::from),
                        mismatch_m: f64::from(report.mismatch),
                        age_s: f64::from(report.age) * HALF_TURN_S,
                        sequence,
                        truth: Some(world.truth(sighted)),
                    };
                    played.fixes.push(Fix { row, sent_s, level: report.level, sd_m: report.sd.map(f64::from) });
                }
                Heard::Health(health) => played.health.push((sent_s, *health)),
                Heard::Other => played.other_frames += 1,
                Heard::Garbled => played.garbled += 1,
            }
            played.frames.push(pcap::Frame { micros: (1e6 * sent_s) as u64, bytes: sent.bytes });
        }
        for line in log.read(&mote.take_log()) {
            boots += u32::from(line.contains(BOOTED));
            played.locks_lost += u32::from(line.contains(LOCK_LOST));
            played.log.push(format!("{second:7.2} s  {line}"));
        }
        played.truth.push((second, world.truth(cycle)));
    }
    played.resets = u32::saturating_sub(boots, 1);
    Ok(played)
}
