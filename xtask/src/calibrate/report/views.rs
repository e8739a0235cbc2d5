//! The room from its three sides, for print and for those without scripts.
//!
//! What can go wrong: a station far away makes the path small; that is how far away it is.

use std::fmt::Write;

use super::residuals::open;
use super::{MOST, Report, rays, thin};
use crate::svg::{AXES, BLUE, INK, RULE, SOFT, Scale, frame, label, line, range, step, text};

/// Of station B; A's is blue.
const GREEN: &str = "#2f855a";
/// A path is not joined over more than this part of the room: it was lost in between.
const JUMP: f64 = 0.08;

/// Where a panel stands and what it shows.
pub(super) struct Panel {
    pub(super) across: usize,
    pub(super) along: usize,
    pub(super) xs: Scale,
    pub(super) ys: Scale,
    left: f64,
    top: f64,
    width: f64,
    height: f64,
}

/// Left edges and side of three panels in a row.
const LEFT: [f64; 3] = [52.0, 412.0, 772.0];
const SIDE: f64 = 276.0;
/// Which coordinates each of the three shows: across, along.
const SIDES: [(usize, usize); 3] = [(0, 1), (0, 2), (1, 2)];
/// Height of the whole row.
pub(super) const HEIGHT: f64 = 30.0 + SIDE + 44.0;
pub(super) const WIDTH: f64 = 1056.0;

/// Three panels with one scale for all, that hold the box from `min` to `max`.
pub(super) fn panels(min: [f64; 3], max: [f64; 3]) -> [Panel; 3] {
    let size = (0..3).map(|k| max[k] - min[k]).fold(1e-3, f64::max);
    let middle: [f64; 3] = std::array::from_fn(|k| (min[k] + max[k]) / 2.0);
    let top = 30.0;
    std::array::from_fn(|n| {
        let ((across, along), left) = (SIDES[n], LEFT[n]);
        let scale = |k: usize, start: f64, end: f64| Scale {
            from: middle[k] - size / 2.0,
            to: middle[k] + size / 2.0,
            start,
            end,
        };
        let (xs, ys) = (scale(across, left, left + SIDE), scale(along, top + SIDE, top));
        Panel { across, along, xs, ys, left, top, width: SIDE, height: SIDE }
    })
}

impl Panel {
    pub(super) fn at(&self, p: &[f64; 3]) -> (f64, f64) {
        (self.xs.at(p[self.across]), self.ys.at(p[self.along]))
    }

    pub(super) fn grid(&self, svg: &mut String) {
        let size = self.xs.to - self.xs.from;
        let step = step(size / 6.0);
        let digits = (-step.log10().floor()).max(0.0) as usize;
        let marks = |scale: &Scale| {
            let (first, last) = ((scale.from / step).ceil() as i64, (scale.to / step).floor() as i64);
            (first..=last).map(|n| n as f64 * step).collect::<Vec<f64>>()
        };
        for tick in marks(&self.xs) {
            let x = self.xs.at(tick);
            line(svg, (x, self.top), (x, self.top + self.height), &format!(r#"stroke="{RULE}""#));
            let style = format!(r#"text-anchor="middle" fill="{SOFT}""#);
            text(svg, x, self.top + self.height + 16.0, &style, &label(tick, digits));
        }
        for tick in marks(&self.ys) {
            let y = self.ys.at(tick);
            line(svg, (self.left, y), (self.left + self.width, y), &format!(r#"stroke="{RULE}""#));
            let style = format!(r#"text-anchor="end" fill="{SOFT}""#);
            text(svg, self.left - 7.0, y + 4.0, &style, &label(tick, digits));
        }
    }

    pub(super) fn path(&self, svg: &mut String, report: &Report) {
        let mut drawn = String::new();
        let jump = JUMP * (self.xs.to - self.xs.from);
        let mut last: Option<[f64; 3]> = None;
        for place in thin(report.path, MOST) {
            let far = last.is_none_or(|last| (0..3).any(|k| (place[k] - last[k]).abs() > jump));
            let (x, y) = self.at(place);
            let _ = write!(drawn, "{}{x:.1} {y:.1}", if far || report.places { 'M' } else { 'L' });
            if report.places {
                drawn.push_str("h0");
            }
            last = Some(*place);
        }
        let width = if report.places { 5.0 } else { 0.8 };
        let _ = write!(
            svg,
            r#"<path d="{drawn}" fill="none" stroke="{INK}" stroke-width="{width}" stroke-linejoin="round" stroke-linecap="round"/>"#
        );
    }

    pub(super) fn border(&self, svg: &mut String, words: &str) {
        let style = format!(r#"fill="none" stroke="{SOFT}" stroke-width="0.8""#);
        frame(svg, self.left, self.top, self.width, self.height, &style);
        let middle = r#"font-size="13" text-anchor="middle""#;
        let name = |k: usize| format!("{} / m", AXES[k]);
        text(svg, self.left + self.width / 2.0, self.top + self.height + 36.0, middle, &name(self.across));
        let (x, y) = (self.left - 38.0, self.top + self.height / 2.0);
        text(svg, x, y, &format!(r#"{middle} transform="rotate(-90 {x} {y})""#), &name(self.along));
        text(svg, self.left, self.top - 10.0, r#"font-size="13""#, words);
    }
}

/// Stations, path, rays and volume.
pub(super) fn sides(report: &Report) -> String {
    let mut svg = open(WIDTH, HEIGHT);
    let volume = report.room.held.volume;
    let bounds: [(f64, f64); 3] = std::array::from_fn(|k| {
        let places = report.path.iter().map(|place| place[k]);
        range(places.chain(report.stations.iter().map(|s| s.position[k])).chain([volume.min[k], volume.max[k]]), 0.07)
    });
    for panel in panels(bounds.map(|b| b.0), bounds.map(|b| b.1)) {
        panel.grid(&mut svg);
        let (low, high) = (panel.at(&volume.min), panel.at(&volume.max));
        let style = format!(r#"fill="none" stroke="{SOFT}" stroke-dasharray="5 4""#);
        frame(&mut svg, low.0, high.1, high.0 - low.0, low.1 - high.1, &style);
        for (station, colour) in [BLUE, GREEN].into_iter().enumerate() {
            for [from, to] in rays(report, station) {
                let style = format!(r#"stroke="{colour}" stroke-width="0.6" stroke-opacity="0.45""#);
                line(&mut svg, panel.at(&from), panel.at(&to), &style);
            }
        }
        panel.path(&mut svg, report);
        for ((station, colour), name) in report.stations.iter().zip([BLUE, GREEN]).zip(["A", "B"]) {
            let (x, y) = panel.at(&station.position.into());
            let forward = station.rotation.row(2);
            let (dx, dy) = (forward[panel.across], -forward[panel.along]);
            line(&mut svg, (x, y), (x + 34.0 * dx, y + 34.0 * dy), &format!(r#"stroke="{colour}" stroke-width="2.5""#));
            let _ = write!(
                svg,
                r##"<circle cx="{x:.1}" cy="{y:.1}" r="9" fill="{colour}" stroke="#fff" stroke-width="1.5"/>"##
            );
            text(&mut svg, x, y + 4.2, r##"fill="#fff" font-weight="bold" text-anchor="middle""##, name);
        }
        panel.border(&mut svg, &format!("along {}", AXES[3 - panel.across - panel.along]));
    }
    svg + "</svg>"
}
