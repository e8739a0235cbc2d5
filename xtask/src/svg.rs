//! The picture of a run: truth and fixes over time and in the room.
//!
//! Three panels share the time axis, one for each coordinate; a fourth shows the room along the
//! axis that the path uses least, with the stations and where they look. Truth is a thin dark line,
//! fixes are dots. The file needs nothing else: no fonts, no scripts, no styles from outside.
//!
//! # What can go wrong
//! A wild fix would squeeze everything else flat, so the frame holds the truth and all but the
//! outermost hundredth of the fixes; dots beyond it are drawn on its border and counted. A long run
//! has more fixes than pixels: evenly chosen ones are drawn, which keeps the file small.

use std::fmt::Write;

use crate::quantile::quantile;
use crate::score::{FixRow, Place, Score};

const WIDTH: f64 = 1240.0;
const HEIGHT: f64 = 760.0;
/// Left edge, width, top and height of the panels over time, and the gap between them.
const TIME: (f64, f64, f64, f64, f64) = (76.0, 640.0, 104.0, 186.0, 20.0);
/// Left edge, top, width and height of the room.
const ROOM: (f64, f64, f64, f64) = (806.0, 104.0, 400.0, 598.0);
/// At most so many dots, and points of a line, in a panel.
const MOST: usize = 3000;
/// A line of truth is not drawn over gaps longer than this, seconds.
const JOIN_S: f64 = 0.25;

pub(crate) const INK: &str = "#1f2933";
pub(crate) const SOFT: &str = "#68747f";
pub(crate) const RULE: &str = "#e3e7eb";
const DOTS: &str = "#f08c4b";
const SHADE: &str = "#eef2f6";
pub(crate) const BLUE: &str = "#2b6cb0";
pub(crate) const AXES: [&str; 3] = ["x", "y", "z"];

/// A station as the picture shows it.
#[derive(Clone, Debug)]
pub struct StationMark {
    /// Its letter.
    pub name: String,
    /// Where it is, metres.
    pub position: [f64; 3],
    /// Which way it looks, of length 1.
    pub forward: [f64; 3],
}

/// A stretch of time that needs a word.
#[derive(Clone, Debug)]
pub struct Span {
    /// Where it begins and ends, seconds of mote time.
    pub seconds: [f64; 2],
    /// The word.
    pub label: String,
}

/// What to draw.
#[derive(Clone, Debug)]
pub struct Picture<'a> {
    /// Headline.
    pub title: &'a str,
    /// How good the run was.
    pub score: &'a Score,
    /// What the mote reported.
    pub fixes: &'a [FixRow],
    /// Where it was.
    pub truth: &'a [Place],
    /// The stations.
    pub stations: &'a [StationMark],
    /// Stretches of time to shade.
    pub spans: &'a [Span],
}

/// A line through points, and what it is.
#[derive(Clone, Debug)]
pub struct Curve {
    /// For the legend.
    pub name: String,
    /// Across and up.
    pub points: Vec<(f64, f64)>,
}

/// The colours of curves, in order.
const CURVES: [&str; 5] = [BLUE, DOTS, INK, "#3f9c6b", "#8b5fbf"];
/// Left edge, top, width and height of the frame of a picture of curves, and the picture's own width and height.
const PLOT: (f64, f64, f64, f64) = (76.0, 104.0, 560.0, 280.0);
const PLOT_SIZE: (f64, f64) = (664.0, 440.0);

