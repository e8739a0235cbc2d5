//! When motes in one room have something to send, and what.
//!
//! Every mote sees the same light: half turns of 8.333 ms, in each of which a laser passes it at a moment of its own,
//! after which a report may go out. That is why motes that count half turns on their own collide for as long as they run,
//! and why motes that count them alike need not collide at all.
//!
//! What can go wrong: motes stand still here, so a pair whose lasers pass at the same moments stays one; real ones walk.

use lighthouse_mote::frame::secured::OVERHEAD;
use lighthouse_mote::frame::{HEALTH_LEN, LEN};
use lighthouse_mote::ootx::FRAME_BITS;
use lighthouse_mote::send::is_own;

use super::air::{Nanos, Wish, air_time};

/// Half a turn of a 60 Hz rotor.
pub const HALF_TURN: f64 = 1e9 / 120.0;
/// Half turns in a second.
const PER_SECOND: u64 = 120;
/// Motes are within this of straight ahead of each rotor, half turns: 45 degrees.
const VIEW: f64 = 0.25;
/// From the laser to the first bit of the frame: at the least and at the most. The bench measures 1.4 ms at the most on
/// the slower multiplier; supplies alone take 0.1 ms.
const SOLVED: (f64, f64) = (0.9e6, 1.4e6);
/// How long a SCuM-3C counts its oscillators behind a health frame: six half turns, and the supplies for what waited
/// (`COUNTED` of `src/bin/scum3c/tuning.rs`, `SETTLE` of its `radio.rs`).
const COUNTING: f64 = 6.0 * HALF_TURN + 0.1e6;
/// Behind every how many health frames: `REST` of the same, and that one.
pub const COUNTED_EVERY: u64 = 61;
/// A packet of the 2020 paper's firmware: station and rotor, flash and laser as 32 bits each, check sequence; no header
/// and nobody's name.
pub const RAW_LEN: usize = 11;

/// How motes decide when to send.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Policy {
    /// Every so many half turns since the mote found the light.
    Steady,
    /// The same on average, by the dice of each mote.
    Jittered,
    /// In the half turns whose number since the station's frame began is the mote's own.
    Slotted,
    /// As the 2020 paper: four raw timings for each fix, as they come.
    Raw,
}

impl Policy {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Raw, Self::Steady, Self::Jittered, Self::Slotted];
}

/// A room full of motes.
#[derive(Debug, Clone, Copy)]
pub struct Swarm {
    /// How many.
    pub motes: u32,
    /// A fix every so many half turns.
    pub every: u16,
    /// When they send.
    pub policy: Policy,
    /// For how long.
    pub seconds: u32,
    /// Where they stand and how their dice fall.
    pub seed: u64,
    /// Frames are under a key, and longer. What is slotted was sealed by the time of its slot.
    pub is_sealed: bool,
    /// Each mote counts its oscillators once a minute, as a SCuM-3C does, and sends nothing meanwhile.
    pub counts: bool,
}

/// A mote that stands somewhere.
struct Mote {
    /// When each rotor's laser passes in its half turn, ns.
    passes: [f64; 4],
    /// Half turns before the first.
    phase: u64,
    /// When in its second the health frame is due, half turns.
    health: u64,
}

impl Swarm {
    /// Every frame that wants to go out.
    #[must_use]
    pub fn wishes(&self) -> Vec<Wish> {
        let mut dice = fastrand::Rng::with_seed(self.seed ^ u64::from(self.motes) << 32);
        let mut wishes = Vec::new();
        let mut fixes = 0;
        for id in 0..self.motes {
            let mote = Mote {
                passes: core::array::from_fn(|_| (0.5 + VIEW * (2.0 * dice.f64() - 1.0)) * HALF_TURN),
                phase: dice.u64(..u64::from(self.every)),
                health: dice.u64(..PER_SECOND),
            };
            self.one(id, &mote, &mut dice, &mut wishes, &mut fixes);
        }
        wishes
    }

    fn one(&self, id: u32, mote: &Mote, dice: &mut fastrand::Rng, wishes: &mut Vec<Wish>, fixes: &mut u32) {
        let half_turns = u64::from(self.seconds) * PER_SECOND;
        let every = u64::from(self.every);
        let mut due = mote.phase;
        let mut told = mote.health;
        // Dice of its own: all else is the same without.
        let seed = self.seed << 16 ^ u64::from(id) ^ u64::from(self.every) << 48;
        let mut uncounted = fastrand::Rng::with_seed(seed).u64(..COUNTED_EVERY);
        // When the radio is done with what it has; when it has counted.
        let (mut free, mut counted) = (0, 0);
        for half_turn in 0..half_turns {
            let is_due = match self.policy {
                Policy::Slotted => is_own((half_turn % u64::from(FRAME_BITS)) as u16, id as u16, self.every),
                _ => half_turn == due,
            };
            if !is_due {
                continue;
            }
            due += match self.policy {
                Policy::Jittered => (every / 2 + dice.u64(..=every)).max(1),
                _ => every,
            };
            let mut wish = |half_turn: u64, len: usize, fix: Option<u32>| {
                let pass = half_turn as f64 * HALF_TURN + mote.passes[half_turn as usize % 4];
                let solved = SOLVED.0 + (SOLVED.1 - SOLVED.0) * dice.f64();
                let lasts = air_time(if self.is_sealed { len + OVERHEAD } else { len });
                let at = ((pass + solved) as Nanos).max(counted);
                free = at.max(free) + lasts;
                wishes.push(Wish { at, mote: id, lasts, fix });
            };
            if self.policy == Policy::Raw {
                (half_turn..half_turn + 4).for_each(|half_turn| wish(half_turn, RAW_LEN, Some(*fixes)));
            } else {
                wish(half_turn, LEN, Some(*fixes));
                // Behind the first report of its second.
                if half_turn >= told {
                    wish(half_turn, HEALTH_LEN, None);
                    told += PER_SECOND;
                    if self.counts && uncounted == 0 {
                        (counted, uncounted) = (free + COUNTING as Nanos, COUNTED_EVERY);
                    }
                    uncounted = uncounted.saturating_sub(1);
                }
            }
            *fixes += 1;
        }
    }
}
