//! What the boards' apps share, on this computer: the stages between their queues, the queues, the breadcrumb.

use std::cell::Cell;

use proptest::prelude::*;

use crate::chain::{Chain, Config, Estimate};
use crate::edge::Edge;
use crate::frame::{self, Header, Message, Reset};
use crate::identity::{self, Block, Identity};
#[cfg(feature = "security")]
use crate::on_target::cycle::HALF_TURN;
use crate::on_target::cycle::{Cycle, PULSES_PER_SLOT};
use crate::pulse::Pulse;
use crate::time::{Span, Ticks};
#[cfg(feature = "security")]
use crate::{frame::secured::Key, send};

#[allow(clippy::module_inception, reason = "the folder's name, here as in every binary")]
#[path = "../../src/bin/mote/mod.rs"]
pub(super) mod mote;

use mote::bytes::Bytes;
use mote::crumb::{Crash, Crumb, Kind};
use mote::edges::Edges;
use mote::queue::{Queue, Reader, Writer};
use mote::room;
#[cfg(feature = "security")]
use mote::seal::{Kept, Seal};
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

/// The room's, where it has one.
#[cfg(feature = "security")]
const KEY: [u8; 16] = *b"a room of its ow";

impl Board for Bench {
    type Pulses = Reader<Pulse, 16>;

    fn identity() -> Identity {
        IDENTITY.read()
    }

    #[cfg(feature = "security")]
    fn key() -> Option<&'static [u8; 16]> {
        Some(&KEY)
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
    /// What frames are under, and the counters that they had.
    #[cfg(feature = "security")]
    key: Option<(Key, Vec<u32>)>,
}

