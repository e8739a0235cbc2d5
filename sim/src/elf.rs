//! A program as the linker leaves it.
//!
//! What can go wrong: a file for another machine is refused, and so is one with anything to load where the chip has no
//! memory; half a program never runs.

use std::collections::BTreeMap;

use object::read::elf::{ElfFile32, FileHeader, ProgramHeader};
use object::{LittleEndian, Object, ObjectSymbol, elf};

/// Why a program could not be loaded.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum LoadError {
    /// Not an ELF file that can be read.
    Unreadable(String),
    /// An ELF file, but not for a 32-bit little-endian Arm.
    WrongMachine {
        /// The machine number in its header.
        machine: u16,
    },
    /// Not an executable but something still to be linked.
    NotLinked,
    /// Something to load where there is no memory.
    OutsideMemory {
        /// Its first address.
        address: u32,
        /// Its length.
        bytes: u32,
    },
}

impl std::fmt::Display for LoadError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Unreadable(why) => write!(f, "cannot read the ELF file: {why}"),
            Self::WrongMachine { machine } => {
                write!(f, "the ELF file is for machine {machine}, not for Arm (40)")
            }
            Self::NotLinked => write!(f, "the ELF file is not an executable"),
            Self::OutsideMemory { address, bytes } => {
                write!(f, "{bytes} bytes to load at {address:#010x} do not fit into the chip's memory")
            }
        }
    }
}

impl std::error::Error for LoadError {}

/// A named place in a program.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Symbol {
    /// Its address; for a function with the Thumb bit set.
    pub address: u32,
    /// Its size in bytes, 0 if the linker does not know.
    pub size: u32,
}

/// The names in a program.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Symbols {
    by_name: BTreeMap<String, Symbol>,
}

impl Symbols {
    /// The symbol of that exact (mangled) name.
    pub fn get(&self, name: &str) -> Option<Symbol> {
        self.by_name.get(name).copied()
    }

    /// The address of the symbol of that exact (mangled) name.
    pub fn address(&self, name: &str) -> Option<u32> {
        self.get(name).map(|symbol| symbol.address)
    }

    /// All symbols, by name.
    pub fn iter(&self) -> impl Iterator<Item = (&str, Symbol)> {
        self.by_name.iter().map(|(name, symbol)| (name.as_str(), *symbol))
    }

    /// The symbol that contains `address`, for reports.
    pub fn containing(&self, address: u32) -> Option<&str> {
        self.iter()
            .find(|(_, symbol)| (symbol.address & !1..(symbol.address & !1) + symbol.size).contains(&address))
            .map(|(name, _)| name)
    }
}

/// A stretch of bytes with the address it is loaded to and the one the program uses.
#[derive(Debug, Clone, Copy)]
pub struct Segment<'a> {
    /// Where the programmer puts it.
    pub load_address: u32,
    /// Where the program expects it.
    pub run_address: u32,
    /// Where it begins in the file.
    pub offset: usize,
    /// What is loaded.
    pub bytes: &'a [u8],
}

/// What there is to load, and the names in it.
#[derive(Debug, Clone)]
pub struct Program<'a> {
    /// The stretches that are not empty, in the file's order.
    pub segments: Vec<Segment<'a>>,
    /// The names.
    pub symbols: Symbols,
}

/// Reads a linked program for a 32-bit little-endian Arm.
///
/// # Errors
/// The file is none.
pub fn read(file: &[u8]) -> Result<Program<'_>, LoadError> {
    let unreadable = |error: object::Error| LoadError::Unreadable(error.to_string());
    let parsed = ElfFile32::<LittleEndian>::parse(file).map_err(unreadable)?;
    let header = parsed.elf_header();
    let machine = header.e_machine(LittleEndian);
    if machine != elf::EM_ARM {
        return Err(LoadError::WrongMachine { machine });
    }
    if header.e_type(LittleEndian) != elf::ET_EXEC {
        return Err(LoadError::NotLinked);
    }
    let mut segments = Vec::new();
    for header in parsed.elf_program_headers() {
        if header.p_type(LittleEndian) != elf::PT_LOAD || header.p_filesz(LittleEndian) == 0 {
            continue;
        }
        let bytes = header
            .data(LittleEndian, file)
            .map_err(|()| LoadError::Unreadable("a segment lies outside the file".to_owned()))?;
        segments.push(Segment {
            load_address: header.p_paddr(LittleEndian),
            run_address: header.p_vaddr(LittleEndian),
            offset: header.p_offset(LittleEndian) as usize,
            bytes,
        });
    }
    let by_name = parsed
        .symbols()
        .filter(|symbol| !symbol.is_undefined())
        .filter_map(|symbol| {
            let name = symbol.name().ok().filter(|name| !name.is_empty() && !name.starts_with('$'))?;
            Some((name.to_owned(), Symbol { address: symbol.address() as u32, size: symbol.size() as u32 }))
        })
        .collect();
    Ok(Program { segments, symbols: Symbols { by_name } })
}
