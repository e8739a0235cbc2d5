//! What double precision makes of the same sweeps, for a table to stand beside the mote's.
//!
//! Two methods: the paper's, as its authors ran it, and the plain one that the mote runs in
//! integers. Both are the direct linear transform, equations (6) to (8) of the paper: each angle's
//! tangent gives a row (x p3 - p1 or y p3 - p2) of a matrix that takes the place to zero, and the
//! place is the singular vector of the least singular value.
//!
//! The paper's method takes the newest angle of each kind whatever its age and turns ticks into
//! degrees at 10.0 MHz, which is also what its poses were fitted to. The plain method takes the
//! half turn from the light, adds the factory's corrections, believes angles within the 62 degrees
//! that a rotor's light reaches, and answers only while all four are at most 0.1 s old.
//!
//! # What can go wrong
//! Poses and scale belong together: the authors' poses with the true scale, or the other way
//! round, are wrong by several degrees.

use std::path::Path;

use anyhow::Result;
use nalgebra::{Matrix3, Matrix4, RowVector4, Vector3};

use crate::calib::schema::{self, Calibration, Rotor};
use crate::light::Light;
use crate::recording::{Axis, Recording, Row, Station};
use crate::score::{self, Late, Score};
use crate::svg::StationMark;

/// The authors' half turn in ticks: degrees = ticks * 180 / 83331.3, a timer at 10.0 MHz.
const PAPER_HALF_TURN: f64 = 83_331.3;

/// No truth is later, seconds: motion capture, network and radio take 10 to 30 ms.
const LATEST_S: f64 = 0.05;
/// How finely that is looked for, seconds: 0.3 mm at 0.6 m/s.
const LATE_STEP_S: f64 = 0.0005;
/// Sweeps that miss by more are all alike, radians: reflections.
const ASTRAY: f64 = 0.005;

/// Two stations with their poses and factory terms.
#[derive(Clone, Debug)]
pub struct Room {
    /// Station A, then B.
    pub stations: [Pose; 2],
}

/// Where a station is and how its rotors differ from ideal ones.
#[derive(Clone, Debug)]
pub struct Pose {
    /// World to station.
    pub rotation: Matrix3<f64>,
    /// Station in the world, metres.
    pub position: Vector3<f64>,
    /// Azimuth's terms, then elevation's.
    pub factory: [Rotor; 2],
}

/// The angle an ideal rotor would have measured; `other` is the tangent of the other axis.
///
/// The curve term is left off: it is tiny and its sign disputed.
pub(crate) fn ideal(rotor: &Rotor, measured: f64, other: f64) -> f64 {
    // The correction is a hundredth of a radian and depends on itself only as much again.
    (0..4).fold(measured + rotor.phase, |ideal, _| {
        let lean = (other * rotor.tilt.tan() * ideal.cos()).atan();
        measured + rotor.phase + lean - rotor.gibmag * (ideal + rotor.gibphase).sin()
    })
}

impl Room {
    /// Reads a recording's `stations.toml`, or another file of the same kind.
    pub fn open(path: &Path) -> Result<Self> {
        Ok(Self::of(&schema::open(path)?))
    }

    /// The room of a calibration.
    pub fn of(calibration: &Calibration) -> Self {
        Self {
            stations: calibration.stations.map(|station| Pose {
                rotation: Matrix3::from(station.rotation).transpose(),
                position: station.position.into(),
                factory: station.factory,
            }),
        }
    }

    /// The stations as the picture of a run shows them.
    pub fn marks(&self) -> Vec<StationMark> {
        let mark = |(name, pose): (&str, &Pose)| StationMark {
            name: name.into(),
            position: pose.position.into(),
            forward: pose.rotation.row(2).transpose().into(),
        };
        ["A", "B"].into_iter().zip(&self.stations).map(mark).collect()
    }
}

/// Which half turn a method divides by.
#[derive(Clone, Copy, Debug)]
enum Clock {
    Measured,
    Assumed(f64),
}

/// A place that a method found for a row.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placed {
    /// Metres.
    pub position: [f64; 3],
    /// When the newest of its four angles was seen, seconds of nominal mote time.
    pub newest_s: f64,
    /// Mean of the four times.
    pub middle_s: f64,
}

/// A way from rows to places.
#[derive(Clone, Debug)]
pub struct Method {
    room: Room,
    clock: Clock,
    oldest_s: f64,
    reach: f64,
}

