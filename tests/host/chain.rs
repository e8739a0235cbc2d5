//! Edges to what the mote tells of the light: real stations' frames through the whole path, its health, its batches.

use sim::world::ootx::{Info, frame};
use sim::world::path::Path;
use sim::world::rotor::Rotor;
use sim::world::{Scene, World};

use crate::angle;
use crate::chain::{Batch, Chain, Classifier, Config, Ears, Estimate, Seen, Solver};
use crate::edge::Edge;
use crate::frame::{Angles, Factory, Health, Lock, Measured};
use crate::on_target::cycle::{Cycle, PULSES_PER_SLOT, Truth, width};
use crate::ootx::{self, Block};
use crate::pulse::Pulse;
use crate::sweep::{Axis, Station, Sweep, Sync};
use crate::time::{Span, Ticks};

use super::mote::mote::room;
use super::recordings::recording;

/// The default room, every frame of the stations read, and believed.
fn config(estimate: Estimate) -> Config {
    Config {
        estimate,
        ootx: ootx::Config { rest_bits: 0, ids: [None, None] },
        angle: angle::Config::default().with_received([true, true]),
        ..room::CONFIG
    }
}

/// What came of some light.
struct Heard {
    blocks: [Vec<Block>; 2],
    health: Health,
}

fn hear(pulses: &[Pulse]) -> Heard {
    let config = config(Estimate::Track);
    let (mut classifier, mut solver, mut ears) = (Classifier::default(), Solver::default(), Ears::default());
    let mut blocks = [Vec::new(), Vec::new()];
    for pulse in pulses {
        let Some(sighting) = classifier.pulse(&config, *pulse) else { continue };
        ears.hear(&config.ootx, &sighting, |station, block| blocks[station as usize].push(*block));
        let _ = solver.step(&config, &sighting);
    }
    let now = pulses.last().map_or(Ticks(0), |last| last.start.after(last.width));
    let health = solver.health(&config, &classifier.understood(now));
    Heard { blocks, health }
}

/// Serial number, and the bits of phase, tilt, curve, gibphase and gibmag of the azimuth and the elevation rotor.
type Terms = (u32, [[u16; 5]; 2]);

/// As published with the recordings: phases 0.01559 and 0.0382, 0.0547 and 0.06186, 0.05862 and 0.06216, each of which is
/// nearer to its half float than to any other; the tracker's tilts 0.001343 and 0.0000793.
const HEADSET: [Terms; 2] = [
    (3_200_290_360, [[0x23fb, 0x0ce2, 0x9762, 0xb53a, 0x1c5a], [0x28e4, 0x1898, 0x9700, 0xbe08, 0x9de6]]),
    (3_275_443_681, [[0x2b00, 0x9d2e, 0x9cf8, 0xadf3, 0xa130], [0x2beb, 0x20ea, 0xa039, 0xba48, 0xa0b9]]),
];
const TRACKER_B: Terms =
    (178_605_925, [[0x2b81, 0x1580, 0x97d3, 0x41c8, 0x1cd8], [0x2bf5, 0x0533, 0x9b66, 0x2625, 0x9c1d]]);

fn terms(block: &Block) -> Terms {
    let rotor = |axis| {
        let terms = block.terms(axis);
        [terms.phase, terms.tilt, terms.curve, terms.gibphase, terms.gibmag].map(|half| half.0)
    };
    (block.id(), [rotor(Axis::Azimuth), rotor(Axis::Elevation)])
}

#[test]
fn the_frames_of_a_recorded_headset_come_through_the_whole_path() {
    let Some(pulses) = recording("hmd-one-station-visible.csv") else { return };
    for (bits, printed) in HEADSET.iter().zip([[0.01559, 0.0382], [0.0547, 0.06186]]) {
        let phases = bits.1.map(|rotor| rotor[0]);
        assert_eq!(phases, printed.map(|phase| half::f16::from_f64(phase).to_bits()));
    }
    let heard = hear(&pulses);
    for (station, frames) in [(Station::A, 4), (Station::B, 5)] {
        let index = station as usize;
        let blocks: Vec<Terms> = heard.blocks[index].iter().map(terms).collect();
        assert_eq!(blocks, vec![HEADSET[index]; frames]);
        let told = heard.health.stations[index];
        assert_eq!((told.id, told.good, told.bad, told.faults), (HEADSET[index].0, frames as u8, 0, 0));
        assert_eq!(told.factory, Factory::Received);
    }
    assert_eq!((heard.health.lock, heard.health.rejects.locks), (Lock::Locked, 0));
}

