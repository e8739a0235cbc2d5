//! What is done to a mote.

use std::ops::Range;

use anyhow::{Context, Result};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use sim::mote::Mote;
use sim::scum3c::{Failure, IRQ_GPIO8_HIGH, IRQ_GPIO9_LOW, IRQ_RF, IRQ_RFTIMER};

use crate::lit::Lit;

/// Failures last at most so long, seconds: well beyond what the watchdog waits.
pub(super) const LONGEST_S: f64 = 10.0;
/// And at least so long.
const SHORTEST_S: f64 = 0.05;

/// Kinds of harm, in the order of the table.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Kind {
    /// One bit of data RAM.
    Flip,
    /// The core starts again, memory as it was; the devices too, or as they are, which of the two is not documented.
    Reset,
    /// Core and devices start again, and data RAM is noise.
    BrownOut,
    /// One interrupt line is active all the time.
    Storm,
    /// Every line is.
    StormOfAll,
    /// The radio timer stands still.
    Timer,
    /// The radio is never done.
    Radio,
}

impl Kind {
    pub(super) const ALL: [Self; 7] =
        [Self::Flip, Self::Reset, Self::BrownOut, Self::Storm, Self::StormOfAll, Self::Timer, Self::Radio];

    fn word(self) -> &'static str {
        match self {
            Self::Flip => "flip",
            Self::Reset => "reset",
            Self::BrownOut => "brown-out",
            Self::Storm => "storm",
            Self::StormOfAll => "storm-of-all",
            Self::Timer => "timer",
            Self::Radio => "radio",
        }
    }
}

impl std::fmt::Display for Kind {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(match self {
            Self::Flip => "a bit of data RAM flips",
            Self::Reset => "reset",
            Self::BrownOut => "brown-out: data RAM is noise",
            Self::Storm => "an interrupt line storms",
            Self::StormOfAll => "all lines storm",
            Self::Timer => "the timer stands still",
            Self::Radio => "the radio is never done",
        })
    }
}

/// Data RAM in use.
#[derive(Debug)]
pub(super) struct Ram {
    variables: Range<u32>,
    stack: Range<u32>,
    names: Vec<(Range<u32>, String)>,
}

impl Ram {
    /// As the image lays it out, the stack as deep as it has been.
    pub(super) fn of(mote: &Mote) -> Result<Self> {
        let at = |name: &str| {
            mote.symbols.get(name).map(|symbol| symbol.address).with_context(|| format!("the image has no {name}"))
        };
        let end = at("__euninit").or_else(|_| at("__ebss"))?;
        let names = mote
            .symbols
            .iter()
            .filter(|(_, symbol)| symbol.address >= sim::memory::DATA_START && symbol.size > 0)
            .map(|(name, symbol)| (symbol.address..symbol.address + symbol.size, name.to_string()))
            .collect();
        Ok(Self {
            variables: at("__sdata")?..end,
            stack: mote.machine.core.registers.lowest_main_sp()..at("_stack_start")?,
            names,
        })
    }

    /// A little, for tests.
    #[cfg(test)]
    pub(super) fn some() -> Self {
        Self { variables: 0x2000_0000..0x2000_0010, stack: 0x2000_0100..0x2000_0110, names: Vec::new() }
    }

    pub(super) fn bytes(&self) -> usize {
        self.variables.len() + self.stack.len()
    }

    pub(super) fn stack_bytes(&self) -> usize {
        self.stack.len()
    }

    fn nth(&self, n: usize) -> u32 {
        self.variables.clone().chain(self.stack.clone()).nth(n).unwrap_or(self.stack.start)
    }

    fn name(&self, address: u32) -> String {
        if self.stack.contains(&address) {
            return format!("stack, {} bytes from its top", self.stack.end - address);
        }
        let known = self.names.iter().find(|(range, _)| range.contains(&address));
        known.map_or("no variable".to_string(), |(range, name)| format!("{name}+{}", address - range.start))
    }
}

