//! The same light on another board: every edge as the virtual SCuM-3C stamped it, played to the `microbit` in QEMU, whose
//! fixes must be the same to the bit.
//!
//! A stamp of the SCuM-3C is late by its handler's latency, so the stamps themselves are the stream, and with them the
//! times at which it was told that a second has passed: what a mote makes of the dark depends on when it looks.
//!
//! What can go wrong: more light than the board's flash holds; an image without the names that are looked for; a QEMU
//! that hangs. And what this is for: a fix that differs.

use std::fs;
use std::path::Path;
use std::time::Duration;

use anyhow::{Context, Result, bail, ensure};
use lighthouse_mote::frame::{self, Message, Report};
use sim::bus::{Bus, Size};
use sim::mote::Mote;
use xtask::pcap::Frame;

use crate::qemu::{self, Wires};
use crate::{firmware, setup};

/// Where the stream lies in flash, and its room in words (`src/bin/microbit/player.rs`).
const STREAM_AT: u32 = 0x1_0000;
const STREAM_WORDS: usize = 0xc000;
/// How long QEMU may take for a second of light, beyond [`PATIENCE`]; it needs a tenth.
const PATIENCE_PER_S: f64 = 10.0;
const PATIENCE: Duration = Duration::from_secs(60);

/// The radio timer's counter, first compare value and what a match does (`src/bin/scum3c/pac.rs`).
const COUNTER: u32 = 0x4200_0004;
const COMPARE: u32 = 0x4200_0010;
const COMPARE_CONTROL: u32 = 0x4200_0030;
/// The exception number of the task that is told of a second: 16 + line 10.
const SECOND: u8 = 26;
/// Longest from the alarm to the task, cycles: a whole classification is a hundredth of that.
const ALARM_TO_TASK: u64 = 200_000;
/// The capture's queue (`src/bin/scum3c/capture.rs`): pulses written so far, how many fit, and where they lie in it.
const QUEUE: &str = "7capture5QUEUE";
const WRITTEN: u32 = 4;
const PULSES: u32 = 16;
const FIRST: u32 = 16;
/// So often that the queue never comes round unseen, seconds: it holds 44 ms of light.
pub(super) const LOOK_S: f64 = 0.01;

/// What the virtual SCuM-3C stamped.
#[derive(Debug, Clone, Default)]
pub(super) struct Stamps {
    queue: Option<u32>,
    read: u32,
    /// Rises and falls in turn, in ticks.
    edges: Vec<u32>,
    /// When it was told that a second has passed.
    seconds: Vec<u32>,
}

impl Stamps {
    /// Runs the mote to `cycle` and takes down what it stamps.
    pub(super) fn run_until(&mut self, mote: &mut Mote, cycle: u64) -> Result<()> {
        loop {
            let alarm = alarm(mote)?;
            if alarm >= cycle {
                mote.run_until(cycle)?;
                break;
            }
            mote.run_until(alarm)?;
            let second = second(mote, alarm + ALARM_TO_TASK)?;
            self.seconds.push(second);
        }
        self.take_pulses(mote)
    }

    fn take_pulses(&mut self, mote: &Mote) -> Result<()> {
        let named = || mote.symbols.iter().find(|(name, _)| name.contains(QUEUE)).map(|(_, symbol)| symbol.address);
        let queue = self.queue.or_else(named).context("the image has no queue of pulses")?;
        self.queue = Some(queue);
        let word = |at: u32| mote.machine.read_word(queue + at).context("the queue of pulses lies in no memory");
        let written = word(WRITTEN)?;
        // Cleared by start-up; before, it is whatever power-on left.
        if self.edges.is_empty() && written > PULSES {
            return Ok(());
        }
        ensure!(written.wrapping_sub(self.read) <= PULSES, "pulses came faster than they were looked at");
        while self.read != written {
            let at = FIRST + self.read % PULSES * 8;
            self.edges.extend([word(at)?, word(at + 4)?]);
            self.read = self.read.wrapping_add(1);
        }
        Ok(())
    }

    /// As the board wants it: how many of each, and both.
    fn stream(&self) -> Result<Vec<u8>> {
        let words = 2 + self.edges.len() + self.seconds.len();
        ensure!(
            words <= STREAM_WORDS,
            "{words} words of light, and the board has room for {STREAM_WORDS}: less --seconds"
        );
        let counts = [self.edges.len() as u32, self.seconds.len() as u32];
        let all = counts.iter().chain(&self.edges).chain(&self.seconds);
        Ok(all.flat_map(|word| word.to_le_bytes()).collect())
    }
}

/// The cycle at which the next second is over by the mote's clock; never, where no alarm is set.
fn alarm(mote: &mut Mote) -> Result<u64> {
    let now = mote.machine.cycles();
    let mut read = |address| mote.machine.bus.read(address, Size::Word, now).ok().context("no radio timer");
    if read(COMPARE_CONTROL)? == 0 {
        return Ok(u64::MAX);
    }
    let ahead = read(COMPARE)?.wrapping_sub(read(COUNTER)?);
    // One that has passed is a whole turn of the counter away.
    Ok(now + u64::from(ahead))
}

