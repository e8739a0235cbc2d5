//! Recordings of real light, where they are on this computer.

use std::path::{Path, PathBuf};

/// The recording of this name, if it is on this computer.
pub fn recording(name: &str) -> Option<PathBuf> {
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data").join(name);
    if !dir.is_dir() {
        eprintln!("skipped: {} is not there", dir.display());
    }
    dir.is_dir().then_some(dir)
}

/// A path as it is typed.
pub fn shown(path: &Path) -> &str {
    path.to_str().expect("a plain path")
}
