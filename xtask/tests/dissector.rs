//! What the library emits is what Wireshark shows: MAC layer, check sequence, every field by its name.
//!
//! What can go wrong: tshark is not installed; the tests then say so and are skipped. `cargo xtask ci` installs it.

use std::fmt::Display;
use std::path::{Path, PathBuf};
use std::process::Command;

use fixed::types::{I6F10, I16F16, U0F16, U8F8};
use lighthouse_mote::frame::secured::{self, Key};
use lighthouse_mote::frame::{
    ANGLES, ANGLES_LEN, Aligned, Angles, Factory, Header, Health, Level, Lock, Losses, Measured, Rejects, Report,
    Reset, Station, emit, emit_angles, emit_health, emit_into,
};
use lighthouse_mote::sweep;
use serde_json::Value;
use xtask::pcap::{self, Frame};

fn dissector() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../wireshark/lighthouse-mote.lua")
}

fn is_there() -> bool {
    let there = Command::new("tshark").arg("--version").output().is_ok_and(|asked| asked.status.success());
    if !there {
        eprintln!("skipped: tshark is not installed");
    }
    there
}

/// tshark with this dissector, nobody's settings and nobody's plugins, about to read `frames`, and their home.
fn tshark(frames: &[Vec<u8>]) -> (Command, tempfile::TempDir) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("frames.pcap");
    let frames: Vec<Frame> =
        frames.iter().enumerate().map(|(n, bytes)| Frame { micros: n as u64, bytes: bytes.clone() }).collect();
    pcap::write(&frames, &mut std::fs::File::create(&path).unwrap()).unwrap();
    let mut command = Command::new("tshark");
    command.env("HOME", dir.path()).env("XDG_CONFIG_HOME", dir.path());
    command.arg("-X").arg(format!("lua_script:{}", dissector().display())).arg("-r").arg(&path);
    (command, dir)
}

/// What tshark says of each frame, asked for `fields` besides those of the MAC layer.
fn dissect(frames: &[Vec<u8>], fields: &[String]) -> Vec<Value> {
    dissect_with(frames, fields, &[])
}

/// The same with settings of Wireshark's.
fn dissect_with(frames: &[Vec<u8>], fields: &[String], settings: &[String]) -> Vec<Value> {
    let (mut command, _home) = tshark(frames);
    command.args(["-T", "json"]);
    settings.iter().for_each(|setting| {
        command.args(["-o", setting]);
    });
    let always = ["wpan.fcs_ok", "wpan.src16", "wpan.dst_pan", "wpan.seq_no", "_ws.expert.message", "_ws.malformed"];
    for field in always.iter().map(|field| (*field).to_string()).chain(fields.iter().cloned()) {
        command.args(["-e", &field]);
    }
    let out = command.output().unwrap();
    let errors = String::from_utf8_lossy(&out.stderr);
    assert!(out.status.success() && !errors.contains("Lua"), "{errors}");
    let told: Value = serde_json::from_slice(&out.stdout).unwrap();
    let layers = |frame: &Value| frame["_source"]["layers"].clone();
    told.as_array().unwrap().iter().map(layers).collect()
}

/// A frame's fields as they must be shown.
#[derive(Default)]
struct Wanted(Vec<(String, Vec<String>)>);

impl Wanted {
    fn is(&mut self, name: &str, value: impl Display) {
        let name = format!("lighthouse.{name}");
        let value = value.to_string();
        match self.0.iter_mut().find(|(known, _)| *known == name) {
            Some((_, values)) => values.push(value),
            None => self.0.push((name, vec![value])),
        }
    }

    /// A fraction, as the shortest text that means it.
    fn fraction(&mut self, name: &str, value: f64) {
        self.is(name, value);
    }

    fn envelope(kind: u8, header: Header) -> Self {
        let mut wanted = Self::default();
        wanted.is("magic", "LM");
        wanted.is("version", 1);
        wanted.is("kind", kind);
        wanted.is("mote", format!("0x{:04x}", header.mote));
        wanted.is("sequence", header.sequence);
        wanted
    }

    fn half_turn(&mut self, half_turn_q8: u32) {
        let ticks = f64::from(half_turn_q8) / 256.0;
        self.fraction("half_turn", ticks);
        if half_turn_q8 > 0 {
            self.fraction("clock", ticks * 120.0);
        }
    }
}

