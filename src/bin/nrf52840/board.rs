//! What one board has and another has not: which pins, which receiver, which channel. To be edited.
//!
//! As it stands: an nRF52840 development kit (PCA10056) with a TS4231, wired as `docs/nrf52840.md` shows.
//!
//! What can go wrong: two channels of GPIOTE on one pin, which the product specification forbids (PS 6.10); so light is
//! brought to two pins, by a piece of wire.

use nrf_pac::gpio::{Gpio, regs::PinCnf, vals};

use crate::channel::Channel;

/// A pin.
#[derive(Clone, Copy)]
pub struct Pin {
    /// Port 1, not 0.
    pub port1: bool,
    /// 0 ..= 31 on port 0, 0 ..= 15 on port 1.
    pub number: u8,
}

/// The level of a line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(dead_code, reason = "a board has one receiver, and that has one level")]
pub enum Level {
    /// Near ground.
    Low,
    /// Near the supply.
    High,
}

/// What makes levels of light.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(dead_code, reason = "a board has one receiver")]
pub enum Receiver {
    /// A TS4231, its E at both light pins and its D at [`DATA`].
    Ts4231,
    /// A photodiode, an amplifier and a comparator, its output at both light pins.
    Comparator {
        /// The output in the light.
        lit: Level,
    },
}

impl Receiver {
    /// The level of the light pins in the light.
    pub const fn lit(self) -> Level {
        match self {
            Self::Ts4231 => Level::Low,
            Self::Comparator { lit } => lit,
        }
    }
}

/// The receiver of this board.
pub const RECEIVER: Receiver = Receiver::Ts4231;
/// Where the light's coming on is watched for: D8 of the kit's Arduino header. With a TS4231, E is driven from here.
///
/// Near the radio, for signals below 10 kHz only (PS, pin assignments): light changes 720 times a second.
pub const RISE: Pin = Pin { port1: true, number: 10 };
/// Where its going off is: D9 of the same header, wired to the same output.
pub const FALL: Pin = Pin { port1: true, number: 11 };
/// Where D of a TS4231 is: D7 of the same header, one of the pins that stand its megahertz.
pub const DATA: Pin = Pin { port1: true, number: 8 };
/// Frames are sent on this channel, unless a programmer said another.
pub const CHANNEL: Channel = match Channel::new(26) {
    Some(channel) => channel,
    None => panic!("channels are 11 ..= 26"),
};

impl Pin {
    /// The port's registers (PS 6.9).
    fn port(self) -> Gpio {
        if self.port1 { nrf_pac::P1 } else { nrf_pac::P0 }
    }

    /// Its bit in the port's registers.
    const fn bit(self) -> u32 {
        1 << self.number
    }

    /// Listens only, pulled by nobody: a TS4231 stands no pull of ours.
    pub fn release(self) {
        self.configure(vals::Dir::Input);
    }

    /// Drives it. The level is set first, so that the other one never shows.
    pub fn drive(self, level: Level) {
        match level {
            // OUTSET, OUTCLR: ones count, zeros do nothing (PS 6.9).
            Level::High => self.port().outset().write(|w| w.0 = self.bit()),
            Level::Low => self.port().outclr().write(|w| w.0 = self.bit()),
        }
        self.configure(vals::Dir::Output);
    }

    /// Whether it is high.
    pub fn is_high(self) -> bool {
        self.port().in_().read().0 & self.bit() != 0
    }

    /// PIN_CNF: direction, input buffer connected, no pull, standard drive, no sense (PS 6.9).
    fn configure(self, dir: vals::Dir) {
        let mut config = PinCnf(0);
        config.set_dir(dir);
        config.set_input(vals::Input::Connect);
        config.set_pull(vals::Pull::Disabled);
        config.set_drive(vals::Drive::S0s1);
        config.set_sense(vals::Sense::Disabled);
        self.port().pin_cnf(usize::from(self.number)).write_value(config);
    }
}
