//! Who may be believed: frames under the room's key, each once.
//!
//! With a key, a frame counts where its code fits and its counter is new: larger than that of every frame of that mote
//! before, or one of the 64 before it that has not come yet. All others are turned away and counted by cause, and never
//! become a position. Without a key, plain frames count, and secured ones are counted as what nobody here can check.
//!
//! A frame that comes again is a duplicate where another receiver hands it over, for receivers overlap, and replayed
//! where the same one does: nobody sends a frame twice.
//!
//! Two motes with one id and one key count each for itself, and the one that was programmed later is ahead for ever.
//! Only that one is believed: what the other sends cannot be told from old frames that somebody sends again. But it is not
//! passed over in silence: refused frames whose counters rise, as those of a mote do, are [`Behind`], and where newer
//! ones come between them its `is_twin` says so. It takes frames under the key to come that far, and whoever sends old
//! ones again gains no more than that flag: what is believed stays what it was.
//!
//! What can go wrong:
//! - The counters are forgotten, and old frames count once more. [`Guard::save`] and [`Guard::load`] keep them in a file.
//! - A receiver hands a frame over twice by itself, or somebody has made one interface of two receivers' captures: replayed,
//!   as if it had been sent twice.
//! - More than 64 receivers: the 64th and all after it count as one.

use std::collections::BTreeMap;
use std::fmt;
use std::fs::File;
use std::io::{ErrorKind, Write as _};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow, bail};
use lighthouse_mote::frame::secured::{Claim, Key, Open, claim};
use lighthouse_mote::frame::{Header, Message, Reject, parse};

use crate::calib::{Calibration, schema};

/// Why a frame is not believed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// It is none of ours, secured or not.
    NotOurs(Reject),
    /// It is plain, and this room has a key.
    Unsecured,
    /// It is secured, and nobody gave us the key.
    NoKey,
    /// Its code does not fit: another key, or changed on the way by somebody who made the check sequence fit.
    Forged,
    /// One of the latest 64 frames of that mote once more: another receiver has heard it too.
    Duplicate,
    /// A frame sent once more, or a mote whose counter began again, or two motes with one id.
    Replayed {
        /// The frame's counter.
        counter: u32,
        /// The largest one of that mote so far.
        latest: u32,
    },
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotOurs(reject) => reject.fmt(f),
            Self::Unsecured => f.write_str("a plain frame where the room has a key"),
            Self::NoKey => f.write_str("a secured frame, and no key to check it with"),
            Self::Forged => f.write_str("forged, or under another key"),
            Self::Duplicate => f.write_str("heard before"),
            Self::Replayed { counter, latest } => write!(f, "replayed: counter {counter} after {latest}"),
        }
    }
}

impl std::error::Error for Refusal {}

/// How many frames were refused, by cause.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Refused {
    /// None of ours.
    pub not_ours: u64,
    /// Plain where there is a key.
    pub unsecured: u64,
    /// Secured where there is none.
    pub no_key: u64,
    /// With a code that does not fit.
    pub forged: u64,
    /// Heard before, by another receiver.
    pub duplicate: u64,
    /// Heard before by the same one, or with an old counter.
    pub replayed: u64,
}

impl Refused {
    fn count(&mut self, refusal: &Refusal) {
        *match refusal {
            Refusal::NotOurs(_) => &mut self.not_ours,
            Refusal::Unsecured => &mut self.unsecured,
            Refusal::NoKey => &mut self.no_key,
            Refusal::Forged => &mut self.forged,
            Refusal::Duplicate => &mut self.duplicate,
            Refusal::Replayed { .. } => &mut self.replayed,
        } += 1;
    }
}

/// How many counters up to the newest are told apart: frames that come late over another receiver count too, each once.
const REMEMBERED: u32 = 64;
/// Stands for every receiver: what an earlier listener heard.
const EARLIER: u64 = u64::MAX;
/// Refused frames with rising counters that are no accident, and how many times newer ones came between them: as many as
/// where there is no key, in [`crate::listen::model`].
const RISES: u64 = 3;
const INTERRUPTIONS: u64 = 2;
/// A stream of refused frames ends where it does not rise for so long, seconds: some health frames.
pub const STREAM_S: f64 = 10.0;

