use fixed::types::I16F16;
use lighthouse_mote::frame::{emit, emit_health};

use super::*;

const HZ: f64 = 10e6;

/// A mote that reports, as a listener hears it.
struct Teller {
    header: Header,
    /// Its ticks at time zero.
    offset: u32,
    x: f64,
}

impl Teller {
    fn new(mote: u16, sequence: u16, offset: u32) -> Self {
        Self { header: Header { pan: 0x4C48, mote, sequence }, offset, x: 0.0 }
    }

    fn fix(&mut self, at_s: f64) -> Vec<u8> {
        let report = Report {
            time: self.offset.wrapping_add((at_s * HZ) as i64 as u32),
            half_turn_q8: (HZ * HALF_TURN_S * 256.0) as u32,
            position: [I16F16::from_num(self.x), I16F16::from_num(1), I16F16::from_num(2)],
            level: Level::Full,
            stations: 3,
            ..Report::default()
        };
        let bytes = emit(self.header, &report).to_vec();
        self.header.sequence = self.header.sequence.wrapping_add(1);
        bytes
    }

    fn health(&mut self, uptime: u32) -> Vec<u8> {
        let bytes = emit_health(self.header, &Health { uptime, lock: Lock::Locked, ..Health::default() }).to_vec();
        self.header.sequence = self.header.sequence.wrapping_add(1);
        bytes
    }
}

fn swarm() -> (Swarm, SourceId) {
    let mut swarm = Swarm::new(None);
    let source = swarm.add_source("roof", "nrf");
    (swarm, source)
}

fn hear(swarm: &mut Swarm, at_s: f64, source: SourceId, bytes: &[u8]) -> Option<Event> {
    swarm.hear(at_s, source, bytes, Signal::default())
}

/// 10 Hz.
fn times(from_s: f64, count: u32) -> impl Iterator<Item = f64> {
    (0..count).map(move |n| from_s + 0.1 * f64::from(n))
}

#[test]
fn a_mote_is_where_its_last_report_says() {
    let (mut swarm, source) = swarm();
    let mut mote = Teller::new(7, 65_530, 0xFFFF_0000);
    for at_s in times(0.0, 40) {
        mote.x = at_s;
        hear(&mut swarm, at_s, source, &mote.fix(at_s)).unwrap();
    }
    hear(&mut swarm, 4.0, source, &mote.health(90)).unwrap();
    let all = swarm.snapshot(TRAIL);
    let [one] = &all.motes[..] else { panic!("{all:?}") };
    assert_eq!((one.key.as_str(), one.frames, one.lost, one.duplicates, one.restarts), ("4c48/7", 41, 0, 0, 0));
    let fix = one.fix.unwrap();
    assert!((fix.position_m.unwrap()[0] - 3.9).abs() < 1e-4 && fix.level == "full", "{fix:?}");
    assert!((one.fixes_per_s - 10.0).abs() < 0.01, "{}", one.fixes_per_s);
    assert_eq!(one.trail.len(), 40);
    assert_eq!(one.condition.as_ref().unwrap().lock, "locked");
    // Snapshots are JSON that can be read back.
    let json = serde_json::to_value(&all).unwrap();
    assert_eq!(json["motes"][0]["fix"]["level"], "full");
    assert_eq!(json["motes"][0]["rssi_dbm"], serde_json::Value::Null);
}

#[test]
fn a_gap_is_a_loss_until_a_late_frame_fills_it() {
    let (mut swarm, source) = swarm();
    let mut mote = Teller::new(1, 10, 0);
    let frames: Vec<Vec<u8>> = times(0.0, 10).map(|at_s| mote.fix(at_s)).collect();
    for (n, at_s) in times(0.0, 10).enumerate().filter(|(n, _)| !matches!(n, 3..=5)) {
        hear(&mut swarm, at_s, source, &frames[n]).unwrap();
    }
    assert_eq!(swarm.snapshot(0).motes[0].lost, 3);
    hear(&mut swarm, 1.0, source, &frames[4]).unwrap();
    let one = &swarm.snapshot(0).motes[0];
    assert_eq!((one.lost, one.late, one.frames), (2, 1, 8));
    assert_eq!(one.sequence, 19);
}

#[test]
fn what_two_receivers_hear_counts_once() {
    let (mut swarm, roof) = swarm();
    let door = swarm.add_source("door", "openmote");
    let mut mote = Teller::new(1, 0, 5);
    for at_s in times(0.0, 30) {
        let bytes = mote.fix(at_s);
        let near = Signal { rssi_dbm: Some(-40), lqi: None };
        assert!(hear(&mut swarm, at_s, roof, &bytes).is_some());
        assert!(swarm.hear(at_s + 0.25, door, &bytes, near).is_none());
    }
    let all = swarm.snapshot(0);
    let [one] = &all.motes[..] else { panic!("{all:?}") };
    assert_eq!((one.frames, one.lost, one.duplicates, all.duplicates), (30, 0, 30, 30));
    assert_eq!(one.sources, [door, roof], "the best first");
}

