//! How many motes a channel carries, how often each may report, and what is lost.
//!
//! The frames have the library's lengths and the channel is that of [`air`]; [`sending`] says when motes have something
//! to send. The 2020 paper's way, four raw timings for each fix that a PC then computes, goes beside.
//!
//! What can go wrong: the air of a real room is shared with Wi-Fi and has walls; this is the bound that no tuning of the
//! radio gets beyond, but for capture, which lets the louder of two frames live.

pub mod air;
#[path = "../../src/bin/nrf52840/csma.rs"]
mod csma;
pub mod firmware;
pub mod sending;

use std::fmt::Write as _;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use clap::Args;
use lighthouse_mote::frame::{ANGLES_LEN, HEALTH_LEN, LEN};
use serde_json::json;

use crate::calib::schema::SEALED_HALF_TURNS;
use crate::flash::image;
use crate::svg::{Curve, draw_curves};
use crate::trust;
use crate::whole;
use air::{Sent, air_time};
use sending::{Policy, RAW_LEN, Swarm};

/// What may be said to `cargo xtask swarm`.
#[derive(Args, Debug, Clone)]
pub struct Arguments {
    /// Motes in the room
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub motes: u32,
    /// Rooms to average over: motes stand elsewhere in each
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub rooms: u32,
    /// Seconds in each room
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u32).range(4..=3600))]
    pub seconds: u32,
    /// Run the image that is flashed instead, in so many virtual motes of one room: steady, slotted, slotted with a key
    #[arg(long, value_name = "MOTES", value_parser = clap::value_parser!(u16).range(2..=32))]
    pub firmware: Option<u16>,
    /// Half turns from one report of the firmware's to the next: no less than two a mote [default: that, and at least 8]
    #[arg(long, value_name = "HALF_TURNS", requires = "firmware", value_parser = clap::value_parser!(u16).range(2..=358))]
    pub every: Option<u16>,
    /// Where the pictures go
    #[arg(long, default_value = "target/swarm")]
    pub out: PathBuf,
}

/// A report every so many half turns: 30, 15, 10, 5, 2 and 1 a second.
const RATES: [u16; 6] = [4, 8, 12, 24, 60, 120];
/// The rate of a mote that nobody told otherwise.
const USUAL: u16 = 8;
/// What may be lost where the question is how many motes there may be.
const BEARABLE: f64 = 0.05;
/// No more motes are asked for.
const MOST: u32 = 1000;

/// A way to send: when, and whether the channel is listened to first.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Way {
    /// When.
    pub policy: Policy,
    /// As the nRF52840 does. The SCuM-3C's firmware has no receiver.
    pub listens: bool,
}

/// The ways, and how the table calls them.
pub const WAYS: [(&str, Way); 6] = [
    ("raw", Way { policy: Policy::Raw, listens: false }),
    ("steady", Way { policy: Policy::Steady, listens: false }),
    ("jittered", Way { policy: Policy::Jittered, listens: false }),
    ("slotted", Way { policy: Policy::Slotted, listens: false }),
    ("steady CSMA", Way { policy: Policy::Steady, listens: true }),
    ("slotted CSMA", Way { policy: Policy::Slotted, listens: true }),
];

/// What came of a swarm.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Loss {
    /// Of all fixes, the share that did not come through.
    pub mean: f64,
    /// The same of the mote that fared worst.
    pub worst: f64,
    /// The share of the time that the channel was in use, overlaps counted twice.
    pub load: f64,
}

/// Lets a swarm send.
#[must_use]
pub fn lose(swarm: &Swarm, listens: bool) -> Loss {
    let wishes = swarm.wishes();
    let sent = if listens { air::listening(wishes) } else { air::unheard(wishes) };
    judge(&sent, swarm)
}

