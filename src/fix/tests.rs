//! The integer solver against an f64 twin, over rooms of several shapes.

use super::{Calib, Reject, Solution, solve};
use crate::angle::Angle;
use nalgebra::{Matrix3, Vector3};

#[path = "../../calib/quantise.rs"]
mod quantise;

use quantise::{Room, Station, bake};

/// Half of 2^20: a right angle in angle units.
const RIGHT_ANGLE: f64 = 524_288.0;

/// xorshift64*: seeded, so that every figure here repeats.
struct Dice(u64);

impl Dice {
    fn unit(&mut self) -> f64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 11) as f64 / (1u64 << 53) as f64
    }

    fn gauss(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.unit()).ln()).sqrt();
        radius * (core::f64::consts::TAU * self.unit()).cos()
    }
}

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

struct Case {
    name: &'static str,
    room: Room,
}

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
    let case = |name, stations, min, max| Case { name, room: Room { stations, min, max } };
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
        case("crazyflie", crazyflie, [-1.5, -1.5, 0.0], [1.5, 1.5, 2.0]),
    ]
}

/// What was measured over a room, millimetres.
#[derive(Debug, Default)]
struct Score {
    rms: f64,
    max: f64,
    mean: [f64; 3],
    /// Mean distance to the two stations, metres.
    range: f64,
    fixes: u32,
    rejects: [u32; 3],
}

fn score(case: &Case, calib: &Calib, noise_deg: f64) -> Score {
    let mut dice = Dice(0x1234_5678_9abc_def1);
    let mut score = Score::default();
    let room = &case.room;
    while score.fixes + score.rejects.iter().sum::<u32>() < 10_000 {
        let point = Vector3::from_fn(|i, _| room.min[i] + (room.max[i] - room.min[i]) * dice.unit());
        let Some(angles) = angles_of(room, point) else {
            continue;
        };
        let angles = angles.map(|a| Angle((a + noise_deg / 90.0 * RIGHT_ANGLE * dice.gauss()).round() as i32));
        match solve(calib, &angles) {
            Ok(Solution { position: found, .. }) => {
                let found = Vector3::from(found.map(|x| f64::from(x) / 65536.0));
                let error = (found - twin(room, &angles)) * 1e3;
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

/// The solver's numbers, carried from the bake's copy of the layout to the library's.
fn calib_of(room: &Room) -> Calib {
    let quantise::layout::Calib::General(g) = bake(room).expect("a room that can be served").calib;
    Calib::General(super::General {
        rotation: g.rotation,
        baseline: g.baseline,
        world: g.world,
        origin: g.origin,
        gate: g.gate,
        parallax: g.parallax,
    })
}

#[test]
fn every_room_agrees_with_least_squares_in_f64() {
    for case in cases() {
        let calib = calib_of(&case.room);
        for noise in [0.0, 0.2] {
            let s = score(&case, &calib, noise);
            println!(
                "{:20} noise {noise}: rms {:.4} max {:.3} mean {:.4} {:.4} {:.4} range {:.2} rejects {:?}",
                case.name, s.rms, s.max, s.mean[0], s.mean[1], s.mean[2], s.range, s.rejects
            );
            assert!(s.rms < 0.1 * s.range / 1.6);
        }
    }
}

#[test]
fn a_mirror_of_the_light_is_turned_away() {
    let case = &cases()[0];
    let calib = calib_of(&case.room);
    let angles = angles_of(&case.room, Vector3::new(0.5, 1.0, 0.5)).expect("a point ahead");
    let mut angles = angles.map(|a| Angle(a as i32));
    assert!(solve(&calib, &angles).is_ok());
    angles[3].0 += 60_000;
    assert_eq!(solve(&calib, &angles), Err(Reject::Mismatch));
    angles[0].0 = 400_000;
    assert_eq!(solve(&calib, &angles), Err(Reject::FieldOfView));
}
