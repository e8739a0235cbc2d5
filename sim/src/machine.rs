//! A chip: the core, its memories and whatever devices it is given.
//!
//! The machine runs instructions up to the next moment at which something other than the core can change, lets that
//! happen, and goes on. While the core sleeps it jumps from one such moment to the next, so a mote that mostly sleeps
//! costs almost nothing to watch.
//!
//! ```
//! use sim::machine::{Config, Machine, NoDevices};
//!
//! // `adds r0, r0, r1` and `bx lr` at 0x100, a stack that ends at 0x2000_1000.
//! let mut machine = Machine::new(Config::default(), NoDevices);
//! machine.write_bytes(0, &0x2000_1000u32.to_le_bytes()).expect("code RAM");
//! machine.write_bytes(0x100, &[0x40, 0x18, 0x70, 0x47]).expect("code RAM");
//! machine.reset();
//! let cost = machine.call(0x101, &[2, 3])?;
//! assert_eq!((cost.r0, cost.instructions, cost.cycles, cost.stack_bytes), (5, 2, 4, 0));
//! # Ok::<(), sim::machine::CallError>(())
//! ```
//!
//! What can go wrong is said by [`Stop`]. By default a fault of the program stops the machine where it happened, since
//! firmware for the mote has no business in HardFault.

use crate::bus::{Bus, BusFault, Size};
use crate::core::cycles::Timing;
use crate::core::{CALL_RETURN, Core, Fault, Halt};
use crate::elf::{self, LoadError, Symbols};
use crate::memory::{Memory, MemoryMap};
use crate::semihosting::{self, Answer, Semihosting};

/// What kind of chip, and how it is watched.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Config {
    /// How much memory there is.
    pub memory: MemoryMap,
    /// What the cycle counter counts.
    pub timing: Timing,
    /// Stop at a fault; otherwise the program's own HardFault handler runs.
    pub fault_is_fatal: bool,
    /// Answer `BKPT 0xAB`.
    pub semihosting: bool,
    /// Stop at any other BKPT; otherwise it is a fault, as without a debugger.
    pub stop_at_breakpoints: bool,
    /// How many cycles a second has, for the semihosting clock.
    pub clock_hz: u32,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            memory: MemoryMap::SCUM3C,
            timing: Timing::default(),
            fault_is_fatal: true,
            semihosting: false,
            stop_at_breakpoints: false,
            clock_hz: 10_000_000,
        }
    }
}

/// Why the machine stopped.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum Stop {
    /// The time asked for has come.
    Deadline,
    /// The program ended itself by semihosting.
    Exit(i32),
    /// A fault, and faults are fatal. Going on enters the program's HardFault handler.
    Fault(Fault),
    /// A fault where no HardFault can be taken. Only a reset helps.
    Lockup(Fault),
    /// A BKPT instruction. Going on skips it.
    Breakpoint {
        /// Its address.
        pc: u32,
        /// Its immediate.
        immediate: u8,
    },
    /// The program asked for a reset; what that means to the devices is for the caller to say.
    Reset,
    /// The core sleeps, nothing will ever wake it, and no deadline was given.
    Asleep,
}

impl std::fmt::Display for Stop {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Deadline => write!(f, "the time asked for has come"),
            Self::Exit(code) => write!(f, "the program ended with {code}"),
            Self::Fault(fault) => write!(f, "{fault}"),
            Self::Lockup(fault) => write!(f, "lockup: {fault}"),
            Self::Breakpoint { pc, immediate } => {
                write!(f, "breakpoint {immediate:#04x} at {pc:#010x}")
            }
            Self::Reset => write!(f, "the program asked for a reset"),
            Self::Asleep => write!(f, "asleep with nothing to wake for"),
        }
    }
}

/// What one call of a function cost.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Call {
    /// The result, as far as it is in R0.
    pub r0: u32,
    /// The result's second word, if it has one.
    pub r1: u32,
    /// Instructions, the returning one included.
    pub instructions: u64,
    /// Cycles, those of the returning instruction included, those of the call itself not.
    pub cycles: u64,
    /// How deep the stack went below where the function found it.
    pub stack_bytes: u32,
}

/// Why a function could not be called.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum CallError {
    /// More arguments than registers for them.
    TooManyArguments,
    /// It did not come back.
    Stopped(Stop),
}

impl std::fmt::Display for CallError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::TooManyArguments => write!(f, "a call takes at most four arguments"),
            Self::Stopped(stop) => write!(f, "the function did not return: {stop}"),
        }
    }
}

