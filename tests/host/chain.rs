//! Edges to what the mote tells of the light: real stations' frames through the whole path, its health, its batches.

use std::fs;
use std::path::Path;

use crate::angle;
use crate::chain::{Batch, Chain, Classifier, Config, Ears, Estimate, Seen, Sighting, Solver};
use crate::ootx::{self, Block};
use crate::pulse::Pulse;
use crate::sweep::{Axis, Station};
use crate::time::{Span, Ticks};

mod room {
    #![allow(dead_code, reason = "what a board wants besides the room")]
    include!(concat!(env!("OUT_DIR"), "/calib.rs"));
}

/// The default room, every frame of the stations read, and believed.
fn config(estimate: Estimate) -> Config {
    Config {
        estimate,
        ootx: ootx::Config { rest_bits: 0, ids: [None, None] },
        angle: angle::Config::default().with_received([true, true]),
        ..room::CONFIG
    }
}

/// The pulses of a recording, as the 32-bit counter of a mote stamps them.
fn recording(name: &str) -> Option<Vec<Pulse>> {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/vive-pulses").join(name);
    let Ok(text) = fs::read_to_string(&file) else {
        eprintln!("skipped: there is no recording ../shared/data/vive-pulses/{name} beside the project");
        return None;
    };
    let pulse = |line: &str| {
        let (start, width) = line.split_once(',').expect("two columns");
        let number = |text: &str| text.parse::<u64>().expect("a whole number") as u32;
        Pulse { start: Ticks(number(start)), width: Span(number(width)) }
    };
    Some(text.lines().skip(1).map(pulse).collect())
}

/// What came of some light.
struct Heard {
    blocks: [Vec<Block>; 2],
    sightings: Vec<Sighting>,
    health: crate::frame::Health,
}

fn hear(pulses: &[Pulse]) -> Heard {
    let config = config(Estimate::Track);
    let (mut classifier, mut solver, mut ears) = (Classifier::default(), Solver::default(), Ears::default());
    let mut blocks = [Vec::new(), Vec::new()];
    let mut sightings = Vec::new();
    for pulse in pulses {
        let Some(sighting) = classifier.pulse(&config, *pulse) else { continue };
        sightings.push(sighting);
        ears.hear(&config.ootx, &sighting, |station, block| blocks[station as usize].push(*block));
        let _ = solver.step(&config, sighting);
    }
    let now = pulses.last().map_or(Ticks(0), |last| last.start.after(last.width));
    let health = solver.health(&config, &classifier.understood(now));
    Heard { blocks, sightings, health }
}

#[test]
fn x() {
    for f in ["hmd-one-station-visible.csv", "tracker-two-stations.csv"] {
        let h = hear(&recording(f).unwrap());
        for b in &h.blocks { for b in b {
            eprintln!("{} {:x?} {:x?} {:?}", b.id(), [Axis::Azimuth, Axis::Elevation].map(|a| b.terms(a)), b.bytes(), b.mode());
        } eprintln!(); }
        eprintln!("{:?}", h.health);
        eprintln!("{:?}", h.sightings.len());
    }
}
