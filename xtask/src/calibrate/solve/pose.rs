//! A station's pose from nothing but planes: which way each sighting went, and where the mote then was.
//!
//! Azimuth and elevation come at different times, so there are no pairs to make points of: each sighting says that its
//! place lies in a plane through the station.
//!
//! # Design
//! Given how the station is turned, where it stands is a linear least squares of those planes. All turns are tried on
//! a grid: which way the middle of the light lies, and the roll about it; from each a few steps of least squares that
//! doubts outliers, and from the best ones all the way down. A flat cloud of places has several such bottoms and the
//! linear transform none, which is why the grid. What a random draw decides is only which sightings are looked at.
//!
//! What can go wrong: places that lie on a line leave the roll open, a cloud as small as its noise the distance; the
//! search then returns one of many poses, and whoever called must ask how sure it is.

use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Uniform};

use super::model::{Fitted, V3, add, cross, dot, length, median, scale, sub, unit};

/// A sighting with its place.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sight {
    pub place: V3,
    pub axis: usize,
    pub angle: f64,
}

/// Directions tried for the middle of the light: 27 degrees apart.
const DIRECTIONS: usize = 60;
/// Rolls tried about each.
const ROLLS: usize = 16;
/// Sightings per try, and per descent.
const FEW: usize = 80;
const MANY: usize = 300;
/// Tries that go all the way down.
const BEST: usize = 24;
/// Different ends that are compared on every sighting.
const LAST: usize = 4;
/// Residuals above this are doubted, radians: first what phases, noise and a coarse turn leave, then noise and phases.
const COARSE: f64 = 0.05;
const FINE: f64 = 0.01;

/// The pose that explains the sightings best and its mean cost; none when every one
/// would be behind the station.
pub(super) fn search(sights: &[Sight], random: &mut ChaCha8Rng) -> Option<(Fitted, f64)> {
    let few = drawn(sights, FEW, random);
    let many = drawn(sights, MANY, random);
    let middle = middle(&many)?;
    let seen = seen(&many);
    let mut tries: Vec<(f64, Fitted)> = Vec::with_capacity(DIRECTIONS * ROLLS);
    for direction in 0..DIRECTIONS {
        let forward = spread(direction);
        let side = unit(cross(forward, if forward[0].abs() < 0.7 { [1.0, 0.0, 0.0] } else { [0.0, 1.0, 0.0] }));
        let third = cross(forward, side);
        for roll in 0..ROLLS {
            let (sin, cos) = (std::f64::consts::TAU * roll as f64 / ROLLS as f64).sin_cos();
            let right = add(scale(side, cos), scale(third, sin));
            // World to a frame that looks along `forward`, and from there to the station, which sees it at `seen`.
            let rotation = through(seen, [right, cross(forward, right), forward]);
            let Some(position) = place(&rotation, &few, middle) else { continue };
            let (station, cost) = descend(Fitted::ideal(rotation, position), &few, COARSE, 4);
            tries.push((cost, station));
        }
    }
    tries.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut chosen: Vec<Fitted> = Vec::with_capacity(BEST);
    for (_, station) in tries {
        if chosen.iter().all(|other| differ(other, &station, middle)) {
            chosen.push(station);
        }
        if chosen.len() == BEST {
            break;
        }
    }
    let ends = chosen.into_iter().map(|station| {
        let station = descend(station, &many, COARSE, 10).0;
        descend(station, &many, FINE, 20)
    });
    let mut ends: Vec<(Fitted, f64)> = ends.filter(|end| end.1.is_finite()).collect();
    ends.sort_by(|a, b| a.1.total_cmp(&b.1));
    // From far away a cloud looks much the same turned inside out; every sighting, doubted by how they really scatter,
    // tells the ways apart.
    let best = ends.first()?.0;
    let doubt = 1.5 * scatter(&best, sights).max(1e-4);
    let mut last: Vec<Fitted> = Vec::with_capacity(LAST);
    for (station, _) in ends {
        if last.len() < LAST && last.iter().all(|other| differ(other, &station, middle)) {
            last.push(station);
        }
    }
    let ends = last.into_iter().map(|station| descend(station, sights, doubt, 30));
    ends.min_by(|a, b| a.1.total_cmp(&b.1))
}

