//! Where numbers come from: summaries of commands, and the code.

use std::collections::BTreeMap;

use anyhow::{Context, Result, bail, ensure};
use serde::Deserialize;
use serde_json::Value;

use super::How;
use crate::process::{cargo, root, run};

/// Commands and what they leave.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Source {
    /// One after the other: the words after `cargo xtask`.
    commands: Vec<String>,
    /// The JSON file that the last one writes.
    summary: String,
    /// What it cannot do without, if there is anything.
    needs: Option<String>,
    /// How long it takes, where that is too long for every time.
    long: Option<String>,
}

/// All that is known, and why other things are not.
#[derive(Default)]
pub(super) struct Known {
    summaries: BTreeMap<String, Value>,
    not: BTreeMap<String, String>,
}

impl Source {
    /// Runs the commands, or takes what they left, or says why neither.
    pub(super) fn ask(&self, name: &str, how: How, known: &mut Known) -> Result<()> {
        if let Some(needs) = self.needs.as_deref().filter(|needs| !root().join(needs).exists()) {
            known.not.insert(name.to_string(), format!("{needs} is not here"));
            return Ok(());
        }
        let path = root().join(&self.summary);
        let runs = match how {
            How::Run => true,
            How::RunIfShort if self.long.is_none() => true,
            How::RunIfShort => {
                known.not.insert(name.to_string(), self.how_to_ask());
                return Ok(());
            }
            How::Left | How::LeftIfAny => {
                let may_be_missing = self.long.is_some() || how == How::LeftIfAny;
                if may_be_missing && !path.exists() {
                    known.not.insert(name.to_string(), self.how_to_ask());
                    return Ok(());
                }
                false
            }
        };
        if runs {
            for command in &self.commands {
                // Through cargo: a build may have put another program in this one's place.
                run(cargo(&["xtask"]).args(command.split_whitespace()))?;
            }
        }
        let text = std::fs::read_to_string(&path).with_context(|| {
            format!("{}; `cargo xtask {}` writes it", self.summary, self.commands.join("`, then `cargo xtask "))
        })?;
        known.summaries.insert(name.to_string(), serde_json::from_str(&text).with_context(|| self.summary.clone())?);
        Ok(())
    }

    fn how_to_ask(&self) -> String {
        match &self.long {
            Some(long) => format!("it takes {long}; `cargo xtask claims --long` counts it"),
            None => "it has left no summary; `cargo xtask claims` counts it".to_string(),
        }
    }
}

impl Known {
    #[cfg(test)]
    pub(super) fn insert(&mut self, name: &str, summary: Value) {
        self.summaries.insert(name.to_string(), summary);
    }

    pub(super) fn has(&self, source: &str) -> bool {
        self.summaries.contains_key(source)
    }

    pub(super) fn why_not(&self, source: &str) -> &str {
        self.not.get(source).map_or("nobody asked", String::as_str)
    }

    /// What stands in a summary under `keys`, one within the other.
    pub(super) fn value(&self, source: &str, keys: &[String]) -> Result<&Value> {
        let path = || format!("{source}/{}", keys.join("/"));
        let mut value = self.summaries.get(source).with_context(|| format!("there is no source {source}"))?;
        for key in keys {
            let next = key.parse::<usize>().ok().and_then(|index| value.get(index)).or_else(|| value.get(key));
            value = next.with_context(|| format!("{} has no such key", path()))?;
        }
        Ok(value)
    }
}

/// The number behind `words`, which stand once in a file of the repository.
pub(super) fn in_code(path: &str, words: &str) -> Result<f64> {
    let text = std::fs::read_to_string(root().join(path)).with_context(|| path.to_string())?;
    behind(&text, words).with_context(|| path.to_string())
}

fn behind(text: &str, words: &str) -> Result<f64> {
    let mut places = text.match_indices(words);
    let Some((at, _)) = places.next() else { bail!("nowhere is {words:?}") };
    ensure!(places.next().is_none(), "{words:?} stands there more than once");
    let rest = text[at + words.len()..].trim_start();
    literal(rest).with_context(|| format!("no number stands behind {words:?}"))
}

/// The number that `text` begins with, as Rust, TOML and lists of figures write it.
fn literal(text: &str) -> Option<f64> {
    if let Some(hex) = text.strip_prefix("0x") {
        let end = hex.find(|c: char| !c.is_ascii_hexdigit() && c != '_').unwrap_or(hex.len());
        return Some(u64::from_str_radix(&hex[..end].replace('_', ""), 16).ok()? as f64);
    }
    let bytes = text.as_bytes();
    let digit = |at: usize| bytes.get(at).is_some_and(u8::is_ascii_digit);
    let mut end = usize::from(text.starts_with('-'));
    if !digit(end) {
        return None;
    }
    while let Some(c) = bytes.get(end) {
        let goes_on = match c {
            b'0'..=b'9' | b'_' => true,
            b'.' => digit(end + 1),
            b'e' => digit(end + 1) || (bytes.get(end + 1) == Some(&b'-') && digit(end + 2)),
            b'-' => bytes[end - 1] == b'e',
            _ => false,
        };
        if !goes_on {
            break;
        }
        end += 1;
    }
    text[..end].trim_end_matches('_').replace('_', "").parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_is_read_off_the_code_that_sets_it() {
        let code =
            "/// Hz.\nconst HZ: u32 = 10_000_000;\nconst S: f64 = 1.5e-3;\nrange(1..=32)\nconst PAN: u16 = 0x4C48;\n";
        let number = |words: &str| behind(code, words).map_err(|error| error.to_string());
        assert_eq!(number("HZ: u32 ="), Ok(1e7));
        assert_eq!(number("S: f64 ="), Ok(1.5e-3));
        assert_eq!(number("range("), Ok(1.0));
        assert_eq!(number("range(1..="), Ok(32.0));
        assert_eq!(number("PAN: u16 ="), Ok(19_528.0));
        assert!(number("const").unwrap_err().contains("more than once"));
        assert!(number("PIN").unwrap_err().contains("nowhere"));
        assert!(number("/// ").unwrap_err().contains("no number"));
    }

    #[test]
    fn what_takes_long_is_left_out_and_that_is_said() {
        let source = Source {
            commands: vec!["soak".into()],
            summary: "target/never-written.json".into(),
            needs: None,
            long: Some("an hour".into()),
        };
        let mut known = Known::default();
        source.ask("soak", How::RunIfShort, &mut known).unwrap();
        assert!(!known.has("soak") && known.why_not("soak").contains("an hour"), "{}", known.why_not("soak"));
        let needy = Source { needs: Some("no/such/folder".into()), long: None, ..source };
        needy.ask("take5", How::Run, &mut known).unwrap();
        assert!(known.why_not("take5").contains("no/such/folder"));
    }
}
