//! The whole firmware in the light of a room: load, latencies, sizes, and where the instructions go.
//!
//! What can go wrong: the mote stops, or sends no frame; both are errors.

use std::collections::BTreeMap;
use std::num::NonZeroU32;

use anyhow::{Context, Result, ensure};
use lighthouse_mote::frame;
use sim::core::cycles::{Multiplier, Timing};
use sim::elf::Symbols;
use sim::machine::{Config, Machine};
use sim::mote::Mote;
use sim::scum3c::{self, Scum3c};
use sim::world::{EventKind, Scene, World};
use xtask::trust::Guard;

use super::stages::Count;

/// The edge handlers' exception numbers: 16 + lines 12 and 13.
const RISE: u8 = 28;
const FALL: u8 = 29;
/// Bring-up, lock and the start of the track are over, seconds.
const SETTLED_S: f64 = 2.0;
/// How often the oscillator follows the world's clock, seconds.
const FOLLOW_S: f64 = 0.1;
/// A frame this close to a laser's stamp reports that laser, seconds.
const SAME_S: f64 = 50e-6;

/// One run.
pub(super) struct Run {
    pub(super) hclk_hz: u32,
    pub(super) multiplier: Multiplier,
    /// Every flash and every sweep arrives, and nothing else.
    pub(super) full_light: bool,
    pub(super) seconds: f64,
    /// Look at every instruction.
    pub(super) profile: bool,
}

/// What came of it.
#[derive(Debug, Default)]
pub(super) struct Whole {
    pub(super) load_percent: f64,
    pub(super) sweeps: u64,
    pub(super) frames: u64,
    /// Rise, fall: entry and return not counted.
    pub(super) edge_own_cycles: [u64; 2],
    pub(super) edge_latency: [u64; 2],
    pub(super) light_to_frame_ms: f64,
    pub(super) light_to_frame_mean_ms: f64,
    pub(super) stack: u32,
    pub(super) energy: Energy,
    pub(super) profile: Profile,
}

/// The chip at work, radio or core, watts: as published for it (Kilberg et al., Accurate 3D Lighthouse Localization of a
/// Low-Power Crystal-Free Single-Chip Mote, JMEMS 29(5), 2020).
pub(super) const ACTIVE_W: f64 = 2e-3;
/// The optical receiver, always on, watts (there).
pub(super) const RECEIVER_W: f64 = 1.5e-6;

/// What a fix takes. Sleep is not in it: nothing is published of that.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Energy {
    /// Of each fix's share of the time, seconds: the core awake, the radio powered, all of it.
    pub(super) awake_s: f64,
    pub(super) radio_s: f64,
    pub(super) all_s: f64,
}

impl Energy {
    /// The core's part, joules.
    pub(super) fn core_j(&self) -> f64 {
        self.awake_s * ACTIVE_W
    }

    /// The radio's, joules: as if the core slept meanwhile, so at most a little too much.
    pub(super) fn radio_j(&self) -> f64 {
        self.radio_s * ACTIVE_W
    }

    /// The receiver's, joules.
    pub(super) fn receiver_j(&self) -> f64 {
        self.all_s * RECEIVER_W
    }

    /// All of it, joules.
    pub(super) fn fix_j(&self) -> f64 {
        self.core_j() + self.radio_j() + self.receiver_j()
    }
}

/// Where the instructions went.
#[derive(Debug, Default)]
pub(super) struct Profile {
    pub(super) instructions: u64,
    /// By function.
    pub(super) functions: BTreeMap<String, u64>,
    /// Of one run of each edge handler: rise, fall.
    pub(super) edges: [Count; 2],
}

