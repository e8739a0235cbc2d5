//! The scenes by name: what each does to the light of a room.
//!
//! A scene is one take or several, each a world of its own with its own seed, and the moments from which a good fix is
//! due again. Everything not said is the default scene's: a hand-held walk, 5 % of the pulses lost, a clock 4 % off.
//!
//! What can go wrong: a repeated disturbance that keeps step with the cycle would meet the same phase each time; the
//! pauses are therefore no multiple of the 33.3 ms cycle.

use sim::world::Scene;
use sim::world::path::Path;
use sim::world::receiver::{Line, LineFault, Mirror, Strobe};
use sim::world::station::{Hides, Moved, Occlusion, Station};

use super::reason::Reason;
use crate::room::Room;

/// A cycle of four slots, seconds.
const CYCLE_S: f64 = 4.0 / 120.0;
/// Phases of the cycle that are tried.
const PHASES: u32 = 64;
/// What is disturbed is disturbed from here on: lock and track are settled, seconds.
const SETTLED_S: f64 = 3.0;
/// What the mote's health is to name, one of these, where no good fix can come for seconds. A health frame comes once a
/// second, so shorter gaps have none to themselves.
const REASONS: [(&str, &[Reason]); 16] = [
    ("occlusion-a-10s", &[Reason::ADark, Reason::OneStation]),
    ("occlusion-b-10s", &[Reason::BDark, Reason::OneStation]),
    ("occlusion-both-1s", &[Reason::NoLight]),
    ("occlusion-both-10s", &[Reason::NoLight]),
    ("stuck-high-1s", &[Reason::NoLight]),
    ("stuck-high-10s", &[Reason::NoLight]),
    ("stuck-low-1s", &[Reason::NoLight]),
    ("stuck-low-10s", &[Reason::NoLight]),
    ("storm-10khz-10s", &[Reason::Widths, Reason::Spacing]),
    ("storm-100khz-10s", &[Reason::Widths, Reason::Spacing, Reason::V2]),
    // Rays that miss each other, too far for a track to begin or for a fix at all, or that meet outside the room.
    ("swapped", &[Reason::Mismatch, Reason::Geometry, Reason::Disbelieved]),
    // Until their numbers are heard, as where nobody knows them.
    ("swapped-known", &[Reason::AStranger, Reason::BStranger, Reason::Geometry]),
    ("moved-up-10cm", &[Reason::Mismatch, Reason::Geometry, Reason::Disbelieved]),
    ("moved-tilted-5deg", &[Reason::Mismatch, Reason::Geometry, Reason::Disbelieved]),
    ("single-a", &[Reason::OneStation]),
    ("single-b", &[Reason::OneStation]),
];
/// Walks of most scenes.
const WALKS: u64 = 5;
/// Walks of a scene that does harm once in some of them.
const MANY_WALKS: u64 = 20;
/// The first flash where the timer is set before it, seconds: bring-up is over.
const LATE_FIRST_SYNC_S: f64 = 0.05;

/// A scene and its name.
pub(crate) struct Named {
    pub(crate) name: String,
    /// For a person to read.
    pub(crate) what: String,
    pub(crate) takes: Vec<Take>,
}

/// One run of a mote from power-on.
#[derive(Clone)]
pub(crate) struct Take {
    pub(crate) scene: Scene,
    pub(crate) seed: u64,
    /// When light first reaches the mote, true seconds.
    pub(crate) first_light_s: f64,
    /// When light has returned or a disturbance has ended: a good fix is due again. True seconds.
    pub(crate) due_again_s: Vec<f64>,
    /// When the mote's 32-bit counter wraps, true seconds; without it, as it comes.
    pub(crate) wrap_s: Option<f64>,
    /// Where no good fix can come for seconds: the mote's health names one of these reasons.
    pub(super) reasons: &'static [Reason],
    /// The room's file names the stations' serial numbers, as the scene has them before it changes anything.
    pub(super) knows_ids: bool,
}

fn take(room: &Scene, length_s: f64, seed: u64) -> Take {
    let scene = Scene { length_s, ..room.clone() };
    let first_light_s = scene.timing.first_sync_s;
    Take { scene, seed, first_light_s, due_again_s: Vec::new(), wrap_s: None, reasons: &[], knows_ids: false }
}

