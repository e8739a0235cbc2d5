//! A base station: where it stands, how its rotors stray, what it says, and what gets in its way.
//!
//! Station frame x right, y up, z forward; c = R (p - position), tan(azimuth) = c.x / c.z and
//! tan(elevation) = c.y / c.z, both from straight ahead.
//!
//! What can go wrong: a rotation that is not a rotation bends the room; [`Station::is_rigid`] says so before any
//! light is made.

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

use super::ootx::Info;
use super::rotor::Rotor;
use super::slot::Axis;

/// One base station of a scene.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Station {
    /// World to station, row by row.
    pub rotation: [[f64; 3]; 3],
    /// In the world, metres.
    pub position_m: [f64; 3],
    /// The rotor that turns about the station's y.
    pub azimuth: Rotor,
    /// The rotor that turns about the station's x.
    pub elevation: Rotor,
    /// The rest of what its OOTX frame says.
    pub info: Info,
    /// When something stands between it and the mote.
    pub occlusions: Vec<Occlusion>,
    /// Somebody knocks against it.
    pub moved: Option<Moved>,
}

/// A station that stands elsewhere from some moment on.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Moved {
    /// From this true time on, seconds.
    pub at_s: f64,
    /// Where to, metres from where it was.
    pub by_m: [f64; 3],
    /// How far it turns about its own y, degrees: to look further to its right.
    pub turn_deg: f64,
    /// How far it then tilts about its own x, degrees: to look further up.
    pub tilt_deg: f64,
}

/// Something stands in the direct line from a station to the mote for a while.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Occlusion {
    /// From this true time on, seconds.
    pub from_s: f64,
    /// Until just before this true time, seconds.
    pub to_s: f64,
    /// What it keeps away.
    pub hides: Hides,
}

/// What an occlusion keeps away from the mote.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Hides {
    /// All light of the station.
    Everything,
    /// The sweeps alone; the flashes still come by way of walls and ceiling.
    Sweeps,
}

/// What all stations of the kind have in common.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Optics {
    /// A sweep is seen up to this far from straight ahead, on both axes, degrees.
    pub half_field_deg: f64,
    /// Light is seen up to this far from the station, metres. The makers ask for stations at most 5 m apart.
    pub reach_m: f64,
    /// How thick the laser line is, millimetres. 3 mm gives the recorded 1.5 to 20 us over 5.3 to 0.4 m.
    pub line_mm: f64,
}

impl Default for Optics {
    fn default() -> Self {
        Optics { half_field_deg: 60.0, reach_m: 5.0, line_mm: 3.0 }
    }
}

/// Nearer to the rotor than this is inside the station's case.
const CASE_M: f64 = 0.05;

/// A place as a station sees it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sight {
    /// In the station's frame, metres.
    pub c_m: Vector3<f64>,
}

impl Station {
    /// The place `p_m` as this station sees it.
    #[must_use]
    pub fn sight(&self, p_m: Vector3<f64>) -> Sight {
        let [x, y, z] = self.rotation;
        let rotation = Matrix3::from_rows(&[x.into(), y.into(), z.into()].map(|row: Vector3<f64>| row.transpose()));
        Sight { c_m: rotation * (p_m - Vector3::from(self.position_m)) }
    }

    /// The rotor of an axis.
    #[must_use]
    pub fn rotor(&self, axis: Axis) -> &Rotor {
        match axis {
            Axis::Azimuth => &self.azimuth,
            Axis::Elevation => &self.elevation,
        }
    }

    /// Whether the rotation is one, to 1e-6.
    #[must_use]
    pub fn is_rigid(&self) -> bool {
        let [x, y, z] = self.rotation.map(Vector3::from);
        let crossed = (x.cross(&y) - z).norm();
        (x.norm() - 1.0).abs() < 1e-6 && (y.norm() - 1.0).abs() < 1e-6 && x.dot(&y).abs() < 1e-6 && crossed < 1e-6
    }

    /// The station as it stands once it has been moved, if it is.
    #[must_use]
    pub fn after_its_move(&self) -> Option<Station> {
        let Moved { by_m, turn_deg, tilt_deg, .. } = self.moved?;
        let [x, y, z] = self.rotation;
        // Two axes of the station, the second turned towards the first.
        let towards = |forward: [f64; 3], other: [f64; 3], deg: f64| {
            let (sin, cos) = (libm::sin(deg.to_radians()), libm::cos(deg.to_radians()));
            let mix = |a: [f64; 3], p: f64, b: [f64; 3], q: f64| core::array::from_fn(|k| p * a[k] + q * b[k]);
            (mix(forward, cos, other, sin), mix(other, cos, forward, -sin))
        };
        let (z, x) = towards(z, x, turn_deg);
        let (z, y) = towards(z, y, tilt_deg);
        Some(Station {
            rotation: [x, y, z],
            position_m: core::array::from_fn(|k| self.position_m[k] + by_m[k]),
            moved: None,
            ..self.clone()
        })
    }

