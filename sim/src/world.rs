//! The room: Lighthouse V1 light around a virtual mote, as the edges it makes on one pin.
//!
//! A [`Scene`] and a seed make a [`World`]; the world hands out edges one by one, in cycles of the mote's own clock,
//! and knows the truth behind each. Everything is lazy: a slot of 8.3 ms is computed when its first edge is due, so
//! 24 h of light take no more memory than one slot.
//!
//! ```
//! use sim::world::path::Path;
//! use sim::world::{EventKind, Scene, World};
//!
//! // A second of a mote that lies still before two perfect stations.
//! let still = Path::Still { at_m: [0.5, 1.0, 0.7] };
//! let scene = Scene { path: still, length_s: 1.0, ..Scene::default() }.without_noise();
//! let mut world = World::new(&scene, 7);
//! world.keep_log();
//! let edges: Vec<_> = world.edges().collect();
//! // 120 half turns of two flashes and a sweep, less what the last one still holds.
//! assert!((715..=720).contains(&edges.len()), "{}", edges.len());
//! assert!(edges.windows(2).all(|pair| pair[0].cycle < pair[1].cycle && pair[0].level != pair[1].level));
//! assert_eq!(world.truth(edges[0].cycle), [0.5, 1.0, 0.7]);
//! let sweeps = world.take_log().iter().filter(|event| matches!(event.kind, EventKind::Sweep { .. })).count();
//! assert!((119..=120).contains(&sweeps), "{sweeps}");
//! ```
//!
//! # Design
//! Light is made in true seconds and only the finished edge is put on the mote's clock, so no error of the clock can
//! leak into the physics. A source of light pushes pulses that start in the slot at hand; the receiver spoils each on
//! its own; what overlaps then merges. A new kind of trouble is one more source or one more step of the receiver.
//!
//! # Note
//! The laser crosses the mote in the middle of its pulse: half a width lies before the crossing and half after. Who
//! stamps the rising edge alone is early by that half, 2 mrad at 0.7 m.
//!
//! What can go wrong: a mote moves while the plane turns, so the moment of a crossing depends on where the mote will
//! be at that moment; the equation is solved to a picosecond, for motes slower than some 100 m/s.

pub mod clock;
mod noise;
pub mod ootx;
pub mod path;
pub mod receiver;
pub mod rotor;
pub mod scene;
pub mod slot;
pub mod station;

#[cfg(test)]
mod tests;

pub use scene::Scene;
pub use slot::{Axis, StationId};

use core::f64::consts::PI;
use core::num::NonZeroU32;

use nalgebra::Vector3;
use serde::Serialize;

use clock::Oscillator;
use noise::{Noise, Purpose};
use path::Walk;
use receiver::{Mirror, Pulse};
use station::{Sight, Station};

/// A change of the level on the mote's light pin.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Edge {
    /// The mote's clock, cycles since power-on.
    pub cycle: u64,
    /// Whether there is light from here on.
    pub level: bool,
}

/// Something a station did, whether or not the mote saw it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Event {
    /// The mote's clock at the start of a flash or the middle of a sweep, before any jitter.
    pub cycle: u64,
    /// Whether its light reached the mote and was not missed. It may yet have merged with other light or have been
    /// too short to notice.
    pub seen: bool,
    /// What happened.
    pub kind: EventKind,
}

/// What a station did.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub enum EventKind {
    /// A sync flash.
    Sync {
        /// Whose.
        station: StationId,
        /// Of which slot.
        axis: Axis,
        /// It will not sweep in this slot.
        skip: bool,
        /// Its OOTX bit.
        data: bool,
    },
    /// A laser plane crossed the mote, within the field of its station.
    Sweep {
        /// Whose.
        station: StationId,
        /// Which angle.
        axis: Axis,
        /// The true angle from straight ahead at the crossing: no factory error, no noise. Radians.
        angle_rad: f64,
        /// From the start of the station's own sync flash to the crossing: with factory error and noise. Seconds.
        sync_to_sweep_s: f64,
        /// Half a turn of the rotor, seconds.
        half_turn_s: f64,
    },
    /// A laser plane crossed the mote by way of a mirror.
    Reflection {
        /// Whose.
        station: StationId,
        /// Which angle it will be taken for.
        axis: Axis,
    },
}

