//! Edges to pulses, with every way an edge can go missing.
#![cfg_attr(target_os = "none", no_std, no_main)]

#[cfg(target_os = "none")]
mod harness;

use lighthouse_mote::edge::Edge;
use lighthouse_mote::pulse::{Pulse, State, step};
use lighthouse_mote::time::{Span, Ticks};

fn rise(at: u32) -> Edge {
    Edge::rise(Ticks(at))
}

fn fall(at: u32) -> Edge {
    Edge::fall(Ticks(at))
}

fn pulse(start: u32, width: u32) -> Option<Pulse> {
    Some(Pulse { start: Ticks(start), width: Span(width) })
}

#[cfg_attr(target_os = "none", defmt_test::tests)]
mod tests {
    use super::*;

    #[test]
    fn a_pulse_lasts_from_its_rise_to_its_fall() {
        let mut state = State::default();
        assert_eq!(step(&mut state, rise(100)), None);
        assert_eq!(step(&mut state, fall(777)), pulse(100, 677));
        assert_eq!(state.lost(), 0);
    }

    #[test]
    fn a_pulse_survives_the_counter_wrapping() {
        let mut state = State::default();
        assert_eq!(step(&mut state, rise(u32::MAX - 9)), None);
        assert_eq!(step(&mut state, fall(90)), pulse(u32::MAX - 9, 100));
        assert_eq!(state.lost(), 0);
    }

    #[test]
    fn a_pulse_that_begins_at_the_wrap_is_whole() {
        let mut state = State::default();
        assert_eq!(step(&mut state, rise(0)), None);
        assert_eq!(step(&mut state, fall(50)), pulse(0, 50));
    }

    #[test]
    fn a_lost_fall_costs_its_own_pulse_and_not_the_next() {
        let mut state = State::default();
        assert_eq!(step(&mut state, rise(100)), None);
        assert_eq!(step(&mut state, rise(9_000)), None);
        assert_eq!(step(&mut state, fall(9_600)), pulse(9_000, 600));
        assert_eq!(state.lost(), 1);
    }

    #[test]
    fn a_lost_rise_costs_its_own_pulse_and_not_the_next() {
        let mut state = State::default();
        assert_eq!(step(&mut state, fall(700)), None);
        assert_eq!(step(&mut state, rise(9_000)), None);
        assert_eq!(step(&mut state, fall(9_600)), pulse(9_000, 600));
        assert_eq!(state.lost(), 1);
    }

    #[test]
    fn a_doubled_edge_costs_at_most_one_pulse() {
        let mut state = State::default();
        assert_eq!(step(&mut state, rise(100)), None);
        assert_eq!(step(&mut state, rise(101)), None);
        assert_eq!(step(&mut state, fall(700)), pulse(101, 599));
        assert_eq!(step(&mut state, fall(701)), None);
        assert_eq!(step(&mut state, rise(9_000)), None);
        assert_eq!(step(&mut state, fall(9_600)), pulse(9_000, 600));
        assert_eq!(state.lost(), 2);
    }

    #[test]
    fn the_count_of_lost_edges_wraps() {
        let mut state = State::default();
        for _ in 0..=u16::MAX {
            assert_eq!(step(&mut state, fall(1)), None);
        }
        assert_eq!(state.lost(), 0);
    }
}
