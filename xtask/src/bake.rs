//! What a calibration becomes on the mote, before anything is built.
//!
//! What can go wrong: a file that does not read, a room that the fixed-point solver cannot hold. Both are said with
//! file, line, field and value, and nothing is written: this only shows.

use std::path::Path;

use anyhow::Result;
use xtask::calib::{firmware, quantise, schema};

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
    let firmware::Held { volume: room, baked } = firmware::bake(&name, &calibration)?;
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
    Ok(())
}