impl Method {
    /// The paper's, with the authors' poses.
    pub fn paper(room: Room) -> Self {
        let clock = Clock::Assumed(PAPER_HALF_TURN);
        // The authors drop angles of 180 degrees and more, where the rotor no longer faces us.
        Self { room, clock, oldest_s: f64::INFINITY, reach: 90f64.to_radians() }
    }

    /// The mote's own, in double precision.
    pub fn plain(room: Room) -> Self {
        Self { room, clock: Clock::Measured, oldest_s: 0.1, reach: 62f64.to_radians() }
    }

    /// A place for each row, from it and the rows before; none where the method has none.
    pub fn places(&self, recording: &Recording, light: &Light) -> Vec<Option<Placed>> {
        let mut newest: [Option<(u64, f64, f64)>; 4] = [None; 4];
        let oldest = self.oldest_s * recording.clock_hz;
        let rows = recording.rows.iter().zip(&light.rows);
        rows.map(|(row, played)| {
            let measured = self.angle(row, played.half_turn);
            let phase = self.factory(row).phase;
            if (measured + phase).abs() > self.reach {
                return None;
            }
            let seen_s = light.seconds(played.laser.unwrap_or(played.cycle));
            newest[row.kind.index()] = Some((row.timestamp, seen_s, measured));
            let mut angles = [0.0; 4];
            let mut middle_s = 0.0;
            for (angle, newest) in angles.iter_mut().zip(newest) {
                let (time, at_s, measured) = newest?;
                if (row.timestamp - time) as f64 > oldest {
                    return None;
                }
                *angle = measured;
                middle_s += at_s / 4.0;
            }
            Some(Placed { position: self.place(angles)?, newest_s: seen_s, middle_s })
        })
        .collect()
    }

    /// The score of this method by the protocol of `score`, with the truth as written.
    pub fn score(&self, recording: &Recording, light: &Light) -> Score {
        self.held_against(recording, light, |row, _| row.truth)
    }

    /// The same rows and places, but each place is held against where the mote was when its newest angle was seen, with
    /// a truth that is late.
    pub fn score_late(&self, recording: &Recording, light: &Light, late: &Late) -> Score {
        let truth = score::recorded_truth(recording, light);
        self.held_against(recording, light, |row, placed| {
            score::place_at(&truth, late.after(placed.newest_s)).unwrap_or(row.truth)
        })
    }

    /// The same, but where the mote was midway through the place's four angles: what is left is the room's error and
    /// not the motion's.
    pub fn score_midway(&self, recording: &Recording, light: &Light, late: &Late) -> Score {
        let truth = score::recorded_truth(recording, light);
        self.held_against(recording, light, |row, placed| {
            score::place_at(&truth, late.after(placed.middle_s)).unwrap_or(row.truth)
        })
    }

    fn held_against(&self, recording: &Recording, light: &Light, truth: impl Fn(&Row, &Placed) -> [f64; 3]) -> Score {
        let places = self.places(recording, light);
        let scored: Vec<_> = recording.rows.iter().zip(places).filter(|r| recording.scored(r.0)).collect();
        let errors: Vec<[f64; 3]> = scored
            .iter()
            .filter_map(|(row, placed)| {
                let (placed, truth) = (placed.as_ref()?, truth(row, placed.as_ref()?));
                Some(std::array::from_fn(|axis| placed.position[axis] - truth[axis]))
            })
            .collect();
        Score::of_errors(scored.len(), &errors)
    }

    /// By how much later than `late` says the truth must be for the room to agree best with the sweeps that are scored,
    /// seconds; none without a sweep. A check and nothing else: what was found on scored rows must not be used to score
    /// them.
    pub fn later(&self, recording: &Recording, light: &Light, late: &Late) -> Option<f64> {
        let truth = score::recorded_truth(recording, light);
        let rows =
            recording.rows.iter().zip(&light.rows).filter(|(row, played)| recording.scored(row) && !played.repeat);
        let sweeps: Vec<(&Row, f64, f64)> = rows
            .filter_map(|(row, played)| {
                Some((row, light.seconds(played.laser.ok()?), self.angle(row, played.half_turn)))
            })
            .collect();
        let left = |later_s: f64| {
            let of = |&(row, at_s, measured): &(&Row, f64, f64)| {
                let place = Vector3::from(score::place_at(&truth, late.after(at_s) + later_s)?);
                let pose = &self.room.stations[row.kind.station as usize];
                let c = pose.rotation * (place - pose.position);
                let (own, other) = (c[row.kind.axis as usize], c[1 - row.kind.axis as usize]);
                let residual = ideal(&self.factory(row), measured, other / c.z) - own.atan2(c.z);
                Some(residual.abs().min(ASTRAY))
            };
            let (sum, count) = sweeps.iter().filter_map(of).fold((0.0, 0), |(sum, n), left| (sum + left, n + 1));
            sum / f64::from(count)
        };
        let steps = (LATEST_S / LATE_STEP_S).round() as i32;
        let tried = (-steps..=steps).map(|step| f64::from(step) * LATE_STEP_S);
        tried.min_by(|a, b| left(*a).total_cmp(&left(*b))).filter(|later_s| left(*later_s).is_finite())
    }

