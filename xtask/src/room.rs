//! The room that a verb works in: its file, its light, its key.
//!
//! What is expected (`tests/expected`) is of `calib/default.toml` without a key. Another room, or a key, has its own light
//! and its own numbers, which nothing is held against; promises hold everywhere.
//!
//! What can go wrong: a room whose stations do not light the mote where it is carried, a mote that does not tell its place
//! or tells it seldom, a key where nobody reads it. Who depends on these asks, and the refusal has the number.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use sim::world::Scene;
use xtask::calib::Calibration;
use xtask::calib::schema::Estimate;
use xtask::light::HALF_TURN_S;
use xtask::listen::simulate;
use xtask::trust;

use crate::firmware::{self, DEFAULT_CALIB};
use crate::process::root;

/// How far light reaches where only its cost is asked for, m: anywhere.
const ANYWHERE_M: f64 = 100.0;
/// The share of a walk that has to be in the light of both stations: what is in the dark is nobody's doing.
const LIT: f64 = 0.95;
/// A mote that tells its place less often has pauses of its own, reports a second.
const LEAST_REPORTS_PER_S: f64 = 5.0;

/// A room.
pub(crate) struct Room {
    pub(crate) file: PathBuf,
    pub(crate) calibration: Calibration,
    /// In the default room the default scene's.
    pub(crate) light: Scene,
    pub(crate) is_other: bool,
    /// Its frames are secured.
    pub(crate) key: Option<[u8; 16]>,
}

impl Room {
    /// The one that was asked for, or else the default one.
    pub(crate) fn open(asked: Option<&Path>) -> Result<Self> {
        let default = root().join(DEFAULT_CALIB);
        let file = asked.map_or_else(|| default.clone(), Path::to_path_buf);
        let calibration = firmware::room(&file)?;
        let place = |path: &Path| path.canonicalize().with_context(|| path.display().to_string());
        let is_other = place(&file)? != place(&default)?;
        let light =
            if is_other { simulate::scene(&file.display().to_string(), &calibration)? } else { Scene::default() };
        let key = trust::key_of(&calibration)?;
        Ok(Self { file, calibration, light, is_other, key })
    }

    /// In another room than the default one light reaches anywhere: for who asks what light costs, not how far it goes.
    pub(crate) fn lit_anywhere(mut self) -> Self {
        if self.is_other {
            self.light.optics.reach_m = ANYWHERE_M;
        }
        self
    }

    /// Why nothing is expected of what comes out here, if nothing is.
    pub(crate) fn unlike_expected(&self) -> Option<String> {
        match (self.is_other, self.key) {
            (true, _) => Some(format!("another room than {DEFAULT_CALIB}")),
            (false, Some(_)) => Some(format!("{DEFAULT_CALIB} with a key")),
            (false, None) => None,
        }
    }

    /// Refuses to take what comes out here for what is expected.
    pub(crate) fn ensure_expected(&self) -> Result<()> {
        let what = format!("what is expected is of {DEFAULT_CALIB} without a key, and of no other room");
        ensure!(self.unlike_expected().is_none(), "{}: {what}", self.file.display());
        Ok(())
    }

    /// Refuses a room in which a hand carries the mote out of the light.
    pub(crate) fn ensure_lit(&self) -> Result<()> {
        let lit = simulate::lit(&self.light);
        ensure!(
            lit >= LIT,
            "{}: both stations light the mote {:.0} % of the time where it is carried, in the middle half of the volume; \
             they reach {} m. Give the file a [room] that they light",
            self.file.display(),
            100.0 * lit,
            self.light.optics.reach_m
        );
        Ok(())
    }

    /// Refuses a room whose motes do not tell their places all the time: nothing could be said of pauses.
    pub(crate) fn ensure_tells_places(&self) -> Result<()> {
        let (file, mote) = (self.file.display(), &self.calibration.mote);
        ensure!(
            mote.estimate != Estimate::Angles,
            "{file}: mote.estimate: \"angles\"; it is places that are judged here"
        );
        ensure!(
            mote.moved_m == 0.0,
            "{file}: mote.moved_m: {}; a mote that is silent at rest has pauses of its own",
            mote.moved_m
        );
        let half_turns = mote.report_every_half_turns;
        ensure!(
            self.reports_per_s() >= LEAST_REPORTS_PER_S,
            "{file}: mote.report_every_half_turns: {half_turns}; {:.1} reports a second are fewer than \
             {LEAST_REPORTS_PER_S}, and have pauses of their own",
            self.reports_per_s()
        );
        Ok(())
    }

    /// Seconds between two reports.
    pub(crate) fn report_every_s(&self) -> f64 {
        f64::from(self.calibration.mote.report_every_half_turns) * HALF_TURN_S
    }

    /// How many places a mote tells in a second.
    pub(crate) fn reports_per_s(&self) -> f64 {
        self.report_every_s().recip()
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    /// The default room with lines before those under its `[mote]`.
    fn room(lines: &str) -> (Room, tempfile::NamedTempFile) {
        let text = std::fs::read_to_string(root().join(DEFAULT_CALIB)).expect("the default room");
        let (before, after) = text.split_once("[mote]\n").expect("it has a mote");
        let names: Vec<&str> = lines.lines().filter_map(|line| line.split_once(" = ")).map(|(name, _)| name).collect();
        let is_said = |line: &&str| !names.iter().any(|name| line.starts_with(&format!("{name} =")));
        let after: String = after.lines().filter(is_said).map(|line| format!("{line}\n")).collect();
        let mut file = tempfile::NamedTempFile::new().expect("a file");
        write!(file, "{before}[mote]\n{lines}\n{after}").expect("it can be written");
        (Room::open(Some(file.path())).expect("a room"), file)
    }

    #[test]
    fn the_default_room_is_known_by_whatever_name_and_its_copy_is_another() {
        for asked in [None, Some(root().join("calib/../calib/default.toml"))] {
            let room = Room::open(asked.as_deref()).expect("a room");
            assert!(room.unlike_expected().is_none() && room.ensure_expected().is_ok() && room.ensure_lit().is_ok());
        }
        let (copy, file) = room("");
        assert!(copy.is_other && copy.ensure_lit().is_ok());
        let said = copy.ensure_expected().expect_err("another room").to_string();
        assert!(said.starts_with(&file.path().display().to_string()) && said.contains("of no other room"), "{said}");
    }

    #[test]
    fn a_key_has_figures_of_its_own() {
        let room = Room { key: Some([7; 16]), ..Room::open(None).expect("a room") };
        assert_eq!(room.unlike_expected().as_deref(), Some("calib/default.toml with a key"));
        assert!(room.ensure_expected().is_err());
    }

    #[test]
    fn motes_that_tell_no_place_or_seldom_are_refused_with_the_number() {
        assert!(room("report_every_half_turns = 24").0.ensure_tells_places().is_ok());
        for (lines, says) in [
            ("estimate = \"angles\"", "mote.estimate: \"angles\""),
            ("moved_m = 0.05", "mote.moved_m: 0.05;"),
            ("report_every_half_turns = 25", "mote.report_every_half_turns: 25; 4.8 reports a second are fewer than 5"),
        ] {
            let said = room(lines).0.ensure_tells_places().expect_err(lines).to_string();
            assert!(said.contains(says), "{said}");
        }
    }
}
