//! A rotor: where its laser plane really points, against where an ideal one would.
//!
//! A station measures an angle by time alone: half a turn after its sync pulse the plane has turned by 180 degrees.
//! The factory finds how each rotor strays from that and writes it into the station; the mote undoes it. Angles here
//! are from straight ahead, positive towards the station's x (azimuth) or y (elevation).
//!
//! What can go wrong: the curve term is sent to the mote and not applied, because the public descriptions of it
//! disagree about its sign.

use serde::{Deserialize, Serialize};

/// The factory terms of one rotor, as its station sends them.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Rotor {
    /// How far the plane runs ahead of the sync pulse, radians.
    pub phase_rad: f64,
    /// The lean of the plane against the rotor's axis, radians.
    pub tilt_rad: f64,
    /// The bow of the plane; sent, not applied.
    pub curve: f64,
    /// Where in the turn the once-per-turn error has its zero, radians.
    pub gibbous_phase_rad: f64,
    /// The height of the once-per-turn error, radians.
    pub gibbous_magnitude_rad: f64,
}

impl Rotor {
    /// The angle the timing will show for a true angle of `ideal_rad`; `other_tan` is the tangent of the angle on the
    /// other axis.
    #[must_use]
    pub fn measured(&self, ideal_rad: f64, other_tan: f64) -> f64 {
        ideal_rad - self.error(ideal_rad, other_tan)
    }

    /// The true angle behind a measured one: the inverse of [`Rotor::measured`].
    #[must_use]
    pub fn ideal(&self, measured_rad: f64, other_tan: f64) -> f64 {
        // The error changes by hundredths per radian, so each round gains two digits.
        (0..10).fold(measured_rad, |ideal, _| measured_rad + self.error(ideal, other_tan))
    }

    /// Whether the terms are those of a rotor that left the factory: phase and gibbous error together, and the tilt,
    /// within 0.1 rad.
    #[must_use]
    pub fn is_fit(&self) -> bool {
        const LIMIT_RAD: f64 = 0.1;
        self.phase_rad.abs() + self.gibbous_magnitude_rad.abs() <= LIMIT_RAD
            && self.tilt_rad.abs() <= LIMIT_RAD
            && self.gibbous_phase_rad.is_finite()
    }

    fn error(&self, ideal_rad: f64, other_tan: f64) -> f64 {
        self.phase_rad + libm::atan(other_tan * libm::tan(self.tilt_rad) * libm::cos(ideal_rad))
            - self.gibbous_magnitude_rad * libm::sin(ideal_rad + self.gibbous_phase_rad)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_rotor_without_faults_measures_the_true_angle() {
        assert_eq!(Rotor::default().measured(0.3, 0.7), 0.3);
    }

    #[test]
    fn the_phase_is_what_has_to_be_added_to_the_measured_angle() {
        let rotor = Rotor { phase_rad: 0.046615, ..Rotor::default() };
        assert!((rotor.measured(0.2, 0.0) + 0.046615 - 0.2).abs() < 1e-15);
    }

    #[test]
    fn every_term_enters_with_its_sign() {
        let rotor =
            Rotor { phase_rad: 0.02, tilt_rad: 0.01, curve: 0.5, gibbous_phase_rad: 0.1, gibbous_magnitude_rad: 0.004 };
        // 0.2 - 0.02 - atan(0.5 tan(0.01) cos(0.2)) + 0.004 sin(0.3), worked out apart.
        assert!((rotor.measured(0.2, 0.5) - 0.176_281_623_8).abs() < 1e-9);
    }

    proptest! {
        #[test]
        fn the_ideal_angle_comes_back_from_the_measured_one(
            ideal in -1.1..1.1f64, other in -1.8..1.8f64, phase in -0.07..0.07f64, tilt in -0.02..0.02f64,
            gibbous_phase in -3.2..3.2f64, gibbous_magnitude in -0.02..0.02f64,
        ) {
            let rotor = Rotor {
                phase_rad: phase, tilt_rad: tilt, curve: 0.0,
                gibbous_phase_rad: gibbous_phase, gibbous_magnitude_rad: gibbous_magnitude,
            };
            prop_assert!((rotor.ideal(rotor.measured(ideal, other), other) - ideal).abs() < 1e-12);
        }
    }
}
