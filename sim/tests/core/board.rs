//! A chip with the smallest device that can do harm: one register for the interrupt lines, and a timetable for them.

use sim::bus::{Bus, BusFault, Size};

/// Reads and writes the interrupt lines.
pub(crate) const LINES: u32 = 0x4000_0000;
/// Reads the cycle of the access.
pub(crate) const NOW: u32 = 0x4000_0004;
/// Keeps what is written to it.
pub(crate) const NOTES: u32 = 0x4000_0008;

#[derive(Default)]
pub(crate) struct Board {
    pub(crate) lines: u32,
    /// When the lines change by themselves, in order.
    pub(crate) timetable: Vec<(u64, u32)>,
    pub(crate) notes: Vec<u32>,
}

impl Bus for Board {
    fn read(&mut self, address: u32, _: Size, cycle: u64) -> Result<u32, BusFault> {
        match address {
            LINES => Ok(self.lines),
            NOW => Ok(cycle as u32),
            _ => Err(BusFault { address, why: "no such register" }),
        }
    }

    fn write(&mut self, address: u32, _: Size, value: u32, _: u64) -> Result<(), BusFault> {
        match address {
            LINES => self.lines = value,
            NOTES => self.notes.push(value),
            _ => {
                return Err(BusFault { address, why: "no such register" });
            }
        }
        Ok(())
    }

    fn lines(&self) -> u32 {
        self.lines
    }

    fn next_event(&self) -> u64 {
        self.timetable.first().map_or(u64::MAX, |&(cycle, _)| cycle)
    }

    fn advance(&mut self, cycle: u64) {
        while self.next_event() <= cycle {
            self.lines = self.timetable.remove(0).1;
        }
    }
}
