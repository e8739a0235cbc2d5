//! What a recording of pulses says: `cargo xtask pulses`.
//!
//! For a person with a mote and a logic analyser in hand: [`table`] reads the pulses, [`play`] hands them to the mote's
//! own code, [`findings`] sums up what that made of them, and [`page`] prints it. No clock rate is assumed on the way;
//! where the light is understood, seconds are those of the rotors.
//!
//! # Design
//! The light goes through the same `Classifier` and `Solver` as on the mote, with 32-bit stamps, and the counts are those
//! of the mote's own health frame. Two things differ: every frame of the stations is read, where a mote rests for two
//! minutes after a good one; and the dark is looked into ten times a second, where a mote does so once.
//!
//! # What can go wrong
//! A table that cannot be right: the first such value stops the reading, named with file, line and column. Light that is
//! not understood is no error; why, and what to do, is what is printed.

pub mod findings;
pub mod page;
pub mod play;
pub mod table;

use std::io::{IsTerminal, Write};
use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use lighthouse_mote::sweep;

use crate::calib::{firmware, schema};
use findings::Findings;
use play::Player;
use table::Table;

/// What the verb may be told.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    /// The pulses: columns rise_ticks and width_ticks, in the order of time
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
    /// The nominal rate of the clock that stamped them, for microseconds where no cycle is found, and to compare with
    #[arg(long, value_name = "HZ", value_parser = rate)]
    pub clock_hz: Option<f64>,
    /// Pulses that overlap are one: two photodiodes on one line
    #[arg(long)]
    pub join: bool,
    /// Angles with the factory terms applied too that the stations sent
    #[arg(long)]
    pub factory: bool,
    /// Which station it is, where only one is seen
    #[arg(long, value_enum, value_name = "STATION", ignore_case = true)]
    pub lone: Option<Lone>,
    /// Which moment of a laser's pulse is the sweep: rise for receivers whose fall comes at any time
    #[arg(long, value_enum, value_name = "MOMENT", default_value = "middle")]
    pub sweep_edge: SweepEdge,
    /// The shortest pulse of a laser that counts, us
    #[arg(long, value_name = "US", default_value_t = 1.0, value_parser = shortest)]
    pub shortest_sweep_us: f64,
    /// One JSON object instead, for programs
    #[arg(long)]
    pub json: bool,
}

/// The moment of a laser's pulse that counts as the sweep.
#[derive(clap::ValueEnum, Clone, Copy, Debug, PartialEq, Eq)]
pub enum SweepEdge {
    /// Half way between both edges.
    Middle,
    /// The first edge.
    Rise,
}

/// A station that is seen alone.
#[derive(clap::ValueEnum, Clone, Copy, Debug, PartialEq, Eq)]
pub enum Lone {
    /// The one that flashes first.
    A,
    /// The other.
    B,
}

fn shortest(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(us) if schema::SHORTEST_SWEEP_LIMITS_US.contains(&us) => Ok(us),
        Ok(us) => {
            let limits = schema::SHORTEST_SWEEP_LIMITS_US;
            Err(format!("{us} us is not in {} ..= {}", limits.start(), limits.end()))
        }
        Err(error) => Err(error.to_string()),
    }
}

fn rate(text: &str) -> Result<f64, String> {
    match text.replace('_', "").parse::<f64>() {
        Ok(hz) if hz.is_finite() && hz > 0.0 => Ok(hz),
        Ok(hz) => Err(format!("{hz} is not the rate of a clock")),
        Err(error) => Err(error.to_string()),
    }
}

/// Plays the recording and sums up; `progress` hears how much has been read, 0 to 1.
///
/// # Errors
/// A table that cannot be right.
pub fn understand(arguments: &Arguments, mut progress: impl FnMut(f64)) -> Result<Findings> {
    let mut table = Table::open(&arguments.file, arguments.join)?;
    let lone = arguments.lone.map(|lone| match lone {
        Lone::A => sweep::Station::A,
        Lone::B => sweep::Station::B,
    });
    let stamp = match arguments.sweep_edge {
        SweepEdge::Middle => sweep::Stamp::Middle,
        SweepEdge::Rise => sweep::Stamp::Rise,
    };
    let shortest_sweep = firmware::shortest_sweep(arguments.shortest_sweep_us);
    let mut player = Player::new(sweep::Config { lone, shortest_sweep, stamp })?;
    while let Some(pulse) = table.pulse()? {
        player.pulse(pulse.rise, pulse.width);
        progress(table.progress());
    }
    let file = arguments.file.display().to_string();
    Ok(Findings::of(file, table.joined(), &player.end(), arguments.clock_hz, arguments.factory))
}

/// The verb.
///
/// # Errors
/// A table that cannot be right, or nowhere to print.
pub fn pulses(arguments: &Arguments) -> Result<()> {
    let is_watched = std::io::stderr().is_terminal();
    let mut told = Instant::now();
    let mut has_told = false;
    let findings = understand(arguments, |share| {
        if is_watched && told.elapsed() > Duration::from_millis(250) {
            told = Instant::now();
            has_told = true;
            eprint!("\rreading {:3.0} %", share * 100.0);
        }
    });
    if has_told {
        eprint!("\r              \r");
    }
    let findings = findings?;
    let mut text = if arguments.json { serde_json::to_string_pretty(&findings)? } else { page::page(&findings) };
    if arguments.json {
        text.push('\n');
    }
    match std::io::stdout().write_all(text.as_bytes()) {
        // Whoever reads has seen enough.
        Err(error) if error.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        done => done.context("cannot print"),
    }
}
