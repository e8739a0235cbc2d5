//! Spans to angles: the ratio, the factory phase, the field of view.
#![cfg_attr(target_os = "none", no_std, no_main)]

#[cfg(target_os = "none")]
mod harness;

use lighthouse_mote::angle::{Angle, Config, FIELD_OF_VIEW, Factory, Rotor, State, receive, received, step};
use lighthouse_mote::ootx::{BLOCK_BYTES, Block};
use lighthouse_mote::sweep::{Axis, HALF_TURN_BITS, HalfTurn, Station, Sweep};
use lighthouse_mote::time::{Span, Ticks};

/// Half turns from the slowest clock that the arithmetic holds to the fastest, in ticks.
const HALF_TURNS: [u32; 5] = [HalfTurn::MIN_TICKS, 75_000, 90_167, 133_333, HalfTurn::MAX_TICKS];

fn sweep(half_turn_ticks: u32, since_sync: u32) -> Sweep {
    let Some(half_turn) = HalfTurn::from_ticks_q8(half_turn_ticks << 8) else { panic!("in range") };
    Sweep { station: Station::B, axis: Axis::Elevation, at: Ticks(77), since_sync: Span(since_sync), half_turn }
}

/// A block of zeros but for the elevation rotor's terms, half floats: phase, tilt, gibphase, gibmag.
fn block(terms: [u16; 4]) -> Block {
    let mut bytes = [0; BLOCK_BYTES];
    for (at, term) in [8, 12, 25, 29].into_iter().zip(terms) {
        bytes[at..at + 2].copy_from_slice(&term.to_le_bytes());
    }
    Block::new(bytes)
}

#[cfg_attr(target_os = "none", defmt_test::tests)]
mod tests {
    use super::*;

    #[test]
    fn half_a_half_turn_is_straight_ahead() {
        for ticks in HALF_TURNS {
            let Some(bearing) = step(&Config::default(), &mut State::default(), sweep(ticks, ticks / 2)) else {
                panic!("straight ahead is in view")
            };
            // An odd half turn has no whole half.
            let half_a_tick = (1 << (HALF_TURN_BITS - 1)) / ticks as i32 + 1;
            assert!(bearing.angle.0.abs() <= half_a_tick, "{:?} at {ticks} ticks", bearing.angle);
        }
    }

    #[test]
    fn a_bearing_says_whose_it_is_and_when() {
        let sweep = sweep(90_000, 45_000);
        let Some(bearing) = step(&Config::default(), &mut State::default(), sweep) else { panic!("in view") };
        assert_eq!((bearing.station, bearing.axis, bearing.at), (Station::B, Axis::Elevation, Ticks(77)));
        assert_eq!(bearing.half_turn, sweep.half_turn);
    }

    #[test]
    fn a_quarter_of_the_half_turn_to_either_side_is_45_degrees() {
        for (since_sync, angle) in [(22_500, -(1 << (HALF_TURN_BITS - 2))), (67_500, 1 << (HALF_TURN_BITS - 2))] {
            let bearing = step(&Config::default(), &mut State::default(), sweep(90_000, since_sync));
            assert!(bearing.is_some_and(|bearing| bearing.angle.0.abs_diff(angle) <= 1));
        }
    }

    #[test]
    fn the_factory_phase_is_added_to_its_own_rotor_only() {
        let phase = |phase| Rotor { phase, ..Rotor::default() };
        let config = Config::new([[phase(1), phase(20)], [phase(300), phase(-4_000)]]);
        let with = step(&config, &mut State::default(), sweep(90_000, 50_000));
        let without = step(&Config::default(), &mut State::default(), sweep(90_000, 50_000));
        let (Some(with), Some(without)) = (with, without) else { panic!("in view") };
        assert_eq!(with.angle, Angle(without.angle.0 - 4_000));
    }

    #[test]
    fn sixty_degrees_are_in_view_and_more_is_counted() {
        for ticks in HALF_TURNS {
            let mut state = State::default();
            let third = ticks as u64 / 3;
            let inside = [ticks as u64 / 2 - third + 2, ticks as u64 / 2 + third - 2];
            let outside = [ticks as u64 / 2 - third - 2, ticks as u64 / 2 + third + 3];
            for since_sync in inside {
                let bearing = step(&Config::default(), &mut state, sweep(ticks, since_sync as u32));
                assert!(bearing.is_some_and(|bearing| bearing.angle.0.abs() <= FIELD_OF_VIEW));
            }
            assert_eq!(state.outside(), 0);
            for since_sync in outside {
                assert_eq!(step(&Config::default(), &mut state, sweep(ticks, since_sync as u32)), None);
            }
            assert_eq!(state.outside(), 2);
        }
    }

