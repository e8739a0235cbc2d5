//! What was understood, in figures: the JSON object of `cargo xtask pulses --json`, field by field.
//!
//! Times are seconds since the first rise, angles degrees from straight ahead, the stations' terms as they send them. What
//! cannot be known is `null`: without a cycle and without `--clock-hz` there are no seconds.
//!
//! # What can go wrong
//! Nothing: figures of too little light are absent, not wrong.

use lighthouse_mote::angle;
use lighthouse_mote::frame::Lock as Status;
use lighthouse_mote::ootx::Block;
use lighthouse_mote::sweep::{Axis as Rotor, HALF_TURN_BITS, Station as Side, Sweep};
use serde::Serialize;

use super::play::{Played, Widths};
use crate::light::HALF_TURNS_HZ;
use crate::quantile::quantile;

/// A full room: flashes of a station, sweeps of a rotor in a second.
pub const FULL: (f64, f64) = (120.0, 30.0);
/// Width of a bin of the histogram.
pub const BIN_US: f64 = 2.0;
/// Bins of the histogram; the last takes what is longer too.
pub const BINS: usize = 78;
/// The eight nominal flashes: 62.5 us and one to seven steps of 1/96,000 s.
pub const NOMINAL_US: [f64; 8] = [62.5, 72.917, 83.333, 93.75, 104.167, 114.583, 125.0, 135.417];
/// A width step in us, 1/32 of which a health frame tells the bias in.
const STEP_US: f64 = 1e6 / 96_000.0;

/// All of it.
#[derive(Debug, Clone, Serialize)]
pub struct Findings {
    /// As it was named.
    pub file: String,
    /// Pulses played.
    pub pulses: u64,
    /// Pulses that were joined to the one before, with `--join`.
    pub joined: u64,
    /// From the first rise to the last fall.
    pub duration_ticks: u64,
    /// The same.
    pub duration_s: Option<f64>,
    /// Whether the cycle was known, and when.
    pub lock: Lock,
    /// What the rotors say of the clock; `null` where no half turn was measured.
    pub clock: Option<Clock>,
    /// Stations A and B.
    pub stations: [Station; 2],
    /// A azimuth, A elevation, B azimuth, B elevation.
    pub rotors: [Angles; 4],
    /// What was turned away, by cause.
    pub rejects: Rejects,
    /// Widths of all pulses; `null` without seconds.
    pub widths: Option<Histogram>,
    /// Shortest, median and longest pulse.
    pub widths_ticks: [u64; 3],
    /// What a person could do better, a sentence each.
    pub advice: Vec<String>,
}

/// Whether the cycle was known, and when.
#[derive(Debug, Clone, Serialize)]
pub struct Lock {
    /// At the end: `locked`, or why not: `no_light`, `searching`, `one_station`, `spacing`, `widths`, `v2`.
    pub status: &'static str,
    /// When it was first known.
    pub acquired_s: Option<f64>,
    /// The same in cycles of 33.3 ms.
    pub acquired_cycles: Option<f64>,
    /// When it was lost.
    pub lost_s: Vec<f64>,
    /// How often.
    pub lost: usize,
    /// Of the recording, 0 to 1.
    pub locked_share: f64,
}

/// What the rotors say of the clock that stamped the pulses.
#[derive(Debug, Clone, Serialize)]
pub struct Clock {
    /// Its mean rate: 120 half turns.
    pub hz: f64,
    /// The mean half turn.
    pub half_turn_ticks: f64,
    /// How much longer half turns were in the last tenth of the recording than in the first, parts in a million.
    pub drift_ppm: f64,
    /// The shortest and the longest against the mean.
    pub range_ppm: [f64; 2],
    /// `--clock-hz`.
    pub nominal_hz: Option<f64>,
    /// The rate against that.
    pub off_nominal_ppm: Option<f64>,
}

/// A count and what it is in a second.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Rate {
    /// How many.
    pub count: u64,
    /// Over the whole recording.
    pub per_s: Option<f64>,
    /// What a full room would give.
    pub full_per_s: f64,
}

