//! The arithmetic of one step: predict, gate, correct.
//!
//! Written out rather than looped over: the compiler keeps loops for this core, and they cost a third.
//!
//! What a plane tells is not taken from the covariances at once but on the way to the next plane: each of the 21 is
//! then read and written once per step.
//!
//! What can go wrong: every sum and product may wrap when the state is nonsense, so all of them say so and none panics;
//! within the limits of [`Config`] none does but the terms of `beside`.

use core::sync::atomic::{Ordering, compiler_fence};

use super::root::{Root, pairs, reciprocal_root};
use super::{Config, PER_HALF_TURN, Pose};
use crate::sweep::Axis;

/// Significant bits of a covariance in a step.
const BITS: u32 = 17;
/// An innovation of an eighth of a metre is no innovation, Q18 m.
const INNOVATION: u32 = 1 << 15;
/// A believed innovation that takes the level, Q18 m: 2.5 cm, which moves a fix by up to the 5 cm that are wrong. At 3 cm
/// mirrored sweeps still made wrong fixes.
const LEAP: i32 = (0.025 * (1 << 18) as f64) as i32;
/// Covariances are carried at most so many half turns at a time: further, the largest would pass 2^31. The position is
/// carried by its velocity no further than that: 0.13 s.
const STRIDE: u32 = 16;

/// A symmetric matrix: xx, xy, xz, yy, yz, zz.
type Symmetric = [i32; 6];

/// Position, velocity, covariance.
///
/// In the order of use: the core reaches 32 words with one instruction each.
#[derive(Debug, Clone, Default)]
#[repr(C)]
pub(super) struct Estimate {
    /// Covariance of the position, Q32 m^2.
    pub pp: Symmetric,
    /// Covariance of position (row) and velocity (column), Q32 m^2 / half turn.
    pub pv: [[i32; 3]; 3],
    /// Covariance of the velocity, Q32 (m / half turn)^2.
    pub vv: Symmetric,
    /// What the latest plane told, still to be taken from the covariances on the way to the next: the covariance of
    /// position and velocity with it, per standard deviation of the innovation, Q16 m and m / half turn.
    pub told: [i32; 6],
    /// Q24 m.
    pub position: [i32; 3],
    /// Q22 m / half turn.
    pub velocity: [i32; 3],
    /// When that was, 1/256 half turns.
    pub at: u32,
    /// Half a half turn before the covariances were, which is within as much of `at`; 1/256 half turns.
    pub spread_from: u32,
}

/// A plane that is believed, and what it has to tell.
pub(super) struct Plane {
    /// Whether the estimate was far from it.
    pub is_leap: bool,
    /// Covariances of the position with the innovation.
    shares: [i32; 3],
    normal: [i32; 3],
    scale: u32,
    /// Of the reciprocal of the innovation's standard deviation.
    mantissa: i32,
    /// From the product of a covariance with the mantissa to Q16.
    down: u32,
    /// The innovation in standard deviations, Q13.
    surprise: i32,
}

impl Estimate {
    /// Standard deviations in Q16 m and Q24 m / half turn.
    pub(super) fn at(position: [i32; 3], position_sd: i32, velocity_sd: i32, now: u32) -> Self {
        let pp = position_sd.wrapping_mul(position_sd);
        // Q20 squared is Q40.
        let vv = (velocity_sd >> 4).wrapping_mul(velocity_sd >> 4) >> 8;
        Self {
            position: position.map(|axis| axis.wrapping_shl(8)),
            at: now,
            spread_from: now.wrapping_sub(PER_HALF_TURN / 2),
            pp: [pp, 0, 0, pp, 0, pp],
            vv: [vv, 0, 0, vv, 0, vv],
            ..Self::default()
        }
    }

    /// Carries the estimate on to `now`; gives the sum of the position variances. `None`, and nothing done, where that is
    /// further than one stride.
    #[inline(always)]
    pub(super) fn predict(&mut self, config: &Config, now: u32) -> Option<i32> {
        let due = now.wrapping_sub(self.spread_from);
        let stride = due / PER_HALF_TURN;
        if stride > STRIDE {
            return None;
        }
        self.spread_from = now.wrapping_sub(due % PER_HALF_TURN);

        let elapsed = now.wrapping_sub(self.at).cast_signed();
        self.at = now;
        let [x, y, z] = &mut self.position;
        let [u, v, w] = &self.velocity;
        carry(x, *u, elapsed);
        carry(y, *v, elapsed);
        carry(z, *w, elapsed);
        Some(self.spread(config, stride.cast_signed()))
    }

    /// Where a stride of a gap ends for the covariances. The position rests until then: the velocity is not believed for
    /// longer than the last one.
    pub(super) fn stride(&mut self) -> u32 {
        self.at = self.spread_from.wrapping_add(PER_HALF_TURN / 2 + STRIDE * PER_HALF_TURN);
        self.at
    }

