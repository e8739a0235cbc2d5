//! What the firmware costs: each stage by itself, the whole in the light of a room, beside the usual way to do it.
//!
//! All of it is counted on the release build in the virtual mote, so the same numbers come out on every computer. Another
//! room than `calib/default.toml` has its own light and its own numbers, which nothing is held against.
//!
//! What can go wrong: something has grown since `tests/expected/bench.txt` was written. That is an error which names
//! it; where the growth is meant, `--bless` writes the file anew and the growth is seen in review.

mod flash;
mod judge;
mod stages;
mod whole;

use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::PathBuf;

use anyhow::{Context, Result, bail};
use serde_json::json;
use sim::core::cycles::Multiplier;

use crate::process::root;
use crate::room::Room;
use crate::{expected, firmware};
use judge::Counted;
use stages::{Cost, STAGES};
pub(crate) use whole::readable;
use whole::{ACTIVE_W, RECEIVER_W, Run, Size, Whole};

/// What the bench may be told.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// Take what is counted now for what is expected from now on
    #[arg(long)]
    bless: bool,
    /// Show this many of the functions that the instructions go to
    #[arg(long, value_name = "FUNCTIONS", default_value_t = 12)]
    profile: usize,
    /// The room to count in; what it costs is then not held against what is expected of calib/default.toml
    #[arg(long, value_name = "FILE", env = "LIGHTHOUSE_CALIB")]
    calib: Option<PathBuf>,
}

/// What is expected, from the root of the repository.
const EXPECTED: &str = "tests/expected/bench.txt";
/// Where the results go.
const OUT: &str = "target/bench";
/// Light of the whole firmware's runs, seconds: as long as from one reading of what the stations say to the next.
const LIGHT_S: f64 = 124.0;
/// Of that, looked at one instruction at a time.
const PROFILE_S: f64 = 3.0;
/// Light in which the stack is looked at, seconds: the stations have said who they are.
const STACK_S: f64 = 30.0;
/// How far QEMU's count may be from ours, percent.
const AGREEMENT_PERCENT: f64 = 0.1;
/// Fractions are kept as whole numbers of thousandths.
const MILLI: f64 = 1000.0;

/// A figure that somebody asked for.
struct Budget {
    /// Its line in the expected file.
    figure: &'static str,
    /// What it may be.
    most: u64,
    /// What it may be until it is met, where it is not: as found when that was last looked at.
    until_met: Option<u64>,
    /// For a person to read.
    what: &'static str,
}

/// The budgets; a stage's is less the empty call around it. Loads are thousandths of a percent, times microseconds.
const BUDGETS: [Budget; 14] = [
    Budget { figure: "fix.instructions.most_less_empty", most: 300, until_met: None, what: "instructions of a fix" },
    Budget {
        figure: "angle.instructions.most_less_empty",
        most: 100,
        until_met: None,
        what: "instructions of an angle",
    },
    Budget {
        figure: "track.instructions.most_less_empty",
        most: 600,
        until_met: None,
        what: "instructions of a tracker step",
    },
    Budget { figure: "edge.own_cycles", most: 60, until_met: None, what: "cycles of an edge handler of its own" },
    Budget { figure: "load_5mhz.milli_percent", most: 8000, until_met: None, what: "CPU load at 5 MHz, 1/1000 %" },
    Budget { figure: "light_to_frame_5mhz.us", most: 2000, until_met: None, what: "light to frame at 5 MHz, us" },
    // A sweep that is the only one of its slot so far is taken at the slot's end.
    Budget {
        figure: "light_to_frame_5mhz_default.us",
        most: 2000,
        until_met: Some(4413),
        what: "light to frame at 5 MHz as it is, us",
    },
    // Which multiplier the chip has is not known.
    Budget {
        figure: "load_5mhz_slow_multiplier.milli_percent",
        most: 8000,
        until_met: Some(16041),
        what: "CPU load at 5 MHz, mul 32, 1/1000 %",
    },
    Budget {
        figure: "light_to_frame_5mhz_slow_multiplier.us",
        most: 2000,
        until_met: Some(2997),
        what: "light to frame at 5 MHz, mul 32, us",
    },
    Budget { figure: "image.bytes", most: 24 * 1024, until_met: None, what: "image, bytes" },
    Budget {
        figure: "ram_and_stack.bytes",
        most: 4 * 1024,
        until_met: None,
        what: "RAM with the deepest stack, bytes",
    },
    Budget {
        figure: "load_5mhz_slotted.milli_percent",
        most: 8000,
        until_met: None,
        what: "slotted: CPU load at 5 MHz, 1/1000 %",
    },
    Budget { figure: "image_slotted.bytes", most: 24 * 1024, until_met: None, what: "slotted: image, bytes" },
    Budget {
        figure: "ram_and_stack_slotted.bytes",
        most: 4 * 1024,
        until_met: None,
        what: "slotted: RAM with the deepest stack, bytes",
    },
];

