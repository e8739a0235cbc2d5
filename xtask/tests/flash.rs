//! From a build to a chip: the programmers' side is played, the mote's is the virtual SCuM-3C.
#![cfg(unix)]

#[path = "flash/player.rs"]
mod player;
mod pty;

use std::io::{Cursor, Write};
use std::num::NonZeroU32;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use anyhow::{Result, bail};
use lighthouse_mote::frame;
use lighthouse_mote::identity::{Block, Identity, READS_ADDRESS, emit};
use player::{Mischief, Player, Taken, line, nrf_dk, teensy};
use serialport::{SerialPortInfo, SerialPortType, UsbPortInfo};
use sim::mote::Mote;
use sim::world::{Scene, World};
use xtask::flash::identity::{self, Change, Fixed};
use xtask::flash::image::{self, Image, Unfit};
use xtask::flash::line::Line;
use xtask::flash::port::{self, Programmer};
use xtask::flash::probe_rs::ProbeRs;
use xtask::flash::teensy::Way;
use xtask::flash::tray::{self, Ids};
use xtask::flash::{Timing, nrf_dk as to_nrf_dk, teensy as to_teensy};

/// Each step may take so long.
const fn each(limit: Duration) -> Timing {
    Timing { answer: limit, boot: limit, check: Duration::ZERO, calibration: limit }
}

/// Where a test waits for something that does not come; what comes before it has to come in time on a busy computer.
const SHORT: Timing = each(Duration::from_secs(5));
/// Where something has to come.
const LONG: Timing = each(Duration::from_secs(60));
/// A Teensy does not say when it has calibrated: the time is waited for.
const LONG_SILENT: Timing = Timing { calibration: Duration::ZERO, ..LONG };

// --- programs ---

/// An ELF file with these load segments: (load address, address, bytes).
fn elf(segments: &[(u32, u32, &[u8])]) -> Vec<u8> {
    let (header, each) = (52, 32);
    let mut file = b"\x7fELF\x01\x01\x01\0\0\0\0\0\0\0\0\0".to_vec();
    let half = |file: &mut Vec<u8>, values: &[u16]| file.extend(values.iter().flat_map(|value| value.to_le_bytes()));
    let word = |file: &mut Vec<u8>, values: &[u32]| file.extend(values.iter().flat_map(|value| value.to_le_bytes()));
    // Executable, for Arm.
    half(&mut file, &[2, 40]);
    word(&mut file, &[1, 0, header, 0, 0]);
    half(&mut file, &[header as u16, each as u16, segments.len() as u16, 40, 0, 0]);
    let mut at = header + each * segments.len() as u32;
    for (load, run, bytes) in segments {
        word(&mut file, &[1, at, *run, *load, bytes.len() as u32, bytes.len() as u32, 5, 4]);
        at += bytes.len() as u32;
    }
    file.extend(segments.iter().flat_map(|(_, _, bytes)| bytes.iter()));
    file
}

/// A program of `bytes` bytes in which every byte value occurs, those that a line could stumble over among them.
fn some_program(bytes: usize) -> Vec<u8> {
    (0..bytes).map(|n| (n * 7 + n / 256) as u8).collect()
}

fn some_image() -> Image {
    image::package(&elf(&[(0, 0, &some_program(24_321))])).expect("a program that fits")
}

#[test]
fn an_image_has_its_program_its_zeros_its_length_and_its_crc() {
    let (code, data) = (some_program(1001), [0xA5; 7]);
    let image = image::package(&elf(&[(0, 0, &code), (1004, 0x2000_0000, &data)])).expect("it fits");
    let bytes = image.bytes();
    assert_eq!(bytes.len(), 65_536);
    assert_eq!((&bytes[..1001], &bytes[1001..1004], &bytes[1004..1011]), (&code[..], &[0; 3][..], &data[..]));
    assert!(bytes[1011..0xFFF8].iter().all(|byte| *byte == 0));
    assert_eq!(bytes[0xFFF8..0xFFFC], 1012_u32.to_le_bytes());
    assert_eq!(image.length(), 1012);
    assert_eq!(image::verify(bytes), Ok(1012));
    // By zlib.
    let nine = image::package(&elf(&[(0, 0, b"123456789")])).expect("it fits");
    assert_eq!((nine.length(), nine.crc()), (12, 0x77D5_5834));
}

