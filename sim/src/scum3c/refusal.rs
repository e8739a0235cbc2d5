//! What a program tells the radio, or the analog part around it, that silicon would not do; and why.
//!
//! What can go wrong: silicon says nothing. These are reasons that this model knows.

use crate::bus::Dma;
use std::fmt;

/// A bit that has to be so.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Needed {
    /// Its number.
    pub bit: u16,
    /// Its value.
    pub value: bool,
    /// What it does.
    pub what: &'static str,
}

/// A code that has to be so.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NeededCode {
    /// The numbers of its bits, the lowest first.
    pub bits: &'static [u16],
    /// Those of the code's bits that mean the opposite.
    pub inverted: u32,
    /// Its value.
    pub value: u32,
    /// What it does.
    pub what: &'static str,
}

/// Something the radio was told to do and would not have done on silicon.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Refusal {
    /// When, in core cycles.
    pub cycle: u64,
    /// Why.
    pub why: Why,
}

/// Why the radio refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Why {
    /// TX_SEND with no packet loaded, or with the last one already sent.
    NotLoaded,
    /// TX_SEND while the packet is still being read from RAM.
    StillLoading,
    /// TX_LOAD with a length of 0 or more than 127 bytes.
    BadLength {
        /// What TX_PACK_LEN said.
        len: u32,
    },
    /// The packet is not, or not all, in data RAM.
    NotInRam {
        /// The packet asked for.
        dma: Dma,
    },
    /// The scan chain was never loaded.
    NotConfigured,
    /// The scan chain was loaded with too few bits shifted in, so that all of them stand elsewhere.
    ScanLength {
        /// How many there were.
        bits: u32,
    },
    /// The scan chain was loaded with a bit that is not as the lighthouse set-up needs it.
    ScanBit {
        /// The bit and what it should be.
        needed: Needed,
    },
    /// The scan chain was loaded with a supply or a current that is not as the lighthouse set-up needs it.
    ScanCode {
        /// The code and what it should be.
        needed: NeededCode,
        /// What it is.
        is: u32,
    },
    /// RX_START while ANALOG_CFG 10 does not have LO and IF on under software control (0x18, or 0x58 with the divider).
    NoReceiver {
        /// What it has.
        ldo: u16,
    },
    /// RX_START while ANALOG_CFG 16 does not have mixers and polyphase on (0x1).
    ReceiverOff {
        /// What it has.
        mixer: u16,
    },
    /// A frame is in the air.
    Sending,
    /// The receiver is running.
    Receiving,
    /// ANALOG_CFG 10 does not have LO and PA on under software control (0x28, or 0x68 with the divider).
    WrongLdos {
        /// What it has.
        ldo: u16,
    },
    /// ANALOG_CFG 16 does not have mixers and polyphase off (0x6).
    WrongMixers {
        /// What it has.
        mixer: u16,
    },
    /// ANALOG_CFG 11 does not have the 802.15.4 chips modulate the transmitter (0x80).
    NotModulated,
    /// Less than 50 us since the transmitter was switched on or tuned.
    NotSettled {
        /// How long it had, in core cycles.
        cycles: u64,
    },
    /// The transmitter was switched off, or its modulation, while a frame was in the air.
    CutOff,
    /// The LC tank was retuned while a frame was in the air.
    Retuned,
    /// The radio was reset while a frame was in the air.
    Reset,
}

impl Why {
    /// The register whose value or write was the reason, with its address.
    #[must_use]
    pub fn register(self) -> &'static str {
        match self {
            Self::NotLoaded
            | Self::StillLoading
            | Self::Sending
            | Self::Receiving
            | Self::NotSettled { .. }
            | Self::Reset => "RF CONTROL (0x40000000)",
            Self::BadLength { .. } => "RF TX_PACK_LEN (0x4000000c)",
            Self::NotInRam { .. } => "RF TX_DATA_ADDR (0x40000008)",
            Self::Retuned => "ANALOG_CFG 7, 8 (0x521c0000, 0x52200000)",
            Self::WrongLdos { .. } | Self::NoReceiver { .. } | Self::CutOff => "ANALOG_CFG 10 (0x52280000)",
            Self::NotModulated => "ANALOG_CFG 11 (0x522c0000)",
            Self::WrongMixers { .. } | Self::ReceiverOff { .. } => "ANALOG_CFG 16 (0x52400000)",
            Self::NotConfigured | Self::ScanLength { .. } | Self::ScanBit { .. } | Self::ScanCode { .. } => {
                "ANALOG_CFG 22 (0x52580000)"
            }
        }
    }
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "cycle {}: {}: {}", self.cycle, self.why.register(), self.why)
    }
}

impl fmt::Display for Why {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotLoaded => write!(f, "no packet is loaded"),
            Self::StillLoading => write!(f, "the packet is still being loaded"),
            Self::BadLength { len } => {
                write!(f, "a length of {len} bytes; 1 to 127 are possible")
            }
            Self::NotInRam { dma: Dma { address, len } } => {
                write!(f, "{len} bytes at {address:#010x} are not all in data RAM")
            }
            Self::NotConfigured => write!(f, "the scan chain was never loaded"),
            Self::ScanLength { bits } => write!(f, "the scan chain was loaded after {bits} bits, not 1216"),
            Self::ScanBit { needed: Needed { bit, value, what } } => {
                write!(f, "bit {bit} of the scan chain is not {}: {what}", u8::from(*value))
            }
            Self::ScanCode { needed: NeededCode { value, what, .. }, is } => {
                write!(f, "a code of the scan chain is {is}, not {value}: {what}")
            }
            Self::NoReceiver { ldo } => write!(f, "{ldo:#x}, not 0x18: LO and IF are not on"),
            Self::ReceiverOff { mixer } => write!(f, "{mixer:#x}, not 0x1: mixers and polyphase are not on"),
            Self::Sending => write!(f, "a frame is in the air"),
            Self::Receiving => write!(f, "the receiver is running"),
            Self::WrongLdos { ldo } => write!(f, "ANALOG_CFG 10 is {ldo:#x}, not 0x28: LO and PA are not on"),
            Self::WrongMixers { mixer } => write!(f, "ANALOG_CFG 16 is {mixer:#x}, not 0x6: the mixers are not off"),
            Self::NotModulated => write!(f, "ANALOG_CFG 11 has not selected the 802.15.4 modulation (0x80)"),
            Self::NotSettled { cycles } => {
                write!(f, "a start {cycles} cycles after switching on or tuning; 50 us are needed")
            }
            Self::CutOff => write!(f, "the transmitter was switched off in the middle of a frame"),
            Self::Retuned => write!(f, "the LC tank was retuned in the middle of a frame"),
            Self::Reset => write!(f, "the radio was reset in the middle of a frame"),
        }
    }
}
