//! Pseudo-terminals: one end for a test, the other for a program that believes in it.

use std::os::fd::OwnedFd;

use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};

/// A new one: this end, and where the other is.
///
/// The end goes to no program that is started meanwhile: the other side would not notice when this one closes it.
pub fn open() -> (OwnedFd, String) {
    let here = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | CLOSED_ON_EXEC).expect("a pseudo-terminal");
    grantpt(&here).expect("it can be granted");
    unlockpt(&here).expect("it can be unlocked");
    let there = ptsname(&here, Vec::new()).expect("it has a name").into_string().expect("its name is text");
    (here, there)
}

#[cfg(target_os = "linux")]
const CLOSED_ON_EXEC: OpenptFlags = OpenptFlags::CLOEXEC;
/// Elsewhere it cannot be asked for.
#[cfg(not(target_os = "linux"))]
const CLOSED_ON_EXEC: OpenptFlags = OpenptFlags::empty();
