//! What the texts name is there: files, links, commands, chapters.
//!
//! What can go wrong: a file is moved and a text goes on naming it. Numbers are held by `cargo xtask claims`.

use std::path::{Path, PathBuf};
use std::{env, fs};

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Every text: those of the root, and the book.
fn texts() -> Vec<(PathBuf, String)> {
    let folders = [root().to_path_buf(), root().join("docs")];
    let files = folders.iter().flat_map(|folder| fs::read_dir(folder).unwrap()).map(|entry| entry.unwrap().path());
    let texts = files.filter(|path| path.extension().is_some_and(|extension| extension == "md"));
    texts.map(|path| (path.clone(), fs::read_to_string(path).unwrap())).collect()
}

/// What stands between `](` and `)`.
fn links(text: &str) -> Vec<&str> {
    text.split("](").skip(1).filter_map(|rest| Some(rest.split_once(')')?.0)).collect()
}

/// What stands between two backticks on one line.
fn quoted(text: &str) -> Vec<&str> {
    let lines = text.lines().filter(|line| !line.starts_with("```"));
    lines.flat_map(|line| line.split('`').skip(1).step_by(2)).collect()
}

#[test]
fn every_link_leads_to_a_file() {
    let mut seen = 0;
    for (path, text) in texts() {
        for link in links(&text).into_iter().filter(|link| !link.contains("://")) {
            let file = link.split('#').next().unwrap();
            let target = path.parent().unwrap().join(file);
            assert!(file.is_empty() || target.exists(), "{}: {link} leads nowhere", path.display());
            seen += 1;
        }
    }
    assert!(seen > 20, "only {seen} links were found");
}

#[test]
fn every_file_that_a_text_names_is_there() {
    let ours = ["src/", "sim/", "xtask/", "calib/", "tests/", "docs/", "fuzz/", "wireshark/"];
    let mut named = 0;
    for (path, text) in texts() {
        for name in quoted(&text).into_iter().filter(|name| ours.iter().any(|folder| name.starts_with(folder))) {
            // Not patterns, places in a file, commands, nor what the reader is to write.
            if name.contains(['*', ' ', '{', ':']) || name.contains("BOARD") || name == "calib/lab.toml" {
                continue;
            }
            assert!(root().join(name).exists(), "{}: there is no {name}", path.display());
            named += 1;
        }
    }
    assert!(named > 30, "only {named} names were found");
}

#[test]
fn every_command_that_a_text_names_is_one() {
    let main = fs::read_to_string(root().join("xtask/src/main.rs")).unwrap();
    let mut commands = 0;
    for (path, text) in texts() {
        for rest in text.split("cargo xtask").skip(1) {
            let verb: String = rest.trim_start_matches(' ').chars().take_while(char::is_ascii_lowercase).collect();
            let Some(first) = verb.chars().next().filter(|_| rest.starts_with(' ')) else { continue };
            let variant = format!("Verb::{}{}", first.to_ascii_uppercase(), &verb[1..]);
            let known = verb == "help" || [" ", "("].iter().any(|end| main.contains(&format!("{variant}{end}")));
            assert!(known, "{}: there is no `cargo xtask {verb}`", path.display());
            commands += 1;
        }
    }
    assert!(commands > 20, "only {commands} commands were found");
}

#[test]
fn the_book_has_every_chapter() {
    for list in ["docs/README.md", "docs/SUMMARY.md"] {
        let text = fs::read_to_string(root().join(list)).unwrap();
        for (path, _) in texts().iter().filter(|(path, _)| path.parent().unwrap().ends_with("docs")) {
            let name = path.file_name().unwrap().to_str().unwrap();
            let listed = ["README.md", "SUMMARY.md"].contains(&name) || text.contains(&format!("({name})"));
            assert!(listed, "{list} does not list {name}");
        }
    }
}
