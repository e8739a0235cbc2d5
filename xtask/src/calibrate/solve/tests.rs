use nalgebra::{Rotation3, UnitQuaternion, Vector3};

use super::rooms::{Kind, Simulated, simulate};
use super::*;
use crate::light::{Light, LightConfig};
use crate::recording::Recording;
use crate::recording::tests::shared_recording;

/// Fewer instants and no outliers: quick, where they are not the matter.
const QUICK: Kind = Kind { noise: 0.001, outliers: 0.0, instants: 150, factory: [0.0; 2] };

fn solved(room: &Simulated, options: &Options) -> Result<Solution, Trouble> {
    solve(&room.sightings, &room.truth, options, &mut |_, _| {})
}

fn ideal_rotors() -> Options {
    Options { seed: 1, fit_factory: Choice::Never, ..Options::default() }
}

/// Rotation, degrees, and place, centimetres, that a station is off.
fn errors(found: &Station, is: &Station) -> (f64, f64) {
    let turned = Rotation3::from_matrix_unchecked(found.rotation * is.rotation.transpose()).angle();
    (turned.to_degrees(), 100.0 * (found.position - is.position).norm())
}

/// How far off the angles of the room's places are with the stations that were found, degrees RMS.
fn angles_off(found: &Station, is: &Station, truth: &[TruthSample]) -> f64 {
    let (found, is) = (Fitted::of(found), Fitted::of(is));
    let angle = |station: &Fitted, p: &TruthSample, axis| {
        station.predict(axis, station.see(p.position.into())).map_or(f64::NAN, |predicted| predicted.angle)
    };
    let squares =
        truth.iter().map(|p| (0..2).map(|axis| (angle(&found, p, axis) - angle(&is, p, axis)).powi(2)).sum::<f64>());
    (squares.sum::<f64>() / truth.len() as f64).sqrt().to_degrees()
}

#[test]
fn twenty_rooms_come_out_as_the_thousand_of_the_table_do() {
    let mut all = Vec::new();
    for seed in 0..20 {
        let room = simulate(&Kind::ORACLE, seed);
        let solution = solved(&room, &ideal_rotors()).unwrap();
        for (found, is) in solution.stations.iter().zip(&room.stations) {
            let (turned, moved) = errors(found, is);
            all.push([turned, moved, angles_off(found, is, &room.truth)]);
        }
    }
    let quantile = |k: usize, part: f64| {
        let mut values: Vec<f64> = all.iter().map(|row| row[k]).collect();
        crate::quantile::quantile(&mut values, part)
    };
    // docs/calibration-oracle.md: medians 0.25 deg, 1.3 cm, 0.025 deg; 95 % within 0.9 deg, 6.2 cm, 0.037 deg. A
    // median of 40 scatters by a fifth, a 95th percentile by a third.
    assert!(quantile(0, 0.5) < 0.25 * 1.6 && quantile(0, 0.95) < 0.9 * 1.7, "{all:?}");
    assert!(quantile(1, 0.5) < 1.3 * 1.6 && quantile(1, 0.95) < 6.2 * 1.7, "{all:?}");
    assert!(quantile(2, 0.5) < 0.025 * 1.4 && quantile(2, 0.95) < 0.037 * 1.4, "{all:?}");
}

#[test]
fn the_same_seed_gives_the_same_room() {
    let room = simulate(&QUICK, 3);
    let [one, other] = [1, 1].map(|_| solved(&room, &ideal_rotors()).unwrap());
    assert_eq!(one.stations[0].position, other.stations[0].position);
    assert_eq!(one.residuals, other.residuals);
}

#[test]
fn clocks_that_differ_are_brought_together_to_a_millisecond() {
    let kind = Kind { outliers: 0.05, instants: 600, ..QUICK };
    for (seed, shift) in [(1, 4.3217), (2, -3.0081)] {
        let mut room = simulate(&kind, seed);
        for sample in &mut room.truth {
            sample.at_s += shift;
        }
        // Motion capture that lost the mote for a while.
        room.truth.retain(|sample| !(10.0..11.5).contains(&(sample.at_s - shift)));
        let options = Options { offset_search_s: Some((-5.0, 5.0)), ..ideal_rotors() };
        let solution = solved(&room, &options).unwrap();
        assert!((solution.offset_s - shift).abs() < 0.001, "{} instead of {shift}", solution.offset_s);
        let across = |r: &&Residual| (10.1..11.4).contains(&r.at_s);
        assert_eq!(solution.residuals.iter().filter(across).count(), 0, "no truth is made up in its gaps");
    }
}