    /// Whether `now` is within a stride; the position is then carried on by one.
    pub(super) fn reaches(&mut self, now: u32) -> bool {
        self.at = now.wrapping_sub(STRIDE * PER_HALF_TURN);
        now.wrapping_sub(self.spread_from) / PER_HALF_TURN <= STRIDE
    }

    /// Takes from the covariances what the latest plane told, and carries them on by `stride` whole half turns; gives
    /// the sum of the position variances.
    #[inline(always)]
    fn spread(&mut self, config: &Config, stride: i32) -> i32 {
        let [xx, xy, xz, yy, yz, zz] = &mut self.pp;
        let [[xu, xv, xw], [yu, yv, yw], [zu, zv, zw]] = &mut self.pv;
        let [uu, uv, uw, vv, vw, ww] = &mut self.vv;
        let [x, y, z, u, v, w] = &self.told;
        spread_pair(xy, xv, yu, uv, [x, y, u, v], stride);
        spread_pair(xz, xw, zu, uw, [x, z, u, w], stride);
        spread_pair(yz, yw, zv, vw, [y, z, v, w], stride);
        let growth = stride.wrapping_mul(config.agility);
        spread_axis(xx, xu, uu, [x, u], stride, growth)
            .wrapping_add(spread_axis(yy, yv, vv, [y, v], stride, growth))
            .wrapping_add(spread_axis(zz, zw, ww, [z, w], stride, growth))
    }

    /// Meets one plane, `tangent` in Q14, where the variances of the position sum up to `spread`; `None` where it is not
    /// believed.
    #[inline(always)]
    pub(super) fn meet(&self, config: &Config, pose: &Pose, axis: Axis, tangent: i32, spread: i32) -> Option<Plane> {
        let row = &pose.axes.data.0[axis as usize];
        // Normal in Q10; how far beside the plane the estimate lies in Q30 m, modulo 4 m; depth in Q26 m.
        let mut beside = 0;
        let mut depth = 0;
        let [ahead, station, own] = [&pose.axes.data.0[2], &pose.position.data.0[0], &self.position];
        let nx = meet(row[0], ahead[0], station[0], own[0], tangent, &mut beside, &mut depth);
        let ny = meet(row[1], ahead[1], station[1], own[1], tangent, &mut beside, &mut depth);
        let nz = meet(row[2], ahead[2], station[2], own[2], tangent, &mut beside, &mut depth);
        let beside = beside >> 12;
        if depth <= 0 {
            return None;
        }

        // A plane at this depth moves by depth * (1 + x^2) per radian.
        let square = tangent.wrapping_mul(tangent) >> 14;
        let lever = (square.wrapping_mul(config.noise) >> 14).wrapping_add(config.noise);
        let sigma = (depth >> 16).wrapping_mul(lever) >> 12;
        let noise = sigma.wrapping_mul(sigma);

        let [xx, xy, xz, yy, yz, zz] = &self.pp;
        // The velocity's variances are at most a few times these. Half of the scale:
        let half = pairs((spread | noise).cast_unsigned(), BITS);
        let scale = 2 * half;

        let normal = [nx, ny, nz];
        let x = share(normal, [xx, xy, xz], scale);
        let y = share(normal, [xy, yy, yz], scale);
        let z = share(normal, [xz, yz, zz], scale);
        let variance = ((noise >> scale) << 10)
            .wrapping_add(x.wrapping_mul(nx))
            .wrapping_add(y.wrapping_mul(ny))
            .wrapping_add(z.wrapping_mul(nz));
        let Root { mantissa, shift } = reciprocal_root(variance);

        // In standard deviations, Q13.
        let surprise = beside.wrapping_mul(mantissa) >> (2 + half + shift);
        if surprise.wrapping_add(config.gate).cast_unsigned() > config.gate.wrapping_mul(2).cast_unsigned() {
            return None;
        }

        let is_leap = beside.wrapping_add(LEAP).cast_unsigned() > 2 * LEAP.cast_unsigned();
        if is_leap && beside.unsigned_abs() >= INNOVATION {
            return None;
        }
        Some(Plane { is_leap, shares: [x, y, z], normal, scale, mantissa, down: 13 + shift - half, surprise })
    }

    /// Takes from a plane what it has to tell.
    #[inline(always)]
    pub(super) fn learn(&mut self, plane: &Plane) {
        let [x, y, z] = plane.shares;
        let [[xu, xv, xw], [yu, yv, yw], [zu, zv, zw]] = &self.pv;
        let share = |covariances| share(plane.normal, covariances, plane.scale);
        let [px, py, pz] = &mut self.position;
        let [pu, pv, pw] = &mut self.velocity;
        let [tx, ty, tz, tu, tv, tw] = &mut self.told;
        plane.moves_position(x, tx, px);
        plane.moves_position(y, ty, py);
        plane.moves_position(z, tz, pz);
        plane.moves_velocity(share([xu, yu, zu]), tu, pu);
        plane.moves_velocity(share([xv, yv, zv]), tv, pv);
        plane.moves_velocity(share([xw, yw, zw]), tw, pw);
    }