#[test]
fn the_frames_of_a_recorded_tracker_come_through_the_whole_path() {
    let Some(pulses) = recording("tracker-two-stations.csv") else { return };
    let printed = [0.05862, 0.06216].map(|phase| half::f16::from_f64(phase).to_bits());
    assert_eq!(TRACKER_B.1.map(|rotor| rotor[0]), printed);
    let heard = hear(&pulses);
    let blocks: Vec<Terms> = heard.blocks[1].iter().map(terms).collect();
    assert!(!blocks.is_empty());
    assert!(blocks.iter().all(|block| *block == TRACKER_B), "{blocks:x?}");
    assert_eq!(usize::from(heard.health.stations[1].good), blocks.len());
    // A ninth of its flashes is missing; one frame comes whole all the same, and nothing that it never said.
    assert!(heard.blocks[0].windows(2).all(|two| two[0] == two[1]));
}

#[test]
fn looking_for_darkness_costs_no_flash_of_the_slot_that_has_begun() {
    let mut scene = Scene { path: Path::Still { at_m: [0.5, 1.0, 0.7] }, length_s: 8.0, ..Scene::default() };
    (scene.receiver.sync_dropout, scene.receiver.sweep_dropout) = (0.0, 0.0);
    scene.interference.rate_per_s = 0.0;
    let config = config(Estimate::Track);
    let (mut chain, mut now) = (Chain::default(), Ticks(0));
    for change in World::new(&scene, 1).edges() {
        now = Ticks(change.cycle as u32);
        if change.level {
            let _ = chain.step(&config, Edge::rise(now));
        } else {
            let _ = chain.step(&config, Edge::fall(now));
            // Not once a second but behind every flash and every sweep.
            let _ = chain.expire(&config, now.after(Span(1)));
        }
    }
    // The search, up to 3 s until a frame begins, and 3 s of frame.
    let stations = chain.health(&config, now).stations;
    assert!(stations.iter().all(|station| station.good >= 1 && station.bad == 0), "{stations:?}");
}

/// Without the pulses from `from` to `to` seconds that `hidden` chooses.
fn without(pulses: &[Pulse], from: f64, to: f64, hidden: impl Fn(&Pulse) -> bool) -> Vec<Pulse> {
    let within = |pulse: &Pulse| (from..to).contains(&(f64::from(pulse.start.0) / 48e6));
    pulses.iter().copied().filter(|pulse| !(within(pulse) && hidden(pulse))).collect()
}

#[test]
fn a_lost_lock_costs_the_frames_it_falls_into_and_no_other() {
    let Some(pulses) = recording("hmd-one-station-visible.csv") else { return };
    for from in [4.1, 7.0, 8.6, 10.3] {
        // 0.4 s is what the cycle is carried on for.
        let heard = hear(&without(&pulses, from, from + 0.6, |_| true));
        assert_eq!((heard.health.lock, heard.health.rejects.locks), (Lock::Locked, 1));
        for (index, whole) in [4, 5].into_iter().enumerate() {
            let blocks: Vec<Terms> = heard.blocks[index].iter().map(terms).collect();
            assert!(blocks.iter().all(|block| *block == HEADSET[index]), "{blocks:x?}");
            // The frame under way, and the next where its preamble falls into the dark.
            assert!(blocks.len() + 2 >= whole, "{} of {whole} frames at {from}", blocks.len());
            assert_eq!(heard.health.stations[index].bad, 0);
        }
    }
}

#[test]
fn a_hidden_station_costs_its_own_frames_and_none_of_the_other() {
    let Some(pulses) = recording("hmd-one-station-visible.csv") else { return };
    // B's flashes rise 409 us after A's.
    let rises: std::collections::BTreeSet<u32> =
        pulses.iter().filter(|pulse| pulse.width.0 > 2_400).map(|pulse| pulse.start.0).collect();
    let is_b = |pulse: &Pulse| {
        let earlier = pulse.start.0.saturating_sub(21_000)..pulse.start.0.saturating_sub(18_000);
        pulse.width.0 > 2_400 && rises.range(earlier).next().is_some()
    };
    // Holes of up to 2 s are filled from the next repetition; 6 s leave nothing but the last frame, as the one before has
    // no preamble.
    for (from, to, frames) in [(4.0, 4.3, 4), (5.0, 7.0, 4), (3.0, 9.0, 1)] {
        let heard = hear(&without(&pulses, from, to, is_b));
        assert_eq!(heard.health.rejects.locks, 0);
        let [a, b] = heard.blocks.each_ref().map(|blocks| blocks.iter().map(terms).collect::<Vec<_>>());
        assert_eq!(a, vec![HEADSET[0]; 4]);
        assert!(b.iter().all(|block| *block == HEADSET[1]));
        assert_eq!(b.len(), frames, "from {from} to {to} s");
    }
}

