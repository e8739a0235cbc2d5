//! Light that is not kind: named scenes of a simulated room, the release firmware in each, what it promises.
//!
//! Scenes are deterministic, so every figure is compared exactly with `tests/expected/scenes.txt`. The promises hold
//! whatever that file says: no crash, no fix of level full that is wrong, a good fix soon after the light is back. What
//! breaks one today stands in [`UNTIL_MET`]; taking it from there is part of mending it. What no firmware could keep
//! stands in [`LIMITS`].
//!
//! In another room than `calib/default.toml` the scenes that mean something there are played, and their promises are held to;
//! nothing is expected of their figures.
//!
//! What can go wrong: a figure is not what is expected, a promise is broken that was not, or one holds that
//! [`UNTIL_MET`] says is broken. Each is named, and the exit is not zero.

mod curves;
mod figures;
pub(crate) mod list;
mod play;
mod reason;

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc;
use std::time::Instant;

use anyhow::{Context, Result, bail, ensure};
use defmt_decoder::Table;
use serde_json::{Value, json};
use xtask::output::{self, Run};
use xtask::reference;
use xtask::score::{FixRow, Score};
use xtask::svg::{Span, figure};
use xtask::whole;

use crate::log::Log;
use crate::process::root;
use crate::room::Room;
use crate::{expected, firmware};
use figures::{Figures, Promise, RECOVERY_MS};
use list::{Named, Take};
use play::{Played, play};

/// What the scenes may be told.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// One scene alone; writes its worst take to target/scenes/NAME as `run` does, and prints the mote's log
    name: Option<String>,
    /// Take what comes out now for what is expected from now on
    #[arg(long, conflicts_with = "name")]
    bless: bool,
    /// Name the scenes and do nothing
    #[arg(long, conflicts_with_all = ["name", "bless"])]
    list: bool,
    /// The room to play them in; its figures are then not held against what is expected of calib/default.toml
    #[arg(long, value_name = "FILE", env = "LIGHTHOUSE_CALIB")]
    calib: Option<PathBuf>,
}

impl Arguments {
    /// As when nobody says anything.
    pub(crate) const PLAIN: Self = Self { name: None, bless: false, list: false, calib: None };
}

/// What is expected, from the root of the repository.
const EXPECTED: &str = "tests/expected/scenes.txt";
/// Where the results go.
const OUT: &str = "target/scenes";

/// Wrong fixes that are shown of a scene.
const MOST_WRONG: usize = 20;

/// Promises that the firmware breaks as it is, by scene, with the reason.
const UNTIL_MET: [(&str, Promise); 2] = [
    // A mirrored sweep that is as bright as the direct one and near it, a pulse that happens to look like a sweep: one is
    // believed now and then, about once in ten minutes of such light.
    ("reflections", Promise::NoWrongGood),
    ("remote-control-500", Promise::NoWrongGood),
];

/// Promises that no mote with one photodiode and two stations can keep, by scene.
const LIMITS: [(&str, Promise); 2] = [
    // The station stays in the plane through both stations and the mote, or turns within it: the rays still meet, at
    // another place. Nothing in four angles tells that place from the true one. Where the rays miss each other, as in
    // the scenes moved-up and moved-tilted, the mote says nothing.
    ("moved-10cm", Promise::NoWrongGood),
    ("moved-turned-5deg", Promise::NoWrongGood),
];

/// Whether no firmware could keep from wrong fixes of level full in a scene.
pub(crate) fn is_limit(scene: &str) -> bool {
    LIMITS.iter().any(|(name, promise)| *name == scene && *promise == Promise::NoWrongGood)
}

/// An image and the strings of its log.
struct Image {
    elf: Vec<u8>,
    strings: &'static Table,
}

impl Image {
    fn build(calib: &Path) -> Result<Self> {
        let elf = firmware::scum3c(calib, "")?;
        let strings = Log::strings(&elf)?;
        Ok(Self { elf, strings })
    }

    fn play(&self, take: &Take) -> Result<Played> {
        play(&self.elf, self.strings, take)
    }
}

/// The firmware of a room, and of the same whose file names the stations' serial numbers.
struct Images {
    plain: Image,
    knows_ids: Image,
}

impl Images {
    fn build(room: &Room) -> Result<Self> {
        let named = named_room(room)?;
        Ok(Self { knows_ids: Image::build(&named)?, plain: Image::build(&room.file)? })
    }

    fn play(&self, take: &Take) -> Result<Played> {
        if take.knows_ids { self.knows_ids.play(take) } else { self.plain.play(take) }
    }
}

