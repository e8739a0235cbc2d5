use std::f64::consts::PI;
use std::path::PathBuf;

use nalgebra::{Matrix3, Vector3};
use proptest::prelude::*;

use super::twin::{Station as Seen, Twin, Vector, dot};
use super::{Config, HALF_TURNS_PER_S, Level, Pose, Room, State, Step, Sweep, report, start, step};
use crate::angle::{Angle, FIELD_OF_VIEW};
use crate::sweep::{Axis, Station};

const CONFIG: Config = Config::HAND_HELD;
/// The age rule of the fix: angles at most so many half turns old.
const FIX_AGE: f64 = 12.0;

/// One sweep of a path, and the truth at its time.
#[derive(Debug, Clone, Copy)]
struct Sighting {
    /// Half turns.
    at: f64,
    station: usize,
    axis: usize,
    /// Radians.
    angle: f64,
    truth: Vector,
    scored: bool,
    calibrate: bool,
}

impl Sighting {
    fn within_view(&self) -> bool {
        units(self.angle).abs() <= FIELD_OF_VIEW
    }
}

fn units(radians: f64) -> i32 {
    (radians / PI * f64::from(1 << 20)).round() as i32
}

fn room(stations: &[Seen; 2]) -> Room {
    Room {
        stations: stations.map(|station| Pose {
            axes: Matrix3::from(station.rotation.map(|row| row.map(|entry| (entry * 32768.0).round() as i32))),
            position: Vector3::from(station.position.map(|axis| (axis * 16_777_216.0).round() as i32)),
        }),
    }
}

/// The newest four angles to a position and the mismatch of their planes, by normal equations.
#[derive(Default)]
struct Fixer {
    newest: [[Option<(f64, f64)>; 2]; 2],
}

impl Fixer {
    fn fix(&mut self, stations: &[Seen; 2], sighting: &Sighting) -> Option<(Vector, f64)> {
        self.newest[sighting.station][sighting.axis] = Some((sighting.at, sighting.angle.tan()));
        let mut planes = Vec::new();
        for (station, newest) in stations.iter().zip(&self.newest) {
            for (axis, known) in newest.iter().enumerate() {
                let (at, tangent) = (*known)?;
                if sighting.at - at > FIX_AGE {
                    return None;
                }
                let normal: Vector =
                    std::array::from_fn(|i| station.rotation[axis][i] - tangent * station.rotation[2][i]);
                planes.push((normal, dot(normal, station.position)));
            }
        }
        let (mut matrix, mut right) = (Matrix3::zeros(), Vector3::zeros());
        for (normal, offset) in &planes {
            let normal = Vector3::from(*normal);
            matrix += normal * normal.transpose();
            right += normal * *offset;
        }
        let position: Vector = matrix.lu().solve(&right)?.into();
        let ahead = stations.iter().all(|station| (0.1..8.0).contains(&station.see(position)[2]));
        let mismatch = planes.iter().map(|(n, offset)| (dot(*n, position) - offset).powi(2)).sum::<f64>().sqrt();
        ahead.then_some((position, mismatch))
    }
}

/// The fixed-point tracker fed with f64, started from the fixer whenever it has no track.
struct Tracker<'a> {
    stations: &'a [Seen; 2],
    room: Room,
    state: State,
    fixer: Fixer,
    clock: Option<i64>,
}

impl<'a> Tracker<'a> {
    fn new(stations: &'a [Seen; 2]) -> Self {
        Self { stations, room: room(stations), state: State::default(), fixer: Fixer::default(), clock: None }
    }

