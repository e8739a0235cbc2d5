//! The image that is flashed, in several virtual motes of one room: do their frames overlap?
//!
//! Every mote has its own place, walks its own way, has its own clock, up to 3 % off, and comes into the light at another
//! time. What it sends has the times of the simulated radio, and the room's air is one.
//!
//! What can go wrong: a mote that stops, that is never heard, or whose frames are not under the room's key; all are errors.

use std::num::NonZeroU32;

use anyhow::{Context, Result, ensure};
use lighthouse_mote::frame::Message;
use lighthouse_mote::ootx::FRAME_BITS;
use sim::mote::Mote;
use sim::world::{Scene, World};

use super::air::{Nanos, Sent, Wish, air_time, unheard};
use super::sending::HALF_TURN;
use crate::flash::identity::{self, Change};
use crate::trust::Guard;

/// The slow end of what the chip's core runs at, Hz: its frames come latest.
const HCLK_HZ: u32 = 5_000_000;
/// A mote comes into the light so much later than the one before, seconds.
const LATER_S: f64 = 0.7313;
/// One station's frame, seconds.
const FRAME_S: f64 = FRAME_BITS as f64 / 120.0;
/// So many of them, and every mote has seen one begin: 18 flashes in a row, of which each is lost with 5 %, come in 40 % of
/// them, and 0.6^16 is 0.03 %.
const FRAMES: f64 = 16.0;

/// What came of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Heard {
    /// Fixes that were on the air.
    pub fixes: usize,
    /// Other frames.
    pub others: usize,
    /// Frames that overlapped another mote's.
    pub lost: usize,
    /// Times that a report came more than a half turn late, and the next so much sooner.
    pub late: usize,
}

/// Lets `motes` motes run `elf`, which reports every `every` half turns, for `seconds` after all of them have seen a station's
/// frame begin. Where there is a `key`, every frame must be under it.
///
/// # Errors
/// A mote that stops, has no identity to change, or sends what is no frame.
pub fn run(
    elf: &[u8],
    key: Option<[u8; 16]>,
    motes: u16,
    every: u16,
    seconds: f64,
    mut done: impl FnMut(u16),
) -> Result<Heard> {
    let known_s = f64::from(motes) * LATER_S + 2.0 + FRAMES * FRAME_S;
    let (mut wishes, mut late) = (Vec::new(), 0);
    for id in 0..motes {
        let sent = one(elf, key, id, motes, (known_s, known_s + seconds));
        let sent = sent.with_context(|| format!("virtual mote {id}"))?;
        let fixes: Vec<f64> = sent.iter().filter(|wish| wish.fix.is_some()).map(|wish| wish.at as f64).collect();
        let apart: Vec<f64> = fixes.windows(2).map(|two| (two[1] - two[0]) / HALF_TURN - f64::from(every)).collect();
        late += apart.windows(2).filter(|two| two[0] > 1.0 && two[1] < -1.0).count();
        wishes.extend(sent);
        done(id);
    }
    let sent = unheard(wishes);
    let fixes = sent.iter().filter(|sent| sent.wish.fix.is_some()).count();
    let is_lost = |sent: &&Sent| !sent.received;
    Ok(Heard { fixes, others: sent.len() - fixes, lost: sent.iter().filter(is_lost).count(), late })
}

/// The frames of one mote between `from_s` and `to_s` of the room's time.
fn one(elf: &[u8], key: Option<[u8; 16]>, id: u16, motes: u16, (from_s, to_s): (f64, f64)) -> Result<Vec<Wish>> {
    let share = f64::from(id) / f64::from(motes);
    let mut scene = Scene { length_s: to_s, ..Scene::default() };
    scene.clock.nominal_hz = f64::from(HCLK_HZ);
    scene.clock.error = 0.06 * share - 0.03;
    // One seed: the same rotors and the same bits of the stations for all. Another box is another way to walk.
    if let sim::world::path::Path::HandHeld { low_m, high_m, .. } = &mut scene.path {
        low_m[0] += 0.2 * share;
        high_m[0] -= 0.2 * (1.0 - share);
        high_m[1] -= 0.1 * share;
    }
    let mut world = World::new(&scene, 1);
    let elf = identity::patch(elf, Change { mote: Some(id), ..Change::default() })?;
    let hclk_hz = NonZeroU32::new(HCLK_HZ).context("the clock stands still")?;
    let mut mote = Mote::boot(&elf, hclk_hz)?;
    let (dark, end) = (world.cycle(f64::from(id) * LATER_S), world.cycle(to_s));
    let mut edges: Vec<_> =
        world.edges().take_while(|edge| edge.cycle < end).filter(|edge| edge.cycle >= dark).collect();
    // The first one rises.
    if edges.first().is_some_and(|edge| !edge.level) {
        edges.remove(0);
    }
    for edge in edges {
        mote.push_edge(edge.cycle, edge.level)?;
    }
    mote.run_until(end)?;
    // Behind a health frame, which it has to know by its length, sealed or not.
    let powered = mote.machine.bus.powered();
    ensure!(powered.oscillator > powered.amplifier, "the radio's oscillator was never counted");
    let mut guard = Guard::new(key);
    let mut wishes = Vec::new();
    for sent in mote.take_frames().collect::<Vec<_>>() {
        let at_s = world.seconds(sent.start_cycle);
        let (_, message) = guard.open(&sent.bytes).with_context(|| format!("a frame at {at_s:.3} s"))?;
        if at_s < from_s {
            continue;
        }
        let is_fix = matches!(message, Message::Fix(_));
        wishes.push(Wish {
            at: (at_s * 1e9) as Nanos,
            mote: id.into(),
            lasts: air_time(sent.bytes.len()),
            fix: is_fix.then_some(0),
        });
    }
    ensure!(!wishes.is_empty(), "not a frame after {from_s:.1} s");
    Ok(wishes)
}