/// Scenes of a room, as they are made.
struct List<'a> {
    room: &'a Scene,
    named: Vec<Named>,
}

impl List<'_> {
    /// One on several walks.
    fn walks(&mut self, name: &str, what: &str, length_s: f64, change: impl Fn(&mut Take)) {
        self.many_walks(WALKS, name, what, length_s, change);
    }

    /// One whose harm is rare.
    fn many_walks(&mut self, walks: u64, name: &str, what: &str, length_s: f64, change: impl Fn(&mut Take)) {
        let changed = |seed| {
            let mut take = take(self.room, length_s, seed);
            change(&mut take);
            take
        };
        let takes = (1..=walks).map(changed).collect();
        self.named.push(Named { name: name.to_string(), what: what.to_string(), takes });
    }
}

/// All of them in the default room, in the order of the table.
#[cfg(test)]
pub(crate) fn all() -> Vec<Named> {
    lit_by(&Scene::default())
}

/// Those that mean something in a room, in the order of the table, and those that do not. In the default room all do;
/// elsewhere not its walls, and not B knocked about in the one way that matters where both stations stand side by side.
pub(crate) fn of(room: &Room) -> (Vec<Named>, Vec<Named>) {
    let anywhere = |named: &Named| named.name != "reflections" && !named.name.starts_with("moved-");
    lit_by(&room.light).into_iter().partition(|named| !room.is_other || anywhere(named))
}

/// All of them in the light of a room.
fn lit_by(room: &Scene) -> Vec<Named> {
    let mut all = List { room, named: Vec::new() };
    all.walks("light", "the room as it is, undisturbed", 30.0, |_| {});
    occlusions(&mut all);
    receivers(&mut all);
    strangers(&mut all);
    speeds(&mut all);
    lines(&mut all);
    rooms(&mut all);
    starts(&mut all);
    clocks(&mut all);
    let mut all = all.named;
    for named in &mut all {
        let reasons = REASONS.iter().find(|(name, _)| *name == named.name).map_or(&[][..], |(_, reasons)| reasons);
        named.takes.iter_mut().for_each(|take| take.reasons = reasons);
    }
    all
}

/// When a take is disturbed: in another phase of the cycle for each walk.
fn settled_s(take: &Take) -> f64 {
    SETTLED_S + 7.3e-3 * take.seed as f64
}

fn occlusions(all: &mut List<'_>) {
    type Pick = fn(&mut Scene) -> Vec<&mut Station>;
    let who: [(&str, Pick); 3] = [
        ("a", |scene| vec![&mut scene.station_a]),
        ("b", |scene| vec![&mut scene.station_b]),
        ("both", |scene| vec![&mut scene.station_a, &mut scene.station_b]),
    ];
    for (name, stations) in who {
        for (long, dark_s, pause_s, times) in [("0.1s", 0.1, 1.507, 10), ("1s", 1.0, 2.011, 4), ("10s", 10.0, 3.0, 1)] {
            let name = format!("occlusion-{name}-{long}");
            let what =
                format!("all light of {} away for {dark_s} s, {times} times", &name[10..name.len() - long.len() - 1]);
            all.walks(&name, &what, SETTLED_S + f64::from(times) * (dark_s + pause_s), |take| {
                hide(take, stations, Hides::Everything, dark_s, pause_s, times);
            });
        }
    }
    all.walks("occlusion-sweeps-1s", "the sweeps of both away for 1 s, 4 times; the flashes go on", 15.1, |take| {
        hide(take, who[2].1, Hides::Sweeps, 1.0, 2.011, 4);
    });
}

fn hide(
    take: &mut Take,
    stations: fn(&mut Scene) -> Vec<&mut Station>,
    hides: Hides,
    dark_s: f64,
    pause_s: f64,
    times: u32,
) {
    let settled_s = settled_s(take);
    let starts_s = (0..times).map(|n| settled_s + f64::from(n) * (dark_s + pause_s));
    let occlusions: Vec<_> = starts_s.map(|from_s| Occlusion { from_s, to_s: from_s + dark_s, hides }).collect();
    take.due_again_s = occlusions.iter().map(|occlusion| occlusion.to_s).collect();
    for station in stations(&mut take.scene) {
        station.occlusions = occlusions.clone();
    }
}

