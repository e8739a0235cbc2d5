//! What the core sees of the chip around it.
//!
//! Code RAM, data RAM and the system control space live in the machine, where they are fast; everything else is a
//! device behind this trait. A device is only ever told the time in whole core cycles since power-on.
//!
//! What can go wrong: an access nobody owns is a `BusFault`, which the core turns into a HardFault and the machine
//! reports with address and program counter; nothing is read as zero in silence.

/// The width of one access.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Size {
    /// 8 bits.
    Byte,
    /// 16 bits.
    Half,
    /// 32 bits.
    Word,
}

/// Nobody answers at this address, or not in this width.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BusFault {
    /// The address of the access.
    pub address: u32,
    /// What the device objects to, for a person to read.
    pub why: &'static str,
}

/// A stretch of memory that a device wants to read by itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Dma {
    /// Where it begins.
    pub address: u32,
    /// How many bytes it has.
    pub len: u32,
}

/// The devices of a chip: memory-mapped registers, interrupt lines, and their own future.
pub trait Bus {
    /// Reads a register at `cycle`.
    ///
    /// # Errors
    /// Nobody answers there, or not in this width, or what the chip would do is not known.
    fn read(&mut self, address: u32, size: Size, cycle: u64) -> Result<u32, BusFault>;

    /// Writes a register at `cycle`.
    ///
    /// # Errors
    /// As for [`Bus::read`].
    fn write(&mut self, address: u32, size: Size, value: u32, cycle: u64) -> Result<(), BusFault>;

    /// The levels of the 32 external interrupt lines now, bit n for IRQ n. A line that is high keeps its interrupt
    /// pending (level sensitive). Asked again after every register access and every `advance`.
    fn lines(&self) -> u32;

    /// The cycle at which a device next changes by itself (an edge arrives, a timer matches, a packet ends);
    /// `u64::MAX` when nothing will.
    fn next_event(&self) -> u64;

    /// Lets every event due at or before `cycle` happen.
    fn advance(&mut self, cycle: u64);

    /// What a device wants to read from the machine's memory, asked after every register access and every `advance`,
    /// and handed out once.
    fn take_dma(&mut self) -> Option<Dma> {
        None
    }

    /// The bytes it asked for; fewer mean that they are not all in memory.
    fn give_dma(&mut self, _bytes: &[u8]) {}
}
