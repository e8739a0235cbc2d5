//! Each stage called by itself in the virtual mote, under the light of a room.
//!
//! The stages hand their results on in the mote's memory, as in the firmware; here it is only decided who is called
//! next. Every call is counted: instructions, cycles, stack.
//!
//! What can go wrong: a reference that solves something else. Each is held against the fix.

use std::collections::BTreeMap;

use anyhow::{Context, Result, bail, ensure};
use sim::core::cycles::{Multiplier, Timing};
use sim::elf::Symbols;
use sim::machine::{Call, Config, Machine, NoDevices};
use sim::memory::MemoryMap;
use sim::world::path::Path;
use sim::world::{Scene, World};
use xtask::calib::Calibration;

use super::flash;
use crate::room::Room;

/// Light for the stages, seconds: 480 sweeps.
const LIGHT_S: f64 = 4.0;
/// Points of the room for the fix.
const POINTS: usize = 400;
/// Of those, for the references, which take a thousand times as long.
const REFERENCE_POINTS: usize = 24;
/// Noise of each angle, degrees: that of the paper's recording.
const NOISE_DEG: f64 = 0.2;
/// Of those, where the noise may leave no fix: the default room has no such point.
const MISSED: usize = POINTS / 20;
/// How far a reference may be from the fix, for each metre from the farther station: another estimator, same angles, noise
/// included.
const SAME: f64 = 0.15;
/// How far apart two roots may be, of their size: micromath's is rough.
const SAME_ROOT: f64 = 0.07;

/// What is counted, the function that is called, and what to call it in the table.
pub(super) const STAGES: [(&str, &str, &str); 19] = [
    ("empty", "stage_empty", "a call of nothing"),
    ("pulse", "stage_pulse", "pulse, both edges"),
    ("sweep_sync", "stage_sweep", "sweep, a flash"),
    ("sweep_laser", "stage_sweep", "sweep, a laser"),
    ("angle", "stage_angle", "angle"),
    ("fix", "stage_fix", "fix"),
    ("track", "stage_track", "track, believed"),
    ("report", "stage_solve", "report, with the fix for its mismatch"),
    ("frame", "stage_frame", "frame"),
    ("seal", "stage_seal", "frame, secured: MIC-32 by AES-CCM*"),
    ("classify_sync", "stage_classify", "first half at once, a flash"),
    ("classify_laser", "stage_classify", "first half at once, a laser"),
    ("solve", "stage_solve", "second half at once, a laser"),
    ("solve_report", "stage_solve", "second half at once, and a report"),
    ("root", "stage_root", "square root"),
    ("root_f32", "reference_root_f32", "square root, micromath f32"),
    ("svd_f32", "reference_svd_f32", "paper's 4x4 SVD, nalgebra f32"),
    ("svd_f64", "reference_svd_f64", "paper's 4x4 SVD, nalgebra f64"),
    ("normal_f32", "reference_normal_f32", "normal equations, nalgebra f32"),
];

/// The fewest, the most and all of something.
#[derive(Debug, Clone, Copy)]
pub(super) struct Count {
    pub(super) least: u64,
    pub(super) most: u64,
    sum: u64,
    pub(super) calls: u64,
}

impl Default for Count {
    fn default() -> Self {
        Self { least: u64::MAX, most: 0, sum: 0, calls: 0 }
    }
}

impl Count {
    pub(super) fn add(&mut self, value: u64) {
        self.least = self.least.min(value);
        self.most = self.most.max(value);
        self.sum += value;
        self.calls += 1;
    }

    pub(super) fn mean(&self) -> f64 {
        if self.calls == 0 { 0.0 } else { self.sum as f64 / self.calls as f64 }
    }
}

/// What one stage costs.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Cost {
    pub(super) instructions: Count,
    /// With a multiplier of one cycle, and of 32.
    pub(super) cycles: [Count; 2],
    /// The function, all it calls and all tables it names.
    pub(super) flash: u32,
    pub(super) stack: u32,
}

/// The bench program in a machine of its own.
pub(super) struct Rig {
    machine: Machine<NoDevices>,
    symbols: Symbols,
}

