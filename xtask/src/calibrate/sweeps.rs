//! What a mote saw, as the solver wants it: an angle, whose, and when, on a clock that counts true seconds.
//!
//! # Design
//! A mote's own clock is off by percents and drifts; the light tells how much, because half a turn of a rotor is
//! 8.333 ms. So time is counted in half turns, as they were measured at each moment, and every clock comes out right.
//!
//! What can go wrong: rows that cannot have been a sweep are left out and counted; a capture may hold no angles at all,
//! because the mote was not told to send them.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use air::capture;
use anyhow::{Context, Result, bail, ensure};
use lighthouse_mote::frame::{self, Measured, Message};
use nalgebra::Vector3;

use super::solve::{Sighting, TruthSample};
use crate::light::{HALF_TURN_S, Light, Stamp};
use crate::quantile::quantile;
use crate::recording::{Recording, Row};

/// Units of a measured share in a half turn.
const SHARE: f64 = (1u32 << 20) as f64;
/// Real half turns have this many ticks on clocks from 1 to 48 MHz.
const HALF_TURN_TICKS: std::ops::RangeInclusive<f64> = 8e3..=4e5;

/// All sweeps of one source.
#[derive(Clone, Debug)]
pub struct Sweeps {
    /// In the order in which they came.
    pub sightings: Vec<Sighting>,
    /// Median half turn, in ticks of the clock that measured it.
    pub half_turn_ticks: f64,
    /// What was found out on the way.
    pub notes: Vec<String>,
}

/// Turns a mote's ticks into seconds since its first sweep.
///
/// Where that cannot be told, because the mote started anew or sent nothing for half a turn of its counter, time goes on
/// from where it stood.
#[derive(Clone, Copy, Debug, Default)]
pub struct MoteClock {
    last: Option<(u32, f64)>,
    /// The counter says nothing of the time before.
    is_new: bool,
    /// How many times it was so.
    breaks: u32,
}

/// Sweeps of one frame may be out of order, by a few half turns; a counter that goes back further began anew, seconds.
const BACK_S: f64 = 1.0;

impl MoteClock {
    /// The mote says that it started anew, or that it was silent for too long.
    fn begin_anew(&mut self) {
        self.is_new = true;
    }

    /// The sweep as the solver wants it, with the half turn as measured by then, ticks, Q8; none when that is no half
    /// turn, or the sweep lies beyond it.
    pub fn sighting(&mut self, seen: &Measured, half_turn_q8: u32) -> Option<Sighting> {
        let half_turn = f64::from(half_turn_q8) / 256.0;
        if !HALF_TURN_TICKS.contains(&half_turn) || f64::from(seen.share) >= SHARE {
            return None;
        }
        let at_s = match self.last {
            None => 0.0,
            Some((ticks, at_s)) => {
                let since_s = f64::from(seen.time.wrapping_sub(ticks).cast_signed()) / half_turn * HALF_TURN_S;
                let is_broken = self.is_new || since_s < -BACK_S;
                self.breaks += u32::from(is_broken);
                if is_broken { at_s } else { at_s + since_s }
            }
        };
        self.is_new = false;
        self.last = Some((seen.time, at_s));
        let angle = angle(f64::from(seen.share) / SHARE);
        Some(Sighting { at_s, station: seen.station as usize, axis: seen.axis as usize, angle })
    }
}

/// The measured angle of a sweep this part of a half turn after its sync, radians from straight ahead.
fn angle(share: f64) -> f64 {
    (share - 0.5) * std::f64::consts::PI
}

