//! What the solver is given and what it gives back.
//!
//! This file is compiled twice, into the library and into the bake (`calib/quantise.rs`), so that both agree on
//! every number by construction. It may use nothing but `core`.

/// Where the mote is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Solution {
    /// Position in the world frame of the calibration, Q16 metres.
    pub position: [i32; 3],
    /// Epipolar mismatch, Q16 metres: by how much the two rays miss each other, measured in the image of one station
    /// at the mote's distance. Zero for clean light.
    pub mismatch: i32,
}

/// Why there is no position.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reject {
    /// An angle lies outside +-60 deg.
    FieldOfView,
    /// The rays are too close to parallel, or meet behind a station or outside the room.
    Geometry,
    /// The rays miss each other by more than noise explains: the angles do not belong to one point.
    Mismatch,
}

/// A room, ready for the solver. Made by `calib/quantise.rs`; not meant to be written by hand.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Calib {
    /// Any pose of the stations.
    General(General),
}

/// The numbers of the general form.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct General {
    /// R21 = R2 R1^T, Q28.
    pub rotation: [[i32; 3]; 3],
    /// t = R2 (position 1 - position 2), Q24 metres.
    pub baseline: [i32; 3],
    /// R1^T, Q28.
    pub world: [[i32; 3]; 3],
    /// Position 1 in the world frame, Q24 metres.
    pub origin: [i32; 3],
    /// Largest mismatch let through, Q24 metres.
    pub gate: i32,
    /// Smallest parallax let through, Q24.
    pub parallax: i32,
}