#[test]
fn a_byte_that_changes_on_the_way_is_noticed() {
    let image = some_image();
    let damaged = |at: usize| {
        let mut bytes = image.bytes().to_vec();
        bytes[at] ^= 1;
        image::verify(&bytes)
    };
    for at in [0, 1, 24_320, 24_323, 0xFFFC] {
        assert!(matches!(damaged(at), Err(Unfit::Crc { .. })), "{at}");
    }
    assert_eq!(damaged(30_000), Err(Unfit::Leftover { address: 30_000 }));
    assert!(matches!(damaged(0xFFF8), Err(Unfit::Length(_))));
    assert_eq!(image::verify(&image.bytes()[1..]), Err(Unfit::NotWhole { bytes: 65_535 }));
}

#[test]
fn what_does_not_fit_is_refused_with_numbers() {
    let full = some_program(65_528);
    assert_eq!(image::package(&elf(&[(0, 0, &full)])).map(|image| image.length()), Ok(65_528));
    let said = image::package(&elf(&[(0, 0, &full), (65_528, 0x2000_0000, &[1, 2, 3])])).expect_err("three too many");
    assert_eq!(said.to_string(), "the image is too large: 65531 bytes, 3 more than the 65528 that the code RAM holds");
    let said = image::package(&elf(&[(0x2000_0000, 0x2000_0000, &[1, 2])])).expect_err("no code RAM there");
    assert_eq!(said, Unfit::Outside { address: 0x2000_0000, bytes: 2 });
    assert!(matches!(image::package(b"no program"), Err(Unfit::Elf(_))));
}

// --- identity ---

const BAKED: Identity = Identity { mote: 1, pan: 0x4C48, channel: 0 };

fn program_with(block: &[u8]) -> Vec<u8> {
    elf(&[(0, 0, &[&some_program(100)[..], block, &some_program(20)].concat())])
}

#[test]
fn another_id_changes_the_block_and_nothing_else() {
    let before = program_with(&emit(BAKED, READS_ADDRESS));
    let after = identity::patch(&before, Change { mote: Some(0xBEEF), ..Change::default() }).expect("a block");
    assert_eq!(identity::read(&after), Ok(Identity { mote: 0xBEEF, ..BAKED }));
    let changed: Vec<u8> = before.iter().zip(&after).filter(|(a, b)| a != b).map(|(_, b)| *b).collect();
    assert_eq!(changed, 0xBEEF_u16.to_le_bytes());
    assert_eq!(identity::patch(&after, Change { mote: Some(1), ..Change::default() }), Ok(before));
}

#[test]
fn a_block_says_what_its_firmware_says() {
    static BLOCK: Block = Block::new(Identity { mote: 0x1234, pan: 0x5678, channel: 20 }, READS_ADDRESS);
    assert_eq!(BLOCK.read(), Identity { mote: 0x1234, pan: 0x5678, channel: 20 });
}

#[test]
fn a_program_that_cannot_be_another_mote_says_why() {
    let ask = Change { mote: Some(2), ..Change::default() };
    let block = emit(BAKED, READS_ADDRESS);
    let refused = |program: &[u8], change| identity::patch(program, change).expect_err("not to be changed");
    assert_eq!(refused(&program_with(&[]), ask), Fixed::None);
    assert_eq!(refused(&program_with(&[block, block].concat()), ask), Fixed::Several(2));
    let mut old = block;
    old[8] = 7;
    assert_eq!(refused(&program_with(&old), ask), Fixed::Version(7));
    let channel = Change { channel: Some(20), ..Change::default() };
    assert_eq!(refused(&program_with(&block), channel), Fixed::NotRead("channel"));
    assert_eq!(identity::patch(&program_with(&[]), Change::default()), Ok(program_with(&[])));
}

