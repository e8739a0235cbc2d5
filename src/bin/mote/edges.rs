//! A capture for boards that stamp every change of the light: changes in, pulses into a queue, what is lost counted.
//!
//! What can go wrong: the queue is full: the whole pulse is dropped and both its edges counted. A change that is missed
//! turns light into dark; who may miss one has to know which it was (`lighthouse_mote::pulse`).

use core::sync::atomic::{AtomicU16, Ordering};

use lighthouse_mote::identity::Identity;
use lighthouse_mote::pulse::Pulse;
use lighthouse_mote::time::Ticks;

use super::queue::{Queue, Reader, Writer};
use super::stages::Board;

/// Pulses that may wait: 44 ms of light.
const PULSES: usize = 16;
/// The memory for them.
pub type Pulses = Queue<Pulse, PULSES>;

/// Edges that became no pulse, wrapping. Written by [`Edges`] alone.
static LOST: AtomicU16 = AtomicU16::new(0);

/// The end for whoever stamps; it begins in the dark.
pub struct Edges {
    pulses: Writer<Pulse, PULSES>,
    rise: Option<Ticks>,
}

impl Edges {
    /// Both ends of `pulses`.
    pub fn split(pulses: &'static mut Pulses) -> (Self, Reader<Pulse, PULSES>) {
        let (pulses, waiting) = pulses.split();
        (Self { pulses, rise: None }, waiting)
    }

    /// The light has changed; true where the classifier has something to do.
    pub fn change(&mut self, at: Ticks) -> bool {
        let Some(start) = self.rise.take() else {
            self.rise = Some(at);
            return false;
        };
        let kept = self.pulses.push(Pulse { start, width: at.since(start) });
        if !kept {
            LOST.store(LOST.load(Ordering::Relaxed).wrapping_add(2), Ordering::Relaxed);
        }
        kept
    }
}

/// A board with this capture, whose frames are never given up.
impl Board for Edges {
    type Pulses = Reader<Pulse, PULSES>;

    fn identity() -> Identity {
        super::super::IDENTITY.read()
    }

    fn edges_lost() -> u16 {
        LOST.load(Ordering::Relaxed)
    }
}
