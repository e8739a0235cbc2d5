//! Stations as others encode them, and as they were recorded.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use half::f16;
use proptest::prelude::*;
use proptest::strategy::ValueTree;
use sim::world::ootx::{Info, frame};
use sim::world::rotor::Rotor;

use crate::ootx::{Block, Config, Half, Outcome, State, gap, step};
use crate::pulse::Pulse;
use crate::sweep::{self, Axis, Light};
use crate::time::{Span, Ticks};

/// Every frame is read.
const CONFIG: Config = Config { rest_bits: 0, ids: [None, None] };

/// What happens to a bit on its way.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Fate {
    Seen,
    Wrong,
    /// Missed, and counted.
    Missed,
    /// Missed, and nobody noticed.
    Swallowed,
}

/// Everything heard of `bits`.
fn hear(state: &mut State, bits: impl IntoIterator<Item = (bool, Fate)>) -> Vec<Outcome> {
    let mut heard = Vec::new();
    for (bit, fate) in bits {
        match fate {
            Fate::Seen => heard.extend(step(&CONFIG, state, bit)),
            Fate::Wrong => heard.extend(step(&CONFIG, state, !bit)),
            Fate::Missed => gap(state, 1),
            Fate::Swallowed => {}
        }
    }
    heard
}

fn any_rotor() -> impl Strategy<Value = Rotor> {
    any::<[f32; 5]>().prop_map(|[phase, tilt, curve, gibphase, gibmag]| Rotor {
        phase_rad: phase.into(),
        tilt_rad: tilt.into(),
        curve: curve.into(),
        gibbous_phase_rad: gibphase.into(),
        gibbous_magnitude_rad: gibmag.into(),
    })
}

fn any_info() -> impl Strategy<Value = Info> {
    let numbers = (any::<u32>(), 0..1u16 << 10, 0..64u8, any::<[u8; 4]>(), any::<[i8; 3]>());
    numbers.prop_map(|(id, firmware, protocol, [unlock_count, hardware, mode, faults], acceleration)| Info {
        id,
        firmware,
        protocol,
        unlock_count,
        hardware,
        acceleration,
        mode,
        faults,
    })
}

/// One bit in twenty is missed; nothing else happens to it.
fn lossy(length: usize) -> impl Strategy<Value = Vec<Fate>> {
    prop::collection::vec(prop_oneof![19 => Just(Fate::Seen), 1 => Just(Fate::Missed)], length)
}

