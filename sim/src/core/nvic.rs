//! The nested vectored interrupt controller: what is pending, enabled and active, and who goes first.
//!
//! All exceptions share one numbering, the manual's: 2 NMI, 3 HardFault, 11 SVCall, 14 PendSV, 15 SysTick and 16 + n
//! for external line n.
//!
//! What can go wrong: the lines are level sensitive. A line that is still high when its handler returns, or when its
//! pending bit is cleared outside its handler, pends again at once; a pulse shorter than one look at the lines stays
//! pending, as on silicon.

/// The number of the non-maskable interrupt (ARMv6-M ARM, B1.5.2, as all of these).
pub const NMI: u8 = 2;
/// The number of HardFault.
pub const HARD_FAULT: u8 = 3;
/// The number of the supervisor call.
pub const SVCALL: u8 = 11;
/// The number of the pendable service call.
pub const PENDSV: u8 = 14;
/// The number of the system timer.
pub const SYSTICK: u8 = 15;
/// The number of external line 0.
pub const FIRST_IRQ: u8 = 16;
/// How many exception numbers there are.
pub const EXCEPTIONS: usize = 48;

pub(crate) const HARD_FAULT_PRIORITY: i8 = -1;
const THREAD_PRIORITY: i8 = 4;
const PRIORITY_BITS: u32 = 2;

/// Pending, enabled and active exceptions with their priorities.
#[derive(Debug, Clone)]
pub struct Nvic {
    pending: u64,
    enabled: u64,
    active: u64,
    lines: u32,
    priority: [i8; EXCEPTIONS],
    pended_at: [u64; EXCEPTIONS],
    pended: bool,
}

impl Default for Nvic {
    fn default() -> Self {
        let mut priority = [0; EXCEPTIONS];
        priority[usize::from(NMI)] = -2;
        priority[usize::from(HARD_FAULT)] = HARD_FAULT_PRIORITY;
        Self {
            pending: 0,
            enabled: (1 << FIRST_IRQ) - 1,
            active: 0,
            lines: 0,
            priority,
            pended_at: [0; EXCEPTIONS],
            pended: false,
        }
    }
}

fn bit(number: u8) -> u64 {
    1 << number
}

fn numbers(mut set: u64) -> impl Iterator<Item = u8> {
    std::iter::from_fn(move || {
        let number = set.trailing_zeros();
        set &= set.wrapping_sub(1);
        (number < 64).then_some(number as u8)
    })
}

impl Nvic {
    /// Whether the exception is pending.
    pub fn is_pending(&self, number: u8) -> bool {
        self.pending & bit(number) != 0
    }

    /// The external lines whose interrupts are enabled.
    pub fn enabled_lines(&self) -> u32 {
        (self.enabled >> FIRST_IRQ) as u32
    }

    /// The external lines whose interrupts are pending.
    pub fn pending_lines(&self) -> u32 {
        (self.pending >> FIRST_IRQ) as u32
    }

    /// The priority that a newcomer must beat: 4 in Thread mode, down to -2.
    pub fn execution_priority(&self, primask: bool) -> i8 {
        let active = numbers(self.active).map(|n| self.priority_of(n)).min().unwrap_or(THREAD_PRIORITY);
        if primask { active.min(0) } else { active }
    }

    /// The priority of an exception, 0 to 3 from urgent to patient, negative when fixed.
    pub fn priority_of(&self, number: u8) -> i8 {
        self.priority[usize::from(number)]
    }

    /// Sets the priority of an exception that has a configurable one, 0 to 3 from urgent to patient.
    pub fn set_priority(&mut self, number: u8, level: i8) {
        if number > HARD_FAULT {
            self.priority[usize::from(number)] = level.clamp(0, THREAD_PRIORITY - 1);
        }
    }

    pub(crate) fn pend(&mut self, number: u8, cycle: u64) {
        self.pend_set(bit(number), cycle);
    }

    pub(crate) fn pend_lines(&mut self, lines: u32, cycle: u64) {
        self.pend_set(u64::from(lines) << FIRST_IRQ, cycle);
    }

    pub(crate) fn unpend(&mut self, number: u8) {
        self.pending &= !bit(number);
    }

    pub(crate) fn unpend_lines(&mut self, lines: u32, cycle: u64) {
        self.pending &= !(u64::from(lines) << FIRST_IRQ);
        self.sample(self.lines, cycle);
    }

    /// Enables external lines, as a write to ISER does.
    pub fn enable_lines(&mut self, lines: u32) {
        self.enabled |= u64::from(lines) << FIRST_IRQ;
    }

    pub(crate) fn disable_lines(&mut self, lines: u32) {
        self.enabled &= !(u64::from(lines) << FIRST_IRQ);
    }

    pub(crate) fn sample(&mut self, lines: u32, cycle: u64) {
        let active = (self.active >> FIRST_IRQ) as u32;
        let pending = (self.pending >> FIRST_IRQ) as u32;
        let news = (lines & !self.lines | lines & !active) & !pending;
        self.lines = lines;
        if news != 0 {
            self.pend_lines(news, cycle);
        }
    }

    fn pend_set(&mut self, set: u64, cycle: u64) {
        let news = set & !self.pending;
        for number in numbers(news) {
            self.pended_at[usize::from(number)] = cycle;
        }
        self.pending |= news;
        self.pended |= news != 0;
    }

    /// Whether anything became pending since the last question.
    pub(crate) fn take_pended(&mut self) -> bool {
        std::mem::take(&mut self.pended)
    }

    pub(crate) fn pended_at(&self, number: u8) -> u64 {
        self.pended_at[usize::from(number)]
    }

    /// The pending and enabled exception that goes first.
    pub(crate) fn first_pending(&self) -> Option<u8> {
        numbers(self.pending & self.enabled).min_by_key(|&n| self.priority_of(n))
    }

    /// The exception that is to be taken now.
    pub(crate) fn preempting(&self, primask: bool) -> Option<u8> {
        let first = self.first_pending()?;
        (self.priority_of(first) < self.execution_priority(primask)).then_some(first)
    }

    pub(crate) fn activate(&mut self, number: u8) {
        self.pending &= !bit(number);
        self.active |= bit(number);
    }

    pub(crate) fn deactivate(&mut self, number: u8, cycle: u64) {
        self.active &= !bit(number);
        self.sample(self.lines, cycle);
    }

    pub(crate) fn active_count(&self) -> u32 {
        self.active.count_ones()
    }

    /// Four priorities as their register shows them, the first exception in the lowest byte.
    pub(crate) fn read_priorities(&self, first: u8) -> u32 {
        (0..4).fold(0, |word, i| {
            let level = self.priority_of(first + i).max(0) as u32;
            word | level << (8 * u32::from(i) + 8 - PRIORITY_BITS)
        })
    }

    pub(crate) fn write_priorities(&mut self, first: u8, word: u32, implemented: u32) {
        for i in (0..4).filter(|i| implemented >> i & 1 != 0) {
            let level = word >> (8 * i + 8 - PRIORITY_BITS) & ((1 << PRIORITY_BITS) - 1);
            self.priority[usize::from(first) + i as usize] = level as i8;
        }
    }
}
