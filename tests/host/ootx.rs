//! Stations as others encode them. What was recorded of real ones is in `chain.rs` beside this.

use half::f16;
use proptest::prelude::*;
use proptest::strategy::ValueTree;
use sim::world::ootx::{Info, frame};
use sim::world::rotor::Rotor;

use crate::ootx::{Block, Config, Half, Outcome, State, gap, step};
use crate::sweep::Axis;

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
    }
}
