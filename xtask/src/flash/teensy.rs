//! The Teensy as programmer of a SCuM-3C, by light or over its three-wire bus.
//!
//! Facts from PisterLab/scum-test-code (scm_v3c/teensy_uC_programmer/teensy_uC_programmer.ino, scm_v3c/bootload.py):
//! lines of text, nominally at 19,200 baud over USB. `transfersram` is answered by a line and takes 65,536 bytes as they
//! are; `insertcrc` computes the CRC of as many bytes as the image says and writes it into the image, without a word;
//! `configopt` takes four numbers, the lengths of light and dark of a one and of a zero; `encode4b5b` is silent;
//! `bootopt4b5b` answers when the light has been sent, `boot3wb` when the wires have; `opti_cal` and `3wb_cal` give 30
//! marks 100 ms apart, silently.
//!
//! What can go wrong: see [`Trouble`]. The Teensy checks nothing, so only the mote itself can find a byte that went
//! wrong, by the CRC. Interrupted in `transfersram` it goes on waiting for bytes until it is unplugged.

use std::thread::sleep;
use std::time::Duration;

use anyhow::{Context, Result};

use super::image::{self, Image};
use super::line::{Line, Trouble};
use super::{Progress, Timing};

/// What its own script says; USB does not care.
pub const BAUD: u32 = 19_200;

/// Light and dark of a one, light and dark of a zero, in turns of an empty loop on the Teensy. The third is the delicate
/// one: 2, 3 and 4 all occur; too short, and the receiver loses pulses.
const LIGHT: &str = "configopt\n80\n80\n3\n80\n";

/// How often the bar moves.
const PIECE: usize = 1024;

/// How the image reaches the mote.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Way {
    /// The LED.
    Light,
    /// Three wires.
    Wire,
}

/// Sends the image, boots and calibrates the mote.
///
/// # Errors
/// [`Trouble`], and at what.
pub fn program(line: &mut Line, image: &Image, way: Way, timing: &Timing, progress: Progress<'_>) -> Result<()> {
    transferring(line, timing.answer).context("asking for the transfer")?;
    for (n, piece) in image.bytes().chunks(PIECE).enumerate() {
        let sent = n * PIECE;
        progress(sent);
        line.send(piece).with_context(|| format!("after {sent} of {} bytes", image::LEN))?;
    }
    progress(image::LEN);
    line.send(b"insertcrc\n").context("asking for the CRC")?;
    let (boot, done, calibrate): (&[&[u8]], _, &[u8]) = match way {
        Way::Light => (&[LIGHT.as_bytes(), b"encode4b5b\n", b"bootopt4b5b\n"], "Optical Boot Complete", b"opti_cal\n"),
        Way::Wire => (&[b"boot3wb\n"], "3WB Bootload Complete", b"3wb_cal\n"),
    };
    booted(line, boot, done, timing.boot).context("booting the mote")?;
    sleep(timing.check);
    line.send(calibrate).context("calibrating the mote")?;
    // Nobody says when that is over; the mote must stay where it is until then.
    sleep(timing.calibration);
    Ok(())
}

fn transferring(line: &mut Line, limit: Duration) -> Result<(), Trouble> {
    line.discard()?;
    line.send(b"transfersram\n")?;
    expect("Executing SRAM Transfer", line.receive(limit)?)
}

/// Some Teensys say that they begin before they say that they are done.
fn booted(line: &mut Line, boot: &[&[u8]], done: &'static str, limit: Duration) -> Result<(), Trouble> {
    for words in boot {
        line.send(words)?;
    }
    let mut got = line.receive(limit)?;
    if got.starts_with("Executing") {
        got = line.receive(limit)?;
    }
    expect(done, got)
}

fn expect(expected: &'static str, got: String) -> Result<(), Trouble> {
    if got.starts_with(expected) { Ok(()) } else { Err(Trouble::Wrong { expected, got }) }
}
