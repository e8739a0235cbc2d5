//! QEMU, written by others, judges the core.
//!
//! One program runs on QEMU's Cortex-M0 and on ours, with instruction sequences made up from a seed. Every line it
//! prints must be the same, among them how many instructions each part took.
//!
//! What can go wrong: without `qemu-system-arm` there is no judgement; the test then says so and passes. QEMU knows
//! nothing of cycles; those are in the tests of the core. QEMU 7.2 prints SYS_WRITE0 to its standard error; another
//! version that prints it elsewhere shows up as a difference in the first line.

#[path = "judge/host/sequences.rs"]
mod sequences;
#[path = "judge/host/timer.rs"]
mod timer;

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use sim::core::cycles::Timing;
use sim::machine::{Config, Machine, Stop};
use sim::memory::MemoryMap;

const SEEDS: std::ops::Range<u64> = 0..6;
const SEQUENCES_AT: u32 = 0x2_0000;
const PATIENCE: Duration = Duration::from_secs(50);

fn build_program() -> Vec<u8> {
    let manifest = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/judge/Cargo.toml");
    let built = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("judge");
    let status = Command::new(env!("CARGO"))
        .args(["build", "--release", "--quiet", "--target", "thumbv6m-none-eabi"])
        .arg("--manifest-path")
        .arg(manifest)
        .arg("--target-dir")
        .arg(&built)
        .env_remove("RUSTFLAGS")
        .env_remove("CARGO_ENCODED_RUSTFLAGS")
        .status()
        .expect("cargo runs");
    assert!(status.success(), "the judge's program does not build");
    std::fs::read(built.join("thumbv6m-none-eabi/release/judge")).expect("the program was built")
}

fn qemu_is_missing() -> bool {
    Command::new("qemu-system-arm").arg("--version").stdout(Stdio::null()).status().is_err()
}

fn run_on_qemu(program: &[u8], blob: &[u8], name: &str) -> String {
    let folder = PathBuf::from(env!("CARGO_TARGET_TMPDIR"));
    let path = |kind: &str| folder.join(format!("{name}.{kind}"));
    std::fs::write(path("elf"), program).expect("the folder for temporary files is writable");
    std::fs::write(path("blob"), blob).expect("the folder for temporary files is writable");
    let output = File::create(path("output")).expect("the folder for temporary files is writable");
    let mut qemu = Command::new("qemu-system-arm")
        .args(["-M", "microbit", "-nographic", "-monitor", "none", "-serial", "null"])
        .args(["-icount", "shift=10,sleep=off", "-semihosting-config", "enable=on,target=native"])
        .arg("-device")
        .arg(format!("loader,file={},addr={SEQUENCES_AT:#x},force-raw=on", path("blob").display()))
        .arg("-kernel")
        .arg(path("elf"))
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(output)
        .spawn()
        .expect("QEMU starts");
    let began = Instant::now();
    let status = loop {
        match qemu.try_wait().expect("QEMU can be waited for") {
            Some(status) => break status,
            None if began.elapsed() > PATIENCE => {
                qemu.kill().expect("QEMU can be killed");
                panic!("the program does not end in QEMU");
            }
            None => std::thread::sleep(Duration::from_millis(10)),
        }
    };
    assert!(status.success(), "QEMU ended with {status}");
    std::fs::read_to_string(path("output")).expect("the program prints text")
}

fn run_on_sim(program: &[u8], blob: &[u8]) -> String {
    let config = Config {
        memory: MemoryMap::MICROBIT,
        timing: Timing::Uniform,
        fault_is_fatal: false,
        semihosting: true,
        ..Config::default()
    };
    let mut machine = Machine::new(config, timer::Timer::default());
    machine.load_elf(program).expect("the program fits the chip");
    machine.write_bytes(SEQUENCES_AT, blob).expect("the sequences fit the flash");
    let stop = machine.run_until(1_000_000_000);
    let output = String::from_utf8(machine.semihosting.output).expect("the program prints text");
    assert_eq!(stop, Stop::Exit(0), "after {output}");
    output
}

#[test]
fn qemu_and_the_sim_print_the_same_and_count_the_same_instructions() {
    if qemu_is_missing() {
        println!("skipped: qemu-system-arm is not installed");
        return;
    }
    let program = build_program();
    for seed in SEEDS {
        let blob = sequences::blob(seed);
        let theirs = run_on_qemu(&program, &blob, &format!("judge-{seed}"));
        let ours = run_on_sim(&program, &blob);
        assert!(!theirs.is_empty(), "QEMU printed nothing to its standard error");
        for (line, (theirs, ours)) in theirs.lines().zip(ours.lines()).enumerate() {
            assert_eq!(theirs, ours, "line {line}, seed {seed}: QEMU's first, then ours");
        }
        assert_eq!(theirs.len(), ours.len(), "seed {seed}: one of the two prints more");
        assert!(ours.lines().filter(|line| line.starts_with("sequence ")).count() > 200);
    }
}