/// Everything that was counted.
struct Counts {
    costs: BTreeMap<&'static str, Cost>,
    /// Full light at 5 MHz, at 10 MHz, at 5 MHz with the slow multiplier; the light as it is at 5 MHz.
    runs: [Whole; 4],
    profile: Whole,
    size: Size,
    /// The image of a mote that was given a number, which takes turns with others: full light at 5 MHz.
    slotted: (Whole, Size),
}

impl Arguments {
    /// As when nobody says anything.
    pub(crate) const PLAIN: Self = Self { bless: false, profile: 12, calib: None };
}

/// Counts, prints, compares.
pub(crate) fn bench(arguments: &Arguments) -> Result<()> {
    let room = Room::open(arguments.calib.as_deref())?.lit_anywhere();
    if arguments.bless {
        room.ensure_expected()?;
    }
    let program = firmware::build("bench", &room.file, "")?;
    let elf = std::fs::read(&program).with_context(|| program.display().to_string())?;
    let counts = count(&room, &elf)?;
    let judged = judge::judge(&program, &elf)?;
    let figures = counts.figures();

    println!("\n{}", counts.table(&judged, arguments.profile));
    xtask::whole::json(&root().join(OUT).join("summary.json"), &counts.summary(&judged))?;
    println!("written to {OUT}/summary.json");

    let disagreement: Vec<String> = judged
        .iter()
        .filter(|(_, counted)| counted.apart().abs() > AGREEMENT_PERCENT)
        .map(|(name, counted)| format!("{name}: {:.2} in QEMU, {:.2} in the virtual mote", counted.qemu, counted.sim))
        .collect();
    if !disagreement.is_empty() {
        bail!("the two do not count alike: {}", disagreement.join("; "));
    }
    if let Some(why) = room.unlike_expected() {
        println!("{why}: not held against {EXPECTED}");
        return Ok(());
    }
    if arguments.bless {
        return expected::bless(EXPECTED, &lines(&figures));
    }
    compare(&expected::known(EXPECTED, "bench")?, &figures)
}

/// The deepest stack of the SCuM-3C's firmware in a while of full light of its room at 5 MHz.
pub(crate) fn deepest_stack(elf: &[u8], room: &Room) -> Result<u32> {
    let run =
        Run { hclk_hz: 5_000_000, multiplier: Multiplier::Fast, full_light: true, seconds: STACK_S, profile: false };
    Ok(whole::run(elf, &room.light, room.key, &run)?.stack)
}

