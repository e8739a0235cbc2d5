//! A serial line to a programmer, on which nothing waits forever.
//!
//! What can go wrong is [`Trouble`]: each has its own message, and says what to do where something can be done.

use std::fmt;
use std::io::{self, Read, Write};
use std::time::{Duration, Instant};

use serialport::{ClearBuffer, SerialPort};

/// What went wrong on the line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Trouble {
    /// No such port.
    NoPort(String),
    /// The user may not open it.
    Forbidden(String),
    /// Another program has it.
    Busy(String),
    /// It cannot be opened for another reason.
    Unopened(String, String),
    /// Nothing came for that long.
    Silent(Duration),
    /// An answer began and did not end within that long.
    CutShort(String, Duration),
    /// Another answer than the expected one.
    Wrong {
        /// What should have come.
        expected: &'static str,
        /// What came.
        got: String,
    },
    /// Bytes that are no text.
    Garbage(Vec<u8>),
    /// The other end takes no more bytes for that long.
    Stuck(Duration),
    /// The other end is no longer there.
    Gone(String),
}

impl fmt::Display for Trouble {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoPort(port) => write!(f, "{port}: no such port; is the programmer plugged in?"),
            Self::Forbidden(port) => write!(
                f,
                "{port}: permission denied; on Linux `sudo usermod -aG dialout $USER` and a new login give it \
                 (the group is uucp on Arch)"
            ),
            Self::Busy(port) => write!(f, "{port}: in use by another program, a terminal perhaps; close that first"),
            Self::Unopened(port, why) => write!(f, "{port}: cannot be opened: {why}"),
            Self::Silent(limit) => write!(
                f,
                "no answer within {}; is this the programmer's port, and does the programmer run its firmware? \
                 Unplugging it and plugging it in again ends an interrupted transfer",
                seconds(*limit)
            ),
            Self::CutShort(got, limit) => {
                write!(f, "the answer broke off after {got:?}: its end did not come within {}", seconds(*limit))
            }
            Self::Wrong { expected, got } => write!(f, "the programmer answered {got:?} instead of {expected:?}"),
            Self::Garbage(bytes) => write!(
                f,
                "garbage instead of an answer ({}); is this the right port and the right --programmer?",
                bytes.iter().map(|byte| format!("{byte:02x}")).collect::<Vec<_>>().join(" ")
            ),
            Self::Stuck(limit) => write!(f, "the programmer takes no more bytes for {}", seconds(*limit)),
            Self::Gone(why) => write!(f, "the programmer went away ({why}); was it unplugged?"),
        }
    }
}

impl std::error::Error for Trouble {}

fn seconds(limit: Duration) -> String {
    format!("{} s", limit.as_secs_f64())
}

/// Bytes of an answer that are read at most: no programmer says that much in a line.
const LONGEST_LINE: usize = 200;
/// Bytes handed to the system at once, a USB packet, as the programmers' own scripts do.
const PIECE: usize = 64;
/// How long the other end may refuse bytes: a thousand of them take half a second at 19,200 baud.
const STUCK: Duration = Duration::from_secs(10);

/// An open line, 8 data bits, no parity, one stop bit.
pub struct Line(Box<dyn SerialPort>);

impl Line {
    /// Opens the port for this program alone.
    ///
    /// # Errors
    /// There is none, or it is not to be had.
    pub fn open(port: &str, baud: u32) -> Result<Self, Trouble> {
        let opened = serialport::new(port, baud).timeout(STUCK).open();
        opened.map(Self).map_err(|error| unopened(port, &error))
    }

    /// Sends bytes, and returns when the system has sent them.
    ///
    /// # Errors
    /// The other end takes none, or is gone.
    pub fn send(&mut self, bytes: &[u8]) -> Result<(), Trouble> {
        self.0.set_timeout(STUCK).map_err(|error| Trouble::Gone(error.to_string()))?;
        for piece in bytes.chunks(PIECE) {
            let sent = self.0.write_all(piece).and_then(|()| self.0.flush());
            sent.map_err(|error| match error.kind() {
                io::ErrorKind::TimedOut => Trouble::Stuck(STUCK),
                _ => Trouble::Gone(error.to_string()),
            })?;
        }
        Ok(())
    }

