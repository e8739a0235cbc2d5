//! When the watchdog may be fed: only after every stage has finished a run since the last time.
//!
//! A timer that feeds by itself proves that a timer works. Here classifier and solver count the runs that they came back
//! from, the radio the frames that it is done with, and food takes one more of each.
//!
//! What can go wrong: a stage that hangs, that is never scheduled, or that something above it starves. All three look
//! the same from here, and all three end in a reset. A stage that runs and computes nonsense does not.

/// The stages that have to move: classify, solve and radio.
pub const STAGES: usize = 3;

/// Where every stage stood when food was last given.
#[derive(Debug, Clone, Default)]
pub struct Progress {
    fed_at: [u32; STAGES],
}

impl Progress {
    /// Whether every stage has moved since this last said yes; `runs` counts, per stage, finished runs, wrapping.
    pub fn all_moved(&mut self, runs: [u32; STAGES]) -> bool {
        let moved = self.fed_at.iter().zip(&runs).all(|(before, now)| before != now);
        if moved {
            self.fed_at = runs;
        }
        moved
    }
}
