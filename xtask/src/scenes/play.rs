//! One take: a mote from power-on in its light, and all that it said.
//!
//! What can go wrong: the mote stops or starts anew. Neither ends the take with an error: both are what a scene is there
//! to find.

use anyhow::{Context, Result};
use defmt_decoder::Table;
use lighthouse_mote::frame::Health;
use sim::world::EventKind;
use xtask::pcap;
use xtask::score::Place;

use super::list::Take;
use crate::lit::{Fix, Lit, Said};
use crate::log::{Log, is_lock_lost, is_start};

/// How often the mote is looked at, seconds of its time.
const LOOK_S: f64 = 0.05;
/// When the timer is set, where a take says so: after bring-up, before the first light, seconds.
const AGE_AT_S: f64 = 0.03;

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

/// Runs `elf` through the take.
pub(super) fn play(elf: &[u8], strings: &'static Table, take: &Take) -> Result<Played> {
    let mut lit = Lit::boot(elf, &take.scene, take.seed)?;
    lit.world.keep_log();
    let mut log = Log::of(strings);
    let mut played = Played { mote_hz: lit.mote_hz, ..Played::default() };
    let mut boots = 0;
    if let Some(wrap_s) = take.wrap_s {
        lit.mote.run_until(lit.world.cycle(AGE_AT_S))?;
        let zero = lit.mote.cycle_of(0).context("the mote's timer cannot be read")?;
        // The timer has then counted so many ticks; wrapping them to zero is the point.
        lit.mote.age_timer(((lit.world.cycle(wrap_s) - zero) as u32).wrapping_neg());
    }
    let mut second = take.wrap_s.map_or(0.0, |_| AGE_AT_S);
    while second < take.scene.length_s && played.halted.is_none() {
        second = (second + LOOK_S).min(take.scene.length_s);
        played.halted = lit.run_to(second)?.map(|halted| halted.to_string());
        for event in lit.world.take_log() {
            if matches!(event.kind, EventKind::Sweep { .. }) {
                played.passes.push(event.cycle);
                if event.seen {
                    played.sweeps.push(event.cycle);
                }
            }
        }
        for heard in lit.hear()? {
            played.frames.push(heard.frame());
            match heard.said {
                Said::Fix(fix) => {
                    played.edges_lost = fix.losses.edges;
                    played.fixes.push(*fix);
                }
                Said::Health(health) => played.health.push((heard.sent_s, *health)),
                Said::Other => played.other_frames += 1,
                Said::Garbled => played.garbled += 1,
            }
        }
        for line in log.read(&lit.mote.take_log()) {
            boots += u32::from(is_start(&line));
            played.locks_lost += u32::from(is_lock_lost(&line));
            played.log.push(format!("{second:7.2} s  {line}"));
        }
        played.truth.push((second, lit.world.truth(lit.world.cycle(second))));
    }
    played.resets = u32::saturating_sub(boots, 1);
    Ok(played)
}