/// The sweeps of a recording, and where it says the mote was: within its window for fitting if it names one.
pub fn of_recording(recording: &Recording, light: &Light) -> (Sweeps, Vec<TruthSample>) {
    let cycles_per_tick = light.mote_hz / recording.clock_hz;
    let within = |row: &Row| recording.calibrate.is_empty() || recording.calibrate.contains(&row.timestamp);
    let mut sightings = Vec::new();
    let mut truth: Vec<TruthSample> = Vec::new();
    let (mut unplayable, mut half_turns) = (0, Vec::new());
    // Where the clock stands: a cycle of the mote and its true time.
    let mut clock: Option<(f64, f64)> = None;
    for (row, played) in recording.rows.iter().zip(&light.rows).filter(|(row, _)| within(row)) {
        let half_turn_cycles = played.half_turn * cycles_per_tick;
        let cycle = played.cycle as f64;
        let (last, then_s) = *clock.get_or_insert((cycle, 0.0));
        let now_s = then_s + (cycle - last) / half_turn_cycles * HALF_TURN_S;
        clock = Some((cycle, now_s));
        if row.truth_ok && truth.last().is_none_or(|sample| now_s > sample.at_s) {
            truth.push(TruthSample { at_s: now_s, position: Vector3::from(row.truth) });
        }
        match played.laser {
            Err(_) => unplayable += 1,
            Ok(_) if played.repeat => {}
            Ok(laser) => {
                half_turns.push(played.half_turn);
                sightings.push(Sighting {
                    at_s: now_s + (laser as f64 - cycle) / half_turn_cycles * HALF_TURN_S,
                    station: row.kind.station as usize,
                    axis: row.kind.axis as usize,
                    angle: angle(f64::from(row.sync_to_sweep) / played.half_turn),
                });
            }
        }
    }
    sightings.sort_by(|a, b| a.at_s.total_cmp(&b.at_s));
    let stamps = match light.findings.stamp {
        Stamp::Sync => "the sync",
        Stamp::Middle => "midway between sync and sweep",
        Stamp::Sweep => "the sweep",
        Stamp::Log => "the time of writing",
    };
    let mut notes = vec![format!("the recording's timestamps are {stamps}")];
    if unplayable > 0 {
        notes.push(format!("{unplayable} rows cannot have been a sweep and are left out"));
    }
    if !recording.calibrate.is_empty() {
        let of = recording.rows.len();
        let used = recording.rows.iter().filter(|row| within(row)).count();
        notes.push(format!("fitted on the {used} of {of} rows within the recording's calibrate window"));
    }
    let half_turn_ticks = quantile(&mut half_turns, 0.5);
    (Sweeps { sightings, half_turn_ticks, notes }, truth)
}

/// The sweeps that a mote sent while somebody captured its frames.
pub fn of_capture(path: &Path) -> Result<Sweeps> {
    let name = path.display().to_string();
    let file = File::open(path).with_context(|| format!("{name}: cannot be read"))?;
    let mut heard = Heard::default();
    // Between two breaks of the mote's clock.
    let mut stretches: Vec<Vec<Sighting>> = vec![Vec::new()];
    let mut half_turns = Vec::new();
    let mut trouble = None;
    capture::frames(&name, BufReader::new(file), |frame| match heard.hear(frame, &mut half_turns) {
        Ok(seen) => {
            stretches.resize(1 + heard.clock.breaks as usize, Vec::new());
            stretches.last_mut().into_iter().for_each(|stretch| stretch.extend(seen.iter()));
            true
        }
        Err(error) => {
            trouble = Some(error.context(name.clone()));
            false
        }
    })?;
    if let Some(trouble) = trouble {
        return Err(trouble);
    }
    let length_s = |stretch: &Vec<Sighting>| Some(stretch.last()?.at_s - stretch.first()?.at_s);
    let lengths: Vec<f64> = stretches.iter().filter_map(length_s).collect();
    let longest = stretches.iter().max_by(|a, b| length_s(a).unwrap_or(-1.0).total_cmp(&length_s(b).unwrap_or(-1.0)));
    let sightings = longest.cloned().unwrap_or_default();
    if sightings.is_empty() {
        bail!("{name}: {}", heard.nothing());
    }
    ensure!(half_turns.iter().all(|h| h.is_finite()), "{name}: a half turn that is no number");
    let mut notes = vec![format!("{} frames with angles, {} others", heard.angles, heard.reports + heard.foreign)];
    if lengths.len() > 1 {
        notes.push(format!(
            "the mote's clock broke {} times, for it started anew or was silent for too long: only the longest stretch is \
             used, {:.1} of {:.1} s",
            lengths.len() - 1,
            lengths.iter().copied().fold(0.0, f64::max),
            lengths.iter().sum::<f64>()
        ));
    }
    Ok(Sweeps { sightings, half_turn_ticks: quantile(&mut half_turns, 0.5), notes })
}

/// A health frame is a second old at most, and a few may be lost, seconds.
const UPTIME_S: f64 = 5.0;

/// What came out of a radio so far: the angles of one mote, and how much else.
#[derive(Clone, Copy, Debug, Default)]
pub struct Heard {
    clock: MoteClock,
    mote: Option<u16>,
    /// Seconds since it started, by its latest health frame, and by the one before its latest sweep.
    uptime: [Option<u32>; 2],
    /// Frames with angles.
    pub angles: u64,
    /// Other frames of ours.
    pub reports: u64,
    /// Frames of others, and garbled ones.
    pub foreign: u64,
}