/// Equal as text, or as numbers to the 15 digits that tshark prints.
fn same(shown: &str, wanted: &str) -> bool {
    match (shown.parse::<f64>(), wanted.parse::<f64>()) {
        (Ok(shown), Ok(wanted)) => (shown - wanted).abs() <= 1e-14 * wanted.abs(),
        _ => shown == wanted,
    }
}

fn texts(value: &Value) -> Vec<String> {
    value.as_array().into_iter().flatten().map(|text| text.as_str().unwrap().to_string()).collect()
}

fn holds(header: Header, told: &Value, wanted: &Wanted) {
    assert_eq!(told["wpan.fcs_ok"][0], "1", "{told}");
    assert_eq!(told["wpan.src16"][0], format!("0x{:04x}", header.mote), "{told}");
    assert_eq!(told["wpan.dst_pan"][0], format!("0x{:04x}", header.pan), "{told}");
    assert_eq!(told["wpan.seq_no"][0], (header.sequence as u8).to_string(), "{told}");
    assert!(told["_ws.expert.message"].is_null() && told["_ws.malformed"].is_null(), "{told}");
    for (name, values) in &wanted.0 {
        let shown = texts(&told[name]);
        assert_eq!(shown.len(), values.len(), "{name} of {told}");
        for (shown, value) in shown.iter().zip(values) {
            assert!(same(shown, value), "{name} is shown as {shown}, and was {value}");
        }
    }
}

fn header(dice: &mut fastrand::Rng) -> Header {
    // Not everyone, and not the addresses that mean something else.
    Header { pan: dice.u16(..0xfffe), mote: dice.u16(..0xfffe), sequence: dice.u16(..) }
}

fn report(dice: &mut fastrand::Rng) -> Report {
    Report {
        time: dice.u32(..),
        half_turn_q8: dice.u32(..),
        position: core::array::from_fn(|_| I16F16::from_bits(dice.i32(..))),
        mismatch: U0F16::from_bits(dice.u16(..)),
        age: U8F8::from_bits(dice.u16(..)),
        stations: dice.u8(..4),
        level: dice.choice([Level::None, Level::Angles, Level::Tracked, Level::Full]).unwrap(),
        velocity: core::array::from_fn(|_| I6F10::from_bits(dice.i16(..))),
        sd: core::array::from_fn(|_| U0F16::from_bits(dice.u16(..))),
        losses: Losses {
            edges: dice.u16(..),
            pulses: dice.u16(..),
            sweeps: dice.u16(..),
            fixes: dice.u16(..),
            reports: dice.u16(..),
        },
    }
}

fn shown_report(header: Header, report: &Report) -> Wanted {
    let mut wanted = Wanted::envelope(1, header);
    wanted.is("time", report.time);
    wanted.half_turn(report.half_turn_q8);
    let axes = ["x", "y", "z"];
    for (axis, coordinate) in axes.iter().zip(report.position) {
        wanted.fraction(axis, coordinate.to_num());
    }
    wanted.fraction("mismatch", report.mismatch.to_num());
    wanted.fraction("age", report.age.to_num());
    wanted.is("station_a", report.stations & 1);
    wanted.is("station_b", report.stations >> 1);
    wanted.is("level", report.level as u8);
    for (axis, speed) in axes.iter().zip(report.velocity) {
        wanted.fraction(&format!("v{axis}"), speed.to_num());
    }
    for (axis, sd) in axes.iter().zip(report.sd) {
        wanted.fraction(&format!("sd_{axis}"), sd.to_num());
    }
    let Losses { edges, pulses, sweeps, fixes, reports } = report.losses;
    for (name, count) in
        [("edges", edges), ("pulses", pulses), ("sweeps", sweeps), ("fixes", fixes), ("reports", reports)]
    {
        wanted.is(&format!("lost_{name}"), count);
    }
    wanted
}

