//! Pulses to flashes and sweeps: the whole V1 cycle, and what happens when parts of it are missing.
#![cfg_attr(target_os = "none", no_std, no_main)]

#[cfg(target_os = "none")]
mod cycle;
#[cfg(target_os = "none")]
mod harness;
#[cfg(not(target_os = "none"))]
use super::cycle;

use lighthouse_mote::angle;
use lighthouse_mote::pulse::Pulse;
use lighthouse_mote::sweep::{
    Axis, COAST_HALF_TURNS, Closed, Config, HALF_TURN_BITS, Light, Stamp, State, Station, Status, Sweep, Sync, expire,
    step,
};
use lighthouse_mote::time::Span;

use cycle::{Cycle, HALF_TURN, Truth, width};

const CONFIG: Config = Config::DEFAULT;
/// Slots after which the cycle must be known, from whichever slot the mote wakes in: two to find the flashes, two
/// until the skip passes from one station to the other.
const LOCKED: u32 = 4;
/// Slots after which every rotor's last sweep is known, and the next is said at once.
const SETTLED: u32 = 2 * LOCKED;
/// Slots after which a flash is believed only where it is expected: to 4 us.
const SURE: u32 = 20;

/// Feeds a whole number of slots; the state at their end.
fn after(cycle: Cycle, first: u32, slots: u32) -> State {
    let mut state = State::default();
    for (_, pulse) in cycle.pulses(first, slots) {
        step(&CONFIG, &mut state, pulse);
    }
    state
}

fn sweep_of(light: Option<Light>) -> Option<Sweep> {
    match light {
        Some(Light::Sweep(sweep)) => Some(sweep),
        _ => None,
    }
}

#[track_caller]
fn assert_understood(cycle: &Cycle, truth: Truth, pulse: Pulse, light: Option<Light>) {
    // The flash, the two edges of the sweep and their middle are each cut to whole ticks.
    assert_understood_within(2, cycle, truth, pulse, light);
}

#[track_caller]
fn assert_understood_within(ticks: u32, cycle: &Cycle, truth: Truth, pulse: Pulse, light: Option<Light>) {
    match truth {
        Truth::Sync(sync) => assert_eq!(light, Some(Light::Sync(sync))),
        Truth::Sweep(station, axis) => {
            let Some(sweep) = sweep_of(light) else { panic!("a sweep was taken for {light:?}") };
            let middle = pulse.start.after(Span(pulse.width.0 / 2));
            assert_eq!((sweep.station, sweep.axis, sweep.at), (station, axis, middle));
            let span = cycle.span(u64::from(cycle.sweep_after[station as usize][axis as usize]));
            assert!(sweep.since_sync.0.abs_diff(span.0) <= ticks, "{:?} for {span:?}", sweep.since_sync);
        }
    }
}

/// Locks, then expects every pulse of `slots` more slots to be understood.
#[track_caller]
fn assert_all_understood(cycle: Cycle, slots: u32) {
    let mut state = after(cycle, 0, SETTLED);
    for (truth, pulse) in cycle.pulses(SETTLED, slots) {
        assert_understood(&cycle, truth, pulse, step(&CONFIG, &mut state, pulse));
    }
    assert_eq!(state.counts().locks_lost, 0);
}

#[cfg_attr(target_os = "none", defmt_test::tests)]
mod tests {
    use super::*;

    #[test]
    fn the_cycle_is_known_after_four_slots_wherever_the_mote_wakes() {
        let cycle = Cycle::TYPICAL;
        for first in 0..4 {
            let mut state = after(cycle, first, LOCKED);
            // The first sweeps wait for the ends of their slots.
            for (n, (truth, pulse)) in (0..).zip(cycle.pulses(first + LOCKED, 5)) {
                let light = step(&CONFIG, &mut state, pulse);
                match truth {
                    Truth::Sync(_) => assert_understood(&cycle, truth, pulse, light),
                    Truth::Sweep(..) if n < 12 => assert_eq!(light, None),
                    Truth::Sweep(..) => assert_understood(&cycle, truth, pulse, light),
                }
                if n >= 3 && n % 3 == 0 {
                    let (truth, pulse) = cycle.pulse(first + LOCKED + n / 3 - 1, 2);
                    let Some(Closed::Sweep(sweep)) = state.closed() else { panic!("a sweep was lost") };
                    assert_understood(&cycle, truth, pulse, Some(Light::Sweep(sweep)));
                }
            }
        }
    }

    #[test]
    fn a_cycle_has_eight_flashes_and_four_sweeps_and_each_is_named() {
        // 32 slots spell every pair of data bits in every slot of the cycle.
        assert_all_understood(Cycle::TYPICAL, 32);
    }

