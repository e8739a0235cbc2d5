//! From receivers to views: the receivers' side is played over pseudo-terminals, and the program itself is run, killed and
//! read back.
#![cfg(unix)]

#[path = "flash/player.rs"]
#[allow(dead_code, reason = "the programmers' parts are others'")]
mod player;
#[path = "listen/port.rs"]
mod port;
mod pty;
#[path = "listen/running.rs"]
mod running;

use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::Receiver;
use std::time::{Duration, Instant};

use air::receiver::Kind;
use air::{capture, hdlc};
use fixed::types::I16F16;
use lighthouse_mote::frame::secured::Key;
use lighthouse_mote::frame::{Aligned, Header, Level, Report, emit, emit_into};
use player::{Player, line};
use proptest::prelude::*;
use running::Running;
use serde_json::Value;
use serialport::{SerialPortInfo, SerialPortType, UsbPortInfo};
use xtask::listen::model::{self, Snapshot, SourceState};
use xtask::listen::source::{self, Desk, Heard};
use xtask::listen::{Session, View, desk};
use xtask::pcap;

/// Long where something has to come on a busy computer.
const LONG: Duration = Duration::from_secs(60);

/// Report number `sequence` of a mote that goes along x.
fn fix(mote: u16, sequence: u16) -> Vec<u8> {
    let report = Report {
        time: u32::from(sequence) * 1_000_000,
        half_turn_q8: 83_333 << 8,
        position: [I16F16::from_num(f64::from(sequence) / 100.0), I16F16::from_num(1), I16F16::from_num(2)],
        level: Level::Full,
        stations: 3,
        ..Report::default()
    };
    emit(Header { pan: 0x4C48, mote, sequence }, &report).to_vec()
}

/// As the nRF Sniffer says it.
fn said(frame: &[u8]) -> Vec<u8> {
    let hex = hex::encode(&frame[..frame.len() - 2]);
    format!("received: {hex}ffff power: -61 lqi: 180 time: 12345\r\n").into_bytes()
}

/// A desk whose queue is emptied until something is as it should be.
struct Bench {
    desk: Desk,
    from: Receiver<Heard>,
}

impl Bench {
    fn new() -> Self {
        let (desk, from) = desk(None);
        Self { desk, from }
    }

    fn until(&mut self, what: &str, is_so: impl Fn(&Snapshot) -> bool) -> Snapshot {
        let until = Instant::now() + LONG;
        loop {
            if let Ok(heard) = self.from.recv_timeout(Duration::from_millis(20)) {
                let mut swarm = model::lock(&self.desk.shared);
                match heard {
                    Heard::Frame(source, at_s, bytes, signal) => drop(swarm.hear(at_s, source, &bytes, signal)),
                    Heard::Bad(source, at_s, cause, bytes) => drop(swarm.reject(at_s, source, cause, &bytes)),
                    Heard::State(source, state, note) => {
                        let source = swarm.source(source).expect("a source that was added");
                        (source.state, source.note) = (state, note);
                    }
                }
                continue;
            }
            let all = model::lock(&self.desk.shared).snapshot(10);
            if is_so(&all) {
                return all;
            }
            assert!(Instant::now() < until, "{what} did not happen: {all:#?}");
        }
    }
}

impl Drop for Bench {
    fn drop(&mut self) {
        self.desk.enough.store(true, Ordering::Relaxed);
    }
}

/// A port whose name stays while what is plugged in changes.
struct Socket {
    home: tempfile::TempDir,
}

/// What is plugged in; its name goes first, for the system may give its number to another test's line.
struct Plugged {
    player: Player,
    name: String,
}

impl Drop for Plugged {
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.name);
    }
}

impl Socket {
    fn new() -> Self {
        Self { home: tempfile::tempdir().expect("a folder") }
    }

    fn name(&self) -> String {
        self.home.path().join("ttyACM0").display().to_string()
    }

    fn plug(&self) -> Plugged {
        let (line, player) = line();
        symlink(line, self.name()).expect("a link");
        Plugged { player, name: self.name() }
    }
}

#[test]
fn an_nrf_sniffer_is_told_its_channel_and_heard_between_rubbish_and_after_it_was_unplugged() {
    let socket = Socket::new();
    let mut bench = Bench::new();
    source::listen(bench.desk.clone(), socket.name(), Kind::Nrf, 17);
    bench.until("waiting", |all| all.sources[0].note == "not plugged in");
    let mut sniffer = socket.plug();
    let mut told = String::new();
    while !told.ends_with("receive\r\n") {
        told += &sniffer.player.text().expect("a command");
    }
    assert_eq!(told, "\r\nsleep\r\nchannel 17\r\nreceive\r\n");
    sniffer.player.noise(told.as_bytes());
    let mut noise = said(&fix(7, 0));
    noise.extend(b"received: 12zz power: 1 lqi: 1 time: 1\r\n\xff\x00\x80\r\n");
    noise.extend(&said(&fix(7, 1))[..50]);
    noise.extend(b"\n");
    noise.extend(said(&fix(7, 2)));
    sniffer.player.noise(&noise);
    let all = bench.until("two frames", |all| all.motes.first().is_some_and(|mote| mote.frames == 2));
    assert_eq!(serde_json::to_value(&all.rejects).unwrap(), serde_json::json!({ "line": 3 }));
    assert_eq!((all.motes[0].lost, all.motes[0].signal.rssi_dbm), (1, Some(-61)));
    assert_eq!(all.sources[0].state, SourceState::Open);
    // In the middle of a line, and its name goes too.
    sniffer.player.noise(&said(&fix(7, 3))[..30]);
    drop(sniffer);
    let all = bench.until("gone", |all| all.sources[0].state == SourceState::Waiting);
    assert_eq!(all.sources[0].unplugged, 1);
    let mut sniffer = socket.plug();
    while sniffer.player.text().expect("a command") != "receive\r\n" {}
    sniffer.player.noise(&said(&fix(7, 4)));
    let all = bench.until("heard again", |all| all.motes[0].frames == 3);
    assert_eq!((all.motes[0].sequence, all.motes[0].restarts, all.motes.len()), (4, 0, 1));
}

#[test]
fn receivers_are_known_by_their_usb_numbers() {
    let port = |name: &str, vid, pid, serial: &str| SerialPortInfo {
        port_name: name.to_owned(),
        port_type: SerialPortType::UsbPort(UsbPortInfo {
            vid,
            pid,
            serial_number: Some(serial.to_owned()),
            manufacturer: None,
            product: None,
        }),
    };
    let ports = [
        port("/dev/ttyUSB1", 0x0403, 0x6010, "b"),
        port("/dev/ttyUSB0", 0x0403, 0x6010, "b"),
        port("/dev/ttyACM1", 0x1366, 0x1015, "kit"),
        port("/dev/ttyACM0", 0x1366, 0x1015, "kit"),
        port("/dev/ttyACM2", 0x2341, 0x0043, "somebody's"),
        port("/dev/ttyACM3", 0x1915, 0x154B, "dongle"),
        SerialPortInfo { port_name: "/dev/ttyS0".into(), port_type: SerialPortType::Unknown },
    ];
    let [nrf, openmote] = [Kind::Nrf, Kind::Openmote];
    let known = [("/dev/ttyACM0", nrf), ("/dev/ttyACM3", nrf), ("/dev/ttyUSB0", openmote), ("/dev/ttyUSB1", openmote)];
    assert_eq!(source::among(&ports), known.map(|(name, kind)| (name.to_owned(), kind)));
}