/// Counts everything that our own machine can count.
fn count(room: &Room, bench: &[u8]) -> Result<Counts> {
    let costs = stages::measure(bench, room)?;
    let slotted = firmware::scum3c(&room.file, &firmware::among_others(&room.file)?)?;
    // Last, so that it stays where it was built.
    let elf = firmware::scum3c(&room.file, "")?;
    let full =
        Run { hclk_hz: 5_000_000, multiplier: Multiplier::Fast, full_light: true, seconds: LIGHT_S, profile: false };
    let run = |run: &Run| whole::run(&elf, &room.light, room.key, run);
    let runs = [
        run(&full)?,
        run(&Run { hclk_hz: 10_000_000, ..full })?,
        run(&Run { multiplier: Multiplier::Small, ..full })?,
        run(&Run { full_light: false, ..full })?,
    ];
    let profile = run(&Run { seconds: PROFILE_S, profile: true, ..full })?;
    let slotted = (whole::run(&slotted, &room.light, room.key, &full)?, whole::size(&slotted)?);
    Ok(Counts { costs, runs, profile, size: whole::size(&elf)?, slotted })
}

impl Counts {
    /// One whole number each, in the order of the expected file.
    fn figures(&self) -> Vec<(String, u64)> {
        let mut figures = Vec::new();
        let mut add = |name: String, value: u64| figures.push((name, value));
        for (name, ..) in STAGES {
            let cost = &self.costs[name];
            add(format!("{name}.instructions.least"), cost.instructions.least);
            add(format!("{name}.instructions.mean_milli"), (cost.instructions.mean() * MILLI).round() as u64);
            add(format!("{name}.instructions.most"), cost.instructions.most);
            let empty = self.costs["empty"].instructions.least;
            add(format!("{name}.instructions.most_less_empty"), cost.instructions.most.saturating_sub(empty));
            add(format!("{name}.cycles.most"), cost.cycles[0].most);
            add(format!("{name}.cycles_slow_multiplier.most"), cost.cycles[1].most);
            add(format!("{name}.flash"), u64::from(cost.flash));
            add(format!("{name}.stack"), u64::from(cost.stack));
        }
        let [five, ten, small, default] = &self.runs;
        let (slotted, slotted_size) = &self.slotted;
        let own = [five, slotted].map(|run| run.edge_own_cycles).into_iter().flatten();
        add("edge.own_cycles".into(), own.max().unwrap_or(0));
        for (name, run) in [
            ("5mhz", five),
            ("10mhz", ten),
            ("5mhz_slow_multiplier", small),
            ("5mhz_default", default),
            ("5mhz_slotted", slotted),
        ] {
            add(format!("load_{name}.milli_percent"), (run.load_percent * MILLI).round() as u64);
            add(format!("edge_latency_{name}.cycles"), run.edge_latency.into_iter().max().unwrap_or(0));
            add(format!("light_to_frame_{name}.us"), (run.light_to_frame_ms * MILLI).round() as u64);
        }
        let stack = self.runs.iter().map(|run| run.stack).max().unwrap_or(0);
        add("image.bytes".into(), u64::from(self.size.image()));
        add("ram.bytes".into(), u64::from(self.size.ram()));
        add("stack.bytes".into(), u64::from(stack));
        add("ram_and_stack.bytes".into(), u64::from(self.size.ram() + stack));
        add("image_slotted.bytes".into(), u64::from(slotted_size.image()));
        add("ram_and_stack_slotted.bytes".into(), u64::from(slotted_size.ram() + slotted.stack));
        figures
    }

    /// The table for a person.
    fn table(&self, judged: &BTreeMap<String, Counted>, functions: usize) -> String {
        let mut text = String::new();
        self.write(&mut text, judged, functions).expect("text takes everything");
        text
    }