/// Runs the firmware in the light of a room.
pub(super) fn run(elf: &[u8], light: &Scene, key: Option<[u8; 16]>, run: &Run) -> Result<Whole> {
    let hz = f64::from(run.hclk_hz);
    let end_s = SETTLED_S + run.seconds;
    let mut scene = Scene { length_s: end_s, ..light.clone() };
    scene.clock.nominal_hz = hz;
    scene.clock.error = 0.0;
    if run.full_light {
        scene.receiver.sync_dropout = 0.0;
        scene.receiver.sweep_dropout = 0.0;
        scene.interference.rate_per_s = 0.0;
    }
    let mut world = World::new(&scene, 1);
    world.keep_log();
    let mut mote = boot(elf, run)?;
    let stack_top = mote.machine.core.registers.msp();
    let (settled, end) = (world.cycle(SETTLED_S), world.cycle(end_s));
    let edges: Vec<_> = world.edges().take_while(|edge| edge.cycle < end).collect();
    for edge in edges {
        mote.push_edge(edge.cycle, edge.level)?;
    }
    let lasers: Vec<u64> = world
        .take_log()
        .iter()
        .filter(|event| event.seen && event.cycle >= settled && matches!(event.kind, EventKind::Sweep { .. }))
        .map(|event| event.cycle)
        .collect();

    follow(&mut mote, &world, 0.0, SETTLED_S)?;
    mote.machine.core.statistics.clear();
    drop(mote.take_frames());
    let before = mote.load();
    let powered_before = mote.machine.bus.powered().oscillator;
    let profile = if run.profile { watch(&mut mote, end)? } else { Profile::default() };
    let mut whole = Whole { profile, sweeps: lasers.len() as u64, ..Whole::default() };
    if !run.profile {
        follow(&mut mote, &world, SETTLED_S, end_s)?;
    }
    let (mut delays, mut fixes, mut guard) = (Vec::new(), 0_u32, Guard::new(key));
    for sent in mote.take_frames().collect::<Vec<_>>() {
        whole.frames += 1;
        let (_, message) = guard.open(&sent.bytes).ok().context("a frame that cannot be read")?;
        let frame::Message::Fix(report) = message else { continue };
        fixes += 1;
        let stamped = mote.cycle_of(report.time).context("the mote's timer cannot be read")?;
        let at = lasers.partition_point(|&laser| laser < stamped);
        let nearest = lasers[at.saturating_sub(1)..].iter().take(2).min_by_key(|laser| laser.abs_diff(stamped));
        if let Some(&laser) = nearest.filter(|laser| (laser.abs_diff(stamped) as f64) < SAME_S * hz) {
            delays.push((sent.start_cycle - laser) as f64 / hz * 1e3);
        }
    }
    ensure!(!delays.is_empty(), "no frame left the mote");
    whole.light_to_frame_ms = delays.iter().copied().fold(0.0, f64::max);
    whole.light_to_frame_mean_ms = delays.iter().sum::<f64>() / delays.len() as f64;
    let refusals = mote.machine.bus.refusals();
    ensure!(refusals.is_empty(), "the chip refused: {}", refusals[0]);
    whole.load_percent = mote.load().percent_since(&before);
    let each = |cycles: u64| cycles as f64 / hz / f64::from(fixes);
    let (after, powered) = (mote.load(), mote.machine.bus.powered().oscillator);
    whole.energy = Energy {
        awake_s: each((after.cycles - before.cycles) - (after.asleep - before.asleep)),
        radio_s: each(powered - powered_before),
        all_s: each(after.cycles - before.cycles),
    };
    let records = [RISE, FALL].map(|number| *mote.machine.core.statistics.of(number));
    whole.edge_own_cycles = records.map(|record| record.worst_own_cycles);
    whole.edge_latency = records.map(|record| record.worst_latency);
    whole.stack = stack_top - mote.machine.core.registers.lowest_main_sp();
    Ok(whole)
}

/// Runs from one true time to another, the oscillator's rate that of the world's clock in each step.
fn follow(mote: &mut Mote, world: &World, from_s: f64, to_s: f64) -> Result<()> {
    let mut now_s = from_s;
    while now_s < to_s {
        mote.set_hclk_hz(world.clock_hz(now_s + FOLLOW_S / 2.0));
        now_s = (now_s + FOLLOW_S).min(to_s);
        mote.run_until(world.cycle(now_s))?;
    }
    Ok(())
}

