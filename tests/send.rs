//! When motes send: no two of them in one half turn once they know its number, and only what is new.
#![cfg_attr(target_os = "none", no_std, no_main)]

#[cfg(target_os = "none")]
mod harness;

use fixed::types::{I16F16, U0F16};
use lighthouse_mote::frame::{Level, Report};
use lighthouse_mote::ootx::FRAME_BITS;
use lighthouse_mote::send::{Config, SEALING_HALF_TURNS, State, When, is_own, slot, step};
use lighthouse_mote::sweep::HalfTurn;
use lighthouse_mote::time::{Span, Ticks};

/// A tick in 1/256 less than 8.333 ms of 10 MHz.
const HALF_TURN_Q8: u32 = 83_333 << 8;

fn half_turn() -> HalfTurn {
    HalfTurn::from_ticks_q8(HALF_TURN_Q8).unwrap_or_default()
}

const fn sends(when: When) -> Config {
    Config { when, moved_q16: 0, heartbeat_half_turns: 120, ahead_half_turns: 0 }
}

/// A mote in the light: its half turns have numbers of their own until it sees the station's frame begin.
struct Mote {
    state: State,
    every: u16,
    config: Config,
    starts: bool,
}

impl Mote {
    fn new(id: u16, every: u16, when: When) -> Self {
        Self { state: State::new(id), every, config: sends(when), starts: false }
    }

    /// Half turn `number` since the stations were switched on; whether the mote reports in it.
    fn sees(&mut self, number: u32, off: i32, is_exact: bool) -> bool {
        let began = Ticks(number.wrapping_mul(83_333).wrapping_add(0xfff0_0000).wrapping_add_signed(off));
        let before = Span(if is_exact { 30_000 + number % 20_000 } else { 83_333 });
        let light = (began.after(before), before, half_turn());
        step(&self.config, self.every, &mut self.state, light, core::mem::take(&mut self.starts))
    }

    /// It sees the station's frame begin in the half turn that comes next.
    fn reads(&mut self) {
        self.starts = true;
    }
}

fn at_rest(x: i32) -> Report {
    Report {
        position: [I16F16::from_bits(x), I16F16::from_bits(70_000), I16F16::from_bits(-5)],
        level: Level::Full,
        sd: [U0F16::from_bits(20); 3],
        ..Report::default()
    }
}

#[cfg_attr(target_os = "none", defmt_test::tests)]
mod tests {
    use super::*;

    #[test]
    fn every_mote_has_a_slot_and_the_first_half_have_room_between() {
        for every in 1..=130 {
            let mut taken = [false; 130];
            for mote in 0..every {
                let own = slot(mote, every);
                assert!(own < every && !taken[usize::from(own)], "mote {} of {}: {}", mote, every, own);
                assert!(own.is_multiple_of(2) || mote >= every / 2);
                assert_eq!(own, slot(mote + 5 * every, every));
                taken[usize::from(own)] = true;
            }
        }
    }

    #[test]
    fn the_first_half_keep_room_between_where_the_station_s_frame_ends_too() {
        // 358 is so many rounds of them, and none, one, some or all but one half turn more.
        for every in [2, 3, 4, 5, 7, 8, 9, 13, 17, 21, 51, 71, 119, 179, 357, 358] {
            // How many of the first half have each half turn of the frame; its end is followed by its beginning.
            let mut taken = [0u8; FRAME_BITS as usize];
            for mote in 0..every / 2 {
                let own = (0..FRAME_BITS).filter(|number| is_own(*number, mote, every));
                own.for_each(|number| taken[usize::from(number)] += 1);
            }
            for number in 0..taken.len() {
                let next = taken[(number + 1) % taken.len()];
                assert!(taken[number] + next <= 1, "half turn {} of every {}", number, every);
            }
        }
    }

