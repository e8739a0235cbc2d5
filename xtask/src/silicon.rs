//! The firmware on a chip as strict as silicon and less forgiving: each chip with oscillators of its own, and a firmware
//! whose bring-up is broken on purpose, write by write.

use std::iter::Peekable;
use std::num::NonZeroU32;

use lighthouse_mote::frame::{self, Health, Message, Reset};
use sim::bus::{Bus, BusFault, Dma, Size};
use sim::machine::{Config, Machine, Stop};
use sim::mote::{Mote, Wall};
use sim::scum3c::{self, IRQ_GPIO8_HIGH, IRQ_GPIO9_LOW, IRQ_RF, IRQ_RFTIMER, NEEDED, Oscillators, Scum3c};
use sim::world::{Scene, World};
use xtask::flash::identity::{self, Change};
use xtask::flash::image;

use crate::firmware;
use crate::process::root;

/// Oscillators' aims in counts of 100 ms, and how far off they may be: HF 2,000,000 +- 3000 and 2M 200,000 +- 15
/// (SCuM-3C test code, optical.c:95-258), LC 250,187 (lighthouse_app.c:33) +- 40 ppm (IEEE 802.15.4).
const HF: (f64, f64) = (2_000_000.0, 3000.0);
const CHIP_CLOCK: (f64, f64) = (200_000.0, 15.0);
const LC: (f64, f64) = (250_187.0, 10.0);
/// What the boot ROM leaves (SCuM-3C test code: a mote that is not a lighthouse mote).
const BOOT_HZ: NonZeroU32 = NonZeroU32::new(5_000_000).unwrap();

/// How many chips are made.
const CHIPS: u64 = 20;
/// Seconds of light until all three oscillators of a chip are right: the first and the last of them, to half a second. The
/// radio's code moves once a second. docs/scum3c.md says so.
const TUNED_S: [f64; 2] = [6.5, 12.5];

/// Bits of the scan chain without which it is no lighthouse mote.
const NEEDED_BITS: usize = 60;

const ANALOG: u32 = 0x5200_0000;
const LDO: u32 = ANALOG + 10 * 0x4_0000;
const SCAN: u32 = ANALOG + 22 * 0x4_0000;
const RF_CONTROL: u32 = 0x4000_0000;
const TX_PACK_LEN: u32 = 0x4000_000C;
const COMPARE1: u32 = 0x4200_0014;

fn elf() -> Vec<u8> {
    firmware::scum3c(&root().join(firmware::DEFAULT_CALIB), "").expect("the firmware builds")
}

/// The default room's light in true seconds.
fn light(seconds: f64) -> Peekable<impl Iterator<Item = (f64, bool)>> {
    let mut scene = Scene { length_s: seconds, ..Scene::default() };
    (scene.clock.nominal_hz, scene.clock.error, scene.clock.drift_per_min, scene.clock.wander) = (10e6, 0.0, 0.0, 0.0);
    let mut world = World::new(&scene, 1);
    std::iter::from_fn(move || {
        let edge = world.next_edge()?;
        Some((world.seconds(edge.cycle), edge.level))
    })
    .peekable()
}

fn within((aim, tolerance): (f64, f64), counts: f64) -> bool {
    (counts - aim).abs() <= tolerance
}

fn healths(mote: &mut Mote) -> Vec<Health> {
    let frames: Vec<_> = mote.take_frames().collect();
    frames
        .iter()
        .filter_map(|sent| match frame::parse(&sent.bytes).expect("our frames").1 {
            Message::Health(health) => Some(health),
            _ => None,
        })
        .collect()
}