fn judge(sent: &[Sent], swarm: &Swarm) -> Loss {
    // A fix is there when all of its frames are.
    let fixes = sent.iter().filter_map(|sent| sent.wish.fix).max().map_or(0, |last| last as usize + 1);
    let mut whole = vec![true; fixes];
    let mut whose = vec![0; fixes];
    let mut on_air = 0;
    for Sent { wish, from, received } in sent {
        if from.is_some() {
            on_air += wish.lasts;
        }
        if let Some(fix) = wish.fix {
            whole[fix as usize] &= received;
            whose[fix as usize] = wish.mote as usize;
        }
    }
    let mut motes = vec![(0u32, 0u32); swarm.motes as usize];
    for (whole, mote) in whole.iter().zip(whose) {
        motes[mote].0 += u32::from(!whole);
        motes[mote].1 += 1;
    }
    let share = |(lost, all): (u32, u32)| if all == 0 { 0.0 } else { f64::from(lost) / f64::from(all) };
    let sum = motes.iter().fold((0, 0), |sum, mote| (sum.0 + mote.0, sum.1 + mote.1));
    Loss {
        mean: share(sum),
        worst: motes.iter().map(|mote| share(*mote)).fold(0.0, f64::max),
        load: on_air as f64 / (f64::from(swarm.seconds) * 1e9),
    }
}

impl Arguments {
    /// The mean over the rooms.
    fn mean(&self, motes: u32, every: u16, way: Way) -> Loss {
        let mut mean = Loss::default();
        let share = 1.0 / f64::from(self.rooms);
        for seed in 0..u64::from(self.rooms) {
            let swarm = Swarm {
                motes,
                every,
                policy: way.policy,
                seconds: self.seconds,
                seed,
                is_sealed: false,
                counts: false,
            };
            let loss = lose(&swarm, way.listens);
            mean.mean += loss.mean * share;
            mean.worst += loss.worst * share;
            mean.load += loss.load * share;
        }
        mean
    }

    /// The most motes of which [`BEARABLE`] is lost at the most.
    fn most(&self, every: u16, way: Way) -> u32 {
        let bears = |motes: u32| self.mean(motes, every, way).mean <= BEARABLE;
        let (mut good, mut bad) = (1, 2);
        while bad <= MOST && bears(bad) {
            (good, bad) = (bad, bad * 2);
        }
        bad = bad.min(MOST + 1);
        while bad - good > 1 {
            let middle = good.midpoint(bad);
            if bears(middle) { good = middle } else { bad = middle }
        }
        good
    }
}

/// Says how many motes a channel carries. `build` makes the SCuM-3C's image with these lines under `[mote]`.
///
/// # Errors
/// The picture cannot be written, or the firmware's slots do not hold what they promise.
pub fn swarm(arguments: &Arguments, build: &dyn Fn(&str) -> Result<Vec<u8>>) -> Result<()> {
    if let Some(motes) = arguments.firmware {
        return firmware_in_one_room(motes, arguments.every, &arguments.out, build);
    }
    let tables = tables(arguments);
    print!("{tables}");
    let counting = counting(arguments.rooms);
    print!("\n{counting}");
    let motes = [1, 2, 3, 4, 5, 6, 7, 8, 10, 12, 14, 16, 20, 24, 28, 32];
    let curve = |name: &str, way: Way| Curve {
        name: name.to_string(),
        points: motes.map(|n| (f64::from(n), 100.0 * arguments.mean(n, USUAL, way).mean)).to_vec(),
    };
    let curves: Vec<Curve> =
        WAYS.iter().filter(|(name, _)| *name != "slotted CSMA").map(|(name, way)| curve(name, *way)).collect();
    let title = "Fixes lost on one channel, 15 fixes a second each";
    let svg = draw_curves(title, "motes in the room", "fixes lost / %", &curves);
    let path = arguments.out.join("loss.svg");
    std::fs::create_dir_all(&arguments.out).with_context(|| arguments.out.display().to_string())?;
    std::fs::write(&path, svg).with_context(|| path.display().to_string())?;
    ensure!(path.is_file(), "{}: not written", path.display());
    let Arguments { motes, rooms, seconds, .. } = arguments;
    let summary = json!({ "motes": motes, "rooms": rooms, "seconds": seconds, "tables": tables, "counting": counting });
    whole::json(&arguments.out.join("summary.json"), &summary)?;
    println!("\nwritten to {}: loss.svg summary.json", arguments.out.display());
    Ok(())
}

/// Half a minute of the virtual motes' time.
const FIRMWARE_S: f64 = 30.0;
/// Where a rate is asked for: so long that each mote counts its oscillators, and twice at most.
const COUNTED_S: f64 = 62.0;