/// Anything happens.
fn noisy(length: usize) -> impl Strategy<Value = Vec<Fate>> {
    let fate = prop_oneof![
        500 => Just(Fate::Seen), 10 => Just(Fate::Missed), 1 => Just(Fate::Wrong), 1 => Just(Fate::Swallowed)
    ];
    prop::collection::vec(fate, length)
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn any_station_is_heard_after_any_garbage(
        info in any_info(), azimuth in any_rotor(), elevation in any_rotor(),
        garbage in prop::collection::vec(any::<bool>(), 0..800),
    ) {
        let sent = info.block(&azimuth, &elevation);
        let bits = frame(&sent);
        let mut state = State::default();
        let said = hear(&mut state, garbage.into_iter().map(|bit| (bit, Fate::Seen)));
        prop_assert!(!said.iter().any(|outcome| matches!(outcome, Outcome::Good(_))));
        // The first frame may end in what the garbage began; the second cannot.
        let heard = hear(&mut state, bits.iter().cycle().take(2 * bits.len()).map(|&bit| (bit, Fate::Seen)));
        let Some(Outcome::Good(block)) = heard.last() else { panic!("{heard:?}") };
        prop_assert_eq!(block, &Block::new(sent));
        prop_assert_eq!((block.id(), block.firmware(), block.protocol()), (info.id, info.firmware, info.protocol));
        prop_assert_eq!((block.unlock_count(), block.hardware()), (info.unlock_count, info.hardware));
        prop_assert_eq!((block.acceleration(), block.mode(), block.faults()), (info.acceleration, info.mode, info.faults));
        for (rotor, axis) in [(azimuth, Axis::Azimuth), (elevation, Axis::Elevation)] {
            let terms = block.terms(axis);
            let wanted = [
                rotor.phase_rad, rotor.tilt_rad, rotor.curve, rotor.gibbous_phase_rad, rotor.gibbous_magnitude_rad,
            ];
            let read = [terms.phase, terms.tilt, terms.curve, terms.gibphase, terms.gibmag];
            prop_assert_eq!(read.map(|half| half.0), wanted.map(|term| f16::from_f64(term).to_bits()));
        }
    }

    #[test]
    fn bits_that_are_missed_wrong_or_swallowed_never_make_a_wrong_block(
        info in any_info(), fates in noisy(20 * 358), start in 0..358usize,
    ) {
        let sent = Block::new(info.block(&Rotor::default(), &Rotor::default()));
        let bits = frame(sent.bytes());
        let heard = hear(&mut State::default(), bits.iter().copied().cycle().skip(start).zip(fates));
        for outcome in heard {
            if let Outcome::Good(block) = outcome {
                prop_assert_eq!(block, sent);
            }
        }
    }

    #[test]
    fn arbitrary_bits_and_gaps_never_panic(bits in prop::collection::vec((any::<bool>(), any::<u8>()), 0..3_000)) {
        let mut state = State::default();
        for (bit, missed) in bits {
            gap(&mut state, missed.saturating_sub(245));
            let _ = step(&CONFIG, &mut state, bit);
        }
    }

    #[test]
    fn a_station_that_changes_is_heard_as_it_was_or_as_it_is(
        fates in lossy(40 * 358), changes in prop::collection::vec(any::<bool>(), 40),
    ) {
        // Gravity flickers by one unit, as recorded stations' does.
        let block = |up| Info { acceleration: [0, up, 0], ..Info::default() }.block(&Rotor::default(), &Rotor::default());
        let said = [block(126), block(127)];
        let bits = changes.iter().flat_map(|&change| frame(&said[usize::from(change)]));
        for outcome in hear(&mut State::default(), bits.zip(fates)) {
            if let Outcome::Good(block) = outcome {
                prop_assert!(said.contains(block.bytes()));
            }
        }
    }
}

/// With one flash in twenty lost a word comes whole in 0.95^16 = 0.44 of the frames, and a frame never. All 19 words
/// have come after 14 frames with (1 - 0.56^14)^19 = 99.4 %; the search costs two frames, the CRC may one.
#[test]
fn one_flash_in_twenty_lost_still_gives_the_block() {
    let sent = Info { id: 77, ..Info::default() }.block(&Rotor::default(), &Rotor::default());
    let bits = frame(&sent);
    let mut runner = proptest::test_runner::TestRunner::deterministic();
    let mut heard = 0;
    for _ in 0..100 {
        let fates = lossy(17 * 358).new_tree(&mut runner).unwrap().current();
        let outcomes = hear(&mut State::default(), bits.iter().copied().cycle().zip(fates));
        heard += u32::from(outcomes.contains(&Outcome::Good(Block::new(sent))));
    }
    assert!(heard >= 97, "{heard} of 100");
}

#[test]
fn every_half_float_is_the_number_it_stands_for() {
    for bits in 0..=u16::MAX {
        let (ours, theirs) = (Half(bits).to_f64(), f16::from_bits(bits).to_f64());
        assert!(ours.to_bits() == theirs.to_bits() || ours.is_nan() && theirs.is_nan(), "{bits:#x}: {ours} {theirs}");
        if let Some(q24) = Half(bits).q24() {
            assert_eq!(f64::from(q24) / f64::from(1 << 24), theirs, "{bits:#x}");
        } else {
            assert!(!theirs.is_finite() || theirs.abs() >= 128.0, "{bits:#x}");
        }
    }
}

/// The blocks of a station, and what was missed or dropped.
type Heard = (Vec<Block>, BTreeMap<String, u32>);

