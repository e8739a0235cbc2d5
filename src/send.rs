//! When a mote sends: in a half turn of its own, by dice, or as it comes; and only what is new, if that is asked for.
//!
//! All motes of a room see the same light, so those that report every so many half turns on their own do it in step: two
//! that fell into the same half turn stay there and are never heard. But what they see also numbers the half turns for
//! all of them: station A repeats its frame every [`FRAME_BITS`] flashes, one flash a half turn. A mote that has seen it
//! begin once counts along, and sends in the half turns whose number is its own ([`slot`]). Nobody listens to anybody.
//!
//! A half turn holds one report and a health frame behind it, 5.5 ms. The laser passes within it, so the two may end in
//! the next one, but hardly ever before that one's laser has passed; a slot is therefore one half turn, and the first half
//! of the motes get every second one.
//!
//! A frame that has to be sealed first would come out of its slot, and that of a fast core earlier than a slow one's. Such a
//! mote makes its report [`Config::ahead_half_turns`] before its own, and sends what it sealed in its own ([`State::is_turn`]).
//!
//! ```
//! use lighthouse_mote::send::{self, Config, State, When};
//! use lighthouse_mote::sweep::HalfTurn;
//! use lighthouse_mote::time::{Span, Ticks};
//!
//! // Eight motes in one room, a report each every eighth half turn. All see station A's frame begin in half turn 5.
//! let config = Config { when: When::Slotted, ..Config::default() };
//! let half_turn = HalfTurn::from_ticks_q8(83_333 << 8).expect("10 MHz");
//! let mut motes: Vec<State> = (0..8).map(State::new).collect();
//! let mut senders = vec![0; 40];
//! for (number, senders) in (0..).zip(&mut senders) {
//!     for mote in &mut motes {
//!         // Its laser passed 4 ms after the half turn began.
//!         let light = (Ticks(number * 83_333 + 40_000), Span(40_000), half_turn);
//!         *senders += u32::from(send::step(&config, 8, mote, light, number == 5));
//!     }
//! }
//! assert!(senders[5..].iter().all(|senders| *senders == 1), "one at a time: {senders:?}");
//! ```
//!
//! What can go wrong: until the frame was seen to begin, 18 flashes without a gap, the count is the mote's own: 1.5 s on
//! average in full light, 6 s where one flash in twenty is lost. More motes than slots: two share one for good, so `every`
//! is to be no less than there are motes. Slots come round with the frame, at its end a little early or late.

use crate::frame::{Level, Report};
use crate::ootx::FRAME_BITS;
use crate::sweep::HalfTurn;
use crate::time::{Span, Ticks};

/// How a mote decides.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Config {
    /// Which half turns are its own.
    pub when: When,
    /// A report goes out where the mote has moved by more than this along an axis since the last one, Q16 m, and by more
    /// than its standard deviation; 0 sends every one.
    pub moved_q16: u32,
    /// Of a mote that rests, one report in so many half turns. One second is 120.
    pub heartbeat_half_turns: u16,
    /// Slotted: a report is made so many half turns before the mote's own, which it is to go out in; 0: in that.
    pub ahead_half_turns: u8,
}

/// What sealing a report and a health frame behind it takes, half turns. On the virtual SCuM-3C at 4.85 MHz, in the light,
/// the two leave 30 ms later than without a key. Five half turns are 41.7 ms, of which 36 are certain: the last one's laser
/// may pass two thirds of a half turn earlier than the first one's, 60 degrees to either side.
pub const SEALING_HALF_TURNS: u8 = 5;

/// Half turns that nobody has to look at are reckoned with at most so many at once: a clock that is tuned by 3 % meanwhile
/// is a quarter of a half turn off at their end.
const REACH: u16 = 8;

