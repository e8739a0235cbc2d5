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

use anyhow::{Context, Result, anyhow};

use super::capture::{self, Growing};
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
    caught_up: Arc<AtomicBool>,
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
        let caught_up = Arc::new(AtomicBool::new(!grows));
        let enough = Arc::new(AtomicBool::new(false));
        let (to, receiver) = channel();
        let (flags, stop) = ((caught_up.clone(), enough.clone()), enough.clone());
        std::thread::spawn(move || {
            let from: Box<dyn Read> = match grows {
                true => Box::new(Growing::new(from, flags.0, flags.1)),
                false => Box::new(from),
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
        Self { from: receiver, caught_up, enough }
    }
}

impl Source for Live {
    fn begin(&mut self, _: &Point) -> Result<()> {
        loop {
            // What was captured before the mote stood there may take a moment to be read past.
            let caught_up = self.caught_up.load(Ordering::Relaxed);
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

    #[test]
    fn what_came_before_the_mote_stood_there_does_not_count() {
        let (from, mut to) = std::io::pipe().unwrap();
        let mut live = Live::read("pipe".to_string(), from, false);
        let frame = |time: u32| {
            let mut angles = Angles { half_turn_q8: 90_000 << 8, ..Angles::default() };
            let _ = angles.sweeps.push(Measured { time, station: Station::A, axis: Axis::Azimuth, share: 1 << 19 });
            let header = Header { pan: 1, mote: 1, sequence: 0 };
            let bytes = emit_angles(header, &angles, &mut [0; ANGLES_LEN]).to_vec();
            let mut capture = Vec::new();
            pcap::write(&[Frame { micros: 0, bytes }], &mut capture).unwrap();
            capture
        };
        let place = Point { name: "lamp".into(), position: Vector3::zeros() };
        to.write_all(&frame(0)).unwrap();
        // The thread reads it when it likes; it must be there before it can be thrown away.
        let first = loop {
            let seen = live.next().unwrap();
            if !seen.is_empty() {
                break seen;
            }
        };
        assert_eq!(first[0].at_s, 0.0);
        to.write_all(&frame(90_000)[24..]).unwrap();
        std::thread::sleep(WAIT);
        live.begin(&place).unwrap();
        to.write_all(&frame(180_000)[24..]).unwrap();
        let seen = loop {
            let seen = live.next().unwrap();
            if !seen.is_empty() {
                break seen;
            }
        };
        assert_eq!(seen.len(), 1);
        assert!((seen[0].at_s - 2.0 / 120.0).abs() < 1e-12, "{seen:?}");
        drop(to);
        let end = loop {
            if let Err(end) = live.next() {
                break end;
            }
        };
        assert_eq!(end.to_string(), "pipe: the capture has ended");
    }
}
