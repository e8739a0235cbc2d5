//! A guided session: the mote is put at one known place after another, and each place is looked at for a few seconds.
//!
//! # Design
//! What was seen at a place is written to a file of its own, under another name first, as soon as the place is done. So
//! nothing is lost when the session is broken off, and starting again goes on where it stopped. The files hold angles
//! alone: a place mistyped in the list is corrected there and need not be visited again.
//!
//! What can go wrong: a rotor that is not seen, a mote that moves while it is looked at, light that scatters. Each is
//! said at once, while the mote still stands there, and the person decides.

use std::fmt::Write as _;
use std::io::{BufRead, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow, bail, ensure};
use nalgebra::Vector3;
use sha2::{Digest, Sha256};

use super::points::{FEWEST, Point, Points};
use super::solve::{Sighting, TruthSample};
use crate::quantile::quantile;
use crate::whole;

/// Where angles come from while the session goes on.
pub trait Source {
    /// The mote now stands at `point`; what came before does not count.
    fn begin(&mut self, point: &Point) -> Result<()>;
    /// What came since; waits a little. Nothing is no error, a source that has ended is.
    fn next(&mut self) -> Result<Vec<Sighting>>;
}

/// What was seen at a place.
#[derive(Clone, Debug)]
pub struct Measured {
    /// The place.
    pub point: Point,
    /// What was seen there, in the order of time.
    pub sightings: Vec<Sighting>,
}

/// The rotors, station by station, azimuth before elevation.
pub const ROTORS: [&str; 4] = ["A az", "A el", "B az", "B el"];
/// Silence after which a person is told, of wall time.
const SILENCE: Duration = Duration::from_secs(5);
/// How often the line with its state is written anew.
const REDRAW: Duration = Duration::from_millis(100);
/// A rotor seen less often than this per second is as good as not seen; it sweeps 30 times.
const SELDOM_HZ: f64 = 3.0;
/// Robust standard deviation of an angle beyond which a place is doubtful, degrees: five times what a mote that lies
/// still shows under the recorded jitter of 5 us, 0.11 degrees at worst.
const SCATTER_DEG: f64 = 0.5;
/// A change of the median from the first third to the last beyond which the mote has moved, degrees: 1 mm at 1 m.
const MOVED_DEG: f64 = 0.06;
/// Sightings further from the median than this many robust standard deviations are no sightings of this place.
const OUTLIER: f64 = 4.0;
/// Standard deviation of a Gaussian over the median of its absolute values.
const PER_MEDIAN: f64 = 1.4826;
/// Robust averages that stand for one rotor at one place.
const AVERAGES: usize = 8;
/// Seconds from one place to the next on the clock that is made up for the solver.
pub const PLACE_S: f64 = 10.0;

/// Position of a sighting's rotor in [`ROTORS`].
fn rotor(sighting: &Sighting) -> usize {
    2 * sighting.station + sighting.axis
}

/// How well one rotor was seen from a place.
#[derive(Clone, Copy, Debug, Default)]
struct Quality {
    rate_hz: f64,
    scatter_deg: f64,
    moved_deg: f64,
    /// What chance alone would make of `moved_deg`, three times over.
    chance_deg: f64,
}

fn quality(sightings: &[Sighting], seconds: f64) -> [Quality; 4] {
    std::array::from_fn(|index| {
        let mut angles: Vec<f64> =
            sightings.iter().filter(|s| rotor(s) == index).map(|s| s.angle.to_degrees()).collect();
        if angles.len() < 3 {
            return Quality { rate_hz: angles.len() as f64 / seconds, ..Quality::default() };
        }
        let third = angles.len() / 3;
        let first = quantile(&mut angles[..third].to_vec(), 0.5);
        let last = quantile(&mut angles[angles.len() - third..].to_vec(), 0.5);
        let rate_hz = angles.len() as f64 / seconds;
        // From one sweep to the next a slow mote hardly moves, so this is noise alone.
        let mut steps: Vec<f64> = angles.windows(2).map(|pair| (pair[1] - pair[0]).abs()).collect();
        let noise_deg = PER_MEDIAN * quantile(&mut steps, 0.5) / 2f64.sqrt();
        let scatter_deg = scatter(&mut angles).1;
        // The median's deviation is 1.25 times the mean's; two of them are compared.
        let chance_deg = 3.0 * noise_deg * 1.25 * (2.0 / third as f64).sqrt();
        Quality { rate_hz, scatter_deg, moved_deg: (last - first).abs(), chance_deg }
    })
}

