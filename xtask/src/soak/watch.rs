//! What is looked at while a mote lives.
//!
//! What can go wrong: a mote that stops talking breaks nothing here by itself; fewer fixes than in other rounds do.

use std::collections::BTreeMap;

use anyhow::Result;
use lighthouse_mote::frame::{Health, Lock, Rejects};
use serde_json::{Map, Value, json};
use xtask::listen::model::by_name;
use xtask::quantile::quantile;

use super::plan::{CLEAR, Meeting};
use super::{Allowed, HALF_TURN_WITHIN, SPELL_S, WRONG_SHARE};
use crate::lit::{Fix, Lit, Said};
use crate::log::{Log, is_lock_lost, is_start};
use crate::scenes::is_limit;

/// A scene's last wrong fixes may come while it is over, and what a scene has done to the tracker takes as long to go,
/// seconds.
const AFTERMATH_S: f64 = 2.0;
/// The same after a scene that is known to break promises, seconds.
const LONG_AFTERMATH_S: f64 = 10.0;

/// What came of one round.
#[derive(Debug, Clone, Default)]
pub(super) struct Round {
    /// Errors of the fixes of level full, centimetres: in clear light, and in the scenes.
    clear: Errors,
    hostile: Errors,
    good: usize,
    tracked: usize,
    wrong: BTreeMap<String, usize>,
    locks_lost: u32,
    /// From light to air, milliseconds.
    latency_ms: Errors,
    /// Measured half turn against the true one, in clear light, parts per million: the worst.
    half_turn_ppm: f64,
    rejects: BTreeMap<&'static str, u16>,
    waiting: [u8; 3],
    stack_bytes: u32,
    busy_percent: f64,
}

/// Some numbers, and what is to know of them.
#[derive(Debug, Clone, Default)]
struct Errors {
    values: Vec<f64>,
    median: f64,
    p95: f64,
    rms: f64,
    worst: f64,
}

impl Errors {
    fn push(&mut self, value: f64) {
        self.values.push(value);
    }

    /// Keeps what is to know and forgets the numbers.
    fn close(&mut self) {
        self.median = quantile(&mut self.values, 0.5);
        self.p95 = quantile(&mut self.values, 0.95);
        self.rms = (self.values.iter().map(|value| value * value).sum::<f64>() / self.values.len() as f64).sqrt();
        self.worst = self.values.iter().copied().fold(f64::NAN, f64::max);
        self.values = Vec::new();
    }

    fn summary(&self) -> Value {
        json!({ "median": self.median, "p95": self.p95, "rms": self.rms, "worst": self.worst })
    }
}