/// Writes a room with the serial numbers that the simulated stations send; where it lies.
fn named_room(Room { file: calib, calibration, light, .. }: &Room) -> Result<PathBuf> {
    let text = std::fs::read_to_string(calib).with_context(|| calib.display().to_string())?;
    let stations = [("A", &light.station_a), ("B", &light.station_b)].into_iter().zip(&calibration.stations);
    let nameless = stations.filter(|(_, station)| station.id.is_none()).map(|(simulated, _)| simulated);
    let named = nameless.fold(text, |text, (name, station)| {
        text.replacen(&format!("[station.{name}]\n"), &format!("[station.{name}]\nid = {}\n", station.info.id), 1)
    });
    let folder = root().join(OUT);
    std::fs::create_dir_all(&folder).with_context(|| folder.display().to_string())?;
    let path = folder.join("named.toml");
    std::fs::write(&path, named).with_context(|| path.display().to_string())?;
    let room = firmware::room(&path)?;
    ensure!(
        room.stations.iter().all(|station| station.id.is_some()),
        "{}: a station has no place for its number",
        calib.display()
    );
    Ok(path)
}

/// Runs the scenes, prints, compares.
pub(crate) fn scenes(arguments: &Arguments) -> Result<()> {
    let room = Room::open(arguments.calib.as_deref())?;
    let (all, left_out) = list::of(&room);
    if arguments.list {
        for Named { name, what, takes } in &all {
            println!("{name:<20} {:>3} x {:>4.1} s  {what}", takes.len(), takes[0].scene.length_s);
        }
        return Ok(());
    }
    ensure!(room.key.is_none(), "{}: its frames are secured; scenes read plain ones", room.file.display());
    if arguments.bless {
        room.ensure_expected()?;
    }
    room.ensure_lit()?;
    if let Some(name) = &arguments.name {
        ensure!(!left_out.iter().any(|named| named.name == *name), "{name} is made for {}", firmware::DEFAULT_CALIB);
        let named = all.iter().find(|named| named.name == *name);
        let named =
            named.with_context(|| format!("no scene is called {name}; `cargo xtask scenes --list` names them"))?;
        return alone(&Images::build(&room)?, named, &room);
    }
    let images = Images::build(&room)?;
    let started = Instant::now();
    println!("{HEADING}");
    let figures = judge_all(&images, &all, room.report_every_s(), |name, figures| println!("{}", line(name, figures)))?;
    let rows: Vec<(&Named, &Figures)> = all.iter().zip(&figures).collect();
    let broken: Vec<_> = rows.iter().map(|(named, figures)| (named.name.as_str(), figures.broken())).collect();
    let table = rows
        .iter()
        .fold(format!("{HEADING}\n"), |text, (named, figures)| text + line(&named.name, figures).trim_end() + "\n");
    if let Some(why) = room.unlike_expected() {
        let names: Vec<&str> = left_out.iter().map(|named| named.name.as_str()).collect();
        println!("{why}: not held against {EXPECTED};");
        println!("left out, as made for that room or a room of their own: {}, range, incidence", names.join(", "));
        let summary = summarised(&rows, None, &table);
        whole::json(&root().join(OUT).join("summary.json"), &summary)?;
        println!("written to {OUT}: summary.json");
        return promises(&broken, &[]);
    }
    let curves = curves::measure()?;
    println!("{curves}");
    let mote_s: f64 = all.iter().flat_map(|named| &named.takes).map(|take| take.scene.length_s).sum();
    println!("{} scenes, {mote_s:.0} s of mote time, in {:.0} s", all.len(), started.elapsed().as_secs_f64());

    let folder = root().join(OUT);
    whole::json(&folder.join("summary.json"), &summarised(&rows, Some(&curves), &table))?;
    curves.draw(&folder)?;
    println!("written to {OUT}: summary.json range.svg incidence.svg");

    let text = table + &curves.to_string();
    let kept = promises(&broken, &[&UNTIL_MET[..], &LIMITS[..]].concat());
    if arguments.bless {
        expected::bless(EXPECTED, &text)?;
        return kept;
    }
    let same = expected::known(EXPECTED, "scenes").and_then(|known| compare(&known, &text));
    match (same, kept) {
        (Ok(()), kept) => kept,
        (same, Ok(())) => same,
        (Err(same), Err(kept)) => bail!("{same:#}\n{kept:#}"),
    }
}

