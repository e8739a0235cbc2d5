//! The chip as RTIC and this binary see it: interrupt lines, vectors, and the registers touched.
//!
//! Addresses and bits are those of the SCuM-3C test code (`scm_v3c/memory_map.h`), lines those of its vector table
//! (`cm0dsasm.s:43-58`).
//!
//! What can go wrong: a wrong address. All addresses are here, and only here can a [`Reg`] be made.

use cortex_m::interrupt::InterruptNumber;
// Brings the vector table's head, the reset handler and the linker script.
use cortex_m_rt as _;

/// Two bits, so four priorities (`scum.h:10`).
pub const NVIC_PRIO_BITS: u8 = 2;

/// The interrupt lines.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(
    dead_code,
    non_camel_case_types,
    clippy::upper_case_acronyms,
    reason = "the chip's whole list, in its own words"
)]
#[repr(u16)]
pub enum Interrupt {
    /// A byte came in.
    UART = 0,
    /// Pin 3 is high, debounced.
    GPIO3 = 1,
    /// The optical receiver has 32 bits.
    OPTICAL_32 = 2,
    /// A conversion is done.
    ADC = 3,
    /// Not wired: pended by software.
    SOFT4 = 4,
    /// Not wired: pended by software.
    SOFT5 = 5,
    /// The radio controller.
    RF = 6,
    /// The radio timer.
    RFTIMER = 7,
    /// Raw chips: the start value was seen.
    RAWCHIPS_START = 8,
    /// Raw chips: 32 came in.
    RAWCHIPS_32 = 9,
    /// Not wired: pended by software.
    SOFT10 = 10,
    /// The optical receiver saw its start symbol.
    OPTICAL_SFD = 11,
    /// Pin 8 is high. Level sensitive.
    GPIO8 = 12,
    /// Pin 9 is low. Level sensitive.
    GPIO9 = 13,
    /// Pin 10 is low. Level sensitive.
    GPIO10 = 14,
    /// Not wired: pended by software.
    SOFT15 = 15,
}

pub use Interrupt as interrupt;

impl Interrupt {
    /// Its bit in the NVIC's registers.
    pub const fn bit(self) -> u32 {
        1 << self as u16
    }
}

// SAFETY: the discriminants are the line numbers of the chip, all below the 32 an M0 can have, and never change.
unsafe impl InterruptNumber for Interrupt {
    fn number(self) -> u16 {
        self as u16
    }
}

