//! The person at the terminal: `cargo xtask calibrate` on a pseudo-terminal, read and typed to.

use std::fs::{File, OpenOptions};
use std::io::{Read, Write};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use crate::pty;

/// Who waits for longer is in a test that has failed.
const PATIENCE: Duration = Duration::from_secs(300);

/// A terminal with the tool at work on it.
pub struct Terminal {
    screen: File,
    tool: Child,
    said: String,
    /// How much of it has been waited for.
    read: usize,
}

impl Terminal {
    /// Types the command.
    pub fn calibrate(words: &[&str]) -> Self {
        let (screen, name) = pty::open();
        let line = OpenOptions::new().read(true).write(true).open(name).expect("its other end");
        let end = || Stdio::from(line.try_clone().expect("the same end"));
        let mut command = Command::new(env!("CARGO_BIN_EXE_xtask"));
        command.arg("calibrate").args(words).stdin(end()).stdout(end()).stderr(end());
        let tool = command.spawn().expect("the tool starts");
        Self { screen: screen.into(), tool, said: String::new(), read: 0 }
    }

    /// Reads on until this is on the screen, after what was waited for before.
    pub fn until(&mut self, wanted: &str) {
        let start = Instant::now();
        loop {
            if let Some(at) = self.said[self.read..].find(wanted) {
                self.read += at + wanted.len();
                return;
            }
            assert!(start.elapsed() < PATIENCE && self.hear(), "`{wanted}` did not come: {}", self.said);
        }
    }

    /// What is on the screen is read for a moment; false when the tool has gone.
    fn hear(&mut self) -> bool {
        let mut ready = [PollFd::new(&self.screen, PollFlags::IN)];
        let limit = Timespec { tv_sec: 0, tv_nsec: 100_000_000 };
        poll(&mut ready, Some(&limit)).expect("a terminal can be waited for");
        let events = ready[0].revents();
        if !events.contains(PollFlags::IN) {
            return !events.contains(PollFlags::HUP);
        }
        let mut piece = [0; 4096];
        match self.screen.read(&mut piece) {
            Ok(0) | Err(_) => false,
            Ok(count) => {
                // A letter cut in two is of no interest here.
                self.said += &String::from_utf8_lossy(&piece[..count]);
                true
            }
        }
    }

    /// Presses keys.
    pub fn press(&mut self, keys: &str) {
        self.screen.write_all(keys.as_bytes()).expect("keys");
    }

    /// Ends the tool as a person, or the system, would.
    pub fn kill(mut self, signal: &str) {
        let kill = format!("kill -{signal} {}", self.tool.id());
        assert!(Command::new("sh").args(["-c", &kill]).status().expect("a shell").success(), "{kill}");
        let status = self.wait();
        assert!(!status.success(), "{status}: {}", self.said);
    }

    /// Reads what comes until the tool has ended well; returns all that was on the screen.
    pub fn end(mut self) -> String {
        let status = self.wait();
        assert!(status.success(), "{status}: {}", self.said);
        self.said.clone()
    }

    fn wait(&mut self) -> ExitStatus {
        let start = Instant::now();
        while self.hear() {
            assert!(start.elapsed() < PATIENCE, "it does not end: {}", self.said);
        }
        self.tool.wait().expect("it ended")
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        // Of a test that failed; otherwise it is gone already.
        let _ = self.tool.kill();
        let _ = self.tool.wait();
    }
}