#[test]
fn every_chip_tunes_itself_to_the_rotors() {
    let elf = elf();
    for seed in 0..CHIPS {
        let chip = scum3c::Config { hclk_hz: BOOT_HZ, oscillators: Some(Oscillators::of(seed)), ..Default::default() };
        let mut mote = Mote::boot_on(&elf, chip).expect("an image");
        let mut wall = Wall::new(&mote);
        let mut light = light(31.0);
        let mut tuned_s = None;
        for half in 1..=60 {
            let next_s = f64::from(half) / 2.0;
            wall.run(&mut mote, &mut light, next_s).expect("the firmware runs");
            let chip = &mote.machine.bus;
            let counts = (f64::from(chip.hclk_hz().get()) / 5.0, chip.chip_clock_hz() / 10.0, chip.lc_hz() / 9600.0);
            let right = within(HF, counts.0) && within(CHIP_CLOCK, counts.1) && within(LC, counts.2);
            tuned_s = if right { tuned_s.or(Some(next_s)) } else { None };
        }
        let chip = &mut mote.machine.bus;
        let counts = (f64::from(chip.hclk_hz().get()) / 5.0, chip.chip_clock_hz() / 10.0, chip.lc_hz() / 9600.0);
        assert_eq!(chip.refused(), 0, "chip {seed}: {}", chip.refusals()[0]);
        let in_time = tuned_s.is_some_and(|s| (TUNED_S[0]..=TUNED_S[1]).contains(&s));
        assert!(in_time, "chip {seed}: tuned at {tuned_s:?} s, now HF, 2M, LC {counts:?}");
        let frames: Vec<_> = mote.take_frames().collect();
        // 15 reports a second but for the first seconds, in which the clock jumps.
        assert!(frames.len() > 300, "chip {seed}: {} frames", frames.len());
    }
}

/// The channel a programmer asked for: 2405 MHz and 5 MHz for each above 11 (IEEE 802.15.4-2006, 6.1.2.1).
#[test]
fn the_channel_that_was_asked_for_is_tuned_to() {
    let elf = elf();
    for (channel, seed) in [(11, 1), (18, 2), (26, 3)] {
        let elf = identity::patch(&elf, Change { channel: Some(channel), ..Change::default() }).expect("it is heeded");
        let chip = scum3c::Config { hclk_hz: BOOT_HZ, oscillators: Some(Oscillators::of(seed)), ..Default::default() };
        let mut mote = Mote::boot_on(&elf, chip).expect("an image");
        Wall::new(&mote).run(&mut mote, &mut light(40.0), 40.0).expect("the firmware runs");
        let (is_hz, aim_hz) = (mote.machine.bus.lc_hz(), 2405e6 + 5e6 * f64::from(channel - 11));
        assert!((is_hz / aim_hz - 1.0).abs() < 40e-6, "channel {channel}: {is_hz} instead of {aim_hz}");
    }
}

#[test]
fn the_radio_is_powered_while_it_sends_and_hardly_ever_else() {
    let elf = elf();
    let mut mote = Mote::boot_on(&elf, scum3c::Config::default()).expect("an image");
    Wall::new(&mote).run(&mut mote, &mut light(30.0), 30.0).expect("the firmware runs");
    let sent: Vec<_> = mote.take_frames().collect();
    let air: u64 = sent.iter().map(|sent| sent.end_cycle - sent.start_cycle).sum();
    let powered = mote.machine.bus.powered();
    // For each frame 100 us of settling and the handlers' way to it and back: measured 1450 cycles.
    let around = (powered.amplifier - air) / sent.len() as u64;
    assert!((1000..1600).contains(&around), "{powered:?}, on the air {air}, around a frame {around}");
    // One count of 50 ms.
    let counting = powered.oscillator - powered.amplifier;
    assert!((500_000..510_000).contains(&counting), "{powered:?}");
}

#[test]
fn every_interrupt_has_its_priority_and_no_other_line_is_on() {
    let mut mote = Mote::boot_on(&elf(), scum3c::Config::default()).expect("an image");
    mote.run_until(1_000_000).expect("the firmware runs");
    let nvic = &mote.machine.core.nvic;
    let lines = [4, 5, 10, 15, IRQ_RF, IRQ_RFTIMER];
    let on = lines.iter().fold(0, |on, line| on | 1 << line);
    assert_eq!(nvic.enabled_lines(), on | 1 << IRQ_GPIO8_HIGH, "in the dark");
    // Of four levels, 0 the most urgent, in the upper two bits: edges, then pulses, then radio, then the solver.
    let levels =
        [(IRQ_GPIO8_HIGH, 0), (IRQ_GPIO9_LOW, 0), (4, 1), (10, 1), (IRQ_RF, 2), (IRQ_RFTIMER, 2), (5, 3), (15, 3)];
    let of = |line: u32| nvic.priority_of(16 + line as u8);
    let urgency: Vec<_> = levels.iter().map(|&(line, level)| (of(line), level)).collect();
    for (a, b) in urgency.iter().flat_map(|a| urgency.iter().map(move |b| (a, b))) {
        assert_eq!(a.0.cmp(&b.0), a.1.cmp(&b.1), "{urgency:?}");
    }
    assert_eq!(nvic.priority_of(15), of(IRQ_GPIO8_HIGH), "the watchdog preempts all that can hang");
}