    fn factory(&self, row: &Row) -> Rotor {
        self.room.stations[row.kind.station as usize].factory[row.kind.axis as usize]
    }

    /// The angle as measured, radians from straight ahead.
    fn angle(&self, row: &Row, measured_half_turn: f64) -> f64 {
        let half_turn = match self.clock {
            Clock::Measured => measured_half_turn,
            Clock::Assumed(ticks) => ticks,
        };
        (f64::from(row.sync_to_sweep) / half_turn - 0.5) * std::f64::consts::PI
    }

    /// Where the four rays meet: A az, A el, B az, B el.
    fn place(&self, measured: [f64; 4]) -> Option<[f64; 3]> {
        let mut rows = [RowVector4::zeros(); 4];
        for station in [Station::A, Station::B] {
            let pose = &self.room.stations[station as usize];
            let translation = -(pose.rotation * pose.position);
            let p = |row: usize| {
                let r = pose.rotation.row(row);
                RowVector4::new(r[0], r[1], r[2], translation[row])
            };
            let at = 2 * station as usize;
            for axis in [Axis::Az, Axis::El] {
                let (own, other) = (axis as usize, 1 - axis as usize);
                let across = (measured[at + other] + pose.factory[other].phase).tan();
                let tangent = ideal(&pose.factory[own], measured[at + own], across).tan();
                rows[at + own] = p(2) * tangent - p(own);
            }
        }
        let svd = Matrix4::from_rows(&rows).svd(false, true);
        let least = svd.singular_values.imin();
        let v = svd.v_t?.row(least).into_owned();
        let place = [v[0] / v[3], v[1] / v[3], v[2] / v[3]];
        place.iter().all(|x| x.is_finite()).then_some(place)
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::light::LightConfig;
    use crate::recording::tests::shared_recording;
    use crate::score::tests::fix;

    /// A room as in the project's pictures: two stations that look at the origin from 2 m.
    fn room() -> Room {
        let pose = |x: f64| {
            let forward = Vector3::new(-x, 0.0, -2.0).normalize();
            let up = Vector3::y();
            let right = up.cross(&forward);
            let rotation = Matrix3::from_rows(&[right.transpose(), up.transpose(), forward.transpose()]);
            let factory =
                [0.02, -0.03].map(|phase| Rotor { phase, tilt: 0.004, curve: 0.0, gibphase: 0.7, gibmag: 0.01 });
            Pose { rotation, position: Vector3::new(x, 0.0, 2.0), factory }
        };
        Room { stations: [pose(-0.8), pose(0.7)] }
    }

    #[test]
    fn a_place_comes_back_from_the_angles_it_gives() {
        let method = Method::plain(room());
        let place = Vector3::new(0.3, -0.2, 0.4);
        let mut measured = [0.0; 4];
        for (s, pose) in method.room.stations.iter().enumerate() {
            let c = pose.rotation * (place - pose.position);
            let tangent = [c[0] / c[2], c[1] / c[2]];
            for axis in 0..2 {
                let (f, ideal) = (pose.factory[axis], tangent[axis].atan());
                measured[2 * s + axis] = ideal - f.phase - (tangent[1 - axis] * f.tilt.tan() * ideal.cos()).atan()
                    + f.gibmag * (ideal + f.gibphase).sin();
            }
        }
        let found = method.place(measured).unwrap();
        for axis in 0..3 {
            assert!((found[axis] - place[axis]).abs() < 5e-4, "{found:?}");
        }
    }

    #[test]
    fn a_room_that_is_not_one_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("stations.toml");
        let says = |text: &str, part: &str| {
            fs::write(&path, text).unwrap();
            let message = format!("{:#}", Room::open(&path).unwrap_err());
            assert!(message.contains("stations.toml") && message.contains(part), "{message}");
        };
        let good = "[station.A]\nrotation = [[1,0,0],[0,1,0],[0,0,1]]\nposition = [0,0,0]\n[station.B]\nrotation = [[1,0,0],[0,1,0],[0,0,1]]\nposition = [1,0,0]\n";
        fs::write(&path, good).unwrap();
        assert_eq!(Room::open(&path).unwrap().stations[1].position[0], 1.0);
        says(&good.replace("station.B", "station.C"), "station.C");
        says(&good.replace("position = [1,0,0]", "position = [1,0]"), ":6:");
        says(&good.replacen("[[1,0,0]", "[[2,0,0]", 1), "station.A.rotation");
        assert!(Room::open(&dir.path().join("gone.toml")).is_err());
    }

