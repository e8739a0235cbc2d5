//! Code RAM and data RAM, and the decoded form of what is in them.
//!
//! What can go wrong: code memory is RAM and can be written while it runs, so a write there forgets what was decoded.
//! Code in data RAM runs too, but is decoded at every step.

use crate::core::decode::{Op, decode, is_wide};

/// Where data RAM begins.
pub const DATA_START: u32 = 0x2000_0000;

/// How much memory a chip has: code RAM at 0 and data RAM at [`DATA_START`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MemoryMap {
    /// Bytes of code RAM.
    pub code_bytes: u32,
    /// Bytes of data RAM.
    pub data_bytes: u32,
}

impl MemoryMap {
    /// The SCuM-3C: 64 KiB each.
    pub const SCUM3C: Self = Self { code_bytes: 0x1_0000, data_bytes: 0x1_0000 };
    /// QEMU's `microbit`: 256 KiB of flash, which is writable here, and 16 KiB of RAM.
    pub const MICROBIT: Self = Self { code_bytes: 0x4_0000, data_bytes: 0x4000 };
}

/// The memories of a chip.
#[derive(Debug, Clone)]
pub struct Memory {
    code: Box<[u8]>,
    data: Box<[u8]>,
    operations: Box<[Op]>,
}

impl Memory {
    /// Memory full of zeros.
    pub fn new(map: MemoryMap) -> Self {
        let zeros = |bytes: u32| vec![0; bytes as usize].into_boxed_slice();
        Self {
            code: zeros(map.code_bytes),
            data: zeros(map.data_bytes),
            operations: vec![Op::Unknown; map.code_bytes as usize / 2].into_boxed_slice(),
        }
    }

    /// The `N` bytes at `address`, unless one of them is not memory.
    #[inline(always)]
    pub fn read<const N: usize>(&self, address: u32) -> Option<[u8; N]> {
        let at = address.wrapping_sub(DATA_START) as usize;
        let bytes = match self.data.get(at..at + N) {
            Some(bytes) => bytes,
            None => self.code.get(address as usize..address as usize + N)?,
        };
        bytes.first_chunk().copied()
    }

    /// Writes `N` bytes at `address`, unless one of them is not memory.
    #[inline(always)]
    pub fn write<const N: usize>(&mut self, address: u32, bytes: [u8; N]) -> Option<()> {
        let at = address.wrapping_sub(DATA_START) as usize;
        match self.data.get_mut(at..at + N) {
            Some(to) => to.copy_from_slice(&bytes),
            None => self.write_code(address as usize, &bytes)?,
        }
        Some(())
    }

    /// A stretch of memory, unless part of it is not memory.
    pub fn slice(&self, address: u32, length: usize) -> Option<&[u8]> {
        let at = address.wrapping_sub(DATA_START) as usize;
        self.data.get(at..at + length).or_else(|| self.code.get(address as usize..address as usize + length))
    }

    /// Writes a stretch of memory, unless part of it is not memory.
    pub fn write_slice(&mut self, address: u32, bytes: &[u8]) -> Option<()> {
        let at = address.wrapping_sub(DATA_START) as usize;
        match self.data.get_mut(at..at + bytes.len()) {
            Some(to) => to.copy_from_slice(bytes),
            None => self.write_code(address as usize, bytes)?,
        }
        Some(())
    }

    #[cold]
    #[inline(never)]
    fn write_code(&mut self, at: usize, bytes: &[u8]) -> Option<()> {
        self.code.get_mut(at..at + bytes.len())?.copy_from_slice(bytes);
        let first = (at / 2).saturating_sub(1);
        let last = (at + bytes.len()).div_ceil(2).min(self.operations.len());
        self.operations[first..last].fill(Op::Unknown);
        Some(())
    }

    /// What runs at `pc`: [`Op::Unknown`] if it was not decoded yet or is not in code RAM.
    #[inline(always)]
    pub(crate) fn operation(&self, pc: u32) -> &Op {
        self.operations.get((pc >> 1) as usize).unwrap_or(&Op::Unknown)
    }

    /// Decodes what runs at `pc` and keeps it if it is in code RAM. `None` where nothing can run.
    #[cold]
    #[inline(never)]
    pub(crate) fn decode(&mut self, pc: u32) -> Option<Op> {
        let half = |address| self.read(address).map(u16::from_le_bytes);
        let first = half(pc)?;
        let second = if is_wide(first) { half(pc.wrapping_add(2))? } else { 0 };
        let op = decode(pc, first, second);
        if let Some(kept) = self.operations.get_mut((pc >> 1) as usize) {
            *kept = op;
        }
        Some(op)
    }
}
