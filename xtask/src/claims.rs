//! What the texts claim, counted anew and held against the texts.
//!
//! `tests/expected/claims.toml` lists sentences of the documents with names in place of their numbers. A number is looked
//! up in the summary that a command has just written, or read off the code that sets it, and the document has to say
//! exactly that. A sentence with plain numbers tells what somebody else has set, a standard or a data sheet: it only has
//! to stand there. A block is a part of a command's output that a document shows as it was printed, a picture one that
//! it has drawn.
//!
//! What can go wrong: a figure has moved, so that a text is no longer true. The error shows what the text says and what
//! it would have to say; `--write` puts the numbers in. A number that no sentence of the list covers is an error too, in
//! the README and in every chapter. What takes long is counted with `--long` only, and what needs a recording only where
//! there is one; of both it is said how many sentences nobody looked at.

mod sentence;
mod source;
mod text;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::ops::Range;

use anyhow::{Context, Result, ensure};
use serde::Deserialize;

use crate::process::root;
use sentence::{Number, Sentence};
use source::{Known, Source};

/// What the comparison may be told.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// Put the numbers as they are now into the texts
    #[arg(long)]
    write: bool,
    /// Take the summaries that earlier commands left under target, instead of running the commands
    #[arg(long)]
    as_left: bool,
    /// Count what takes long as well
    #[arg(long)]
    long: bool,
    /// Run the commands of these sources only, and take what others left: names of tests/expected/claims.toml
    #[arg(long, value_name = "SOURCE", conflicts_with_all = ["as_left", "long"])]
    only: Vec<String>,
    /// Sources that have just been run
    #[arg(skip)]
    ran: &'static [&'static str],
}

impl Arguments {
    /// Behind these sources.
    pub(crate) const fn after(ran: &'static [&'static str]) -> Self {
        Self { write: false, as_left: false, long: false, only: Vec::new(), ran }
    }

    fn how(&self, name: &str) -> How {
        let left = self.as_left || self.ran.contains(&name);
        if !self.only.is_empty() {
            return if self.only.iter().any(|only| only == name) { How::Run } else { How::LeftIfAny };
        }
        match (left, self.long) {
            (true, _) => How::Left,
            (false, true) => How::Run,
            (false, false) => How::RunIfShort,
        }
    }
}

/// How a source's numbers are come by.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum How {
    /// Its commands are run.
    Run,
    /// The same, unless that takes long.
    RunIfShort,
    /// From what an earlier run left; what takes long may have left nothing.
    Left,
    /// The same, and whatever left nothing is left out.
    LeftIfAny,
}

const LIST: &str = "tests/expected/claims.toml";

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct List {
    /// Where numbers come from, by name.
    source: BTreeMap<String, Source>,
    /// By document: sentences as they stand there, line breaks as spaces, with `{...}` for each number that is looked up.
    claims: BTreeMap<String, Vec<String>>,
    /// Output that a document shows.
    block: Vec<Block>,
    /// Pictures that a document shows.
    picture: Vec<Picture>,
}

/// A picture of the documents that a command draws.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Picture {
    file: String,
    source: String,
    /// Where that source leaves it.
    drawn: String,
}

/// A fenced part of a document that is a command's output.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Block {
    file: String,
    /// How its first line begins.
    begins: String,
    /// `source/key` of the text.
    is: String,
}

/// One document while it is looked at.
struct Document {
    text: String,
    /// What sentences and blocks speak of.
    covered: Vec<Range<usize>>,
}

/// What came of it.
#[derive(Default)]
struct Verdict {
    right: usize,
    wrong: String,
    /// Documents of sentences and blocks, by the source that was not asked.
    unknown: BTreeMap<String, Vec<String>>,
}