/// A figure of a round, by name.
pub(super) type Figure = (&'static str, fn(&Round) -> f64);

impl Round {
    /// What is compared between rounds.
    pub(super) const FIGURES: [Figure; 8] = [
        ("good fixes", |round| round.good as f64),
        ("clear light: median error, cm", |round| round.clear.median),
        ("clear light: 95 % error, cm", |round| round.clear.p95),
        ("clear light: RMS error, cm", |round| round.clear.rms),
        ("scenes: median error, cm", |round| round.hostile.median),
        ("scenes: 95 % error, cm", |round| round.hostile.p95),
        ("light to air: median, ms", |round| round.latency_ms.median),
        ("core busy, %", |round| round.busy_percent),
    ];

    pub(super) const HEADING: &str = "\
round  mote h  wall s    good  tracked | clear light, cm              | scenes, cm       | wrong  locks | to air, ms   | half turn | waited | stack
                                       | median    95 %    RMS  worst | median      95 % |         lost | median worst | worst ppm | p s r  | bytes";

    pub(super) fn line(&self, number: usize, second: f64, wall_s: f64) -> String {
        let [pulses, sightings, reports] = self.waiting;
        format!(
            "{number:>5} {:>7.2} {wall_s:>7.0} {:>7} {:>8} | {:>6.3} {:>7.3} {:>6.3} {:>6.2} | {:>6.3} {:>9.3} | {:>5} {:>6} | {:>6.3} {:>5.1} | {:>9.0} | {pulses} {sightings} {reports} | {}",
            second / 3600.0,
            self.good,
            self.tracked,
            self.clear.median,
            self.clear.p95,
            self.clear.rms,
            self.clear.worst,
            self.hostile.median,
            self.hostile.p95,
            self.wrong.values().sum::<usize>(),
            self.locks_lost,
            self.latency_ms.median,
            self.latency_ms.worst,
            self.half_turn_ppm,
            self.stack_bytes
        )
    }

    pub(super) fn summary(&self) -> Value {
        json!({
            "good_fixes": self.good,
            "tracked_fixes": self.tracked,
            "clear_cm": self.clear.summary(),
            "scenes_cm": self.hostile.summary(),
            "wrong": self.wrong,
            "locks_lost": self.locks_lost,
            "latency_ms": self.latency_ms.summary(),
            "half_turn_worst_ppm": self.half_turn_ppm,
            "rejects": self.rejects,
            "waiting": self.waiting,
            "stack_bytes": self.stack_bytes,
            "busy_percent": self.busy_percent,
        })
    }
}

/// What holds for the whole life.
#[derive(Debug, Clone, Default)]
pub(super) struct Life {
    starts: u32,
    other_frames: u32,
    garbled: u32,
    frames: u64,
    /// Numbers of frames that never came.
    missing: u64,
    uptime_back: u32,
    /// The most that uptime went on between two health frames, seconds.
    uptime_step: u32,
    health: u64,
    half_turn_ppm: f64,
    latency_ms: f64,
    reports_lost: u16,
    /// Of each scene in which there was one.
    wrong: BTreeMap<String, Wrong>,
    /// Fixes of level full in each scene.
    good: BTreeMap<String, u64>,
    refused: u64,
    allowed: Allowed,
}

/// Wrong fixes of level full.
#[derive(Debug, Clone, Default)]
struct Wrong {
    fixes: u64,
    /// Wrong ones within [`SPELL_S`] of each other are one spell, whatever right ones lie between.
    spells: u64,
    longest_s: f64,
    /// When the latest spell began, and its latest wrong one, true seconds.
    since_s: f64,
    latest_s: f64,
}

impl Wrong {
    fn at(&mut self, sent_s: f64) {
        if self.spells == 0 || sent_s - self.latest_s > SPELL_S {
            self.spells += 1;
            self.since_s = sent_s;
        }
        self.fixes += 1;
        self.latest_s = sent_s;
        self.longest_s = self.longest_s.max(sent_s - self.since_s);
    }

    fn summary(&self) -> Value {
        json!({ "fixes": self.fixes, "spells": self.spells, "longest_s": self.longest_s })
    }
}

impl Life {
    fn good_in(&self, scene: &str) -> u64 {
        self.good.get(scene).copied().unwrap_or(0)
    }

    /// How many of a scene's good fixes may be wrong.
    fn may_be_wrong(&self, scene: &str) -> u64 {
        (WRONG_SHARE * self.good_in(scene) as f64 + self.allowed.spell_fixes) as u64
    }

    /// What must not be.
    pub(super) fn broken(&self) -> Vec<String> {
        let mut broken = Vec::new();
        let mut must = |holds: bool, what: String| {
            if !holds {
                broken.push(what);
            }
        };
        must(self.starts == 1, format!("the mote started {} times", self.starts));
        must(self.missing == 0, format!("{} frames never came", self.missing));
        // They have no number, so none is missing.
        must(self.reports_lost == 0, format!("{} frames found no room or were given up", self.reports_lost));
        must(self.other_frames + self.garbled == 0, "frames of another kind, or that cannot be read".to_string());
        must(self.uptime_back == 0, format!("uptime went back {} times", self.uptime_back));
        // Two health frames may wait in the queue while a scene keeps the solver from its work, not more.
        must(self.uptime_step <= 4, format!("uptime jumped by {} s", self.uptime_step));
        must(
            self.half_turn_ppm <= 1e6 * HALF_TURN_WITHIN,
            format!("the half turn was off by {} ppm", self.half_turn_ppm),
        );
        must(self.latency_ms <= 1e3 * self.allowed.latency_s, format!("a fix took {} ms to the air", self.latency_ms));
        must(self.refused == 0, format!("the radio refused {} times", self.refused));
        for (scene, wrong) in self.wrong.iter().filter(|(scene, _)| !is_limit(scene)) {
            let Wrong { fixes, longest_s, .. } = wrong;
            if scene == CLEAR {
                must(false, format!("{fixes} wrong fixes of level full in clear light"));
                continue;
            }
            must(*longest_s <= SPELL_S, format!("{scene}: fixes of level full were wrong for {longest_s:.2} s"));
            let (good, may) = (self.good_in(scene), self.may_be_wrong(scene));
            must(*fixes <= may, format!("{scene}: {fixes} of {good} fixes of level full are wrong, and {may} may be"));
        }
        broken
    }

    pub(super) fn summary(&self) -> Value {
        json!({
            "starts": self.starts,
            "frames": self.frames,
            "frames_missing": self.missing,
            "other_frames": self.other_frames,
            "garbled_frames": self.garbled,
            "health_frames": self.health,
            "uptime_went_back": self.uptime_back,
            "uptime_largest_step_s": self.uptime_step,
            "half_turn_worst_ppm": self.half_turn_ppm,
            "latency_worst_ms": self.latency_ms,
            "reports_lost": self.reports_lost,
            "wrong": self.wrong.iter().map(|(scene, wrong)| (scene.clone(), wrong.summary())).collect::<Map<_, _>>(),
            "good_fixes_in_scenes": self.good,
            "radio_refused": self.refused,
        })
    }
}

impl std::fmt::Display for Life {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "starts {}, frames {} of which missing {}, other or garbled {}; health frames {}, uptime back {} times, \
             largest step {} s\nhalf turn off by at most {:.0} ppm in clear light, light to air at most {:.2} ms there, reports \
             lost {}, radio refused {}\n{} fixes of level full in {} scenes; wrong ones by scene:",
            self.starts,
            self.frames,
            self.missing,
            self.other_frames + self.garbled,
            self.health,
            self.uptime_back,
            self.uptime_step,
            self.half_turn_ppm,
            self.latency_ms,
            self.reports_lost,
            self.refused,
            self.good.values().sum::<u64>(),
            self.good.len()
        )?;
        if self.wrong.is_empty() {
            write!(f, " none")?;
        }
        for (scene, Wrong { fixes, spells, longest_s, .. }) in &self.wrong {
            let good = self.good_in(scene);
            write!(f, "\n  {scene:<22} {fixes:>6} of {good:>7}, in {spells:>4} spells of {longest_s:.2} s at most; ")?;
            match is_limit(scene) {
                true => write!(f, "known")?,
                false => write!(f, "{} may be, for {SPELL_S} s", self.may_be_wrong(scene))?,
            }
        }
        Ok(())
    }
}