/// Median and robust standard deviation.
fn scatter(values: &mut [f64]) -> (f64, f64) {
    let median = quantile(values, 0.5);
    let mut off: Vec<f64> = values.iter().map(|value| (value - median).abs()).collect();
    (median, PER_MEDIAN * quantile(&mut off, 0.5))
}

/// What a person should know before leaving the place; empty when all is well.
fn complaints(quality: &[Quality; 4]) -> Vec<String> {
    let mut said = Vec::new();
    for (name, rotor) in ROTORS.iter().zip(quality) {
        if rotor.rate_hz < SELDOM_HZ {
            said.push(format!(
                "{name} was seen {:.1} times a second: is its station in sight of the mote?",
                rotor.rate_hz
            ));
        } else if rotor.moved_deg > MOVED_DEG + rotor.chance_deg {
            said.push(format!("{name} changed by {:.2} degrees: did the mote move?", rotor.moved_deg));
        } else if rotor.scatter_deg > SCATTER_DEG {
            said.push(format!(
                "{name} scatters by {:.2} degrees: does the mote shake, or does something shine?",
                rotor.scatter_deg
            ));
        }
    }
    said
}

fn state(seconds: f64, quality: &[Quality; 4]) -> String {
    let mut line = format!("{seconds:5.1} s ");
    for (name, rotor) in ROTORS.iter().zip(quality) {
        let _ = write!(line, "  {name} {:4.1}/s \u{b1}{:.2}\u{b0}", rotor.rate_hz, rotor.scatter_deg);
    }
    line
}

/// The session's folder and how it talks.
pub struct Session<'a> {
    /// Where the finished places are kept.
    pub folder: PathBuf,
    /// What a person types.
    pub input: &'a mut dyn BufRead,
    /// What a person reads.
    pub output: &'a mut dyn Write,
    /// Whether that is a terminal, on which a line can be written anew.
    pub terminal: bool,
}

