//! The programmers' side of the line, played over a pseudo-terminal: checks every byte, and misbehaves on demand.

use std::fs::File;
use std::io::{Read, Write};
use std::thread::{JoinHandle, sleep, spawn};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};

use crate::pty;

/// A player that hears nothing for so long is in a test that has failed: a build may come first.
const PATIENCE: Duration = Duration::from_secs(900);

/// What the player does instead of answering.
#[derive(Debug, Clone)]
pub enum Mischief {
    /// Nothing.
    Silence,
    /// Something else.
    Say(&'static [u8]),
    /// The right thing, later; nothing if the tool has closed the line before.
    Late(Duration),
    /// The right thing, byte by byte.
    Dribble,
    /// It is gone.
    Vanish,
}

/// The programmer's end of a line.
pub struct Player {
    line: Option<File>,
    /// How many bytes it takes at once.
    pub gulp: usize,
    /// At which of its answers, counted from 0, it does what else.
    pub mischief: Option<(usize, Mischief)>,
    answers: usize,
    /// The tool opens and closes the line more than once.
    pub reopened: bool,
}

/// A line: where the tool finds it, and who is at its other end.
pub fn line() -> (String, Player) {
    let (line, name) = pty::open();
    // As a serial port is: without an echo.
    let mut settings = tcgetattr(&line).expect("a line has settings");
    settings.make_raw();
    tcsetattr(&line, OptionalActions::Now, &settings).expect("a line takes settings");
    (name, Player { line: Some(line.into()), gulp: 4096, mischief: None, answers: 0, reopened: false })
}

impl Player {
    /// Lets it play in its own thread.
    pub fn play<T: Send + 'static>(mut self, play: impl FnOnce(&mut Self) -> T + Send + 'static) -> JoinHandle<T> {
        spawn(move || play(&mut self))
    }

    /// The rate at which the tool set the line.
    pub fn baud(&self) -> u32 {
        tcgetattr(self.line.as_ref().expect("still there")).expect("a line has settings").output_speed()
    }

    /// Puts bytes on the line unasked.
    pub fn noise(&mut self, bytes: &[u8]) {
        self.line.as_mut().expect("still there").write_all(bytes).expect("the line takes bytes");
    }

    /// The next byte; `None` when the tool has gone for good, or the player has.
    pub fn byte(&mut self) -> Option<u8> {
        self.bytes(1).map(|bytes| bytes[0])
    }

    /// The next so many bytes.
    pub fn bytes(&mut self, count: usize) -> Option<Vec<u8>> {
        let mut bytes = Vec::new();
        let until = Instant::now() + PATIENCE;
        while bytes.len() < count {
            assert!(Instant::now() < until, "{} of {count} bytes came", bytes.len());
            let line = self.line.as_mut()?;
            let mut ready = [PollFd::new(line, PollFlags::IN)];
            let limit = Timespec { tv_sec: 0, tv_nsec: 100_000_000 };
            poll(&mut ready, Some(&limit)).expect("a line can be waited for");
            if !ready[0].revents().contains(PollFlags::IN) {
                if ready[0].revents().contains(PollFlags::HUP) {
                    if !self.reopened {
                        return None;
                    }
                    sleep(Duration::from_millis(5));
                }
                continue;
            }
            let mut piece = vec![0; (count - bytes.len()).min(self.gulp)];
            match line.read(&mut piece) {
                Ok(0) | Err(_) => return None,
                Ok(got) => bytes.extend(&piece[..got]),
            }
        }
        Some(bytes)
    }

    /// Whether the tool closes the line within this time.
    fn is_left_within(&self, limit: Duration) -> bool {
        let line = self.line.as_ref().expect("still there");
        // A line that was left is told without being asked for.
        let mut left = [PollFd::new(line, PollFlags::empty())];
        let limit = Timespec { tv_sec: limit.as_secs() as i64, tv_nsec: limit.subsec_nanos().into() };
        poll(&mut left, Some(&limit)).expect("a line can be waited for") > 0
    }

    /// Stays until the tool has closed the line.
    fn linger(&mut self) {
        if !self.reopened {
            assert_eq!(self.byte(), None, "more after the end");
            return;
        }
        // The next mote's first byte may come before the closing was seen: it is left to whoever plays that.
        let line = self.line.as_ref().expect("still there");
        let mut ready = [PollFd::new(line, PollFlags::IN)];
        let limit = Timespec { tv_sec: PATIENCE.as_secs() as i64, tv_nsec: 0 };
        poll(&mut ready, Some(&limit)).expect("a line can be waited for");
        assert!(!ready[0].revents().is_empty(), "the tool neither went nor went on");
    }

    /// A line of text with its end.
    pub fn text(&mut self) -> Option<String> {
        let mut line = Vec::new();
        loop {
            line.push(self.byte()?);
            if line.ends_with(b"\n") {
                return Some(String::from_utf8(line).expect("commands are text"));
            }
        }
    }

    /// Answers, unless it is time for mischief.
    pub fn answer(&mut self, right: &[u8]) {
        let now = self.answers;
        self.answers += 1;
        let mischief = self.mischief.clone().filter(|(at, _)| *at == now).map(|(_, mischief)| mischief);
        match mischief {
            None => self.noise(right),
            Some(Mischief::Silence) => {}
            Some(Mischief::Say(bytes)) => self.noise(bytes),
            Some(Mischief::Late(by)) => {
                if !self.is_left_within(by) {
                    self.noise(right);
                }
            }
            Some(Mischief::Dribble) => {
                for byte in right {
                    sleep(Duration::from_millis(5));
                    self.noise(&[*byte]);
                }
            }
            Some(Mischief::Vanish) => self.line = None,
        }
    }
}

