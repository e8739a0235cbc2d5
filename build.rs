//! What the compiler cannot know: the room the mote lives in, and the memory of the board it runs on.
//!
//! What can go wrong: a calibration that cannot be represented, a board without a line in [`BOARDS`]. Both stop here.

#[path = "calib/firmware.rs"]
mod firmware;
#[path = "calib/key.rs"]
mod key;
#[path = "calib/quantise.rs"]
mod quantise;
#[path = "calib/schema.rs"]
mod schema;
#[path = "calib/solver.rs"]
mod solver;
#[path = "calib/volume.rs"]
mod volume;

use std::path::Path;
use std::{env, fs};

fn main() {
    bake();
    link();
}

/// Writes `OUT_DIR/calib.rs`: `CONFIG`, `PAN` and `MOTE` as constants, so that the compiler folds them into the code.
///
/// The room is `calib/default.toml`, or whatever file `LIGHTHOUSE_CALIB` names. `LIGHTHOUSE_MOTE` may hold lines as
/// they stand under `[mote]` in such a file, which then count instead. `LIGHTHOUSE_KEY` may name the file of the room's key.
fn bake() {
    println!("cargo:rerun-if-changed=build.rs");
    println!("cargo:rerun-if-changed=calib");
    println!("cargo:rerun-if-changed=src/fix");
    println!("cargo:rerun-if-env-changed=LIGHTHOUSE_CALIB");
    let chosen = env::var("LIGHTHOUSE_CALIB").unwrap_or_else(|_| "calib/default.toml".to_string());
    println!("cargo:rerun-if-changed={chosen}");
    println!("cargo:rerun-if-env-changed=LIGHTHOUSE_MOTE");
    println!("cargo:rerun-if-env-changed=LIGHTHOUSE_KEY");
    let own = env::var("LIGHTHOUSE_MOTE").unwrap_or_default();
    let baked = schema::open(Path::new(&chosen)).and_then(|mut calibration| {
        calibration.mote = calibration.mote.with("LIGHTHOUSE_MOTE", &own)?;
        if let Some(file) = env::var_os("LIGHTHOUSE_KEY").filter(|file| !file.is_empty()) {
            println!("cargo:rerun-if-changed={}", Path::new(&file).display());
            calibration.mote.key = Some(key::Key(key::open(Path::new(&file))?));
        }
        if calibration.mote.key.is_some() && env::var_os("CARGO_FEATURE_SECURITY").is_none() {
            println!("cargo:warning=the room has a key, and the feature `security` is off: frames are plain");
        }
        let held = firmware::bake(&chosen, &calibration)?;
        if let Some(warning) = held.warning(&calibration.mote) {
            println!("cargo:warning={warning}");
        }
        firmware::source_of(&chosen, &calibration, &held)
    });
    let source = baked.unwrap_or_else(|error| {
        eprintln!("{error}");
        std::process::exit(1);
    });
    let out = env::var("OUT_DIR").expect("cargo sets OUT_DIR for every build script");
    fs::write(Path::new(&out).join("calib.rs"), source).expect("OUT_DIR is writable");
}

/// Whose link line it is.
enum Unit {
    /// The binary of that name.
    Bin(&'static str),
    /// The tests, which run in QEMU.
    Tests,
}

/// What the linker has to know of a board.
struct Board {
    /// Its cargo feature: one board per build.
    feature: &'static str,
    unit: Unit,
    /// Bytes of code memory at 0.
    flash: u32,
    /// Bytes of data memory at 0x2000_0000.
    ram: u32,
    /// Of those, the first bytes, for the stack; a multiple of 8 (AAPCS). `cargo xtask memory` proves that a board's is
    /// enough.
    stack: u32,
    /// The folder of a hand-written `device.x`, where no peripheral access crate brings one.
    device: Option<&'static str>,
}

const BOARDS: &[Board] = &[
    // 64 KiB each. The last two words of the code RAM are the boot loader's: length and CRC-32 of the image (SCuM-3C
    // test code, lighthouse_app.c:26-27).
    Board {
        feature: "scum3c",
        unit: Unit::Bin("scum3c"),
        flash: 64 * 1024 - 8,
        ram: 64 * 1024,
        stack: 2 * 1024,
        device: Some("src/bin/scum3c"),
    },
    // The whole chip: no boot loader, no SoftDevice (PS 4.2). Its peripheral access crate brings `device.x`.
    Board {
        feature: "nrf52840",
        unit: Unit::Bin("nrf52840"),
        flash: 1024 * 1024,
        ram: 256 * 1024,
        stack: 8 * 1024,
        device: None,
    },
    // nRF51822. The upper 192 KiB of its flash hold the light that it plays.
    Board {
        feature: "microbit",
        unit: Unit::Bin("microbit"),
        flash: 64 * 1024,
        ram: 16 * 1024,
        stack: 4 * 1024,
        device: None,
    },
    // The same chip, as in QEMU's `microbit`.
    Board { feature: "qemu", unit: Unit::Tests, flash: 256 * 1024, ram: 16 * 1024, stack: 12 * 1024, device: None },
    Board {
        feature: "bench",
        unit: Unit::Bin("bench"),
        flash: 256 * 1024,
        ram: 16 * 1024,
        stack: 8 * 1024,
        device: None,
    },
];

/// Bytes of stack more where frames are sealed; a multiple of 8.
const SEALING: u32 = 2304;

/// Hands the linker its scripts and each board its memory.
///
/// Here and not in `.cargo/config.toml`, because `RUSTFLAGS` in the environment would silence those.
fn link() {
    println!("cargo:rerun-if-changed=memory.x");
    if env::var("CARGO_CFG_TARGET_OS").as_deref() != Ok("none") {
        return;
    }
    let root = env::var("CARGO_MANIFEST_DIR").expect("cargo sets CARGO_MANIFEST_DIR for every build script");
    for board in BOARDS {
        if env::var_os(format!("CARGO_FEATURE_{}", board.feature.to_uppercase().replace('-', "_"))).is_none() {
            continue;
        }
        let kind = match board.unit {
            Unit::Bin(name) => format!("cargo:rustc-link-arg-bin={name}"),
            Unit::Tests => "cargo:rustc-link-arg-tests".to_owned(),
        };
        println!("{kind}=-L{root}");
        if let Some(folder) = board.device {
            println!("cargo:rerun-if-changed={folder}/device.x");
            println!("{kind}=-L{root}/{folder}");
        }
        println!("{kind}=--defsym=__flash_size={}", board.flash);
        println!("{kind}=--defsym=__ram_size={}", board.ram);
        let sealing = if env::var_os("CARGO_FEATURE_SECURITY").is_some() { SEALING } else { 0 };
        println!("{kind}=--defsym=__stack_size={}", board.stack + sealing);
        // `--nmagic`: no page alignment between sections; a mote has no pages.
        for argument in ["--nmagic", "-Tlink.x"] {
            println!("{kind}={argument}");
        }
        if env::var_os("CARGO_FEATURE_DEFMT").is_some() {
            println!("{kind}=-Tdefmt.x");
        }
    }
}
