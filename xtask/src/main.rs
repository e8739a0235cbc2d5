//! Everything a person types.
//!
//! One verb, one file. The verbs need no flags in the common case and work from any folder of the repository.
//!
//! What can go wrong: something is missing on the computer. A verb first gets what it needs, and says so; what it
//! cannot get itself it names.

use std::panic::{self, PanicHookInfo};
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};

use clap::{Parser, Subcommand};
use xtask::flash;

mod bake;
mod bench;
mod ci;
mod claims;
mod deny;
mod expected;
mod faults;
mod firmware;
mod fuzz;
mod lit;
mod log;
mod memory;
mod oracle;
mod process;
mod qemu;
mod reproduce;
mod room;
mod run;
mod scenes;
mod setup;
#[cfg(test)]
mod silicon;
mod soak;
mod test;

/// Motes that find their own position in the light of two Lighthouse stations
#[derive(Parser)]
#[command(name = "cargo xtask", bin_name = "cargo xtask")]
struct Arguments {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Subcommand)]
enum Verb {
    /// Fly the firmware without a chip: boot it in the virtual mote, in simulated or recorded light, and see how well
    /// it finds itself
    ///
    /// Prints what the mote reports while it runs and a table at the end, and writes target/run: fixes.csv,
    /// frames.pcap (for Wireshark), trajectory.svg (look at it), summary.json. With --board microbit the same light then
    /// goes to that board in QEMU, and a fix that differs in one bit is an error.
    Run(run::Arguments),
    /// Show what a room becomes on the mote: which solver it gets, and how exact that is
    Bake {
        /// The calibration
        #[arg(default_value = "calib/default.toml", env = "LIGHTHOUSE_CALIB")]
        calib: PathBuf,
    },
    /// Measure a room: from a walk under motion capture, or from known places without any
    ///
    /// Writes the room (calib/lab.toml), checked and ready for bake, run and the build, and a report to look at
    /// (target/calibrate/report.html) that says whether it can be trusted. A room file that this wrote before is
    /// replaced and kept as .toml~; what stands under its [mote] is carried over, and so are its stations' serial numbers.
    Calibrate(xtask::calibrate::Arguments),
    /// Look at a recording of pulses as the mote does: is there a cycle in it, who flashes, what do the stations say
    ///
    /// For a mote or a photodiode with a logic analyser: a CSV file of rise_ticks and width_ticks, of any clock. Prints
    /// lock, rates, widths, the clock as the rotors measure it, the stations' own frames and the angles of each rotor.
    Pulses(xtask::pulses::Arguments),
    /// Count what the firmware costs: instructions, cycles, flash and stack of each stage, processor load, delays, sizes
    ///
    /// Runs the release firmware's own code in the virtual mote, beside what the position would cost the usual way,
    /// and has QEMU count the same instructions. Prints one table and writes target/bench/summary.json. What grew
    /// since tests/expected/bench.txt was written is an error.
    Bench(bench::Arguments),
    /// Weigh every board's image: code, constants, variables, and the deepest that its stack can ever be
    ///
    /// The stack is bounded by reading the program: frames, calls, and the worst nesting of priorities. What may not fit
    /// into its room, or grew since tests/expected/memory.txt was written, is an error.
    Memory(memory::Arguments),
    /// Put the firmware into light that is not kind: occlusions, reflections, strobes, stuck lines, moved stations
    ///
    /// Runs the release firmware in the virtual mote through every named scene. Prints one table and writes
    /// target/scenes: summary.json, range.svg, incidence.svg. A promise that is broken, or a figure that is not in
    /// tests/expected/scenes.txt, is an error.
    Scenes(scenes::Arguments),
    /// Hear motes and see where they are: one or a swarm, from receivers, captures, or simulated
    ///
    /// A dashboard in the terminal, CSV, JSON lines, a broker, a recording. docs/listening.md is the manual.
    Listen(xtask::listen::Arguments),
    /// Show a recording of `listen --record` again
    Replay(xtask::listen::Replay),
    /// Let one mote live for a day: hostile scenes and clear light in turn, its counter wrapping hundreds of times
    ///
    /// Runs the release firmware in the virtual mote. Prints a line for each half hour and the last hour beside the
    /// first, and writes target/soak/summary.json. A crash, a lost frame, a drift, a wrong fix is an error.
    Soak(soak::Arguments),
    /// Let the chip misbehave: bits of data RAM flip, power dips, lines storm, timer and radio stand still
    ///
    /// Runs the release firmware in the virtual mote, thousands of times from one settled state. Prints one table and
    /// writes target/faults/summary.json. A wrong position reported as good for more than a second, or silence though
    /// there is light, or a watchdog that lets silence last, is an error.
    Faults(faults::Arguments),
    /// Put the firmware onto a chip, or onto a tray of chips: release build with the room and the id, size, programming
    ///
    /// A SCuM-3C through an nRF52840-DK or a Teensy on a serial port, an nRF52840 through probe-rs. docs/flashing.md has
    /// the wires and the formats.
    Flash(flash::Arguments),
    /// Count how many motes a channel carries: frames of real length, motes in the same light, ways to send side by side
    ///
    /// Prints what a swarm loses at each rate and how many motes there may be, beside the 2020 paper's way of sending raw
    /// timings, and writes target/swarm: loss.svg. docs/air.md has what follows from it.
    Swarm(xtask::swarm::Arguments),
    /// Run every test: on this computer, and on an emulated Cortex-M0 like the one in the mote
    ///
    /// Installs what that needs: the Rust target of the mote's processor through rustup, and QEMU through the
    /// system's package manager.
    Test,
    /// Let loose what nobody thought of: maimed light through the whole path, bytes as frames, serial lines, captures
    ///
    /// Half a minute each. What crashes is kept under target/fuzz, with what to type to run it again.
    Fuzz(fuzz::Arguments),
    /// Count every number of the README and the docs anew, and see that the texts say just that
    ///
    /// Runs the commands that the numbers come from; those that need recordings which are not here are skipped, those
    /// that take long are run with --long. Says of which numbers that is so. A number in the README or in a chapter that
    /// tests/expected/claims.toml does not have is an error.
    Claims(claims::Arguments),
    /// Build every image a second time, from a copy in another folder, and see that not a byte differs
    ///
    /// Prints the images' SHA-256, for someone who holds an image and wants to know what it was built from.
    Reproduce,
    /// Bind the docs into a book to read in a browser: target/book/index.html
    Book,
    /// Look at what comes in from elsewhere: licences, sources, known holes
    Deny,
    /// Run all that a change has to pass: formatting, lints for this computer and for each board, every test, every cost
    Ci,
    /// Draw the pictures of docs that come from the simulated room
    #[command(hide = true)]
    Pictures,
    /// Hold the calibration's solver against OpenCV's on simulated rooms; needs Python and its package index
    #[command(hide = true)]
    Oracle {
        /// How many rooms
        #[arg(long, default_value_t = 20)]
        rooms: u64,
    },
    /// Run one program on the emulated Cortex-M0 and print its log; cargo calls this for `cargo test --target ...`
    #[command(hide = true)]
    Qemu {
        /// The program, as the linker made it
        elf: PathBuf,
        /// How long it may run before it counts as hanging
        #[arg(long, value_name = "SECONDS", default_value_t = 120)]
        timeout: u64,
    },
}