/// What a programmer took.
#[derive(Debug, Default, Clone, PartialEq, Eq)]
pub struct Taken {
    /// What went on to the mote.
    pub memory: Vec<u8>,
    pub booted: bool,
    pub calibrated: bool,
}

/// The nRF52840-DK: state by state what its firmware does with bytes, written from its description.
pub fn nrf_dk(player: &mut Player) -> Taken {
    let mut taken = Taken::default();
    let mut frame: Option<Vec<u8>> = None;
    while let Some(byte) = player.byte() {
        match (&mut frame, byte) {
            (None, 0x7E) => frame = Some(Vec::new()),
            (None, other) => panic!("{other:#04x} outside of a frame"),
            (Some(bytes), 0x7E) if bytes.is_empty() => {}
            (Some(bytes), 0x7E) => {
                let payload = unstuffed(bytes);
                frame = None;
                assert_eq!(player.baud(), 460_800);
                command(&mut taken, &payload);
                player.answer(b"ACK\n");
                if taken.calibrated {
                    player.linger();
                    return taken;
                }
            }
            (Some(bytes), byte) => bytes.push(byte),
        }
    }
    taken
}

/// Payload of a frame whose check sequence must be right: the residue of CRC-16/X-25 is 0xF0B8.
fn unstuffed(bytes: &[u8]) -> Vec<u8> {
    let mut plain = Vec::new();
    let mut rest = bytes.iter();
    while let Some(&byte) = rest.next() {
        plain.push(match byte {
            0x7D => match rest.next() {
                Some(0x5E) => 0x7E,
                Some(0x5D) => 0x7D,
                other => panic!("{other:?} behind an escape"),
            },
            byte => byte,
        });
    }
    let residue = plain.iter().fold(0xFFFF_u16, |fcs, byte| {
        (0..8).fold(fcs ^ u16::from(*byte), |fcs, _| if fcs & 1 == 1 { fcs >> 1 ^ 0x8408 } else { fcs >> 1 })
    });
    assert_eq!(residue, 0xF0B8, "check sequence");
    plain.truncate(plain.len() - 2);
    plain
}

fn command(taken: &mut Taken, payload: &[u8]) {
    match payload {
        [1] => *taken = Taken::default(),
        [2, chunk @ ..] => {
            assert_eq!(chunk.len(), 1024, "bytes of a chunk");
            taken.memory.extend(chunk);
            assert!(taken.memory.len() <= 65_536, "more than a memory");
        }
        [3] => taken.booted = true,
        [4] => {
            assert!(taken.booted, "calibrated before it was booted");
            taken.calibrated = true;
        }
        other => panic!("{} bytes are no command, the first: {:?}", other.len(), other.first()),
    }
}

/// The Teensy: command by command.
pub fn teensy(player: &mut Player) -> Taken {
    let mut taken = Taken::default();
    let mut encoded = false;
    let mut light = Vec::new();
    while let Some(line) = player.text() {
        match line.as_str() {
            "transfersram\n" => {
                assert_eq!(player.baud(), 19_200);
                player.answer(b"Executing SRAM Transfer - SCM3B Rev 2\r\n");
                match player.bytes(65_536) {
                    Some(bytes) => taken.memory = bytes,
                    None => return taken,
                }
            }
            "insertcrc\n" => insert_crc(&mut taken.memory),
            "configopt\n" => light = (0..4).filter_map(|_| player.text()).collect(),
            "encode4b5b\n" => encoded = true,
            "bootopt4b5b\n" => {
                assert!(encoded, "booted before it was encoded");
                assert_eq!(light, ["80\n", "80\n", "3\n", "80\n"]);
                taken.booted = true;
                player.answer(b"Optical Boot Complete\r\n");
            }
            "boot3wb\n" => {
                assert!(!encoded && light.is_empty(), "light for a wire");
                taken.booted = true;
                player.answer(b"3WB Bootload Complete\r\n");
            }
            "opti_cal\n" | "3wb_cal\n" => {
                assert!(taken.booted && encoded == (line == "opti_cal\n"), "{line:?} at the wrong time");
                taken.calibrated = true;
                player.linger();
                return taken;
            }
            other => panic!("{other:?} is no command"),
        }
    }
    taken
}

/// Computes the CRC bit by bit, highest first, of as many bytes as the two at 0xFFF8 say: the other way round than the
/// tool does.
fn insert_crc(memory: &mut [u8]) {
    let length = usize::from(u16::from_le_bytes([memory[0xFFF8], memory[0xFFF9]]));
    let crc = memory[..length].iter().fold(u32::MAX, |crc, byte| {
        let crc = crc ^ u32::from(byte.reverse_bits()) << 24;
        (0..8).fold(crc, |crc, _| if crc >> 31 == 1 { crc << 1 ^ 0x04C1_1DB7 } else { crc << 1 })
    });
    memory[0xFFFC..].copy_from_slice(&(!crc).reverse_bits().to_le_bytes());
}
