//! The deepest that a board's stack can ever be, read off its program.
//!
//! A function's frame is all that it ever pushes or takes off the stack pointer; what it needs is that and the neediest
//! of the functions that it branches to. Over the needs of the program lies, for each priority, the neediest handler on
//! an exception frame, and over all of them the HardFault's. No run of the program goes deeper, whatever the light.
//!
//! A bound, not a measurement: a frame counts as a whole where a call is made from part of it, and every priority counts
//! as interrupted at its worst.
//!
//! Two recursions are known and have an end, so a way through them is followed so often and no further. A panic logs, and
//! the log panics where it was taken already; the second panic has nothing to log (`src/bin/mote/fault.rs`). The tracker
//! crosses a long gap in strides, each a step of its own, which is no longer a gap (`src/track.rs`).
//!
//! What can go wrong: what cannot be read is an error and never a guess: a recursion, a jump out of a function through a
//! register, a stack pointer that is set from one, a handler without a priority. A call through a register counts as a
//! call of the neediest function whose address is a word of the program.

use std::collections::{BTreeMap, BTreeSet};

use anyhow::{Context, Result, bail, ensure};
use object::read::elf::ElfFile32;
use object::{LittleEndian, Object, ObjectSection, ObjectSymbol, SymbolKind};

use super::thumb::{self, Effect};
use crate::bench::readable;

/// What the core pushes as it takes an exception: eight words, and one where the stack pointer was not on a double word
/// (ARMv6-M ARM, B1.5.6); a core with floating point 18 more (ARMv7-M ARM, B1.5.6).
const EXCEPTION_FRAME: u32 = 8 * 4 + 4;
const FLOATING_POINT: u32 = 18 * 4;

/// What a function's name holds, and how often a way leads through it at most.
const RETURNING: [(&str, u8); 2] = [("rust_begin_unwind", 2), ("track::bridge", 1)];
/// How often a way led through each.
type Returns = [u8; RETURNING.len()];

/// A task that an interrupt line runs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Task {
    pub(super) line: String,
    pub(super) priority: u8,
}

/// The hardware tasks of an RTIC app, from its source: `#[task(binds = LINE, priority = N`.
pub(super) fn tasks(source: &str) -> Result<Vec<Task>> {
    let value = |attribute: &str, key: &str| {
        let (_, rest) = attribute.split_once(&format!("{key} = "))?;
        Some(rest.split([',', ')']).next().unwrap_or_default().trim().to_string())
    };
    source
        .lines()
        .filter(|line| line.trim_start().starts_with("#[task("))
        .map(|line| {
            let line_of = value(line, "binds").with_context(|| format!("a task without a line: {line}"))?;
            let priority = value(line, "priority").with_context(|| format!("a task without a priority: {line}"))?;
            Ok(Task { line: line_of, priority: priority.parse().with_context(|| line.to_string())? })
        })
        .collect()
}

/// A stretch of the stack and who needs it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Layer {
    /// "program", "priority 3", "HardFault".
    pub(super) what: String,
    /// The neediest way, outermost first.
    pub(super) way: Vec<String>,
    /// Bytes, with the exception frame.
    pub(super) bytes: u32,
}

/// The whole of it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Bound {
    pub(super) layers: Vec<Layer>,
    /// What there is.
    pub(super) space: u32,
}

impl Bound {
    /// Bytes, at most.
    pub(super) fn bytes(&self) -> u32 {
        self.layers.iter().map(|layer| layer.bytes).sum()
    }
}

