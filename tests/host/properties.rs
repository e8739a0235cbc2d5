//! What holds for any light at all, not only for the examples.

use proptest::prelude::*;

use crate::angle;
use crate::edge::{Edge, Level};
use crate::frame::{self, ANGLES_LEN, Angles, Header, Health, LEN, Losses, Measured, Message, Rejects, Report};
use crate::on_target::cycle::{Cycle, HALF_TURN};
use crate::pulse::{self, Pulse};
use crate::sweep::{self, Axis, Closed, HALF_TURN_BITS, HalfTurn, Light, Station, Sweep};
use crate::time::{Span, Ticks};
use crate::track::Level as Known;

const CONFIG: sweep::Config = sweep::Config::DEFAULT;

/// Everything that pulses give, at once and at the ends of slots, and the pulses they gave it for.
fn lights(pulses: impl IntoIterator<Item = Pulse>) -> Vec<(Pulse, Option<Light>)> {
    let mut state = sweep::State::default();
    let mut lights = Vec::new();
    for pulse in pulses {
        let light = sweep::step(&CONFIG, &mut state, pulse);
        lights.push((pulse, light));
        if !matches!(light, Some(Light::Sweep(_)))
            && let Some(Closed::Sweep(sweep)) = state.closed()
        {
            lights.push((pulse, Some(Light::Sweep(sweep))));
        }
    }
    lights
}

/// Everything that edges give.
fn pulses(edges: impl IntoIterator<Item = Edge>) -> Vec<Pulse> {
    let mut state = pulse::State::default();
    edges.into_iter().filter_map(|edge| pulse::step(&mut state, edge)).collect()
}

/// The two edges of a pulse.
fn edges(pulse: Pulse) -> [Edge; 2] {
    [Edge::rise(pulse.start), Edge::fall(pulse.start.after(pulse.width))]
}

/// The same light, seen by a counter that started `by` ticks earlier.
fn shifted(light: Option<Light>, by: u32) -> Option<Light> {
    light.map(|light| match light {
        Light::Sweep(sweep) => Light::Sweep(Sweep { at: sweep.at.after(Span(by)), ..sweep }),
        other => other,
    })
}

/// The angles of 40 slots, in their order.
fn angles(cycle: Cycle) -> Vec<(Station, Axis, i32)> {
    let mut state = angle::State::default();
    let mut bearing = |sweep| angle::step(&angle::Config::default(), &mut state, sweep);
    lights(cycle.pulses(0, 40).map(|(_, pulse)| pulse))
        .into_iter()
        .filter_map(|(_, light)| match light? {
            Light::Sweep(sweep) => bearing(sweep).map(|bearing| (bearing.station, bearing.axis, bearing.angle.0)),
            _ => None,
        })
        .collect()
}

/// Any edge at any time: the worst that a broken counter can do.
fn any_edge() -> impl Strategy<Value = Edge> {
    (any::<u32>(), any::<bool>())
        .prop_map(|(at, lit)| Edge { at: Ticks(at), level: if lit { Level::Lit } else { Level::Dark } })
}

/// Times from one pulse to the next, and widths, that have something to do with the cycle: so that windows are hit.
fn plausible_pulses() -> impl Strategy<Value = Vec<Pulse>> {
    let step = prop_oneof![
        Just(4_509u32),
        Just(90_167),
        Just(85_658),
        4_000..5_000u32,
        80_000..95_000u32,
        0..200_000u32,
        any::<u32>()
    ];
    let width = prop_oneof![600..1_600u32, 10..300u32, any::<u32>()];
    (any::<u32>(), prop::collection::vec((step, width), 0..200)).prop_map(|(start, parts)| {
        let mut at = Ticks(start);
        parts
            .into_iter()
            .map(|(step, width)| {
                at = at.after(Span(step));
                Pulse { start: at, width: Span(width) }
            })
            .collect()
    })
}

/// A real cycle in which pulses are missing, strays shine, and edges jitter.
fn disturbed_cycle() -> impl Strategy<Value = Vec<Pulse>> {
    let fate = prop_oneof![8 => Just(0u8), 1 => Just(1), 1 => Just(2)];
    let clock = 9_000_000..12_000_000u32;
    (clock, any::<u32>(), prop::collection::vec((fate, -50..50i32, 0..40_000u32), 3 * 60)).prop_map(
        |(clock, start, fates)| {
            let cycle = Cycle { clock, start, ..Cycle::TYPICAL };
            let mut seen = Vec::new();
            for ((_, pulse), (fate, jitter, elsewhere)) in cycle.pulses(0, 60).zip(fates) {
                let pulse = Pulse { start: Ticks(pulse.start.0.wrapping_add_signed(jitter)), ..pulse };
                if fate != 1 {
                    seen.push(pulse);
                }
                if fate == 2 {
                    seen.push(Pulse { start: pulse.start.after(Span(2_000 + elsewhere % 2_000)), width: pulse.width });
                }
            }
            seen
        },
    )
}