/// Runs what the numbers come from and compares.
pub(crate) fn claims(arguments: &Arguments) -> Result<()> {
    let path = root().join(LIST);
    let text = std::fs::read_to_string(&path).with_context(|| LIST.to_string())?;
    let list: List = toml::from_str(&text).with_context(|| LIST.to_string())?;
    for name in arguments.only.iter().chain(list.sources_named()?.iter()) {
        ensure!(list.source.contains_key(name), "{LIST}: there is no source {name}");
    }
    let mut known = Known::default();
    for (name, source) in &list.source {
        source.ask(name, arguments.how(name), &mut known)?;
    }
    let mut documents = list.documents()?;
    let mut verdict = Verdict::default();
    for (file, sentences) in &list.claims {
        let document = documents.get_mut(file).with_context(|| format!("{LIST}: {file} is no document"))?;
        for sentence in sentences {
            document.hold(file, sentence, &known, arguments.write, &mut verdict)?;
        }
    }
    for block in &list.block {
        let document = documents.get_mut(&block.file).with_context(|| format!("{LIST}: {} is none", block.file))?;
        document.show(block, &known, arguments.write, &mut verdict)?;
    }
    for picture in &list.picture {
        picture.hold(&known, arguments.write, &mut verdict)?;
    }
    if arguments.write {
        for (file, document) in &documents {
            std::fs::write(root().join(file), &document.text).with_context(|| file.clone())?;
        }
        print!("{}", verdict.wrong);
        println!("written. Run it again without --write.");
        return Ok(());
    }
    for (file, document) in &documents {
        for (line, number) in text::unclaimed(&document.text, &document.covered) {
            writeln!(verdict.wrong, "{file}:{line}: {number} is in no sentence of {LIST}")?;
        }
    }
    println!("{} sentences, blocks and pictures say what is so", verdict.right);
    for (name, files) in &verdict.unknown {
        let places: BTreeSet<&str> = files.iter().map(String::as_str).collect();
        let places = places.into_iter().collect::<Vec<_>>().join(", ");
        println!("not counted now: {} of {places} that {name} knows: {}", files.len(), known.why_not(name));
    }
    ensure!(
        verdict.wrong.is_empty(),
        "the texts say what is not so; `cargo xtask claims --write` puts the numbers in\n{}",
        verdict.wrong
    );
    Ok(())
}

impl Picture {
    /// Whether the document's is the one that was drawn; with `write` it becomes that.
    fn hold(&self, known: &Known, write: bool, verdict: &mut Verdict) -> Result<()> {
        let Picture { file, source, drawn } = self;
        if !known.has(source) {
            verdict.unknown.entry(source.clone()).or_default().push(file.clone());
            return Ok(());
        }
        let read = |file: &str| std::fs::read(root().join(file)).with_context(|| file.to_string());
        let now = read(drawn)?;
        if read(file)? == now {
            verdict.right += 1;
            return Ok(());
        }
        writeln!(verdict.wrong, "{file} is not the picture that {source} draws, {drawn}")?;
        if write {
            std::fs::write(root().join(file), now).with_context(|| file.clone())?;
        }
        Ok(())
    }
}

impl List {
    /// The README, what a contributor reads, and every chapter.
    fn documents(&self) -> Result<BTreeMap<String, Document>> {
        let mut files = vec!["README.md".to_string(), "CONTRIBUTING.md".to_string()];
        for entry in std::fs::read_dir(root().join("docs")).context("docs")? {
            let name = entry?.file_name().to_string_lossy().into_owned();
            if name.ends_with(".md") {
                files.push(format!("docs/{name}"));
            }
        }
        let read = |file: String| {
            let text = std::fs::read_to_string(root().join(&file)).with_context(|| file.clone())?;
            Ok((file, Document { text, covered: Vec::new() }))
        };
        files.into_iter().map(read).collect()
    }

    /// The sources that sentences and blocks ask for.
    fn sources_named(&self) -> Result<BTreeSet<String>> {
        let mut named: BTreeSet<String> =
            self.block.iter().filter_map(|block| Some(block.is.split_once('/')?.0.to_string())).collect();
        named.extend(self.picture.iter().map(|picture| picture.source.clone()));
        for text in self.claims.values().flatten() {
            let sentence = Sentence::parse(text).with_context(|| format!("{LIST}: {text:?}"))?;
            named.extend(sentence.numbers.iter().filter_map(Number::source).map(str::to_string));
        }
        Ok(named)
    }
}

impl Document {
    fn line(&self, at: usize) -> usize {
        1 + self.text[..at].matches('\n').count()
    }

    /// Holds a sentence against every place where it stands.
    fn hold(&mut self, file: &str, text: &str, known: &Known, write: bool, verdict: &mut Verdict) -> Result<()> {
        let sentence = Sentence::parse(text).with_context(|| format!("{LIST}: {text:?}"))?;
        let found = sentence.find(&self.text);
        if found.is_empty() {
            writeln!(verdict.wrong, "{file}: no such sentence, whatever its numbers: {text}")?;
            return Ok(());
        }
        self.covered.extend(found.iter().map(|found| found.whole.clone()));
        if let Some(source) = sentence.numbers.iter().filter_map(Number::source).find(|source| !known.has(source)) {
            verdict.unknown.entry(source.to_string()).or_default().push(file.to_string());
            return Ok(());
        }
        let mut is = Vec::new();
        for number in &sentence.numbers {
            is.push(number.look_up(known).with_context(|| format!("{LIST}: {text:?}"))?);
        }
        let mut right = true;
        for found in found.iter().rev() {
            let said: Vec<&str> = found.numbers.iter().map(|at| &self.text[at.clone()]).collect();
            if said.iter().zip(&is).all(|(said, is)| is.is_said_by(said)) {
                continue;
            }
            let shown: Vec<&str> = is.iter().map(|is| is.written.as_str()).collect();
            let line = self.line(found.whole.start);
            writeln!(verdict.wrong, "{file}:{line}: says {}, is {}: {text}", said.join(" "), shown.join(" "))?;
            right = false;
            if write {
                for (at, is) in found.numbers.iter().zip(&is).rev() {
                    self.text.replace_range(at.clone(), &is.written);
                }
            }
        }
        verdict.right += usize::from(right);
        if write {
            // Places have moved.
            self.covered.clear();
        }
        Ok(())
    }