// --- a bring-up that is broken on purpose ---

/// A chip whose firmware writes something else than it meant to.
struct Tampered<R> {
    chip: Scum3c,
    /// Address, value, to what is really written.
    rule: R,
}

impl<R: FnMut(u32, u32) -> Option<u32>> Bus for Tampered<R> {
    fn read(&mut self, address: u32, size: Size, cycle: u64) -> Result<u32, BusFault> {
        self.chip.read(address, size, cycle)
    }

    fn write(&mut self, address: u32, size: Size, value: u32, cycle: u64) -> Result<(), BusFault> {
        match (self.rule)(address, value) {
            Some(value) => self.chip.write(address, size, value, cycle),
            None => Ok(()),
        }
    }

    fn lines(&self) -> u32 {
        self.chip.lines()
    }

    fn next_event(&self) -> u64 {
        self.chip.next_event()
    }

    fn advance(&mut self, cycle: u64) {
        self.chip.advance(cycle);
    }

    fn take_dma(&mut self) -> Option<Dma> {
        self.chip.take_dma()
    }

    fn give_dma(&mut self, bytes: &[u8]) {
        self.chip.give_dma(bytes);
    }
}

/// What the chip refuses of the firmware in the dark when its writes go through `rule`, and the frames it sends.
fn refused(elf: &[u8], cycles: u64, rule: impl FnMut(u32, u32) -> Option<u32>) -> (Vec<String>, usize) {
    let chip = Tampered { chip: Scum3c::new(scum3c::Config::default()), rule };
    let mut machine = Machine::new(Config::default(), chip);
    machine.load_elf(elf).expect("an image");
    assert_eq!(machine.run_until(cycles), Stop::Deadline);
    let said = machine.bus.chip.refusals().iter().map(ToString::to_string).collect();
    (said, machine.bus.chip.take_frames().len())
}

/// Long enough for the first health frame, which comes after a second.
const FIRST_FRAME: u64 = 12_000_000;
/// Long enough for the scan chain.
const LOADED: u64 = 200_000;