    fn sweep(&mut self, sighting: &Sighting) -> Step {
        let now = (sighting.at * 256.0).round() as i64;
        let elapsed = self.clock.map_or(0, |before| now - before);
        self.clock = Some(now);
        let outcome = step(
            &CONFIG,
            &self.room,
            &mut self.state,
            &Sweep {
                station: [Station::A, Station::B][sighting.station],
                axis: [Axis::Azimuth, Axis::Elevation][sighting.axis],
                angle: Angle(units(sighting.angle)),
                elapsed: elapsed.try_into().unwrap_or(u16::MAX),
            },
        );
        if outcome != Step::OutOfView
            && let Some((position, mismatch)) = self.fixer.fix(self.stations, sighting)
        {
            start(
                &CONFIG,
                &self.room,
                &mut self.state,
                position.map(|axis| (axis * 65536.0) as i32),
                (mismatch * 65536.0) as i32,
            );
        }
        outcome
    }

    fn fix(&self) -> Option<Vector> {
        let track = report(&CONFIG, &self.state, 0);
        (track.level >= Level::Tracked).then(|| track.position.map(|axis| f64::from(axis) / 65536.0))
    }
}

/// The f64 filter, likewise.
struct TwinTracker<'a> {
    stations: &'a [Seen; 2],
    twin: Twin,
    fixer: Fixer,
    clock: Option<f64>,
}

impl<'a> TwinTracker<'a> {
    fn new(stations: &'a [Seen; 2]) -> Self {
        Self { stations, twin: Twin::default(), fixer: Fixer::default(), clock: None }
    }

    fn sweep(&mut self, sighting: &Sighting) {
        if !sighting.within_view() {
            return;
        }
        let elapsed = self.clock.map_or(0.0, |before| sighting.at - before);
        self.clock = Some(sighting.at);
        self.twin.step(&CONFIG, self.stations, sighting.station, sighting.axis, sighting.angle, elapsed);
        if let Some((position, mismatch)) = self.fixer.fix(self.stations, sighting) {
            self.twin.start(&CONFIG, position, mismatch);
        }
    }
}

/// Errors in centimetres, coverage in per cent.
#[derive(Debug, Default, Clone, Copy)]
struct Score {
    mae: Vector,
    mean: f64,
    rms: f64,
    p95: f64,
    coverage: f64,
}

fn score(path: &[Sighting], which: fn(&Sighting) -> bool, mut fix: impl FnMut(&Sighting) -> Option<Vector>) -> Score {
    let mut rows = 0;
    let mut errors: Vec<Vector> = Vec::new();
    for sighting in path {
        let fix = fix(sighting);
        if which(sighting) {
            rows += 1;
            errors.extend(fix.map(|fix| -> Vector { std::array::from_fn(|i| 100.0 * (fix[i] - sighting.truth[i])) }));
        }
    }
    let n = errors.len() as f64;
    let mut lengths: Vec<f64> = errors.iter().map(|error| dot(*error, *error).sqrt()).collect();
    lengths.sort_by(f64::total_cmp);
    Score {
        mae: std::array::from_fn(|i| errors.iter().map(|error| error[i].abs()).sum::<f64>() / n),
        mean: lengths.iter().sum::<f64>() / n,
        rms: (lengths.iter().map(|length| length * length).sum::<f64>() / n).sqrt(),
        p95: lengths.get(lengths.len() * 95 / 100).copied().unwrap_or(f64::NAN),
        coverage: 100.0 * n / f64::from(rows),
    }
}

fn score_both(name: &str, path: &[Sighting], stations: &[Seen; 2], which: fn(&Sighting) -> bool) -> (Score, Score) {
    let mut tracker = Tracker::new(stations);
    let fixed = score(path, which, |sighting| {
        tracker.sweep(sighting);
        tracker.fix()
    });
    let mut twin = TwinTracker::new(stations);
    let f64s = score(path, which, |sighting| {
        twin.sweep(sighting);
        twin.twin.fix(&CONFIG)
    });
    for (kind, s) in [("fixed", fixed), ("f64", f64s)] {
        println!(
            "{name}, {kind}: MAE {:.3} {:.3} {:.3} cm, mean {:.3}, RMS {:.3}, p95 {:.2}, coverage {:.1} %",
            s.mae[0], s.mae[1], s.mae[2], s.mean, s.rms, s.p95, s.coverage
        );
    }
    (fixed, f64s)
}

