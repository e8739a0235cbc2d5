//! Files that appear whole or not at all.
//!
//! What can go wrong: a full disk, a folder that is not ours. The error names the file, and what stood there stands.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use serde::Serialize;

/// The folder of a file.
#[must_use]
pub fn folder(file: &Path) -> &Path {
    file.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// The file beside its place; gone again unless it is put there.
fn beside(path: &Path) -> Result<tempfile::NamedTempFile> {
    let mut builder = tempfile::Builder::new();
    // A temporary file is its owner's alone; this one is to stay, as any other.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    let file = builder.prefix(".partial-").tempfile_in(folder(path));
    file.with_context(|| format!("{}: cannot be written", path.display()))
}

/// Whether a file could be written there: known before the work that it is to hold is done.
///
/// # Errors
/// Why not.
pub fn writable(path: &Path) -> Result<()> {
    beside(path).map(drop)
}

/// Writes a file: beside its place first, then renamed into it.
pub fn write(path: &Path, bytes: &[u8]) -> Result<()> {
    let name = path.display();
    let failed = || format!("{name}: cannot be written");
    let mut file = beside(path)?;
    file.write_all(bytes).and_then(|()| file.as_file().sync_all()).with_context(failed)?;
    file.persist(path).with_context(|| format!("{name}: cannot be put in its place"))?;
    Ok(())
}

/// Writes figures for programs, as JSON, and makes the folder for them.
pub fn json(path: &Path, figures: &impl Serialize) -> Result<()> {
    let folder = folder(path);
    fs::create_dir_all(folder).with_context(|| format!("{}: cannot be made", folder.display()))?;
    write(path, (serde_json::to_string_pretty(figures)? + "\n").as_bytes())
}

/// Writes a file and keeps what was there under its name and a `~`; returns where.
pub fn replace(path: &Path, bytes: &[u8]) -> Result<Option<PathBuf>> {
    let mut kept = None;
    if path.exists() {
        let mut name = path.as_os_str().to_owned();
        name.push("~");
        let old = PathBuf::from(name);
        let before = fs::read(path).with_context(|| format!("{}: cannot be read", path.display()))?;
        write(&old, &before)?;
        kept = Some(old);
    }
    write(path, bytes)?;
    Ok(kept)
}
