//! All that a change has to pass.
//!
//! What can go wrong: lints that the computer never sees. A board's binary compiles for its own processor only, so
//! each board is linted by itself, with its own feature. The images
//! are linked too, twice, and weighed: no other check runs the nRF52840's.

use anyhow::Result;

use crate::bench::{self, bench};
use crate::claims::{self, claims};
use crate::deny;
use crate::faults::{self, faults};
use crate::fuzz::{self, fuzz};
use crate::memory::{self, memory};
use crate::oracle;
use crate::process::{cargo, run};
use crate::reproduce;
use crate::run as fly;
use crate::scenes::{self, scenes};
use crate::setup;
use crate::soak::{self, soak};
use crate::test::{Tally, run_all};

/// A board as cargo has to be told about it.
struct Board {
    feature: &'static str,
    target: &'static str,
    /// What is compiled for it.
    what: &'static [&'static str],
}

const BOARDS: [Board; 7] = [
    Board { feature: "scum3c", target: setup::CORTEX_M0, what: &["--lib", "--bins"] },
    Board { feature: "scum3c,security", target: setup::CORTEX_M0, what: &["--lib", "--bin", "scum3c"] },
    Board { feature: "nrf52840", target: setup::CORTEX_M4F, what: &["--lib", "--bin", "nrf52840"] },
    Board { feature: "nrf52840,security", target: setup::CORTEX_M4F, what: &["--lib", "--bin", "nrf52840"] },
    Board { feature: "microbit", target: setup::CORTEX_M0, what: &["--lib", "--bin", "microbit"] },
    Board { feature: "bench", target: setup::CORTEX_M0, what: &["--bin", "bench"] },
    Board { feature: "qemu", target: setup::CORTEX_M0, what: &["--test", "*"] },
];

/// Runs formatting, lints, documentation, tests, the bench, the claims, the scenes, the calibration's oracle and the fuzzer, and closes with how many passed.
pub(crate) fn ci() -> Result<()> {
    let mut tally = Tally::default();
    for manifest in deny::MANIFESTS {
        let words = ["fmt", "--all", "--check", "--manifest-path", manifest];
        tally.check(&format!("formatting of {manifest}"), || run(&mut cargo(&words)));
    }
    if deny::is_there() {
        tally.check("licences, sources and known holes", deny::deny);
    }
    tally.check("lints for this computer", || {
        run(&mut cargo(&["clippy", "--workspace", "--all-targets", "--", "-D", "warnings"]))
    });
    tally.check("every public item documented, every link of it whole", || {
        run(cargo(&["doc", "--workspace", "--no-deps"]).env("RUSTDOCFLAGS", "-D warnings"))
    });
    for board in &BOARDS {
        tally.check(&format!("lints for {}", board.feature), || lint(board));
    }
    tally.check("the same images from another folder", reproduce::reproduce);
    tally.check("memory and stack of every board", || memory(&memory::Arguments::PLAIN));
    if let Err(error) = setup::broker() {
        println!("{error:#}; the tests that need a broker are skipped");
    }
    if let Err(error) = setup::browser() {
        println!("{error:#}; the tests that need a browser are skipped");
    }
    // The tests that ask it are skipped without.
    tally.check("tshark", setup::tshark);
    run_all(&mut tally);
    tally.check("costs", || bench(&bench::Arguments::PLAIN));
    tally.check("the same fixes on two boards", || fly::run(&fly::Arguments::both_boards()));
    tally.check("two motes take turns", || {
        let few = ["--motes", "4", "--rooms", "2", "--seconds", "4"];
        run(cargo(&["xtask", "swarm", "--firmware", "2"]).args(few))
    });
    tally.check("scenes", || scenes(&scenes::Arguments::PLAIN));
    // Behind what it takes its numbers from.
    tally.check("what the texts claim", || claims(&claims::Arguments::after(&["bench", "scenes", "swarm_firmware"])));
    tally.check("soak, half a minute", || soak(&soak::Arguments::SHORT));
    tally.check("faults, a few of each", || faults(&faults::Arguments::SHORT));
    tally.check("calibration beside OpenCV, 20 rooms", || oracle::oracle(20));
    tally.check("fuzzing for half a minute each", || fuzz(&fuzz::Arguments::PLAIN));
    tally.close()
}

fn lint(board: &Board) -> Result<()> {
    setup::target(board.target)?;
    let mut command = cargo(&["clippy", "--target", board.target, "--features", board.feature]);
    run(command.args(board.what).args(["--", "-D", "warnings"]))
}
