//! The nRF52840's board, as far as it is arithmetic: everything above its registers, on this computer.

use std::collections::HashSet;

use proptest::prelude::*;

use crate::frame::{self, Header, LEN, Report, Reset, emit};
use crate::on_target::cycle::{Cycle, PULSES_PER_SLOT, Truth};
use crate::pulse::Pulse;
use crate::sweep::{self, Light};
use crate::time::{Span, Ticks};

use super::mote::mote;

#[path = "../../src/bin/nrf52840/cause.rs"]
mod cause;
#[path = "../../src/bin/nrf52840/channel.rs"]
mod channel;
#[path = "../../src/bin/nrf52840/csma.rs"]
mod csma;
#[path = "../../src/bin/nrf52840/pairing.rs"]
mod pairing;
#[path = "../../src/bin/nrf52840/progress.rs"]
mod progress;
#[path = "../../src/bin/nrf52840/psdu.rs"]
mod psdu;

use cause::{Boot, Cause};
use channel::Channel;
use csma::Csma;
use pairing::{Pairing, Sample};
use progress::{Progress, STAGES};
use psdu::{MAX_PSDU, Psdu};

/// 20 symbols of 16 us (IEEE 802.15.4-2006, 7.4.1).
const PERIOD_US: u32 = 320;

/// A change of the light, and what becomes of it on its way.
#[derive(Debug, Clone, Copy)]
struct Change {
    /// Ticks since the change before.
    after: u32,
    /// The hardware sees it.
    seen: bool,
    /// The handler has run before the next change.
    fetched: bool,
}

/// Light as the hardware and the handler see it: what pairing gave, and what there was to give.
struct Outcome {
    given: Vec<Pulse>,
    /// Rise and fall of every pulse of the light.
    real: Vec<Pulse>,
    /// Edges the hardware saw.
    seen: u32,
    lost: u16,
}

/// Plays changes, rises and falls in turn, into counters and stamps as GPIOTE, PPI and TIMER keep them.
fn play(start: Ticks, changes: &[Change]) -> Outcome {
    let mut pairing = Pairing::default();
    let mut sample = Sample { rises: 0, falls: 0, rise: Ticks(0), fall: Ticks(0) };
    let mut outcome = Outcome { given: Vec::new(), real: Vec::new(), seen: 0, lost: 0 };
    let mut at = start;
    let mut rise = at;
    let mut owed = false;
    for (index, change) in changes.iter().enumerate() {
        at = at.after(Span(change.after));
        let lit = index % 2 == 0;
        if lit {
            rise = at;
        } else {
            outcome.real.push(Pulse { start: rise, width: at.since(rise) });
        }
        if change.seen {
            outcome.seen += 1;
            if lit {
                sample.rises += 1;
                sample.rise = at;
            } else {
                sample.falls += 1;
                sample.fall = at;
                owed = true;
            }
        }
        // The interrupt is asked for by a fall, and comes when it can.
        if owed && (change.fetched || index + 1 == changes.len()) {
            owed = false;
            outcome.given.extend(pairing.take(sample));
        }
    }
    outcome.lost = pairing.lost();
    outcome
}

/// Changes with the spacing of Lighthouse light and of trouble.
fn changes(
    seen: impl Strategy<Value = bool> + 'static,
    fetched: impl Strategy<Value = bool> + 'static,
) -> BoxedStrategy<Vec<Change>> {
    let after = prop_oneof![1..50u32, 24..3_000u32, 4_800..150_000u32];
    let change = (after, seen, fetched).prop_map(|(after, seen, fetched)| Change { after, seen, fetched });
    prop::collection::vec(change, 0..120).boxed()
}