    #[test]
    fn a_span_of_many_half_turns_is_outside_and_not_wrapped_back_in() {
        let mut state = State::default();
        for since_sync in [90_000 * 3 / 2, 90_000 * 5 / 2, 1 << 30, u32::MAX] {
            assert_eq!(step(&Config::default(), &mut state, sweep(90_000, since_sync)), None);
        }
        // 2048 half turns: the share no longer fits a signed number.
        let longest = sweep(HalfTurn::MIN_TICKS, HalfTurn::MIN_TICKS << 11);
        assert_eq!(step(&Config::default(), &mut state, longest), None);
    }

    #[test]
    fn a_tilted_rotor_shows_nothing_where_the_other_looks_straight_ahead() {
        // tan(other) = 0 takes the tilt away; the other rotor's 45 degrees bring all of it back.
        let tilted = Rotor { tilt: 2_000, ..Rotor::default() };
        let config = Config::new([[Rotor::default(); 2], [Rotor::default(), tilted]]);
        let mut state = State::default();
        let azimuth = |since_sync| Sweep { axis: Axis::Azimuth, ..sweep(90_000, since_sync) };
        for (other, seen) in [(45_000, 0), (67_500, 2_000), (22_500, -2_000)] {
            assert!(step(&config, &mut state, azimuth(other)).is_some());
            let Some(bearing) = step(&config, &mut state, sweep(90_000, 45_000)) else { panic!("in view") };
            // Sines and cosines are kept to 8e-5.
            assert!(bearing.angle.0.abs_diff(seen) <= 3, "{:?} for {seen}", bearing.angle);
        }
    }

    #[test]
    fn received_terms_count_where_they_were_asked_for() {
        let file = Rotor { phase: 1_000, ..Rotor::default() };
        let config = Config::new([[file; 2]; 2]);
        // 0.0625 rad are 20,860.8 units.
        let Some(rotors) = received(&block([0x2c00, 0, 0, 0])) else { panic!("plausible") };
        let angle = |config: &Config, state: &mut State, station| {
            let sweep = Sweep { station, ..sweep(90_000, 45_000) };
            step(config, state, sweep).map(|bearing| bearing.angle.0)
        };
        for asked in [[false, false], [true, false], [false, true], [true, true]] {
            let config = config.with_received(asked);
            let mut state = State::default();
            for (station, asked) in [Station::A, Station::B].into_iter().zip(asked) {
                let waiting = if asked { Factory::Awaited } else { Factory::File };
                assert_eq!(state.factory(&config, station), waiting);
                assert_eq!(angle(&config, &mut state, station), Some(1_000));
                receive(&config, &mut state, station, rotors);
                let (factory, seen) = if asked { (Factory::Received, 20_861) } else { (Factory::File, 1_000) };
                assert_eq!(state.factory(&config, station), factory);
                assert_eq!(angle(&config, &mut state, station), Some(seen));
            }
        }
    }

    #[test]
    fn a_received_once_per_turn_term_is_split_by_its_phase() {
        // gibmag 0.01 rad, 3,338 units, as a half float; gibphase 0, a right angle, and 2 rad.
        for (gibphase, sin, cos) in
            [(0x0000, 0, 3_338), (0x3e48, 3_338, 0), (0xbe48, -3_338, 0), (0x4000, 3_035, -1_389)]
        {
            let Some([azimuth, elevation]) = received(&block([0, 0, gibphase, 0x211f])) else { panic!("plausible") };
            assert_eq!(azimuth, Rotor::default());
            assert!(elevation.gibbous_cos.abs_diff(sin) <= 2, "{elevation:?}");
            assert!(elevation.gibbous_sin.abs_diff(cos) <= 2, "{elevation:?}");
        }
    }

    #[test]
    fn a_station_that_talks_nonsense_is_not_believed() {
        // 0.5 rad of phase; infinity; no number.
        for terms in [[0x3800, 0, 0, 0], [0, 0x7c00, 0, 0], [0, 0, 0x7e00, 0], [0, 0, 0, 0xfc00]] {
            assert_eq!(received(&block(terms)), None);
        }
    }

    #[test]
    fn the_share_is_within_one_unit_of_the_exact_ratio() {
        for ticks in HALF_TURNS {
            let half_turn = sweep(ticks, 0).half_turn;
            for part in 0..=64 {
                let span = (u64::from(ticks) * part / 64) as u32;
                let exact = (u64::from(span) << HALF_TURN_BITS) / u64::from(ticks);
                assert!(u64::from(half_turn.share(Span(span))).abs_diff(exact) <= 1);
            }
        }
    }

    #[test]
    fn a_half_turn_out_of_range_is_refused() {
        for ticks_q8 in [0, 1, (HalfTurn::MIN_TICKS << 8) - 1, (HalfTurn::MAX_TICKS << 8) + 1, u32::MAX] {
            assert_eq!(HalfTurn::from_ticks_q8(ticks_q8), None);
        }
    }
}
