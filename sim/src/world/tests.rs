//! The room as a whole: what leaves it as edges, against what it knows.

use super::clock::Clock;
use super::ootx::tests::unframe;
use super::path::Path;
use super::receiver::{Facing, Interference, Line, LineFault, Mirror, Receiver, Sensitivity, Strobe};
use super::rotor::Rotor;
use super::station::{Hides, Moved, Occlusion};
use super::*;
use nalgebra::{Matrix3, Vector3};
use proptest::prelude::*;

const STILL: Path = Path::Still { at_m: [0.5, 1.0, 0.8] };

/// Pulses of a world in true seconds: start, width.
fn pulses(world: &mut World, until_s: f64) -> Vec<(f64, f64)> {
    let mut pulses = Vec::new();
    while let Some(rise) = world.next_edge() {
        let fall = world.next_edge().expect("light that rises falls");
        let (rise_s, fall_s) = (world.seconds(rise.cycle), world.seconds(fall.cycle));
        if rise_s > until_s {
            break;
        }
        pulses.push((rise_s, fall_s - rise_s));
    }
    pulses
}

fn log(scene: &Scene, seed: u64, length_s: f64) -> Vec<Event> {
    let mut world = World::new(&Scene { length_s, ..scene.clone() }, seed);
    world.keep_log();
    while world.next_edge().is_some() {}
    world.take_log()
}

fn edges(scene: &Scene, seed: u64, count: usize) -> Vec<Edge> {
    World::new(scene, seed).edges().take(count).collect()
}

/// A clock fine enough that its steps are not the error: 1 ns is 0.4 um at 1 m.
fn fine(scene: Scene) -> Scene {
    let scene = scene.without_noise();
    Scene { clock: Clock { nominal_hz: 1e9, ..scene.clock }, ..scene }
}

fn crooked() -> Scene {
    let rotor = |phase_rad, tilt_rad, gibbous_magnitude_rad| Rotor {
        phase_rad,
        tilt_rad,
        curve: 0.002,
        gibbous_phase_rad: 0.7,
        gibbous_magnitude_rad,
    };
    let mut scene = Scene::default();
    scene.station_a.azimuth = rotor(0.046, 0.004, 0.003);
    scene.station_a.elevation = rotor(0.055, -0.006, -0.002);
    scene.station_b.azimuth = rotor(0.015, 0.002, 0.008);
    scene.station_b.elevation = rotor(-0.02, 0.003, 0.001);
    scene
}

/// The place nearest to four planes, each a row of (normal, height over the origin).
fn meet(planes: &[(Vector3<f64>, f64)]) -> Vector3<f64> {
    let squares: Matrix3<f64> = planes.iter().map(|(n, _)| n * n.transpose()).sum();
    let heights: Vector3<f64> = planes.iter().map(|(n, d)| n * *d).sum();
    squares.try_inverse().expect("the planes meet in a point") * heights
}

/// The true plane of a sweep: the points whose angle on the axis has this tangent.
fn plane(station: &Station, axis: Axis, tan: f64) -> (Vector3<f64>, f64) {
    let [x, y, z] = station.rotation.map(Vector3::from);
    let n = (if axis == Axis::Azimuth { x } else { y } - z * tan).normalize();
    (n, n.dot(&Vector3::from(station.position_m)))
}

/// The mote's place from four spans between sync and sweep, by Newton's ten rounds for the factory terms.
fn solve(scene: &Scene, spans_s: &[(StationId, Axis, f64)]) -> Vector3<f64> {
    let half_turn_s = scene.timing.half_turn_s();
    let station = |id| {
        if id == StationId::A { &scene.station_a } else { &scene.station_b }
    };
    (0..10).fold(Vector3::new(0.5, 1.0, 0.8), |place, _| {
        let planes: Vec<_> = spans_s
            .iter()
            .map(|&(id, axis, span_s)| {
                let (_, other_tan) = station(id).sight(place).tangents(axis).expect("in front");
                let measured_rad = (span_s / half_turn_s - 0.5) * PI;
                plane(station(id), axis, station(id).rotor(axis).ideal(measured_rad, other_tan).tan())
            })
            .collect();
        meet(&planes)
    })
}