proptest! {
    #[test]
    fn every_pulse_is_given_when_the_handler_keeps_up(start: u32, changes in changes(Just(true), Just(true))) {
        let outcome = play(Ticks(start), &changes);
        prop_assert_eq!(outcome.given, outcome.real);
        prop_assert_eq!(outcome.lost, 0);
    }

    #[test]
    fn a_late_handler_costs_pulses_and_never_makes_one_up(
        start: u32,
        changes in changes(Just(true), any::<bool>()),
    ) {
        let outcome = play(Ticks(start), &changes);
        let real: HashSet<(u32, u32)> = outcome.real.iter().map(|pulse| (pulse.start.0, pulse.width.0)).collect();
        for pulse in &outcome.given {
            prop_assert!(real.contains(&(pulse.start.0, pulse.width.0)), "{pulse:?} was no pulse");
        }
    }

    #[test]
    fn a_handler_within_the_dark_after_each_pulse_gives_every_pulse(
        start: u32,
        pulses in prop::collection::vec((24..2_200u32, 4_800..150_000u32), 0..60),
    ) {
        // Both edges of each pulse come before the handler: it is never there between a rise and its fall.
        let changes: Vec<Change> = pulses
            .iter()
            .flat_map(|&(width, dark)| {
                [
                    Change { after: dark, seen: true, fetched: false },
                    Change { after: width, seen: true, fetched: true },
                ]
            })
            .collect();
        let outcome = play(Ticks(start), &changes);
        prop_assert_eq!(outcome.given, outcome.real);
    }

    #[test]
    fn every_edge_seen_is_in_a_pulse_or_lost_or_waiting(
        start: u32,
        changes in changes(any::<bool>(), any::<bool>()),
    ) {
        let outcome = play(Ticks(start), &changes);
        let kept = outcome.seen - 2 * outcome.given.len() as u32 - u32::from(outcome.lost);
        // After the last fall nothing is fetched any more; one rise at least is kept for the fall that may come.
        let trailing = changes.iter().enumerate().rev().take_while(|(index, change)| index % 2 == 0 || !change.seen);
        let rises = trailing.filter(|(_, change)| change.seen).count() as u32;
        prop_assert!((rises.min(1)..=rises).contains(&kept), "{kept} kept of {rises}");
    }

    #[test]
    fn an_edge_the_hardware_misses_costs_only_its_own_pulse_when_the_handler_keeps_up(
        start: u32,
        pulses in 2..40usize,
        missed: prop::sample::Index,
    ) {
        let missed = missed.index(2 * pulses - 1);
        let changes: Vec<Change> = (0..2 * pulses)
            .map(|index| Change { after: if index % 2 == 0 { 5_000 } else { 1_000 }, seen: index != missed, fetched: true })
            .collect();
        let outcome = play(Ticks(start), &changes);
        let mut kept = outcome.real.clone();
        kept.remove(missed / 2);
        prop_assert_eq!(outcome.given, kept);
        prop_assert_eq!(outcome.lost, 1);
    }

    #[test]
    fn counters_that_wrap_change_nothing(changes in changes(any::<bool>(), any::<bool>()), rises: u32, falls: u32) {
        prop_assume!(falls != 0);
        // A pairing that begins far on takes the first sample as what was before it.
        let mut plain = Pairing::default();
        let mut far = Pairing::default();
        let before = Sample { rises, falls, rise: Ticks(0), fall: Ticks(0) };
        let _ = far.take(before);
        let behind = far.lost();
        let mut seen = [0u32; 2];
        let mut at = Ticks(0);
        let mut stamps = [Ticks(0); 2];
        for (index, change) in changes.iter().enumerate() {
            at = at.after(Span(change.after));
            seen[index % 2] += 1;
            stamps[index % 2] = at;
            if index % 2 == 1 && change.fetched {
                let here = Sample { rises: seen[0], falls: seen[1], rise: stamps[0], fall: stamps[1] };
                let there = Sample {
                    rises: rises.wrapping_add(seen[0]),
                    falls: falls.wrapping_add(seen[1]),
                    ..here
                };
                prop_assert_eq!(plain.take(here), far.take(there));
                prop_assert_eq!(plain.lost(), far.lost().wrapping_sub(behind));
            }
        }
    }

    #[test]
    fn the_watchdog_is_fed_only_after_every_stage_moved(
        moves in prop::collection::vec(any::<[bool; STAGES]>(), 1..100),
    ) {
        let mut progress = Progress::default();
        let mut runs = [u32::MAX - 3; STAGES];
        progress.all_moved(runs);
        let mut since = [false; STAGES];
        for moves in moves {
            for (stage, moved) in moves.into_iter().enumerate() {
                runs[stage] = runs[stage].wrapping_add(u32::from(moved));
                since[stage] |= moved;
            }
            let fed = progress.all_moved(runs);
            prop_assert_eq!(fed, since == [true; STAGES]);
            if fed {
                since = [false; STAGES];
            }
        }
    }

    #[test]
    fn a_busy_channel_is_tried_five_times_after_waits_within_the_standards_bounds(seed: u32) {
        let mut csma = Csma::new(seed);
        for _ in 0..3 {
            let first = csma.begin();
            prop_assert!(first < 8 * PERIOD_US && first.is_multiple_of(PERIOD_US));
            let later: Vec<u32> = std::iter::from_fn(|| csma.again()).collect();
            prop_assert_eq!(later.len(), 4);
            for (wait, bound) in later.into_iter().zip([16, 32, 32, 32]) {
                prop_assert!(wait < bound * PERIOD_US && wait.is_multiple_of(PERIOD_US));
            }
        }
    }

    #[test]
    fn the_radio_makes_the_two_bytes_that_were_left_out(pan: u16, mote: u16, sequence: u16, time: u32) {
        let frame = emit(Header { pan, mote, sequence }, &Report { time, ..Report::default() });
        let mut psdu = Psdu::new();
        prop_assert!(psdu.load(&frame));
        let sent = on_air(&psdu);
        prop_assert_eq!(&sent[..], &frame[..]);
        prop_assert!(frame::parse(&sent).is_ok());
    }

    #[test]
    fn no_length_is_sent_that_a_listener_could_not_hold(frame in prop::collection::vec(any::<u8>(), 0..300)) {
        let mut psdu = Psdu::new();
        let fits = (2..=MAX_PSDU).contains(&frame.len());
        prop_assert_eq!(psdu.load(&frame), fits);
        if fits {
            prop_assert_eq!(usize::from(psdu.bytes()[0]), frame.len());
            prop_assert_eq!(&psdu.bytes()[1..frame.len() - 1], &frame[..frame.len() - 2]);
        } else {
            prop_assert_eq!(psdu.bytes()[0], 0);
        }
    }

}

