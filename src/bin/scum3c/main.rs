//! The lighthouse mote on the SCuM-3C: light edges in, position frames out.
//!
//! Every task is a hardware task. The lines that are wired to nothing (4, 5, 10, 15) are pended instead of spawning
//! software tasks: a spawn turns all interrupts off for a moment, and a moment is what an edge's stamp is made of.
//!
//! | priority | task | line | does |
//! |---|---|---|---|
//! | 4 | `rise`, `fall` | 12, 13 | stamp the light |
//! | 4 | `watchdog` | SysTick | starts again when nothing is said any more |
//! | 3 | `classify`, `second` | 4, 10 | pulses to sightings |
//! | 2 | `radio`, `alarm` | 6, 7 | frames onto the air |
//! | 1 | `solve` | 5 | sightings to frames |
//! | 1 | `look_again` | 15 | lets the light in again after a storm |
//! | 0 | `idle` | | carries the log, writes what was tuned, sleeps |
//!
//! What can go wrong: each module says its own. That unwired lines can be pended is how an M0's NVIC works; it has not
//! been seen on this chip.
#![no_std]
#![no_main]
#![allow(unreachable_pub, reason = "a binary has no outside; `pub` here says: for the other modules")]

mod bring_up;
mod capture;
mod crash;
mod fault;
mod image;
mod memory;
#[path = "../mote/mod.rs"]
mod mote;
mod oscillators;
mod pac;
mod radio;
mod rf_timer;
mod tuning;
mod uart_log;
mod watchdog;

use lighthouse_mote::identity::{self, Block, Identity};

/// This board, as the stages know it.
struct Scum3c;

impl mote::stages::Board for Scum3c {
    type Pulses = capture::Reader;

    fn identity() -> Identity {
        IDENTITY.read()
    }

    #[cfg(feature = "security")]
    fn key() -> Option<&'static [u8; 16]> {
        mote::room::KEY.as_ref()
    }

    fn edges_lost() -> u16 {
        capture::lost()
    }

    fn frames_lost() -> u16 {
        radio::lost()
    }
}

/// Who this mote is; a programmer overwrites it.
#[used]
static IDENTITY: Block = mote::room::identity(identity::READS_ADDRESS | identity::READS_CHANNEL);

/// Where the frame counter begins; a programmer overwrites it.
#[cfg(feature = "security")]
#[used]
static FIRST: identity::FirstCounter = identity::FirstCounter::new();

// SAFETY: `.uninit` is ordinary RAM that start-up leaves alone (cortex-m-rt's link.x); any bits are a valid `Kept`.
#[cfg(feature = "security")]
#[unsafe(link_section = ".uninit.counter")]
static KEPT: mote::seal::Kept = mote::seal::Kept::new();

#[rtic::app(device = crate::pac, peripherals = false)]
mod app {
    use lighthouse_mote::frame::Reset;

    use crate::capture::{self, Capture};
    use crate::image::{self, Image};
    use crate::mote::room::CONFIG;
    #[cfg(feature = "security")]
    use crate::mote::room::KEY;
    #[cfg(feature = "security")]
    use crate::mote::seal::Seal;
    use crate::mote::stages::{Classify, Queues, Solve};
    use crate::pac::Interrupt;
    use crate::radio::Radio;
    use crate::rf_timer::{self, Alarm, SECOND};
    use crate::{Scum3c, bring_up, crash, tuning, uart_log};

    #[shared]
    struct Shared {
        #[lock_free]
        capture: Capture,
        #[lock_free]
        classify: Classify<Scum3c>,
        #[lock_free]
        radio: Radio,
    }

    #[local]
    struct Local {
        solve: Solve<Scum3c>,
    }

    #[init(local = [queues: Queues = Queues::new()])]
    fn init(cx: init::Context) -> (Shared, Local) {
        bring_up::chip();
        let image = image::check();
        rf_timer::start();
        rf_timer::arm(Alarm::Second, SECOND);
        let last = crash::last();
        let identity = crate::IDENTITY.read();
        defmt::info!("lighthouse mote {=u16:#06x}, image {}, last crash {}", identity.mote, image, last);
        crate::watchdog::watch();

        let reset = if image == Image::Damaged { (Reset::Image, 0) } else { crash::Crash::told(last) };
        let (capture, pulses) = capture::start();
        let (classify, solve, frames) = cx.local.queues.wire(pulses, reset);
        #[cfg(feature = "security")]
        let solve = solve.under(KEY.map(|_| Seal::new(&crate::FIRST, &crate::KEPT)));
        (Shared { capture, classify, radio: Radio::new(frames, identity.channel) }, Local { solve })
    }

    #[task(binds = SysTick, priority = 4)]
    fn watchdog(_: watchdog::Context) {
        crate::watchdog::turn();
    }

    #[task(binds = GPIO8, priority = 4, shared = [capture])]
    fn rise(cx: rise::Context) {
        cx.shared.capture.rise(rf_timer::now());
    }

    #[task(binds = GPIO9, priority = 4, shared = [capture])]
    fn fall(cx: fall::Context) {
        cx.shared.capture.fall(rf_timer::now());
        rtic::pend(Interrupt::SOFT4);
    }

    #[task(binds = SOFT4, priority = 3, shared = [classify])]
    fn classify(cx: classify::Context) {
        capture::catch_up();
        let done = cx.shared.classify.run(&CONFIG);
        done.wake(|| rtic::pend(Interrupt::SOFT5), || rtic::pend(Interrupt::SOFT4));
    }

    #[task(binds = SOFT10, priority = 3, shared = [classify])]
    fn second(cx: second::Context) {
        cx.shared.classify.second(rf_timer::now());
        let half_turn = cx.shared.classify.half_turn();
        tuning::light(half_turn);
        rf_timer::arm(Alarm::Second, half_turn.map_or(SECOND, rf_timer::second));
        rtic::pend(Interrupt::SOFT5);
    }

    #[task(binds = SOFT5, priority = 1, local = [solve])]
    fn solve(cx: solve::Context) {
        let done = cx.local.solve.run(&CONFIG);
        done.wake(|| rtic::pend(Interrupt::RF), || rtic::pend(Interrupt::SOFT5));
    }

    /// Of two that are pended at one priority, the lower line's comes first.
    #[task(binds = SOFT15, priority = 1)]
    fn look_again(_: look_again::Context) {
        capture::look_again();
    }

    #[task(binds = RF, priority = 2, shared = [radio])]
    fn radio(cx: radio::Context) {
        cx.shared.radio.step();
    }

    #[task(binds = RFTIMER, priority = 2, shared = [radio])]
    fn alarm(cx: alarm::Context) {
        let rung = rf_timer::take();
        if rung.is(Alarm::Second) {
            rtic::pend(Interrupt::SOFT10);
        }
        if rung.is(Alarm::Radio) {
            cx.shared.radio.alarm();
        }
    }

    #[idle]
    fn idle(_: idle::Context) -> ! {
        loop {
            tuning::apply();
            uart_log::carry();
            cortex_m::asm::wfi();
        }
    }
}
