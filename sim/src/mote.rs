//! One virtual mote: the machine with the chip's devices, running the very image that is flashed.
//!
//! Light goes in as edges at exact cycles, frames and log bytes come out with theirs.
//!
//! ```
//! use std::num::NonZeroU32;
//!
//! use sim::mote::{Load, Mote};
//!
//! // `Mote::boot` takes the ELF that is flashed. This image writes an L to the UART at 0x5100_0000 and sleeps.
//! let mut image = [0; 0xcc];
//! image[..8].copy_from_slice(&[0x00, 0x10, 0x00, 0x20, 0xc1, 0x00, 0x00, 0x00]);
//! image[0xc0..].copy_from_slice(&[0x01, 0x48, 0x4c, 0x21, 0x01, 0x60, 0x30, 0xbf, 0x00, 0x00, 0x00, 0x51]);
//! let mut mote = Mote::boot_image(&image, NonZeroU32::new(5_000_000).expect("5 MHz"))?;
//! // Light comes on after a millisecond; nobody listens. Then a second goes by.
//! mote.push_edge(5_000, true)?;
//! mote.run_until(5_000_000)?;
//! assert_eq!(mote.take_log(), b"L");
//! assert_eq!(mote.take_frames().count(), 0);
//! assert!(mote.load().percent_since(&Load::default()) < 0.01);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! What can go wrong: the firmware faults, locks up or resets. The run stops there and says where and why.

use std::num::NonZeroU32;

use crate::bus::{Bus, Size};
use crate::elf::{LoadError, Symbols};
use crate::machine::{Config, Machine, Stop};
use crate::scum3c::{self, EdgeError, Scum3c, SentFrame};

/// A mote from power-on.
#[derive(Debug, Clone)]
pub struct Mote {
    /// The chip, for looking inside.
    pub machine: Machine<Scum3c>,
    /// Addresses of the image by name.
    pub symbols: Symbols,
}

/// Why a mote no longer runs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Halted {
    /// What the machine says.
    pub stop: Stop,
    /// When, in cycles since power-on.
    pub cycle: u64,
    /// The function it happened in, where the image knows.
    pub function: Option<String>,
}

impl std::fmt::Display for Halted {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "the mote stopped at cycle {}: {}", self.cycle, self.stop)?;
        self.function.as_ref().map_or(Ok(()), |function| write!(f, " (in {function})"))
    }
}

impl std::error::Error for Halted {}

/// How the core spent its time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Load {
    /// Cycles since power-on.
    pub cycles: u64,
    /// Of those, asleep.
    pub asleep: u64,
    /// Instructions since power-on.
    pub instructions: u64,
}

impl Load {
    /// The share of the time since `earlier` that the core was awake, in percent.
    #[must_use]
    pub fn percent_since(&self, earlier: &Load) -> f64 {
        let (cycles, asleep) = (self.cycles - earlier.cycles, self.asleep - earlier.asleep);
        if cycles == 0 { 0.0 } else { 100.0 * (cycles - asleep) as f64 / cycles as f64 }
    }
}

/// True time beside the clock of a mote that tunes it.
#[derive(Debug, Clone, Copy)]
pub struct Wall {
    cycle: u64,
    seconds: f64,
    hclk_hz: NonZeroU32,
    /// When the last edge came.
    edge: u64,
}

/// How often the clock's rate is looked at, seconds: an edge may come late by this times the change.
const LOOK_S: f64 = 1e-3;

impl Wall {
    /// Power-on.
    #[must_use]
    pub fn new(mote: &Mote) -> Self {
        Self { cycle: mote.machine.cycles(), seconds: 0.0, hclk_hz: mote.machine.bus.hclk_hz(), edge: 0 }
    }

    /// True seconds since power-on.
    #[must_use]
    pub fn seconds(&self) -> f64 {
        self.seconds
    }

    fn cycle_at(&self, seconds: f64) -> u64 {
        self.cycle + ((seconds - self.seconds) * f64::from(self.hclk_hz.get())).round() as u64
    }

    /// Runs `mote` to `until_s` in light whose changes come at true seconds, one after the other.
    ///
    /// # Errors
    /// The firmware stopped on the way; what was left of the light then is still there.
    pub fn run(
        &mut self,
        mote: &mut Mote,
        light: &mut std::iter::Peekable<impl Iterator<Item = (f64, bool)>>,
        until_s: f64,
    ) -> Result<(), Halted> {
        while self.seconds < until_s {
            let next_s = (self.seconds + LOOK_S).min(until_s);
            while let Some((at_s, level)) = light.next_if(|&(at_s, _)| at_s < next_s) {
                self.edge = self.cycle_at(at_s.max(self.seconds)).max(self.edge + 1);
                let queued = mote.push_edge(self.edge, level);
                debug_assert_eq!(queued, Ok(()), "edges come in order");
            }
            let end = self.cycle_at(next_s).max(self.cycle + 1);
            let ran = mote.run_until(end);
            let cycle = mote.machine.cycles();
            // To the cycle where an instruction ended, by the rate that it began with.
            self.seconds += (cycle - self.cycle) as f64 / f64::from(self.hclk_hz.get());
            self.cycle = cycle;
            self.hclk_hz = mote.machine.bus.hclk_hz();
            ran?;
        }
        Ok(())
    }
}

