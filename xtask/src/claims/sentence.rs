//! A sentence with names in place of its numbers, and where it stands in a text.

use std::ops::Range;

use anyhow::{Context, Result, ensure};

use super::source::{Known, in_code};

/// A sentence, in pieces.
#[derive(Debug, PartialEq)]
pub(super) struct Sentence {
    /// One more than there are numbers.
    words: Vec<String>,
    pub(super) numbers: Vec<Number>,
}

/// Where a number comes from and how it is written: `{source/key/key; * factor .decimals , <}`, or `{file#words; ...}`
/// for the one that stands behind these words in a file.
#[derive(Debug, PartialEq)]
pub(super) struct Number {
    from: From,
    factor: f64,
    decimals: usize,
    grouped: bool,
    /// What the text says is a bound.
    at_most: bool,
}

#[derive(Debug, PartialEq)]
enum From {
    Summary { source: String, keys: Vec<String> },
    Code { path: String, words: String },
}

/// A number as it has to be written.
#[derive(Debug, PartialEq)]
pub(super) struct Is {
    pub(super) written: String,
    value: f64,
    at_most: bool,
}

/// Where a sentence stands in a text.
pub(super) struct Found {
    pub(super) whole: Range<usize>,
    pub(super) numbers: Vec<Range<usize>>,
}

impl Sentence {
    pub(super) fn parse(text: &str) -> Result<Self> {
        let mut words = vec![String::new()];
        let mut numbers = Vec::new();
        let mut rest = text;
        while let Some((before, behind)) = rest.split_once('{') {
            let (number, behind) = behind.split_once('}').context("a { without its }")?;
            words.last_mut().into_iter().for_each(|last| last.push_str(before));
            words.push(String::new());
            numbers.push(Number::parse(number)?);
            rest = behind;
        }
        words.last_mut().into_iter().for_each(|last| last.push_str(rest));
        ensure!(!words[0].trim().is_empty(), "a sentence has to begin with a word");
        let plain = words.iter().any(|words| words.contains(|c: char| c.is_ascii_digit()));
        ensure!(plain || !numbers.is_empty(), "there is no number in it");
        Ok(Self { words, numbers })
    }

    /// The places where the words stand with numbers between them; any white space is as good as any other.
    pub(super) fn find(&self, text: &str) -> Vec<Found> {
        let Some(start_word) = self.words[0].split_whitespace().next() else { return Vec::new() };
        text.match_indices(start_word).filter_map(|(start, _)| self.stands_at(text, start)).collect()
    }

    fn stands_at(&self, text: &str, start: usize) -> Option<Found> {
        let whole_word = |at: usize| {
            let inside = |c: Option<char>| c.is_some_and(char::is_alphanumeric);
            !(inside(text[..at].chars().next_back()) && inside(text[at..].chars().next()))
        };
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
        // 12 is not said by 112, nor by 123.
        (whole_word(start) && whole_word(at)).then_some(Found { whole: start..at, numbers })
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
        // Code has semicolons of its own.
        let (path, written) = text.rsplit_once(';').unwrap_or((text, ""));
        let from = if let Some((path, words)) = path.split_once('#') {
            From::Code { path: path.to_string(), words: words.to_string() }
        } else {
            let mut keys = path.split('/').map(str::to_string);
            From::Summary { source: keys.next().unwrap_or_default(), keys: keys.collect() }
        };
        let mut number = Self { from, factor: 1.0, decimals: 0, grouped: false, at_most: false };
        let mut words = written.split_whitespace();
        while let Some(word) = words.next() {
            match word {
                "," => number.grouped = true,
                "<" => number.at_most = true,
                "*" => {
                    let factor = words.next().unwrap_or_default();
                    number.factor = factor.parse().with_context(|| format!("{factor:?} in {text:?} is no factor"))?;
                }
                _ => {
                    let decimals = word.strip_prefix('.').and_then(|decimals| decimals.parse().ok());
                    number.decimals = decimals.with_context(|| format!("what is {word:?} in {text:?}?"))?;
                }
            }
        }
        Ok(number)
    }

