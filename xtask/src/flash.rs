//! From a release build to a chip: one program, as many motes of a room as there are in the tray.
//!
//! ```text
//! ELF -> identity::patch -> image::package -> nrf_dk | teensy     SCuM-3C, RAM only: lost at power-off
//!                  |-> probe_rs                                   nRF52840
//! ```
//!
//! What can go wrong: arguments are checked and the programmer is found before anything is built; each part says what
//! else. Nothing is ever called programmed that was not acknowledged as far as the programmer can.

pub mod identity;
pub mod image;
pub mod line;
pub mod nrf_dk;
pub mod port;
pub mod probe_rs;
pub mod teensy;
pub mod tray;

use std::io::{BufRead, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result, ensure};
use lighthouse_mote::identity::first_counter;
use sim::elf;

use crate::whole;
use identity::Change;
use line::Line;
use port::{Found, Programmer};
use probe_rs::ProbeRs;
use teensy::Way;
use tray::Ids;

/// What can be flashed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Board {
    /// The single-chip micro mote, through an nRF52840-DK or a Teensy
    Scum3c,
    /// An nRF52840, through its debugger and probe-rs
    Nrf52840,
}

impl Board {
    /// Its binary and its cargo feature.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Scum3c => "scum3c",
            Self::Nrf52840 => "nrf52840",
        }
    }
}

/// What flashing may be told.
#[derive(clap::Args, Debug, Clone)]
pub struct Arguments {
    /// What is to be flashed
    pub board: Board,
    /// The room to bake into the motes; another room is another build [default: calib/default.toml]
    #[arg(long, value_name = "FILE", env = "LIGHTHOUSE_CALIB")]
    pub calib: Option<PathBuf>,
    /// The mote's id [default: the one under `[mote]` in the room]
    #[arg(long, value_name = "N", value_parser = tray::id)]
    pub id: Option<u16>,
    /// A tray of motes, one after the other: 1..20, both ends meant, or a list like 3,7,9..12
    #[arg(long, value_name = "FIRST..LAST", conflicts_with = "id")]
    pub ids: Option<Ids>,
    /// The radio channel
    #[arg(long, value_name = "11..26", value_parser = channel)]
    pub channel: Option<u8>,
    /// The programmer's serial port, if it is not found by itself
    #[arg(long)]
    pub port: Option<String>,
    /// Which programmer, if its port does not tell
    #[arg(long)]
    pub programmer: Option<Programmer>,
    /// A Teensy uses its three wires instead of light
    #[arg(long)]
    pub wired: bool,
    /// Build, and write what would be sent to target/flash, without a programmer
    #[arg(long)]
    pub dry_run: bool,
}

/// A channel of the 2.4 GHz band (IEEE 802.15.4-2006, 6.1.2.1).
fn channel(text: &str) -> Result<u8, String> {
    match text.parse::<u64>() {
        Ok(channel @ 11..=26) => Ok(channel as u8),
        _ => Err(format!("{text} is no channel of IEEE 802.15.4 in the 2.4 GHz band: 11 ..= 26")),
    }
}

/// How long the steps of a programmer may take, and do take where it does not tell.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Timing {
    /// For an answer: what scum-sdk's script allows.
    pub answer: Duration,
    /// For sending 64 KiB to the mote: 2 to 3 s by the programmers' loops, light and wire alike.
    pub boot: Duration,
    /// What the mote gets for checking its CRC before the calibration begins, as the Teensy's later script does.
    pub check: Duration,
    /// For a calibration: 30 marks 100 ms apart.
    pub calibration: Duration,
}

impl Default for Timing {
    fn default() -> Self {
        Self {
            answer: Duration::from_secs(5),
            boot: Duration::from_secs(30),
            check: Duration::from_secs(2),
            calibration: Duration::from_secs(4),
        }
    }
}

/// Hears how many of the 65,536 bytes have been sent.
pub type Progress<'a> = &'a mut dyn FnMut(usize);