/// One station.
#[derive(Debug, Clone, Serialize)]
pub struct Station {
    /// `A` or `B`: who flashes first.
    pub station: &'static str,
    /// Flashes understood.
    pub flashes: Rate,
    /// How much longer than nominal they look.
    pub width_bias_us: Option<f64>,
    /// When a frame came whole.
    pub good_s: Vec<f64>,
    /// How many did.
    pub good: u64,
    /// When one was dropped.
    pub bad_s: Vec<f64>,
    /// How many were.
    pub bad: u64,
    /// Different things that it said.
    pub versions: usize,
    /// What it said last.
    pub said: Option<Said>,
}

/// What a station says about itself.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Said {
    /// Serial number.
    pub id: u32,
    /// Firmware version.
    pub firmware: u16,
    /// Version of the block's layout.
    pub protocol: u8,
    /// Hardware version.
    pub hardware: u8,
    /// Channel: `A`, `b`, `c`, or a number.
    pub mode: String,
    /// Fault flags, 0 when well.
    pub faults: u8,
    /// How often its rotors lost their lock.
    pub unlock_count: u8,
    /// Gravity as it feels it, g.
    pub gravity_g: [f64; 3],
    /// Terms of the azimuth and the elevation rotor.
    pub rotors: [Terms; 2],
    /// Whether a mote would believe the terms.
    pub is_believed: bool,
}

/// Factory terms of a rotor, exactly as sent: half floats.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[allow(missing_docs, reason = "as in lighthouse_mote::ootx::Terms")]
pub struct Terms {
    pub phase_rad: f64,
    pub tilt_rad: f64,
    pub curve: f64,
    pub gibphase_rad: f64,
    pub gibmag_rad: f64,
}

/// The angles of one rotor.
#[derive(Debug, Clone, Serialize)]
pub struct Angles {
    /// `A` or `B`.
    pub station: &'static str,
    /// `azimuth` or `elevation`.
    pub axis: &'static str,
    /// Sweeps understood.
    pub sweeps: Rate,
    /// As measured.
    pub measured: Option<Series>,
    /// With the station's own terms, with `--factory` and where they came.
    pub factory: Option<Series>,
}

/// A row of angles, degrees from straight ahead, within the field of view.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Series {
    /// How many.
    pub count: usize,
    /// More than 60 degrees to a side, and turned away.
    pub outside: usize,
    /// The first.
    pub first_deg: f64,
    /// The last.
    pub last_deg: f64,
    /// Their mean.
    pub mean_deg: f64,
    /// Standard deviation of one angle about its neighbours, from the median: neither a slow walk nor a few
    /// reflections count.
    pub scatter_deg: Option<f64>,
}

/// What was turned away.
#[derive(Debug, Clone, Copy, Serialize)]
#[allow(missing_docs, reason = "as in the health frame")]
pub struct Rejects {
    pub strays: u64,
    pub widths: u64,
    pub short: u64,
    pub long: u64,
    pub second: u64,
    pub outside: u64,
}

/// How often each width came; the last bin takes what is longer too.
#[derive(Debug, Clone, Serialize)]
pub struct Histogram {
    /// From bin to bin.
    pub bin_us: f64,
    /// A's flashes.
    pub a: Vec<u64>,
    /// B's flashes.
    pub b: Vec<u64>,
    /// Sweeps.
    pub sweeps: Vec<u64>,
    /// Pulses that were neither.
    pub other: Vec<u64>,
}

const NAMES: [&str; 2] = ["A", "B"];