#[test]
fn light_at_sixteen_megahertz_is_understood_from_stamps_and_counts() {
    // The counter wraps in slot 7. 20 slots are enough to find the cycle; after them every slot has its sweep.
    let cycle = Cycle { clock: 16_000_000, start: u32::MAX - 1_000_000, ..Cycle::TYPICAL };
    let mut pairing = Pairing::default();
    let mut state = sweep::State::default();
    let mut sample = Sample { rises: 0, falls: 0, rise: Ticks(0), fall: Ticks(0) };
    let mut sweeps = 0;
    for (index, (truth, pulse)) in cycle.pulses(0, 60).enumerate() {
        sample.rises += 1;
        sample.falls += 1;
        sample.rise = pulse.start;
        sample.fall = pulse.start.after(pulse.width);
        let light = sweep::step(&sweep::Config::DEFAULT, &mut state, pairing.take(sample).unwrap());
        if index < 20 * PULSES_PER_SLOT as usize {
            continue;
        }
        match (light, truth) {
            (Some(Light::Sweep(sweep)), Truth::Sweep(station, axis)) => {
                assert_eq!((sweep.station, sweep.axis), (station, axis));
                let after = cycle.span(cycle.sweep_after[station as usize][axis as usize].into());
                // Four instants, each rounded down to a tick.
                assert!(sweep.since_sync.0.abs_diff(after.0) <= 2, "{:?}, not {after:?}", sweep.since_sync);
                sweeps += 1;
            }
            (Some(Light::Sync(sync)), Truth::Sync(truth)) => assert_eq!(sync, truth),
            other => panic!("{other:?} at pulse {index}"),
        }
    }
    assert_eq!(sweeps, 40);
}

