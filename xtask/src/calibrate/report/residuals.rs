//! How far the measured angles are from the solved room's.
//!
//! What can go wrong: nothing to draw; the frames are then empty.

use std::fmt::Write;

use super::super::session::{PLACE_S, ROTORS};
use super::super::solve::Residual;
use super::{Look, MOST, Report, looks, thin};
use crate::quantile::quantile;
use crate::svg::{BLUE, INK, RULE, SOFT, Scale, frame, halo, label, line, range, text};

const WIDTH: f64 = 1056.0;
/// Height of a rotor's row and the gap to the next.
const ROW: (f64, f64) = (104.0, 14.0);
/// Left edge and width of the panel over time, and of the histogram.
const TIME: (f64, f64) = (84.0, 720.0);
const HISTOGRAM: (f64, f64) = (826.0, 214.0);
/// Bars of a histogram.
const BARS: usize = 41;
pub(super) const RED: &str = "#d64545";
pub(super) const ORANGE: &str = "#f08c4b";

/// Opens a picture.
pub(super) fn open(width: f64, height: f64) -> String {
    format!(
        r##"<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" font-family="Helvetica, Arial, 'DejaVu Sans', sans-serif" font-size="12" fill="{INK}">"##
    )
}

/// Dots, each a line of no length with round ends.
pub(super) fn dots(svg: &mut String, points: impl Iterator<Item = (f64, f64)>, size: f64, colour: &str) {
    let mut path = String::new();
    for (x, y) in points {
        let _ = write!(path, "M{x:.1} {y:.1}h0");
    }
    if !path.is_empty() {
        let _ = write!(
            svg,
            r#"<path d="{path}" fill="none" stroke="{colour}" stroke-width="{size}" stroke-linecap="round"/>"#
        );
    }
}