impl Findings {
    /// Sums up; `nominal_hz` serves where the light gives no rate.
    #[must_use]
    pub fn of(file: String, joined: u64, played: &Played, nominal_hz: Option<f64>, factory: bool) -> Self {
        let clock = Clock::of(&played.half_turns, nominal_hz);
        let hz = clock.as_ref().map(|clock| clock.hz).or(nominal_hz);
        let seconds = |at: u64| hz.map(|hz| at.saturating_sub(played.first) as f64 / hz);
        let all = |times: &mut dyn Iterator<Item = u64>| times.filter_map(seconds).collect::<Vec<_>>();
        let duration_ticks = played.last - played.first;
        let rate = |count: u64, full_per_s: f64| {
            let per_s = seconds(played.last).filter(|length| *length > 0.0).map(|length| count as f64 / length);
            Rate { count, per_s, full_per_s }
        };
        let locked: u64 = played.locked.iter().map(|(from, to)| to - from).sum();
        let acquired = played.locked.first().map(|(from, _)| *from);
        let totals = &played.totals;
        let stations = [0, 1].map(|station| {
            let frames = &played.frames[station];
            let mut versions: Vec<&Block> = Vec::new();
            for (_, block) in frames {
                if !versions.contains(&block) {
                    versions.push(block);
                }
            }
            Station {
                station: NAMES[station],
                flashes: rate(totals.syncs[station], FULL.0),
                width_bias_us: played.width_bias[station].map(|bias| f64::from(bias) * STEP_US / 32.0),
                good_s: all(&mut frames.iter().map(|(at, _)| *at)),
                good: totals.good[station],
                bad_s: all(&mut played.bad[station].iter().copied()),
                bad: totals.bad[station],
                versions: versions.len(),
                said: frames.last().map(|(_, block)| Said::of(block)),
            }
        });
        let rotors = rotors(played, factory).map(|(side, axis, measured, factory)| Angles {
            station: NAMES[side],
            axis: ["azimuth", "elevation"][axis],
            sweeps: rate(totals.sweeps[side][axis], FULL.1),
            measured,
            factory,
        });
        let lock = Lock {
            status: name(played.status),
            acquired_s: acquired.and_then(seconds),
            acquired_cycles: acquired.and_then(seconds).map(|s| s * HALF_TURNS_HZ / 4.0),
            lost_s: all(&mut played.lost.iter().copied()),
            lost: played.lost.len(),
            locked_share: if duration_ticks == 0 { 0.0 } else { locked as f64 / duration_ticks as f64 },
        };
        let advice = advice(played, &stations, &rotors);
        Self {
            file,
            pulses: played.pulses,
            joined,
            duration_ticks,
            duration_s: seconds(played.last),
            lock,
            clock,
            stations,
            rotors,
            rejects: Rejects {
                strays: totals.strays,
                widths: totals.widths,
                short: totals.short,
                long: totals.long,
                second: totals.second,
                outside: totals.outside,
            },
            widths: hz.map(|hz| Histogram::of(&played.widths, hz)),
            widths_ticks: span(&played.widths),
            advice,
        }
    }
}

/// The status as it is written.
fn name(status: Status) -> &'static str {
    match status {
        Status::NoLight => "no_light",
        Status::Searching => "searching",
        Status::Locked => "locked",
        Status::OneStation => "one_station",
        Status::Spacing => "spacing",
        Status::Widths => "widths",
        Status::V2 => "v2",
    }
}

