//! The same image from the same sources, wherever they lie.
//!
//! Someone who holds an image wants to know that it came from these sources. The tracked files are copied to a folder
//! of another name and depth, built there from nothing, and the bytes that a chip would be given are compared.
//!
//! What can go wrong: something of this computer is in the image (a path, a time, an order). The error names the first
//! byte that differs. Two computers agree only with the same toolchain, which `rust-toolchain.toml` pins.

use std::path::Path;
use std::process::Command;

use anyhow::{Context, Result, bail, ensure};
use sha2::{Digest, Sha256};
use sim::elf;

use crate::firmware::{self, DEFAULT_CALIB};
use crate::process::{cargo, root, run};
use crate::setup;

/// The boards with an image to flash, and what cargo calls their cores.
const BOARDS: [(&str, &str); 2] = [("scum3c", setup::CORTEX_M0), ("nrf52840", setup::CORTEX_M4F)];

/// Builds every board's image here and elsewhere, and prints what both have in common.
pub(crate) fn reproduce() -> Result<()> {
    let elsewhere = tempfile::tempdir().context("cannot make a folder to build in")?;
    let copy = elsewhere.path().join("another/place");
    copy_sources(&copy)?;
    for (board, target) in BOARDS {
        let here = image(&firmware::build_for(target, board, Path::new(DEFAULT_CALIB), "", run)?)?;
        let arguments = ["build", "--release", "--bin", board, "--features", board, "--target", target];
        let built = copy.join("built");
        run(cargo(&arguments).arg("--manifest-path").arg(copy.join("Cargo.toml")).env("CARGO_TARGET_DIR", &built))?;
        let there = image(&built.join(target).join("release").join(board))?;
        same(board, &here, &there)?;
        let hash = hex::encode(Sha256::digest(&here));
        println!("{board}: {} bytes, SHA-256 {hash}, the same from two folders", here.len());
    }
    Ok(())
}

/// Copies what git tracks, as it is now.
fn copy_sources(to: &Path) -> Result<()> {
    let listed =
        Command::new("git").args(["ls-files", "-z"]).current_dir(root()).output().context("cannot start git")?;
    ensure!(listed.status.success(), "git cannot list the sources: {}", String::from_utf8_lossy(&listed.stderr).trim());
    for name in String::from_utf8(listed.stdout).context("a file's name is not UTF-8")?.split_terminator('\0') {
        let (from, to) = (root().join(name), to.join(name));
        if let Some(folder) = to.parent() {
            std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
        }
        std::fs::copy(&from, &to).with_context(|| from.display().to_string())?;
    }
    Ok(())
}

/// What a chip would be given: each load address with its bytes.
fn image(path: &Path) -> Result<Vec<u8>> {
    let bytes = std::fs::read(path).with_context(|| path.display().to_string())?;
    let program = elf::read(&bytes).with_context(|| path.display().to_string())?;
    let mut image = Vec::new();
    for segment in &program.segments {
        image.extend_from_slice(&segment.load_address.to_le_bytes());
        image.extend_from_slice(segment.bytes);
    }
    Ok(image)
}

fn same(board: &str, here: &[u8], there: &[u8]) -> Result<()> {
    if let Some(at) = here.iter().zip(there).position(|(here, there)| here != there) {
        bail!("{board}: built elsewhere, byte {at} is {:#04x} and not {:#04x}", there[at], here[at]);
    }
    ensure!(here.len() == there.len(), "{board}: built elsewhere it has {} bytes, not {}", there.len(), here.len());
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::same;

    #[test]
    fn an_image_that_differs_is_refused_with_its_place() {
        let error = same("mote", &[1, 2, 3], &[1, 9, 3]).unwrap_err().to_string();
        assert_eq!(error, "mote: built elsewhere, byte 1 is 0x09 and not 0x02");
        assert!(same("mote", &[1, 2, 3], &[1, 2]).is_err());
        assert!(same("mote", &[1, 2, 3], &[1, 2, 3]).is_ok());
    }
}
