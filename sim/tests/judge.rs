//! QEMU, written by others, judges the core.
//!
//! One program runs on QEMU's Cortex-M0 and on ours, with instruction sequences made up from a seed, interrupted where
//! nobody chose. Every line it prints must be the same, among them how many instructions each part took. Every encoding
//! there is must have been executed.
//!
//! `JUDGE_INSTRUCTIONS` says how many instructions must agree: `JUDGE_INSTRUCTIONS=10000000 cargo test -p sim --test judge
//! -- --nocapture`; `JUDGE_SEED` with which seed to begin.
//!
//! What can go wrong: without `qemu-system-arm` there is no judgement; the test then says so and passes. QEMU knows
//! nothing of cycles; those are in the tests of the core. QEMU 7.2 prints SYS_WRITE0 to its standard error; another
//! version that prints it elsewhere shows up as a difference in the first line.

#[path = "judge/host/encodings.rs"]
mod encodings;
#[path = "judge/host/sequences.rs"]
mod sequences;
#[path = "judge/host/timer.rs"]
mod timer;

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use encodings::Census;
use sim::core::cycles::Timing;
use sim::machine::{Config, Machine, Stop};
use sim::memory::MemoryMap;

/// Instructions that must agree where nobody says how many.
const INSTRUCTIONS: u64 = 500_000;
/// How often each sequence runs.
const RUNS: u32 = 8;
const SEQUENCES_AT: u32 = 0x2_0000;
const PATIENCE: Duration = Duration::from_secs(300);

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

/// What one run came to.
struct Ran {
    output: String,
    instructions: u64,
    /// Of those, in the sequences.
    random: u64,
}

fn run_on_sim(program: &[u8], blob: &[u8], census: &mut Census) -> Ran {
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
    let sequences = SEQUENCES_AT..SEQUENCES_AT + blob.len() as u32;
    let mut random = 0;
    let stop = loop {
        if machine.bus.is_due(machine.cycles()) {
            // QEMU enters what the last instruction has pended before it looks at the time.
            machine.run_until(machine.cycles());
            machine.bus.fire();
        }
        // One instruction at a time, to see which.
        let (pc, before) = (machine.core.registers.pc, machine.instructions());
        let stop = machine.run_until(machine.cycles() + 1);
        if machine.instructions() > before {
            let half = |address: u32| {
                let bytes = machine.read_bytes(address, 2).unwrap_or(&[0, 0]);
                u16::from_le_bytes([bytes[0], bytes[1]])
            };
            census.count(half(pc), half(pc.wrapping_add(2)));
            random += u64::from(sequences.contains(&pc));
        }
        if stop != Stop::Deadline {
            break stop;
        }
    };
    let instructions = machine.instructions();
    let output = String::from_utf8(machine.semihosting.output).expect("the program prints text");
    assert_eq!(stop, Stop::Exit(0), "after {output}");
    Ran { output, instructions, random }
}

fn asked(name: &str, otherwise: u64) -> u64 {
    let asked = std::env::var(name).ok();
    asked.map_or(otherwise, |asked| asked.parse().unwrap_or_else(|_| panic!("{name}={asked} is no number")))
}

#[test]
fn qemu_and_the_sim_print_the_same_and_count_the_same_instructions() {
    if qemu_is_missing() {
        println!("skipped: qemu-system-arm is not installed");
        return;
    }
    let (wanted, first) = (asked("JUDGE_INSTRUCTIONS", INSTRUCTIONS), asked("JUDGE_SEED", 0));
    let program = build_program();
    let mut census = Census::new();
    let (mut all, mut random, mut exceptions, mut seed) = (0, 0, 0, first);
    let began = Instant::now();
    while random < wanted {
        let blob = sequences::blob(seed, RUNS);
        let theirs = run_on_qemu(&program, &blob, &format!("judge-{seed}"));
        let ours = run_on_sim(&program, &blob, &mut census);
        assert!(!theirs.is_empty(), "QEMU printed nothing to its standard error");
        for (line, (theirs, ours)) in theirs.lines().zip(ours.output.lines()).enumerate() {
            assert_eq!(theirs, ours, "line {line}, seed {seed}: QEMU's first, then ours");
        }
        assert_eq!(theirs.len(), ours.output.len(), "seed {seed}: one of the two prints more");
        let lines = |what: &str| ours.output.lines().filter_map(|line| line.strip_prefix(what)).collect::<Vec<_>>();
        assert!(lines("sequence ").len() > 200);
        let count = |words: &str| u64::from_str_radix(words.trim(), 16).expect("the program prints hexadecimal");
        exceptions += lines("exceptions ").iter().filter(|line| line.len() == 8).map(|line| count(line)).sum::<u64>();
        all += ours.instructions;
        random += ours.random;
        seed += 1;
    }
    println!(
        "{random} instructions of random sequences agree, with {exceptions} exceptions in them, and {all} in all; \
         seeds {first} to {}, {:.0} s",
        seed - 1,
        began.elapsed().as_secs_f64()
    );
    for (name, executed) in census.rows() {
        println!("{executed:>10}  {name}");
    }
    let never: Vec<_> = census.rows().filter(|(_, executed)| *executed == 0).map(|(name, _)| name).collect();
    assert!(never.is_empty(), "never executed: {never:?}");
}