    #[test]
    fn a_wake_up_between_the_two_flashes_of_a_slot_is_no_trap() {
        let cycle = Cycle::TYPICAL;
        for missing in 1..3 {
            let mut state = State::default();
            for (_, pulse) in cycle.pulses(0, 10).skip(missing) {
                step(&CONFIG, &mut state, pulse);
            }
            for (truth, pulse) in cycle.pulses(10, 4) {
                assert_understood(&cycle, truth, pulse, step(&CONFIG, &mut state, pulse));
            }
        }
    }

    #[test]
    fn the_cycle_goes_on_through_the_wrap_of_the_counter() {
        let slot = Cycle::TYPICAL.span(HALF_TURN).0;
        // The wrap falls into the search, between flashes, on a sweep, much later.
        for slots_before in [1, 2, 5, 9] {
            for part in 0..4 {
                let start = 0u32.wrapping_sub(slots_before * slot + part * slot / 4);
                assert_all_understood(Cycle { start, ..Cycle::TYPICAL }, 8);
            }
        }
    }

    #[test]
    fn clocks_from_1_to_100_mhz_are_followed() {
        for clock in [1_000_000, 2_000_000, 5_000_000, 16_000_000, 48_000_000, 100_000_000] {
            assert_all_understood(Cycle { clock, ..Cycle::TYPICAL }, 8);
        }
    }

    #[test]
    fn a_clock_off_by_a_tenth_sees_the_same_angles() {
        // A tick at 9 MHz is 14 units of angle. Sweep and flash are each cut to a whole tick, and so are the two ends
        // of the half turn, which counts for about a half of its length.
        const TWO_TICKS: u32 = 28;
        for clock in [9_000_000, 10_000_000, 11_000_000] {
            let cycle = Cycle { clock, ..Cycle::TYPICAL };
            let mut sweeps = State::default();
            let mut angles = angle::State::default();
            let mut seen = 0;
            for (_, pulse) in cycle.pulses(0, 40) {
                let Some(sweep) = sweep_of(step(&CONFIG, &mut sweeps, pulse)) else { continue };
                let Some(bearing) = angle::step(&angle::Config::default(), &mut angles, sweep) else {
                    panic!("in the field of view")
                };
                let after = cycle.sweep_after[bearing.station as usize][bearing.axis as usize];
                let truth = (i64::from(after) - 200_000) * (1 << HALF_TURN_BITS) / 400_000;
                let off = (i64::from(bearing.angle.0) - truth).unsigned_abs();
                assert!(off <= u64::from(TWO_TICKS), "{off} units off at {clock} Hz");
                seen += 1;
            }
            // The first cycle's wait for the ends of their slots.
            assert!(seen >= 32);
        }
    }

    #[test]
    fn a_sweep_is_stamped_at_its_middle_or_at_its_rise() {
        let cycle = Cycle::TYPICAL;
        let rise = Config { stamp: Stamp::Rise, ..CONFIG };
        let (_, pulse) = cycle.pulse(8, 2);
        let mut state = after(cycle, 0, 8);
        for index in 0..2 {
            step(&CONFIG, &mut state, cycle.pulse(8, index).1);
        }
        let middle = sweep_of(step(&CONFIG, &mut state.clone(), pulse));
        let rise = sweep_of(step(&rise, &mut state, pulse));
        let (Some(middle), Some(rise)) = (middle, rise) else { panic!("a sweep was not understood") };
        assert_eq!(rise.at, pulse.start);
        assert_eq!(middle.at, pulse.start.after(Span(pulse.width.0 / 2)));
        assert_eq!(middle.since_sync.0 - rise.since_sync.0, pulse.width.0 / 2);
    }

    #[test]
    fn a_pulse_shorter_than_the_shortest_sweep_is_none_and_is_counted() {
        let cycle = Cycle::TYPICAL;
        let (_, pulse) = cycle.pulse(8, 2);
        // The last unit that is no longer than the pulse, and the first that is.
        let fits = pulse.width.0 * 8192 / cycle.span(HALF_TURN).0;
        for (shortest_sweep, too_short) in [(fits, 0), (fits + 1, 1)] {
            let config = Config { shortest_sweep, ..CONFIG };
            let mut state = after(cycle, 0, 8);
            for index in 0..2 {
                step(&config, &mut state, cycle.pulse(8, index).1);
            }
            let before = state.counts().too_short;
            let sweep = sweep_of(step(&config, &mut state, pulse));
            assert_eq!((sweep.is_none(), state.counts().too_short - before), (too_short == 1, too_short));
        }
    }

