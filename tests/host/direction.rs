//! The direction of the path: no stage imports a later one.
//!
//! What can go wrong: a stage that reaches forward compiles all the same. The order is the `pub mod` list of `lib.rs`.

use std::path::Path;
use std::{env, fs};

/// The sources of a stage: its own file and those of its folder, however deep.
fn sources(stage: &Path) -> String {
    let folder = fs::read_dir(stage).into_iter().flatten().map(|entry| entry.unwrap().path());
    let below: String = folder.map(|file| sources(&file.with_extension(""))).collect();
    fs::read_to_string(stage.with_extension("rs")).unwrap_or_default() + &below
}

/// Whether `source` speaks of `crate::stage` or takes it out of a `use crate::{..}`; documentation may.
fn imports(source: &str, stage: &str) -> bool {
    let code: String = source.lines().filter(|line| !line.trim_start().starts_with("//")).collect();
    let braced = code.split("crate::{").skip(1).filter_map(|rest| rest.split(';').next());
    let direct = code.split("crate::").skip(1);
    direct.map(|path| path.split(|c: char| !c.is_alphanumeric() && c != '_').next()).any(|name| name == Some(stage))
        || braced.flat_map(|list| list.split([',', '{', '}'])).any(|path| path.trim().split("::").next() == Some(stage))
}

#[test]
fn no_stage_imports_a_later_one() {
    let src = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let lib = fs::read_to_string(src.join("lib.rs")).unwrap();
    let order: Vec<&str> = lib.lines().filter_map(|line| line.strip_prefix("pub mod ")?.strip_suffix(';')).collect();
    assert_eq!((order.first(), order.last()), (Some(&"time"), Some(&"chain")));
    for (index, stage) in order.iter().enumerate() {
        let source = sources(&src.join(stage));
        assert!(!source.is_empty(), "{stage} has no source");
        for later in &order[index + 1..] {
            assert!(!imports(&source, later), "{stage} imports {later}, which comes after it");
        }
    }
}

#[test]
fn an_import_is_seen_in_every_spelling() {
    for source in ["use crate::fix;", "use crate::{angle, fix};", "use crate::{fix::Fix};", "crate::fix::step(x)"] {
        assert!(imports(source, "fix"), "{source}");
    }
    assert!(imports("use crate::{\n    angle::Angle,\n    fix::{Config, Fix},\n};", "fix"));
    for source in ["/// See [`crate::fix`].", "use crate::fixed;", "use crate::{prefix, angle};", "use super::fix;"] {
        assert!(!imports(source, "fix"), "{source}");
    }
}
