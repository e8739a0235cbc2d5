//! How many instructions a second the core runs on this computer.
//!
//! Without an argument it runs a loop of arithmetic, memory and calls; with the path of an ELF file and the name of a
//! function in it, it calls that function again and again.
//!
//! What can go wrong: a function that uses devices faults, because there are none here. On a computer that is busy
//! with other things the number says more about them.

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

const CYCLES: u64 = 600_000_000;

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let config = Config { memory: MemoryMap { code_bytes: 0x4_0000, data_bytes: 0x1_0000 }, ..Config::default() };
    let mut machine = Machine::new(config, NoDevices);
    let began = Instant::now();
    match arguments.as_slice() {
        [path, function] => {
            let file = std::fs::read(path).expect("the ELF file is readable");
            let symbols = machine.load_elf(&file).expect("the program fits the chip");
            machine.initialise_variables();
            let address = symbols.address(function).expect("the program has the function");
            while machine.cycles() < CYCLES {
                machine.call(address, &[]).expect("the function returns");
            }
        }
        _ => {
            machine.write_bytes(0, &[0, 0, 1, 0x20, 9, 0, 0, 0]);
            for (half, at) in LOOP.iter().zip((8..).step_by(2)) {
                machine.write_bytes(at, &half.to_le_bytes());
            }
            machine.reset();
            assert_eq!(machine.run_until(CYCLES), Stop::Deadline);
        }
    }
    let seconds = began.elapsed().as_secs_f64();
    let (instructions, cycles) = (machine.instructions(), machine.cycles());
    println!("{instructions} instructions, {cycles} cycles in {seconds:.3} s");
    println!("{:.1} MIPS, {:.1} MHz", instructions as f64 / seconds / 1e6, cycles as f64 / seconds / 1e6);
}