/// What a person with the mote in hand could do.
fn advice(played: &Played, stations: &[Station; 2], rotors: &[Angles; 4]) -> Vec<String> {
    let mut advice = Vec::new();
    let mut say = |text: &str| advice.push(text.to_string());
    match played.status {
        Status::Locked => {}
        Status::NoLight => {
            say("The light went before the end: look for what stands between the mote and the stations.")
        }
        Status::Searching => say(
            "There are pulses, but no cycle in them yet: record at least a second, with the photodiode facing both \
             stations and out of sun and lamp light.",
        ),
        Status::OneStation => say(
            "Only one station of a pair flashes here, and the light does not tell which: uncover the other, or say who \
             this is with --lone A or --lone B.",
        ),
        Status::Spacing => say(
            "Two stations flash, but not 350 to 450 us apart, so they are not synchronised: join them by the cable and \
             set their channels to A and b, or let them see each other and set b and c.",
        ),
        Status::Widths => say(
            "The pulses are too long to be flashes or sweeps: check that the line is high while there is light, and \
             switch off lamps that flicker.",
        ),
        Status::V2 => {
            say("There are sweeps but no flashes: these look like Lighthouse V2 stations, and the mote reads V1 only.")
        }
    }
    if played.locked.is_empty() {
        return advice;
    }
    for (index, station) in stations.iter().enumerate() {
        let name = station.station;
        let swept = rotors.iter().filter(|rotor| rotor.station == name).map(|rotor| rotor.sweeps.count).sum::<u64>();
        if station.flashes.count == 0 {
            advice.push(format!("Station {name} is not seen: something hides it, or it is off."));
        } else if swept == 0 {
            advice.push(format!(
                "Station {name} flashes but never sweeps here: the mote sees it by reflection only, or lies outside its \
                 120 degrees."
            ));
        }
        if station.said.as_ref().is_some_and(|said| said.faults != 0) {
            advice.push(format!(
                "Station {name} says that it is faulty: switch it off and on, and see that it stands firmly."
            ));
        }
        if station.said.as_ref().is_some_and(|said| !said.is_believed) {
            advice.push(format!(
                "Station {name} sends factory terms beyond any real station's: a mote does not use them."
            ));
        }
        let rate = station.flashes.per_s.unwrap_or(FULL.0);
        if played.frames[index].is_empty() && station.flashes.count > 0 {
            advice.push(if rate < 0.9 * FULL.0 {
                format!("No frame of station {name} came whole: too many of its flashes are lost.")
            } else {
                format!("No frame of station {name} came whole: one takes 3 s, and 9 s are sure to hold two.")
            });
        }
    }
    advice
}

impl Clock {
    fn of(half_turns: &[(u64, u32)], nominal_hz: Option<f64>) -> Option<Self> {
        let ticks = |q8: u32| f64::from(q8) / 256.0;
        let mean = |part: &[(u64, u32)]| part.iter().map(|(_, q8)| ticks(*q8)).sum::<f64>() / part.len() as f64;
        let tenth = half_turns.len().div_ceil(10);
        if tenth == 0 {
            return None;
        }
        let half_turn_ticks = mean(half_turns);
        let ppm = |ticks: f64| (ticks / half_turn_ticks - 1.0) * 1e6;
        let ends = half_turns.iter().fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], (_, q8)| {
            [low.min(ppm(ticks(*q8))), high.max(ppm(ticks(*q8)))]
        });
        let hz = half_turn_ticks * HALF_TURNS_HZ;
        Some(Self {
            hz,
            half_turn_ticks,
            drift_ppm: ppm(mean(&half_turns[half_turns.len() - tenth..])) - ppm(mean(&half_turns[..tenth])),
            range_ppm: ends,
            nominal_hz,
            off_nominal_ppm: nominal_hz.map(|nominal| (hz / nominal - 1.0) * 1e6),
        })
    }
}

impl Said {
    fn of(block: &Block) -> Self {
        let terms = |axis| {
            let terms = block.terms(axis);
            Terms {
                phase_rad: terms.phase.to_f64(),
                tilt_rad: terms.tilt.to_f64(),
                curve: terms.curve.to_f64(),
                gibphase_rad: terms.gibphase.to_f64(),
                gibmag_rad: terms.gibmag.to_f64(),
            }
        };
        Self {
            id: block.id(),
            firmware: block.firmware(),
            protocol: block.protocol(),
            hardware: block.hardware(),
            mode: match block.mode() {
                0 => "A".to_string(),
                1 => "b".to_string(),
                2 => "c".to_string(),
                other => other.to_string(),
            },
            faults: block.faults(),
            unlock_count: block.unlock_count(),
            gravity_g: block.acceleration().map(|axis| f64::from(axis) / 127.0),
            rotors: [terms(Rotor::Azimuth), terms(Rotor::Elevation)],
            is_believed: angle::received(block).is_some(),
        }
    }
}

/// Station, axis, angles as measured, and with the station's terms.
type Swept = (usize, usize, Option<Series>, Option<Series>);

