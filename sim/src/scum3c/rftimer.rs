//! The radio timer: the clock every light edge is stamped with.
//!
//! A 32-bit counter, eight compares that interrupt or drive the radio, four captures that the radio or software
//! trigger. No pad can trigger a capture, so software stamps edges by reading COUNTER.
//!
//! # Design
//! The counter is never stepped. It is known at one cycle, `base_cycle`, and computed from there when asked; a write
//! moves the base. A match is an event at a known cycle, so every access costs the same however long the timer ran.
//!
//! # Note
//! Where the public sources are silent, this is what the model does:
//! - A match happens on a tick that brings the counter to the compare value. Writing COMPARE or COUNTER so that they
//!   are equal is no match; the counter must come round again. The chip's users keep 5 ticks of margin
//!   (SCuM-3C test code, rftimer.c:9).
//! - A counter above MAX goes to 0 on its next tick.
//! - An interrupt flag is latched only if its unit's interrupt is enabled at that moment. Software that polls INT must
//!   enable it there too.
//! - A capture while its flag is still set overwrites the captured value and sets the overflow flag as well.
//! - Reserved bits are ignored when written and read as zero; unlisted registers fault.

const CONTROL: u32 = 0x00;
const COUNTER: u32 = 0x04;
const MAX: u32 = 0x08;
const COMPARE: u32 = 0x10;
const COMPARE_LAST: u32 = 0x2C;
const COMPARE_CONTROL: u32 = 0x30;
const COMPARE_CONTROL_LAST: u32 = 0x4C;
const CAPTURE: u32 = 0x50;
const CAPTURE_LAST: u32 = 0x5C;
const CAPTURE_CONTROL: u32 = 0x60;
const CAPTURE_CONTROL_LAST: u32 = 0x6C;
const INT: u32 = 0x70;
const INT_CLEAR: u32 = 0x74;

/// Bits of CONTROL (SCuM-3C test code, memory_map.h:83-182).
const ENABLE: u32 = 0x1;
const INTERRUPT: u32 = 0x2;
const COUNT_RESET: u32 = 0x4;

/// Bits of COMPARE_CTRL (SCuM-3C test code, memory_map.h:83-182).
const COMPARE_ENABLE: u32 = 0x01;
const COMPARE_INTERRUPT: u32 = 0x02;
const COMPARE_ACTIONS: u32 = 0x3C;
/// TX_LOAD, TX_SEND, RX_START, RX_STOP have the order of the radio's own CONTROL bits, this many places up.
const COMPARE_ACTIONS_SHIFT: u32 = 2;

/// Bits of CAPTURE_CTRL (SCuM-3C test code, memory_map.h:150-157).
const CAPTURE_INTERRUPT: u32 = 0x01;
const CAPTURE_SOFTWARE: u32 = 0x02;
/// The radio's five events have the order of its own INT bits, this many places up.
const CAPTURE_RADIO_SHIFT: u32 = 2;
const CAPTURE_RADIO: u32 = 0x1F;
const CAPTURE_NOW: u32 = 0x80;
const CAPTURE_KEPT: u32 = 0x7F;

/// Where the flags begin in INT (SCuM-3C test code, memory_map.h:83-182).
const CAPTURE_FLAGS: u32 = 8;
const OVERFLOW_FLAGS: u32 = 12;

/// How fast the radio timer counts: ticks per core cycles, at most one per cycle, for its clock cannot exceed HCLK.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Ratio {
    ticks: u32,
    cycles: u32,
}

impl Ratio {
    /// A tick every core cycle: the lighthouse set-up, both clocks divided from HF to 10 MHz.
    pub const ONE: Self = Self { ticks: 1, cycles: 1 };

    /// `ticks` every `cycles` core cycles; `None` if either is zero or there are more ticks than cycles.
    pub const fn new(ticks: u32, cycles: u32) -> Option<Self> {
        if ticks == 0 || ticks > cycles {
            return None;
        }
        Some(Self { ticks, cycles })
    }

    /// Ticks since power-on at `cycle`.
    fn ticks_at(self, cycle: u64) -> u64 {
        if self.ticks == self.cycles {
            return cycle;
        }
        // At most `cycle`, because there are never more ticks than cycles.
        (u128::from(cycle) * u128::from(self.ticks) / u128::from(self.cycles)) as u64
    }