/// Walls, floor and ceiling near enough that most images stay in the field of the stations. Each is bright for a share
/// of the sweeps; the stations stand a few degrees askew, so that a wall moves the elevation a little as well. Together a
/// fifth of the sweeps get company (`a_fifth_of_the_sweeps_have_company`).
pub(crate) fn mirrors() -> Vec<Mirror> {
    let mirror = |point_m, normal| Mirror { point_m, normal, probability: 0.075, gain: [0.5, 2.0], alone: 0.25 };
    vec![
        mirror([0.0, 0.0, 0.0], [1.0, 0.0, 0.0]),
        mirror([1.1, 0.0, 0.0], [-1.0, 0.0, 0.0]),
        mirror([0.0, 0.55, 0.0], [0.0, 1.0, 0.0]),
        mirror([0.0, 1.5, 0.0], [0.0, -1.0, 0.0]),
    ]
}

fn receivers(all: &mut List<'_>) {
    all.many_walks(
        MANY_WALKS,
        "reflections",
        "a fifth of the sweeps with a mirrored one, before or after, a quarter of those alone",
        30.0,
        |take| {
            take.scene.mirrors = mirrors();
        },
    );
    all.walks("dropout-50", "half of all pulses missing", 30.0, |take| {
        take.scene.receiver.sync_dropout = 0.5;
        take.scene.receiver.sweep_dropout = 0.5;
    });
    for us in [5.0, 20.0] {
        all.walks(&format!("jitter-{us}us"), &format!("every edge moved by up to {us} us"), 30.0, |take| {
            take.scene.receiver.jitter_us = 0.0;
            take.scene.receiver.even_jitter_us = us;
        });
    }
    // Sweeps last 7 to 13 us in this room: 10 us less would leave none. Receivers recorded at -10.4 us still gave
    // sweeps, so the laser's bias was less.
    for (name, flash_us, sweep_us) in
        [("-10us", -10.0, -5.0), ("-5us", -5.0, -5.0), ("+5us", 5.0, 5.0), ("+10us", 10.0, 10.0)]
    {
        let what = format!("flashes {flash_us:+} us long, sweeps {sweep_us:+}");
        all.walks(&format!("bias{name}"), &what, 20.0, |take| {
            take.scene.receiver.sync_width_bias_us = flash_us;
            take.scene.receiver.sweep_width_bias_us = sweep_us;
        });
    }
    all.walks("bias-drift", "flashes from -10 to +10 us within 40 s", 40.0, |take| {
        take.scene.receiver.sync_width_bias_us = -10.0;
        take.scene.receiver.sync_width_drift_us_per_s = 0.5;
    });
}

fn strangers(all: &mut List<'_>) {
    all.walks("remote-control", "200 pulses of 1 to 200 us a second, at random", 30.0, |take| {
        take.scene.interference.rate_per_s = 200.0;
    });
    all.walks("remote-control-500", "500 of them a second", 30.0, |take| {
        take.scene.interference.rate_per_s = 500.0;
    });
    // One slides over a whole half turn of the rotors, at 120 Hz over the same flashes, within its 20 s.
    for (rate, rate_hz) in [("60hz", 60.05), ("120hz", 120.1)] {
        for (long, burst_us) in [("0.25ms", 250.0), ("1ms", 1000.0)] {
            let what = format!("motion capture's strobe at {rate_hz} Hz for 20 s");
            all.walks(&format!("strobe-{rate}-{long}"), &what, 25.0, |take| {
                let first_s = settled_s(take);
                take.scene.strobes = vec![Strobe { rate_hz, burst_us, first_s, to_s: first_s + 20.0 }];
                take.due_again_s = vec![first_s + 20.0];
            });
        }
    }
}