/// As many motes as `every` has slots for with room between: nothing may be lost that is slotted, whether it has to be
/// sealed first or not; but where a report is due while the oscillators are counted, what that moves.
fn firmware_in_one_room(
    motes: u16,
    every: Option<u16>,
    out: &Path,
    build: &dyn Fn(&str) -> Result<Vec<u8>>,
) -> Result<()> {
    let is_asked = every.is_some();
    let seconds = if is_asked { COUNTED_S } else { FIRMWARE_S };
    let out = out.join(every.map_or("firmware".to_string(), |every| format!("firmware-{every}")));
    let every = every.unwrap_or((2 * motes).max(USUAL));
    ensure!(every >= 2 * motes, "--every {every}: {motes} motes need {} half turns, two each", 2 * motes);
    let key_file = tempfile::NamedTempFile::new().context("a file for a key")?;
    std::fs::write(key_file.path(), "0f1e2d3c4b5a69788796a5b4c3d2e1f0\n").context("a key")?;
    let with_key = format!("key_file = {:?}\n", key_file.path());
    // Whoever names a key wants to see it everywhere.
    let own = trust::key_of_environment()?;
    let any = own.map_or_else(|| trust::key(key_file.path()), Ok)?;
    let ways = [
        ("steady", "steady", "", own),
        ("slotted", "slotted", "", own),
        ("slotted with a key", "slotted", with_key.as_str(), Some(any)),
    ];
    let ways = ways.into_iter().filter(|(.., lines, _)| lines.is_empty() || every >= SEALED_HALF_TURNS);
    let mut found = Vec::new();
    let mut bytes = serde_json::Map::new();
    for (name, send, lines, key) in ways {
        let elf = build(&format!("send = \"{send}\"\nreport_every_half_turns = {every}\n{lines}"))?;
        let heard =
            firmware::run(&elf, key, motes, every, seconds, |id| println!("{name}: virtual mote {id} has run"))?;
        found.push((name, send, heard));
        bytes.insert(name.to_string(), image::package(&elf)?.length().into());
    }
    let mut table = format!("{motes} virtual motes in one room, a report every {every} half turns, {seconds} s\n");
    for (name, _, heard) in &found {
        let firmware::Heard { fixes, others, lost, late } = heard;
        // None is at the usual rates; it is looked for where somebody asks for others.
        let late = if is_asked { format!(", {late} times one waited for a count") } else { String::new() };
        let _ = writeln!(
            table,
            "{name:>18}: {fixes} fixes and {others} health frames on the air, {lost} of them overlapped{late}"
        );
    }
    print!("\n{table}");
    let size = |name: &str| bytes[name].as_u64().unwrap_or_default() as i64;
    let more = size("slotted") - size("steady");
    let summary = json!({ "motes": motes, "table": table, "image_bytes": bytes, "slotted_less_steady_bytes": more });
    whole::json(&out.join("summary.json"), &summary)?;
    // A mote counts twice in so long at most; what it moves by less than seven half turns may overlap as many others and a health
    // frame.
    let moved = if every < COUNTED_HALF_TURNS { COUNTED_HALF_TURNS.div_ceil(every) } else { 0 };
    let bearable = usize::from(motes * if moved > 0 { 2 * (2 * moved + 1) } else { 0 });
    for (name, send, heard) in found {
        ensure!(
            send != "slotted" || heard.lost <= bearable,
            "{name}: {} frames overlapped, and no more than {bearable} may",
            heard.lost
        );
    }
    Ok(())
}

/// How long a SCuM-3C that counts its oscillators sends nothing, half turns from its report before: one and a half for
/// that and the health frame, less where the next one's laser passes earlier, and the six of the count.
const COUNTED_HALF_TURNS: u16 = 7;
/// Reports so often that some fall into it, and the first that does not.
const SHORT: RangeInclusive<u16> = 2..=8;

