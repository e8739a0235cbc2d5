//! A guided session at a terminal, broken off and taken up again, in a simulated room and with a mote in the air.
#![cfg(unix)]

mod pty;
#[path = "calibrate/terminal.rs"]
mod terminal;

use std::collections::BTreeMap;
use std::fs::{self, OpenOptions};
use std::io::Write;
use std::num::NonZeroU32;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread::{JoinHandle, sleep, spawn};
use std::time::Duration;

use lighthouse_mote::frame::{self, Message};
use nalgebra::Vector3;
use sim::mote::Mote;
use sim::world::path::Path as MotePath;
use sim::world::{Scene, World};
use terminal::Terminal;
use xtask::calib::{firmware, schema};
use xtask::calibrate::points::{self, Point};
use xtask::calibrate::simulate::Simulated;
use xtask::pcap;

const DESK: &str = "seconds = 1\n[[point]]\nname = \"lamp\"\nposition = [0.4, 0.1, 0.3]\n\
    [[sheet]]\nname = \"A4\"\nsize = [0.297, 0.210]\nheights = [0.0, 0.15]\n";
/// The same, so slow that no place is finished before it is broken off.
fn slow() -> String {
    DESK.replace("seconds = 1\n", "seconds = 600\n")
}

/// Places in it.
const PLACES: usize = 9;

struct Desk {
    home: tempfile::TempDir,
    points: PathBuf,
    room: PathBuf,
}

impl Desk {
    fn new(list: &str) -> Self {
        let home = tempfile::tempdir().expect("a folder");
        let [points, room] = ["desk.toml", "lab.toml"].map(|name| home.path().join(name));
        fs::write(&points, list).expect("a list");
        Self { home, points, room }
    }

    /// Starts the session, or goes on with it.
    fn sit_down(&self, more: &[&str]) -> Terminal {
        let page = self.home.path().join("out/report.html");
        let [points, room, page] = [&self.points, &self.room, &page].map(|path| path.to_str().expect("a plain path"));
        Terminal::calibrate(&[&["--points", points, "-o", room, "--report", page], more].concat())
    }

    /// The files of the finished places.
    fn kept(&self, kind: &str) -> BTreeMap<PathBuf, Vec<u8>> {
        let folder = self.home.path().join("out").join(format!("{kind}-desk"));
        let files = fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("a file").path());
        files.map(|file| (file.clone(), fs::read(file).expect("its bytes"))).collect()
    }

    /// How far the room's stations are from these, metres.
    fn off_m(&self, stations_m: [[f64; 3]; 2]) -> [f64; 2] {
        let room = schema::open(&self.room).expect("a room that reads");
        firmware::bake("lab.toml", &room).expect("a room that bakes");
        let off = |n: usize| (Vector3::from(room.stations[n].position) - Vector3::from(stations_m[n])).norm();
        [off(0), off(1)]
    }
}

fn measure(terminal: &mut Terminal, place: usize) {
    terminal.until(&format!("place {place} of {PLACES}"));
    terminal.until("q: enough]");
    terminal.press("\n");
    terminal.until("kept: ");
}