/// The bound of a program whose tasks are these.
pub(super) fn bound(elf: &[u8], tasks: &[Task], has_floating_point: bool) -> Result<Bound> {
    let program = Program::read(elf)?;
    let entry = EXCEPTION_FRAME + if has_floating_point { FLOATING_POINT } else { 0 };
    let mut layers = vec![program.layer("program", "Reset", program.vector(1)?, 0)?];
    let mut priorities: BTreeMap<u8, Layer> = BTreeMap::new();
    for (line, handler) in program.interrupts()? {
        let name = program.name(handler);
        let task = tasks.iter().find(|task| program.symbols.get(&task.line) == Some(&handler));
        let task = task.with_context(|| format!("line {line} runs {name}, and no task has a priority for it"))?;
        let what = format!("priority {}", task.priority);
        let layer = program.layer(&what, &task.line, handler, entry)?;
        let deepest = priorities.entry(task.priority).or_insert_with(|| layer.clone());
        if layer.bytes > deepest.bytes {
            *deepest = layer;
        }
    }
    layers.extend(priorities.into_values());
    layers.push(program.layer("HardFault", "HardFault", program.vector(3)?, entry)?);
    let start = program.symbols.get("_stack_start").context("the program has no _stack_start")?;
    Ok(Bound { layers, space: start - sim::memory::DATA_START })
}

/// A function: what it takes itself, and where it goes.
#[derive(Debug, Default)]
struct Function {
    name: String,
    /// Bytes, its literals among them; 0 where the assembler does not say.
    size: u32,
    frame: u32,
    calls: BTreeSet<u32>,
    calls_through_register: bool,
}

/// A function's address, and how often the way to it led through each of [`RETURNING`].
type Place = (u32, Returns);
/// Bytes, and the way, outermost first.
type Need = (u32, Vec<u32>);

/// A program, taken apart.
struct Program {
    /// By address, without the Thumb bit.
    functions: BTreeMap<u32, Function>,
    /// Addresses by name, without the Thumb bit for functions.
    symbols: BTreeMap<String, u32>,
    vectors: Vec<u32>,
    /// Functions whose address is a word somewhere.
    taken: BTreeSet<u32>,
}

impl Program {
    fn read(elf: &[u8]) -> Result<Self> {
        let file = ElfFile32::<LittleEndian>::parse(elf).context("not an ELF file")?;
        let section = |name: &str| -> Result<(u32, Vec<u8>)> {
            let section = file.section_by_name(name).with_context(|| format!("the program has no {name}"))?;
            Ok((section.address() as u32, section.data().with_context(|| name.to_string())?.to_vec()))
        };
        let (base, text) = section(".text")?;
        let end = base + text.len() as u32;
        let mut symbols = BTreeMap::new();
        // Where code begins and where data does, as the assembler marked it (ELF for the Arm architecture, 5.5.5).
        let mut marks: BTreeMap<u32, bool> = BTreeMap::new();
        let mut functions: BTreeMap<u32, Function> = BTreeMap::new();
        for symbol in file.symbols() {
            let (Ok(name), address) = (symbol.name(), symbol.address() as u32) else { continue };
            match name.get(..2) {
                Some("$t") => drop(marks.insert(address, true)),
                Some("$d") => drop(marks.entry(address).or_insert(false)),
                _ if symbol.kind() == SymbolKind::Text && (base..end).contains(&(address & !1)) => {
                    symbols.insert(name.to_string(), address & !1);
                    let function = functions.entry(address & !1).or_default();
                    if function.name.is_empty() || symbol.size() > 0 {
                        function.name = name.to_string();
                    }
                    function.size = function.size.max(symbol.size() as u32);
                }
                _ => drop(symbols.insert(name.to_string(), address)),
            }
        }
        let is_code = |at: u32| marks.range(..=at).next_back().is_some_and(|(_, code)| *code);
        let half = |at: u32| text.get((at - base) as usize..)?.first_chunk().map(|bytes| u16::from_le_bytes(*bytes));
        let starts: Vec<u32> = functions.keys().copied().collect();
        for (n, &start) in starts.iter().enumerate() {
            // Behind a function the linker fills up with what is no code.
            let stop = match functions[&start].size {
                0 => starts.get(n + 1).copied().unwrap_or(end),
                size => start + size,
            };
            let mut at = start;
            let mut before = Vec::new();
            while at < stop {
                if !is_code(at) {
                    at += 2;
                    continue;
                }
                let codes = [half(at).unwrap_or(0), half(at + 2).unwrap_or(0)];
                let name = functions[&start].name.clone();
                let effect = thumb::effect(codes, at, &before, |at| {
                    let [low, high] = [half(at)?, half(at + 2)?];
                    Some(u32::from(high) << 16 | u32::from(low))
                });
                let function = functions.get_mut(&start).context("a function that was there")?;
                match effect {
                    Effect::None => {}
                    Effect::Takes(bytes) => function.frame += bytes,
                    Effect::Goes(to) if (start..stop).contains(&to) && to != start => {}
                    // Back to its own first instruction is a loop where nothing was pushed before, a recursion else.
                    Effect::Goes(to) if to == start && function.frame == 0 => {}
                    Effect::Goes(to) => drop(function.calls.insert(to)),
                    // A far jump: `bl` reaches what a branch does not, and the link register was saved before.
                    Effect::Calls(to) if (start..stop).contains(&to) && to != start => {}
                    Effect::Calls(to) => drop(function.calls.insert(to)),
                    Effect::CallsThroughRegister => function.calls_through_register = true,
                    Effect::Unknown(why) => bail!("{}, at {at:#x}: {why}", readable(&name)),
                }
                before.push(codes[0]);
                at += thumb::length(codes[0]);
            }
        }
        let (_, table) = section(".vector_table")?;
        let words = |bytes: &[u8]| bytes.as_chunks().0.iter().map(|word| u32::from_le_bytes(*word)).collect::<Vec<_>>();
        let mut taken = BTreeSet::new();
        for name in [".text", ".rodata", ".data"] {
            let (_, bytes) = section(name)?;
            taken.extend(words(&bytes).iter().filter(|word| *word & 1 == 1).map(|word| word & !1));
        }
        taken.retain(|address| functions.contains_key(address));
        Ok(Self { functions, symbols, vectors: words(&table), taken })
    }

