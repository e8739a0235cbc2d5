//! How much of the program a function needs: itself, what it calls, the tables it names.
//!
//! Read from the code: a call is a BL to the first byte of a function, a table is a word that is the address of one.
//!
//! What can go wrong: a constant that looks like an address counts a table too many; a table without a name is not
//! seen.

use std::collections::{BTreeMap, BTreeSet};

use anyhow::{Context, Result};
use sim::elf::Symbols;
use sim::memory::Memory;

/// Bytes of `function` and of everything that it needs.
pub(super) fn reachable(memory: &Memory, symbols: &Symbols, function: &str) -> Result<u32> {
    // Several names may be one place. Code has the lowest bit set.
    let places: BTreeMap<u32, u32> =
        symbols.iter().filter(|(_, symbol)| symbol.size > 0).map(|(_, s)| (s.address, s.size)).collect();
    let start = symbols.address(function).with_context(|| format!("no function {function}"))?;
    let mut seen = BTreeSet::from([start]);
    let mut next = vec![start];
    let mut bytes = 0;
    while let Some(place) = next.pop() {
        let size = places.get(&place).copied().unwrap_or(0);
        bytes += size;
        let code = place & 1 != 0;
        let address = place & !1;
        if !code {
            continue;
        }
        let mut found = Vec::new();
        for at in (address..address + size).step_by(2) {
            found.extend(call_target(memory, at));
            if at % 4 == 0 {
                found.extend(memory.read(at).map(u32::from_le_bytes));
            }
        }
        for target in found {
            // Variables are no flash.
            if target < sim::memory::DATA_START && places.contains_key(&target) && seen.insert(target) {
                next.push(target);
            }
        }
    }
    Ok(bytes)
}

/// Where a BL at `at` goes, the Thumb bit set.
fn call_target(memory: &Memory, at: u32) -> Option<u32> {
    let half = |at| memory.read(at).map(u16::from_le_bytes).map(u32::from);
    let (first, second) = (half(at)?, half(at + 2)?);
    if first & 0xf800 != 0xf000 || second & 0xd000 != 0xd000 {
        return None;
    }
    // S:I1:I2:imm10:imm11:0, Armv6-M Architecture Reference Manual, BL encoding T1.
    let sign = first >> 10 & 1;
    let [i1, i2] = [13, 11].map(|bit| !(second >> bit ^ sign) & 1);
    let offset = sign << 24 | i1 << 23 | i2 << 22 | (first & 0x3ff) << 12 | (second & 0x7ff) << 1;
    let offset = ((offset << 7) as i32 >> 7) as u32;
    Some(at.wrapping_add(4).wrapping_add(offset) | 1)
}
