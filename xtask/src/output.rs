//! What a run leaves behind: a table to read, and a folder to keep.
//!
//! The folder has `fixes.csv` (every fix with its truth), `frames.pcap` (what went on air),
//! `trajectory.svg` (to look at) and `summary.json` (the table's figures by name).
//!
//! # Design
//! The folder appears whole or not at all: it is written beside its place under another name and
//! renamed at the end. Until then an earlier run stays as it was.
//!
//! # What can go wrong
//! A full disk or a frame that no radio can send: the error says which file, and what was written
//! so far is removed. A folder that holds anything but an earlier run is not replaced.

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow, ensure};
use serde_json::{Map, Value, json};

use crate::pcap::{self, Frame};
use crate::score::{FixRow, Place, Score};
use crate::svg::{self, Picture, Span, StationMark, figure};

/// The files of a run.
const FILES: [&str; 4] = ["fixes.csv", "frames.pcap", "trajectory.svg", "summary.json"];

/// Everything about a run that is worth keeping.
#[derive(Clone, Debug)]
pub struct Run {
    /// What was run, for a headline.
    pub title: String,
    /// How good it was.
    pub score: Score,
    /// Other methods on the same light, by name, for comparison.
    pub others: Vec<(String, Score)>,
    /// What the mote reported, in order.
    pub fixes: Vec<FixRow>,
    /// What went on air, in order.
    pub frames: Vec<Frame>,
    /// Where the mote was.
    pub truth: Vec<Place>,
    /// The stations.
    pub stations: Vec<StationMark>,
    /// Stretches of time to shade in the picture.
    pub spans: Vec<Span>,
    /// How long the mote ran, seconds of nominal mote time.
    pub seconds: f64,
    /// Part of the core's cycles that it did not sleep, in percent.
    pub cpu_percent: f64,
    /// Edges, pulses, fixes and frames that the mote says it lost.
    pub lost: u64,
    /// Further figures for the table and the summary: key, and value as it should be written.
    pub more: Vec<(String, Value)>,
}

/// The end of a run as a table for the terminal.
pub fn table(run: &Run) -> String {
    let mut out = format!("{}\n\n", run.title);
    let names = std::iter::once("this run").chain(run.others.iter().map(|(name, _)| name.as_str()));
    let wide = names.clone().map(|name| name.chars().count()).max().unwrap_or(0);
    let _ =
        writeln!(out, "{:wide$} | {:^20} | {:^20} | {:^15} |", "cm", "mean absolute error", "95th percentile", "3-D");
    let _ = writeln!(
        out,
        "{:wide$} | {:>6} {:>6} {:>6} | {:>6} {:>6} {:>6} | {:>7} {:>7} | coverage",
        "", "x", "y", "z", "x", "y", "z", "mean", "RMS"
    );
    let _ = writeln!(out, "{:-<wide$}-+-{:-<20}-+-{:-<20}-+-{:-<15}-+---------", "", "", "", "");
    for (name, score) in names.zip(std::iter::once(&run.score).chain(run.others.iter().map(|o| &o.1))) {
        let three = |values: [f64; 3], digits| {
            let [x, y, z] = values.map(|v| figure(v, digits));
            format!("{x:>6} {y:>6} {z:>6}")
        };
        let _ = writeln!(
            out,
            "{name:wide$} | {} | {} | {:>7} {:>7} | {:>6} %",
            three(score.mae_cm, 2),
            three(score.p95_cm, 2),
            figure(score.mean3d_cm, 2),
            figure(score.rms3d_cm, 2),
            figure(100.0 * score.coverage(), 1)
        );
    }
    let rate = run.fixes.len() as f64 / run.seconds;
    let mut rows = vec![
        ("scored".to_owned(), format!("{} sweeps, {} with a fix", run.score.scored, run.score.fixed)),
        ("fixes".to_owned(), format!("{} in {:.1} s, {} per second", run.fixes.len(), run.seconds, figure(rate, 1))),
        ("frames".to_owned(), run.frames.len().to_string()),
        ("lost".to_owned(), run.lost.to_string()),
        ("cpu".to_owned(), format!("{} % of the cycles", figure(run.cpu_percent, 1))),
    ];
    rows.extend(run.more.iter().map(|(key, value)| {
        let text = value.as_str().map_or_else(|| value.to_string(), str::to_owned);
        (key.replace('_', " "), text)
    }));
    let wide = rows.iter().map(|row| row.0.chars().count()).max().unwrap_or(0);
    out.push('\n');
    for (key, value) in rows {
        let _ = writeln!(out, "{key:wide$}  {value}");
    }
    out
}