    fn vector(&self, number: usize) -> Result<u32> {
        Ok(self.vectors.get(number).with_context(|| format!("no vector {number}"))? & !1)
    }

    /// The lines that run something, and what.
    fn interrupts(&self) -> Result<Vec<(usize, u32)>> {
        let default = self.symbols.get("DefaultHandler_").or_else(|| self.symbols.get("DefaultHandler"));
        let default = *default.context("the program has no DefaultHandler")?;
        let lines = self.vectors.iter().enumerate().skip(16).map(|(number, vector)| (number - 16, vector & !1));
        Ok(lines.filter(|(_, handler)| *handler != default && *handler != 0).collect())
    }

    fn name(&self, address: u32) -> String {
        self.functions.get(&address).map_or_else(|| format!("{address:#x}"), |function| readable(&function.name))
    }

    fn layer(&self, what: &str, first: &str, address: u32, entry: u32) -> Result<Layer> {
        let (bytes, way) = self.need((address, Returns::default()), &mut Vec::new(), &mut BTreeMap::new())?;
        let mut names: Vec<String> = way.iter().map(|address| self.name(*address)).collect();
        if let Some(name) = names.first_mut() {
            *name = first.to_string();
        }
        Ok(Layer { what: what.to_string(), way: names, bytes: bytes + entry })
    }

