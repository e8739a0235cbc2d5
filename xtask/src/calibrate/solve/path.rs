//! Where the mote was at any time: truth joined by lines, but not across gaps.
//!
//! What can go wrong: two samples at one instant; the first counts.

use super::model::{V3, add, length, scale, sub};
use super::observation::{Attitude, TruthSample};

/// Truth is joined over no longer than this, seconds: at 1 m/s a hand bends its path by about a centimetre in it.
pub(super) const JOIN_S: f64 = 0.1;
/// Samples closer than this are one, seconds.
const SAME_S: f64 = 1e-4;
/// Half the time over which a velocity is taken, seconds.
const VELOCITY_S: f64 = 0.01;

/// Samples in the order of time, later one by one.
#[derive(Clone, Debug)]
pub(super) struct Path {
    times: Vec<f64>,
    places: Vec<V3>,
}

impl Path {
    pub(super) fn of(truth: &[TruthSample]) -> Self {
        let mut order: Vec<&TruthSample> = truth.iter().collect();
        order.sort_by(|a, b| a.at_s.total_cmp(&b.at_s));
        let mut path = Self { times: Vec::with_capacity(order.len()), places: Vec::with_capacity(order.len()) };
        for sample in order {
            if path.times.last().is_none_or(|last| sample.at_s - last > SAME_S) {
                path.times.push(sample.at_s);
                path.places.push(sample.position.into());
            }
        }
        path
    }

    pub(super) fn places(&self) -> &[V3] {
        &self.places
    }

    /// The same in a mirror.
    pub(super) fn mirrored(&self) -> Self {
        Self { times: self.times.clone(), places: self.places.iter().map(|[x, y, z]| [-x, *y, *z]).collect() }
    }

    /// Root mean square of the speed where there are no gaps, m/s.
    pub(super) fn speed(&self) -> f64 {
        let (mut squares, mut time) = (0.0, 0.0);
        // Over at least a twentieth of a second, or the noise of motion capture moves a mote at rest.
        let mut from = 0;
        for to in 1..self.times.len() {
            let passed = self.times[to] - self.times[from];
            if passed > 3.0 * JOIN_S {
                from = to;
            } else if passed >= 0.5 * JOIN_S {
                let away = length(sub(self.places[to], self.places[from]));
                squares += away * away / passed;
                time += passed;
                from = to;
            }
        }
        if time > 0.0 { (squares / time).sqrt() } else { 0.0 }
    }

    /// The place at `t`, where truth is near enough in time.
    pub(super) fn at(&self, t: f64) -> Option<V3> {
        let after = self.times.partition_point(|&time| time < t);
        let one = |index: usize| self.times.get(index).filter(|time| (**time - t).abs() <= SAME_S);
        if let Some(index) = [after.wrapping_sub(1), after].into_iter().find(|&index| one(index).is_some()) {
            return Some(self.places[index]);
        }
        let before = self.times.get(after.checked_sub(1)?)?;
        (self.times.get(after)? - before <= JOIN_S).then(|| self.line(after, t))
    }

    /// The place at `t` and the velocity, m/s, whatever the gap.
    pub(super) fn anywhere(&self, t: f64) -> (V3, V3) {
        let place = |t: f64| {
            let after = self.times.partition_point(|&time| time < t).clamp(1, self.times.len() - 1);
            self.line(after, t.clamp(self.times[0], self.times[self.times.len() - 1]))
        };
        let velocity = scale(sub(place(t + VELOCITY_S), place(t - VELOCITY_S)), 0.5 / VELOCITY_S);
        (place(t), velocity)
    }

    fn line(&self, after: usize, t: f64) -> V3 {
        let (t0, t1) = (self.times[after - 1], self.times[after]);
        let (p0, p1) = (self.places[after - 1], self.places[after]);
        add(p0, scale(sub(p1, p0), (t - t0) / (t1 - t0)))
    }
}

/// How the body is turned at `t`, body to world; the nearer of the samples before and after.
pub(super) fn attitude(attitudes: &[Attitude], t: f64) -> Option<[V3; 3]> {
    let after = attitudes.partition_point(|attitude| attitude.at_s < t);
    let near = |attitude: &&Attitude| (attitude.at_s - t).abs() <= JOIN_S;
    let sides = [after.checked_sub(1).and_then(|before| attitudes.get(before)), attitudes.get(after)];
    let nearest = sides.into_iter().flatten().filter(near);
    let nearest = nearest.min_by(|a, b| (a.at_s - t).abs().total_cmp(&(b.at_s - t).abs()))?;
    let matrix = nearest.rotation.to_rotation_matrix();
    Some(std::array::from_fn(|row| std::array::from_fn(|column| matrix[(row, column)])))
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;

    #[test]
    fn truth_is_joined_but_not_across_gaps() {
        let sample = |at_s: f64, x: f64| TruthSample { at_s, position: Vector3::new(x, 0.0, 0.0) };
        let path = Path::of(&[sample(0.05, 1.0), sample(0.0, 0.0), sample(0.05, 9.0), sample(1.0, 2.0)]);
        assert_eq!(path.times.len(), 3);
        assert!((path.at(0.025).unwrap()[0] - 0.5).abs() < 1e-12);
        assert_eq!(path.at(0.05).unwrap()[0], 1.0);
        assert_eq!(path.at(0.5), None);
        assert_eq!(path.at(1.0).unwrap()[0], 2.0);
        assert_eq!(path.at(1.5), None);
        assert_eq!(path.at(-0.5), None);
        assert!((path.anywhere(0.02).1[0] - 20.0).abs() < 1e-9);
    }
}