/// Who looks.
pub(super) struct Watch {
    log: Log<'static>,
    round: Round,
    life: Life,
    /// What is met now, since when, and what was met before.
    name: String,
    since_s: f64,
    /// When the latest good fix came.
    last_s: f64,
    before: String,
    sequence: Option<u16>,
    health: Option<Health>,
    /// Of the health frame that ended the round before.
    rejects: Rejects,
    load: sim::mote::Load,
}

impl Watch {
    pub(super) fn new(log: Log<'static>, allowed: Allowed) -> Self {
        Self {
            log,
            round: Round::default(),
            life: Life { allowed, ..Life::default() },
            name: String::new(),
            since_s: 0.0,
            last_s: 0.0,
            before: String::new(),
            sequence: None,
            health: None,
            rejects: Rejects::default(),
            load: sim::mote::Load::default(),
        }
    }

    pub(super) fn meets(&mut self, meeting: &Meeting) {
        self.before = std::mem::replace(&mut self.name, meeting.name.clone());
        self.since_s = meeting.from_s;
    }

    /// What the mote said since the last look.
    pub(super) fn look(&mut self, lit: &mut Lit) -> Result<()> {
        for heard in lit.hear()? {
            self.life.frames += 1;
            if let Some(header) = heard.header {
                if let Some(before) = self.sequence {
                    self.life.missing += u64::from(header.sequence.wrapping_sub(before).wrapping_sub(1));
                }
                self.sequence = Some(header.sequence);
            }
            match heard.said {
                Said::Fix(fix) => self.fix(&fix),
                Said::Health(health) => self.health(*health, heard.sent_s, lit),
                Said::Other => self.life.other_frames += 1,
                Said::Garbled => self.life.garbled += 1,
            }
        }
        for line in self.log.read(&lit.mote.take_log()) {
            self.life.starts += u32::from(is_start(&line));
            self.round.locks_lost += u32::from(is_lock_lost(&line));
        }
        Ok(())
    }