    /// One line of text, without its end.
    ///
    /// # Errors
    /// None comes within `limit`, or no text.
    pub fn receive(&mut self, limit: Duration) -> Result<String, Trouble> {
        let until = Instant::now() + limit;
        let mut line = Vec::new();
        loop {
            let left = until.saturating_duration_since(Instant::now());
            let byte = if left.is_zero() { Err(io::ErrorKind::TimedOut.into()) } else { self.byte(left) };
            match byte {
                Ok(b'\n') => break,
                Ok(byte) if line.len() < LONGEST_LINE => line.push(byte),
                Ok(_) => return Err(Trouble::Garbage(line)),
                Err(error) if error.kind() == io::ErrorKind::TimedOut => {
                    return Err(match text(&line) {
                        Some(got) if got.is_empty() => Trouble::Silent(limit),
                        Some(got) => Trouble::CutShort(got, limit),
                        None => Trouble::Garbage(line),
                    });
                }
                Err(error) => return Err(Trouble::Gone(error.to_string())),
            }
        }
        text(&line).ok_or(Trouble::Garbage(line))
    }

    /// Whatever is there, waited for up to `limit`; none if nothing came.
    ///
    /// # Errors
    /// The other end is gone.
    pub fn read(&mut self, bytes: &mut [u8], limit: Duration) -> Result<usize, Trouble> {
        let read = self.0.set_timeout(limit).map_err(io::Error::from).and_then(|()| self.0.read(bytes));
        match read {
            Ok(0) => Err(Trouble::Gone("end of file".to_owned())),
            Ok(count) => Ok(count),
            Err(error) if matches!(error.kind(), io::ErrorKind::TimedOut | io::ErrorKind::Interrupted) => Ok(0),
            Err(error) => Err(Trouble::Gone(error.to_string())),
        }
    }

    fn byte(&mut self, limit: Duration) -> io::Result<u8> {
        self.0.set_timeout(limit)?;
        let mut byte = [0];
        match self.0.read(&mut byte)? {
            0 => Err(io::Error::new(io::ErrorKind::BrokenPipe, "end of file")),
            _ => Ok(byte[0]),
        }
    }

    /// Forgets what came and was not read.
    ///
    /// # Errors
    /// The other end is gone.
    pub fn discard(&mut self) -> Result<(), Trouble> {
        self.0.clear(ClearBuffer::Input).map_err(|error| Trouble::Gone(error.to_string()))
    }
}

/// Printable ASCII, white space around it cut off.
fn text(line: &[u8]) -> Option<String> {
    let line = line.trim_ascii();
    let printable = line.iter().all(|byte| byte.is_ascii_graphic() || *byte == b' ');
    printable.then(|| String::from_utf8_lossy(line).into_owned())
}

/// What the crate says of a port that does not open.
fn unopened(port: &str, error: &serialport::Error) -> Trouble {
    let port = port.to_owned();
    match error.kind() {
        serialport::ErrorKind::Io(io::ErrorKind::PermissionDenied) => Trouble::Forbidden(port),
        serialport::ErrorKind::Io(io::ErrorKind::NotFound) => Trouble::NoPort(port),
        // What a lock that somebody else holds becomes, and a device without a driver behind it.
        serialport::ErrorKind::NoDevice if !std::path::Path::new(&port).exists() => Trouble::NoPort(port),
        serialport::ErrorKind::NoDevice => Trouble::Busy(port),
        _ => Trouble::Unopened(port, error.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use serialport::{Error, ErrorKind};

    use super::{Trouble, unopened};

    #[test]
    fn a_port_that_does_not_open_says_why() {
        let because = |kind| unopened("/dev/null", &Error::new(kind, "reason"));
        let port = || "/dev/null".to_owned();
        assert_eq!(because(ErrorKind::Io(std::io::ErrorKind::PermissionDenied)), Trouble::Forbidden(port()));
        assert_eq!(because(ErrorKind::NoDevice), Trouble::Busy(port()));
        assert_eq!(because(ErrorKind::Unknown), Trouble::Unopened(port(), "reason".into()));
        let gone = unopened("/dev/there is none", &Error::new(ErrorKind::NoDevice, "reason"));
        assert_eq!(gone, Trouble::NoPort("/dev/there is none".into()));
    }
}