/// Writes the run into the folder `dir`, in place of an earlier run.
pub fn write(dir: &Path, run: &Run) -> Result<()> {
    ensure_replaceable(dir)?;
    let stage = Stage::beside(dir)?;
    let save = |name: &str, bytes: &[u8]| {
        let path = stage.path.join(name);
        fs::write(&path, bytes).with_context(|| format!("{name} of {}: cannot be written", dir.display()))
    };
    save(FILES[0], fixes_csv(&run.fixes).as_bytes())?;
    let mut capture = Vec::new();
    pcap::write(&run.frames, &mut capture).with_context(|| format!("{} of {}", FILES[1], dir.display()))?;
    save(FILES[1], &capture)?;
    let picture = Picture {
        title: &run.title,
        score: &run.score,
        fixes: &run.fixes,
        truth: &run.truth,
        stations: &run.stations,
        spans: &run.spans,
    };
    save(FILES[2], svg::draw(&picture).as_bytes())?;
    let mut summary = serde_json::to_string_pretty(&summary(run))?;
    summary.push('\n');
    save(FILES[3], summary.as_bytes())?;
    stage.take_place_of(dir)
}

/// Refuses a place that holds anything but an earlier run.
pub fn ensure_replaceable(dir: &Path) -> Result<()> {
    if !dir.exists() {
        return Ok(());
    }
    let place = dir.display();
    ensure!(dir.is_dir(), "{place}: is there already and is not a folder");
    for entry in fs::read_dir(dir).with_context(|| format!("{place}: cannot be read"))? {
        let name = entry?.file_name();
        let ours = name.to_str().is_some_and(|name| FILES.contains(&name));
        ensure!(
            ours,
            "{place}: holds `{}`, which no run wrote; choose another folder or empty this one",
            name.display()
        );
    }
    Ok(())
}

/// A folder under construction; gone again unless it takes its place.
struct Stage {
    path: PathBuf,
    old: PathBuf,
}

impl Stage {
    fn beside(dir: &Path) -> Result<Self> {
        let name = dir
            .file_name()
            .and_then(|name| name.to_str())
            .ok_or_else(|| anyhow!("{}: is not a name for a folder of results", dir.display()))?;
        let parent = dir.parent().filter(|parent| !parent.as_os_str().is_empty());
        let parent = parent.unwrap_or(Path::new("."));
        fs::create_dir_all(parent).with_context(|| format!("{}: cannot be made", parent.display()))?;
        let mark = std::process::id();
        let path = parent.join(format!(".{name}.{mark}.partial"));
        let old = parent.join(format!(".{name}.{mark}.old"));
        fs::create_dir(&path).with_context(|| format!("{}: cannot be made", path.display()))?;
        Ok(Self { path, old })
    }

    /// Renames into place; an earlier run steps aside first and comes back if that fails.
    fn take_place_of(self, dir: &Path) -> Result<()> {
        let place = dir.display();
        let earlier = dir.exists();
        if earlier {
            fs::rename(dir, &self.old).with_context(|| format!("{place}: cannot be replaced"))?;
        }
        if let Err(error) = fs::rename(&self.path, dir) {
            if earlier {
                let _ = fs::rename(&self.old, dir);
            }
            return Err(error).with_context(|| format!("{place}: cannot be put in its place"));
        }
        if earlier {
            fs::remove_dir_all(&self.old)
                .with_context(|| format!("{}: the earlier run cannot be removed", self.old.display()))?;
        }
        Ok(())
    }
}

impl Drop for Stage {
    fn drop(&mut self) {
        // Nothing is left here once it took its place.
        let _ = fs::remove_dir_all(&self.path);
    }
}

fn fixes_csv(fixes: &[FixRow]) -> String {
    let mut out =
        String::from("cycle,seconds,sequence,x_m,y_m,z_m,mismatch_m,age_s,truth_x_m,truth_y_m,truth_z_m,error_m\n");
    for fix in fixes {
        let [x, y, z] = fix.position;
        let _ = write!(
            out,
            "{},{:.6},{},{x:.5},{y:.5},{z:.5},{:.5},{:.5}",
            fix.cycle, fix.seconds, fix.sequence, fix.mismatch_m, fix.age_s
        );
        let _ = match (fix.truth, fix.error_m()) {
            (Some([x, y, z]), Some(error)) => writeln!(out, ",{x:.5},{y:.5},{z:.5},{error:.5}"),
            _ => writeln!(out, ",,,,"),
        };
    }
    out
}

/// A score's figures by name; what is not a number is null.
fn figures(score: &Score) -> Map<String, Value> {
    let rounded = |value: f64| json!((value * 1e4).round() / 1e4);
    let mut map = Map::new();
    map.insert("mae_cm".into(), json!(score.mae_cm.map(rounded)));
    map.insert("p95_cm".into(), json!(score.p95_cm.map(rounded)));
    map.insert("rms3d_cm".into(), rounded(score.rms3d_cm));
    map.insert("mean3d_cm".into(), rounded(score.mean3d_cm));
    map.insert("coverage".into(), rounded(score.coverage()));
    map.insert("scored".into(), json!(score.scored));
    map.insert("scored_with_fix".into(), json!(score.fixed));
    map
}