/// What is lost because a SCuM-3C counts its oscillators once a minute: slotted, some slots taken or all.
#[must_use]
pub fn counting(rooms: u32) -> String {
    /// Each mote counts twice.
    const COUNTS: u64 = 2;
    let seconds = COUNTS * sending::COUNTED_EVERY;
    let mut text = format!(
        "what a SCuM-3C's count of its oscillators costs, slotted, {rooms} rooms, {seconds} s each\n\
         {:>10} {:>16} {:>26} {:>26}\n{:>10} {:>16} {:>10} {:>15} {:>10} {:>15}\n",
        "half turns",
        "reports moved",
        "every second slot taken",
        "every slot taken",
        "a report",
        "by a count",
        "motes",
        "lost by a count",
        "motes",
        "lost by a count"
    );
    for every in SHORT {
        let of = |motes: u32| {
            let (mut moved, mut lost) = (0, 0);
            for seed in 0..u64::from(rooms) {
                let without = Swarm {
                    motes,
                    every,
                    policy: Policy::Slotted,
                    seconds: seconds as u32,
                    seed,
                    is_sealed: false,
                    counts: false,
                };
                let (before, after) = (without.wishes(), Swarm { counts: true, ..without }.wishes());
                moved += before.iter().zip(&after).filter(|(before, after)| before.at != after.at).count();
                let fixes =
                    |sent: Vec<Sent>| sent.iter().filter(|sent| sent.wish.fix.is_some() && !sent.received).count();
                lost += fixes(air::unheard(after)) as i64 - fixes(air::unheard(before)) as i64;
            }
            let counts = (u64::from(rooms * motes) * COUNTS) as f64;
            (moved as f64 / counts, lost as f64 / counts)
        };
        let (some, all) = ((u32::from(every) / 2).max(1), u32::from(every));
        let ((moved, few), (_, many)) = (of(some), of(all));
        let _ = writeln!(text, "{every:>10} {moved:>16.2} {some:>10} {few:>15.2} {all:>10} {many:>15.2}");
    }
    text
}