    #[test]
    fn a_clock_that_drifts_is_followed() {
        // 0.1 % a second is far more than an RC oscillator does while it warms up.
        let mut state = State::default();
        let mut start = Cycle::TYPICAL.start;
        let mut understood = 0;
        for slot in 0..240u32 {
            let clock = 10_000_000 + slot * 10_000 / 120;
            let cycle = Cycle { clock, start: 0, ..Cycle::TYPICAL };
            // This slot alone, moved to where the slower slots before it ended.
            let zero = cycle.pulse(slot, 0).1.start;
            for index in 0..3 {
                let (truth, pulse) = cycle.pulse(slot, index);
                let moved = Pulse { start: pulse.start.before(Span(zero.0.wrapping_sub(start))), ..pulse };
                let light = step(&CONFIG, &mut state, moved);
                if slot >= SETTLED {
                    // The half turn is up to 0.1 s old, so in each turn its flash comes 0.01 % of a turn, 17 ticks, further
                    // from where it is expected. Half of that is made good each time, which leaves 17 ticks; and a
                    // tick is cut off.
                    assert_understood_within(18, &cycle, truth, moved, light);
                    understood += 1;
                }
            }
            start += cycle.span(HALF_TURN).0;
        }
        assert_eq!(understood, 3 * (240 - SETTLED));
    }

    #[test]
    fn half_of_all_pulses_lost_only_delay_the_cycle() {
        let cycle = Cycle::TYPICAL;
        let mut noise = 1u32;
        for first in 0..24 {
            let mut state = State::default();
            let mut slots_until_seen = None;
            for (n, (truth, pulse)) in (0..).zip(cycle.pulses(first, 240)) {
                // What comes next looks random, and is the same every time.
                noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                if noise >> 31 == 0 {
                    continue;
                }
                if let Some(Light::Sync(sync)) = step(&CONFIG, &mut state, pulse) {
                    assert_eq!(truth, Truth::Sync(sync), "from slot {first}");
                    slots_until_seen.get_or_insert(n / 3);
                }
            }
            // Two whole slots in a row are one chance in 16, another whole slot is one in 4: 16 slots and 16 more. Three
            // times that are 0.8 s.
            assert!(slots_until_seen.is_some_and(|slots| slots < 96), "{slots_until_seen:?} slots from {first}");
            assert_eq!(state.counts().locks_lost, 0);
        }
    }

    #[test]
    fn flashes_of_one_rotor_that_come_elsewhere_are_followed() {
        let cycle = Cycle::TYPICAL;
        let later = cycle.span(48 * 12);
        for rotor in 0..2 {
            // Long enough for the receiver to be known.
            let mut state = after(cycle, 0, 4 * SURE);
            for (n, (truth, pulse)) in (0..).zip(cycle.pulses(4 * SURE, 40)) {
                let Truth::Sync(sync) = truth else { continue };
                let is_moved = sync.axis as u32 == rotor;
                let pulse = if is_moved { Pulse { start: pulse.start.after(later), ..pulse } } else { pulse };
                let light = step(&CONFIG, &mut state, pulse);
                // The first might be no flash; a second that agrees is one.
                if !is_moved || n >= 3 * 2 {
                    assert_eq!(light, Some(Light::Sync(sync)), "{n}");
                }
            }
            assert_eq!(state.counts().locks_lost, 0);
        }
    }

    #[test]
    fn a_clock_that_ran_away_in_the_dark_costs_no_data_bit() {
        let cycle = Cycle::TYPICAL;
        // 20 us within 0.1 s are a rate 0.02 % off. The width of a flash tells its bit, wherever it is.
        for by in [-200, -160, -110, -60, 60, 110, 160, 200] {
            for dark in 12..16 {
                // Long enough for the receiver to be known.
                let mut state = after(cycle, 0, 4 * SURE);
                for (n, (truth, pulse)) in (0..).zip(cycle.pulses(4 * SURE + dark, 40)) {
                    let start = pulse.start.after(Span(0u32.wrapping_add_signed(by)));
                    let light = step(&CONFIG, &mut state, Pulse { start, ..pulse });
                    if let Truth::Sync(sync) = truth {
                        assert_eq!(light, Some(Light::Sync(sync)), "{n} {by} {dark}");
                    }
                }
                assert_eq!(state.counts().locks_lost, 0);
            }
        }
    }

    #[test]
    fn flashes_from_before_a_wrap_of_the_counter_are_no_light() {
        let cycle = Cycle::TYPICAL;
        let mut state = State::default();
        for (_, pulse) in cycle.pulses(0, 1).take(2) {
            step(&CONFIG, &mut state, pulse);
        }
        // A whole wrap and a half turn later a pair of flashes would be one half turn after the others.
        let dark = 1 << 28;
        for quarter in 1..16 {
            assert_eq!(expire(&mut state, cycle.ticks(0).after(Span(dark * quarter))), None);
        }
        assert_eq!(state.status(cycle.ticks(3 * HALF_TURN)), Status::NoLight);
        for (_, pulse) in cycle.pulses(1, 1).take(2) {
            step(&CONFIG, &mut state, pulse);
        }
        assert_eq!(state.half_turn(), None);
    }

