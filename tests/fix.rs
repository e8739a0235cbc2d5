//! Four angles to a position in the default room: the truth, the age rule, and what is turned away.
#![cfg_attr(target_os = "none", no_std, no_main)]

#[cfg(target_os = "none")]
mod harness;

use lighthouse_mote::angle::{Angle, Bearing};
use lighthouse_mote::fix::{self, Reject, State, solve, step};
use lighthouse_mote::sweep::{Axis, HalfTurn, Station};
use lighthouse_mote::time::Ticks;

mod room {
    #![allow(dead_code, reason = "what a board wants besides the room")]
    include!(concat!(env!("OUT_DIR"), "/calib.rs"));
}

/// Points of the default room in Q16 m, and their angles az A, el A, az B, el B: atan of c.x / c.z and c.y / c.z with
/// c = R (p - position), worked out in f64 and rounded to 2^-20 half turns.
const POINTS: [([i32; 3], [i32; 4]); 3] = [
    ([32_768, 65_536, 32_768], [-70_542, 21_162, 102_300, -14_620]),
    ([13_107, 45_875, 0], [6_649, -46_892, 134_990, -75_575]),
    ([58_982, 91_750, 58_982], [-236_776, 200_969, -34_395, 148_391]),
];
/// 0.3 mm in Q16 m: rounding the angles makes up to 0.1 mm here, the solver at most 0.36 mm anywhere in the room.
const NEAR: u32 = 20;
const HALF_TURN_TICKS: u32 = 90_000;

fn config() -> fix::Config {
    fix::Config { calib: room::CONFIG.fix.calib, max_age_half_turns: 12 }
}

fn is_near(found: [i32; 3], truth: [i32; 3]) -> bool {
    found.iter().zip(&truth).all(|(found, truth)| found.abs_diff(*truth) <= NEAR)
}

fn bearing(rotor: usize, angle: i32, at: u32) -> Bearing {
    let Some(half_turn) = HalfTurn::from_ticks_q8(HALF_TURN_TICKS << 8) else { panic!("in range") };
    let (station, axis) = match rotor {
        0 => (Station::A, Axis::Azimuth),
        1 => (Station::A, Axis::Elevation),
        2 => (Station::B, Axis::Azimuth),
        _ => (Station::B, Axis::Elevation),
    };
    Bearing { station, axis, angle: Angle(angle), at: Ticks(at), half_turn }
}

#[cfg_attr(target_os = "none", defmt_test::tests)]
mod tests {
    use super::*;

    #[test]
    fn the_angles_of_a_point_give_it_back() {
        for (truth, angles) in POINTS {
            let Ok(found) = solve(&config().calib, &angles.map(Angle)) else { panic!("a point of the room") };
            assert!(is_near(found.position, truth), "{:?} is not {:?}", found.position, truth);
            assert!(found.mismatch.unsigned_abs() <= NEAR);
        }
    }

    #[test]
    fn an_angle_out_of_view_gives_nothing() {
        let (_, mut angles) = POINTS[0];
        angles[3] = 400_000;
        assert!(matches!(solve(&config().calib, &angles.map(Angle)), Err(Reject::FieldOfView)));
    }

    #[test]
    fn an_elevation_of_elsewhere_gives_nothing() {
        let (_, mut angles) = POINTS[0];
        angles[3] += 60_000;
        assert!(solve(&config().calib, &angles.map(Angle)).is_err());
    }

    #[test]
    fn the_fourth_angle_completes_a_fix_of_the_oldest_one_s_age() {
        let (truth, angles) = POINTS[1];
        let mut state = State::default();
        // Across the wrap of the counter.
        let start = u32::MAX - HALF_TURN_TICKS;
        for (slot, rotor) in [2, 3, 0, 1].into_iter().enumerate() {
            let at = start.wrapping_add(slot as u32 * HALF_TURN_TICKS);
            let fix = step(&config(), &mut state, bearing(rotor, angles[rotor], at));
            match (slot, fix) {
                (3, Some(fix)) => {
                    assert!(is_near(fix.position, truth));
                    assert_eq!(fix.age.0, 3 * HALF_TURN_TICKS);
                }
                (3, None) => panic!("four angles make a fix"),
                (_, fix) => assert!(fix.is_none()),
            }
        }
    }

    #[test]
    fn an_angle_older_than_100_ms_gives_no_fix_rather_than_a_stale_one() {
        let (_, angles) = POINTS[1];
        for (late, fresh) in [(12 * HALF_TURN_TICKS, true), (12 * HALF_TURN_TICKS + 1, false)] {
            let mut state = State::default();
            for (rotor, angle) in angles.into_iter().enumerate().take(3) {
                assert!(step(&config(), &mut state, bearing(rotor, angle, 0)).is_none());
            }
            assert_eq!(step(&config(), &mut state, bearing(3, angles[3], late)).is_some(), fresh);
        }
    }

    #[test]
    fn what_was_forgotten_must_be_seen_again() {
        let (_, angles) = POINTS[2];
        let mut state = State::default();
        for (rotor, angle) in angles.into_iter().enumerate() {
            step(&config(), &mut state, bearing(rotor, angle, 0));
        }
        state.forget();
        assert!(step(&config(), &mut state, bearing(0, angles[0], 1)).is_none());
    }
}
