//! Mote after mote: which ids, one at a time, and what is left to do.
//!
//! What can go wrong: a mote fails, and is tried again or skipped; the person stops, or goes away. The summary says
//! which ids are left, in the form in which they are asked for.

use std::collections::BTreeSet;
use std::fmt;
use std::io::{BufRead, Write};
use std::str::FromStr;

use anyhow::{Result, bail};

/// The largest short address that a mote may have: above are "none yet" and "everyone" (IEEE 802.15.4-2006, 7.2.1.4).
pub const LAST_ID: u16 = 0xFFFD;

/// Ids in the order in which they are programmed, each once: `1..20` (both ends meant), `7`, `1..4,9`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Ids(Vec<u16>);

/// One id.
///
/// # Errors
/// It is none.
pub fn id(text: &str) -> Result<u16, String> {
    match text.trim().parse::<u64>() {
        Ok(id) if id <= u64::from(LAST_ID) => Ok(id as u16),
        Ok(id) => Err(format!("{id} is no mote id: 0 ..= {LAST_ID}")),
        Err(_) => Err(format!("{text:?} is no mote id: a number in 0 ..= {LAST_ID}")),
    }
}

impl FromStr for Ids {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let mut ids = Vec::new();
        for part in text.split(',') {
            let (first, last) = match part.split_once("..") {
                Some((first, last)) => (id(first)?, id(last.strip_prefix('=').unwrap_or(last))?),
                None => (id(part)?, id(part)?),
            };
            if first > last {
                return Err(format!("{part} counts backwards: {last}..{first}"));
            }
            ids.extend(first..=last);
        }
        let once: BTreeSet<u16> = ids.iter().copied().collect();
        if once.len() < ids.len() {
            return Err(format!("{text} names an id twice"));
        }
        Ok(Self(ids))
    }
}

impl fmt::Display for Ids {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let runs = self.0.chunk_by(|a, b| a.checked_add(1) == Some(*b));
        let texts: Vec<String> = runs
            .map(|run| match run {
                [.., last] if run.len() > 1 => format!("{}..{last}", run[0]),
                _ => run.iter().map(u16::to_string).collect(),
            })
            .collect();
        f.write_str(&texts.join(","))
    }
}

impl Ids {
    /// In order.
    #[must_use]
    pub fn list(&self) -> &[u16] {
        &self.0
    }
}

/// What became of a tray.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Outcome {
    /// Programmed.
    pub done: Vec<u16>,
    /// Not, with the last reason if there was an attempt.
    pub left: Vec<(u16, Option<String>)>,
}

/// Asks for mote after mote and programs it. The end of `input` is a stop.
///
/// # Errors
/// The terminal is gone.
pub fn walk(
    ids: &Ids,
    input: &mut dyn BufRead,
    output: &mut dyn Write,
    mut program: impl FnMut(u16) -> Result<()>,
) -> Result<Outcome> {
    let mut outcome = Outcome::default();
    let count = ids.0.len();
    let mut stopped = false;
    for (n, &id) in ids.0.iter().enumerate() {
        let mut failed = None;
        while !stopped {
            let again = if failed.is_none() { "connect it and press Enter" } else { "press Enter to try again" };
            write!(output, "mote {} of {count}, id {id}: {again} (s skips it, q stops): ", n + 1)?;
            output.flush()?;
            let mut answer = String::new();
            let ended = input.read_line(&mut answer)? == 0;
            match answer.trim() {
                "" if !ended => {}
                "s" => break,
                "" | "q" => {
                    stopped = true;
                    break;
                }
                other => {
                    writeln!(output, "{other:?} is not one of Enter, s and q")?;
                    continue;
                }
            }
            match program(id) {
                Ok(()) => {
                    writeln!(output, "mote {} of {count}, id {id}: done", n + 1)?;
                    outcome.done.push(id);
                    failed = None;
                    break;
                }
                Err(error) => {
                    writeln!(output, "mote {} of {count}, id {id}: failed: {error:#}", n + 1)?;
                    failed = Some(format!("{error:#}"));
                }
            }
        }
        if outcome.done.last() != Some(&id) {
            outcome.left.push((id, failed));
        }
    }
    writeln!(output)?;
    Ok(outcome)
}

impl Outcome {
    /// Prints what was done and, if anything is left, what to type for it, which starts with `again`.
    ///
    /// # Errors
    /// Something is left.
    pub fn conclude(&self, output: &mut dyn Write, again: &str) -> Result<()> {
        let total = self.done.len() + self.left.len();
        if !self.done.is_empty() {
            writeln!(output, "{} of {total} motes programmed: ids {}", self.done.len(), Ids(self.done.clone()))?;
        }
        for (id, why) in &self.left {
            writeln!(output, "id {id} is left: {}", why.as_deref().unwrap_or("not tried"))?;
        }
        if self.left.is_empty() {
            return Ok(());
        }
        let left = Ids(self.left.iter().map(|(id, _)| *id).collect());
        bail!("{} of {total} motes are left; go on with: {again} --ids {left}", self.left.len())
    }
}
