//! A day in the life of one mote: hostile scenes and clear light in turn, its counter wrapping on the way.
//!
//! One mote is switched on once. It meets the named scenes in an order that a seed draws anew for each round, with clear
//! light between; its clock, its walk and the rotors never start again. What it says is judged as it comes and then
//! forgotten, so that a day takes no more memory than a minute.
//!
//! # What must hold
//! The mote starts once and never stops. Frames are numbered without a gap. Uptime never goes back. The measured half
//! turn is the true one to [`HALF_TURN_WITHIN`] in clear light. No good fix is wrong in clear light. In the scenes, those
//! aside that are known to make some, a wrong one is over within [`SPELL_S`], and of no scene's good fixes more than
//! [`WRONG_SHARE`] are wrong. No figure of the last hour differs from the first's by more than rounds differ from each
//! other, and none has a trend ([`compare`]).
//!
//! In another room than `calib/default.toml` the scenes that mean something there are met, and the same must hold. In a
//! room with a key a frame counts where a listener with the key believes it.
//!
//! What can go wrong: scenes that need another mote are not met: other clocks, a counter that is set, other pairs of
//! stations, a receiver whose bias would drift for a day.

mod compare;
mod plan;
mod watch;

use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Result, ensure};
use serde_json::{Value, json};

use crate::firmware;
use crate::lit::Lit;
use crate::log::Log;
use crate::process::root;
use crate::room::Room;
use crate::scenes::list;
use compare::Comparison;
use plan::{Plan, ROUND_S};
use watch::{Round, Watch};
use xtask::calib::schema::SEALED_HALF_TURNS;
use xtask::light::HALF_TURN_S;
use xtask::whole;

/// How the soak may be told.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// Hours of mote time
    #[arg(long, default_value_t = 24.0, value_parser = hours)]
    hours: f64,
    /// Keep the mote in the dark for so many hours first, to see soon what came late
    #[arg(long, default_value_t = 0.0)]
    from: f64,
    /// A line for each scene as well
    #[arg(long)]
    each: bool,
    /// Which walk, which light, which order
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// The room to live in
    #[arg(long, value_name = "FILE", env = "LIGHTHOUSE_CALIB")]
    calib: Option<PathBuf>,
}

impl Arguments {
    /// Half a minute: the shortest that meets some scenes.
    pub(crate) const SHORT: Self = Self { hours: 30.0 / 3600.0, from: 0.0, each: false, seed: 1, calib: None };
}

fn hours(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(hours) if (0.005..=240.0).contains(&hours) => Ok(hours),
        Ok(hours) => Err(format!("{hours} is not in 0.005 ..= 240")),
        Err(error) => Err(error.to_string()),
    }
}

/// Where the results go.
const OUT: &str = "target/soak";
/// How often the mote is looked at, seconds of its time.
const LOOK_S: f64 = 0.25;
/// How far the measured half turn may be off in clear light, as a fraction: the clock drifts by 1e-5 within the tens of
/// milliseconds over which it is measured, and wanders by 1e-4.
const HALF_TURN_WITHIN: f64 = 5e-4;
/// What a fix may take from light to air, seconds: it may be held back until its half turn ends, 8.3 ms, and then wait for
/// the oscillators, which are counted for six half turns once a minute, 50 ms; itself it takes under 2.
const LATENCY_S: f64 = 0.0605;
/// What it may take more where it is sealed, seconds: the half turns by which a mote that takes turns is ahead of its own,
/// which is long enough for a report and a health frame.
const SEALING_S: f64 = SEALED_HALF_TURNS as f64 * HALF_TURN_S;

/// A wrong position is reported as good no longer than this, seconds: as where the chip misbehaves ([`crate::faults`]).
const SPELL_S: f64 = 1.0;
/// The share of a scene's good fixes that may be wrong. Wrong is what lies beyond five of the standard deviations that
/// the mote reports. In hostile light errors have no Gaussian's tails, and five must be worth three of a Gaussian's all
/// the same, which leave 2 (1 - Phi(3)) outside. Over all scenes together the share says nothing: it goes down with every
/// scene that makes none.
const WRONG_SHARE: f64 = 2.7e-3;

/// What depends on the room.
#[derive(Debug, Clone, Copy, Default)]
struct Allowed {
    /// What a fix may take from light to air, seconds.
    latency_s: f64,
    /// Reports that the longest spell can have, which may fall into any scene however short.
    spell_fixes: f64,
}