    /// What a function needs with all that it calls behind so many returns, and the way there.
    fn need(&self, place: Place, above: &mut Vec<Place>, known: &mut BTreeMap<Place, Need>) -> Result<Need> {
        if let Some(need) = known.get(&place) {
            return Ok(need.clone());
        }
        if let Some(at) = above.iter().position(|other| *other == place) {
            let names: Vec<String> =
                above[at..].iter().chain([&place]).map(|(address, _)| self.name(*address)).collect();
            bail!("a recursion, whose depth nobody knows: {}", names.join(" -> "));
        }
        let (address, mut returns) = place;
        let function =
            self.functions.get(&address).with_context(|| format!("{address:#x} is called and is no function"))?;
        let name = readable(&function.name);
        for ((held, most), count) in RETURNING.iter().zip(&mut returns) {
            *count += u8::from(name.contains(held));
            if *count > *most {
                return Ok((0, Vec::new()));
            }
        }
        above.push(place);
        let through: &BTreeSet<u32> = if function.calls_through_register { &self.taken } else { &BTreeSet::new() };
        ensure!(
            !function.calls_through_register || !through.is_empty(),
            "{} calls through a register, and no function's address is anywhere",
            readable(&function.name)
        );
        let mut most = (0, Vec::new());
        for callee in function.calls.iter().chain(through) {
            let need = self.need((*callee, returns), above, known)?;
            if need.0 > most.0 || most.1.is_empty() {
                most = need;
            }
        }
        above.pop();
        let mut way = vec![address];
        way.extend(&most.1);
        let need = (function.frame + most.0, way);
        known.insert(place, need.clone());
        Ok(need)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn priorities_are_read_off_the_app() {
        let source =
            "    #[task(binds = GPIO8, priority = 4, shared = [capture])]\n  #[task(binds = RF, priority = 2)]\n";
        let task = |line: &str, priority| Task { line: line.to_string(), priority };
        assert_eq!(tasks(source).ok(), Some(vec![task("GPIO8", 4), task("RF", 2)]));
        assert!(tasks("#[task(binds = RF)]").is_err());
    }

    fn program(functions: &[(u32, u32, &[u32])]) -> Program {
        let function = |(address, frame, calls): &(u32, u32, &[u32])| {
            let calls = calls.iter().copied().collect();
            (*address, Function { name: format!("f{address}"), frame: *frame, calls, ..Function::default() })
        };
        Program {
            functions: functions.iter().map(function).collect(),
            symbols: BTreeMap::new(),
            vectors: Vec::new(),
            taken: BTreeSet::new(),
        }
    }

    #[test]
    fn the_neediest_way_counts_and_not_the_longest() {
        let program = program(&[(0, 8, &[2, 4]), (2, 8, &[6]), (4, 100, &[]), (6, 8, &[])]);
        assert_eq!(
            program.need((0, Returns::default()), &mut Vec::new(), &mut BTreeMap::new()).ok(),
            Some((108, vec![0, 4]))
        );
    }

    #[test]
    fn a_recursion_is_named_and_refused() {
        let program = program(&[(0, 8, &[2]), (2, 8, &[4]), (4, 8, &[2])]);
        let error =
            program.need((0, Returns::default()), &mut Vec::new(), &mut BTreeMap::new()).expect_err("it goes round");
        assert!(error.to_string().ends_with("f2 -> f4 -> f2"), "{error}");
    }

    #[test]
    fn a_panic_in_a_panic_is_followed_and_a_third_is_not() {
        let mut program = program(&[(0, 8, &[2]), (2, 100, &[4]), (4, 16, &[2])]);
        program.functions.get_mut(&2).expect("it is there").name = RETURNING[0].0.to_string();
        let need = program.need((0, Returns::default()), &mut Vec::new(), &mut BTreeMap::new());
        assert_eq!(need.ok(), Some((8 + 2 * (100 + 16), vec![0, 2, 4, 2, 4])));
    }

    #[test]
    fn a_call_through_a_register_may_go_wherever_an_address_is_known() {
        let mut program = program(&[(0, 8, &[]), (2, 40, &[]), (4, 16, &[])]);
        program.functions.get_mut(&0).expect("it is there").calls_through_register = true;
        assert!(program.need((0, Returns::default()), &mut Vec::new(), &mut BTreeMap::new()).is_err());
        program.taken = BTreeSet::from([2, 4]);
        assert_eq!(
            program.need((0, Returns::default()), &mut Vec::new(), &mut BTreeMap::new()).ok(),
            Some((48, vec![0, 2]))
        );
    }
}
