//! The solver for rooms in which one row of the second station has parallax all over the volume.
//!
//! That row always divides, so there is nothing to choose at run time: the cost is the same for every fix.

use super::layout::{Fast, Reject, Solution};
use super::reciprocal::reciprocal;
use super::walk::{Images, baseline, linear, mul, parallax, sum, walk};

/// Solves `angles` (az A, el A, az B, el B; 2^20 units per half turn).
#[inline(always)]
pub(super) fn solve(c: &Fast, angles: [i32; 4]) -> Result<Solution, Reject> {
    let scene = &c.scene;
    let images = Images::of(scene, angles)?;
    let Images { x1, y1, x2, y2, .. } = images;
    let v3 = linear(&scene.depth, x1, y1) >> scene.depth_shift;
    let a3 = parallax(scene, &c.near, &images, images.x2_whole, x2, v3);
    let r = reciprocal(a3, scene.least).ok_or(Reject::Geometry)?;
    let whole = mul(scene.depth_whole, images.y2_whole) << scene.whole_shift;
    let a4 = sum([whole, mul(y2, v3), linear(&c.far, x1, y1)]);
    let (d3, d4) = (baseline(scene, 0, x2), baseline(scene, 1, y2));
    // A point lies ahead of station 1; a parallax that wrapped says otherwise.
    if d3 < 0 {
        return Err(Reject::Geometry);
    }
    walk(scene, c.lines, [x1, y1, x2], r, a4, [d3, d4])
}