/// Marsaglia's xorshift, 64 bits.
struct Dice(u64);

impl Dice {
    fn flat(&mut self) -> f64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) as f64 / (1u64 << 53) as f64
    }

    fn normal(&mut self) -> f64 {
        (-2.0 * (1.0 - self.flat()).ln()).sqrt() * (2.0 * PI * self.flat()).cos()
    }
}

/// Two stations 0.6 m apart that look along -z with a little yaw, like the pair of the 2020 recording.
fn two_stations() -> [Seen; 2] {
    [(0.08f64, [0.25, 1.0, 1.6]), (-0.05f64, [0.85, 1.0, 1.6])].map(|(yaw, position)| Seen {
        rotation: [[-yaw.cos(), 0.0, yaw.sin()], [0.0, 1.0, 0.0], [-yaw.sin(), 0.0, -yaw.cos()]],
        position,
    })
}

/// What a simulated path suffers.
#[derive(Clone, Copy)]
struct Weather {
    /// One standard deviation of each angle, radians.
    noise: f64,
    /// The share of sweeps not seen.
    dropouts: f64,
    /// The share of sweeps that come from anywhere.
    reflections: f64,
}

const CLEAR: Weather = Weather { noise: 0.0, dropouts: 0.0, reflections: 0.0 };
const HAZE: Weather = Weather { noise: 0.0026, dropouts: 0.05, reflections: 0.02 };

fn hand_held(seed: u64, seconds: f64, weather: Weather, stations: &[Seen; 2]) -> Vec<Sighting> {
    let mut dice = Dice(seed);
    let waves: [[(f64, f64, f64); 4]; 3] = std::array::from_fn(|axis| {
        [(0.07, 0.5), (0.19, 0.28), (0.43, 0.15), (1.1, 0.07)].map(|(hertz, share)| {
            let reach = [0.35, 0.3, 0.3][axis];
            (hertz * (0.8 + 0.4 * dice.flat()), share * reach, 2.0 * PI * dice.flat())
        })
    });
    let place = |at: f64| -> Vector {
        std::array::from_fn(|axis| {
            let wave = |(hertz, reach, phase): (f64, f64, f64)| {
                reach * (2.0 * PI * hertz * at / HALF_TURNS_PER_S + phase).sin()
            };
            [0.55, 1.0, 0.85][axis] + waves[axis].map(wave).iter().sum::<f64>()
        })
    };
    let mut path = Vec::new();
    for slot in 0..(seconds * HALF_TURNS_PER_S) as usize {
        let (station, axis) = (slot % 4 / 2, slot % 2);
        let mut at = slot as f64 + 0.5;
        let mut angle = 0.0;
        for _ in 0..3 {
            angle = stations[station].angle(axis, place(at));
            at = slot as f64 + 0.5 + angle / PI;
        }
        let measured = if dice.flat() < weather.reflections {
            2.0 * dice.flat() - 1.0
        } else {
            angle + weather.noise * dice.normal()
        };
        if dice.flat() >= weather.dropouts {
            path.push(Sighting {
                at,
                station,
                axis,
                angle: measured,
                truth: place(at),
                scored: true,
                calibrate: false,
            });
        }
    }
    path
}

#[test]
fn ten_simulated_minutes_are_within_one_per_cent_of_the_f64_twin() {
    let stations = two_stations();
    let path = hand_held(4, 600.0, HAZE, &stations);
    let (fixed, f64s) = score_both("simulated", &path, &stations, |_| true);
    assert!((fixed.rms / f64s.rms - 1.0).abs() < 0.01);
    assert!(fixed.coverage > 99.0);
    assert!(fixed.rms < 1.2);
}

