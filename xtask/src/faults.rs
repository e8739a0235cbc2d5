//! A mote whose chip misbehaves: bits that flip, power that dips, lines that storm, a timer and a radio that stand still.
//!
//! A mote lives in clear light once and is copied for every run, so that a thousand runs take minutes. Harm is done when it is
//! settled; one in four resets and brown-outs comes before, and of those every other one while the chain of the bring-up is
//! half written. Each run has a number, and everything that happens in it is drawn from that number and the seed: `--run`
//! plays one again and prints what the mote says.
//!
//! # What comes of a run
//! - correct: no pause, no wrong fix, no reset.
//! - transient: a pause or wrong fixes, over within [`PAUSE_S`] and [`WRONG_S`].
//! - detected: the mote started again and its health says why; good fixes again within [`PAUSE_S`].
//! - WRONG: fixes of level full that are wrong (as in the scenes), or under another's name, over more than [`WRONG_S`]
//!   from the first to the last.
//! - SILENT: no good fix for more than [`PAUSE_S`] though the light is there and nothing fails any more.
//! - MISSED: what keeps every frame from the air went on beyond [`BITES_S`], and the watchdog did not start the mote again.
//!
//! The default room's light, or that of the room that is named. In a room with a key a fix counts where a listener with the
//! key believes it; after a brown-out, which wipes the frames' counter out, that listener knows of none.
//!
//! What can go wrong: only data RAM in use is hit, variables and stack as deep as it ever was; code RAM is not. Two
//! failures at once are not tried. Velocity and standard deviation are believed as they are.

mod harm;
mod outcome;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Mutex, mpsc};
use std::time::Instant;

use anyhow::{Context, Result, ensure};
use serde_json::json;
use sim::machine::Stop;
use sim::world::Scene;
use xtask::svg::figure;
use xtask::whole;

use crate::firmware;
use crate::lit::Lit;
use crate::log::Log;
use crate::process::root;
use crate::room::Room;
use harm::{Harm, Kind, Ram};
use outcome::{Outcome, Seen};

/// How much harm is done.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// Random bits of data RAM that flip, one per run
    #[arg(long, default_value_t = 1000)]
    flips: usize,
    /// Resets and brown-outs at random cycles, one per run
    #[arg(long, default_value_t = 1000)]
    resets: usize,
    /// Failures of each other kind: lines that storm, a timer that stands still, a radio that is never done
    #[arg(long, default_value_t = 100)]
    failures: usize,
    /// Which bits, which cycles
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// One run again, as the table calls it, with the mote's log: flip-17
    #[arg(long, value_name = "RUN")]
    run: Option<String>,
    /// The room to do it in
    #[arg(long, value_name = "FILE", env = "LIGHTHOUSE_CALIB")]
    calib: Option<PathBuf>,
}

impl Arguments {
    /// A few of each.
    pub(crate) const SHORT: Self = Self { flips: 40, resets: 40, failures: 8, seed: 1, run: None, calib: None };
}

/// Where the results go.
const OUT: &str = "target/faults";
/// Harm is done between these, true seconds: lock, track and the queues are settled.
const HARM_S: [f64; 2] = [4.0, 9.0];
/// By then the scan chain of the bring-up is written: 40,000 cycles of 10 MHz, and a little.
const CHAIN_S: f64 = 5e-3;
/// The watchdog has bitten by then, seconds: its third turn without a frame ends 7 s after the last one at most
/// (`docs/scum3c.md`).
const BITES_S: f64 = 7.5;
/// A run goes on after the harm is over for so long, seconds: the watchdog bites within 5 s, and what is wrong after that
/// has time to show.
const AFTER_S: f64 = 9.0;
/// The same after a start, which takes less than a second.
const AFTER_START_S: f64 = 3.0;
/// How often the mote is looked at, seconds of its time.
const LOOK_S: f64 = 0.05;
/// A pause of the good fixes that is over is a transient one up to here, seconds: the watchdog bites within 5 s, and a
/// start takes less than one.
const PAUSE_S: f64 = 6.0;
/// Wrong fixes may be reported as good no longer than this, seconds.
const WRONG_S: f64 = 1.0;
/// After a reset or a brown-out a good fix comes by then, seconds.
const BACK_S: f64 = 1.0;

/// Who a mote is on air: network and short address.
type Address = (u16, u16);

/// One run that was judged.
struct Judged {
    harm: Harm,
    seen: Seen,
    outcome: Outcome,
}