impl Heard {
    /// The sweeps in a frame, check sequence included; the half turns they were measured with go to `half_turns`.
    pub fn hear(&mut self, frame: &[u8], half_turns: &mut Vec<f64>) -> Result<Vec<Sighting>> {
        let (mote, angles) = match frame::parse(frame) {
            Ok((header, Message::Angles(angles))) => (header.mote, angles),
            Ok((header, Message::Health(health))) => {
                self.reports += 1;
                if self.mote.is_none_or(|mote| mote == header.mote) {
                    if self.uptime[0].is_some_and(|before| health.uptime < before) {
                        self.clock.begin_anew();
                        self.uptime[1] = None;
                    }
                    self.uptime[0] = Some(health.uptime);
                }
                return Ok(Vec::new());
            }
            Ok(_) => {
                self.reports += 1;
                return Ok(Vec::new());
            }
            Err(_) => {
                self.foreign += 1;
                return Ok(Vec::new());
            }
        };
        let first = *self.mote.get_or_insert(mote);
        ensure!(first == mote, "angles of two motes, {first} and {mote}: switch one of them off");
        self.angles += 1;
        // Half a turn of the counter, in the half turns of the light; the last seconds may be missing in what was told.
        let half_counter_s = f64::from(1u32 << 31) / f64::from(angles.half_turn_q8) * 256.0 * HALF_TURN_S;
        if let [Some(now), Some(before)] = self.uptime
            && f64::from(now.saturating_sub(before)) > half_counter_s - UPTIME_S
        {
            self.clock.begin_anew();
        }
        self.uptime[1] = self.uptime[0];
        half_turns.push(f64::from(angles.half_turn_q8) / 256.0);
        Ok(angles.sweeps.iter().filter_map(|sweep| self.clock.sighting(sweep, angles.half_turn_q8)).collect())
    }