/// What flashing needs from whoever builds.
pub struct Workshop<'a> {
    /// The root of the repository.
    pub root: &'a Path,
    /// The room when nobody names one, below the root.
    pub default_calib: &'a str,
    /// Checks that a room can be baked.
    pub check: &'a dyn Fn(&Path) -> Result<()>,
    /// Builds a board's release program for a room: the ELF file's bytes.
    pub build: &'a dyn Fn(Board, &Path) -> Result<Vec<u8>>,
}

/// Where a mote's program goes.
enum Target {
    File,
    Scum(Found),
    Probe(ProbeRs),
}

/// Builds and programs what was asked for; asks at `input`.
///
/// # Errors
/// Nothing was programmed, or not all that was asked for.
pub fn flash(arguments: &Arguments, workshop: &Workshop<'_>, input: &mut dyn BufRead) -> Result<()> {
    let board = arguments.board;
    let calib = arguments.calib.clone().unwrap_or_else(|| workshop.root.join(workshop.default_calib));
    (workshop.check)(&calib)?;
    let target = target(arguments, input)?;
    let elf = (workshop.build)(board, &calib)?;
    println!("{}", size(board, &elf, &calib)?);
    let motes: Vec<Option<u16>> = match (&arguments.ids, arguments.id) {
        (Some(ids), _) => ids.list().iter().copied().map(Some).collect(),
        (None, id) => vec![id],
    };
    // Whatever cannot be changed or packed is said before anybody has connected a mote.
    let program = |mote| Program::of(board, &elf, Change { mote, pan: None, channel: arguments.channel });
    for &mote in &motes {
        program(mote)?;
    }
    let folder = workshop.root.join("target/flash");
    match (&arguments.ids, &target) {
        (Some(ids), Target::Scum(_) | Target::Probe(_)) => {
            let stdout = &mut std::io::stdout();
            let outcome =
                tray::walk(ids, input, stdout, |id| program(Some(id))?.put(&target, arguments.wired, &folder))?;
            outcome.conclude(stdout, &again(arguments, |name| std::env::var(name).ok()))
        }
        _ => motes.iter().try_for_each(|&mote| program(mote)?.put(&target, arguments.wired, &folder)),
    }
}

/// Finds the programmer, before anything is built.
fn target(arguments: &Arguments, input: &mut dyn BufRead) -> Result<Target> {
    let programmer = arguments.programmer;
    if arguments.board == Board::Nrf52840 {
        ensure!(
            arguments.port.is_none() && programmer.is_none() && !arguments.wired,
            "--port, --programmer and --wired are for the SCuM-3C; probe-rs finds a debugger by itself, and \
             PROBE_RS_PROBE=VID:PID:SERIAL names one of several"
        );
        if arguments.dry_run {
            return Ok(Target::File);
        }
        let probe_rs = ProbeRs::default();
        probe_rs.ensure_installed()?;
        return Ok(Target::Probe(probe_rs));
    }
    ensure!(
        !arguments.wired || programmer != Some(Programmer::Nrf),
        "--wired is for a Teensy; the nRF52840-DK has nothing but wires"
    );
    if arguments.dry_run {
        return Ok(Target::File);
    }
    let asked = if arguments.wired { Some(Programmer::Teensy) } else { programmer };
    let input: Option<&mut dyn BufRead> = if std::io::stdin().is_terminal() { Some(input) } else { None };
    let found = port::choose(&port::all()?, arguments.port.as_deref(), asked, input)?;
    // Opened once already now: a port that cannot be had is said before the build.
    Line::open(&found.port, baud(found.programmer))?;
    println!("programmer: {} at {}", found.programmer, found.port);
    Ok(Target::Scum(found))
}

fn baud(programmer: Programmer) -> u32 {
    match programmer {
        Programmer::Nrf => nrf_dk::BAUD,
        Programmer::Teensy => teensy::BAUD,
    }
}

