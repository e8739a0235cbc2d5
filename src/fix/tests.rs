//! The integer solver against an f64 twin, over rooms of several shapes.

use super::{Calib, Reject, Solution, solve};
use crate::angle::Angle;
use crate::fix as solver;
use nalgebra::{Matrix3, Vector3};
use proptest::prelude::*;
use std::sync::LazyLock;

#[path = "../../calib/quantise.rs"]
mod quantise;

use quantise::{Baked, Dice, GENERAL_SLACK, Room, Station, bake};

/// Half of 2^20: a right angle in angle units.
const RIGHT_ANGLE: f64 = 524_288.0;

fn rotation(station: &Station) -> Matrix3<f64> {
    Matrix3::from_fn(|i, j| station.rotation[i][j])
}

fn position(station: &Station) -> Vector3<f64> {
    Vector3::from(station.position)
}

/// The true angles of `point`, in angle units.
fn angles_of(room: &Room, point: Vector3<f64>) -> Option<[f64; 4]> {
    let mut angles = [0.0; 4];
    for (station, pair) in room.stations.iter().zip(angles.chunks_mut(2)) {
        let c = rotation(station) * (point - position(station));
        if c.z <= 0.0 {
            return None;
        }
        pair[0] = (c.x / c.z).atan();
        pair[1] = (c.y / c.z).atan();
    }
    let units = angles.map(|a| a * RIGHT_ANGLE / core::f64::consts::FRAC_PI_2);
    units.iter().all(|a| a.abs() < RIGHT_ANGLE * 2.0 / 3.0).then_some(units)
}

/// The inhomogeneous least-squares DLT in f64: rows x p3 - p1 and y p3 - p2 of both stations.
fn twin(room: &Room, angles: &[Angle; 4]) -> Vector3<f64> {
    let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
    for (station, pair) in room.stations.iter().zip(angles.chunks(2)) {
        let r = rotation(station);
        for (axis, angle) in pair.iter().enumerate() {
            let image = (f64::from(angle.0) * core::f64::consts::FRAC_PI_2 / RIGHT_ANGLE).tan();
            let row = (image * r.row(2) - r.row(axis)).transpose();
            normal += row * row.transpose();
            right += row * row.dot(&position(station));
        }
    }
    normal.lu().solve(&right).expect("rays that cross")
}

/// World to station for a station looking along `forward`, its x axis turned by `roll` degrees from level.
fn looking(forward: [f64; 3], roll: f64) -> [[f64; 3]; 3] {
    let z = Vector3::from(forward).normalize();
    // Station x is right of forward as seen with the world's z up.
    let x = z.cross(&Vector3::z()).normalize();
    let y = x.cross(&z);
    // x right, y up, z forward is left-handed; a rotation matrix must be right-handed, so x points left here, as in
    // the measured rooms.
    let (sin, cos) = roll.to_radians().sin_cos();
    let (right, up) = (x * -1.0, y);
    let (a, b) = (right * cos + up * sin, up * cos - right * sin);
    [a.into(), b.into(), z.into()]
}

/// A room and what came out of baking it.
struct Case {
    name: &'static str,
    room: Room,
    baked: Baked,
}

static CASES: LazyLock<Vec<Case>> = LazyLock::new(cases);