#[test]
fn two_motes_with_one_id_are_told_apart_and_flagged() {
    // Far apart in their sequences, close together, and exactly alike.
    for (sequence, offset) in [(30_000, 77_000_000), (103, 3_000_000_000), (100, 900_000_000)] {
        let (mut swarm, source) = swarm();
        let (mut one, mut other) = (Teller::new(5, 100, 0), Teller::new(5, sequence, offset));
        (one.x, other.x) = (1.0, -1.0);
        for at_s in times(0.0, 60) {
            hear(&mut swarm, at_s, source, &one.fix(at_s)).unwrap();
            hear(&mut swarm, at_s + 0.03, source, &other.fix(at_s + 0.03)).unwrap();
        }
        let all = swarm.snapshot(TRAIL);
        assert_eq!(all.motes.len(), 2, "{sequence}: {:?}", all.motes);
        assert!(all.motes.iter().all(|mote| mote.is_conflict && mote.lost == 0), "{:?}", all.motes);
        let xs: Vec<f64> = all.motes.iter().map(|mote| mote.fix.unwrap().position_m.unwrap()[0]).collect();
        assert_eq!(xs, [1.0, -1.0]);
        for mote in &all.motes {
            assert!(mote.trail.windows(2).all(|two| two[0][1] == two[1][1]), "{sequence}: a trail of both");
        }
        assert_eq!(all.motes[1].key, "4c48/5.1");
    }
}

#[test]
fn a_mote_that_starts_anew_is_one_mote() {
    let (mut swarm, source) = swarm();
    let mut mote = Teller::new(5, 700, 0);
    for at_s in times(0.0, 30) {
        hear(&mut swarm, at_s, source, &mote.fix(at_s)).unwrap();
    }
    hear(&mut swarm, 3.0, source, &mote.health(71)).unwrap();
    let mut mote = Teller::new(5, 0, (-5.0 * HZ) as i64 as u32);
    for at_s in times(5.0, 40) {
        hear(&mut swarm, at_s, source, &mote.fix(at_s)).unwrap();
    }
    let all = swarm.snapshot(TRAIL);
    let [one] = &all.motes[..] else { panic!("{:?}", all.motes) };
    assert_eq!((one.restarts, one.frames, one.lost, one.is_conflict), (1, 71, 0, false));
    assert_eq!(one.trail.len(), 70);
}

#[test]
fn frames_that_were_held_back_are_no_second_mote() {
    let (mut swarm, source) = swarm();
    let mut mote = Teller::new(5, 700, 0);
    for at_s in times(0.0, 200) {
        // Ten seconds of them come at once.
        let heard_s = if (5.0..15.0).contains(&at_s) { 15.0 } else { at_s };
        hear(&mut swarm, heard_s, source, &mote.fix(at_s)).unwrap();
    }
    let all = swarm.snapshot(0);
    let [one] = &all.motes[..] else { panic!("{:?}", all.motes) };
    assert!(one.frames == 200 && one.restarts == 0 && !one.is_conflict, "{one:?}");
}

#[test]
fn rejects_are_counted_by_cause() {
    let (mut swarm, source) = swarm();
    let mut flipped = Teller::new(1, 0, 0).fix(0.0);
    flipped[20] ^= 1;
    for _ in 0..3 {
        assert!(matches!(hear(&mut swarm, 0.0, source, &flipped), Some(Event::Reject(_))));
    }
    hear(&mut swarm, 0.0, source, b"short");
    let all = swarm.snapshot(0);
    assert_eq!(all.rejects, BTreeMap::from([(Cause::Length, 1), (Cause::Fcs, 3)]));
    assert_eq!(serde_json::to_value(&all).unwrap()["rejects"]["fcs"], 3);
    assert!(all.motes.is_empty());
    assert_eq!((all.sources[0].frames, all.sources[0].rejected), (4, 4));
}

#[test]
fn memory_has_an_end() {
    let (mut swarm, source) = swarm();
    for n in 0..3 * MOTES {
        let mut mote = Teller::new(n as u16, 0, 0);
        hear(&mut swarm, n as f64, source, &mote.fix(n as f64)).unwrap();
    }
    let all = swarm.snapshot(0);
    assert_eq!(all.motes.len(), MOTES);
    assert_eq!(all.forgotten, 2 * MOTES as u64);
    assert_eq!(all.motes[0].mote, 2 * MOTES as u16, "the silent ones went");
    // One id whose sequence never continues.
    for n in 0..10_000u32 {
        hear(
            &mut swarm,
            1e6 + f64::from(n),
            source,
            &Teller::new(1, (n * 7919) as u16, n.wrapping_mul(99_999_999)).fix(0.0),
        );
    }
    assert!(swarm.ids[&(0x4C48, 1)].len() <= VOICES);
}

