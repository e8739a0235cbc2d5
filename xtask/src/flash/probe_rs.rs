//! The nRF52840 through its debugger, by the program `probe-rs`.
//!
//! What can go wrong: it is not installed (said with how to install it), it fails (it says why itself), or it hangs (it
//! is ended).

use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};

/// As `probe-rs chip list` has it.
const CHIP: &str = "nRF52840_xxAA";

const BY_HAND: &str = "\
    Linux, macOS: curl --proto '=https' --tlsv1.2 -LsSf https://github.com/probe-rs/probe-rs/releases/latest/download/probe-rs-tools-installer.sh | sh\n  \
    Windows:      irm https://github.com/probe-rs/probe-rs/releases/latest/download/probe-rs-tools-installer.ps1 | iex\n  \
    elsewhere:    cargo install probe-rs-tools --locked\n  \
    Linux also needs a udev rule: https://probe.rs/docs/getting-started/probe-setup";

/// The program and how long it may take.
#[derive(Debug, Clone)]
pub struct ProbeRs {
    /// Its name or its path.
    pub program: PathBuf,
    /// For one call of it.
    pub limit: Duration,
}

impl Default for ProbeRs {
    fn default() -> Self {
        Self { program: "probe-rs".into(), limit: Duration::from_secs(120) }
    }
}

impl ProbeRs {
    /// Makes sure that it is there.
    ///
    /// # Errors
    /// It is not, or does not run.
    pub fn ensure_installed(&self) -> Result<()> {
        let mut asked = Command::new(&self.program);
        asked.arg("--version").stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        let Ok(child) = asked.spawn() else {
            bail!("probe-rs is not installed. Install it and try again:\n  {BY_HAND}");
        };
        if !self.wait(child, "probe-rs --version")?.success() {
            bail!("probe-rs is there but does not run; install it anew:\n  {BY_HAND}");
        }
        Ok(())
    }

    /// What is typed for one mote, in order: write and read back, start.
    #[must_use]
    pub fn commands(elf: &Path) -> [Vec<String>; 2] {
        let words = |words: &[&str]| words.iter().map(|&word| word.to_owned()).collect();
        [
            words(&["download", "--non-interactive", "--chip", CHIP, "--verify", &elf.display().to_string()]),
            words(&["reset", "--non-interactive", "--chip", CHIP]),
        ]
    }

    /// Writes a program and starts it.
    ///
    /// # Errors
    /// `probe-rs` fails or takes too long.
    pub fn program(&self, elf: &Path) -> Result<()> {
        for arguments in Self::commands(elf) {
            let line = format!("probe-rs {}", arguments.join(" "));
            println!("$ {line}");
            let child = Command::new(&self.program).args(&arguments).stdin(Stdio::null()).spawn();
            let status = self.wait(child.with_context(|| format!("cannot start {line}"))?, &line)?;
            if !status.success() {
                bail!("{line}: {status}");
            }
        }
        Ok(())
    }

    fn wait(&self, mut child: Child, line: &str) -> Result<ExitStatus> {
        let until = Instant::now() + self.limit;
        loop {
            if let Some(status) = child.try_wait()? {
                return Ok(status);
            }
            if Instant::now() >= until {
                child.kill()?;
                child.wait()?;
                bail!("{line}: ended after {} s without result", self.limit.as_secs_f64());
            }
            sleep(Duration::from_millis(20));
        }
    }
}
