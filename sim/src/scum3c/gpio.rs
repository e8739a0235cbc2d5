//! The pads: one optical signal in, sixteen outputs.
//!
//! The optical receiver drives pad 3, which is wired outside the chip to pads 8 and 9; one of those interrupts while
//! the light is on, the other while it is off. Both are level sensitive, so software makes edges of them by masking
//! one line and unmasking the other.
//!
//! What can go wrong: line 13 is active in the dark, which is most of the time. Software that unmasks it without
//! masking it again in the handler never returns to its main loop.

use std::collections::VecDeque;
use std::fmt;

/// Input pads, offset from the GPIO base (SCuM-3C test code, memory_map.h:18-21).
const INPUT: u32 = 0x00_0000;
/// Output pads (SCuM-3C test code, memory_map.h:190).
const OUTPUT: u32 = 0x04_0000;
/// Pads 3, 8 and 9: all three carry the optical signal on a lighthouse board.
const OPTICAL_PADS: u32 = 1 << 3 | 1 << 8 | 1 << 9;
/// The chip has sixteen pads.
const ALL_PADS: u32 = 0xFFFF;

/// Why an edge was not queued.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EdgeError {
    /// Not later than the edge queued before it.
    OutOfOrder {
        /// When the refused edge was to happen, in core cycles.
        cycle: u64,
        /// When the edge before it happens, in core cycles.
        previous: u64,
    },
    /// Earlier than the chip's present.
    InThePast {
        /// When the refused edge was to happen, in core cycles.
        cycle: u64,
        /// The chip's present, in core cycles.
        now: u64,
    },
}

impl fmt::Display for EdgeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::OutOfOrder { cycle, previous } => {
                write!(f, "edge at cycle {cycle} is not later than the one at {previous}")
            }
            Self::InThePast { cycle, now } => {
                write!(f, "edge at cycle {cycle} is before the present, {now}")
            }
        }
    }
}

impl std::error::Error for EdgeError {}

#[derive(Debug, Clone, Default)]
pub(super) struct Gpio {
    level: bool,
    output: u32,
    coming: VecDeque<(u64, bool)>,
    latest: Option<u64>,
}

impl Gpio {
    pub(super) fn push_edge(&mut self, cycle: u64, level: bool, now: u64) -> Result<(), EdgeError> {
        if let Some(previous) = self.latest.filter(|&previous| cycle <= previous) {
            return Err(EdgeError::OutOfOrder { cycle, previous });
        }
        if cycle < now {
            return Err(EdgeError::InThePast { cycle, now });
        }
        self.latest = Some(cycle);
        self.coming.push_back((cycle, level));
        Ok(())
    }

    pub(super) fn next_event(&self) -> u64 {
        self.coming.front().map_or(u64::MAX, |&(cycle, _)| cycle)
    }

    pub(super) fn advance(&mut self, cycle: u64) {
        while let Some((_, level)) = self.coming.pop_front_if(|&mut (at, _)| at <= cycle) {
            self.level = level;
        }
    }

    /// The optical level now.
    pub(super) fn level(&self) -> bool {
        self.level
    }

    pub(super) fn read(&self, offset: u32) -> Result<u32, &'static str> {
        match offset {
            INPUT => Ok(if self.level { OPTICAL_PADS } else { 0 }),
            OUTPUT => Ok(self.output),
            _ => Err("no GPIO register here"),
        }
    }

    pub(super) fn write(&mut self, offset: u32, value: u32) -> Result<(), &'static str> {
        match offset {
            INPUT => Err("the GPIO input register cannot be written"),
            OUTPUT => {
                self.output = value & ALL_PADS;
                Ok(())
            }
            _ => Err("no GPIO register here"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_edge_takes_effect_at_its_cycle_and_not_before() {
        let mut gpio = Gpio::default();
        gpio.push_edge(10, true, 0).unwrap();
        gpio.push_edge(12, false, 0).unwrap();
        gpio.advance(9);
        assert_eq!((gpio.level(), gpio.next_event()), (false, 10));
        gpio.advance(10);
        assert_eq!((gpio.level(), gpio.next_event()), (true, 12));
        assert_eq!(gpio.read(INPUT), Ok(0x308));
        gpio.advance(12);
        assert_eq!((gpio.level(), gpio.next_event()), (false, u64::MAX));
    }

    #[test]
    fn edges_out_of_order_or_in_the_past_are_refused() {
        let mut gpio = Gpio::default();
        gpio.push_edge(10, true, 0).unwrap();
        assert_eq!(gpio.push_edge(10, false, 0), Err(EdgeError::OutOfOrder { cycle: 10, previous: 10 }));
        gpio.advance(20);
        assert_eq!(gpio.push_edge(15, false, 20), Err(EdgeError::InThePast { cycle: 15, now: 20 }));
        gpio.push_edge(20, false, 20).unwrap();
        assert_eq!(gpio.next_event(), 20);
    }

    #[test]
    fn outputs_read_back_and_inputs_refuse_writes() {
        let mut gpio = Gpio::default();
        gpio.write(OUTPUT, 0xABCD_1234).unwrap();
        assert_eq!(gpio.read(OUTPUT), Ok(0x1234));
        assert!(gpio.write(INPUT, 1).is_err());
        assert!(gpio.read(0x08_0000).is_err());
    }
}