fn cases() -> Vec<Case> {
    let take5 = [
        Station {
            rotation: [
                [-0.996768590, 0.080301131, 0.002026208],
                [0.080157929, 0.995992190, -0.039677005],
                [-0.005204195, -0.039386376, -0.999210503],
            ],
            position: [0.259609, 0.992558, 1.627112],
        },
        Station {
            rotation: [
                [-0.998495012, -0.049356295, -0.023909556],
                [-0.050814630, 0.996603172, 0.064807334],
                [0.020629689, 0.065924755, -0.997611318],
            ],
            position: [0.825604, 0.992643, 1.619665],
        },
    ];
    let crazyflie = [
        Station {
            rotation: [
                [-0.058020338, 0.998269796, 0.009545021],
                [0.597055733, 0.027035488, 0.801744103],
                [0.800098836, 0.052216370, -0.597591281],
            ],
            position: [-2.646225929, -0.281137258, 3.150382757],
        },
        Station {
            rotation: [
                [-0.998534918, -0.024164222, -0.048416343],
                [-0.052295059, 0.660823345, 0.748717368],
                [0.013902475, 0.750152409, -0.661118865],
            ],
            position: [0.410867780, -3.137694597, 3.176520348],
        },
    ];
    let station = |position, forward, roll| Station { rotation: looking(forward, roll), position };
    let case = |name, stations, min, max| {
        let room = Room { stations, min, max };
        let baked = bake(&room).expect("a room that can be served");
        Case { name, room, baked }
    };
    vec![
        case("take5, 2 x 2 x 2 m", take5, [-0.457, -0.007, -0.877], [1.543, 1.993, 1.123]),
        case("take5, by hand", take5, [0.0, 0.6, 0.3], [1.1, 1.5, 1.2]),
        case(
            "3 m corners",
            [station([-1.5, -1.5, 2.5], [1.0, 0.9, -1.0], 0.0), station([1.5, -1.5, 2.5], [-0.9, 1.0, -1.0], 0.0)],
            [-1.0, -1.0, 0.3],
            [1.0, 1.2, 1.8],
        ),
        case(
            "5 m wide",
            [station([-2.5, 0.0, 2.2], [0.7, 1.0, -0.4], 3.0), station([2.5, 0.0, 2.2], [-0.7, 1.0, -0.4], -2.0)],
            [-1.5, 1.5, 0.3],
            [1.5, 4.0, 1.8],
        ),
        case(
            "face to face",
            [station([-2.2, -2.2, 2.4], [1.0, 1.0, -0.8], 0.0), station([2.2, 2.2, 2.4], [-1.0, -1.0, -0.8], 0.0)],
            [-1.2, -1.2, 0.2],
            [1.2, 1.2, 1.5],
        ),
        case(
            "rolled 45 deg",
            [station([-1.0, 0.0, 1.5], [0.3, 1.0, -0.1], 0.0), station([1.0, 0.0, 1.5], [-0.3, 1.0, -0.1], 45.0)],
            [-1.0, 1.0, 0.5],
            [1.0, 2.5, 2.0],
        ),
        case(
            "across the baseline",
            [station([0.0, -3.0, 1.0], [0.0, 1.0, 0.0], 0.0), station([0.0, 3.0, 1.0], [0.0, -1.0, 0.0], 0.0)],
            [-1.2, -1.0, 0.0],
            [1.2, 1.0, 2.0],
        ),
        case("crazyflie", crazyflie, [-1.5, -1.5, 0.0], [1.5, 1.5, 2.0]),
    ]
}

/// Distance between the solver and its twin over a room, millimetres.
#[derive(Debug, Default)]
struct Score {
    rms: f64,
    max: f64,
    mean: [f64; 3],
    /// Mean distance from both stations, metres.
    range: f64,
    fixes: u32,
    rejects: [u32; 3],
}

fn random_point(room: &Room, dice: &mut Dice) -> Vector3<f64> {
    Vector3::from_fn(|i, _| room.min[i] + (room.max[i] - room.min[i]) * dice.unit())
}

fn metres(solution: &Solution) -> Vector3<f64> {
    Vector3::from(solution.position.map(|x| f64::from(x) / 65536.0))
}

fn score(case: &Case, noise_deg: f64, points: u32) -> Score {
    let mut dice = Dice(0x1234_5678_9abc_def1);
    let mut score = Score::default();
    let room = &case.room;
    while score.fixes + score.rejects.iter().sum::<u32>() < points {
        let point = random_point(room, &mut dice);
        let Some(angles) = angles_of(room, point) else {
            continue;
        };
        let noise = noise_deg / 90.0 * RIGHT_ANGLE;
        let angles = angles.map(|a| Angle((a + noise * dice.gauss()).round() as i32));
        match solve(&case.baked.calib, &angles) {
            Ok(solution) => {
                let error = (metres(&solution) - twin(room, &angles)) * 1e3;
                score.rms += error.norm_squared();
                score.max = score.max.max(error.norm());
                for i in 0..3 {
                    score.mean[i] += error[i];
                }
                let ranges = room.stations.iter().map(|s| (point - position(s)).norm());
                score.range += ranges.sum::<f64>() / 2.0;
                score.fixes += 1;
            }
            Err(reject) => score.rejects[reject as usize] += 1,
        }
    }
    let n = f64::from(score.fixes);
    score.rms = (score.rms / n).sqrt();
    score.mean = score.mean.map(|m| m / n);
    score.range /= n;
    score
}

