//! The numbers of a document: which of its digits claim something.
//!
//! Names have digits that count nothing: `f64`, `take5`, `src/bin/scum3c`, 802.15.4. What one types or programs, a fence
//! of a language, is an example; a fence of plain text is output or algebra, and claims.

use std::ops::Range;

/// Names without a letter: standards, and the paper's year.
const NAMES: [&str; 3] = ["802.15.4", "802.15.4-2006", "2020"];

/// The line and the word of each number that lies in none of `covered`.
pub(super) fn unclaimed(text: &str, covered: &[Range<usize>]) -> Vec<(usize, String)> {
    let mut found = Vec::new();
    let mut fence: Option<&str> = None;
    let mut start = 0;
    for (index, line) in text.split_inclusive('\n').enumerate() {
        let from = start;
        start += line.len();
        if let Some(language) = line.trim_start().strip_prefix("```") {
            fence = if fence.is_some() { None } else { Some(language.trim()) };
            continue;
        }
        if fence.is_some_and(|language| language != "text") {
            continue;
        }
        for word in words(line) {
            let at = from + word.start;
            let word = &line[word];
            let digits = word.char_indices().filter(|(_, c)| c.is_ascii_digit()).map(|(index, _)| at + index);
            let is_covered = |digit: usize| covered.iter().any(|range| range.contains(&digit));
            if !is_name(word) && !is_ordinal(line, word) && digits.clone().any(|digit| !is_covered(digit)) {
                found.push((index + 1, word.trim_matches(['.', ',', ':', ';']).to_string()));
            }
        }
    }
    found
}

/// Words with a digit; table bars, brackets and quotes part them as blanks do.
fn words(line: &str) -> impl Iterator<Item = Range<usize>> {
    let parts = |c: char| c.is_whitespace() || "|()[]{}\"`*".contains(c);
    let mut ranges = Vec::new();
    let mut from = 0;
    for piece in line.split_inclusive(parts) {
        let word = piece.trim_end_matches(parts);
        if word.contains(|c: char| c.is_ascii_digit()) {
            ranges.push(from..from + word.len());
        }
        from += piece.len();
    }
    ranges.into_iter()
}

/// Whether the digits belong to a name.
fn is_name(word: &str) -> bool {
    let word = word.trim_matches(|c: char| c.is_ascii_punctuation());
    // An exponent is no name.
    let letters = |word: &str| word.contains(|c: char| c.is_alphabetic());
    let is_number = word.parse::<f64>().is_ok();
    (letters(word) && !is_number) || NAMES.contains(&word)
}

/// Whether it numbers the items of a list: first in its line, with a point behind.
fn is_ordinal(line: &str, word: &str) -> bool {
    let digits = word.strip_suffix('.').is_some_and(|digits| digits.bytes().all(|byte| byte.is_ascii_digit()));
    digits && line.trim_start().starts_with(word)
}

/// What stands within the fence whose first line begins so.
pub(super) fn fence(text: &str, begins: &str) -> Option<Range<usize>> {
    let opened = "```text\n";
    let starts = text.match_indices(opened).map(|(at, _)| at + opened.len());
    let start = starts.into_iter().find(|&at| text[at..].trim_start().starts_with(begins))?;
    Some(start..start + text[start..].find("```")?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_that_nothing_covers_is_named_by_its_line() {
        let text = "# x\n\n| take5 in f64 | 0.39 |\n7.8 % of 3-D\n";
        let covered = text.find("0.39").unwrap();
        let covered = std::iter::once(covered..covered + 4).collect::<Vec<_>>();
        assert_eq!(unclaimed(text, &covered), [(4, "7.8".to_string())]);
        assert_eq!(unclaimed(text, &[]), [(3, "0.39".to_string()), (4, "7.8".to_string())]);
    }

    #[test]
    fn names_ordinals_and_what_one_types_are_no_claims() {
        let text = "1. IEEE 802.15.4 of the 2020 paper, `src/bin/scum3c`, [x](a1.md)\n\n```sh\nsoak --hours 24\n```\n";
        assert_eq!(unclaimed(text, &[]), []);
        let text = "```text\n 15 fixes\n```\n\n1e-7 of `12`, 1/600,\n";
        let words: Vec<String> = unclaimed(text, &[]).into_iter().map(|(_, word)| word).collect();
        assert_eq!(words, ["15", "1e-7", "12", "1/600"]);
    }

    #[test]
    fn a_half_covered_number_is_not_covered() {
        assert_eq!(unclaimed("12.5 cm\n", std::slice::from_ref(&(0..2))), [(1, "12.5".to_string())]);
    }

    #[test]
    fn a_block_is_found_by_its_first_line() {
        let text = "```text\na b\n```\n\n```text\n  c d\ne\n```\n";
        assert_eq!(fence(text, "c d").map(|at| &text[at]), Some("  c d\ne\n"));
        assert_eq!(fence(text, "b"), None);
    }
}
