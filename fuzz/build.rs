//! Bakes the default room, as the board's build does.

#[path = "../calib/firmware.rs"]
mod firmware;
#[allow(dead_code, reason = "a board's build uses more of it")]
#[path = "../calib/key.rs"]
mod key;
#[path = "../calib/quantise.rs"]
mod quantise;
#[allow(dead_code, reason = "a board's build uses more of it")]
#[path = "../calib/schema.rs"]
mod schema;
#[path = "../calib/solver.rs"]
mod solver;
#[path = "../calib/volume.rs"]
mod volume;

use std::path::Path;
use std::{env, fs};

const ROOM: &str = "../calib/default.toml";

fn main() {
    println!("cargo:rerun-if-changed=../calib");
    println!("cargo:rerun-if-changed=../src/fix");
    let baked = schema::open(Path::new(ROOM)).and_then(|calibration| firmware::source(ROOM, &calibration));
    let source = baked.unwrap_or_else(|error| {
        eprintln!("{error}");
        std::process::exit(1);
    });
    let out = env::var("OUT_DIR").expect("cargo sets OUT_DIR for every build script");
    fs::write(Path::new(&out).join("calib.rs"), source).expect("OUT_DIR is writable");
}