/// 0.1 mm RMS, 0.6 mm at most and 10 um of bias per axis at the mean range of the paper, 1.6 m; in proportion to the
/// range elsewhere; four times that for the general form.
#[test]
fn every_room_agrees_with_least_squares_in_f64() {
    for case in CASES.iter() {
        let slack = case.baked.slack;
        // The general form is blind where the rays are close to parallel.
        let rejects = if slack > 1.0 { 500 } else { 10 };
        for noise in [0.0, 0.2] {
            let s = score(case, noise, 10_000);
            let name = case.name;
            println!(
                "{name:20} noise {noise}: rms {:.3} max {:.2} mean {:+.4} {:+.4} {:+.4} range {:.2} rejects {:?}",
                s.rms, s.max, s.mean[0], s.mean[1], s.mean[2], s.range, s.rejects
            );
            let scale = slack * s.range / 1.6;
            assert!(s.rms <= 0.1 * scale, "{name}: {} mm RMS", s.rms);
            assert!(s.max <= 0.6 * scale, "{name}: {} mm at most", s.max);
            assert!(s.mean.iter().all(|m| m.abs() <= 0.01 * scale), "{name}: bias {:?}", s.mean);
            assert!(s.rejects.iter().sum::<u32>() <= rejects, "{name}: rejects {:?}", s.rejects);
        }
    }
}

/// Two stations that somebody put up without much thought, around a volume that both look at.
fn any_room(seed: u64) -> Room {
    let mut dice = Dice(0x9e37_79b9_7f4a_7c15u64.wrapping_mul(seed + 1));
    // The first numbers of neighbouring seeds are alike.
    for _ in 0..8 {
        dice.unit();
    }
    let mut between = |least: f64, most: f64| least + (most - least) * dice.unit();
    let half = [between(0.25, 1.6), between(0.25, 1.6), between(0.2, 1.0)];
    let middle = [0.0, 0.0, between(0.6, 1.2)];
    let mut station = || {
        let (bearing, far) = (between(0.0, core::f64::consts::TAU), between(1.2, 4.5));
        let position = [far * bearing.cos(), far * bearing.sin(), between(1.0, 3.0)];
        let aim = [0, 1, 2].map(|i| middle[i] + half[i] * between(-0.3, 0.3) - position[i]);
        Station { rotation: looking(aim, between(-0.8, 0.8).to_degrees()), position }
    };
    let stations = [station(), station()];
    Room { stations, min: [0, 1, 2].map(|i| middle[i] - half[i]), max: [0, 1, 2].map(|i| middle[i] + half[i]) }
}

/// What is promised holds at points that neither the choice nor the bake's own verification knew, but for what another
/// sample of them may differ by: a tenth in the RMS, half in the largest of 4,000, and in the mean four of its
/// standard errors, RMS / sqrt(3 * 4,000) each.
#[test]
fn any_room_is_served_as_promised_or_refused_for_a_reason() {
    let (mut exact, mut loose, mut refused) = (0, 0, 0);
    for seed in 0..24 {
        let room = any_room(seed);
        match bake(&room) {
            Ok(baked) => {
                let slack = baked.slack;
                assert!(slack == 1.0 && matches!(baked.calib, Calib::Fast(_)) || slack == GENERAL_SLACK, "{slack}");
                if slack == 1.0 {
                    exact += 1
                } else {
                    loose += 1
                }
                let case = Case { name: "any", room, baked };
                for noise in [0.0, 0.2] {
                    let s = score(&case, noise, 4000);
                    let scale = slack * s.range / 1.6;
                    let (said, choice) = (case.baked.measured, &case.baked.choice);
                    assert!(said.keeps(slack, s.range * 1.02), "{seed}: {said:?} at {:.2} m, {choice}", s.range);
                    assert!(s.rms <= 1.1 * 0.1 * scale, "{seed}: {} mm RMS, {choice}", s.rms);
                    assert!(s.max <= 1.5 * 0.6 * scale, "{seed}: {} mm at most, {choice}", s.max);
                    let chance = 4.0 * s.rms / (3.0 * f64::from(s.fixes)).sqrt();
                    assert!(s.mean.iter().all(|m| m.abs() <= 0.01 * scale + chance), "{seed}: {:?}, {choice}", s.mean);
                    // A twentieth of the bake's own points may be blind.
                    let rejects: u32 = s.rejects.iter().sum();
                    assert!(rejects <= if slack == 1.0 { 8 } else { 250 }, "{seed}: {:?}, {choice}", s.rejects);
                }
            }
            Err(refusal) => {
                refused += 1;
                if refusal.reason.contains("inside the volume") {
                    continue;
                }
                // Four plans that divide by one row all over the volume, two by the larger, four by one row where it can.
                let each = ["fast: along", "general: along", "fast where it can: along"];
                let tried = each.map(|name| refusal.reason.matches(name).count());
                assert_eq!(tried, [4, 2, 4], "{seed}: {refusal}");
                for measured in &refusal.measured {
                    assert!(!measured.keeps(GENERAL_SLACK, refusal.number), "{seed}: {measured:?} would do: {refusal}");
                }
            }
        }
    }
    println!("{exact} exact, {loose} loose, {refused} refused");
    // Of 250 such rooms 152 are exact, 70 loose, 28 refused.
    assert!(exact >= 12 && loose >= 3 && refused <= 6, "{exact} exact, {loose} loose, {refused} refused");
}

