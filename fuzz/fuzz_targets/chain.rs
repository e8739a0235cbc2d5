//! Any light at all through the whole path: real light, maimed by the input, so that the lock and the tracker are
//! reached and then misled.
//!
//! Nothing may panic or overflow, and every report must survive the air.
#![no_main]

use libfuzzer_sys::fuzz_target;
use lighthouse_mote::chain::{Chain, Config, Estimate};
use lighthouse_mote::edge::Edge;
use lighthouse_mote::frame::{Header, Message, Report, emit, emit_health, parse};
use lighthouse_mote::sweep::Stamp;
use lighthouse_mote::time::{Span, Ticks};

mod room {
    #![allow(dead_code, reason = "what a board wants besides the room")]
    include!(concat!(env!("OUT_DIR"), "/calib.rs"));
}

/// The half turn in 1/48 us: 8.333 ms.
const HALF_TURN: u64 = 400_000;
/// From A's flash to B's, in 1/48 us: 417 us.
const GAP: u64 = 20_000;
/// From a station's flash to its sweep, in 1/48 us: somewhere within the default room, `[station][axis]`.
const SWEEP_AFTER: [[u64; 2]; 2] = [[167_155, 200_996], [237_081, 191_772]];
/// Clocks of a mote, Hz: nominal, half, twice, and the ends of what the arithmetic holds.
const CLOCKS: [u64; 8] =
    [10_000_000, 10_820_000, 5_000_000, 20_000_000, 16_000_000, 1_000_000, 48_000_000, 124_000_000];
/// Half turns that one input may play, so that each run is short.
const SLOTS: u64 = 4_000;

const HEADER: Header = Header { pan: room::PAN, mote: room::MOTE, sequence: 7 };

/// A pulse in 1/48 us: its start from the beginning of the slot, and its width.
type Pulse = (u64, u64);

struct Mote {
    config: Config,
    chain: Chain,
    clock: u64,
    /// What the counter reads at time zero.
    start: u32,
    /// Of the present slot, 1/48 us.
    slot_start: u64,
    slot: u64,
    sweep_after: [[u64; 2]; 2],
}

impl Mote {
    fn ticks(&self, at: u64) -> Ticks {
        Ticks(self.start).after(Span((u128::from(at) * u128::from(self.clock) / 48_000_000) as u32))
    }

    fn edge(&mut self, edge: Edge) {
        let report = self.chain.step(&self.config, edge);
        check(report);
    }

    fn pulse(&mut self, (at, width): Pulse) {
        let at = self.slot_start + at;
        let (rise, fall) = (self.ticks(at), self.ticks(at + width));
        self.edge(Edge::rise(rise));
        self.edge(Edge::fall(fall));
    }

    /// One half turn of light: without the pulses in `missing`, with one more where there is one.
    fn play(&mut self, missing: u8, extra: Option<Pulse>) {
        let slot = self.slot % 4;
        let (sweeping, axis) = if slot < 2 { (1, slot) } else { (0, slot - 2) };
        let mut pulses: Vec<Pulse> = (0..2)
            .map(|station| {
                let (data, skip) = (self.slot >> (2 + station) & 1, u64::from(station != sweeping));
                (GAP * station, 3_000 + 500 * axis + 1_000 * data + 2_000 * skip)
            })
            .collect();
        pulses.push((GAP * sweeping + self.sweep_after[sweeping as usize][axis as usize], 480));
        let mut seen: Vec<Pulse> = pulses
            .into_iter()
            .enumerate()
            .filter(|(index, _)| missing >> index & 1 == 0)
            .map(|(_, pulse)| pulse)
            .chain(extra)
            .collect();
        seen.sort_unstable();
        for pulse in seen {
            self.pulse(pulse);
        }
        self.slot += 1;
        self.slot_start += HALF_TURN;
    }
}

/// What goes onto the air comes back from it.
fn check(report: Option<Report>) {
    if let Some(report) = report {
        assert_eq!(parse(&emit(HEADER, &report)), Ok((HEADER, Message::Fix(report))));
    }
}

/// The input, a byte or more at a time; zeros never come: the end ends the run.
struct Input<'a>(&'a [u8]);

impl Input<'_> {
    fn byte(&mut self) -> Option<u8> {
        let (first, rest) = self.0.split_first()?;
        self.0 = rest;
        Some(*first)
    }

    fn u16(&mut self) -> Option<u64> {
        Some(u64::from(self.byte()?) << 8 | u64::from(self.byte()?))
    }

    fn u32(&mut self) -> Option<u32> {
        Some((self.u16()? << 16 | self.u16()?) as u32)
    }
}

fn run(input: &mut Input<'_>) -> Option<()> {
    let choice = input.byte()?;
    let config = Config {
        estimate: if choice & 1 == 0 { Estimate::Track } else { Estimate::Fix },
        report_every_half_turns: if choice & 2 == 0 { 1 } else { 4 },
        sweep: lighthouse_mote::sweep::Config {
            stamp: if choice & 4 == 0 { Stamp::Middle } else { Stamp::Rise },
            ..room::CONFIG.sweep
        },
        ..room::CONFIG
    };
    let clock = CLOCKS[usize::from(choice >> 3 & 7)];
    let mut mote = Mote {
        config,
        chain: Chain::default(),
        clock,
        start: input.u32()?,
        slot_start: 0,
        slot: u64::from(choice >> 6),
        sweep_after: SWEEP_AFTER,
    };
    while mote.slot < SLOTS {
        let order = input.byte()?;
        let low = u64::from(order & 0x1f);
        match order >> 5 {
            0 => (0..=low).for_each(|_| mote.play(0, None)),
            1 => mote.play(low as u8, None),
            2 => {
                let extra = ((input.u16()? * HALF_TURN) >> 16, (input.u16()? * HALF_TURN) >> 20);
                (0..=low).for_each(|_| mote.play(0, Some(extra)));
            }
            3 => {
                let at = Ticks(input.u32()?);
                mote.edge(if low & 1 == 0 { Edge::rise(at) } else { Edge::fall(at) });
            }
            4 => mote.slot_start += u64::from(input.u32()?) << (low & 7),
            5 => {
                let now = mote.ticks(mote.slot_start);
                let report = mote.chain.expire(&mote.config, now);
                check(report);
                let health = mote.chain.health(&mote.config, now);
                assert_eq!(parse(&emit_health(HEADER, &health)), Ok((HEADER, Message::Health(health))));
            }
            6 => mote.sweep_after[(low >> 1 & 1) as usize][(low & 1) as usize] = (input.u16()? * HALF_TURN) >> 16,
            _ => {
                mote.slot += low;
                mote.clock = mote.clock * 99 / 100 + u64::from(input.byte()?) * mote.clock / 12_800;
            }
        }
    }
    Some(())
}

fuzz_target!(|bytes: &[u8]| {
    let _ = run(&mut Input(bytes));
});
