//! Motes for a desk without hardware.
//!
//! A few are the real thing: the image that is flashed, in the virtual SCuM-3C, in simulated light, at the pace of a
//! clock on the wall. More than [`VIRTUAL`] would be too many for a computer, so a swarm says with the library's own
//! emitter where the same simulated hands carry it.
//!
//! What can go wrong: a computer too slow for the virtual motes; they then fall behind, and nothing else does.

use std::num::NonZeroU32;
use std::thread::{sleep, spawn};
use std::time::Duration;

use anyhow::{Context, Result, bail};
use fixed::types::{I6F10, I16F16, U0F16, U8F8};
use lighthouse_mote::frame::secured::Key;
use lighthouse_mote::frame::{self, Aligned, Header, Health, Level, Lock, Report, Station};
use sim::mote::Mote;
use sim::world::path::Path as MotePath;
use sim::world::{Scene, World};

use super::model::{SIMULATION, Signal, SourceState};
use super::source::{Desk, Heard};
use crate::calib::{Calibration, firmware};
use crate::flash::identity::{self, Change};
use crate::light::HALF_TURN_S;

/// Most motes that run the firmware: each keeps a core busy 2 % of the time.
pub const VIRTUAL: u16 = 8;
/// Most motes: what two octets of address leave.
pub const MOST: u16 = 0xFFFD;
/// How often the motes are looked at.
const LOOK: Duration = Duration::from_millis(20);
/// Clock of a mote that only says where it is, Hz.
const CLOCK_HZ: f64 = 10e6;
/// How fast a hand goes, metres per second.
const SPEED_M_PER_S: f64 = 0.27;

/// The default scene in the room of a calibration: its stations, and a hand in the middle half of its volume.
///
/// # Errors
/// The room cannot be baked or lit.
pub fn scene(name: &str, calibration: &Calibration) -> Result<Scene> {
    let mut scene = Scene::default();
    let [a, b] = &calibration.stations;
    for (station, measured) in [(&mut scene.station_a, a), (&mut scene.station_b, b)] {
        station.rotation = measured.rotation;
        station.position_m = measured.position;
        station.info.id = measured.id.unwrap_or(station.info.id);
        for (rotor, terms) in [&mut station.azimuth, &mut station.elevation].into_iter().zip(&measured.factory) {
            rotor.phase_rad = terms.phase;
            rotor.tilt_rad = terms.tilt;
            rotor.gibbous_phase_rad = terms.gibphase;
            rotor.gibbous_magnitude_rad = terms.gibmag;
        }
    }
    // The middle half of the room: a person does not carry a mote along the walls.
    let volume = firmware::bake(name, calibration)?.volume;
    let within = |part: f64| std::array::from_fn(|k| volume.min[k] + part * (volume.max[k] - volume.min[k]));
    scene.path = MotePath::HandHeld { low_m: within(0.25), high_m: within(0.75), mean_speed_m_per_s: SPEED_M_PER_S };
    if let Err(unfit) = scene.check() {
        bail!("the scene cannot be lit: {}", unfit.0);
    }
    Ok(scene)
}

/// The share of a walk's moments at which the light of both stations reaches the mote.
#[must_use]
pub fn lit(scene: &Scene) -> f64 {
    const MOMENTS: u16 = 600;
    const EVERY_S: f64 = 0.1;
    let world = World::new(scene, 1);
    let is_lit = |moment: &u16| {
        let at_m = world.position(EVERY_S * f64::from(*moment)).into();
        [&scene.station_a, &scene.station_b].iter().all(|station| {
            let sight = station.sight(at_m);
            sight.lit(&scene.optics) && sight.in_field(&scene.optics)
        })
    };
    (0..MOMENTS).filter(is_lit).count() as f64 / f64::from(MOMENTS)
}