/// What the synthetic stations say: channels b and c, the second with a fault.
const SAID: [Info; 2] = [said(1_234_567_890, 1, 0), said(77, 2, 5)];
/// The phases of the default room's rotors, rad.
const PHASES: [[f64; 2]; 2] = [[0.046615, 0.055583], [0.015264, 0.020820]];

const fn said(id: u32, mode: u8, faults: u8) -> Info {
    Info { id, firmware: 1, protocol: 6, unlock_count: 0, hardware: 9, acceleration: [0, 127, 0], mode, faults }
}

/// The light of `cycle` from slot `first` on, with what the stations say in its flashes, whose ends come `late` ticks
/// late. A pulse for which `change` gives nothing is hidden; the pulses that it gives come instead.
fn light(
    cycle: &Cycle,
    first: u32,
    slots: u32,
    late: [i32; 2],
    change: impl Fn(u32, Truth, Pulse) -> Vec<Pulse>,
) -> Vec<Pulse> {
    let bits = [0, 1].map(|station: usize| {
        let [azimuth, elevation] = PHASES[station].map(|phase_rad| Rotor { phase_rad, ..Rotor::default() });
        frame(&SAID[station].block(&azimuth, &elevation))
    });
    let mut pulses = Vec::new();
    for slot in first..first + slots {
        for index in 0..PULSES_PER_SLOT {
            let (mut truth, mut pulse) = cycle.pulse(slot, index);
            if let Truth::Sync(sync) = &mut truth {
                let bits = &bits[sync.station as usize];
                sync.data = bits[slot as usize % bits.len()];
                pulse.width = Span(cycle.span(width(*sync)).0.saturating_add_signed(late[sync.station as usize]));
            }
            pulses.extend(change(slot, truth, pulse));
        }
    }
    pulses
}

fn edges(pulses: &[Pulse]) -> impl Iterator<Item = Edge> {
    pulses.iter().flat_map(|pulse| [Edge::rise(pulse.start), Edge::fall(pulse.start.after(pulse.width))])
}

fn end(pulses: &[Pulse]) -> Ticks {
    pulses.last().map_or(Ticks(0), |last| last.start.after(last.width))
}

/// Plays the pulses; how the chain then is.
fn play(chain: &mut Chain, config: &Config, pulses: &[Pulse]) -> Health {
    for edge in edges(pulses) {
        let _ = chain.step(config, edge);
    }
    chain.health(config, end(pulses))
}

fn as_is(_: u32, _: Truth, pulse: Pulse) -> Vec<Pulse> {
    vec![pulse]
}

const ROTORS: [[(Station, Axis); 2]; 2] = [
    [(Station::A, Axis::Azimuth), (Station::A, Axis::Elevation)],
    [(Station::B, Axis::Azimuth), (Station::B, Axis::Elevation)],
];