#[test]
fn the_standard_deviation_is_honest() {
    let stations = two_stations();
    let mut tracker = Tracker::new(&stations);
    let (mut inside, mut all) = (0, 0);
    for sighting in hand_held(5, 120.0, HAZE, &stations) {
        tracker.sweep(&sighting);
        let track = report(&CONFIG, &tracker.state, 0);
        if track.level == Level::Full {
            for i in 0..3 {
                let off = f64::from(track.position[i]) / 65536.0 - sighting.truth[i];
                all += 1;
                inside += u32::from(off.abs() * 65536.0 < 2.0 * f64::from(track.sd[i]));
            }
        }
    }
    let share = f64::from(inside) / f64::from(all);
    assert!(share > 0.95, "{share} of the errors within two standard deviations");
}

#[test]
fn velocity_is_metres_per_second() {
    let stations = two_stations();
    let mut tracker = Tracker::new(&stations);
    let place = |at: f64| [0.3 + 0.2 * at / HALF_TURNS_PER_S, 1.0, 0.7];
    for slot in 0..240 {
        let (station, axis, at) = (slot % 4 / 2, slot % 2, slot as f64);
        let angle = stations[station].angle(axis, place(at));
        tracker.sweep(&Sighting { at, station, axis, angle, truth: place(at), scored: true, calibrate: false });
    }
    let [x, y, z] = report(&CONFIG, &tracker.state, 0).velocity.map(|axis| f64::from(axis) / 65536.0);
    assert!((x - 0.2).abs() < 0.01 && y.abs() < 0.01 && z.abs() < 0.01, "{x} {y} {z}");
}

#[test]
fn an_occlusion_is_coasted_through_and_said_so() {
    let stations = two_stations();
    let mut tracker = Tracker::new(&stations);
    for sighting in hand_held(6, 5.0, CLEAR, &stations) {
        tracker.sweep(&sighting);
    }
    let at = |half_turns: u32| report(&CONFIG, &tracker.state, 256 * half_turns);
    assert_eq!(at(0).level, Level::Full);
    assert_eq!(at(28).level, Level::Tracked);
    assert!(at(28).sd[2] > at(10).sd[2] && at(10).sd[2] > at(0).sd[2]);
    assert_eq!(at(49).level, Level::None);
    assert_eq!(report(&CONFIG, &tracker.state, u32::MAX).level, Level::None);
}

#[test]
fn one_station_keeps_it_going_less_and_less_surely() {
    let stations = two_stations();
    let mut tracker = Tracker::new(&stations);
    let path = hand_held(7, 6.0, CLEAR, &stations);
    let (both, rest) = path.split_at(5 * 120);
    both.iter().for_each(|sighting| {
        tracker.sweep(sighting);
    });
    let before = report(&CONFIG, &tracker.state, 0);
    let mut believed = 0;
    for sighting in rest.iter().filter(|sighting| sighting.station == 0).take(14) {
        believed += u32::from(tracker.sweep(sighting) == Step::Believed);
    }
    let after = report(&CONFIG, &tracker.state, 0);
    assert_eq!(believed, 14);
    assert_eq!(after.level, Level::Tracked);
    assert!(after.sd[2] > 2 * before.sd[2]);
}

#[test]
fn a_sweep_outside_the_field_of_view_changes_nothing() {
    let stations = two_stations();
    let mut tracker = Tracker::new(&stations);
    for sighting in hand_held(8, 1.0, CLEAR, &stations) {
        tracker.sweep(&sighting);
    }
    let before = report(&CONFIG, &tracker.state, 0);
    for angle in [units(1.05), units(-1.05), i32::MAX, i32::MIN] {
        let sweep = Sweep { station: Station::A, axis: Axis::Azimuth, angle: Angle(angle), elapsed: 0 };
        assert_eq!(step(&CONFIG, &tracker.room, &mut tracker.state, &sweep), Step::OutOfView);
    }
    assert_eq!(report(&CONFIG, &tracker.state, 0), before);
}