/// To and fro in a straight line: at each end the velocity turns round at once, as no hand's does.
fn speeds(all: &mut List<'_>) {
    let Path::HandHeld { low_m, high_m, .. } = all.room.path else { return };
    for speed_m_per_s in [0.5, 1.0, 2.0] {
        let what = format!("to and fro at {speed_m_per_s} m/s, turning at once");
        all.walks(&format!("shuttle-{speed_m_per_s}mps"), &what, 30.0, |take| {
            take.scene.path = Path::Line { from_m: low_m, to_m: high_m, speed_m_per_s };
        });
    }
}

fn lines(all: &mut List<'_>) {
    for (name, line, long_s) in [
        ("stuck-high-1s", Line::StuckHigh, 1.0),
        ("stuck-high-10s", Line::StuckHigh, 10.0),
        ("stuck-low-1s", Line::StuckLow, 1.0),
        ("stuck-low-10s", Line::StuckLow, 10.0),
        ("storm-100khz", Line::Storm { hz: 100e3 }, 0.5),
        ("storm-10khz-10s", Line::Storm { hz: 10e3 }, 10.0),
        ("storm-100khz-10s", Line::Storm { hz: 100e3 }, 10.0),
    ] {
        let what = format!(
            "the line {} for {long_s} s",
            if matches!(line, Line::Storm { .. }) { "storms" } else { "is stuck" }
        );
        all.walks(name, &what, SETTLED_S + long_s + 3.0, |take| {
            let from_s = settled_s(take);
            let to_s = from_s + long_s;
            take.scene.line_faults = vec![LineFault { from_s, to_s, line }];
            take.due_again_s = vec![to_s];
        });
    }
}

fn rooms(all: &mut List<'_>) {
    all.walks("swapped", "A stands where the room file has B, and B where it has A", 20.0, |take| {
        std::mem::swap(&mut take.scene.station_a, &mut take.scene.station_b);
    });
    all.walks("swapped-known", "the same, where the room file has the stations' serial numbers", 20.0, |take| {
        std::mem::swap(&mut take.scene.station_a, &mut take.scene.station_b);
        take.knows_ids = true;
    });
    // Along the line to A and towards the mote, and turned about the upright: planes through both stations and the mote
    // stay such planes, and the rays meet as before, elsewhere. Up, and tilted: the rays no longer meet.
    for (name, by_m, turn_deg, tilt_deg) in [
        ("moved-10cm", [0.06, 0.0, 0.08], 0.0, 0.0),
        ("moved-turned-5deg", [0.0; 3], 5.0, 0.0),
        ("moved-up-10cm", [0.0, 0.1, 0.0], 0.0, 0.0),
        ("moved-tilted-5deg", [0.0; 3], 0.0, 5.0),
    ] {
        all.walks(name, "B is knocked out of its place and stays there", 20.0, |take| {
            take.scene.station_b.moved = Some(Moved { at_s: settled_s(take), by_m, turn_deg, tilt_deg });
        });
    }
    for (name, dark) in [("single-a", 1), ("single-b", 0)] {
        all.walks(name, "only one station, from cold start", 10.0, |take| {
            let scene = &mut take.scene;
            let station = if dark == 0 { &mut scene.station_a } else { &mut scene.station_b };
            station.occlusions = vec![Occlusion { from_s: 0.0, to_s: 1e9, hides: Hides::Everything }];
        });
    }
    for us in [350.0, 450.0] {
        all.walks(&format!("gap-{us}us"), "the stations flash at the end of what their cable allows", 20.0, |take| {
            take.scene.timing.sync_gap_us = us;
        });
    }
}

