//! What each board's image takes of its memories, and the deepest that its stack can ever be.
//!
//! Another room than `calib/default.toml`, or a room with a key, has its own images, which are weighed and whose stacks have
//! to fit; nothing is expected of their sizes.
//!
//! What can go wrong: a stack that may be deeper than there is room for it, or that was seen deeper than it is said it
//! could be: errors. Something that has grown since `tests/expected/memory.txt` was written: an error which names it;
//! where it is meant, `--bless` writes the file anew.

mod stack;
mod thumb;

use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use object::read::elf::ElfFile32;
use object::{LittleEndian, Object, ObjectSection, ObjectSymbol, SymbolKind};

use crate::process::{root, run};
use crate::room::Room;
use crate::{bench, expected, firmware, setup};
use stack::Bound;
use xtask::whole;

/// What may be told.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// Take what is found now for what is expected from now on
    #[arg(long)]
    bless: bool,
    /// The room that is baked in; what it takes is then not held against what is expected of calib/default.toml
    #[arg(long, value_name = "FILE", env = "LIGHTHOUSE_CALIB")]
    calib: Option<PathBuf>,
}

impl Arguments {
    /// As when nobody says anything.
    pub(crate) const PLAIN: Self = Self { bless: false, calib: None };
}

/// What is expected, from the root of the repository.
const EXPECTED: &str = "tests/expected/memory.txt";
/// Where the results go.
const OUT: &str = "target/memory";
/// By how much code and constants may differ from one computer to another: panics of other crates name their file, whose
/// path begins with the user's home.
const SLACK: u32 = 128;

/// A board with an app.
struct Board {
    name: &'static str,
    target: &'static str,
    has_floating_point: bool,
    /// It may have a key: its image links with one too.
    has_key: bool,
    /// Its stack is bounded with a key too. The nRF52840's is not (docs/air.md): a formatter in the panics of the cipher, as
    /// `StreamCipherError` has it, jumps out through a register; it has 10 KiB, four times what it has ever needed without.
    seals: bool,
}

const BOARDS: [Board; 3] = [
    Board { name: "scum3c", target: setup::CORTEX_M0, has_floating_point: false, has_key: true, seals: true },
    Board { name: "nrf52840", target: setup::CORTEX_M4F, has_floating_point: true, has_key: true, seals: false },
    Board { name: "microbit", target: setup::CORTEX_M0, has_floating_point: false, has_key: false, seals: false },
];

/// Bytes of a board's memories.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Taken {
    /// Vectors and code.
    text: u32,
    /// Constants, the tables among them.
    rodata: u32,
    /// Of those, the ones with a name: tables.
    tables: u32,
    /// Variables.
    ram: u32,
    /// The deepest stack, where it is bounded.
    stack: Option<u32>,
}

impl Taken {
    fn of(elf: &[u8], stack: Option<u32>) -> Result<Self> {
        let file = ElfFile32::<LittleEndian>::parse(elf).context("not an ELF file")?;
        let size = |names: &[&str]| {
            let sections = names.iter().filter_map(|name| file.section_by_name(name));
            sections.map(|section| section.size() as u32).sum::<u32>()
        };
        let rodata = file.section_by_name(".rodata").context("the image has no .rodata")?;
        let within = rodata.address()..rodata.address() + rodata.size();
        let mut tables: Vec<(u64, u64)> = file
            .symbols()
            .filter(|symbol| symbol.kind() == SymbolKind::Data && within.contains(&symbol.address()))
            // What the compiler made up has a name for the linker alone.
            .filter(|symbol| symbol.name().is_ok_and(|name| !name.starts_with(".L")))
            .map(|symbol| (symbol.address(), symbol.size()))
            .collect();
        tables.sort_unstable();
        tables.dedup();
        Ok(Self {
            text: size(&[".vector_table", ".text"]),
            rodata: size(&[".rodata"]),
            tables: tables.iter().map(|(_, size)| *size as u32).sum(),
            ram: size(&[".data", ".bss", ".uninit"]),
            stack,
        })
    }

    fn figures(&self) -> impl Iterator<Item = (&'static str, u32)> + use<> {
        let Self { text, rodata, tables, ram, stack } = *self;
        let sizes = [("text", text), ("rodata", rodata), ("tables", tables), ("ram", ram)];
        sizes.into_iter().chain(stack.map(|bytes| ("stack", bytes)))
    }
}

