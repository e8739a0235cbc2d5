//! The frame counters that were heard, kept in a file: what was believed once is not believed again by the next listener.
//!
//! Several listeners may keep theirs in one file. Motes that are simulated have none there.
//!
//! What can go wrong: the file is lost, and frames from before count once more; or the computer goes down, and those of the
//! last ten seconds do. A file that cannot be written is an error before anything is heard.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::Result;

use super::model::{Event, Shared, lock};
use super::output::Sink;

/// How often they are written.
const EVERY: Duration = Duration::from_secs(10);

/// The file, and whose counters are in it.
pub(super) struct Counters {
    path: PathBuf,
    shared: Shared,
    written: Instant,
}

impl Counters {
    /// Takes what an earlier listener left at `path`.
    ///
    /// # Errors
    /// A file that holds something else, or cannot be written.
    pub(super) fn open(path: PathBuf, shared: Shared) -> Result<Self> {
        let mut swarm = lock(&shared);
        swarm.guard_mut().load(&path)?;
        swarm.guard_mut().save(&path)?;
        drop(swarm);
        Ok(Self { path, shared, written: Instant::now() })
    }
}

impl Sink for Counters {
    fn event(&mut self, _: &Event) -> Result<()> {
        Ok(())
    }

    fn tick(&mut self) -> Result<()> {
        if self.written.elapsed() < EVERY {
            return Ok(());
        }
        self.end()
    }

    fn end(&mut self) -> Result<()> {
        self.written = Instant::now();
        lock(&self.shared).guard_mut().save(&self.path)
    }
}