/// What a receiver hears of a PSDU in memory: the radio of the product specification as a shift register.
///
/// CRCPOLY 0x11021, CRCINIT 0, from behind the length on, every byte's lowest bit first; then the register, its highest
/// bit first (6.20.12, 6.20 CRCPOLY).
fn on_air(psdu: &Psdu) -> Vec<u8> {
    let [length, rest @ ..] = psdu.bytes() else { unreachable!() };
    let body = &rest[..usize::from(*length) - 2];
    let mut register = 0u32;
    for byte in body {
        for bit in 0..8 {
            let carry = register >> 15 & 1 != u32::from(byte >> bit & 1);
            register = register << 1 & 0xffff ^ if carry { 0x1_1021 & 0xffff } else { 0 };
        }
    }
    let mut bytes = body.to_vec();
    // Bits arrive lowest first in each byte.
    for byte in 0..2 {
        bytes.push((0..8).map(|bit| ((register >> (15 - 8 * byte - bit) & 1) as u8) << bit).sum());
    }
    bytes
}

#[test]
fn the_length_counts_the_two_bytes_that_the_radio_adds() {
    let mut psdu = Psdu::new();
    assert!(psdu.load(&emit(Header::default(), &Report::default())));
    assert_eq!(usize::from(psdu.bytes()[0]), LEN);
}

#[test]
fn channels_lie_five_megahertz_apart_from_2405_to_2480() {
    let all: Vec<u8> = (0..=255).filter_map(Channel::new).map(Channel::mhz_above_2400).collect();
    assert_eq!(all, (0..16).map(|step| 5 + 5 * step).collect::<Vec<u8>>());
    assert_eq!(Channel::new(26).map(Channel::mhz_above_2400), Some(80));
}

#[test]
fn motes_with_different_numbers_do_not_wait_alike() {
    let waits = |seed| {
        let mut csma = Csma::new(seed);
        (0..32).map(move |_| csma.begin()).collect::<Vec<u32>>()
    };
    let all: HashSet<Vec<u32>> = (0..64).map(waits).collect();
    assert_eq!(all.len(), 64);
    let mut counts = [0u32; 8];
    for wait in (0..2_000).flat_map(waits) {
        counts[(wait / PERIOD_US) as usize] += 1;
    }
    // 64,000 throws of an 8-sided die: 8,000 each, standard deviation 84.
    assert!(counts.iter().all(|count| count.abs_diff(8_000) < 500), "{counts:?}");
}

#[test]
fn a_reset_has_one_cause_and_the_pin_speaks_alone() {
    assert_eq!(Cause::from_bits(0), Cause::Power);
    assert_eq!(Cause::from_bits(0b0001), Cause::Pin);
    assert_eq!(Cause::from_bits(0b1111), Cause::Pin);
    assert_eq!(Cause::from_bits(0b0010), Cause::Watchdog);
    assert_eq!(Cause::from_bits(0b0100), Cause::Software);
    assert_eq!(Cause::from_bits(0b1000), Cause::Lockup);
    assert_eq!(Cause::from_bits(1 << 16), Cause::Wake(1 << 16));
}

#[test]
fn every_end_is_told_by_the_next_start() {
    use mote::crumb::{Crumb, Kind};
    let start = |cause, left: Option<(Kind, u32)>| {
        let crumb = Crumb::new();
        if let Some((kind, at)) = left {
            crumb.leave(kind, at);
        }
        let told = Boot::of(cause, &crumb).reset();
        // Told once: the start after it has nothing to tell of this one.
        assert_eq!(Boot::of(cause, &crumb).crash, None);
        told
    };
    // A panic and a fault ask for a reset themselves.
    assert_eq!(start(Cause::Software, Some((Kind::Panic, 42))), (Reset::Panic, 42));
    assert_eq!(start(Cause::Software, Some((Kind::HardFault, 0x1234))), (Reset::Fault, 0x1234));
    assert_eq!(start(Cause::Software, None), (Reset::Requested, 0));
    assert_eq!(start(Cause::Pin, None), (Reset::Requested, 0));
    assert_eq!(start(Cause::Watchdog, None), (Reset::Watchdog, 0));
    // The log hung in a panic: what the panic left says more than the watchdog.
    assert_eq!(start(Cause::Watchdog, Some((Kind::Panic, 7))), (Reset::Panic, 7));
    assert_eq!(start(Cause::Lockup, None), (Reset::Fault, 0));
    assert_eq!(start(Cause::Power, None), (Reset::PowerOn, 0));
    // Memory that lived through a dip of the supply, or noise that looks like ours.
    assert_eq!(start(Cause::Power, Some((Kind::Panic, 7))), (Reset::PowerOn, 0));
}