/// Whoever read the standard output has gone.
static READER_GONE: AtomicBool = AtomicBool::new(false);

/// Whether `println!` found nobody who reads: the system's error 32.
fn is_reader_gone(panic: &PanicHookInfo<'_>) -> bool {
    let what = panic.payload_as_str().unwrap_or_default();
    what.starts_with("failed printing to stdout") && what.ends_with("(os error 32)")
}

/// Does what was asked. Where the standard output is closed, as `head` does, the verb ends there, quietly and well: it
/// unwinds, so that its children and files are left as after any other error.
fn main() -> ExitCode {
    let usual = panic::take_hook();
    panic::set_hook(Box::new(move |panic| {
        if is_reader_gone(panic) {
            READER_GONE.store(true, Ordering::Relaxed);
        }
        // Threads that are waited for panic in turn.
        if !READER_GONE.load(Ordering::Relaxed) {
            usual(panic);
        }
    }));
    match panic::catch_unwind(verb) {
        Ok(code) => code,
        Err(_) if READER_GONE.load(Ordering::Relaxed) => ExitCode::SUCCESS,
        Err(panic) => panic::resume_unwind(panic),
    }
}

/// One verb.
fn verb() -> ExitCode {
    let done = match Arguments::parse().verb {
        Verb::Run(arguments) => run::run(&arguments).map(|()| 0),
        Verb::Bake { calib } => bake::bake(&calib).map(|()| 0),
        Verb::Calibrate(arguments) => xtask::calibrate::calibrate(&arguments).map(|()| 0),
        Verb::Pulses(arguments) => xtask::pulses::pulses(&arguments).map(|()| 0),
        Verb::Bench(arguments) => bench::bench(&arguments).map(|()| 0),
        Verb::Memory(arguments) => memory::memory(&arguments).map(|()| 0),
        Verb::Scenes(arguments) => scenes::scenes(&arguments).map(|()| 0),
        Verb::Listen(arguments) => firmware::listen(&arguments).map(|()| 0),
        Verb::Replay(arguments) => xtask::listen::replay(&arguments).map(|()| 0),
        Verb::Faults(arguments) => faults::faults(&arguments).map(|()| 0),
        Verb::Soak(arguments) => soak::soak(&arguments).map(|()| 0),
        Verb::Flash(arguments) => firmware::flash(&arguments).map(|()| 0),
        Verb::Swarm(arguments) => {
            let build = |mote: &str| firmware::scum3c(&process::root().join(firmware::DEFAULT_CALIB), mote);
            xtask::swarm::swarm(&arguments, &build).map(|()| 0)
        }
        Verb::Test => test::test().map(|()| 0),
        Verb::Fuzz(arguments) => fuzz::fuzz(&arguments).map(|()| 0),
        Verb::Claims(arguments) => claims::claims(&arguments).map(|()| 0),
        Verb::Reproduce => reproduce::reproduce().map(|()| 0),
        Verb::Book => book().map(|()| 0),
        Verb::Deny => deny::deny().map(|()| 0),
        Verb::Ci => ci::ci().map(|()| 0),
        Verb::Pictures => pictures().map(|()| 0),
        Verb::Oracle { rooms } => oracle::oracle(rooms).map(|()| 0),
        Verb::Qemu { elf, timeout } => qemu::qemu(&elf, std::time::Duration::from_secs(timeout)),
    };
    match done {
        Ok(code) => ExitCode::from(code),
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

/// Binds `docs`.
fn book() -> anyhow::Result<()> {
    let program = setup::tool("mdbook", &["--no-default-features"])?;
    process::run(std::process::Command::new(program).arg("build"))?;
    println!("bound: target/book/index.html");
    Ok(())
}

/// Draws what `docs` shows of the simulated room.
fn pictures() -> anyhow::Result<()> {
    let path = process::root().join("docs/cycle.svg");
    std::fs::write(&path, xtask::cycle::draw())?;
    println!("drawn: docs/cycle.svg");
    Ok(())
}