/// Builds every board, prints, checks.
pub(crate) fn memory(arguments: &Arguments) -> Result<()> {
    let room = Room::open(arguments.calib.as_deref())?.lit_anywhere();
    if arguments.bless {
        room.ensure_expected()?;
    }
    let calib = &room.file;
    let mut figures = Vec::new();
    let mut keyed = BTreeMap::new();
    let mut report = String::new();
    let mut wrong = Vec::new();
    let key_file = tempfile::NamedTempFile::new().context("a file for a key")?;
    std::fs::write(key_file.path(), "00".repeat(16)).context("a key")?;
    let with_key = format!("key_file = {:?}", key_file.path());
    for board in &BOARDS {
        // Where frames are sealed the stack is another one. First, so that the usual image is what is left behind.
        let sealing = if board.seals && room.key.is_none() {
            let elf = image(board, calib, &with_key)?;
            let bound = bound(board, &elf)?;
            let name = format!("{} with a key", board.name);
            writeln!(report, "{name}: stack at most {} of {}", bound.bytes(), bound.space)?;
            if bound.bytes() > bound.space {
                wrong.push(format!("{name}: a stack of {} bytes in room for {}", bound.bytes(), bound.space));
            }
            Some(Taken::of(&elf, Some(bound.bytes()))?)
        } else {
            if board.has_key {
                image(board, calib, &with_key)?;
            }
            None
        };
        let elf = image(board, calib, "")?;
        let bound = if board.seals || room.key.is_none() { Some(bound(board, &elf)?) } else { None };
        let taken = Taken::of(&elf, bound.as_ref().map(Bound::bytes))?;
        figures.extend(taken.figures().map(|(what, bytes)| (format!("{}.{what}", board.name), bytes)));
        table(&mut report, board.name, &taken, bound.as_ref())?;
        if let Some(sealing) = sealing {
            let image = (sealing.text + sealing.rodata).saturating_sub(taken.text + taken.rodata);
            let ram = sealing.ram.saturating_sub(taken.ram);
            writeln!(report, "{:<14} {image:>6}  bytes of image more with a key, and {ram} of RAM", "")?;
            keyed.extend([(format!("{}.image", board.name), image), (format!("{}.ram", board.name), ram)]);
        }
        let Some(bound) = bound else { continue };
        if bound.bytes() > bound.space {
            wrong.push(format!("{}: a stack of {} bytes in room for {}", board.name, bound.bytes(), bound.space));
        }
        if board.name == "scum3c" {
            let seen = bench::deepest_stack(&elf, &room)?;
            writeln!(report, "{:<14} {seen:>6}  seen in the virtual mote", "")?;
            if seen > bound.bytes() {
                wrong.push(format!("{}: a stack of {seen} bytes was seen, {} said", board.name, bound.bytes()));
            }
        }
    }
    println!("\n{report}");
    let folder = root().join(OUT);
    whole::json(&folder.join("summary.json"), &figures.iter().cloned().collect::<BTreeMap<_, _>>())?;
    if room.key.is_none() {
        whole::json(&folder.join("keyed.json"), &keyed)?;
    }
    ensure!(wrong.is_empty(), "{}", wrong.join("; "));
    if let Some(why) = room.unlike_expected() {
        println!("{why}: not held against {EXPECTED}");
        return Ok(());
    }
    if arguments.bless {
        let text = figures.iter().fold(String::new(), |text, (name, bytes)| text + &format!("{name} {bytes}\n"));
        return expected::bless(EXPECTED, &text);
    }
    compare(&expected::known(EXPECTED, "memory")?, &figures)?;
    println!("as expected in {EXPECTED}");
    Ok(())
}

/// Built with these lines under `[mote]`.
fn image(board: &Board, calib: &Path, mote: &str) -> Result<Vec<u8>> {
    let elf = firmware::build_for(board.target, board.name, calib, mote, run)?;
    std::fs::read(&elf).with_context(|| elf.display().to_string())
}

fn bound(board: &Board, elf: &[u8]) -> Result<Bound> {
    let main = root().join("src/bin").join(board.name).join("main.rs");
    let source = std::fs::read_to_string(&main).with_context(|| main.display().to_string())?;
    let tasks = stack::tasks(&source).with_context(|| main.display().to_string())?;
    stack::bound(elf, &tasks, board.has_floating_point).with_context(|| format!("the stack of {}", board.name))
}