    #[test]
    fn all_motes_of_a_room_share_no_half_turn_and_each_has_its_share() {
        for every in [2, 3, 4, 5, 7, 8, 9, 12, 25, 119, 120, 357, 358] {
            for number in 0..FRAME_BITS {
                let motes = (0..every).filter(|mote| is_own(number, *mote, every)).count();
                assert!(motes == 1 || motes == 0 && number == FRAME_BITS - 1, "{} of every {}", number, every);
            }
            let least = u32::from(FRAME_BITS / every) - u32::from(every % 2 == 1);
            for mote in 0..every {
                let own = (0..FRAME_BITS).filter(|number| is_own(*number, mote, every)).count() as u32;
                assert!((least..=least + 2).contains(&own), "mote {} of {}: {}", mote, every, own);
            }
        }
    }

    #[test]
    fn what_is_made_ahead_is_made_once_for_each_turn_and_so_long_before() {
        let config = Config { ahead_half_turns: SEALING_HALF_TURNS, ..sends(When::Slotted) };
        for every in [5, 7, 8, 9, 120, 358] {
            let mut mote = Mote { config, ..Mote::new(3, every, When::Slotted) };
            let mut plain = Mote::new(3, every, When::Slotted);
            let mut made = [false; SEALING_HALF_TURNS as usize];
            // Over many ends of the station's frame, the first of which it saw begin.
            for number in 0..4_000u32 {
                if number == 10 {
                    mote.reads();
                    plain.reads();
                }
                let (makes, sends) = (mote.sees(number, 0, true), plain.sees(number, 0, true));
                assert_eq!(mote.state.is_turn(&config, every), sends, "{} of every {}", number, every);
                let made = &mut made[number as usize % usize::from(SEALING_HALF_TURNS)];
                let was_made = core::mem::replace(made, makes);
                assert!(number < 20 || was_made == sends, "{} of every {}", number, every);
            }
            // In the dark nothing waits.
            mote.state.forget();
            assert!(mote.state.is_turn(&config, every) && !mote.state.takes_turns(&config));
        }
    }

    #[test]
    fn motes_that_saw_the_frame_begin_at_different_times_never_share_a_half_turn() {
        for every in [2, 7, 8, 12, 100] {
            let (a, b) = (every - 1, every / 2 - 1);
            let mut motes = [Mote::new(a, every, When::Slotted), Mote::new(b, every, When::Slotted)];
            let mut reports = [0; 2];
            for number in 1_000..3_500 {
                // The second was switched on later, and both have seen a frame begin by 2000.
                match number {
                    // 4 and 5 times 358.
                    1_432 => motes[0].reads(),
                    1_790 => motes[1].reads(),
                    _ => {}
                }
                let first = motes[0].sees(number, 0, true);
                let second = number >= 1_333 && motes[1].sees(number, 0, true);
                if number >= 2_000 {
                    assert!(!(first && second), "half turn {} of every {}", number, every);
                    reports[0] += u32::from(first);
                    reports[1] += u32::from(second);
                }
            }
            // 1500 half turns hold four ends of the station's frame, where a slot comes early or is left out.
            for count in reports {
                assert!(count.abs_diff(1_500 / u32::from(every)) <= 5, "{} of every {}", count, every);
            }
        }
    }

    #[test]
    fn half_turns_that_nobody_saw_are_counted() {
        let (mut seeing, mut blind) = (Mote::new(3, 8, When::Slotted), Mote::new(3, 8, When::Slotted));
        for number in 0..1_000u32 {
            let due = seeing.sees(number, 0, true);
            if number % 48 == 0 || number % 100 == 3 {
                assert_eq!(blind.sees(number, 0, true), due, "{}", number);
            }
        }
    }

    #[test]
    fn a_time_that_is_not_exact_moves_no_count() {
        let (mut sure, mut unsure) = (Mote::new(5, 12, When::Slotted), Mote::new(5, 12, When::Slotted));
        for number in 0..2_000u32 {
            let due = sure.sees(number, 0, true);
            // Up to 0.4 half turns early or late, by turns.
            let off = (number.wrapping_mul(7_919) % 66_667) as i32 - 33_333;
            let (is_exact, off) = if number % 50 == 0 { (true, 0) } else { (false, off) };
            assert_eq!(unsure.sees(number, off, is_exact), due, "{}", number);
        }
    }

