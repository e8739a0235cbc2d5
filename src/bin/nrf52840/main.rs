//! The lighthouse mote on the nRF52840: light edges in, position frames out.
//!
//! | priority | task | line | does |
//! |---|---|---|---|
//! | 4 | `edges` | GPIOTE | fetches what the hardware stamped |
//! | 3 | `classify`, `expire` | SWI 0, 1 | pulses to sightings |
//! | 2 | `radio`, `alarm` | RADIO, TIMER3 | reports to frames on the air; time |
//! | 1 | `solve` | SWI 2 | sightings to reports |
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
mod clock;
mod csma;
mod fault;
mod pairing;
mod progress;
mod psdu;
mod radio;
mod receiver;
mod stages;
mod ts4231;
mod watchdog;

// The log's way out.
use defmt_rtt as _;

/// The room, as baked by build.rs.
mod calib {
    include!(concat!(env!("OUT_DIR"), "/calib.rs"));
}

#[rtic::app(device = nrf_pac, peripherals = false)]
mod app {
    use lighthouse_mote::frame::Header;
    use nrf_pac::Interrupt;

    use crate::calib::{CONFIG, MOTE, PAN};
    use crate::capture::{self, Capture, Pulses};
    use crate::clock::{self, Alarm, HEARTBEAT};
    use crate::fault::{self, Boot};
    use crate::psdu::Psdu;
    use crate::radio::Radio;
    use crate::stages::{Classify, Reports, Sightings, Solve};
    use crate::watchdog::{self, Stage, Watchdog};
    use crate::{bring_up, receiver};

    #[shared]
    struct Shared {
        #[lock_free]
        classify: Classify,
        #[lock_free]
        radio: Radio,
    }

    #[local]
    struct Local {
        capture: Capture,
        solve: Solve,
        watchdog: Watchdog,
        boot: Boot,
    }

    #[init(local = [
        pulses: Pulses = Pulses::new(),
        sightings: Sightings = Sightings::new(),
        reports: Reports = Reports::new(),
        psdu: Psdu = Psdu::new(),
    ])]
    fn init(cx: init::Context) -> (Shared, Local) {
        let watchdog = watchdog::start();
        let boot = fault::boot(bring_up::cause());
        bring_up::debugger();
        bring_up::crystal();
        clock::start();
        clock::arm(Alarm::Heartbeat, HEARTBEAT);
        defmt::info!("lighthouse mote {=u16:#06x}, started by {}", MOTE, boot);

        let (capture, pulses) = capture::split(cx.local.pulses);
        let (to_solve, sightings) = cx.local.sightings.split();
        let (to_radio, reports) = cx.local.reports.split();
        let header = Header { pan: PAN, mote: MOTE, sequence: 0 };
        (
            Shared { classify: Classify::new(pulses, to_solve), radio: Radio::new(reports, cx.local.psdu, header) },
            Local { capture, solve: Solve::new(sightings, to_radio), watchdog, boot },
        )
    }

    #[task(binds = GPIOTE, priority = 4, local = [capture])]
    fn edges(cx: edges::Context) {
        cx.local.capture.step();
        rtic::pend(Interrupt::EGU0_SWI0);
    }

    #[task(binds = EGU0_SWI0, priority = 3, shared = [classify])]
    fn classify(cx: classify::Context) {
        if cx.shared.classify.run(&CONFIG).sightings {
            rtic::pend(Interrupt::EGU2_SWI2);
        }
        watchdog::moved(Stage::Classify);
    }

    #[task(binds = EGU1_SWI1, priority = 3, shared = [classify])]
    fn expire(cx: expire::Context) {
        if cx.shared.classify.expire(&CONFIG) {
            rtic::pend(Interrupt::EGU2_SWI2);
        }
        watchdog::moved(Stage::Classify);
    }

    #[task(binds = EGU2_SWI2, priority = 1, local = [solve])]
    fn solve(cx: solve::Context) {
        if cx.local.solve.run(&CONFIG) {
            rtic::pend(Interrupt::RADIO);
        }
        watchdog::moved(Stage::Solve);
    }

    #[task(binds = RADIO, priority = 2, shared = [radio])]
    fn radio(cx: radio::Context) {
        cx.shared.radio.step();
    }

    #[task(binds = TIMER3, priority = 2, shared = [radio], local = [watchdog])]
    fn alarm(cx: alarm::Context) {
        let rung = clock::take();
        if rung.is(Alarm::Heartbeat) {
            clock::arm(Alarm::Heartbeat, HEARTBEAT);
            cx.local.watchdog.feed_if_all_moved();
            // In the dark nobody else asks.
            rtic::pend(Interrupt::EGU1_SWI1);
            rtic::pend(Interrupt::EGU2_SWI2);
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