#[test]
fn the_edges_alone_give_back_where_a_still_mote_lies() {
    let scene = Scene { path: STILL, ..fine(crooked()) };
    let mut world = World::new(&scene, 1);
    let pulses = pulses(&mut world, 1.0 / 30.0);
    assert_eq!(pulses.len(), 12);
    // Of each slot: A's flash, B's flash, the sweep. B sweeps in the first two slots.
    let spans: Vec<_> = pulses
        .chunks(3)
        .zip(0u64..)
        .map(|(slot, n)| {
            let (id, axis) = slot::sweep_of(n);
            let sync_s = slot[id as usize].0;
            (id, axis, slot[2].0 + slot[2].1 / 2.0 - sync_s)
        })
        .collect();
    let error_m = (solve(&scene, &spans) - Vector3::new(0.5, 1.0, 0.8)).norm();
    assert!(error_m < 10e-6, "{error_m} m");
}

#[test]
fn every_sweep_of_a_moving_mote_passes_through_the_truth() {
    let scene = Scene { clock: Clock { nominal_hz: 1e9, ..Clock::default() }, ..fine(crooked()) };
    let mut world = World::new(&scene, 2);
    world.keep_log();
    while world.next_edge().is_some_and(|edge| world.seconds(edge.cycle) < 20.0) {}
    let mut sweeps = 0;
    for event in world.take_log() {
        let EventKind::Sweep { station, axis, angle_rad, sync_to_sweep_s, half_turn_s } = event.kind else {
            continue;
        };
        let (id, truth) = (station, Vector3::from(world.truth(event.cycle)));
        let station = if id == StationId::A { &scene.station_a } else { &scene.station_b };
        let (_, other_tan) = station.sight(truth).tangents(axis).expect("in front");
        let ideal = station.rotor(axis).ideal((sync_to_sweep_s / half_turn_s - 0.5) * PI, other_tan);
        let (normal, height) = plane(station, axis, ideal.tan());
        assert!((ideal - angle_rad).abs() < 1e-8);
        assert!((normal.dot(&truth) - height).abs() < 1e-6);
        sweeps += 1;
    }
    assert!(sweeps >= 2_399, "{sweeps}");
}

#[test]
fn a_mote_without_noise_sees_the_eight_v1_widths_and_no_others() {
    let scene = Scene { path: STILL, ..fine(Scene::default()) };
    let pulses = pulses(&mut World::new(&scene, 3), 10.0);
    let mut counts = [0; 8];
    for (_, width_s) in pulses {
        let steps = (width_s * 1e6 - 62.5) / (62.5 / 6.0);
        if width_s > 30e-6 {
            assert!((steps - steps.round()).abs() < 0.01, "{} us", width_s * 1e6);
            counts[steps.round() as usize] += 1;
        } else {
            assert!((1.5e-6..20e-6).contains(&width_s));
        }
    }
    assert!(counts.iter().all(|&count| count > 100), "{counts:?}");
    assert_eq!(counts.iter().sum::<i32>(), 2_400);
}

#[test]
fn a_slot_opens_with_a_and_b_follows_by_the_gap() {
    let events = log(&Scene::default().without_noise(), 4, 1.0);
    let syncs: Vec<_> = events
        .iter()
        .filter_map(|event| match event.kind {
            EventKind::Sync { station, axis, skip, .. } => Some((event.cycle, station, axis, skip)),
            _ => None,
        })
        .collect();
    for (pair, n) in syncs.chunks_exact(2).zip(0u64..) {
        let ((first, a, axis, a_skips), (second, b, _, b_skips)) = (pair[0], pair[1]);
        assert_eq!((a, b), (StationId::A, StationId::B));
        assert_eq!(axis, slot::sweep_of(n).1);
        assert!(a_skips != b_skips && a_skips == (n % 4 < 2));
        assert!(((second - first) as f64 / 10.82e6 - 20_000.0 / 48e6).abs() < 2e-7);
    }
}

