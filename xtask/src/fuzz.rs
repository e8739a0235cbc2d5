//! Light, frames, serial lines and captures that nobody thought of: the fuzz targets, built and let loose for a while.
//!
//! The targets are cargo-fuzz's (`fuzz/`), and `cargo fuzz run chain` works where that and its nightly compiler are
//! installed. Without a sanitizer, which code without `unsafe` has no use for, the pinned compiler instruments just as
//! well, so nothing has to be installed but a C++ compiler for libFuzzer itself.
//!
//! What can go wrong: a target crashes. The input that did it is kept, and the error says how to run it again.

use std::path::PathBuf;
use std::process::Command;

use anyhow::{Context, Result, bail};

use crate::process::{cargo, root, run};
use crate::setup;

/// What the fuzzer may be told.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// Only this one: chain (light through the whole path), frame (bytes from the air), serial (a receiver's line) or
    /// capture (pcap and pcapng)
    target: Option<String>,
    /// How long each is let loose
    #[arg(long, default_value_t = SECONDS)]
    seconds: u32,
    /// Run this one input instead: what an earlier run kept
    #[arg(long, value_name = "FILE", requires = "target")]
    again: Option<PathBuf>,
}

impl Arguments {
    /// As when nobody says anything.
    pub(crate) const PLAIN: Self = Self { target: None, seconds: SECONDS, again: None };
}

const TARGETS: [&str; 4] = ["chain", "frame", "serial", "capture"];
/// How long each is let loose unless told: two minutes together.
const SECONDS: u32 = 30;
/// Where everything of the fuzzer's goes.
const OUT: &str = "target/fuzz";
/// The longest input in bytes: a few hundred orders to the light.
const LONGEST_INPUT: u32 = 512;
/// Counters at each edge and comparisons told to the fuzzer: what cargo-fuzz passes, less the sanitizers.
const INSTRUMENTED: &str = "--cfg fuzzing -Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=4 \
    -Cllvm-args=-sanitizer-coverage-inline-8bit-counters -Cllvm-args=-sanitizer-coverage-pc-table \
    -Cllvm-args=-sanitizer-coverage-trace-compares -Ccodegen-units=1";

/// Builds the targets and lets them loose.
pub(crate) fn fuzz(arguments: &Arguments) -> Result<()> {
    let targets: Vec<&str> = match &arguments.target {
        None => TARGETS.to_vec(),
        Some(name) => match TARGETS.iter().find(|target| *target == name) {
            Some(target) => vec![target],
            None => bail!("no fuzz target {name}; there are {}", TARGETS.join(", ")),
        },
    };
    setup::cpp_compiler()?;
    let out = root().join(OUT);
    // A named target keeps the instrumentation away from build scripts.
    let host = host()?;
    let mut build = cargo(&["build", "--release", "--manifest-path", "fuzz/Cargo.toml", "--target", &host]);
    run(build.env("RUSTFLAGS", INSTRUMENTED).env("CARGO_TARGET_DIR", &out))?;
    for target in targets {
        let program = out.join(&host).join("release").join(target);
        let mut command = Command::new(&program);
        if let Some(input) = &arguments.again {
            run(command.arg(std::path::absolute(input)?))?;
            continue;
        }
        let corpus = out.join("corpus").join(target);
        std::fs::create_dir_all(&corpus).with_context(|| corpus.display().to_string())?;
        let kept = format!("{OUT}/{target}-");
        command.args([
            format!("-max_total_time={}", arguments.seconds),
            format!("-max_len={LONGEST_INPUT}"),
            format!("-artifact_prefix={kept}"),
            // Hangs are crashes too: no input takes a second.
            "-timeout=20".to_string(),
            "-print_final_stats=1".to_string(),
            "-reduce_inputs=0".to_string(),
        ]);
        run(command.arg(&corpus)).with_context(|| {
            format!("the input that did it is kept as {kept}*; `cargo xtask fuzz {target} --again FILE` runs it again")
        })?;
    }
    Ok(())
}

/// What the compiler calls this computer.
fn host() -> Result<String> {
    let asked = Command::new("rustc").arg("-vV").current_dir(root()).output().context("cannot start rustc")?;
    let said = String::from_utf8_lossy(&asked.stdout).into_owned();
    said.lines()
        .find_map(|line| line.strip_prefix("host: "))
        .map(str::to_string)
        .context("rustc does not say what this computer is")
}