    /// The first cycle at which `ticks` have passed since power-on; `u64::MAX` if that is beyond counting.
    fn cycle_of(self, ticks: u128) -> u64 {
        let cycle = (ticks * u128::from(self.cycles)).div_ceil(u128::from(self.ticks));
        u64::try_from(cycle).unwrap_or(u64::MAX)
    }
}

#[derive(Debug, Clone, Copy, Default)]
struct Unit {
    value: u32,
    control: u32,
}

#[derive(Debug, Clone)]
pub(super) struct RfTimer {
    ratio: Ratio,
    enabled: bool,
    interrupt: bool,
    base_cycle: u64,
    base_counter: u32,
    max: u32,
    compares: [Unit; 8],
    captures: [Unit; 4],
    flags: u32,
}

impl RfTimer {
    pub(super) fn new(ratio: Ratio) -> Self {
        Self {
            ratio,
            enabled: false,
            interrupt: false,
            base_cycle: 0,
            base_counter: 0,
            max: u32::MAX,
            compares: [Unit::default(); 8],
            captures: [Unit::default(); 4],
            flags: 0,
        }
    }

    pub(super) fn line(&self) -> bool {
        self.interrupt && self.flags != 0
    }

    fn period(&self) -> u64 {
        u64::from(self.max) + 1
    }

    fn counter(&self, cycle: u64) -> u32 {
        if !self.enabled {
            return self.base_counter;
        }
        let ticks = self.ratio.ticks_at(cycle).saturating_sub(self.ratio.ticks_at(self.base_cycle));
        let period = self.period();
        let counter = match ticks {
            0 => return self.base_counter,
            _ if self.base_counter > self.max => (ticks - 1) % period,
            _ => (u64::from(self.base_counter) + ticks % period) % period,
        };
        counter as u32
    }

    /// As if the counter had been started `ticks` earlier: it and the alarms that are set stand that much higher.
    pub(super) fn age(&mut self, ticks: u32, cycle: u64) {
        self.rebase(cycle);
        self.base_counter = self.base_counter.wrapping_add(ticks);
        for compare in &mut self.compares {
            compare.value = compare.value.wrapping_add(ticks);
        }
    }

    /// Stops the counter where it is, whatever it is told, until it is let go.
    pub(super) fn hold(&mut self, held: bool, cycle: u64) {
        self.rebase(cycle);
        self.enabled = !held;
    }

    fn rebase(&mut self, cycle: u64) {
        self.base_counter = self.counter(cycle);
        self.base_cycle = cycle;
    }

    /// When compare `index` next does something that can be seen; `u64::MAX` if it will not.
    fn match_at(&self, index: usize) -> u64 {
        let Unit { value, control } = self.compares[index];
        let flags = control & COMPARE_INTERRUPT != 0 && self.flags & (1 << index) == 0;
        let acts = control & COMPARE_ACTIONS != 0;
        if !self.enabled || control & COMPARE_ENABLE == 0 || !(flags || acts) || value > self.max {
            return u64::MAX;
        }
        let ticks = if self.base_counter > self.max {
            u64::from(value) + 1
        } else if value > self.base_counter {
            u64::from(value - self.base_counter)
        } else {
            self.period() - u64::from(self.base_counter - value)
        };
        self.ratio.cycle_of(u128::from(self.ratio.ticks_at(self.base_cycle)) + u128::from(ticks))
    }

    pub(super) fn next_event(&self) -> u64 {
        if !self.enabled {
            return u64::MAX;
        }
        (0..self.compares.len()).map(|index| self.match_at(index)).min().unwrap_or(u64::MAX)
    }

    /// Lets the matches at `cycle` happen; the radio's CONTROL bits that they set.
    pub(super) fn fire(&mut self, cycle: u64) -> u32 {
        let mut actions = 0;
        for index in 0..self.compares.len() {
            if self.match_at(index) == cycle {
                let control = self.compares[index].control;
                actions |= (control & COMPARE_ACTIONS) >> COMPARE_ACTIONS_SHIFT;
                if control & COMPARE_INTERRUPT != 0 {
                    self.flags |= 1 << index;
                }
            }
        }
        self.rebase(cycle);
        actions
    }

    fn capture(&mut self, index: usize, cycle: u64) {
        self.captures[index].value = self.counter(cycle);
        if self.captures[index].control & CAPTURE_INTERRUPT != 0 {
            let flag = 1 << CAPTURE_FLAGS << index;
            if self.flags & flag != 0 {
                self.flags |= 1 << OVERFLOW_FLAGS << index;
            }
            self.flags |= flag;
        }
    }