impl Allowed {
    fn of(room: &Room) -> Self {
        let latency_s = LATENCY_S + room.key.map_or(0.0, |_| SEALING_S);
        Self { latency_s, spell_fixes: room.reports_per_s() * SPELL_S }
    }
}

/// Runs the soak, prints, judges.
pub(crate) fn soak(arguments: &Arguments) -> Result<()> {
    let room = Room::open(arguments.calib.as_deref())?;
    room.ensure_tells_places()?;
    room.ensure_lit()?;
    let elf = firmware::scum3c(&room.file, "")?;
    let (scenes, left_out) = list::of(&room);
    let plan = Plan::new(3600.0 * arguments.hours, arguments.seed, scenes, &room.light);
    println!(
        "{:.4} h of mote time in {} rounds of {} scenes and clear light between, seed {}",
        arguments.hours, plan.rounds, plan.scenes_per_round, arguments.seed
    );
    if !left_out.is_empty() {
        let names: Vec<&str> = left_out.iter().map(|named| named.name.as_str()).collect();
        println!("left out, as made for {}: {}", firmware::DEFAULT_CALIB, names.join(", "));
    }
    let started = Instant::now();
    let mut lit = Lit::boot(&elf, &plan.clear, arguments.seed)?.heard_with(room.key);
    let mut watch = Watch::new(Log::of(Log::strings(&elf)?), Allowed::of(&room));
    let mut rounds: Vec<Round> = Vec::new();
    println!("{}", Round::HEADING);
    let mut halted = None;
    let from_s = 3600.0 * arguments.from;
    if from_s > 0.0 {
        lit.world.skip(from_s);
        lit.run_to(from_s)?;
        lit.hear()?;
        // The mote's start is in it.
        watch.look(&mut lit)?;
    }
    for meeting in plan.meetings.iter().filter(|meeting| meeting.from_s >= from_s) {
        lit.world.meet(&meeting.scene.clone().later(meeting.from_s));
        watch.meets(meeting);
        let mut second = meeting.from_s;
        while second < meeting.to_s && halted.is_none() {
            second = (second + LOOK_S).min(meeting.to_s);
            halted = lit.run_to(second)?;
            watch.look(&mut lit)?;
        }
        if arguments.each {
            println!("{}", watch.each(&lit));
        }
        if meeting.ends_round || halted.is_some() {
            let round = watch.close(&lit);
            println!("{}", round.line(rounds.len() + 1, second, started.elapsed().as_secs_f64()));
            rounds.push(round);
        }
        if halted.is_some() {
            break;
        }
    }
    let lived_s = lit.world.seconds(lit.mote.machine.cycles());
    let wall_s = started.elapsed().as_secs_f64();
    let wraps = lit.mote.machine.cycles() >> 32;
    let comparison = Comparison::of(&rounds, plan.rounds_per_hour());
    let life = watch.life(&lit);
    println!("\n{comparison}\n{life}");
    println!(
        "{:.3} h of mote time, {wraps} counter wraps, {} instructions, in {:.0} s: {:.0} times as fast as the mote",
        lived_s / 3600.0,
        lit.mote.machine.instructions(),
        wall_s,
        lived_s / wall_s
    );
    let mut broken = life.broken();
    if let Some(halted) = &halted {
        broken.push(halted.to_string());
    }
    broken.extend(comparison.broken());
    // At the slowest the clock does 10.9 million ticks a second.
    if arguments.hours >= 24.0 && wraps < 200 {
        broken.push(format!("{wraps} counter wraps are fewer than 200"));
    }
    let summary: Value = json!({
        "hours": lived_s / 3600.0,
        "seed": arguments.seed,
        "round_s": ROUND_S,
        "counter_wraps": wraps,
        "wall_s": wall_s,
        "instructions": lit.mote.machine.instructions(),
        "rounds": rounds.iter().map(Round::summary).collect::<Vec<_>>(),
        "comparison": comparison.summary(),
        "life": life.summary(),
        "broken": broken,
    });
    whole::json(&root().join(OUT).join("summary.json"), &summary)?;
    println!("written to {OUT}: summary.json");
    ensure!(broken.is_empty(), "the soak broke:\n  {}", broken.join("\n  "));
    Ok(())
}
