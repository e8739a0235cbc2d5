//! What a rotor measures of a point, with its derivatives: the model of the recordings in double precision.
//!
//! [`crate::reference`] has the other direction, from the measured angle to the ideal one. Plain arrays, because this
//! is the inner loop and the packages are built unoptimised.
//!
//! What can go wrong: a point behind a station has no angle; it gets none.

use nalgebra::Matrix3;

use crate::calib::schema::Rotor;
use crate::reference::Pose;

/// World x, y, z or a station's right, up, forward.
pub(super) type V3 = [f64; 3];

/// Factory terms of one rotor that can be fitted: phase, tilt, and the once-per-turn term as the factors of the ideal
/// angle's sine and cosine; radians.
pub(super) const TERMS: usize = 4;
/// Numbers per station: a turn, a place, the terms of two rotors.
pub(super) const PER_STATION: usize = 6 + 2 * TERMS;

/// A station while it is being fitted.
#[derive(Clone, Copy, Debug)]
pub(super) struct Fitted {
    /// World to station.
    pub rotation: [V3; 3],
    /// In the world, metres.
    pub position: V3,
    /// Of azimuth and elevation.
    pub terms: [[f64; TERMS]; 2],
}

/// An angle as the model has it, and how it moves.
#[derive(Clone, Copy, Debug)]
pub(super) struct Predicted {
    /// Radians, factory terms included.
    pub angle: f64,
    /// By the point in station coordinates, radians per metre.
    pub by_point: V3,
    /// By the rotor's terms.
    pub by_terms: [f64; TERMS],
}

/// The smallest distance ahead of a station at which a point still has an angle, metres.
const NEAREST_M: f64 = 1e-3;

impl Fitted {
    /// A station with rotors as they ought to be.
    pub(super) fn ideal(rotation: [V3; 3], position: V3) -> Self {
        Self { rotation, position, terms: [[0.0; TERMS]; 2] }
    }

    pub(super) fn of(pose: &Pose) -> Self {
        let term = |r: &Rotor| [r.phase, r.tilt, r.gibmag * r.gibphase.cos(), r.gibmag * r.gibphase.sin()];
        Self {
            rotation: std::array::from_fn(|row| std::array::from_fn(|column| pose.rotation[(row, column)])),
            position: pose.position.into(),
            terms: pose.factory.each_ref().map(term),
        }
    }

    pub(super) fn pose(&self) -> Pose {
        let rotor = |[phase, tilt, sine, cosine]: [f64; TERMS]| Rotor {
            phase,
            tilt,
            curve: 0.0,
            gibphase: if sine == 0.0 && cosine == 0.0 { 0.0 } else { cosine.atan2(sine) },
            gibmag: sine.hypot(cosine),
        };
        Pose {
            rotation: Matrix3::from_fn(|row, column| self.rotation[row][column]),
            position: self.position.into(),
            factory: self.terms.map(rotor),
        }
    }

    /// A world point in station coordinates.
    pub(super) fn see(&self, point: V3) -> V3 {
        let away = sub(point, self.position);
        self.rotation.map(|row| dot(row, away))
    }

    /// What the rotor measures of a point in station coordinates.
    pub(super) fn predict(&self, axis: usize, c: V3) -> Option<Predicted> {
        let (own, other, ahead) = (c[axis], c[1 - axis], c[2]);
        if ahead < NEAREST_M {
            return None;
        }
        let [phase, tilt, sine, cosine] = self.terms[axis];
        let square = own * own + ahead * ahead;
        let (ideal, length) = (own.atan2(ahead), square.sqrt());
        let (sin, cos, across, lean) = (own / length, ahead / length, other / ahead, tilt.tan());
        let tangent = across * lean * cos;
        let slope = 1.0 / (1.0 + tangent * tangent);
        let by_ideal = 1.0 + slope * across * lean * sin + sine * cos - cosine * sin;
        let by_across = -slope * lean * cos;
        let mut by_point = [0.0; 3];
        by_point[axis] = by_ideal * ahead / square;
        by_point[1 - axis] = by_across / ahead;
        by_point[2] = -by_ideal * own / square - by_across * across / ahead;
        Some(Predicted {
            angle: ideal - phase - tangent.atan() + sine * sin + cosine * cos,
            by_point,
            by_terms: [-1.0, -slope * across * cos * (1.0 + lean * lean), sin, cos],
        })
    }