    /// The radio's events, in the order of its INT bits, as they reach the capture units.
    pub(super) fn radio_events(&mut self, events: u32, cycle: u64) {
        for index in 0..self.captures.len() {
            if self.captures[index].control >> CAPTURE_RADIO_SHIFT & CAPTURE_RADIO & events != 0 {
                self.capture(index, cycle);
            }
        }
    }

    pub(super) fn read(&self, offset: u32, cycle: u64) -> Result<u32, &'static str> {
        if !offset.is_multiple_of(4) {
            return Err("RFTIMER registers are words");
        }
        match offset {
            CONTROL => Ok((u32::from(self.enabled) * ENABLE) | (u32::from(self.interrupt) * INTERRUPT)),
            COUNTER => Ok(self.counter(cycle)),
            MAX => Ok(self.max),
            COMPARE..=COMPARE_LAST => Ok(self.compares[word(offset - COMPARE)].value),
            COMPARE_CONTROL..=COMPARE_CONTROL_LAST => Ok(self.compares[word(offset - COMPARE_CONTROL)].control),
            CAPTURE..=CAPTURE_LAST => Ok(self.captures[word(offset - CAPTURE)].value),
            CAPTURE_CONTROL..=CAPTURE_CONTROL_LAST => Ok(self.captures[word(offset - CAPTURE_CONTROL)].control),
            INT => Ok(self.flags),
            INT_CLEAR => Err("RFTIMER INT_CLEAR can only be written"),
            _ => Err("no RFTIMER register here"),
        }
    }

    pub(super) fn write(&mut self, offset: u32, value: u32, cycle: u64) -> Result<(), &'static str> {
        if !offset.is_multiple_of(4) {
            return Err("RFTIMER registers are words");
        }
        self.rebase(cycle);
        match offset {
            CONTROL => {
                self.enabled = value & ENABLE != 0;
                self.interrupt = value & INTERRUPT != 0;
                if value & COUNT_RESET != 0 {
                    self.base_counter = 0;
                }
            }
            COUNTER => self.base_counter = value,
            MAX => self.max = value,
            COMPARE..=COMPARE_LAST => self.compares[word(offset - COMPARE)].value = value,
            COMPARE_CONTROL..=COMPARE_CONTROL_LAST => {
                self.compares[word(offset - COMPARE_CONTROL)].control =
                    value & (COMPARE_ENABLE | COMPARE_INTERRUPT | COMPARE_ACTIONS);
            }
            CAPTURE..=CAPTURE_LAST => return Err("RFTIMER captures cannot be written"),
            CAPTURE_CONTROL..=CAPTURE_CONTROL_LAST => {
                let index = word(offset - CAPTURE_CONTROL);
                self.captures[index].control = value & CAPTURE_KEPT;
                if value & CAPTURE_NOW != 0 && value & CAPTURE_SOFTWARE != 0 {
                    self.capture(index, cycle);
                }
            }
            INT => return Err("RFTIMER INT cannot be written; write INT_CLEAR"),
            INT_CLEAR => self.flags &= !value,
            _ => return Err("no RFTIMER register here"),
        }
        Ok(())
    }
}