/// Which half turns are a mote's own.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum When {
    /// Every so many since the last report.
    #[default]
    Steady,
    /// The same on average: dice of each mote throw the distance, half to one and a half of it.
    Jittered,
    /// Those of its [`slot`]; at most [`FRAME_BITS`] apart.
    Slotted,
}

/// The half turn of `every` that is a mote's own, below `every`: 0, 2, 4 .. for the first half of them, then 1, 3, 5 ..
/// Of no half turns at all it is the first.
#[must_use]
#[inline]
pub const fn slot(mote: u16, every: u16) -> u16 {
    let every = if every == 0 { 1 } else { every };
    let twice = 2 * remainder(mote, every) as u32;
    let again = (every - 1) as u32 | 1;
    (if twice >= every as u32 { twice - again } else { twice }) as u16
}

/// Whether the half turn of that number since station A's frame began, below [`FRAME_BITS`], is a mote's own.
///
/// Where `every` is odd, the frame's last one may be an even slot's. It is nobody's then: slot 0 comes right behind it, and
/// would not have the room between that even slots have elsewhere.
#[must_use]
#[inline]
pub const fn is_own(number: u16, mote: u16, every: u16) -> bool {
    let own = slot(mote, every);
    let ends = !every.is_multiple_of(2) && number == FRAME_BITS - 1;
    remainder(number, if every == 0 { 1 } else { every }) == own && !(ends && own.is_multiple_of(2))
}

/// `number` modulo `every`, which is not 0, without a division: the core has no instruction for it.
#[inline]
const fn remainder(number: u16, every: u16) -> u16 {
    if every.is_power_of_two() {
        return number & (every - 1);
    }
    let (mut left, every) = (number as u32, every as u32);
    let mut part = every;
    while part <= left {
        part <<= 1;
    }
    while part > every {
        part >>= 1;
        if left >= part {
            left -= part;
        }
    }
    left as u16
}

/// Where a mote is in its rounds.
#[derive(Debug, Clone, Default)]
pub struct State {
    mote: u16,
    /// Slotted: half turns since station A's frame began, below [`FRAME_BITS`]. By dice: half turns to go to the next one.
    /// Of the half turn that was looked at last.
    count: u16,
    /// Half turns from that one to the next that needs a look, [`REACH`] at most; 0 before the first.
    to_go: u8,
    /// Half a half turn before that one began: times from here on are those of one half turn after another.
    latest: Ticks,
    /// Zero before the first throw.
    dice: u32,
    sent: Option<Sent>,
}

/// The last report.
#[derive(Debug, Clone, Copy)]
struct Sent {
    position: [i32; 3],
    level: Level,
    /// Half turns ago.
    age: u16,
}

impl Config {
    /// Whether half turns are counted for it.
    #[must_use]
    pub const fn counts(&self) -> bool {
        !matches!(self.when, When::Steady) || self.moved_q16 != 0
    }
}

impl State {
    /// Of the mote with that short address.
    #[must_use]
    pub fn new(mote: u16) -> Self {
        Self { mote, ..Self::default() }
    }

    /// The light was lost, and with it the count.
    pub fn forget(&mut self) {
        self.to_go = 0;
    }

    /// Whether what was made ahead waits for a half turn of the mote's own: in the light, where it has some.
    #[must_use]
    pub const fn takes_turns(&self, config: &Config) -> bool {
        config.ahead_half_turns != 0 && matches!(config.when, When::Slotted) && self.to_go != 0
    }

    /// Whether what was made ahead is to go out now: in a half turn of its own, or because it waits for none.
    #[must_use]
    pub const fn is_turn(&self, config: &Config, every: u16) -> bool {
        !self.takes_turns(config) || is_own(self.count, self.mote, every)
    }

    /// One half turn more.
    #[inline(always)]
    fn advance(&mut self, config: &Config, every: u16) {
        if config.moved_q16 != 0
            && let Some(sent) = &mut self.sent
        {
            sent.age = sent.age.saturating_add(1);
        }
        match config.when {
            When::Steady => {}
            When::Jittered => self.count = if self.count > 0 { self.count - 1 } else { self.throw(every) },
            When::Slotted => self.count = if self.count < FRAME_BITS - 1 { self.count + 1 } else { 0 },
        }
    }