/// Steps on until the task reads the clock; what it reads.
fn second(mote: &mut Mote, deadline: u64) -> Result<u32> {
    while mote.machine.cycles() < deadline {
        let registers = &mote.machine.core.registers;
        let from = (registers.ipsr == SECOND).then(|| loads_from_counter(mote)).flatten();
        mote.run_until(mote.machine.cycles() + 1)?;
        if let Some(register) = from {
            return Ok(mote.machine.core.registers.read(register));
        }
    }
    bail!("the mote's alarm rang, and nobody was told that a second has passed")
}

/// The register that the next instruction loads the counter into: LDR with an offset or an index (ARMv6-M ARM, A6.7.26,
/// A6.7.28).
fn loads_from_counter(mote: &Mote) -> Option<u8> {
    let registers = &mote.machine.core.registers;
    let bytes = mote.machine.read_bytes(registers.pc, 2)?;
    let code = u16::from_le_bytes([bytes[0], bytes[1]]);
    let field = |at: u32| (code >> at & 7) as u8;
    let address = match code >> 9 {
        0x2c => registers.read(field(3)).wrapping_add(registers.read(field(6))),
        0x34..=0x37 => registers.read(field(3)).wrapping_add(u32::from(code >> 6 & 31) * 4),
        _ => return None,
    };
    (address == COUNTER).then_some(field(0))
}

/// Plays the stamps to the board, with the lines of `mote` as the other one had them, and holds its fixes against those
/// among `frames`; how many there were.
pub(super) fn follow(stamps: &Stamps, frames: &[Frame], calib: &Path, mote: &str, seconds: f64) -> Result<usize> {
    setup::emulator()?;
    let stream = stamps.stream()?;
    let elf = firmware::build("microbit", calib, mote)?;
    let folder = tempfile::tempdir().context("a folder for the board's light")?;
    let (light, serial) = (folder.path().join("light.bin"), folder.path().join("frames.bin"));
    fs::write(&light, stream).with_context(|| light.display().to_string())?;
    println!("microbit in QEMU: {} edges, {} seconds", stamps.edges.len(), stamps.seconds.len());
    let wires = Wires { serial: Some(&serial), flash: Some((&light, STREAM_AT)) };
    let code = qemu::run(&elf, &wires, PATIENCE + Duration::from_secs_f64(seconds * PATIENCE_PER_S))?;
    ensure!(code == 0, "the board's program ended with {code}");
    let bytes = fs::read(&serial).with_context(|| serial.display().to_string())?;
    let theirs = unpack(&bytes)?;
    let ours: Vec<&[u8]> = frames.iter().map(|frame| &frame.bytes[..]).collect();
    same(&fixes(&ours)?, &fixes(&theirs)?)
}

/// Frames, each behind its length.
fn unpack(mut bytes: &[u8]) -> Result<Vec<&[u8]>> {
    let mut frames = Vec::new();
    while let Some((length, rest)) = bytes.split_first() {
        let (frame, rest) = rest.split_at_checked(usize::from(*length)).context("the board's last frame is cut off")?;
        frames.push(frame);
        bytes = rest;
    }
    Ok(frames)
}

fn fixes(frames: &[&[u8]]) -> Result<Vec<Report>> {
    let mut fixes = Vec::new();
    for frame in frames {
        match frame::parse(frame) {
            Ok((_, Message::Fix(report))) => fixes.push(report),
            Ok(_) => {}
            Err(reject) => bail!("a frame that cannot be read: {reject}"),
        }
    }
    Ok(fixes)
}

/// How many fixes there are, if they are the same on both: every field, losses included. Their sequence numbers are
/// not, they count frames of health between.
fn same(ours: &[Report], theirs: &[Report]) -> Result<usize> {
    ensure!(!ours.is_empty(), "no fix on either board");
    for (n, (ours, theirs)) in ours.iter().zip(theirs).enumerate() {
        ensure!(ours == theirs, "fix {n} differs:\n  scum3c   {ours:?}\n  microbit {theirs:?}");
    }
    ensure!(ours.len() == theirs.len(), "{} fixes of the SCuM-3C, {} of the microbit", ours.len(), theirs.len());
    Ok(ours.len())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::process::root;

    #[test]
    fn a_fix_that_differs_in_one_bit_is_named() {
        let fixes = vec![Report::default(); 3];
        assert_eq!(same(&fixes, &fixes).ok(), Some(3));
        let mut theirs = fixes.clone();
        theirs[1].time ^= 1;
        assert!(same(&fixes, &theirs).expect_err("one differs").to_string().starts_with("fix 1 differs"));
        assert!(same(&fixes, &fixes[..2]).is_err());
        assert!(same(&[], &[]).is_err());
    }

    #[test]
    fn another_board_takes_fewer_than_150_lines() {
        // Lines of code; without what says why.
        let folder = root().join("src/bin/microbit");
        let lines: usize = fs::read_dir(folder)
            .expect("the board is there")
            .map(|file| fs::read_to_string(file.expect("a file").path()).expect("it can be read"))
            .map(|text| text.lines().map(str::trim).filter(|line| !line.is_empty() && !line.starts_with("//")).count())
            .sum();
        assert!((1..150).contains(&lines), "{lines} lines");
    }
}