/// The index of a register in its row. The caller's ranges keep it inside the row.
fn word(offset: u32) -> usize {
    (offset / 4) as usize
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn running(ratio: Ratio, max: u32) -> RfTimer {
        let mut timer = RfTimer::new(ratio);
        timer.write(MAX, max, 0).unwrap();
        timer.write(CONTROL, ENABLE | INTERRUPT | COUNT_RESET, 0).unwrap();
        timer
    }

    #[test]
    fn the_counter_follows_core_cycles_in_the_lighthouse_set_up() {
        let timer = running(Ratio::ONE, u32::MAX);
        assert_eq!(timer.read(COUNTER, 83_333), Ok(83_333));
        assert_eq!(timer.read(COUNTER, (1 << 32) + 5), Ok(5));
    }

    #[test]
    fn a_slower_counter_ticks_at_the_exact_fraction() {
        let timer = running(Ratio::new(1, 10).unwrap(), u32::MAX);
        assert_eq!(timer.read(COUNTER, 9), Ok(0));
        assert_eq!(timer.read(COUNTER, 10), Ok(1));
        assert_eq!(timer.read(COUNTER, 10_000_009), Ok(1_000_000));
    }

    #[test]
    fn a_ratio_above_one_or_of_nothing_is_refused() {
        assert_eq!(Ratio::new(2, 1), None);
        assert_eq!(Ratio::new(0, 1), None);
        assert_eq!(Ratio::new(0, 0), None);
    }

    #[test]
    fn the_counter_wraps_after_max() {
        let timer = running(Ratio::ONE, 9);
        assert_eq!(timer.read(COUNTER, 9), Ok(9));
        assert_eq!(timer.read(COUNTER, 10), Ok(0));
        assert_eq!(timer.read(COUNTER, 1_000_000_000_003), Ok(3));
    }

    #[test]
    fn the_counter_can_be_written_and_stopped() {
        let mut timer = running(Ratio::ONE, u32::MAX);
        timer.write(COUNTER, 100, 50).unwrap();
        assert_eq!(timer.read(COUNTER, 53), Ok(103));
        timer.write(CONTROL, 0, 60).unwrap();
        assert_eq!(timer.read(COUNTER, 1_000), Ok(110));
        assert_eq!(timer.next_event(), u64::MAX);
    }

    #[test]
    fn a_compare_interrupts_at_its_cycle_until_it_is_cleared() {
        let mut timer = running(Ratio::ONE, u32::MAX);
        timer.write(COMPARE + 4, 500, 10).unwrap();
        timer.write(COMPARE_CONTROL + 4, COMPARE_ENABLE | COMPARE_INTERRUPT, 11).unwrap();
        assert_eq!(timer.next_event(), 500);
        assert_eq!(timer.fire(500), 0);
        assert!(timer.line());
        assert_eq!(timer.read(INT, 501), Ok(2));
        assert_eq!(timer.next_event(), u64::MAX);
        timer.write(INT_CLEAR, 2, 600).unwrap();
        assert!(!timer.line());
        assert_eq!(timer.next_event(), (1 << 32) + 500);
    }

    #[test]
    fn a_compare_beyond_max_never_matches() {
        let mut timer = running(Ratio::ONE, 99);
        timer.write(COMPARE, 100, 0).unwrap();
        timer.write(COMPARE_CONTROL, COMPARE_ENABLE | COMPARE_INTERRUPT, 0).unwrap();
        assert_eq!(timer.next_event(), u64::MAX);
    }

    #[test]
    fn a_compare_drives_the_radio_every_period() {
        let mut timer = running(Ratio::ONE, 99);
        timer.write(COMPARE, 7, 0).unwrap();
        timer.write(COMPARE_CONTROL, COMPARE_ENABLE | 0x8, 0).unwrap();
        for cycle in [7, 107, 207] {
            assert_eq!(timer.next_event(), cycle);
            assert_eq!(timer.fire(cycle), 0x2);
        }
    }

    #[test]
    fn software_captures_the_counter_and_a_second_capture_overflows() {
        let mut timer = running(Ratio::ONE, u32::MAX);
        let now = CAPTURE_INTERRUPT | CAPTURE_SOFTWARE | CAPTURE_NOW;
        timer.write(CAPTURE_CONTROL + 8, now, 40).unwrap();
        assert_eq!(timer.read(CAPTURE + 8, 99), Ok(40));
        assert_eq!(timer.read(INT, 99), Ok(0x400));
        timer.write(CAPTURE_CONTROL + 8, now, 70).unwrap();
        assert_eq!(timer.read(CAPTURE + 8, 99), Ok(70));
        assert_eq!(timer.read(INT, 99), Ok(0x4400));
    }

    #[test]
    fn a_radio_event_captures_only_where_it_is_selected() {
        let mut timer = running(Ratio::ONE, u32::MAX);
        timer.write(CAPTURE_CONTROL, 0x9, 0).unwrap();
        timer.write(CAPTURE_CONTROL + 4, 0x11, 0).unwrap();
        timer.radio_events(0x2, 1_600);
        assert_eq!(timer.read(CAPTURE, 2_000), Ok(1_600));
        assert_eq!(timer.read(CAPTURE + 4, 2_000), Ok(0));
        assert_eq!(timer.read(INT, 2_000), Ok(0x100));
    }

    #[test]
    fn holes_and_forbidden_directions_fault() {
        let mut timer = running(Ratio::ONE, u32::MAX);
        for offset in [0x0C, 0x78, 0x02, 0xFFFF_FFFC] {
            assert!(timer.read(offset, 0).is_err());
            assert!(timer.write(offset, 0, 0).is_err());
        }
        assert!(timer.read(INT_CLEAR, 0).is_err());
        assert!(timer.write(INT, 0, 0).is_err());
        assert!(timer.write(CAPTURE, 0, 0).is_err());
    }

    /// The same timer stepped cycle by cycle, with nothing clever about it.
    struct Stepped {
        ratio: Ratio,
        phase: u32,
        control: u32,
        counter: u32,
        max: u32,
        compares: [Unit; 8],
        flags: u32,
        actions: u32,
    }

    impl Stepped {
        fn step(&mut self) {
            self.phase += self.ratio.ticks;
            let tick = self.phase >= self.ratio.cycles;
            if tick {
                self.phase -= self.ratio.cycles;
            }
            if !tick || self.control & ENABLE == 0 {
                return;
            }
            self.counter = if self.counter >= self.max { 0 } else { self.counter + 1 };
            for (index, compare) in self.compares.iter().enumerate() {
                if compare.control & COMPARE_ENABLE != 0 && compare.value == self.counter {
                    self.actions += (compare.control & COMPARE_ACTIONS) >> COMPARE_ACTIONS_SHIFT;
                    if compare.control & COMPARE_INTERRUPT != 0 {
                        self.flags |= 1 << index;
                    }
                }
            }
        }

        fn write(&mut self, offset: u32, value: u32) {
            match offset {
                CONTROL => {
                    self.control = value;
                    if value & COUNT_RESET != 0 {
                        self.counter = 0;
                    }
                }
                COUNTER => self.counter = value,
                MAX => self.max = value,
                COMPARE..=COMPARE_LAST => self.compares[word(offset - COMPARE)].value = value,
                COMPARE_CONTROL..=COMPARE_CONTROL_LAST => {
                    self.compares[word(offset - COMPARE_CONTROL)].control = value;
                }
                _ => self.flags &= !value,
            }
        }
    }

    fn small_write() -> impl Strategy<Value = (u64, u32, u32)> {
        let value = prop_oneof![0_u32..24, 0_u32..64, (u32::MAX - 8)..=u32::MAX];
        let register = prop_oneof![
            (Just(CONTROL), (0_u32..8).prop_map(|bits| bits | ENABLE)),
            (Just(CONTROL), 0_u32..8),
            (Just(COUNTER), value.clone()),
            (Just(MAX), value.clone()),
            (Just(COMPARE), value.clone()),
            (Just(COMPARE_LAST), value),
            (Just(COMPARE_CONTROL), 0_u32..0x40),
            (Just(COMPARE_CONTROL_LAST), 0_u32..0x40),
            (Just(INT_CLEAR), Just(u32::MAX)),
        ];
        (0_u64..60, register).prop_map(|(wait, (offset, value))| (wait, offset, value))
    }

    proptest! {
        #[test]
        fn the_computed_timer_agrees_with_one_stepped_cycle_by_cycle(
            (ticks, cycles) in (1_u32..8, 1_u32..8).prop_filter("at most one", |(t, c)| t <= c),
            writes in proptest::collection::vec(small_write(), 1..40),
        ) {
            let ratio = Ratio::new(ticks, cycles).unwrap();
            let mut timer = RfTimer::new(ratio);
            let mut stepped = Stepped {
                ratio,
                phase: 0,
                control: 0,
                counter: 0,
                max: u32::MAX,
                compares: [Unit::default(); 8],
                flags: 0,
                actions: 0,
            };
            let mut cycle = 0_u64;
            let mut actions = 0;
            for (wait, offset, value) in writes {
                for _ in 0..wait {
                    cycle += 1;
                    stepped.step();
                    let due = timer.next_event();
                    prop_assert!(due >= cycle, "an event at {due} was missed by {cycle}");
                    if due == cycle {
                        for index in 0..timer.compares.len() {
                            if timer.match_at(index) == cycle {
                                actions += (timer.compares[index].control & COMPARE_ACTIONS) >> COMPARE_ACTIONS_SHIFT;
                            }
                        }
                        timer.fire(cycle);
                    }
                    prop_assert_eq!(timer.read(COUNTER, cycle), Ok(stepped.counter));
                    prop_assert_eq!(timer.read(INT, cycle), Ok(stepped.flags));
                    prop_assert_eq!(timer.line(), stepped.control & INTERRUPT != 0 && stepped.flags != 0);
                    prop_assert_eq!(actions, stepped.actions);
                }
                timer.write(offset, value, cycle).unwrap();
                stepped.write(offset, value);
            }
        }
    }
}