impl Rig {
    pub(super) fn new(elf: &[u8], multiplier: Multiplier) -> Result<Self> {
        let config = Config { memory: MemoryMap::MICROBIT, timing: Timing::CortexM0(multiplier), ..Config::default() };
        let mut machine = Machine::new(config, NoDevices);
        let symbols = machine.load_elf(elf)?;
        machine.initialise_variables();
        let mut rig = Self { machine, symbols };
        rig.call("reset", &[])?;
        Ok(rig)
    }

    pub(super) fn call(&mut self, name: &str, arguments: &[u32]) -> Result<Call> {
        let address = self.address(name)?;
        self.machine.call(address, arguments).with_context(|| name.to_string())
    }

    fn address(&self, name: &str) -> Result<u32> {
        self.symbols.address(name).with_context(|| format!("the bench program has no {name}"))
    }

    fn set_angles(&mut self, angles: [i32; 4]) -> Result<()> {
        let address = self.address("ANGLES")?;
        let bytes: Vec<u8> = angles.iter().flat_map(|angle| angle.to_le_bytes()).collect();
        self.machine.write_bytes(address, &bytes).context("ANGLES is not in memory")
    }

    fn words(&self, name: &str) -> Result<[u32; 3]> {
        let address = self.address(name)?;
        let words = [0, 4, 8].map(|offset| self.machine.read_word(address + offset));
        Ok([words[0], words[1], words[2]].map(Option::unwrap_or_default))
    }
}

/// Counts every stage with both multipliers.
pub(super) fn measure(elf: &[u8], room: &Room) -> Result<BTreeMap<&'static str, Cost>> {
    let mut costs: BTreeMap<&'static str, Cost> = BTreeMap::new();
    for (n, multiplier) in [Multiplier::Fast, Multiplier::Small].into_iter().enumerate() {
        let mut rig = Rig::new(elf, multiplier)?;
        let mut count = |name: &'static str, call: Call| {
            let cost = costs.entry(name).or_default();
            cost.cycles[n].add(call.cycles);
            if n == 0 {
                cost.instructions.add(call.instructions);
                cost.stack = cost.stack.max(call.stack_bytes);
            }
        };
        in_light(&mut rig, &room.light, &mut count)?;
        at_points(&mut rig, room, &mut count)?;
        if n == 0 {
            for (name, function, _) in STAGES {
                let bytes = flash::reachable(&rig.machine.memory, &rig.symbols, function)?;
                costs.entry(name).or_default().flash = bytes;
            }
        }
    }
    for (name, ..) in STAGES {
        ensure!(
            costs.get(name).is_some_and(|cost| cost.instructions.calls > 0),
            "{name} was never reached: the stations light too little of the middle of the room"
        );
    }
    Ok(costs)
}