impl std::error::Error for CallError {}

/// A chip without devices.
#[derive(Debug, Clone, Copy, Default)]
pub struct NoDevices;

impl Bus for NoDevices {
    fn read(&mut self, address: u32, _: Size, _: u64) -> Result<u32, BusFault> {
        Err(BusFault { address, why: "no memory and no device at this address" })
    }

    fn write(&mut self, address: u32, _: Size, _: u32, _: u64) -> Result<(), BusFault> {
        Err(BusFault { address, why: "no memory and no device at this address" })
    }

    fn lines(&self) -> u32 {
        0
    }

    fn next_event(&self) -> u64 {
        u64::MAX
    }

    fn advance(&mut self, _: u64) {}
}

/// A chip.
#[derive(Debug, Clone)]
pub struct Machine<B> {
    /// The core with its registers, its NVIC and its counts.
    pub core: Core,
    /// Code RAM and data RAM.
    pub memory: Memory,
    /// The devices.
    pub bus: B,
    /// What the program wrote by semihosting.
    pub semihosting: Semihosting,
    /// How many cycles [`Machine::call`] lets a function take before it gives up.
    pub call_limit: u64,
    config: Config,
    initialised: Vec<(u32, Vec<u8>)>,
}

impl<B: Bus> Machine<B> {
    /// A chip with empty memory.
    pub fn new(config: Config, bus: B) -> Self {
        Self {
            core: Core::new(config.timing),
            memory: Memory::new(config.memory),
            bus,
            semihosting: Semihosting::default(),
            call_limit: 1 << 36,
            config,
            initialised: Vec::new(),
        }
    }

    /// Puts a program into memory as a programmer does, at its load addresses, and resets.
    ///
    /// # Errors
    /// No executable for this core, or one that wants memory where there is none; nothing was written then.
    pub fn load_elf(&mut self, file: &[u8]) -> Result<Symbols, LoadError> {
        let program = elf::read(file)?;
        for segment in &program.segments {
            let (address, bytes) = (segment.load_address, segment.bytes.len());
            if self.memory.slice(address, bytes).is_none() {
                return Err(LoadError::OutsideMemory { address, bytes: bytes as u32 });
            }
        }
        self.initialised.clear();
        for segment in program.segments {
            self.memory.write_slice(segment.load_address, segment.bytes);
            if segment.run_address != segment.load_address {
                self.initialised.push((segment.run_address, segment.bytes.to_vec()));
            }
        }
        self.reset();
        Ok(program.symbols)
    }

    /// Does what a program's startup code does to its initialised variables, for [`Machine::call`] without a run.
    pub fn initialise_variables(&mut self) {
        for (address, bytes) in &self.initialised {
            self.memory.write_slice(*address, bytes);
        }
    }

    /// From here on a fault of the program enters its own HardFault handler, as on the chip.
    pub fn forgive_faults(&mut self) {
        self.config.fault_is_fatal = false;
    }

    /// Resets the core. Time goes on, memory and devices stay as they are.
    pub fn reset(&mut self) {
        self.core.reset(&self.memory);
    }

    /// Cycles since power-on.
    pub fn cycles(&self) -> u64 {
        self.core.cycles
    }

    /// Instructions since power-on.
    pub fn instructions(&self) -> u64 {
        self.core.instructions
    }

    /// Cycles since power-on that the core slept.
    pub fn sleep_cycles(&self) -> u64 {
        self.core.sleep_cycles
    }

    /// The latest fault since power-on, also when a handler dealt with it.
    pub fn last_fault(&self) -> Option<Fault> {
        self.core.last_fault
    }

    /// The word at `address`, if that is memory.
    pub fn read_word(&self, address: u32) -> Option<u32> {
        self.memory.read(address).map(u32::from_le_bytes)
    }

    /// The bytes from `address` on, if all of them are memory.
    pub fn read_bytes(&self, address: u32, length: usize) -> Option<&[u8]> {
        self.memory.slice(address, length)
    }

    /// Writes from `address` on. `None`, and nothing written, if part of that is not memory.
    pub fn write_bytes(&mut self, address: u32, bytes: &[u8]) -> Option<()> {
        self.memory.write_slice(address, bytes)
    }

    /// Runs to `cycle`, or a few cycles beyond if an instruction or an exception entry straddles it.
    pub fn run_until(&mut self, cycle: u64) -> Stop {
        self.run(cycle).unwrap_or(Stop::Deadline)
    }