#[test]
fn the_data_bits_in_the_widths_spell_the_info_block() {
    let scene = fine(crooked());
    let mut world = World::new(&scene, 5);
    let flashes: Vec<_> = pulses(&mut world, 7.0).into_iter().filter(|&(_, width_s)| width_s > 30e-6).collect();
    for (n, station) in [&scene.station_a, &scene.station_b].into_iter().enumerate() {
        let bits: Vec<bool> = flashes
            .chunks_exact(2)
            .map(|pair| ((pair[n].1 * 48e6 - 3_000.0) / 500.0).round() as u32 >> 1 & 1 == 1)
            .collect();
        assert_eq!(unframe(&bits), Ok(station.info.block(&station.azimuth, &station.elevation).to_vec()));
    }
}

#[test]
fn an_occluded_station_is_dark_and_the_other_shines_as_before() {
    let mut scene = Scene { path: STILL, ..Scene::default() };
    let open = log(&scene, 6, 4.0);
    scene.station_a.occlusions = vec![
        Occlusion { from_s: 1.0, to_s: 2.0, hides: Hides::Everything },
        Occlusion { from_s: 3.0, to_s: 3.5, hides: Hides::Sweeps },
    ];
    let shut = log(&scene, 6, 4.0);
    let world = World::new(&scene, 6);
    assert_eq!(open.len(), shut.len());
    for (open, shut) in open.iter().zip(&shut) {
        let t_s = world.seconds(shut.cycle);
        let hidden = match shut.kind {
            EventKind::Sync { station, .. } => station == StationId::A && (1.0..2.0).contains(&t_s),
            EventKind::Sweep { station, .. } => {
                station == StationId::A && ((1.0..2.0).contains(&t_s) || (3.0..3.5).contains(&t_s))
            }
            EventKind::Reflection { .. } => unreachable!("there is no mirror"),
        };
        assert_eq!((shut.cycle, shut.kind), (open.cycle, open.kind));
        assert_eq!(shut.seen, open.seen && !hidden);
    }
}

#[test]
fn a_room_that_stays_dark_ends_without_an_edge() {
    let mut scene = Scene { length_s: 600.0, ..Scene::default() };
    for station in [&mut scene.station_a, &mut scene.station_b] {
        station.occlusions = vec![Occlusion { from_s: 0.0, to_s: 1e9, hides: Hides::Everything }];
    }
    assert_eq!(World::new(&scene, 7).next_edge(), None);
}

#[test]
fn a_mote_outside_the_field_sees_flashes_and_no_sweeps() {
    // 75 degrees to the side of both stations.
    let scene = Scene { path: Path::Still { at_m: [3.0, 1.0, 1.0] }, ..Scene::default() };
    let events = log(&scene, 8, 1.0);
    assert!(events.iter().all(|event| matches!(event.kind, EventKind::Sync { .. })));
    assert!(events.iter().filter(|event| event.seen).count() > 200);
}

#[test]
fn dropouts_and_angle_noise_have_the_size_they_are_given() {
    let mut scene = Scene { path: STILL, ..Scene::default() };
    scene.timing.angle_noise_deg = 0.2;
    scene.receiver.sync_dropout = 0.1;
    scene.receiver.sweep_dropout = 0.3;
    let events = log(&scene, 9, 60.0);
    let (mut flashes, mut sweeps, mut squares) = ([0.0; 2], [0.0; 2], 0.0);
    let phase =
        |id, axis: Axis| if id == StationId::A { &scene.station_a } else { &scene.station_b }.rotor(axis).phase_rad;
    for event in &events {
        match event.kind {
            EventKind::Sync { .. } => flashes[usize::from(event.seen)] += 1.0,
            EventKind::Sweep { station, axis, angle_rad, sync_to_sweep_s, half_turn_s } => {
                sweeps[usize::from(event.seen)] += 1.0;
                let measured_rad = (sync_to_sweep_s / half_turn_s - 0.5) * PI;
                squares += (measured_rad + phase(station, axis) - angle_rad).to_degrees().powi(2);
            }
            EventKind::Reflection { .. } => {}
        }
    }
    assert!((flashes[0] / (flashes[0] + flashes[1]) - 0.1_f64).abs() < 0.01);
    assert!((sweeps[0] / (sweeps[0] + sweeps[1]) - 0.3_f64).abs() < 0.02);
    assert!(((squares / (sweeps[0] + sweeps[1])).sqrt() - 0.2_f64).abs() < 0.01);
}

