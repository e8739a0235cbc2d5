//! Angles from the air, while they come.
//!
//! Something else captures the radio's frames (a sniffer, tshark, a dongle's own program) into a file that grows or
//! into a pipe; a thread reads them here, so that a person who takes long to put the mote in its place stops nothing.
//!
//! What can go wrong: the capture ends, or is none. Both end the session, which keeps what it has.

use std::fs::File;
use std::io::Read;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, TryRecvError, channel};
use std::time::Duration;

use air::capture::{self, EndOfNow, Growing};
use anyhow::{Context, Result, anyhow};

use super::points::Point;
use super::session::Source;
use super::solve::Sighting;
use super::sweeps::Heard;

/// How long to wait for a frame before the session may say something.
const WAIT: Duration = Duration::from_millis(200);

/// A capture that goes on.
#[derive(Debug)]
pub struct Live {
    from: Receiver<Result<Vec<Sighting>>>,
    /// Of a file; what comes through a pipe is read as it comes.
    end: Option<Arc<EndOfNow>>,
    enough: Arc<AtomicBool>,
}

impl Live {
    /// Opens a file or a pipe; `-` is the standard input.
    pub fn open(path: &Path) -> Result<Self> {
        let name = path.display().to_string();
        if name == "-" {
            return Ok(Self::read(name, std::io::stdin(), false));
        }
        let file = File::open(path).with_context(|| format!("{name}: cannot be read"))?;
        let grows = file.metadata().is_ok_and(|about| about.is_file());
        Ok(Self::read(name, file, grows))
    }

    /// Reads from anything; a source that `grows` has pauses where others end.
    pub fn read(name: String, from: impl Read + Send + 'static, grows: bool) -> Self {
        let end = grows.then(Arc::<EndOfNow>::default);
        let enough = Arc::new(AtomicBool::new(false));
        let (to, receiver) = channel();
        let (asked, stop) = (end.clone(), enough.clone());
        std::thread::spawn(move || {
            let from: Box<dyn Read> = match asked {
                Some(end) => Box::new(Growing::new(from, end, stop.clone())),
                None => Box::new(from),
            };
            let mut heard = Heard::default();
            let mut half_turns = Vec::new();
            let ended = capture::frames(&name, from, |frame| {
                half_turns.clear();
                let said = heard.hear(frame, &mut half_turns).with_context(|| name.clone());
                // Nobody listens once the session is over.
                to.send(said).is_ok() && !stop.load(Ordering::Relaxed)
            });
            let _ = to.send(ended.and_then(|()| Err(anyhow!("{name}: the capture has ended"))));
        });
        Self { from: receiver, end, enough }
    }
}

impl Source for Live {
    fn begin(&mut self, _: &Point) -> Result<()> {
        // What was captured before the mote stood there may take a moment to be read past.
        let asked = self.end.as_ref().map(|end| (end, end.ask()));
        loop {
            let caught_up = asked.is_none_or(|(end, question)| end.is_reached(question));
            loop {
                match self.from.try_recv() {
                    Ok(said) => drop(said?),
                    Err(TryRecvError::Empty) => break,
                    Err(TryRecvError::Disconnected) => return Err(anyhow!("the capture has ended")),
                }
            }
            if caught_up {
                return Ok(());
            }
            std::thread::sleep(WAIT / 10);
        }
    }

    fn next(&mut self) -> Result<Vec<Sighting>> {
        match self.from.recv_timeout(WAIT) {
            Ok(said) => said,
            Err(RecvTimeoutError::Timeout) => Ok(Vec::new()),
            Err(RecvTimeoutError::Disconnected) => Err(anyhow!("the capture has ended")),
        }
    }
}

impl Drop for Live {
    fn drop(&mut self) {
        self.enough.store(true, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use lighthouse_mote::frame::{ANGLES_LEN, Angles, Header, Measured, emit_angles};
    use lighthouse_mote::sweep::{Axis, Station};
    use nalgebra::Vector3;

    use super::*;
    use crate::pcap::{self, Frame};

    /// The next sightings, however long they take.
    fn some(live: &mut Live) -> Vec<Sighting> {
        loop {
            let seen = live.next().unwrap();
            if !seen.is_empty() {
                return seen;
            }
        }
    }

    /// A capture of one sweep at a time of the mote's; without its head, what is appended to one.
    fn captured(time: u32) -> Vec<u8> {
        let mut angles = Angles { half_turn_q8: 90_000 << 8, ..Angles::default() };
        let _ = angles.sweeps.push(Measured { time, station: Station::A, axis: Axis::Azimuth, share: 1 << 19 });
        let header = Header { pan: 1, mote: 1, sequence: 0 };
        let bytes = emit_angles(header, &angles, &mut [0; ANGLES_LEN]).to_vec();
        let mut capture = Vec::new();
        pcap::write(&[Frame { micros: 0, bytes }], &mut capture).unwrap();
        capture
    }

    #[test]
    fn what_came_before_the_mote_stood_there_does_not_count() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("air.pcap");
        std::fs::write(&path, captured(0)).unwrap();
        let mut air = std::fs::OpenOptions::new().append(true).open(&path).unwrap();
        let place = Point { name: "lamp".into(), position: Vector3::zeros() };
        let mut live = Live::open(&path).unwrap();
        assert_eq!(some(&mut live)[0].at_s, 0.0);
        for half_turn in [1, 3] {
            air.write_all(&captured(half_turn * 90_000)[24..]).unwrap();
            live.begin(&place).unwrap();
            air.write_all(&captured((half_turn + 1) * 90_000)[24..]).unwrap();
            let seen = some(&mut live);
            assert_eq!(seen.len(), 1);
            assert!((seen[0].at_s - f64::from(half_turn + 1) / 120.0).abs() < 1e-12, "{seen:?}");
        }
    }

    #[test]
    fn a_pipe_that_ends_is_an_end() {
        let (from, mut to) = std::io::pipe().unwrap();
        let mut live = Live::read("pipe".to_string(), from, false);
        to.write_all(&captured(0)).unwrap();
        assert_eq!(some(&mut live).len(), 1);
        drop(to);
        let end = loop {
            if let Err(end) = live.next() {
                break end;
            }
        };
        assert_eq!(end.to_string(), "pipe: the capture has ended");
    }
}