#[test]
fn health_counts_what_was_played() {
    let cycle = Cycle { start: u32::MAX - 30_000_000, ..Cycle::IN_THE_ROOM };
    let config =
        Config { ootx: ootx::Config { rest_bits: 0, ids: [Some(SAID[0].id), Some(78)] }, ..config(Estimate::Track) };
    let config = Config { angle: room::CONFIG.angle.with_received([true, false]), ..config };
    let mut chain = Chain::default();
    // Ends 8 us late and 4 us early: 24.6 and -12.3 of 1/32 width steps.
    let late = [87, -43];
    let clean = light(&cycle, 0, 1200, late, as_is);
    let before = play(&mut chain, &config, &clean);
    // The preamble comes by at slot 358 first, and each 358 slots later a frame is whole.
    for (station, info) in before.stations.iter().zip(SAID) {
        assert_eq!((station.id, station.mode, station.faults), (info.id, info.mode, info.faults));
        assert_eq!((station.good, station.bad), (2, 0));
    }
    assert_eq!(before.stations.map(|station| station.is_stranger), [false, true]);
    assert_eq!(before.stations.map(|station| station.factory), [Factory::Received, Factory::File]);

    // Pulses of 1 tick, 10 us and 60 us, where no laser is, before any is due, and after all.
    let (half_turn, us) = (cycle.span(400_000).0, cycle.span(48).0);
    let extra = |slot: u32, share: u32, width: u32| {
        let start = cycle.pulse(slot, 0).1.start.after(Span(half_turn / 100 * share));
        Pulse { start, width: Span(width) }
    };
    let changed = light(&cycle, 1200, 1200, late, |slot, truth, pulse| match (slot - 1200, truth) {
        // Ten of A's flashes, seven of B's, and five sweeps of A's azimuth are hidden.
        (n, Truth::Sync(Sync { station: Station::A, .. })) if n % 100 == 10 && n < 1000 => vec![],
        (n, Truth::Sync(Sync { station: Station::B, .. })) if n % 100 == 20 && n < 700 => vec![],
        (n, Truth::Sweep(Station::A, Axis::Azimuth)) if n % 100 == 30 && n < 500 => vec![],
        // Three of A's flashes do not end in time.
        (n, Truth::Sync(Sync { station: Station::A, .. })) if n % 300 == 45 && n < 900 => {
            vec![Pulse { width: Span(200 * us), ..pulse }]
        }
        // Four too short and three too long before the sweep, two after it that could be one, six after all.
        (n, Truth::Sweep(..)) if n % 100 == 55 && n < 400 => vec![extra(slot, 25, 1), pulse],
        (n, Truth::Sweep(..)) if n % 100 == 65 && n < 300 => vec![extra(slot, 25, 60 * us), pulse],
        (n, Truth::Sweep(..)) if n % 100 == 75 && n < 200 => vec![pulse, extra(slot, 75, 10 * us)],
        (n, Truth::Sweep(..)) if n % 100 == 85 && n < 600 => vec![pulse, extra(slot, 95, 10 * us)],
        _ => vec![pulse],
    });
    // Two rises are doubled.
    let mut stamped: Vec<Edge> = edges(&changed).collect();
    for doubled in [600, 1800] {
        stamped.insert(doubled, stamped[doubled]);
    }
    for edge in stamped {
        let _ = chain.step(&config, edge);
    }
    let after = chain.health(&config, end(&changed));
    let syncs = [0, 1].map(|station| after.syncs[station].wrapping_sub(before.syncs[station]));
    assert_eq!(syncs, [1200 - 10 - 3, 1200 - 7]);
    let sweeps = ROTORS.map(|station| {
        station.map(|(station, axis)| {
            let (station, axis) = (station as usize, axis as usize);
            after.sweeps[station][axis].wrapping_sub(before.sweeps[station][axis])
        })
    });
    assert_eq!(sweeps, [[300 - 5, 300], [300, 300]]);
    let (now, then) = (after.rejects, before.rejects);
    assert_eq!(
        [now.widths, now.short, now.long, now.second, now.edges, now.locks, now.outside],
        [3, 4, 3, 2, 2, 0, 0],
        "{now:?}"
    );
    assert_eq!(now.strays - then.strays, 6);
    assert_eq!((now.disbelieved, now.geometry, now.mismatch), (0, 0, 0));
    assert_eq!(after.lock, Lock::Locked);
    // 10.82 MHz / 120 in Q8, to one tick in the eight half turns that it is measured over.
    assert!(after.half_turn_q8.abs_diff(10_820_000 / 15 * 32) <= 32 + 10_820_000 % 15, "{}", after.half_turn_q8);
    for (station, bias) in after.stations.iter().zip([25, -12]) {
        // 2: a tick is 0.28 of it, and the mean over eight flashes wanders by as much.
        assert!(station.width_bias.abs_diff(bias) <= 2, "{} for {bias}", station.width_bias);
        assert_eq!(station.bad, 0);
    }
}