/// Rooms in which no row has enough parallax everywhere, one has it nearly everywhere, and the other helps nobody.
#[test]
fn a_room_in_which_one_row_serves_nearly_all_of_the_volume_is_served() {
    for seed in [1089, 1115] {
        let baked = bake(&any_room(seed)).expect("a room that can be served");
        assert!(baked.choice.starts_with("fast where it can") && baked.slack == GENERAL_SLACK, "{}", baked.choice);
        assert!(matches!(baked.calib, Calib::Fast(_)));
    }
}

/// Rooms that the fast form holds at twice its error or so, and in which the other row serves nobody.
#[test]
fn a_room_that_the_fast_form_alone_can_hold_gets_it_though_it_is_off_by_more() {
    for seed in [1030, 1201] {
        let baked = bake(&any_room(seed)).expect("a room that can be served");
        assert!(matches!(baked.calib, Calib::Fast(_)) && baked.slack == GENERAL_SLACK, "{}", baked.choice);
        assert!(baked.choice.matches("too few points divide by the other row").count() == 2, "{}", baked.choice);
    }
}

#[test]
fn only_stations_that_look_at_each_other_across_the_volume_need_the_general_form() {
    for case in CASES.iter() {
        let general = matches!(case.baked.calib, Calib::General(_));
        assert_eq!(general, case.name == "across the baseline", "{}: {}", case.name, case.baked.choice);
    }
}

#[test]
fn a_point_outside_the_volume_is_right_or_turned_away() {
    for case in CASES.iter() {
        let mut dice = Dice(0x0ddb_1a5e_5bad_5eed);
        let (mut right, mut worst) = (0, 0.0f64);
        for _ in 0..300_000 {
            // Up to half as far again from each station as the farthest corner of the volume.
            let point =
                Vector3::from_fn(|i, _| (case.room.min[i] + case.room.max[i]) / 2.0 + 16.0 * (dice.unit() - 0.5));
            let far = |s: &Station| {
                let corner = |k: usize| Vector3::from_fn(|i, _| [case.room.min[i], case.room.max[i]][k >> i & 1]);
                let farthest = (0..8).map(|k| (corner(k) - position(s)).norm()).fold(0.0, f64::max);
                (point - position(s)).norm() > 1.5 * farthest
            };
            if case.room.stations.iter().any(far) {
                continue;
            }
            let Some(angles) = angles_of(&case.room, point) else {
                continue;
            };
            let angles = angles.map(|a| Angle(a.round() as i32));
            if let Ok(solution) = solve(&case.baked.calib, &angles) {
                right += 1;
                worst = worst.max((metres(&solution) - point).norm());
            }
        }
        println!("{}: {right} fixes, {:.1} mm at most", case.name, worst * 1e3);
        assert!(right > 0);
        assert!(worst < 0.02, "{}: {worst} m", case.name);
    }
}

