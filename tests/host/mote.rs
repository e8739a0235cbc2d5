//! What the boards' apps share, on this computer: the stages between their queues, the queues, the breadcrumb.

use std::cell::Cell;

use proptest::prelude::*;

use crate::chain::{Chain, Config, Estimate};
use crate::edge::Edge;
use crate::frame::{self, Header, Message, Reset};
use crate::identity::{self, Block, Identity};
use crate::on_target::cycle::{Cycle, PULSES_PER_SLOT};
use crate::pulse::Pulse;
use crate::time::{Span, Ticks};

#[allow(clippy::module_inception, reason = "the folder's name, here as in every binary")]
#[path = "../../src/bin/mote/mod.rs"]
pub(super) mod mote;

use mote::bytes::Bytes;
use mote::crumb::{Crash, Crumb, Kind};
use mote::edges::Edges;
use mote::queue::{Queue, Reader, Writer};
use mote::room;
use mote::stages::{Board, Classify, Pulses, Queues, Solve};

const LIGHT: Cycle = Cycle::IN_THE_ROOM;

thread_local! {
    static EDGES_LOST: Cell<u16> = const { Cell::new(0) };
    static FRAMES_LOST: Cell<u16> = const { Cell::new(0) };
}

/// As a binary has it.
static IDENTITY: Block =
    Block::new(Identity { mote: HEADER.mote, pan: HEADER.pan, channel: 0 }, identity::READS_ADDRESS);

/// A board without registers.
struct Bench;

impl Board for Bench {
    type Pulses = Reader<Pulse, 16>;

    fn identity() -> Identity {
        IDENTITY.read()
    }

    fn edges_lost() -> u16 {
        EDGES_LOST.get()
    }

    fn frames_lost() -> u16 {
        FRAMES_LOST.get()
    }
}

/// Where every mote of these tests is.
const HEADER: Header = Header { pan: 0xca5a, mote: 7, sequence: 0 };

/// An app without its scheduler: every task runs to its end at once.
struct App {
    config: Config,
    light: Writer<Pulse, 16>,
    classify: Classify<Bench>,
    solve: Solve<Bench>,
    air: Reader<frame::Aligned, { mote::stages::FRAMES }>,
    /// Nobody fetches frames.
    deaf: bool,
    heard: Vec<(Header, Message)>,
}

impl App {
    fn new(config: Config, reset: (Reset, u32)) -> Self {
        fn leak<T>(value: T) -> &'static mut T {
            Box::leak(Box::new(value))
        }
        let (light, pulses) = leak(Queue::new()).split();
        let (classify, solve, air) = leak(Queues::new()).wire(pulses, reset);
        Self { config, light, classify, solve, air, deaf: false, heard: Vec::new() }
    }

    fn pulse(&mut self, pulse: Pulse) {
        assert!(self.light.push(pulse));
        while self.classify.run(&self.config).more {}
        self.solve();
    }

    fn second(&mut self, now: Ticks) {
        self.classify.second(now);
        self.solve();
    }

    fn solve(&mut self) {
        while self.solve.run(&self.config).more {}
        while !self.deaf
            && let Some(sent) = self.air.oldest()
        {
            self.heard.push(frame::parse(sent.bytes()).expect("what a mote says can be read"));
            self.air.pop();
        }
    }

    /// Plays light of the typical cycle with a second after each 120 slots.
    fn shine(&mut self, slots: std::ops::Range<u32>) {
        let mut at = Ticks(0);
        for (index, (_, pulse)) in LIGHT.pulses(slots.start, slots.end - slots.start).enumerate() {
            self.pulse(pulse);
            at = pulse.start.after(pulse.width).after(Span(1));
            if (index as u32 + 1).is_multiple_of(120 * PULSES_PER_SLOT) {
                self.second(at);
            }
        }
        self.second(at);
    }

    fn healths(&self) -> Vec<frame::Health> {
        let health = |(_, message): &(Header, Message)| match message {
            Message::Health(health) => Some(*health),
            _ => None,
        };
        self.heard.iter().filter_map(health).collect()
    }
}

#[test]
fn the_two_halves_between_their_queues_report_what_the_whole_path_does() {
    let mut app = App::new(room::CONFIG, (Reset::PowerOn, 0));
    let mut chain = Chain::of_mote(HEADER.mote);
    let mut expected = Vec::new();
    for (_, pulse) in LIGHT.pulses(0, 600) {
        app.pulse(pulse);
        for edge in [Edge::rise(pulse.start), Edge::fall(pulse.start.after(pulse.width))] {
            expected.extend(chain.step(&app.config, edge));
        }
    }
    let told: Vec<_> = app
        .heard
        .iter()
        .filter_map(|(_, message)| if let Message::Fix(report) = message { Some(*report) } else { None })
        .collect();
    assert!(expected.len() > 50, "only {} reports", expected.len());
    assert_eq!(told, expected);
}

#[test]
fn every_second_says_why_the_mote_started_and_what_was_lost() {
    let mut app = App::new(room::CONFIG, (Reset::Fault, 0x1234));
    EDGES_LOST.set(3);
    FRAMES_LOST.set(5);
    app.shine(0..600);
    let healths = app.healths();
    assert!(healths.len() >= 4, "{healths:?}");
    for health in &healths {
        assert_eq!((health.reset, health.reset_detail), (Reset::Fault, 0x1234));
        assert_eq!((health.rejects.edges, health.rejects.reports), (3, 5));
    }
    let uptimes: Vec<u32> = healths.iter().map(|health| health.uptime).collect();
    assert!(uptimes.is_sorted_by(|a, b| a < b), "{uptimes:?}");
    // Frames of any kind share one sequence without a gap.
    assert!(app.heard.iter().enumerate().all(|(n, (header, _))| *header == Header { sequence: n as u16, ..HEADER }));
}