#[test]
fn an_openmote_is_heard_between_damaged_frames() {
    let socket = Socket::new();
    let mut bench = Bench::new();
    let mut mote = socket.plug();
    source::listen(bench.desk.clone(), socket.name(), Kind::Openmote, 11);
    bench.until("open", |all| all.sources.first().is_some_and(|source| source.state == SourceState::Open));
    let packet = |frame: &[u8]| hdlc::encode(&[b"P\x00\x2a", frame, &[11]].concat());
    let mut damaged = packet(&fix(9, 1));
    damaged[20] ^= 4;
    mote.player.noise(&[b"junk".to_vec(), packet(&fix(9, 0)), damaged, packet(&fix(9, 2))].concat());
    let all = bench.until("two frames", |all| all.motes.first().is_some_and(|mote| mote.frames == 2));
    assert_eq!(serde_json::to_value(&all.rejects).unwrap(), serde_json::json!({ "hdlc": 2 }));
}

// --- captures ---

/// A capture of `frames` a tenth of a second apart, with a link type and what stands before and after a frame.
fn captured(link: u32, frames: &[Vec<u8>], as_captured: impl Fn(&[u8]) -> Vec<u8>) -> Vec<u8> {
    let mut bytes = Vec::new();
    pcap::write(&[], &mut bytes).unwrap();
    bytes[20..24].copy_from_slice(&link.to_le_bytes());
    for (n, frame) in frames.iter().enumerate() {
        let data = as_captured(frame);
        for word in [n as u32 / 10, n as u32 % 10 * 100_000, data.len() as u32, data.len() as u32] {
            bytes.extend(word.to_le_bytes());
        }
        bytes.extend(data);
    }
    bytes
}

/// Reads a capture to its end.
fn read(bytes: Vec<u8>) -> Snapshot {
    let mut bench = Bench::new();
    source::read_from(bench.desk.clone(), "air.pcap".into(), std::io::Cursor::new(bytes));
    bench.until("the end", |all| all.sources[0].state == SourceState::Ended)
}

#[test]
fn every_link_type_is_heard() {
    let frames: Vec<Vec<u8>> = (0..30).map(|sequence| fix(3, sequence)).collect();
    let bare = |frame: &[u8]| frame[..frame.len() - 2].to_vec();
    let tap = |frame: &[u8]| [&capture::tap_header(Some(-70.0), Some(99))[..], frame].concat();
    for (link, capture) in [
        (195, captured(195, &frames, <[u8]>::to_vec)),
        (230, captured(230, &frames, bare)),
        (283, captured(283, &frames, tap)),
    ] {
        let all = read(capture);
        let mote = &all.motes[0];
        assert_eq!((mote.frames, mote.lost), (30, 0), "{link}");
        assert!((mote.fixes_per_s - 10.0).abs() < 1e-6, "{link}: its own clock: {}", mote.fixes_per_s);
        assert_eq!(mote.signal.lqi, (link == 283).then_some(99));
        assert!(all.rejects.is_empty() && all.sources[0].note.is_empty(), "{all:?}");
    }
}

#[test]
fn a_damaged_capture_is_heard_up_to_the_damage() {
    let mut frames: Vec<Vec<u8>> = (0..30).map(|sequence| fix(3, sequence)).collect();
    frames[7][30] ^= 1;
    let whole = captured(195, &frames, <[u8]>::to_vec);
    let all = read(whole[..whole.len() - 40].to_vec());
    assert_eq!(all.motes[0].frames, 28);
    assert_eq!(serde_json::to_value(&all.rejects).unwrap(), serde_json::json!({ "fcs": 1, "capture": 1 }));
    assert!(all.sources[0].note.starts_with("frame 30"), "{}", all.sources[0].note);
    let all = read(b"GIF89a, not a capture".to_vec());
    assert!(all.sources[0].note.contains("neither pcap nor pcapng"), "{}", all.sources[0].note);
}

