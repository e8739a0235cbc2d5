//! Recordings of pulses, real and made up, as `cargo xtask pulses` tells of them.

use std::f64::consts::PI;
use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use lighthouse_mote::ootx::Half;
use sim::world::ootx::{Info, frame};
use sim::world::rotor::Rotor;
use xtask::pulses::findings::{Findings, shortest};
use xtask::pulses::{Arguments, Lone, SweepEdge, page::page, understand};

fn arguments(file: &Path) -> Arguments {
    Arguments {
        file: file.to_path_buf(),
        clock_hz: None,
        join: false,
        factory: false,
        lone: None,
        sweep_edge: SweepEdge::Middle,
        shortest_sweep_us: 1.0,
        json: false,
    }
}

fn findings(arguments: &Arguments) -> Findings {
    understand(arguments, |_| ()).unwrap_or_else(|error| panic!("{error:#}"))
}

fn recording(name: &str) -> Option<PathBuf> {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data/vive-pulses").join(name);
    if !file.is_file() {
        eprintln!("skipped: there is no recording ../shared/data/vive-pulses/{name} beside the project");
        return None;
    }
    Some(file)
}

/// A synthetic pair of stations and the clock that stamps their light.
#[derive(Clone, Copy)]
struct Light {
    clock_hz: f64,
    start: u64,
    /// Seconds between the flashes of A and B.
    gap_s: f64,
    /// Which stations flash, and sweep.
    flash: [bool; 2],
    sweep: [bool; 2],
    /// Microseconds that flashes end late.
    late_us: [f64; 2],
    /// As measured, degrees from straight ahead.
    degrees: [[f64; 2]; 2],
    phases: [[f64; 2]; 2],
}

impl Light {
    const USUAL: Self = Self {
        clock_hz: 10_820_000.0,
        start: 0,
        gap_s: 20.0 / 48_000.0,
        flash: [true; 2],
        sweep: [true; 2],
        late_us: [0.0; 2],
        degrees: [[-12.5, 3.25], [20.0, -31.0]],
        phases: [[0.03, -0.02], [0.01, 0.05]],
    };

    /// Rises and widths of `slots` half turns that begin `after` seconds after the start.
    fn pulses(&self, after: f64, slots: u32) -> Vec<(u64, u64)> {
        let bits = [0, 1].map(|station: usize| {
            let [azimuth, elevation] = self.phases[station].map(|phase_rad| Rotor { phase_rad, ..Rotor::default() });
            frame(
                &Info { id: 100 + station as u32, mode: 1 + station as u8, ..Info::default() }
                    .block(&azimuth, &elevation),
            )
        });
        let ticks = |seconds: f64| (seconds * self.clock_hz).round() as u64;
        let mut pulses = Vec::new();
        for slot in 0..slots {
            let begins = after + f64::from(slot) / 120.0;
            let (sweeping, axis) = if slot % 4 < 2 { (1, slot as usize % 2) } else { (0, slot as usize % 2) };
            let mut push = |at: f64, width_us: f64| {
                let (rise, fall) = (ticks(at), ticks(at + width_us / 1e6));
                pulses.push((self.start + rise, fall - rise));
            };
            let flash_at = |station: usize| begins + if station == 0 { 0.0 } else { self.gap_s };
            for station in 0..2 {
                let data = bits[station][slot as usize % bits[station].len()];
                let steps = axis as u32 + 2 * u32::from(data) + 4 * u32::from(station != sweeping);
                if self.flash[station] {
                    push(flash_at(station), 62.5 + f64::from(steps) / 0.096 + self.late_us[station]);
                }
            }
            if self.sweep[sweeping] {
                let middle = flash_at(sweeping) + (self.degrees[sweeping][axis] + 90.0) / 180.0 / 120.0;
                push(middle - 5e-6, 10.0);
            }
        }
        pulses
    }
}

fn write(pulses: &[(u64, u64)]) -> tempfile::NamedTempFile {
    let mut text = String::from("rise_ticks,width_ticks\n");
    for (rise, width) in pulses {
        writeln!(text, "{rise},{width}").unwrap();
    }
    table(&text)
}

fn table(text: &str) -> tempfile::NamedTempFile {
    let file = tempfile::Builder::new().suffix(".csv").tempfile().unwrap();
    fs::write(file.path(), text).unwrap();
    file
}