/// Draws shares in percent, 0 to 100, against a quantity.
pub fn draw_curves(title: &str, across: &str, up: &str, curves: &[Curve]) -> String {
    let (left, top, width, height) = PLOT;
    let mut svg = String::new();
    let (all_width, all_height) = PLOT_SIZE;
    let _ = write!(
        svg,
        r##"<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {all_width} {all_height}" width="{all_width}" height="{all_height}" font-family="Helvetica, Arial, 'DejaVu Sans', sans-serif" font-size="12" fill="{INK}"><rect width="{all_width}" height="{all_height}" fill="#fff"/>"##
    );
    text(&mut svg, 28.0, 38.0, r#"font-size="19" font-weight="bold""#, title);
    let (from, to) = range(curves.iter().flat_map(|curve| &curve.points).map(|point| point.0), 0.02);
    let xs = Scale { from, to, start: left, end: left + width };
    let ys = Scale { from: 0.0, to: 105.0, start: top + height, end: top };
    for tick in ys.ticks(6.0) {
        let y = ys.at(tick);
        line(&mut svg, (left, y), (left + width, y), &format!(r#"stroke="{RULE}""#));
        text(&mut svg, left - 8.0, y + 4.0, &format!(r#"text-anchor="end" fill="{SOFT}""#), &label(tick, 0));
    }
    for tick in xs.ticks(10.0) {
        let x = xs.at(tick);
        line(&mut svg, (x, top + height), (x, top + height + 4.0), &format!(r#"stroke="{SOFT}""#));
        let words = label(tick, xs.digits(10.0));
        text(&mut svg, x, top + height + 18.0, &format!(r#"text-anchor="middle" fill="{SOFT}""#), &words);
    }
    for (n, curve) in curves.iter().enumerate() {
        let colour = CURVES[n % CURVES.len()];
        // Lines that lie on each other stay visible: the first is the widest.
        let wide = 1.2 + 1.4 * (curves.len() - n - 1) as f64;
        let mut path = String::new();
        for (k, (x, y)) in curve.points.iter().enumerate() {
            let _ = write!(path, "{}{:.1} {:.1}", if k == 0 { 'M' } else { 'L' }, xs.held(*x), ys.held(*y));
        }
        let _ = write!(
            svg,
            r#"<path d="{path}" fill="none" stroke="{colour}" stroke-width="{wide:.1}" stroke-linejoin="round" stroke-linecap="round"/>"#
        );
        let (x, y) = (left + 190.0 * (n % 3) as f64, 74.0 + 17.0 * (n / 3) as f64);
        line(&mut svg, (x, y), (x + 22.0, y), &format!(r#"stroke="{colour}" stroke-width="{wide:.1}""#));
        text(&mut svg, x + 28.0, y + 4.0, "", &curve.name);
    }
    frame(&mut svg, left, top, width, height, &format!(r#"fill="none" stroke="{SOFT}" stroke-width="0.8""#));
    let style = r#"font-size="13" text-anchor="middle""#;
    text(&mut svg, left + width / 2.0, top + height + 40.0, style, across);
    let (x, y) = (24.0, top + height / 2.0);
    text(&mut svg, x, y, &format!(r#"{style} transform="rotate(-90 {x} {y})""#), up);
    svg.push_str("</svg>\n");
    svg
}

/// A straight map from a quantity to pixels.
#[derive(Clone, Copy)]
pub(crate) struct Scale {
    pub(crate) from: f64,
    pub(crate) to: f64,
    pub(crate) start: f64,
    pub(crate) end: f64,
}

impl Scale {
    pub(crate) fn at(&self, value: f64) -> f64 {
        self.start + (value - self.from) / (self.to - self.from) * (self.end - self.start)
    }

    /// The pixel of `value`, held inside the frame.
    pub(crate) fn held(&self, value: f64) -> f64 {
        self.at(value.clamp(self.from.min(self.to), self.from.max(self.to)))
    }

    /// Round values at a pleasant distance, at most about `most` of them.
    pub(crate) fn ticks(&self, most: f64) -> Vec<f64> {
        let step = step((self.to - self.from) / most);
        let first = (self.from / step).ceil() as i64;
        let last = (self.to / step).floor() as i64;
        (first..=last).map(|n| n as f64 * step).collect()
    }

    /// Digits after the point that tell the ticks apart.
    pub(crate) fn digits(&self, most: f64) -> usize {
        (-step((self.to - self.from) / most).log10().floor()).max(0.0) as usize
    }
}

/// The least of 1, 2, 5 times a power of ten that is no less than `least`.
pub(crate) fn step(least: f64) -> f64 {
    let power = 10f64.powf(least.log10().floor());
    [1.0, 2.0, 5.0, 10.0].into_iter().map(|m| m * power).find(|s| *s >= least * 0.999).unwrap_or(10.0 * power)
}

/// The least and greatest of the values, with a margin; something sensible when there are none.
pub(crate) fn range(values: impl Iterator<Item = f64>, margin: f64) -> (f64, f64) {
    let (low, high) =
        values.filter(|v| v.is_finite()).fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
    if low > high {
        return (0.0, 1.0);
    }
    let pad = ((high - low) * margin).max(1e-3);
    (low - pad, high + pad)
}

/// At most [`MOST`] of the items, evenly chosen.
fn thin<T>(items: &[T]) -> impl Iterator<Item = &T> {
    let count = items.len().min(MOST);
    (0..count).map(move |n| &items[n * items.len() / count])
}

/// A number for people, or a dash where there is none.
pub fn figure(value: f64, digits: usize) -> String {
    if value.is_finite() { format!("{value:.digits$}") } else { "-".into() }
}

/// The value at a tick, with a true minus sign.
pub(crate) fn label(value: f64, digits: usize) -> String {
    format!("{value:.digits$}").replace('-', "\u{2212}")
}

pub(crate) fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

/// Draws the picture.
pub fn draw(picture: &Picture) -> String {
    let mut svg = String::new();
    let _ = write!(
        svg,
        r##"<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}" font-family="Helvetica, Arial, 'DejaVu Sans', sans-serif" font-size="12" fill="{INK}"><rect width="{WIDTH}" height="{HEIGHT}" fill="#fff"/>"##
    );
    heading(&mut svg, picture);
    over_time(&mut svg, picture);
    room(&mut svg, picture);
    svg.push_str("</svg>\n");
    svg
}

pub(crate) fn text(svg: &mut String, x: f64, y: f64, attributes: &str, words: &str) {
    let _ = write!(svg, r#"<text x="{x:.1}" y="{y:.1}" {attributes}>{}</text>"#, escape(words));
}

pub(crate) fn line(svg: &mut String, from: (f64, f64), to: (f64, f64), attributes: &str) {
    let _ =
        write!(svg, r#"<line x1="{:.1}" y1="{:.1}" x2="{:.1}" y2="{:.1}" {attributes}/>"#, from.0, from.1, to.0, to.1);
}

pub(crate) fn frame(svg: &mut String, x: f64, y: f64, width: f64, height: f64, attributes: &str) {
    let _ = write!(svg, r#"<rect x="{x:.1}" y="{y:.1}" width="{width:.1}" height="{height:.1}" {attributes}/>"#);
}

/// Strokes dots as points of no length with round ends: the shortest way to write them.
fn dots(svg: &mut String, points: impl Iterator<Item = (f64, f64)>, size: f64) {
    let mut path = String::new();
    for (x, y) in points {
        let _ = write!(path, "M{x:.1} {y:.1}h0");
    }
    let _ = write!(
        svg,
        r#"<path d="{path}" fill="none" stroke="{DOTS}" stroke-width="{size}" stroke-linecap="round" stroke-opacity="0.85"/>"#
    );
}

/// Draws truth as lines that break where it is unknown for long.
fn path(svg: &mut String, truth: &[Place], point: impl Fn(&Place) -> (f64, f64)) {
    let mut path = String::new();
    let mut last: Option<f64> = None;
    let mut gap = false;
    let every = truth.len().div_ceil(MOST).max(1);
    for (index, place) in truth.iter().enumerate() {
        gap |= last.is_none_or(|last| place.0 - last > JOIN_S);
        last = Some(place.0);
        if gap || index % every == 0 {
            let (x, y) = point(place);
            let _ = write!(path, "{}{x:.1} {y:.1}", if gap { 'M' } else { 'L' });
            gap = false;
        }
    }
    let _ = write!(
        svg,
        r#"<path d="{path}" fill="none" stroke="{INK}" stroke-width="0.9" stroke-linejoin="round" stroke-linecap="round"/>"#
    );
}

fn heading(svg: &mut String, picture: &Picture) {
    let score = picture.score;
    let [x, y, z] = score.mae_cm.map(|v| figure(v, 2));
    text(svg, 28.0, 38.0, r#"font-size="21" font-weight="bold""#, picture.title);
    let words = format!(
        "mean absolute error x {x}, y {y}, z {z} cm   ·   3-D: mean {}, RMS {} cm   ·   coverage {} % of {} sweeps",
        figure(score.mean3d_cm, 2),
        figure(score.rms3d_cm, 2),
        figure(100.0 * score.coverage(), 1),
        score.scored
    );
    text(svg, 28.0, 62.0, &format!(r#"font-size="14" fill="{SOFT}" xml:space="preserve""#), &words);
    // Legend, above the panels over time.
    let y = 90.0;
    line(svg, (TIME.0, y - 4.0), (TIME.0 + 26.0, y - 4.0), &format!(r#"stroke="{INK}" stroke-width="1.2""#));
    text(svg, TIME.0 + 33.0, y, "", "truth");
    dots(svg, [88.0, 96.0, 104.0].into_iter().map(|x| (TIME.0 + x, y - 4.0)), 3.4);
    let drawn = thin(picture.fixes).count();
    let count = match drawn == picture.fixes.len() {
        true => format!("{drawn} fixes"),
        false => format!("fixes, {drawn} of {} drawn", picture.fixes.len()),
    };
    text(svg, TIME.0 + 113.0, y, "", &count);
}

/// The range of one coordinate: all of the truth, and the fixes but for the outermost.
fn extent(picture: &Picture, axis: usize) -> (f64, f64) {
    let mut fixes: Vec<f64> = picture.fixes.iter().map(|fix| fix.position[axis]).collect();
    let inner = [0.005, 0.995].map(|q| quantile(&mut fixes, q));
    let truth = picture.truth.iter().map(|place| place.1[axis]);
    let (low, high) = range(truth.clone(), 0.0);
    let reach = (high - low).max(0.05);
    // Fixes may widen the frame by as much as half of what the truth needs, no more.
    let (low, high) = match picture.truth {
        [] => (f64::NEG_INFINITY, f64::INFINITY),
        _ => (low - reach / 2.0, high + reach / 2.0),
    };
    let fixes = inner.into_iter().map(|v| v.max(low).min(high)).filter(|_| !picture.fixes.is_empty());
    range(truth.chain(fixes), 0.06)
}

fn over_time(svg: &mut String, picture: &Picture) {
    let (left, width, top, height, gap) = TIME;
    let times = picture.truth.iter().map(|p| p.0).chain(picture.fixes.iter().map(|f| f.seconds));
    let (from, to) = range(times, 0.01);
    let time = Scale { from, to, start: left, end: left + width };
    let bottom = top + 3.0 * height + 2.0 * gap;
    for (axis, name) in AXES.iter().enumerate() {
        let y0 = top + axis as f64 * (height + gap);
        let (low, high) = extent(picture, axis);
        let metres = Scale { from: low, to: high, start: y0 + height, end: y0 };
        for span in picture.spans {
            let [a, b] = span.seconds.map(|s| time.held(s));
            if b > a {
                frame(svg, a, y0, b - a, height, &format!(r#"fill="{SHADE}""#));
            }
        }
        for tick in metres.ticks(5.0) {
            let y = metres.at(tick);
            line(svg, (left, y), (left + width, y), &format!(r#"stroke="{RULE}""#));
            let label = label(tick, metres.digits(5.0));
            text(svg, left - 8.0, y + 4.0, &format!(r#"text-anchor="end" fill="{SOFT}""#), &label);
        }
        for tick in time.ticks(8.0) {
            let x = time.at(tick);
            line(svg, (x, y0 + height), (x, y0 + height + 4.0), &format!(r#"stroke="{SOFT}""#));
            if axis == 2 {
                let label = label(tick, time.digits(8.0));
                text(svg, x, y0 + height + 18.0, &format!(r#"text-anchor="middle" fill="{SOFT}""#), &label);
            }
        }
        let points = thin(picture.fixes).map(|f| (time.held(f.seconds), metres.held(f.position[axis])));
        dots(svg, points, 3.4);
        path(svg, picture.truth, |p| (time.at(p.0), metres.at(p.1[axis])));
        frame(svg, left, y0, width, height, &format!(r#"fill="none" stroke="{SOFT}" stroke-width="0.8""#));
        let label = format!("{name} / m");
        let (x, y) = (24.0, y0 + height / 2.0);
        text(svg, x, y, &format!(r#"font-size="13" text-anchor="middle" transform="rotate(-90 {x} {y})""#), &label);
        let beyond = picture.fixes.iter().filter(|f| !(low..=high).contains(&f.position[axis])).count();
        let mut words = format!(
            "mean |error| {} cm, p95 {} cm",
            figure(picture.score.mae_cm[axis], 2),
            figure(picture.score.p95_cm[axis], 2)
        );
        if beyond > 0 {
            let _ = write!(words, ", {beyond} beyond the frame");
        }
        halo(svg, left + 9.0, y0 + 17.0, "", &words);
        for span in picture.spans.iter().filter(|_| axis == 0) {
            let [a, b] = span.seconds.map(|s| time.held(s));
            let style = format!(r#"fill="{SOFT}" font-size="11" text-anchor="middle""#);
            halo(svg, (a + b) / 2.0, y0 + height - 7.0, &style, &span.label);
        }
    }
    text(svg, left + width / 2.0, bottom + 37.0, r#"font-size="13" text-anchor="middle""#, "mote time / s");
}

/// Words that stay readable over what is drawn.
pub(crate) fn halo(svg: &mut String, x: f64, y: f64, attributes: &str, words: &str) {
    let style = r##"stroke="#fff" stroke-width="4" stroke-linejoin="round" paint-order="stroke""##;
    text(svg, x, y, &format!("{style} {attributes}"), words);
}

/// The two axes along which the path goes furthest.
fn widest(picture: &Picture) -> (usize, usize) {
    let spread = |axis: usize| {
        let (low, high) = if picture.truth.is_empty() {
            range(picture.fixes.iter().map(|f| f.position[axis]), 0.0)
        } else {
            range(picture.truth.iter().map(|p| p.1[axis]), 0.0)
        };
        high - low
    };
    let least = (0..3).min_by(|&a, &b| spread(a).total_cmp(&spread(b))).unwrap_or(2);
    match least {
        0 => (1, 2),
        1 => (0, 2),
        _ => (0, 1),
    }
}

fn room(svg: &mut String, picture: &Picture) {
    let (left, top, width, height) = ROOM;
    let (across, along) = widest(picture);
    // Stations are part of the room; an arrow shows where they look.
    let bounds = |axis: usize| {
        let path = extent(picture, axis);
        range(picture.stations.iter().map(|s| s.position[axis]).chain([path.0, path.1]), 0.08)
    };
    let ((x0, x1), (y0, y1)) = (bounds(across), bounds(along));
    let pixels = (width / (x1 - x0)).min(height / (y1 - y0));
    let (mx, my) = ((x0 + x1) / 2.0, (y0 + y1) / 2.0);
    let half = (width / pixels / 2.0, height / pixels / 2.0);
    let xs = Scale { from: mx - half.0, to: mx + half.0, start: left, end: left + width };
    let ys = Scale { from: my - half.1, to: my + half.1, start: top + height, end: top };
    let grid = step((2.0 * half.0).max(2.0 * half.1) / 7.0);
    let digits = (-grid.log10().floor()).max(0.0) as usize;
    let marks = |scale: &Scale| {
        let first = (scale.from / grid).ceil() as i64;
        let last = (scale.to / grid).floor() as i64;
        (first..=last).map(|n| n as f64 * grid).collect::<Vec<f64>>()
    };
    for tick in marks(&xs) {
        let x = xs.at(tick);
        line(svg, (x, top), (x, top + height), &format!(r#"stroke="{RULE}""#));
        text(svg, x, top + height + 18.0, &format!(r#"text-anchor="middle" fill="{SOFT}""#), &label(tick, digits));
    }
    for tick in marks(&ys) {
        let y = ys.at(tick);
        line(svg, (left, y), (left + width, y), &format!(r#"stroke="{RULE}""#));
        text(svg, left - 8.0, y + 4.0, &format!(r#"text-anchor="end" fill="{SOFT}""#), &label(tick, digits));
    }
    let at = |p: &[f64; 3]| (xs.held(p[across]), ys.held(p[along]));
    dots(svg, thin(picture.fixes).map(|f| at(&f.position)), 3.0);
    path(svg, picture.truth, |p| at(&p.1));
    for station in picture.stations {
        let (x, y) = at(&station.position);
        let look = (station.forward[across], -station.forward[along]);
        let size = look.0.hypot(look.1);
        if size > 0.05 {
            let (dx, dy) = (look.0 / size, look.1 / size);
            let tip = (x + 38.0 * dx, y + 38.0 * dy);
            line(svg, (x, y), tip, &format!(r#"stroke="{BLUE}" stroke-width="2""#));
            let _ = write!(
                svg,
                r#"<path d="M{:.1} {:.1}L{:.1} {:.1}L{:.1} {:.1}z" fill="{BLUE}"/>"#,
                tip.0 + 7.0 * dx,
                tip.1 + 7.0 * dy,
                tip.0 - 4.5 * dy,
                tip.1 + 4.5 * dx,
                tip.0 + 4.5 * dy,
                tip.1 - 4.5 * dx
            );
        }
        let _ =
            write!(svg, r##"<circle cx="{x:.1}" cy="{y:.1}" r="10" fill="{BLUE}" stroke="#fff" stroke-width="1.5"/>"##);
        text(svg, x, y + 4.2, r##"fill="#fff" font-weight="bold" text-anchor="middle""##, &station.name);
    }
    frame(svg, left, top, width, height, &format!(r#"fill="none" stroke="{SOFT}" stroke-width="0.8""#));
    let centre = left + width / 2.0;
    text(svg, centre, top + height + 37.0, r#"font-size="13" text-anchor="middle""#, &format!("{} / m", AXES[across]));
    let (x, y) = (left - 46.0, top + height / 2.0);
    text(
        svg,
        x,
        y,
        &format!(r#"font-size="13" text-anchor="middle" transform="rotate(-90 {x} {y})""#),
        &format!("{} / m", AXES[along]),
    );
    let caption = format!("the room seen along its {} axis; stations and where they look", AXES[3 - across - along]);
    text(svg, left, 90.0, "", &caption);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::score::tests::fix;

    fn walk(count: u64) -> (Vec<FixRow>, Vec<Place>) {
        let at = |t: f64| [t.sin(), 1.0 + 0.1 * (3.0 * t).cos(), 0.5 * t.cos()];
        let fixes = (0..count).map(|n| fix(n * 8_333, at(n as f64 * 8_333e-6))).collect();
        let truth = (0..count).map(|n| (n as f64 * 8_333e-6, at(n as f64 * 8_333e-6))).collect();
        (fixes, truth)
    }

    fn drawn(fixes: &[FixRow], truth: &[Place]) -> String {
        let score = Score::of_errors(1, &[]);
        let stations = [StationMark { name: "A".into(), position: [0.0, 1.0, 2.0], forward: [0.0, 0.0, -1.0] }];
        let spans = [Span { seconds: [1.0, 2.0], label: "fitted & kept".into() }];
        draw(&Picture { title: "a < b", score: &score, fixes, truth, stations: &stations, spans: &spans })
    }

    #[test]
    fn a_long_run_stays_a_small_file() {
        let (fixes, truth) = walk(200_000);
        let svg = drawn(&fixes, &truth);
        assert!(svg.len() < 400_000, "{} bytes", svg.len());
        assert!(svg.contains("of 200000 drawn"));
    }

    #[test]
    fn nothing_to_show_is_still_a_picture() {
        for svg in [drawn(&[], &[]), drawn(&walk(1).0, &[]), drawn(&[], &walk(1).1)] {
            assert!(svg.starts_with("<svg") && svg.ends_with("</svg>\n"));
            assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        }
    }

    #[test]
    fn words_are_escaped_and_nothing_is_fetched() {
        let (fixes, truth) = walk(600);
        let svg = drawn(&fixes, &truth);
        assert!(svg.contains("a &lt; b") && svg.contains("fitted &amp; kept"));
        assert!(!svg.contains("href") && !svg.contains("url("));
    }

    #[test]
    fn the_room_is_seen_along_the_axis_that_varies_least() {
        let (fixes, truth) = walk(600);
        assert!(drawn(&fixes, &truth).contains("along its y axis"));
    }

    #[test]
    fn curves_go_through_their_points_and_say_what_they_are() {
        let curve = Curve { name: "a & b".into(), points: vec![(0.0, 0.0), (1.0, 105.0)] };
        let svg = draw_curves("t", "x", "y", &[curve]);
        // 2 % of the range on either side.
        let (left, top, width, height) = PLOT;
        let at = |part: f64| left + width * (part + 0.02) / 1.04;
        let path = format!("M{:.1} {:.1}L{:.1} {top:.1}", at(0.0), top + height, at(1.0));
        assert!(svg.contains(&path) && svg.contains("a &amp; b"), "{path} {svg}");
        assert!(svg.ends_with("</svg>\n") && !draw_curves("", "", "", &[]).contains("NaN"));
    }

    #[test]
    fn steps_are_round() {
        for (least, round) in [(0.9, 1.0), (1.1, 2.0), (0.03, 0.05), (60.0, 100.0), (5.0, 5.0)] {
            assert!((step(least) - round).abs() < 1e-9 * round, "{least} {}", step(least));
        }
    }
}