/// Plays every job on as many threads as there are cores; hands each result to `done` on this thread, as it comes.
fn on_all_cores<T: Sync, R: Send>(
    jobs: &[T],
    work: impl Fn(&T) -> Result<R> + Sync,
    mut done: impl FnMut(usize, R) -> Result<()>,
) -> Result<()> {
    let next = AtomicUsize::new(0);
    let threads = std::thread::available_parallelism().map_or(1, usize::from).min(jobs.len());
    std::thread::scope(|scope| {
        let (send, results) = mpsc::channel();
        for _ in 0..threads {
            let (send, next, work) = (send.clone(), &next, &work);
            scope.spawn(move || {
                loop {
                    let n = next.fetch_add(1, Ordering::Relaxed);
                    let Some(job) = jobs.get(n) else { break };
                    // Nobody listens after an error elsewhere.
                    if send.send((n, work(job))).is_err() {
                        break;
                    }
                }
            });
        }
        drop(send);
        for (n, result) in results {
            done(n, result?)?;
        }
        Ok(())
    })
}

/// Judges all scenes; says each as soon as it and all before it are through.
fn judge_all(
    images: &Images,
    all: &[Named],
    every_s: f64,
    mut say: impl FnMut(&str, &Figures),
) -> Result<Vec<Figures>> {
    let jobs: Vec<(usize, &Take)> =
        all.iter().enumerate().flat_map(|(n, named)| named.takes.iter().map(move |take| (n, take))).collect();
    let mut waiting: BTreeMap<usize, Vec<(usize, Played)>> = BTreeMap::new();
    let mut judged: BTreeMap<usize, Figures> = BTreeMap::new();
    let mut said = 0;
    on_all_cores(
        &jobs,
        |(_, take)| images.play(take),
        |job, played| {
            let (scene, _) = jobs[job];
            let named = &all[scene];
            let takes = waiting.entry(scene).or_default();
            takes.push((job, played));
            if takes.len() < named.takes.len() {
                return Ok(());
            }
            let mut takes = waiting.remove(&scene).unwrap_or_default();
            takes.sort_by_key(|(job, _)| *job);
            let takes: Vec<_> = takes.iter().map(|(job, played)| (jobs[*job].1, played)).collect();
            judged.insert(scene, Figures::of(&takes, every_s));
            while let Some(figures) = judged.get(&said) {
                say(&all[said].name, figures);
                said += 1;
            }
            Ok(())
        },
    )?;
    Ok(judged.into_values().collect())
}

/// Plays one scene and writes its worst take as `run` writes a run.
fn alone(images: &Images, named: &Named, room: &Room) -> Result<()> {
    let mut all: Vec<Option<Played>> = named.takes.iter().map(|_| None).collect();
    on_all_cores(
        &named.takes,
        |take| images.play(take),
        |n, played| {
            all[n] = Some(played);
            Ok(())
        },
    )?;
    let every_s = room.report_every_s();
    let takes: Vec<(&Take, Played)> = named.takes.iter().zip(all.into_iter().flatten()).collect();
    ensure!(!takes.is_empty(), "{} has no take", named.name);
    let figures = Figures::of(&takes.iter().map(|(take, played)| (*take, played)).collect::<Vec<_>>(), every_s);
    let badness = |(take, played): &(&Take, Played)| {
        let own = Figures::of(&[(take, played)], every_s);
        let number = |value: f64| if value.is_nan() { 0.0 } else { value };
        (own.crashes, own.wrong_good, number(own.recovery_ms), number(own.first_fix_ms), number(own.worst_cm))
    };
    let worst = takes
        .into_iter()
        .enumerate()
        .max_by(|a, b| badness(&a.1).partial_cmp(&badness(&b.1)).unwrap_or(std::cmp::Ordering::Equal));
    let Some((n, (take, played))) = worst else { bail!("{} has no take", named.name) };
    for line in &played.log {
        println!("{line}");
    }
    if let Some(halted) = &played.halted {
        println!("{halted}");
    }
    let wrong = || played.fixes.iter().filter(|fix| fix.is_good() && fix.is_wrong());
    for fix in wrong().take(MOST_WRONG) {
        let [x, y, z] = fix.sd_m.map(|sd| 100.0 * sd);
        let error_cm = 100.0 * fix.error_m();
        println!("{:7.2} s  wrong by {error_cm:.1} cm, says {x:.1} {y:.1} {z:.1} cm of itself", fix.row.seconds);
    }
    if wrong().count() > MOST_WRONG {
        println!("and {} more that are wrong", wrong().count() - MOST_WRONG);
    }
    let rows: Vec<FixRow> = played.fixes.iter().map(|fix| fix.row.clone()).collect();
    let dir = root().join(OUT).join(&named.name);
    output::ensure_replaceable(&dir)?;
    if let Some(folder) = dir.parent() {
        std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    }
    let truth = |cycle: u64| rows.iter().find(|row| row.sighted == cycle).and_then(|row| row.truth).unwrap_or_default();
    let again = take
        .due_again_s
        .iter()
        .map(|&from_s| Span { seconds: [from_s, from_s + 1e-3 * RECOVERY_MS], label: String::new() });
    let run = Run {
        title: format!("Scene {}: {} (take {} of {})", named.name, named.what, n + 1, named.takes.len()),
        score: Score::of_simulation(&played.sweeps, &rows, played.mote_hz, every_s, truth),
        others: Vec::new(),
        frames: played.frames,
        truth: played.truth,
        stations: reference::Room::of(&room.calibration).marks(),
        spans: again.collect(),
        seconds: take.scene.length_s,
        cpu_percent: f64::NAN,
        lost: u64::from(played.garbled),
        more: vec![
            ("seed".to_string(), json!(take.seed)),
            ("locks_lost".to_string(), json!(played.locks_lost)),
            ("edges_lost".to_string(), json!(played.edges_lost)),
        ],
        fixes: rows,
    };
    output::write(&dir, &run)?;
    println!("\n{}", output::table(&run));
    println!("{HEADING}\n{}", line(&named.name, &figures));
    println!("written to {OUT}/{}: fixes.csv frames.pcap trajectory.svg summary.json", named.name);
    Ok(())
}