/// Does the harm, prints, judges.
pub(crate) fn faults(arguments: &Arguments) -> Result<()> {
    let room = Room::open(arguments.calib.as_deref())?;
    room.ensure_tells_places()?;
    room.ensure_lit()?;
    let elf = firmware::scum3c(&room.file, "")?;
    let strings = Log::strings(&elf)?;
    let scene = Scene { length_s: HARM_S[1] + harm::LONGEST_S + AFTER_S + 1.0, ..room.light.clone() };
    let mut booted = Lit::boot(&elf, &scene, arguments.seed)?.heard_with(room.key);
    booted.mote.machine.forgive_faults();
    let mut settled = booted.clone();
    ensure!(settled.run_to(HARM_S[0])?.is_none(), "the mote stops in clear light");
    let ours = settled.hear()?.iter().find_map(|heard| heard.header).context("the mote says nothing in clear light")?;
    let ours = (ours.pan, ours.mote);
    let ram = Ram::of(&settled.mote)?;
    let mut harms: Vec<Harm> = Vec::new();
    for kind in Kind::ALL {
        let count = match kind {
            Kind::Flip => arguments.flips,
            Kind::Reset => arguments.resets / 2,
            Kind::BrownOut => arguments.resets - arguments.resets / 2,
            _ => arguments.failures,
        };
        harms.extend((0..count).map(|number| {
            let span = match kind {
                Kind::Reset | Kind::BrownOut if number % 8 == 0 => [0.0, CHAIN_S],
                Kind::Reset | Kind::BrownOut if number % 8 == 4 => [0.0, HARM_S[0]],
                _ => HARM_S,
            };
            Harm::draw(kind, number, arguments.seed, span, &ram)
        }));
    }
    if let Some(name) = &arguments.run {
        let harm = harms.iter().find(|harm| harm.name() == *name);
        let harm = harm.with_context(|| format!("{name} is no run of these; the table names them"))?;
        return one(&booted, ours, harm, &ram, Log::of(strings));
    }
    println!(
        "{} runs, {} bytes of data RAM in use ({} of stack), seed {}",
        harms.len(),
        ram.bytes(),
        ram.stack_bytes(),
        arguments.seed
    );
    let started = Instant::now();
    harms.sort_by(|a, b| a.at_s.total_cmp(&b.at_s));
    let judged = all(booted, ours, harms, || Log::of(strings))?;
    let table = table(&judged);
    println!("{table}");
    let bad: Vec<&Judged> = judged.iter().filter(|run| run.outcome.is_bad()).collect();
    for run in &bad {
        println!("{:<14} {:<10} {}", run.harm.name(), run.outcome.to_string(), describe(run, &ram));
    }
    let others = judged.iter().filter(|run| !run.outcome.is_bad());
    for run in others.filter(|run| !matches!(run.outcome, Outcome::Correct) && run.harm.kind == Kind::Flip) {
        println!("{:<14} {:<10} {}", run.harm.name(), run.outcome.to_string(), describe(run, &ram));
    }
    println!("{} runs in {:.0} s", judged.len(), started.elapsed().as_secs_f64());
    write(arguments, &judged, &ram)?;
    ensure!(
        bad.is_empty(),
        "{} runs ended badly; `cargo xtask faults --seed {} --run NAME` plays one again",
        bad.len(),
        arguments.seed
    );
    Ok(())
}

fn describe(run: &Judged, ram: &Ram) -> String {
    let Judged { harm, seen, .. } = run;
    format!(
        "{}; pause {:.2} s, {} wrong over {:.2} s, starts {}, cause {}",
        harm.what(ram),
        seen.pause_s,
        seen.wrong,
        seen.wrong_s,
        seen.starts,
        seen.cause()
    )
}

/// Plays all, each from a copy of the mote at the moment of its harm.
fn all(mut living: Lit, ours: Address, harms: Vec<Harm>, log: impl Fn() -> Log<'static> + Sync) -> Result<Vec<Judged>> {
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let total = harms.len();
    let log = &log;
    std::thread::scope(|scope| {
        // Few copies at a time: each has half a megabyte.
        let (work, jobs) = mpsc::sync_channel::<(Harm, Lit)>(2);
        let (done, results) = mpsc::channel();
        let jobs = std::sync::Arc::new(Mutex::new(jobs));
        for _ in 0..threads {
            let (jobs, done) = (jobs.clone(), done.clone());
            scope.spawn(move || {
                loop {
                    let job = jobs.lock().ok().and_then(|jobs| jobs.recv().ok());
                    let Some((harm, lit)) = job else { break };
                    // Nobody listens after an error elsewhere.
                    if done.send(play(lit, ours, harm, log(), |_| {})).is_err() {
                        break;
                    }
                }
            });
        }
        drop((done, jobs));
        let feeding = scope.spawn(move || -> Result<()> {
            for harm in harms {
                living.run_to(harm.at_s)?;
                living.hear()?;
                living.mote.take_log();
                // Nobody works after an error elsewhere.
                if work.send((harm, living.clone())).is_err() {
                    break;
                }
            }
            Ok(())
        });
        let mut judged = Vec::with_capacity(total);
        for run in results {
            judged.push(run?);
            if judged.len().is_multiple_of(250) {
                println!("{:>6} of {total}", judged.len());
            }
        }
        feeding.join().map_err(|_| anyhow::anyhow!("the mote broke without harm"))??;
        judged.sort_by_key(|run: &Judged| (run.harm.kind, run.harm.number));
        Ok(judged)
    })
}

