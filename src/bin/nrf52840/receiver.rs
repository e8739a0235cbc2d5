//! The receiver of light, made ready.
//!
//! A comparator is ready by itself. A TS4231 has to be told, and that only after it has seen light; so this waits as
//! long as it takes, in `idle`, where waiting costs nobody anything.
//!
//! What can go wrong: `ts4231` says it, the log carries it, and one second later it is tried again. A chip that loses
//! its configuration while the mote runs on stays deaf until the mote starts again.

use crate::board::{self, DATA, Level, Pin, RECEIVER, Receiver};
use crate::clock;
use crate::ts4231::{self, Drive, Wires};

/// E and D as pins.
struct Lines;

impl Wires for Lines {
    fn e(&mut self, drive: Drive) {
        to(board::RISE, drive);
    }

    fn d(&mut self, drive: Drive) {
        to(DATA, drive);
    }

    fn levels(&mut self) -> (bool, bool) {
        (board::RISE.is_high(), DATA.is_high())
    }

    fn wait_us(&mut self, us: u32) {
        clock::wait_us(us);
    }
}

fn to(pin: Pin, drive: Drive) {
    match drive {
        Drive::Low => pin.drive(Level::Low),
        Drive::High => pin.drive(Level::High),
        Drive::Released => pin.release(),
    }
}

/// Comes back when there are levels to be watched.
pub fn ready() {
    board::RISE.release();
    board::FALL.release();
    if RECEIVER != Receiver::Ts4231 {
        return;
    }
    while let Err(failure) = ts4231::start(&mut Lines) {
        defmt::warn!("TS4231: {}; once more in a second", failure);
        clock::wait_us(1_000_000);
    }
}