/// One entry of the vector table.
#[derive(Clone, Copy)]
#[repr(transparent)]
pub struct Vector(#[allow(dead_code, reason = "the core reads it, not the program")] unsafe extern "C" fn());

macro_rules! vectors {
    ($($name:ident),* $(,)?) => {
        unsafe extern "C" { $(fn $name();)* }

        /// The handlers of all lines, in the lines' order; `device.x` names the default of each.
        // SAFETY: the section is where link.x wants the device's vectors, and the name is the one it looks for.
        #[unsafe(link_section = ".vector_table.interrupts")]
        #[unsafe(no_mangle)]
        pub static __INTERRUPTS: [Vector; 16] = [$(Vector($name)),*];
    };
}

vectors!(
    UART,
    GPIO3,
    OPTICAL_32,
    ADC,
    SOFT4,
    SOFT5,
    RF,
    RFTIMER,
    RAWCHIPS_START,
    RAWCHIPS_32,
    SOFT10,
    OPTICAL_SFD,
    GPIO8,
    GPIO9,
    GPIO10,
    SOFT15,
);

/// One 32-bit register, its address in its type so that an access is one instruction on a constant.
#[derive(Clone, Copy)]
pub struct Reg<const ADDRESS: usize>(());

impl<const ADDRESS: usize> Reg<ADDRESS> {
    /// Reads it.
    #[inline(always)]
    pub fn read(self) -> u32 {
        // SAFETY: a `Reg` can only be made in this module, where every address is an implemented, aligned register
        // outside all memory that Rust owns; reading any of them as a word is allowed at any time.
        unsafe { (ADDRESS as *const u32).read_volatile() }
    }

    /// Writes it.
    #[inline(always)]
    pub fn write(self, value: u32) {
        // SAFETY: as for `read`. No value makes the chip write to memory: the receiver's DMA address is no `Reg`.
        unsafe { (ADDRESS as *mut u32).write_volatile(value) }
    }
}

/// What the programmer wrote behind the program: the last words of the code RAM (`lighthouse_app.c:26-27`).
pub mod image {
    use super::Reg;

    /// Bytes of the program from 0 on; 0 where no programmer wrote it.
    pub const LENGTH: Reg<0xfff8> = Reg(());
    /// Their CRC-32.
    pub const CRC: Reg<0xfffc> = Reg(());
}

/// The interrupt controller's registers that RTIC's own functions do not reach atomically enough (ARMv6-M ARM, B3.4).
pub mod nvic {
    use super::Reg;

    /// Writing ones enables lines; reads which are.
    pub const ISER: Reg<0xe000_e100> = Reg(());
    /// Writing ones disables lines.
    pub const ICER: Reg<0xe000_e180> = Reg(());
    /// Writing ones pends.
    pub const ISPR: Reg<0xe000_e200> = Reg(());
    /// Writing ones takes back what is pending.
    pub const ICPR: Reg<0xe000_e280> = Reg(());
}

/// The system control block (ARMv6-M ARM, B3.2.7).
pub mod scb {
    use super::Reg;

    /// How the core sleeps.
    pub const SCR: Reg<0xe000_ed10> = Reg(());

    /// A handler that would return to `idle` sleeps instead.
    pub const SLEEP_ON_EXIT: u32 = 1 << 1;
}

/// The core's own timer (ARMv6-M ARM, B3.3).
pub mod syst {
    use super::Reg;

    /// [`RUN`].
    pub const CSR: Reg<0xe000_e010> = Reg(());
    /// Where it starts down from.
    pub const RVR: Reg<0xe000_e014> = Reg(());

    /// Counting core cycles, with an interrupt at zero.
    pub const RUN: u32 = 7;
    /// 24 bits: 1.7 s at 10 MHz.
    pub const LONGEST: u32 = 0xff_ffff;
}

/// The radio controller (`memory_map.h:25-79`).
pub mod rf {
    use super::Reg;

    /// What to do: [`TX_LOAD`], [`TX_SEND`], [`RESET`].
    pub const CONTROL: Reg<0x4000_0000> = Reg(());
    /// Where the frame to load is.
    pub const TX_DATA_ADDR: Reg<0x4000_0008> = Reg(());
    /// Its bytes, FCS included.
    pub const TX_PACK_LEN: Reg<0x4000_000c> = Reg(());
    /// Which events happened.
    pub const INT: Reg<0x4000_0010> = Reg(());
    /// Which of them interrupt.
    pub const INT_CONFIG: Reg<0x4000_0014> = Reg(());
    /// Writing ones clears events.
    pub const INT_CLEAR: Reg<0x4000_0018> = Reg(());
    /// Writing ones clears errors.
    pub const ERROR_CLEAR: Reg<0x4000_0024> = Reg(());

    /// Copy the frame into the FIFO.
    pub const TX_LOAD: u32 = 0x01;
    /// Send what is in the FIFO.
    pub const TX_SEND: u32 = 0x02;
    /// Forget everything.
    pub const RESET: u32 = 0x10;
    /// The last chip has left (in [`INT`], [`INT_CONFIG`], [`INT_CLEAR`]).
    pub const TX_SEND_DONE: u32 = 0x04;
    /// All events.
    pub const ALL: u32 = 0x1f;
}

/// The radio timer (`memory_map.h:83-182`).
pub mod rftimer {
    use super::Reg;

    /// [`ENABLE`], [`INTERRUPT`], [`COUNT_RESET`].
    pub const CONTROL: Reg<0x4200_0000> = Reg(());
    /// The tick counter.
    pub const COUNTER: Reg<0x4200_0004> = Reg(());
    /// Where it wraps.
    pub const MAX_COUNT: Reg<0x4200_0008> = Reg(());
    /// First compare value.
    pub const COMPARE0: Reg<0x4200_0010> = Reg(());
    /// Second compare value.
    pub const COMPARE1: Reg<0x4200_0014> = Reg(());
    /// What a match of the first does.
    pub const COMPARE0_CONTROL: Reg<0x4200_0030> = Reg(());
    /// What a match of the second does.
    pub const COMPARE1_CONTROL: Reg<0x4200_0034> = Reg(());
    /// Which compares matched, bit n for compare n.
    pub const INT: Reg<0x4200_0070> = Reg(());
    /// Writing ones clears them.
    pub const INT_CLEAR: Reg<0x4200_0074> = Reg(());

    /// Count.
    pub const ENABLE: u32 = 1;
    /// Let compares interrupt.
    pub const INTERRUPT: u32 = 2;
    /// Start at zero.
    pub const COUNT_RESET: u32 = 4;
    /// A match counts at all.
    pub const COMPARE_ENABLE: u32 = 1;
    /// A match interrupts.
    pub const COMPARE_INTERRUPT: u32 = 2;
}

/// The serial port (`memory_map.h:194`).
pub mod uart {
    use super::Reg;

    /// One byte to send.
    pub const TX_DATA: Reg<0x5100_0000> = Reg(());
}

/// The analog configuration: 16 bits every 0x4_0000 bytes (`memory_map.h:204-236`).
pub mod analog {
    use super::Reg;

    /// The counters: [`COUNTERS_RESET`], [`COUNTERS_RUN`], [`COUNTERS_STOP`].
    pub const REG0: Reg<0x5200_0000> = Reg(());
    /// Counted edges of the 20 MHz oscillator; these read counters, not what was written.
    pub const COUNT_HF: Reg<0x5210_0000> = Reg(());
    /// Their upper half.
    pub const COUNT_HF_HIGH: Reg<0x5214_0000> = Reg(());
    /// Counted edges of the chip clock.
    pub const COUNT_2M: Reg<0x5218_0000> = Reg(());
    /// Their upper half.
    pub const COUNT_2M_HIGH: Reg<0x521c_0000> = Reg(());
    /// Counted edges of the radio's oscillator, divided by 960.
    pub const COUNT_LC: Reg<0x5228_0000> = Reg(());
    /// Their upper half.
    pub const COUNT_LC_HIGH: Reg<0x522c_0000> = Reg(());
    /// Oscillator of the radio: fine, mid, coarse.
    pub const REG7: Reg<0x521c_0000> = Reg(());
    /// Oscillator of the radio: the last bit of fine.
    pub const REG8: Reg<0x5220_0000> = Reg(());
    /// Supplies of the radio.
    pub const REG10: Reg<0x5228_0000> = Reg(());
    /// Source of the transmitted chips.
    pub const REG11: Reg<0x522c_0000> = Reg(());
    /// Mixers and polyphase filter.
    pub const REG16: Reg<0x5240_0000> = Reg(());
    /// The scan chain, bit by bit.
    pub const REG22: Reg<0x5258_0000> = Reg(());

    /// All counters to zero (`radio.c`).
    pub const COUNTERS_RESET: u32 = 0;
    /// All counters run.
    pub const COUNTERS_RUN: u32 = 0x3fff;
    /// All counters keep what they have.
    pub const COUNTERS_STOP: u32 = 0x7f;
}
