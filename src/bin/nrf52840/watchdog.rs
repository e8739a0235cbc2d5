//! The watchdog (PS 6.36): 6 s without progress and the chip starts again.
//!
//! `progress` has the rule. Every second asks for a run of every stage and for a health frame, and the next one feeds if
//! all of them came back and a frame is off the radio's hands.
//!
//! Food may be late. The first second gives none, for nothing was asked for before it. A mote whose reports cease keeps
//! its health frame for one that does not come until the next second; with a key and rare turns it then keeps two sealed
//! ones, and only the third sends the first on its way (`mote::seal`): 4 s. One more is for the oscillator of the clock
//! that counts, which is not calibrated, and one for what nobody thought of.
//!
//! What can go wrong: nothing stops it, and its settings hold until a reset that reaches it; where it is found running,
//! it is fed as it was left. It stands still while a debugger halts the core, so that one can look.

use core::sync::atomic::{AtomicU32, Ordering};

use nrf_pac::WDT;
use nrf_pac::wdt::vals;

use crate::progress::{Progress, STAGES};

/// 6 s of the 32,768 Hz clock: timeout = (CRV + 1) / 32768 (PS 6.36).
const COUNT: u32 = 6 * 32_768 - 1;

/// Runs that each stage came back from, wrapping. Each has one writer: its stage.
static RUNS: [AtomicU32; STAGES] = [const { AtomicU32::new(0) }; STAGES];

/// A stage that has to move.
#[derive(Debug, Clone, Copy)]
pub enum Stage {
    /// Pulses to sightings.
    Classify,
    /// Sightings to reports.
    Solve,
    /// Reports onto the air.
    Radio,
}

/// A run of `stage` is over; of the radio, a frame is sent or given up.
pub fn moved(stage: Stage) {
    let runs = match stage {
        Stage::Classify => &RUNS[0],
        Stage::Solve => &RUNS[1],
        Stage::Radio => &RUNS[2],
    };
    runs.store(runs.load(Ordering::Relaxed).wrapping_add(1), Ordering::Relaxed);
}

/// The hand that feeds.
#[derive(Default)]
pub struct Watchdog {
    progress: Progress,
}

/// Starts it, which also starts the 32,768 Hz oscillator (PS 6.36), and feeds it once.
pub fn start() -> Watchdog {
    // CRV, RREN and CONFIG are blocked while it runs (PS 6.36).
    if !WDT.runstatus().read().runstatus() {
        WDT.config().write(|w| {
            w.set_sleep(vals::Sleep::Run);
            w.set_halt(vals::Halt::Pause);
        });
        WDT.crv().write_value(COUNT);
        WDT.rren().write(|w| w.set_rr(0, true));
        WDT.tasks_start().write_value(1);
    }
    feed();
    Watchdog::default()
}

impl Watchdog {
    /// Feeds, if every stage has come back from a run since the last time.
    pub fn feed_if_all_moved(&mut self) {
        if self.progress.all_moved(RUNS.each_ref().map(|runs| runs.load(Ordering::Relaxed))) {
            feed();
        }
    }
}

/// Reload register 0 is the enabled one (PS 6.36).
fn feed() {
    WDT.rr(0).write(|w| w.set_rr(vals::Rr::Reload));
}
