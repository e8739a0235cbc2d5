//! Along one station's ray to the point that least squares asks for.
//!
//! With u = (x1, y1, 1) the ray of the first station in its own frame and v = R21 u the same ray seen from the
//! second, a row of the second station's P reads Z a = d minus its share of the offset from ray 1: parallax
//! a3 = x2 v3 - v1 and baseline d3 = t1 - x2 t3, a4 and d4 alike. With m = a4 / a3 the epipolar mismatch is
//! d4 - m d3, in metres, zero for clean light. Least squares moves the point along ray 1 by -W mismatch / a3 and
//! aside, in the image of station 1, by E mismatch:
//! Z = (d3 - W mismatch) / a3, X = x1 Z + E1 mismatch, Y = y1 Z + E2 mismatch.
//!
//! E depends on the epipolar line alone, and W on that, m and x2; a table over the lines holds them, and since they
//! only multiply the mismatch a nearest entry is precise enough. A line is told by m plus a multiple of the mismatch,
//! chosen so that the noise across the line disturbs E least.
//!
//! Products of 32 bits may wrap on the way; the bake has seen to it that what is shifted or compared fits. Each shift
//! rounds, its half folded into a constant before it or, where there is none, into the position of the station.
//!
//! What can go wrong: angles that belong to no point can wrap into something plausible; the mismatch, which is checked,
//! and the lines, which end, catch most of them. A point outside the volume is right or turned away.

use super::layout::{Linear, Lines, Reject, Row, Scene, Solution};
use super::tan::tan;

/// The product; where it wraps, only a sum it belongs to has to fit.
#[inline(always)]
pub(super) fn mul(a: i32, b: i32) -> i32 {
    a.wrapping_mul(b)
}

/// The sum, modulo 2^32.
#[inline(always)]
pub(super) fn sum<const N: usize>(terms: [i32; N]) -> i32 {
    terms.into_iter().fold(0, i32::wrapping_add)
}

/// x kx + y ky + k.
#[inline(always)]
pub(super) fn linear(c: &Linear, x: i32, y: i32) -> i32 {
    sum([mul(x, c.x), mul(y, c.y), c.one])
}

/// x_img of both stations: Q28 for whole multiples, Q15 for products.
pub(super) struct Images {
    x1_whole: i32,
    y1_whole: i32,
    pub(super) x2_whole: i32,
    pub(super) y2_whole: i32,
    pub(super) x1: i32,
    pub(super) y1: i32,
    pub(super) x2: i32,
    pub(super) y2: i32,
}

impl Images {
    /// The tangents of `angles`, in the order of the scene.
    #[inline(always)]
    pub(super) fn of(scene: &Scene, angles: [i32; 4]) -> Result<Images, Reject> {
        let image = |k: usize| tan(angles[(scene.order[k] & 3) as usize]).ok_or(Reject::FieldOfView);
        let (x1_whole, y1_whole, x2_whole, y2_whole) = (image(0)?, image(1)?, image(2)?, image(3)?);
        let [x1, y1, x2, y2] = [x1_whole >> 13, y1_whole >> 13, x2_whole >> 13, y2_whole >> 13];
        Ok(Images { x1_whole, y1_whole, x2_whole, y2_whole, x1, y1, x2, y2 })
    }
}

/// x2 v3 - v1 for the row whose image coordinate is `image`, `v3` without its whole part.
#[inline(always)]
pub(super) fn parallax(scene: &Scene, row: &Row, images: &Images, image_whole: i32, image: i32, v3: i32) -> i32 {
    let [x, y] = row.whole;
    let whole = [mul(scene.depth_whole, image_whole), mul(x, images.x1_whole), mul(y, images.y1_whole)];
    sum([sum(whole) << scene.whole_shift, mul(image, v3), linear(&row.rest, images.x1, images.y1)])
}

/// t1 - x2 t3 in Q31, or t2 - y2 t3.
#[inline(always)]
pub(super) fn baseline(scene: &Scene, row: usize, image: i32) -> i32 {
    scene.baseline[row & 1].wrapping_sub(mul(image, scene.baseline_depth))
}

/// The position, from the images `x1`, `y1` and that of the row that divides, `r` = 1 / a3, the parallax `a4` of the
/// other row, and the baselines of both.
#[inline(always)]
pub(super) fn walk(
    scene: &Scene,
    lines: &Lines,
    [x1, y1, x2]: [i32; 3],
    r: i32,
    a4: i32,
    [d3, d4]: [i32; 2],
) -> Result<Solution, Reject> {
    let m_fine = mul(a4 >> 15, r);
    let m = m_fine >> 14;
    let mismatch = d4.wrapping_sub(mul(m, d3 >> 15)) >> 15;
    if (mismatch ^ (mismatch >> 31)) as u32 >> scene.gate_shift != 0 {
        return Err(Reject::Mismatch);
    }
    let line = sum([m_fine, mul(mismatch, lines.slant)]) >> lines.shift;
    let entry = line.wrapping_sub(lines.first) as u32 as usize;
    let weight = lines.weights.get(entry).ok_or(Reject::Geometry)?;
    let w = sum([mul(weight.x.into(), x2), mul(weight.m.into(), m), weight.one]) >> 14;

    let z = (mul(d3.wrapping_sub(mul(mismatch, w)) >> 15, r) as u32 >> scene.z_shift) as i32;
    let x = sum([mul(x1, z), mul(mismatch, weight.aside[0].into())]) >> scene.side_shift;
    let y = sum([mul(y1, z), mul(mismatch, weight.aside[1].into())]) >> scene.side_shift;
    let [wx, wy, wz] = &scene.world;
    let position = [
        sum([linear(wx, x, y), mul(scene.world_z[0], z)]) >> scene.position_shift,
        sum([linear(wy, x, y), mul(scene.world_z[1], z)]) >> scene.position_shift,
        sum([linear(wz, x, y), mul(scene.world_z[2], z)]) >> scene.position_shift,
    ];
    Ok(Solution { position, mismatch: mismatch << scene.unit_shift })
}