#[test]
fn a_mirror_sends_the_sweep_a_second_time_from_elsewhere() {
    let mut scene = Scene { path: STILL, ..Scene::default().without_noise() };
    scene.mirrors = vec![Mirror { point_m: [1.2, 0.0, 0.0], normal: [-1.0, 0.0, 0.0], ..Mirror::default() }];
    let events = log(&scene, 10, 1.0);
    let count = |wanted: fn(&EventKind) -> bool| events.iter().filter(|event| wanted(&event.kind)).count();
    assert_eq!(count(|kind| matches!(kind, EventKind::Sweep { .. })), 120);
    assert!(count(|kind| matches!(kind, EventKind::Reflection { .. })) > 50);
    assert!(events.is_sorted_by_key(|event| event.cycle));
}

#[test]
fn interference_comes_at_its_rate() {
    let quiet = Scene { length_s: 20.0, path: STILL, ..Scene::default() };
    let loud =
        Scene { interference: Interference { rate_per_s: 100.0, shortest_us: 1.0, longest_us: 5.0 }, ..quiet.clone() };
    let pulses = |scene: &Scene| World::new(scene, 11).edges().count() / 2;
    let more = pulses(&loud) - pulses(&quiet);
    // 2,000 less the few that fall into other light.
    assert!((1_800..2_100).contains(&more), "{more}");
}

#[test]
fn a_reflection_comes_when_the_plane_meets_the_image_of_the_mote() {
    let mut scene = Scene { path: STILL, ..fine(Scene::default()) };
    let wall = Mirror { point_m: [1.1, 0.0, 0.0], normal: [-1.0, 0.0, 0.0], ..Mirror::default() };
    scene.mirrors = vec![wall];
    let image = wall.image(Vector3::new(0.5, 1.0, 0.8));
    let cycles = |scene: &Scene, reflected: bool| -> Vec<u64> {
        let wanted = |kind: &EventKind| match kind {
            EventKind::Reflection { station, axis } => reflected && (*station, *axis) == (StationId::B, Axis::Azimuth),
            EventKind::Sweep { station, axis, .. } => !reflected && (*station, *axis) == (StationId::B, Axis::Azimuth),
            EventKind::Sync { .. } => false,
        };
        log(scene, 14, 1.0).iter().filter(|event| wanted(&event.kind)).map(|event| event.cycle).collect()
    };
    let seen = cycles(&scene, true);
    let there = Scene { path: Path::Still { at_m: image.into() }, mirrors: Vec::new(), ..scene };
    assert_eq!(seen.len(), 30);
    assert_eq!(seen, cycles(&there, false));
}

#[test]
fn a_reflection_may_come_alone_and_be_the_stronger() {
    let mut scene = Scene { path: STILL, ..fine(Scene::default()) };
    let wall = Mirror { point_m: [1.1, 0.0, 0.0], normal: [-1.0, 0.0, 0.0], ..Mirror::default() };
    scene.mirrors = vec![Mirror { alone: 0.5, gain: [2.0, 2.0], ..wall }];
    let events = log(&scene, 15, 10.0);
    let of = |wanted: fn(&EventKind) -> bool| events.iter().filter(move |event| wanted(&event.kind));
    let direct = of(|kind| matches!(kind, EventKind::Sweep { station: StationId::B, .. }));
    let hidden = direct.filter(|event| !event.seen).count();
    // 600 sweeps of B, each with its image.
    assert!((250..350).contains(&hidden), "{hidden}");
    let first = of(|kind| matches!(kind, EventKind::Reflection { axis: Axis::Azimuth, .. })).next().expect("a wall");
    let mut world = World::new(&scene, 15);
    let at_s = world.seconds(first.cycle);
    let image = wall.image(Vector3::new(0.5, 1.0, 0.8));
    let plain_us =
        scene.station_b.sight(image).sweep_width_us(Axis::Azimuth, &scene.optics, scene.timing.half_turn_s());
    let width_s = pulses(&mut world, 1.0).into_iter().find(|(s, w)| s <= &at_s && at_s < s + w).expect("its pulse").1;
    assert!((width_s * 1e6 - 2.0 * plain_us).abs() < 0.01, "{} us, direct {plain_us}", width_s * 1e6);
}