    /// Why there is nothing to work with.
    pub fn nothing(&self) -> String {
        format!(
            "no frame holds angles ({} reports of positions, {} other frames); has the mote been told to send angles?",
            self.reports, self.foreign
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pcap::{self, Frame};
    use lighthouse_mote::frame::{ANGLES_LEN, Angles, Header, Health, emit_angles, emit_health};
    use lighthouse_mote::sweep::{Axis, Station};

    /// A half turn of a 10.82 MHz clock, ticks.
    const HALF_TURN: u32 = 90_167;

    fn angles_frame(mote: u16, times: &[u32]) -> Vec<u8> {
        let mut angles = Angles { half_turn_q8: HALF_TURN << 8, ..Angles::default() };
        for (n, time) in times.iter().enumerate() {
            let axis = if n % 2 == 0 { Axis::Azimuth } else { Axis::Elevation };
            let share = (1 << 19) + (n as u32) * 1000;
            angles.sweeps.push(Measured { time: *time, station: Station::B, axis, share }).expect("at most eight");
        }
        let header = Header { pan: 1, mote, sequence: 0 };
        emit_angles(header, &angles, &mut [0; ANGLES_LEN]).to_vec()
    }

    #[test]
    fn a_mote_s_ticks_become_seconds_across_the_wrap_of_its_counter() {
        let mut heard = Heard::default();
        let start = u32::MAX - HALF_TURN / 2;
        let times = [start, start.wrapping_add(HALF_TURN), start.wrapping_add(3 * HALF_TURN)];
        let mut half_turns = Vec::new();
        let seen = heard.hear(&angles_frame(7, &times), &mut half_turns).unwrap();
        let later = heard.hear(&angles_frame(7, &[start.wrapping_add(120 * HALF_TURN)]), &mut half_turns).unwrap();
        for (sighting, at_s) in seen.iter().chain(&later).zip([0.0, 1.0 / 120.0, 3.0 / 120.0, 1.0]) {
            assert!((sighting.at_s - at_s).abs() < 1e-12, "{sighting:?} {at_s}");
        }
        assert_eq!(half_turns, [f64::from(HALF_TURN); 2]);
        assert_eq!(
            (seen[0].station, seen[0].axis, seen[0].angle),
            (1, 0, 0.0),
            "half of the half turn is straight ahead"
        );
        assert!((seen[1].angle - 1000.0 * std::f64::consts::PI / SHARE).abs() < 1e-12 && seen[1].axis == 1);
    }

    fn health_frame(mote: u16, uptime: u32) -> Vec<u8> {
        let header = Header { pan: 1, mote, sequence: 0 };
        emit_health(header, &Health { uptime, ..Health::default() }).to_vec()
    }

    #[test]
    fn time_never_goes_back_and_a_mote_that_starts_anew_is_noticed() {
        let hear = |frames: &[Vec<u8>]| {
            let mut heard = Heard::default();
            let seen: Vec<f64> =
                frames.iter().flat_map(|f| heard.hear(f, &mut Vec::new()).unwrap()).map(|s| s.at_s).collect();
            assert!(seen.is_sorted(), "{seen:?}");
            (heard.clock.breaks, seen.last().copied().unwrap_or(0.0))
        };
        let at = |half_turns: u32| angles_frame(7, &[half_turns.wrapping_mul(HALF_TURN)]);
        // 100 s, and from the beginning again for 50: by itself, and as a health frame tells.
        let (breaks, end_s) = hear(&[at(0), at(12_000), at(0), at(6_000)]);
        assert!(breaks == 1 && (end_s - 150.0).abs() < 1e-6, "{breaks} {end_s}");
        let told = [at(0), health_frame(7, 100), at(12_000), health_frame(7, 3), at(13_000), at(19_000)];
        assert_eq!(hear(&told), (1, 150.0));
        // One that has been up for long when it is first heard.
        assert_eq!(hear(&[at(0), health_frame(7, 4000), at(120)]).0, 0);
        // What another mote does is none of its business.
        let (breaks, _) = hear(&[at(0), health_frame(7, 100), health_frame(8, 3), at(12_000)]);
        assert_eq!(breaks, 0);
        // 198.4 s are half a turn of the counter; 300 s look like 97 s back.
        let (breaks, end_s) = hear(&[health_frame(7, 1), at(0), at(60), health_frame(7, 301), at(36_000), at(36_120)]);
        assert!(breaks == 1 && (end_s - 1.5).abs() < 1e-6, "{breaks} {end_s}");
    }

    #[test]
    fn of_a_capture_with_a_break_the_longest_stretch_is_used_and_that_is_said() {
        let frames: Vec<Frame> = [0, 1200, 2400, 0, 1200]
            .iter()
            .map(|half_turns| Frame { micros: 0, bytes: angles_frame(7, &[half_turns * HALF_TURN]) })
            .collect();
        let home = tempfile::tempdir().unwrap();
        let path = home.path().join("air.pcap");
        let mut bytes = Vec::new();
        pcap::write(&frames, &mut bytes).unwrap();
        std::fs::write(&path, bytes).unwrap();
        let sweeps = of_capture(&path).unwrap();
        assert_eq!(sweeps.sightings.len(), 3);
        assert!(
            sweeps.notes[1].contains("broke 1 times") && sweeps.notes[1].contains("20.0 of 30.0 s"),
            "{:?}",
            sweeps.notes
        );
    }

    #[test]
    fn two_motes_at_once_are_refused_and_others_frames_are_counted() {
        let mut heard = Heard::default();
        let mut half_turns = Vec::new();
        assert_eq!(heard.hear(&angles_frame(7, &[1]), &mut half_turns).unwrap().len(), 1);
        assert!(heard.hear(b"somebody else's", &mut half_turns).unwrap().is_empty());
        let mut garbled = angles_frame(7, &[2]);
        garbled[20] ^= 1;
        assert!(heard.hear(&garbled, &mut half_turns).unwrap().is_empty());
        assert_eq!((heard.angles, heard.foreign), (1, 2));
        let said = heard.hear(&angles_frame(8, &[3]), &mut half_turns).unwrap_err().to_string();
        assert!(said.starts_with("angles of two motes, 7 and 8"), "{said}");
    }

    #[test]
    fn a_half_turn_that_is_none_gives_no_sweep() {
        let mut clock = MoteClock::default();
        let seen = Measured { time: 0, station: Station::A, axis: Axis::Azimuth, share: 1 << 19 };
        assert!(clock.sighting(&seen, 0).is_none());
        assert!(clock.sighting(&Measured { share: 1 << 20, ..seen }, HALF_TURN << 8).is_none());
        assert!(clock.sighting(&seen, HALF_TURN << 8).is_some());
    }
}
