//! The mote's clock: true seconds to cycles and back.
//!
//! The chip counts an RC oscillator. Its rate is off by percents from the start, breathes with temperature and
//! wanders besides. All of it is a sum of sines, so the count is an integral in closed form: exact after 24 h, and
//! one Newton step or two from being inverted.
//!
//! What can go wrong: a drift of 1 %/min kept up for a day would be an oscillator 15 times too fast, so the drift
//! swings back at `drift_limit`; a scene whose errors could stop the clock is refused.

use serde::{Deserialize, Serialize};

use super::noise::{Noise, Purpose};

/// The periods of the wander, seconds: from within a fix to the length of a short run.
const WANDER_PERIODS_S: [f64; 4] = [0.31, 1.3, 5.3, 23.0];

/// An oscillator and what is wrong with it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Clock {
    /// What the rate should be, hertz.
    pub nominal_hz: f64,
    /// How much too fast at time 0, as a fraction.
    pub error: f64,
    /// How quickly the error grows at time 0, as a fraction per minute.
    pub drift_per_min: f64,
    /// How far the drift takes the error from where it started before it swings back, as a fraction.
    pub drift_limit: f64,
    /// What the error does on its own within seconds, RMS, as a fraction.
    pub wander: f64,
}

impl Default for Clock {
    fn default() -> Self {
        Clock { nominal_hz: 10_820_000.0, error: 0.04, drift_per_min: 0.01, drift_limit: 0.03, wander: 1e-4 }
    }
}

impl Clock {
    /// Whether the clock always runs forward, at a rate within a tenth to ten times its nominal.
    #[must_use]
    pub fn is_fit(&self) -> bool {
        let swing = if self.drift_per_min == 0.0 { 0.0 } else { self.drift_limit.abs() } + self.wander.abs() * 3.0;
        self.nominal_hz >= 1.0
            && self.nominal_hz <= 1e10
            && (self.drift_per_min == 0.0 || self.drift_limit > 0.0)
            && self.drift_per_min.is_finite()
            && 1.0 + self.error - swing >= 0.1
            && 1.0 + self.error + swing <= 10.0
    }
}

/// A clock made definite by a seed.
#[derive(Debug, Clone)]
pub(super) struct Oscillator {
    nominal_hz: f64,
    /// Rate without any swing, over nominal.
    mean: f64,
    swings: [Swing; WANDER_PERIODS_S.len() + 1],
}

/// A part of the error: fraction * sin(rate t + phase).
#[derive(Debug, Clone, Copy)]
struct Swing {
    fraction: f64,
    rate_rad_per_s: f64,
    phase_rad: f64,
}

impl Oscillator {
    pub(super) fn new(clock: &Clock, seed: u64) -> Oscillator {
        let mut noise = Noise::new(seed, Purpose::Clock);
        let drift = Swing {
            fraction: clock.drift_limit,
            rate_rad_per_s: clock.drift_per_min / 60.0 / clock.drift_limit,
            phase_rad: 0.0,
        };
        let still = Swing { fraction: 0.0, rate_rad_per_s: 1.0, phase_rad: 0.0 };
        let amplitude = clock.wander * (2.0 / WANDER_PERIODS_S.len() as f64).sqrt();
        let [a, b, c, d] = WANDER_PERIODS_S.map(|period_s| Swing {
            fraction: amplitude,
            rate_rad_per_s: core::f64::consts::TAU / (period_s * noise.between(0.8, 1.25)),
            phase_rad: noise.between(0.0, core::f64::consts::TAU),
        });
        Oscillator {
            nominal_hz: clock.nominal_hz,
            mean: 1.0 + clock.error,
            swings: [if clock.drift_per_min == 0.0 { still } else { drift }, a, b, c, d],
        }
    }

    /// The cycle nearest to a true time.
    pub(super) fn cycle(&self, t_s: f64) -> u64 {
        // A negative time saturates to 0.
        libm::round(self.count(t_s)) as u64
    }

    /// The true time of a cycle.
    pub(super) fn seconds(&self, cycle: u64) -> f64 {
        let wanted = cycle as f64;
        let mut t_s = wanted / (self.nominal_hz * self.mean);
        for _ in 0..50 {
            let step_s = (wanted - self.count(t_s)) / self.hz(t_s);
            t_s += step_s;
            if step_s.abs() * self.nominal_hz < 1e-3 {
                break;
            }
        }
        t_s
    }

    /// Cycles since time 0, with their fraction.
    fn count(&self, t_s: f64) -> f64 {
        let swung: f64 = self.swings.iter().map(|swing| swing.integral_s(t_s)).sum();
        self.nominal_hz * (self.mean * t_s + swung)
    }

    fn hz(&self, t_s: f64) -> f64 {
        let swing: f64 = self.swings.iter().map(|s| s.fraction * libm::sin(s.rate_rad_per_s * t_s + s.phase_rad)).sum();
        self.nominal_hz * (self.mean + swing)
    }
}

impl Swing {
    fn integral_s(&self, t_s: f64) -> f64 {
        let turned = libm::cos(self.phase_rad) - libm::cos(self.rate_rad_per_s * t_s + self.phase_rad);
        self.fraction / self.rate_rad_per_s * turned
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn the_clock_starts_with_its_error_and_drifts_by_its_rate() {
        let clock = Oscillator::new(&Clock { wander: 0.0, ..Clock::default() }, 0);
        let rate = |t_s: f64| (clock.count(t_s + 0.5) - clock.count(t_s - 0.5)) / 10_820_000.0 - 1.0;
        assert!((rate(0.0) - 0.04).abs() < 1e-5);
        assert!((rate(60.0) - 0.05).abs() < 5e-4);
    }

    #[test]
    fn the_drift_turns_back_at_its_limit_for_a_day() {
        let clock = Oscillator::new(&Clock { wander: 0.0, ..Clock::default() }, 0);
        let rates = || (0..86_400).map(|t_s| clock.hz(f64::from(t_s)) / 10_820_000.0 - 1.0);
        assert!((rates().fold(f64::MIN, f64::max) - 0.07).abs() < 1e-4);
        assert!((rates().fold(f64::MAX, f64::min) - 0.01).abs() < 1e-4);
    }

    #[test]
    fn a_clock_that_could_stop_is_not_fit() {
        assert!(Clock::default().is_fit());
        assert!(!Clock { error: -0.95, ..Clock::default() }.is_fit());
        assert!(!Clock { drift_limit: 1.2, ..Clock::default() }.is_fit());
        assert!(!Clock { nominal_hz: f64::NAN, ..Clock::default() }.is_fit());
    }

    proptest! {
        #[test]
        fn a_cycle_comes_back_from_its_time_over_24_h(
            seed: u64, cycle in 0..1_000_000_000_000u64, error in -0.1..0.1f64, drift in -0.05..0.05f64, wander in 0.0..0.01f64,
        ) {
            let clock = Clock { error, drift_per_min: drift, wander, ..Clock::default() };
            prop_assert!(clock.is_fit());
            let clock = Oscillator::new(&clock, seed);
            prop_assert_eq!(clock.cycle(clock.seconds(cycle)), cycle);
        }

        #[test]
        fn a_later_time_is_never_an_earlier_cycle(seed: u64, t_s in 0.0..86_400.0f64, later_s in 0.0..1e-5f64) {
            let clock = Oscillator::new(&Clock::default(), seed);
            prop_assert!(clock.cycle(t_s) <= clock.cycle(t_s + later_s));
        }
    }
}