fn summary(run: &Run) -> Map<String, Value> {
    let mut map = Map::new();
    map.insert("title".into(), json!(run.title));
    map.extend(figures(&run.score));
    map.insert("cpu_percent".into(), json!((run.cpu_percent * 1e3).round() / 1e3));
    map.insert("seconds".into(), json!((run.seconds * 1e6).round() / 1e6));
    map.insert("fixes".into(), json!(run.fixes.len()));
    map.insert("frames".into(), json!(run.frames.len()));
    map.insert("lost".into(), json!(run.lost));
    map.extend(run.more.iter().cloned());
    if !run.others.is_empty() {
        let others: Map<String, Value> =
            run.others.iter().map(|(name, score)| (name.clone(), figures(score).into())).collect();
        map.insert("others".into(), others.into());
    }
    map
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::score::tests::fix;

    fn run() -> Run {
        let mut known = fix(2_000_000, [1.0, 2.0, 3.0]);
        known.truth = Some([1.0, 2.0, 3.01]);
        Run {
            title: "a walk".into(),
            score: Score::of_errors(4, &[[0.0, 0.0, -0.01], [0.02, 0.0, 0.0]]),
            others: vec![("double precision".into(), Score::of_errors(4, &[]))],
            fixes: vec![fix(1_000_000, [0.0; 3]), known],
            frames: vec![Frame { micros: 1, bytes: pcap::tests::data_frame(1, b"hello") }],
            truth: vec![(1.0, [0.0; 3]), (1.1, [0.1; 3])],
            stations: Vec::new(),
            spans: Vec::new(),
            seconds: 2.0,
            cpu_percent: 12.3456,
            lost: 7,
            more: vec![("half_turn_ticks".into(), json!(90_207)), ("seed".into(), json!("0x2a"))],
        }
    }

    fn names(dir: &Path) -> Vec<String> {
        let mut names: Vec<String> =
            fs::read_dir(dir).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn a_run_leaves_its_four_files_and_nothing_else() {
        let home = tempfile::tempdir().unwrap();
        let dir = home.path().join("target/run");
        write(&dir, &run()).unwrap();
        write(&dir, &run()).unwrap();
        assert_eq!(names(&dir), ["fixes.csv", "frames.pcap", "summary.json", "trajectory.svg"]);
        assert_eq!(names(&home.path().join("target")), ["run"]);
        let csv = fs::read_to_string(dir.join("fixes.csv")).unwrap();
        let columns = csv.lines().next().unwrap().split(',').count();
        assert!(csv.lines().all(|line| line.split(',').count() == columns), "{csv}");
        assert!(csv.ends_with(",1.00000,2.00000,3.01000,0.01000\n"), "{csv}");
    }

    #[test]
    fn the_summary_has_the_figures_by_name() {
        let home = tempfile::tempdir().unwrap();
        let dir = home.path().join("run");
        write(&dir, &run()).unwrap();
        let text = fs::read_to_string(dir.join("summary.json")).unwrap();
        let summary: Value = serde_json::from_str(&text).unwrap();
        assert_eq!(summary["mae_cm"], json!([1.0, 0.0, 0.5]));
        assert_eq!(summary["mean3d_cm"], json!(1.5));
        assert_eq!(summary["coverage"], json!(0.5));
        assert_eq!(summary["cpu_percent"], json!(12.346));
        for (key, value) in [("fixes", 2), ("frames", 1), ("lost", 7), ("half_turn_ticks", 90_207)] {
            assert_eq!(summary[key], json!(value), "{key}");
        }
        assert!(summary["p95_cm"].is_array() && summary["rms3d_cm"].is_number());
        assert!(summary["others"]["double precision"]["mean3d_cm"].is_null());
    }

    #[test]
    fn a_run_that_cannot_be_written_leaves_the_earlier_one_as_it_was() {
        let home = tempfile::tempdir().unwrap();
        let dir = home.path().join("run");
        write(&dir, &run()).unwrap();
        let before = fs::read(dir.join("summary.json")).unwrap();
        let mut bad = run();
        bad.title = "another".into();
        bad.frames[0].bytes = vec![0; 200];
        let error = format!("{:#}", write(&dir, &bad).unwrap_err());
        assert!(error.contains("frames.pcap") && error.contains("200 bytes"), "{error}");
        assert_eq!(names(home.path()), ["run"]);
        assert_eq!(fs::read(dir.join("summary.json")).unwrap(), before);
    }

    #[test]
    fn a_folder_that_is_not_a_run_is_left_alone() {
        let home = tempfile::tempdir().unwrap();
        fs::write(home.path().join("thesis.tex"), "years of work").unwrap();
        let error = write(home.path(), &run()).unwrap_err().to_string();
        assert!(error.contains("thesis.tex"), "{error}");
        assert_eq!(names(home.path()), ["thesis.tex"]);
        let file = home.path().join("thesis.tex");
        assert!(write(&file, &run()).unwrap_err().to_string().contains("not a folder"));
        assert!(write(Path::new("/"), &run()).is_err());
    }

    #[test]
    fn the_table_lines_up() {
        let text = table(&run());
        println!("{text}");
        let bars: Vec<Vec<usize>> = text
            .lines()
            .skip(2)
            .take(5)
            .map(|line| line.char_indices().filter(|c| matches!(c.1, '|' | '+')).map(|c| c.0).collect())
            .collect();
        assert!(bars.windows(2).all(|pair| pair[0] == pair[1]), "{text}");
        assert!(text.contains("half turn ticks  90207") && text.contains("  0x2a\n"), "{text}");
    }
}