/// Above the lines of the scenes; errors are of fixes of level full, but for the one of level tracked.
const HEADING: &str = "\
scene                   fixes   sweeps followed by   error of good fixes, cm   tracked    wrong  recovery first fix  locks         other
                  good  track   any fix    a good  median     p95    worst     worst     good        ms        ms   lost crash frames  reasons in health; promises broken";

fn line(name: &str, figures: &Figures) -> String {
    let broken: Vec<String> = figures.broken().iter().map(|promise| format!("; BROKEN: {promise}")).collect();
    let reasons: Vec<String> = figures.reasons.iter().map(ToString::to_string).collect();
    format!(
        "{name:<20} {:>4} {:>5} {:>7} % {:>7} % {:>7} {:>7} {:>8} {:>9} {:>8} {:>9} {:>9} {:>6} {:>5} {:>6}  {}{}",
        figures.good,
        figures.tracked,
        figure(figures.coverage, 1),
        figure(figures.good_coverage, 1),
        figure(figures.median_cm, 2),
        figure(figures.p95_cm, 2),
        figure(figures.worst_cm, 2),
        figure(figures.worst_tracked_cm, 2),
        figures.wrong_good,
        waited(figures.recovery_ms),
        waited(figures.first_fix_ms),
        figures.locks_lost,
        figures.crashes,
        figures.other_frames + figures.garbled,
        reasons.join(", "),
        broken.concat().trim_start_matches(if reasons.is_empty() { "; " } else { "" })
    )
}

/// A time, a dash where none was asked for, a word where it never ended.
fn waited(ms: f64) -> String {
    if ms == f64::INFINITY { "never".to_string() } else { figure(ms, 1) }
}

fn summarised(rows: &[(&Named, &Figures)], curves: Option<&curves::Curves>, table: &str) -> Value {
    // What is not finite has no number in JSON and becomes null.
    let scenes: serde_json::Map<String, Value> = rows
        .iter()
        .map(|(named, figures)| {
            let broken: Vec<String> = figures.broken().iter().map(ToString::to_string).collect();
            let row = json!({
                "what": named.what,
                "takes": named.takes.len(),
                "seconds": named.takes.iter().map(|take| take.scene.length_s).sum::<f64>(),
                "good_fixes": figures.good,
                "tracked_fixes": figures.tracked,
                "coverage_percent": figures.coverage,
                "good_coverage_percent": figures.good_coverage,
                "median_cm": figures.median_cm,
                "p95_cm": figures.p95_cm,
                "worst_cm": figures.worst_cm,
                "worst_tracked_cm": figures.worst_tracked_cm,
                "wrong_good": figures.wrong_good,
                "recovery_ms": figures.recovery_ms,
                "never_recovered": figures.recovery_ms == f64::INFINITY,
                "first_fix_ms": figures.first_fix_ms,
                "locks_lost": figures.locks_lost,
                "edges_lost": figures.edges_lost,
                "crashes": figures.crashes,
                "other_frames": figures.other_frames,
                "garbled_frames": figures.garbled,
                "reasons": figures.reasons.iter().map(ToString::to_string).collect::<Vec<_>>(),
                "promises_broken": broken,
            });
            (named.name.clone(), row)
        })
        .collect();
    let good: usize = rows.iter().map(|(_, figures)| figures.good).sum();
    let mut summary = json!({ "scenes": scenes, "good_fixes": good, "table": table });
    if let Some(curves) = curves {
        summary["range"] = curves.range.summary();
        summary["incidence"] = curves.incidence.summary();
    }
    summary
}

