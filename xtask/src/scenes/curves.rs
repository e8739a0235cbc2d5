//! How far and how far aside the light reaches: the shares of sweeps and of good fixes against distance and against
//! incidence, as the 2020 paper's figures 10 and 11 show for the chip.
//!
//! # Design
//! Both are measured from what the mote reports, in a room of their own: two stations side by side two metres apart look
//! along a corridor. The mote lies still on the middle line; it looks at the stations for the range, and away from them
//! more and more for the incidence. Reports come at every sweep.
//!
//! What the receiver notices follows [`Sensitivity`], a model; what the mote makes of it is measured.
//!
//! What can go wrong: where no track runs there are no reports, so a share of sweeps counts those that the mote used.

use std::fmt;
use std::path::Path;

use anyhow::{Context, Result};
use lighthouse_mote::frame::Level;
use serde_json::{Value, json};
use sim::world::Scene;
use sim::world::path::Path as MotePath;
use sim::world::receiver::{Facing, Sensitivity};
use sim::world::rotor::Rotor;
use sim::world::station::Station;
use xtask::svg::{Curve, draw_curves};

use super::list::Take;
use super::play::Played;
use super::{Image, on_all_cores};
use crate::process::root;

/// The stations' distance from the middle line, metres.
const ASIDE_M: f64 = 1.0;
/// How long the mote lies at each place, seconds; the first of them are for the lock.
const EACH_S: f64 = 6.0;
const SETTLED_S: f64 = 1.0;
/// Straight-on light is at the threshold at 5 m, where the makers' range ends; 10 % from pulse to pulse.
const SENSITIVITY: Sensitivity = Sensitivity { reach_m: 5.0, spread: 0.1 };
/// Where the mote lies for the incidence: light is there four times what is needed, straight on.
const INCIDENCE_AT_M: f64 = 2.25;
/// A report this close to a sweep is of that sweep, seconds.
const SAME_S: f64 = 50e-6;

/// Both curves.
pub(super) struct Curves {
    pub(super) range: Measured,
    pub(super) incidence: Measured,
}

/// One curve.
pub(super) struct Measured {
    name: &'static str,
    unit: &'static str,
    points: Vec<Point>,
}

/// A place on a curve; shares in percent of the sweeps that passed.
#[derive(Default)]
struct Point {
    at: f64,
    /// Noticed by the receiver.
    noticed: f64,
    /// Used by the mote: reported on.
    used: f64,
    /// Reported on with a fix of level full.
    good: f64,
}

fn scene(z_m: f64, incidence_deg: f64) -> Scene {
    let station = |x_m| Station {
        rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        position_m: [x_m, 1.0, 0.0],
        azimuth: Rotor::default(),
        ..Station::default()
    };
    let mut scene = Scene { length_s: EACH_S, path: MotePath::Still { at_m: [0.0, 1.0, z_m] }, ..Scene::default() };
    (scene.station_a, scene.station_b) = (station(-ASIDE_M), station(ASIDE_M));
    (scene.receiver.sync_dropout, scene.receiver.sweep_dropout) = (0.0, 0.0);
    // Tilted about x, both stations are the same angle aside: cos = cos(tilt) z / distance.
    let cos_tilt = (incidence_deg.to_radians().cos() * distance_m(z_m) / z_m).min(1.0);
    let sin_tilt = (1.0 - cos_tilt * cos_tilt).sqrt();
    scene.receiver.facing = Some(Facing { normal: [0.0, sin_tilt, -cos_tilt], max_incidence_deg: 90.0 });
    scene.receiver.sensitivity = Some(SENSITIVITY);
    scene.optics.reach_m = 100.0;
    scene
}

/// From the middle line to either station.
fn distance_m(z_m: f64) -> f64 {
    z_m.hypot(ASIDE_M)
}

/// The corridor as a calibration.
const CORRIDOR: &str = "\
[provenance]
what = \"A simulated corridor: two stations two metres apart look along it\"

[room]
min = [-0.2, 0.8, 0.9]
max = [0.2, 1.2, 6.2]

[mote]
id = 1
pan = 0x4C48
estimate = \"track\"
report_every_half_turns = 1
max_angle_age_ms = 100

[station.A]
rotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
position = [-1.0, 1.0, 0.0]

[station.B]
rotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
position = [1.0, 1.0, 0.0]
";

/// Measures both.
pub(super) fn measure() -> Result<Curves> {
    let folder = root().join(super::OUT);
    std::fs::create_dir_all(&folder).with_context(|| folder.display().to_string())?;
    let calib = folder.join("corridor.toml");
    std::fs::write(&calib, CORRIDOR).with_context(|| calib.display().to_string())?;
    let image = Image::build(&calib)?;
    let ranges_m = (4..=24).map(|n| 0.25 * f64::from(n));
    let least_deg = (INCIDENCE_AT_M / distance_m(INCIDENCE_AT_M)).acos().to_degrees();
    let incidences_deg = std::iter::once(least_deg.ceil()).chain((6..=17).map(|n| 5.0 * f64::from(n)));
    Ok(Curves {
        range: curve(&image, "range", "m", ranges_m.map(|z_m| (distance_m(z_m), scene(z_m, 0.0))).collect())?,
        incidence: curve(
            &image,
            "incidence",
            "deg",
            incidences_deg.map(|deg| (deg, scene(INCIDENCE_AT_M, deg))).collect(),
        )?,
    })
}