/// Lets light run through the stages, one pulse after another.
fn in_light(rig: &mut Rig, light: &Scene, count: &mut impl FnMut(&'static str, Call)) -> Result<()> {
    let mut scene = Scene { length_s: LIGHT_S, ..light.clone() };
    scene.receiver.sync_dropout = 0.0;
    scene.receiver.sweep_dropout = 0.0;
    let edges: Vec<_> = World::new(&scene, 1).edges().map(|edge| edge.cycle as u32).collect();
    let mut lasers = 0;
    for pulse in edges.chunks_exact(2) {
        count("empty", rig.call("stage_empty", pulse)?);
        let made = rig.call("stage_pulse", pulse)?;
        count("pulse", made);
        let light = rig.call("stage_sweep", &[])?;
        let classified = rig.call("stage_classify", pulse)?;
        match light.r0 {
            1 => {
                count("sweep_sync", light);
                if classified.r0 == 0 {
                    count("classify_sync", classified);
                }
            }
            2 => {
                count("sweep_laser", light);
                count("classify_laser", classified);
                second_half(rig, lasers, count)?;
                lasers += 1;
            }
            _ => {}
        }
    }
    Ok(())
}

/// What follows a laser.
fn second_half(rig: &mut Rig, lasers: u32, count: &mut impl FnMut(&'static str, Call)) -> Result<()> {
    let mut believed = false;
    let angle = rig.call("stage_angle", &[])?;
    if angle.r0 == 1 {
        count("angle", angle);
        let all_known = rig.call("pass_on", &[])?.r0 == 1;
        let track = rig.call("stage_track", &[])?;
        // As in `track::Step`: 0 believed, 2 idle, 4 lost.
        match track.r0 {
            0 => {
                count("track", track);
                believed = true;
            }
            2 | 4 if all_known && rig.call("stage_fix", &[])?.r0 == 1 => {
                rig.call("start_track", &[])?;
            }
            _ => {}
        }
    }
    // A report comes with the sweep that makes it due, or now and then in the dark before that.
    if lasers / 16 % 2 == 1 {
        rig.call("darken", &[])?;
        let report = rig.call("stage_solve", &[])?;
        if report.r0 == 1 {
            count("report", report);
            count("frame", rig.call("stage_frame", &[])?);
            let seal = rig.call("stage_seal", &[])?;
            ensure!(seal.r0 == 1, "a frame that cannot be secured");
            count("seal", seal);
        }
        rig.call("relight", &[])?;
    }
    let solved = rig.call("stage_solve", &[])?;
    if believed {
        count(if solved.r0 == 1 { "solve_report" } else { "solve" }, solved);
    }
    Ok(())
}

/// Solves for points all over the middle of the room.
fn at_points(rig: &mut Rig, room: &Room, count: &mut impl FnMut(&'static str, Call)) -> Result<()> {
    let Path::HandHeld { low_m, high_m, .. } = room.light.path else { bail!("the mote is not carried by hand") };
    let mut random = Random(0x9e37_79b9_7f4a_7c15);
    let mut missed = 0;
    for n in 0..POINTS {
        let point: [f64; 3] = std::array::from_fn(|k| low_m[k] + random.uniform() * (high_m[k] - low_m[k]));
        let angles = angles(&room.calibration, point, &mut random);
        rig.set_angles(angles)?;
        let fix = rig.call("stage_fix", &[])?;
        if fix.r0 != 1 {
            missed += 1;
            ensure!(missed <= MISSED, "no fix at {point:?} and {MISSED} other points of the middle of the room");
            continue;
        }
        count("fix", fix);
        // 12 to 15 bits.
        let variance = (((0.1 + 0.9 * random.uniform()) * 32768.0).powi(2)) as u32;
        let [root, reference] = ["stage_root", "reference_root_f32"].map(|name| rig.call(name, &[variance]));
        let (root, reference) = (root?, reference?);
        let apart = f64::from(root.r0.abs_diff(reference.r0)) / f64::from(variance).sqrt();
        ensure!(apart < SAME_ROOT, "the root of {variance} is {}, or else {}", root.r0, reference.r0);
        count("root", root);
        count("root_f32", reference);
        if n >= REFERENCE_POINTS {
            continue;
        }
        let away = |station: &[f64; 3]| station.iter().zip(point).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
        let far_m = room.calibration.stations.iter().map(|station| away(&station.position)).fold(0.0, f64::max);
        let position = rig.words("POSITION")?.map(|word| f64::from(word as i32) / 65536.0);
        for name in ["svd_f32", "svd_f64", "normal_f32"] {
            let call = rig.call(&format!("reference_{name}"), &[])?;
            ensure!(call.r0 == 1, "{name} finds nothing at {point:?}");
            count(name, call);
            let found = rig.words("POINT")?.map(|word| f64::from(f32::from_bits(word)));
            let apart = found.iter().zip(position).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
            ensure!(apart < SAME * far_m, "{name} finds {found:?}, the fix {position:?}");
        }
    }
    Ok(())
}

/// The angles under which the stations see a point, with noise.
fn angles(calibration: &Calibration, point: [f64; 3], random: &mut Random) -> [i32; 4] {
    let mut angles = [0; 4];
    for (station, angles) in calibration.stations.iter().zip(angles.chunks_exact_mut(2)) {
        let [right, up, ahead] = station
            .rotation
            .map(|row| row.iter().zip(point.iter().zip(&station.position)).map(|(r, (p, s))| r * (p - s)).sum::<f64>());
        for (angle, side) in angles.iter_mut().zip([right, up]) {
            let noisy = side.atan2(ahead) + random.normal() * NOISE_DEG.to_radians();
            *angle = (noisy / std::f64::consts::PI * f64::from(1 << 20)).round() as i32;
        }
    }
    angles
}

/// Numbers that are the same on every computer.
struct Random(u64);

impl Random {
    /// 0 .. 1.
    fn uniform(&mut self) -> f64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Twelve uniform ones have a variance of one.
    fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.uniform()).sum::<f64>() - 6.0
    }
}
