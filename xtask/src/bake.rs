//! What a calibration becomes on the mote, before anything is built.
//!
//! What can go wrong: a file that does not read, a room that the fixed-point solver cannot hold. Both are said with
//! file, line, field and value. What is shown is also written to target/bake/summary.json, for programs.

use std::path::Path;

use anyhow::{Result, ensure};
use nalgebra::{Matrix3, Matrix4, RowVector4, Vector3};
use serde_json::json;
use xtask::calib::{Calibration, firmware, quantise, schema};
use xtask::whole;

use crate::process::root;

/// Where the figures go.
const OUT: &str = "target/bake";

/// Prints what would be baked and how well it does.
pub(crate) fn bake(calib: &Path) -> Result<()> {
    let name = calib.display().to_string();
    let calibration = schema::open(calib)?;
    println!("{name}");
    for (key, value) in &calibration.provenance {
        println!("  {key}: {value}");
    }
    let place = |p: [f64; 3]| format!("({:.3}, {:.3}, {:.3}) m", p[0], p[1], p[2]);
    for (station, name) in calibration.stations.iter().zip(["A", "B"]) {
        println!("  station {name} at {} looks along {}", place(station.position), place(station.rotation[2]));
    }
    let held = firmware::bake(&name, &calibration)?;
    let warning = held.warning(&calibration.mote);
    let firmware::Held { volume: room, baked } = held;
    let whence = if calibration.room.is_some() { "declared" } else { "both stations light it" };
    println!("  room {} to {} ({whence})", place(room.min), place(room.max));
    println!("  solver: {}", baked.choice);
    let measured = baked.measured;
    println!(
        "  at {} points, against least squares in f64, with 0.2 deg of noise and without: {:.3} mm RMS, {:.2} mm at \
         most, mean of an axis {:.1} um, {:.1} % turned away",
        quantise::VERIFIED,
        measured.rms_mm,
        measured.max_mm,
        measured.bias_um,
        100.0 * measured.rejected
    );
    if let Some(warning) = warning {
        println!("  {warning}");
    }
    let Noise { least_squares_mm, homogeneous_mm } = noise(&calibration, [room.min, room.max])?;
    println!(
        "  {NOISE_DEG} deg of noise moves least squares by {least_squares_mm:.0} mm RMS, and the singular vector of the \
         homogeneous system is {homogeneous_mm:.1} mm from it"
    );
    let [a, b] = calibration.stations.each_ref().map(|station| Vector3::from(station.position));
    let summary = json!({
        "points": quantise::VERIFIED,
        "rms_mm": measured.rms_mm,
        "max_mm": measured.max_mm,
        "bias_um": measured.bias_um,
        "rejected": measured.rejected,
        "baseline_m": (a - b).norm(),
        "noise_mm": least_squares_mm,
        "homogeneous_from_least_squares_mm": homogeneous_mm,
    });
    whole::json(&root().join(OUT).join("summary.json"), &summary)
}

/// What noise of the light does, whatever the arithmetic.
struct Noise {
    /// From the truth to least squares, RMS.
    least_squares_mm: f64,
    /// From least squares to the paper's singular vector, RMS.
    homogeneous_mm: f64,
}

/// Of each angle, as `quantise` puts on it.
const NOISE_DEG: f64 = 0.2;
/// Light is believed so far from straight ahead, degrees.
const FIELD_DEG: f64 = 60.0;
/// Points that both stations see.
const POINTS: usize = 4000;

/// Four noisy angles at points of the room, solved both ways in f64.
fn noise(room: &Calibration, [min, max]: [[f64; 3]; 2]) -> Result<Noise> {
    let mut dice = fastrand::Rng::with_seed(1);
    let gauss =
        |dice: &mut fastrand::Rng| (-2.0 * (1.0 - dice.f64()).ln()).sqrt() * (std::f64::consts::TAU * dice.f64()).cos();
    let (mut least_squares, mut homogeneous, mut seen) = (0.0, 0.0, 0);
    for _ in 0..100 * POINTS {
        let point = Vector3::from(std::array::from_fn(|i| min[i] + (max[i] - min[i]) * dice.f64()));
        let mut rows = Matrix4::zeros();
        let mut is_seen = true;
        for (s, station) in room.stations.iter().enumerate() {
            let rotation = Matrix3::from(station.rotation).transpose();
            let position = Vector3::from(station.position);
            let (c, t) = (rotation * (point - position), -(rotation * position));
            let row = |i: usize| RowVector4::new(rotation[(i, 0)], rotation[(i, 1)], rotation[(i, 2)], t[i]);
            for axis in 0..2 {
                let angle = c[axis].atan2(c.z) + NOISE_DEG.to_radians() * gauss(&mut dice);
                is_seen &= angle.abs() < FIELD_DEG.to_radians();
                rows.set_row(2 * s + axis, &(row(2) * angle.tan() - row(axis)));
            }
        }
        if !is_seen {
            continue;
        }
        let known = rows.fixed_columns::<3>(0);
        let normal: Matrix3<f64> = known.transpose() * known;
        let found = normal.cholesky().map(|normal| normal.solve(&(known.transpose() * -rows.column(3))));
        let vectors = rows.svd(false, true).v_t;
        let (Some(found), Some(vectors)) = (found, vectors) else { continue };
        let last = vectors.row(3);
        let singular = Vector3::new(last[0], last[1], last[2]) / last[3];
        least_squares += (found - point).norm_squared();
        homogeneous += (singular - found).norm_squared();
        seen += 1;
        if seen == POINTS {
            break;
        }
    }
    ensure!(seen == POINTS, "hardly a point of the room is seen by both stations");
    let mean = |sum: f64| sum / POINTS as f64;
    Ok(Noise { least_squares_mm: 1e3 * mean(least_squares).sqrt(), homogeneous_mm: 1e3 * mean(homogeneous).sqrt() })
}