fn curve(image: &Image, name: &'static str, unit: &'static str, places: Vec<(f64, Scene)>) -> Result<Measured> {
    let mut points: Vec<Point> = places.iter().map(|_| Point::default()).collect();
    on_all_cores(
        &places,
        |(at, scene)| {
            let first_light_s = scene.timing.first_sync_s;
            let take = Take {
                scene: scene.clone(),
                seed: 1,
                first_light_s,
                due_again_s: Vec::new(),
                wrap_s: None,
                reasons: &[],
                knows_ids: false,
            };
            Ok(point(*at, &image.play(&take)?))
        },
        |n, point| {
            points[n] = point;
            Ok(())
        },
    )?;
    Ok(Measured { name, unit, points })
}

fn point(at: f64, played: &Played) -> Point {
    let (from, same) = ((SETTLED_S * played.mote_hz) as u64, (SAME_S * played.mote_hz) as u64);
    let passes: Vec<u64> = played.passes.iter().copied().filter(|cycle| *cycle >= from).collect();
    let share = |is: &dyn Fn(u64) -> bool| {
        100.0 * passes.iter().filter(|cycle| is(**cycle)).count() as f64 / passes.len().max(1) as f64
    };
    let reported = |cycle: u64, least: Level| {
        played.fixes.iter().any(|fix| fix.level >= least && fix.row.sighted.abs_diff(cycle) < same)
    };
    Point {
        at,
        noticed: share(&|cycle| played.sweeps.binary_search(&cycle).is_ok()),
        used: share(&|cycle| reported(cycle, Level::Tracked)),
        good: share(&|cycle| reported(cycle, Level::Full)),
    }
}

impl fmt::Display for Curves {
    /// For a person and for the expected file.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for Measured { name, unit, points } in [&self.range, &self.incidence] {
            for Point { at, noticed, used, good } in points {
                writeln!(
                    f,
                    "{name}-{at:.2}{unit} sweeps noticed {noticed:.1} %, used {used:.1} %, with a good fix {good:.1} %"
                )?;
            }
        }
        Ok(())
    }
}

impl Measured {
    pub(super) fn summary(&self) -> Value {
        let points = self.points.iter().map(|point| {
            json!({ "at": point.at, "noticed_percent": point.noticed, "used_percent": point.used, "good_percent": point.good })
        });
        json!({ "unit": self.unit, "points": points.collect::<Vec<_>>() })
    }

    fn line(&self, name: &str, of: impl Fn(&Point) -> f64) -> Curve {
        Curve { name: name.to_string(), points: self.points.iter().map(|point| (point.at, of(point))).collect() }
    }
}

impl Curves {
    /// Writes range.svg and incidence.svg.
    pub(super) fn draw(&self, folder: &Path) -> Result<()> {
        for (measured, title, across) in [
            (&self.range, "Light against distance", "distance from both stations / m"),
            (
                &self.incidence,
                "Light against incidence, 2.5 m from both stations",
                "angle between where the mote looks and the stations / degrees",
            ),
        ] {
            let lines = [
                measured.line("sweeps the receiver notices", |point| point.noticed),
                measured.line("sweeps the mote reports at", |point| point.used),
                measured.line("of those, with level full", |point| point.good),
            ];
            let file = folder.join(format!("{}.svg", measured.name));
            std::fs::write(&file, draw_curves(title, across, "% of the sweeps that pass", &lines))
                .with_context(|| file.display().to_string())?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::firmware;

    #[test]
    fn the_corridor_is_the_one_that_is_baked() {
        let folder = tempfile::tempdir().expect("a folder");
        let calib = folder.path().join("corridor.toml");
        std::fs::write(&calib, CORRIDOR).expect("it can be written");
        let calibration = firmware::room(&calib).expect("it can be baked");
        let scene = scene(2.0, 30.0);
        assert_eq!(scene.check(), Ok(()));
        for (station, baked) in [&scene.station_a, &scene.station_b].into_iter().zip(&calibration.stations) {
            assert_eq!((station.position_m, station.rotation), (baked.position, baked.rotation));
        }
    }

    #[test]
    fn the_mote_looks_as_far_aside_as_asked() {
        for asked in [25.0, 45.0, 80.0] {
            let scene = scene(INCIDENCE_AT_M, asked);
            let normal = scene.receiver.facing.expect("it looks somewhere").normal;
            for x in [-ASIDE_M, ASIDE_M] {
                let cos = (normal[0] * x - normal[2] * INCIDENCE_AT_M) / distance_m(INCIDENCE_AT_M);
                assert!((cos.acos().to_degrees() - asked).abs() < 1e-9, "{asked}");
            }
        }
    }
}