#[test]
fn a_strobe_is_where_its_own_crystal_puts_it() {
    let mut scene = Scene { path: STILL, ..fine(Scene::default()) };
    for station in [&mut scene.station_a, &mut scene.station_b] {
        station.occlusions = vec![Occlusion { from_s: 0.0, to_s: 1e9, hides: Hides::Everything }];
    }
    scene.strobes = vec![Strobe { rate_hz: 60.05, burst_us: 400.0, first_s: 0.5, to_s: 9.0 }];
    scene.length_s = 10.0;
    let bursts = pulses(&mut World::new(&scene, 16), 10.0);
    // 8.5 s at 60.05 per second, the first of them at once.
    assert_eq!(bursts.len(), 511);
    for (n, (rise_s, width_s)) in bursts.into_iter().enumerate() {
        assert!((rise_s - (0.5 + n as f64 / 60.05)).abs() < 2e-9 && (width_s - 400e-6).abs() < 2e-9);
    }
}

#[test]
fn a_strobe_over_a_flash_makes_one_long_pulse() {
    let mut scene = Scene { path: STILL, length_s: 1.0, ..fine(Scene::default()) };
    // 100 us before each flash of A in even slots, so long that it ends within the flash.
    scene.strobes = vec![Strobe { rate_hz: 60.0, burst_us: 150.0, first_s: 0.9e-3, to_s: 1.0 }];
    let (first_s, width_s) = pulses(&mut World::new(&scene, 17), 1.0)[0];
    assert!((first_s - 0.9e-3).abs() < 2e-9);
    let ends = [false, true].map(|data| 100.0 + slot::sync_width_us(Axis::Azimuth, data, true));
    assert!(ends.iter().any(|end_us| (width_s * 1e6 - end_us).abs() < 0.01), "{} us", width_s * 1e6);
}

#[test]
fn a_stuck_line_says_one_thing_until_it_is_well_again() {
    for (line, edges_within) in [(Line::StuckHigh, 0), (Line::StuckLow, 0), (Line::Storm { hz: 100e3 }, 20_000)] {
        let well = Scene { path: STILL, length_s: 1.0, ..fine(Scene::default()) };
        let ill = Scene { line_faults: vec![LineFault { from_s: 0.3, to_s: 0.4, line }], ..well.clone() };
        let [well, ill] = [well, ill].map(|scene| World::new(&scene, 18).edges().collect::<Vec<_>>());
        let span = |from: u64, to: u64, edges: &[Edge]| -> Vec<Edge> {
            edges.iter().filter(|edge| (from..to).contains(&edge.cycle)).copied().collect()
        };
        assert_eq!(span(0, 299_000_000, &well), span(0, 299_000_000, &ill));
        assert_eq!(span(405_000_000, 1_000_000_000, &well), span(405_000_000, 1_000_000_000, &ill));
        let during = span(300_000_001, 400_000_000, &ill).len();
        assert!(during.abs_diff(edges_within) <= 2, "{line:?}: {during}");
    }
}

#[test]
fn even_jitter_stays_within_what_it_is_given_and_uses_all_of_it() {
    let mut scene = Scene { path: STILL, ..fine(Scene::default()) };
    let starts = |scene: &Scene| -> Vec<f64> { pulses(&mut World::new(scene, 19), 10.0).iter().map(|p| p.0).collect() };
    let calm = starts(&scene);
    // Small enough that no sweep is lost to it.
    scene.receiver.even_jitter_us = 3.0;
    let moves: Vec<f64> = starts(&scene).iter().zip(&calm).map(|(a, b)| (a - b) * 1e6).collect();
    let (low, high) = moves.iter().fold((0.0f64, 0.0f64), |(l, h), m| (l.min(*m), h.max(*m)));
    assert!((-3.01..-2.95).contains(&low) && (2.95..3.01).contains(&high), "{low} {high}");
    let deviation = (moves.iter().map(|m| m * m).sum::<f64>() / moves.len() as f64).sqrt();
    assert!((deviation - 3.0 / 3f64.sqrt()).abs() < 0.05, "{deviation}");
}

