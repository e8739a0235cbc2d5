//! The mote's own clock: at any rate, and while it drifts, it changes no angle.
//!
//! What can go wrong: nothing that is not asserted; the light is made, not recorded.

use crate::angle;
use crate::on_target::cycle::{Cycle, PULSES_PER_SLOT, Truth};
use crate::pulse::Pulse;
use crate::sweep::{self, Closed, HALF_TURN_BITS, Light};
use crate::time::Ticks;

/// 0.02 degrees, in units of a 2^20th of 180.
const BOUND: i64 = 116;
/// 80 s of light: less than the wrap of the counter that makes it.
const SLOTS: u32 = 80 * 120;
/// Until every rotor's first sweep has waited for the end of its slot, with lost flashes and without.
const LOCKED: u32 = 120;
/// Nominal; the chip's free-running oscillator, Hz.
const NOMINAL_HZ: f64 = 10e6;
/// 1 % a minute, per second.
const DRIFT: f64 = 0.01 / 60.0;

/// Stations that count 1/48 us: what a drifting clock reads is worked out from there.
fn cycle() -> Cycle {
    Cycle { clock: 48_000_000, start: 0, ..Cycle::TYPICAL }
}

/// The same pulse on a clock of `hz` at the beginning that gains a share of `drift` a second.
fn drifting(pulse: Pulse, hz: f64, drift: f64) -> Pulse {
    let ticks = |at: u32| {
        let seconds = f64::from(at) / 48e6;
        Ticks((hz * seconds * (1.0 + drift * seconds / 2.0)) as u64 as u32)
    };
    let start = ticks(pulse.start.0);
    Pulse { start, width: ticks(pulse.start.after(pulse.width).0).since(start) }
}

/// How far the worst angle is off, of how many; `is_lost` tells by slot whether a flash is missed.
fn worst(hz: f64, drift: f64, slots: u32, mut is_lost: impl FnMut(u32) -> bool) -> (i64, u32) {
    let cycle = cycle();
    let mut sweeps = sweep::State::default();
    let mut angles = angle::State::default();
    let (mut worst, mut seen) = (0, 0);
    for (n, (truth, pulse)) in (0..).zip(cycle.pulses(0, slots)) {
        if matches!(truth, Truth::Sync(_)) && is_lost(n / PULSES_PER_SLOT) {
            continue;
        }
        let sweep = match sweep::step(&sweep::Config::DEFAULT, &mut sweeps, drifting(pulse, hz, drift)) {
            Some(Light::Sweep(sweep)) => sweep,
            _ => match sweeps.closed() {
                Some(Closed::Sweep(sweep)) => sweep,
                _ => continue,
            },
        };
        let bearing = angle::step(&angle::Config::default(), &mut angles, sweep).expect("in view");
        let after = cycle.sweep_after[bearing.station as usize][bearing.axis as usize];
        let truth = (i64::from(after) - 200_000) * (1 << HALF_TURN_BITS) / 400_000;
        worst = (i64::from(bearing.angle.0) - truth).abs().max(worst);
        seen += 1;
    }
    (worst, seen)
}

#[test]
fn a_clock_of_half_to_twice_the_rate_that_drifts_changes_no_angle() {
    for times in [0.5, 1.0, 2.0] {
        for drift in [-DRIFT, 0.0, DRIFT] {
            // What comes next looks random, and is the same every time.
            let mut noise = 1u32;
            let one_in_twenty = |_| {
                noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                noise >> 16 < 65_536 / 20
            };
            let hz = times * NOMINAL_HZ;
            for (name, (worst, seen)) in
                [("all", worst(hz, drift, SLOTS, |_| false)), ("lossy", worst(hz, drift, SLOTS, one_in_twenty))]
            {
                assert!(worst <= BOUND, "{worst} units off at {times} x nominal, {drift} a second, {name}");
                assert!(seen >= SLOTS - LOCKED, "{seen} sweeps at {times} x nominal, {name}");
            }
        }
    }
}

#[test]
fn one_rotors_flashes_may_be_covered_for_a_second_while_the_clock_drifts() {
    // A strobe of nearly the rotors' rate does so. The other rotor's flashes say how the clock goes.
    for times in [0.5, 1.0, 2.0] {
        for rotor in 0..2 {
            let is_covered = |slot| (240..360).contains(&slot) && slot % 2 == rotor;
            let (worst, seen) = worst(times * NOMINAL_HZ, DRIFT, 480, is_covered);
            // What the other rotor says comes a slot late, and by halves: a flash is some ticks off.
            assert!(worst <= 2 * BOUND, "{worst} units off at {times} x nominal");
            assert!(seen >= 480 - 12, "{seen} sweeps at {times} x nominal");
        }
    }
}
