//! The UART, sending only: where logs leave.
//!
//! What can go wrong: it is not known whether the chip queues a byte that is written while another is on the wire, or
//! loses it. Every byte is taken, and those that came early are counted, so that a report can say how much of a log
//! rests on that.

/// Transmit data when written, received data when read (SCuM-3C test code, memory_map.h:18-21).
const DATA: u32 = 0;
/// Core cycles to send a byte: 10 bits at 38,400 baud with HCLK at 10 MHz. The baud rate is divided from HCLK, so the
/// number holds at any clock (19,200 baud at 5 MHz).
const BYTE_CYCLES: u64 = 10 * 10_000_000 / 38_400;

#[derive(Debug, Clone, Default)]
pub(super) struct Uart {
    sent: Vec<u8>,
    idle_at: u64,
    early: u64,
}

impl Uart {
    pub(super) fn take(&mut self) -> Vec<u8> {
        std::mem::take(&mut self.sent)
    }

    /// Bytes written while another was still on the wire.
    pub(super) fn early(&self) -> u64 {
        self.early
    }

    pub(super) fn read(&self, offset: u32) -> Result<u32, &'static str> {
        match offset {
            DATA => Err("nothing is ever received by the simulated UART"),
            _ => Err("no UART register here"),
        }
    }

    pub(super) fn write(&mut self, offset: u32, value: u32, cycle: u64) -> Result<(), &'static str> {
        if offset != DATA {
            return Err("no UART register here");
        }
        if cycle < self.idle_at {
            self.early += 1;
        }
        self.idle_at = cycle.max(self.idle_at).saturating_add(BYTE_CYCLES);
        self.sent.push(value as u8);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_come_out_in_order_and_once() {
        let mut uart = Uart::default();
        for (at, byte) in (0..).zip(*b"log") {
            uart.write(DATA, u32::from(byte), at * BYTE_CYCLES).unwrap();
        }
        assert_eq!(uart.take(), b"log");
        assert!(uart.take().is_empty());
        assert_eq!(uart.early(), 0);
    }

    #[test]
    fn bytes_faster_than_the_wire_are_kept_and_counted() {
        let mut uart = Uart::default();
        for byte in 0..3 {
            uart.write(DATA, byte, 0).unwrap();
        }
        uart.write(DATA, 3, 3 * BYTE_CYCLES).unwrap();
        assert_eq!(uart.take(), [0, 1, 2, 3]);
        assert_eq!(uart.early(), 2);
    }

    #[test]
    fn receiving_is_a_fault() {
        assert!(Uart::default().read(DATA).is_err());
        assert!(Uart::default().read(4).is_err());
    }
}
