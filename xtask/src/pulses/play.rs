//! Pulses through the mote's own code, and notes on what came of each.
//!
//! What can go wrong: nothing that is an error. Light that is not understood is counted by cause, as the mote counts it.

use std::collections::{BTreeMap, VecDeque};
use std::sync::OnceLock;

use anyhow::{Result, anyhow};
use lighthouse_mote::chain::{Classifier, Config, Ears, Estimate, Seen, Sighting, Solver};
use lighthouse_mote::frame::{Health, Lock};
use lighthouse_mote::ootx::{self, Block};
use lighthouse_mote::pulse::Pulse;
use lighthouse_mote::send;
use lighthouse_mote::sweep::{self, Stamp, Sweep};
use lighthouse_mote::time::{Span, Ticks};
use lighthouse_mote::{angle, fix, track};
use nalgebra::{Matrix3, Vector3};

use crate::calib::{firmware, schema};

/// Half turns between two looks into the dark: 0.1 s, so that a loss is dated to that.
const LOOK_HALF_TURNS: u64 = 12;
/// Pulses among which a sweep is looked for that was chosen when its slot ended: more than fit in a slot of clean light.
const RECENT: usize = 256;

/// Widths in ticks, and how often each came.
pub type Widths = BTreeMap<u64, u64>;

/// Counts since the beginning, of 64 bits where the mote's wrap at 16 and 8.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[allow(missing_docs, reason = "as in the health frame")]
pub struct Totals {
    pub syncs: [u64; 2],
    pub sweeps: [[u64; 2]; 2],
    pub strays: u64,
    pub widths: u64,
    pub short: u64,
    pub long: u64,
    pub second: u64,
    pub outside: u64,
    pub locks: u64,
    pub good: [u64; 2],
    pub bad: [u64; 2],
}

/// All that was noted.
#[derive(Debug, Clone, Default)]
pub struct Played {
    /// How many pulses there were.
    pub pulses: u64,
    /// The first rise.
    pub first: u64,
    /// The last fall.
    pub last: u64,
    /// The stretches of time while the cycle was known.
    pub locked: Vec<(u64, u64)>,
    /// When the cycle was lost.
    pub lost: Vec<u64>,
    /// Whether the cycle is known at the end, and why not.
    pub status: Lock,
    /// Counts.
    pub totals: Totals,
    /// The flashes' lengthening, 1/32 width steps; `None` before any was understood.
    pub width_bias: [Option<i8>; 2],
    /// Good frames by station.
    pub frames: [Vec<(u64, Block)>; 2],
    /// Times of bad frames by station.
    pub bad: [Vec<u64>; 2],
    /// Sweeps as measured, by their times.
    pub sweeps: Vec<(u64, Sweep)>,
    /// The half turn in ticks, Q8, as often as the mote told.
    pub half_turns: Vec<(u64, u32)>,
    /// Widths of A's flashes, B's flashes, sweeps, all else.
    pub widths: [Widths; 4],
}

/// The mote's two halves, and what has been noted so far.
pub struct Player {
    config: Config,
    classifier: Classifier,
    solver: Solver,
    ears: Ears,
    played: Played,
    health: Health,
    /// Pulses that are neither flash nor, so far, sweep: when they would be one, and their width.
    recent: VecDeque<(u32, u64)>,
    is_locked: bool,
}

impl Player {
    /// A mote that has just been switched on.
    ///
    /// # Errors
    /// The project's own default room cannot be held; no place is ever asked of it here.
    pub fn new(sweep: sweep::Config) -> Result<Self> {
        let calib = room()?;
        let nowhere = track::Pose { axes: Matrix3::zeros(), position: Vector3::zeros() };
        let config = Config {
            sweep,
            ootx: ootx::Config { rest_bits: 0, ids: [None, None] },
            angle: angle::Config::default(),
            fix: fix::Config { calib, max_age_half_turns: 12 },
            track: track::Config::HAND_HELD,
            room: track::Room { stations: [nowhere, nowhere] },
            estimate: Estimate::Angles,
            report_every_half_turns: 1,
            send: send::Config::default(),
        };
        Ok(Self {
            config,
            classifier: Classifier::default(),
            solver: Solver::default(),
            ears: Ears::default(),
            played: Played::default(),
            health: Health::default(),
            recent: VecDeque::new(),
            is_locked: false,
        })
    }

    /// Takes the next pulse.
    pub fn pulse(&mut self, rise: u64, width: u64) {
        if self.played.pulses == 0 {
            self.played.first = rise;
        } else {
            self.wait(rise);
        }
        self.played.pulses += 1;
        self.played.last = rise.saturating_add(width);
        // A counter of 32 bits cannot tell how often it wrapped meanwhile; it is long, and no station's, anyhow.
        let pulse = Pulse { start: Ticks(rise as u32), width: Span(u32::try_from(width).unwrap_or(u32::MAX)) };
        let before = self.health.syncs;
        let sighting = self.classifier.pulse(&self.config, pulse);
        self.sight(rise, sighting);
        self.look(rise, pulse.start.after(pulse.width));
        let after = self.health.syncs;
        if let Some(station) = (0..2).find(|station| before[*station] != after[*station]) {
            note(&mut self.played.widths[station], width);
        } else {
            let at = match self.config.sweep.stamp {
                Stamp::Middle => pulse.start.after(Span(pulse.width.0 / 2)),
                Stamp::Rise => pulse.start,
            };
            self.recent.push_back((at.0, width));
            if self.recent.len() > RECENT
                && let Some((_, width)) = self.recent.pop_front()
            {
                note(&mut self.played.widths[3], width);
            }
            // A sweep that was plain at once.
            if let Some(Seen::Sweep(sweep)) = sighting.map(|sighting| sighting.seen) {
                self.claim(sweep);
            }
        }
    }