    /// Holds a shown output against the output.
    fn show(&mut self, block: &Block, known: &Known, write: bool, verdict: &mut Verdict) -> Result<()> {
        let Block { file, begins, is } = block;
        let Some(at) = text::fence(&self.text, begins) else {
            writeln!(verdict.wrong, "{file}: no block begins with {begins:?}")?;
            return Ok(());
        };
        self.covered.push(at.clone());
        let (source, key) = is.split_once('/').with_context(|| format!("{LIST}: {is:?} names no key"))?;
        if !known.has(source) {
            verdict.unknown.entry(source.to_string()).or_default().push(file.to_string());
            return Ok(());
        }
        let printed = known.value(source, &[key.to_string()])?;
        let printed = printed.as_str().with_context(|| format!("{LIST}: {is} is {printed}, no text"))?;
        let trimmed = |text: &str| text.trim_end().lines().map(|line| line.trim_end().to_string()).collect::<Vec<_>>();
        let (said, printed) = (trimmed(&self.text[at.clone()]), trimmed(printed));
        if said == printed {
            verdict.right += 1;
            return Ok(());
        }
        let differs = said.iter().zip(&printed).take_while(|(said, is)| said == is).count();
        let line = |lines: &[String]| lines.get(differs).map_or("nothing".to_string(), |line| format!("{line:?}"));
        let number = self.line(at.start) + differs;
        writeln!(verdict.wrong, "{file}:{number}: shows {}, {is} is {}", line(&said), line(&printed))?;
        if write {
            self.text.replace_range(at, &(printed.join("\n") + "\n"));
            self.covered.clear();
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn document(text: &str) -> Document {
        Document { text: text.to_string(), covered: Vec::new() }
    }

    fn known() -> Known {
        let mut known = Known::default();
        known.insert("run", json!({ "cm": 0.394, "table": "a 1\nb 3  \n" }));
        known
    }

    #[test]
    fn what_a_text_says_wrong_is_named_with_its_line_and_can_be_written() {
        let mut text = document("# x\n\nIt errs by 0.38 cm.\nAlso here: errs by 0.39 cm.\n");
        let mut verdict = Verdict::default();
        text.hold("a.md", "errs by {run/cm; .2} cm", &known(), true, &mut verdict).unwrap();
        assert_eq!(verdict.wrong, "a.md:3: says 0.38, is 0.39: errs by {run/cm; .2} cm\n");
        assert!(text.text.contains("errs by 0.39 cm.\nAlso here: errs by 0.39"), "{}", text.text);
        text.hold("a.md", "errs in {run/cm; .2} cm", &known(), false, &mut verdict).unwrap();
        assert!(verdict.wrong.contains("no such sentence"), "{}", verdict.wrong);
    }

    #[test]
    fn what_was_not_asked_is_counted_and_covers_its_sentences() {
        let mut text = document("It takes 12 s.\n");
        let mut verdict = Verdict::default();
        text.hold("a.md", "takes {soak/s} s", &known(), false, &mut verdict).unwrap();
        assert_eq!((verdict.unknown["soak"].len(), verdict.right, verdict.wrong.as_str()), (1, 0, ""));
        assert_eq!(text::unclaimed(&text.text, &text.covered), []);
    }

    #[test]
    fn a_shown_output_is_that_of_the_command() {
        let block = Block { file: "a.md".into(), begins: "a ".into(), is: "run/table".into() };
        let mut text = document("So:\n\n```text\na 1\nb 2\n```\n\nMore.\n");
        let mut verdict = Verdict::default();
        text.show(&block, &known(), true, &mut verdict).unwrap();
        assert_eq!(verdict.wrong, "a.md:5: shows \"b 2\", run/table is \"b 3\"\n");
        assert_eq!(text.text, "So:\n\n```text\na 1\nb 3\n```\n\nMore.\n");
        text.show(&block, &known(), false, &mut verdict).unwrap();
        assert_eq!(verdict.right, 1);
        assert_eq!(text::unclaimed(&text.text, &text.covered), []);
    }

    #[test]
    fn every_source_is_there_and_every_document_too() {
        let text = std::fs::read_to_string(root().join(LIST)).unwrap();
        let list: List = toml::from_str(&text).unwrap();
        let (named, there) = (list.sources_named().unwrap(), list.source.keys().cloned().collect());
        assert_eq!(named, there);
        let documents = list.documents().unwrap();
        assert!(list.claims.keys().all(|file| documents.contains_key(file)));
    }
}