fn of(pulses: &[(u64, u64)]) -> Findings {
    findings(&arguments(write(pulses).path()))
}

#[test]
fn a_receiver_with_one_good_edge_is_told_so() {
    let late = |n: u64, width: u64| if width < 200 { width + 9 * (n * 7 % 11) } else { width };
    let pulses = Light::USUAL.pulses(0.0, 400);
    let pulses: Vec<_> = (0..).zip(pulses).map(|(n, (rise, width))| (rise, late(n, width))).collect();
    let file = write(&pulses);
    let scatter = |sweep_edge: SweepEdge| {
        let found = findings(&Arguments { sweep_edge, ..arguments(file.path()) });
        let sweeps = found.widths.as_ref().expect("a clock").sweeps.iter().sum::<u64>();
        assert_eq!(sweeps, found.rotors.iter().map(|angles| angles.sweeps.count).sum::<u64>());
        found.rotors.iter().map(|a| a.measured.expect("sweeps").scatter_deg.expect("many")).fold(0.0, f64::max)
    };
    // Falls that come up to 8 us late move a middle by up to 4, and a rotor turns 0.0216 degrees in 1 us.
    let (middle, rise) = (scatter(SweepEdge::Middle), scatter(SweepEdge::Rise));
    assert!(middle > 0.02 && rise < 0.004, "{middle} {rise}");
    let found = findings(&Arguments { shortest_sweep_us: 25.0, ..arguments(file.path()) });
    assert!(found.rotors.iter().all(|angles| angles.sweeps.count == 0));
}

#[test]
fn a_pulse_longer_than_a_counter_is_long() {
    let mut pulses = Light::USUAL.pulses(0.0, 400);
    let (rise, width) = pulses[pulses.len() - 1];
    // Modulo 2^32 it would be a sweep of 10 us.
    pulses.push((rise + width + 20_000, (1 << 32) + 108));
    let (with, without) = (of(&pulses), of(&pulses[..pulses.len() - 1]));
    assert_eq!(with.widths_ticks[2], (1 << 32) + 108);
    let swept = |found: &Findings| found.rotors.iter().map(|angles| angles.sweeps.count).sum::<u64>();
    assert_eq!(swept(&with), swept(&without));
}

#[test]
fn all_nine_frames_of_the_recorded_headset_are_shown() {
    let Some(file) = recording("hmd-one-station-visible.csv") else { return };
    let found = findings(&Arguments { factory: true, clock_hz: Some(48e6), ..arguments(&file) });
    let printed = page(&found);
    for (station, frames, id, phases) in
        [(0, 4, 3_200_290_360u32, ["0.01559", "0.0382"]), (1, 5, 3_275_443_681, ["0.0547", "0.06186"])]
    {
        let station = &found.stations[station];
        let said = station.said.as_ref().expect("frames");
        assert_eq!(
            (station.good, station.good_s.len(), station.bad, station.versions),
            (frames, frames as usize, 0, 1)
        );
        assert_eq!((said.id, said.protocol, said.faults, said.is_believed), (id, 6, 0, true));
        assert_eq!(said.rotors.each_ref().map(|rotor| shortest(rotor.phase_rad)), phases);
        for text in [&*id.to_string(), phases[0], phases[1]] {
            assert!(printed.contains(text), "{text} is not in\n{printed}");
        }
        // 240 flashes a second, of both; the first slots go to the search.
        assert!(station.flashes.count >= 1880 && station.flashes.per_s.unwrap() > 119.0);
    }
    assert_eq!((found.lock.status, found.lock.lost), ("locked", 0));
    assert!(found.lock.acquired_s.unwrap() < 0.25 && found.lock.locked_share > 0.98);
    assert_eq!(found.pulses, 4729);
    let clock = found.clock.as_ref().unwrap();
    // A crystal against a crystal.
    assert!(clock.off_nominal_ppm.unwrap().abs() < 100.0 && clock.drift_ppm.abs() < 20.0, "{clock:?}");
    // The headset lay still: 0.0018 degrees is what a tick of jitter makes.
    for rotor in &found.rotors[..2] {
        let (measured, factory) = (rotor.measured.unwrap(), rotor.factory.unwrap());
        assert!(measured.scatter_deg.unwrap() < 0.01 && (measured.first_deg - measured.last_deg).abs() < 0.05);
        assert!((factory.mean_deg - measured.mean_deg).abs() > 0.5);
    }
    assert!(found.rotors[2].measured.is_none() && found.advice.iter().any(|advice| advice.contains("Station B")));
}

