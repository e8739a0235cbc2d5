//! One program on QEMU's `microbit`, a true Cortex-M0: unaligned accesses fault here as they do on the mote.
//!
//! The program logs through semihosting, which QEMU writes to its standard output as binary `defmt` frames; the
//! strings they stand for are in the program's own file. Virtual time is counted in instructions, 64 ns each, so that
//! a run is the same run on any computer.
//!
//! What can go wrong: the program hangs (the time limit ends it, exit code 124), faults (its own handler exits), or
//! faults in its fault handler (QEMU gives up: most likely the stack ran over).

use std::io::{ErrorKind, Read, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::{Duration, Instant};
use std::{fs, io, thread};

use anyhow::{Context, Result, bail};
use defmt_decoder::{DecodeError, Frame, Locations, Table};

/// The emulator.
pub(crate) const PROGRAM: &str = "qemu-system-arm";
/// The board: an nRF51822 with its Cortex-M0, 256 KiB of flash, 16 KiB of RAM.
pub(crate) const MACHINE: &str = "microbit";
/// The exit code of a run that was ended from here, as that of timeout(1).
const TIMED_OUT: u8 = 124;

/// A running emulator, ended at the latest when nobody looks at it any more.
struct Machine(Child);

impl Drop for Machine {
    fn drop(&mut self) {
        // Both fail when it has ended by itself.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// What the machine is connected to.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Wires<'a> {
    /// Where what it says on its serial port goes.
    pub(crate) serial: Option<&'a Path>,
    /// A file that lies in its flash, and where.
    pub(crate) flash: Option<(&'a Path, u32)>,
}

impl Wires<'_> {
    fn arguments(&self) -> Vec<String> {
        // A comma in QEMU's own options is written twice.
        let name = |path: &Path| path.display().to_string().replace(',', ",,");
        let serial = self.serial.map_or_else(|| "none".to_string(), |path| format!("file:{}", path.display()));
        let flash = self.flash.map(|(path, at)| format!("loader,file={},addr={at:#x},force-raw=on", name(path)));
        let device = flash.into_iter().flat_map(|flash| ["-device".to_string(), flash]);
        ["-serial".to_string(), serial].into_iter().chain(device).collect()
    }
}

/// Runs `elf`, prints its log and gives the code it exits with.
pub(crate) fn qemu(elf: &Path, timeout: Duration) -> Result<u8> {
    run(elf, &Wires::default(), timeout)
}

/// The same, connected to something.
pub(crate) fn run(elf: &Path, wires: &Wires<'_>, timeout: Duration) -> Result<u8> {
    let image = fs::read(elf).with_context(|| format!("cannot read the program {}", elf.display()))?;
    let table = Table::parse(&image).with_context(|| format!("the log strings of {}", elf.display()))?;
    let locations = match &table {
        Some(table) => table.get_locations(&image).with_context(|| format!("the lines of {}", elf.display()))?,
        None => Locations::new(),
    };
    let mut machine = Machine(
        Command::new(PROGRAM)
            .args(["-machine", MACHINE, "-nographic", "-monitor", "none"])
            .args(wires.arguments())
            .args(["-icount", "shift=6,sleep=off", "-semihosting-config", "enable=on,target=native", "-kernel"])
            .arg(elf)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .with_context(|| format!("cannot start {PROGRAM}; `cargo xtask test` installs it"))?,
    );
    let mut stdout = machine.0.stdout.take().context("QEMU's output")?;
    let (sender, receiver) = channel();
    thread::spawn(move || {
        let mut bytes = [0; 4096];
        loop {
            let read = match stdout.read(&mut bytes) {
                Ok(0) => return,
                Ok(read) => read,
                Err(error) if error.kind() == ErrorKind::Interrupted => continue,
                Err(_) => return,
            };
            if sender.send(bytes[..read].to_vec()).is_err() {
                return;
            }
        }
    });

    let mut decoder = table.as_ref().map(Table::new_stream_decoder);
    let deadline = Instant::now() + timeout;
    loop {
        match receiver.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
            Ok(bytes) => match &mut decoder {
                None => io::stdout().write_all(&bytes)?,
                Some(decoder) => {
                    decoder.received(&bytes);
                    loop {
                        match decoder.decode() {
                            Ok(frame) => print(&frame, &locations),
                            Err(DecodeError::UnexpectedEof) => break,
                            Err(DecodeError::Malformed) => println!("(a damaged log frame)"),
                        }
                    }
                }
            },
            Err(RecvTimeoutError::Disconnected) => break,
            Err(RecvTimeoutError::Timeout) => {
                eprintln!(
                    "error: {} did not end within {} s: it hangs, or waits for ever",
                    elf.display(),
                    timeout.as_secs()
                );
                return Ok(TIMED_OUT);
            }
        }
    }
    let status = machine.0.wait().context("lost sight of QEMU")?;
    match status.code() {
        Some(code) => Ok(u8::try_from(code).unwrap_or(u8::MAX)),
        None => bail!("QEMU gave up ({status}): a fault inside the fault handler, most likely a stack that ran over"),
    }
}

/// What went well needs no place; what did not says where it was said.
fn print(frame: &Frame<'_>, locations: &Locations) {
    let message = frame.display_message();
    match frame.level() {
        Some(level) if level.as_str() != "info" => {
            println!("{}: {message}", level.as_str());
            if let Some(location) = locations.get(&frame.index()) {
                println!("  at {}:{}", location.file.display(), location.line);
            }
        }
        _ => println!("{message}"),
    }
}