/// What is done, drawn from the run's number and the seed.
#[derive(Debug, Clone)]
pub(super) struct Harm {
    pub(super) kind: Kind,
    pub(super) number: usize,
    /// When, true seconds.
    pub(super) at_s: f64,
    /// How long it lasts, seconds.
    pub(super) long_s: f64,
    address: u32,
    bit: u8,
    line: u32,
    noise: u64,
}

impl Harm {
    pub(super) fn draw(kind: Kind, number: usize, seed: u64, [from_s, to_s]: [f64; 2], ram: &Ram) -> Self {
        let mut dice = ChaCha8Rng::seed_from_u64(seed ^ (kind as u64) << 56 ^ (number as u64) << 24);
        let mut unit = || dice.next_u64() as f64 / u64::MAX as f64;
        let at_s = from_s + unit() * (to_s - from_s);
        let lasts = SHORTEST_S + unit() * (LONGEST_S - SHORTEST_S);
        let nth = ((unit() * ram.bytes() as f64) as usize).min(ram.bytes() - 1);
        let bit = (unit() * 8.0) as u8 & 7;
        // Those that the firmware uses, wired or not, and one that it does not.
        let lines = [IRQ_RF, IRQ_RFTIMER, IRQ_GPIO8_HIGH, IRQ_GPIO9_LOW, 4, 5, 10, 3];
        let line = lines[(unit() * lines.len() as f64) as usize % lines.len()];
        let long_s = match kind {
            Kind::Flip | Kind::Reset | Kind::BrownOut => 0.0,
            Kind::Storm | Kind::StormOfAll | Kind::Timer | Kind::Radio => lasts,
        };
        Self { kind, number, at_s, long_s, address: ram.nth(nth), bit, line, noise: dice.next_u64() }
    }

    /// As it is called.
    pub(super) fn name(&self) -> String {
        format!("{}-{}", self.kind.word(), self.number)
    }

    pub(super) fn what(&self, ram: &Ram) -> String {
        match self.kind {
            Kind::Flip => format!("bit {} at {:#010x}, {}", self.bit, self.address, ram.name(self.address)),
            Kind::Reset if self.number / 8 % 2 == 1 => "reset of the core alone".to_string(),
            Kind::Reset | Kind::BrownOut => self.kind.to_string(),
            Kind::Storm => format!("line {} for {:.2} s", self.line, self.long_s),
            Kind::StormOfAll | Kind::Timer | Kind::Radio => format!("{} for {:.2} s", self.kind, self.long_s),
        }
    }

    /// Does it, now.
    pub(super) fn happen(&self, lit: &mut Lit) {
        let until = lit.world.cycle(self.at_s + self.long_s);
        let mote = &mut lit.mote;
        let now = mote.machine.cycles();
        let mut fail = |failure| mote.machine.bus.fail(failure, now, until.max(now + 1));
        match self.kind {
            Kind::Flip => {
                let byte = mote.machine.read_bytes(self.address, 1).map_or(0, |bytes| bytes[0]);
                mote.machine.write_bytes(self.address, &[byte ^ 1 << self.bit]);
            }
            Kind::Reset if self.number / 8 % 2 == 1 => mote.machine.reset(),
            Kind::Reset => mote.restart(),
            Kind::BrownOut => {
                let mut noise = ChaCha8Rng::seed_from_u64(self.noise);
                let words = sim::memory::MemoryMap::SCUM3C.data_bytes / 8;
                let bytes: Vec<u8> = (0..words).flat_map(|_| noise.next_u64().to_le_bytes()).collect();
                mote.machine.write_bytes(sim::memory::DATA_START, &bytes);
                mote.restart();
                lit.forget_counters();
            }
            Kind::Storm => fail(Failure::Lines(1 << self.line)),
            Kind::StormOfAll => fail(Failure::Lines(0xffff)),
            Kind::Timer => fail(Failure::Timer),
            Kind::Radio => fail(Failure::Radio),
        }
    }
}
