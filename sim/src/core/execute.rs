//! The instructions.
//!
//! One loop and one `match`. Whatever concerns more than the next instruction (an access to a device, a change of
//! masks, a fault) ends the loop by moving its horizon to now, so the loop itself checks one number. An instruction not
//! decoded yet is one more arm of the `match` and goes round again: a test before it would cost every instruction.
//!
//! What can go wrong: an instruction that faults must leave its destination and the program counter as they were.

use super::decode::Op;
use super::registers::{LR, PC, SP};
use super::{CALL_RETURN, Core, Halt, Sleep, cycles, nvic};
use crate::bus::{Bus, Size};
use crate::memory::Memory;

#[inline(always)]
fn widen<const N: usize>(bytes: [u8; N]) -> u32 {
    let mut word = [0; 4];
    word[..N].copy_from_slice(&bytes);
    u32::from_le_bytes(word)
}

#[inline(always)]
fn narrow<const N: usize>(value: u32) -> [u8; N] {
    let mut bytes = [0; N];
    bytes.copy_from_slice(&value.to_le_bytes()[..N]);
    bytes
}

const fn size<const N: usize>() -> Size {
    match N {
        1 => Size::Byte,
        2 => Size::Half,
        _ => Size::Word,
    }
}

fn registers_in(list: u16) -> impl Iterator<Item = (u8, u32)> {
    let mut rest = list;
    let mut beat = 0;
    std::iter::from_fn(move || {
        let n = rest.trailing_zeros();
        rest &= rest.wrapping_sub(1);
        beat += 1;
        (n < 16).then_some((n as u8, beat - 1))
    })
}

impl Core {
    #[inline(always)]
    fn load_beat<const N: usize, B: Bus>(
        &mut self,
        memory: &Memory,
        bus: &mut B,
        address: u32,
        beat: u32,
    ) -> Option<u32> {
        if address & (N as u32 - 1) == 0
            && let Some(bytes) = memory.read::<N>(address)
        {
            return Some(widen(bytes));
        }
        self.load_register(bus, address, size::<N>(), beat)
    }

    #[inline(always)]
    fn load<const N: usize, B: Bus>(&mut self, memory: &Memory, bus: &mut B, address: u32) -> Option<u32> {
        self.load_beat::<N, B>(memory, bus, address, 0)
    }

    #[inline(always)]
    fn store_beat<const N: usize, B: Bus>(
        &mut self,
        memory: &mut Memory,
        bus: &mut B,
        address: u32,
        value: u32,
        beat: u32,
    ) -> Option<()> {
        if address & (N as u32 - 1) == 0 && memory.write::<N>(address, narrow(value)).is_some() {
            return Some(());
        }
        self.store_register(bus, address, size::<N>(), value, beat)
    }

    #[inline(always)]
    fn store<const N: usize, B: Bus>(&mut self, memory: &mut Memory, bus: &mut B, address: u32, t: u8) -> Option<()> {
        self.store_beat::<N, B>(memory, bus, address, self.registers.get(t), 0)
    }

    #[inline(always)]
    fn add(&mut self, a: u32, b: u32) -> u32 {
        let (result, carry) = a.overflowing_add(b);
        let registers = &mut self.registers;
        registers.set_nz(result);
        registers.c = carry;
        registers.v = (a ^ result) & (b ^ result);
        result
    }

    #[inline(always)]
    fn subtract(&mut self, a: u32, b: u32) -> u32 {
        let result = a.wrapping_sub(b);
        let registers = &mut self.registers;
        registers.set_nz(result);
        registers.c = a >= b;
        registers.v = (a ^ b) & (a ^ result);
        result
    }

    #[inline(always)]
    fn add_with_carry(&mut self, a: u32, b: u32) -> u32 {
        let sum = u64::from(a) + u64::from(b) + u64::from(self.registers.c);
        let result = sum as u32;
        let registers = &mut self.registers;
        registers.set_nz(result);
        registers.c = sum >> 32 != 0;
        registers.v = (a ^ result) & (b ^ result);
        result
    }

    #[inline(always)]
    fn assign(&mut self, d: u8, result: u32) {
        self.registers.set_nz(result);
        self.registers.set(d, result);
    }