#[test]
fn the_recorded_tracker_is_shown_once_its_overlaps_are_joined() {
    let Some(file) = recording("tracker-two-stations.csv") else { return };
    let refused = understand(&arguments(&file), |_| ()).map(|_| ()).expect_err("it overlaps");
    for part in ["tracker-two-stations.csv:91:", "column width_ticks: `2994`", "19181293", "--join"] {
        assert!(format!("{refused:#}").contains(part), "{part} is not in {refused:#}");
    }
    let found = findings(&Arguments { join: true, ..arguments(&file) });
    assert_eq!(found.pulses + found.joined, 4478);
    let station = &found.stations[1];
    let said = station.said.as_ref().expect("a frame");
    assert_eq!((said.id, station.versions), (178_605_925, 1));
    assert_eq!(said.rotors.each_ref().map(|rotor| shortest(rotor.phase_rad)), ["0.05862", "0.06216"]);
    assert_eq!(said.rotors.each_ref().map(|rotor| shortest(rotor.tilt_rad)), ["0.001343", "0.00007933"]);
}

#[test]
fn what_was_played_is_what_is_told_whatever_the_clock_and_its_start() {
    for (clock_hz, start) in [(10_820_000.0, 0), (9_738_000.0, (1 << 32) - 20_000_000), (48e6, (1 << 40) - 1_000_000)] {
        let light = Light { clock_hz, start, late_us: [6.0, -4.0], ..Light::USUAL };
        let pulses = light.pulses(0.5, 1440);
        let file = write(&pulses);
        let found = findings(&Arguments { factory: true, ..arguments(file.path()) });
        assert_eq!((found.lock.status, found.lock.lost), ("locked", 0));
        assert!(found.lock.acquired_cycles.unwrap() < 4.0 && found.lock.locked_share > 0.98);
        let clock = found.clock.as_ref().unwrap();
        // One tick in 16 half turns.
        assert!((clock.hz / clock_hz - 1.0).abs() * 16.0 * clock_hz / 120.0 < 1.0, "{clock:?}");
        for (index, bias) in light.late_us.into_iter().enumerate() {
            let station = &found.stations[index];
            // Two of the 0.33 us that the bias is told in, and a tick of the slowest clock is a third of one.
            assert!((station.width_bias_us.unwrap() - bias).abs() < 0.66, "{station:?}");
            // 12 s are four frames; the one that it begins in has no preamble before it was locked.
            assert_eq!((station.good, station.bad), (3, 0));
            assert_eq!(station.said.as_ref().unwrap().id, 100 + index as u32);
            assert!(station.flashes.count >= 1420 && station.flashes.count <= 1440);
        }
        for (index, rotor) in found.rotors.iter().enumerate() {
            let (side, axis) = (index / 2, index % 2);
            let (degrees, phase) = (light.degrees[side][axis], light.phases[side][axis]);
            let (measured, factory) = (rotor.measured.unwrap(), rotor.factory.unwrap());
            // Flash, rise and fall are each off by half a tick at most, and the middle of the sweep by half of one more.
            let near = 1.5 * 21_600.0 / clock_hz + 0.0004;
            assert!(
                (measured.mean_deg - degrees).abs() < near && (measured.last_deg - degrees).abs() < near,
                "{measured:?}"
            );
            // A half float of 0.05 rad is off by 0.001 degrees at most.
            assert!((factory.mean_deg - degrees - phase * 180.0 / PI).abs() < near + 0.001, "{factory:?}");
            assert!(measured.scatter_deg.unwrap() < near, "{measured:?}");
            assert!(rotor.sweeps.count >= 355 && measured.outside == 0);
        }
        assert!(found.advice.is_empty(), "{:?}", found.advice);
        let widths = found.widths.as_ref().unwrap();
        let binned: u64 = [&widths.a, &widths.b, &widths.sweeps, &widths.other].into_iter().flatten().sum();
        assert_eq!((binned, found.pulses), (pulses.len() as u64, pulses.len() as u64));
        assert_eq!(widths.a.iter().sum::<u64>(), found.stations[0].flashes.count);
        assert_eq!(widths.sweeps.iter().sum::<u64>(), found.rotors.iter().map(|rotor| rotor.sweeps.count).sum::<u64>());
    }
}