    /// The source that has to be asked for it.
    pub(super) fn source(&self) -> Option<&str> {
        match &self.from {
            From::Summary { source, .. } => Some(source),
            From::Code { .. } => None,
        }
    }

    pub(super) fn look_up(&self, known: &Known) -> Result<Is> {
        let value = match &self.from {
            From::Code { path, words } => in_code(path, words)?,
            From::Summary { source, keys } => {
                let value = known.value(source, keys)?;
                value.as_f64().with_context(|| format!("{source}/{} is {value}, no number", keys.join("/")))?
            }
        };
        let value = value * self.factor;
        let plain = format!("{value:.*}", self.decimals);
        let written = if self.grouped { grouped(&plain) } else { plain };
        Ok(Is { written, value, at_most: self.at_most })
    }
}

impl Is {
    /// Whether a text that says `said` says so.
    pub(super) fn is_said_by(&self, said: &str) -> bool {
        if self.at_most {
            return said.replace(',', "").parse::<f64>().is_ok_and(|bound| self.value <= bound);
        }
        self.written == said
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sentence_is_found_across_line_breaks_with_its_numbers() {
        let sentence = Sentence::parse("errors of {run/a; .2}, {run/b; .2} cm").unwrap();
        let text = "No errors here.\nIt has errors\nof 0.39, 1,204.5 cm.";
        let [found] = &sentence.find(text)[..] else { panic!("once") };
        let numbers: Vec<&str> = found.numbers.iter().map(|at| &text[at.clone()]).collect();
        assert_eq!(numbers, ["0.39", "1,204.5"]);
        assert_eq!(&text[found.whole.clone()], "errors\nof 0.39, 1,204.5 cm");
        assert_eq!(sentence.find("errors of 1, 2 cm and errors of 3, 4 cm").len(), 2);
    }

    #[test]
    fn a_plain_number_is_not_found_within_another() {
        let places = |sentence: &str| Sentence::parse(sentence).unwrap().find("in 112 s, after 12 s, 12 steps").len();
        assert_eq!((places("12 s"), places("12 st"), places("12")), (1, 0, 2));
        assert!(Sentence::parse("no number").is_err());
    }

    #[test]
    fn a_number_is_looked_up_scaled_and_written_as_asked() {
        let mut known = Known::default();
        known.insert("b", serde_json::json!({ "size": { "image.bytes": 24332 }, "mae": [0.3949, 1.0] }));
        let written = |text: &str| Number::parse(text).and_then(|number| number.look_up(&known)).map(|is| is.written);
        assert_eq!(written("b/size/image.bytes; ,").unwrap(), "24,332");
        assert_eq!(written("b/mae/0; .2").unwrap(), "0.39");
        assert_eq!(written("b/size/image.bytes; * 0.001 .1").unwrap(), "24.3");
        assert!(written("b/size/nothing").unwrap_err().to_string().contains("b/size/nothing"));
        assert!(written("c/size").is_err());
        assert_eq!(written("calib/default.toml#max_angle_age_ms = ; * 0.001 .1").unwrap(), "0.1");
        assert!(written("calib/default.toml#nothing = ").is_err());
    }

    #[test]
    fn a_bound_may_be_wide_but_not_passed() {
        let mut known = Known::default();
        known.insert("b", serde_json::json!({ "percent": 2.3 }));
        let is = Number::parse("b/percent; <").and_then(|number| number.look_up(&known)).unwrap();
        assert!(is.is_said_by("5") && is.is_said_by("2.3") && !is.is_said_by("2"));
    }

    #[test]
    fn thousands_are_grouped_from_the_point_leftwards() {
        assert_eq!(grouped("1234567.8901"), "1,234,567.8901");
        assert_eq!(grouped("123"), "123");
        assert_eq!(grouped("-1234"), "-1,234");
    }
}