/// What a call takes from its environment, besides the room, which is said anew.
const ENVIRONMENT: [&str; 3] = ["LIGHTHOUSE_MOTE", "LIGHTHOUSE_KEY", "PROBE_RS_PROBE"];

/// The same call without its ids, for a shell; `environment` is asked for what it was told there.
fn again(arguments: &Arguments, environment: impl Fn(&str) -> Option<String>) -> String {
    let mut line = String::new();
    for name in ENVIRONMENT {
        if let Some(value) = environment(name).filter(|value| !value.is_empty()) {
            line.push_str(&format!("{name}={} ", quoted(&value)));
        }
    }
    line.push_str(&format!("cargo xtask flash {}", arguments.board.name()));
    let mut add = |name: &str, value: Option<String>| {
        if let Some(value) = value {
            line.push_str(&format!(" --{name} {}", quoted(&value)));
        }
    };
    add("calib", arguments.calib.as_ref().map(|calib| calib.display().to_string()));
    add("channel", arguments.channel.map(|channel| channel.to_string()));
    add("port", arguments.port.clone());
    add("programmer", arguments.programmer.map(|programmer| programmer.to_string()));
    if arguments.wired {
        line.push_str(" --wired");
    }
    line
}

/// As a shell takes it for one word.
fn quoted(word: &str) -> String {
    // No argument and no variable can hold a NUL, which is all that cannot be said.
    shlex::try_quote(word).map_or_else(|_| word.to_owned(), |quoted| quoted.into_owned())
}

/// What the program takes of the board's memories.
fn size(board: Board, elf: &[u8], calib: &Path) -> Result<String> {
    let program = elf::read(elf)?;
    let code: usize = program.segments.iter().map(|segment| segment.bytes.len()).sum();
    // From the stack's top (memory.x) to the first byte behind all variables (cortex-m-rt).
    let top = program.symbols.address("_stack_start").unwrap_or(sim::memory::DATA_START);
    let data = program.symbols.address("__sheap").map(|end| end.saturating_sub(top));
    let of = match board {
        Board::Scum3c => image::LENGTH_AT,
        Board::Nrf52840 => 1024 * 1024,
    };
    let data = data.map_or(String::new(), |data| format!(", variables {data} bytes"));
    Ok(format!("{} for {}: {code} of {of} bytes{data}", board.name(), calib.display()))
}

/// One mote's program, ready to be sent.
enum Program {
    Scum { name: String, image: image::Image },
    Elf { name: String, bytes: Vec<u8> },
}

impl Program {
    fn of(board: Board, elf: &[u8], change: Change) -> Result<Self> {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs());
        let bytes = identity::count_from(&identity::patch(elf, change)?, first_counter(now))?;
        // A board whose firmware has no block has the id of its room.
        let name = match identity::read(&bytes) {
            Ok(identity) => format!("{}-{}", board.name(), identity.mote),
            Err(_) => board.name().to_owned(),
        };
        match board {
            Board::Scum3c => Ok(Self::Scum { name, image: image::package(&bytes)? }),
            Board::Nrf52840 => Ok(Self::Elf { name, bytes }),
        }
    }

    /// Sends it, or writes it down.
    fn put(&self, target: &Target, wired: bool, folder: &Path) -> Result<()> {
        match (self, target) {
            (Self::Scum { image, .. }, Target::Scum(found)) => scum(image, found, wired),
            (Self::Scum { name, image }, _) => {
                let file = write(folder, &format!("{name}.bin"), image.bytes())?;
                println!("{}: {} bytes, CRC-32 {:#010x}", file.display(), image.length(), image.crc());
                Ok(())
            }
            (Self::Elf { name, bytes }, target) => {
                let file = write(folder, &format!("{name}.elf"), bytes)?;
                if let Target::Probe(probe_rs) = target {
                    return probe_rs.program(&file);
                }
                for arguments in ProbeRs::commands(&file) {
                    println!("would run: probe-rs {}", arguments.join(" "));
                }
                Ok(())
            }
        }
    }
}