fn boot(elf: &[u8], run: &Run) -> Result<Mote> {
    let hclk_hz = NonZeroU32::new(run.hclk_hz).context("the clock stands still")?;
    let devices = Scum3c::new(scum3c::Config { hclk_hz, ..scum3c::Config::default() });
    let timing = Timing::CortexM0(run.multiplier);
    let mut machine = Machine::new(Config { clock_hz: run.hclk_hz, timing, ..Config::default() }, devices);
    let symbols = machine.load_elf(elf)?;
    Ok(Mote { machine, symbols })
}

/// Runs to `end` one instruction at a time.
fn watch(mote: &mut Mote, end: u64) -> Result<Profile> {
    let mut profile = Profile::default();
    let mut places: BTreeMap<u32, u64> = BTreeMap::new();
    let mut handler = (0, 0);
    while mote.machine.cycles() < end {
        let (pc, number) = (mote.machine.core.registers.pc, mote.machine.core.registers.ipsr);
        let before = mote.machine.instructions();
        mote.run_until(mote.machine.cycles() + 1)?;
        let ran = mote.machine.instructions() - before;
        if ran > 0 {
            *places.entry(pc).or_default() += ran;
            profile.instructions += ran;
        }
        // Nothing preempts the edges' handlers, so each runs in one piece.
        if number != handler.0 {
            match handler.0 {
                RISE => profile.edges[0].add(handler.1),
                FALL => profile.edges[1].add(handler.1),
                _ => {}
            }
            handler = (number, 0);
        }
        handler.1 += ran;
    }
    for (pc, ran) in places {
        let name = mote.symbols.containing(pc).map_or_else(|| "?".to_string(), readable);
        *profile.functions.entry(name).or_default() += ran;
    }
    Ok(profile)
}

/// A mangled name as a path: the numbered parts of `_ZN5first6second17h0123456789abcdefE`.
pub(crate) fn readable(name: &str) -> String {
    let name = name.split(".llvm").next().unwrap_or(name);
    // The crate's own number ends with the first underline after `_R`.
    let newer = name.strip_prefix("_R").and_then(|rest| rest.split_once('_')).map(|(_, rest)| rest);
    let Some(mut rest) = name.strip_prefix("_ZN").or(newer) else { return name.to_string() };
    let mut parts = Vec::new();
    while let Some(digit) = rest.find(|c: char| c.is_ascii_digit()) {
        rest = &rest[digit..];
        let digits = rest.len() - rest.trim_start_matches(|c: char| c.is_ascii_digit()).len();
        let (number, after) = rest.split_at(digits);
        match number.parse().ok().and_then(|length: usize| after.split_at_checked(length)) {
            Some((part, after)) if !part.is_empty() => {
                let hash = part.len() == 17 && part.starts_with('h');
                if !hash {
                    parts.push(part);
                }
                rest = after;
            }
            _ => rest = after,
        }
    }
    if parts.is_empty() { name.to_string() } else { parts.join("::") }
}

/// Bytes of the image by what they are for.
#[derive(Debug, Clone, Copy)]
pub(super) struct Size {
    /// Vectors and code.
    pub(super) text: u32,
    /// Constants and tables.
    pub(super) rodata: u32,
    /// Initial values of variables.
    pub(super) data: u32,
    /// Variables that start-up clears.
    pub(super) bss: u32,
    /// Variables that it leaves alone, RTIC's among them.
    pub(super) uninit: u32,
}

impl Size {
    /// Reads it from the names the linker script gives.
    pub(super) fn of(symbols: &Symbols) -> Result<Self> {
        let at = |name: &str| symbols.address(name).with_context(|| format!("the image has no {name}"));
        Ok(Self {
            text: at("__etext")?,
            rodata: at("__erodata")? - at("__srodata")?,
            data: at("__edata")? - at("__sdata")?,
            bss: at("__ebss")? - at("__sbss")?,
            uninit: at("__euninit")? - at("__suninit")?,
        })
    }

    pub(super) fn image(&self) -> u32 {
        self.text + self.rodata + self.data
    }

    pub(super) fn ram(&self) -> u32 {
        self.data + self.bss + self.uninit
    }
}

/// The size of an image for the SCuM-3C.
pub(super) fn size(elf: &[u8]) -> Result<Size> {
    let mut machine = Machine::new(Config::default(), sim::machine::NoDevices);
    Size::of(&machine.load_elf(elf)?)
}