impl Session<'_> {
    /// Leads through the places that are not finished, and returns all that are.
    pub fn run(&mut self, points: &Points, source: &mut dyn Source) -> Result<Vec<Measured>> {
        std::fs::create_dir_all(&self.folder).with_context(|| format!("{}: cannot be made", self.folder.display()))?;
        let mut finished: Vec<Option<Measured>> = Vec::new();
        for point in &points.points {
            finished.push(self.earlier(point)?);
        }
        let done = finished.iter().flatten().count();
        let place = self.folder.display().to_string();
        writeln!(self.output, "{} places; each is kept in {place} as soon as it is done", points.points.len())?;
        if done > 0 {
            writeln!(self.output, "{done} of them are there from before; delete a file to measure its place anew")?;
        }
        for (index, point) in
            points.points.iter().enumerate().filter(|(index, _)| finished[*index].is_none()).collect::<Vec<_>>()
        {
            let [x, y, z] = point.position.into();
            let heading = format!(
                "place {} of {}: put the mote at \"{}\" ({x:.3}, {y:.3}, {z:.3}) m and press Enter  [s: skip, q: enough] ",
                index + 1,
                points.points.len(),
                point.name
            );
            match self.visit(&heading, point, points.seconds, source)? {
                Visit::Done(measured) => finished[index] = Some(measured),
                Visit::Skipped => {}
                Visit::Enough => break,
            }
        }
        let measured: Vec<Measured> = finished.into_iter().flatten().collect();
        ensure!(
            measured.len() >= FEWEST,
            "{place}: {} of {} places are measured and {FEWEST} are the least; they are kept, and the same command goes on",
            measured.len(),
            points.points.len()
        );
        Ok(measured)
    }

    fn visit(&mut self, heading: &str, point: &Point, seconds: f64, source: &mut dyn Source) -> Result<Visit> {
        loop {
            match self.ask(heading)?.as_str() {
                "" => {}
                "s" => return Ok(Visit::Skipped),
                "q" => return Ok(Visit::Enough),
                other => {
                    writeln!(self.output, "`{other}`? Enter to measure, s to skip this place, q when it is enough")?;
                    continue;
                }
            }
            source.begin(point)?;
            let Some(sightings) = self.look(seconds, source)? else { continue };
            let quality = quality(&sightings, seconds);
            writeln!(self.output, "{}", state(seconds, &quality))?;
            let complaints = complaints(&quality);
            for complaint in &complaints {
                writeln!(self.output, "  {complaint}")?;
            }
            let keep = complaints.is_empty() || self.keep()?;
            if keep {
                let measured = Measured { point: point.clone(), sightings };
                let file = self.save(&measured)?;
                writeln!(self.output, "  kept: {}", file.display())?;
                return Ok(Visit::Done(measured));
            }
        }
    }

    fn keep(&mut self) -> Result<bool> {
        loop {
            match self.ask("  Enter: look again, k: keep it all the same ")?.as_str() {
                "" => return Ok(false),
                "k" => return Ok(true),
                other => writeln!(self.output, "  `{other}`?")?,
            }
        }
    }

    fn ask(&mut self, question: &str) -> Result<String> {
        write!(self.output, "{question}")?;
        self.output.flush()?;
        let mut line = String::new();
        let count = self.input.read_line(&mut line).context("cannot read what you type")?;
        if !self.terminal {
            writeln!(self.output)?;
        }
        if count == 0 {
            bail!("{}: input ended; the finished places are kept, and the same command goes on", self.folder.display());
        }
        Ok(line.trim().to_lowercase())
    }

    /// Looks for so long of mote time; nothing when nothing is to be seen.
    fn look(&mut self, seconds: f64, source: &mut dyn Source) -> Result<Option<Vec<Sighting>>> {
        let mut sightings: Vec<Sighting> = Vec::new();
        let mut heard = Instant::now();
        let mut drawn = Instant::now();
        loop {
            let new = source.next()?;
            if new.is_empty() {
                if heard.elapsed() > SILENCE {
                    writeln!(
                        self.output,
                        "  nothing heard for {} s: is the mote on, in reach of the receiver, and told to send angles?",
                        SILENCE.as_secs()
                    )?;
                    return Ok(None);
                }
                continue;
            }
            heard = Instant::now();
            sightings.extend(new);
            let first = sightings[0].at_s;
            let last = sightings.last().map_or(first, |sighting| sighting.at_s);
            if last - first >= seconds {
                sightings.retain(|sighting| sighting.at_s - first < seconds);
                if self.terminal {
                    write!(self.output, "\r\x1b[2K")?;
                }
                return Ok(Some(sightings));
            }
            if self.terminal && drawn.elapsed() > REDRAW {
                drawn = Instant::now();
                let so_far = quality(&sightings, (last - first).max(0.1));
                write!(self.output, "\r\x1b[2K{}", state(last - first, &so_far))?;
                self.output.flush()?;
            }
        }
    }

    fn file(&self, point: &Point) -> PathBuf {
        let plain: String = point.name.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '-' }).collect();
        // Names that differ only in what a file cannot be called stay apart.
        let hash = Sha256::digest(point.name.as_bytes());
        self.folder.join(format!("{plain}-{:02x}{:02x}.csv", hash[0], hash[1]))
    }

    fn save(&self, measured: &Measured) -> Result<PathBuf> {
        let mut text = String::from(HEADER);
        for sighting in &measured.sightings {
            let name = ROTORS[rotor(sighting)];
            let _ = writeln!(text, "{:.6},{},{},{:.8}", sighting.at_s, &name[..1], &name[2..], sighting.angle);
        }
        let file = self.file(&measured.point);
        whole::write(&file, text.as_bytes())?;
        Ok(file)
    }

    /// What an earlier session saw at the place.
    fn earlier(&self, point: &Point) -> Result<Option<Measured>> {
        let file = self.file(point);
        if !file.exists() {
            return Ok(None);
        }
        Ok(Some(Measured { point: point.clone(), sightings: read(&file)? }))
    }
}

enum Visit {
    Done(Measured),
    Skipped,
    Enough,
}

const HEADER: &str = "at_s,station,axis,angle_rad\n";

fn read(file: &Path) -> Result<Vec<Sighting>> {
    let name = file.display();
    let text = std::fs::read_to_string(file).with_context(|| format!("{name}: cannot be read"))?;
    let body = text.strip_prefix(HEADER).ok_or_else(|| anyhow!("{name}:1: the header is not `{}`", HEADER.trim()))?;
    let mut sightings = Vec::new();
    for (index, line) in body.lines().enumerate() {
        let wrong = |what: &str| anyhow!("{name}:{}: {what} in `{line}`; delete the file to measure anew", index + 2);
        let cells: Vec<&str> = line.split(',').collect();
        let [at_s, station, axis, angle] = cells[..] else { return Err(wrong("not four cells")) };
        let number = |text: &str| text.parse::<f64>().ok().filter(|x| x.is_finite()).ok_or_else(|| wrong("no number"));
        let of = |text: &str, names: [&str; 2]| {
            names.iter().position(|name| *name == text).ok_or_else(|| wrong("no such rotor"))
        };
        sightings.push(Sighting {
            at_s: number(at_s)?,
            station: of(station, ["A", "B"])?,
            axis: of(axis, ["az", "el"])?,
            angle: number(angle)?,
        });
    }
    ensure!(!sightings.is_empty(), "{name}: holds no angle; delete the file to measure anew");
    Ok(sightings)
}

