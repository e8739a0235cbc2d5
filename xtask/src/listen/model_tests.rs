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

#[test]
fn forged_replayed_and_plain_frames_are_counted_and_never_make_a_mote() {
    const KEY: [u8; 16] = *b"a room of its ow";
    let sealed = |mote: &mut Teller, key: &[u8; 16], counter: u32, at_s: f64| {
        let mut frame = frame::Aligned::BLANK;
        let report = Report { half_turn_q8: 83_333 << 8, time: (at_s * HZ) as u32, ..Report::default() };
        frame::emit_into(&mut frame, mote.header, &report);
        mote.header.sequence = mote.header.sequence.wrapping_add(1);
        assert!(frame::secured::Key::new(key).seal(&mut frame, counter));
        frame.bytes().to_vec()
    };
    let (mut swarm, source) = swarm();
    swarm.under(Some(KEY));
    let mut mote = Teller::new(7, 0, 0);
    let early = sealed(&mut mote, &KEY, 10, 0.0);
    let events = [
        hear(&mut swarm, 0.0, source, &early),
        hear(&mut swarm, 0.1, source, &early),
        hear(&mut swarm, 0.2, source, &sealed(&mut mote, &KEY, 100, 0.2)),
        hear(&mut swarm, 0.3, source, &early),
        hear(&mut swarm, 0.4, source, &sealed(&mut Teller::new(8, 0, 0), b"another room's..", 1, 0.4)),
        hear(&mut swarm, 0.5, source, &Teller::new(9, 0, 0).fix(0.5)),
    ];
    let told: Vec<Option<Cause>> = events
        .iter()
        .map(|event| match event {
            Some(Event::Reject(rejected)) => Some(rejected.cause),
            _ => None,
        })
        .collect();
    let causes = [None, None, None, Some(Cause::Replayed), Some(Cause::Mic), Some(Cause::Unsecured)];
    assert_eq!(told, causes);
    assert!(events[1].is_none(), "the second receiver's copy is no news");
    let all = swarm.snapshot(TRAIL);
    let [one] = &all.motes[..] else { panic!("{all:?}") };
    assert_eq!((one.key.as_str(), one.frames), ("4c48/7", 2));
    // Without the key nothing can be checked, and nothing is shown.
    let mut keyless = Swarm::new(None);
    let source = keyless.add_source("roof", "nrf");
    let event = keyless.hear(0.0, source, &early, Signal::default());
    assert!(matches!(event, Some(Event::Reject(Rejected { cause: Cause::NoKey, .. }))), "{event:?}");
}
