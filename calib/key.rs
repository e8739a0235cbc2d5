//! A room's key: a file of 32 hex digits, 16 bytes, first byte first.
//!
//! Blanks and line ends between the digits are as one likes, lines that begin with `#` are for people. Make one with
//! `openssl rand -hex 16 > lab.key` and keep it out of the repository.
//!
//! What can go wrong: a file that holds anything else; the complaint never repeats what it holds.

use std::fmt;
use std::path::Path;

use super::schema::Error;

/// The bytes; they show themselves to nobody.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Key(pub [u8; 16]);

impl fmt::Debug for Key {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Key")
    }
}

/// Reads a key file.
///
/// # Errors
/// It cannot be read, or does not hold 32 hex digits.
pub fn open(path: &Path) -> Result<[u8; 16], Error> {
    let refuse =
        |line: usize, what: String| Error { file: path.display().to_string(), line, field: String::new(), what };
    let text = std::fs::read_to_string(path).map_err(|error| refuse(0, format!("cannot be read: {error}")))?;
    let mut digits = Vec::new();
    for (index, line) in text.lines().enumerate().filter(|(_, line)| !line.starts_with('#')) {
        for letter in line.chars().filter(|letter| !letter.is_whitespace()) {
            let digit =
                letter.to_digit(16).ok_or_else(|| refuse(index + 1, "a key is hex digits and nothing else".into()))?;
            digits.push(digit as u8);
        }
    }
    let pairs: Vec<u8> = digits.chunks(2).map(|pair| pair.iter().fold(0, |byte, digit| byte << 4 | digit)).collect();
    match (digits.len(), <[u8; 16]>::try_from(pairs)) {
        (32, Ok(bytes)) => Ok(bytes),
        (count, _) => Err(refuse(0, format!("{count} hex digits; a key is 32 of them, 16 bytes"))),
    }
}
