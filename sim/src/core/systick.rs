//! The 24-bit system timer.
//!
//! It is not stepped: its value is worked out from the cycle at which it last had a known one.
//!
//! What can go wrong: there is no reference clock, so the timer always counts core cycles and CLKSOURCE reads as one.

const ENABLE: u32 = 1;
const TICKINT: u32 = 2;
const CLKSOURCE: u32 = 4;
const COUNTFLAG: u32 = 1 << 16;
const MASK: u32 = 0x00FF_FFFF;
const NO_REFERENCE_CLOCK: u32 = 1 << 31;

/// SYST_CSR, SYST_RVR and SYST_CVR.
#[derive(Debug, Clone, Default)]
pub struct SysTick {
    control: u32,
    reload: u32,
    value: u32,
    since: u64,
    wrapped: bool,
    due: Option<u64>,
}

impl SysTick {
    /// The cycle at which the timer next reaches zero with its interrupt on; `u64::MAX` if never.
    pub fn next_event(&self) -> u64 {
        if self.control & TICKINT == 0 { u64::MAX } else { self.due.unwrap_or(u64::MAX) }
    }

    /// Counts on to `now`. Returns when the timer last reached zero on the way, if its interrupt is on.
    pub(crate) fn advance(&mut self, now: u64) -> Option<u64> {
        let first = self.due.filter(|&due| due <= now)?;
        let period = u64::from(self.reload) + 1;
        let last = if self.reload == 0 { first } else { first + (now - first) / period * period };
        self.wrapped = true;
        self.value = 0;
        self.since = last;
        self.schedule();
        (self.control & TICKINT != 0).then_some(last)
    }

    pub(crate) fn read(&mut self, register: u32, now: u64) -> u32 {
        match register {
            0x0 => {
                let flag = if std::mem::take(&mut self.wrapped) { COUNTFLAG } else { 0 };
                self.control | CLKSOURCE | flag
            }
            0x4 => self.reload,
            0x8 => self.value_at(now),
            _ => NO_REFERENCE_CLOCK,
        }
    }

    pub(crate) fn write(&mut self, register: u32, value: u32, now: u64) {
        self.value = self.value_at(now);
        self.since = now;
        match register {
            0x0 => self.control = value & (ENABLE | TICKINT),
            0x4 => self.reload = value & MASK,
            0x8 => {
                self.value = 0;
                self.wrapped = false;
            }
            _ => {}
        }
        self.schedule();
    }

    fn value_at(&self, now: u64) -> u32 {
        let elapsed = now - self.since;
        if self.control & ENABLE == 0 || elapsed == 0 {
            return self.value;
        }
        let until_zero = u64::from(self.value);
        if elapsed <= until_zero {
            return (until_zero - elapsed) as u32;
        }
        let period = u64::from(self.reload) + 1;
        match (elapsed - until_zero) % period {
            0 => 0,
            into => (period - into) as u32,
        }
    }

    fn schedule(&mut self) {
        self.due = match (self.control & ENABLE, self.value, self.reload) {
            (0, _, _) | (_, 0, 0) => None,
            (_, 0, reload) => Some(self.since + u64::from(reload) + 1),
            (_, value, _) => Some(self.since + u64::from(value)),
        };
    }
}
