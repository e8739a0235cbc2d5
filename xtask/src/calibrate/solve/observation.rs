//! What is observed: angles on the mote's clock, places and turns on the truth's.
//!
//! What can go wrong: nothing here; the solver looks at every number before it uses one.

use nalgebra::{UnitQuaternion, Vector3};

/// One sweep as the mote timed it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sighting {
    /// When the laser passed, seconds of the mote's clock, a half turn being 1/120 s.
    pub at_s: f64,
    /// 0 is A.
    pub station: usize,
    /// 0 is azimuth, 1 elevation.
    pub axis: usize,
    /// As measured, radians from straight ahead: ticks * pi / half turn - pi / 2, factory terms still in.
    pub angle: f64,
}

/// Where the mote was.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TruthSample {
    /// When, seconds of the truth's clock.
    pub at_s: f64,
    /// In the world, metres.
    pub position: Vector3<f64>,
}

/// How the tracked body was turned.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Attitude {
    /// When, seconds of the truth's clock.
    pub at_s: f64,
    /// Body to world.
    pub rotation: UnitQuaternion<f64>,
}