#[test]
fn a_rotor_that_is_refused_twice_or_believed_far_off_takes_the_level() {
    let stations = two_stations();
    let mut tracker = Tracker::new(&stations);
    let path = hand_held(12, 2.0, CLEAR, &stations);
    path.iter().for_each(|sighting| {
        tracker.sweep(sighting);
    });
    let last = path.last().expect("a path");
    let after = |state: &mut State, half_turns: u16, off: f64| {
        let sweep = Sweep {
            station: [Station::A, Station::B][last.station],
            axis: [Axis::Azimuth, Axis::Elevation][last.axis],
            angle: Angle(units(last.angle + off)),
            elapsed: 256 * half_turns,
        };
        let outcome = step(&CONFIG, &tracker.room, state, &sweep);
        (outcome, report(&CONFIG, state, 0).level)
    };
    let mut state = tracker.state.clone();
    assert_eq!(after(&mut state, 4, 0.2), (Step::Refused, Level::Full));
    assert_eq!(after(&mut state, 1, 0.2), (Step::Refused, Level::Tracked));
    assert_eq!(after(&mut state, 1, 0.0), (Step::Believed, Level::Full));
    // Long enough in the dark for some centimetres to be believed.
    let leaps: Vec<_> = (0..20).map(|n| after(&mut tracker.state.clone(), 16, 0.005 * f64::from(n))).collect();
    assert_eq!(leaps[0], (Step::Believed, Level::Full));
    assert!(leaps.contains(&(Step::Believed, Level::Tracked)), "{leaps:?}");
}

#[test]
fn a_track_begun_in_the_wrong_place_is_given_up() {
    let stations = two_stations();
    let mut tracker = Tracker::new(&stations);
    assert!(start(&CONFIG, &tracker.room, &mut tracker.state, [40_000, 90_000, 20_000], 0));
    let path = hand_held(9, 3.0, HAZE, &stations);
    path.iter().for_each(|sighting| {
        tracker.sweep(sighting);
    });
    let (fix, truth) = (tracker.fix().expect("a fix after three seconds"), path.last().expect("a path").truth);
    assert!((0..3).all(|i| (fix[i] - truth[i]).abs() < 0.05), "{fix:?} {truth:?}");
}

#[test]
fn a_fix_whose_rays_miss_each_other_starts_nothing() {
    let room = room(&two_stations());
    let mut state = State::default();
    assert!(!start(&CONFIG, &room, &mut state, [0; 3], CONFIG.start_mismatch + 1));
    assert!(!start(&CONFIG, &room, &mut state, [0; 3], i32::MIN));
    assert!(start(&CONFIG, &room, &mut state, [0; 3], -CONFIG.start_mismatch));
    assert!(!start(&CONFIG, &room, &mut State::default(), [0, 0, 200_000], 0), "behind the stations");
    assert!(!start(&CONFIG, &room, &mut state, [0; 3], 0), "a running track is not begun anew");
}

fn any_sweep() -> impl Strategy<Value = Sweep> {
    let elapsed = prop_oneof![0u16..2048, any::<u16>()];
    let angle = prop_oneof![-FIELD_OF_VIEW..FIELD_OF_VIEW, any::<i32>()];
    (any::<bool>(), any::<bool>(), angle, elapsed).prop_map(|(station, axis, angle, elapsed)| Sweep {
        station: if station { Station::A } else { Station::B },
        axis: if axis { Axis::Azimuth } else { Axis::Elevation },
        angle: Angle(angle),
        elapsed,
    })
}

