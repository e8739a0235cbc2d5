//! The nRF52840's receiver, made ready: what is said over its two wires, against a copy of it.

use std::collections::VecDeque;

use proptest::prelude::*;

#[path = "../../src/bin/nrf52840/ts4231.rs"]
mod driver;

use driver::{Drive, Failure, State, WORD, Wires, start, state};

/// What a TS4231 does, as far as its maker's library shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Mode {
    /// Since power-on; whether light has come, and clocks of E since.
    Fresh {
        lit: bool,
        clocks: u8,
    },
    /// Waits for a transfer.
    Open,
    /// In a transfer: bits so far, and their number.
    Transfer {
        bits: u16,
        count: u8,
    },
    /// E has fallen before D: leaving the open state.
    Leaving,
    Watching,
}

/// A TS4231 on its two wires.
struct Ts4231 {
    mode: Mode,
    word: u16,
    e: Drive,
    d: Drive,
    /// What it says on D while it is read.
    says: Option<bool>,
    us: u64,
    /// Comes to the light at all.
    light: bool,
    /// Takes what is written.
    sound: bool,
}

impl Ts4231 {
    fn new(power_on: bool) -> Self {
        let mode = if power_on { Mode::Fresh { lit: false, clocks: 0 } } else { Mode::Watching };
        Self { mode, word: 0, e: Drive::Released, d: Drive::Released, says: None, us: 0, light: true, sound: true }
    }

    /// A flash of 100 us every 8.333 ms.
    fn lit(&self) -> bool {
        self.light && self.us % 8_333 < 100
    }

    fn level(drive: Drive, itself: bool) -> bool {
        match drive {
            Drive::Low => false,
            Drive::High => true,
            Drive::Released => itself,
        }
    }

    fn wires(&self) -> (bool, bool) {
        let (e, d) = match self.mode {
            Mode::Fresh { .. } => (false, self.lit()),
            Mode::Open | Mode::Leaving => (true, true),
            Mode::Transfer { .. } => (true, self.says.unwrap_or(true)),
            Mode::Watching => (!self.lit(), self.lit() && self.us.is_multiple_of(2)),
        };
        (Self::level(self.e, e), Self::level(self.d, d))
    }

    /// One wire changes: what the chip makes of it.
    fn change(&mut self, drive: impl FnOnce(&mut Self)) {
        let (e, d) = self.wires();
        drive(self);
        let (e_now, d_now) = self.wires();
        let (e_rose, e_fell, d_rose, d_fell) = (!e && e_now, e && !e_now, !d && d_now, d && !d_now);
        let driven_e = self.e != Drive::Released;
        self.mode = match self.mode {
            Mode::Fresh { lit: true, clocks } if e_rose && driven_e => Mode::Fresh { lit: true, clocks: clocks + 1 },
            Mode::Fresh { lit: true, clocks: 2.. } if d_rose && e_now => Mode::Open,
            // On watch it opens in the same way; the clocks do not matter to this copy.
            Mode::Watching if d_rose && e_now && driven_e => Mode::Open,
            Mode::Open if d_fell && e_now => Mode::Transfer { bits: 0, count: 0 },
            Mode::Open if e_fell => Mode::Leaving,
            Mode::Leaving if e_rose && self.d == Drive::Released => Mode::Watching,
            Mode::Transfer { bits, count } if e_rose && count < 15 => {
                Mode::Transfer { bits: bits << 1 | u16::from(d_now), count: count + 1 }
            }
            Mode::Transfer { bits, count } if d_rose && e_now => {
                if count == 15 && bits >> 14 == 0 && self.sound {
                    self.word = bits;
                }
                self.says = None;
                Mode::Open
            }
            other => other,
        };
        // The first bit was a one: the word goes out, a bit for each clock that follows, from the fall before on.
        if let Mode::Transfer { bits, count } = self.mode
            && count > 0
            && bits >> (count - 1) & 1 == 1
            && e_fell
        {
            self.says = 14u8.checked_sub(count).map(|bit| self.word >> bit & 1 != 0);
        }
    }
}

impl Wires for Ts4231 {
    fn e(&mut self, drive: Drive) {
        self.change(|chip| chip.e = drive);
    }

    fn d(&mut self, drive: Drive) {
        self.change(|chip| chip.d = drive);
    }

    fn levels(&mut self) -> (bool, bool) {
        self.wires()
    }

    fn wait_us(&mut self, us: u32) {
        self.us += u64::from(us);
        if let Mode::Fresh { lit, .. } = &mut self.mode {
            *lit |= self.light && self.us % 8_333 >= 100;
        }
    }
}

proptest! {
    #[test]
    fn a_ts4231_ends_on_watch_with_our_word_whatever_it_remembered(power_on: bool, word in 0..1u16 << 14) {
        let mut chip = Ts4231 { word, ..Ts4231::new(power_on) };
        prop_assert_eq!(start(&mut chip), Ok(()));
        prop_assert_eq!(chip.mode, Mode::Watching);
        prop_assert_eq!(chip.word, WORD);
        prop_assert_eq!((chip.e, chip.d), (Drive::Released, Drive::Released));
    }
}

#[test]
fn a_ts4231_that_sees_no_light_is_said_to_be_in_the_dark() {
    let mut chip = Ts4231 { light: false, ..Ts4231::new(true) };
    assert_eq!(start(&mut chip), Err(Failure::Dark));
    chip.light = true;
    assert_eq!(start(&mut chip), Ok(()));
}

#[test]
fn a_ts4231_that_forgets_is_caught_by_reading_back() {
    let mut chip = Ts4231 { sound: false, word: 0x1234, ..Ts4231::new(true) };
    assert_eq!(start(&mut chip), Err(Failure::Word(0x1234)));
}

#[test]
fn wires_that_lead_nowhere_are_said_not_to_open() {
    struct Nothing(bool, bool);
    impl Wires for Nothing {
        fn e(&mut self, _: Drive) {}
        fn d(&mut self, _: Drive) {}
        fn levels(&mut self) -> (bool, bool) {
            (self.0, self.1)
        }
        fn wait_us(&mut self, _: u32) {}
    }
    assert_eq!(start(&mut Nothing(false, false)), Err(Failure::Dark));
    assert_eq!(start(&mut Nothing(true, false)), Err(Failure::Closed(State::Watching)));
    assert_eq!(start(&mut Nothing(false, true)), Err(Failure::Closed(State::Asleep)));
    assert_eq!(start(&mut Nothing(true, true)), Err(Failure::Word(0x3fff)));
}

#[test]
fn one_look_spoilt_by_light_does_not_change_what_is_seen() {
    struct Looks(VecDeque<(bool, bool)>);
    impl Wires for Looks {
        fn e(&mut self, _: Drive) {}
        fn d(&mut self, _: Drive) {}
        fn levels(&mut self) -> (bool, bool) {
            self.0.pop_front().unwrap()
        }
        fn wait_us(&mut self, _: u32) {}
    }
    let watching = (true, false);
    let lit = (false, true);
    for looks in [[lit, watching, watching], [watching, lit, watching], [watching, watching, lit]] {
        assert_eq!(state(&mut Looks(looks.into_iter().collect())), State::Watching);
    }
    let mixed = vec![watching, lit, (true, true)];
    assert_eq!(state(&mut Looks(mixed.into())), State::Unclear);
}
