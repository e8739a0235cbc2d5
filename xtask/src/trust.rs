//! Who may be believed: frames under the room's key, each once.
//!
//! With a key, a frame counts where its code fits and its counter is new: larger than that of every frame of that mote
//! before, or one of the 64 before it that has not come yet. All others are turned away and counted by cause, and never become a position. Without a key, plain frames count, and
//! secured ones are counted as what nobody here can check.
//!
//! What can go wrong: the counters are forgotten, and old frames count once more. [`Guard::save`] and [`Guard::load`] keep
//! them in a file. Two motes with one id are seen as one whose counter goes to and fro: a stream of replays.

use std::collections::BTreeMap;
use std::fmt;
use std::io::Write as _;
use std::path::Path;

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
    /// One of the latest 64 frames of that mote once more: another gateway has heard it too.
    Duplicate,
    /// An old frame sent once more, or a mote whose counter began again, or two motes with one id.
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
    /// Heard before.
    pub duplicate: u64,
    /// With an old counter.
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

/// The largest counter that was believed, and which of the 64 up to it were: frames that come late over another gateway
/// count too, each once.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Window {
    latest: u32,
    /// Bit n: the counter n before the latest.
    seen: u64,
}

impl Window {
    /// Takes a counter that was proved.
    fn take(&mut self, counter: u32) -> Result<(), Refusal> {
        if counter > self.latest {
            let by = counter - self.latest;
            self.seen = self.seen.checked_shl(by).unwrap_or(0) | 1;
            self.latest = counter;
            return Ok(());
        }
        let bit = 1u64.checked_shl(self.latest - counter);
        match bit {
            None => Err(Refusal::Replayed { counter, latest: self.latest }),
            Some(bit) if self.seen & bit != 0 => Err(Refusal::Duplicate),
            Some(bit) => {
                self.seen |= bit;
                Ok(())
            }
        }
    }
}

/// Stands between the air and everything that shows or keeps a position.
#[derive(Debug, Clone, Default)]
pub struct Guard {
    key: Option<Key>,
    /// By PAN and mote: what was believed.
    heard: BTreeMap<(u16, u16), Window>,
    /// What was refused so far.
    pub refused: Refused,
}

impl Guard {
    /// Believes frames under `key` alone; plain ones where there is none.
    #[must_use]
    pub fn new(key: Option<[u8; 16]>) -> Self {
        Self { key: key.map(|bytes| Key::new(&bytes)), ..Self::default() }
    }

    /// Reads a whole frame, FCS included, if it may be believed.
    ///
    /// # Errors
    /// Why it may not; counted in [`Guard::refused`].
    pub fn open(&mut self, bytes: &[u8]) -> Result<(Header, Message), Refusal> {
        let read = self.read(bytes);
        if let Err(refusal) = &read {
            self.refused.count(refusal);
        }
        read
    }

    fn read(&mut self, bytes: &[u8]) -> Result<(Header, Message), Refusal> {
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
        match self.heard.get_mut(&(pan, mote)) {
            Some(window) => window.take(counter)?,
            None => {
                self.heard.insert((pan, mote), Window { latest: counter, seen: 1 });
            }
        }
        Ok(read)
    }

    /// Takes the counters that [`Guard::save`] wrote; no file is no counters.
    ///
    /// # Errors
    /// A line that is none, with file, line and text.
    pub fn load(&mut self, path: &Path) -> Result<()> {
        let text = match std::fs::read_to_string(path) {
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(()),
            text => text.with_context(|| path.display().to_string())?,
        };
        for (index, line) in text.lines().enumerate() {
            let numbers = || {
                let [pan, mote, counter] = line.split(' ').collect::<Vec<_>>()[..] else { return None };
                let hex = |text| u16::from_str_radix(text, 16).ok();
                Some((hex(pan)?, hex(mote)?, counter.parse().ok()?))
            };
            let (pan, mote, counter) =
                numbers().ok_or_else(|| anyhow!("{}:{}: not a counter: {line:?}", path.display(), index + 1))?;
            // Which of those before it were heard is forgotten: none of them counts any more.
            let window = self.heard.entry((pan, mote)).or_insert(Window { latest: counter, seen: u64::MAX });
            if counter > window.latest {
                *window = Window { latest: counter, seen: u64::MAX };
            }
        }
        Ok(())
    }

    /// Writes the counters, one mote a line: PAN and mote in hex, counter. The old file stays until the new one is whole.
    ///
    /// # Errors
    /// The folder cannot be written to.
    pub fn save(&self, path: &Path) -> Result<()> {
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let mut file = tempfile::NamedTempFile::new_in(folder).with_context(|| folder.display().to_string())?;
        for ((pan, mote), Window { latest, .. }) in &self.heard {
            writeln!(file, "{pan:04x} {mote:04x} {latest}")?;
        }
        file.persist(path).with_context(|| path.display().to_string())?;
        Ok(())
    }
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
        let mut frame = plain(mote, counter as u16);
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
        assert_eq!(guard.open(&sealed(&KEY, 7, 10)), Err(Refusal::Duplicate));
        // One that came late over another gateway counts, once; one that is older than 64 frames does not.
        assert!(guard.open(&sealed(&KEY, 7, 9)).is_ok());
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
        assert!(duplicate >= 1 && replayed == 1 && guard.refused.forged > 1, "{:?}", guard.refused);
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
        assert_eq!(again.open(&sealed(&KEY, 7, 9)), Err(Refusal::Duplicate));
        assert!(again.open(&sealed(&KEY, 7, 11)).is_ok());
        std::fs::write(&path, "4c48 0007 10\n4c48 seven 10\n").unwrap();
        let error = again.load(&path).unwrap_err().to_string();
        assert!(error.contains("counters:2") && error.contains("seven"), "{error}");
    }
}