#[test]
fn truth_that_comes_late_on_the_mote_s_own_clock_is_noticed() {
    let kind = Kind { instants: 400, ..QUICK };
    for (seed, late_s) in [(1, 0.0145), (2, 0.0)] {
        let mut room = simulate(&kind, seed);
        for sample in &mut room.truth {
            sample.at_s += late_s;
        }
        let solution = solved(&room, &Options { late: true, ..ideal_rotors() }).unwrap();
        assert!((solution.offset_s - late_s).abs() < 0.0005, "{} instead of {late_s}", solution.offset_s);
        let said = solution.evidence.iter().any(|said| said.contains("ms late"));
        assert_eq!(said, late_s > 0.0, "{:?}", solution.evidence);
    }
}

#[test]
fn truth_whose_clock_drifts_against_the_rotors_is_noticed() {
    let kind = Kind { instants: 900, ..QUICK };
    for (seed, drift) in [(1, -425e-6), (2, 425e-6), (3, 0.0)] {
        let mut room = simulate(&kind, seed);
        let middle_s = 0.5 * room.truth.last().map_or(0.0, |last| last.at_s);
        for sample in &mut room.truth {
            sample.at_s += 0.003 + drift * (sample.at_s - middle_s);
        }
        let solution = solved(&room, &Options { late: true, ..ideal_rotors() }).unwrap();
        assert!((solution.middle_s - middle_s).abs() < 0.1, "{} s", solution.middle_s);
        assert!((solution.offset_s - 0.003).abs() < 0.0005, "{} s", solution.offset_s);
        assert_eq!(solution.drift.is_some(), drift != 0.0, "{:?}", solution.evidence);
        // 1 mrad is 7 ms of a hand that passes at 0.15 rad/s; of 3,600 sweeps over 30 s that leaves 13 ppm: four of those.
        assert!((solution.drift.unwrap_or(0.0) - drift).abs() < 52e-6, "{:?} instead of {drift}", solution.drift);
    }
}

#[test]
fn a_truth_that_is_much_too_late_is_no_truth() {
    let mut room = simulate(&Kind { instants: 400, ..QUICK }, 1);
    for sample in &mut room.truth {
        sample.at_s += 0.3;
    }
    let trouble = solved(&room, &Options { late: true, ..ideal_rotors() }).unwrap_err();
    assert!(matches!(trouble, Trouble::TooLate { .. } | Trouble::Unexplained { .. }), "{trouble}");
}

#[test]
fn an_offset_beyond_the_search_is_said_to_be_there() {
    let mut room = simulate(&Kind { instants: 600, ..QUICK }, 1);
    for sample in &mut room.truth {
        sample.at_s += 1.4;
    }
    let options = Options { offset_search_s: Some((-1.0, 1.0)), ..ideal_rotors() };
    let trouble = solved(&room, &options).unwrap_err();
    let Trouble::OffsetAtEdge { offset_s, searched } = trouble else { panic!("{trouble}") };
    assert!((offset_s - 1.4).abs() < 0.1 && searched == (-1.0, 1.0), "{trouble}");
    assert!(trouble.to_string().contains("search further"), "{trouble}");
}

#[test]
fn a_mote_that_creeps_leaves_the_offset_open() {
    let mut room = simulate(&Kind { noise: 0.005, instants: 100, ..QUICK }, 1);
    // A twentieth of the pace, and sighted as seldom.
    for sample in &mut room.truth {
        sample.at_s *= 20.0;
    }
    let ends: Vec<TruthSample> = room.truth.clone();
    room.truth = ends
        .windows(2)
        .flat_map(|pair| {
            let (a, b) = (pair[0], pair[1]);
            (0..10).map(move |k| f64::from(k) / 10.0).map(move |part| TruthSample {
                at_s: a.at_s + part * (b.at_s - a.at_s),
                position: a.position + part * (b.position - a.position),
            })
        })
        .collect();
    for sighting in &mut room.sightings {
        sighting.at_s *= 20.0;
    }
    let options = Options { offset_search_s: Some((-2.0, 2.0)), ..ideal_rotors() };
    let trouble = solved(&room, &options).map(|solution| solution.evidence).unwrap_err();
    assert!(matches!(trouble, Trouble::OffsetUnknown { .. }), "{trouble}");
    assert!(trouble.to_string().contains("only known to"), "{trouble}");
}