/// What is heard of both stations in a recording of pulses, through the stages before.
fn recorded(name: &str) -> Option<[Heard; 2]> {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/vive-pulses").join(name);
    let Ok(text) = fs::read_to_string(&file) else {
        eprintln!("skipped: there is no recording ../shared/data/vive-pulses/{name} beside the project");
        return None;
    };
    let mut light = sweep::State::default();
    let mut stations = [State::default(), State::default()];
    let mut heard = [(Vec::new(), BTreeMap::new()), (Vec::new(), BTreeMap::new())];
    let mut last = [None; 2];
    for line in text.lines().skip(1) {
        let (start, width) = line.split_once(',').expect("two columns");
        let number = |text: &str| text.parse::<u64>().expect("a whole number") as u32;
        let pulse = Pulse { start: Ticks(number(start)), width: Span(number(width)) };
        match sweep::step(&sweep::Config::DEFAULT, &mut light, pulse) {
            Some(Light::Sync(sync)) => {
                let (at, half_turn) = (sync.station as usize, light.half_turn().expect("locked").span().0);
                if let Some(last) = last[at] {
                    let slots = (pulse.start.since(last).0 + half_turn / 2) / half_turn;
                    gap(&mut stations[at], u8::try_from(slots - 1).unwrap_or(u8::MAX));
                    *heard[at].1.entry("missed".to_string()).or_default() += slots - 1;
                }
                last[at] = Some(pulse.start);
                match step(&CONFIG, &mut stations[at], sync.data) {
                    Some(Outcome::Good(block)) => heard[at].0.push(block),
                    Some(Outcome::Bad(flaw)) => *heard[at].1.entry(format!("{flaw:?}")).or_default() += 1,
                    None => {}
                }
            }
            Some(Light::Lost) => {
                for at in 0..2 {
                    stations[at].restart();
                    *heard[at].1.entry("lost".to_string()).or_default() += 1;
                }
                last = [None; 2];
            }
            _ => {}
        }
    }
    Some(heard)
}

/// The phases, rad.
fn phases(block: &Block) -> [f64; 2] {
    [Axis::Azimuth, Axis::Elevation].map(|axis| block.terms(axis).phase.to_f64())
}

/// `printed` is all the digits that `value` was printed with.
fn is_as_printed(value: f64, printed: f64, digit: f64) -> bool {
    (value - printed).abs() <= digit / 2.0 + 1e-12
}

#[test]
fn a_recorded_headset_hears_both_stations() {
    let Some([a, b]) = recorded("hmd-one-station-visible.csv") else { return };
    for ((blocks, flaws), frames, id, [azimuth, elevation], digits) in [
        (&a, 4, 3_200_290_360, [0.01559, 0.0382], [1e-5, 1e-4]),
        (&b, 5, 3_275_443_681, [0.0547, 0.06186], [1e-4, 1e-5]),
    ] {
        assert_eq!(blocks.len(), frames, "{flaws:?}");
        for block in blocks {
            assert_eq!((block.id(), block.protocol(), block.faults()), (id, 6, 0));
            assert!(is_as_printed(phases(block)[0], azimuth, digits[0]), "{:?}", phases(block));
            assert!(is_as_printed(phases(block)[1], elevation, digits[1]), "{:?}", phases(block));
        }
    }
}

#[test]
fn a_recorded_tracker_hears_a_station() {
    let Some([_, (blocks, flaws)]) = recorded("tracker-two-stations.csv") else { return };
    assert!(!blocks.is_empty(), "{flaws:?}");
    for block in &blocks {
        assert_eq!(block.id(), 178_605_925);
        let tilts = [Axis::Azimuth, Axis::Elevation].map(|axis| block.terms(axis).tilt.to_f64());
        assert!(is_as_printed(phases(block)[0], 0.05862, 1e-5) && is_as_printed(phases(block)[1], 0.06216, 1e-5));
        assert!(is_as_printed(tilts[0], 0.001343, 1e-6) && is_as_printed(tilts[1], 0.000_079_3, 1e-7), "{tilts:?}");
    }
}