    /// Whether the direct flash is blocked at a true time.
    #[must_use]
    pub fn hides_sync(&self, at_s: f64) -> bool {
        self.occlusions.iter().any(|o| o.hides == Hides::Everything && (o.from_s..o.to_s).contains(&at_s))
    }

    /// Whether the direct sweep is blocked at a true time.
    #[must_use]
    pub fn hides_sweep(&self, at_s: f64) -> bool {
        self.occlusions.iter().any(|o| (o.from_s..o.to_s).contains(&at_s))
    }
}

impl Sight {
    /// The tangent of the angle on an axis and of the one on the other; nothing behind the station.
    #[must_use]
    pub fn tangents(&self, axis: Axis) -> Option<(f64, f64)> {
        let c = self.c_m;
        (c.z > 0.0).then(|| match axis {
            Axis::Azimuth => (c.x / c.z, c.y / c.z),
            Axis::Elevation => (c.y / c.z, c.x / c.z),
        })
    }

    /// Whether a flash from here is seen: in front of the station and within reach.
    #[must_use]
    pub fn lit(&self, optics: &Optics) -> bool {
        self.c_m.z > 0.0 && self.c_m.norm() <= optics.reach_m
    }

    /// Whether the sweeps pass here: within the field of both axes.
    #[must_use]
    pub fn in_field(&self, optics: &Optics) -> bool {
        let edge = libm::tan(optics.half_field_deg.to_radians());
        let c = self.c_m;
        c.z > 0.0 && c.x.abs() <= edge * c.z && c.y.abs() <= edge * c.z
    }

    /// How long the laser line takes to pass, microseconds: line / (2 pi * r / turn), with r the distance from the
    /// rotor's axis and at least `CASE_M`.
    #[must_use]
    pub fn sweep_width_us(&self, axis: Axis, optics: &Optics, half_turn_s: f64) -> f64 {
        let c = self.c_m;
        let r_m = match axis {
            Axis::Azimuth => (c.x * c.x + c.z * c.z).sqrt(),
            Axis::Elevation => (c.y * c.y + c.z * c.z).sqrt(),
        };
        let speed_m_per_s = core::f64::consts::PI * r_m.max(CASE_M) / half_turn_s;
        optics.line_mm * 1e-3 / speed_m_per_s * 1e6
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::slot::HALF_TURN_S;

    fn ahead(c_m: [f64; 3]) -> Sight {
        Sight { c_m: Vector3::from(c_m) }
    }

    #[test]
    fn the_field_ends_at_sixty_degrees_on_either_axis() {
        let optics = Optics::default();
        let edge = 3f64.sqrt();
        assert!(ahead([0.999 * edge, -0.999 * edge, 1.0]).in_field(&optics));
        assert!(!ahead([1.001 * edge, 0.0, 1.0]).in_field(&optics));
        assert!(!ahead([0.0, -1.001 * edge, 1.0]).in_field(&optics));
        assert!(!ahead([0.0, 0.0, -1.0]).in_field(&optics));
    }

    #[test]
    fn a_sweep_is_short_when_far_and_long_when_near() {
        let width = |z| ahead([0.0, 0.0, z]).sweep_width_us(Axis::Azimuth, &Optics::default(), HALF_TURN_S);
        assert!((19.0..21.0).contains(&width(0.4)));
        assert!((1.5..1.7).contains(&width(5.0)));
    }

    #[test]
    fn a_sweep_inside_the_case_is_no_longer_than_at_its_wall() {
        let sight = ahead([0.0, 0.0, 1e-9]);
        let width_us = sight.sweep_width_us(Axis::Elevation, &Optics::default(), HALF_TURN_S);
        assert!(width_us < 160.0);
    }

    #[test]
    fn a_station_that_was_turned_looks_elsewhere_and_is_still_a_station() {
        let eye = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let moved = Some(Moved { at_s: 1.0, by_m: [0.1, 0.0, 0.0], turn_deg: 5.0, tilt_deg: 3.0 });
        let station = Station { rotation: eye, moved, ..Station::default() };
        let after = station.after_its_move().expect("it moves");
        assert!(after.is_rigid());
        assert_eq!(after.position_m, [0.1, 0.0, 0.0]);
        // What is straight ahead of it now lies to the right and up: right-handed with x right, y up, z forward.
        let (turn, tilt) = (5f64.to_radians(), 3f64.to_radians());
        let ahead = Vector3::new(turn.sin() * tilt.cos(), tilt.sin(), turn.cos() * tilt.cos());
        let sight = after.sight(Vector3::new(0.1, 0.0, 0.0) + ahead).c_m;
        assert!((sight - Vector3::z()).norm() < 1e-12, "{sight}");
    }

    #[test]
    fn a_mirrored_frame_is_not_a_rotation() {
        let eye = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let mirrored = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]];
        assert!(Station { rotation: eye, ..Station::default() }.is_rigid());
        assert!(!Station { rotation: mirrored, ..Station::default() }.is_rigid());
        assert!(!Station::default().is_rigid());
    }
}
