//! Frames out of the serial port, where other boards have a radio.
//!
//! What can go wrong: nobody listens; nobody notices.

use nrf_pac::UART0;
use nrf_pac::uart::vals::{Baudrate, Enable};

use crate::mote::bytes::Bytes;

pub struct Serial {
    bytes: Bytes,
    busy: bool,
}

impl Serial {
    pub fn start(bytes: Bytes) -> Self {
        UART0.pseltxd().write_value(24);
        UART0.baudrate().write(|w| w.set_baudrate(Baudrate::Baud1m));
        UART0.enable().write(|w| w.set_enable(Enable::Enabled));
        UART0.intenset().write(|w| w.set_txdrdy(true));
        UART0.tasks_starttx().write_value(1);
        Self { bytes, busy: false }
    }

    /// A frame has come, or a byte has gone.
    pub fn step(&mut self) {
        if self.busy && UART0.events_txdrdy().read() == 0 {
            return;
        }
        UART0.events_txdrdy().write_value(0);
        self.busy = self.bytes.next().map(|byte| UART0.txd().write(|w| w.set_txd(byte))).is_some();
    }
}