/// Both tables.
#[must_use]
pub fn tables(arguments: &Arguments) -> String {
    let ms = |len: usize| air_time(len) as f64 / 1e6;
    let mut text = String::new();
    let _ = writeln!(
        text,
        "on the air: a fix {LEN} bytes, {:.2} ms; health {HEALTH_LEN} bytes, {:.2} ms, once a second; angles up to \
         {ANGLES_LEN} bytes, {:.2} ms;\nraw timings 4 packets of {RAW_LEN} bytes, 4 x {:.2} ms. 250 kbit/s, no capture.",
        ms(LEN),
        ms(HEALTH_LEN),
        ms(ANGLES_LEN),
        ms(RAW_LEN),
    );
    let head = |text: &mut String, first: &str| {
        let _ = write!(text, "{first:>9}");
        WAYS.iter().for_each(|(name, _)| {
            let _ = write!(text, " {name:>16}");
        });
        text.push('\n');
    };
    let rate = |every: u16| 120.0 / f64::from(every);
    let _ = writeln!(
        text,
        "\n{} motes: fixes lost, percent, mean and worst mote ({} rooms, {} s each)",
        arguments.motes, arguments.rooms, arguments.seconds
    );
    head(&mut text, "fixes/s");
    for every in RATES {
        let _ = write!(text, "{:>9}", rate(every));
        for (_, way) in WAYS {
            let loss = arguments.mean(arguments.motes, every, way);
            let _ = write!(text, " {:>8.1} {:>7.1}", 100.0 * loss.mean, 100.0 * loss.worst);
        }
        text.push('\n');
    }
    let _ = writeln!(text, "\nthe most motes of which {} % of the fixes are lost", 100.0 * BEARABLE);
    head(&mut text, "fixes/s");
    for every in RATES {
        let _ = write!(text, "{:>9}", rate(every));
        for (_, way) in WAYS {
            let _ = write!(text, " {:>16}", arguments.most(every, way));
        }
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn swarm(motes: u32, every: u16, policy: Policy) -> Swarm {
        Swarm { motes, every, policy, seconds: 20, seed: 7, is_sealed: false, counts: false }
    }

    #[test]
    fn half_as_many_motes_as_slots_lose_nothing_at_all() {
        // Six or seven ends of the station's frame each, where slots come early or are left out: at rates that end there
        // with half a round, with all but one half turn of it, with one.
        for every in [2, 3, 4, 5, 7, 8, 9, 12, 13, 17, 24, 25, 51, 60, 71, 119, 120, 179, 357, 358] {
            for (seed, is_sealed) in (0..3).flat_map(|seed| [(seed, false), (seed, true)]) {
                let motes = u32::from(every) / 2;
                let loss = lose(&Swarm { seed, is_sealed, ..swarm(motes, every, Policy::Slotted) }, false);
                assert_eq!(loss.mean, 0.0, "every {every}, sealed {is_sealed}: {loss:?}");
            }
        }
    }

    #[test]
    fn a_count_of_the_oscillators_moves_what_is_due_meanwhile_and_nothing_else() {
        // Behind a report and a health frame, 5.5 ms, nothing leaves for six half turns and 0.1 ms: what is due within 55.6
        // ms of that report waits, 4.2 ms less or more by where the lasers pass within 45 degrees, and 0.5 ms. One more
        // or less where the station's frame ends and slots come early or are left out.
        for (every, least, most) in [(2, 3, 3), (3, 1, 3), (4, 1, 2), (5, 1, 2), (6, 1, 2), (7, 0, 2), (8, 0, 1)] {
            for seed in 0..20 {
                let without = Swarm { seconds: 61, seed, ..swarm(1, every, Policy::Slotted) };
                let (before, after) = (without.wishes(), Swarm { counts: true, ..without }.wishes());
                let moved: Vec<_> = before.iter().zip(&after).filter(|(before, after)| before.at != after.at).collect();
                assert!((least..=most).contains(&moved.len()), "every {every}, room {seed}: {moved:?}");
                assert!(moved.iter().all(|(before, after)| (before.at..before.at + 50_100_000).contains(&after.at)));
            }
        }
        let lost = |every: u16, seed| {
            let counts = Swarm { seconds: 122, seed, ..swarm(u32::from(every) / 2, every, Policy::Slotted) };
            lose(&Swarm { counts: true, ..counts }, false).mean > 0.0
        };
        assert!((0..20).any(|seed| lost(4, seed)), "every 4: it never overlaps another");
        for every in 7..=8 {
            assert!((0..20).all(|seed| !lost(every, seed)), "every {every}");
        }
    }

    #[test]
    fn as_many_motes_as_slots_lose_next_to_nothing() {
        // Health frames run on into the next slot where the next mote's laser passes 60 degrees earlier: within 45
        // degrees of straight ahead that is one pair in 18, once a second.
        for every in [8, 12, 24] {
            let loss = lose(&swarm(every.into(), every, Policy::Slotted), false);
            assert!(loss.mean < 0.02, "{every}: {loss:?}");
        }
    }

    #[test]
    fn motes_that_count_by_themselves_may_never_be_heard() {
        let worst = |policy| {
            let rooms = (0..6).map(|seed| lose(&Swarm { seed, ..swarm(8, 8, policy) }, false).worst);
            rooms.fold(0.0, f64::max)
        };
        let (steady, jittered) = (worst(Policy::Steady), worst(Policy::Jittered));
        assert!(steady > 0.98 && jittered < 0.75, "{steady} {jittered}");
    }

    #[test]
    fn dice_lose_about_what_pure_aloha_does() {
        // 20 motes, 10 reports of 2.3 ms and one of 3.1 ms a second each. Lasers bunch up within a half turn, which
        // costs more: not beyond what beginnings in 60 % of the time would.
        let loss = lose(&swarm(20, 12, Policy::Jittered), false);
        let aloha = |load: f64| 1.0 - (-2.0 * load).exp();
        assert!((aloha(loss.load * 0.95)..aloha(loss.load / 0.6)).contains(&loss.mean), "{loss:?}");
    }

    #[test]
    fn a_fix_of_four_packets_needs_all_four() {
        let one = lose(&swarm(1, 8, Policy::Raw), false);
        assert_eq!(one.mean, 0.0);
        // Four packets of 0.54 ms are 2.2 ms, as long as a whole fix, but any of the four takes the fix along.
        let (raw, fix) = (lose(&swarm(20, 8, Policy::Raw), false), lose(&swarm(20, 8, Policy::Steady), false));
        assert!(raw.load < fix.load && raw.mean > fix.mean * 0.8, "{raw:?} {fix:?}");
    }

    #[test]
    fn the_tables_say_how_many_there_may_be() {
        let arguments = Arguments { motes: 3, rooms: 1, seconds: 4, firmware: None, every: None, out: PathBuf::new() };
        let slotted = arguments.most(8, Way { policy: Policy::Slotted, listens: false });
        assert!((8..=10).contains(&slotted), "{slotted}");
    }
}