#[test]
fn a_receiver_that_warms_up_stretches_its_flashes() {
    let mut scene = Scene { path: STILL, ..fine(Scene::default()) };
    scene.receiver.sync_width_bias_us = -10.0;
    scene.receiver.sync_width_drift_us_per_s = 1.0;
    let flashes = pulses(&mut World::new(&scene, 20), 20.0).into_iter().filter(|p| p.1 > 30e-6);
    for (rise_s, width_s) in flashes {
        let steps = ((width_s * 1e6 + 10.0 - rise_s) - 62.5) / (62.5 / 6.0);
        assert!((steps - steps.round()).abs() < 0.01, "{} us at {rise_s} s", width_s * 1e6);
    }
}

#[test]
fn a_station_that_was_moved_sweeps_from_its_new_place_from_then_on() {
    let mut scene = Scene { path: STILL, ..fine(Scene::default()) };
    scene.station_b.moved = Some(Moved { at_s: 1.0, by_m: [0.1, 0.0, 0.0], turn_deg: 5.0, tilt_deg: -2.0 });
    let angles: Vec<(u64, f64)> = log(&scene, 21, 2.0)
        .iter()
        .filter_map(|event| match event.kind {
            EventKind::Sweep { station: StationId::B, axis: Axis::Azimuth, angle_rad, .. } => {
                Some((event.cycle, angle_rad))
            }
            _ => None,
        })
        .collect();
    let after = scene.station_b.after_its_move().expect("it moves");
    for (cycle, angle_rad) in angles {
        let station = if cycle < 1_000_000_000 { &scene.station_b } else { &after };
        let (tan, _) = station.sight(Vector3::new(0.5, 1.0, 0.8)).tangents(Axis::Azimuth).expect("in front");
        assert!((angle_rad - tan.atan()).abs() < 1e-12, "at cycle {cycle}");
    }
}

#[test]
fn weak_light_is_missed_half_the_time_at_its_reach_and_sooner_from_the_side() {
    let share = |distance_m: f64, incidence_deg: f64| {
        let station = Station { rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], ..Station::default() };
        let mut scene = Scene { path: Path::Still { at_m: [0.0, 0.0, distance_m] }, ..fine(Scene::default()) };
        (scene.station_a, scene.station_b) = (station.clone(), station);
        let (sin, cos) = incidence_deg.to_radians().sin_cos();
        scene.receiver.facing = Some(Facing { normal: [sin, 0.0, -cos], max_incidence_deg: 90.0 });
        scene.receiver.sensitivity = Some(Sensitivity { reach_m: 4.0, spread: 0.1 });
        let events = log(&scene, 22, 10.0);
        events.iter().filter(|event| event.seen).count() as f64 / events.len() as f64
    };
    assert!(share(3.0, 0.0) > 0.999 && share(4.9, 0.0) < 0.001);
    assert!((share(4.0, 0.0) - 0.5).abs() < 0.05);
    // cos 60 degrees = 1/2: half the light, at 1/sqrt 2 of the distance.
    assert!((share(4.0 / 2f64.sqrt(), 60.0) - 0.5).abs() < 0.05);
}

#[test]
fn the_half_turn_follows_the_rotor_rate() {
    let mut scene = Scene { path: STILL, ..fine(Scene::default()) };
    scene.timing.half_turn_error_ppm = 1_000.0;
    let pulses = pulses(&mut World::new(&scene, 12), 10.0);
    let flashes: Vec<_> = pulses.iter().filter(|(_, width_s)| *width_s > 30e-6).collect();
    let half_turn_s = (flashes[1_000].0 - flashes[0].0) / 500.0;
    assert!((half_turn_s * 120.0 - 1.001).abs() < 1e-6);
}