#[test]
fn a_mote_at_rest_does_not_tell_the_clocks_apart() {
    let mut room = simulate(&QUICK, 1);
    let options = Options { offset_search_s: Some((-5.0, 5.0)), ..ideal_rotors() };
    let (first, last) = (room.truth[0].position, room.truth[60].position);
    for (k, sample) in room.truth.iter_mut().enumerate() {
        sample.position = if k < 75 { first } else { last };
        sample.at_s += if k < 75 { 0.0 } else { 60.0 };
    }
    let trouble = solved(&room, &options).unwrap_err();
    assert!(matches!(trouble, Trouble::AtRest { .. }), "{trouble}");
    assert!(trouble.to_string().contains("hardly moved"));
}

#[test]
fn phases_are_fitted_where_there_are_some() {
    let kind = Kind { noise: 0.002, instants: 600, factory: [0.04, 0.0], ..QUICK };
    let mut fitted = 0;
    for seed in 0..3 {
        let room = simulate(&kind, seed);
        let solution = solved(&room, &Options::default()).unwrap();
        assert!(solution.evidence[0].starts_with("Rotor phases"), "{:?}", solution.evidence);
        if solution.evidence[0].contains("are fitted") {
            fitted += 1;
        }
        for (found, is) in solution.stations.iter().zip(&room.stations) {
            assert!(angles_off(found, is, &room.truth) < 0.1);
        }
    }
    assert!(fitted >= 2, "{fitted} of 3 rooms");
}

#[test]
fn ideal_rotors_are_left_alone() {
    let solution = solved(&simulate(&QUICK, 5), &Options::default()).unwrap();
    assert!(solution.evidence[0].contains("are left alone"), "{:?}", solution.evidence);
    assert_eq!(solution.stations[0].factory, [Rotor::default(); 2]);
}

#[test]
fn one_station_s_given_factory_terms_are_kept_and_the_other_s_fitted() {
    let kind = Kind { noise: 0.002, instants: 600, factory: [0.04, 0.0], ..QUICK };
    for known in 0..2 {
        let room = simulate(&kind, 6);
        let mut factory = [None; 2];
        factory[known] = Some(room.stations[known].factory);
        let options = Options { factory, fit_factory: Choice::Always, ..Options::default() };
        let solution = solved(&room, &options).unwrap();
        let phase = |station: usize| solution.stations[station].factory[0].phase;
        let is = |station: usize| room.stations[station].factory[0].phase;
        assert!((phase(known) - is(known)).abs() < 1e-12);
        assert!(phase(1 - known) != 0.0 && solution.stations[1 - known].factory[1].phase != 0.0);
        for (found, is) in solution.stations.iter().zip(&room.stations) {
            assert!(angles_off(found, is, &room.truth) < 0.1);
        }
    }
}

#[test]
fn given_factory_terms_are_kept() {
    let room = simulate(&Kind { factory: [0.04, 0.004], ..QUICK }, 6);
    let factory = room.stations.each_ref().map(|station| station.factory);
    let solution = solved(&room, &Options { factory: factory.map(Some), ..Options::default() }).unwrap();
    for (found, is) in solution.stations.iter().zip(&room.stations) {
        assert!((found.factory[0].phase - is.factory[0].phase).abs() < 1e-12);
        assert!(angles_off(found, is, &room.truth) < 0.03);
    }
}

#[test]
fn a_photodiode_beside_the_marker_is_found_where_the_body_turns() {
    let mut room = simulate(&Kind { instants: 400, ..QUICK }, 7);
    let lever = Vector3::new(0.03, -0.01, 0.02);
    let turned = |t: f64| UnitQuaternion::from_euler_angles((0.9 * t).sin(), 0.8 * (0.7 * t).cos(), t);
    let attitudes: Vec<Attitude> =
        room.truth.iter().map(|s| Attitude { at_s: s.at_s, rotation: turned(s.at_s) }).collect();
    for (sample, attitude) in room.truth.iter_mut().zip(&attitudes) {
        sample.position -= attitude.rotation * lever;
    }
    let solution = solved(&room, &Options { attitudes, ..ideal_rotors() }).unwrap();
    let found = solution.lever_arm.expect("it was fitted");
    assert!((found - lever).norm() < 0.003, "{found}");
    let blind = solved(&room, &ideal_rotors()).unwrap();
    assert!(blind.lever_arm.is_none() && blind.evidence.iter().any(|said| said.contains("does not say how the body")));
}