#[test]
fn a_file_that_is_no_capture_is_an_error_before_anything_is_shown() {
    let folder = tempfile::tempdir().unwrap();
    for (name, bytes) in [("picture.gif", &b"GIF89a, not a capture"[..]), ("empty.pcap", b"")] {
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        let Err(error) = source::Capture::open(&path) else { panic!("{name} was opened") };
        let error = error.to_string();
        assert!(error.starts_with(path.to_str().unwrap()) && error.ends_with("neither pcap nor pcapng"), "{error}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]
    #[test]
    fn a_capture_damaged_anywhere_never_stops_the_program(
        at in prop::collection::vec((0usize..3000, any::<u8>()), 0..8),
        cut in 0usize..3000,
        ng: bool,
    ) {
        let frames: Vec<Vec<u8>> = (0..30).map(|sequence| fix(3, sequence)).collect();
        let mut bytes = if ng { recorded(&frames) } else { captured(195, &frames, <[u8]>::to_vec) };
        for (at, value) in at {
            let at = at % bytes.len();
            bytes[at] = value;
        }
        bytes.truncate(cut.max(1));
        let mut count = 0;
        let _ = capture::records("air", &bytes[..], |_| { count += 1; true });
        prop_assert!(count <= 3000 / 16);
    }

    #[test]
    fn any_bytes_at_all_are_no_capture_or_one(mut bytes: Vec<u8>, ng: bool) {
        if bytes.len() >= 4 && ng {
            bytes[..4].copy_from_slice(&[0x0A, 0x0D, 0x0D, 0x0A]);
        }
        let _ = capture::records("air", &bytes[..], |_| true);
    }
}

/// The frames as this program records them.
fn recorded(frames: &[Vec<u8>]) -> Vec<u8> {
    recorded_by(&["roof"], frames)
}

/// The same where each of several receivers hears all of them.
fn recorded_by(receivers: &[&str], frames: &[Vec<u8>]) -> Vec<u8> {
    let home = tempfile::tempdir().unwrap();
    let dir = home.path().join("take");
    let (desk, from) = desk(None);
    let recorder = xtask::listen::record::Recorder::create(&dir, None, desk.shared.clone()).unwrap();
    let sources: Vec<_> =
        receivers.iter().map(|receiver| model::lock(&desk.shared).add_source(receiver, "nrf")).collect();
    for (n, frame) in frames.iter().enumerate() {
        let signal = model::Signal { rssi_dbm: Some(-50), lqi: None };
        for source in &sources {
            desk.to.send(Heard::Frame(*source, 0.1 * n as f64, frame.clone(), signal)).unwrap();
        }
    }
    for source in sources {
        desk.to.send(Heard::State(source, SourceState::Ended, String::new())).unwrap();
    }
    let mut session = Session { desk, from, sinks: vec![Box::new(recorder)], ends: true, until: None };
    session.listen(&mut View::None, &AtomicBool::new(false)).unwrap();
    drop(session);
    fs::read(dir.join("air.pcapng")).unwrap()
}

#[test]
fn a_frame_that_comes_again_is_a_duplicate_of_another_receiver_and_replayed_of_the_same() {
    let frames = secured_frames();
    let twice: Vec<Vec<u8>> = frames.iter().flat_map(|frame| [frame.clone(), frame.clone()]).collect();
    let counted = |capture: Vec<u8>| {
        let mut bench = Bench::new();
        model::lock(&bench.desk.shared).under(Some(KEY));
        source::read_from(bench.desk.clone(), "air".into(), std::io::Cursor::new(capture));
        let all = bench.until("the end", |all| all.sources.iter().all(|source| source.state == SourceState::Ended));
        assert_eq!((all.motes.len(), all.motes[0].frames), (1, 5), "{all:?}");
        let names = all.sources.iter().map(|source| (source.name.clone(), source.frames)).collect::<Vec<_>>();
        (all.duplicates, all.rejects.get(&model::Cause::Replayed).copied().unwrap_or(0), names)
    };
    let names = |names: &[(&str, u64)]| names.iter().map(|(name, frames)| ((*name).to_owned(), *frames)).collect();
    assert_eq!(counted(recorded_by(&["roof", "door"], &frames)), (5, 0, names(&[("air", 5), ("air: door", 5)])));
    assert_eq!(counted(recorded_by(&["roof", "door"], &twice)), (5, 10, names(&[("air", 10), ("air: door", 10)])));
    assert_eq!(counted(captured(195, &twice, <[u8]>::to_vec)), (0, 5, names(&[("air", 10)])));
}

#[test]
fn a_recording_keeps_its_times() {
    let home = tempfile::tempdir().unwrap();
    let frames: Vec<Vec<u8>> = (0..30).map(|sequence| fix(3, sequence)).collect();
    fs::write(home.path().join("air.pcapng"), recorded(&frames)).unwrap();
    let (desk, from) = desk(None);
    xtask::listen::record::Recording::open(home.path()).unwrap().replay(desk, 0.0);
    let heard = from.iter().filter_map(|heard| match heard {
        Heard::Frame(_, at_s, ..) => Some(at_s),
        _ => None,
    });
    // To the nanosecond in which they are written; in seconds since 1970 it would be 0.24 us.
    let times = (0..30).map(|n| Duration::from_millis(100 * n).as_secs_f64());
    assert_eq!(heard.collect::<Vec<_>>(), times.collect::<Vec<_>>());
}

// --- the program ---

fn xtask(words: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_xtask"));
    command.args(words).env_remove("LIGHTHOUSE_CALIB").current_dir(env!("CARGO_MANIFEST_DIR")).stdin(Stdio::null());
    command
}

/// Of a room.
const KEY: [u8; 16] = *b"a room of its ow";

/// Five reports of mote 7 under that key, counted from 100 on.
fn secured_frames() -> Vec<Vec<u8>> {
    let secured = |sequence| {
        let mut frame = Aligned::BLANK;
        emit_into(&mut frame, Header { pan: 0x4C48, mote: 7, sequence }, &Report::default());
        assert!(Key::new(&KEY).seal(&mut frame, 100 + u32::from(sequence)));
        frame.bytes().to_vec()
    };
    (0..5).map(secured).collect()
}

#[test]
fn a_secured_frame_is_believed_once_and_not_again_by_the_next_listener() {
    let dir = tempfile::tempdir().expect("a folder");
    let [air, key, counters, summary] = ["air.pcap", "key", "heard", "all.json"].map(|name| dir.path().join(name));
    fs::write(&air, captured(195, &secured_frames(), <[u8]>::to_vec)).expect("a capture");
    fs::write(&key, hex::encode(KEY)).expect("a key");
    let heard = || {
        let [air, counters, summary] = [&air, &counters, &summary].map(|path| path.to_str().expect("a plain path"));
        let words = ["listen", "--capture", air, "--counters", counters, "--summary", summary, "--plain"];
        let done = xtask(&words).env("LIGHTHOUSE_KEY", &key).output().expect("it starts");
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
        serde_json::from_slice::<Value>(&fs::read(summary).expect("a summary")).expect("JSON")
    };
    let (first, again) = (heard(), heard());
    assert_eq!(
        (first["motes"].as_array().map(Vec::len), first["rejects"]["replayed"].as_u64()),
        (Some(1), None),
        "{first}"
    );
    assert_eq!(again["motes"].as_array().map(Vec::len), Some(0), "{again}");
    assert_eq!(fs::read_to_string(&counters).expect("counters"), "4c48 0007 104\n");
}

#[test]
fn counters_that_cannot_be_kept_are_an_error_before_anything_is_heard() {
    let dir = tempfile::tempdir().expect("a folder");
    let [air, key, csv] = ["air.pcap", "key", "fixes.csv"].map(|name| dir.path().join(name));
    fs::write(&air, captured(195, &secured_frames(), <[u8]>::to_vec)).expect("a capture");
    fs::write(&key, hex::encode(KEY)).expect("a key");
    let nowhere = dir.path().join("nowhere/heard");
    let [air, csv_name, nowhere] = [&air, &csv, &nowhere].map(|path| path.to_str().expect("a plain path"));
    let words = ["listen", "--capture", air, "--counters", nowhere, "--csv", csv_name, "--plain"];
    let done = xtask(&words).env("LIGHTHOUSE_KEY", &key).output().expect("it starts");
    let said = String::from_utf8_lossy(&done.stderr).into_owned();
    assert!(!done.status.success() && said.contains("nowhere/heard: cannot be written"), "{said}");
    assert!(done.stdout.is_empty() && !csv.exists(), "{done:?}");
}

#[test]
fn a_simulated_swarm_in_a_room_with_a_key_is_shown_each_time_and_keeps_no_counters() {
    let home = tempfile::tempdir().expect("a folder");
    let at = |name: &str| home.path().join(name).to_str().expect("a plain path").to_owned();
    let room = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("../calib/default.toml")).expect("a room");
    fs::write(at("lab.toml"), room.replace("[mote]", "[mote]\nkey_file = \"lab.key\"")).expect("a room");
    fs::write(at("lab.key"), hex::encode(KEY)).expect("a key");
    let words = ["listen", "--calib", &at("lab.toml"), "--simulate", "12", "--seconds", "2"];
    for time in 1..=2 {
        let done = xtask(&words).args(["--plain", "--summary", &at("all.json")]).output().expect("it starts");
        assert!(done.status.success(), "{done:?}");
        let all: Value = serde_json::from_slice(&fs::read(at("all.json")).expect("a summary")).expect("JSON");
        assert_eq!(all["motes"].as_array().map(Vec::len), Some(12), "time {time}: {all}");
        assert_eq!((&all["rejects"], &all["duplicates"]), (&serde_json::json!({}), &0.into()), "time {time}");
    }
    if Path::new("/proc/self/stat").exists() {
        let words = ["listen", "--calib", &at("lab.toml"), "--measure", "2", "--simulate", "20"];
        let done = xtask(&words).output().expect("it starts");
        let text = String::from_utf8_lossy(&done.stdout);
        assert!(text.contains("20 motes; ") && text.contains(" 0 lost, rejected {};"), "{done:?}");
    }
    assert!(!Path::new(&at("lab.counters")).exists());
}

#[test]
fn a_recording_of_a_room_with_a_key_is_replayed_under_it() {
    let home = tempfile::tempdir().expect("a folder");
    let at = |name: &str| home.path().join(name);
    let text = |path: &Path| path.to_str().expect("a plain path").to_owned();
    fs::write(at("air.pcap"), captured(195, &secured_frames(), <[u8]>::to_vec)).expect("a capture");
    let room = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("../calib/default.toml")).expect("a room");
    let with_key = |name: &str| room.replace("[mote]", &format!("[mote]\nkey_file = \"{name}\""));
    let hex = hex::encode(KEY);
    fs::write(at("lab.toml"), with_key("lab.key")).expect("a room");
    fs::write(at("lab.key"), &hex).expect("a key");
    let take = text(&at("take"));
    let words = ["listen", "--calib", &text(&at("lab.toml")), "--capture", &text(&at("air.pcap")), "--record", &take];
    let done = xtask(&words).args(["--plain"]).output().expect("it starts");
    assert!(done.status.success(), "{done:?}");
    let summary = text(&at("all.json"));
    let words = ["replay", &take, "--speed", "0", "--plain", "--summary", &summary];
    let motes = |command: &mut Command| {
        let done = command.output().expect("it starts");
        assert!(done.status.success(), "{done:?}");
        let all: Value = serde_json::from_slice(&fs::read(&summary).expect("a summary")).expect("JSON");
        assert!(all["room"].is_object(), "{all}");
        all["motes"].as_array().map(Vec::len)
    };
    // Where the room's key lies, as long as it does.
    assert_eq!(motes(&mut xtask(&words)), Some(1));
    fs::create_dir(at("elsewhere")).expect("a folder");
    fs::rename(at("lab.key"), at("elsewhere/lab.key")).expect("moved");
    let lost = xtask(&words).output().expect("it starts");
    let said = String::from_utf8_lossy(&lost.stderr).into_owned();
    assert!(!lost.status.success() && said.contains("room.toml") && said.contains("--calib"), "{said}");
    assert!(said.contains("lab.key") && !said.contains(&hex), "{said}");
    // In the room that is named, by a flag or as everywhere.
    fs::write(at("elsewhere/lab.toml"), with_key("lab.key")).expect("a room");
    let elsewhere = text(&at("elsewhere/lab.toml"));
    assert_eq!(motes(xtask(&words).args(["--calib", &elsewhere])), Some(1));
    assert_eq!(motes(xtask(&words).env("LIGHTHOUSE_CALIB", &elsewhere)), Some(1));
    // And the file that is named counts before all others.
    fs::write(at("other.key"), "00".repeat(16)).expect("a key");
    let named = |name: &str| {
        let mut command = xtask(&words);
        command.args(["--calib", &elsewhere]).env("LIGHTHOUSE_KEY", at(name));
        motes(&mut command)
    };
    assert_eq!((named("elsewhere/lab.key"), named("other.key")), (Some(1), Some(0)));
}

