//! What is expected of a verb: a file beside the tests that it is held against, and that `--bless` writes anew.
//!
//! What can go wrong: the file is not there; the error says what writes it.

use anyhow::{Context, Result};
use xtask::whole;

use crate::process::root;

/// Takes `text` for what is expected from now on in `file`, from the root of the repository.
pub(crate) fn bless(file: &str, text: &str) -> Result<()> {
    let path = root().join(file);
    let folder = whole::folder(&path);
    std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    whole::write(&path, text.as_bytes())?;
    println!("blessed: {file}");
    Ok(())
}

/// What is expected of `verb`.
pub(crate) fn known(file: &str, verb: &str) -> Result<String> {
    std::fs::read_to_string(root().join(file))
        .with_context(|| format!("{file}; `cargo xtask {verb} --bless` writes it"))
}
