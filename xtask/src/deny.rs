//! What comes in from elsewhere: licences, sources, and known holes of every crate, by cargo-deny.
//!
//! What can go wrong: cargo-deny is not there and is built first, which takes minutes; the list of known holes cannot be
//! fetched, which is said and leaves the rest checked.

use std::path::Path;
use std::process::Command;

use anyhow::Result;

use crate::process::run;
use crate::setup;

const TOOL: &str = "cargo-deny";
/// Every `Cargo.lock` of the repository stands beside one of these.
pub(crate) const MANIFESTS: [&str; 3] = ["Cargo.toml", "fuzz/Cargo.toml", "sim/tests/judge/Cargo.toml"];

/// Whether cargo-deny is on this computer already.
pub(crate) fn is_there() -> bool {
    setup::has_tool(TOOL)
}

/// Checks every workspace.
pub(crate) fn deny() -> Result<()> {
    let program = setup::tool(TOOL, &[])?;
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

fn command(program: &Path, manifest: &str) -> Command {
    let mut command = Command::new(program);
    command.args(["--log-level", "error", "--config", "deny.toml", "--manifest-path", manifest]);
    command.args(["check", "--hide-inclusion-graph"]);
    command
}