/// A counter that was believed.
#[derive(Debug, Clone, Copy, Default)]
struct Taken {
    /// The integrity code it came with: another frame under the same counter has another, but for one in 2^32.
    mic: u32,
    /// Bit n: receiver n has handed it over. 0: nobody yet.
    by: u64,
}

/// Frames of one mote that are refused for their counters, although these rise.
#[derive(Debug, Clone, Copy)]
struct Stream {
    counter: u32,
    at_s: f64,
    rises: u64,
    /// Times newer frames came between two of them.
    interruptions: u64,
    /// One has come since the last of them.
    is_interrupted: bool,
}

/// What was heard of one mote.
#[derive(Clone, Debug)]
struct Heard {
    /// The largest counter that was believed.
    latest: u32,
    /// Where the counters that end there began: since then no 64 in a row were missing.
    from: u64,
    /// The latest [`REMEMBERED`] counters, each at its remainder.
    taken: [Taken; REMEMBERED as usize],
    /// The receivers' own largest ones.
    ears: Vec<(u8, u32)>,
    behind: Option<Stream>,
}

/// A counter's place among the latest.
fn place(counter: u32) -> usize {
    (counter % REMEMBERED) as usize
}

impl Heard {
    /// The first frame of a mote.
    fn new(counter: u32) -> Self {
        // As if the one before the window had come: those in it may still.
        let taken = [Taken::default(); REMEMBERED as usize];
        Self { latest: counter, from: counter.into(), taken, ears: Vec::new(), behind: None }
    }

    /// What an earlier listener has left: none up to `counter` counts any more.
    fn earlier(counter: u32) -> Self {
        let taken = [Taken { mic: 0, by: EARLIER }; REMEMBERED as usize];
        Self { taken, from: u64::from(counter) + 1, ..Self::new(counter) }
    }

    /// Takes a counter that was proved, from a receiver.
    fn take(&mut self, at_s: f64, ear: u8, counter: u32, mic: u32) -> Result<(), Refusal> {
        let (latest, bit) = (self.latest, 1 << ear);
        let went_back = self.went_back(ear, counter);
        if counter > latest {
            if counter - latest >= REMEMBERED {
                self.taken = [Taken::default(); REMEMBERED as usize];
                self.from = counter.into();
            }
            for missing in latest + 1..counter {
                self.taken[place(missing)] = Taken::default();
            }
            self.latest = counter;
            self.taken[place(counter)] = Taken { mic, by: bit };
            if let Some(behind) = &mut self.behind {
                behind.is_interrupted = true;
            }
            return Ok(());
        }
        let is_recent = latest - counter < REMEMBERED;
        let taken = &mut self.taken[place(counter)];
        if is_recent && taken.by == 0 {
            *taken = Taken { mic, by: bit };
            self.from = self.from.min(counter.into());
            return Ok(());
        }
        let is_same = is_recent && taken.by != EARLIER && taken.mic == mic;
        if is_same && taken.by & bit == 0 {
            taken.by |= bit;
            return Err(Refusal::Duplicate);
        }
        // Another frame under a counter of these, one from before them all, or one behind a newer one of the same
        // receiver: another mote, or an old frame. Else that receiver is just late.
        let is_recent = is_recent && taken.by != EARLIER;
        if !is_same && (is_recent || went_back || u64::from(counter) < self.from) {
            self.stray(at_s, counter);
        }
        Err(Refusal::Replayed { counter, latest })
    }

    /// Whether that receiver has had a newer one; knows of this one from now on.
    fn went_back(&mut self, ear: u8, counter: u32) -> bool {
        match self.ears.iter_mut().find(|known| known.0 == ear) {
            Some((_, newest)) if counter < *newest => true,
            Some((_, newest)) => {
                *newest = counter;
                false
            }
            None => {
                self.ears.push((ear, counter));
                false
            }
        }
    }

    /// Watches a frame that is none of those that are believed.
    fn stray(&mut self, at_s: f64, counter: u32) {
        match &mut self.behind {
            Some(stream) if at_s - stream.at_s <= STREAM_S => {
                if counter > stream.counter {
                    stream.rises += 1;
                    stream.interruptions += u64::from(std::mem::take(&mut stream.is_interrupted));
                    (stream.counter, stream.at_s) = (counter, at_s);
                }
            }
            _ => {
                self.behind = Some(Stream { counter, at_s, rises: 1, interruptions: 0, is_interrupted: false });
            }
        }
    }
}