    fn fix(&mut self, fix: &Fix) {
        self.life.reports_lost = fix.losses.reports;
        let latency_ms = 1e3 * (fix.sent_s - fix.row.seconds);
        self.round.latency_ms.push(latency_ms);
        // A storm of edges keeps all else from its work as long as it lasts.
        if self.name == CLEAR && fix.row.seconds > self.since_s {
            self.life.latency_ms = self.life.latency_ms.max(latency_ms);
        }
        if !fix.is_good() {
            self.round.tracked += 1;
            return;
        }
        self.round.good += 1;
        self.last_s = fix.sent_s;
        let settled = fix.row.seconds > self.since_s + AFTERMATH_S;
        let errors = if self.name == CLEAR && settled { &mut self.round.clear } else { &mut self.round.hostile };
        // Where the light itself lies, errors say nothing of the mote.
        let aftermath_s = if is_limit(&self.before) { LONG_AFTERMATH_S } else { AFTERMATH_S };
        let over = fix.row.seconds > self.since_s + aftermath_s;
        let blame = if self.name == CLEAR && !over { &self.before } else { &self.name };
        if self.name != CLEAR {
            *self.life.good.entry(self.name.clone()).or_default() += 1;
        }
        if !is_limit(blame) {
            errors.push(100.0 * fix.error_m());
        }
        if fix.is_wrong() {
            *self.round.wrong.entry(blame.clone()).or_default() += 1;
            self.life.wrong.entry(blame.clone()).or_default().at(fix.sent_s);
        }
    }

    fn health(&mut self, health: Health, sent_s: f64, lit: &Lit) {
        self.life.health += 1;
        if let Some(before) = &self.health {
            self.life.uptime_back += u32::from(health.uptime < before.uptime);
            self.life.uptime_step = self.life.uptime_step.max(health.uptime.saturating_sub(before.uptime));
        }
        if health.lock == Lock::Locked && self.name == CLEAR && sent_s > self.since_s + AFTERMATH_S {
            // It was measured over the last half turns before.
            let (world, half_s) = (&lit.world, lit.world.scene().timing.half_turn_s());
            let ticks = (world.cycle(sent_s) - world.cycle(sent_s - 12.0 * half_s)) as f64 / 12.0;
            let ppm = 1e6 * (f64::from(health.half_turn_q8) / 256.0 / ticks - 1.0).abs();
            self.round.half_turn_ppm = self.round.half_turn_ppm.max(ppm);
            self.life.half_turn_ppm = self.life.half_turn_ppm.max(ppm);
        }
        self.health = Some(health);
    }