#[test]
fn a_flat_cloud_is_refused_and_a_thick_one_is_not_wrong() {
    // Standard deviation above the plane, as a share of the longest.
    for share in [0.0, 0.015, 0.05] {
        flat_cloud(share);
    }
}

fn flat_cloud(share: f64) {
    let (mut good, mut refused) = (0, 0);
    for seed in 0..6 {
        let mut room = simulate(&QUICK, seed);
        let height = room.truth[0].position.z;
        let stations = room.stations.each_ref().map(Fitted::of);
        let rise = share * longest(&room.truth) * 2f64.sqrt();
        for (k, sample) in room.truth.iter_mut().enumerate() {
            sample.position.z = height + rise * (0.37 * k as f64).sin();
        }
        for (k, sighting) in room.sightings.iter_mut().enumerate() {
            let station = &stations[sighting.station];
            let c = station.see(room.truth[k / 4].position.into());
            let jitter = 0.001 * ((k * k) as f64).sin();
            sighting.angle = station.predict(sighting.axis, c).unwrap().angle + jitter;
        }
        match solved(&room, &ideal_rotors()) {
            Ok(solution) => {
                for (found, is) in solution.stations.iter().zip(&room.stations) {
                    let distance = (is.position - room.truth[0].position).norm();
                    let (_, moved) = errors(found, is);
                    assert!(moved < 20.0 * distance, "room {seed}: {moved} cm at {distance} m");
                }
                good += 1;
            }
            Err(Trouble::Coplanar { .. }) if share < 0.02 => refused += 1,
            Err(Trouble::Unsteady { .. }) if share > 0.02 => refused += 1,
            Err(other) => panic!("{share}: {other}"),
        }
    }
    assert!(if share < 0.02 { refused == 6 } else { good >= 3 }, "{share}: {good} solved, {refused} refused");
}

/// Standard deviation of the places along the longer of x and y, metres.
fn longest(truth: &[TruthSample]) -> f64 {
    let spread = |axis: usize| {
        let mean = truth.iter().map(|sample| sample.position[axis]).sum::<f64>() / truth.len() as f64;
        (truth.iter().map(|sample| (sample.position[axis] - mean).powi(2)).sum::<f64>() / truth.len() as f64).sqrt()
    };
    spread(0).max(spread(1))
}

/// What a damaged room is refused for.
fn trouble(damage: impl Fn(&mut Simulated)) -> Trouble {
    let mut room = simulate(&Kind { instants: 600, ..QUICK }, 11);
    damage(&mut room);
    solved(&room, &ideal_rotors()).map(|solution| solution.held_out).expect_err("this room is damaged")
}

#[test]
fn numbers_that_are_none_are_named() {
    let said = trouble(|room| room.sightings[7].angle = f64::NAN);
    assert!(said.to_string().starts_with("sighting 7"), "{said}");
    let said = trouble(|room| room.truth[3].position.y = f64::INFINITY);
    assert!(said.to_string().starts_with("truth sample 3"), "{said}");
}

#[test]
fn a_station_never_seen_is_named() {
    let said = trouble(|room| room.sightings.retain(|s| s.station == 0));
    assert_eq!(said, Trouble::NeverSeen { station: 1, axis: 0 });
    assert!(said.to_string().contains("station B's azimuth"), "{said}");
    assert_eq!(trouble(|room| room.sightings.clear()), Trouble::NeverSeen { station: 0, axis: 0 });
}

#[test]
fn too_few_sightings_and_truth_of_another_time_are_named() {
    let said = trouble(|room| room.sightings.truncate(20));
    assert_eq!(said, Trouble::TooFew { station: 0, axis: 0, seen: 5, paired: 5, needed: 12 });
    let said = trouble(|room| room.truth.iter_mut().for_each(|sample| sample.at_s += 1000.0));
    assert_eq!(said, Trouble::TooFew { station: 0, axis: 0, seen: 600, paired: 0, needed: 12 });
    let said = trouble(|room| room.truth.clear());
    assert!(matches!(said, Trouble::TooFew { paired: 0, .. } | Trouble::TooSmall { .. }), "{said}");
}