const KEY: [u8; 16] = *b"a room of its ow";

/// What a mote reports at a time, sealed.
fn sealed(mote: &mut Teller, key: &[u8; 16], counter: u32, at_s: f64) -> Vec<u8> {
    let mut frame = frame::Aligned::BLANK;
    let report = Report {
        half_turn_q8: (HZ * HALF_TURN_S * 256.0) as u32,
        time: mote.offset.wrapping_add((at_s * HZ) as i64 as u32),
        position: [I16F16::from_num(mote.x), I16F16::from_num(1), I16F16::from_num(2)],
        level: Level::Full,
        ..Report::default()
    };
    frame::emit_into(&mut frame, mote.header, &report);
    mote.header.sequence = mote.header.sequence.wrapping_add(1);
    assert!(frame::secured::Key::new(key).seal(&mut frame, counter));
    frame.bytes().to_vec()
}

#[test]
fn forged_replayed_and_plain_frames_are_counted_and_never_make_a_mote() {
    let (mut swarm, source) = swarm();
    let door = swarm.add_source("door", "nrf");
    swarm.under(Some(KEY));
    let mut mote = Teller::new(7, 0, 0);
    let mut again = Teller::new(7, 2, 0);
    let early = sealed(&mut mote, &KEY, 10, 0.0);
    let events = [
        hear(&mut swarm, 0.0, source, &early),
        hear(&mut swarm, 0.1, source, &early),
        hear(&mut swarm, 0.2, source, &sealed(&mut mote, &KEY, 100, 0.2)),
        hear(&mut swarm, 0.3, source, &early),
        hear(&mut swarm, 0.4, source, &sealed(&mut Teller::new(8, 0, 0), b"another room's..", 1, 0.4)),
        hear(&mut swarm, 0.5, source, &Teller::new(9, 0, 0).fix(0.5)),
        hear(&mut swarm, 0.6, door, &early),
        hear(&mut swarm, 0.7, door, &sealed(&mut mote, &KEY, 101, 0.7)),
        hear(&mut swarm, 0.8, source, &sealed(&mut again, &KEY, 101, 0.7)),
    ];
    let told: Vec<Option<Cause>> = events
        .iter()
        .map(|event| match event {
            Some(Event::Reject(rejected)) => Some(rejected.cause),
            _ => None,
        })
        .collect();
    let (replayed, mic, plain) = (Some(Cause::Replayed), Some(Cause::Mic), Some(Cause::Unsecured));
    // Sent again at once, and later, to either receiver.
    assert_eq!(told, [None, replayed, None, replayed, mic, plain, replayed, None, None]);
    assert!(events[7].is_some() && events[8].is_none(), "the second receiver's copy is no news");
    let all = swarm.snapshot(TRAIL);
    let [one] = &all.motes[..] else { panic!("{all:?}") };
    assert_eq!((one.key.as_str(), one.frames, all.duplicates), ("4c48/7", 3, 1));
    // Without the key nothing can be checked, and nothing is shown.
    let mut keyless = Swarm::new(None);
    let source = keyless.add_source("roof", "nrf");
    let event = keyless.hear(0.0, source, &early, Signal::default());
    assert!(matches!(event, Some(Event::Reject(Rejected { cause: Cause::NoKey, .. }))), "{event:?}");
}