#[test]
fn a_firmware_that_leaves_out_a_step_of_the_bring_up_is_refused_by_name() {
    let elf = elf();
    let (said, frames) = refused(&elf, FIRST_FRAME, |_, value| Some(value));
    assert_eq!((said, frames), (vec![], 1), "as it is");
    type Rule = fn(u32, u32) -> Option<u32>;
    let broken: [(Rule, &str); 9] = [
        (
            |address, value| (address != LDO).then_some(value),
            "ANALOG_CFG 10 (0x52280000): ANALOG_CFG 10 is 0x0, not 0x28: LO and PA are not on",
        ),
        (
            |address, value| Some(if address == LDO { value & !0x8 } else { value }),
            "ANALOG_CFG 10 (0x52280000): ANALOG_CFG 10 is 0x20, not 0x28: LO and PA are not on",
        ),
        (
            |address, value| (address != ANALOG + 16 * 0x4_0000).then_some(value),
            "ANALOG_CFG 16 (0x52400000): ANALOG_CFG 16 is 0x0, not 0x6: the mixers are not off",
        ),
        (|address, value| (address != ANALOG + 11 * 0x4_0000).then_some(value), "ANALOG_CFG 11 (0x522c0000): "),
        // Settles for 10 instead of 100 us, and what the handlers take.
        (
            |address, value| Some(if address == COMPARE1 { value - 900 } else { value }),
            "RF CONTROL (0x40000000): a start ",
        ),
        (
            |address, value| Some(if address == TX_PACK_LEN { 128 } else { value }),
            "RF TX_PACK_LEN (0x4000000c): a length of 128 bytes; 1 to 127 are possible",
        ),
        (
            |address, value| Some(if (address, value) == (RF_CONTROL, 2) { 4 } else { value }),
            "ANALOG_CFG 10 (0x52280000): 0x28, not 0x18: LO and IF are not on",
        ),
        (
            |address, value| (address != SCAN).then_some(value),
            "ANALOG_CFG 22 (0x52580000): the scan chain was never loaded",
        ),
        (
            |address, value| (address != SCAN || value & 8 == 0).then_some(value),
            "ANALOG_CFG 22 (0x52580000): the scan chain was never loaded",
        ),
    ];
    for (rule, expected) in broken {
        let (said, frames) = refused(&elf, FIRST_FRAME, rule);
        assert_eq!(frames, 0, "{expected}");
        let first = said.first().unwrap_or_else(|| panic!("nothing was refused: {expected}"));
        let (cycle, why) = first.strip_prefix("cycle ").and_then(|rest| rest.split_once(": ")).expect("a cycle");
        assert!(cycle.parse::<u64>().is_ok_and(|cycle| cycle < FIRST_FRAME), "{first}");
        assert!(why.starts_with(expected), "{first}, not {expected}");
    }
}

#[test]
fn every_bit_of_the_chain_that_the_firmware_gets_wrong_is_named() {
    let elf = elf();
    assert_eq!(NEEDED.len(), NEEDED_BITS);
    for needed in NEEDED {
        // Shifted in from the last bit to the first; four writes for each, of which the last has both clock phases
        // behind it.
        let mut writes = 0;
        let (said, _) = refused(&elf, LOADED, |address, value| {
            let is_this = address == SCAN && writes / 4 == 1215 - u32::from(needed.bit);
            writes += u32::from(address == SCAN);
            Some(if is_this { value ^ 1 } else { value })
        });
        assert_eq!(said.len(), 1, "{needed:?}: {said:?}");
        assert!(said[0].contains(&format!("bit {} of the scan chain", needed.bit)), "{said:?}");
    }
}

#[test]
fn a_chain_that_lost_a_bit_on_the_way_is_refused() {
    let mut writes = 0;
    let (said, _) = refused(&elf(), LOADED, |address, value| {
        writes += u32::from(address == SCAN);
        (address != SCAN || writes / 4 != 600).then_some(value)
    });
    let first = said.first().expect("a refusal");
    assert!(first.ends_with("the scan chain was loaded after 1215 bits, not 1216"), "{first}");
}

// --- never silent ---

/// The first health frame of a packed image in the dark.
fn told(memory: &[u8]) -> Health {
    let mut mote = Mote::boot_image(memory, NonZeroU32::new(10_000_000).expect("a rate")).expect("an image that fits");
    // The check takes 0.2 s, the frame comes a second later.
    mote.run_until(15_000_000).expect("the firmware runs");
    *healths(&mut mote).first().expect("a health frame")
}

#[test]
fn an_image_with_a_wrong_byte_runs_and_says_so() {
    let elf = elf();
    let image = image::package(&elf).expect("it fits");
    assert_eq!(told(image.bytes()).reset, Reset::PowerOn, "a sound image");
    // A table's last byte; a byte of the CRC; a length beyond the memory.
    for (at, flip) in [(image.length() - 100, 0x10), (image::CRC_AT, 1), (image::LENGTH_AT + 2, 0x40)] {
        let mut memory = image.bytes().to_vec();
        memory[at] ^= flip;
        assert!(image::verify(&memory).is_err());
        assert_eq!(told(&memory).reset, Reset::Image, "byte {at:#x}");
    }
}

#[test]
fn an_image_that_nobody_packed_is_not_called_damaged() {
    let mut memory = image::package(&elf()).expect("it fits").bytes().to_vec();
    memory[image::LENGTH_AT..].fill(0);
    assert_eq!(told(&memory).reset, Reset::PowerOn);
}