    fn write(
        &self,
        out: &mut String,
        judged: &BTreeMap<String, Counted>,
        functions: usize,
    ) -> Result<(), std::fmt::Error> {
        writeln!(
            out,
            "{:<38} {:>26} {:>9} {:>9} {:>7} {:>6} {:>9} {:>9}",
            "", "instructions", "cycles", "cycles32", "flash", "stack", "to QEMU", "to fix"
        )?;
        writeln!(
            out,
            "{:<38} {:>8} {:>8} {:>8} {:>9} {:>9} {:>7} {:>6} {:>9} {:>9}",
            "one call, empty call included", "least", "mean", "most", "mean", "mean", "B", "B", "%", "times"
        )?;
        let five = &self.runs[0];
        for (n, name) in
            ["edge ISR, rise (in the firmware)", "edge ISR, fall (in the firmware)"].into_iter().enumerate()
        {
            let count = &self.profile.profile.edges[n];
            writeln!(
                out,
                "{name:<38} {:>8} {:>8.1} {:>8} {:>9} {:>9}",
                count.least,
                count.mean(),
                count.most,
                five.edge_own_cycles[n],
                self.runs[2].edge_own_cycles[n]
            )?;
        }
        let fix = self.costs["fix"].instructions.mean();
        for (name, function, what) in STAGES {
            let cost = &self.costs[name];
            let apart = judged.get(function).filter(|_| name != "sweep_laser");
            let apart = apart.map_or_else(String::new, |counted| format!("{:+.3}", counted.apart()));
            let reference = function.starts_with("reference");
            let ratio = if reference || name == "fix" {
                format!("{:.1}", cost.instructions.mean() / fix)
            } else {
                String::new()
            };
            writeln!(
                out,
                "{what:<38} {:>8} {:>8.1} {:>8} {:>9.1} {:>9.1} {:>7} {:>6} {apart:>9} {ratio:>9}",
                cost.instructions.least,
                cost.instructions.mean(),
                cost.instructions.most,
                cost.cycles[0].mean(),
                cost.cycles[1].mean(),
                cost.flash,
                cost.stack
            )?;
        }
        self.write_whole(out)?;
        self.write_energy(out)?;
        self.write_profile(out, functions)?;
        writeln!(out, "\n{:<38} {:>9} {:>9}", "budget", "is", "may be")?;
        let figures = self.figures();
        for budget in &BUDGETS {
            let is = figure(&figures, budget.figure);
            let verdict = match (is <= budget.most, budget.until_met) {
                (true, _) => String::new(),
                (false, None) => "MISSED".to_string(),
                (false, Some(was)) => format!("MISSED, {was} when last looked at"),
            };
            writeln!(out, "{:<38} {is:>9} {:>9} {verdict}", budget.what, budget.most)?;
        }
        Ok(())
    }

    fn write_whole(&self, out: &mut String) -> Result<(), std::fmt::Error> {
        writeln!(
            out,
            "\n{:<38} {:>9} {:>9} {:>9} {:>9} {:>9}",
            "whole firmware", "5 MHz", "10 MHz", "5, mul 32", "5, as is", "5,slotted"
        )?;
        let mut row = |what: &str, of: &dyn Fn(&Whole) -> String| {
            let [a, b, c, d] = self.runs.each_ref().map(of);
            let slotted = of(&self.slotted.0);
            writeln!(out, "{what:<38} {a:>9} {b:>9} {c:>9} {d:>9} {slotted:>9}")
        };
        row("sweeps per second", &|run| format!("{:.1}", run.sweeps as f64 / LIGHT_S))?;
        row("frames per second", &|run| format!("{:.1}", run.frames as f64 / LIGHT_S))?;
        row("CPU load, %", &|run| format!("{:.2}", run.load_percent))?;
        row("worst latency of a rise, cycles", &|run| run.edge_latency[0].to_string())?;
        row("worst latency of a fall, cycles", &|run| run.edge_latency[1].to_string())?;
        row("light to frame, worst, ms", &|run| format!("{:.3}", run.light_to_frame_ms))?;
        row("light to frame, mean, ms", &|run| format!("{:.3}", run.light_to_frame_mean_ms))?;
        row("deepest stack, B", &|run| run.stack.to_string())?;
        let Size { text, rodata, data, bss, uninit } = self.size;
        let slotted = self.slotted.1.image();
        writeln!(out, "image {} B: text {text}, rodata {rodata}, data {data}; slotted {slotted} B", self.size.image())?;
        writeln!(out, "RAM {} B: data {data}, bss {bss}, uninit {uninit}; the stack comes on top", self.size.ram())
    }

