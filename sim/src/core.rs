//! An ARMv6-M core: the Cortex-M0 as its Technical Reference Manual counts it.
//!
//! The firmware's argument is a budget: so many cycles from light to position, so much of the time asleep. A core
//! that counts cycles, sleeps and takes interrupts as the chip does turns that argument into a measurement. The core
//! knows nothing of the chip around it except the [`Bus`].
//!
//! What can go wrong: code that relies on UNPREDICTABLE behaviour faults here although silicon may do something with
//! it. Memory has no wait states. A load or store of several registers always finishes, where silicon abandons and
//! restarts it for an interrupt, so an interrupt can come up to eight cycles late. An exception return costs the
//! cycles in [`cycles`], which the manual does not give.

pub mod cycles;
pub mod decode;
pub mod exception;
mod execute;
pub mod nvic;
pub mod registers;
pub mod statistics;
mod system_control;
pub mod systick;

use crate::bus::{Bus, Size};
use crate::memory::Memory;
use cycles::Timing;
use exception::Returning;
use nvic::Nvic;
use registers::Registers;
use statistics::Statistics;
use systick::SysTick;

/// The address that [`Machine::call`](crate::machine::Machine::call) leaves in LR; nothing is mapped there.
pub(crate) const CALL_RETURN: u32 = 0xEFFF_FFF0;

/// Why the core cannot go on by itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Halt {
    /// A BKPT instruction; the program counter still points at it.
    Breakpoint {
        /// The immediate of the instruction.
        immediate: u8,
    },
    /// A function called from outside returned.
    Returned,
    /// A fault where no HardFault can be taken.
    Lockup,
    /// The program asked for a system reset.
    Reset,
}

/// What a sleeping core waits for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Sleep {
    /// WFI, or SLEEPONEXIT.
    Interrupt,
    /// WFE.
    Event,
}

/// Something the program did that a Cortex-M0 refuses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Fault {
    /// The address of the instruction.
    pub pc: u32,
    /// The address it wanted to use; for a fault of the instruction itself, its own.
    pub address: u32,
    /// The reason, for a person to read.
    pub why: &'static str,
    /// When it happened.
    pub cycle: u64,
}

impl std::fmt::Display for Fault {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { pc, address, why, cycle } = self;
        write!(f, "fault at pc {pc:#010x}, address {address:#010x}, cycle {cycle}: {why}")
    }
}

/// The state of the core.
#[derive(Debug, Clone)]
pub struct Core {
    /// General-purpose and special registers.
    pub registers: Registers,
    /// Pending, enabled and active exceptions with their priorities.
    pub nvic: Nvic,
    /// The system timer.
    pub systick: SysTick,
    /// What was measured of every exception.
    pub statistics: Statistics,
    /// Core cycles since power-on, asleep or awake.
    pub cycles: u64,
    /// Instructions executed since power-on.
    pub instructions: u64,
    /// The part of `cycles` spent asleep.
    pub sleep_cycles: u64,
    /// The latest fault since power-on, also when a handler dealt with it.
    pub last_fault: Option<Fault>,
    timing: Timing,
    instruction_cycles_limit: u32,
    horizon: u64,
    thumb: bool,
    event: bool,
    pub(crate) fault_is_new: bool,
    call_in_progress: bool,
    pub(crate) halt: Option<Halt>,
    pub(crate) sleep: Option<Sleep>,
    returning: Option<Returning>,
    sleep_on_exit: bool,
    sleep_deep: bool,
    event_on_pend: bool,
}

impl Core {
    /// A core that has power but has not left reset.
    pub fn new(timing: Timing) -> Self {
        Self {
            registers: Registers::default(),
            nvic: Nvic::default(),
            systick: SysTick::default(),
            statistics: Statistics::default(),
            cycles: 0,
            instructions: 0,
            sleep_cycles: 0,
            last_fault: None,
            instruction_cycles_limit: timing.instruction_cycles_limit(),
            timing,
            horizon: 0,
            thumb: true,
            event: false,
            fault_is_new: false,
            call_in_progress: false,
            halt: None,
            sleep: None,
            returning: None,
            sleep_on_exit: false,
            sleep_deep: false,
            event_on_pend: false,
        }
    }

    /// Leaves reset: stack pointer and program counter come from the first two words of code memory. Time, counts and
    /// statistics go on.
    pub fn reset(&mut self, memory: &Memory) {
        *self = Self {
            statistics: std::mem::take(&mut self.statistics),
            cycles: self.cycles,
            instructions: self.instructions,
            sleep_cycles: self.sleep_cycles,
            last_fault: self.last_fault,
            ..Self::new(self.timing)
        };
        let vector = |index: u32| memory.read(4 * index).map_or(0, u32::from_le_bytes);
        self.statistics.forget_running();
        self.registers.restart(vector(0));
        self.jump(vector(1));
    }

    /// Whether the core waits in WFI or WFE.
    pub fn is_asleep(&self) -> bool {
        self.sleep.is_some()
    }