    /// Turned by `turn` (radians about the station's axes) and moved.
    pub(super) fn moved(&self, turn: V3, by: V3) -> Self {
        let rotation = product(turned(turn), self.rotation);
        Self { rotation: orthonormal(rotation), position: add(self.position, by), terms: self.terms }
    }
}

/// The rotation about `turn` by its length, radians.
fn turned(turn: V3) -> [V3; 3] {
    let turned = nalgebra::Rotation3::new(turn.into());
    std::array::from_fn(|row| std::array::from_fn(|column| turned[(row, column)]))
}

/// Rows made orthogonal again after many small turns.
fn orthonormal([right, up, _]: [V3; 3]) -> [V3; 3] {
    let right = unit(right);
    let up = unit(sub(up, scale(right, dot(right, up))));
    [right, up, cross(right, up)]
}

fn product(a: [V3; 3], b: [V3; 3]) -> [V3; 3] {
    a.map(|row| std::array::from_fn(|column| (0..3).map(|k| row[k] * b[k][column]).sum()))
}

pub(super) fn dot(a: V3, b: V3) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(super) fn cross(a: V3, b: V3) -> V3 {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

pub(super) fn add(a: V3, b: V3) -> V3 {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

pub(super) fn sub(a: V3, b: V3) -> V3 {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

pub(super) fn scale(a: V3, by: f64) -> V3 {
    a.map(|x| x * by)
}

pub(super) fn length(a: V3) -> f64 {
    dot(a, a).sqrt()
}

pub(super) fn unit(a: V3) -> V3 {
    scale(a, 1.0 / length(a))
}

/// The middle one of `values`; not a number when there are none.
pub(super) fn median(values: &mut [f64]) -> f64 {
    if values.is_empty() {
        return f64::NAN;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_derivatives_are_those_of_the_angle() {
        let mut station = Fitted::ideal([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], [0.0; 3]);
        station.terms = [[0.03, 0.006, 0.01, -0.004], [-0.02, -0.005, 0.003, 0.007]];
        let c = [0.7, -0.4, 1.9];
        const STEP: f64 = 1e-6;
        for axis in 0..2 {
            let at = |c: V3, s: &Fitted| s.predict(axis, c).unwrap().angle;
            let predicted = station.predict(axis, c).unwrap();
            for k in 0..3 {
                let (mut above, mut below) = (c, c);
                above[k] += STEP;
                below[k] -= STEP;
                let slope = (at(above, &station) - at(below, &station)) / (2.0 * STEP);
                assert!((slope - predicted.by_point[k]).abs() < 1e-8, "{axis} {k}");
            }
            for k in 0..TERMS {
                let (mut above, mut below) = (station, station);
                above.terms[axis][k] += STEP;
                below.terms[axis][k] -= STEP;
                let slope = (at(c, &above) - at(c, &below)) / (2.0 * STEP);
                assert!((slope - predicted.by_terms[k]).abs() < 1e-8, "{axis} term {k}");
            }
        }
    }

    #[test]
    fn terms_come_back_as_a_rotor() {
        let mut station = Fitted::ideal([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], [1.0, 2.0, 3.0]);
        station.terms = [[0.03, 0.006, 0.01, -0.004], [-0.02, -0.005, 0.0, 0.0]];
        let again = Fitted::of(&station.pose());
        for (one, other) in station.terms.iter().flatten().zip(again.terms.iter().flatten()) {
            assert!((one - other).abs() < 1e-15);
        }
    }

    #[test]
    fn nothing_is_seen_behind() {
        let station = Fitted::ideal([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], [0.0; 3]);
        assert!(station.predict(0, [0.1, 0.1, -1.0]).is_none());
    }
}
