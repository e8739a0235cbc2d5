//! How many cycles an instruction takes.
//!
//! The numbers are those of the Cortex-M0 Technical Reference Manual for memory without wait states.
//!
//! What can go wrong: the manual gives sixteen cycles from an interrupt to its handler and nothing for the way back;
//! [`EXCEPTION_RETURN`] and [`TAIL_CHAIN`] are estimates (eight words to load and a pipeline to fill; no words to
//! move). The sixteen cycles hold for every entry, as on a core built for zero jitter.

/// The multiplier a chip was built with.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Multiplier {
    /// One cycle.
    #[default]
    Fast,
    /// Thirty-two cycles.
    Small,
}

/// What the cycle counter counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Timing {
    /// The cycles of a Cortex-M0.
    CortexM0(Multiplier),
    /// One cycle for every instruction and none for exceptions, as QEMU's `-icount` counts.
    Uniform,
}

impl Default for Timing {
    fn default() -> Self {
        Self::CortexM0(Multiplier::Fast)
    }
}

pub(crate) const ALU: u32 = 1;
pub(crate) const BRANCH: u32 = 3;
pub(crate) const BRANCH_LINK: u32 = 4;
pub(crate) const LOAD_STORE: u32 = 2;
pub(crate) const SPECIAL_REGISTER: u32 = 4;
pub(crate) const BARRIER: u32 = 4;
pub(crate) const WAIT: u32 = 2;

/// Cycles from an interrupt being noticed to the first instruction of its handler, by the manual.
pub const EXCEPTION_ENTRY: u32 = 16;
/// Cycles from the end of the returning instruction to the instruction that was interrupted: an estimate, as above.
pub const EXCEPTION_RETURN: u32 = 10;
/// Cycles from the end of the returning instruction to the next handler, when the frame stays on the stack: an estimate,
/// as above.
pub const TAIL_CHAIN: u32 = 6;

pub(crate) const fn multiple(registers: u32) -> u32 {
    1 + registers
}

pub(crate) const fn pop_with_return(registers: u32) -> u32 {
    4 + registers
}

impl Timing {
    pub(crate) fn multiply(self) -> u32 {
        match self {
            Self::CortexM0(Multiplier::Small) => 32,
            _ => 1,
        }
    }

    pub(crate) fn instruction_cycles_limit(self) -> u32 {
        match self {
            Self::CortexM0(_) => u32::MAX,
            Self::Uniform => 1,
        }
    }

    pub(crate) fn exception(self, cycles: u32) -> u64 {
        match self {
            Self::CortexM0(_) => u64::from(cycles),
            Self::Uniform => 0,
        }
    }

    /// When, in its instruction, the data of transfer `beat` moves: one cycle after its address.
    pub(crate) fn data_phase(self, beat: u32) -> u32 {
        match self {
            Self::CortexM0(_) => 1 + beat,
            Self::Uniform => 0,
        }
    }
}