    #[test]
    fn a_lost_flash_costs_nothing_else() {
        let cycle = Cycle::TYPICAL;
        for lost in 0..2 {
            for lost_slot in SETTLED..SETTLED + 4 {
                let mut state = after(cycle, 0, lost_slot);
                for (n, (truth, pulse)) in (0..).zip(cycle.pulses(lost_slot, 4)) {
                    if n != lost {
                        let light = step(&CONFIG, &mut state, pulse);
                        match truth {
                            Truth::Sync(_) => assert_understood(&cycle, truth, pulse, light),
                            Truth::Sweep(..) => {
                                let Some(sweep) = sweep_of(light) else { panic!("lost with its flash") };
                                let Truth::Sweep(station, axis) = truth else { continue };
                                assert_eq!((sweep.station, sweep.axis), (station, axis));
                                let span = cycle.span(u64::from(cycle.sweep_after[station as usize][axis as usize]));
                                // Its flash was predicted: a few ticks.
                                assert!(sweep.since_sync.0.abs_diff(span.0) <= 4);
                            }
                        }
                    }
                }
                assert_eq!(state.counts().locks_lost, 0);
            }
        }
    }

    #[test]
    fn one_station_out_of_sight_leaves_the_other_its_sweeps() {
        let cycle = Cycle::TYPICAL;
        for hidden in [Station::A, Station::B] {
            let mut state = after(cycle, 0, 8);
            let mut sweeps = 0;
            for (truth, pulse) in cycle.pulses(8, 40) {
                let of = match truth {
                    Truth::Sync(sync) => sync.station,
                    Truth::Sweep(station, _) => station,
                };
                if of == hidden {
                    continue;
                }
                let light = step(&CONFIG, &mut state, pulse);
                if let Truth::Sweep(station, axis) = truth {
                    let Some(sweep) = sweep_of(light) else { panic!("the visible station was lost") };
                    assert_eq!((sweep.station, sweep.axis), (station, axis));
                    sweeps += 1;
                }
            }
            assert_eq!(sweeps, 20);
            assert_eq!(state.counts().locks_lost, 0);
        }
    }

    #[test]
    fn a_short_darkness_is_bridged() {
        let cycle = Cycle::TYPICAL;
        let mut state = after(cycle, 0, 12);
        let again = 12 + COAST_HALF_TURNS - 2;
        for (n, (truth, pulse)) in (0..).zip(cycle.pulses(again, 8)) {
            let light = step(&CONFIG, &mut state, pulse);
            // Where the lasers are is an open question again, for a cycle.
            if matches!(truth, Truth::Sync(_)) || n >= 12 {
                assert_understood(&cycle, truth, pulse, light);
            }
        }
    }

    #[test]
    fn a_long_darkness_is_said_and_the_cycle_found_again() {
        let cycle = Cycle::TYPICAL;
        let mut state = after(cycle, 0, 8);
        let again = 8 + COAST_HALF_TURNS + 10;
        let (_, pulse) = cycle.pulse(again, 0);
        assert_eq!(step(&CONFIG, &mut state, pulse), Some(Light::Lost));
        assert_eq!(state.half_turn(), None);
        for (_, pulse) in cycle.pulses(again, SETTLED).skip(1) {
            assert_ne!(step(&CONFIG, &mut state, pulse), Some(Light::Lost));
        }
        for (truth, pulse) in cycle.pulses(again + SETTLED, 4) {
            assert_understood(&cycle, truth, pulse, step(&CONFIG, &mut state, pulse));
        }
        assert_eq!(state.counts().locks_lost, 1);
    }

    #[test]
    fn darkness_is_noticed_without_a_pulse() {
        let cycle = Cycle::TYPICAL;
        let mut state = after(cycle, 0, 8);
        let coast = u64::from(COAST_HALF_TURNS);
        assert_eq!(expire(&mut state, cycle.ticks(9 * HALF_TURN)), None);
        assert_eq!(expire(&mut state, cycle.ticks((6 + coast) * HALF_TURN)), None);
        assert_eq!(expire(&mut state, cycle.ticks((10 + coast) * HALF_TURN)), Some(Light::Lost));
        assert_eq!(expire(&mut state, cycle.ticks((11 + coast) * HALF_TURN)), None);
        assert_eq!(state.counts().locks_lost, 1);
    }

