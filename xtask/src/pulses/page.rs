//! The findings as a person reads them, 80 columns.
//!
//! # What can go wrong
//! A terminal without block characters shows the bars as something else; `--json` has no bars.

use std::fmt::Write as _;

use super::findings::{BIN_US, BINS, Findings, Histogram, NOMINAL_US, Rate, Series, Station, shortest};

const HEIGHTS: [char; 9] = [' ', '▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];
/// Columns of a full bar.
const BAR: usize = 24;
/// Columns before the histogram's bars.
const MARGIN: usize = 7;
/// Times of frames that are printed.
const TIMES: usize = 6;

/// The whole page.
#[must_use]
pub fn page(findings: &Findings) -> String {
    let mut page = String::new();
    // A String takes everything.
    write(&mut page, findings).unwrap_or_default();
    page.lines().flat_map(|line| [line.trim_end(), "\n"]).collect()
}

fn write(page: &mut String, findings: &Findings) -> std::fmt::Result {
    let length = match findings.duration_s {
        Some(seconds) => format!("{seconds:.2} s"),
        None => format!("{} ticks", findings.duration_ticks),
    };
    let plural = if findings.pulses == 1 { "" } else { "s" };
    write!(page, "{}: {} pulse{plural} in {length}", findings.file, findings.pulses)?;
    if findings.joined > 0 {
        write!(page, ", {} more joined to those", findings.joined)?;
    }
    writeln!(page, "\n")?;
    lock(page, findings)?;
    if let Some(clock) = &findings.clock {
        let [low, high] = clock.range_ppm;
        write!(page, "Clock     {:.4} MHz by the rotors", clock.hz / 1e6)?;
        if let Some(off) = clock.off_nominal_ppm {
            write!(page, " ({})", parts(off))?;
        }
        writeln!(page, ", half turn {:.1} ticks", clock.half_turn_ticks)?;
        writeln!(page, "          drift {}, within {} and {}", parts(clock.drift_ppm), parts(low), parts(high))?;
    }
    let rejects = &findings.rejects;
    let causes = [
        (rejects.strays, "where no light of ours is due"),
        (rejects.widths, "wrong for a flash"),
        (rejects.short, "too short for a sweep"),
        (rejects.long, "too long for a sweep"),
        (rejects.second, "after the sweep"),
        (rejects.outside, "beyond 60 degrees"),
    ];
    let causes: Vec<String> =
        causes.iter().filter(|(count, _)| *count > 0).map(|(count, cause)| format!("{count} {cause}")).collect();
    paragraph(page, "Rejected", &if causes.is_empty() { "nothing".to_string() } else { causes.join(", ") })?;
    for advice in &findings.advice {
        paragraph(page, "Advice", advice)?;
    }
    if findings.clock.is_some() {
        writeln!(page, "\nUnderstood      count   per second")?;
        for station in &findings.stations {
            bar(page, &format!("{} flashes", station.station), &station.flashes)?;
        }
        for rotor in &findings.rotors {
            bar(page, &format!("{} {}", rotor.station, rotor.axis), &rotor.sweeps)?;
        }
    }
    match &findings.widths {
        Some(histogram) => widths(page, histogram)?,
        None => {
            let [shortest, median, longest] = findings.widths_ticks;
            writeln!(
                page,
                "\nWidths    {shortest} to {longest} ticks, half of them up to {median}; --clock-hz makes microseconds of that"
            )?;
        }
    }
    for station in &findings.stations {
        self::station(page, station)?;
    }
    angles(page, findings)
}

fn lock(page: &mut String, findings: &Findings) -> std::fmt::Result {
    let lock = &findings.lock;
    write!(page, "Lock      ")?;
    let Some((seconds, cycles)) = lock.acquired_s.zip(lock.acquired_cycles) else {
        return writeln!(page, "never ({})", lock.status.replace('_', " "));
    };
    write!(page, "after {seconds:.2} s ({cycles:.1} cycles), ")?;
    match lock.lost {
        0 => write!(page, "never lost")?,
        1 => write!(page, "lost once at {} s", times(&lock.lost_s))?,
        lost => write!(page, "lost {lost} times at {} s", times(&lock.lost_s))?,
    }
    write!(page, ", {:.1} % of the time", lock.locked_share * 100.0)?;
    if lock.status == "locked" {
        writeln!(page)
    } else {
        writeln!(page, "; at the end {}", lock.status.replace('_', " "))
    }
}

fn paragraph(page: &mut String, name: &str, text: &str) -> std::fmt::Result {
    let lines = wrapped(text, 68);
    lines.iter().enumerate().try_for_each(|(n, line)| writeln!(page, "{:<10}{line}", if n == 0 { name } else { "" }))
}

/// A part of a million with its sign, or per cent where that is shorter.
fn parts(ppm: f64) -> String {
    if ppm.abs() >= 10_000.0 { format!("{:+.2} %", ppm / 1e4) } else { format!("{ppm:+.1} ppm") }
}

fn bar(page: &mut String, name: &str, rate: &Rate) -> std::fmt::Result {
    let per_s = rate.per_s.unwrap_or(0.0);
    let eighths = (per_s / rate.full_per_s * (BAR * 8) as f64).round() as usize;
    let eighths = eighths.min(BAR * 8).max(usize::from(rate.count > 0));
    // The left eighths of a block: U+2588 is whole, U+258F is one.
    let rest = [' ', '▏', '▎', '▍', '▌', '▋', '▊', '▉'][eighths % 8];
    let bar = format!("{}{rest}", "█".repeat(eighths / 8));
    let full = rate.full_per_s;
    writeln!(page, "  {name:<12}{:>7}{per_s:>8.1} of {full:<4.0} {bar}", rate.count)
}

fn widths(page: &mut String, histogram: &Histogram) -> std::fmt::Result {
    writeln!(page, "\nWidths, microseconds (^ nominal flashes)")?;
    for (name, bins) in
        [("A", &histogram.a), ("B", &histogram.b), ("sweeps", &histogram.sweeps), ("other", &histogram.other)]
    {
        let most = bins.iter().copied().max().unwrap_or(0);
        if most == 0 {
            continue;
        }
        let bars: String = bins
            .iter()
            .map(|count| HEIGHTS[if *count == 0 { 0 } else { (*count * 8).div_ceil(most).clamp(1, 8) as usize }])
            .collect();
        writeln!(page, " {name:<w$}{}", bars.trim_end(), w = MARGIN - 1)?;
    }
    let mut marks = vec![' '; BINS + 4];
    let mut scale = vec![' '; BINS + 4];
    for us in NOMINAL_US {
        let column = (us / BIN_US) as usize;
        marks[column] = '^';
        put(&mut scale, column, &format!("{us:.0}"));
    }
    for us in (0..60).step_by(10) {
        let column = (f64::from(us) / BIN_US) as usize;
        marks[column] = '\'';
        put(&mut scale, column, &us.to_string());
    }
    for line in [marks, scale] {
        let line: String = line.into_iter().collect();
        writeln!(page, "{}{}", " ".repeat(MARGIN), line.trim_end())?;
    }
    Ok(())
}

/// Writes `text` with its middle at `column`.
fn put(line: &mut [char], column: usize, text: &str) {
    let from = column.saturating_sub((text.len() - 1) / 2);
    for (place, letter) in line.iter_mut().skip(from).zip(text.chars()) {
        *place = letter;
    }
}

fn station(page: &mut String, station: &Station) -> std::fmt::Result {
    if station.flashes.count == 0 {
        return Ok(());
    }
    let name = station.station;
    write!(page, "\nStation {name}  ")?;
    match &station.said {
        Some(said) => writeln!(
            page,
            "id {}, channel {}, {}, unlocked {} times",
            said.id,
            said.mode,
            if said.faults == 0 { "no faults".to_string() } else { format!("FAULTS 0x{:02x}", said.faults) },
            said.unlock_count
        )?,
        None => writeln!(page, "not heard: no frame came whole")?,
    }
    if let Some(said) = &station.said {
        let [x, y, z] = said.gravity_g;
        writeln!(
            page,
            "           firmware {}, protocol {}, hardware {}, gravity {x:+.2} {y:+.2} {z:+.2} g",
            said.firmware, said.protocol, said.hardware
        )?;
    }
    write!(page, "           {} good frame{}", station.good, if station.good == 1 { "" } else { "s" })?;
    if station.good > 0 {
        write!(page, " at {} s", times(&station.good_s))?;
    }
    write!(page, ", {} bad", station.bad)?;
    if station.bad > 0 {
        write!(page, " at {} s", times(&station.bad_s))?;
    }
    if station.versions > 1 {
        write!(page, "; {} different, the last of them:", station.versions)?;
    }
    writeln!(page)?;
    if let Some(bias) = station.width_bias_us {
        let than = if bias < 0.0 { "shorter" } else { "longer" };
        writeln!(page, "           flashes look {:.1} us {than} than nominal", bias.abs())?;
    }
    if let Some(said) = &station.said {
        writeln!(
            page,
            "           {:<11}{:>12}{:>12}{:>12}{:>12}{:>12}",
            "terms", "phase", "tilt", "curve", "gibphase", "gibmag"
        )?;
        for (axis, terms) in ["azimuth", "elevation"].into_iter().zip(&said.rotors) {
            let [phase, tilt, curve, gibphase, gibmag] =
                [terms.phase_rad, terms.tilt_rad, terms.curve, terms.gibphase_rad, terms.gibmag_rad].map(shortest);
            writeln!(page, "           {axis:<11}{phase:>12}{tilt:>12}{curve:>12}{gibphase:>12}{gibmag:>12}")?;
        }
    }
    Ok(())
}

fn angles(page: &mut String, findings: &Findings) -> std::fmt::Result {
    if findings.rotors.iter().all(|rotor| rotor.measured.is_none()) {
        return Ok(());
    }
    writeln!(page, "\nAngles, degrees      first      last      mean   scatter   outside")?;
    let mut row = |name: String, series: Option<&Series>| {
        let Some(series) = series else { return Ok(()) };
        let Series { first_deg: first, last_deg: last, mean_deg: mean, outside, .. } = series;
        let scatter = series.scatter_deg.map_or("-".to_string(), |scatter| format!("{scatter:.4}"));
        writeln!(page, "  {name:<14}{first:>+10.3}{last:>+10.3}{mean:>+10.3}{scatter:>10}{outside:>10}")
    };
    for rotor in &findings.rotors {
        row(format!("{} {}", rotor.station, rotor.axis), rotor.measured.as_ref())?;
        row("  with terms".to_string(), rotor.factory.as_ref())?;
    }
    Ok(())
}

/// The first few times.
fn times(seconds: &[f64]) -> String {
    let mut shown: Vec<String> = seconds.iter().take(TIMES).map(|at| format!("{at:.1}")).collect();
    if seconds.len() > TIMES {
        shown.push("...".to_string());
    }
    shown.join(", ")
}

/// Lines of at most `columns`.
fn wrapped(text: &str, columns: usize) -> Vec<String> {
    let mut lines = vec![String::new()];
    for word in text.split_whitespace() {
        if let Some(line) = lines.last_mut() {
            if line.is_empty() {
                line.push_str(word);
                continue;
            }
            if line.chars().count() + 1 + word.chars().count() <= columns {
                line.push(' ');
                line.push_str(word);
                continue;
            }
        }
        lines.push(word.to_string());
    }
    lines
}