    #[test]
    fn both_methods_score_on_the_paper_s_recording_as_they_are_known_to() {
        let Some(recording) = shared_recording("scum-take5") else {
            return;
        };
        let light = Light::rebuild(&recording, &LightConfig::of(&recording)).unwrap();
        let near = |found: Score, mae: [f64; 3], p95: [f64; 3], rms: f64, coverage: f64| {
            println!("{found:?} {}", found.coverage());
            for axis in 0..3 {
                assert!((found.mae_cm[axis] - mae[axis]).abs() < 0.006);
                assert!((found.p95_cm[axis] - p95[axis]).abs() < 0.06);
            }
            assert!((found.rms3d_cm - rms).abs() < 0.06);
            assert!((found.coverage() - coverage).abs() < 0.01);
        };
        let authors = Room::open(&recording.dir.join("authors_poses.toml")).unwrap();
        let paper = Method::paper(authors).score(&recording, &light);
        near(paper, [0.68, 0.87, 2.12], [2.0, 2.1, 6.6], 9.4, 0.99);
        let plain = Method::plain(Room::open(&recording.stations).unwrap()).score(&recording, &light);
        near(plain, [0.47, 0.25, 0.91], [1.7, 0.8, 3.2], 1.9, 0.80);
    }

    #[test]
    fn fixes_reported_soon_after_their_sweeps_score_as_the_rows_do() {
        let Some(recording) = shared_recording("scum-take5") else {
            return;
        };
        let light = Light::rebuild(&recording, &LightConfig::of(&recording)).unwrap();
        let plain = Method::plain(Room::open(&recording.stations).unwrap());
        let report = |(placed, played): (Option<Placed>, &crate::light::PlayedRow)| {
            Some(fix(played.laser.ok()? + 20_000, placed?.position))
        };
        let places = plain.places(&recording, &light).into_iter();
        let fixes: Vec<_> = places.zip(&light.rows).filter_map(report).collect();
        let found = Score::of_recording(&recording, &light, &fixes);
        assert_eq!(found, plain.score(&recording, &light));
    }

    #[test]
    fn a_late_truth_costs_a_mote_that_knows_where_it_is() {
        for (name, late_s) in [("crazyflie-lh1-flight", 0.012), ("scum-take5", 0.0)] {
            let late = Late { late_s, at_s: 50.0, drift: -0.01 * late_s };
            let Some(recording) = shared_recording(name) else {
                return;
            };
            let recording = recording.sensor(0).unwrap();
            let light = Light::rebuild(&recording, &LightConfig::of(&recording)).unwrap();
            // A mote that knows where it is at each sweep, by a truth that is so late.
            let truth = score::recorded_truth(&recording, &light);
            let knows = |played: &crate::light::PlayedRow| {
                let laser = *played.laser.as_ref().ok()?;
                let place = score::place_at(&truth, late.after(light.seconds(laser)))?;
                Some(score::FixRow { seconds: light.seconds(laser), ..fix(laser, place) })
            };
            let fixes: Vec<_> = light.rows.iter().filter_map(knows).collect();
            let late = Score::of_late_truth(&recording, &light, &fixes, &late);
            let written = Score::of_recording(&recording, &light, &fixes);
            assert!(late.mean3d_cm < 0.1, "{late:?}");
            assert_eq!(written.mean3d_cm > 0.4, late_s > 0.0, "{written:?}");
            assert_eq!(late.fixed, written.fixed);
        }
    }

    #[test]
    fn the_flight_scores_as_it_is_known_to() {
        let Some(recording) = shared_recording("crazyflie-lh1-flight") else {
            return;
        };
        let recording = recording.sensor(0).unwrap();
        let light = Light::rebuild(&recording, &LightConfig::of(&recording)).unwrap();
        let plain = Method::plain(Room::open(&recording.stations).unwrap()).score(&recording, &light);
        println!("{plain:?}");
        assert!((plain.mean3d_cm - 2.34).abs() < 0.15);
    }
}