/// Two sweeps without a loss between them are of different slots: a quarter of the half turn apart at least, and
/// never the same rotor twice in a row.
fn assert_one_sweep_per_slot(lights: &[(Pulse, Option<Light>)]) -> Result<(), TestCaseError> {
    let mut last: Option<Sweep> = None;
    for (_, light) in lights {
        match light {
            Some(Light::Sweep(sweep)) => {
                prop_assert!(sweep.since_sync < sweep.half_turn.span());
                if let Some(last) = last {
                    let apart = sweep.at.since(last.at);
                    prop_assert!(apart.0 > sweep.half_turn.span().0 / 4, "{last:?} then {sweep:?}");
                    let turn = (sweep.station, sweep.axis);
                    let half_a_cycle = sweep.half_turn.span().0 * 2;
                    prop_assert!(apart.0 > half_a_cycle || turn != (last.station, last.axis));
                }
                last = Some(*sweep);
            }
            Some(Light::Lost) => last = None,
            _ => {}
        }
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn arbitrary_edges_never_panic_and_give_one_sweep_per_slot(edges in prop::collection::vec(any_edge(), 0..400)) {
        assert_one_sweep_per_slot(&lights(pulses(edges)))?;
    }

    #[test]
    fn plausible_light_gives_one_sweep_per_slot(pulses in plausible_pulses()) {
        assert_one_sweep_per_slot(&lights(pulses))?;
    }

    #[test]
    fn a_disturbed_cycle_gives_one_sweep_per_slot(pulses in disturbed_cycle()) {
        assert_one_sweep_per_slot(&lights(pulses))?;
    }

    #[test]
    fn darkness_may_be_asked_for_at_any_time(pulses in plausible_pulses(), at in prop::collection::vec(any::<u32>(), 200)) {
        let mut state = sweep::State::default();
        for (pulse, at) in pulses.into_iter().zip(at) {
            sweep::step(&CONFIG, &mut state, pulse);
            sweep::expire(&mut state, Ticks(at));
        }
    }

    #[test]
    fn the_counter_may_start_anywhere(
        pulses in prop_oneof![disturbed_cycle(), plausible_pulses()], by in any::<u32>(),
    ) {
        let moved = pulses.iter().map(|pulse| Pulse { start: pulse.start.after(Span(by)), ..*pulse });
        let there: Vec<_> = lights(moved).into_iter().map(|(_, light)| light).collect();
        let here: Vec<_> = lights(pulses).into_iter().map(|(_, light)| shifted(light, by)).collect();
        prop_assert_eq!(here, there);
    }

    #[test]
    fn the_clock_changes_no_angle(percent in 50..=200u32, sweep_after in prop::array::uniform2(prop::array::uniform2(80_000..320_000u32))) {
        let nominal = Cycle { clock: 10_000_000, sweep_after, ..Cycle::TYPICAL };
        let scaled = Cycle { clock: nominal.clock / 100 * percent, ..nominal };
        let (nominal, there) = (angles(nominal), angles(scaled));
        prop_assert_eq!(nominal.len(), there.len());
        // Each angle is off by at most two and a half ticks of its own clock: a sweep's start and its flash are cut to
        // whole ticks, which is one between them, so is its width, of which half counts, and the half turn is known to
        // one (`the_half_turn_is_measured_to_a_tick`), which counts for less than its whole.
        let tick = |clock: u32| (1 << HALF_TURN_BITS) / (clock / 120) as i32 + 1;
        let off = 5 * (tick(10_000_000) + tick(scaled.clock)) / 2;
        for (here, there) in nominal.iter().zip(&there) {
            prop_assert_eq!((here.0, here.1), (there.0, there.1));
            prop_assert!((here.2 - there.2).abs() <= off, "{} and {}", here.2, there.2);
        }
    }

    #[test]
    fn any_sweep_gives_an_angle_in_view_or_none(ticks_q8 in 1u32 << 21..=1 << 28, spans in prop::collection::vec(any::<u32>(), 1..50)) {
        let mut state = angle::State::default();
        let half_turn = HalfTurn::from_ticks_q8(ticks_q8).expect("in range");
        for since_sync in spans {
            let sweep = Sweep {
                station: if since_sync & 1 == 0 { Station::A } else { Station::B },
                axis: if since_sync & 2 == 0 { Axis::Azimuth } else { Axis::Elevation },
                at: Ticks(since_sync),
                since_sync: Span(since_sync),
                half_turn,
            };
            if let Some(bearing) = angle::step(&angle::Config::default(), &mut state, sweep) {
                prop_assert!(bearing.angle.0.abs() <= angle::FIELD_OF_VIEW);
                prop_assert!(since_sync < half_turn.span().0);
            }
        }
    }

    #[test]
    fn the_half_turn_is_measured_to_a_tick(clock in 1_000_000..100_000_000u32) {
        let cycle = Cycle { clock, ..Cycle::TYPICAL };
        let mut state = sweep::State::default();
        for (_, pulse) in cycle.pulses(0, 40) {
            sweep::step(&CONFIG, &mut state, pulse);
        }
        let truth_q8 = cycle.span(HALF_TURN << 8).0;
        let half_turn = state.half_turn().map_or(0, HalfTurn::ticks_q8);
        prop_assert!(half_turn.abs_diff(truth_q8) <= 1 << 8, "{} for {}", half_turn, truth_q8);
    }

    #[test]
    fn one_lost_edge_costs_one_pulse(lost in 0..2 * 3 * 16usize) {
        let whole: Vec<Edge> = Cycle::TYPICAL.pulses(0, 16).flat_map(|(_, pulse)| edges(pulse)).collect();
        let mut holed = whole.clone();
        holed.remove(lost);
        let (whole, holed) = (pulses(whole), pulses(holed));
        prop_assert_eq!(holed.len() + 1, whole.len());
        prop_assert!(holed.iter().all(|pulse| whole.contains(pulse)));
    }

    #[test]
    fn one_doubled_edge_costs_at_most_one_pulse(doubled in 0..2 * 3 * 16usize, later in 0..100u32) {
        let mut twice: Vec<Edge> = Cycle::TYPICAL.pulses(0, 16).flat_map(|(_, pulse)| edges(pulse)).collect();
        let whole = pulses(twice.clone());
        let echo = Edge { at: twice[doubled].at.after(Span(later)), ..twice[doubled] };
        twice.insert(doubled + 1, echo);
        let twice = pulses(twice);
        prop_assert_eq!(twice.len(), whole.len());
        let changed = twice.iter().filter(|pulse| !whole.contains(pulse)).count();
        prop_assert!(changed <= 1);
    }

    #[test]
    fn reports_come_back_as_they_left(
        (pan, mote, sequence) in any::<(u16, u16, u16)>(),
        (time, half_turn_q8, position) in any::<(u32, u32, [i32; 3])>(),
        (mismatch, age, stations, level) in (any::<u16>(), any::<u16>(), 0..4u8, 0..4usize),
        (velocity, sd) in any::<([i16; 3], [u16; 3])>(),
        [edges, pulses, sweeps, fixes, reports] in any::<[u16; 5]>(),
    ) {
        let header = Header { pan, mote, sequence };
        let report = Report {
            time,
            half_turn_q8,
            position: position.map(fixed::types::I16F16::from_bits),
            mismatch: fixed::types::U0F16::from_bits(mismatch),
            age: fixed::types::U8F8::from_bits(age),
            stations,
            level: [Known::None, Known::Angles, Known::Tracked, Known::Full][level],
            velocity: velocity.map(fixed::types::I6F10::from_bits),
            sd: sd.map(fixed::types::U0F16::from_bits),
            losses: Losses { edges, pulses, sweeps, fixes, reports },
        };
        prop_assert_eq!(frame::parse(&frame::emit(header, &report)), Ok((header, Message::Fix(report))));
    }

    #[test]
    fn health_comes_back_as_it_left(
        (pan, mote, sequence, uptime, half_turn_q8) in any::<(u16, u16, u16, u32, u32)>(),
        (lock, reset, reset_detail) in (0..7usize, 0..6usize, any::<u32>()),
        (syncs, sweeps, waiting) in any::<([u16; 2], [[u16; 2]; 2], [u8; 3])>(),
        counts in any::<[u16; 12]>(),
        stations in prop::array::uniform2((any::<(u32, [u8; 4], i8, bool)>(), 0..3usize)),
    ) {
        use frame::{Factory, Lock, Reset};
        let header = Header { pan, mote, sequence };
        let [edges, strays, widths, short, long, second, outside, geometry, mismatch, disbelieved, reports, locks] = counts;
        let health = Health {
            uptime,
            half_turn_q8,
            lock: [
                Lock::NoLight, Lock::Searching, Lock::Locked, Lock::OneStation, Lock::Spacing, Lock::Widths, Lock::V2,
            ][lock],
            reset: [Reset::PowerOn, Reset::Requested, Reset::Fault, Reset::Panic, Reset::Watchdog, Reset::Image][reset],
            reset_detail,
            syncs,
            sweeps,
            rejects: Rejects {
                edges, strays, widths, short, long, second, outside, geometry, mismatch, disbelieved, reports, locks,
            },
            waiting,
            stations: stations.map(|((id, [good, bad, mode, faults], width_bias, is_stranger), factory)| frame::Station {
                id,
                good,
                bad,
                mode,
                faults,
                width_bias,
                factory: [Factory::File, Factory::Awaited, Factory::Received][factory],
                is_stranger,
            }),
        };
        prop_assert_eq!(frame::parse(&frame::emit_health(header, &health)), Ok((header, Message::Health(health))));
    }

    #[test]
    fn angles_come_back_as_they_left(
        (pan, mote, sequence, half_turn_q8) in any::<(u16, u16, u16, u32)>(),
        sweeps in prop::collection::vec((any::<u32>(), 0..4u8, 0..1u32 << 24), 1..=8),
    ) {
        let header = Header { pan, mote, sequence };
        let mut angles = Angles { half_turn_q8, ..Angles::default() };
        for (time, rotor, share) in sweeps {
            let station = if rotor & 1 == 0 { Station::A } else { Station::B };
            let axis = if rotor & 2 == 0 { Axis::Azimuth } else { Axis::Elevation };
            angles.sweeps.push(Measured { time, station, axis, share }).expect("at most eight");
        }
        let mut bytes = [0; ANGLES_LEN];
        prop_assert_eq!(
            frame::parse(frame::emit_angles(header, &angles, &mut bytes)), Ok((header, Message::Angles(angles)))
        );
    }

    #[test]
    fn the_fcs_is_what_the_standard_makes_of_each_bit(bytes in prop::collection::vec(any::<u8>(), 0..2 * LEN)) {
        let mut crc = 0u16;
        for byte in &bytes {
            for bit in 0..8 {
                let odd = (crc ^ u16::from(byte >> bit)) & 1 != 0;
                crc = crc >> 1 ^ if odd { 0x8408 } else { 0 };
            }
        }
        prop_assert_eq!(frame::fcs(&bytes), crc);
    }

    #[test]
    fn arbitrary_bytes_never_panic_the_parser(bytes in prop::collection::vec(any::<u8>(), 0..2 * LEN)) {
        let _ = frame::parse(&bytes);
    }

    #[test]
    fn bytes_that_parse_are_the_bytes_that_emit_would_write(
        (pan, mote, sequence) in any::<(u16, u16, u16)>(), kind in 0..5u8, length in prop_oneof![Just(66usize), Just(92), (1..=8usize).prop_map(|n| 23 + 8 * n), 0..128usize],
        tail in prop::collection::vec(any::<u8>(), 128), is_tame in any::<bool>(),
    ) {
        // A right envelope and a right check sequence around anything.
        let mut bytes = frame::emit(Header { pan, mote, sequence }, &Report::default())[..17].to_vec();
        bytes[12] = kind;
        bytes.extend(tail);
        bytes.truncate(length.max(19));
        if is_tame {
            // Codes that mean something.
            for at in [25, 26, 33, 41, 49, 57, 65, 73, 79, 81, 89] {
                if let Some(byte) = bytes.get_mut(at) {
                    *byte &= 1;
                }
            }
        }
        let end = bytes.len() - 2;
        let check = frame::fcs(&bytes[..end]).to_le_bytes();
        bytes[end..].copy_from_slice(&check);
        match frame::parse(&bytes) {
            Ok((header, Message::Fix(report))) => prop_assert_eq!(frame::emit(header, &report).to_vec(), bytes),
            Ok((header, Message::Health(health))) => {
                prop_assert_eq!(frame::emit_health(header, &health).to_vec(), bytes);
            }
            Ok((header, Message::Angles(angles))) => {
                prop_assert_eq!(frame::emit_angles(header, &angles, &mut [0; ANGLES_LEN]).to_vec(), bytes);
            }
            Err(_) => {}
        }
    }
}