fn health(dice: &mut fastrand::Rng) -> Health {
    let mut station = || Station {
        id: dice.u32(..),
        good: dice.u8(..),
        bad: dice.u8(..),
        mode: dice.u8(..),
        faults: dice.u8(..),
        width_bias: dice.i8(..),
        factory: *dice.choice(Factory::ALL).unwrap(),
        is_stranger: dice.bool(),
    };
    let stations = [station(), station()];
    Health {
        uptime: dice.u32(..),
        // None while there is no cycle.
        half_turn_q8: if dice.bool() { dice.u32(..) } else { 0 },
        lock: *dice.choice(Lock::ALL).unwrap(),
        reset: *dice.choice(Reset::ALL).unwrap(),
        reset_detail: dice.u32(..),
        syncs: [dice.u16(..), dice.u16(..)],
        sweeps: [[dice.u16(..), dice.u16(..)], [dice.u16(..), dice.u16(..)]],
        rejects: Rejects {
            edges: dice.u16(..),
            strays: dice.u16(..),
            widths: dice.u16(..),
            short: dice.u16(..),
            long: dice.u16(..),
            second: dice.u16(..),
            outside: dice.u16(..),
            geometry: dice.u16(..),
            mismatch: dice.u16(..),
            disbelieved: dice.u16(..),
            reports: dice.u16(..),
            locks: dice.u16(..),
        },
        waiting: [dice.u8(..), dice.u8(..), dice.u8(..)],
        stations,
    }
}

fn shown_health(header: Header, health: &Health) -> Wanted {
    let mut wanted = Wanted::envelope(2, header);
    wanted.is("uptime", health.uptime);
    wanted.half_turn(health.half_turn_q8);
    wanted.is("lock", health.lock as u8);
    wanted.is("reset", health.reset as u8);
    wanted.is("reset_detail", format!("0x{:08x}", health.reset_detail));
    for ((name, syncs), sweeps) in ["a", "b"].iter().zip(health.syncs).zip(health.sweeps) {
        wanted.is(&format!("syncs_{name}"), syncs);
        wanted.is(&format!("sweeps_{name}_az"), sweeps[0]);
        wanted.is(&format!("sweeps_{name}_el"), sweeps[1]);
    }
    let r = &health.rejects;
    for (name, count) in [
        ("edges", r.edges),
        ("strays", r.strays),
        ("widths", r.widths),
        ("short", r.short),
        ("long", r.long),
        ("second", r.second),
        ("outside", r.outside),
        ("geometry", r.geometry),
        ("mismatch", r.mismatch),
        ("disbelieved", r.disbelieved),
        ("reports", r.reports),
        ("locks", r.locks),
    ] {
        wanted.is(&format!("rejects_{name}"), count);
    }
    for (name, most) in ["pulses", "sightings", "reports"].iter().zip(health.waiting) {
        wanted.is(&format!("waiting_{name}"), most);
    }
    for (name, station) in ["a", "b"].iter().zip(&health.stations) {
        wanted.is(&format!("{name}_id"), format!("0x{:08x}", station.id));
        wanted.is(&format!("{name}_good"), station.good);
        wanted.is(&format!("{name}_bad"), station.bad);
        wanted.is(&format!("{name}_mode"), station.mode);
        wanted.is(&format!("{name}_faults"), format!("0x{:02x}", station.faults));
        // 1/25,600 of a half turn of 1/120 s, in us.
        wanted.fraction(&format!("{name}_width_bias"), f64::from(station.width_bias) * (1e6 / 120.0 / 25_600.0));
        wanted.is(&format!("{name}_factory"), station.factory as u8);
        wanted.is(&format!("{name}_is_stranger"), u8::from(station.is_stranger));
    }
    wanted
}

fn angles(dice: &mut fastrand::Rng) -> Angles {
    let mut angles = Angles { half_turn_q8: dice.u32(..), ..Angles::default() };
    for _ in 0..dice.usize(1..=ANGLES) {
        let station = dice.choice([sweep::Station::A, sweep::Station::B]).unwrap();
        let axis = dice.choice([sweep::Axis::Azimuth, sweep::Axis::Elevation]).unwrap();
        angles.sweeps.push(Measured { time: dice.u32(..), station, axis, share: dice.u32(..1 << 24) }).unwrap();
    }
    angles
}

