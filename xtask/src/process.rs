//! Other programs, started in the open: every command line is printed before it runs.
//!
//! What can go wrong: the program is not there, or ends with another code than zero. Both are errors that name it.

use std::env;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};

use anyhow::{Context, Result, bail};

/// The root of the repository: where every command runs, whatever folder it was asked for from.
pub(crate) fn root() -> &'static Path {
    let xtask = Path::new(env!("CARGO_MANIFEST_DIR"));
    xtask.parent().unwrap_or(xtask)
}

/// The cargo that runs this program.
pub(crate) fn cargo(arguments: &[&str]) -> Command {
    let mut command = Command::new(env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    command.args(arguments);
    command
}

/// Runs a command at the root of the repository and waits for its end.
pub(crate) fn run(command: &mut Command) -> Result<()> {
    start(command.stdout(Stdio::inherit()), |_| {})
}

/// Runs a command, prints its standard output as it comes and hands each line to `read`.
pub(crate) fn run_and_read(command: &mut Command, read: impl FnMut(&str)) -> Result<()> {
    start(command.stdout(Stdio::piped()), read)
}

/// Runs a command for a verb whose standard output is for other programs: what is printed goes to the standard error.
pub(crate) fn run_aside(command: &mut Command) -> Result<()> {
    eprintln!("$ {}", command_line(command));
    wait(command.stdout(Stdio::null()), |_| {})
}

fn start(command: &mut Command, read: impl FnMut(&str)) -> Result<()> {
    println!("$ {}", command_line(command));
    wait(command, read)
}

fn wait(command: &mut Command, mut read: impl FnMut(&str)) -> Result<()> {
    let line = command_line(command);
    let mut child =
        command.current_dir(root()).stdin(Stdio::null()).spawn().with_context(|| format!("cannot start {line}"))?;
    if let Some(stdout) = child.stdout.take() {
        for printed in BufReader::new(stdout).split(b'\n') {
            let printed = printed.with_context(|| format!("cannot read what {line} prints"))?;
            let printed = String::from_utf8_lossy(&printed);
            println!("{printed}");
            read(&printed);
        }
    }
    let status = child.wait().with_context(|| format!("lost sight of {line}"))?;
    if !status.success() {
        bail!("{line}: {status}");
    }
    Ok(())
}

/// What a person would type for it.
fn command_line(command: &Command) -> String {
    let program = Path::new(command.get_program()).file_stem().unwrap_or(command.get_program());
    let words = [program].into_iter().chain(command.get_args()).map(|word| {
        let word = word.to_string_lossy();
        if word.contains(['*', ' ']) { format!("'{word}'") } else { word.into_owned() }
    });
    words.collect::<Vec<_>>().join(" ")
}