/// A stream of edges and the truth behind it.
#[derive(Debug, Clone)]
pub struct World {
    scene: Scene,
    walk: Walk,
    oscillator: Oscillator,
    frames: [Loop; 2],
    rotor_noise: Noise,
    receiver_noise: Noise,
    mirror_noise: Noise,
    interference_noise: Noise,
    weak_noise: Noise,
    /// The stations as they stand after they were moved.
    moved: [Option<Station>; 2],
    /// The slot to be lit next.
    slot: u64,
    /// Pulses made and not yet given out, the earliest last.
    ahead: Vec<Pulse>,
    /// The falling edge that belongs to the rising edge just given out.
    fall: Option<Edge>,
    /// The first cycle the next edge may have.
    free: u64,
    log: Option<Vec<Event>>,
}

/// An OOTX frame, sent for ever.
#[derive(Debug, Clone)]
struct Loop {
    bits: Vec<bool>,
    /// The bit that goes out with slot 0.
    first: usize,
}

/// A laser plane meets the mote.
struct Crossing {
    /// After the station's sync flash, seconds.
    after_s: f64,
    sight: Sight,
    ideal_rad: f64,
}

impl World {
    /// Makes the room. The same scene and seed make the same light on every machine.
    ///
    /// # Panics
    /// When [`Scene::check`] refuses the scene; the message is its reason.
    #[must_use]
    pub fn new(scene: &Scene, seed: u64) -> World {
        if let Err(unfit) = scene.check() {
            panic!("{unfit}");
        }
        let mut ootx_noise = Noise::new(seed, Purpose::Ootx);
        let frames = [&scene.station_a, &scene.station_b].map(|station| {
            let bits = ootx::frame(&station.info.block(&station.azimuth, &station.elevation));
            let first = (ootx_noise.uniform() * bits.len() as f64) as usize;
            Loop { bits, first }
        });
        World {
            walk: Walk::new(&scene.path, seed),
            oscillator: Oscillator::new(&scene.clock, seed),
            frames,
            rotor_noise: Noise::new(seed, Purpose::Rotor),
            receiver_noise: Noise::new(seed, Purpose::Receiver),
            mirror_noise: Noise::new(seed, Purpose::Mirror),
            interference_noise: Noise::new(seed, Purpose::Interference),
            weak_noise: Noise::new(seed, Purpose::Weak),
            moved: [&scene.station_a, &scene.station_b].map(Station::after_its_move),
            slot: 0,
            ahead: Vec::new(),
            fall: None,
            free: 0,
            log: None,
            scene: scene.clone(),
        }
    }

    /// The next change of the light pin; cycles strictly increase and levels alternate, the first one rising.
    /// `None` once the stations are switched off at [`Scene::length_s`].
    pub fn next_edge(&mut self) -> Option<Edge> {
        if let Some(fall) = self.fall.take() {
            return Some(fall);
        }
        let min_width_s = self.scene.receiver.min_width_us * 1e-6;
        loop {
            let pulse = self.next_pulse()?;
            if pulse.fall_s - pulse.rise_s >= min_width_s {
                let rise = self.oscillator.cycle(pulse.rise_s).max(self.free);
                let fall = self.oscillator.cycle(pulse.fall_s).max(rise + 1);
                self.free = fall + 1;
                self.fall = Some(Edge { cycle: fall, level: false });
                return Some(Edge { cycle: rise, level: true });
            }
        }
    }

    /// Lets the light be as in `scene` from the next slot on: receiver, stations, strangers, mirrors, strobes and line
    /// are its; the mote's path and clock and the rotors' timing go on, and so does time. Its times are this world's.
    ///
    /// # Panics
    /// When [`Scene::check`] refuses the scene; the message is its reason.
    pub fn meet(&mut self, scene: &Scene) {
        if let Err(unfit) = scene.check() {
            panic!("{unfit}");
        }
        let Scene { length_s, path, clock, timing, .. } = self.scene;
        self.scene = Scene { length_s, path, clock, timing, ..scene.clone() };
        let stations = [&self.scene.station_a, &self.scene.station_b];
        for (frame, station) in self.frames.iter_mut().zip(stations) {
            frame.bits = ootx::frame(&station.info.block(&station.azimuth, &station.elevation));
        }
        self.moved = stations.map(Station::after_its_move);
    }