fn table(out: &mut String, name: &str, taken: &Taken, bound: Option<&Bound>) -> std::fmt::Result {
    let Taken { text, rodata, tables, ram, .. } = taken;
    write!(out, "{name}: text {text}, rodata {rodata} ({tables} of it tables), RAM {ram}, stack ")?;
    let Some(bound) = bound else { return writeln!(out, "not bounded with a key") };
    writeln!(out, "at most {}", bound.bytes())?;
    for layer in &bound.layers {
        writeln!(out, "{:>14} {:>6}  {}", layer.what, layer.bytes, layer.way.join(" > "))?;
    }
    writeln!(out, "{:>14} {:>6}  of {}", "together", bound.bytes(), bound.space)
}

/// Whether anything grew.
fn compare(known: &str, figures: &[(String, u32)]) -> Result<()> {
    let was = |name: &str| {
        known.lines().filter_map(|line| line.split_once(' ')).find(|(known, _)| *known == name)?.1.parse::<u32>().ok()
    };
    let mut grown = String::new();
    for (name, is) in figures {
        let slack = if name.ends_with(".text") || name.ends_with(".rodata") { SLACK } else { 0 };
        match was(name) {
            Some(was) if *is <= was + slack => {}
            Some(was) => grown += &format!("\n  {name}: {was} -> {is}"),
            None => grown += &format!("\n  {name}: not there -> {is}"),
        }
    }
    if !grown.is_empty() {
        bail!("against {EXPECTED}, where it is meant `cargo xtask memory --bless`:{grown}");
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::num::NonZeroU32;

    use sim::machine::Stop;
    use sim::mote::{Halted, Mote};
    use sim::world::{Scene, World};

    use super::*;

    const HCLK: u32 = 10_000_000;
    const LIGHT_S: f64 = 4.0;

    #[test]
    fn growth_is_named_and_shrinking_is_welcome() {
        let figures = |text, ram| vec![("a.text".to_string(), text), ("a.ram".to_string(), ram)];
        let known = "a.text 1000\na.ram 100\n";
        assert!(compare(known, &figures(1000 + SLACK, 100)).is_ok());
        assert!(compare(known, &figures(900, 90)).is_ok());
        let grown = compare(known, &figures(900, 101)).expect_err("it grew");
        assert!(grown.to_string().contains("a.ram: 100 -> 101"), "{grown}");
        assert!(compare("a.text 1000\n", &figures(900, 90)).is_err());
    }

    /// Runs the SCuM-3C's firmware in light with so much stack; how it ended, and the deepest stack.
    fn run(elf: &[u8], stack: u32) -> (Result<(), Halted>, u32) {
        let program = sim::elf::read(elf).expect("it was built");
        let vectors = program.segments.iter().find(|segment| segment.load_address == 0).expect("it has vectors").offset;
        let mut elf = elf.to_vec();
        let top = sim::memory::DATA_START + stack;
        elf[vectors..vectors + 4].copy_from_slice(&top.to_le_bytes());
        let mut scene = Scene { length_s: LIGHT_S, ..Scene::default() };
        scene.clock.nominal_hz = f64::from(HCLK);
        scene.clock.error = 0.0;
        let mut world = World::new(&scene, 1);
        let end = world.cycle(LIGHT_S);
        let mut mote = Mote::boot(&elf, NonZeroU32::new(HCLK).expect("it runs")).expect("it fits");
        for edge in world.edges().take_while(|edge| edge.cycle < end) {
            mote.push_edge(edge.cycle, edge.level).expect("edges come in order");
        }
        let ended = mote.run_until(end);
        (ended, top - mote.machine.core.registers.lowest_main_sp())
    }

    #[test]
    fn a_stack_that_runs_over_faults_and_harms_no_variable() {
        let calib = root().join(firmware::DEFAULT_CALIB);
        let board = &BOARDS[0];
        let elf = image(board, &calib, "").expect("it builds");
        let bound = bound(board, &elf).expect("it can be read");
        let (ended, deepest) = run(&elf, bound.space);
        assert_eq!(ended, Ok(()));
        assert!(deepest <= bound.bytes(), "{deepest} bytes of stack were seen, {} said", bound.bytes());
        // Half of it runs over at the latest where all of it was used. There is no memory below: nothing is written.
        let (ended, _) = run(&elf, deepest / 16 * 8);
        assert!(matches!(ended, Err(Halted { stop: Stop::Lockup(_) | Stop::Fault(_), .. })), "{ended:?}");
        // And all variables are above.
        let symbols = sim::elf::read(&elf).expect("it was built").symbols;
        let first = symbols.address("__sdata").expect("it has variables");
        assert!(first >= sim::memory::DATA_START + bound.space, "{first:#x}");
    }
}