    /// Takes nothing from a plane.
    #[cold]
    #[inline(never)]
    pub(super) fn refuse(&mut self) {
        self.told = [0; 6];
    }

    /// Position (Q16 m), velocity (Q16 m/s) and variances of the position (Q32 m^2) at `now`, in the dark.
    ///
    /// The variance of one axis needs that axis alone, so nothing else is carried on.
    pub(super) fn after(&self, config: &Config, now: u32) -> ([i32; 3], [i32; 3], [i32; 3]) {
        let [xx, _, _, yy, _, zz] = self.pp;
        let [[xu, _, _], [_, yv, _], [_, _, zw]] = self.pv;
        let [uu, _, _, vv, _, ww] = self.vv;
        let [x, y, z, u, v, w] = self.told;
        let mut position = self.position;
        // Right at a sweep there is nothing to carry: only what its plane told is still to be taken.
        let mut variances = [known(xx, x, x), known(yy, y, y), known(zz, z, z)];
        if now != self.at {
            let ahead = now.wrapping_sub(self.spread_from) / PER_HALF_TURN;
            let axes = [[xx, xu, uu, x, u], [yy, yv, vv, y, v], [zz, zw, ww, z, w]];
            variances = axes.map(|axis| variance_after(config, axis, ahead));
            // No further than `predict` carries it.
            let elapsed = if ahead > STRIDE { STRIDE * PER_HALF_TURN } else { now.wrapping_sub(self.at) };
            for (position, velocity) in position.iter_mut().zip(self.velocity) {
                carry(position, velocity, elapsed.cast_signed());
            }
        }
        (
            position.map(|axis| axis >> 8),
            // 120 half turns a second.
            self.velocity.map(|axis| axis.wrapping_mul(120) >> 6),
            variances,
        )
    }

    /// Whether `position`, Q16 m, is more than 2 m away along an axis.
    pub(super) fn is_elsewhere(&self, position: [i32; 3]) -> bool {
        let pairs = self.position.iter().zip(position);
        pairs.into_iter().any(|(own, other)| (own >> 8).abs_diff(other) > 2 << 16)
    }
}

/// The position's variance of one axis `left` half turns later.
#[cold]
#[inline(never)]
fn variance_after(config: &Config, [mut pp, mut pv, mut vv, mut x, mut u]: [i32; 5], mut left: u32) -> i32 {
    loop {
        let stride = left.min(STRIDE).cast_signed();
        let wider = spread_axis(&mut pp, &mut pv, &mut vv, [&x, &u], stride, stride.wrapping_mul(config.agility));
        left -= stride.cast_unsigned();
        // Beyond the limit the track is over, and further the sum would leave the 32 bits.
        if left == 0 || wider.cast_unsigned() > config.variance_limit.cast_unsigned() {
            return wider;
        }
        (x, u) = (0, 0);
    }
}

/// One axis of the motion.
#[inline(always)]
fn carry(position: &mut i32, velocity: i32, elapsed: i32) {
    *position = position.wrapping_add(velocity.wrapping_mul(elapsed) >> 6);
    home();
}

/// One axis of the covariances; gives the position's variance.
#[inline(always)]
fn spread_axis(pp: &mut i32, pv: &mut i32, vv: &mut i32, told: [&i32; 2], stride: i32, growth: i32) -> i32 {
    let [x, u] = told;
    let faster = known(*vv, *u, *u).wrapping_add(growth);
    *vv = faster;
    let gain = faster.wrapping_mul(stride);
    let before = known(*pv, *x, *u);
    let after = before.wrapping_add(gain);
    *pv = after;
    let wider = known(*pp, *x, *x).wrapping_add(before.wrapping_add(after).wrapping_mul(stride));
    *pp = wider;
    home();
    wider
}

/// One pair of axes of the covariances.
#[inline(always)]
fn spread_pair(pp: &mut i32, pv: &mut i32, vp: &mut i32, vv: &mut i32, told: [&i32; 4], stride: i32) {
    let [x, y, u, v] = told;
    let fast = known(*vv, *u, *v);
    *vv = fast;
    let gain = fast.wrapping_mul(stride);
    let before = known(*pv, *x, *v);
    *pv = before.wrapping_add(gain);
    let after = known(*vp, *y, *u).wrapping_add(gain);
    *vp = after;
    *pp = known(*pp, *x, *y).wrapping_add(before.wrapping_add(after).wrapping_mul(stride));
    home();
}