#[test]
fn counts_go_on_past_the_wraps_of_the_counter_and_of_the_counts() {
    // 560 s: the counter wraps after 397 s, a count of flashes after 546 s.
    let found = of(&Light::USUAL.pulses(0.0, 67_200));
    assert_eq!((found.lock.lost, found.lock.status), (0, "locked"));
    for station in &found.stations {
        assert!(station.flashes.count > 67_180 && station.flashes.count <= 67_200);
        assert_eq!(station.bad, 0);
        assert!(station.good >= 186);
    }
    assert!((found.duration_s.unwrap() - 560.0).abs() < 0.1);
}

#[test]
fn a_darkness_longer_than_the_counter_is_a_loss_and_no_more() {
    let light = Light::USUAL;
    // A whole wrap and a bit, so that a counter alone would see 0.1 s; and one long enough for many.
    let wrap = (1u64 << 32) as f64 / light.clock_hz;
    for dark in [wrap + 0.1, 0.3 * wrap, 7.0 * wrap + 0.02] {
        let mut pulses = light.pulses(0.0, 900);
        pulses.extend(light.pulses(7.5 + dark, 900));
        let found = of(&pulses);
        assert_eq!((found.lock.lost, found.lock.status), (1, "locked"));
        // It is carried on for 0.4 s.
        assert!((found.lock.lost_s[0] - 7.9).abs() < 0.2, "{:?}", found.lock);
        assert!(found.stations.iter().all(|station| station.flashes.count > 1770 && station.bad == 0));
        assert!(found.stations.iter().all(|station| station.good == 2 && station.versions == 1));
    }
}

#[test]
fn light_that_is_not_understood_is_explained() {
    let light = Light::USUAL;
    let lone = Light { flash: [true, false], sweep: [true, false], ..light };
    let spaced = Light { gap_s: 700e-6, ..light };
    let v2: Vec<(u64, u64)> = (0..400).map(|n| (n * 90_000, 60)).collect();
    let stuck: Vec<(u64, u64)> = (0..400).map(|n| (n * 90_000, 80_000)).collect();
    for (pulses, status, advice) in [
        (lone.pulses(0.0, 600), "one_station", "--lone"),
        (spaced.pulses(0.0, 600), "spacing", "not synchronised"),
        (v2, "v2", "V2"),
        (stuck, "widths", "too long"),
        (light.pulses(0.0, 1), "searching", "at least a second"),
    ] {
        let found = of(&pulses);
        assert_eq!((found.lock.status, found.lock.acquired_s, found.lock.locked_share), (status, None, 0.0));
        assert!(found.advice.iter().any(|said| said.contains(advice)), "{:?}", found.advice);
        assert!(page(&found).contains("never ("));
    }
    let file = write(&lone.pulses(0.0, 1440));
    for lone in [Lone::A, Lone::B] {
        let found = findings(&Arguments { lone: Some(lone), ..arguments(file.path()) });
        let (seen, hidden) = if lone == Lone::A { (0, 1) } else { (1, 0) };
        assert_eq!((found.lock.status, found.stations[hidden].flashes.count), ("locked", 0));
        assert!(found.stations[seen].flashes.count > 1400 && found.stations[seen].said.is_some());
    }
}