proptest! {
    #[test]
    fn no_sweep_is_believed_when_none_was_for_too_long(
        sweeps in prop::collection::vec((0u16..20 * 256, prop_oneof![3 => Just(0.1), 1 => Just(0.0), 1 => Just(2.0)]), 0..60),
        gap in 0u16..60 * 256,
    ) {
        let stations = two_stations();
        let mut tracker = Tracker::new(&stations);
        let place = [0.55, 1.0, 0.85];
        start(&CONFIG, &tracker.room, &mut tracker.state, place.map(|axis| (axis * 65536.0) as i32), 0);
        let mut silence = 0;
        for (n, (elapsed, off)) in sweeps.into_iter().chain([(gap, 0.0)]).enumerate() {
            let (station, axis) = (n % 4 / 2, n % 2);
            let sweep = Sweep {
                station: [Station::A, Station::B][station],
                axis: [Axis::Azimuth, Axis::Elevation][axis],
                angle: Angle(units(stations[station].angle(axis, place) + off)),
                elapsed,
            };
            silence += u32::from(elapsed);
            match step(&CONFIG, &tracker.room, &mut tracker.state, &sweep) {
                Step::Believed if silence < CONFIG.lost_after => silence = 0,
                Step::Refused | Step::OutOfView if silence < CONFIG.lost_after => {}
                Step::Lost => break,
                other => prop_assert!(false, "{:?} after {} half turns", other, silence / 256),
            }
        }
    }

    #[test]
    fn whatever_came_before_two_clean_seconds_bring_it_back(
        garbage in prop::collection::vec((any_sweep(), any::<[i32; 3]>(), any::<bool>()), 0..200),
        seed in 1u64..,
    ) {
        let stations = two_stations();
        let mut tracker = Tracker::new(&stations);
        for (sweep, position, begin) in garbage {
            step(&CONFIG, &tracker.room, &mut tracker.state, &sweep);
            if begin {
                start(&CONFIG, &tracker.room, &mut tracker.state, position.map(|axis| axis >> 12), 0);
            }
            let _ = report(&CONFIG, &tracker.state, sweep.elapsed.into());
        }
        let path = hand_held(seed, 2.0, CLEAR, &stations);
        for sighting in &path {
            tracker.sweep(sighting);
        }
        let track = report(&CONFIG, &tracker.state, 0);
        prop_assert_eq!(track.level, Level::Full);
        let truth = path.last().expect("a path").truth;
        for (axis, truth) in track.position.iter().zip(truth) {
            prop_assert!((f64::from(*axis) / 65536.0 - truth).abs() < 0.02, "{:?} {:?}", track, truth);
        }
    }

    #[test]
    fn nonsense_in_the_configuration_does_not_panic(
        sweeps in prop::collection::vec(any_sweep(), 1..100),
        position in any::<[i32; 3]>(),
        numbers in any::<[i32; 6]>(),
        times in any::<[u32; 4]>(),
        rotation in any::<[[i32; 3]; 3]>(),
    ) {
        let [noise, agility, gate, start_position, start_velocity, variance_limit] = numbers;
        let [lost_after, doubt_count, doubtful, fresh] = times;
        let (lost_after, doubt_count, doubtful) = (lost_after & 0x3fff, doubt_count as u16, doubtful as u16);
        let config = Config {
            noise, agility, gate, start_position, start_velocity, variance_limit,
            lost_after, doubt_count, doubtful, fresh, ..CONFIG
        };
        let pose = Pose { axes: Matrix3::from(rotation), position: Vector3::from(position) };
        let room = Room { stations: [pose; 2] };
        let mut state = State::default();
        for sweep in sweeps {
            start(&config, &room, &mut state, position, 0);
            step(&config, &room, &mut state, &sweep);
            let _ = report(&config, &state, sweep.elapsed.into());
        }
    }
}

// ---- Recordings of real light; they are not part of the project.

fn recording(name: &str) -> Option<PathBuf> {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/data").join(name);
    if folder.is_dir() {
        return Some(folder);
    }
    println!("skipped: no recording at {}", folder.display());
    None
}

/// The factory's terms of one rotor, radians.
#[derive(Debug, Clone, Copy, Default)]
struct Factory {
    phase: f64,
    tilt: f64,
    gibphase: f64,
    gibmag: f64,
}

