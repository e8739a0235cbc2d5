//! How many instructions a second the core runs on this computer.
//!
//! Without an argument it runs a loop of arithmetic, memory and calls; with the path of an ELF file (and optionally
//! seconds of simulated time) it runs that program.
//!
//! What can go wrong: a program with devices faults, because there are none here.

use std::time::Instant;

use sim::machine::{Config, Machine, NoDevices, Stop};
use sim::memory::MemoryMap;

const LOOP: [u16; 14] = [
    0x2100, // movs r1, #0
    0x2280, // movs r2, #128
    0x0592, // lsls r2, r2, #22   ; 0x2000_0000
    0x1C49, // loop: adds r1, r1, #1
    0x404B, // eors r3, r1
    0x6013, // str r3, [r2]
    0x6814, // ldr r4, [r2]
    0xF000, 0xF802, // bl function
    0x42A1, // cmp r1, r4
    0xE7F7, // b loop
    0x1865, // function: adds r5, r4, r1
    0x4770, // bx lr
    0xBE00, // bkpt
];

fn main() {
    let mut arguments = std::env::args().skip(1);
    let config = Config {
        memory: MemoryMap { code_bytes: 0x4_0000, data_bytes: 0x1_0000 },
        semihosting: true,
        ..Config::default()
    };
    let mut machine = Machine::new(config, NoDevices);
    let deadline = match arguments.next() {
        Some(path) => {
            let file = std::fs::read(&path).expect("the ELF file is readable");
            machine.load_elf(&file).expect("the ELF file fits the chip");
            let seconds: f64 = arguments.next().map_or(60.0, |text| text.parse().expect("seconds are a number"));
            (seconds * 10e6) as u64
        }
        None => {
            machine.write_bytes(0, &[0, 0, 1, 0x20, 9, 0, 0, 0]);
            for (half, at) in LOOP.iter().zip((8..).step_by(2)) {
                machine.write_bytes(at, &half.to_le_bytes());
            }
            machine.reset();
            600_000_000
        }
    };
    let began = Instant::now();
    let stop = machine.run_until(deadline);
    let seconds = began.elapsed().as_secs_f64();
    let (instructions, cycles) = (machine.instructions(), machine.cycles());
    println!("{instructions} instructions, {cycles} cycles in {seconds:.3} s");
    println!("{:.1} MIPS, {:.1} MHz", instructions as f64 / seconds / 1e6, cycles as f64 / seconds / 1e6);
    if stop != Stop::Deadline {
        println!("stopped early: {stop}");
    }
}