    fn write_energy(&self, out: &mut String) -> Result<(), std::fmt::Error> {
        let micro = 1e6;
        writeln!(
            out,
            "\nenergy of a fix, uJ: {:.1} mW while the core or the radio is on, {:.1} uW for the optical receiver; sleep,",
            ACTIVE_W * 1e3,
            RECEIVER_W * micro
        )?;
        writeln!(out, "of which nothing is published, not counted")?;
        for (name, run) in [("5 MHz", &self.runs[0]), ("10 MHz", &self.runs[1])] {
            let energy = &run.energy;
            writeln!(
                out,
                "{name:>7}: core {:.0} us awake {:.2} + radio {:.0} us powered {:.2} + receiver {:.1} ms {:.3} = {:.2}",
                energy.awake_s * micro,
                energy.core_j() * micro,
                energy.radio_s * micro,
                energy.radio_j() * micro,
                energy.all_s * 1e3,
                energy.receiver_j() * micro,
                energy.fix_j() * micro
            )?;
        }
        Ok(())
    }

    fn write_profile(&self, out: &mut String, functions: usize) -> Result<(), std::fmt::Error> {
        let profile = &self.profile.profile;
        let sweeps = self.profile.sweeps.max(1) as f64;
        writeln!(
            out,
            "\nwhere {:.0} instructions per sweep go (a function with what was inlined into it)",
            profile.instructions as f64 / sweeps
        )?;
        let mut rows: Vec<_> = profile.functions.iter().collect();
        rows.sort_by_key(|(_, ran)| std::cmp::Reverse(**ran));
        for (name, ran) in rows.into_iter().take(functions) {
            let share = 100.0 * *ran as f64 / profile.instructions as f64;
            writeln!(out, "{share:7.2} % {:9.1}  {name}", *ran as f64 / sweeps)?;
        }
        Ok(())
    }

    /// The same for a program.
    fn summary(&self, judged: &BTreeMap<String, Counted>) -> serde_json::Value {
        let fix = self.costs["fix"].instructions.mean();
        let stages: serde_json::Map<_, _> = STAGES
            .iter()
            .map(|(name, function, what)| {
                let cost = &self.costs[name];
                let counted = judged.get(*function);
                let row = json!({
                    "what": what,
                    "calls": cost.instructions.calls,
                    "instructions": { "least": cost.instructions.least, "mean": cost.instructions.mean(), "most": cost.instructions.most },
                    "cycles_mean": cost.cycles[0].mean(),
                    "cycles_mean_slow_multiplier": cost.cycles[1].mean(),
                    "flash_bytes": cost.flash,
                    "stack_bytes": cost.stack,
                    "times_fix": cost.instructions.mean() / fix,
                    "walk_in_qemu": counted.map(|counted| counted.qemu),
                    "walk_in_virtual_mote": counted.map(|counted| counted.sim),
                });
                ((*name).to_string(), row)
            })
            .collect();
        let figures = self.figures();
        let budgets: Vec<_> = BUDGETS
            .iter()
            .map(|budget| {
                let is = figure(&figures, budget.figure);
                json!({ "figure": budget.figure, "what": budget.what, "is": is, "may_be": budget.most, "met": is <= budget.most })
            })
            .collect();
        let energy: serde_json::Map<_, _> = [("5mhz", &self.runs[0]), ("10mhz", &self.runs[1])]
            .into_iter()
            .map(|(name, run)| {
                let of = &run.energy;
                let row = json!({
                    "active_w": ACTIVE_W,
                    "receiver_w": RECEIVER_W,
                    "awake_s": of.awake_s,
                    "radio_s": of.radio_s,
                    "all_s": of.all_s,
                    "core_j": of.core_j(),
                    "radio_j": of.radio_j(),
                    "receiver_j": of.receiver_j(),
                    "fix_j": of.fix_j(),
                });
                (name.to_string(), row)
            })
            .collect();
        let figures: serde_json::Map<_, _> = figures.into_iter().map(|(name, value)| (name, json!(value))).collect();
        let edges = self.runs[0].edge_own_cycles;
        json!({
            "stages": stages,
            "energy_of_a_fix": energy,
            "figures": figures,
            "budgets": budgets,
            "edge_own_cycles": { "rise": edges[0], "fall": edges[1] },
        })
    }
}