    #[test]
    fn a_slot_without_a_sweep_is_said_once() {
        let cycle = Cycle::TYPICAL;
        let mut state = after(cycle, 0, 8);
        step(&CONFIG, &mut state, cycle.pulse(8, 0).1);
        assert!(matches!(state.closed(), Some(Closed::Sweep(_))));
        step(&CONFIG, &mut state, cycle.pulse(8, 1).1);
        assert_eq!(state.closed(), None);
        step(&CONFIG, &mut state, cycle.pulse(9, 0).1);
        assert_eq!(state.closed(), state.half_turn().map(Closed::Dark));
        assert_eq!(state.closed(), None);
        for index in 1..3 {
            step(&CONFIG, &mut state, cycle.pulse(9, index).1);
        }
        step(&CONFIG, &mut state, cycle.pulse(10, 0).1);
        assert_eq!(state.closed(), None);
    }

    #[test]
    fn stray_light_is_counted_and_changes_nothing() {
        let cycle = Cycle::TYPICAL;
        let mut state = after(cycle, 0, 8);
        let mut turned_away = state.counts().turned_away;
        for slot in 8..16 {
            for index in 0..3 {
                let (truth, pulse) = cycle.pulse(slot, index);
                assert_understood(&cycle, truth, pulse, step(&CONFIG, &mut state, pulse));
                // 100 us of other light, 500 us after each flash and sweep.
                let stray = Pulse { start: pulse.start.after(cycle.span(48 * 500)), width: cycle.span(48 * 100) };
                // Between the flashes there is no room for one.
                if index > 0 {
                    assert_eq!(step(&CONFIG, &mut state, stray), None);
                    turned_away += 1;
                }
            }
        }
        assert_eq!(state.counts().turned_away, turned_away);
    }

    #[test]
    fn stray_light_does_not_hide_the_cycle_from_the_search() {
        let cycle = Cycle::TYPICAL;
        let mut state = State::default();
        for (truth, pulse) in cycle.pulses(0, 12) {
            let light = step(&CONFIG, &mut state, pulse);
            if matches!(truth, Truth::Sync(Sync { station: Station::B, .. })) {
                let stray = Pulse { start: pulse.start.after(cycle.span(48 * 500)), width: cycle.span(48 * 90) };
                step(&CONFIG, &mut state, stray);
            }
            if pulse.start.since(cycle.ticks(0)) > cycle.span(u64::from(2 * LOCKED) * HALF_TURN) {
                assert_understood(&cycle, truth, pulse, light);
            }
        }
    }

    #[test]
    fn a_second_sweep_in_a_slot_is_a_reflection() {
        let cycle = Cycle::TYPICAL;
        let mut state = after(cycle, 0, 8);
        let seconds = state.counts().seconds;
        for (truth, pulse) in cycle.pulses(8, 4) {
            assert_understood(&cycle, truth, pulse, step(&CONFIG, &mut state, pulse));
            if let Truth::Sweep(..) = truth {
                let echo = Pulse { start: pulse.start.after(cycle.span(48 * 300)), ..pulse };
                assert_eq!(step(&CONFIG, &mut state, echo), None);
            }
        }
        assert_eq!(state.counts().seconds, seconds + 4);
    }

    #[test]
    fn a_receiver_that_shortens_every_flash_is_understood() {
        let cycle = Cycle::TYPICAL;
        let shorter = cycle.span(48 * 9);
        let mut state = State::default();
        for (n, (truth, pulse)) in (0..).zip(cycle.pulses(0, 40)) {
            let width = match truth {
                Truth::Sync(_) => Span(pulse.width.0 - shorter.0),
                Truth::Sweep(..) => pulse.width,
            };
            let light = step(&CONFIG, &mut state, Pulse { width, ..pulse });
            if n >= 3 * SETTLED {
                assert_understood(&cycle, truth, pulse, light);
            }
        }
    }

    #[test]
    fn any_single_pulse_may_be_missing() {
        let cycle = Cycle::TYPICAL;
        for missing in 0..12 {
            let mut state = after(cycle, 0, SETTLED);
            for (n, (truth, pulse)) in (0..).zip(cycle.pulses(SETTLED, 12)) {
                if n != missing {
                    assert_understood(&cycle, truth, pulse, step(&CONFIG, &mut state, pulse));
                }
            }
            assert_eq!(state.counts().locks_lost, 0);
        }
    }