#[test]
fn a_session_that_is_killed_goes_on_where_it_was() {
    // As Ctrl-C does; that signal itself is ignored where the tests were started in the background.
    for signal in ["TERM", "KILL"] {
        let desk = Desk::new(DESK);
        let mut terminal = desk.sit_down(&["--simulate"]);
        measure(&mut terminal, 1);
        measure(&mut terminal, 2);
        terminal.until("place 3 of");
        terminal.kill("KILL");
        let before = desk.kept("simulated");
        assert_eq!(before.len(), 2);
        // In the middle of the third.
        fs::write(&desk.points, slow()).expect("the list");
        let mut terminal = desk.sit_down(&["--simulate"]);
        terminal.until("place 3 of");
        terminal.press("\n");
        terminal.until("A az");
        terminal.kill(signal);
        assert_eq!(desk.kept("simulated"), before, "{signal}: what is done is there and whole, and nothing else");
        assert!(!desk.room.exists() && !desk.home.path().join("out/report.html").exists());

        fs::write(&desk.points, DESK).expect("the list");
        let mut terminal = desk.sit_down(&["--simulate"]);
        terminal.until("2 of them are there from before");
        (3..=PLACES).for_each(|place| measure(&mut terminal, place));
        let said = terminal.end();
        assert!(said.contains("This calibration can be trusted"), "{said}");
        assert!(!said.contains("place 1 of") && !said.contains("place 2 of"), "{said}");
        let after = desk.kept("simulated");
        assert!(after.len() == PLACES && before.iter().all(|(file, bytes)| after[file] == *bytes), "{signal}");
        let points = points::open(&desk.points).expect("a list");
        let simulated = Simulated::around(&points.points, 1, false).stations.map(|station| station.position_m);
        // 30 looks of 0.05 degrees at each place: 3 mm of station, as in the other sessions' tests with 60.
        let off_m = desk.off_m(simulated);
        assert!(off_m.iter().all(|off| *off < 0.015), "{off_m:?} m");
    }
}

#[test]
fn a_session_that_is_killed_at_the_question_loses_nothing() {
    let desk = Desk::new(DESK);
    let mut terminal = desk.sit_down(&["--simulate"]);
    measure(&mut terminal, 1);
    terminal.until("place 2 of");
    terminal.kill("TERM");
    let mut terminal = desk.sit_down(&["--simulate"]);
    terminal.until("1 of them are there from before");
    terminal.until("place 2 of");
    terminal.kill("KILL");
    assert_eq!(desk.kept("simulated").len(), 1);
}

/// A mote that sends its angles, and somebody who captures them.
struct Air {
    place: Arc<AtomicUsize>,
    there: Arc<AtomicUsize>,
    enough: Arc<AtomicBool>,
    mote: JoinHandle<u64>,
}

/// Mote time for which it lies before anybody presses Enter: the cycle is found within half a second, and what was
/// gathered at the place before is sent.
const SETTLED_S: f64 = 1.0;
/// Mote time between two looks at the air.
const LOOK_S: f64 = 0.1;

impl Air {
    /// Boots the mote at the first of `places`; what it sends goes to `file` as it comes.
    fn new(file: &Path, scene: Scene, places: Vec<Point>) -> Self {
        pcap::write(&[], &mut fs::File::create(file).expect("a capture")).expect("its head");
        let mut capture = OpenOptions::new().append(true).open(file).expect("the capture");
        let [place, there] = [(); 2].map(|()| Arc::new(AtomicUsize::new(usize::MAX)));
        let enough = Arc::new(AtomicBool::new(false));
        let (asked, reached, stop) = (place.clone(), there.clone(), enough.clone());
        let elf = angles_image();
        let mote = spawn(move || {
            let hz = scene.clock.nominal_hz * (1.0 + scene.clock.error);
            let mut mote = Mote::boot(&elf, NonZeroU32::new(hz.round() as u32).expect("a clock")).expect("an image");
            let (mut now, mut sent, mut high) = (0, 0, false);
            while !stop.load(Ordering::Relaxed) {
                let at = asked.load(Ordering::Relaxed);
                let Some(point) = places.get(at) else {
                    sleep(Duration::from_millis(5));
                    continue;
                };
                // Carried there in the dark.
                if high {
                    mote.push_edge(now + 1, false).expect("the end of a pulse");
                }
                high = false;
                let from = now + 1000;
                let path = MotePath::Still { at_m: point.position.into() };
                let mut world = World::new(&Scene { path, ..scene.clone() }, at as u64);
                let mut waiting = world.next_edge();
                let mut lain_s = 0.0;
                while asked.load(Ordering::Relaxed) == at && !stop.load(Ordering::Relaxed) {
                    lain_s += LOOK_S;
                    now = from + world.cycle(lain_s);
                    while let Some(edge) = waiting.filter(|edge| from + edge.cycle <= now) {
                        mote.push_edge(from + edge.cycle, edge.level).expect("light in order");
                        high = edge.level;
                        waiting = world.next_edge();
                    }
                    mote.run_until(now).expect("the firmware runs");
                    for frame in mote.take_frames().collect::<Vec<_>>() {
                        sent += u64::from(matches!(frame::parse(&frame.bytes), Ok((_, Message::Angles(_)))));
                        let mut bytes = Vec::new();
                        let frame = pcap::Frame { micros: frame.start_cycle / 10, bytes: frame.bytes };
                        pcap::write(&[frame], &mut bytes).expect("a frame");
                        // Behind the capture's head.
                        capture.write_all(&bytes[24..]).expect("it is captured");
                    }
                    if lain_s > SETTLED_S {
                        reached.store(at, Ordering::Relaxed);
                        // Faster than a clock on the wall, but not by so much that a busy computer is left behind.
                        sleep(Duration::from_millis(20));
                    }
                }
            }
            sent
        });
        Self { place, there, enough, mote }
    }

