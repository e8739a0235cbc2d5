//! What the texts claim, counted anew and held against the texts.
//!
//! `tests/expected/claims.toml` lists sentences of the documents with names in place of their numbers. Every number is
//! looked up in the summary that a command has just written, and the document has to say exactly that. A sentence with
//! plain numbers tells what is set and not what is measured: it only has to stand there.
//!
//! What can go wrong: a figure has moved, so that a text is no longer true. The error shows what the text says and what
//! it would have to say; `--write` puts the numbers in. A number under the README's `## Numbers` that no sentence of
//! the list covers is an error too.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::path::Path;

use anyhow::{Context, Result, anyhow, bail, ensure};
use serde::Deserialize;
use serde_json::Value;

use crate::process::{cargo, root, run};

/// What the comparison may be told.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// Put the numbers as they are now into the texts
    #[arg(long)]
    write: bool,
    /// Take the summaries that earlier commands left under target, instead of running the commands
    #[arg(long)]
    as_left: bool,
    /// Sources that have just been run
    #[arg(skip)]
    ran: &'static [&'static str],
}

impl Arguments {
    /// Behind a bench.
    pub(crate) const AFTER_BENCH: Self = Self { write: false, as_left: false, ran: &["bench"] };
}

const LIST: &str = "tests/expected/claims.toml";

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct List {
    /// Where numbers come from, by name.
    source: BTreeMap<String, Source>,
    claim: Vec<Claim>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Source {
    /// One after the other: the words after `cargo xtask`.
    commands: Vec<String>,
    /// The JSON file it writes.
    summary: String,
    /// What it cannot do without, if there is anything.
    needs: Option<String>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Claim {
    file: String,
    /// As in the document, line breaks as spaces, with `{source/key/key; * factor .decimals ,}` for each number.
    text: String,
}

/// A sentence, in pieces.
#[derive(Debug, PartialEq)]
struct Template {
    /// One more than there are numbers.
    words: Vec<String>,
    numbers: Vec<Number>,
}

/// Where a number comes from and how it is written.
#[derive(Debug, PartialEq)]
struct Number {
    source: String,
    keys: Vec<String>,
    factor: f64,
    decimals: usize,
    grouped: bool,
}

/// Runs what the numbers come from and compares.
pub(crate) fn claims(arguments: &Arguments) -> Result<()> {
    let path = root().join(LIST);
    let text = std::fs::read_to_string(&path).with_context(|| LIST.to_string())?;
    let list: List = toml::from_str(&text).with_context(|| LIST.to_string())?;
    let mut known = BTreeMap::new();
    let mut skipped = BTreeSet::new();
    for (name, source) in &list.source {
        if let Some(needs) = source.needs.as_deref().filter(|needs| !root().join(needs).exists()) {
            println!("skipped: {name} needs {needs}, which is not here");
            skipped.insert(name.as_str());
            continue;
        }
        known.insert(name.as_str(), source.numbers(arguments.as_left || arguments.ran.contains(&name.as_str()))?);
    }
    let mut texts: BTreeMap<&str, String> = BTreeMap::new();
    let mut covered: BTreeMap<&str, Vec<std::ops::Range<usize>>> = BTreeMap::new();
    let (mut wrong, mut right, mut unknown) = (String::new(), 0, 0);
    for claim in &list.claim {
        let template = Template::parse(&claim.text).with_context(|| format!("{LIST}: {:?}", claim.text))?;
        if !texts.contains_key(claim.file.as_str()) {
            let text = std::fs::read_to_string(root().join(&claim.file)).with_context(|| claim.file.clone())?;
            texts.insert(&claim.file, text);
        }
        let text = &texts[claim.file.as_str()];
        let Some(found) = template.find(text) else {
            writeln!(wrong, "{}: no such sentence, whatever its numbers: {}", claim.file, claim.text)?;
            continue;
        };
        covered.entry(&claim.file).or_default().push(found.whole.clone());
        if template.numbers.iter().any(|number| skipped.contains(number.source.as_str())) {
            unknown += 1;
            continue;
        }
        let is = template.numbers.iter().map(|number| number.look_up(&known)).collect::<Result<Vec<String>>>()?;
        let said: Vec<&str> = found.numbers.iter().map(|at| &text[at.clone()]).collect();
        if is.iter().map(String::as_str).eq(said.iter().copied()) {
            right += 1;
            continue;
        }
        let line = 1 + text[..found.whole.start].matches('\n').count();
        writeln!(wrong, "{}:{line}: says {}, is {}: {}", claim.file, said.join(" "), is.join(" "), claim.text)?;
        if arguments.write {
            let mut text = text.clone();
            for (at, is) in found.numbers.iter().zip(&is).rev() {
                text.replace_range(at.clone(), is);
            }
            texts.insert(&claim.file, text);
            // Places behind this one have moved.
            covered.remove(claim.file.as_str());
        }
    }
    if arguments.write {
        for (file, text) in &texts {
            std::fs::write(root().join(file), text).with_context(|| (*file).to_string())?;
        }
        print!("{wrong}");
        println!("written. Run it again without --write.");
        return Ok(());
    }
    if let Some(text) = texts.get("README.md") {
        let covered = covered.remove("README.md").unwrap_or_default();
        for line in unclaimed(text, &covered) {
            writeln!(wrong, "README.md:{line}: a number that no sentence of {LIST} covers")?;
        }
    }
    println!("{right} sentences say what is so, {unknown} could not be looked at");
    ensure!(
        wrong.is_empty(),
        "the texts say what is not so; `cargo xtask claims --write` puts the numbers in\n{wrong}"
    );
    Ok(())
}

impl Source {
    /// Runs the command, unless its summary is to be taken as it lies there.
    fn numbers(&self, as_left: bool) -> Result<Value> {
        if !as_left {
            for command in &self.commands {
                // Through cargo: a build may have put another program in this one's place.
                run(cargo(&["xtask"]).args(command.split_whitespace()))?;
            }
        }
        let path = root().join(&self.summary);
        let text = std::fs::read_to_string(&path).with_context(|| {
            format!("{}; `cargo xtask {}` writes it", self.summary, self.commands.join("`, then `cargo xtask "))
        })?;
        serde_json::from_str(&text).with_context(|| self.summary.clone())
    }
}

/// Where a sentence stands in a text.
struct Found {
    whole: std::ops::Range<usize>,
    numbers: Vec<std::ops::Range<usize>>,
}

impl Template {
    fn parse(text: &str) -> Result<Self> {
        let mut words = vec![String::new()];
        let mut numbers = Vec::new();
        let mut rest = text;
        while let Some((before, behind)) = rest.split_once('{') {
            let (number, behind) = behind.split_once('}').ok_or_else(|| anyhow!("a {{ without its }}"))?;
            words.last_mut().into_iter().for_each(|last| last.push_str(before));
            words.push(String::new());
            numbers.push(Number::parse(number)?);
            rest = behind;
        }
        words.last_mut().into_iter().for_each(|last| last.push_str(rest));
        ensure!(!words[0].trim().is_empty(), "a sentence has to begin with a word");
        Ok(Self { words, numbers })
    }

    /// The first place where the words stand with numbers between them; any white space is as good as any other.
    fn find(&self, text: &str) -> Option<Found> {
        let start_word = self.words[0].split_whitespace().next()?;
        text.match_indices(start_word).find_map(|(start, _)| self.stands_at(text, start))
    }

    fn stands_at(&self, text: &str, start: usize) -> Option<Found> {
        let mut at = start;
        let mut numbers = Vec::new();
        for (index, words) in self.words.iter().enumerate() {
            at = skip(text, at, words)?;
            if index < self.numbers.len() {
                let length = number_length(&text[at..])?;
                numbers.push(at..at + length);
                at += length;
            }
        }
        Some(Found { whole: start..at, numbers })
    }
}

/// The place behind `words`, if they stand at `at`.
fn skip(text: &str, mut at: usize, words: &str) -> Option<usize> {
    let mut wanted = words.chars().peekable();
    while let Some(next) = wanted.next() {
        if next.is_whitespace() {
            while wanted.next_if(|next| next.is_whitespace()).is_some() {}
            let blank = text[at..].len() - text[at..].trim_start().len();
            if blank == 0 {
                return None;
            }
            at += blank;
        } else {
            let there = text[at..].chars().next().filter(|there| *there == next)?;
            at += there.len_utf8();
        }
    }
    Some(at)
}

/// The length of the number that `text` begins with: digits, points and commas, a digit last.
fn number_length(text: &str) -> Option<usize> {
    let signed = usize::from(text.starts_with('-'));
    let end = text[signed..].find(|c: char| !c.is_ascii_digit() && c != '.' && c != ',').unwrap_or(text.len() - signed);
    let length = signed + text[signed..signed + end].trim_end_matches(['.', ',']).len();
    (length > signed).then_some(length)
}

impl Number {
    fn parse(text: &str) -> Result<Self> {
        let (path, written) = text.split_once(';').unwrap_or((text, ""));
        let mut words = written.split_whitespace();
        let mut keys = path.split('/').map(str::to_string);
        let source = keys.next().unwrap_or_default();
        let mut number = Self { source, keys: keys.collect(), factor: 1.0, decimals: 0, grouped: false };
        while let Some(word) = words.next() {
            match word {
                "," => number.grouped = true,
                "*" => {
                    let factor = words.next().unwrap_or_default();
                    number.factor = factor.parse().with_context(|| format!("{factor:?} in {text:?} is no factor"))?;
                }
                _ => {
                    let decimals = word.strip_prefix('.').and_then(|decimals| decimals.parse().ok());
                    number.decimals = decimals.ok_or_else(|| anyhow!("what is {word:?} in {text:?}?"))?;
                }
            }
        }
        Ok(number)
    }

    fn look_up(&self, known: &BTreeMap<&str, Value>) -> Result<String> {
        let path = || format!("{}/{}", self.source, self.keys.join("/"));
        let mut value =
            known.get(self.source.as_str()).ok_or_else(|| anyhow!("{LIST}: there is no source {}", self.source))?;
        for key in &self.keys {
            let next = key.parse::<usize>().ok().and_then(|index| value.get(index)).or_else(|| value.get(key));
            value = next.ok_or_else(|| anyhow!("{LIST}: {} has no such key", path()))?;
        }
        let Some(value) = value.as_f64() else { bail!("{LIST}: {} is {value}, no number", path()) };
        let plain = format!("{:.*}", self.decimals, value * self.factor);
        Ok(if self.grouped { grouped(&plain) } else { plain })
    }
}

/// A comma between thousands.
fn grouped(plain: &str) -> String {
    let whole = plain.find('.').unwrap_or(plain.len());
    let first = plain.find(|c: char| c.is_ascii_digit()).unwrap_or(0);
    let mut written = String::new();
    for (index, c) in plain.char_indices() {
        if index > first && index < whole && (whole - index).is_multiple_of(3) {
            written.push(',');
        }
        written.push(c);
    }
    written
}

/// The lines under `## Numbers` with a digit that lies in none of `covered`; names with digits in them are no numbers.
fn unclaimed(text: &str, covered: &[std::ops::Range<usize>]) -> Vec<usize> {
    let Some(start) = text.find("\n## Numbers\n") else { return Vec::new() };
    let start = start + 1;
    let end = text[start..].find("\n## ").map_or(text.len(), |end| start + end);
    let mut lines: Vec<usize> = text[start..end]
        .char_indices()
        .filter(|(_, c)| c.is_ascii_digit())
        .map(|(index, _)| start + index)
        .filter(|&index| !in_a_name(text, index) && !covered.iter().any(|range| range.contains(&index)))
        .map(|index| 1 + text[..index].matches('\n').count())
        .collect();
    lines.dedup();
    lines
}

/// Whether the digit at `index` belongs to a word or a path: `f64`, `take5`, `3-D`, `802.15.4`.
fn in_a_name(text: &str, index: usize) -> bool {
    let blank = |c: char| c.is_whitespace() || "|,:()".contains(c);
    let start = text[..index].rfind(blank).map_or(0, |at| at + 1);
    let end = text[index..].find(blank).map_or(text.len(), |end| index + end);
    let word = text[start..end].trim_matches(|c: char| c.is_ascii_punctuation());
    word.contains(|c: char| c.is_alphabetic()) || word == "802.15.4" || Path::new(word).components().count() > 1
}

#[cfg(test)]
mod tests {
    use super::{Number, Template, grouped, unclaimed};

    #[test]
    fn a_sentence_is_found_across_line_breaks_with_its_numbers() {
        let template = Template::parse("errors of {run/a; .2}, {run/b; .2} cm").unwrap();
        let text = "No errors here.\nIt has errors\nof 0.39, 1,204.5 cm.";
        let found = template.find(text).unwrap();
        let numbers: Vec<&str> = found.numbers.iter().map(|at| &text[at.clone()]).collect();
        assert_eq!(numbers, ["0.39", "1,204.5"]);
        assert_eq!(&text[found.whole], "errors\nof 0.39, 1,204.5 cm");
    }

    #[test]
    fn a_number_is_looked_up_scaled_and_written_as_asked() {
        let summary = serde_json::json!({ "size": { "image.bytes": 24332 }, "mae": [0.3949, 1.0] });
        let known = std::iter::once(("b", summary)).collect();
        let written = |text: &str| Number::parse(text).and_then(|number| number.look_up(&known));
        assert_eq!(written("b/size/image.bytes; ,").unwrap(), "24,332");
        assert_eq!(written("b/mae/0; .2").unwrap(), "0.39");
        assert_eq!(written("b/size/image.bytes; * 0.001 .1").unwrap(), "24.3");
        assert!(written("b/size/nothing").unwrap_err().to_string().contains("b/size/nothing"));
        assert!(written("c/size").is_err());
    }

    #[test]
    fn thousands_are_grouped_from_the_point_leftwards() {
        assert_eq!(grouped("1234567.8901"), "1,234,567.8901");
        assert_eq!(grouped("123"), "123");
        assert_eq!(grouped("-1234"), "-1,234");
    }

    #[test]
    fn a_number_that_nothing_covers_is_named_by_its_line() {
        let text = "# x\n\n## Numbers\n\n| take5 in f64 | 0.39 |\n7.8 % of 3-D\n\n## Licence\n\n2.0\n";
        let covered = text.find("0.39").unwrap();
        let covered = std::iter::once(covered..covered + 4).collect::<Vec<_>>();
        assert_eq!(unclaimed(text, &covered), [6]);
        assert_eq!(unclaimed(text, &[]), [5, 6]);
    }
}
