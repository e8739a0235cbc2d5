//! What both stations see of a room: points scattered over it, their angles, and where least squares puts them.
//!
//! What can go wrong: a volume of which the stations hardly see a point in common is refused.

use super::{Refusal, Room, refuse};

/// How far outside the volume a point must come out right if it comes out at all, in times the farthest corner.
const BEYOND: f64 = 1.5;
/// Angle units per degree.
const DEGREE: f64 = 1_048_576.0 / 180.0;
/// Half the field of view, angle units.
const FIELD: f64 = 60.0 * DEGREE;
/// Share by which every measured range is widened before it must fit.
pub(super) const MARGIN: f64 = 0.04;

pub(super) type V = [f64; 3];

pub(super) fn dot(a: V, b: V) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(super) fn times(m: [V; 3], v: V) -> V {
    m.map(|row| dot(row, v))
}

pub(super) fn transposed(m: [V; 3]) -> [V; 3] {
    [0, 1, 2].map(|i| [m[0][i], m[1][i], m[2][i]])
}

pub(super) fn minus(a: V, b: V) -> V {
    [0, 1, 2].map(|i| a[i] - b[i])
}

pub(super) fn length(v: V) -> f64 {
    dot(v, v).sqrt()
}

/// xorshift64*: the same seed always throws the same numbers.
pub struct Dice(pub u64);

impl Dice {
    /// Evenly from 0 up to 1.
    pub fn unit(&mut self) -> f64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Gaussian, mean 0, deviation 1.
    pub fn gauss(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.unit()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.unit()).cos()
    }
}

/// Four angles seen at a point of the volume.
pub(super) struct Sight {
    pub(super) angles: [i32; 4],
    /// Their tangents.
    pub(super) image: [f64; 4],
    /// The least-squares position.
    pub(super) answer: V,
}

/// Solves the n equations `a x = b` by elimination; a little is added to the diagonal so that it always can.
pub(super) fn solve<const N: usize>(mut a: [[f64; N]; N], mut b: [f64; N]) -> [f64; N] {
    let trace: f64 = (0..N).map(|i| a[i][i]).sum();
    for (i, row) in a.iter_mut().enumerate() {
        row[i] += 1e-12 * trace + f64::MIN_POSITIVE;
    }
    for i in 0..N {
        let pivot = (i..N).max_by(|&j, &k| a[j][i].abs().total_cmp(&a[k][i].abs())).unwrap_or(i);
        a.swap(i, pivot);
        b.swap(i, pivot);
        for j in i + 1..N {
            let f = a[j][i] / a[i][i];
            let (upper, lower) = a.split_at_mut(j);
            for (x, y) in lower[0].iter_mut().zip(&upper[i]).skip(i) {
                *x -= f * y;
            }
            b[j] -= f * b[i];
        }
    }
    for i in (0..N).rev() {
        let known: f64 = (i + 1..N).map(|k| a[i][k] * b[k]).sum();
        b[i] = (b[i] - known) / a[i][i];
    }
    b
}

/// Inhomogeneous least squares over x p3 - p1 and y p3 - p2 of both stations, P = [R | -R position].
fn least_squares(room: &Room, image: &[f64; 4]) -> V {
    let (mut normal, mut right) = ([[0.0; 3]; 3], [0.0; 3]);
    for (station, pair) in room.stations.iter().zip(image.chunks(2)) {
        for (axis, &x) in pair.iter().enumerate() {
            let r = station.rotation;
            let row = [0, 1, 2].map(|i| x * r[2][i] - r[axis][i]);
            let d = dot(row, station.position);
            for i in 0..3 {
                right[i] += row[i] * d;
                for j in 0..3 {
                    normal[i][j] += row[i] * row[j];
                }
            }
        }
    }
    solve(normal, right)
}

