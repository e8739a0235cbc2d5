//! One way to use the four equations, in floating point: what the closed form makes of each sight.
//!
//! What can go wrong: nothing; whether a plan can be held in integers is for others to say.

use super::sight::{Sight, V, minus, times, transposed};
use super::{Room, Station};

/// Which row of the other station is divided by.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Divide {
    /// This one: azimuth or elevation.
    Row(usize),
    /// This one, where its parallax is large enough; nowhere else.
    Most(usize),
    /// Whichever has the larger parallax.
    Larger,
}

/// One way to use the four equations.
#[derive(Clone, Copy)]
pub(super) struct Plan {
    /// The station whose ray is walked along.
    pub(super) first: usize,
    pub(super) divide: Divide,
}

/// The quantities of the closed form for one sight, in metres.
pub(super) struct Seen {
    pub(super) x1: f64,
    pub(super) y1: f64,
    pub(super) x2: f64,
    pub(super) y2: f64,
    pub(super) v3: f64,
    pub(super) a3: f64,
    pub(super) a4: f64,
    pub(super) d3: f64,
    pub(super) d4: f64,
    pub(super) m: f64,
    pub(super) mismatch: f64,
    pub(super) w: f64,
    pub(super) z: f64,
    pub(super) u: V,
    pub(super) aside: [f64; 2],
}

/// A plan with its matrices: R21 with its rows in the plan's order, t likewise, the sign such that parallax is positive.
pub(super) struct Frame {
    pub(super) first: Station,
    pub(super) order: [u32; 4],
    pub(super) r21: [V; 3],
    pub(super) t: V,
}

impl Frame {
    pub(super) fn new(room: &Room, first: usize, [k3, k4]: [usize; 2]) -> Frame {
        let (one, two) = (room.stations[first], room.stations[1 - first]);
        // Column j of R21 = R2 R1^T is R2 times row j of R1.
        let r21 = transposed(one.rotation.map(|row| times(two.rotation, row)));
        let t = times(two.rotation, minus(one.position, two.position));
        let (a, b) = (2 * first as u32, 2 * (1 - first as u32));
        Frame {
            first: one,
            order: [a, a + 1, b + k3 as u32, b + k4 as u32],
            r21: [r21[k3], r21[k4], r21[2]],
            t: [t[k3], t[k4], t[2]],
        }
    }

    pub(super) fn flip(&mut self) {
        self.r21 = self.r21.map(|row| row.map(|x| -x));
        self.t = self.t.map(|x| -x);
    }

    pub(super) fn see(&self, sight: &Sight) -> Seen {
        let [x1, y1, x2, y2] = self.order.map(|k| sight.image[k as usize]);
        let [r1, r2, r3] = self.r21;
        let u = [x1, y1, 1.0];
        let [v1, v2, v3] = times(self.r21, u);
        let (a3, a4) = (x2 * v3 - v1, y2 * v3 - v2);
        let (d3, d4) = (self.t[0] - x2 * self.t[2], self.t[1] - y2 * self.t[2]);
        let m = a4 / a3;
        let mismatch = d4 - m * d3;
        let g1 = [0, 1].map(|i| x2 * r3[i] - r1[i]);
        let g2 = [0, 1].map(|i| y2 * r3[i] - r2[i]);
        let h = [0, 1].map(|i| g2[i] - m * g1[i]);
        let scale = 1.0 + m * m + h[0] * h[0] + h[1] * h[1];
        let w = (g1[0] * h[0] + g1[1] * h[1] - m) / scale;
        Seen {
            x1,
            y1,
            x2,
            y2,
            v3,
            a3,
            a4,
            d3,
            d4,
            m,
            mismatch,
            w,
            z: (d3 - mismatch * w) / a3,
            u,
            aside: [h[0] / scale, h[1] / scale],
        }
    }
}