#[test]
fn an_elevation_that_belongs_to_another_point_is_turned_away() {
    let case = &CASES[0];
    let solve = |angles: &[Angle; 4]| solve(&case.baked.calib, angles);
    let mut dice = Dice(7);
    let mut tried = 0;
    while tried < 1000 {
        let point = random_point(&case.room, &mut dice);
        let Some(angles) = angles_of(&case.room, point) else {
            continue;
        };
        let angles = angles.map(|a| Angle(a.round() as i32));
        if solve(&angles).is_err() {
            continue;
        }
        tried += 1;
        for wrong in [1, 3] {
            // 20 degrees up or down, whichever stays in view.
            let mut angles = angles;
            angles[wrong].0 -= angles[wrong].0.signum() * 116_508;
            assert!(matches!(solve(&angles), Err(Reject::Mismatch | Reject::Geometry)), "{point}");
        }
    }
}

#[test]
fn the_mismatch_is_how_far_the_rays_miss_each_other() {
    let case = &CASES[0];
    let angles = angles_of(&case.room, Vector3::new(0.5, 1.0, 0.3)).expect("a point ahead");
    let mut angles = angles.map(|a| Angle(a.round() as i32));
    let clean = solve(&case.baked.calib, &angles).expect("a clean fix");
    assert!(clean.mismatch.abs() < 4, "{} / 65536 m", clean.mismatch);
    // 1.3 m away, one degree of elevation is 23 mm.
    angles[3].0 += 5825;
    let raised = solve(&case.baked.calib, &angles).expect("a fix inside the gate");
    let millimetres = f64::from(raised.mismatch.abs()) / 65.536;
    assert!((20.0..27.0).contains(&millimetres), "{millimetres} mm");
}

#[test]
fn an_angle_beyond_sixty_degrees_is_turned_away() {
    for case in CASES.iter() {
        for k in 0..4 {
            for angle in [350_208, -350_208, i32::MAX, i32::MIN] {
                let mut angles = [Angle(0); 4];
                angles[k] = Angle(angle);
                assert_eq!(solve(&case.baked.calib, &angles), Err(Reject::FieldOfView));
            }
        }
    }
}

#[test]
fn rooms_that_cannot_be_served_are_refused_with_a_number() {
    let room = CASES[0].room;
    let refusal = |room: &Room| bake(room).expect_err("a refusal");

    let inside = Room { min: [-1.0; 3], max: [3.0; 3], ..room };
    assert!(refusal(&inside).reason.contains("inside the volume"));

    let mut sheared = room;
    sheared.stations[1].rotation[0][0] = 0.5;
    assert!(refusal(&sheared).reason.contains("orthogonal"));

    let empty = Room { min: room.max, max: room.min, ..room };
    assert!(refusal(&empty).number < 0.0);

    let behind = Room { min: [0.0, 0.0, 3.0], max: [1.0, 1.0, 5.0], ..room };
    assert!(refusal(&behind).reason.contains("seen by both"));

    // A corridor along the line between two stations: hardly any parallax.
    let across = &CASES.iter().find(|c| c.name == "across the baseline").expect("that room").room;
    let corridor = Room { min: [-0.2, -1.0, 0.8], max: [0.2, 1.0, 1.2], ..*across };
    let refusal = refusal(&corridor);
    assert!(refusal.reason.contains("parallel"), "{refusal}");
}

#[test]
fn what_is_emitted_names_the_library_and_every_number() {
    let emitted = CASES[0].baked.emit();
    assert!(emitted.contains("use lighthouse_mote::fix::{"));
    assert!(emitted.contains("Calib::Fast("));
    assert_eq!(emitted.matches("aside: [").count(), super::WEIGHTS);
}

proptest! {
    #[test]
    fn no_four_numbers_make_the_solver_panic(room in 0..8usize, a: i32, b: i32, c: i32, d: i32) {
        let _ = solve(&CASES[room].baked.calib, &[Angle(a), Angle(b), Angle(c), Angle(d)]);
    }

    #[test]
    fn no_four_angles_in_view_make_the_solver_panic(
        room in 0..8usize,
        angles in prop::array::uniform4(-349_525..=349_525i32),
    ) {
        let _ = solve(&CASES[room].baked.calib, &angles.map(Angle));
    }
}
