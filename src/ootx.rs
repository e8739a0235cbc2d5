//! Data bits of the flashes to what a station says about itself.
//!
//! The length of a flash carries one bit. A station strings them into a frame that it repeats for ever, 358 bits in 3 s:
//!
//! | bits | what |
//! |---|---|
//! | 18 | 17 zeros and a one; nowhere else are there 17 zeros |
//! | 17 | length of the block in bytes, 33, then a one |
//! | 17 x 17 | the block, padded to whole words; a one closes every word of 16 bits |
//! | 2 x 17 | CRC-32 of the block without its padding, each word closed by a one |
//!
//! Words are little-endian, and the bytes travel highest bit first (the public decoders agree; recorded frames too).
//!
//! One flash in twenty may be lost, and a frame without a hole then never comes. But the frame repeats, and a mote that
//! counts the half turns knows which bits it missed ([`gap`]): words with a hole are taken from a later repetition.
//! The CRC over all of them decides, a word of it with every word that comes, so that no bit costs much.
//!
//! ```
//! use lighthouse_mote::ootx::{self, Config, FRAME_BITS, Outcome, State, gap};
//! use sim::world::ootx::{Info, frame};
//! use sim::world::rotor::Rotor;
//!
//! // What station 0xa0000001 sends, from the middle of a frame on, and every 30th flash is missed.
//! let bits = frame(&Info { id: 0xa000_0001, ..Info::default() }.block(&Rotor::default(), &Rotor::default()));
//! assert_eq!(bits.len(), usize::from(FRAME_BITS));
//! let mut state = State::default();
//! let heard = bits.iter().cycle().skip(150).take(20 * bits.len()).enumerate().find_map(|(flash, bit)| {
//!     if flash % 30 == 29 {
//!         gap(&mut state, 1);
//!         return None;
//!     }
//!     ootx::step(&Config::DEFAULT, &mut state, *bit)
//! });
//! let Some(Outcome::Good(block)) = heard else { panic!("no frame in a minute") };
//! assert_eq!((block.id(), state.bad()), (0xa000_0001, 0));
//! ```
//!
//! What can go wrong: a bit is read wrong, or the block changes between two repetitions: the CRC does not fit, and
//! everything gathered is dropped and counted. A miscounted gap moves the place in the frame: a zero then stands where a
//! one must be, and the search for the 17 zeros starts again. Nothing but a whole frame with a right CRC comes out.

mod block;

pub use block::{BLOCK_BYTES, Block, Half, Terms};

/// Zeros before the one that starts a frame.
pub const PREAMBLE_ZEROS: u8 = 17;
/// Bits of a frame, preamble included: 18 + 17 + 17 x 17 + 2 x 17, as above.
pub const FRAME_BITS: u16 = 358;

/// Words of the block, its padding included.
const BLOCK_WORDS: usize = BLOCK_BYTES.div_ceil(2);
/// Words of block and CRC.
const WORDS: usize = BLOCK_WORDS + 2;
/// Every word of block and CRC, a bit each.
const ALL: u32 = (1 << WORDS) - 1;
/// CRC-32 of IEEE 802.3, reflected.
const POLYNOMIAL: u32 = 0xedb8_8320;

/// Looking for the preamble.
const HUNTING: u8 = 0;
/// The place of the length; the words of block and CRC follow.
const LENGTH: u8 = 1;
/// The place of the next frame's preamble, after the words.
const PREAMBLE: u8 = LENGTH + WORDS as u8 + 1;
/// Bits in a word, its closing one aside.
const WORD_BITS: u8 = 16;

/// How often a station is listened to, and who it should be.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Config {
    /// After a good frame, so many bits go by unread, 120 a second: what a station says hardly changes. At most 9 min.
    pub rest_bits: u16,
    /// The serial numbers of stations A and B, where the room's file names them.
    pub ids: [Option<u32>; 2],
}

impl Config {
    /// Read every two minutes.
    pub const DEFAULT: Self = Self { rest_bits: 120 * 120, ids: [None, None] };

    /// Whether `id` is not who the room's file expects to be `station`.
    #[must_use]
    pub fn is_stranger(&self, station: crate::sweep::Station, id: u32) -> bool {
        self.ids[station as usize].is_some_and(|expected| expected != id)
    }
}

/// What a bit completed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Outcome {
    /// A whole block whose CRC fits.
    Good(Block),
    /// What was gathered is no frame, and is dropped.
    Bad(Flaw),
}

/// Why what was gathered is no frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Flaw {
    /// A zero where a one must be, or the other way round.
    Framing,
    /// The length is not that of a block.
    Length,
    /// The CRC does not fit.
    Crc,
}

/// What a bit did.
enum Progress {
    Bit,
    /// It closed a word.
    Word,
    Flaw(Flaw),
}

/// One station's frame as far as it has come. 56 bytes, all of them 0 at first.
#[derive(Debug, Clone, Default)]
pub struct State {
    /// Block and CRC.
    words: [u16; WORDS],
    /// The words that have come, a bit each.
    known: u32,
    /// Over the first `checked` words of the block.
    crc: u32,
    checked: u8,
    /// Bits still to go by unread.
    rest: u16,
    /// The word that is coming.
    word: u16,
    /// Which one that is: [`HUNTING`], [`LENGTH`], those of block and CRC, [`PREAMBLE`].
    place: u8,
    /// Bits of it that have gone by; zeros in a row while hunting.
    bits: u8,
    /// One of them was missed.
    torn: bool,
    good: u8,
    bad: u8,
}

impl State {
    /// Frames whose CRC fitted, since start-up, wrapping.
    #[must_use]
    pub const fn good(&self) -> u8 {
        self.good
    }