/// A mote whose frames are refused for their counters, although these rise: it counts anew, or is another's twin, or its
/// old frames are sent again.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Behind {
    /// The personal area network.
    pub pan: u16,
    /// The mote.
    pub mote: u16,
    /// Newer frames of that mote come between those that are refused: there are two, or somebody plays one.
    pub is_twin: bool,
    /// The counter of the last frame that was refused.
    pub counter: u32,
    /// The largest that was believed.
    pub latest: u32,
    /// How many were refused, each with a larger counter than the one before.
    pub frames: u64,
    /// When the last was.
    pub at_s: f64,
}

/// Stands between the air and everything that shows or keeps a position.
#[derive(Debug, Clone, Default)]
pub struct Guard {
    key: Option<Key>,
    /// By PAN and mote: what was believed.
    heard: BTreeMap<(u16, u16), Heard>,
    /// What was refused so far.
    pub refused: Refused,
}

impl Guard {
    /// Believes frames under `key` alone; plain ones where there is none.
    #[must_use]
    pub fn new(key: Option<[u8; 16]>) -> Self {
        Self { key: key.map(|bytes| Key::new(&bytes)), ..Self::default() }
    }

    /// Reads a whole frame, FCS included, if it may be believed, where there is one receiver.
    ///
    /// # Errors
    /// Why it may not; counted in [`Guard::refused`].
    pub fn open(&mut self, bytes: &[u8]) -> Result<(Header, Message), Refusal> {
        self.hear(0.0, 0, bytes)
    }

    /// The same from one of several receivers, by its number, at a time.
    ///
    /// # Errors
    /// As [`Guard::open`].
    pub fn hear(&mut self, at_s: f64, receiver: usize, bytes: &[u8]) -> Result<(Header, Message), Refusal> {
        let read = self.read(at_s, receiver.min(63) as u8, bytes);
        if let Err(refusal) = &read {
            self.refused.count(refusal);
        }
        read
    }

    fn read(&mut self, at_s: f64, ear: u8, bytes: &[u8]) -> Result<(Header, Message), Refusal> {
        let Some(key) = &self.key else {
            return parse(bytes).map_err(|reject| match claim(bytes) {
                Ok(_) => Refusal::NoKey,
                Err(_) => Refusal::NotOurs(reject),
            });
        };
        let (Claim { pan, mote, counter }, plain) = key.open(bytes).map_err(|refusal| match refusal {
            Open::Forged => Refusal::Forged,
            Open::Reject(reject) if parse(bytes).is_ok() => {
                let _ = reject;
                Refusal::Unsecured
            }
            Open::Reject(reject) => Refusal::NotOurs(reject),
        })?;
        let read = parse(plain.bytes()).map_err(Refusal::NotOurs)?;
        let mic = bytes.split_last_chunk::<6>().map_or(0, |(_, [a, b, c, d, ..])| u32::from_le_bytes([*a, *b, *c, *d]));
        self.heard.entry((pan, mote)).or_insert_with(|| Heard::new(counter)).take(at_s, ear, counter, mic)?;
        Ok(read)
    }

    /// Motes whose frames are refused for their counters, although these rise; by PAN and id.
    pub fn behind(&self) -> impl Iterator<Item = Behind> {
        self.heard.iter().filter_map(|(whose, heard)| behind(*whose, heard))
    }

    /// The same of one mote.
    #[must_use]
    pub fn behind_of(&self, pan: u16, mote: u16) -> Option<Behind> {
        behind((pan, mote), self.heard.get(&(pan, mote))?)
    }

    /// Takes the counters that [`Guard::save`] wrote; no file is no counters.
    ///
    /// # Errors
    /// A line that is none, with file, line and text.
    pub fn load(&mut self, path: &Path) -> Result<()> {
        for (whose, counter) in counters(path)? {
            // Which of those before it were heard is forgotten: none of them counts any more.
            if self.heard.get(&whose).is_none_or(|heard| counter > heard.latest) {
                self.heard.insert(whose, Heard::earlier(counter));
            }
        }
        Ok(())
    }