#[test]
fn a_table_that_cannot_be_right_is_refused_with_line_column_and_value() {
    let good = "rise_ticks,width_ticks\n0,700\n";
    let cases: [(&str, &[&str]); 12] = [
        ("", &["the file is empty"]),
        ("rise_ticks,width_ticks\n", &["header but not one row"]),
        ("0,700\n900,700\n", &[":1:", "column rise_ticks is missing", "`0,700`"]),
        ("rise_ticks,length\n0,700\n", &[":1:", "column width_ticks is missing", "`rise_ticks,length`"]),
        ("900,70x", &[":3:", "column width_ticks", "`70x`", "not a whole number"]),
        ("9.5,700", &[":3:", "column rise_ticks", "`9.5`", "not a whole number"]),
        (",700", &[":3:", "column rise_ticks", "``", "not a whole number"]),
        ("-3,700", &[":3:", "column rise_ticks", "`-3`", "not a whole number"]),
        ("99999999999999999999,700", &[":3:", "column rise_ticks", "more than 64 bits"]),
        ("900", &[":3:", "1 cells", "2 columns"]),
        ("900,50\n800,50", &[":4:", "column rise_ticks", "`800`", "`900` on line 3", "backwards"]),
        ("699,50", &[":2:", "column width_ticks", "`700`", "699 on line 3", "--join"]),
    ];
    for (text, parts) in cases {
        let text = if text.is_empty() || text.contains("700\n") || text.contains("width_ticks\n") {
            text.to_string()
        } else {
            format!("{good}{text}\n")
        };
        let file = table(&text);
        let message = format!("{:#}", understand(&arguments(file.path()), |_| ()).map(|_| ()).expect_err(&text));
        assert!(message.starts_with(&*file.path().to_string_lossy()), "{message}");
        for part in parts {
            assert!(message.contains(part), "{part} is not in: {message}");
        }
    }
    let gone = understand(&arguments(Path::new("/gone/pulses.csv")), |_| ()).map(|_| ()).expect_err("no such file");
    assert!(format!("{gone:#}").contains("/gone/pulses.csv: cannot be read"));
}

#[test]
fn columns_may_come_in_any_order_and_joined_pulses_are_one() {
    let file = table("note,width_ticks,rise_ticks\nx,700,0\ny,100,300\nz,500,600\n\n,10,5000\n");
    let found = findings(&Arguments { join: true, clock_hz: Some(1e6), ..arguments(file.path()) });
    assert_eq!((found.pulses, found.joined, found.duration_ticks), (2, 2, 5010));
    assert_eq!(found.widths_ticks, [10, 10, 1100]);
}

#[test]
fn the_shortest_decimal_of_a_half_float_is_nearer_to_it_than_to_any_other() {
    for bits in 1..0x7bff_u16 {
        let value = |bits| Half(bits).to_f64();
        let text = shortest(value(bits));
        let read: f64 = text.parse().unwrap();
        let off = (read - value(bits)).abs();
        assert!(off < (read - value(bits - 1)).abs() && off < (read - value(bits + 1)).abs(), "{text} for {bits:#x}");
        assert_eq!(shortest(-value(bits)), format!("-{text}"));
    }
}

#[test]
fn the_command_prints_json_that_keeps_its_names_and_fails_with_a_message() {
    let xtask =
        |arguments: &[&str]| Command::new(env!("CARGO_BIN_EXE_xtask")).arg("pulses").args(arguments).output().unwrap();
    let file = write(&Light::USUAL.pulses(0.0, 900));
    let done = xtask(&[file.path().to_str().unwrap(), "--json", "--factory"]);
    assert!(done.status.success() && done.stderr.is_empty());
    let json: serde_json::Value = serde_json::from_slice(&done.stdout).unwrap();
    let names: Vec<&String> = json.as_object().unwrap().keys().collect();
    assert_eq!(
        names,
        [
            "file",
            "pulses",
            "joined",
            "duration_ticks",
            "duration_s",
            "lock",
            "clock",
            "stations",
            "rotors",
            "rejects",
            "widths",
            "widths_ticks",
            "advice"
        ]
    );
    assert_eq!(json["stations"][0]["said"]["id"], 100);
    assert_eq!(json["lock"]["status"], "locked");
    assert!(json["rotors"][3]["factory"]["mean_deg"].is_f64());

    let bad = table("rise_ticks,width_ticks\n0,one\n");
    let done = xtask(&[bad.path().to_str().unwrap()]);
    assert!(!done.status.success() && done.stdout.is_empty());
    assert!(String::from_utf8_lossy(&done.stderr).contains(":2: column width_ticks: `one`"));
}

#[test]
fn the_page_is_no_wider_than_a_terminal() {
    let file = write(&Light { late_us: [3.0, 9.0], ..Light::USUAL }.pulses(0.0, 1440));
    let printed = page(&findings(&Arguments { factory: true, clock_hz: Some(10e6), ..arguments(file.path()) }));
    for line in printed.lines().skip(1) {
        assert!(line.chars().count() <= 88 && line.trim_end() == line, "`{line}`");
    }
    for text in ["+8.20 %", "never lost", "3 good frames", "with terms", "longer than nominal"] {
        assert!(printed.contains(text), "{text} is not in\n{printed}");
    }
}
