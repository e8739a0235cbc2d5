//! The image of a board, built with a room baked in.
//!
//! What can go wrong: the calibration cannot be read or represented (said before anything is built), or the build
//! fails (cargo says why).

use std::env;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result, anyhow};
use xtask::calib::{self, Calibration};
use xtask::flash::{self, Board, Workshop};
use xtask::listen;
use xtask::trust;

use crate::process::{cargo, root, run, run_aside};
use crate::setup;

/// The room that is baked when nobody names one.
pub(crate) const DEFAULT_CALIB: &str = "calib/default.toml";

/// Lines that the build takes before those under `[mote]`.
const MOTE: &str = "LIGHTHOUSE_MOTE";

/// Reads a calibration and makes sure that it can be baked.
pub(crate) fn room(calib: &Path) -> Result<Calibration> {
    let mut calibration = calib::schema::open(calib)?;
    calibration.mote = calibration.mote.with(MOTE, &env::var(MOTE).unwrap_or_default())?;
    calib::firmware::bake(&calib.display().to_string(), &calibration)?;
    Ok(calibration)
}

/// Builds the SCuM-3C image for the room in `calib`, with the lines of `mote`, then those of the environment, in place of
/// those under its `[mote]`; returns the ELF file's bytes.
pub(crate) fn scum3c(calib: &Path, mote: &str) -> Result<Vec<u8>> {
    read(&build("scum3c", calib, mote)?)
}

/// The lines that a mote of several in a room is built with: who numbers motes has several, and they have to take turns.
pub(crate) fn among_others(calib: &Path) -> Result<String> {
    Ok(format!("send = \"{}\"", room(calib)?.mote.among_others().name()))
}

/// Puts what it builds onto chips.
pub(crate) fn flash(arguments: &flash::Arguments) -> Result<()> {
    let mote = |calib: &Path| -> Result<String> {
        let one = arguments.id.is_none() && arguments.ids.is_none();
        if one { Ok(String::new()) } else { among_others(calib) }
    };
    let workshop = Workshop {
        root: root(),
        default_calib: DEFAULT_CALIB,
        check: &|calib| room(calib).map(|_| ()),
        build: &|board, calib| match board {
            Board::Scum3c => scum3c(calib, &mote(calib)?),
            Board::Nrf52840 => read(&build_for(setup::CORTEX_M4F, board.name(), calib, &mote(calib)?, run)?),
        },
    };
    flash::flash(arguments, &workshop, &mut std::io::stdin().lock())
}

/// Listens, to simulated motes with the image that is flashed if to nothing else.
pub(crate) fn listen(arguments: &listen::Arguments) -> Result<()> {
    let build = |calib: &Path| read(&build_for(setup::CORTEX_M0, "scum3c", calib, "", run_aside)?);
    listen::listen(arguments, &listen::Workshop { root: root(), build: &build })
}

fn read(elf: &Path) -> Result<Vec<u8>> {
    std::fs::read(elf).with_context(|| format!("{}: built, but cannot be read", elf.display()))
}

/// Builds the binary `name`, whose feature has the same name, as [`scum3c`] does; returns where it lies.
pub(crate) fn build(name: &str, calib: &Path, mote: &str) -> Result<PathBuf> {
    build_for(setup::CORTEX_M0, name, calib, mote, run)
}

/// The same for a processor of another kind, by `run`.
pub(crate) fn build_for(
    target: &str,
    name: &str,
    calib: &Path,
    mote: &str,
    run: fn(&mut Command) -> Result<()>,
) -> Result<PathBuf> {
    setup::target(target)?;
    let mote = &before(&env::var(MOTE).unwrap_or_default(), mote)?;
    let keyed =
        calib::schema::open(calib)?.mote.with(MOTE, mote)?.key.is_some() || trust::key_of_environment()?.is_some();
    let features = if keyed { format!("{name},security") } else { name.to_string() };
    let arguments = ["build", "--release", "--bin", name, "--features", &features, "--target", target];
    let calib = calib.canonicalize().with_context(|| calib.display().to_string())?;
    run(cargo(&arguments).env("LIGHTHOUSE_CALIB", &calib).env(MOTE, mote))?;
    Ok(target_dir()?.join(target).join("release").join(name))
}

/// The lines of `own`, and of `others` those whose names it has not.
fn before(others: &str, own: &str) -> Result<String> {
    let mut lines: toml::Table = toml::from_str(others).map_err(|error| anyhow!("{MOTE}: {}", error.message()))?;
    lines.extend(toml::from_str::<toml::Table>(own)?);
    Ok(lines.to_string())
}

/// Where cargo builds, which the user may have moved.
fn target_dir() -> Result<PathBuf> {
    let asked: Command = cargo(&["metadata", "--format-version=1", "--no-deps", "--offline"]);
    let mut asked = asked;
    let answer = asked.current_dir(root()).output().context("cannot ask cargo where it builds")?;
    let metadata: serde_json::Value =
        serde_json::from_slice(&answer.stdout).context("cannot understand where cargo builds")?;
    let folder = metadata["target_directory"].as_str().ok_or_else(|| anyhow!("cargo does not say where it builds"))?;
    Ok(PathBuf::from(folder))
}

#[cfg(test)]
mod tests {
    use super::before;

    #[test]
    fn what_the_environment_says_of_a_mote_counts_unless_a_verb_says_otherwise() {
        assert_eq!(before("", "").unwrap(), "");
        let lines = before("estimate = \"angles\"\nsend = \"steady\"", "send = \"slotted\"").unwrap();
        assert_eq!(lines, "estimate = \"angles\"\nsend = \"slotted\"\n");
        let wrong = before("estimate = angles", "").unwrap_err().to_string();
        assert!(wrong.starts_with("LIGHTHOUSE_MOTE: "), "{wrong}");
    }
}
