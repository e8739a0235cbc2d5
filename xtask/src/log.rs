//! What a mote logs over its UART, and what of that tells how it is.
//!
//! What can go wrong: a frame that does not decode, in the middle of one that was cut off. It is a line of its own.

use anyhow::{Context, Result};
use defmt_decoder::{DecodeError, StreamDecoder, Table};

/// Whether the mote says that it has started.
pub(crate) fn is_start(line: &str) -> bool {
    line.contains("lighthouse mote")
}

/// Whether it says that it has lost the cycle.
pub(crate) fn is_lock_lost(line: &str) -> bool {
    line.contains("light lost")
}

/// The log, decoded with the image's own strings.
pub(crate) struct Log<'t> {
    decoder: Box<dyn StreamDecoder + Send + Sync + 't>,
}

impl Log<'_> {
    /// The mote with this image.
    pub(crate) fn new(elf: &[u8]) -> Result<Self> {
        Ok(Self::of(Self::strings(elf)?))
    }

    /// One of several motes with the same image.
    pub(crate) fn of(strings: &'static Table) -> Self {
        Self { decoder: strings.new_stream_decoder() }
    }

    /// The image's strings, for as many motes as have it.
    pub(crate) fn strings(elf: &[u8]) -> Result<&'static Table> {
        let table = Table::parse(elf)?.context("the image has no log strings")?;
        // One run, one image: the table lives as long as the program.
        Ok(Box::leak(Box::new(table)))
    }

    /// The lines that are whole by now.
    pub(crate) fn read(&mut self, bytes: &[u8]) -> Vec<String> {
        self.decoder.received(bytes);
        let mut lines = Vec::new();
        loop {
            match self.decoder.decode() {
                Ok(frame) => lines.push(format!("mote: {}", frame.display(false))),
                Err(DecodeError::UnexpectedEof) => return lines,
                Err(DecodeError::Malformed) => lines.push("mote: a log frame that does not decode".to_string()),
            }
        }
    }
}