#[test]
fn stations_that_are_swapped_are_said_and_give_no_place() {
    let cycle = Cycle::IN_THE_ROOM;
    let pulses = light(&cycle, 0, 1200, [0; 2], as_is);
    for (ids, is_swapped) in [([SAID[0].id, SAID[1].id], false), ([SAID[1].id, SAID[0].id], true)] {
        let config =
            Config { ootx: ootx::Config { ids: ids.map(Some), ..ootx::Config::DEFAULT }, ..config(Estimate::Track) };
        let mut chain = Chain::default();
        // Rays that meet, as in a room where each station stands where the other's image would: only the numbers tell.
        let mut reports = 0;
        for edge in edges(&pulses) {
            // Two frames of 358 bits: by then both have said who they are.
            let is_late = edge.at.since(cycle.ticks(0)) > cycle.span(720 * 400_000);
            reports += u32::from(chain.step(&config, edge).is_some() && is_late);
        }
        let health = chain.health(&config, end(&pulses));
        assert_eq!(health.stations.map(|station| station.is_stranger), [is_swapped; 2]);
        assert_eq!(health.lock, Lock::Locked);
        if is_swapped {
            assert_eq!(reports, 0);
        } else {
            assert!(reports > 20, "{reports}");
        }
    }
}

#[test]
fn health_says_why_there_is_no_cycle() {
    let cycle = Cycle::IN_THE_ROOM;
    let config = config(Estimate::Track);
    assert_eq!(Chain::default().health(&room::CONFIG, Ticks(0)), Health::default());
    let is_of = |truth: Truth, one: Station| match truth {
        Truth::Sync(sync) => sync.station == one,
        Truth::Sweep(station, _) => station == one,
    };
    for one in [Station::A, Station::B] {
        let lone =
            light(&cycle, 0, 600, [0; 2], |_, truth, pulse| if is_of(truth, one) { vec![pulse] } else { vec![] });
        let health = play(&mut Chain::default(), &config, &lone);
        assert_eq!((health.lock, health.syncs), (Lock::OneStation, [0, 0]));
    }
    // Hidden later on, nothing is lost but its light.
    let mut chain = Chain::default();
    let before = play(&mut chain, &config, &light(&cycle, 0, 120, [0; 2], as_is));
    let hidden =
        light(&cycle, 120, 600, [0; 2], |_, truth, pulse| if is_of(truth, Station::B) { vec![] } else { vec![pulse] });
    let after = play(&mut chain, &config, &hidden);
    assert_eq!((before.lock, after.lock, after.rejects.locks), (Lock::Locked, Lock::Locked, 0));
    assert_eq!((after.syncs[0] - before.syncs[0], after.syncs[1] - before.syncs[1]), (600, 0));
    assert_eq!((after.sweeps[0][0] - before.sweeps[0][0], after.sweeps[1][0] - before.sweeps[1][0]), (150, 0));
    // And then all of it: 0.5 s later the cycle is lost, 5 s later there is no light.
    let half_turn = cycle.span(400_000).0;
    let dark = end(&hidden).after(Span(60 * half_turn));
    assert!(chain.expire(&config, dark).is_none());
    let lost = chain.health(&config, dark.after(Span(540 * half_turn)));
    assert_eq!((lost.lock, lost.rejects.locks, lost.half_turn_q8), (Lock::NoLight, 1, 0));
    // Who comes back may be another.
    assert_eq!(lost.stations.map(|station| station.id), [0, 0]);
}

#[test]
fn health_counts_angles_that_cannot_be() {
    let cycle = Cycle::IN_THE_ROOM;
    let [a, b] = cycle.sweep_after;
    // The field of view ends at 60 degrees, 333,333; this is 61.2.
    let beyond = Cycle { sweep_after: [[336_000, a[1]], b], ..cycle };
    // Twenty degrees up for one station only: the rays miss each other.
    let askew = Cycle { sweep_after: [[a[0], a[1] + 44_444], b], ..cycle };
    let config = |estimate| Config { angle: angle::Config::default(), ..self::config(estimate) };
    let mut chain = Chain::default();
    play(&mut chain, &config(Estimate::Angles), &light(&cycle, 0, 120, [0; 2], as_is));
    let health = play(&mut chain, &config(Estimate::Angles), &light(&beyond, 120, 120, [0; 2], as_is));
    assert_eq!((health.rejects.outside, health.sweeps[0][0] > 50), (30, true));

    let real = |estimate| Config { estimate, report_every_half_turns: 1, ..room::CONFIG };
    let mut chain = Chain::default();
    let before = play(&mut chain, &real(Estimate::Fix), &light(&cycle, 0, 120, [0; 2], as_is));
    let after = play(&mut chain, &real(Estimate::Fix), &light(&askew, 120, 120, [0; 2], as_is));
    assert_eq!((before.rejects.geometry, before.rejects.mismatch), (0, 0));
    // From A's elevation in slot 3 on, every sweep makes a fix that is refused.
    assert_eq!(after.rejects.geometry + after.rejects.mismatch, 120 - 3, "{:?}", after.rejects);

    let mut chain = Chain::default();
    play(&mut chain, &real(Estimate::Track), &light(&cycle, 0, 240, [0; 2], as_is));
    play(&mut chain, &real(Estimate::Track), &light(&askew, 240, 4, [0; 2], as_is));
    // So far from the one before, that sweep was kept until its slot had ended.
    let one = play(&mut chain, &real(Estimate::Track), &light(&cycle, 244, 4, [0; 2], as_is));
    assert_eq!(one.rejects.disbelieved, 1);
}