    #[test]
    fn any_single_pulse_may_be_added() {
        let cycle = Cycle::TYPICAL;
        // Like a sweep, too short, between the two, like a flash, too long; everywhere, and just before each pulse.
        let mut tried = 0;
        for width in [48 / 2, 480, 1_700, 3_500, 5_000, 9_000] {
            for place in 0..100 {
                let at = match place {
                    0..76 => place * 4 * HALF_TURN / 76,
                    // The gap to what it precedes is 5 us.
                    _ => {
                        let (slot, index) = ((place - 76) / 6, (place - 76) % 6 / 2);
                        let of_b = if slot < 2 { 20_000 } else { 0 };
                        let sweep = u64::from(cycle.sweep_after[usize::from(slot < 2)][slot as usize % 2]);
                        let before = 240 * (1 + place % 2 * 12) + width;
                        (4 + slot) * HALF_TURN + [0, 20_000, of_b + sweep - 240][index as usize] - before
                    }
                } + (u64::from(SURE) - if place < 76 { 0 } else { 4 }) * HALF_TURN;
                let added = Pulse { start: cycle.ticks(at), width: cycle.span(width) };
                // What would overlap is one pulse to a photodiode.
                let overlaps = |pulse: Pulse| {
                    let apart = pulse.start.offset_from(added.start);
                    apart <= added.width.0 as i32 && -apart <= pulse.width.0 as i32
                };
                if cycle.pulses(SURE - 1, 13).any(|(_, pulse)| overlaps(pulse)) {
                    continue;
                }
                tried += 1;
                let mut state = after(cycle, 0, SURE - 1);
                let mut was_added = false;
                for (truth, pulse) in cycle.pulses(SURE - 1, 13) {
                    let is_next = !was_added && pulse.start.offset_from(added.start) >= 0;
                    if is_next {
                        was_added = true;
                        let light = step(&CONFIG, &mut state, added);
                        assert!(matches!(light, None | Some(Light::Sweep(_))), "{light:?} for {width} at {at}");
                    }
                    let light = step(&CONFIG, &mut state, pulse);
                    match truth {
                        Truth::Sync(_) => assert_understood(&cycle, truth, pulse, light),
                        // The added one may have been the nearer, once.
                        Truth::Sweep(..) if light.is_some() => assert_understood(&cycle, truth, pulse, light),
                        Truth::Sweep(..) => {}
                    }
                }
                for (truth, pulse) in cycle.pulses(SURE + 12, 4) {
                    assert_understood(&cycle, truth, pulse, step(&CONFIG, &mut state, pulse));
                }
                assert_eq!(state.counts().locks_lost, 0);
            }
        }
        assert!(tried > 400, "{tried}");
    }

    #[test]
    fn one_displaced_flash_changes_no_angle_by_a_fiftieth_of_a_degree() {
        // 0.02 degrees are 0.93 us, 10 ticks.
        let cycle = Cycle::TYPICAL;
        for displaced in 0..12 {
            for by in [-400, -100, -40, -20, -10, 10, 20, 40, 100, 400] {
                let mut state = after(cycle, 0, SURE);
                for (n, (truth, pulse)) in (0..).zip(cycle.pulses(SURE, 12)) {
                    let is_flash = matches!(truth, Truth::Sync(_));
                    if n == displaced && is_flash {
                        let moved = Pulse { start: pulse.start.after(Span(0u32.wrapping_add_signed(by))), ..pulse };
                        step(&CONFIG, &mut state, moved);
                    } else if let Some(light) = step(&CONFIG, &mut state, pulse)
                        && !is_flash
                    {
                        assert_understood_within(8, &cycle, truth, pulse, Some(light));
                    }
                }
            }
        }
    }

    #[test]
    fn the_longest_of_several_sweeps_is_chosen_and_a_mirror_is_left() {
        let cycle = Cycle::TYPICAL;
        // The direct light is blocked at first, and a mirror is believed.
        let mirrored =
            |pulse: Pulse| Pulse { start: pulse.start.after(cycle.span(48 * 900)), width: cycle.span(48 * 4) };
        let mut state = State::default();
        for (truth, pulse) in cycle.pulses(0, 2 * SETTLED) {
            let pulse = if matches!(truth, Truth::Sweep(..)) { mirrored(pulse) } else { pulse };
            step(&CONFIG, &mut state, pulse);
        }
        // Then it comes as well: earlier, longer.
        for (n, (truth, pulse)) in (0..).zip(cycle.pulses(2 * SETTLED, 16)) {
            let light = step(&CONFIG, &mut state, pulse);
            if let Truth::Sweep(..) = truth {
                assert!(n >= 12 && light.is_some() || n < 12 && light.is_none(), "{n} {light:?}");
                assert_eq!(step(&CONFIG, &mut state, mirrored(pulse)), None);
            } else if n > 0 && n < 15 && n % 3 == 0 {
                assert!(matches!(state.closed(), Some(Closed::Sweep(sweep)) if sweep.since_sync.0 > 0) == (n <= 12));
            }
        }
    }