/// The places as the solver wants them: each is a moment of a made-up path, seen by robust averages.
///
/// Averages, because thirty sightings of one place are no more places than one, but a rotor that was seen badly from it
/// must not count as much as the others.
pub fn averages(measured: &[Measured]) -> (Vec<Sighting>, Vec<TruthSample>) {
    let mut sightings = Vec::new();
    let mut truth = Vec::new();
    for (place, measured) in measured.iter().enumerate() {
        let start_s = place as f64 * PLACE_S;
        for index in 0..4 {
            let of: Vec<&Sighting> = measured.sightings.iter().filter(|s| rotor(s) == index).collect();
            let mut angles: Vec<f64> = of.iter().map(|s| s.angle).collect();
            if angles.is_empty() {
                continue;
            }
            let (median, deviation) = scatter(&mut angles);
            let near: Vec<f64> =
                of.iter().map(|s| s.angle).filter(|angle| (angle - median).abs() <= OUTLIER * deviation).collect();
            let parts = AVERAGES.min(near.len());
            for part in 0..parts {
                let block = &near[part * near.len() / parts..(part + 1) * near.len() / parts];
                sightings.push(Sighting {
                    at_s: start_s + part as f64 * STEP_S,
                    station: index / 2,
                    axis: index % 2,
                    angle: block.iter().sum::<f64>() / block.len() as f64,
                });
            }
        }
        // From before the first average to after the last, so that each lies between two samples.
        for step in -1..=AVERAGES as i32 {
            truth.push(TruthSample {
                at_s: start_s + f64::from(step) * STEP_S,
                position: Vector3::from(measured.point.position),
            });
        }
    }
    sightings.sort_by(|a, b| a.at_s.total_cmp(&b.at_s));
    (sightings, truth)
}

