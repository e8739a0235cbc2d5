//! QEMU counts the same instructions.
//!
//! The bench program walks through its stages by itself and prints ticks of a timer; with 1024 ns for an instruction
//! and 62.5 ns for a tick that is exact. The virtual mote calls the same functions with the same inputs.
//!
//! What can go wrong: QEMU is not there and cannot be installed, or hangs. Both are errors.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use sim::core::cycles::Multiplier;

use super::stages::Rig;
use crate::{qemu, setup};

/// Ticks that an instruction takes.
const TICKS: f64 = 1024.0 / 62.5;

/// How long QEMU may take; half a second is enough.
const PATIENCE: Duration = Duration::from_secs(120);

/// Mean instructions of a call, without what an empty one takes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Counted {
    pub(super) qemu: f64,
    pub(super) sim: f64,
}

impl Counted {
    /// How far QEMU is from us, percent.
    pub(super) fn apart(&self) -> f64 {
        100.0 * (self.qemu - self.sim) / self.sim
    }
}

/// Lets both count; by the function's name.
pub(super) fn judge(program: &Path, elf: &[u8]) -> Result<BTreeMap<String, Counted>> {
    setup::emulator()?;
    let printed = run_in_qemu(program)?;
    let mut counted = BTreeMap::new();
    for line in printed.lines() {
        let words: Vec<&str> = line.split_whitespace().collect();
        let [name, steps, with, without] = words[..] else { continue };
        let (steps, with, without): (u32, u32, u32) = (steps.parse()?, with.parse()?, without.parse()?);
        let qemu = (f64::from(with) - f64::from(without)) / TICKS / f64::from(steps);
        counted.insert(name.to_string(), Counted { qemu, sim: walk(elf, name, steps)? });
    }
    ensure!(!counted.is_empty(), "the bench program printed nothing in QEMU");
    Ok(counted)
}

/// What the program prints in QEMU; a few hundred bytes, which any pipe holds.
fn run_in_qemu(program: &Path) -> Result<String> {
    let mut qemu = Command::new(qemu::PROGRAM)
        .args(["-machine", qemu::MACHINE, "-nographic", "-monitor", "none", "-serial", "none"])
        .args(["-icount", "shift=10,sleep=off", "-semihosting-config", "enable=on,target=native", "-kernel"])
        .arg(program)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .spawn()
        .with_context(|| format!("cannot start {}", qemu::PROGRAM))?;
    let began = Instant::now();
    while qemu.try_wait()?.is_none() {
        if began.elapsed() > PATIENCE {
            qemu.kill()?;
            qemu.wait()?;
            bail!("the bench program does not end in QEMU");
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    let output = qemu.wait_with_output()?;
    ensure!(output.status.success(), "the bench program in QEMU: {}", output.status);
    String::from_utf8(output.stdout).context("what the bench program prints")
}

/// The same walk in the virtual mote.
fn walk(elf: &[u8], name: &str, steps: u32) -> Result<f64> {
    let mut rig = Rig::new(elf, Multiplier::Fast)?;
    let (mut with, mut without) = (0, 0);
    for step in 0..steps {
        let arguments = [step * 1000, step * 1000 + 500];
        rig.call("prepare", &[step])?;
        with += rig.call(name, &arguments)?.instructions;
        without += rig.call("stage_empty", &arguments)?.instructions;
    }
    Ok((with - without) as f64 / f64::from(steps))
}