    /// Lets all light pass unmade that begins before `seconds`. Nothing changes in what comes after.
    pub fn skip(&mut self, seconds: f64) {
        while self.scene.timing.start_s(self.slot) < seconds {
            self.slot += 1;
        }
        self.ahead.clear();
    }

    /// The edges from here on, as an iterator.
    pub fn edges(&mut self) -> impl Iterator<Item = Edge> + '_ {
        core::iter::from_fn(|| self.next_edge())
    }

    /// Where the mote is at a cycle of its clock, metres in the world.
    #[must_use]
    pub fn truth(&self, cycle: u64) -> [f64; 3] {
        self.position(self.seconds(cycle))
    }

    /// Where the mote is at a true time in seconds, metres in the world.
    #[must_use]
    pub fn position(&self, seconds: f64) -> [f64; 3] {
        self.walk.position(seconds).into()
    }

    /// The true time of a cycle, seconds since power-on.
    #[must_use]
    pub fn seconds(&self, cycle: u64) -> f64 {
        self.oscillator.seconds(cycle)
    }

    /// The cycle nearest to a true time in seconds since power-on.
    #[must_use]
    pub fn cycle(&self, seconds: f64) -> u64 {
        self.oscillator.cycle(seconds)
    }

    /// The rate of the mote's clock in the tenth of a second around a true time, Hz; at least 1.
    #[must_use]
    pub fn clock_hz(&self, seconds: f64) -> NonZeroU32 {
        let from_s = (seconds - 0.05).max(0.0);
        let counted = self.cycle(from_s + 0.1) - self.cycle(from_s);
        u32::try_from(10 * counted).ok().and_then(NonZeroU32::new).unwrap_or(NonZeroU32::MIN)
    }

    /// The scene this world was made from.
    #[must_use]
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// Writes down from here on what the stations do. The log grows until it is taken.
    pub fn keep_log(&mut self) {
        self.log.get_or_insert_default();
    }

    /// The log so far, in order of time, and an empty one in its place. It runs ahead of the edges by a slot or two.
    pub fn take_log(&mut self) -> Vec<Event> {
        self.log.as_mut().map(core::mem::take).unwrap_or_default()
    }

    /// The next stretch of light, whoever made it.
    fn next_pulse(&mut self) -> Option<Pulse> {
        while self.ahead.last().is_none_or(|pulse| pulse.rise_s >= self.known_until_s()) {
            if !self.light_slot() {
                break;
            }
        }
        let mut pulse = self.ahead.pop()?;
        loop {
            while pulse.fall_s >= self.known_until_s() && self.light_slot() {}
            match self.ahead.pop_if(|next| next.rise_s <= pulse.fall_s) {
                Some(next) => pulse.fall_s = pulse.fall_s.max(next.fall_s),
                None => return Some(pulse),
            }
        }
    }

    /// Until when no pulse can rise that is not in `ahead`, seconds.
    fn known_until_s(&self) -> f64 {
        self.scene.timing.start_s(self.slot) - self.scene.receiver.earliest_s()
    }

    /// Makes all light that starts in the next slot; `false` once the stations are off.
    fn light_slot(&mut self) -> bool {
        let slot = self.slot;
        let start_s = self.scene.timing.start_s(slot);
        if start_s >= self.scene.length_s {
            return false;
        }
        self.slot += 1;
        let logged = self.log.as_ref().map_or(0, Vec::len);
        // Both flashes come within half a millisecond: to a hand the same place.
        let here = self.walk.position(start_s);
        self.receiver_noise.at(slot);
        self.weak_noise.at(slot);
        self.flash(slot, StationId::A, here);
        self.flash(slot, StationId::B, here);
        let alone = self.reflect(slot);
        self.sweep(slot, alone);
        self.interfere(slot);
        self.disturb(slot);
        if let Some(log) = &mut self.log {
            log[logged..].sort_by_key(|event| event.cycle);
        }
        true
    }

    fn flash(&mut self, slot: u64, id: StationId, here: Vector3<f64>) {
        let (sweeper, axis) = slot::sweep_of(slot);
        let (skip, data) = (id != sweeper, self.frames[id as usize].bit(slot));
        let rise_s = self.scene.timing.sync_s(slot, id);
        let light = Pulse { rise_s, fall_s: rise_s + slot::sync_width_us(axis, data, skip) * 1e-6 };
        let received = self.scene.receiver.sync(light, &mut self.receiver_noise);

        let station = self.station(id, rise_s);
        let from = Vector3::from(station.position_m);
        let reaches = station.sight(here).lit(&self.scene.optics)
            && !station.hides_sync(rise_s)
            && self.scene.receiver.faces(here, from);
        let reaches = self.scene.receiver.notices(here, from, &mut self.weak_noise) && reaches;
        self.shine(received.filter(|_| reaches), rise_s, EventKind::Sync { station: id, axis, skip, data });
    }

    /// The direct sweep; `hidden` when it is but a reflection that arrives.
    fn sweep(&mut self, slot: u64, hidden: bool) {
        let (id, axis) = slot::sweep_of(slot);
        let timing = &self.scene.timing;
        let (sync_s, half_turn_s) = (timing.sync_s(slot, id), timing.half_turn_s());
        let noise_rad = (timing.angle_noise_deg * self.rotor_noise.at(slot).gaussian()).to_radians();
        let station = self.station(id, sync_s);
        let walk = &self.walk;
        let crossing = self.crossing(station, axis, sync_s, noise_rad, |t_s| walk.position(t_s));
        let Some(crossing) = crossing else { return };

        let at_s = sync_s + crossing.after_s;
        let (here, from) = (self.walk.position(at_s), Vector3::from(station.position_m));
        let reaches = crossing.sight.lit(&self.scene.optics)
            && !hidden
            && !station.hides_sweep(at_s)
            && self.scene.receiver.faces(here, from);
        let reaches = self.scene.receiver.notices(here, from, &mut self.weak_noise) && reaches;
        let light = self.line(axis, at_s, &crossing.sight);
        let received = self.scene.receiver.sweep(light, &mut self.receiver_noise);
        let kind = EventKind::Sweep {
            station: id,
            axis,
            angle_rad: crossing.ideal_rad,
            sync_to_sweep_s: crossing.after_s,
            half_turn_s,
        };
        self.shine(received.filter(|_| reaches), at_s, kind);
    }

    /// The same sweep again, as it comes from the image of the mote in each mirror; whether it comes alone.
    fn reflect(&mut self, slot: u64) -> bool {
        let (id, axis) = slot::sweep_of(slot);
        let sync_s = self.scene.timing.sync_s(slot, id);
        self.mirror_noise.at(slot);
        let mut one_alone = false;
        for n in 0..self.scene.mirrors.len() {
            let mirror: Mirror = self.scene.mirrors[n];
            let bright = self.mirror_noise.uniform() < mirror.probability;
            let alone = self.mirror_noise.uniform() < mirror.alone;
            let gain = self.mirror_noise.between(mirror.gain[0], mirror.gain[1]);
            let station = self.station(id, sync_s);
            let walk = &self.walk;
            let crossing = self.crossing(station, axis, sync_s, 0.0, |t_s| mirror.image(walk.position(t_s)));
            let Some(crossing) = crossing else { continue };

            let at_s = sync_s + crossing.after_s;
            let (here, from) = (self.walk.position(at_s), Vector3::from(station.position_m));
            let reaches = crossing.sight.lit(&self.scene.optics)
                && mirror.shows(here)
                && mirror.shows(from)
                && self.scene.receiver.faces(here, mirror.image(from));
            let half_s = (self.line(axis, at_s, &crossing.sight).fall_s - at_s) * gain;
            let light = Pulse { rise_s: at_s - half_s, fall_s: at_s + half_s };
            let received = self.scene.receiver.sweep(light, &mut self.mirror_noise);
            if bright && reaches {
                one_alone |= alone;
                self.shine(received, at_s, EventKind::Reflection { station: id, axis });
            }
        }
        one_alone
    }

    /// Strobes, and what a bad line adds.
    fn disturb(&mut self, slot: u64) {
        let from_s = if slot == 0 { 0.0 } else { self.scene.timing.start_s(slot) };
        let to_s = self.scene.timing.start_s(slot + 1);
        for strobe in &self.scene.strobes {
            for burst in strobe.bursts(from_s, to_s) {
                light(&self.scene, &mut self.ahead, burst);
            }
        }
        for fault in &self.scene.line_faults {
            fault.pulses(from_s, to_s).into_iter().for_each(|pulse| insert(&mut self.ahead, pulse));
        }
    }

    fn interfere(&mut self, slot: u64) {
        let strangers = self.scene.interference;
        if strangers.rate_per_s == 0.0 {
            return;
        }
        let noise = self.interference_noise.at(slot);
        let end_s = self.scene.timing.start_s(slot + 1);
        let mut rise_s = self.scene.timing.start_s(slot);
        loop {
            rise_s += noise.wait() / strangers.rate_per_s;
            let width_us = noise.between(strangers.shortest_us, strangers.longest_us);
            if rise_s >= end_s {
                break;
            }
            light(&self.scene, &mut self.ahead, Pulse { rise_s, fall_s: rise_s + width_us * 1e-6 });
        }
    }

    /// When a plane meets a place that moves: the fixed point of "the plane gets to where the mote will be then".
    /// Nothing when the place is outside the field.
    fn crossing(
        &self,
        station: &Station,
        axis: Axis,
        sync_s: f64,
        noise_rad: f64,
        place: impl Fn(f64) -> Vector3<f64>,
    ) -> Option<Crossing> {
        // The plane outruns a mote of 1 m/s at 0.4 m by a factor of 150, so each round gains two digits.
        const ROUNDS: u32 = 12;
        const CLOSE_S: f64 = 1e-12;
        let half_turn_s = self.scene.timing.half_turn_s();
        let mut after_s = half_turn_s / 2.0;
        for _ in 0..ROUNDS {
            let sight = station.sight(place(sync_s + after_s));
            let (tan, other_tan) = sight.tangents(axis)?;
            let ideal_rad = libm::atan(tan);
            let measured_rad = station.rotor(axis).measured(ideal_rad, other_tan) + noise_rad;
            let next_s = half_turn_s * (0.5 + measured_rad / PI);
            let moved_s = (next_s - after_s).abs();
            after_s = next_s;
            if moved_s < CLOSE_S {
                return sight.in_field(&self.scene.optics).then_some(Crossing { after_s, sight, ideal_rad });
            }
        }
        None
    }

    /// The light of a laser line as it passes, around the moment of its middle.
    fn line(&self, axis: Axis, at_s: f64, sight: &Sight) -> Pulse {
        let half_turn_s = self.scene.timing.half_turn_s();
        let half_s = sight.sweep_width_us(axis, &self.scene.optics, half_turn_s) * 0.5e-6;
        Pulse { rise_s: at_s - half_s, fall_s: at_s + half_s }
    }

    fn shine(&mut self, received: Option<Pulse>, at_s: f64, kind: EventKind) {
        if let Some(log) = &mut self.log {
            log.push(Event { cycle: self.oscillator.cycle(at_s), seen: received.is_some(), kind });
        }
        if let Some(pulse) = received {
            light(&self.scene, &mut self.ahead, pulse);
        }
    }

    /// A station as it stands at a true time.
    fn station(&self, id: StationId, at_s: f64) -> &Station {
        let first = match id {
            StationId::A => &self.scene.station_a,
            StationId::B => &self.scene.station_b,
        };
        let has_moved = first.moved.is_some_and(|moved| at_s >= moved.at_s);
        self.moved[id as usize].as_ref().filter(|_| has_moved).unwrap_or(first)
    }
}

impl Loop {
    fn bit(&self, slot: u64) -> bool {
        let length = self.bits.len() as u64;
        self.bits[((self.first as u64 + slot) % length) as usize]
    }
}

/// Sends light down the line.
fn light(scene: &Scene, ahead: &mut Vec<Pulse>, pulse: Pulse) {
    let pulse = scene.line_faults.iter().fold(pulse, |pulse, fault| fault.pass(pulse));
    if pulse.fall_s > pulse.rise_s {
        insert(ahead, pulse);
    }
}

/// Keeps `ahead` ordered, the earliest last.
fn insert(ahead: &mut Vec<Pulse>, pulse: Pulse) {
    let at = ahead.partition_point(|other| other.rise_s > pulse.rise_s);
    ahead.insert(at, pulse);
}