/// Frames of a recording, as far as it is whole, and what is wrong with the rest.
fn frames_of(dir: &Path) -> (u64, anyhow::Result<()>) {
    let mut frames = 0;
    let air = fs::File::open(dir.join("air.pcapng")).expect("a capture");
    let end = capture::records("air.pcapng", air, |record| {
        assert!(lighthouse_mote::frame::parse(record.frame.as_deref().expect("a frame")).is_ok());
        frames += 1;
        true
    });
    (frames, end)
}

/// Whole rows of a table, its heading not counted.
fn rows_of(table: &Path) -> usize {
    fs::read_to_string(table).expect("a table").matches('\n').count().saturating_sub(1)
}

/// A swarm recorded for a while by a program that is then killed: the frames that are there.
fn killed_recording(dir: &Path) -> u64 {
    let words = ["listen", "--simulate", "40", "--json", "--record", dir.to_str().unwrap()];
    let mut child = Running(xtask(&words).stdout(Stdio::piped()).spawn().expect("it starts"));
    let lines = BufReader::new(child.0.stdout.take().unwrap()).lines();
    let seen = Arc::new(AtomicU64::new(0));
    let counted = seen.clone();
    // Read to its end: the program must not wait for a reader.
    let reader = std::thread::spawn(move || {
        for line in lines.map_while(Result::ok) {
            let Ok(event) = serde_json::from_str::<Value>(&line) else { return line };
            assert_eq!(event["source"], "simulated swarm");
            counted.fetch_add(1, Ordering::Relaxed);
        }
        String::new()
    });
    let until = Instant::now() + LONG;
    let wait = |what: &str, is_so: &dyn Fn() -> bool| {
        while !is_so() {
            assert!(Instant::now() < until, "{what} did not happen");
            std::thread::sleep(Duration::from_millis(20));
        }
    };
    wait("1500 frames", &|| seen.load(Ordering::Relaxed) >= 1500);
    let said = seen.load(Ordering::Relaxed);
    // What was said is on disk while the program goes on.
    wait("the recording", &|| frames_of(dir).0 >= said);
    let written = frames_of(dir).0;
    wait("the fixes", &|| rows_of(&dir.join("fixes.csv")) > 400);
    // SIGKILL.
    child.0.kill().expect("it was running");
    child.0.wait().expect("it has ended");
    // What was being printed may break off; the recording may not.
    let rest = reader.join().expect("each line is of the swarm");
    assert!(rest.is_empty() || rest.starts_with('{'), "{rest}");
    let (frames, end) = frames_of(dir);
    end.expect("whole to its last block");
    assert!(frames >= written, "{frames} of {written}");
    frames
}

#[test]
fn a_killed_recording_reads_and_is_replayed_and_is_not_overwritten() {
    let home = tempfile::tempdir().unwrap();
    let dir = home.path().join("take");
    let frames = killed_recording(&dir);
    let mut rows = csv::Reader::from_path(dir.join("fixes.csv")).unwrap();
    let fixes = rows.records().collect::<Result<Vec<_>, _>>().expect("whole to its last row").len();
    assert!(fixes > 400, "{fixes}");
    let summary = home.path().join("summary.json");
    let words = ["replay", dir.to_str().unwrap(), "--speed", "0", "--summary", summary.to_str().unwrap()];
    let shown = xtask(&words).output().expect("it runs");
    assert!(shown.status.success(), "{shown:?}");
    let all: Value = serde_json::from_slice(&fs::read(&summary).unwrap()).unwrap();
    assert_eq!(all["frames"], frames);
    assert_eq!(all["motes"].as_array().unwrap().len(), 40);
    assert_eq!(all["sources"][0]["name"], "simulated swarm");
    assert_eq!(all["room"]["stations"][0]["name"], "A");
    assert!(all["motes"].as_array().unwrap().iter().all(|mote| mote["lost"] == 0), "{all}");
    let before = fs::read(dir.join("air.pcapng")).unwrap();
    let again = xtask(&["listen", "--simulate", "40", "--record", dir.to_str().unwrap()]).output().unwrap();
    assert!(!again.status.success());
    assert!(String::from_utf8_lossy(&again.stderr).contains("not overwritten"), "{again:?}");
    assert_eq!(fs::read(dir.join("air.pcapng")).unwrap(), before);
}

#[test]
fn a_replay_takes_as_long_as_it_is_told() {
    let home = tempfile::tempdir().unwrap();
    let frames: Vec<Vec<u8>> = (0..30).map(|sequence| fix(3, sequence)).collect();
    fs::write(home.path().join("air.pcapng"), recorded(&frames)).unwrap();
    let started = Instant::now();
    let csv = home.path().join("again.csv");
    let words = ["replay", home.path().to_str().unwrap(), "--speed", "2", "--plain", "--csv", csv.to_str().unwrap()];
    let shown = xtask(&words).output().unwrap();
    assert!(shown.status.success(), "{shown:?}");
    // 2.9 s at twice the speed.
    assert!(started.elapsed() >= Duration::from_millis(1400), "{:?}", started.elapsed());
    let text = fs::read_to_string(&csv).unwrap();
    assert_eq!(text.lines().count(), 31, "{text}");
    assert!(text.contains("\n2.9,roof,19528,3,0,29,full,0.28999,1.0,2.0,"), "{text}");
    let none = xtask(&["replay", "no such folder"]).output().unwrap();
    assert!(String::from_utf8_lossy(&none.stderr).contains("is that the folder of a recording?"), "{none:?}");
    for bytes in [&b""[..], b"not a capture at all"] {
        let home = tempfile::tempdir().unwrap();
        fs::write(home.path().join("air.pcapng"), bytes).unwrap();
        let none = xtask(&["replay", home.path().to_str().unwrap()]).output().unwrap();
        let said = String::from_utf8_lossy(&none.stderr);
        assert!(none.status.code() == Some(1) && said.contains("air.pcapng: is neither pcap nor pcapng"), "{none:?}");
    }
}

#[test]
fn a_capture_through_a_pipe_is_shown_in_lines_where_there_is_no_terminal() {
    let mut frames: Vec<Vec<u8>> = (0..30).map(|sequence| fix(3, sequence)).collect();
    frames[4][20] ^= 1;
    let words = ["listen", "--capture", "-"];
    let mut child = xtask(&words).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    child.stdin.take().unwrap().write_all(&captured(195, &frames, <[u8]>::to_vec)).unwrap();
    let mut text = String::new();
    child.stdout.take().unwrap().read_to_string(&mut text).unwrap();
    assert!(child.wait().unwrap().success());
    assert_eq!(text, "1 motes, 1 frames lost, 30 frames, 0 heard twice, 1 rejected: 1 check sequence wrong\n");
}