/// The median of the residuals' sizes, radians.
fn scatter(station: &Fitted, sights: &[Sight]) -> f64 {
    let residual = |sight: &Sight| {
        let predicted = station.predict(sight.axis, station.see(sight.place));
        predicted.map_or(std::f64::consts::PI, |predicted| (sight.angle - predicted.angle).abs())
    };
    median(&mut sights.iter().map(residual).collect::<Vec<_>>())
}

/// Up to `count` of the sightings, as many of either axis, drawn one from each stretch of time.
fn drawn(sights: &[Sight], count: usize, random: &mut ChaCha8Rng) -> Vec<Sight> {
    let mut drawn = Vec::with_capacity(count);
    for axis in 0..2 {
        let own: Vec<&Sight> = sights.iter().filter(|sight| sight.axis == axis).collect();
        let wanted = (count / 2).min(own.len());
        for k in 0..wanted {
            let (from, to) = (k * own.len() / wanted, (k + 1) * own.len() / wanted);
            let at = Uniform::new(from, to).map_or(from, |stretch| stretch.sample(random));
            drawn.push(*own[at]);
        }
    }
    drawn
}

fn middle(sights: &[Sight]) -> Option<V3> {
    let axis = |k: usize| median(&mut sights.iter().map(|sight| sight.place[k]).collect::<Vec<_>>());
    let middle: V3 = std::array::from_fn(axis);
    middle.iter().all(|x| x.is_finite()).then_some(middle)
}

/// Where in the station's view the middle of the light lies.
fn seen(sights: &[Sight]) -> V3 {
    let tangent = |axis: usize| {
        let own = sights.iter().filter(|sight| sight.axis == axis);
        median(&mut own.map(|sight| sight.angle.clamp(-1.4, 1.4).tan()).collect::<Vec<_>>())
    };
    unit([tangent(0), tangent(1), 1.0])
}

/// Directions spread evenly over the sphere, on a golden spiral.
fn spread(index: usize) -> V3 {
    let z = 1.0 - (2.0 * index as f64 + 1.0) / DIRECTIONS as f64;
    let (sin, cos) = (index as f64 * std::f64::consts::PI * (3.0 - 5f64.sqrt())).sin_cos();
    let around = (1.0 - z * z).sqrt();
    [around * cos, around * sin, z]
}

/// The frame `rows`, turned so that its third axis is seen at `seen`.
fn through(seen: V3, rows: [V3; 3]) -> [V3; 3] {
    let side = unit(cross([0.0, 1.0, 0.0], seen));
    let up = cross(seen, side);
    std::array::from_fn(|k| add(add(scale(rows[0], side[k]), scale(rows[1], up[k])), scale(rows[2], seen[k])))
}

/// The plane's normal in the world.
fn normal(rotation: &[V3; 3], sight: &Sight) -> V3 {
    let (sin, cos) = sight.angle.sin_cos();
    sub(scale(rotation[sight.axis], cos), scale(rotation[2], sin))
}

/// Where a station turned so stands, such that it is in all the planes; outliers doubted.
fn place(rotation: &[V3; 3], sights: &[Sight], middle: V3) -> Option<V3> {
    let mut position: Option<V3> = None;
    for _ in 0..3 {
        let mut square = [[0.0; 3]; 3];
        let mut right = [0.0; 3];
        for sight in sights {
            let n = normal(rotation, sight);
            let away = sub(sight.place, middle);
            let weight = position.map_or(1.0, |position: V3| {
                let range = length(sub(away, position)).max(0.05);
                let angle = dot(n, sub(away, position)) / range;
                1.0 / (range * range * (1.0 + (angle / COARSE).powi(2)))
            });
            let by = weight * dot(n, away);
            for k in 0..3 {
                right[k] += n[k] * by;
                for j in 0..3 {
                    square[k][j] += weight * n[k] * n[j];
                }
            }
        }
        position = Some(solve(square, right)?);
    }
    let position = position?;
    // The planes go through a station behind the mote as well as ahead.
    let range = length(position);
    (range > 0.05 && range < 30.0).then(|| add(position, middle))
}