fn shown_angles(header: Header, angles: &Angles) -> Wanted {
    let mut wanted = Wanted::envelope(3, header);
    wanted.half_turn(angles.half_turn_q8);
    for sweep in &angles.sweeps {
        let share = f64::from(sweep.share) / f64::from(1 << 20);
        wanted.is("sweep_time", sweep.time);
        wanted.is("sweep_rotor", sweep.station as u8 | (sweep.axis as u8) << 1);
        wanted.fraction("sweep_share", share);
        wanted.fraction("sweep_angle", (share - 0.5) * 180.0);
    }
    wanted
}

#[test]
fn every_field_of_every_kind_is_shown_as_it_was_put_in() {
    if !is_there() {
        return;
    }
    let mut dice = fastrand::Rng::with_seed(802_154);
    let mut sent = Vec::new();
    for _ in 0..100 {
        let (header, report) = (header(&mut dice), report(&mut dice));
        sent.push((header, emit(header, &report).to_vec(), shown_report(header, &report)));
        let health = health(&mut dice);
        sent.push((header, emit_health(header, &health).to_vec(), shown_health(header, &health)));
        let angles = angles(&mut dice);
        let mut bytes = [0; ANGLES_LEN];
        sent.push((header, emit_angles(header, &angles, &mut bytes).to_vec(), shown_angles(header, &angles)));
    }
    let fields: Vec<String> =
        sent[..3].iter().flat_map(|(_, _, wanted)| &wanted.0).map(|(name, _)| name.clone()).collect();
    let frames: Vec<Vec<u8>> = sent.iter().map(|(_, bytes, _)| bytes.clone()).collect();
    let told = dissect(&frames, &fields);
    assert_eq!(told.len(), sent.len());
    for ((header, _, wanted), told) in sent.iter().zip(&told) {
        holds(*header, told, wanted);
    }
    // Nothing that the dissector knows was left out above.
    let script = std::fs::read_to_string(dissector()).unwrap();
    for name in script.lines().filter_map(|line| line.strip_prefix("field(\"")?.split('"').next()) {
        assert!(name == "sweep" || fields.contains(&format!("lighthouse.{name}")), "{name} is not looked at");
    }
}

#[test]
fn every_code_has_a_name() {
    if !is_there() {
        return;
    }
    let header = Header { pan: 0x4c48, mote: 7, sequence: 300 };
    let with = |change: &dyn Fn(&mut Health)| {
        let mut health = Health::default();
        change(&mut health);
        emit_health(header, &health).to_vec()
    };
    let resets = Reset::ALL.iter().map(|reset| with(&|health| health.reset = *reset));
    let locks = Lock::ALL.iter().map(|lock| with(&|health| health.lock = *lock));
    let factories = Factory::ALL.iter().map(|factory| with(&|health| health.stations[1].factory = *factory));
    let modes = (0..3).map(|mode| with(&|health| health.stations[0].mode = mode));
    let levels = [Level::None, Level::Angles, Level::Tracked, Level::Full];
    let levels = levels.map(|level| emit(header, &Report { level, ..Report::default() }).to_vec());
    let angles = [sweep::Station::A, sweep::Station::B].map(|station| {
        let mut angles = Angles::default();
        for axis in [sweep::Axis::Azimuth, sweep::Axis::Elevation] {
            angles.sweeps.push(Measured { time: 0, station, axis, share: 0 }).unwrap();
        }
        emit_angles(header, &angles, &mut [0; ANGLES_LEN]).to_vec()
    });
    let frames: Vec<Vec<u8>> = resets.chain(locks).chain(factories).chain(modes).chain(levels).chain(angles).collect();
    let (mut command, _home) = tshark(&frames);
    let out = command.args(["-O", "lighthouse"]).output().unwrap();
    let text = String::from_utf8(out.stdout).unwrap();
    assert!(text.contains("Last reset: damaged image (5)"), "{text}");
    assert_eq!(text.matches("Last reset: ").count(), Reset::ALL.len() + Lock::ALL.len() + Factory::ALL.len() + 3);
    assert!(!text.contains("Unknown"), "{text}");
}