    /// Lets the time pass until `rise`, as a board's seconds do: not later than its light is missed. Once it is, the
    /// mote knows nothing that could grow old.
    fn wait(&mut self, rise: u64) {
        let mut now = self.played.last;
        while let Some(half_turn) = self.classifier.half_turn() {
            now = now.saturating_add(LOOK_HALF_TURNS * u64::from(half_turn.span().0));
            if now >= rise {
                return;
            }
            let sighting = self.classifier.expire(Ticks(now as u32));
            self.sight(now, sighting);
            self.look(now, Ticks(now as u32));
        }
    }

    /// Hands a sighting on, and notes it.
    fn sight(&mut self, now: u64, sighting: Option<Sighting>) {
        let Some(sighting) = sighting else { return };
        let frames = &mut self.played.frames;
        self.ears.hear(&self.config.ootx, &sighting, |station, block| {
            frames[station as usize].push((now, *block));
        });
        let _ = self.solver.step(&self.config, &sighting);
        match sighting.seen {
            Seen::Sweep(sweep) => {
                let at = now.saturating_add_signed(i64::from(sweep.at.offset_from(Ticks(now as u32))));
                self.played.sweeps.push((at, sweep));
                self.played.half_turns.push((at, sweep.half_turn.ticks_q8()));
                self.claim(sweep);
            }
            Seen::Nothing { half_turn, .. } => self.played.half_turns.push((now, half_turn.ticks_q8())),
            Seen::Lost => {}
        }
    }

    /// The pulse that a sweep was is no stranger any more.
    fn claim(&mut self, sweep: Sweep) {
        if let Some(index) = self.recent.iter().rposition(|(at, _)| *at == sweep.at.0)
            && let Some((_, width)) = self.recent.remove(index)
        {
            note(&mut self.played.widths[2], width);
        }
    }

    /// Notes how the mote is; `end` is later than every pulse.
    fn look(&mut self, now: u64, end: Ticks) {
        let understood = self.classifier.understood(end);
        let health = self.solver.health(&self.config, &understood);
        let earlier = std::mem::replace(&mut self.health, health);
        let totals = &mut self.played.totals;
        let add = |total: &mut u64, now: u16, before: u16| *total += u64::from(now.wrapping_sub(before));
        for station in 0..2 {
            add(&mut totals.syncs[station], health.syncs[station], earlier.syncs[station]);
            for axis in 0..2 {
                add(&mut totals.sweeps[station][axis], health.sweeps[station][axis], earlier.sweeps[station][axis]);
            }
            let (now_told, told) = (health.stations[station], earlier.stations[station]);
            totals.good[station] += u64::from(now_told.good.wrapping_sub(told.good));
            let bad = now_told.bad.wrapping_sub(told.bad);
            totals.bad[station] += u64::from(bad);
            self.played.bad[station].extend((0..bad).map(|_| now));
            if health.syncs[station] != earlier.syncs[station] {
                self.played.width_bias[station] = Some(now_told.width_bias);
            }
        }
        let (new, old) = (health.rejects, earlier.rejects);
        for (total, now, before) in [
            (&mut totals.strays, new.strays, old.strays),
            (&mut totals.widths, new.widths, old.widths),
            (&mut totals.short, new.short, old.short),
            (&mut totals.long, new.long, old.long),
            (&mut totals.second, new.second, old.second),
            (&mut totals.outside, new.outside, old.outside),
            (&mut totals.locks, new.locks, old.locks),
        ] {
            add(total, now, before);
        }
        let is_locked = understood.is_locked();
        let was_lost = new.locks != old.locks;
        if self.is_locked
            && (was_lost || !is_locked)
            && let Some((_, to)) = self.played.locked.last_mut()
        {
            *to = now;
            self.played.lost.push(now);
        }
        if is_locked && (was_lost || !self.is_locked) {
            self.played.locked.push((now, now));
        }
        self.is_locked = is_locked;
    }

    /// No more pulses come.
    #[must_use]
    pub fn end(mut self) -> Played {
        let last = self.played.last;
        if self.is_locked
            && let Some((_, to)) = self.played.locked.last_mut()
        {
            *to = last;
        }
        for (_, width) in self.recent {
            note(&mut self.played.widths[3], width);
        }
        self.played.status = self.health.lock;
        self.played
    }
}

/// Some room: the solver wants one, and no place is asked for. Baked once, as that takes the time of a minute of light.
fn room() -> Result<fix::Calib> {
    const FILE: &str = "calib/default.toml";
    static ROOM: OnceLock<fix::Calib> = OnceLock::new();
    if let Some(room) = ROOM.get() {
        return Ok(*room);
    }
    let usual = schema::read(FILE, include_str!("../../../calib/default.toml"));
    let held = usual.and_then(|room| firmware::bake(FILE, &room)).map_err(|error| anyhow!("{error}"))?;
    Ok(*ROOM.get_or_init(|| held.baked.calib))
}

fn note(widths: &mut Widths, width: u64) {
    *widths.entry(width).or_default() += 1;
}