    #[test]
    fn a_clock_that_is_tuned_moves_no_count() {
        for every in [7, 8, 120, 358] {
            let config = sends(When::Slotted);
            let (mut state, mut began) = (State::new(3), Ticks(0xfff0_0000));
            for number in 0..2_000u32 {
                // By 3 % at once, there and back.
                let ticks = if number / 100 % 2 == 0 { 83_333 } else { 85_833 };
                let half_turn = HalfTurn::from_ticks_q8(ticks << 8).unwrap_or_default();
                let light = (began.after(Span(30_000)), Span(30_000), half_turn);
                let due = step(&config, every, &mut state, light, number == 10);
                if let Some(number) = number.checked_sub(10) {
                    let number = (number % u32::from(FRAME_BITS)) as u16;
                    assert_eq!(due, is_own(number, 3, every), "{} of every {}", number, every);
                }
                began = began.after(Span(ticks));
            }
        }
    }

    #[test]
    fn dice_keep_the_rate_and_fall_differently_for_each_mote() {
        let mut motes = [Mote::new(1, 8, When::Jittered), Mote::new(2, 8, When::Jittered)];
        let (mut reports, mut both, mut last) = ([0; 2], 0, [None; 2]);
        for number in 0..80_000u32 {
            let due = [motes[0].sees(number, 0, true), motes[1].sees(number, 0, true)];
            both += u32::from(due == [true; 2]);
            for k in (0..2).filter(|k| due[*k]) {
                if let Some(last) = last[k].replace(number) {
                    assert!((4..=12).contains(&(number - last)), "{} after {}", number, last);
                }
                reports[k] += 1;
            }
        }
        for count in reports {
            // 10,000 of them, 2.6 half turns of deviation each: 0.3 % of the distance in all; six of that.
            assert!((9_800..10_200).contains(&count), "{}", count);
        }
        // One half turn in 64 by chance: 1250, and six deviations of 35.
        assert!((1_040..1_460).contains(&both), "{}", both);
    }

    #[test]
    fn a_mote_at_rest_sends_its_heartbeat_and_one_that_moves_all() {
        let config = Config { moved_q16: 655, ..sends(When::Slotted) };
        let mut mote = Mote { config, ..Mote::new(0, 8, When::Slotted) };
        let mut reports = [0; 3];
        for number in 0..3 * 1_200u32 {
            if mote.sees(number, 0, true) {
                let phase = (number / 1_200) as usize;
                // Rests within 1 cm, walks 2 cm from report to report, rests.
                let x = if phase == 1 { number as i32 * 164 } else { (number as i32 % 3) * 200 };
                reports[phase] += u32::from(mote.state.is_news(&config, &at_rest(x)));
            }
        }
        assert!((9..=11).contains(&reports[0]) && (9..=11).contains(&reports[2]), "{:?}", reports);
        assert!(reports[1] >= 148, "{:?}", reports);
    }

    #[test]
    fn what_is_known_less_well_must_move_further_and_another_level_is_news() {
        let config = Config { moved_q16: 100, heartbeat_half_turns: u16::MAX, ..sends(When::Steady) };
        let mut state = State::new(0);
        assert!(state.is_news(&config, &at_rest(0)));
        assert!(!state.is_news(&config, &at_rest(100)) && state.is_news(&config, &at_rest(101)));
        let vague = Report { sd: [U0F16::from_bits(900); 3], ..at_rest(1_000) };
        assert!(!state.is_news(&config, &vague));
        assert!(state.is_news(&config, &Report { level: Level::Tracked, ..vague }));
        // Asked for nothing, everything goes.
        assert!(state.is_news(&sends(When::Steady), &vague) && state.is_news(&sends(When::Steady), &vague));
    }
}