#[test]
fn a_swarm_is_listened_to_without_a_loss() {
    if !Path::new("/proc/self/stat").exists() {
        eprintln!("skipped: there is no /proc here");
        return;
    }
    // The share of the processor is a matter of the computer: 100 motes for a moment only show that it is weighed.
    let words = ["listen", "--measure", "3", "--simulate", "100"];
    let shown = xtask(&words).output().unwrap();
    let text = String::from_utf8_lossy(&shown.stdout);
    println!("{text}");
    assert!(text.contains("100 motes; ") && text.contains(" 0 lost, rejected {};"), "{shown:?}");
}

// --- a broker ---

struct Mosquitto {
    _running: Running,
    port: u16,
    _home: tempfile::TempDir,
}

/// Debian puts it where only root looks.
fn mosquitto() -> Option<PathBuf> {
    let paths =
        ["/usr/sbin/mosquitto", "/usr/bin/mosquitto", "/usr/local/sbin/mosquitto", "/opt/homebrew/sbin/mosquitto"];
    let found = paths.iter().map(PathBuf::from).find(|path| path.is_file());
    if found.is_none() {
        eprintln!("skipped: mosquitto is not installed (Debian: apt-get install mosquitto)");
    }
    found
}

impl Mosquitto {
    fn start() -> Option<Self> {
        Self::start_at(port::free, "allow_anonymous true")
    }

    fn start_at(port: impl Fn() -> u16, access: &str) -> Option<Self> {
        let program = mosquitto()?;
        let home = tempfile::tempdir().unwrap();
        let settings = home.path().join("mosquitto.conf");
        let until = Instant::now() + LONG;
        loop {
            let port = port();
            fs::write(&settings, format!("listener {port} 127.0.0.1\n{access}\n")).unwrap();
            let mut command = Command::new(&program);
            let child = command.arg("-c").arg(&settings).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
            let mut running = Running(child);
            // It ends where another was faster to have the port.
            while running.0.try_wait().unwrap().is_none() {
                if std::net::TcpStream::connect(("127.0.0.1", port)).is_ok() {
                    return Some(Self { _running: running, port, _home: home });
                }
                assert!(Instant::now() < until, "the broker does not answer");
                std::thread::sleep(Duration::from_millis(20));
            }
            assert!(Instant::now() < until, "the broker does not start");
        }
    }

    /// Every message that comes until `enough` says so: topic, payload, whether it was retained.
    fn hear(&self, mut enough: impl FnMut(&str, &[u8], bool) -> bool) {
        let mut options = rumqttc::MqttOptions::new(format!("test-{:?}", Instant::now()), "127.0.0.1", self.port);
        options.set_keep_alive(LONG);
        let (client, mut connection) = rumqttc::Client::new(options, 100);
        let until = Instant::now() + LONG;
        loop {
            assert!(Instant::now() < until, "it did not come");
            let Ok(Ok(event)) = connection.recv_timeout(Duration::from_secs(1)) else { continue };
            match event {
                // Each time: a line that was lost is made anew by itself, and knows nothing.
                rumqttc::Event::Incoming(rumqttc::Packet::ConnAck(_)) => {
                    client.try_subscribe("#", rumqttc::QoS::AtLeastOnce).expect("room for one");
                }
                rumqttc::Event::Incoming(rumqttc::Packet::Publish(message))
                    if enough(&message.topic, &message.payload, message.retain) =>
                {
                    return;
                }
                _ => {}
            }
        }
    }
}

#[test]
fn a_broker_has_one_retained_topic_per_mote() {
    let Some(broker) = Mosquitto::start() else { return };
    let address = format!("127.0.0.1:{}", broker.port);
    let words = ["listen", "--simulate", "12", "--json", "--mqtt", &address, "--mqtt-gateway", "roof"];
    let mut gateway = Running(xtask(&words).stdout(Stdio::null()).spawn().unwrap());
    let mut online = false;
    let mut seen = std::collections::BTreeSet::new();
    broker.hear(|topic, payload, _| {
        online |= topic == "lighthouse/gateway/roof" && payload == b"online";
        if topic.starts_with("lighthouse/4c48/") {
            seen.insert(topic.to_owned());
        }
        online && seen.len() == 12
    });
    // Whoever comes later knows at once.
    let mut retained = None;
    broker.hear(|topic, payload, is_retained| {
        if topic == "lighthouse/4c48/7" && is_retained {
            retained = Some(payload.to_vec());
        }
        retained.is_some()
    });
    let mote: Value = serde_json::from_slice(&retained.unwrap()).unwrap();
    assert_eq!((&mote["gateway"], &mote["mote"], &mote["fix"]["level"]), (&"roof".into(), &7.into(), &"full".into()));
    assert!(mote["fix"]["position_m"][0].is_number() && mote["time_unix_s"].as_f64() > Some(1.6e9), "{mote}");
    assert_eq!(mote["trail"], serde_json::json!([]));
    gateway.0.kill().unwrap();
    // The broker says it.
    broker.hear(|topic, payload, _| topic == "lighthouse/gateway/roof" && payload == b"offline");
}

#[test]
fn what_one_gateway_has_said_another_leaves() {
    let Some(broker) = Mosquitto::start() else { return };
    let address = format!("127.0.0.1:{}", broker.port);
    let home = tempfile::tempdir().unwrap();
    // A minute and a half; nobody waits for its end.
    let frames: Vec<Vec<u8>> = (0..900).map(|sequence| fix(3, sequence)).collect();
    fs::write(home.path().join("air.pcapng"), recorded(&frames)).unwrap();
    // Two gateways hear the same mote; one is half a second late, or more.
    let gateway = |name: &str| {
        let words = ["replay", home.path().to_str().unwrap(), "--json", "--mqtt", &address, "--mqtt-gateway", name];
        Running(xtask(&words).stdout(Stdio::null()).spawn().unwrap())
    };
    let _first = gateway("first");
    let mut second = None;
    let mut is_online = false;
    // Messages of the first since the second has said anything of the mote: it may, until it has heard the first.
    let mut alone = 0;
    broker.hear(|topic, payload, _| {
        is_online |= topic == "lighthouse/gateway/second" && payload == b"online";
        if topic == "lighthouse/4c48/3" {
            let mote: Value = serde_json::from_slice(payload).unwrap();
            if second.is_none() && mote["sequence"].as_u64() >= Some(5) {
                second = Some(gateway("second"));
            }
            alone = if is_online && mote["gateway"] == "first" { alone + 1 } else { 0 };
        }
        // 2 s in which the second would have said as much.
        alone >= 20
    });
    assert!(second.expect("a second").0.try_wait().unwrap().is_none(), "the second had ended");
}