fn scum(image: &image::Image, found: &Found, wired: bool) -> Result<()> {
    let mut line = Line::open(&found.port, baud(found.programmer))?;
    let mut bar = Bar::new();
    let mut progress = |sent| bar.show(sent);
    let timing = Timing::default();
    let sent = match found.programmer {
        Programmer::Nrf => nrf_dk::program(&mut line, image, &timing, &mut progress),
        Programmer::Teensy => {
            let way = if wired { Way::Wire } else { Way::Light };
            teensy::program(&mut line, image, way, &timing, &mut progress)
        }
    };
    bar.end();
    sent?;
    println!(
        "{}",
        match found.programmer {
            Programmer::Nrf => "programmed: every chunk's check sequence was right; the mote was booted and calibrated",
            Programmer::Teensy =>
                "sent, booted and calibrated; a Teensy checks nothing: the mote's own CRC check has to",
        }
    );
    Ok(())
}

fn write(folder: &Path, name: &str, bytes: &[u8]) -> Result<PathBuf> {
    let file = folder.join(name);
    std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    whole::write(&file, bytes)?;
    Ok(file)
}

/// The line that shows how far it is: redrawn on a terminal, a line at each quarter elsewhere.
struct Bar {
    terminal: bool,
    quarters: usize,
}

impl Bar {
    fn new() -> Self {
        Self { terminal: std::io::stdout().is_terminal(), quarters: 0 }
    }

    fn show(&mut self, sent: usize) {
        const WIDTH: usize = 32;
        if self.terminal {
            let filled = sent * WIDTH / image::LEN;
            let (done, rest) = ("#".repeat(filled), "-".repeat(WIDTH - filled));
            print!("\r\x1b[2K[{done}{rest}] {sent} of {} bytes", image::LEN);
            // A terminal that is gone is no reason to stop.
            let _ = std::io::stdout().flush();
        } else if sent * 4 / image::LEN > self.quarters {
            self.quarters = sent * 4 / image::LEN;
            println!("{sent} of {} bytes", image::LEN);
        }
    }

    fn end(&self) {
        if self.terminal {
            println!();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rest_of_a_tray_is_asked_for_as_the_tray_was() {
        let arguments = Arguments {
            board: Board::Scum3c,
            calib: Some("my rooms/it's \"lab\" $1.toml".into()),
            id: None,
            ids: None,
            channel: Some(17),
            port: Some("/dev/tty USB0".into()),
            programmer: None,
            wired: true,
            dry_run: false,
        };
        let mote = "pan = 0x4c49\nsend = \"slotted\"";
        let told = |name: &str| match name {
            "LIGHTHOUSE_MOTE" => Some(mote.to_owned()),
            "LIGHTHOUSE_KEY" => Some("keys/lab 1.key".to_owned()),
            _ => Some(String::new()),
        };
        let line = again(&arguments, told);
        let words = [
            &format!("LIGHTHOUSE_MOTE={mote}"),
            "LIGHTHOUSE_KEY=keys/lab 1.key",
            "cargo",
            "xtask",
            "flash",
            "scum3c",
            "--calib",
            "my rooms/it's \"lab\" $1.toml",
            "--channel",
            "17",
            "--port",
            "/dev/tty USB0",
            "--wired",
        ];
        assert_eq!(shlex::split(&line).unwrap(), words, "{line}");
        let plain = Arguments { calib: None, port: None, wired: false, ..arguments };
        assert_eq!(again(&plain, |_| None), "cargo xtask flash scum3c --channel 17");
        #[cfg(unix)]
        {
            // What a shell makes of it.
            let say = line.replace("cargo xtask flash", "printenv LIGHTHOUSE_MOTE LIGHTHOUSE_KEY #");
            let said = std::process::Command::new("sh").args(["-c", &say]).output().unwrap();
            assert_eq!(String::from_utf8(said.stdout).unwrap(), format!("{mote}\nkeys/lab 1.key\n"));
        }
    }
}