    /// Frames that were dropped for a flaw, since start-up, wrapping.
    #[must_use]
    pub const fn bad(&self) -> u8 {
        self.bad
    }

    /// Whether the latest bit was the one that ends a preamble: the same flash for all who hear that station.
    #[must_use]
    pub const fn is_at_start(&self) -> bool {
        self.place == LENGTH && self.bits == 0
    }

    /// Whether bits go by unread.
    #[must_use]
    pub const fn is_resting(&self) -> bool {
        self.rest > 0
    }

    /// Starts from nothing, counters aside: the cycle was lost, so the place in the frame is, and who flashes may be
    /// another station. Ends a rest too.
    #[inline(never)]
    pub fn restart(&mut self) {
        self.rest = 0;
        self.drop_words();
        self.hunt();
    }

    fn drop_words(&mut self) {
        self.known = 0;
        self.crc = 0;
        self.checked = 0;
    }

    fn hunt(&mut self) {
        self.place = HUNTING;
        self.bits = 0;
    }

    /// Moves on by one bit, `None` if it was missed.
    #[inline]
    fn advance(&mut self, bit: Option<bool>) -> Progress {
        let end = match self.place {
            HUNTING => {
                match bit {
                    Some(false) if self.bits < PREAMBLE_ZEROS => self.bits += 1,
                    Some(false) => {}
                    Some(true) if self.bits == PREAMBLE_ZEROS => self.begin(LENGTH),
                    _ => self.bits = 0,
                }
                return Progress::Bit;
            }
            PREAMBLE => PREAMBLE_ZEROS,
            _ => WORD_BITS,
        };
        if self.bits >= end {
            return self.close(bit);
        }
        self.bits += 1;
        match bit {
            Some(true) if self.place == PREAMBLE => return Progress::Flaw(Flaw::Framing),
            Some(bit) => self.word = self.word << 1 | u16::from(bit),
            None => self.torn = true,
        }
        Progress::Bit
    }

    /// Takes the bit that closes a word, and the word with it.
    #[inline(never)]
    fn close(&mut self, bit: Option<bool>) -> Progress {
        if bit == Some(false) {
            return Progress::Flaw(Flaw::Framing);
        }
        // The byte that came first is the lower one.
        let word = self.word.swap_bytes();
        match self.place {
            PREAMBLE => {
                self.begin(LENGTH);
                return Progress::Word;
            }
            LENGTH if !self.torn && word != BLOCK_BYTES as u16 => return Progress::Flaw(Flaw::Length),
            LENGTH => {}
            place => {
                let index = place - (LENGTH + 1);
                let mask = 1 << index;
                if !self.torn
                    && self.known & mask == 0
                    && let Some(kept) = self.words.get_mut(usize::from(index))
                {
                    *kept = word;
                    self.known |= mask;
                }
            }
        }
        self.begin(self.place + 1);
        Progress::Word
    }

    fn begin(&mut self, place: u8) {
        self.place = place;
        self.bits = 0;
        self.torn = false;
    }

    /// Takes the CRC one word further where that is known; whether everything is.
    #[inline(never)]
    fn check(&mut self) -> bool {
        let index = usize::from(self.checked);
        if index < BLOCK_WORDS && self.known >> index & 1 != 0 {
            let word = self.words.get(index).copied().unwrap_or(0);
            let (word, steps) = if index == BLOCK_WORDS - 1 { (word & 0xff, 8) } else { (word, 16) };
            let mut crc = !self.crc ^ u32::from(word);
            for _ in 0..steps {
                let odd = crc & 1 != 0;
                crc >>= 1;
                if odd {
                    crc ^= POLYNOMIAL;
                }
            }
            self.crc = !crc;
            self.checked += 1;
        }
        usize::from(self.checked) == BLOCK_WORDS && self.known == ALL
    }

    #[cold]
    #[inline(never)]
    fn refuse(&mut self, flaw: Flaw) -> Outcome {
        self.bad = self.bad.wrapping_add(1);
        self.drop_words();
        if flaw != Flaw::Crc {
            self.hunt();
        }
        Outcome::Bad(flaw)
    }

    #[cold]
    #[inline(never)]
    fn conclude(&mut self, config: &Config) -> Outcome {
        let [words @ .., low, high] = &self.words;
        if u32::from(*low) | u32::from(*high) << 16 != self.crc {
            return self.refuse(Flaw::Crc);
        }
        let block = Block::of(words);
        self.good = self.good.wrapping_add(1);
        self.drop_words();
        self.rest = config.rest_bits;
        if self.rest > 0 {
            self.hunt();
        }
        Outcome::Good(block)
    }
}

/// Takes the data bit of one flash; one [`State`] per station.
#[inline]
pub fn step(config: &Config, state: &mut State, bit: bool) -> Option<Outcome> {
    if state.rest > 0 {
        state.rest -= 1;
        return None;
    }
    match state.advance(Some(bit)) {
        Progress::Bit => None,
        Progress::Word => state.check().then(|| state.conclude(config)),
        Progress::Flaw(flaw) => Some(state.refuse(flaw)),
    }
}

/// Is told of `missed` flashes of that station between the last bit and the next.
///
/// 255 stands for any larger number too, and starts from nothing: so long a darkness loses more than it keeps.
pub fn gap(state: &mut State, missed: u8) {
    if missed == u8::MAX {
        state.restart();
        return;
    }
    for _ in 0..missed {
        if state.rest > 0 {
            state.rest -= 1;
        } else {
            // A bit that nobody saw contradicts nothing.
            let _ = state.advance(None);
        }
    }
}
