//! Every test: on this computer, then on the emulated Cortex-M0.
//!
//! What can go wrong: one part fails. The others run all the same, and the end names all that failed.

use std::env;

use anyhow::{Context, Result, bail};

use crate::process::{cargo, run_and_read};
use crate::setup;

/// Runs every test and closes with how many passed.
pub(crate) fn test() -> Result<()> {
    let mut tally = Tally::default();
    run_all(&mut tally);
    tally.close()
}

/// Runs every test, whatever fails on the way.
pub(crate) fn run_all(tally: &mut Tally) {
    // First, so that nobody waits for the host's tests only to be asked for something.
    let emulator = setup::target(setup::CORTEX_M0).and_then(|()| setup::emulator());
    tally.part("tests on this computer", on_host);
    tally.part("tests on the emulated Cortex-M0", |tally| {
        emulator?;
        on_target(tally)
    });
}

fn on_host(tally: &mut Tally) -> Result<()> {
    run_and_read(&mut cargo(&["test", "--workspace", "--no-fail-fast"]), |line| tally.read_libtest(line))
}

fn on_target(tally: &mut Tally) -> Result<()> {
    setup::target(setup::CORTEX_M0)?;
    setup::emulator()?;
    let mut command =
        cargo(&["test", "--no-fail-fast", "--target", setup::CORTEX_M0, "--features", "qemu", "--test", "*"]);
    // This very program is the runner: no second cargo in between.
    let runner = env::current_exe().context("where this program lies")?;
    let runner = runner.to_str().filter(|path| !path.contains(' '));
    if let Some(runner) = runner {
        command.env("CARGO_TARGET_THUMBV6M_NONE_EABI_RUNNER", format!("{runner} qemu"));
    }
    let mut log = TargetLog::default();
    let done = run_and_read(&mut command, |line| log.read(line));
    tally.passed += log.passed();
    tally.failed += log.failed();
    done
}

/// What passed and what did not, over all parts.
#[derive(Debug, Default)]
pub(crate) struct Tally {
    passed: usize,
    failed: usize,
    broken: Vec<String>,
}

impl Tally {
    /// Runs one part that counts what it does itself.
    pub(crate) fn part(&mut self, name: &str, part: impl FnOnce(&mut Self) -> Result<()>) {
        let failed = self.failed;
        if let Err(error) = part(self) {
            eprintln!("error: {error:#}");
            let reason = format!("{error:#}");
            self.broken.push(format!("{name}: {}", reason.lines().next().unwrap_or_default()));
            // What did not even begin counts as one.
            self.failed = self.failed.max(failed + 1);
        }
    }

    /// Runs one part that either passes or does not.
    pub(crate) fn check(&mut self, name: &str, check: impl FnOnce() -> Result<()>) {
        self.part(name, |tally| {
            check()?;
            tally.passed += 1;
            Ok(())
        });
    }

    /// Says what failed and closes with the sum.
    ///
    /// # Errors
    /// When anything failed.
    pub(crate) fn close(self) -> Result<()> {
        println!();
        for broken in &self.broken {
            println!("FAILED {broken}");
        }
        println!("{} passed, {} failed", self.passed, self.failed);
        match self.broken.len() {
            0 => Ok(()),
            parts => bail!("{parts} of the parts above failed"),
        }
    }

    /// Counts by the closing line of one of Rust's own test programs.
    fn read_libtest(&mut self, line: &str) {
        let Some(counts) = line.strip_prefix("test result: ") else { return };
        let count = |what: &str| {
            let words: Vec<&str> = counts.split_whitespace().collect();
            let number = words.windows(2).find(|pair| pair[1].trim_end_matches(';') == what).map(|pair| pair[0]);
            number.and_then(|number| number.parse::<usize>().ok()).unwrap_or(0)
        };
        self.passed += count("passed");
        self.failed += count("failed");
    }
}

/// What the test programs on the mote's processor say: `(1/7) running ...` before each test, `all tests passed!` at
/// the end. A test that fails ends its program.
#[derive(Debug, Default)]
struct TargetLog {
    begun: usize,
    programs: usize,
    finished: usize,
}

impl TargetLog {
    fn read(&mut self, line: &str) {
        if line == "all tests passed!" {
            self.finished += 1;
        } else if line.starts_with('(') && line.contains(") running `") {
            self.begun += 1;
            self.programs += usize::from(line.starts_with("(1/"));
        }
    }

    fn failed(&self) -> usize {
        self.programs.saturating_sub(self.finished)
    }

    fn passed(&self) -> usize {
        self.begun.saturating_sub(self.failed())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_closing_line_of_a_test_program_is_counted() {
        let mut tally = Tally::default();
        tally.read_libtest(
            "test result: FAILED. 57 passed; 3 failed; 0 ignored; 0 measured; 0 filtered out; finished in 0.92s",
        );
        tally.read_libtest("test on_target::frame::tests::any_pan_is_taken ... ok");
        assert_eq!((tally.passed, tally.failed), (57, 3));
    }

    #[test]
    fn a_test_that_ends_its_program_is_the_one_that_failed() {
        let mut log = TargetLog::default();
        for line in ["(1/2) running `a`...", "(2/2) running `b`...", "all tests passed!"] {
            log.read(line);
        }
        for line in ["(1/3) running `c`...", "(2/3) running `d`...", "error: panicked at tests/x.rs:1:1:"] {
            log.read(line);
        }
        assert_eq!((log.passed(), log.failed()), (3, 1));
    }

    #[test]
    fn a_part_that_does_not_begin_counts_as_one_failure() {
        let mut tally = Tally::default();
        tally.part("nothing", |_| bail!("not there"));
        tally.check("something", || Ok(()));
        assert_eq!((tally.passed, tally.failed), (1, 1));
        assert!(tally.close().is_err());
    }
}
