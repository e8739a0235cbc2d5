//! Where the channels lie.
//!
//! What can go wrong: a number that is no channel; there is none of it.

/// A channel of the 2.4 GHz band, 11 ..= 26 (IEEE 802.15.4-2006, 6.1.2.1).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Channel(u8);

impl Channel {
    /// The channel of that number, if there is one.
    pub const fn new(number: u8) -> Option<Self> {
        if number >= 11 && number <= 26 { Some(Self(number)) } else { None }
    }

    /// Its centre in MHz above 2400: 2405 + 5 (k - 11) (802.15.4-2006, 6.1.2.1).
    pub const fn mhz_above_2400(self) -> u8 {
        5 + 5 * (self.0 - 11)
    }
}