#[test]
fn millimetres_are_not_taken_for_metres() {
    let said = trouble(|room| room.truth.iter_mut().for_each(|sample| sample.position *= 1000.0));
    assert!(said.to_string().contains("millimetres"), "{said}");
    let said = trouble(|room| room.truth.iter_mut().for_each(|sample| sample.position *= 10.0));
    assert!(matches!(said, Trouble::TooFar { .. } | Trouble::Units { .. }), "{said}");
    let said = trouble(|room| room.truth.iter_mut().for_each(|sample| sample.position *= 0.001));
    assert!(matches!(said, Trouble::TooSmall { .. }), "{said}");
}

#[test]
fn a_line_is_not_enough() {
    let said = trouble(|room| {
        let stations = room.stations.each_ref().map(Fitted::of);
        let middle = room.truth[0].position;
        for sample in &mut room.truth {
            sample.position = middle + Vector3::new(0.3, 0.2, -0.1) * (0.7 * sample.at_s).sin();
        }
        for (k, sighting) in room.sightings.iter_mut().enumerate() {
            let station = &stations[sighting.station];
            sighting.angle =
                station.predict(sighting.axis, station.see(room.truth[k / 4].position.into())).unwrap().angle;
        }
    });
    assert!(matches!(said, Trouble::Collinear { .. }), "{said}");
}

#[test]
fn a_mirrored_truth_is_named() {
    for seed in [11, 12] {
        let mut room = simulate(&Kind { instants: 600, ..QUICK }, seed);
        for sample in &mut room.truth {
            sample.position.swap_rows(0, 1);
        }
        let said = solved(&room, &ideal_rotors()).map(|_| ()).unwrap_err();
        assert!(matches!(said, Trouble::Mirrored { .. }), "room {seed}: {said}");
    }
}

#[test]
fn truth_of_another_take_is_named() {
    let other = simulate(&Kind { instants: 600, ..QUICK }, 21);
    let said = trouble(|room| {
        let by = room.truth[0].position - other.truth[0].position;
        for (sample, other) in room.truth.iter_mut().zip(&other.truth) {
            sample.position = other.position + by;
        }
    });
    assert!(matches!(said, Trouble::Unexplained { .. }), "{said}");
    assert!(said.to_string().contains("another take"), "{said}");
}

#[test]
fn a_short_walk_is_not_found_somewhere_in_a_minute_of_another_take() {
    let walk = |instants| Kind { noise: 0.003, outliers: 0.03, instants, ..QUICK };
    // 5 and 12 seconds.
    for (instants, seed) in [(150, 0), (360, 0), (360, 1), (360, 2)] {
        let room = simulate(&walk(instants), seed);
        let mut other = simulate(&walk(1800), seed + 100).truth;
        let by = room.truth[0].position - other[900].position;
        for sample in &mut other {
            sample.position += by;
        }
        let options = Options { offset_search_s: Some((-5.0, 50.0)), ..Options::default() };
        let said = solve(&room.sightings, &other, &options, &mut |_, _| {}).map(|solution| solution.held_out);
        match said {
            // Of the longer walks a part may lie beyond the truth's end.
            Err(Trouble::TooShort { length_s, .. }) => assert!(length_s < 10.0),
            Err(Trouble::Unexplained { .. } | Trouble::Mirrored { .. }) => assert_eq!(instants, 360),
            other => panic!("{instants} instants of take {seed}: {other:?}"),
        }
    }
}

#[test]
fn room_656_was_once_wrong_and_believed() {
    // The first draw misses station A's valley, and what it finds instead explains half of its sightings.
    let room = simulate(&Kind::ORACLE, 656);
    let solution = solved(&room, &Options { seed: 656, ..ideal_rotors() }).unwrap();
    for (found, is) in solution.stations.iter().zip(&room.stations) {
        assert!(errors(found, is).1 < 6.2, "{:?}", errors(found, is));
    }
}

