//! TIMER3 as the mote's clock: 32 bits at 16 MHz from the crystal, two captured edges, three alarms.
//!
//! | register | holds |
//! |---|---|
//! | CC 0, 1 | the newest rise and fall, written by hardware (`capture`) |
//! | CC 2, 3, 4 | the alarms |
//! | CC 5 | now, for whoever asks |
//!
//! TIMER3 because it has six of them, and TIMER0 to 2 have four (PS 6.30). The counter wraps after 268 s.
//!
//! What can go wrong: `now` is asked for while somebody of a higher priority asks too. Both write the same register,
//! the later one later, so the lower one reads a time that is a little newer than its question, never an older one.

use lighthouse_mote::time::{Span, Ticks};
use nrf_pac::TIMER3 as TIMER;
use nrf_pac::timer::{regs, vals};

/// 16 MHz / 2^0 (PS 6.30, PRESCALER).
pub const TICKS_PER_US: u32 = 16;
/// How often the classifier is told that time passes, and the watchdog may be fed.
pub const SECOND: Span = Span(1_000_000 * TICKS_PER_US);

/// CC and COMPARE of [`now`].
const NOW: usize = 5;

/// The alarms.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Alarm {
    /// A second has passed.
    Second = 2,
    /// The radio may listen, or takes too long.
    Radio = 3,
    /// Light may interrupt again.
    Gate = 4,
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

/// Starts the counter at zero. The crystal runs already.
pub fn start() {
    // Mode, width and prescaler only while stopped (PS 6.30).
    TIMER.tasks_stop().write_value(1);
    TIMER.mode().write(|w| w.set_mode(vals::Mode::Timer));
    TIMER.bitmode().write(|w| w.set_bitmode(vals::Bitmode::_32bit));
    TIMER.prescaler().write(|w| w.set_prescaler(0));
    TIMER.tasks_clear().write_value(1);
    TIMER.tasks_start().write_value(1);
}

/// Reads the clock: the CAPTURE task copies the counter into its CC register (PS 6.30).
#[inline]
pub fn now() -> Ticks {
    TIMER.tasks_capture(NOW).write_value(1);
    Ticks(TIMER.cc(NOW).read())
}

/// Lets that much time pass. For start-up and `idle`.
pub fn wait_us(us: u32) {
    let start = now();
    while now().since(start).0 < us.saturating_mul(TICKS_PER_US) {}
}

/// Lets `alarm` go off `span` from now; `span` is a microsecond or more.
pub fn arm(alarm: Alarm, span: Span) {
    let n = alarm as usize;
    // COMPARE happens on a match only (PS 6.30). Whoever interrupts us here for all of `span` would make it wait for
    // the counter to come round, so that is looked for.
    loop {
        let start = now();
        TIMER.cc(n).write_value(start.after(span).0);
        TIMER.events_compare(n).write_value(0);
        if now().since(start) < span {
            break;
        }
    }
    TIMER.intenset().write_value(only(n));
}

/// Lets `alarm` rest.
pub fn disarm(alarm: Alarm) {
    let n = alarm as usize;
    TIMER.intenclr().write_value(only(n));
    TIMER.events_compare(n).write_value(0);
}

/// Takes note of the alarms that went off; each is armed anew or silent.
pub fn take() -> Rung {
    let mut rung = 0;
    let armed = TIMER.intenset().read();
    for alarm in [Alarm::Second, Alarm::Radio, Alarm::Gate] {
        let n = alarm as usize;
        if armed.compare(n) && TIMER.events_compare(n).read() != 0 {
            disarm(alarm);
            rung |= 1 << n;
        }
    }
    // The write that clears an event is through once it reads as clear; before, the interrupt would come twice (PS
    // 6.1).
    let _ = TIMER.events_compare(NOW).read();
    Rung(rung)
}

/// The bit of COMPARE `n` in INTENSET and INTENCLR; zeros do nothing.
fn only(n: usize) -> regs::Int {
    let mut mask = regs::Int(0);
    mask.set_compare(n, true);
    mask
}

defmt::timestamp!("{=u32:us}", now().0 / TICKS_PER_US);