/// The batches of some light, the sweeps that went in, and what was left at the end.
fn batches(pulses: &[Pulse], dark: Option<Ticks>) -> (Vec<(Ticks, Angles)>, Vec<Sweep>) {
    let config = config(Estimate::Angles);
    let (mut classifier, mut batch) = (Classifier::default(), Batch::default());
    let (mut frames, mut sweeps) = (Vec::new(), Vec::new());
    let mut take = |sighting: Option<crate::chain::Sighting>, now: Ticks| {
        let Some(sighting) = sighting else { return };
        if let Seen::Sweep(sweep) = sighting.seen {
            sweeps.push(sweep);
        }
        frames.extend(batch.step(&sighting).map(|angles| (now, angles)));
    };
    for pulse in pulses {
        take(classifier.pulse(&config, *pulse), pulse.start);
    }
    if let Some(dark) = dark {
        take(classifier.expire(dark), dark);
    }
    (frames, sweeps)
}

fn measured(sweeps: &[Sweep]) -> Vec<Measured> {
    sweeps.iter().map(Measured::from).collect()
}

#[test]
fn a_batch_goes_out_with_eight_sweeps_as_they_were_measured() {
    let cycle = Cycle { start: u32::MAX - 5_000_000, ..Cycle::TYPICAL };
    let (frames, sweeps) = batches(&light(&cycle, 0, 400, [0; 2], as_is), None);
    assert!(frames.len() >= 48, "{} frames", frames.len());
    assert!(frames.iter().all(|(_, angles)| angles.sweeps.len() == 8));
    let sent: Vec<Measured> = frames.iter().flat_map(|(_, angles)| angles.sweeps.clone()).collect();
    assert_eq!(sent, measured(&sweeps)[..sent.len()]);
    assert!(sweeps.len() - sent.len() < 8);
    for (sweep, (_, angles)) in sweeps.iter().skip(7).step_by(8).zip(&frames) {
        assert_eq!(angles.half_turn_q8, sweep.half_turn.ticks_q8());
    }
}

#[test]
fn a_batch_goes_out_after_a_quarter_second_and_when_the_cycle_is_lost() {
    let cycle = Cycle::TYPICAL;
    // One sweep in eight half turns: at 0, 8, 16, 24, and in the 31st the first has waited long enough.
    let rare = light(&cycle, 0, 400, [0; 2], |slot, truth, pulse| {
        if matches!(truth, Truth::Sweep(..)) && slot % 8 != 2 { vec![] } else { vec![pulse] }
    });
    let half_turn = cycle.span(400_000).0;
    let (frames, sweeps) = batches(&rare, Some(end(&rare).after(Span(60 * half_turn))));
    let sent: Vec<Measured> = frames.iter().flat_map(|(_, angles)| angles.sweeps.clone()).collect();
    assert_eq!(sent, measured(&sweeps));
    let ((_, last), in_time) = frames.split_last().expect("some frames");
    assert!(in_time.len() >= 10 && !last.sweeps.is_empty());
    for (now, angles) in in_time {
        assert_eq!(angles.sweeps.len(), 4);
        let waited = now.since(Ticks(angles.sweeps[0].time)).0;
        // A slot without a sweep is told of at the next flash.
        assert!(waited > 30 * half_turn && waited <= 32 * half_turn, "{waited}");
    }
}
