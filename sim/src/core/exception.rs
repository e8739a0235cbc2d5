//! Exception entry and return.
//!
//! What can go wrong: a stack pointer that leaves memory while a frame is written becomes a HardFault on top of the
//! lost frame, and a lockup if the frame was HardFault's own; a return value or frame that makes no sense is a
//! HardFault too.

use super::registers::{LR, SP, THUMB_BIT};
use super::{Core, Halt, Sleep, cycles, nvic};
use crate::bus::Bus;
use crate::memory::Memory;

const FRAME_BYTES: u32 = 32;
const FRAME_ALIGNED: u32 = 1 << 9;
const RETURN_TO_HANDLER: u32 = 0xFFFF_FFF1;
const RETURN_TO_THREAD_MAIN: u32 = 0xFFFF_FFF9;
const RETURN_TO_THREAD_PROCESS: u32 = 0xFFFF_FFFD;

/// An EXC_RETURN value on its way into the program counter.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Returning(u32);

impl Core {
    /// Takes or leaves an exception if one is due. Says whether it did.
    pub(crate) fn change_exception<B: Bus>(&mut self, memory: &mut Memory, bus: &mut B) -> bool {
        if let Some(returning) = self.returning.take() {
            self.leave(returning, memory);
            return true;
        }
        if self.nvic.take_pended() && self.event_on_pend {
            self.event = true;
        }
        match self.nvic.preempting(self.registers.primask) {
            Some(number) => {
                self.enter(number, memory, bus);
                true
            }
            None => false,
        }
    }

    /// Whether something ends the sleep. PRIMASK does not count.
    pub(crate) fn is_woken(&mut self) -> bool {
        let by_interrupt = self.nvic.preempting(false).is_some();
        match self.sleep {
            None | Some(Sleep::Interrupt) => by_interrupt,
            Some(Sleep::Event) => std::mem::take(&mut self.event),
        }
    }

    /// A branch by BX or POP: in Handler mode the highest addresses mean exception return.
    pub(super) fn branch_exchange(&mut self, target: u32) {
        if target >= 0xF000_0000 && self.registers.ipsr != 0 {
            self.returning = Some(Returning(target));
            self.interrupt_loop();
        } else {
            self.jump(target);
        }
    }

    fn enter<B: Bus>(&mut self, first: u8, memory: &mut Memory, bus: &mut B) {
        let began = self.cycles;
        let return_value = match (self.registers.ipsr, self.registers.control()) {
            (0, 0) => RETURN_TO_THREAD_MAIN,
            (0, _) => RETURN_TO_THREAD_PROCESS,
            _ => RETURN_TO_HANDLER,
        };
        let stacked = self.push_frame(memory);
        self.cycles += self.timing.exception(cycles::EXCEPTION_ENTRY);
        if stacked.is_none() {
            self.refuse(self.registers.get(SP), "no memory for an exception frame");
            if first == nvic::HARD_FAULT {
                self.halt(Halt::Lockup);
                return;
            }
        }
        self.catch_up(bus, self.cycles);
        let number = self.nvic.preempting(self.registers.primask).unwrap_or(first);
        self.start_handler(number, return_value, began, memory);
    }

    fn start_handler(&mut self, number: u8, return_value: u32, began: u64, memory: &Memory) {
        self.statistics.enter(number, self.nvic.pended_at(number), began, self.cycles);
        self.nvic.activate(number);
        self.sleep = None;
        self.event = true;
        let registers = &mut self.registers;
        registers.use_stack(false);
        registers.ipsr = number;
        registers.set(LR, return_value);
        match memory.read(4 * u32::from(number)) {
            Some(vector) => self.jump(u32::from_le_bytes(vector)),
            None => self.halt(Halt::Lockup),
        }
    }

    fn push_frame(&mut self, memory: &mut Memory) -> Option<()> {
        let registers = &mut self.registers;
        let sp = registers.get(SP);
        let aligned = sp & 4 != 0;
        let frame = sp.wrapping_sub(FRAME_BYTES) & !4;
        let psr = registers.apsr()
            | (u32::from(self.thumb) * THUMB_BIT)
            | (u32::from(aligned) * FRAME_ALIGNED)
            | u32::from(registers.ipsr);
        registers.set_sp(frame);
        let r = |n| registers.get(n);
        let words = [r(0), r(1), r(2), r(3), r(12), r(14), registers.pc, psr];
        words.iter().zip(0..).try_for_each(|(word, i)| memory.write(frame.wrapping_add(4 * i), word.to_le_bytes()))
    }

    fn leave(&mut self, Returning(value): Returning, memory: &Memory) {
        let ended = self.registers.ipsr;
        let last = self.cycles;
        let (to_handler, process) = match value {
            RETURN_TO_HANDLER => (true, false),
            RETURN_TO_THREAD_MAIN => (false, false),
            RETURN_TO_THREAD_PROCESS => (false, true),
            _ => return self.refuse(value, "not an exception return value"),
        };
        if to_handler != (self.nvic.active_count() > 1) {
            return self.refuse(value, "exception return to the wrong mode");
        }
        self.nvic.deactivate(ended, last);
        if let Some(next) = self.nvic.preempting(self.registers.primask) {
            self.cycles += self.timing.exception(cycles::TAIL_CHAIN);
            self.statistics.leave(last, last);
            return self.start_handler(next, value, last, memory);
        }
        self.cycles += self.timing.exception(cycles::EXCEPTION_RETURN);
        self.statistics.leave(last, self.cycles);
        self.registers.use_stack(process);
        self.event = true;
        if self.pop_frame(memory, to_handler).is_none() {
            return;
        }
        if self.sleep_on_exit && !to_handler {
            self.sleep = Some(Sleep::Interrupt);
        }
    }

    fn pop_frame(&mut self, memory: &Memory, to_handler: bool) -> Option<()> {
        let frame = self.registers.get(SP);
        let mut words = [0; 8];
        for (word, i) in words.iter_mut().zip(0..) {
            let Some(bytes) = memory.read(frame.wrapping_add(4 * i)) else {
                self.registers.ipsr = 0;
                self.refuse(frame, "no exception frame in memory to return to");
                return None;
            };
            *word = u32::from_le_bytes(bytes);
        }
        let [r0, r1, r2, r3, r12, lr, pc, psr] = words;
        let registers = &mut self.registers;
        for (n, value) in [(0, r0), (1, r1), (2, r2), (3, r3), (12, r12), (LR, lr)] {
            registers.set(n, value);
        }
        registers.set_sp(frame.wrapping_add(FRAME_BYTES) | u32::from(psr & FRAME_ALIGNED != 0) << 2);
        registers.set_apsr(psr);
        registers.ipsr = (psr & 0x3F) as u8;
        registers.pc = pc & !1;
        self.thumb = psr & THUMB_BIT != 0;
        if (registers.ipsr != 0) != to_handler {
            registers.ipsr = 0;
            self.refuse(frame, "the exception frame belongs to the other mode");
            return None;
        }
        Some(())
    }
}
