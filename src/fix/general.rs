//! The solver for any pose of the stations.
//!
//! With u = (x1, y1, 1) the ray of station 1 in its own frame and v = R21 u the same ray seen from station 2,
//! each row of station 2 reads Z a = d - (its share of the offset from ray 1), with parallax a = x2 v3 - v1 and
//! baseline d = t1 - x2 t3. The row with the larger parallax gives Z along ray 1; the other then misses by the
//! epipolar mismatch, and least squares spreads that over the four equations with the weights below.

use super::layout::{General, Reject, Solution};
use super::tan::tan;

const Q: u32 = 24;
const ONE: i64 = 1 << Q;

#[inline(always)]
fn mul(a: i64, b: i64) -> i64 {
    (a * b + (1 << (Q - 1))) >> Q
}

#[inline(always)]
fn dot(row: &[i32; 3], x: i64, y: i64, z: i64) -> i64 {
    (i64::from(row[0]) * x + i64::from(row[1]) * y + i64::from(row[2]) * z) >> 28
}

/// Solves `angles` (az A, el A, az B, el B; 2^20 units per half turn).
#[inline]
pub(super) fn solve(calib: &General, angles: [i32; 4]) -> Result<Solution, Reject> {
    let image = |angle| tan(angle).map(|t| (i64::from(t) + 8) >> 4).ok_or(Reject::FieldOfView);
    let (x1, y1, x2, y2) = (image(angles[0])?, image(angles[1])?, image(angles[2])?, image(angles[3])?);
    let [row1, row2, row3] = &calib.rotation;
    let [t1, t2, t3] = calib.baseline.map(i64::from);
    let v = [dot(row1, x1, y1, ONE), dot(row2, x1, y1, ONE), dot(row3, x1, y1, ONE)];
    let row = |image, k: usize, t| {
        let lateral = |axis: usize| mul(image, i64::from(row3[axis]) >> 4) - (i64::from(calib.rotation[k][axis]) >> 4);
        (mul(image, v[2]) - v[k], t - mul(image, t3), [lateral(0), lateral(1)])
    };
    let (mut first, mut second) = (row(x2, 0, t1), row(y2, 1, t2));
    if first.0.abs() < second.0.abs() {
        core::mem::swap(&mut first, &mut second);
    }
    let (a3, d3, g1) = first;
    let (a4, d4, g2) = second;
    if a3.abs() < i64::from(calib.parallax) {
        return Err(Reject::Geometry);
    }
    let inverse = (1i64 << (2 * Q)) / a3;
    let m = mul(a4, inverse);
    let mismatch = d4 - mul(m, d3);
    if mismatch.abs() > i64::from(calib.gate) {
        return Err(Reject::Mismatch);
    }
    let h = [g2[0] - mul(m, g1[0]), g2[1] - mul(m, g1[1])];
    let scale = ONE + mul(m, m) + mul(h[0], h[0]) + mul(h[1], h[1]);
    let share = (mismatch << Q) / scale;
    let z = mul(d3 - mul(share, mul(g1[0], h[0]) + mul(g1[1], h[1]) - m), inverse);
    if z <= 0 {
        return Err(Reject::Geometry);
    }
    let x = mul(x1, z) + mul(share, h[0]);
    let y = mul(y1, z) + mul(share, h[1]);
    let mut position = [0; 3];
    for ((out, row), origin) in position.iter_mut().zip(&calib.world).zip(&calib.origin) {
        *out = ((dot(row, x, y, z) + i64::from(*origin) + 128) >> 8) as i32;
    }
    Ok(Solution { position, mismatch: (mismatch >> 8) as i32 })
}
