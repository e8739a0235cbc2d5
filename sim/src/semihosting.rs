//! Semihosting: what a program says to the debugger that it believes is there.
//!
//! `BKPT 0xAB` with an operation in R0 and its parameters in R1. Firmware for the mote does not use it; test programs
//! that also run in QEMU do.
//!
//! What can go wrong: only the console exists. An operation that is not listed here answers -1, as for a debugger that
//! does not know it; a parameter block outside memory does too.

use crate::memory::Memory;

/// The immediate of the BKPT instruction that asks for semihosting.
pub(crate) const BREAKPOINT: u8 = 0xAB;

const SYS_OPEN: u32 = 0x01;
const SYS_CLOSE: u32 = 0x02;
const SYS_WRITEC: u32 = 0x03;
const SYS_WRITE0: u32 = 0x04;
const SYS_WRITE: u32 = 0x05;
const SYS_CLOCK: u32 = 0x10;
const SYS_ERRNO: u32 = 0x13;
const SYS_EXIT: u32 = 0x18;
const SYS_EXIT_EXTENDED: u32 = 0x20;

const APPLICATION_EXIT: u32 = 0x2_0026;
const FAILED: u32 = u32::MAX;
const CONSOLE_NAME: &[u8] = b":tt";
const STDIN: u32 = 1;
const STDOUT: u32 = 2;
const STDERR: u32 = 3;

/// What an operation does to the program.
pub(crate) enum Answer {
    /// It goes on with this in R0.
    Continue(u32),
    /// It ends.
    Exit(i32),
}

/// The console of a program, seen from the other side.
#[derive(Debug, Clone, Default)]
pub struct Semihosting {
    /// What the program wrote to its standard output.
    pub output: Vec<u8>,
    /// What the program wrote to its standard error.
    pub errors: Vec<u8>,
}

impl Semihosting {
    pub(crate) fn serve(
        &mut self,
        operation: u32,
        parameter: u32,
        memory: &Memory,
        centiseconds: impl Fn() -> u32,
    ) -> Answer {
        let answer = match operation {
            SYS_EXIT => return Answer::Exit(exit_code(parameter, 0)),
            SYS_EXIT_EXTENDED => match words(memory, parameter) {
                Some([reason, code]) => return Answer::Exit(exit_code(reason, code as i32)),
                None => None,
            },
            SYS_OPEN => open(memory, parameter),
            SYS_CLOSE | SYS_ERRNO => Some(0),
            SYS_WRITEC => memory.read(parameter).map(|[byte]| {
                self.output.push(byte);
                parameter
            }),
            SYS_WRITE0 => self.write_string(memory, parameter),
            SYS_WRITE => self.write(memory, parameter),
            SYS_CLOCK => Some(centiseconds()),
            _ => None,
        };
        Answer::Continue(answer.unwrap_or(FAILED))
    }

    fn write(&mut self, memory: &Memory, parameter: u32) -> Option<u32> {
        let [handle, address, length] = words(memory, parameter)?;
        let Some(bytes) = memory.slice(address, length as usize) else {
            return Some(length);
        };
        match handle {
            STDOUT => self.output.extend_from_slice(bytes),
            STDERR => self.errors.extend_from_slice(bytes),
            _ => return Some(length),
        }
        Some(0)
    }

    fn write_string(&mut self, memory: &Memory, parameter: u32) -> Option<u32> {
        for address in parameter.. {
            match memory.read(address)? {
                [0] => break,
                [byte] => self.output.push(byte),
            }
        }
        Some(parameter)
    }
}

fn words<const N: usize>(memory: &Memory, address: u32) -> Option<[u32; N]> {
    let mut words = [0; N];
    for (word, i) in words.iter_mut().zip(0..) {
        *word = u32::from_le_bytes(memory.read(address.checked_add(4 * i)?)?);
    }
    Some(words)
}

fn open(memory: &Memory, parameter: u32) -> Option<u32> {
    let [name, mode, length] = words(memory, parameter)?;
    let is_console = memory.slice(name, length as usize)? == CONSOLE_NAME;
    match mode {
        _ if !is_console => None,
        0..4 => Some(STDIN),
        4..8 => Some(STDOUT),
        8..12 => Some(STDERR),
        _ => None,
    }
}

fn exit_code(reason: u32, code: i32) -> i32 {
    if reason == APPLICATION_EXIT { code } else { 1 }
}
