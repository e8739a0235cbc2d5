//! The system control space: SysTick, NVIC and SCB registers from 0xE000_E000.
//!
//! What can go wrong: ARMv6-M has only word registers here; anything narrower faults instead of being UNPREDICTABLE.
//! Reserved words read as zero and ignore writes; the rest of the private peripheral bus is empty and faults.

use super::nvic::{NMI, PENDSV, SVCALL, SYSTICK};
use super::{Core, Halt};
use crate::bus::{BusFault, Size};

const CPUID_CORTEX_M0: u32 = 0x410C_C200;
const CCR_ALIGNMENT: u32 = 0x0000_0208;
const VECTKEY: u32 = 0x05FA;
const VECTKEYSTAT: u32 = 0xFA05_0000;
const SYSRESETREQ: u32 = 1 << 2;

impl Core {
    pub(super) fn read_system_control(&mut self, address: u32, size: Size, now: u64) -> Result<u32, BusFault> {
        let offset = offset(address, size)?;
        let nvic = &self.nvic;
        Ok(match offset {
            0x010..=0x01C => self.systick.read(offset - 0x010, now),
            0x100 | 0x180 => nvic.enabled_lines(),
            0x200 | 0x280 => nvic.pending_lines(),
            0x400..=0x41C => nvic.read_priorities((16 + offset - 0x400) as u8),
            0xD00 => CPUID_CORTEX_M0,
            0xD04 => self.read_icsr(),
            0xD0C => VECTKEYSTAT,
            0xD10 => {
                u32::from(self.sleep_on_exit) << 1
                    | u32::from(self.sleep_deep) << 2
                    | u32::from(self.event_on_pend) << 4
            }
            0xD14 => CCR_ALIGNMENT,
            0xD1C => nvic.read_priorities(8),
            0xD20 => nvic.read_priorities(12),
            0xD24 => u32::from(nvic.is_pending(SVCALL)) << 15,
            _ => 0,
        })
    }

    pub(super) fn write_system_control(
        &mut self,
        address: u32,
        size: Size,
        value: u32,
        now: u64,
    ) -> Result<(), BusFault> {
        let offset = offset(address, size)?;
        let nvic = &mut self.nvic;
        match offset {
            0x010..=0x01C => self.systick.write(offset - 0x010, value, now),
            0x100 => nvic.enable_lines(value),
            0x180 => nvic.disable_lines(value),
            0x200 => nvic.pend_lines(value, now),
            0x280 => nvic.unpend_lines(value, now),
            0x400..=0x41C => nvic.write_priorities((16 + offset - 0x400) as u8, value, 0b1111),
            0xD04 => self.write_icsr(value, now),
            0xD0C if value >> 16 == VECTKEY && value & SYSRESETREQ != 0 => self.halt(Halt::Reset),
            0xD10 => {
                self.sleep_on_exit = value & 1 << 1 != 0;
                self.sleep_deep = value & 1 << 2 != 0;
                self.event_on_pend = value & 1 << 4 != 0;
            }
            0xD1C => nvic.write_priorities(8, value, 0b1000),
            0xD20 => nvic.write_priorities(12, value, 0b1100),
            0xD24 if value & 1 << 15 != 0 => nvic.pend(SVCALL, now),
            0xD24 => nvic.unpend(SVCALL),
            _ => {}
        }
        Ok(())
    }

    fn read_icsr(&self) -> u32 {
        let nvic = &self.nvic;
        u32::from(self.registers.ipsr)
            | u32::from(nvic.first_pending().unwrap_or(0)) << 12
            | u32::from(nvic.pending_lines() != 0) << 22
            | u32::from(nvic.is_pending(SYSTICK)) << 26
            | u32::from(nvic.is_pending(PENDSV)) << 28
            | u32::from(nvic.is_pending(NMI)) << 31
    }

    fn write_icsr(&mut self, value: u32, now: u64) {
        let nvic = &mut self.nvic;
        let is_set = |n: u32| value >> n & 1 != 0;
        if is_set(31) {
            nvic.pend(NMI, now);
        }
        for (number, set, clear) in [(PENDSV, 28, 27), (SYSTICK, 26, 25)] {
            if is_set(set) {
                nvic.pend(number, now);
            } else if is_set(clear) {
                nvic.unpend(number);
            }
        }
    }
}

fn offset(address: u32, size: Size) -> Result<u32, BusFault> {
    let refuse = |why| Err(BusFault { address, why });
    match (address, size) {
        (0xE000_E000..=0xE000_EFFF, Size::Word) => Ok(address & 0xFFF),
        (0xE000_E000..=0xE000_EFFF, _) => refuse("the system control space has only word registers"),
        _ => refuse("nothing on the private peripheral bus at this address"),
    }
}
