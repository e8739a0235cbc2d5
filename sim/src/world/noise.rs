//! Randomness that depends on the seed, the purpose and the slot, and on nothing else.
//!
//! Every slot of the light draws from its own stretch of a counter-based generator, so hiding a station for a second
//! changes what is hidden and not one jitter after it. ChaCha8 and libm are the same on every machine, and so is the
//! light.
//!
//! What can go wrong: a slot that draws more than its stretch overlaps the next one's numbers; the stretch is far
//! longer than the dozen draws a slot makes, interference aside.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal, StandardUniform};

const WORDS_PER_SLOT: u128 = 1 << 12;

/// What a stream of numbers is for; each purpose is its own stream of the same seed.
#[derive(Debug, Clone, Copy)]
#[repr(u64)]
pub(super) enum Purpose {
    Path = 1,
    Clock,
    Ootx,
    Rotor,
    Receiver,
    Mirror,
    Interference,
    Weak,
}

/// One stream of random numbers, addressable by slot.
#[derive(Debug, Clone)]
pub(super) struct Noise(ChaCha8Rng);

impl Noise {
    pub(super) fn new(seed: u64, purpose: Purpose) -> Noise {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(purpose as u64);
        Noise(rng)
    }

    /// The same stream, at the stretch that belongs to `slot`.
    pub(super) fn at(&mut self, slot: u64) -> &mut Noise {
        self.0.set_word_pos(u128::from(slot) * WORDS_PER_SLOT);
        self
    }

    /// Uniform in 0..1.
    pub(super) fn uniform(&mut self) -> f64 {
        StandardUniform.sample(&mut self.0)
    }

    /// Uniform in `low..high`.
    pub(super) fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.uniform()
    }

    /// Gaussian, mean 0, deviation 1, cut at `SIGMA_LIMIT`.
    pub(super) fn gaussian(&mut self) -> f64 {
        let draw: f64 = StandardNormal.sample(&mut self.0);
        draw.clamp(-SIGMA_LIMIT, SIGMA_LIMIT)
    }

    /// The wait for the next of independent events that come once per unit of time.
    pub(super) fn wait(&mut self) -> f64 {
        -libm::log(1.0 - self.uniform())
    }
}

/// No gaussian goes further, so that a jittered edge has an earliest moment and the stream can be lazy.
pub(super) const SIGMA_LIMIT: f64 = 6.0;