fn starts(all: &mut List<'_>) {
    let phase_s = |n: u32| f64::from(n) * CYCLE_S / f64::from(PHASES);
    let room = all.room;
    let late = |length_s, n: u32| {
        let mut take = take(room, length_s, 1 + u64::from(n));
        take.scene.timing.first_sync_s = LATE_FIRST_SYNC_S;
        take.first_light_s = LATE_FIRST_SYNC_S;
        take
    };
    let cold = (0..PHASES).map(|n| {
        let mut take = late(2.0, n);
        let to_s = LATE_FIRST_SYNC_S + 0.2 + phase_s(n);
        for station in [&mut take.scene.station_a, &mut take.scene.station_b] {
            station.occlusions = vec![Occlusion { from_s: 0.0, to_s, hides: Hides::Everything }];
        }
        Take { first_light_s: to_s, due_again_s: vec![to_s], ..take }
    });
    let what = "the first light in each of 64 phases of the cycle";
    all.named.push(Named { name: "cold-start".into(), what: what.into(), takes: cold.collect() });

    let wrap = (0..PHASES).map(|n| {
        let wrap_s = 1.2 + phase_s(n);
        Take { wrap_s: Some(wrap_s), due_again_s: vec![wrap_s], ..late(1.8, n) }
    });
    let what = "the counter wraps in each of 64 phases of the cycle";
    all.named.push(Named { name: "wrap".into(), what: what.into(), takes: wrap.collect() });

    let lock = (0..PHASES).map(|n| {
        let wrap_s = LATE_FIRST_SYNC_S + 0.3 * f64::from(n) / f64::from(PHASES);
        Take { wrap_s: Some(wrap_s), due_again_s: vec![LATE_FIRST_SYNC_S], ..late(1.0, n) }
    });
    let what = "the counter wraps at one of 64 moments between the first light and 0.3 s after";
    all.named.push(Named { name: "wrap-at-lock".into(), what: what.into(), takes: lock.collect() });
}

fn clocks(all: &mut List<'_>) {
    for (name, times) in [("clock-0.5x", 0.5), ("clock-1x", 1.0), ("clock-2x", 2.0)] {
        let what = format!("{times} times the nominal clock, drifting 1 % per minute");
        all.walks(name, &what, 30.0, |take| {
            let clock = &mut take.scene.clock;
            (clock.nominal_hz, clock.error, clock.drift_per_min) = (times * clock.nominal_hz, 0.0, 0.01);
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use sim::world::{EventKind, World};
    use std::collections::BTreeSet;

    #[test]
    fn every_scene_can_be_lit_and_has_a_name_of_its_own() {
        let all = all();
        for named in &all {
            assert!(!named.takes.is_empty(), "{}", named.name);
            for take in &named.takes {
                assert_eq!(take.scene.check(), Ok(()), "{}", named.name);
                assert!(take.due_again_s.iter().all(|s| s + 0.5 < take.scene.length_s), "{}", named.name);
            }
        }
        assert_eq!(all.iter().map(|named| &named.name).collect::<BTreeSet<_>>().len(), all.len());
        assert!(REASONS.iter().all(|(name, _)| all.iter().any(|named| named.name == *name)));
    }

    #[test]
    fn a_fifth_of_the_sweeps_have_company() {
        let named = all().into_iter().find(|named| named.name == "reflections").expect("it is in the list");
        let mut world = World::new(&named.takes[0].scene, named.takes[0].seed);
        world.keep_log();
        while world.next_edge().is_some() {}
        let (mut sweeps, mut accompanied, mut before, mut alone) = (0, 0, 0, 0);
        let mut slot: Vec<(bool, u64, bool)> = Vec::new();
        for event in world.take_log() {
            match event.kind {
                EventKind::Sync { .. } => {
                    let direct = slot.iter().find(|(reflected, ..)| !reflected).copied();
                    if let Some((_, at, seen)) = direct {
                        sweeps += 1;
                        // Nearer than 30 us it is the same pulse.
                        let far: Vec<_> =
                            slot.iter().filter(|(r, t, seen)| *r && *seen && at.abs_diff(*t) > 330).collect();
                        accompanied += u32::from(!far.is_empty());
                        before += u32::from(far.iter().any(|(_, t, _)| *t < at));
                        alone += u32::from(!far.is_empty() && !seen);
                    }
                    slot.clear();
                }
                EventKind::Sweep { .. } => slot.push((false, event.cycle, event.seen)),
                EventKind::Reflection { .. } => slot.push((true, event.cycle, event.seen)),
            }
        }
        let share = |n: u32, of: u32| f64::from(n) / f64::from(of);
        assert!((0.17..0.23).contains(&share(accompanied, sweeps)), "{}", share(accompanied, sweeps));
        assert!((0.3..0.7).contains(&share(before, accompanied)), "{}", share(before, accompanied));
        assert!((0.15..0.4).contains(&share(alone, accompanied)), "{}", share(alone, accompanied));
    }
}