    #[inline(always)]
    fn shift_by_register(&mut self, d: u8, m: u8, shift: impl Fn(u64, u32) -> u64, carry: impl Fn(u64, u32) -> bool) {
        let amount = self.registers.get(m) & 0xFF;
        let value = u64::from(self.registers.get(d));
        if amount != 0 {
            self.registers.c = carry(value, amount.min(63));
        }
        self.assign(d, shift(value, amount.min(63)) as u32);
    }

    #[inline(always)]
    fn store_list<B: Bus>(&mut self, memory: &mut Memory, bus: &mut B, start: u32, list: u16) -> Option<()> {
        for (n, beat) in registers_in(list) {
            let value = self.registers.get(n);
            self.store_beat::<4, B>(memory, bus, start.wrapping_add(4 * beat), value, beat)?;
        }
        Some(())
    }

    #[inline(always)]
    fn load_list<B: Bus>(&mut self, memory: &Memory, bus: &mut B, start: u32, list: u16, base: u8) -> Option<()> {
        let mut held = None;
        for (n, beat) in registers_in(list) {
            let value = self.load_beat::<4, B>(memory, bus, start.wrapping_add(4 * beat), beat)?;
            if n == base {
                held = Some(value);
            } else {
                self.registers.set(n, value);
            }
        }
        if let Some(value) = held {
            self.registers.set(base, value);
        }
        Some(())
    }

    fn read_special(&self, special: u8) -> u32 {
        let registers = &self.registers;
        match special {
            0 | 2 => registers.apsr(),
            1 | 3 => registers.apsr() | u32::from(registers.ipsr),
            5 | 7 => u32::from(registers.ipsr),
            8 => registers.msp(),
            9 => registers.psp(),
            16 => u32::from(registers.primask),
            20 => registers.control(),
            _ => 0,
        }
    }

    fn write_special(&mut self, special: u8, value: u32) {
        let registers = &mut self.registers;
        match special {
            0..=3 => registers.set_apsr(value),
            8 => registers.set_msp(value),
            9 => registers.set_psp(value),
            16 => self.set_primask(value & 1 != 0),
            20 if registers.ipsr == 0 => registers.use_stack(value & 2 != 0),
            _ => {}
        }
    }

    fn set_primask(&mut self, masked: bool) {
        self.registers.primask = masked;
        self.interrupt_loop();
    }

    fn supervisor_call(&mut self) -> bool {
        let urgent = self.nvic.priority_of(nvic::SVCALL) < self.nvic.execution_priority(self.registers.primask);
        if urgent {
            self.nvic.pend(nvic::SVCALL, self.cycles);
            self.interrupt_loop();
        } else {
            self.refuse(self.registers.pc, "SVC where SVCall cannot be taken");
        }
        urgent
    }

    fn go_to_sleep(&mut self, sleep: Sleep) {
        self.sleep = Some(sleep);
        self.interrupt_loop();
    }

    #[cold]
    #[inline(never)]
    fn fetch(&mut self, memory: &mut Memory, pc: u32) -> Option<Op> {
        let op = memory.decode(pc);
        if op.is_none() && self.call_in_progress && pc == CALL_RETURN {
            self.halt(Halt::Returned);
        } else if op.is_none() {
            self.refuse(pc, "nothing to execute at this address");
        }
        op
    }