#[test]
fn in_the_dark_there_is_health_and_nothing_else() {
    let mut app = App::new(room::CONFIG, (Reset::Watchdog, 0));
    for second in 1..=5u32 {
        app.second(Ticks(second * 10_000_000));
    }
    assert_eq!(app.healths().len(), 5);
    assert_eq!(app.heard.len(), 5);
    assert!(app.healths().iter().all(|health| health.lock == frame::Lock::NoLight));
}

#[test]
fn a_room_that_wants_angles_gets_frames_of_angles() {
    let mut app = App::new(Config { estimate: Estimate::Angles, ..room::CONFIG }, (Reset::PowerOn, 0));
    app.shine(0..240);
    let sweeps: usize = app
        .heard
        .iter()
        .map(|(_, message)| match message {
            Message::Angles(angles) => angles.sweeps.len(),
            Message::Fix(_) => panic!("a fix where angles were asked for"),
            Message::Health(_) => 0,
        })
        .sum();
    // 240 slots less those in which the cycle is found, and what has not filled a frame yet.
    assert!((200..=240).contains(&sweeps), "{sweeps} sweeps");
}

#[test]
fn frames_that_nobody_fetches_are_counted_and_the_next_ones_go_out() {
    let mut app = App::new(room::CONFIG, (Reset::PowerOn, 0));
    app.deaf = true;
    app.shine(0..600);
    app.deaf = false;
    FRAMES_LOST.set(0);
    app.second(Ticks(LIGHT.start));
    let waited = app.heard.len();
    assert_eq!(waited, mote::stages::FRAMES);
    app.shine(600..840);
    let lost = app.healths().last().expect("a second has gone by").rejects.reports;
    assert!(lost > 20, "only {lost} lost");
    // A lost frame has no number: what was sent is numbered without a gap.
    assert!(app.heard.iter().enumerate().all(|(n, (header, _))| usize::from(header.sequence) == n));
}

#[test]
fn a_crash_is_told_once_and_counted_until_power_goes() {
    let crumb = Crumb::new();
    assert_eq!(crumb.take(), None);
    for count in 1..=3 {
        crumb.leave(Kind::HardFault, 0x200 + count);
        let crash = crumb.take().expect("it was left");
        assert_eq!(crash, Crash { count, kind: Kind::HardFault as u32, at: 0x200 + count });
        assert_eq!(crash.reset(), Reset::Fault);
    }
    assert_eq!(crumb.take(), None);
    crumb.leave(Kind::Panic, 1);
    assert_eq!(crumb.take().map(|crash| (crash.count, crash.reset())), Some((1, Reset::Panic)));
    crumb.leave(Kind::Panic, 1);
    crumb.forget();
    assert_eq!(crumb.take(), None);
}

proptest! {
    #[test]
    fn a_queue_gives_what_it_took_in_order_and_refuses_only_when_full(ops in prop::collection::vec(any::<bool>(), 0..200)) {
        let (mut writer, mut reader) = Box::leak(Box::new(Queue::<u32, 8>::new())).split();
        let mut model = std::collections::VecDeque::new();
        let mut next = 0;
        let mut most = 0;
        for push in ops {
            if push {
                prop_assert_eq!(writer.is_full(), model.len() == 8);
                prop_assert_eq!(writer.push(next), model.len() < 8);
                if model.len() < 8 {
                    model.push_back(next);
                }
                next += 1;
            } else {
                prop_assert_eq!(reader.oldest().copied(), model.pop_front());
                reader.pop();
            }
            most = most.max(model.len());
            prop_assert_eq!(usize::from(reader.most()), most);
            prop_assert_eq!(reader.has_several(), model.len() > 1);
        }
    }
}

#[test]
fn changes_become_pulses_and_what_finds_no_room_is_counted_by_edges() {
    let (mut edges, mut waiting) = Edges::split(Box::leak(Box::new(Queue::new())));
    for n in 0..20u32 {
        assert!(!edges.change(Ticks(100 * n)));
        // 16 fit.
        assert_eq!(edges.change(Ticks(100 * n + 7)), n < 16);
    }
    assert_eq!(<Edges as Board>::edges_lost(), 8);
    for n in 0..16u32 {
        assert_eq!(waiting.next(), Some(Pulse { start: Ticks(100 * n), width: Span(7) }));
    }
    assert!(waiting.is_empty());
}

#[test]
fn frames_on_a_wire_stand_behind_their_lengths() {
    let (mut writer, reader) = Box::leak(Box::new(Queue::new())).split();
    let mut bytes = Bytes::new(reader);
    assert_eq!(bytes.next(), None);
    let mut expected = Vec::new();
    for sequence in 0..3 {
        let header = Header { sequence, ..HEADER };
        assert!(writer.fill(|frame| frame::emit_into(frame, header, &frame::Report::default())));
        let frame = frame::emit(header, &frame::Report::default());
        expected.push(frame.len() as u8);
        expected.extend(frame);
    }
    let sent: Vec<u8> = std::iter::from_fn(|| bytes.next()).collect();
    assert_eq!(sent, expected);
    assert_eq!(bytes.next(), None);
}
