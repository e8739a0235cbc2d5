//! A room, turned into the integers of the solver.
//!
//! Host only. build.rs and xtask include this file by path, so it uses nothing but `std` and the solver's own files.

#[allow(dead_code, unreachable_pub)]
#[path = "../src/fix/general.rs"]
mod general;
#[allow(dead_code, unreachable_pub)]
#[path = "../src/fix/layout.rs"]
pub mod layout;
#[allow(dead_code, unreachable_pub)]
#[path = "../src/fix/tan.rs"]
mod tan;

use layout::{Calib, General};

/// Where a station is and how it is turned.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Station {
    /// World to station: x right, y up, z forward. The paper's R.
    pub rotation: [[f64; 3]; 3],
    /// Of the station in the world, metres.
    pub position: [f64; 3],
}

/// Two stations and the box the mote stays in.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Room {
    /// A and B.
    pub stations: [Station; 2],
    /// Smallest corner of the declared volume, metres.
    pub min: [f64; 3],
    /// Largest corner of the declared volume, metres.
    pub max: [f64; 3],
}

/// What came out.
#[derive(Debug, Clone, PartialEq)]
pub struct Baked {
    /// The numbers for the solver.
    pub calib: Calib,
}

/// Why a room cannot be served.
#[derive(Debug, Clone, PartialEq)]
pub struct Refusal {
    /// What was measured and which limit it broke.
    pub reason: String,
    /// The number in question.
    pub number: f64,
}

impl Baked {
    /// The calibration as a Rust expression, for `static CALIB: lighthouse_mote::fix::Calib = ...;`.
    #[must_use]
    pub fn emit(&self) -> String {
        format!(
            "{{\n#[allow(unused_imports)]\nuse lighthouse_mote::fix::{{Calib, General}};\nCalib::{:#?}\n}}",
            self.calib
        )
    }
}

type V = [f64; 3];

fn dot(a: V, b: V) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn times(m: [V; 3], v: V) -> V {
    m.map(|row| dot(row, v))
}

fn transposed(m: [V; 3]) -> [V; 3] {
    [0, 1, 2].map(|i| [m[0][i], m[1][i], m[2][i]])
}

fn fixed(value: f64, q: i32) -> i32 {
    (value * f64::powi(2.0, q)).round() as i32
}

/// Quantises `room`.
///
/// # Errors
/// A station inside the volume, or lengths beyond 100 m.
pub fn bake(room: &Room) -> Result<Baked, Refusal> {
    let [one, two] = room.stations;
    for station in room.stations {
        let p = station.position;
        if (0..3).all(|i| room.min[i] <= p[i] && p[i] <= room.max[i]) {
            return Err(Refusal { reason: "a station stands inside the volume; its x in metres".into(), number: p[0] });
        }
        if let Some(far) = p.into_iter().find(|x| !(x.abs() < 100.0)) {
            return Err(Refusal { reason: "a station stands more than 100 m from the origin".into(), number: far });
        }
    }
    let world = transposed(one.rotation);
    // R21 = R2 R1^T: column j is R2 times row j of R1.
    let r21 = transposed(one.rotation.map(|row| times(two.rotation, row)));
    let offset = [0, 1, 2].map(|i| one.position[i] - two.position[i]);
    Ok(Baked {
        calib: Calib::General(General {
            rotation: r21.map(|row| row.map(|x| fixed(x, 28))),
            baseline: times(two.rotation, offset).map(|x| fixed(x, 24)),
            world: world.map(|row| row.map(|x| fixed(x, 28))),
            origin: one.position.map(|x| fixed(x, 24)),
            gate: fixed(0.12, 24),
            parallax: fixed(0.02, 24),
        }),
    })
}
