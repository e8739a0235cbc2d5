//! What a verb needs on the computer, fetched if it is not there.
//!
//! Rust targets come through rustup, QEMU through the system's package manager: nothing is installed without a line
//! that says so.
//!
//! What can go wrong: no rustup, no known package manager, no right to install. The error then says what to type.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, Result, anyhow, bail};

use crate::process::{cargo, root, run};
use crate::qemu;

/// SCuM-3C and the emulated board both have a Cortex-M0.
pub(crate) const CORTEX_M0: &str = "thumbv6m-none-eabi";
/// The nRF52840 has a Cortex-M4 with floating point.
pub(crate) const CORTEX_M4F: &str = "thumbv7em-none-eabihf";

/// Where programs go that have to be built.
const TOOLS: &str = "target/tools";

/// How to get QEMU by hand.
const QEMU_BY_HAND: &str = "\
    Debian, Ubuntu: sudo apt-get install qemu-system-arm\n  \
    Fedora:         sudo dnf install qemu-system-arm-core\n  \
    Arch:           sudo pacman -S qemu-system-arm\n  \
    macOS:          brew install qemu\n  \
    elsewhere:      https://www.qemu.org/download";

/// Makes sure that the pinned toolchain can compile for `target`.
pub(crate) fn target(target: &str) -> Result<()> {
    if has_target(target)? {
        return Ok(());
    }
    println!("The Rust toolchain cannot compile for {target} yet: adding that through rustup.");
    run(Command::new("rustup").args(["target", "add", target])).with_context(|| {
        format!("{target} is missing; with rustup (https://rustup.rs) it is `rustup target add {target}`")
    })
}

/// Whether the core library for `target` is there.
fn has_target(target: &str) -> Result<bool> {
    let asked = Command::new("rustc")
        .args(["--print", "target-libdir", "--target", target])
        .current_dir(root())
        .output()
        .context("cannot start rustc")?;
    Ok(asked.status.success() && Path::new(String::from_utf8_lossy(&asked.stdout).trim()).is_dir())
}

/// Makes sure that QEMU is there and knows the board.
pub(crate) fn emulator() -> Result<()> {
    if has_board() {
        return Ok(());
    }
    if !runs(Command::new("apt-get").arg("--version")) {
        bail!("QEMU with its `{}` board is not installed. Install it and try again:\n  {QEMU_BY_HAND}", qemu::MACHINE);
    }
    println!("QEMU is not installed: installing the package qemu-system-arm through apt-get.");
    install("qemu-system-arm").map_err(|error| {
        anyhow!("QEMU could not be installed ({error:#}). Install it by hand and try again:\n  {QEMU_BY_HAND}")
    })?;
    if !has_board() {
        bail!("{} was installed, but it does not start or has no `{}` board", qemu::PROGRAM, qemu::MACHINE);
    }
    Ok(())
}

/// Makes sure that there is a C++ compiler, which libFuzzer is written for.
pub(crate) fn cpp_compiler() -> Result<()> {
    package("g++", "There is no C++ compiler", runs(Command::new("c++").arg("--version")))
}

/// Whether a tool is there, installed or built by [`tool`] before.
pub(crate) fn has_tool(name: &str) -> bool {
    is_installed(name) || own_tool(name).exists()
}

fn is_installed(name: &str) -> bool {
    runs(Command::new(name).arg("--version"))
}

/// Where [`tool`] builds one.
fn own_tool(name: &str) -> PathBuf {
    root().join(TOOLS).join("bin").join(name)
}

/// A program of cargo's registry: the one that is installed, or one built for us with `flags`.
pub(crate) fn tool(name: &str, flags: &[&str]) -> Result<PathBuf> {
    if is_installed(name) {
        return Ok(name.into());
    }
    let own = own_tool(name);
    if !own.exists() {
        println!("There is no {name}: building it into {TOOLS}. That takes some minutes, once.");
        run(cargo(&["install", name, "--locked", "--root", TOOLS]).args(flags))?;
    }
    Ok(own)
}

/// Makes sure that there is an MQTT broker to test against. Debian puts it where only root looks.
pub(crate) fn broker() -> Result<()> {
    let there = ["/usr/sbin/mosquitto", "/usr/bin/mosquitto", "/usr/local/sbin/mosquitto"];
    let is_there = there.iter().any(|path| Path::new(path).is_file());
    package("mosquitto", "There is no MQTT broker to test against", is_there)
}

/// Makes sure that there is a tshark, which the tests of what Wireshark shows ask.
pub(crate) fn tshark() -> Result<()> {
    package("tshark", "tshark is not installed", runs(Command::new("tshark").arg("--version")))
}

/// Makes sure that there is a browser to look at pages with.
pub(crate) fn browser() -> Result<()> {
    let is_there = runs(Command::new("chromium").arg("--version"));
    package("chromium", "There is no browser to test against", is_there)
}

/// Installs what `is_there` says is missing, after a line that says so.
fn package(name: &str, missing: &str, is_there: bool) -> Result<()> {
    if is_there {
        return Ok(());
    }
    println!("{missing}: installing the package {name} through apt-get.");
    install(name).map_err(|error| anyhow!("{name} could not be installed ({error:#}); install it and try again"))
}

fn has_board() -> bool {
    let asked = Command::new(qemu::PROGRAM).args(["-machine", "help"]).stdin(Stdio::null()).output();
    asked.is_ok_and(|asked| String::from_utf8_lossy(&asked.stdout).lines().any(|line| line.starts_with(qemu::MACHINE)))
}

/// Installs a package with the rights that takes: as root, or through a sudo that asks no password.
fn install(package: &str) -> Result<()> {
    let asked = Command::new("id").arg("-u").output().context("cannot start id")?;
    let with_rights: &[&str] = if asked.stdout.trim_ascii() == b"0" {
        &["env"]
    } else if runs(Command::new("sudo").args(["-n", "true"])) {
        &["sudo", "-n", "env"]
    } else {
        bail!("apt-get needs root, and sudo asks for a password");
    };
    let apt_get = |arguments: &[&str]| {
        let mut command = Command::new(with_rights[0]);
        command.args(&with_rights[1..]).args(["DEBIAN_FRONTEND=noninteractive", "apt-get"]);
        run(command.args(arguments))
    };
    // A list that cannot be refreshed may still be good enough; if not, the installation says so.
    if let Err(error) = apt_get(&["update"]) {
        println!("{error:#}; going on with the package lists as they are");
    }
    apt_get(&["install", "--yes", "--no-install-recommends", package])
}

/// Whether a program is there and content.
fn runs(command: &mut Command) -> bool {
    let asked = command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).status();
    asked.is_ok_and(|status| status.success())
}