/// One run alone, with all that the mote says.
fn one(booted: &Lit, ours: Address, harm: &Harm, ram: &Ram, log: Log<'static>) -> Result<()> {
    let mut lit = booted.clone();
    lit.run_to(harm.at_s)?;
    lit.hear()?;
    lit.mote.take_log();
    println!("{} at {:.4} s: {}", harm.name(), harm.at_s, harm.what(ram));
    let run = play(lit, ours, harm.clone(), log, |line| println!("{line}"))?;
    println!("{}: {}", run.outcome, describe(&run, ram));
    Ok(())
}

/// Does the harm to `lit` and watches what comes of it.
fn play(mut lit: Lit, ours: Address, harm: Harm, mut log: Log<'static>, mut say: impl FnMut(String)) -> Result<Judged> {
    harm.happen(&mut lit);
    let (over_s, mut second) = (harm.at_s + harm.long_s, harm.at_s);
    let end_s = over_s + if matches!(harm.kind, Kind::Reset | Kind::BrownOut) { AFTER_START_S } else { AFTER_S };
    let mut seen = Seen::since(over_s, ours);
    while second < end_s {
        second = (second + LOOK_S).min(end_s);
        while let Some(halted) = lit.run_to(second)? {
            // What was sent before says so before the timer starts anew.
            seen.hear(lit.hear()?);
            say(format!("{:8.4} s  {halted}", lit.world.seconds(lit.mote.machine.cycles())));
            match halted.stop {
                // Whether this reset reaches the chip's devices is not documented.
                Stop::Reset if harm.number.is_multiple_of(2) => lit.mote.machine.reset(),
                Stop::Reset => lit.mote.restart(),
                _ => {
                    seen.dead = true;
                    second = end_s;
                    break;
                }
            }
        }
        let heard = lit.hear()?;
        for heard in &heard {
            if let crate::lit::Said::Fix(fix) = &heard.said
                && fix.is_wrong()
            {
                say(format!("{second:8.4} s  wrong by {:.1} cm, level {:?}", 100.0 * fix.error_m(), fix.level));
            }
        }
        seen.hear(heard);
        for line in log.read(&lit.mote.take_log()) {
            seen.read(&line);
            say(format!("{second:8.4} s  {line}"));
        }
    }
    seen.close(end_s);
    let outcome = Outcome::of(&harm, &seen);
    Ok(Judged { harm, seen, outcome })
}

fn table(judged: &[Judged]) -> String {
    let mut rows: BTreeMap<Kind, Vec<&Judged>> = BTreeMap::new();
    for run in judged {
        rows.entry(run.harm.kind).or_default().push(run);
    }
    let mut table = format!(
        "{:<32} {:>5} {:>8} {:>9} {:>9} {:>6} {:>7} {:>7} | {:>12} {:>13}",
        "harm", "runs", "correct", "transient", "detected", "WRONG", "SILENT", "MISSED", "longest", "longest wrong"
    );
    table += &format!("\n{:<32} {:>85}", "", "| pause, s     s");
    for (kind, runs) in rows {
        let count = |outcome: Outcome| runs.iter().filter(|run| run.outcome == outcome).count();
        let most = |value: fn(&Seen) -> f64| runs.iter().map(|run| value(&run.seen)).fold(0.0, f64::max);
        table += &format!(
            "\n{:<32} {:>5} {:>8} {:>9} {:>9} {:>6} {:>7} {:>7} | {:>12} {:>13}",
            kind.to_string(),
            runs.len(),
            count(Outcome::Correct),
            count(Outcome::Transient),
            count(Outcome::Detected),
            count(Outcome::Wrong),
            count(Outcome::Silent),
            count(Outcome::Missed),
            figure(most(|seen| seen.pause_s), 2),
            figure(most(|seen| seen.wrong_s), 2)
        );
    }
    table
}

fn write(arguments: &Arguments, judged: &[Judged], ram: &Ram) -> Result<()> {
    let runs: Vec<_> = judged
        .iter()
        .map(|run| {
            json!({
                "run": run.harm.name(),
                "at_s": run.harm.at_s,
                "what": run.harm.what(ram),
                "outcome": run.outcome.to_string(),
                "pause_s": run.seen.pause_s,
                "wrong": run.seen.wrong,
                "wrong_s": run.seen.wrong_s,
                "starts": run.seen.starts,
                "cause": run.seen.cause(),
            })
        })
        .collect();
    let summary = json!({ "seed": arguments.seed, "runs": runs });
    whole::json(&root().join(OUT).join("summary.json"), &summary)?;
    println!("written to {OUT}: summary.json");
    Ok(())
}
