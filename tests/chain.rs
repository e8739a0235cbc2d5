//! Edges to reports: the whole path in the default room, on any clock.
#![cfg_attr(target_os = "none", no_std, no_main)]

#[cfg(target_os = "none")]
mod cycle;
#[cfg(target_os = "none")]
mod harness;

#[cfg(not(target_os = "none"))]
use super::cycle;

use cycle::{Cycle, PULSES_PER_SLOT};
use lighthouse_mote::chain::{Chain, Config, Estimate};
use lighthouse_mote::edge::Edge;
use lighthouse_mote::frame::{Header, Level, Message, Report, emit, parse};

mod room {
    #![allow(dead_code, reason = "what a board wants besides the room")]
    include!(concat!(env!("OUT_DIR"), "/calib.rs"));
}

/// Where the mote of [`Cycle::IN_THE_ROOM`] is, Q16 m.
const TRUTH: [i32; 3] = [32_768, 65_536, 32_768];
/// 1 mm in Q16 m: a tick of the slowest clock here is 0.1 us, 38 urad, which the baseline makes 0.3 mm in depth.
const NEAR: u32 = 66;

fn config(estimate: Estimate, report_every_half_turns: u16) -> Config {
    Config { estimate, report_every_half_turns, ..room::CONFIG }
}

/// The reports of `slots` half turns: how many, and the last.
fn reports(config: &Config, cycle: &Cycle, slots: u32) -> (u32, Option<Report>) {
    let mut chain = Chain::default();
    let (mut count, mut last) = (0, None);
    for slot in 0..slots {
        for index in 0..PULSES_PER_SLOT {
            let (_, pulse) = cycle.pulse(slot, index);
            for edge in [Edge::rise(pulse.start), Edge::fall(pulse.start.after(pulse.width))] {
                if let Some(report) = chain.step(config, edge) {
                    count += 1;
                    last = Some(report);
                }
            }
        }
    }
    (count, last)
}

fn is_near(report: &Report) -> bool {
    report.position.iter().zip(&TRUTH).all(|(found, truth)| found.to_bits().abs_diff(*truth) <= NEAR)
}

#[cfg_attr(target_os = "none", defmt_test::tests)]
mod tests {
    use super::*;

    #[test]
    fn light_becomes_the_place_whatever_the_clock() {
        // 10.82 MHz and ten per cent to either side, the counter wrapping on the way.
        for clock in [9_738_000, 10_820_000, 11_902_000] {
            for estimate in [Estimate::Track, Estimate::Fix] {
                let cycle = Cycle { clock, start: u32::MAX - 900_000, ..Cycle::IN_THE_ROOM };
                let (count, last) = reports(&config(estimate, 1), &cycle, 60);
                let Some(report) = last else { panic!("no report at {} Hz", clock) };
                assert!(count > 40, "{} reports", count);
                assert!(is_near(&report), "{:?}", report.position.map(|axis| axis.to_bits()));
                assert_eq!((report.level, report.stations), (Level::Full, 3));
            }
        }
    }

    #[test]
    fn reports_come_at_the_rate_asked_for() {
        let (every, _) = reports(&config(Estimate::Track, 1), &Cycle::IN_THE_ROOM, 120);
        let (fourth, _) = reports(&config(Estimate::Track, 4), &Cycle::IN_THE_ROOM, 120);
        assert!(every > 100 && every.abs_diff(4 * fourth) <= 4, "{} and {}", every, fourth);
    }

    #[test]
    fn a_report_survives_the_air() {
        let (_, Some(report)) = reports(&config(Estimate::Track, 1), &Cycle::IN_THE_ROOM, 30) else {
            panic!("no report")
        };
        let header = Header { pan: room::PAN, mote: room::MOTE, sequence: 7 };
        assert!(parse(&emit(header, &report)) == Ok((header, Message::Fix(report))));
    }
}