    /// Writes the counters, one mote a line: PAN and mote in hex, counter; of those that another listener has written
    /// meanwhile the larger. The old file stays until the new one is whole. Listeners take turns by a lock on a file beside
    /// it, `.lock` behind its name.
    ///
    /// # Errors
    /// It holds something else, or cannot be written.
    pub fn save(&self, path: &Path) -> Result<()> {
        let unwritten = || format!("{}: cannot be written", path.display());
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let mut beside = path.as_os_str().to_owned();
        beside.push(".lock");
        let turn = File::options().create(true).truncate(false).write(true).open(PathBuf::from(beside));
        let turn = turn.with_context(unwritten)?;
        match turn.lock() {
            // A file system without locks; whoever is alone needs none.
            Err(error) if error.kind() == ErrorKind::Unsupported => {}
            locked => locked.with_context(unwritten)?,
        }
        let mut all = counters(path)?;
        for (whose, heard) in &self.heard {
            let known = all.entry(*whose).or_default();
            *known = heard.latest.max(*known);
        }
        let mut file = tempfile::NamedTempFile::new_in(folder).with_context(unwritten)?;
        for ((pan, mote), counter) in all {
            writeln!(file, "{pan:04x} {mote:04x} {counter}").with_context(unwritten)?;
        }
        file.persist(path).with_context(unwritten)?;
        Ok(())
    }
}

fn behind((pan, mote): (u16, u16), heard: &Heard) -> Option<Behind> {
    let stream = heard.behind.filter(|stream| stream.rises >= RISES)?;
    Some(Behind {
        pan,
        mote,
        is_twin: stream.interruptions >= INTERRUPTIONS,
        counter: stream.counter,
        latest: heard.latest,
        frames: stream.rises,
        at_s: stream.at_s,
    })
}

/// The counters that a file holds, the largest of each mote; no file is none.
fn counters(path: &Path) -> Result<BTreeMap<(u16, u16), u32>> {
    let text = match std::fs::read_to_string(path) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(BTreeMap::new()),
        text => text.with_context(|| path.display().to_string())?,
    };
    let mut all = BTreeMap::new();
    for (index, line) in text.lines().enumerate() {
        let numbers = || {
            let [pan, mote, counter] = line.split(' ').collect::<Vec<_>>()[..] else { return None };
            let hex = |text| u16::from_str_radix(text, 16).ok();
            Some((hex(pan)?, hex(mote)?, counter.parse::<u32>().ok()?))
        };
        let (pan, mote, counter) =
            numbers().ok_or_else(|| anyhow!("{}:{}: not a counter: {line:?}", path.display(), index + 1))?;
        let known = all.entry((pan, mote)).or_default();
        *known = counter.max(*known);
    }
    Ok(all)
}

/// Reads a key file: 32 hex digits, blanks between them as one likes, lines that begin with `#` aside.
///
/// # Errors
/// The file cannot be read or holds something else; its content is never repeated.
pub fn key(path: &Path) -> Result<[u8; 16]> {
    crate::calib::key::open(path).map_err(|error| anyhow!("{error}"))
}

/// The key of a room: what `LIGHTHOUSE_KEY` names, or else what the room's file does.
///
/// # Errors
/// As [`key`].
pub fn key_of(room: &Calibration) -> Result<Option<[u8; 16]>> {
    Ok(key_of_environment()?.or(room.mote.key.map(|key| key.0)))
}

/// The text of a room's file, to be kept elsewhere: it names its key where that is.
#[must_use]
pub fn with_key_in_place(room: &Path, text: &str) -> String {
    let Some((place, file)) = schema::key_file(text) else { return text.to_string() };
    let file = room.parent().unwrap_or(Path::new("")).join(file);
    let Ok(file) = std::path::absolute(&file) else { return text.to_string() };
    let (before, after) = (text.get(..place.start), text.get(place.end..));
    let value = toml::Value::String(file.display().to_string());
    format!("{}{value}{}", before.unwrap_or_default(), after.unwrap_or_default())
}

