//! Sweeps with the truth at their time.
//!
//! What can go wrong: a sweep that falls into a gap of the truth; it is left out, and who counts notices.

use super::observation::Sighting;
use super::path::Path;
use super::refine::Point;

/// By station and axis.
pub(super) fn rotors() -> impl Iterator<Item = (usize, usize)> {
    (0..2).flat_map(|station| (0..2).map(move |axis| (station, axis)))
}

/// In the order of the sightings.
pub(super) fn pair(sightings: &[Sighting], path: &Path, offset_s: f64) -> Vec<Point> {
    let paired = |s: &Sighting| {
        path.at(s.at_s + offset_s)?;
        Some(Point { at_s: s.at_s, station: s.station, axis: s.axis, angle: s.angle })
    };
    sightings.iter().filter_map(paired).collect()
}

/// At most so many, as many of each rotor, spread over the time.
pub(super) fn thinned(points: &[Point], most: usize) -> Vec<Point> {
    let mut thinned = Vec::with_capacity(most);
    for (station, axis) in rotors() {
        let own: Vec<&Point> = points.iter().filter(|p| p.station == station && p.axis == axis).collect();
        let count = own.len().min(most / 4);
        thinned.extend((0..count).map(|k| *own[k * own.len() / count]));
    }
    thinned
}
