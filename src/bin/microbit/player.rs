//! Moments out of flash, played by a timer: a compare match is the moment, its register the stamp.
//!
//! From 0x1_0000 on: how many edges, how many seconds, then their ticks, all in words. At 8 MHz QEMU's timer is exact.
//!
//! What can go wrong: flash without a stream, or too long a one: nothing is played. A moment that is over as it is
//! armed comes at once, with its own stamp.

use core::sync::atomic::{AtomicU8, Ordering};

use lighthouse_mote::time::Ticks;
use nrf_pac::timer::{Timer, regs::Int, vals::Bitmode};
use nrf_pac::{TIMER0, TIMER1};

/// How many players have come to their ends.
pub static OVER: AtomicU8 = AtomicU8::new(0);

pub struct Player {
    timer: Timer,
    rest: core::slice::Iter<'static, u32>,
    armed: Option<Ticks>,
}

/// Starts to play edges, rises and falls in turn, and seconds.
pub fn start() -> [Player; 2] {
    // SAFETY: the upper 192 KiB of flash, which nothing of the program lies in (build.rs) and nobody writes.
    let words = unsafe { core::slice::from_raw_parts(0x1_0000 as *const u32, 0xc000) };
    let edges = words.get(2..).and_then(|rest| rest.get(..words[0] as usize)).unwrap_or(&[]);
    let seconds = words.get(2 + edges.len()..).and_then(|rest| rest.get(..words[1] as usize)).unwrap_or(&[]);
    [(TIMER0, edges), (TIMER1, seconds)].map(|(timer, stream)| {
        timer.bitmode().write(|w| w.set_bitmode(Bitmode::_32bit));
        timer.prescaler().write(|w| w.set_prescaler(1));
        timer.intenset().write_value(Int(1 << 16));
        let mut player = Player { timer, rest: stream.iter(), armed: None };
        player.arm();
        timer.tasks_start().write_value(1);
        player
    })
}

impl Player {
    /// The moment that has come.
    pub fn due(&mut self) -> Option<Ticks> {
        self.timer.tasks_capture(1).write_value(1);
        let now = Ticks(self.timer.cc(1).read());
        let at = self.armed.filter(|at| now.since(*at).0 < 1 << 31)?;
        self.arm();
        Some(at)
    }

    fn arm(&mut self) {
        self.armed = self.rest.next().map(|at| Ticks(*at));
        match self.armed {
            Some(at) => self.timer.cc(0).write_value(at.0),
            None => OVER.store(OVER.load(Ordering::Relaxed) + 1, Ordering::Relaxed),
        }
        // Behind CC, or QEMU's timer would match the old one again.
        self.timer.events_compare(0).write_value(0);
    }
}