#[test]
fn stations_that_changed_places_are_named() {
    let room = simulate(&QUICK, 11);
    let [a, b] = room.stations.each_ref().map(|station| station.position);
    let near = Vector3::new(0.05, 0.0, -0.05);
    assert!(solved(&room, &Options { before: Some([a + near, b - near]), ..ideal_rotors() }).is_ok());
    let said = solved(&room, &Options { before: Some([b + near, a - near]), ..ideal_rotors() }).unwrap_err();
    assert!(matches!(said, Trouble::Swapped { .. }), "{said}");
}

/// The window of a recording that is for fitting, as the solver wants it; truth `shift` seconds later.
fn window(recording: &Recording, shift: f64) -> (Vec<Sighting>, Vec<TruthSample>) {
    let light = Light::rebuild(recording, &LightConfig::of(recording)).unwrap();
    let (mut sightings, mut truth) = (Vec::new(), Vec::new());
    for (row, played) in recording.rows.iter().zip(&light.rows) {
        if !recording.calibrate.contains(&row.timestamp) {
            continue;
        }
        if row.truth_ok {
            let at_s = light.seconds(played.cycle) + shift;
            truth.push(TruthSample { at_s, position: row.truth.into() });
        }
        if let (Ok(laser), false) = (played.laser, played.repeat) {
            let angle = (f64::from(row.sync_to_sweep) / played.half_turn - 0.5) * std::f64::consts::PI;
            let (station, axis) = (row.kind.station as usize, row.kind.axis as usize);
            sightings.push(Sighting { at_s: light.seconds(laser), station, axis, angle });
        }
    }
    (sightings, truth)
}

#[test]
fn the_paper_s_recording_is_solved_with_phases_and_its_clock_found() {
    let Some(recording) = shared_recording("scum-take5") else {
        return;
    };
    let (sightings, truth) = window(&recording, 0.0);
    let solution = solve(&sightings, &truth, &Options::default(), &mut |_, _| {}).unwrap();
    assert!(solution.evidence[0].contains("Rotor phases are fitted"), "{:?}", solution.evidence);
    let phases = solution.stations.each_ref().map(|station| station.factory.map(|rotor| rotor.phase));
    // The hand-refitted file's.
    for (found, known) in phases.as_flattened().iter().zip([0.047, 0.056, 0.015, 0.021]) {
        assert!((found - known).abs() < 0.006, "{phases:?}");
    }
    assert!(solution.held_out.mean_3d_m < 0.0040, "{:?}", solution.held_out);

    let searched = Options { offset_search_s: Some((-20.0, 20.0)), ..Options::default() };
    let found = [0.0, 4.567].map(|shift| {
        let (sightings, truth) = window(&recording, shift);
        solve(&sightings, &truth, &searched, &mut |_, _| {}).unwrap().offset_s - shift
    });
    assert!((found[0] - found[1]).abs() < 0.001, "{found:?}");
}

#[test]
fn a_flight_with_given_factory_terms_is_solved() {
    let Some(recording) = shared_recording("crazyflie-lh1-flight") else {
        return;
    };
    let recording = recording.sensor(0).unwrap();
    let factory = crate::reference::Room::open(&recording.stations).unwrap().stations.map(|station| station.factory);
    let (sightings, truth) = window(&recording, 0.0);
    let solution =
        solve(&sightings, &truth, &Options { factory: factory.map(Some), ..Options::default() }, &mut |_, _| {});
    let solution = solution.unwrap();
    assert!(solution.held_out.mean_3d_m < 0.0085, "{:?}", solution.held_out);
}

#[test]
fn the_flight_s_truth_is_late_and_its_rotors_have_every_term() {
    let Some(recording) = shared_recording("crazyflie-lh1-flight") else {
        return;
    };
    let recording = recording.sensor(0).unwrap();
    let (sightings, truth) = window(&recording, 0.0);
    let solution = solve(&sightings, &truth, &Options { late: true, ..Options::default() }, &mut |_, _| {}).unwrap();
    // Any of the four photodiodes says 14.0 to 14.7 ms, with or without the factory's terms.
    assert!((0.0135..0.0155).contains(&solution.offset_s), "{}", solution.offset_s);
    assert!(solution.stations.iter().flat_map(|station| &station.factory).all(|rotor| rotor.gibmag > 0.0));
    // 0.3 mrad at 4 m, two stations.
    assert!(solution.held_out.mean_3d_m < 0.0022, "{:?}", solution.held_out);
}
