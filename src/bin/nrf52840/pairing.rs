//! Captured edges to pulses: which rise and which fall belong together.
//!
//! The hardware keeps the time of the newest rise, the time of the newest fall, and how many of each there were. The
//! interrupt comes at a fall, some time later, and in between anything may have happened. Pure, so that a computer can
//! try all of it.
//!
//! What can go wrong:
//! - Both edges of a short pulse are over before the interrupt: nothing is lost, that is the usual case.
//! - The light is on again already: the newest rise is the next pulse's. It waits for its fall; the pulse before it has
//!   lost its rise and is counted.
//! - Several pulses went by: the newest is whole, those before are counted, exactly.
//! - The hardware missed an edge (a glitch shorter than its sampling, 62.5 ns). One rise and two falls do not say which
//!   of the two falls is the pulse's own, so neither is believed; two rises and one fall do, the newest rise is its.
//! - Light that stays for 2^31 ticks (134 s at 16 MHz) looks like a rise newer than the fall: counted, and over with
//!   the next pulse.

use lighthouse_mote::pulse::Pulse;
use lighthouse_mote::time::Ticks;

/// What the hardware holds at one moment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sample {
    /// Times the light came on, since start-up, wrapping.
    pub rises: u32,
    /// Times it went off.
    pub falls: u32,
    /// When it last came on.
    pub rise: Ticks,
    /// When it last went off.
    pub fall: Ticks,
}

/// What was taken already.
#[derive(Debug, Clone, Default)]
pub struct Pairing {
    rises: u32,
    falls: u32,
    lost: u16,
}

impl Pairing {
    /// Edges that became no pulse, wrapping. A rise that waits for its fall is not lost.
    pub const fn lost(&self) -> u16 {
        self.lost
    }

    /// Takes what has come since the last time; gives the newest pulse, if it is whole.
    #[inline]
    pub fn take(&mut self, sample: Sample) -> Option<Pulse> {
        let rises = sample.rises.wrapping_sub(self.rises);
        let falls = sample.falls.wrapping_sub(self.falls);
        if falls == 0 {
            return None;
        }
        self.rises = sample.rises;
        self.falls = sample.falls;
        let edges = rises.wrapping_add(falls);
        if rises > 0 && sample.fall.offset_from(sample.rise) < 0 {
            self.rises = sample.rises.wrapping_sub(1);
            self.lose(edges.wrapping_sub(1));
            return None;
        }
        if rises < falls {
            self.lose(edges);
            return None;
        }
        self.lose(edges.wrapping_sub(2));
        Some(Pulse { start: sample.rise, width: sample.fall.since(sample.rise) })
    }

    fn lose(&mut self, edges: u32) {
        self.lost = self.lost.wrapping_add(edges as u16);
    }
}
