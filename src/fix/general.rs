//! The solver for rooms in which neither row of the second station has parallax everywhere.
//!
//! Stations that face each other across the volume are such a room: on the plane through both where the parallax is
//! all azimuth the elevation has none, and the other way round. Here the row with the larger parallax divides, and
//! each row has its own table of lines. Points too close to the line between the stations see no parallax at all and
//! are turned away.

use super::layout::{General, Reject, Solution};
use super::reciprocal::reciprocal;
use super::walk::{Images, baseline, linear, parallax, walk};

/// Solves `angles` (az A, el A, az B, el B; 2^20 units per half turn).
#[inline(always)]
pub(super) fn solve(c: &General, angles: [i32; 4]) -> Result<Solution, Reject> {
    let scene = &c.scene;
    let images = Images::of(scene, angles)?;
    let Images { x1, y1, x2, y2, .. } = images;
    let v3 = linear(&scene.depth, x1, y1) >> scene.depth_shift;
    let [row1, row2] = &c.rows;
    let a1 = parallax(scene, row1, &images, images.x2_whole, x2, v3);
    let a2 = parallax(scene, row2, &images, images.y2_whole, y2, v3);
    let (d1, d2) = (baseline(scene, 0, x2), baseline(scene, 1, y2));
    let [lines1, lines2] = &c.lines;
    let (lines, image, a3, a4, d) = if a1.unsigned_abs() >= a2.unsigned_abs() {
        (lines1, x2, a1, a2, [d1, d2])
    } else {
        (lines2, y2, a2, a1, [d2, d1])
    };
    // A point lies ahead of station 1; a parallax that wrapped says otherwise.
    if (a3 ^ d[0]) < 0 {
        return Err(Reject::Geometry);
    }
    let sign = a3 >> 31;
    let size = (a3 ^ sign).wrapping_sub(sign);
    let r = reciprocal(size, scene.least).ok_or(Reject::Geometry)?;
    walk(scene, lines, [x1, y1, image], (r ^ sign).wrapping_sub(sign), a4, d)
}