impl Sight {
    /// What both stations see of `point`, with `noise` degrees on each angle; nothing if one of them does not see it.
    pub(super) fn of(room: &Room, point: V, mut noise: impl FnMut() -> f64) -> Option<Sight> {
        let mut angles = [0.0; 4];
        for (station, pair) in room.stations.iter().zip(angles.chunks_mut(2)) {
            let c = times(station.rotation, minus(point, station.position));
            pair[0] = (c[0] / c[2]).atan().to_degrees() * DEGREE;
            pair[1] = (c[1] / c[2]).atan().to_degrees() * DEGREE;
            if c[2] <= 0.0 || pair.iter().any(|a| a.abs() > FIELD) {
                return None;
            }
        }
        let angles = angles.map(|a| (a + DEGREE * noise()).round());
        if angles.iter().any(|a| a.abs() > FIELD) {
            return None;
        }
        let image = angles.map(|a| (a / DEGREE).to_radians().tan());
        let angles = angles.map(|a| a as i32);
        Some(Sight { angles, image, answer: least_squares(room, &image) })
    }
}

/// Sights of points outside the volume, without noise, up to [`BEYOND`] times as far from each station.
pub(super) fn beyond(room: &Room, count: usize, dice: &mut Dice) -> Vec<Sight> {
    let corner = |k: usize| [0, 1, 2].map(|i| if k >> i & 1 == 0 { room.min[i] } else { room.max[i] });
    let far = room.stations.map(|s| BEYOND * Range::of((0..8).map(|k| length(minus(corner(k), s.position)))).max);
    let sight = |_| {
        let first = (dice.unit() < 0.5) as usize;
        let station = room.stations[first];
        let image = [0, 1].map(|_| (120.0 * (dice.unit() - 0.5)).to_radians().tan());
        let depth = far[first] * 0.02f64.powf(dice.unit());
        let c = [image[0] * depth, image[1] * depth, depth];
        let from_station = times(transposed(station.rotation), c);
        let point = [0, 1, 2].map(|i| station.position[i] + from_station[i]);
        let near = room.stations.iter().zip(far).all(|(s, far)| length(minus(point, s.position)) < far);
        if near { Sight::of(room, point, || 0.0) } else { None }
    };
    (0..count).filter_map(sight).collect()
}

/// `count` sights over the volume, with `noise` degrees on each angle; only where both stations see the point.
pub(super) fn scatter(room: &Room, count: usize, noise: f64, dice: &mut Dice) -> Result<Vec<Sight>, Refusal> {
    let mut found = Vec::with_capacity(count);
    let mut tries = 0;
    while found.len() < count {
        tries += 1;
        if tries > 1000 * count {
            return refuse("hardly a point of the volume is seen by both stations; points found", found.len() as f64);
        }
        let point = [0, 1, 2].map(|i| room.min[i] + (room.max[i] - room.min[i]) * dice.unit());
        found.extend(Sight::of(room, point, || noise * dice.gauss()));
    }
    Ok(found)
}

/// The least and the greatest of what was seen.
#[derive(Clone, Copy)]
pub(super) struct Range {
    pub(super) min: f64,
    pub(super) max: f64,
}

impl Range {
    pub(super) fn of(values: impl Iterator<Item = f64>) -> Range {
        let none = Range { min: f64::INFINITY, max: f64::NEG_INFINITY };
        values.fold(none, |r, v| Range { min: r.min.min(v), max: r.max.max(v) })
    }

    pub(super) fn and(self, other: Range) -> Range {
        Range { min: self.min.min(other.min), max: self.max.max(other.max) }
    }

    pub(super) fn magnitude(self) -> f64 {
        self.max.max(-self.min) * (1.0 + MARGIN)
    }
}

pub(super) fn mean(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let n = values.len() as f64;
    values.sum::<f64>() / n
}

/// What the stations see: points to choose by, and more to fit the weights to.
pub(super) struct Sights {
    pub(super) clean: Vec<Sight>,
    pub(super) noisy: Vec<Sight>,
    pub(super) wild: Vec<Sight>,
    /// Points anywhere in view of both, without noise.
    pub(super) beyond: Vec<Sight>,
}