fn read_stations(folder: &std::path::Path) -> ([Seen; 2], [[Factory; 2]; 2]) {
    let text = std::fs::read_to_string(folder.join("stations.toml")).expect("stations.toml");
    let mut stations = [Seen { rotation: [[0.0; 3]; 3], position: [0.0; 3] }; 2];
    let mut factory = [[Factory::default(); 2]; 2];
    let (mut station, mut axis) = (0, 0);
    for line in text.lines().map(str::trim).filter(|line| !line.starts_with('#')) {
        if line.starts_with('[') {
            station = usize::from(line.contains(".B"));
            axis = usize::from(line.contains(".el"));
        } else if let Some((key, value)) = line.split_once('=') {
            let numbers: Vec<f64> =
                value.split(['[', ']', ',', ' ']).filter_map(|number| number.parse().ok()).collect();
            let rotor = &mut factory[station][axis];
            match key.trim() {
                "rotation" => {
                    stations[station].rotation = std::array::from_fn(|i| std::array::from_fn(|j| numbers[3 * i + j]));
                }
                "position" => stations[station].position = std::array::from_fn(|i| numbers[i]),
                "phase" => rotor.phase = numbers[0],
                "tilt" => rotor.tilt = numbers[0],
                "gibphase" => rotor.gibphase = numbers[0],
                "gibmag" => rotor.gibmag = numbers[0],
                _ => {}
            }
        }
    }
    (stations, factory)
}

/// A row as recorded: ticks.
#[derive(Debug, Clone, Copy)]
struct Row {
    at: f64,
    station: usize,
    axis: usize,
    since_sync: f64,
    truth: Vector,
    good: bool,
    calibrate: bool,
}

/// The rows of photodiode 0.
fn read_rows(folder: &std::path::Path, calibrate: std::ops::Range<f64>) -> Vec<Row> {
    let text = std::fs::read_to_string(folder.join("sweeps.csv")).expect("sweeps.csv");
    let rows = text.lines().skip(1).map(|line| line.split(',').collect::<Vec<_>>());
    rows.filter(|fields| fields[1] == "0")
        .map(|fields| {
            let number = |i: usize| fields[i].parse::<f64>().expect("a number");
            Row {
                at: number(0),
                station: usize::from(fields[2] == "B"),
                axis: usize::from(fields[3] == "el"),
                since_sync: number(4),
                truth: [number(5), number(6), number(7)],
                good: fields[8] == "1",
                calibrate: calibrate.contains(&number(0)),
            }
        })
        .collect()
}

#[test]
fn the_2020_recording_is_followed() {
    let Some(folder) = recording("scum-take5") else { return };
    let (stations, factory) = read_stations(&folder);
    // 90,207 ticks: what the light says of this recording's clock; followed from there at 1 % a sweep.
    let mut half_turn = 90_207.0;
    let mut newest: [[Option<Row>; 2]; 2] = Default::default();
    let mut at = 0.0;
    let mut before: Option<f64> = None;
    let mut path = Vec::new();
    for row in read_rows(&folder, 1_050_000_000.0..1_375_000_000.0) {
        let slot = &mut newest[row.station][row.axis];
        if let Some(last) = *slot
            && (last.since_sync - row.since_sync).abs() < 300.0
        {
            // Two syncs of one rotor are 4 half turns apart.
            let off = (row.at - last.at - (row.since_sync - last.since_sync)) / 4.0 - half_turn;
            if off.abs() < 80.0 {
                half_turn += 0.01 * off;
            }
        }
        *slot = Some(row);
        at += (row.at - before.unwrap_or(row.at)) / half_turn;
        before = Some(row.at);
        path.push(Sighting {
            at,
            station: row.station,
            axis: row.axis,
            angle: (row.since_sync / half_turn - 0.5) * PI + factory[row.station][row.axis].phase,
            truth: row.truth,
            scored: row.good && !row.calibrate,
            calibrate: row.good && row.calibrate,
        });
    }
    let (fixed, f64s) = score_both("take5, calibrate window", &path, &stations, |sighting| sighting.calibrate);
    assert!((fixed.rms / f64s.rms - 1.0).abs() < 0.01);
    let (fixed, f64s) = score_both("take5, scored rows", &path, &stations, |sighting| sighting.scored);
    assert!((fixed.rms / f64s.rms - 1.0).abs() < 0.01);
    assert!(fixed.mae[0] <= 0.45 && fixed.mae[1] <= 0.28 && fixed.mae[2] <= 0.85, "{fixed:?}");
    assert!(fixed.rms <= 2.5 && fixed.coverage >= 95.0, "{fixed:?}");
}