    /// Runs awake until `horizon`, or until something happens that is not the next instruction's business.
    pub(crate) fn run_to<B: Bus>(&mut self, memory: &mut Memory, bus: &mut B, horizon: u64) {
        self.horizon = horizon;
        if self.thumb {
            self.run(memory, bus);
        } else {
            self.refuse(self.registers.pc, "branch to an address without the Thumb bit");
        }
    }

    /// Gives the devices every event due by `now` and takes in their lines and the system timer's wrap.
    pub(crate) fn catch_up<B: Bus>(&mut self, bus: &mut B, now: u64) {
        let mut due = bus.next_event();
        while due <= now {
            bus.advance(due);
            self.nvic.sample(bus.lines(), due);
            let next = bus.next_event();
            assert!(next > due, "a device has an event at cycle {due} that does not go away when it is due");
            due = next;
        }
        self.nvic.sample(bus.lines(), now);
        if let Some(wrapped) = self.systick.advance(now) {
            self.nvic.pend(nvic::SYSTICK, wrapped);
        }
    }

    /// Lets time pass asleep.
    pub(crate) fn sleep_until(&mut self, cycle: u64) {
        self.sleep_cycles += cycle - self.cycles;
        self.cycles = cycle;
    }

    /// Prepares registers as a caller of `function` would.
    pub(crate) fn begin_call(&mut self, function: u32, arguments: &[u32], return_to: u32) {
        let registers = &mut self.registers;
        registers.use_stack(false);
        registers.set_sp(registers.msp() & !7);
        registers.forget_lowest_sp();
        for (&argument, n) in arguments.iter().zip(0..) {
            registers.set(n, argument);
        }
        registers.set(registers::LR, return_to);
        registers.ipsr = 0;
        registers.primask = true;
        self.sleep = None;
        self.halt = None;
        self.call_in_progress = true;
        self.jump(function | 1);
    }

    /// Takes over what a call has changed for good: time, counts and what the program asked of NVIC and SysTick.
    pub(crate) fn take_over(&mut self, called: Self) {
        *self = Self {
            registers: std::mem::take(&mut self.registers),
            thumb: self.thumb,
            event: self.event,
            fault_is_new: self.fault_is_new,
            call_in_progress: self.call_in_progress,
            halt: self.halt,
            sleep: self.sleep,
            returning: self.returning,
            ..called
        };
    }

    pub(crate) fn skip_breakpoint(&mut self) {
        self.registers.pc = self.registers.pc.wrapping_add(2);
        self.instructions += 1;
        self.cycles += u64::from(cycles::ALU);
    }

    pub(crate) fn refuse_breakpoint(&mut self) {
        self.refuse(self.registers.pc, "BKPT without a debugger");
    }

    fn interrupt_loop(&mut self) {
        self.horizon = 0;
    }

    fn halt(&mut self, halt: Halt) {
        self.halt = Some(halt);
        self.interrupt_loop();
    }

    fn jump(&mut self, target: u32) {
        self.registers.pc = target & !1;
        self.thumb = target & 1 != 0;
        if !self.thumb {
            self.interrupt_loop();
        }
    }

    #[cold]
    fn refuse(&mut self, address: u32, why: &'static str) {
        self.last_fault = Some(Fault { pc: self.registers.pc, address, why, cycle: self.cycles });
        self.fault_is_new = true;
        if self.nvic.execution_priority(self.registers.primask) <= nvic::HARD_FAULT_PRIORITY {
            self.halt(Halt::Lockup);
        } else {
            self.nvic.pend(nvic::HARD_FAULT, self.cycles);
            self.interrupt_loop();
        }
    }

    #[cold]
    #[inline(never)]
    fn load_register<B: Bus>(&mut self, bus: &mut B, address: u32, size: Size, beat: u32) -> Option<u32> {
        let cycle = self.begin_access(bus, address, size, beat)?;
        let result = match address {
            0xE000_0000..=0xE00F_FFFF => self.read_system_control(address, size, cycle),
            _ => bus.read(address, size, cycle),
        };
        result.map_err(|fault| self.refuse(fault.address, fault.why)).ok()
    }

    #[cold]
    #[inline(never)]
    fn store_register<B: Bus>(&mut self, bus: &mut B, address: u32, size: Size, value: u32, beat: u32) -> Option<()> {
        let cycle = self.begin_access(bus, address, size, beat)?;
        let result = match address {
            0xE000_0000..=0xE00F_FFFF => self.write_system_control(address, size, value, cycle),
            _ => bus.write(address, size, value, cycle),
        };
        result.map_err(|fault| self.refuse(fault.address, fault.why)).ok()
    }

    fn begin_access<B: Bus>(&mut self, bus: &mut B, address: u32, size: Size, beat: u32) -> Option<u64> {
        let mask = match size {
            Size::Byte => 0,
            Size::Half => 1,
            Size::Word => 3,
        };
        if address & mask != 0 {
            self.refuse(address, "unaligned access");
            return None;
        }
        let cycle = self.cycles + u64::from(self.timing.data_phase(beat));
        self.catch_up(bus, cycle);
        self.interrupt_loop();
        Some(cycle)
    }
}