/// Residuals over time and how often each, one row per rotor.
pub(super) fn over_time(report: &Report) -> String {
    let top = 10.0;
    let height = top + 4.0 * (ROW.0 + ROW.1) + 36.0;
    let mut svg = open(WIDTH, height);
    let (from, to) = range(report.residuals.iter().map(|r| r.at_s), 0.01);
    let time = Scale { from, to, start: TIME.0, end: TIME.0 + TIME.1 };
    for (index, name) in ROTORS.iter().enumerate() {
        let mine: Vec<&Residual> = report.residuals.iter().filter(|r| 2 * r.station + r.axis == index).collect();
        let degrees = |r: &&Residual| r.residual.to_degrees();
        let mut kept: Vec<f64> = mine.iter().filter(|r| r.kept).map(|r| degrees(r).abs()).collect();
        let reach = quantile(&mut kept, 0.995).max(0.01) * 1.3;
        let reach = if reach.is_finite() { reach } else { 1.0 };
        let y0 = top + index as f64 * (ROW.0 + ROW.1);
        let y = Scale { from: -reach, to: reach, start: y0 + ROW.0, end: y0 };
        for tick in y.ticks(4.0) {
            let at = y.at(tick);
            for (left, width) in [TIME, HISTOGRAM] {
                line(&mut svg, (left, at), (left + width, at), &format!(r#"stroke="{RULE}""#));
            }
            let words = label(tick, y.digits(4.0));
            text(&mut svg, TIME.0 - 8.0, at + 4.0, &format!(r#"text-anchor="end" fill="{SOFT}""#), &words);
        }
        for (tick, words) in ticks(report, &time) {
            let x = time.at(tick);
            line(&mut svg, (x, y0 + ROW.0), (x, y0 + ROW.0 + 4.0), &format!(r#"stroke="{SOFT}""#));
            if index == 3 {
                text(&mut svg, x, y0 + ROW.0 + 18.0, &format!(r#"text-anchor="middle" fill="{SOFT}""#), &words);
            }
        }
        for (kept, colour, size) in [(true, BLUE, 2.4), (false, RED, 3.2)] {
            let of: Vec<&&Residual> = mine.iter().filter(|r| r.kept == kept).collect();
            dots(&mut svg, thin(&of, MOST).map(|r| (time.held(r.at_s), y.held(degrees(r)))), size, colour);
        }
        histogram(&mut svg, &mine, &y, y0);
        for (left, width) in [TIME, HISTOGRAM] {
            frame(&mut svg, left, y0, width, ROW.0, &format!(r#"fill="none" stroke="{SOFT}" stroke-width="0.8""#));
        }
        let (x, middle) = (26.0, y0 + ROW.0 / 2.0);
        let turned = format!(r#"font-size="13" text-anchor="middle" transform="rotate(-90 {x} {middle})""#);
        text(&mut svg, x, middle, &turned, &format!("{name} / deg"));
        let away = mine.iter().filter(|r| !r.kept).count();
        halo(&mut svg, TIME.0 + 8.0, y0 + 16.0, "", &format!("{} kept, {away} turned away", mine.len() - away));
    }
    let bottom = top + 4.0 * (ROW.0 + ROW.1) + 30.0;
    let middle = r#"font-size="13" text-anchor="middle""#;
    text(
        &mut svg,
        TIME.0 + TIME.1 / 2.0,
        bottom,
        middle,
        if report.places { "places, in the order of the list" } else { "mote time / s" },
    );
    let counted = if report.places { "averages" } else { "sweeps" };
    text(&mut svg, HISTOGRAM.0 + HISTOGRAM.1 / 2.0, bottom, middle, counted);
    svg + "</svg>"
}

/// Where the axis of time is marked, and how: places have numbers.
fn ticks(report: &Report, time: &Scale) -> Vec<(f64, String)> {
    if !report.places {
        return time.ticks(9.0).into_iter().map(|tick| (tick, label(tick, time.digits(9.0)))).collect();
    }
    let places = (time.to / PLACE_S).max(0.0) as usize + 1;
    (0..places).map(|place| (PLACE_S * place as f64, (place + 1).to_string())).collect()
}

fn histogram(svg: &mut String, mine: &[&Residual], y: &Scale, y0: f64) {
    let mut counts = [[0usize; BARS]; 2];
    for residual in mine {
        let part = (residual.residual.to_degrees() - y.from) / (y.to - y.from);
        let bar = (part * BARS as f64).floor().clamp(0.0, (BARS - 1) as f64) as usize;
        counts[usize::from(!residual.kept)][bar] += 1;
    }
    let most = (0..BARS).map(|bar| counts[0][bar] + counts[1][bar]).max().unwrap_or(0).max(1);
    let x = Scale { from: 0.0, to: most as f64 * 1.06, start: 0.0, end: HISTOGRAM.1 };
    let high = ROW.0 / BARS as f64;
    for (bar, (kept, away)) in counts[0].iter().zip(&counts[1]).enumerate() {
        let [kept, away] = [kept, away].map(|count| x.at(*count as f64));
        let at = y0 + ROW.0 - (bar + 1) as f64 * high;
        for (left, width, colour) in [(0.0, kept, BLUE), (kept, away, RED)] {
            if width > 0.0 {
                frame(svg, HISTOGRAM.0 + left, at, width, high - 0.3, &format!(r#"fill="{colour}""#));
            }
        }
    }
    let style = format!(r#"fill="{SOFT}" text-anchor="end""#);
    halo(svg, HISTOGRAM.0 + HISTOGRAM.1 - 6.0, y0 + 16.0, &style, &format!("most {most}"));
}

/// Measured and predicted angles in the image plane of each station.
pub(super) fn image_planes(report: &Report) -> String {
    const SIDE: f64 = 440.0;
    const LEFT: [f64; 2] = [70.0, 600.0];
    const TOP: f64 = 26.0;
    let mut svg = open(WIDTH, TOP + SIDE + 44.0);
    for (station, left) in LEFT.into_iter().enumerate() {
        let looks: Vec<Look> = looks(report.residuals, station);
        let kept: Vec<Look> = looks.iter().copied().filter(Look::kept).collect();
        let degrees = |r: &Residual| [r.measured.to_degrees(), r.predicted.to_degrees()];
        let bounds = |angles: &dyn Fn(&Look) -> [f64; 2]| range(kept.iter().flat_map(angles), 0.06);
        let (x, y) = (bounds(&|look| degrees(look.az)), bounds(&|look| degrees(look.el)));
        // One scale for both axes: an image has no stretch.
        let half = ((x.1 - x.0).max(y.1 - y.0) / 2.0).max(0.5);
        let centred = |(low, high): (f64, f64)| ((low + high) / 2.0 - half, (low + high) / 2.0 + half);
        let (x, y) = (centred(x), centred(y));
        let xs = Scale { from: x.0, to: x.1, start: left, end: left + SIDE };
        let ys = Scale { from: y.0, to: y.1, start: TOP + SIDE, end: TOP };
        for tick in xs.ticks(8.0) {
            let at = xs.at(tick);
            line(&mut svg, (at, TOP), (at, TOP + SIDE), &format!(r#"stroke="{RULE}""#));
            let words = label(tick, xs.digits(8.0));
            text(&mut svg, at, TOP + SIDE + 16.0, &format!(r#"text-anchor="middle" fill="{SOFT}""#), &words);
        }
        for tick in ys.ticks(8.0) {
            let at = ys.at(tick);
            line(&mut svg, (left, at), (left + SIDE, at), &format!(r#"stroke="{RULE}""#));
            let words = label(tick, ys.digits(8.0));
            text(&mut svg, left - 8.0, at + 4.0, &format!(r#"text-anchor="end" fill="{SOFT}""#), &words);
        }
        let most = MOST / 3;
        let at = |look: &Look, which: usize| (xs.held(degrees(look.az)[which]), ys.held(degrees(look.el)[which]));
        let mut path = String::new();
        for look in thin(&kept, most) {
            let (measured, predicted) = (at(look, 0), at(look, 1));
            let _ = write!(path, "M{:.1} {:.1}L{:.1} {:.1}", measured.0, measured.1, predicted.0, predicted.1);
        }
        let _ = write!(svg, r#"<path d="{path}" fill="none" stroke="{SOFT}" stroke-width="0.6"/>"#);
        // A ring: a blue dot with a white one on it.
        dots(&mut svg, thin(&kept, most).map(|look| at(look, 0)), 6.4, BLUE);
        dots(&mut svg, thin(&kept, most).map(|look| at(look, 0)), 4.4, "#fff");
        dots(&mut svg, thin(&kept, most).map(|look| at(look, 1)), 2.6, ORANGE);
        frame(&mut svg, left, TOP, SIDE, SIDE, &format!(r#"fill="none" stroke="{SOFT}" stroke-width="0.8""#));
        let name = ["A", "B"][station];
        let shown = kept.len().min(most);
        let heading =
            format!("station {name}: {shown} of {} looks, {} more turned away", kept.len(), looks.len() - kept.len());
        text(&mut svg, left, TOP - 10.0, r#"font-size="13""#, &heading);
        let middle = r#"font-size="13" text-anchor="middle""#;
        text(&mut svg, left + SIDE / 2.0, TOP + SIDE + 36.0, middle, "measured azimuth / deg");
        let (x, y) = (left - 46.0, TOP + SIDE / 2.0);
        text(&mut svg, x, y, &format!(r#"{middle} transform="rotate(-90 {x} {y})""#), "measured elevation / deg");
    }
    svg + "</svg>"
}
