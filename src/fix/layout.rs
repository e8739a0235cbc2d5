//! What the solver is given and what it gives back.
//!
//! Every number of a room is an `i32` or a shift: `calib/quantise.rs` works them out, build.rs writes them into the
//! firmware as a `const`.

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
#[allow(clippy::large_enum_variant, reason = "one of them sits in flash, and none is moved")]
pub enum Calib {
    /// One row of the second station has parallax all over the volume.
    Fast(Fast),
    /// Whichever row has the larger parallax serves.
    General(General),
}

/// What each tangent has added to it, in Q28: half of a Q15 unit, so that a shift down to Q15 rounds.
pub const HALF: i32 = 1 << 12;

/// The least parallax that the reciprocal takes, as normalised by the bake to lie below 2.
pub const LEAST: f64 = 1.0 / 8.0;

/// Entries of the table of weights.
pub const WEIGHTS: usize = 128;

/// x * image x + y * image y + one, in the Q format of whatever takes it; image x and y are Q15 tangents.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Linear {
    /// Multiplies x.
    pub x: i32,
    /// Multiplies y.
    pub y: i32,
    /// The constant, with the half of the shift that follows.
    pub one: i32,
}

/// The least-squares weights of the epipolar mismatch on one epipolar line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Weight {
    /// Of x2 in W, Q14.
    pub x: i16,
    /// Of m in W, Q14.
    pub m: i16,
    /// The constant in W, Q29.
    pub one: i32,
    /// E.
    pub aside: [i16; 2],
}

/// A row of -R21: v1 or v2, negative.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Row {
    /// The whole multiples of x1 and y1, which meet them in full precision.
    pub whole: [i32; 2],
    /// The rest.
    pub rest: Linear,
}

/// The epipolar lines of the second station's image, and what to do with the mismatch on each.
// The table comes first, here and in the forms, because a load of the Cortex-M0 reaches 124 bytes beyond its base.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(C)]
pub struct Lines {
    /// W and E over the lines.
    pub weights: [Weight; WEIGHTS],
    /// What one unit of mismatch adds to m to tell the line, Q13.
    pub slant: i32,
    /// log2 of the width of an entry of the table, in Q29 of the line.
    pub shift: u32,
    /// The line where the table begins, in entries.
    pub first: i32,
}

/// What both forms share. Lengths are in units of 2^`unit_shift` metres; the Q formats that depend on the room show in
/// the shifts. x1, y1, x2, y2 are in Q15.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Scene {
    /// Which of az A, el A, az B, el B serves as x1, y1, x2 (the row divided by, if that is fixed) and y2.
    pub order: [u32; 4],
    /// v3 less `depth_whole`.
    pub depth: Linear,
    /// From `depth` to the format whose product with a Q15 is that of the parallax.
    pub depth_shift: u32,
    /// The whole number nearest to v3.
    pub depth_whole: i32,
    /// From Q28 to the format of the parallax.
    pub whole_shift: u32,
    /// Least parallax that is let through, positive.
    pub least: i32,
    /// t1 and t2, Q31.
    pub baseline: [i32; 2],
    /// t3, Q16.
    pub baseline_depth: i32,
    /// log2 of the largest mismatch let through, in 2^-16 units.
    pub gate_shift: u32,
    /// From N / a3 to the format of Z.
    pub z_shift: u32,
    /// From the products that make X and Y to their format.
    pub side_shift: u32,
    /// The first two columns of R1^T, and position 1.
    pub world: [Linear; 3],
    /// The third column of R1^T.
    pub world_z: [i32; 3],
    /// From the sum to Q16 metres.
    pub position_shift: u32,
    /// log2 of the unit of length in metres.
    pub unit_shift: u32,
}

/// The numbers of the fast form.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(C)]
pub struct Fast {
    /// The lines of the row divided by. Elsewhere, so that the rest is small enough to be folded into the code wherever
    /// the room is a constant.
    pub lines: &'static Lines,
    /// What both forms share.
    pub scene: Scene,
    /// -v1, of the row divided by.
    pub near: Row,
    /// -v2, unsplit but for v3.
    pub far: Linear,
}

/// The numbers of the general form.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(C)]
pub struct General {
    /// The lines when the first row divides, and when the second does. Elsewhere, as in [`Fast`].
    pub lines: &'static [Lines; 2],
    /// What both forms share.
    pub scene: Scene,
    /// -v1 and -v2.
    pub rows: [Row; 2],
}