/// What is left of a covariance.
#[inline(always)]
fn known(covariance: i32, a: i32, b: i32) -> i32 {
    covariance.wrapping_sub(a.wrapping_mul(b))
}

/// One axis of where the plane meets the estimate: gives the normal, Q10; adds to the distance from it, Q30 m,
/// and to the depth, Q26 m.
#[inline(always)]
fn meet(row: i32, ahead: i32, station: i32, own: i32, tangent: i32, beside: &mut i32, depth: &mut i32) -> i32 {
    // Q15 both.
    let normal = row.wrapping_sub(tangent.wrapping_mul(ahead) >> 14);
    let away = own.wrapping_sub(station) >> 9;
    *beside = beside.wrapping_add(normal.wrapping_mul(away));
    *depth = depth.wrapping_add(ahead.wrapping_mul(away >> 4));
    home();
    normal >> 5
}

/// The covariance with the distance from the plane of what has these `covariances` with the position; Q(32 - scale), 19
/// bits.
#[inline(always)]
fn share([nx, ny, nz]: [i32; 3], [a, b, c]: [&i32; 3], scale: u32) -> i32 {
    let sum = (*a >> scale).wrapping_mul(nx);
    let sum = sum.wrapping_add((*b >> scale).wrapping_mul(ny));
    sum.wrapping_add((*c >> scale).wrapping_mul(nz)) >> 10
}

impl Plane {
    /// Moves one component of the state, `DOWN` from Q29, by its share of the surprise.
    #[inline(always)]
    fn moves<const DOWN: u32>(&self, share: i32, told: &mut i32, state: &mut i32) {
        *told = share;
        *state = state.wrapping_sub(share.wrapping_mul(self.surprise) >> DOWN);
        home();
    }

    /// A component of the position: tens to hundreds of units, so rounded down.
    #[inline(always)]
    fn moves_position(&self, covariance: i32, told: &mut i32, position: &mut i32) {
        self.moves::<5>(covariance.wrapping_mul(self.mantissa) >> self.down, told, position);
    }

    /// A component of the velocity: a few units, so rounded to the nearest; down would cost 2 % of accuracy.
    #[inline(always)]
    fn moves_velocity(&self, covariance: i32, told: &mut i32, velocity: &mut i32) {
        let twice = covariance.wrapping_mul(self.mantissa) >> (self.down - 1);
        self.moves::<7>((twice + 1) >> 1, told, velocity);
    }
}

/// Every value is in its place in memory here. Costs nothing, and saves the copies on the stack that the compiler would
/// keep of 27 numbers in seven registers: a quarter of the step.
#[inline(always)]
pub(super) fn home() {
    compiler_fence(Ordering::SeqCst);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::angle::Angle;
    use crate::sweep::{Axis, Station};
    use crate::track::{Course, Room, State, Step, Sweep, step};
    use nalgebra::{Matrix3, Vector3};
    use proptest::prelude::*;

    prop_compose! {
        /// Three axes with some covariance, and a plane that told less than is known.
        fn estimates()(
            position in prop::array::uniform3(-(4 << 24)..4 << 24),
            velocity in prop::array::uniform3(-(1 << 16)..1 << 16),
            told in prop::array::uniform6(-64..64),
            now in any::<u32>(),
        ) -> Estimate {
            let config = Config::HAND_HELD;
            let start = Estimate::at([0; 3], config.start_position, config.start_velocity, now);
            Estimate { position, velocity, told, ..start }
        }
    }

    proptest! {
        #[test]
        fn a_look_ahead_is_where_the_estimate_will_be(estimate in estimates(), elapsed in 0u32..48 * PER_HALF_TURN) {
            let config = Config::HAND_HELD;
            let now = estimate.at.wrapping_add(elapsed);
            let (position, velocity, variances) = estimate.after(&config, now);
            // A sweep that is out of view carries the estimate on, and tells nothing.
            let mut state = State { estimate: estimate.clone(), course: Course::Steady, now: estimate.at, ..State::default() };
            let station = Pose { axes: Matrix3::identity(), position: Vector3::zeros() };
            let angle = Angle(i32::MAX);
            let dark = Sweep { station: Station::A, axis: Axis::Azimuth, angle, elapsed: elapsed.try_into().expect("a short time") };
            let outcome = step(&config, &Room { stations: [station; 2] }, &mut state, &dark);
            // Beyond the limit of the variances the track is over.
            prop_assume!(outcome == Step::OutOfView);
            let later = state.estimate;
            prop_assert_eq!(position, later.position.map(|axis| axis >> 8));
            prop_assert_eq!(velocity, later.velocity.map(|axis| (axis * 120) >> 6));
            let [xx, _, _, yy, _, zz] = later.pp;
            prop_assert_eq!(variances, [xx, yy, zz]);
        }
    }
}