// --- programmers ---

/// Programs through a played nRF52840-DK; what the tool says, and what the player took.
fn with_nrf_dk(player: (String, Player), timing: &Timing) -> (Result<()>, Taken, Vec<usize>) {
    let (port, player) = player;
    let player = player.play(nrf_dk);
    let mut seen = Vec::new();
    let done = Line::open(&port, to_nrf_dk::BAUD)
        .map_err(anyhow::Error::from)
        .and_then(|mut line| to_nrf_dk::program(&mut line, &some_image(), timing, &mut |sent| seen.push(sent)));
    (done, player.join().expect("the player found nothing wrong"), seen)
}

fn mischief(at: usize, mischief: Mischief) -> (String, Player) {
    let (port, mut player) = line();
    player.mischief = Some((at, mischief));
    (port, player)
}

fn complaint(done: Result<()>) -> String {
    format!("{:#}", done.expect_err("something went wrong"))
}

/// What goes wrong at which answer, and how the complaint begins.
type Case = (usize, Mischief, &'static str);

/// Plays every case, all at a time, for some are waited out.
fn each_is_told(cases: &[Case], program: impl Fn((String, Player), &Timing) -> Result<()> + Sync) {
    std::thread::scope(|scope| {
        for (at, what, says) in cases {
            let program = &program;
            scope.spawn(move || {
                // Only of silence does a limit tell.
                let waits = match what {
                    Mischief::Silence | Mischief::Late(_) => true,
                    Mischief::Say(bytes) => !bytes.ends_with(b"\n"),
                    Mischief::Dribble | Mischief::Vanish => false,
                };
                let said = complaint(program(mischief(*at, what.clone()), if waits { &SHORT } else { &LONG }));
                assert!(said.starts_with(says), "{at}, {what:?}: {said}");
            });
        }
    });
}

#[test]
fn an_nrf_dk_gets_every_byte_and_every_command() {
    let (done, taken, seen) = with_nrf_dk(line(), &LONG);
    done.expect("nothing went wrong");
    assert!(taken.booted && taken.calibrated);
    assert!(taken.memory == some_image().bytes());
    assert_eq!((seen.len(), seen.first(), seen.last()), (65, Some(&0), Some(&65_536)));
}

#[test]
fn an_nrf_dk_that_is_slow_but_right_is_waited_for() {
    for slow in [Mischief::Late(Duration::from_millis(700)), Mischief::Dribble] {
        let (done, taken, _) = with_nrf_dk(mischief(30, slow), &LONG);
        done.expect("nothing went wrong");
        assert!(taken.memory == some_image().bytes());
    }
}

#[test]
fn an_nrf_dk_that_takes_seven_bytes_at_a_time_gets_them_all() {
    let (port, mut player) = line();
    player.gulp = 7;
    let (done, taken, _) = with_nrf_dk((port, player), &LONG);
    done.expect("nothing went wrong");
    assert!(taken.memory == some_image().bytes());
}

#[test]
fn an_answer_from_before_is_not_taken_for_one() {
    let (port, mut player) = line();
    player.noise(b"ACK\nERROR\nACK\n");
    let (done, taken, _) = with_nrf_dk((port, player), &LONG);
    done.expect("nothing went wrong");
    assert!(taken.memory == some_image().bytes());
}

#[test]
fn an_nrf_dk_that_misbehaves_is_told_from_one_that_misbehaves_otherwise() {
    // Answer 0 is START's, 1 to 64 are the chunks', 65 is BOOT's, 66 CALIBRATE's.
    let cases = [
        (0, Mischief::Silence, "resetting the mote: no answer within 5 s"),
        (0, Mischief::Say(b"ERROR\n"), "resetting the mote: the programmer answered \"ERROR\" instead of \"ACK\""),
        (11, Mischief::Silence, "after 10240 of 65536 bytes: no answer within 5 s"),
        // Not waited for, or this takes an hour.
        (11, Mischief::Late(Duration::from_secs(3600)), "after 10240 of 65536 bytes: no answer within 5 s"),
        (11, Mischief::Say(b"AC"), "after 10240 of 65536 bytes: the answer broke off after \"AC\""),
        (11, Mischief::Say(b"\xf0\x00\x13\n"), "after 10240 of 65536 bytes: garbage instead of an answer (f0 00 13)"),
        (11, Mischief::Say(b"\xf0\x00ACK\n"), "after 10240 of 65536 bytes: garbage instead of an answer"),
        (11, Mischief::Vanish, "after 10240 of 65536 bytes: the programmer went away"),
        (65, Mischief::Silence, "booting the mote: no answer"),
        (66, Mischief::Vanish, "calibrating the mote: the programmer went away"),
    ];
    each_is_told(&cases, |player, timing| with_nrf_dk(player, timing).0);
}

/// As [`with_nrf_dk`], through a Teensy.
fn with_teensy(player: (String, Player), way: Way, timing: &Timing) -> (Result<()>, Taken) {
    let (port, player) = player;
    let player = player.play(teensy);
    let done = Line::open(&port, to_teensy::BAUD)
        .map_err(anyhow::Error::from)
        .and_then(|mut line| to_teensy::program(&mut line, &some_image(), way, timing, &mut |_| {}));
    (done, player.join().expect("the player found nothing wrong"))
}

#[test]
fn a_teensy_gets_every_byte_and_finds_the_same_crc() {
    for way in [Way::Light, Way::Wire] {
        let (done, taken) = with_teensy(line(), way, &LONG_SILENT);
        done.expect("nothing went wrong");
        assert!(taken.booted && taken.calibrated);
        // Its own CRC has been written over the tool's.
        assert!(taken.memory == some_image().bytes(), "{way:?}");
    }
}

#[test]
fn a_teensy_that_announces_its_boot_is_understood() {
    let announced = Mischief::Say(b"Executing 3wb Bootload\r\n3WB Bootload Complete\r\n");
    let (done, taken) = with_teensy(mischief(1, announced), Way::Wire, &LONG_SILENT);
    done.expect("nothing went wrong");
    assert!(taken.calibrated);
}

#[test]
fn a_teensy_that_misbehaves_is_told_from_one_that_misbehaves_otherwise() {
    let cases = [
        (0, Mischief::Silence, "asking for the transfer: no answer within 5 s"),
        (
            0,
            Mischief::Say(b"what?\r\n"),
            "asking for the transfer: the programmer answered \"what?\" instead of \"Executing SRAM Transfer\"",
        ),
        (0, Mischief::Say(b"\x80\x80\x80\n"), "asking for the transfer: garbage instead of an answer (80 80 80)"),
        (1, Mischief::Silence, "booting the mote: no answer within 5 s"),
        (
            1,
            Mischief::Say(b"Error: Invalid packet format\r\n"),
            "booting the mote: the programmer answered \"Error: Invalid packet format\"",
        ),
        (1, Mischief::Vanish, "booting the mote: the programmer went away"),
    ];
    each_is_told(&cases, |player, timing| with_teensy(player, Way::Light, timing).0);
}

#[test]
fn a_teensy_that_is_unplugged_in_the_transfer_is_missed() {
    let (port, player) = line();
    let player = player.play(|player| {
        player.text();
        player.answer(b"Executing SRAM Transfer - SCM3B Rev 2\r\n");
        player.bytes(20_000);
    });
    let mut line = Line::open(&port, to_teensy::BAUD).expect("a line");
    let said = complaint(to_teensy::program(&mut line, &some_image(), Way::Light, &LONG, &mut |_| {}));
    drop(line);
    player.join().expect("the player found nothing wrong");
    assert!(said.starts_with("after ") && said.contains("of 65536 bytes: the programmer went away"), "{said}");
}

#[test]
fn a_port_that_is_not_there_or_taken_says_so() {
    let refused = |port: &str| Line::open(port, 19_200).err().expect("it does not open").to_string();
    let said = refused("/dev/no-such-port");
    assert!(said.starts_with("/dev/no-such-port: no such port"), "{said}");
    let (port, _player) = line();
    let _first = Line::open(&port, 19_200).expect("nobody has it yet");
    let said = refused(&port);
    assert!(said.starts_with(&format!("{port}: in use by another program")), "{said}");
}

// --- which programmer ---

fn usb(name: &str, vid: u16, pid: u16, serial: &str) -> SerialPortInfo {
    let serial_number = Some(serial.to_owned());
    let usb = UsbPortInfo { vid, pid, serial_number, manufacturer: None, product: None };
    SerialPortInfo { port_name: name.to_owned(), port_type: SerialPortType::UsbPort(usb) }
}

#[test]
fn programmers_are_known_by_their_usb_numbers() {
    let plain = SerialPortInfo { port_name: "/dev/ttyS0".into(), port_type: SerialPortType::Unknown };
    let dk = [usb("/dev/ttyACM1", 0x1366, 0x1051, "683"), usb("/dev/ttyACM0", 0x1366, 0x1051, "683")];
    let teensy = usb("/dev/ttyACM2", 0x16C0, 0x0483, "391");
    let other = usb("/dev/ttyUSB0", 0x0403, 0x6001, "FT1");
    let found = |ports: &[SerialPortInfo], asked| port::choose(ports, None, asked, None);

    let one = found(&[plain.clone(), other.clone(), dk[0].clone(), dk[1].clone()], None).expect("one board");
    assert_eq!((one.programmer, one.port.as_str()), (Programmer::Nrf, "/dev/ttyACM0"));

    let both = [dk[0].clone(), teensy.clone()];
    assert_eq!(found(&both, Some(Programmer::Teensy)).expect("one Teensy").port, "/dev/ttyACM2");
    let said = found(&both, None).expect_err("two").to_string();
    assert_eq!(said, "several programmers: /dev/ttyACM1 (nrf), /dev/ttyACM2 (teensy); name one with --port");
    let answered = |answer: &str| port::choose(&both, None, None, Some(&mut Cursor::new(answer.to_owned())));
    assert_eq!(answered("2\n").expect("the second").programmer, Programmer::Teensy);
    assert_eq!(answered("\n").expect("the first").programmer, Programmer::Nrf);
    assert_eq!(answered("3\n").expect_err("there is no third").to_string(), "\"3\" is none of 1 ..= 2");

    let said = found(&[plain, other], None).expect_err("none").to_string();
    assert!(said.starts_with("no programmer found") && said.contains("(/dev/ttyS0, /dev/ttyUSB0)"), "{said}");
    let said = port::choose(&both, Some("/dev/pts/9"), None, None).expect_err("unknown").to_string();
    assert!(said.starts_with("/dev/pts/9 does not tell what is behind it"), "{said}");
    assert_eq!(
        port::choose(&both, Some("/dev/ttyACM2"), None, None).expect("it is there").programmer,
        Programmer::Teensy
    );
}

// --- trays ---

fn walk(ids: &str, typed: &str, mut program: impl FnMut(u16) -> Result<()>) -> (tray::Outcome, String) {
    let mut said = Vec::new();
    let ids: Ids = ids.parse().expect("good ids");
    let outcome = tray::walk(&ids, &mut Cursor::new(typed.to_owned()), &mut said, &mut program).expect("a terminal");
    (outcome, String::from_utf8(said).expect("text"))
}

#[test]
fn a_tray_is_walked_mote_by_mote() {
    let mut programmed = Vec::new();
    let (outcome, said) = walk("1..3,9", "\n\n\n\n", |id| {
        programmed.push(id);
        Ok(())
    });
    assert_eq!(programmed, [1, 2, 3, 9]);
    assert_eq!(outcome.done, [1, 2, 3, 9]);
    assert!(said.contains("mote 3 of 4, id 3: connect it and press Enter"), "{said}");
    let mut summary = Vec::new();
    outcome.conclude(&mut summary, "again").expect("nothing is left");
    assert_eq!(String::from_utf8_lossy(&summary), "4 of 4 motes programmed: ids 1..3,9\n");
}

#[test]
fn a_mote_that_fails_is_tried_again_or_skipped_and_the_rest_can_be_resumed() {
    let mut attempts = Vec::new();
    // Mote 1; mote 2 fails twice and is skipped; mote 3 fails once; mote 4 is skipped; mote 5 is never reached.
    let (outcome, said) = walk("1..6", "\n\n\ns\n\nhm\n\ns\nq\n", |id| {
        attempts.push(id);
        match attempts.iter().filter(|tried| **tried == id).count() {
            1 | 2 if id == 2 => bail!("dead"),
            1 if id == 3 => bail!("loose"),
            _ => Ok(()),
        }
    });
    assert_eq!(attempts, [1, 2, 2, 3, 3]);
    assert_eq!(outcome.done, [1, 3]);
    assert!(said.contains("\"hm\" is not one of Enter, s and q"), "{said}");
    assert!(said.contains("id 2: press Enter to try again"), "{said}");
    let mut summary = Vec::new();
    let left = outcome.conclude(&mut summary, "cargo xtask flash scum3c").expect_err("some are left").to_string();
    assert_eq!(left, "4 of 6 motes are left; go on with: cargo xtask flash scum3c --ids 2,4..6");
    let summary = String::from_utf8_lossy(&summary);
    assert!(summary.contains("ids 1,3\nid 2 is left: dead\nid 4 is left: not tried\n"), "{summary}");
}

#[test]
fn nobody_at_the_terminal_is_a_stop() {
    let (outcome, _) = walk("1..3", "\n", |_| Ok(()));
    assert_eq!(outcome.done, [1]);
    assert_eq!(outcome.left, [(2, None), (3, None)]);
}

#[test]
fn ids_are_read_as_they_are_written() {
    for text in ["1..20", "7", "1..3,9,11..12", "0..2", "65533"] {
        assert_eq!(text.parse::<Ids>().expect("good ids").to_string(), text);
    }
    assert_eq!("4..=6".parse::<Ids>().expect("good ids").list(), [4, 5, 6]);
}

// --- probe-rs ---

/// A `probe-rs` that writes down what it is called with and does `then`.
fn fake_probe_rs(folder: &Path, then: &str) -> ProbeRs {
    let program = folder.join("probe-rs");
    let script = format!("#!/bin/sh\nprintf '%s\\n' \"$*\" >> '{}/calls'\n{then}\n", folder.display());
    // Written by another process: what another thread starts just then inherits a file that is open here, and a program
    // that is open for writing does not start ("text file busy").
    let mut write = Command::new("sh");
    write.args(["-c", "printf %s \"$1\" > \"$0\" && chmod 755 \"$0\""]).arg(&program).arg(script);
    assert!(write.status().expect("a shell").success());
    ProbeRs { program, limit: Duration::from_secs(60) }
}

#[test]
fn probe_rs_is_told_chip_and_file() {
    let folder = tempfile::tempdir().expect("a folder");
    let probe_rs = fake_probe_rs(folder.path(), "exit 0");
    probe_rs.ensure_installed().expect("it runs");
    probe_rs.program(Path::new("a mote.elf")).expect("it is content");
    let calls = std::fs::read_to_string(folder.path().join("calls")).expect("it was called");
    assert_eq!(
        calls,
        "--version\n\
         download --non-interactive --chip nRF52840_xxAA --verify a mote.elf\n\
         reset --non-interactive --chip nRF52840_xxAA\n"
    );
}

#[test]
fn a_probe_rs_that_fails_hangs_or_is_missing_says_so() {
    let folder = tempfile::tempdir().expect("a folder");
    let said = complaint(fake_probe_rs(folder.path(), "exit 1").program(Path::new("mote.elf")));
    assert!(said.starts_with("probe-rs download") && said.contains("exit status: 1"), "{said}");
    let calls = std::fs::read_to_string(folder.path().join("calls")).expect("it was called");
    assert_eq!(calls.lines().count(), 1, "a mote that was not written is not started");

    let hanging = ProbeRs { limit: Duration::from_millis(300), ..fake_probe_rs(folder.path(), "exec sleep 60") };
    let said = complaint(hanging.program(Path::new("mote.elf")));
    assert!(said.ends_with("ended after 0.3 s without result"), "{said}");

    let missing = ProbeRs { program: folder.path().join("none"), ..ProbeRs::default() };
    let said = complaint(missing.ensure_installed());
    assert!(said.contains("probe-rs is not installed") && said.contains("cargo install probe-rs-tools"), "{said}");
}

// --- the verb ---

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn verb(arguments: &[&str]) -> Output {
    let mut xtask = Command::new(env!("CARGO_BIN_EXE_xtask"));
    xtask.arg("flash").args(arguments).current_dir(root()).env_remove("LIGHTHOUSE_CALIB");
    xtask.output().expect("the tool runs")
}

#[test]
fn bad_arguments_are_refused_before_anything_is_built() {
    for (arguments, says) in [
        (&["scum3c", "--id", "70000"][..], "70000 is no mote id: 0 ..= 65533"),
        (&["scum3c", "--id", "65534"], "65534 is no mote id"),
        (&["scum3c", "--id", "-3"], "-3"),
        (&["scum3c", "--id", "one"], "\"one\" is no mote id"),
        (&["scum3c", "--ids", "5..1"], "5..1 counts backwards: 1..5"),
        (&["scum3c", "--ids", "1..4,3"], "names an id twice"),
        (&["scum3c", "--ids", "1..70000"], "70000 is no mote id"),
        (&["scum3c", "--id", "1", "--ids", "1..2"], "cannot be used with"),
        (&["scum3d"], "invalid value 'scum3d'"),
        (&["scum3c", "--channel", "10"], "10 is no channel"),
        (&["scum3c", "--channel", "27"], "27 is no channel"),
        (&["scum3c", "--programmer", "jtag"], "invalid value 'jtag'"),
        (&["scum3c", "--programmer", "nrf", "--wired"], "--wired is for a Teensy"),
        (&["nrf52840", "--port", "/dev/ttyACM0"], "--port, --programmer and --wired are for the SCuM-3C"),
        (&["scum3c", "--calib", "no.toml"], "no.toml: cannot be read"),
        (&["scum3c", "--port", "/dev/no-such-port", "--programmer", "nrf"], "/dev/no-such-port: no such port"),
        (&["scum3c", "--port", "/dev/no-such-port"], "does not tell what is behind it"),
    ] {
        let output = verb(arguments);
        let (said, printed) = (String::from_utf8_lossy(&output.stderr), String::from_utf8_lossy(&output.stdout));
        assert!(!output.status.success(), "{arguments:?}");
        assert!(said.contains(says), "{arguments:?}: {said}");
        assert!(!printed.contains("cargo"), "{arguments:?} built something: {printed}");
    }
}

/// Builds go to one place: what one has built, another with other words would build anew before it is read.
static BUILDING: Mutex<()> = Mutex::new(());

/// The verb at work on a played nRF52840-DK: what each mote received.
fn flashed(arguments: &[&str], motes: usize, typed: &[u8]) -> (Output, Vec<Taken>) {
    let _alone = BUILDING.lock().unwrap_or_else(PoisonError::into_inner);
    let (port, mut player) = line();
    player.reopened = true;
    let player = player.play(move |player| (0..motes).map(|_| nrf_dk(player)).collect());
    let mut xtask = Command::new(env!("CARGO_BIN_EXE_xtask"));
    xtask.args(["flash", "scum3c", "--programmer", "nrf", "--port", &port]).args(arguments);
    xtask.current_dir(root()).env_remove("LIGHTHOUSE_CALIB");
    let mut tool =
        xtask.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("the tool starts");
    tool.stdin.take().expect("it listens").write_all(typed).expect("it reads");
    let output = tool.wait_with_output().expect("the tool ends");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    (output, player.join().expect("the player found nothing wrong"))
}

/// The frames that a mote with this code RAM sends in the default scene, as (header, error in metres).
fn heard(memory: &[u8], seconds: f64) -> Vec<(frame::Header, f64)> {
    let mut world = World::new(&Scene { length_s: seconds, ..Scene::default() }, 1);
    let clock = &world.scene().clock;
    let hclk = NonZeroU32::new((clock.nominal_hz * (1.0 + clock.error)).round() as u32).expect("a clock that runs");
    let mut mote = Mote::boot_image(memory, hclk).expect("an image that fits");
    let end = world.cycle(seconds);
    while let Some(edge) = world.next_edge().filter(|edge| edge.cycle < end) {
        mote.push_edge(edge.cycle, edge.level).expect("light comes in order");
    }
    mote.run_until(end).expect("the firmware runs");
    mote.take_frames()
        .collect::<Vec<_>>()
        .into_iter()
        .filter_map(|sent| {
            let (header, message) = frame::parse(&sent.bytes).expect("our frames");
            let frame::Message::Fix(report) = message else { return None };
            let sighted = mote.cycle_of(report.time).expect("a timer that counts");
            let error =
                world.truth(sighted).into_iter().zip(report.position.map(f64::from)).map(|(a, b)| (a - b).powi(2));
            Some((header, error.sum::<f64>().sqrt()))
        })
        .collect()
}

#[test]
fn what_a_programmer_received_boots_as_the_mote_asked_for_and_finds_itself() {
    let (output, taken) = flashed(&["--ids", "48879,7"], 2, b"\n\n");
    let printed = String::from_utf8_lossy(&output.stdout);
    assert!(printed.contains("mote 2 of 2, id 7: done\n"), "{printed}");
    assert!(printed.contains("2 of 2 motes programmed: ids 48879,7\n"), "{printed}");
    assert_eq!(printed.matches("$ cargo build").count(), 1, "one build for all: {printed}");
    for (taken, id) in taken.iter().zip([48_879, 7]) {
        assert!(taken.booted && taken.calibrated);
        image::verify(&taken.memory).expect("a whole image");
        let heard = heard(&taken.memory, 3.0);
        // The cycle is found within half a second, and then there are 15 reports in each.
        assert!(heard.len() > 35, "{} frames", heard.len());
        assert!(heard.iter().all(|(header, _)| (header.mote, header.pan) == (id, 0x4C48)), "{:?}", heard.first());
        // Ten times the simulated room's 3-D RMS of 0.15 cm.
        let (_, error) = heard.last().expect("frames");
        assert!(*error < 0.015, "{error} m");
    }
    let differing = taken[0].memory.iter().zip(&taken[1].memory).filter(|(a, b)| a != b).count();
    assert!(differing <= 2 + 4, "id and CRC, but {differing} bytes differ");
}

#[test]
fn a_room_names_the_mote_that_nobody_names() {
    let (_, taken) = flashed(&[], 1, b"");
    let heard = heard(&taken[0].memory, 1.5);
    // The cycle is found within half a second, and then there are 15 reports in each.
    assert!(heard.len() > 10, "{} frames", heard.len());
    assert!(heard.iter().all(|(header, _)| header.mote == 1), "{:?}", heard.first());
}