/// Whether exactly those promises are broken that are known to be.
fn promises(broken: &[(&str, Vec<Promise>)], until_met: &[(&str, Promise)]) -> Result<()> {
    let mut wrong = String::new();
    for (scene, promises) in broken {
        for promise in promises.iter().filter(|promise| !until_met.contains(&(*scene, **promise))) {
            let _ = write!(wrong, "\n  {scene}: {promise}");
        }
    }
    for (scene, promise) in until_met {
        if !broken.iter().any(|(name, promises)| name == scene && promises.contains(promise)) {
            let _ = write!(wrong, "\n  {scene}: {promise} holds; take it from those known to be broken");
        }
    }
    ensure!(wrong.is_empty(), "promises:{wrong}");
    Ok(())
}

/// Whether every line is as expected.
fn compare(known: &str, is: &str) -> Result<()> {
    let name = |line: &str| line.split_whitespace().next().unwrap_or_default().to_string();
    let (known, is): (Vec<&str>, Vec<&str>) = (known.lines().collect(), is.lines().collect());
    let mut changed = String::new();
    for line in &known {
        if !is.contains(line) {
            let _ = write!(changed, "\n- {line}");
            if let Some(now) = is.iter().find(|now| name(now) == name(line) && !known.contains(now)) {
                let _ = write!(changed, "\n+ {now}");
            }
        }
    }
    for line in is.iter().filter(|line| !known.contains(line) && !known.iter().any(|old| name(old) == name(line))) {
        let _ = write!(changed, "\n+ {line}");
    }
    ensure!(changed.is_empty(), "against {EXPECTED}, where it is meant `cargo xtask scenes --bless`:{changed}");
    println!("as expected in {EXPECTED}");
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_broken_promise_is_named_and_so_is_one_that_holds_again() {
        let broken = [("a", vec![Promise::Recovery]), ("b", vec![])];
        assert!(promises(&broken, &[("a", Promise::Recovery)]).is_ok());
        let new = promises(&broken, &[]).expect_err("nobody knew");
        assert!(new.to_string().contains("a: recovery"), "{new}");
        let mended = promises(&broken, &[("a", Promise::Recovery), ("b", Promise::NoCrash)]).expect_err("it holds");
        assert!(mended.to_string().contains("b: crash holds"), "{mended}");
    }

    #[test]
    fn every_exception_is_of_a_scene_there_is() {
        let all = list::all();
        for (scene, _) in UNTIL_MET.iter().chain(&LIMITS) {
            assert!(all.iter().any(|named| named.name == *scene), "{scene}");
        }
    }

    #[test]
    fn a_changed_line_is_shown_as_it_was_and_as_it_is() {
        assert!(compare("a 1\nb 2\n", "a 1\nb 2\n").is_ok());
        let changed = compare("a 1\nb 2\n", "a 1\nb 3\nc 4\n").expect_err("b changed").to_string();
        assert!(changed.contains("- b 2\n+ b 3\n+ c 4"), "{changed}");
        let gone = compare("a 1\nb 2\n", "a 1\n").expect_err("b is gone").to_string();
        assert!(gone.contains("- b 2"), "{gone}");
    }

    #[test]
    fn work_on_all_cores_comes_back_once_each_and_an_error_ends_it() {
        let jobs: Vec<usize> = (0..100).collect();
        let mut seen = vec![0; jobs.len()];
        let doubled = on_all_cores(
            &jobs,
            |n| Ok(2 * n),
            |job, twice| {
                assert_eq!(twice, 2 * job);
                seen[job] += 1;
                Ok(())
            },
        );
        assert!(doubled.is_ok() && seen.iter().all(|&times| times == 1));
        let error = on_all_cores(&jobs, |n| if *n == 50 { bail!("fifty") } else { Ok(()) }, |_, ()| Ok(()));
        assert!(error.is_err());
    }
}
