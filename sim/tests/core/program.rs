//! Small programs: vectors at 0, main at 0x100, handlers where the test puts them.

use sim::core::cycles::{Multiplier, Timing};
use sim::machine::{Config, Machine, Stop};

use crate::board::Board;
use crate::thumb::BKPT;

pub(crate) const MAIN: u32 = 0x100;
pub(crate) const STACK: u32 = 0x2000_1000;

pub(crate) struct Program {
    pub(crate) machine: Machine<Board>,
}

pub(crate) fn config() -> Config {
    Config { stop_at_breakpoints: true, timing: Timing::CortexM0(Multiplier::Fast), ..Config::default() }
}

impl Program {
    pub(crate) fn new(main: &[u16]) -> Self {
        Self::with(config(), main)
    }

    pub(crate) fn with(config: Config, main: &[u16]) -> Self {
        let mut program = Self { machine: Machine::new(config, Board::default()) };
        program.word(0, STACK);
        program.word(4, MAIN | 1);
        program.code(MAIN, main);
        program.machine.reset();
        program
    }

    pub(crate) fn word(&mut self, address: u32, value: u32) {
        self.machine.write_bytes(address, &value.to_le_bytes()).expect("a test writes to memory");
    }

    pub(crate) fn code(&mut self, address: u32, halves: &[u16]) {
        for (half, at) in halves.iter().chain(&[BKPT]).zip((address..).step_by(2)) {
            self.machine.write_bytes(at, &half.to_le_bytes()).expect("a test writes to memory");
        }
    }

    /// Puts a handler for exception `number` at 0x400 + 0x40 * number.
    pub(crate) fn handler(mut self, number: u32, halves: &[u16]) -> Self {
        let address = 0x400 + 0x40 * number;
        self.word(4 * number, address | 1);
        self.code(address, halves);
        self
    }

    /// Sets words that the program loads as literals or reads as data.
    pub(crate) fn data(mut self, words: &[(u32, u32)]) -> Self {
        for &(address, value) in words {
            self.word(address, value);
        }
        self
    }

    pub(crate) fn set(mut self, n: u8, value: u32) -> Self {
        self.machine.core.registers.write(n, value);
        self
    }

    pub(crate) fn flags(mut self, nzcv: u32) -> Self {
        self.machine.core.registers.set_apsr(nzcv << 28);
        self
    }

    pub(crate) fn enable(mut self, lines: u32) -> Self {
        self.machine.core.nvic.enable_lines(lines);
        self
    }

    pub(crate) fn priority(mut self, number: u8, level: i8) -> Self {
        self.machine.core.nvic.set_priority(number, level);
        self
    }

    pub(crate) fn timetable(mut self, timetable: &[(u64, u32)]) -> Self {
        self.machine.bus.timetable = timetable.to_vec();
        self
    }

    /// Runs to the breakpoint that ends every program.
    pub(crate) fn run(mut self) -> Self {
        let stop = self.machine.run_until(1_000_000);
        assert!(matches!(stop, Stop::Breakpoint { .. }), "{stop}");
        self
    }

    pub(crate) fn stop(&mut self) -> Stop {
        self.machine.run_until(1_000_000)
    }

    pub(crate) fn r(&self, n: u8) -> u32 {
        self.machine.core.registers.read(n)
    }

    pub(crate) fn nzcv(&self) -> u32 {
        self.machine.core.registers.apsr() >> 28
    }

    pub(crate) fn cycles(&self) -> u64 {
        self.machine.cycles()
    }

    pub(crate) fn at(&self, address: u32) -> u32 {
        self.machine.read_word(address).expect("a test reads memory")
    }

    pub(crate) fn notes(&self) -> &[u32] {
        &self.machine.bus.notes
    }
}