/// The room of a recording, `kept` beside it, and the key of its frames: what `LIGHTHOUSE_KEY` names, or else the room
/// `calib`, or else the room that was kept.
///
/// # Errors
/// A file that cannot be read or understood; a key that the recording's room names and nobody has.
pub fn of_recording(kept: Option<&Path>, calib: Option<&Path>) -> Result<(Option<Calibration>, Option<[u8; 16]>)> {
    let mut found = key_of_environment()?;
    if found.is_none()
        && let Some(calib) = calib
    {
        found = schema::open(calib)?.mote.key.map(|key| key.0);
    }
    let Some(kept) = kept else { return Ok((None, found)) };
    let name = kept.display().to_string();
    let text = std::fs::read_to_string(kept).with_context(|| name.clone())?;
    let room = schema::read_without_key(&name, &text)?;
    if found.is_none()
        && let Some((_, file)) = schema::key_file(&text)
    {
        let file = kept.parent().unwrap_or(Path::new("")).join(file);
        let missing = "--calib ROOM or LIGHTHOUSE_KEY=FILE names the key of the recorded frames";
        found = Some(key(&file).with_context(|| format!("{name}: mote.key_file; {missing}"))?);
    }
    Ok((Some(room), found))
}

/// The key that the environment names by `LIGHTHOUSE_KEY`, a key file.
///
/// # Errors
/// As [`key`].
pub fn key_of_environment() -> Result<Option<[u8; 16]>> {
    match std::env::var("LIGHTHOUSE_KEY") {
        Ok(path) if !path.is_empty() => key(Path::new(&path)).map(Some),
        Err(std::env::VarError::NotUnicode(_)) => bail!("LIGHTHOUSE_KEY is no text"),
        _ => Ok(None),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use lighthouse_mote::frame::{Aligned, Report, emit_into, fcs};

    const KEY: [u8; 16] = *b"a room of its ow";

    fn plain(mote: u16, sequence: u16) -> Aligned {
        let mut frame = Aligned::BLANK;
        emit_into(&mut frame, Header { pan: 0x4c48, mote, sequence }, &Report::default());
        frame
    }

    fn sealed(key: &[u8; 16], mote: u16, counter: u32) -> Vec<u8> {
        sealed_as(key, mote, counter as u16, counter)
    }

    fn sealed_as(key: &[u8; 16], mote: u16, sequence: u16, counter: u32) -> Vec<u8> {
        let mut frame = plain(mote, sequence);
        assert!(Key::new(key).seal(&mut frame, counter));
        frame.bytes().to_vec()
    }

    /// Another bit, and the check sequence made right again.
    fn flipped(bytes: &[u8], bit: usize) -> Vec<u8> {
        let mut bytes = bytes.to_vec();
        bytes[bit / 8] ^= 1 << (bit % 8);
        let body = bytes.len() - 2;
        let check = fcs(&bytes[..body]).to_le_bytes();
        bytes[body..].copy_from_slice(&check);
        bytes
    }

    #[test]
    fn a_forged_a_replayed_and_a_flipped_frame_are_counted_and_never_read() {
        let mut guard = Guard::new(Some(KEY));
        assert_eq!(guard.open(&sealed(&KEY, 7, 10)).unwrap().0.mote, 7);
        assert_eq!(guard.open(&sealed(b"another room's..", 7, 11)), Err(Refusal::Forged));
        assert_eq!(guard.open(&sealed(&KEY, 7, 10)), Err(Refusal::Replayed { counter: 10, latest: 10 }));
        // One that came late over another receiver counts, once; one that is older than 64 frames does not.
        assert!(guard.hear(0.0, 1, &sealed(&KEY, 7, 9)).is_ok());
        assert_eq!(guard.open(&sealed(&KEY, 7, 9)), Err(Refusal::Duplicate));
        assert!(guard.open(&sealed(&KEY, 7, 80)).is_ok());
        assert_eq!(guard.open(&sealed(&KEY, 7, 10)), Err(Refusal::Replayed { counter: 10, latest: 80 }));
        let next = sealed(&KEY, 7, 81);
        for bit in 0..8 * next.len() {
            assert!(guard.open(&flipped(&next, bit)).is_err() || bit >= 8 * (next.len() - 2), "bit {bit}");
        }
        let mut torn = sealed(&KEY, 7, 82);
        torn[40] ^= 1;
        assert_eq!(guard.open(&torn), Err(Refusal::NotOurs(Reject::Fcs)));
        assert_eq!(guard.open(plain(7, 13).bytes()), Err(Refusal::Unsecured));
        // A larger counter that nobody could prove has locked nobody out.
        assert!(guard.open(&sealed(&KEY, 7, 82)).is_ok());
        let Refused { unsecured, no_key, duplicate, replayed, .. } = guard.refused;
        assert_eq!((unsecured, no_key), (1, 0));
        // The check sequence has 16 bits, which are put right again: 15 of these frames have come before.
        assert!(duplicate == 1 && replayed == 2 + 15 && guard.refused.forged > 1, "{:?}", guard.refused);
    }

    #[test]
    fn a_frame_is_a_duplicate_of_each_further_receiver_once_and_replayed_after_that() {
        const RECEIVERS: usize = 64;
        let mut guard = Guard::new(Some(KEY));
        for counter in 100..200 {
            let frame = sealed(&KEY, 7, counter);
            assert!(guard.hear(0.0, counter as usize % RECEIVERS, &frame).is_ok());
            for further in 1..RECEIVERS {
                let receiver = (counter as usize + further) % RECEIVERS;
                assert_eq!(guard.hear(0.0, receiver, &frame), Err(Refusal::Duplicate), "{receiver}");
            }
            for receiver in 0..RECEIVERS {
                let replayed = Err(Refusal::Replayed { counter, latest: counter });
                assert_eq!(guard.hear(0.0, receiver, &frame), replayed, "{receiver}");
            }
        }
        // One frame again and again is no mote.
        assert_eq!(guard.behind().count(), 0);
    }

    /// How many frames of a mote under these counters receiver 0 is believed, one every tenth of a second.
    fn heard(guard: &mut Guard, counters: impl IntoIterator<Item = u32>, from_s: f64) -> usize {
        let times = (0..).map(|n| from_s + 0.1 * f64::from(n));
        let frames = counters.into_iter().map(|counter| sealed_as(&KEY, 7, from_s as u16, counter));
        times.zip(frames).filter(|(at_s, frame)| guard.hear(*at_s, 0, frame).is_ok()).count()
    }

    #[test]
    fn of_two_motes_with_one_id_the_one_ahead_is_believed_and_the_other_is_told_of() {
        // Flashed minutes, one minute or years apart; whichever is heard first.
        for (behind, ahead) in [(5_120, 9_216), (1_024, 2_048), (1, 4_000_000_000), (1_000, 1_065)] {
            for first in [0, 1] {
                let mut guard = Guard::new(Some(KEY));
                let of = |n: u32| if n % 2 == first { ahead + n / 2 } else { behind + n / 2 };
                let believed = heard(&mut guard, (0..40).map(of), 0.0);
                // The one behind is believed until the other is heard.
                assert_eq!(believed, if first == 0 { 20 } else { 21 }, "{behind} {ahead}");
                let told = guard.behind_of(0x4c48, 7).unwrap();
                assert_eq!((told.is_twin, told.counter, told.latest), (true, behind + 19, ahead + 19), "{told:?}");
                assert_eq!(told.frames, if first == 0 { 20 } else { 19 });
                assert!(guard.behind().eq([told]));
            }
        }
    }

    #[test]
    fn two_motes_that_count_alike_are_told_of_by_their_integrity_codes() {
        // Programmed within one minute: each counter comes twice, with another frame.
        let mut guard = Guard::new(Some(KEY));
        let other = |counter| sealed_as(&KEY, 7, 40_000, counter);
        for counter in 1_024..1_034 {
            assert!(guard.hear(0.0, 0, &sealed(&KEY, 7, counter)).is_ok());
            let refusal = Err(Refusal::Replayed { counter, latest: counter });
            assert_eq!(guard.hear(0.0, 1, &other(counter)), refusal, "no duplicate, whoever hears it");
        }
        assert!(guard.behind_of(0x4c48, 7).unwrap().is_twin);
    }

    #[test]
    fn a_mote_that_counts_anew_is_told_of_until_it_is_believed_again() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("counters");
        let mut guard = Guard::new(Some(KEY));
        assert_eq!(heard(&mut guard, 1_000..1_200, 0.0), 200);
        guard.save(&path).unwrap();
        // To the listener that has heard it, and to the next.
        let mut next = Guard::new(Some(KEY));
        next.load(&path).unwrap();
        for guard in [&mut guard, &mut next] {
            assert_eq!(heard(guard, 1_000..1_200, 20.0), 0);
            let told = guard.behind_of(0x4c48, 7).unwrap();
            assert_eq!((told.is_twin, told.counter, told.latest), (false, 1_199, 1_199));
            assert_eq!(heard(guard, 1_200..1_300, 40.0), 100);
            assert!(!guard.behind_of(0x4c48, 7).unwrap().is_twin);
        }
    }

    #[test]
    fn who_sends_old_frames_again_hides_no_mote() {
        let mut guard = Guard::new(Some(KEY));
        // Of an hour ago, when nobody listened: in their order, backwards, and one for ever.
        let old: [&dyn Fn(u32) -> u32; 3] = [&|n| 1_000 + n, &|n| 9_000 - n, &|_| 5_000];
        for n in 0..3_000 {
            let at_s = 0.07 * f64::from(n);
            assert!(guard.hear(at_s, 0, &sealed(&KEY, 7, 60_000 + n)).is_ok(), "{n}");
            for old in &old {
                let replayed = guard.hear(at_s, 0, &sealed(&KEY, 7, old(n)));
                assert!(matches!(replayed, Err(Refusal::Replayed { .. })), "{n}");
            }
        }
        assert_eq!(guard.refused, Refused { replayed: 9_000, ..Refused::default() });
        assert_eq!(guard.heard.len(), 1);
        // Without the key nobody is told of at all.
        let mut guard = Guard::new(Some(KEY));
        assert_eq!(heard(&mut guard, 1_000..1_010, 0.0), 10);
        for counter in 0..100 {
            assert_eq!(guard.open(&sealed(b"another room's..", 7, counter)), Err(Refusal::Forged));
        }
        assert_eq!(guard.behind().count(), 0);
    }

    #[test]
    fn a_receiver_that_is_late_is_no_twin() {
        let mut guard = Guard::new(Some(KEY));
        // By 500 frames, of which the other has lost every ninth.
        for n in 0..2_000_u32 {
            if n % 9 != 0 || n < 500 {
                assert!(guard.hear(0.0, 0, &sealed(&KEY, 7, 1_000 + n)).is_ok());
            }
            if let Some(late) = n.checked_sub(500) {
                assert!(guard.hear(0.0, 1, &sealed(&KEY, 7, 1_000 + late)).is_err());
            }
        }
        assert_eq!(guard.behind().count(), 0);
    }

    #[test]
    fn a_stream_of_refused_frames_ends() {
        let mut guard = Guard::new(Some(KEY));
        let of = |n: u32| if n.is_multiple_of(2) { 9_000 + n } else { 1_000 + n };
        heard(&mut guard, (0..20).map(of), 0.0);
        assert!(guard.behind_of(0x4c48, 7).unwrap().is_twin);
        // A single old frame long after is no more than that.
        assert!(guard.hear(60.0, 0, &sealed(&KEY, 7, 2_000)).is_err());
        assert_eq!(guard.behind().count(), 0);
    }

    #[test]
    fn each_mote_has_its_own_counter() {
        let mut guard = Guard::new(Some(KEY));
        for (mote, counter) in [(1, 500), (2, 3), (1, 501), (2, 4), (1, 900)] {
            assert!(guard.open(&sealed(&KEY, mote, counter)).is_ok(), "{mote} {counter}");
        }
        assert_eq!(guard.refused, Refused::default());
    }

    #[test]
    fn without_a_key_plain_frames_count_and_secured_ones_are_named() {
        let mut guard = Guard::new(None);
        assert!(guard.open(plain(1, 1).bytes()).is_ok());
        assert_eq!(guard.open(&sealed(&KEY, 1, 1)), Err(Refusal::NoKey));
        assert_eq!(guard.open(&[1, 2, 3]), Err(Refusal::NotOurs(Reject::Length)));
        assert_eq!(guard.refused, Refused { no_key: 1, not_ours: 1, ..Refused::default() });
    }

    #[test]
    fn slots_that_leave_no_time_to_seal_are_refused_where_there_is_a_key() {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../calib/default.toml");
        let mut room = schema::open(&file).unwrap();
        let source = |room: &Calibration| crate::calib::firmware::source("lab.toml", room);
        room.mote.send = Some(schema::Send::Slotted);
        room.mote.report_every_half_turns = schema::SEALED_HALF_TURNS - 1;
        assert!(source(&room).is_ok());
        room.mote.key = Some(crate::calib::key::Key(KEY));
        let error = source(&room).unwrap_err().to_string();
        assert!(error.contains("lab.toml: mote.report_every_half_turns: 4; "), "{error}");
        room.mote.report_every_half_turns += 1;
        assert!(source(&room).unwrap().contains("SEALING_HALF_TURNS"));
        // Who asks for nothing gets dice instead.
        room.mote.send = None;
        assert_eq!(room.mote.among_others(), schema::Send::Slotted);
        room.mote.report_every_half_turns -= 1;
        assert_eq!(room.mote.among_others(), schema::Send::Jittered);
    }

    #[test]
    fn a_room_that_is_kept_elsewhere_names_its_key_where_it_is() {
        let room = |file: &str| format!("# key_file = \"no\"\n[mote]\nid = 3\nkey_file = {file} # ours\npan = 5\n");
        let kept = with_key_in_place(Path::new("/lab/rooms/a.toml"), &room("'keys/\u{fc}.key'"));
        assert_eq!(kept, room("\"/lab/rooms/keys/\u{fc}.key\""));
        assert_eq!(with_key_in_place(Path::new("/elsewhere/b.toml"), &kept), kept);
        for plain in ["", "[mote]\nid = 3\n", "not a room at all ["] {
            assert_eq!(with_key_in_place(Path::new("/lab/a.toml"), plain), plain);
        }
    }

    #[test]
    fn counters_outlive_the_listener() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("counters");
        let mut guard = Guard::new(Some(KEY));
        guard.load(&path).unwrap();
        assert!(guard.open(&sealed(&KEY, 7, 10)).is_ok());
        guard.save(&path).unwrap();
        let mut again = Guard::new(Some(KEY));
        again.load(&path).unwrap();
        // Of what an earlier listener heard every receiver knows.
        for (receiver, counter) in [(0, 9), (0, 10), (1, 10)] {
            let refusal = Err(Refusal::Replayed { counter, latest: 10 });
            assert_eq!(again.hear(0.0, receiver, &sealed(&KEY, 7, counter)), refusal, "{receiver}");
        }
        assert!(again.open(&sealed(&KEY, 7, 11)).is_ok());
        std::fs::write(&path, "4c48 0007 10\n4c48 seven 10\n").unwrap();
        for error in [again.load(&path).unwrap_err(), again.save(&path).unwrap_err()] {
            let error = error.to_string();
            assert!(error.contains("counters:2") && error.contains("seven"), "{error}");
        }
        // Not overwritten either.
        assert!(std::fs::read_to_string(&path).unwrap().contains("seven"));
    }

    #[test]
    fn listeners_that_share_a_file_lose_none_of_their_counters() {
        const LISTENERS: u16 = 4;
        const TIMES: u32 = 50;
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("counters");
        std::thread::scope(|scope| {
            for listener in 1..=LISTENERS {
                let path = &path;
                scope.spawn(move || {
                    // Each hears a mote of its own, and one that all hear, each up to another frame.
                    let mut guard = Guard::new(Some(KEY));
                    for n in 0..TIMES {
                        assert!(guard.open(&sealed(&KEY, listener, n)).is_ok());
                        assert!(guard.open(&sealed(&KEY, 100, 1_000 * u32::from(listener) + n)).is_ok());
                        guard.save(path).unwrap();
                    }
                });
            }
        });
        let last = TIMES - 1;
        let mut lines: Vec<String> = (1..=LISTENERS).map(|listener| format!("4c48 {listener:04x} {last}\n")).collect();
        lines.push(format!("4c48 {:04x} {}\n", 100, 1_000 * u32::from(LISTENERS) + last));
        assert_eq!(std::fs::read_to_string(&path).unwrap(), lines.concat());
        let error = Guard::new(Some(KEY)).save(&dir.path().join("nowhere/counters")).unwrap_err().to_string();
        assert!(error.ends_with("nowhere/counters: cannot be written"), "{error}");
    }
}