impl App {
    fn new(config: Config, reset: (Reset, u32)) -> Self {
        fn leak<T>(value: T) -> &'static mut T {
            Box::leak(Box::new(value))
        }
        let (light, pulses) = leak(Queue::new()).split();
        let (classify, solve, air) = leak(Queues::new()).wire(pulses, reset);
        Self {
            config,
            light,
            classify,
            solve,
            air,
            deaf: false,
            heard: Vec::new(),
            #[cfg(feature = "security")]
            key: None,
        }
    }

    /// In a room with a key.
    #[cfg(feature = "security")]
    fn sealed(config: Config) -> Self {
        static FIRST: identity::FirstCounter = identity::FirstCounter::new();
        let mut app = Self::new(config, (Reset::PowerOn, 0));
        app.solve = app.solve.under(Some(Seal::new(&FIRST, Box::leak(Box::new(Kept::new())))));
        app.key = Some((Key::new(&KEY), Vec::new()));
        app
    }

    fn read(&mut self, bytes: &[u8]) -> (Header, Message) {
        #[cfg(feature = "security")]
        if let Some((key, counters)) = &mut self.key {
            let (claim, plain) = key.open(bytes).expect("every frame is under the key");
            counters.push(claim.counter);
            return frame::parse(plain.bytes()).expect("what was sealed can be read");
        }
        frame::parse(bytes).expect("what a mote says can be read")
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
            && let Some(sent) = self.air.oldest().copied()
        {
            let heard = self.read(sent.bytes());
            self.heard.push(heard);
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

/// Each frame that leaves in `slots` of the typical cycle: in which of them, and what it is.
#[cfg(feature = "security")]
fn departures(app: &mut App, slots: u32) -> Vec<(u32, Message)> {
    let mut left = Vec::new();
    for (index, (_, pulse)) in LIGHT.pulses(0, slots).enumerate() {
        let index = index as u32;
        app.pulse(pulse);
        if (index + 1).is_multiple_of(120 * PULSES_PER_SLOT) {
            app.second(pulse.start.after(pulse.width).after(Span(1)));
        }
        left.extend(app.heard.drain(..).map(|(_, message)| (index / PULSES_PER_SLOT, message)));
    }
    left
}

#[cfg(feature = "security")]
#[test]
fn sealed_frames_leave_in_the_mote_s_own_half_turns_whatever_sealing_takes() {
    let config = |every, ahead_half_turns| Config {
        report_every_half_turns: every,
        send: send::Config { when: send::When::Slotted, ahead_half_turns, ..room::CONFIG.send },
        ..room::CONFIG
    };
    for every in [5, 8, 9, 60] {
        let plain = departures(&mut App::new(config(every, 0), (Reset::PowerOn, 0)), 1_200);
        let mut app = App::sealed(config(every, send::SEALING_HALF_TURNS));
        let sealed = departures(&mut app, 1_200);
        let fixes = |left: &[(u32, Message)]| -> Vec<u32> {
            left.iter().filter(|(_, message)| matches!(message, Message::Fix(_))).map(|(slot, _)| *slot).collect()
        };
        let (own, sent) = (fixes(&plain), fixes(&sealed));
        assert!(sent.len() >= own.len() - 1 && sent.len() > 15, "{} and {} of every {every}", own.len(), sent.len());
        assert!(sent.iter().all(|slot| own.contains(slot)), "every {every}: {sent:?}, not {own:?}");
        // Once there are turns, health frames leave behind fixes, and nothing out of turn.
        let first = sent.first().copied().expect("there are some");
        for (slot, message) in sealed.iter().filter(|(slot, _)| *slot >= first) {
            assert!(sent.contains(slot), "every {every}: half turn {slot}: {message:?}");
        }
        // Each fix is of the half turn in which its sealing began, so many before.
        for (slot, message) in &sealed {
            if let Message::Fix(report) = message {
                let age = LIGHT.ticks(u64::from(*slot) * HALF_TURN).since(Ticks(report.time));
                let half_turns = f64::from(age.0) * 120.0 / f64::from(LIGHT.clock);
                let ahead = f64::from(send::SEALING_HALF_TURNS);
                assert!((ahead - 1.0..ahead).contains(&half_turns), "every {every}: {half_turns} half turns old");
            }
        }
        let counters = &app.key.as_ref().expect("it has one").1;
        assert!(counters.is_sorted_by(|a, b| a < b), "{counters:?}");
    }
}

#[cfg(feature = "security")]
#[test]
fn sealed_frames_are_numbered_without_a_gap_in_the_light_and_in_the_dark() {
    let mut app = App::sealed(Config {
        send: send::Config {
            when: send::When::Slotted,
            ahead_half_turns: send::SEALING_HALF_TURNS,
            ..room::CONFIG.send
        },
        ..room::CONFIG
    });
    for second in 1..=3u32 {
        app.second(Ticks(LIGHT.start.wrapping_sub(40_000_000).wrapping_add(second * 10_000_000)));
    }
    assert_eq!(app.healths().len(), 3);
    app.shine(0..600);
    // The light goes out: what waited for its turn goes, and there is health again.
    let lit = app.heard.len();
    assert!(lit > 40, "{lit}");
    for second in 60..=64u32 {
        app.second(Ticks(LIGHT.start.wrapping_add(second * 10_000_000)));
    }
    assert!(app.heard.len() >= lit + 4, "{} after {lit}", app.heard.len());
    assert!(app.heard.iter().enumerate().all(|(n, (header, _))| usize::from(header.sequence) == n));
    // Nobody fetches them: what finds no room is lost, and the next ones go out.
    app.deaf = true;
    app.shine(1_000..1_600);
    app.deaf = false;
    app.shine(1_600..1_840);
    assert!(app.healths().last().is_some_and(|health| health.rejects.reports > 20), "{:?}", app.healths().last());
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

/// Flips one bit of one of a queue's counts, as nobody but a fault does: its fields lie as they are declared.
fn flip(queue: *mut Queue<u32, 8>, count: usize, bit: u32) {
    // SAFETY: `written` and `read` are the first two words, atomics both, and the queue was leaked.
    let word = unsafe { &*queue.cast::<std::sync::atomic::AtomicU32>().add(count) };
    word.fetch_xor(1 << bit, std::sync::atomic::Ordering::Relaxed);
}

#[test]
fn a_queue_recovers_from_any_flipped_bit_of_its_counts() {
    for (count, bit) in (0..2).flat_map(|count| (0..32).map(move |bit| (count, bit))) {
        for before in 0..16u32 {
            let queue: *mut Queue<u32, 8> = Box::into_raw(Box::new(Queue::new()));
            // SAFETY: it was leaked, and the ends are the only ones but for `flip`.
            let (mut writer, mut reader) = unsafe { &mut *queue }.split();
            for n in 0..before {
                assert!(writer.push(n));
                if n >= 5 {
                    reader.pop();
                }
            }
            flip(queue, count, bit);
            // What was there is lost or comes again: no more than twice the length, and then it is empty.
            for _ in 0..16 {
                reader.pop();
            }
            for n in 100..200 {
                assert!(!writer.is_full(), "bit {bit} of count {count} after {before}");
                assert!(writer.push(n), "bit {bit} of count {count} after {before}");
                assert_eq!(reader.oldest().copied(), Some(n), "bit {bit} of count {count} after {before}");
                reader.pop();
            }
            // And the writer is told of no room exactly where there is none.
            for n in 0..10 {
                assert_eq!(writer.is_full(), n >= 8);
                assert_eq!(writer.push(n), n < 8);
            }
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