#[test]
fn a_day_of_light_is_right_in_its_last_second() {
    let scene = Scene { path: STILL, ..fine(crooked()) };
    let mut world = World::new(&scene, 13);
    world.slot = 86_399 * 120;
    world.keep_log();
    let edges: Vec<_> = world.edges().collect();
    assert!(edges.len() >= 2 * 3 * 119);
    for event in world.take_log() {
        let rise = edges.partition_point(|edge| edge.cycle + 20_000 < event.cycle);
        assert!(edges[rise].cycle.abs_diff(event.cycle) < 20_000);
    }
}

fn rough() -> impl Strategy<Value = Scene> {
    (0.0..20.0f64, 0.0..0.9f64, 0.0..30_000.0f64, 350.0..450.0f64, 0.0..2.0f64, 1e4..1e8f64, 0.0..1.0f64).prop_map(
        |(jitter_us, dropout, rate_per_s, sync_gap_us, angle_noise_deg, nominal_hz, probability)| {
            let mut scene = crooked();
            scene.receiver = Receiver { jitter_us, sync_dropout: dropout, sweep_dropout: dropout, ..scene.receiver };
            scene.interference = Interference { rate_per_s, ..scene.interference };
            scene.timing.sync_gap_us = sync_gap_us;
            scene.timing.angle_noise_deg = angle_noise_deg;
            scene.clock.nominal_hz = nominal_hz;
            scene.mirrors =
                vec![Mirror { point_m: [1.2, 0.0, 0.0], normal: [-1.0, 0.2, 0.0], probability, ..Mirror::default() }];
            scene
        },
    )
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn edges_alternate_and_their_cycles_strictly_increase(scene in rough(), seed: u64) {
        let edges = edges(&scene, seed, 2_000);
        prop_assert!(edges[0].level);
        for pair in edges.windows(2) {
            prop_assert!(pair[0].cycle < pair[1].cycle);
            prop_assert!(pair[0].level != pair[1].level);
        }
    }

    #[test]
    fn the_same_seed_makes_the_same_light_and_another_seed_another(scene in rough(), seed: u64) {
        let light = edges(&scene, seed, 500);
        prop_assert_eq!(&light, &edges(&scene, seed, 500));
        prop_assert_ne!(&light, &edges(&scene, seed.wrapping_add(1), 500));
    }

    #[test]
    fn a_log_changes_no_edge(scene in rough(), seed: u64) {
        let mut logged = World::new(&scene, seed);
        logged.keep_log();
        prop_assert_eq!(logged.edges().take(500).collect::<Vec<_>>(), edges(&scene, seed, 500));
    }

    #[test]
    fn a_cycle_comes_back_from_its_seconds(scene in rough(), seed: u64, t_s in 0.0..86_400.0f64) {
        let world = World::new(&scene, seed);
        let cycle = world.cycle(t_s);
        prop_assert!((world.seconds(cycle) - t_s).abs() * scene.clock.nominal_hz <= 1.0);
        prop_assert_eq!(world.cycle(world.seconds(cycle)), cycle);
    }
}

#[test]
fn a_world_that_meets_another_scene_goes_on_in_its_light_and_back() {
    let light = Scene { path: STILL, length_s: 4.0, ..Scene::default() }.without_noise();
    let occlusions = vec![Occlusion { from_s: 0.5, to_s: 1.0, hides: Hides::Everything }];
    let mut dark = light.clone();
    dark.station_a.occlusions = occlusions.clone();
    dark.station_b.occlusions = occlusions;
    let mut alone = World::new(&light, 1);
    let undisturbed = pulses(&mut alone, 3.9);
    let mut world = World::new(&light, 1);
    let mut met = pulses(&mut world, 1.0);
    world.meet(&dark.later(1.0));
    met.extend(pulses(&mut world, 3.0));
    world.meet(&light);
    met.extend(pulses(&mut world, 3.9));
    assert!(!met.iter().any(|(at_s, _)| (1.5..2.0).contains(at_s)));
    // A pulse of each meeting is spent on seeing that its time is over.
    let lit = |at_s: f64| !(1.5..2.0).contains(&at_s);
    let missing = undisturbed.iter().filter(|pulse| lit(pulse.0) && !met.contains(pulse)).count();
    assert!(missing <= 2, "{missing}");
    assert!(met.iter().all(|pulse| undisturbed.contains(pulse)));
}
