//! How exact a place will be, over the room.
//!
//! A place follows from four angles; how much each scatters becomes, through the derivatives of the angles by the
//! place, a covariance of the place: (sum of g g^T / sigma^2)^-1. What the map shows is the root of its trace.
//!
//! What can go wrong: out of a rotor's light there is no place to be found, and on the line through both stations
//! hardly one; the first is grey, the second beyond the last colour.

use nalgebra::{Matrix3, Vector3};

use super::residuals::open;
use super::views::{HEIGHT, WIDTH, panels};
use super::{Report, sigma};
use crate::calib::schema::RoomBox;
use crate::quantile::quantile;
use crate::svg::{AXES, SOFT, frame, text};

/// Half of what a rotor lights, degrees.
const FIELD_DEG: f64 = 60.0;
/// Cells along a panel.
const CELLS: usize = 60;
/// Bounds of the colours, metres, and the colours: below the first bound the first, beyond the last the last.
const BOUNDS: [f64; 8] = [0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1];
const COLOURS: [&str; 9] =
    ["#1a6b54", "#2f9e73", "#74c69a", "#b9e3bd", "#fdf3b0", "#fbd27a", "#f5a05a", "#dd6547", "#a8323a"];
const NAMES: [&str; 9] = ["0.5 mm", "1 mm", "2 mm", "5 mm", "1 cm", "2 cm", "5 cm", "10 cm", "more"];
const DARK: &str = "#dde2e7";

/// Standard deviation of a place, all axes together, metres; none where a rotor does not shine.
pub(super) fn at(report: &Report, sigma: [f64; 4], place: Vector3<f64>) -> Option<f64> {
    let edge = FIELD_DEG.to_radians().tan();
    let mut information = Matrix3::zeros();
    for (index, station) in report.stations.iter().enumerate() {
        let c = station.rotation * (place - station.position);
        if c.z <= 0.0 || c.x.abs() > edge * c.z || c.y.abs() > edge * c.z {
            return None;
        }
        for axis in 0..2 {
            let square = c[axis] * c[axis] + c.z * c.z;
            let mut gradient = Vector3::zeros();
            gradient[axis] = c.z / square;
            gradient.z = -c[axis] / square;
            let gradient = station.rotation.transpose() * gradient;
            information += gradient * gradient.transpose() / sigma[2 * index + axis].max(1e-6).powi(2);
        }
    }
    Some(information.try_inverse().map_or(f64::INFINITY, |covariance| covariance.trace().max(0.0).sqrt()))
}

/// Three slices of the volume through the middle of the path.
pub(super) fn slices(report: &Report) -> String {
    let mut svg = open(WIDTH, HEIGHT + 44.0);
    let RoomBox { min, max } = report.room.held.volume;
    let middle: [f64; 3] = std::array::from_fn(|k| {
        let mut places: Vec<f64> = report.path.iter().map(|place| place[k]).collect();
        quantile(&mut places, 0.5)
    });
    let sigma = sigma(report.figures);
    for panel in panels(min, max) {
        let through = 3 - panel.across - panel.along;
        let size = (panel.xs.to - panel.xs.from) / CELLS as f64;
        for row in 0..CELLS {
            // A run of one colour is one rectangle.
            let mut run: Option<(f64, f64, &str)> = None;
            let y = panel.ys.from + (row as f64 + 0.5) * size;
            let high = (panel.ys.at(y + 0.5 * size) - panel.ys.at(y - 0.5 * size)).abs();
            let top = panel.ys.at(y + 0.5 * size);
            let mut close = |run: &mut Option<(f64, f64, &str)>| {
                if let Some((from, to, colour)) = run.take() {
                    frame(&mut svg, from, top, to - from, high + 0.3, &format!(r#"fill="{colour}""#));
                }
            };
            for column in 0..CELLS {
                let x = panel.xs.from + (column as f64 + 0.5) * size;
                let (from, to) = (panel.xs.at(x - 0.5 * size), panel.xs.at(x + 0.5 * size));
                let inside = (min[panel.across]..=max[panel.across]).contains(&x)
                    && (min[panel.along]..=max[panel.along]).contains(&y);
                let mut place = middle;
                place[panel.across] = x;
                place[panel.along] = y;
                let colour = inside.then(|| match at(report, sigma, place.into()) {
                    None => DARK,
                    Some(deviation) => COLOURS[BOUNDS.partition_point(|bound| *bound < deviation)],
                });
                match (&mut run, colour) {
                    (Some((_, end, before)), Some(colour)) if *before == colour => *end = to,
                    (_, colour) => {
                        close(&mut run);
                        run = colour.map(|colour| (from, to, colour));
                    }
                }
            }
            close(&mut run);
        }
        panel.grid(&mut svg);
        panel.path(&mut svg, report);
        panel.border(&mut svg, &format!("at {} = {:.2} m", AXES[through], middle[through]));
    }
    let (left, top, wide) = (52.0, HEIGHT + 12.0, 84.0);
    for (n, (colour, name)) in COLOURS.iter().zip(NAMES).enumerate() {
        let x = left + n as f64 * wide;
        frame(&mut svg, x, top, wide, 12.0, &format!(r#"fill="{colour}""#));
        let words = if n < BOUNDS.len() { format!("to {name}") } else { name.to_string() };
        text(&mut svg, x + wide / 2.0, top + 27.0, &format!(r#"text-anchor="middle" fill="{SOFT}""#), &words);
    }
    let x = left + COLOURS.len() as f64 * wide + 24.0;
    frame(&mut svg, x, top, wide, 12.0, &format!(r#"fill="{DARK}""#));
    text(&mut svg, x + wide / 2.0, top + 27.0, &format!(r#"text-anchor="middle" fill="{SOFT}""#), "no light");
    svg + "</svg>"
}