#[test]
fn of_two_motes_with_one_id_and_one_key_one_is_shown_and_flagged_and_the_other_is_told_of() {
    // As a programmer says it: minutes since 2025 began, times 1024.
    let first = lighthouse_mote::identity::first_counter;
    let (mut swarm, source) = swarm();
    swarm.under(Some(KEY));
    let (mut early, mut later) = (Teller::new(5, 100, 0), Teller::new(5, 30_000, 77_000_000));
    (early.x, later.x) = (1.0, -1.0);
    let (mut counters, mut now_s) = ([first(1_760_000_000), first(1_760_000_600)], 0.0);
    let mut both = |swarm: &mut Swarm, speak: [bool; 2], seconds: u32| {
        for _ in 0..10 * seconds {
            now_s += 0.1;
            for (n, mote) in [&mut early, &mut later].into_iter().enumerate().filter(|(n, _)| speak[*n]) {
                counters[n] += 1;
                hear(swarm, now_s, source, &sealed(mote, &KEY, counters[n], now_s));
            }
        }
        swarm.pass(now_s);
    };
    both(&mut swarm, [true, false], 5);
    let all = swarm.snapshot(TRAIL);
    assert!(!all.motes[0].has_refused_twin && all.refused_motes.is_empty() && all.refusals().is_none());
    both(&mut swarm, [true, true], 5);
    let all = swarm.snapshot(TRAIL);
    let [one] = &all.motes[..] else { panic!("{:?}", all.motes) };
    assert!(one.has_refused_twin && !one.is_conflict, "{one:?}");
    assert_eq!(one.fix.unwrap().position_m.unwrap()[0], -1.0, "the one that was programmed later");
    assert!(swarm.mote(0x4C48, 5, 0, 0).unwrap().has_refused_twin);
    let [refused] = &all.refused_motes[..] else { panic!("{:?}", all.refused_motes) };
    assert_eq!((refused.key.as_str(), refused.is_twin), ("4c48/5", true));
    assert!(refused.frames > 45 && refused.silent_s < 0.2, "{refused:?}");
    assert!(all.refusals().unwrap().contains("another mote says that it is this one"), "{:?}", all.refusals());
    assert!(all.rejects[&Cause::Replayed] > 45);
    let json = serde_json::to_value(&all).unwrap();
    assert_eq!((&json["motes"][0]["has_refused_twin"], &json["refused_motes"][0]["mote"]), (&true.into(), &5.into()));
    // The flag goes with its cause; what was, is told at the end.
    both(&mut swarm, [false, true], 11);
    let all = swarm.snapshot(TRAIL);
    assert!(!all.motes[0].has_refused_twin && all.refusals().is_none() && all.refused_motes.len() == 1);
    // Where the one that is ahead falls silent, the other is still told of.
    both(&mut swarm, [true, false], 11);
    let all = swarm.snapshot(TRAIL);
    assert!(all.refusals().is_some() && all.motes[0].silent_s > 10.0, "{all:?}");
}

#[test]
fn a_flood_of_old_frames_leaves_every_mote_where_it_is() {
    const MOTES: u16 = 200;
    let (mut swarm, source) = swarm();
    swarm.under(Some(KEY));
    let mut motes: Vec<Teller> = (0..MOTES).map(|mote| Teller::new(mote, mote, 0)).collect();
    let mut old: Vec<Teller> = (0..MOTES).map(|mote| Teller { x: 9.0, ..Teller::new(mote, 5_000, 9_999) }).collect();
    for (n, at_s) in times(0.0, 40).enumerate() {
        for (mote, old) in motes.iter_mut().zip(&mut old) {
            mote.x = at_s;
            let counter = 100_000 + n as u32;
            assert!(matches!(hear(&mut swarm, at_s, source, &sealed(mote, &KEY, counter, at_s)), Some(Event::Fix(_))));
            for again in 0..3 {
                let replay = sealed(old, &KEY, 1_000 + 3 * n as u32 + again, at_s);
                assert!(matches!(hear(&mut swarm, at_s, source, &replay), Some(Event::Reject(_))));
            }
        }
    }
    let all = swarm.snapshot(TRAIL);
    assert_eq!((all.motes.len(), all.forgotten, all.rejects[&Cause::Replayed]), (MOTES.into(), 0, 24_000));
    for mote in &all.motes {
        // What drops motes in conflict drops none of these.
        assert!(!mote.is_conflict && mote.has_refused_twin && mote.frames == 40 && mote.twin == 0, "{mote:?}");
        assert!((mote.fix.unwrap().position_m.unwrap()[0] - 3.9).abs() < 1e-4);
        assert!(mote.trail.iter().all(|at| at[1] < 4.0));
    }
    assert_eq!(all.refused_motes.len(), REFUSED);
    assert!(all.refusals().unwrap().ends_with("and so are 7 others or more"), "{:?}", all.refusals());
}

#[test]
fn motes_that_are_simulated_count_for_themselves() {
    let mut swarm = Swarm::new(None);
    swarm.under(Some(KEY));
    let (air, desk) = (swarm.add_source("roof", "nrf"), swarm.add_source("simulated light", SIMULATION));
    let mut mote = Teller::new(1, 0, 0);
    let real = sealed(&mut mote, &KEY, 1_000_000, 0.0);
    assert!(matches!(hear(&mut swarm, 0.0, air, &real), Some(Event::Fix(_))));
    let simulated = sealed(&mut Teller::new(1, 7_000, 0), &KEY, 0, 0.1);
    assert!(matches!(hear(&mut swarm, 0.1, desk, &simulated), Some(Event::Fix(_))));
    // Not the other way round: what is simulated opens no door.
    assert!(matches!(hear(&mut swarm, 0.2, air, &simulated), Some(Event::Reject(_))));
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("counters");
    swarm.guard_mut().save(&path).unwrap();
    assert_eq!(std::fs::read_to_string(&path).unwrap(), "4c48 0001 1000000\n");
}
