//! What comes in from elsewhere: licences, sources, and known holes of every crate, by cargo-deny.
//!
//! What can go wrong: cargo-deny is not there and is built first, which takes minutes; the list of known holes cannot be
//! fetched, which is said and leaves the rest checked.

use std::path::PathBuf;
use std::process::{Command, Stdio};

use anyhow::Result;

use crate::process::{cargo, root, run};

/// Every `Cargo.lock` of the repository stands beside one of these.
const MANIFESTS: [&str; 2] = ["Cargo.toml", "fuzz/Cargo.toml"];
/// Where cargo-deny goes if it has to be built.
const TOOLS: &str = "target/tools";

/// Checks both workspaces.
pub(crate) fn deny() -> Result<()> {
    let program = program()?;
    for manifest in MANIFESTS {
        let checks = ["bans", "licenses", "sources"];
        run(command(&program, manifest).args(checks))?;
    }
    let mut fetch = Command::new(&program);
    if run(fetch.args(["--log-level", "off", "--config", "deny.toml", "fetch", "db"])).is_err() {
        println!("skipped: the list of known holes cannot be fetched here; where it can, this checks against it");
        return Ok(());
    }
    for manifest in MANIFESTS {
        run(command(&program, manifest).arg("advisories"))?;
    }
    Ok(())
}

fn command(program: &PathBuf, manifest: &str) -> Command {
    let mut command = Command::new(program);
    command.args(["--log-level", "error", "--config", "deny.toml", "--manifest-path", manifest]);
    command.args(["check", "--hide-inclusion-graph"]);
    command
}

/// The cargo-deny that is installed, or one of our own.
fn program() -> Result<PathBuf> {
    let installed = PathBuf::from("cargo-deny");
    let asked = Command::new(&installed).arg("--version").stdout(Stdio::null()).stderr(Stdio::null()).status();
    if asked.is_ok_and(|status| status.success()) {
        return Ok(installed);
    }
    let own = root().join(TOOLS).join("bin/cargo-deny");
    if !own.exists() {
        println!("There is no cargo-deny: building it into {TOOLS}. That takes some minutes, once.");
        run(&mut cargo(&["install", "cargo-deny", "--locked", "--root", TOOLS]))?;
    }
    Ok(own)
}
