//! When to listen before talking: unslotted CSMA-CA (IEEE 802.15.4-2006, 7.5.1.4).
//!
//! What can go wrong: a channel that is never clear. After five tries the frame is given up; the next one is newer.

/// One backoff period: 20 symbols of 16 us (7.4.1, aUnitBackoffPeriod).
const PERIOD_US: u32 = 320;
/// The exponents between which the wait grows (7.4.2, macMinBE and macMaxBE).
const MIN_EXPONENT: u8 = 3;
const MAX_EXPONENT: u8 = 5;
/// Busy channels borne with after the first (7.4.2, macMaxCSMABackoffs).
const MAX_BACKOFFS: u8 = 4;

/// How often a frame has been held back, and the dice.
#[derive(Debug, Clone)]
pub struct Csma {
    busy: u8,
    random: u32,
}

impl Csma {
    /// Dice of its own for each `seed`: motes that wait alike collide for ever.
    pub const fn new(seed: u32) -> Self {
        // Spread over all bits by 2^32 over the golden ratio; zero is the one state that the generator never leaves.
        let random = seed.wrapping_mul(0x9e37_79b9);
        Self { busy: 0, random: if random == 0 { 1 } else { random } }
    }

    /// A new frame: how long to wait before listening, us; it may be nothing.
    pub fn begin(&mut self) -> u32 {
        self.busy = 0;
        self.wait()
    }

    /// The channel was busy: how long to wait before listening again, us; `None` gives the frame up.
    pub fn again(&mut self) -> Option<u32> {
        self.busy = self.busy.saturating_add(1);
        (self.busy <= MAX_BACKOFFS).then(|| self.wait())
    }

    /// 0 ..= 2^exponent - 1 periods, by Marsaglia's xorshift.
    fn wait(&mut self) -> u32 {
        self.random ^= self.random << 13;
        self.random ^= self.random >> 17;
        self.random ^= self.random << 5;
        let exponent = MIN_EXPONENT.saturating_add(self.busy).min(MAX_EXPONENT);
        // The high bits: the low ones of a xorshift are its worst.
        PERIOD_US * (self.random >> (32 - u32::from(exponent)))
    }
}