/// A chip with empty memory whose core runs at `hclk_hz`.
fn chip(hclk_hz: NonZeroU32) -> Machine<Scum3c> {
    let devices = Scum3c::new(scum3c::Config { hclk_hz, ..scum3c::Config::default() });
    Machine::new(Config { clock_hz: hclk_hz.get(), ..Config::default() }, devices)
}

impl Mote {
    /// Loads `elf` into a chip whose core runs at `hclk_hz`, in the dark.
    ///
    /// # Errors
    /// The file is no image for this chip.
    pub fn boot(elf: &[u8], hclk_hz: NonZeroU32) -> Result<Self, LoadError> {
        let mut machine = chip(hclk_hz);
        let symbols = machine.load_elf(elf)?;
        Ok(Self { machine, symbols })
    }

    /// As [`Self::boot`], on any chip; faults are the firmware's own to handle.
    ///
    /// # Errors
    /// The file is no image for this chip.
    pub fn boot_on(elf: &[u8], chip: scum3c::Config) -> Result<Self, LoadError> {
        let config = Config { clock_hz: chip.hclk_hz.get(), fault_is_fatal: false, ..Config::default() };
        let mut machine = Machine::new(config, Scum3c::new(chip));
        let symbols = machine.load_elf(elf)?;
        Ok(Self { machine, symbols })
    }

    /// Puts `image` into the code RAM from address 0, as the chip's boot loader does, and starts it as [`Self::boot`].
    ///
    /// # Errors
    /// More bytes than code RAM.
    pub fn boot_image(image: &[u8], hclk_hz: NonZeroU32) -> Result<Self, LoadError> {
        let mut machine = chip(hclk_hz);
        let outside = LoadError::OutsideMemory { address: 0, bytes: image.len() as u32 };
        machine.write_bytes(0, image).ok_or(outside)?;
        machine.reset();
        Ok(Self { machine, symbols: Symbols::default() })
    }

    /// Queues a change of the light at `cycle`.
    ///
    /// # Errors
    /// `cycle` is not later than that of the edge before, or already past.
    pub fn push_edge(&mut self, cycle: u64, level: bool) -> Result<(), EdgeError> {
        self.machine.bus.push_edge(cycle, level)
    }

    /// Runs to `cycle`.
    ///
    /// # Errors
    /// The firmware stopped on the way.
    pub fn run_until(&mut self, cycle: u64) -> Result<(), Halted> {
        match self.machine.run_until(cycle) {
            Stop::Deadline => Ok(()),
            stop => {
                let pc = match &stop {
                    Stop::Fault(fault) | Stop::Lockup(fault) => Some(fault.pc),
                    _ => None,
                };
                let function = pc.and_then(|pc| self.symbols.containing(pc)).map(str::to_string);
                Err(Halted { stop, cycle: self.machine.cycles(), function })
            }
        }
    }

    /// From now on the core clock, which counts the cycles that light comes at, has this true rate: the other
    /// oscillators, and what is on the air, do not drift with it.
    pub fn set_hclk_hz(&mut self, hclk_hz: NonZeroU32) {
        let now = self.machine.cycles();
        self.machine.bus.set_hclk_hz(hclk_hz, now);
    }

    /// Starts the mote anew, its devices as at power-on; its memory stays, the light goes on.
    pub fn restart(&mut self) {
        let now = self.machine.cycles();
        self.machine.bus.power_cycle(now);
        self.machine.reset();
    }

    /// The frames that left since the last call.
    pub fn take_frames(&mut self) -> impl Iterator<Item = SentFrame> + use<> {
        self.machine.bus.take_frames().into_iter()
    }

    /// The log bytes written since the last call.
    pub fn take_log(&mut self) -> Vec<u8> {
        self.machine.bus.take_uart()
    }

    /// The cycle, now or earlier, at which the radio timer read `ticks`; `None` if the timer does not answer.
    pub fn cycle_of(&mut self, ticks: u32) -> Option<u64> {
        const RFTIMER_COUNTER: u32 = 0x4200_0004;
        let now = self.machine.cycles();
        let counter = self.machine.bus.read(RFTIMER_COUNTER, Size::Word, now).ok()?;
        Some(now.saturating_sub(u64::from(counter.wrapping_sub(ticks))))
    }

    /// Lets the radio timer stand as if it had been started `ticks` earlier: to see it wrap without the wait.
    pub fn age_timer(&mut self, ticks: u32) {
        let now = self.machine.cycles();
        self.machine.bus.age_timer(ticks, now);
    }

    /// How the core spent its time so far.
    #[must_use]
    pub fn load(&self) -> Load {
        Load {
            cycles: self.machine.cycles(),
            asleep: self.machine.sleep_cycles(),
            instructions: self.machine.instructions(),
        }
    }
}