    #[test]
    fn a_station_alone_is_a_and_sweeps_in_every_slot() {
        let cycle = Cycle::TYPICAL;
        let mut state = State::default();
        let mut sweeps = 0;
        for slot in 0..64u32 {
            // The flash and sweep that A has in its own slots, with data that repeats nothing.
            let data = 0x35a6_c1d2_7be8_904fu64 >> slot & 1 == 1;
            let axis = if slot % 2 == 0 { Axis::Azimuth } else { Axis::Elevation };
            let sync = Sync { station: Station::A, axis, skip: false, data };
            let start = cycle.ticks(u64::from(slot) * HALF_TURN);
            let flash = Pulse { start, width: cycle.span(width(sync)) };
            let light = step(&CONFIG, &mut state, flash);
            if slot >= 20 {
                assert_eq!(light, Some(Light::Sync(sync)), "{slot}");
            }
            let after = u64::from(cycle.sweep_after[0][axis as usize]);
            let sweep = Pulse { start: start.after(cycle.span(after - 240)), width: cycle.span(480) };
            if let Some(Light::Sweep(sweep)) = step(&CONFIG, &mut state, sweep) {
                assert_eq!((sweep.station, sweep.axis), (Station::A, axis));
                sweeps += 1;
            }
        }
        assert!(sweeps >= 40, "{sweeps}");
        assert_eq!(state.status(cycle.ticks(64 * HALF_TURN)), Status::Locked);
    }

    #[test]
    fn one_of_a_pair_is_nobody_until_it_is_named() {
        let cycle = Cycle::TYPICAL;
        for shown in [Station::A, Station::B] {
            let seen = |first| {
                cycle.pulses(first, 60).filter(move |(truth, _)| match truth {
                    Truth::Sync(sync) => sync.station == shown,
                    Truth::Sweep(station, _) => *station == shown,
                })
            };
            let mut state = State::default();
            for (_, pulse) in seen(0) {
                assert_eq!(step(&CONFIG, &mut state, pulse), None);
            }
            assert_eq!(state.status(cycle.ticks(60 * HALF_TURN)), Status::OneStation);
            state.name(shown);
            let mut sweeps = 0;
            for (truth, pulse) in seen(60) {
                match (truth, step(&CONFIG, &mut state, pulse)) {
                    (Truth::Sweep(station, axis), Some(Light::Sweep(sweep))) => {
                        assert_eq!((sweep.station, sweep.axis), (station, axis));
                        sweeps += 1;
                    }
                    (Truth::Sync(sync), Some(Light::Sync(seen))) => {
                        assert_eq!((seen.axis, seen.skip), (sync.axis, sync.skip))
                    }
                    _ => {}
                }
            }
            assert!(sweeps >= 24, "{sweeps}");
            // And the other comes back.
            for (truth, pulse) in cycle.pulses(120, 40) {
                step(&CONFIG, &mut state, pulse);
                let _ = truth;
            }
            for (truth, pulse) in cycle.pulses(160, 8) {
                let light = step(&CONFIG, &mut state, pulse);
                if let Truth::Sync(_) = truth {
                    assert_understood(&cycle, truth, pulse, light);
                }
            }
        }
    }

    #[test]
    fn one_of_a_pair_that_the_room_names_gives_its_sweeps() {
        let cycle = Cycle::TYPICAL;
        for lone in [Station::A, Station::B] {
            let config = Config { lone: Some(lone), ..CONFIG };
            let mut state = State::default();
            let mut sweeps = 0;
            for (truth, pulse) in cycle.pulses(0, 64) {
                let of = match truth {
                    Truth::Sync(sync) => sync.station,
                    Truth::Sweep(station, _) => station,
                };
                if of != lone {
                    continue;
                }
                match (truth, step(&config, &mut state, pulse)) {
                    (Truth::Sync(sync), Some(Light::Sync(seen))) => assert_eq!(sync, seen),
                    (Truth::Sweep(station, axis), Some(Light::Sweep(sweep))) => {
                        assert_eq!((sweep.station, sweep.axis), (station, axis));
                        sweeps += 1;
                    }
                    _ => {}
                }
            }
            // Half of the slots are its own; the first few find the cycle.
            assert!(sweeps >= 20, "{sweeps} of {lone:?}");
        }
    }