/// What two listeners that hear the same at the same moment publish: message by message, topic, gateway and sequence.
fn said_by_two(broker: &Mosquitto, motes: u16, seconds: f64) -> Vec<(String, String, u16)> {
    let address = format!("127.0.0.1:{}", broker.port);
    let mut gateways: Vec<Running> = ["east", "west"]
        .iter()
        .map(|name| {
            let words = ["listen", "--capture", "-", "--json", "--mqtt", &address, "--mqtt-gateway", name];
            Running(xtask(&words).stdin(Stdio::piped()).stdout(Stdio::null()).spawn().unwrap())
        })
        .collect();
    let mut pipes: Vec<_> = gateways.iter_mut().map(|gateway| gateway.0.stdin.take().unwrap()).collect();
    let (mut online, mut said) = (0, Vec::new());
    broker.hear(|topic, payload, _| {
        online += u32::from(topic.starts_with("lighthouse/gateway/") && payload == b"online");
        online == 2
    });
    let feed = std::thread::spawn(move || {
        let calibration = xtask::calib::schema::read("d", include_str!("../../calib/default.toml")).unwrap();
        let scene = xtask::listen::simulate::scene("d", &calibration).unwrap();
        let mut swarm = xtask::listen::simulate::Swarm::new(&scene, 0x4C48, motes, 10.0);
        let head = captured(195, &[], <[u8]>::to_vec);
        let mut bytes = head.clone();
        let started = Instant::now();
        while started.elapsed().as_secs_f64() < seconds {
            swarm.until(started.elapsed().as_secs_f64(), |at_s, frame| {
                let frame = pcap::Frame { micros: (1e6 * at_s) as u64, bytes: frame.to_vec() };
                let mut one = Vec::new();
                pcap::write(&[frame], &mut one).unwrap();
                bytes.extend(&one[head.len()..]);
            });
            for pipe in &mut pipes {
                pipe.write_all(&bytes).unwrap();
                pipe.flush().unwrap();
            }
            bytes.clear();
            std::thread::sleep(Duration::from_millis(5));
        }
    });
    let mut offline = 0;
    broker.hear(|topic, payload, is_retained| {
        if topic.starts_with("lighthouse/4c48/") && !is_retained {
            let mote: Value = serde_json::from_slice(payload).unwrap();
            let (gateway, sequence) = (mote["gateway"].as_str().unwrap(), mote["sequence"].as_u64().unwrap());
            said.push((topic.to_owned(), gateway.to_owned(), sequence as u16));
        }
        offline += u32::from(topic.starts_with("lighthouse/gateway/") && payload == b"offline");
        offline == 2
    });
    feed.join().unwrap();
    said
}

#[test]
fn two_gateways_that_hear_the_same_at_once_say_it_once() {
    const MOTES: u16 = 30;
    const SECONDS: f64 = 8.0;
    let Some(broker) = Mosquitto::start() else { return };
    let said = said_by_two(&broker, MOTES, SECONDS);
    let mut last = std::collections::BTreeMap::<&str, (&str, u16)>::new();
    let (mut stale, mut handed_over) = (0, 0);
    for (topic, gateway, sequence) in &said {
        let Some((speaker, newest)) = last.insert(topic, (gateway, *sequence)) else { continue };
        stale += u32::from(sequence.wrapping_sub(newest).cast_signed() <= 0);
        handed_over += u32::from(speaker != gateway);
    }
    let each_per_s = said.len() as f64 / f64::from(MOTES) / SECONDS;
    println!(
        "{} messages, {each_per_s:.1} a second of a mote, {stale} stale, {handed_over} times another gateway",
        said.len()
    );
    assert_eq!(last.len(), usize::from(MOTES));
    // As often as one alone would; a computer that has other things to do makes it less.
    assert!(each_per_s > 3.0 && each_per_s < 11.5, "{each_per_s}");
    // Once where both begin, and where one is late on a busy computer. Without turns: 366 to 1389 and 1 to 782.
    assert!(handed_over <= 4 * u32::from(MOTES), "{handed_over}");
    assert!(stale <= 2 * u32::from(MOTES), "{stale}");
}

/// A capture of thirty reports of one mote in a folder.
fn thirty(home: &Path) -> String {
    let path = home.join("air.pcap");
    let frames: Vec<Vec<u8>> = (0..30).map(|sequence| fix(3, sequence)).collect();
    fs::write(&path, captured(195, &frames, <[u8]>::to_vec)).expect("a capture");
    path.to_str().expect("a plain path").to_owned()
}

#[test]
fn a_broker_that_asks_who_one_is_is_told() {
    let home = tempfile::tempdir().expect("a folder");
    let file = |name: &str, text: &str| {
        let path = home.path().join(name);
        fs::write(&path, text).expect("a file");
        path.to_str().expect("a plain path").to_owned()
    };
    // Mosquitto's own tool hashes it in place.
    let known = file("known", "roof:sesame\n");
    let hashed = Command::new("mosquitto_passwd").args(["-U", &known]).status();
    if !hashed.is_ok_and(|status| status.success()) {
        eprintln!("skipped: there is no mosquitto_passwd");
        return;
    }
    // It may give up root, and then has to read that.
    let _ = Command::new("chmod").args(["-R", "a+rX", home.path().to_str().expect("a plain path")]).status();
    let access = format!("allow_anonymous false\npassword_file {known}");
    let Some(broker) = Mosquitto::start_at(port::free, &access) else { return };
    let address = format!("127.0.0.1:{}", broker.port);
    let (air, right, wrong) = (thirty(home.path()), file("right", "sesame\nnot this\n"), file("wrong", "mustard"));
    let play = |more: &[&str]| {
        let words = ["listen", "--capture", &air, "--plain", "--mqtt", &address];
        let done = xtask(&[&words, more].concat()).output().expect("it starts");
        let said = [done.stdout, done.stderr].map(|said| String::from_utf8_lossy(&said).into_owned());
        (done.status.code(), said)
    };
    let (code, said) = play(&["--mqtt-user", "roof", "--mqtt-password", &right]);
    assert!(code == Some(0) && !said[0].contains(" 0 published"), "{said:?}");
    let refused = format!("broker {address} was never reached: it refuses this client: ");
    for more in [&[][..], &["--mqtt-user", "roof", "--mqtt-password", &wrong]] {
        let (code, said) = play(more);
        assert!(code == Some(1) && said[1].contains(&refused) && !said[1].contains("mustard"), "{said:?}");
    }
    let (code, said) = play(&["--mqtt-user", "roof", "--mqtt-password", &file("empty", "")]);
    assert!(code == Some(1) && said[1].contains("empty:1: no password"), "{said:?}");
}

#[test]
fn what_strangers_leave_at_the_broker_is_no_reason_to_hang_up() {
    let Some(broker) = Mosquitto::start() else { return };
    let address = format!("127.0.0.1:{}", broker.port);
    let home = tempfile::tempdir().expect("a folder");
    let mut options = rumqttc::MqttOptions::new("stranger", "127.0.0.1", broker.port);
    options.set_max_packet_size(1 << 20, 1 << 20);
    let (stranger, mut connection) = rumqttc::Client::new(options, 10);
    let long = vec![b'x'; 200_000];
    stranger.try_publish("lighthouse/any/thing", rumqttc::QoS::AtLeastOnce, true, long).expect("room for one");
    let taken = |said: &rumqttc::Event| matches!(said, rumqttc::Event::Incoming(rumqttc::Packet::PubAck(_)));
    assert!(connection.iter().any(|said| taken(&said.expect("a broker"))), "it took it");
    let air = thirty(home.path());
    let done = xtask(&["listen", "--capture", &air, "--plain", "--mqtt", &address]).output().expect("it starts");
    let said = String::from_utf8_lossy(&done.stdout);
    assert!(done.status.success(), "{done:?}");
    assert!(said.contains("0 not delivered\n") && !said.contains(" 0 published"), "{said}");
}