/// Seconds between two averages on the made-up clock.
const STEP_S: f64 = 0.01;

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use super::*;
    use crate::calibrate::points;
    use crate::calibrate::simulate::Simulated;

    const DESK: &str = "seconds = 1\n[[sheet]]\nname = \"A4\"\nsize = [0.297, 0.210]\nheights = [0.0, 0.1]\n";

    /// Plays a session with what a person types; returns its end and what was said.
    fn play(folder: &Path, typed: &str, source: &mut dyn Source) -> (Result<Vec<Measured>>, String) {
        let points = points::read("points.toml", DESK).unwrap();
        let mut said = Vec::new();
        let mut input = Cursor::new(typed.as_bytes());
        let mut session = Session { folder: folder.to_owned(), input: &mut input, output: &mut said, terminal: false };
        (session.run(&points, source), String::from_utf8(said).unwrap())
    }

    fn room() -> Simulated {
        Simulated::around(&points::read("points.toml", DESK).unwrap().points, 1, false)
    }

    /// A room in which something is wrong.
    struct Spoilt(Simulated, fn(&mut Sighting));

    impl Source for Spoilt {
        fn begin(&mut self, point: &Point) -> Result<()> {
            self.0.begin(point)
        }
        fn next(&mut self) -> Result<Vec<Sighting>> {
            let mut seen = self.0.next()?;
            seen.iter_mut().for_each(self.1);
            seen.retain(|sighting| sighting.angle.is_finite());
            Ok(seen)
        }
    }

    #[test]
    fn a_session_visits_every_place_and_what_it_saw_is_read_back() {
        let home = tempfile::tempdir().unwrap();
        let (measured, said) = play(home.path(), &"\n".repeat(8), &mut room());
        let measured = measured.unwrap();
        assert_eq!(measured.len(), 8);
        assert!(
            said.contains("place 3 of 8: put the mote at \"A4 corner 3 at height 0\" (0.297, 0.210, 0.000) m"),
            "{said}"
        );
        assert_eq!(std::fs::read_dir(home.path()).unwrap().count(), 8, "one file a place and nothing else");
        // Started again, nothing is asked.
        let (again, said) = play(home.path(), "", &mut room());
        assert!(said.contains("8 of them are there from before"), "{said}");
        for (one, other) in measured.iter().zip(again.unwrap()) {
            assert_eq!(one.point, other.point);
            assert_eq!(one.sightings.len(), other.sightings.len());
            for (a, b) in one.sightings.iter().zip(&other.sightings) {
                assert_eq!((a.station, a.axis), (b.station, b.axis));
                assert!((a.angle - b.angle).abs() < 1e-8 && (a.at_s - b.at_s).abs() < 1e-6);
            }
        }
    }

    #[test]
    fn a_session_broken_off_goes_on_where_it_stopped() {
        let home = tempfile::tempdir().unwrap();
        let (broken, _) = play(home.path(), "\n\n\n", &mut room());
        let said = broken.unwrap_err().to_string();
        assert!(said.contains("input ended") && said.contains("kept"), "{said}");
        let (measured, said) = play(home.path(), "\n\nq\n", &mut room());
        assert_eq!(measured.unwrap().len(), 5);
        assert!(said.contains("3 of them are there from before") && !said.contains("place 3 of 8"), "{said}");
    }

    #[test]
    fn four_places_are_not_enough_and_say_so() {
        let home = tempfile::tempdir().unwrap();
        let (few, _) = play(home.path(), "\ns\n\n\n\nq\n", &mut room());
        let said = few.unwrap_err().to_string();
        assert!(said.contains("4 of 8 places are measured and 5 are the least"), "{said}");
    }

    #[test]
    fn a_mote_that_moves_is_noticed_and_looked_at_again() {
        let home = tempfile::tempdir().unwrap();
        // 0.3 degrees a second: 5 mm at 1 m.
        let mut moving = Spoilt(room(), |sighting| sighting.angle += 0.005 * sighting.at_s);
        let (_, said) = play(home.path(), "\n\n\nk\n", &mut moving);
        assert!(said.contains("did the mote move?"), "{said}");
        assert_eq!(said.matches("put the mote at").count(), 3, "asked again, kept, and on to the next");
        assert_eq!(std::fs::read_dir(home.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_rotor_that_is_not_seen_is_named() {
        let home = tempfile::tempdir().unwrap();
        let hide = |sighting: &mut Sighting| {
            if (sighting.station, sighting.axis) == (1, 1) {
                sighting.angle = f64::NAN;
            }
        };
        let (_, said) = play(home.path(), "\n", &mut Spoilt(room(), hide));
        assert!(said.contains("B el was seen 0.0 times a second: is its station in sight"), "{said}");
        let (_, said) = play(home.path(), "\n", &mut room());
        assert!(!said.contains("times a second: is") && said.contains("kept:"), "{said}");
    }

    #[test]
    fn a_spoilt_file_of_a_place_is_named_with_its_line() {
        let home = tempfile::tempdir().unwrap();
        let (_, _) = play(home.path(), "\n", &mut room());
        let file = std::fs::read_dir(home.path()).unwrap().next().unwrap().unwrap().path();
        let text = std::fs::read_to_string(&file).unwrap();
        let mut lines: Vec<&str> = text.lines().collect();
        lines[2] = "0.1,C,az,0.5";
        std::fs::write(&file, lines.join("\n")).unwrap();
        let said = play(home.path(), "", &mut room()).0.unwrap_err().to_string();
        assert!(said.contains(".csv:3: no such rotor in `0.1,C,az,0.5`; delete the file"), "{said}");
    }

    #[test]
    fn averages_leave_reflections_out() {
        let at = |n: usize, angle: f64| Sighting { at_s: n as f64 / 30.0, station: 1, axis: 0, angle };
        let sightings = (0..90).map(|n| at(n, if n % 9 == 0 { 0.9 } else { 0.2 + 1e-4 * (n % 7) as f64 })).collect();
        let point = Point { name: "lamp".into(), position: Vector3::new(1.0, 2.0, 3.0) };
        let (averages, truth) = averages(&[Measured { point, sightings }]);
        assert_eq!(averages.len(), 8);
        assert!(averages.iter().all(|average| (average.angle - 0.2003).abs() < 1e-4));
        let span = (truth[0].at_s, truth.last().unwrap().at_s);
        assert!(averages.iter().all(|average| span.0 < average.at_s && average.at_s < span.1));
    }
}