/// Runs so many motes with the firmware `elf`.
///
/// # Errors
/// The firmware does not start.
pub fn virtual_motes(desk: Desk, elf: &[u8], scene: &Scene, count: u16) -> Result<()> {
    let source = desk.add("simulated light", SIMULATION);
    let mut motes = Vec::new();
    for id in 1..=count {
        let mut scene = scene.clone();
        // No two chips are alike.
        scene.clock.error += 0.004 * f64::from(id % 9);
        let world = World::new(&scene, id.into());
        let hclk = scene.clock.nominal_hz * (1.0 + scene.clock.error);
        let hclk = NonZeroU32::new(hclk.round() as u32).context("the mote's clock stands still")?;
        let elf = identity::patch(elf, Change { mote: Some(id), ..Change::default() })?;
        motes.push((Mote::boot(&elf, hclk)?, world, None));
    }
    let begun_s = desk.now_s();
    spawn(move || {
        desk.state(source, SourceState::Open, "no hardware: these motes are simulated");
        while !desk.is_over() && !motes.is_empty() {
            let now_s = desk.now_s() - begun_s;
            motes.retain_mut(|(mote, world, edge)| {
                let cycle = world.cycle(now_s);
                loop {
                    let Some(next) = edge.take().or_else(|| world.next_edge()) else { return false };
                    if next.cycle > cycle {
                        *edge = Some(next);
                        break;
                    }
                    if mote.push_edge(next.cycle, next.level).is_err() {
                        return false;
                    }
                }
                let runs = mote.run_until(cycle).is_ok();
                for sent in mote.take_frames() {
                    let at_s = begun_s + world.seconds(sent.start_cycle);
                    desk.say(Heard::Frame(source, at_s, sent.bytes, Signal::default()));
                }
                drop(mote.take_log());
                runs
            });
            sleep(LOOK);
        }
        desk.state(source, SourceState::Ended, "the simulated motes have stopped");
    });
    Ok(())
}

/// Motes that say where a simulated hand carries them.
pub struct Swarm {
    motes: Vec<Teller>,
    pan: u16,
    per_s: f64,
    key: Option<Key>,
}

struct Teller {
    world: World,
    sequence: u16,
    /// Of its next secured frame.
    counter: u32,
    /// When it says something next, seconds.
    next_s: f64,
    next_health_s: f64,
}

impl Swarm {
    /// So many motes that report so often a second.
    #[must_use]
    pub fn new(scene: &Scene, pan: u16, count: u16, per_s: f64) -> Self {
        let motes = (1..=count).map(|id| {
            // Spread over the time between two reports.
            let part = f64::from(id) * 0.618_033_988_75 % 1.0;
            let world = World::new(scene, id.into());
            let sequence = id.wrapping_mul(7919);
            Teller { world, sequence, counter: 0, next_s: part / per_s, next_health_s: part }
        });
        Self { motes: motes.collect(), pan, per_s, key: None }
    }

    /// The same under the room's key, if there is one: their counters begin at 0.
    #[must_use]
    pub fn under(self, key: Option<[u8; 16]>) -> Self {
        Self { key: key.map(|bytes| Key::new(&bytes)), ..self }
    }

    /// Hands over all that is said up to and including a time, with its time.
    pub fn until(&mut self, now_s: f64, mut take: impl FnMut(f64, &[u8])) {
        let (pan, every_s) = (self.pan, 1.0 / self.per_s);
        for (index, mote) in self.motes.iter_mut().enumerate() {
            let id = index as u16 + 1;
            loop {
                let is_health = mote.next_health_s < mote.next_s;
                let at_s = mote.next_s.min(mote.next_health_s);
                if at_s > now_s {
                    break;
                }
                let header = Header { pan, mote: id, sequence: mote.sequence };
                mote.sequence = mote.sequence.wrapping_add(1);
                let mut said = Aligned::BLANK;
                if is_health {
                    mote.next_health_s += 1.0;
                    frame::emit_health_into(&mut said, header, &health(id, at_s));
                } else {
                    mote.next_s += every_s;
                    frame::emit_into(&mut said, header, &report(&mote.world, id, at_s));
                }
                // None is too long to be sealed.
                if self.key.as_ref().is_some_and(|key| key.seal(&mut said, mote.counter)) {
                    mote.counter = mote.counter.wrapping_add(1);
                }
                take(at_s, said.bytes());
            }
        }
    }