    #[test]
    fn stations_350_to_450_microseconds_apart_are_a_pair_and_no_others() {
        let cycle = Cycle::TYPICAL;
        for (gap, is_pair) in [(340, false), (350, true), (380, true), (417, true), (450, true), (460, false)] {
            let mut state = State::default();
            for (truth, pulse) in cycle.pulses(0, 40) {
                let of = match truth {
                    Truth::Sync(sync) => sync.station,
                    Truth::Sweep(station, _) => station,
                };
                let start = match of {
                    Station::A => pulse.start,
                    Station::B => pulse.start.before(cycle.span(20_000)).after(cycle.span(48 * gap)),
                };
                step(&CONFIG, &mut state, Pulse { start, ..pulse });
            }
            let status = state.status(cycle.ticks(40 * HALF_TURN));
            assert_eq!(status, if is_pair { Status::Locked } else { Status::Spacing }, "{gap} us");
        }
    }

    #[test]
    fn light_that_returns_is_understood_within_100_ms_whenever_it_does() {
        let cycle = Cycle::TYPICAL;
        for dark in [60, 1_200] {
            for phase in 0..12u32 {
                let mut state = after(cycle, 0, SURE);
                let mut slots_until_seen = None;
                for (n, (truth, pulse)) in (phase..).zip(cycle.pulses(SURE + dark, 17).skip(phase as usize)) {
                    let light = step(&CONFIG, &mut state, pulse);
                    if slots_until_seen.is_some() && matches!(truth, Truth::Sync(_)) {
                        assert_understood(&cycle, truth, pulse, light);
                    }
                    if matches!(light, Some(Light::Sync(_))) && slots_until_seen.is_none() {
                        slots_until_seen = Some((n - phase) / 3);
                    }
                }
                // 12 slots are 100 ms.
                assert!(slots_until_seen.is_some_and(|slots| slots < 12), "{slots_until_seen:?} slots from {phase}");
                assert_eq!(state.counts().locks_lost, 1);
            }
        }
    }

    #[test]
    fn the_cycle_is_known_after_four_cycles_with_a_pulse_too_many_wherever_the_mote_wakes() {
        let cycle = Cycle::TYPICAL;
        for phase in 0..12u32 {
            for width in [480, 1_700, 4_500] {
                // Anywhere in the slots that the search looks at, and a little beyond.
                for place in 0..60 {
                    let at = u64::from(phase) * HALF_TURN / 3 + place * 8 * HALF_TURN / 60;
                    let added = Pulse { start: cycle.ticks(at), width: cycle.span(width) };
                    let overlaps = |pulse: Pulse| {
                        let apart = pulse.start.offset_from(added.start);
                        apart <= added.width.0 as i32 && -apart <= pulse.width.0 as i32
                    };
                    if cycle.pulses(0, 14).any(|(_, pulse)| overlaps(pulse)) {
                        continue;
                    }
                    let mut state = State::default();
                    let mut was_added = false;
                    for (n, (truth, pulse)) in (phase..).zip(cycle.pulses(0, 24).skip(phase as usize)) {
                        if !was_added && pulse.start.offset_from(added.start) >= 0 {
                            was_added = true;
                            step(&CONFIG, &mut state, added);
                        }
                        let light = step(&CONFIG, &mut state, pulse);
                        if n >= phase + 48 && (light.is_some() || matches!(truth, Truth::Sync(_))) {
                            assert_understood(&cycle, truth, pulse, light);
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn why_there_is_no_lock_is_said() {
        let cycle = Cycle::TYPICAL;
        let status = |length: u64, width: u64, every: u64| {
            let mut state = State::default();
            for n in 0..length {
                let pulse = Pulse { start: cycle.ticks(n * every), width: cycle.span(width) };
                step(&CONFIG, &mut state, pulse);
            }
            (state.status(cycle.ticks(length * every)), state.status(cycle.ticks(length * every + 400 * HALF_TURN)))
        };
        assert_eq!(status(0, 0, 0), (Status::NoLight, Status::NoLight));
        // Two sweeps of 5 us per turn of 20 ms.
        assert_eq!(status(30, 240, 480_000), (Status::V2, Status::NoLight));
        // A remote control: 9 us of every 26.
        assert_eq!(status(30, 430, 1_250), (Status::Widths, Status::NoLight));
        // Flashes 600 us apart.
        let mut state = State::default();
        for slot in 0..20 {
            for (index, at) in [(0, 0), (1, 600 * 48)] {
                let pulse = cycle.pulse(slot, index).1;
                let start = cycle.ticks(u64::from(slot) * HALF_TURN + at);
                step(&CONFIG, &mut state, Pulse { start, ..pulse });
            }
        }
        assert_eq!(state.status(cycle.ticks(20 * HALF_TURN)), Status::Spacing);
        let state = after(cycle, 0, SETTLED);
        assert_eq!(state.status(cycle.ticks(u64::from(SETTLED) * HALF_TURN)), Status::Locked);
    }
}