    fn carry_to(&self, place: usize) {
        self.place.store(place, Ordering::Relaxed);
        while self.there.load(Ordering::Relaxed) != place {
            assert!(!self.mote.is_finished(), "the mote has stopped");
            sleep(Duration::from_millis(5));
        }
    }
}

/// The firmware, told to send its angles.
fn angles_image() -> Vec<u8> {
    let target = "thumbv6m-none-eabi";
    let mut cargo = Command::new(env!("CARGO"));
    cargo.args(["build", "--release", "--bin", "scum3c", "--features", "scum3c", "--target", target]);
    cargo.current_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("..")).env_remove("LIGHTHOUSE_CALIB");
    cargo.env("LIGHTHOUSE_MOTE", "estimate = \"angles\"");
    assert!(cargo.status().expect("cargo runs").success(), "the image is not built");
    // This tool lies in a profile's folder of the same place.
    let built = Path::new(env!("CARGO_BIN_EXE_xtask")).ancestors().nth(2).expect("where cargo builds");
    fs::read(built.join(target).join("release/scum3c")).expect("the image")
}

/// Places in the light of the default scene.
const BEFORE_THE_STATIONS: &str = "seconds = 2\n[[point]]\nname = \"stool\"\nposition = [0.55, 1.05, 0.8]\n\
    [[sheet]]\nname = \"board\"\nsize = [0.5, 0.4]\ncorner = [0.3, 0.85]\nheights = [0.65, 1.0]\n";

#[test]
fn a_mote_that_sends_its_angles_is_led_to_the_places_and_finds_the_stations() {
    let desk = Desk::new(BEFORE_THE_STATIONS);
    let file = desk.home.path().join("air.pcap");
    let scene = Scene::default();
    let stations_m = [scene.station_a.position_m, scene.station_b.position_m];
    let air = Air::new(&file, scene, points::open(&desk.points).expect("a list").points);
    air.carry_to(0);
    let frames = ["--frames", file.to_str().expect("a plain path")];
    let mut terminal = desk.sit_down(&frames);
    for place in 1..=PLACES {
        air.carry_to(place - 1);
        measure(&mut terminal, place);
        if place == 4 {
            terminal.until("place 5 of");
            terminal.kill("TERM");
            terminal = desk.sit_down(&frames);
            terminal.until("4 of them are there from before");
        }
    }
    let said = terminal.end();
    air.enough.store(true, Ordering::Relaxed);
    let sent = air.mote.join().expect("a mote that ran to the end");
    assert!(sent > 100, "{sent} frames with angles");
    assert!(said.contains("This calibration can be trusted"), "{said}");
    assert_eq!(desk.kept("points").len(), PLACES);
    // 60 looks of 0.035 degrees and the receiver's jitter at each place leave a tenth of a millirad, and 0.5 m of places
    // at 0.8 m lever that, and what phases take up of it, to a millimetre.
    let off_m = desk.off_m(stations_m);
    println!("stations are {off_m:?} m off");
    assert!(off_m.iter().all(|off| *off < 0.005), "{off_m:?} m");
}