/// One figure by name; one that does not exist is never met.
fn figure(figures: &[(String, u64)], name: &str) -> u64 {
    figures.iter().find(|(known, _)| known == name).map_or(u64::MAX, |(_, value)| *value)
}

/// The expected file.
fn lines(figures: &[(String, u64)]) -> String {
    figures.iter().fold(String::new(), |text, (name, value)| text + &format!("{name} {value}\n"))
}

/// By how much a figure may differ from one computer to another: panics of other crates name their file, whose path
/// begins with the user's home.
fn slack(name: &str) -> u64 {
    if matches!(name, "image.bytes" | "image_slotted.bytes") { 128 } else { 0 }
}

/// Whether anything grew.
fn compare(known: &str, figures: &[(String, u64)]) -> Result<()> {
    let expected: BTreeMap<&str, u64> = known
        .lines()
        .filter_map(|line| line.split_once(' '))
        .filter_map(|(name, value)| Some((name, value.parse().ok()?)))
        .collect();
    let mut grown = String::new();
    let mut shrunk = 0;
    for (name, is) in figures {
        match expected.get(name.as_str()) {
            Some(was) if *is > was + slack(name) => grown += &format!("\n  {name}: {was} -> {is}"),
            Some(was) => shrunk += u32::from(is < was),
            None => grown += &format!("\n  {name}: not there -> {is}"),
        }
    }
    for name in expected.keys().filter(|name| !figures.iter().any(|(known, _)| known == *name)) {
        grown += &format!("\n  {name}: no longer counted");
    }
    if !grown.is_empty() {
        bail!("against {EXPECTED}, where it is meant `cargo xtask bench --bless`:{grown}");
    }
    match shrunk {
        0 => println!("as expected in {EXPECTED}"),
        _ => println!("{shrunk} figures are smaller than in {EXPECTED}: `cargo xtask bench --bless` keeps it so"),
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_budgets_hold() {
        let calib = root().join(firmware::DEFAULT_CALIB);
        let program = firmware::build("bench", &calib, "").expect("the bench program builds");
        let elf = std::fs::read(program).expect("it was built");
        let room = Room::open(Some(&calib)).expect("it can be baked").lit_anywhere();
        let figures = count(&room, &elf).expect("the firmware runs").figures();
        for Budget { figure: name, most, until_met, what } in &BUDGETS {
            let is = figure(&figures, name);
            let may_be = until_met.unwrap_or(*most);
            assert!(is <= may_be, "{what}: {is}, may be {may_be}");
            assert!(until_met.is_none() || is > *most, "{what}: {is} is met; take its exception out");
        }
    }

    #[test]
    fn growth_is_named_and_shrinking_is_welcome() {
        let figures = |value| vec![("a.most".to_string(), value), ("b.most".to_string(), 7)];
        let known = lines(&figures(10));
        assert!(compare(&known, &figures(10)).is_ok());
        assert!(compare(&known, &figures(9)).is_ok());
        let grown = compare(&known, &figures(11)).expect_err("it grew");
        assert!(grown.to_string().contains("a.most: 10 -> 11"), "{grown}");
    }

    #[test]
    fn a_figure_nobody_counts_any_more_is_named() {
        let gone = compare("a 1\nb 2\n", &[("a".to_string(), 1)]).expect_err("b is gone");
        assert!(gone.to_string().contains("b: no longer counted"), "{gone}");
    }
}