/// Solves N equations by Cholesky's factors; none when they say too little.
fn solve<const N: usize>(mut a: [[f64; N]; N], mut b: [f64; N]) -> Option<[f64; N]> {
    for i in 0..N {
        for j in 0..=i {
            let sum: f64 = (0..j).map(|k| a[i][k] * a[j][k]).sum();
            let rest = a[i][j] - sum;
            if i == j {
                if rest <= 1e-12 * a[i][i].abs() || !rest.is_finite() {
                    return None;
                }
                a[i][i] = rest.sqrt();
            } else {
                a[i][j] = rest / a[j][j];
            }
        }
    }
    for i in 0..N {
        let sum: f64 = (0..i).map(|k| a[i][k] * b[k]).sum();
        b[i] = (b[i] - sum) / a[i][i];
    }
    for i in (0..N).rev() {
        let sum: f64 = (i + 1..N).map(|k| a[k][i] * b[k]).sum();
        b[i] = (b[i] - sum) / a[i][i];
    }
    Some(b)
}

/// Least squares of the six numbers of a pose with Cauchy's loss at `doubt` radians; the mean cost reached.
fn descend(mut station: Fitted, sights: &[Sight], doubt: f64, steps: usize) -> (Fitted, f64) {
    let mut damping = 1e-3;
    let (mut cost, mut square, mut slope) = equations(&station, sights, doubt);
    for _ in 0..steps {
        let mut damped = square;
        for (k, row) in damped.iter_mut().enumerate() {
            row[k] *= 1.0 + damping;
            row[k] += 1e-9;
        }
        let Some(step) = solve(damped, slope) else { break };
        let next = station.moved([step[0], step[1], step[2]], [step[3], step[4], step[5]]);
        let there = equations(&next, sights, doubt);
        if there.0 < cost {
            let gain = cost - there.0;
            station = next;
            (cost, square, slope) = there;
            damping = (damping * 0.1).max(1e-9);
            if gain < 1e-9 * cost {
                break;
            }
        } else {
            damping *= 10.0;
            if damping > 1e6 {
                break;
            }
        }
    }
    (station, cost)
}

/// Mean cost, and the normal equations of the next step.
fn equations(station: &Fitted, sights: &[Sight], doubt: f64) -> (f64, [[f64; 6]; 6], [f64; 6]) {
    let mut cost = 0.0;
    let mut square = [[0.0f64; 6]; 6];
    let mut slope = [0.0; 6];
    for sight in sights {
        let c = station.see(sight.place);
        let Some(predicted) = station.predict(sight.axis, c) else {
            cost += (1.0 + (std::f64::consts::PI / doubt).powi(2)).ln();
            continue;
        };
        let residual = (sight.angle - predicted.angle) / doubt;
        let doubted = 1.0 + residual * residual;
        cost += doubted.ln();
        let by_turn = cross(c, predicted.by_point);
        let mut row = [0.0; 6];
        for k in 0..3 {
            row[k] = by_turn[k] / doubt;
            row[3 + k] = -(0..3).map(|r| station.rotation[r][k] * predicted.by_point[r]).sum::<f64>() / doubt;
        }
        for i in 0..6 {
            let weighed = row[i] / doubted;
            slope[i] += weighed * residual;
            for j in 0..=i {
                square[i][j] += weighed * row[j];
            }
        }
    }
    let whole = std::array::from_fn(|i| std::array::from_fn(|j| square[i.max(j)][i.min(j)]));
    (cost / sights.len() as f64, whole, slope)
}

/// Whether two poses are more than a step of the descent apart.
fn differ(one: &Fitted, other: &Fitted, middle: V3) -> bool {
    let turned = one.rotation.iter().zip(other.rotation).any(|(a, b)| dot(*a, b) < 0.998);
    let range = length(sub(one.position, middle));
    turned || length(sub(one.position, other.position)) > 0.05 * range
}
