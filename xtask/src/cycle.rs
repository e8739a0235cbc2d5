//! The picture of one cycle: what a photodiode sees of two stations in four half turns.
//!
//! It is drawn from the light of the simulated room, so it shows what the firmware is tested with.
//!
//! What can go wrong: the light has changed and the picture in `docs` has not; a test holds them together.

use std::fmt::Write;

use sim::world::{Axis, EventKind, Scene, StationId, World};

use crate::svg::{BLUE, INK, RULE, SOFT, Scale, frame, line, text};

const WIDTH: f64 = 1120.0;
const HEIGHT: f64 = 372.0;
const ORANGE: &str = "#c05621";
/// A cycle is four half turns.
const SLOTS: usize = 4;
const SLOT_S: f64 = 1.0 / 120.0;
/// Where the stretch begins that the walk has settled, seconds.
const FROM_S: f64 = 0.5;
/// Widths of pulses are drawn so many times as wide: a flash of 0.1 ms would be a hair.
const WIDER: f64 = 6.0;
/// Baselines, top to bottom, and the height of a pulse.
const ROWS: [(f64, &str); 3] = [(150.0, "station A"), (220.0, "station B"), (300.0, "on the line")];
const TALL: f64 = 46.0;
/// Left and right edge of time.
const TIME: (f64, f64) = (110.0, 1090.0);

/// Draws it.
#[must_use]
pub fn draw() -> String {
    let mut scene = Scene { length_s: FROM_S + 0.2, ..Scene::default() };
    scene.receiver.sync_dropout = 0.0;
    scene.receiver.sweep_dropout = 0.0;
    scene.interference.rate_per_s = 0.0;
    let mut world = World::new(&scene, 1);
    world.keep_log();
    let edges: Vec<(f64, bool)> = world
        .edges()
        .map(|edge| (edge.cycle, edge.level))
        .collect::<Vec<_>>()
        .into_iter()
        .map(|(cycle, level)| (world.seconds(cycle), level))
        .collect();
    let events: Vec<(f64, EventKind)> =
        world.take_log().iter().map(|event| (world.seconds(event.cycle), event.kind)).collect();
    let start = events.iter().find(|(at, kind)| {
        *at > FROM_S && matches!(kind, EventKind::Sync { station: StationId::A, axis: Axis::Azimuth, skip: false, .. })
    });
    let start = start.map_or(FROM_S, |(at, _)| *at) - 0.0002;
    let end = start + SLOTS as f64 * SLOT_S;
    let time = Scale { from: start, to: end, start: TIME.0, end: TIME.1 };
    let pulses = pulses(&edges);

    let mut svg = String::new();
    let _ = write!(
        svg,
        r##"<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}" font-family="Helvetica, Arial, 'DejaVu Sans', sans-serif" font-size="12" fill="{INK}"><rect width="{WIDTH}" height="{HEIGHT}" fill="#fff"/>"##
    );
    text(&mut svg, 28.0, 38.0, r#"font-size="19" font-weight="bold""#, "One cycle of two stations at one photodiode");
    let words = format!("four half turns of 8.33 ms; pulses are drawn {WIDER} times as wide as they are");
    text(&mut svg, 28.0, 60.0, &format!(r#"font-size="14" fill="{SOFT}""#), &words);
    for slot in 0..=SLOTS {
        let x = time.at(start + slot as f64 * SLOT_S);
        line(&mut svg, (x, 84.0), (x, 322.0), &format!(r#"stroke="{RULE}""#));
        let words = format!("{:.1} ms", 1e3 * slot as f64 * SLOT_S);
        text(&mut svg, x, 340.0, &format!(r#"text-anchor="middle" fill="{SOFT}""#), &words);
    }
    for (y, name) in ROWS {
        line(&mut svg, (TIME.0, y), (TIME.1, y), &format!(r#"stroke="{SOFT}""#));
        text(&mut svg, TIME.0 - 10.0, y, r#"text-anchor="end""#, name);
    }
    let within = |at: f64| at >= start && at < end - 0.001;
    for (at, kind) in events.iter().filter(|event| within(event.0)) {
        let (station, colour, words) = match kind {
            EventKind::Sync { station, axis, skip, data } => {
                let who = if *skip { "skips" } else { named(*axis) };
                (station, BLUE, format!("{who}, {}", u8::from(*data)))
            }
            EventKind::Sweep { station, angle_rad, .. } => {
                (station, ORANGE, format!("{:.2}\u{b0}", angle_rad.to_degrees()).replace('-', "\u{2212}"))
            }
            EventKind::Reflection { .. } => continue,
        };
        let sweep = colour == ORANGE;
        let row = ROWS[usize::from(*station == StationId::B)].0;
        // What the line shows of it.
        let Some((from, to)) = pulses.iter().find(|pulse| pulse.1 > *at && pulse.0 < *at + 20e-6) else { continue };
        for y in [row, ROWS[2].0] {
            // The flashes of B are 0.4 ms behind those of A: wider ones would lie on each other on one line.
            let wide = (time.at(*to) - time.at(*from)) * WIDER / if y == row { 1.0 } else { 2.0 };
            frame(&mut svg, time.at(*from), y - TALL, wide.max(2.0), TALL, &format!(r#"fill="{colour}""#));
        }
        let beside = if sweep { r#"text-anchor="middle""# } else { "" };
        text(&mut svg, time.at(*from), row - TALL - 4.0, &format!(r#"{beside} fill="{colour}""#), &words);
    }
    let words = "A flash says by its width whose rotor sweeps next and one bit of data; \
                 the time from it to the sweep, over the half turn, is the angle.";
    text(&mut svg, 28.0, 362.0, &format!(r#"fill="{SOFT}""#), words);
    svg.push_str("</svg>\n");
    svg
}

const fn named(axis: Axis) -> &'static str {
    match axis {
        Axis::Azimuth => "azimuth",
        Axis::Elevation => "elevation",
    }
}

/// Rises with their falls.
fn pulses(edges: &[(f64, bool)]) -> Vec<(f64, f64)> {
    edges.windows(2).filter(|pair| pair[0].1 && !pair[1].1).map(|pair| (pair[0].0, pair[1].0)).collect()
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_picture_in_the_docs_is_what_the_simulated_room_looks_like() {
        let kept = include_str!("../../docs/cycle.svg");
        assert!(super::draw() == kept, "docs/cycle.svg is out of date; `cargo xtask pictures` draws it anew");
    }

    #[test]
    fn a_cycle_has_eight_flashes_and_four_sweeps_on_the_line() {
        let drawn = super::draw();
        // Each twice: in its station's row and on the line.
        assert_eq!(drawn.matches("<rect").count(), 1 + 2 * (8 + 4));
        assert_eq!(drawn.matches("skips").count(), 4);
    }
}
