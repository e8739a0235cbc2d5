//! The lighthouse mote on the nRF52840: light edges in, position frames out.
//!
//! | priority | task | line | does |
//! |---|---|---|---|
//! | 4 | `edges` | GPIOTE | fetches what the hardware stamped |
//! | 3 | `classify`, `second` | SWI 0, 1 | pulses to sightings |
//! | 2 | `radio`, `alarm` | RADIO, TIMER3 | frames onto the air; time |
//! | 1 | `solve` | SWI 2 | sightings to frames |
//! | 0 | `idle` | | makes the receiver ready, sleeps |
//!
//! The log goes over RTT in critical sections, which turn all interrupts off for the length of a line: here that is no
//! harm, the stamps are the hardware's (`capture`). A line that finds no room is dropped; it never waits for a reader.
//!
//! "PS" is the nRF52840 product specification; its section numbers are those of version 1.1.
//!
//! What can go wrong: each module says its own. None of this has met silicon.
#![no_std]
#![no_main]
#![allow(unreachable_pub, reason = "a binary has no outside; `pub` here says: for the other modules")]

mod board;
mod bring_up;
mod capture;
mod cause;
mod channel;
mod clock;
mod csma;
#[path = "../mote/fault.rs"]
mod fault;
#[path = "../mote/mod.rs"]
mod mote;
mod pairing;
mod progress;
mod psdu;
mod radio;
mod receiver;
mod ts4231;
mod watchdog;

// The log's way out.
use defmt_rtt as _;
use lighthouse_mote::identity::{self, Block, Identity};

/// This board, as the stages know it.
struct Nrf52840;

impl mote::stages::Board for Nrf52840 {
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

#[rtic::app(device = nrf_pac, peripherals = false)]
mod app {
    use nrf_pac::Interrupt;

    use crate::board::CHANNEL;
    use crate::capture::{self, Capture, Pulses};
    use crate::cause::Boot;
    use crate::channel::Channel;
    use crate::clock::{self, Alarm, SECOND};
    use crate::mote::room::CONFIG;
    #[cfg(feature = "security")]
    use crate::mote::room::KEY;
    #[cfg(feature = "security")]
    use crate::mote::seal::Seal;
    use crate::mote::stages::{Classify, Queues, Solve};
    use crate::psdu::Psdu;
    use crate::radio::Radio;
    use crate::watchdog::{self, Stage, Watchdog};
    use crate::{Nrf52840, bring_up, fault, receiver};

    #[shared]
    struct Shared {
        #[lock_free]
        classify: Classify<Nrf52840>,
        #[lock_free]
        radio: Radio,
    }

    #[local]
    struct Local {
        capture: Capture,
        solve: Solve<Nrf52840>,
        watchdog: Watchdog,
        boot: Boot,
    }

    #[init(local = [
        pulses: Pulses = Pulses::new(),
        queues: Queues = Queues::new(),
        psdu: Psdu = Psdu::new(),
    ])]
    fn init(cx: init::Context) -> (Shared, Local) {
        let watchdog = watchdog::start();
        let boot = Boot::of(bring_up::cause(), &fault::CRUMB);
        bring_up::debugger();
        bring_up::crystal();
        clock::start();
        clock::arm(Alarm::Second, SECOND);
        let identity = crate::IDENTITY.read();
        let channel = Channel::new(identity.channel).unwrap_or(CHANNEL);
        defmt::info!("lighthouse mote {=u16:#06x}, started by {}", identity.mote, boot);

        let (capture, pulses) = capture::split(cx.local.pulses);
        let (classify, solve, frames) = cx.local.queues.wire(pulses, boot.reset());
        #[cfg(feature = "security")]
        let solve = solve.under(KEY.map(|_| Seal::new(&crate::FIRST, &crate::KEPT)));
        (
            Shared { classify, radio: Radio::new(frames, cx.local.psdu, channel) },
            Local { capture, solve, watchdog, boot },
        )
    }

    #[task(binds = GPIOTE, priority = 4, local = [capture])]
    fn edges(cx: edges::Context) {
        cx.local.capture.step();
        rtic::pend(Interrupt::EGU0_SWI0);
    }

    #[task(binds = EGU0_SWI0, priority = 3, shared = [classify])]
    fn classify(cx: classify::Context) {
        let done = cx.shared.classify.run(&CONFIG);
        done.wake(|| rtic::pend(Interrupt::EGU2_SWI2), || rtic::pend(Interrupt::EGU0_SWI0));
        if !done.more {
            capture::caught_up();
        }
        watchdog::moved(Stage::Classify);
    }

    #[task(binds = EGU1_SWI1, priority = 3, shared = [classify])]
    fn second(cx: second::Context) {
        cx.shared.classify.second(clock::now());
        rtic::pend(Interrupt::EGU2_SWI2);
        watchdog::moved(Stage::Classify);
    }

    #[task(binds = EGU2_SWI2, priority = 1, local = [solve])]
    fn solve(cx: solve::Context) {
        let done = cx.local.solve.run(&CONFIG);
        done.wake(|| rtic::pend(Interrupt::RADIO), || rtic::pend(Interrupt::EGU2_SWI2));
        watchdog::moved(Stage::Solve);
    }

    #[task(binds = RADIO, priority = 2, shared = [radio])]
    fn radio(cx: radio::Context) {
        cx.shared.radio.step();
    }

    #[task(binds = TIMER3, priority = 2, shared = [radio], local = [watchdog])]
    fn alarm(cx: alarm::Context) {
        let rung = clock::take();
        if rung.is(Alarm::Second) {
            clock::arm(Alarm::Second, SECOND);
            cx.local.watchdog.feed_if_all_moved();
            // The second has every stage run, in the dark too.
            rtic::pend(Interrupt::EGU1_SWI1);
        }
        if rung.is(Alarm::Gate) {
            capture::open();
        }
        if rung.is(Alarm::Radio) {
            cx.shared.radio.alarm();
        }
    }

    #[idle(local = [boot])]
    fn idle(cx: idle::Context) -> ! {
        receiver::ready();
        capture::listen();
        // Once more: a receiver may take its time, and a reader of the log too.
        defmt::info!("watching; started by {}", cx.local.boot);
        loop {
            cortex_m::asm::wfi();
        }
    }
}
