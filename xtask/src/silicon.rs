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
// use xtask::flash::image;
// use xtask::flash::identity::{self, Change};

use crate::firmware;
use crate::process::root;

/// Oscillators' aims in counts of 100 ms, and how far off they may be: HF 2,000,000 +- 3000 and 2M 200,000 +- 15
/// (SCuM-3C test code, optical.c:95-258), LC 250,187 (lighthouse_app.c:33) +- 40 ppm (IEEE 802.15.4-2006, 6.9.6).
const HF: (f64, f64) = (2_000_000.0, 3000.0);
const CHIP_CLOCK: (f64, f64) = (200_000.0, 15.0);
const LC: (f64, f64) = (250_187.0, 10.0);
/// What the boot ROM leaves (SCuM-3C test code: a mote that is not a lighthouse mote).
const BOOT_HZ: NonZeroU32 = NonZeroU32::new(5_000_000).unwrap();

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
    let mut late = Vec::new();
    for seed in 0..20 {
        let chip = scum3c::Config { hclk_hz: BOOT_HZ, oscillators: Some(Oscillators::of(seed)), ..Default::default() };
        let mut mote = Mote::boot_on(&elf, chip).expect("an image");
        let mut wall = Wall::new(&mote);
        let mut light = light(60.0);
        let mut tuned_s = None;
        while wall.seconds() < 40.0 {
            let next_s = wall.seconds() + 0.5;
            wall.run(&mut mote, &mut light, next_s).expect("the firmware runs");
            let chip = &mote.machine.bus;
            let counts = (f64::from(chip.hclk_hz().get()) / 5.0, chip.chip_clock_hz() / 10.0, chip.lc_hz() / 9600.0);
            let right = within(HF, counts.0) && within(CHIP_CLOCK, counts.1) && within(LC, counts.2);
            tuned_s = if right { tuned_s.or(Some(next_s)) } else { None };
            if right && next_s > 30.0 {
                break;
            }
        }
        let chip = &mut mote.machine.bus;
        let counts = (f64::from(chip.hclk_hz().get()) / 5.0, chip.chip_clock_hz() / 10.0, chip.lc_hz() / 9600.0);
        assert_eq!(chip.refused(), 0, "chip {seed}: {}", chip.refusals()[0]);
        println!("chip {seed}: tuned after {tuned_s:?} s, HF {:.0}, 2M {:.1}, LC {:.1}", counts.0, counts.1, counts.2);
        late.push(tuned_s.unwrap_or_else(|| panic!("chip {seed} was not tuned: HF, 2M, LC {counts:?}")));
        let frames: Vec<_> = mote.take_frames().collect();
        // 15 reports a second but for the first seconds, in which the clock jumps.
        assert!(frames.len() > 300, "chip {seed}: {} frames", frames.len());
    }
    assert!(late.iter().all(|&s| s <= 30.0), "{late:?}");
}