    /// How many frames a second they make.
    #[must_use]
    pub fn frames_per_s(&self) -> f64 {
        self.motes.len() as f64 * (self.per_s + 1.0)
    }
}

fn half_turn_q8(id: u16) -> u32 {
    (CLOCK_HZ * (1.0 + 1e-4 * f64::from(id % 400)) * HALF_TURN_S * 256.0) as u32
}

fn report(world: &World, id: u16, at_s: f64) -> Report {
    const STEP_S: f64 = 0.01;
    let (here, before) = (world.position(at_s), world.position(at_s - STEP_S));
    let half_turn_q8 = half_turn_q8(id);
    let hz = f64::from(half_turn_q8) / 256.0 / HALF_TURN_S;
    Report {
        time: (at_s * hz) as u64 as u32,
        half_turn_q8,
        position: here.map(I16F16::saturating_from_num),
        mismatch: U0F16::saturating_from_num(0.001 + 0.002 * (at_s * 1.3 + f64::from(id)).sin().abs()),
        age: U8F8::from_num(3),
        stations: 3,
        level: Level::Full,
        velocity: std::array::from_fn(|k| I6F10::saturating_from_num((here[k] - before[k]) / STEP_S)),
        sd: [U0F16::from_num(0.002), U0F16::from_num(0.002), U0F16::from_num(0.004)],
        ..Report::default()
    }
}

fn health(id: u16, at_s: f64) -> Health {
    Health {
        uptime: at_s as u32,
        half_turn_q8: half_turn_q8(id),
        lock: Lock::Locked,
        syncs: [(120.0 * at_s) as u64 as u16; 2],
        sweeps: [[(30.0 * at_s) as u64 as u16; 2]; 2],
        stations: [
            Station { id: 0x5EED_000A, good: 3, ..Station::default() },
            Station { id: 0x5EED_000B, good: 3, mode: 1, ..Station::default() },
        ],
        ..Health::default()
    }
}

/// Lets a swarm be heard.
pub fn swarm(desk: Desk, mut swarm: Swarm) {
    let source = desk.add("simulated swarm", SIMULATION);
    let begun_s = desk.now_s();
    spawn(move || {
        desk.state(source, SourceState::Open, "no hardware: these motes are simulated");
        while !desk.is_over() {
            let now_s = desk.now_s();
            swarm.until(now_s - begun_s, |at_s, bytes| {
                desk.say(Heard::Frame(source, begun_s + at_s, bytes.to_vec(), Signal::default()));
            });
            sleep(LOOK);
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::listen::model::{self, TRAIL};

    #[test]
    fn a_swarm_says_what_it_should_and_nothing_is_lost() {
        for key in [None, Some(*b"a room of its ow")] {
            a_swarm_under(key);
        }
    }

    fn a_swarm_under(key: Option<[u8; 16]>) {
        let calibration = crate::calib::schema::read("d", include_str!("../../../calib/default.toml")).unwrap();
        let mut swarm = Swarm::new(&scene("d", &calibration).unwrap(), 0x4C48, 50, 10.0).under(key);
        let mut heard = model::Swarm::new(None);
        heard.under(key);
        let source = heard.add_source("simulation", "simulation");
        let mut count = 0;
        for step in 0..100 {
            swarm.until(0.1 * f64::from(step), |at_s, bytes| {
                count += 1;
                heard.hear(at_s, source, bytes, Signal::default()).unwrap();
            });
        }
        let all = heard.snapshot(TRAIL);
        assert_eq!(all.motes.len(), 50);
        assert!(all.rejects.is_empty(), "{:?}", all.rejects);
        let frames: u64 = all.motes.iter().map(|mote| mote.frames).sum();
        assert_eq!((frames, all.frames), (count, count));
        assert!((f64::from(count as u32) / 9.9 - swarm.frames_per_s()).abs() < 0.03 * swarm.frames_per_s());
        for mote in &all.motes {
            assert!(mote.lost == 0 && !mote.is_conflict && mote.restarts == 0, "{mote:?}");
            assert!((mote.fixes_per_s - 10.0).abs() < 0.1, "{mote:?}");
            assert!(mote.condition.as_ref().unwrap().lock == "locked");
        }
    }
}
