//! The radio timer as the mote's clock: a free-running 32-bit counter and two alarms.
//!
//! It has no capture input for a pin (`memory_map.h:150-157`), so edges are stamped by reading [`now`] first thing in
//! their interrupt handlers.
//!
//! What can go wrong: an alarm set for a tick already past waits for the counter to come round, 7 min. A storm of edges
//! can hold up [`arm`] for longer than any span, so it looks again.

use lighthouse_mote::time::{Span, Ticks};

use crate::pac::rftimer;

/// A second by the nominal clock, 10 MHz: how often the classifier is told that time passes, until light tells better.
pub const SECOND: Span = Span(10_000_000);

/// Half turns in a second: two per turn of a 60 Hz rotor.
const HALF_TURNS_PER_S: u32 = 120;

/// A second by the rotors.
pub const fn second(half_turn: Span) -> Span {
    Span(half_turn.0.saturating_mul(HALF_TURNS_PER_S))
}

/// The two alarms.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Alarm {
    /// Compare 0: a second has passed.
    Second = 0,
    /// Compare 1: the radio has settled, or takes too long.
    Radio = 1,
}

/// The alarms that went off.
#[derive(Debug, Clone, Copy)]
pub struct Rung(u32);

impl Rung {
    /// Whether this one did.
    pub const fn is(self, alarm: Alarm) -> bool {
        self.0 & 1 << alarm as u32 != 0
    }
}

/// Starts the counter at zero, over all 32 bits.
pub fn start() {
    rftimer::MAX_COUNT.write(u32::MAX);
    rftimer::INT_CLEAR.write(u32::MAX);
    rftimer::CONTROL.write(rftimer::ENABLE | rftimer::INTERRUPT | rftimer::COUNT_RESET);
}

/// Reads the clock.
#[inline(always)]
pub fn now() -> Ticks {
    Ticks(rftimer::COUNTER.read())
}

/// Lets `alarm` go off `span` from now; a span below half the counter's.
#[inline(never)]
pub fn arm(alarm: Alarm, span: Span) {
    let on = rftimer::COMPARE_ENABLE | rftimer::COMPARE_INTERRUPT;
    loop {
        let at = now().after(span);
        match alarm {
            Alarm::Second => {
                rftimer::COMPARE0.write(at.0);
                rftimer::COMPARE0_CONTROL.write(on);
            }
            Alarm::Radio => {
                rftimer::COMPARE1.write(at.0);
                rftimer::COMPARE1_CONTROL.write(on);
            }
        }
        // Had the edges kept the core meanwhile, it would be past.
        if at.since(now()).0 < 1 << 31 {
            return;
        }
    }
}

/// Lets `alarm` rest.
pub fn disarm(alarm: Alarm) {
    match alarm {
        Alarm::Second => rftimer::COMPARE0_CONTROL.write(0),
        Alarm::Radio => rftimer::COMPARE1_CONTROL.write(0),
    }
    rftimer::INT_CLEAR.write(1 << alarm as u32);
}

/// Takes note of the alarms that went off, which ends their interrupt.
pub fn take() -> Rung {
    let rung = rftimer::INT.read();
    rftimer::INT_CLEAR.write(rung);
    Rung(rung)
}