    /// Looks at the half turn that began at `began`, as [`step`].
    #[inline(never)]
    fn look(&mut self, config: &Config, every: u16, (began, before, length): (Ticks, Span, u32), starts: bool) -> bool {
        if length == 0 {
            return false;
        }
        let mut since = if self.to_go == 0 { length / 2 } else { began.since(self.latest).0 };
        // At most the 48 that a cycle is carried on without light, and once round the counter where somebody errs.
        while since >= length {
            since -= length;
            self.advance(config, every);
        }
        self.latest = began.before(Span(if before.0 < length { length / 2 } else { since }));
        // Each of these has to be looked at.
        let reach = if config.moved_q16 == 0 && config.ahead_half_turns == 0 { REACH } else { 1 };
        let (is_due, to_go) = match config.when {
            When::Steady => (false, 1),
            When::Jittered => (self.count == 0, self.count.max(1)),
            When::Slotted => {
                if starts {
                    self.count = 0;
                }
                let number = self.count + u16::from(config.ahead_half_turns);
                let number = if number < FRAME_BITS { number } else { number - FRAME_BITS };
                let (own, place) = (slot(self.mote, every), remainder(number, every.max(1)));
                let away = if own > place { own - place } else { own + every - place };
                (is_own(number, self.mote, every), away.min(FRAME_BITS - number))
            }
        };
        self.to_go = to_go.min(reach) as u8;
        is_due
    }

    /// Half turns to go to the one after the next: half of `every` to one and a half, less the one that begins.
    fn throw(&mut self, every: u16) -> u16 {
        if self.dice == 0 {
            // Spread over all bits by 2^32 over the golden ratio; from there the generator never comes to zero.
            self.dice = (u32::from(self.mote) + 1).wrapping_mul(0x9e37_79b9);
        }
        // Marsaglia's xorshift; its high bits, for the low ones are its worst.
        self.dice ^= self.dice << 13;
        self.dice ^= self.dice >> 17;
        self.dice ^= self.dice << 5;
        let spread = ((self.dice >> 16) * (u32::from(every) + 1)) >> 16;
        (every / 2 + spread as u16).saturating_sub(1)
    }

    /// Whether `report` says more than the last one that went out, and if so, it goes.
    #[inline]
    pub fn is_news(&mut self, config: &Config, report: &Report) -> bool {
        if config.moved_q16 == 0 {
            return true;
        }
        let position = report.position.map(|axis| axis.to_bits());
        let is_old = self.sent.is_some_and(|sent| {
            sent.age < config.heartbeat_half_turns
                && sent.level == report.level
                && (0..3).all(|k| {
                    position[k].abs_diff(sent.position[k]) <= config.moved_q16.max(u32::from(report.sd[k].to_bits()))
                })
        });
        if !is_old {
            self.sent = Some(Sent { position, level: report.level, age: 0 });
        }
        !is_old
    }
}

/// Takes the half turn that began `before` ago at `at`: exactly, or about where that is a half turn or more. Whether a
/// report is to be made in it, which for [`When::Steady`] others decide.
///
/// `starts`: its flash of station A ended the preamble of that station's frame. To be called for one half turn after
/// another; those between that nobody saw are counted by their time.
#[inline(always)]
pub fn step(
    config: &Config,
    every: u16,
    state: &mut State,
    (at, before, half_turn): (Ticks, Span, HalfTurn),
    starts: bool,
) -> bool {
    let (began, length) = (at.before(before), half_turn.span().0);
    if !starts && began.since(state.latest).0 < u32::from(state.to_go).wrapping_mul(length) {
        return false;
    }
    state.look(config, every, (began, before, length), starts)
}