/// Lets the firmware run in the dark, puts `instruction` at the start of `handler` and waits for the reset that follows;
/// what the first health frame after it says.
fn broken_in(elf: &[u8], handler: &str, instruction: u16) -> (Health, u32) {
    let mut mote = Mote::boot_on(elf, scum3c::Config::default()).expect("an image");
    mote.run_until(1_000_000).expect("the firmware runs");
    let at = mote.symbols.address(handler).expect("a handler of that name") & !1;
    let was = mote.machine.read_bytes(at, 2).expect("code").to_vec();
    mote.machine.write_bytes(at, &instruction.to_le_bytes()).expect("code");
    // The handler comes within a second, the watchdog after 5 to 7.
    let halted = mote.run_until(90_000_000).expect_err("it resets");
    assert_eq!(halted.stop, Stop::Reset, "{handler}");
    mote.machine.write_bytes(at, &was).expect("code");
    mote.machine.reset();
    drop(mote.take_frames());
    mote.run_until(halted.cycle + 15_000_000).expect("the firmware runs again");
    (*healths(&mut mote).first().expect("a health frame"), at)
}

#[test]
fn a_fault_resets_the_mote_which_tells_where_it_was() {
    const UNDEFINED: u16 = 0xDE00;
    let elf = elf();
    for handler in ["SOFT10", "SOFT5", "RF"] {
        let (health, at) = broken_in(&elf, handler, UNDEFINED);
        assert_eq!((health.reset, health.reset_detail), (Reset::Fault, at), "{handler}");
    }
}

#[test]
fn a_task_that_hangs_is_ended_by_the_watchdog() {
    const FOR_EVER: u16 = 0xE7FE;
    let elf = elf();
    // Of every priority but the edges'.
    for handler in ["SOFT10", "RFTIMER", "SOFT5"] {
        let (health, _) = broken_in(&elf, handler, FOR_EVER);
        assert_eq!(health.reset, Reset::Watchdog, "{handler}");
    }
}

#[test]
fn the_watchdog_is_quiet_in_the_light_and_in_the_dark() {
    let elf = elf();
    for hclk_hz in [5_000_000, 10_000_000, 20_000_000] {
        let hclk_hz = NonZeroU32::new(hclk_hz).expect("a rate");
        let mut mote = Mote::boot_on(&elf, scum3c::Config { hclk_hz, ..Default::default() }).expect("an image");
        let mut wall = Wall::new(&mote);
        wall.run(&mut mote, &mut light(15.0), 35.0).expect("no reset");
    }
}

#[test]
fn nothing_in_the_image_can_panic_and_what_a_panic_leaves_is_told() {
    let elf = elf();
    let mote = Mote::boot_on(&elf, scum3c::Config::default()).expect("an image");
    let panics: Vec<&str> = mote.symbols.iter().map(|(name, _)| name).filter(|name| name.contains("panic")).collect();
    assert!(panics.is_empty(), "{panics:?}");
    // One variable, or, as the compiler likes, one for each of its words in their order.
    let crumbs: Vec<u32> =
        mote.symbols.iter().filter(|(name, _)| name.contains("5CRUMB")).map(|(_, symbol)| symbol.address).collect();
    let place = |word: usize| crumbs.get(word).copied().unwrap_or(crumbs[0] + 4 * word as u32);
    for (kind, reset) in
        [(1, Reset::Panic), (2, Reset::Fault), (3, Reset::Panic), (4, Reset::Watchdog), (5, Reset::Fault)]
    {
        let mut mote = Mote::boot_on(&elf, scum3c::Config::default()).expect("an image");
        for (n, word) in [0x4C69_6768_u32, 1, kind, 4711].into_iter().enumerate() {
            mote.machine.write_bytes(place(n), &word.to_le_bytes()).expect("RAM that start-up leaves alone");
        }
        mote.run_until(15_000_000).expect("the firmware runs");
        let health = *healths(&mut mote).first().expect("a health frame");
        assert_eq!((health.reset, health.reset_detail), (reset, 4711));
    }
}