    /// What was met, in a line: the latest fix and what the mote says of the cycle.
    pub(super) fn each(&self, lit: &Lit) -> String {
        let (hertz, lock) = self
            .health
            .as_ref()
            .map_or((0.0, Lock::NoLight), |health| (f64::from(health.half_turn_q8) / 256.0 * 120.0, health.lock));
        let true_hertz = lit.world.cycle(self.last_s + 1.0) - lit.world.cycle(self.last_s);
        format!(
            "{:>10.1} s  {:<22} good so far {:>6}, worst in clear light {:>6.2} cm, {lock:?}, clock {hertz:.0} Hz of {true_hertz}",
            self.last_s,
            self.name,
            self.round.good,
            self.round.clear.values.iter().copied().fold(0.0, f64::max)
        )
    }

    /// Ends a round.
    pub(super) fn close(&mut self, lit: &Lit) -> Round {
        let mut round = std::mem::take(&mut self.round);
        round.clear.close();
        round.hostile.close();
        round.latency_ms.close();
        if let Some(health) = &self.health {
            let before = by_name(&self.rejects).into_iter();
            let since = by_name(&health.rejects).into_iter().zip(before);
            round.rejects = since.map(|((name, now), (_, before))| (name, now.wrapping_sub(before))).collect();
            self.rejects = health.rejects;
            round.waiting = health.waiting;
        }
        let top = lit.mote.symbols.get("_stack_start").map_or(0, |symbol| symbol.address);
        round.stack_bytes = top.saturating_sub(lit.mote.machine.core.registers.lowest_main_sp());
        let load = lit.mote.load();
        round.busy_percent = load.percent_since(&self.load);
        self.load = load;
        round
    }

    /// What holds for the life so far.
    pub(super) fn life(&self, lit: &Lit) -> Life {
        Life { refused: lit.mote.machine.bus.refused(), ..self.life.clone() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenes::list;

    #[test]
    fn every_scene_that_may_be_wrong_is_one_there_is() {
        assert!(list::all().iter().any(|named| is_limit(&named.name)));
        assert!(!is_limit(CLEAR));
    }

    #[test]
    fn a_life_with_a_second_start_or_a_wrong_fix_in_clear_light_is_broken() {
        // 15 reports a second.
        let allowed = Allowed { latency_s: 0.0605, spell_fixes: 15.0 };
        let well = Life { starts: 1, allowed, ..Life::default() };
        assert!(well.broken().is_empty());
        assert_eq!(Life { starts: 2, ..well.clone() }.broken().len(), 1);
        assert_eq!(Life { missing: 1, ..well.clone() }.broken().len(), 1);
        assert_eq!(Life { reports_lost: 1, ..well.clone() }.broken().len(), 1);
        let broken = |scene: &str, good: u64, at_s: &[f64]| {
            let mut wrong = Wrong::default();
            at_s.iter().for_each(|at_s| wrong.at(*at_s));
            let of = |what: &str| what.to_string();
            Life { wrong: [(of(scene), wrong)].into(), good: [(of(scene), good)].into(), ..well.clone() }.broken()
        };
        let once = [1.0];
        assert_eq!((broken(CLEAR, 0, &once).len(), broken("moved-10cm", 1, &[1.0, 1.9, 2.8]).len()), (1, 0));
        assert_eq!(broken("reflections", 1000, &once).len(), 0);
        // Short ones, too many: 2.7 and 15 may be.
        let often: Vec<f64> = (0..18).map(|n| 10.0 * f64::from(n)).collect();
        assert_eq!(
            broken("reflections", 1000, &often),
            ["reflections: 18 of 1000 fixes of level full are wrong, and 17 may be"]
        );
        assert_eq!(broken("reflections", 2000, &often).len(), 0);
        // Few, too long, though each is near the one before.
        let long = [1.0, 1.6, 2.1];
        assert_eq!(broken("reflections", 1000, &long), ["reflections: fixes of level full were wrong for 1.10 s"]);
        assert_eq!(broken("reflections", 1000, &[1.0, 1.6, 2.7, 3.2]).len(), 0, "two spells");
    }
}