#[test]
fn what_is_off_is_marked_and_what_is_not_ours_is_left_alone() {
    if !is_there() {
        return;
    }
    let header = Header { pan: 0x4c48, mote: 7, sequence: 300 };
    let whole = emit(header, &Report::default()).to_vec();
    let with = |at: usize, byte: u8| {
        let mut bytes = whole.clone();
        bytes[at] = byte;
        let body = bytes.len() - 2;
        let check = lighthouse_mote::frame::fcs(&bytes[..body]).to_le_bytes();
        bytes[body..].copy_from_slice(&check);
        bytes
    };
    let mut torn = whole.clone();
    torn[30] ^= 1;
    let frames = [with(11, 2), with(12, 9), with(12, 2), with(13, 8), with(9, b'X'), torn];
    let told = dissect(&frames, &["lighthouse.mote".into(), "lighthouse.version".into(), "lighthouse.x".into()]);
    let experts: Vec<String> = told.iter().map(|told| texts(&told["_ws.expert.message"]).concat()).collect();
    for (expert, expected) in
        experts.iter().zip(["Unknown version", "Unknown kind", "Not the length of its kind", "Not the source address"])
    {
        assert!(expert.contains(expected), "{expert:?} is not {expected:?}");
    }
    assert!(told[..4].iter().all(|told| told["wpan.fcs_ok"][0] == "1"));
    assert_eq!((&told[4]["lighthouse.version"], experts[4].as_str()), (&Value::Null, ""));
    assert_eq!(told[5]["wpan.fcs_ok"][0], "0");
}

/// What Wireshark must be told to check the frames of `motes` under `key`: the key, and the extended address of each.
fn secrets(key: &[u8; 16], header: &[Header]) -> Vec<String> {
    let key = format!(r#"uat:ieee802154_keys:"{}","0","No hash""#, hex::encode(key));
    let address = |Header { pan, mote, .. }: &Header| {
        format!(r#"uat:802154_addresses:"{mote:x}","{pan:x}",{}"#, hex::encode(secured::address(*pan, *mote)))
    };
    std::iter::once(key).chain(header.iter().map(address)).collect()
}

#[test]
fn a_secured_frame_is_believed_under_its_key_and_no_other_frame_is() {
    if !is_there() {
        return;
    }
    const KEY: [u8; 16] = *b"a room of its ow";
    let mut dice = fastrand::Rng::with_seed(4);
    let (mut sent, mut headers) = (Vec::new(), Vec::new());
    for counter in [0, 1, 0x0102_0304, u32::MAX] {
        let (header, report) = (header(&mut dice), report(&mut dice));
        let mut frame = Aligned::BLANK;
        emit_into(&mut frame, header, &report);
        assert!(Key::new(&KEY).seal(&mut frame, counter));
        sent.push((header, frame.bytes().to_vec(), counter, shown_report(header, &report)));
        headers.push(header);
    }
    let fields: Vec<String> = sent[0].3.0.iter().map(|(name, _)| name.clone()).collect();
    let fields = [fields, vec!["wpan.aux_sec.frame_counter".into(), "wpan.aux_sec.sec_level".into()]].concat();
    let frames: Vec<Vec<u8>> = sent.iter().map(|(_, bytes, ..)| bytes.clone()).collect();
    let told = dissect_with(&frames, &fields, &secrets(&KEY, &headers));
    for ((header, _, counter, wanted), told) in sent.iter().zip(&told) {
        holds(*header, told, wanted);
        assert_eq!(told["wpan.aux_sec.frame_counter"][0], counter.to_string());
        let level = texts(&told["wpan.aux_sec.sec_level"]).concat();
        assert!(["1", "0x01", "0x1"].contains(&level.as_str()), "{level}");
    }
    // One bit of the payload, the check sequence right; and another key.
    let forged: Vec<Vec<u8>> = frames
        .iter()
        .map(|frame| {
            let mut frame = frame.clone();
            let body = frame.len() - 2;
            frame[30] ^= 1;
            let check = lighthouse_mote::frame::fcs(&frame[..body]).to_le_bytes();
            frame[body..].copy_from_slice(&check);
            frame
        })
        .collect();
    let others = dissect_with(&forged, &fields, &secrets(&KEY, &headers));
    let elsewhere = dissect_with(&frames, &fields, &secrets(b"another room's..", &headers));
    for told in others.iter().chain(&elsewhere) {
        assert_eq!((&told["wpan.fcs_ok"][0], &told["lighthouse.x"]), (&Value::from("1"), &Value::Null), "{told}");
    }
}