    #[inline(never)]
    pub(super) fn run<B: Bus>(&mut self, memory: &mut Memory, bus: &mut B) {
        let fast_multiply = self.timing.multiply();
        macro_rules! get {
            ($n:expr) => {
                self.registers.get($n)
            };
        }
        while self.cycles < self.horizon {
            let pc = self.registers.pc;
            let mut fetched;
            let mut op = memory.operation(pc);
            let mut next = pc.wrapping_add(2);
            let mut spent = cycles::ALU;

            macro_rules! branch_if {
                ($condition:expr, $target:expr) => {
                    if $condition {
                        next = $target;
                        spent = cycles::BRANCH;
                    }
                };
            }
            macro_rules! load {
                ($bytes:literal, $t:expr, $address:expr, $extend:expr) => {{
                    let address = $address;
                    let Some(value) = self.load::<$bytes, B>(memory, bus, address) else {
                        return;
                    };
                    self.registers.set($t, $extend(value));
                    spent = cycles::LOAD_STORE;
                }};
                ($bytes:literal, $t:expr, $address:expr) => {
                    load!($bytes, $t, $address, |value| value)
                };
            }
            macro_rules! store {
                ($bytes:literal, $t:expr, $address:expr) => {{
                    let address = $address;
                    let Some(()) = self.store::<$bytes, B>(memory, bus, address, $t) else {
                        return;
                    };
                    spent = cycles::LOAD_STORE;
                }};
            }
            macro_rules! indexed {
                ($n:expr, $m:expr) => {
                    get!($n).wrapping_add(get!($m))
                };
            }
            macro_rules! offset {
                ($n:expr, $offset:expr) => {
                    get!($n).wrapping_add(u32::from($offset))
                };
            }

            loop {
                match *op {
                    Op::Unknown => {
                        match self.fetch(memory, pc) {
                            Some(decoded) => fetched = decoded,
                            None => return,
                        }
                        op = &fetched;
                        continue;
                    }
                    Op::Undefined => return self.refuse(pc, "undefined instruction"),
                    Op::Movs { d, m } => self.assign(d, get!(m)),
                    Op::LslImm { d, m, shift } => {
                        let value = get!(m);
                        self.registers.c = value >> (32 - shift) & 1 != 0;
                        self.assign(d, value << (shift & 31));
                    }
                    Op::LsrImm { d, m, shift } => {
                        let value = get!(m);
                        self.registers.c = value >> (shift - 1) & 1 != 0;
                        self.assign(d, (u64::from(value) >> shift) as u32);
                    }
                    Op::AsrImm { d, m, shift } => {
                        let value = get!(m) as i32;
                        self.registers.c = value >> (shift - 1) & 1 != 0;
                        self.assign(d, (i64::from(value) >> shift) as u32);
                    }
                    Op::AddReg { d, n, m } => {
                        let result = self.add(get!(n), get!(m));
                        self.registers.set(d, result);
                    }
                    Op::SubReg { d, n, m } => {
                        let result = self.subtract(get!(n), get!(m));
                        self.registers.set(d, result);
                    }
                    Op::AddImm { d, n, imm } => {
                        let result = self.add(get!(n), u32::from(imm));
                        self.registers.set(d, result);
                    }
                    Op::SubImm { d, n, imm } => {
                        let result = self.subtract(get!(n), u32::from(imm));
                        self.registers.set(d, result);
                    }
                    Op::MovImm { d, imm } => self.assign(d, u32::from(imm)),
                    Op::CmpImm { n, imm } => {
                        self.subtract(get!(n), u32::from(imm));
                    }
                    Op::And { d, m } => self.assign(d, get!(d) & get!(m)),
                    Op::Eor { d, m } => self.assign(d, get!(d) ^ get!(m)),
                    Op::LslReg { d, m } => {
                        self.shift_by_register(d, m, |value, by| value << by, |value, by| value << by >> 32 & 1 != 0);
                    }
                    Op::LsrReg { d, m } => {
                        self.shift_by_register(d, m, |value, by| value >> by, |value, by| value >> (by - 1) & 1 != 0);
                    }
                    Op::AsrReg { d, m } => {
                        let signed = |value: u64| i64::from(value as u32 as i32);
                        self.shift_by_register(
                            d,
                            m,
                            |value, by| (signed(value) >> by) as u64,
                            |value, by| signed(value) >> (by - 1) & 1 != 0,
                        );
                    }
                    Op::RorReg { d, m } => {
                        let amount = get!(m) & 0xFF;
                        let result = get!(d).rotate_right(amount & 31);
                        if amount != 0 {
                            self.registers.c = result >> 31 != 0;
                        }
                        self.assign(d, result);
                    }
                    Op::Adc { d, m } => {
                        let result = self.add_with_carry(get!(d), get!(m));
                        self.registers.set(d, result);
                    }
                    Op::Sbc { d, m } => {
                        let result = self.add_with_carry(get!(d), !get!(m));
                        self.registers.set(d, result);
                    }
                    Op::Tst { n, m } => self.registers.set_nz(get!(n) & get!(m)),
                    Op::Rsb { d, n } => {
                        let result = self.subtract(0, get!(n));
                        self.registers.set(d, result);
                    }
                    Op::CmpReg { n, m } => {
                        self.subtract(get!(n), get!(m));
                    }
                    Op::Cmn { n, m } => {
                        self.add(get!(n), get!(m));
                    }
                    Op::Orr { d, m } => self.assign(d, get!(d) | get!(m)),
                    Op::Mul { d, m } => {
                        self.assign(d, get!(d).wrapping_mul(get!(m)));
                        spent = fast_multiply;
                    }
                    Op::Bic { d, m } => self.assign(d, get!(d) & !get!(m)),
                    Op::Mvn { d, m } => self.assign(d, !get!(m)),
                    Op::AddHigh { d, m } => self.registers.set(d, get!(d).wrapping_add(get!(m))),
                    Op::AddToSp { m } => self.registers.set_sp(get!(SP).wrapping_add(get!(m))),
                    Op::AddConstant { d, value } => self.registers.set(d, get!(d).wrapping_add(value)),
                    Op::AddPc { m } => {
                        next = pc.wrapping_add(4).wrapping_add(get!(m)) & !1;
                        spent = cycles::BRANCH;
                    }
                    Op::Mov { d, m } => self.registers.set(d, get!(m)),
                    Op::MovToSp { m } => self.registers.set_sp(get!(m)),
                    Op::MovPc { m } => {
                        next = get!(m) & !1;
                        spent = cycles::BRANCH;
                    }
                    Op::Bx { m } => {
                        self.branch_exchange(get!(m));
                        next = self.registers.pc;
                        spent = cycles::BRANCH;
                    }
                    Op::Blx { m } => {
                        let target = get!(m);
                        self.registers.set(LR, next | 1);
                        self.jump(target);
                        next = self.registers.pc;
                        spent = cycles::BRANCH;
                    }
                    Op::Constant { d, value } => self.registers.set(d, value),
                    Op::LdrLiteral { t, address } => load!(4, t, address),
                    Op::StrReg { t, n, m } => store!(4, t, indexed!(n, m)),
                    Op::StrhReg { t, n, m } => store!(2, t, indexed!(n, m)),
                    Op::StrbReg { t, n, m } => store!(1, t, indexed!(n, m)),
                    Op::LdrsbReg { t, n, m } => {
                        load!(1, t, indexed!(n, m), |value| value as i8 as u32)
                    }
                    Op::LdrReg { t, n, m } => load!(4, t, indexed!(n, m)),
                    Op::LdrhReg { t, n, m } => load!(2, t, indexed!(n, m)),
                    Op::LdrbReg { t, n, m } => load!(1, t, indexed!(n, m)),
                    Op::LdrshReg { t, n, m } => {
                        load!(2, t, indexed!(n, m), |value| value as i16 as u32)
                    }
                    Op::StrImm { t, n, offset } => store!(4, t, offset!(n, offset)),
                    Op::LdrImm { t, n, offset } => load!(4, t, offset!(n, offset)),
                    Op::StrbImm { t, n, offset } => store!(1, t, offset!(n, offset)),
                    Op::LdrbImm { t, n, offset } => load!(1, t, offset!(n, offset)),
                    Op::StrhImm { t, n, offset } => store!(2, t, offset!(n, offset)),
                    Op::LdrhImm { t, n, offset } => load!(2, t, offset!(n, offset)),
                    Op::AddSpTo { d, offset } => self.registers.set(d, offset!(SP, offset)),
                    Op::AdjustSp { offset } => self.registers.set_sp(get!(SP).wrapping_add_signed(i32::from(offset))),
                    Op::Sxth { d, m } => self.registers.set(d, get!(m) as i16 as u32),
                    Op::Sxtb { d, m } => self.registers.set(d, get!(m) as i8 as u32),
                    Op::Uxth { d, m } => self.registers.set(d, get!(m) & 0xFFFF),
                    Op::Uxtb { d, m } => self.registers.set(d, get!(m) & 0xFF),
                    Op::Rev { d, m } => self.registers.set(d, get!(m).swap_bytes()),
                    Op::Rev16 { d, m } => self.registers.set(d, get!(m).swap_bytes().rotate_right(16)),
                    Op::Revsh { d, m } => self.registers.set(d, (get!(m) as u16).swap_bytes() as i16 as u32),
                    Op::Push { list } => {
                        let bytes = 4 * list.count_ones();
                        let start = get!(SP).wrapping_sub(bytes);
                        let Some(()) = self.store_list(memory, bus, start, list) else {
                            return;
                        };
                        self.registers.set_sp(start);
                        spent = cycles::multiple(list.count_ones());
                    }
                    Op::Pop { list } => {
                        let start = get!(SP);
                        let Some(()) = self.load_list(memory, bus, start, list, PC) else {
                            return;
                        };
                        self.registers.set_sp(start.wrapping_add(4 * list.count_ones()));
                        spent = cycles::multiple(list.count_ones());
                    }
                    Op::PopReturn { list } => {
                        let start = get!(SP);
                        let count = list.count_ones();
                        let Some(()) = self.load_list(memory, bus, start, list, PC) else {
                            return;
                        };
                        let last = start.wrapping_add(4 * count);
                        let Some(target) = self.load_beat::<4, B>(memory, bus, last, count) else {
                            return;
                        };
                        self.registers.set_sp(last.wrapping_add(4));
                        self.branch_exchange(target);
                        next = self.registers.pc;
                        spent = cycles::pop_with_return(count + 1);
                    }
                    Op::Stm { n, list } => {
                        let start = get!(n);
                        let Some(()) = self.store_list(memory, bus, start, list) else {
                            return;
                        };
                        self.registers.set(n, start.wrapping_add(4 * list.count_ones()));
                        spent = cycles::multiple(list.count_ones());
                    }
                    Op::Ldm { n, list, writeback } => {
                        let start = get!(n);
                        let Some(()) = self.load_list(memory, bus, start, list, n) else {
                            return;
                        };
                        if writeback {
                            self.registers.set(n, start.wrapping_add(4 * list.count_ones()));
                        }
                        spent = cycles::multiple(list.count_ones());
                    }
                    Op::Cps { mask } => self.set_primask(mask),
                    Op::Bkpt { immediate } => return self.halt(Halt::Breakpoint { immediate }),
                    Op::Svc => {
                        if !self.supervisor_call() {
                            return;
                        }
                    }
                    Op::Nop => {}
                    Op::Sev => self.event = true,
                    Op::Wfe => {
                        if !std::mem::take(&mut self.event) {
                            self.go_to_sleep(Sleep::Event);
                        }
                        spent = cycles::WAIT;
                    }
                    Op::Wfi => {
                        self.go_to_sleep(Sleep::Interrupt);
                        spent = cycles::WAIT;
                    }
                    Op::Beq { target } => branch_if!(self.registers.z == 0, target),
                    Op::Bne { target } => branch_if!(self.registers.z != 0, target),
                    Op::Bcs { target } => branch_if!(self.registers.c, target),
                    Op::Bcc { target } => branch_if!(!self.registers.c, target),
                    Op::Bmi { target } => branch_if!((self.registers.n as i32) < 0, target),
                    Op::Bpl { target } => branch_if!(self.registers.n as i32 >= 0, target),
                    Op::Bvs { target } => branch_if!((self.registers.v as i32) < 0, target),
                    Op::Bvc { target } => branch_if!(self.registers.v as i32 >= 0, target),
                    Op::Bhi { target } => {
                        branch_if!(self.registers.c && self.registers.z != 0, target)
                    }
                    Op::Bls { target } => {
                        branch_if!(!self.registers.c || self.registers.z == 0, target)
                    }
                    Op::Bge { target } => {
                        branch_if!((self.registers.n ^ self.registers.v) as i32 >= 0, target)
                    }
                    Op::Blt { target } => {
                        branch_if!(((self.registers.n ^ self.registers.v) as i32) < 0, target)
                    }
                    Op::Bgt { target } => {
                        branch_if!((self.registers.n ^ self.registers.v) as i32 >= 0 && self.registers.z != 0, target);
                    }
                    Op::Ble { target } => {
                        branch_if!(((self.registers.n ^ self.registers.v) as i32) < 0 || self.registers.z == 0, target);
                    }
                    Op::B { target } => {
                        next = target;
                        spent = cycles::BRANCH;
                    }
                    Op::Bl { target } => {
                        self.registers.set(LR, pc.wrapping_add(4) | 1);
                        next = target;
                        spent = cycles::BRANCH_LINK;
                    }
                    Op::Msr { n, special } => {
                        self.write_special(special, get!(n));
                        next = pc.wrapping_add(4);
                        spent = cycles::SPECIAL_REGISTER;
                    }
                    Op::Mrs { d, special } => {
                        let value = self.read_special(special);
                        self.registers.set(d, value);
                        next = pc.wrapping_add(4);
                        spent = cycles::SPECIAL_REGISTER;
                    }
                    Op::Barrier => {
                        next = pc.wrapping_add(4);
                        spent = cycles::BARRIER;
                    }
                }
                break;
            }
            self.registers.pc = next;
            self.instructions += 1;
            self.cycles += u64::from(spent.min(self.instruction_cycles_limit));
        }
    }
}