#[test]
fn a_broker_that_is_never_there_is_an_error_in_the_end_and_costs_nothing_else() {
    let home = tempfile::tempdir().unwrap();
    let at = |name: &str| home.path().join(name).to_str().expect("a plain path").to_owned();
    let (air, take, summary, csv) = (thirty(home.path()), at("take"), at("all.json"), at("fixes.csv"));
    let address = format!("127.0.0.1:{}", port::free());
    let words =
        ["listen", "--capture", &air, "--record", &take, "--summary", &summary, "--csv", &csv, "--mqtt", &address];
    let done = xtask(&words).output().expect("it starts");
    let said = [&done.stdout, &done.stderr].map(|said| String::from_utf8_lossy(said).into_owned());
    assert_eq!(done.status.code(), Some(1), "{said:?}");
    // At once and in the end, with where and why.
    let [first, last] = [0, 1].map(|line| said[1].lines().nth(line).expect("two lines").to_owned());
    let broker = format!("broker {address}");
    assert!(first.starts_with(&format!("{broker}: cannot be reached: Connection refused")), "{first}");
    assert!(last.starts_with(&format!("error: {broker} was never reached: Connection refused")), "{last}");
    assert!(said[0].contains("30 frames, 0 heard twice") && said[0].contains("0 published"), "{}", said[0]);
    let (frames, end) = frames_of(Path::new(&take));
    end.expect("whole to its last block");
    assert_eq!((frames, rows_of(&Path::new(&take).join("fixes.csv")), rows_of(Path::new(&csv))), (30, 30, 30));
    let all: Value = serde_json::from_slice(&fs::read(&summary).expect("a summary")).expect("JSON");
    assert_eq!(all["motes"][0]["frames"], 30);
    // A name that nobody has, and where nothing shows it but the standard error.
    let words = ["replay", &take, "--speed", "0", "--json", "--mqtt", "no-such-host.invalid"];
    let done = xtask(&words).output().expect("it starts");
    let said = String::from_utf8_lossy(&done.stderr);
    assert!(!done.status.success() && said.contains("broker no-such-host.invalid:1883 was never reached: "), "{said}");
    assert_eq!(String::from_utf8_lossy(&done.stdout).lines().count(), 30);
}

/// Tells a program to end.
fn interrupt(child: &Running) {
    let told = Command::new("kill").args(["-INT", &child.0.id().to_string()]).status().expect("it starts");
    assert!(told.success());
}

/// The number in front of `what`, in the last line that has it.
fn number(text: &str, what: &str) -> u64 {
    let words = |line: &str| line.split(what).next().and_then(|before| before.split(' ').next_back()?.parse().ok());
    text.lines().rev().find(|line| line.contains(what)).and_then(words).unwrap_or_else(|| panic!("{what}: {text}"))
}

#[test]
fn a_broker_that_is_lost_and_comes_back_is_survived_and_what_it_missed_is_counted() {
    let Some(broker) = Mosquitto::start() else { return };
    let (port, home) = (broker.port, tempfile::tempdir().unwrap());
    let at = |name: &str| home.path().join(name);
    let address = format!("127.0.0.1:{port}");
    let mut words = vec!["listen", "--simulate", "12", "--plain", "--mqtt", &address, "--mqtt-gateway", "roof"];
    let (take, summary) = (at("take"), at("all.json"));
    words.extend(["--record", take.to_str().unwrap(), "--summary", summary.to_str().unwrap()]);
    let mut command = xtask(&words);
    let mut gateway = Running(command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap());
    let mut shown = gateway.0.stdout.take().unwrap();
    let shown = std::thread::spawn(move || {
        let mut text = String::new();
        shown.read_to_string(&mut text).expect("text");
        text
    });
    let mut alarms = BufReader::new(gateway.0.stderr.take().unwrap()).lines().map_while(Result::ok);
    let mut count = 0;
    let mut heard = |broker: &Mosquitto, enough: u64| {
        let mut motes = std::collections::BTreeSet::new();
        let from = count;
        broker.hear(|topic, _, _| {
            if topic.starts_with("lighthouse/4c48/") {
                motes.insert(topic.to_owned());
                count += 1;
            }
            motes.len() == 12 && count - from >= enough
        });
    };
    heard(&broker, 100);
    drop(broker);
    let lost = alarms.next().expect("it is said");
    assert!(lost.starts_with(&format!("broker {address}: lost: ")) && lost.contains("all else goes on"), "{lost}");
    // Long enough that something is missed.
    std::thread::sleep(Duration::from_secs(1));
    let broker = Mosquitto::start_at(|| port, "allow_anonymous true").expect("as before");
    assert_eq!(alarms.next().as_deref(), Some(&*format!("broker {address}: is there")));
    // It knows nothing of before, and is told of every mote.
    heard(&broker, 100);
    interrupt(&gateway);
    let offline = |topic: &str, payload: &[u8], _: bool| topic == "lighthouse/gateway/roof" && payload == b"offline";
    broker.hear(offline);
    assert!(gateway.0.wait().expect("it ends").success());
    let rest: Vec<String> = alarms.collect();
    assert!(rest.is_empty(), "{rest:?}");
    let shown = shown.join().unwrap();
    let last = shown.lines().last().expect("a line");
    assert!(last.starts_with(&format!("broker {address}: ")) && last.ends_with(", lost once"), "{last}");
    // Whatever was heard was said; a second of 12 motes is a hundred messages, but on a computer that is busy.
    let (published, missed) = (number(last, " published"), number(last, " not delivered"));
    assert!(published + missed >= count && missed > 0, "{last}, {count} heard");
    // And nothing of it is missing where it was recorded.
    let (frames, end) = frames_of(&take);
    end.expect("whole to its last block");
    let all: Value = serde_json::from_slice(&fs::read(&summary).expect("a summary")).expect("JSON");
    assert_eq!(all["frames"], frames);
    assert!(all["motes"].as_array().unwrap().iter().all(|mote| mote["lost"] == 0), "{all}");
}

#[test]
fn a_broker_that_is_gone_at_the_end_is_an_error() {
    let Some(broker) = Mosquitto::start() else { return };
    let address = format!("127.0.0.1:{}", broker.port);
    let words = ["listen", "--simulate", "12", "--json", "--mqtt", &address, "--mqtt-gateway", "roof"];
    let mut gateway = Running(xtask(&words).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap());
    broker.hear(|topic, _, _| topic == "lighthouse/4c48/7");
    drop(broker);
    let mut alarms = BufReader::new(gateway.0.stderr.take().unwrap()).lines().map_while(Result::ok);
    assert!(alarms.next().is_some_and(|lost| lost.contains(": lost: ")));
    interrupt(&gateway);
    assert_eq!(gateway.0.wait().expect("it ends").code(), Some(1));
    let error = alarms.last().expect("an error");
    assert!(error.starts_with(&format!("error: broker {address} went away and did not come back: ")), "{error}");
}

#[test]
fn a_disk_that_is_full_is_an_error_and_what_was_recorded_reads() {
    let home = tempfile::tempdir().unwrap();
    let (take, csv) = (home.path().join("take"), home.path().join("fixes.csv"));
    // No file may be longer than 100 blocks of 512 or 1024 bytes: what is written is cut there, as on a disk.
    let mut command = Command::new("sh");
    command.args(["-c", "trap '' XFSZ; ulimit -f 100; exec \"$@\"", "sh", env!("CARGO_BIN_EXE_xtask")]);
    command.args(["listen", "--simulate", "200", "--plain", "--csv"]).arg(&csv).arg("--record").arg(&take);
    let done =
        command.env_remove("LIGHTHOUSE_CALIB").current_dir(env!("CARGO_MANIFEST_DIR")).output().expect("it starts");
    let said = String::from_utf8_lossy(&done.stderr);
    assert!(!done.status.success() && said.contains(": cannot be written: "), "{said}");
    let (frames, end) = frames_of(&take);
    end.expect("whole to its last block");
    assert!(frames > 0);
    for table in [&csv, &take.join("fixes.csv")] {
        let mut rows = csv::Reader::from_path(table).expect("a table");
        let rows = rows.records().collect::<Result<Vec<_>, _>>().expect("whole to its last row");
        assert!(!rows.is_empty() && fs::read_to_string(table).unwrap().ends_with('\n'));
    }
}

