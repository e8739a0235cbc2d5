//! Lines on the semihosting console.

use core::arch::asm;

const SYS_WRITE0: u32 = 0x04;
const SYS_EXIT_EXTENDED: u32 = 0x20;
const APPLICATION_EXIT: u32 = 0x2_0026;

fn ask(operation: u32, parameter: *const u8) {
    // SAFETY: the operations used here only read what the parameter points at.
    unsafe { asm!("bkpt 0xAB", inout("r0") operation => _, in("r1") parameter) }
}

struct Line {
    text: [u8; 256],
    length: usize,
}

impl Line {
    fn push(&mut self, byte: u8) {
        if let Some(place) = self.text.get_mut(self.length) {
            *place = byte;
            self.length += 1;
        }
    }
}

/// Prints a name and words.
pub fn say(name: &str, words: &[u32]) {
    let mut line = Line { text: [0; 256], length: 0 };
    name.bytes().for_each(|byte| line.push(byte));
    for word in words {
        line.push(b' ');
        for shift in (0..8).rev() {
            let digit = (word >> (4 * shift) & 15) as u8;
            line.push(if digit < 10 { b'0' + digit } else { b'a' - 10 + digit });
        }
    }
    line.push(b'\n');
    line.push(0);
    ask(SYS_WRITE0, line.text.as_ptr());
}

/// Ends the program.
pub fn exit(code: u32) -> ! {
    let block = [APPLICATION_EXIT, code];
    ask(SYS_EXIT_EXTENDED, block.as_ptr().cast());
    loop {
        core::hint::spin_loop();
    }
}