    /// Calls the function at `address` with up to four word arguments, and comes back with what it cost.
    ///
    /// It runs in Thread mode below the stack as it is now, with interrupts masked. Registers are as before
    /// afterwards; memory, devices and time have moved on.
    ///
    /// # Errors
    /// More than four arguments, or the function did not come back within [`Machine::call_limit`] cycles.
    pub fn call(&mut self, address: u32, arguments: &[u32]) -> Result<Call, CallError> {
        if arguments.len() > 4 {
            return Err(CallError::TooManyArguments);
        }
        let before = self.core.clone();
        self.core.begin_call(address, arguments, CALL_RETURN | 1);
        let stopped = self.run(before.cycles.saturating_add(self.call_limit));
        let after = std::mem::replace(&mut self.core, before);
        let before = &self.core;
        let call = Call {
            r0: after.registers.read(0),
            r1: after.registers.read(1),
            instructions: after.instructions - before.instructions,
            cycles: after.cycles - before.cycles,
            stack_bytes: (before.registers.msp() & !7).saturating_sub(after.registers.lowest_main_sp()),
        };
        self.core.take_over(after);
        match stopped {
            None => Ok(call),
            Some(stop) => Err(CallError::Stopped(stop)),
        }
    }

    /// Runs to `deadline`; `None` if a function called from outside returned.
    fn run(&mut self, deadline: u64) -> Option<Stop> {
        loop {
            self.core.catch_up(&mut self.bus, self.core.cycles);
            while let Some(dma) = self.bus.take_dma() {
                let bytes = self.memory.slice(dma.address, dma.len as usize);
                self.bus.give_dma(bytes.unwrap_or(&[]));
            }
            if self.core.halt.is_some() || self.core.fault_is_new {
                match self.halted() {
                    Next::Continue => {}
                    Next::Returned => return None,
                    Next::Stop(stop) => return Some(stop),
                }
            }
            if self.core.change_exception(&mut self.memory, &mut self.bus) {
                continue;
            }
            if self.core.sleep.is_some() && self.core.is_woken() {
                self.core.sleep = None;
            }
            if self.core.cycles >= deadline {
                return Some(Stop::Deadline);
            }
            let horizon = deadline.min(self.bus.next_event()).min(self.core.systick.next_event());
            if self.core.sleep.is_none() {
                self.core.run_to(&mut self.memory, &mut self.bus, horizon);
            } else if horizon == u64::MAX {
                return Some(Stop::Asleep);
            } else {
                self.core.sleep_until(horizon);
            }
        }
    }

    fn halted(&mut self) -> Next {
        let halt = self.core.halt.take();
        let fault_is_new = std::mem::take(&mut self.core.fault_is_new);
        let fault = self.core.last_fault;
        match (halt, fault) {
            (Some(Halt::Returned), _) => Next::Returned,
            (Some(Halt::Reset), _) => Next::Stop(Stop::Reset),
            (Some(Halt::Breakpoint { immediate }), _) => self.breakpoint(immediate),
            (Some(Halt::Lockup), fault) => {
                self.core.halt = halt;
                let pc = self.core.registers.pc;
                let unknown = Fault { pc, address: pc, why: "no vector", cycle: self.core.cycles };
                Next::Stop(Stop::Lockup(fault.unwrap_or(unknown)))
            }
            (None, Some(fault)) if fault_is_new && self.config.fault_is_fatal => Next::Stop(Stop::Fault(fault)),
            (None, _) => Next::Continue,
        }
    }

    fn breakpoint(&mut self, immediate: u8) -> Next {
        let pc = self.core.registers.pc;
        if immediate == semihosting::BREAKPOINT && self.config.semihosting {
            let centiseconds = || (self.core.cycles * 100 / u64::from(self.config.clock_hz.max(1))) as u32;
            let (operation, parameter) = (self.core.registers.read(0), self.core.registers.read(1));
            let answer = self.semihosting.serve(operation, parameter, &self.memory, centiseconds);
            self.core.skip_breakpoint();
            match answer {
                Answer::Continue(value) => {
                    self.core.registers.set(0, value);
                    Next::Continue
                }
                Answer::Exit(code) => Next::Stop(Stop::Exit(code)),
            }
        } else if self.config.stop_at_breakpoints {
            self.core.skip_breakpoint();
            Next::Stop(Stop::Breakpoint { pc, immediate })
        } else {
            self.core.refuse_breakpoint();
            self.halted()
        }
    }
}

/// What a halt of the core leads to.
enum Next {
    Continue,
    Returned,
    Stop(Stop),
}