#[test]
fn what_cannot_be_had_is_said_before_anything_is_made() {
    let home = tempfile::tempdir().unwrap();
    let at = |name: &str| home.path().join(name).to_str().expect("a plain path").to_owned();
    fs::write(at("there.csv"), "mine").unwrap();
    let taken = std::net::TcpListener::bind(("127.0.0.1", 0)).unwrap();
    let web = taken.local_addr().unwrap().to_string();
    let [missing, there, nowhere] = ["missing.pcap", "there.csv", "no/such.json"].map(at);
    for (words, says) in [
        (["--capture", &missing], "missing.pcap: cannot be read"),
        (["--csv", &there], "there.csv: is there already and is not overwritten"),
        (["--summary", &nowhere], "no/such.json: no file can be made there"),
        (["--web", &web], "cannot be served"),
        (["--mqtt-prefix", "a#b"], "\"a#b\" cannot be part of a topic"),
        (["--rate", "-1"], "-1 is not above 0"),
    ] {
        let take = at("take");
        let done =
            xtask(&["listen", "--simulate", "12", "--mqtt", "127.0.0.1:1", "--record", &take]).args(words).output();
        let done = done.expect("it starts");
        let said = String::from_utf8_lossy(&done.stderr);
        assert!(!done.status.success() && said.contains(says), "{words:?}: {said}");
        assert!(!Path::new(&take).exists(), "{words:?}");
    }
}

// --- ROS 2 ---

/// The recipe as it stands in the manual.
fn recipe() -> &'static str {
    let manual = include_str!("../../docs/listening.md");
    let (_, behind) = manual.split_once("```python\n").expect("a recipe");
    behind.split_once("```").expect("its end").0
}

/// What the recipe publishes of these messages: when, topic, payload, retained.
fn poses(messages: &[(f64, String, String, bool)]) -> Option<Vec<Value>> {
    if Command::new("python3").arg("--version").output().is_err() {
        eprintln!("skipped: python3 is not installed");
        return None;
    }
    let home = tempfile::tempdir().unwrap();
    let [recipe_file, messages_file, player] =
        ["recipe.py", "messages.json", "ros.py"].map(|name| home.path().join(name));
    fs::write(&recipe_file, recipe()).unwrap();
    fs::write(&messages_file, serde_json::to_vec(messages).unwrap()).unwrap();
    fs::write(&player, include_str!("listen/ros.py")).unwrap();
    let done = Command::new("python3").args([player, recipe_file, messages_file]).output().expect("it starts");
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    Some(serde_json::from_slice(&done.stdout).expect("JSON"))
}

#[test]
fn the_recipe_for_ros_makes_one_pose_of_each_position_whoever_says_it_and_in_whatever_order() {
    let Some(broker) = Mosquitto::start() else { return };
    let address = format!("127.0.0.1:{}", broker.port);
    let words = ["listen", "--simulate", "12", "--json", "--mqtt", &address, "--mqtt-gateway", "roof"];
    let _gateway = Running(xtask(&words).stdout(Stdio::null()).spawn().unwrap());
    let mut real = Vec::new();
    broker.hear(|topic, payload, retained| {
        real.push((topic.to_owned(), String::from_utf8(payload.to_vec()).expect("text"), retained));
        real.len() >= 400
    });
    let json = |payload: &str| serde_json::from_str::<Value>(payload).expect("JSON");
    // What the broker says, each once more as from another gateway, and then the one before.
    let mut said = Vec::new();
    let mut before = std::collections::BTreeMap::<String, String>::new();
    let (mut positions, mut at_s) = (Vec::new(), 100.0);
    for (topic, payload, retained) in &real {
        at_s += 0.01;
        said.push((at_s, topic.clone(), payload.clone(), *retained));
        if topic.starts_with("lighthouse/gateway/") || *retained {
            continue;
        }
        let mut mote = json(payload);
        let position = (topic.clone(), mote["fix"]["sequence"].clone());
        if !mote["fix"].is_null() && positions.iter().all(|(known, _)| *known != position) {
            positions.push((position, mote["fix"].clone()));
        }
        mote["gateway"] = "cellar".into();
        said.push((at_s, topic.clone(), mote.to_string(), false));
        if let Some(older) = before.insert(topic.clone(), payload.clone()) {
            said.push((at_s, topic.clone(), older, false));
        }
    }
    let Some(poses) = poses(&said) else { return };
    assert!(positions.len() > 250, "{} positions of {} messages", positions.len(), real.len());
    assert_eq!(poses.len(), positions.len());
    for (pose, ((topic, _), fix)) in poses.iter().zip(&positions) {
        let mote = topic.rsplit('/').next().unwrap();
        assert_eq!((&pose["topic"], &pose["frame"]), (&format!("mote_4c48_{mote}/pose").into(), &"room".into()));
        assert_eq!(pose["position_m"], fix["position_m"]);
        let close = |one: &Value, other: f64| (one.as_f64().unwrap() - other).abs() < 1e-6;
        assert!(close(&pose["before_s"], fix["ago_s"].as_f64().unwrap()), "{pose}: {fix}");
        for axis in 0..3 {
            let sd = fix["sd_m"][axis].as_f64().unwrap();
            assert!(
                close(&pose["covariance"][7 * axis], sd * sd) && pose["covariance"][7 * (axis + 3)] == 1e6,
                "{pose}"
            );
        }
    }
}

#[test]
fn the_recipe_for_ros_counts_round_and_takes_a_mote_that_starts_anew() {
    let message = |sequence: u16, fix: Option<u16>, x: f64| {
        let fix = fix.map(|sequence| serde_json::json!({ "ago_s": 0.0, "sequence": sequence, "position_m": [x, 0.0, 0.0], "sd_m": null }));
        serde_json::json!({ "pan": 0x4C48, "mote": 7, "is_conflict": false, "sequence": sequence, "fix": fix })
    };
    let none = serde_json::json!({ "ago_s": 0.0, "sequence": 4, "position_m": null, "sd_m": null });
    let with = |mut message: Value, name: &str, value: Value| {
        message[name] = value;
        message
    };
    let told = [
        // When, what, and whether it is a pose.
        (0.0, message(65_534, Some(65_534), 1.0), true),
        (0.1, message(65_535, Some(65_534), 1.0), false),
        (0.2, message(1, Some(0), 2.0), true),
        (0.3, message(0, Some(0), 2.0), false),
        (0.4, message(65_535, Some(65_534), 1.0), false),
        (0.5, message(2, Some(2), 3.0), true),
        (0.6, message(3, None, 0.0), false),
        (0.7, with(message(4, None, 0.0), "fix", none), false),
        (0.8, with(message(5, Some(5), 4.0), "is_conflict", true.into()), false),
        (0.9, message(6, Some(6), 5.0), true),
        // It has started anew: nobody can tell, until it was silent.
        (1.0, message(0, Some(0), 6.0), false),
        (5.8, message(1, Some(1), 7.0), false),
        (6.0, message(0, Some(0), 8.0), true),
        (6.1, message(1, Some(1), 9.0), true),
    ];
    let topic = || "lighthouse/4c48/7".to_owned();
    let mut said = vec![(0.0, "lighthouse/gateway/roof".to_owned(), "online".to_owned(), true)];
    said.push((0.0, topic(), message(65_535, Some(65_535), 0.5).to_string(), true));
    said.extend(told.iter().map(|(at_s, message, _)| (*at_s, topic(), message.to_string(), false)));
    let Some(poses) = poses(&said) else { return };
    let seen: Vec<&Value> = poses.iter().map(|pose| &pose["position_m"][0]).collect();
    let due: Vec<&Value> = told.iter().filter(|told| told.2).map(|told| &told.1["fix"]["position_m"][0]).collect();
    assert_eq!(seen, due);
}
