//! The register file: R0 to R15, the banked stack pointers, PSR, PRIMASK and CONTROL.
//!
//! The flags are kept as the results they come from and only made into bits when the program reads the PSR.
//!
//! What can go wrong: `r13` is the active stack pointer; the sleeping one is swapped in by `Registers::use_stack`
//! and nowhere else.

/// Program counter as an operand: the address of the instruction plus four.
pub(crate) const PC: u8 = 15;
pub(crate) const LR: u8 = 14;
pub(crate) const SP: u8 = 13;

/// Bit 24 of the EPSR: the core runs Thumb code.
pub(crate) const THUMB_BIT: u32 = 1 << 24;

/// General-purpose and special registers.
#[derive(Debug, Clone)]
pub struct Registers {
    r: [u32; 16],
    /// The address of the instruction that runs next.
    pub pc: u32,
    pub(crate) n: u32,
    pub(crate) z: u32,
    pub(crate) c: bool,
    pub(crate) v: u32,
    /// Set: no exception with configurable priority is taken.
    pub primask: bool,
    /// The number of the exception being handled, 0 in Thread mode.
    pub ipsr: u8,
    on_process_stack: bool,
    other_sp: u32,
    lowest_main_sp: u32,
}

impl Default for Registers {
    fn default() -> Self {
        Self {
            r: [0; 16],
            pc: 0,
            n: 0,
            z: 1,
            c: false,
            v: 0,
            primask: false,
            ipsr: 0,
            on_process_stack: false,
            other_sp: 0,
            lowest_main_sp: u32::MAX,
        }
    }
}

impl Registers {
    /// Register `n`; for 15 the address of the next instruction.
    pub fn read(&self, n: u8) -> u32 {
        if n == PC { self.pc } else { self.get(n) }
    }

    /// Writes register `n` from outside; for 15 the address of the next instruction.
    pub fn write(&mut self, n: u8, value: u32) {
        match n {
            PC => self.pc = value & !1,
            SP => self.set_sp(value),
            _ => self.set(n, value),
        }
    }

    /// The flags as the top four bits of a word.
    pub fn apsr(&self) -> u32 {
        (self.n & 1 << 31) | u32::from(self.z == 0) << 30 | u32::from(self.c) << 29 | (self.v >> 31) << 28
    }

    /// The main stack pointer.
    pub fn msp(&self) -> u32 {
        if self.on_process_stack { self.other_sp } else { self.get(SP) }
    }

    /// The process stack pointer.
    pub fn psp(&self) -> u32 {
        if self.on_process_stack { self.get(SP) } else { self.other_sp }
    }

    /// The CONTROL register.
    pub fn control(&self) -> u32 {
        u32::from(self.on_process_stack) << 1
    }

    /// The lowest value the main stack pointer had since the last reset of this mark.
    pub fn lowest_main_sp(&self) -> u32 {
        self.lowest_main_sp
    }

    /// Starts the mark of the lowest main stack pointer anew.
    pub fn forget_lowest_sp(&mut self) {
        self.lowest_main_sp = self.msp();
    }

    pub(crate) fn restart(&mut self, stack: u32) {
        *self = Self::default();
        self.set(LR, u32::MAX);
        self.set_sp(stack);
    }

    #[inline(always)]
    pub(crate) fn get(&self, n: u8) -> u32 {
        self.r[usize::from(n & 15)]
    }

    #[inline(always)]
    pub(crate) fn set(&mut self, n: u8, value: u32) {
        self.r[usize::from(n & 15)] = value;
    }

    #[inline(always)]
    pub(crate) fn set_sp(&mut self, value: u32) {
        self.r[13] = value & !3;
        if !self.on_process_stack {
            self.lowest_main_sp = self.lowest_main_sp.min(self.r[13]);
        }
    }

    pub(crate) fn use_stack(&mut self, process: bool) {
        if self.on_process_stack != process {
            self.on_process_stack = process;
            std::mem::swap(&mut self.r[13], &mut self.other_sp);
        }
    }

    pub(crate) fn set_msp(&mut self, value: u32) {
        self.set_banked(false, value);
    }

    pub(crate) fn set_psp(&mut self, value: u32) {
        self.set_banked(true, value);
    }

    fn set_banked(&mut self, process: bool, value: u32) {
        let active = self.on_process_stack;
        self.use_stack(process);
        self.set_sp(value);
        self.use_stack(active);
    }

    /// Sets the flags from the top four bits of a word.
    pub fn set_apsr(&mut self, value: u32) {
        self.n = value;
        self.z = !value & 1 << 30;
        self.c = value & 1 << 29 != 0;
        self.v = value << 3;
    }

    #[inline(always)]
    pub(crate) fn set_nz(&mut self, result: u32) {
        self.n = result;
        self.z = result;
    }
}