/// Every rotor's angles, by the mote's own arithmetic.
fn rotors(played: &Played, factory: bool) -> [Swept; 4] {
    let measured = angles(&played.sweeps, &angle::Config::default());
    let terms = [0, 1].map(|side| played.frames[side].last().and_then(|(_, block)| angle::received(block)));
    let corrected =
        factory.then(|| angles(&played.sweeps, &angle::Config::new(terms.map(|rotors| rotors.unwrap_or_default()))));
    [(0, 0), (0, 1), (1, 0), (1, 1)].map(|(side, axis)| {
        let with_terms = corrected.as_ref().filter(|_| terms[side].is_some()).and_then(|all| all[side][axis]);
        (side, axis, measured[side][axis], with_terms)
    })
}

fn angles(sweeps: &[(u64, Sweep)], config: &angle::Config) -> [[Option<Series>; 2]; 2] {
    let mut state = angle::State::default();
    let mut seen: [[Vec<f64>; 2]; 2] = Default::default();
    let mut outside = [[0; 2]; 2];
    for (_, sweep) in sweeps {
        let (side, axis) = (sweep.station as usize, sweep.axis as usize);
        match angle::step(config, &mut state, *sweep) {
            Some(bearing) => {
                seen[side][axis].push(f64::from(bearing.angle.0) * 180.0 / f64::from(1 << HALF_TURN_BITS));
            }
            None => outside[side][axis] += 1,
        }
    }
    [Side::A, Side::B]
        .map(|side| [0, 1].map(|axis| Series::of(&seen[side as usize][axis], outside[side as usize][axis])))
}

impl Series {
    fn of(degrees: &[f64], outside: usize) -> Option<Self> {
        let (first, last) = (degrees.first()?, degrees.last()?);
        let mut off: Vec<f64> =
            degrees.windows(3).map(|three| (three[1] - (three[0] + three[2]) / 2.0).abs()).collect();
        // The median of a normal deviation is 0.6745 of the standard one; the mean of two neighbours adds half the
        // variance.
        let scatter = (off.len() >= 3).then(|| quantile(&mut off, 0.5) / 0.6745 / 1.5_f64.sqrt());
        Some(Self {
            count: degrees.len(),
            outside,
            first_deg: *first,
            last_deg: *last,
            mean_deg: degrees.iter().sum::<f64>() / degrees.len() as f64,
            scatter_deg: scatter,
        })
    }
}

impl Histogram {
    fn of(widths: &[Widths; 4], hz: f64) -> Self {
        let [a, b, sweeps, other] = widths.each_ref().map(|widths| {
            let mut bins = vec![0; BINS];
            for (ticks, count) in widths {
                let bin = (*ticks as f64 / hz * 1e6 / BIN_US) as usize;
                bins[bin.min(BINS - 1)] += count;
            }
            bins
        });
        Self { bin_us: BIN_US, a, b, sweeps, other }
    }
}

/// Shortest, median, longest.
fn span(widths: &[Widths; 4]) -> [u64; 3] {
    let mut all = Widths::new();
    for (width, count) in widths.iter().flatten() {
        *all.entry(*width).or_default() += count;
    }
    let half = all.values().sum::<u64>().div_ceil(2);
    let mut below = 0;
    let median = all.iter().find(|(_, count)| {
        below += *count;
        below >= half
    });
    let end = |entry: Option<(&u64, &u64)>| entry.map_or(0, |(width, _)| *width);
    [end(all.first_key_value()), end(median), end(all.last_key_value())]
}

/// The shortest decimal number that is this half float and no other.
#[must_use]
pub fn shortest(value: f64) -> String {
    if value == 0.0 || !value.is_finite() {
        return format!("{value}");
    }
    // The spacing of half floats here, and half of it: 10 bits below the leading one, 2^-24 at the least.
    let spacing = value.abs().log2().floor().max(-14.0).exp2() / 1024.0;
    let reach = if value.abs().log2().fract() == 0.0 { spacing / 4.0 } else { spacing / 2.0 };
    let exponent = value.abs().log10().floor() as i32;
    for digits in 0..6 {
        let places = digits - exponent;
        let scale = 10f64.powi(places);
        let rounded = (value * scale).round() / scale;
        if (rounded - value).abs() < reach {
            return format!("{rounded:.*}", usize::try_from(places).unwrap_or(0));
        }
    }
    format!("{value}")
}
