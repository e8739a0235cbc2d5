//! The nRF52840-DK as programmer of a SCuM-3C, over its three-wire bus.
//!
//! Facts from PisterLab/scum-sdk, scum_programmer (nrf-fw/scum-programmer.c, programmer/scum.py): 460,800 baud; commands
//! are [`hdlc`] frames of a byte START 1, CHUNK 2 and 1024 bytes, BOOT 3, CALIBRATE 4; each is answered by the line
//! `ACK` when it is done, and a frame with a wrong check sequence by nothing. START holds the chip in reset; a chunk
//! goes out on the wires as it comes; BOOT fills up to 64 KiB with zeros and raises the supply tap; CALIBRATE sends
//! pulses 100 ms apart on the clock wire and then lets go of the tap, without which the optical receiver stays off.
//!
//! What can go wrong: see [`Trouble`]. A chunk that was not acknowledged is not sent again, because the programmer would
//! count it twice if only the answer was lost: the mote is programmed anew.

use std::thread::sleep;
use std::time::Duration;

use air::hdlc;
use anyhow::{Context, Result};

use super::image::{self, Image};
use super::line::{Line, Trouble};
use super::{Progress, Timing};

/// Of the UART behind the board's USB.
pub const BAUD: u32 = 460_800;
/// Bytes that the programmer wants in a chunk.
pub const CHUNK: usize = 1024;

const START: u8 = 1;
const SEND_CHUNK: u8 = 2;
const BOOT: u8 = 3;
const CALIBRATE: u8 = 4;

/// How long the programmer may take over a lone flag, which ends a frame that somebody left unfinished.
const RESYNC: Duration = Duration::from_millis(50);

/// Sends the image, boots and calibrates the mote.
///
/// # Errors
/// [`Trouble`], and at what.
pub fn program(line: &mut Line, image: &Image, timing: &Timing, progress: Progress<'_>) -> Result<()> {
    reset(line, timing.answer).context("resetting the mote")?;
    for (n, chunk) in image.bytes().chunks(CHUNK).enumerate() {
        let sent = n * CHUNK;
        progress(sent);
        command(line, &[&[SEND_CHUNK], chunk].concat(), timing.answer)
            .with_context(|| format!("after {sent} of {} bytes", image::LEN))?;
    }
    progress(image::LEN);
    command(line, &[BOOT], timing.boot).context("booting the mote")?;
    sleep(timing.check);
    command(line, &[CALIBRATE], timing.calibration).context("calibrating the mote")
}

fn reset(line: &mut Line, limit: Duration) -> Result<(), Trouble> {
    line.send(&[hdlc::FLAG])?;
    sleep(RESYNC);
    line.discard()?;
    command(line, &[START], limit)
}

fn command(line: &mut Line, payload: &[u8], limit: Duration) -> Result<(), Trouble> {
    line.send(&hdlc::encode(payload))?;
    let got = line.receive(limit)?;
    if got == "ACK" { Ok(()) } else { Err(Trouble::Wrong { expected: "ACK", got }) }
}
