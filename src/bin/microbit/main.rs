//! The lighthouse mote on an nRF51822 as QEMU's `microbit` has it: light from flash in, position frames out of its serial port.
//!
//! | priority | task | line | does |
//! |---|---|---|---|
//! | 4 | `light` | TIMER0 | plays edges |
//! | 3 | `classify`, `second` | SWI 0, TIMER1 | pulses to sightings; plays seconds |
//! | 2 | `serial` | UART0 | frames out |
//! | 1 | `solve` | SWI 1 | sightings to frames |
//! | 0 | `idle` | | sleeps, and ends the program when the light is over |
//!
//! What can go wrong: no debugger and no QEMU; then log and end are faults, and the mote starts again.
#![no_std]
#![no_main]
#![allow(unreachable_pub, reason = "a binary has no outside; `pub` here says: for the other modules")]

#[path = "../mote/fault.rs"]
mod fault;
#[path = "../mote/mod.rs"]
mod mote;
mod player;
mod serial;

use defmt_semihosting as _;
use lighthouse_mote::identity::{Block, READS_ADDRESS};

#[used]
static IDENTITY: Block = mote::room::identity(READS_ADDRESS);

#[rtic::app(device = nrf_pac, peripherals = false)]
mod app {
    use core::sync::atomic::Ordering;

    use nrf_pac::Interrupt;

    use crate::mote::edges::{Edges, Pulses};
    use crate::mote::stages::{Classify, Queues, Solve};
    use crate::mote::{bytes::Bytes, crumb::Crash, room::CONFIG};
    use crate::player::{self, OVER, Player};
    use crate::serial::Serial;
    use crate::{IDENTITY, fault};

    #[shared]
    struct Shared {
        #[lock_free]
        classify: Classify<Edges>,
    }

    #[local]
    struct Local {
        light: Player,
        edges: Edges,
        seconds: Player,
        solve: Solve<Edges>,
        serial: Serial,
    }

    #[init(local = [pulses: Pulses = Pulses::new(), queues: Queues = Queues::new()])]
    fn init(cx: init::Context) -> (Shared, Local) {
        let (identity, crash) = (IDENTITY.read(), fault::CRUMB.take());
        defmt::info!("lighthouse mote {=u16:#06x}, last crash {}", identity.mote, crash);
        let (edges, pulses) = Edges::split(cx.local.pulses);
        let (classify, solve, frames) = cx.local.queues.wire(pulses, Crash::told(crash));
        let serial = Serial::start(Bytes::new(frames));
        let [light, seconds] = player::start();
        (Shared { classify }, Local { light, edges, seconds, solve, serial })
    }

    #[task(binds = TIMER0, priority = 4, local = [light, edges])]
    fn light(cx: light::Context) {
        while let Some(at) = cx.local.light.due() {
            if cx.local.edges.change(at) {
                rtic::pend(Interrupt::SWI0);
            }
        }
    }

    #[task(binds = SWI0, priority = 3, shared = [classify])]
    fn classify(cx: classify::Context) {
        let done = cx.shared.classify.run(&CONFIG);
        done.wake(|| rtic::pend(Interrupt::SWI1), || rtic::pend(Interrupt::SWI0));
    }

    #[task(binds = TIMER1, priority = 3, shared = [classify], local = [seconds])]
    fn second(cx: second::Context) {
        while let Some(at) = cx.local.seconds.due() {
            cx.shared.classify.second(at);
            rtic::pend(Interrupt::SWI1);
        }
    }

    #[task(binds = SWI1, priority = 1, local = [solve])]
    fn solve(cx: solve::Context) {
        let done = cx.local.solve.run(&CONFIG);
        done.wake(|| rtic::pend(Interrupt::UART0), || rtic::pend(Interrupt::SWI1));
    }

    #[task(binds = UART0, priority = 2, local = [serial])]
    fn serial(cx: serial::Context) {
        cx.local.serial.step();
    }

    #[idle]
    fn idle(_: idle::Context) -> ! {
        while OVER.load(Ordering::Relaxed) < 2 {
            cortex_m::asm::wfi();
        }
        semihosting::process::exit(0)
    }
}