/// Laser times from log times: the log tells of both rotors of a station when their two slots are over. The cycle is
/// B azimuth, B elevation, A azimuth, A elevation, each 200,000 ticks; its phase follows the earliest log entries.
fn crazyflie(folder: &std::path::Path) -> (Vec<Sighting>, [Seen; 2]) {
    const SLOT: f64 = 200_000.0;
    let (stations, factory) = read_stations(folder);
    let rows = read_rows(folder, 335_348_208.0..988_148_568.0);
    let truth: Vec<Row> = rows.iter().copied().filter(|row| row.good).collect();
    let mut path: Vec<Sighting> = Vec::new();
    let mut measured = [[0.0f64; 2]; 2];
    let mut phase: Option<f64> = None;
    let mut known = 0;
    let mut first = 0;
    while first < rows.len() {
        let burst = rows[first..].iter().take_while(|row| row.at < rows[first].at + SLOT / 2.0).count();
        let burst = &rows[first..first + burst];
        first += burst.len();
        // An entry with B repeats the angles of A that the entry before it told.
        let station = usize::from(burst.iter().any(|row| row.station == 1));
        let log = burst[0].at - if station == 1 { 2.0 * SLOT } else { 0.0 };
        let end = phase.map_or(log, |phase: f64| {
            let cycle = phase + ((log - phase) / (4.0 * SLOT)).round() * 4.0 * SLOT;
            let late = log - cycle;
            cycle + if late < 0.0 { 0.05 * late.max(-SLOT) } else { 0.005 * late.min(SLOT) }
        });
        phase = Some(end);
        let end = end + if station == 1 { 2.0 * SLOT } else { 0.0 };
        for row in burst.iter().filter(|row| row.station == station) {
            let at = end - SLOT * (2 - row.axis) as f64 + row.since_sync;
            measured[station][row.axis] = (row.since_sync / SLOT - 0.5) * PI;
            let rotor = factory[station][row.axis];
            let other = measured[station][1 - row.axis].tan();
            let mut angle = measured[station][row.axis];
            for _ in 0..4 {
                angle = measured[station][row.axis] + rotor.phase + (other * rotor.tilt.tan() * angle.cos()).atan()
                    - rotor.gibmag * (angle + rotor.gibphase).sin();
            }
            if path.last().is_some_and(|last| at <= last.at * SLOT) {
                continue;
            }
            while known + 1 < truth.len() && truth[known + 1].at <= at {
                known += 1;
            }
            let pair = truth.get(known).zip(truth.get(known + 1));
            let pair = pair.filter(|(left, right)| left.at <= at && right.at - left.at < 4.0 * SLOT);
            let there = pair.map(|(left, right)| -> Vector {
                let share = (at - left.at) / (right.at - left.at);
                std::array::from_fn(|i| left.truth[i] + share * (right.truth[i] - left.truth[i]))
            });
            path.push(Sighting {
                at: at / SLOT,
                station,
                axis: row.axis,
                angle,
                truth: there.unwrap_or_default(),
                scored: there.is_some() && !row.calibrate,
                calibrate: there.is_some() && row.calibrate,
            });
        }
    }
    (path, stations)
}

#[test]
fn the_crazyflie_is_followed_in_flight() {
    let Some(folder) = recording("crazyflie-lh1-flight") else { return };
    let (path, stations) = crazyflie(&folder);
    score_both("crazyflie, calibrate window", &path, &stations, |sighting| sighting.calibrate);
    let (fixed, _) = score_both("crazyflie, scored rows", &path, &stations, |sighting| sighting.scored);
    assert!(fixed.mean <= 2.4 && fixed.coverage >= 95.0, "{fixed:?}");
}
