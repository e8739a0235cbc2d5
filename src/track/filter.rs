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

use super::root::{Root, half_width, reciprocal_root};
use super::{Config, PER_HALF_TURN, Pose};
use crate::sweep::Axis;

/// Significant bits of a covariance in a step.
const BITS: u32 = 18;
/// An innovation of an eighth of a metre is no innovation, Q18 m.
const INNOVATION_BITS: u32 = 15;
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
    /// When that was, 1/256 half turns.
    pub at: u32,
    /// When the covariances were, 1/256 half turns: within half a half turn of `at`.
    pub spread_at: u32,
    /// Q22 m / half turn.
    pub velocity: [i32; 3],
}

/// What became of one plane.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Outcome {
    Believed,
    /// Believed, and the estimate was far from it.
    Leapt,
    Refused,
    Lost,
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
            spread_at: now & !(PER_HALF_TURN - 1),
            pp: [pp, 0, 0, pp, 0, pp],
            vv: [vv, 0, 0, vv, 0, vv],
            ..Self::default()
        }
    }

    /// One plane, `tangent` in Q14, seen at `now`.
    #[inline(always)]
    pub(super) fn step(&mut self, config: &Config, pose: &Pose, axis: Axis, tangent: i32, now: u32) -> Outcome {
        let spread = self.predict(config, now);
        // A negative sum is nonsense, and large.
        if spread.cast_unsigned() > config.variance_limit.cast_unsigned() {
            return Outcome::Lost;
        }
        let outcome = self.correct(config, pose, axis, tangent, spread);
        if outcome == Outcome::Refused {
            self.told = [0; 6];
        }
        outcome
    }

    /// Carries the estimate on to `now`; gives the sum of the position variances.
    #[inline(always)]
    fn predict(&mut self, config: &Config, now: u32) -> i32 {
        let due = due(now);
        let mut left = due.wrapping_sub(self.spread_at) / PER_HALF_TURN;
        self.spread_at = due;
        while left > STRIDE {
            left -= STRIDE;
            let spread = self.spread_far(config, now);
            if spread.cast_unsigned() > config.variance_limit.cast_unsigned() {
                return spread;
            }
        }

        let elapsed = now.wrapping_sub(self.at).cast_signed();
        self.at = now;
        let [x, y, z] = &mut self.position;
        let [u, v, w] = &self.velocity;
        carry(x, *u, elapsed);
        carry(y, *v, elapsed);
        carry(z, *w, elapsed);
        self.spread(config, left.cast_signed())
    }

    /// One stride of a gap too long for one; the velocity is not believed for longer than that.
    #[cold]
    #[inline(never)]
    fn spread_far(&mut self, config: &Config, now: u32) -> i32 {
        self.at = now.wrapping_sub(STRIDE * PER_HALF_TURN);
        let spread = self.spread(config, STRIDE.cast_signed());
        self.told = [0; 6];
        spread
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

    #[inline(always)]
    fn correct(&mut self, config: &Config, pose: &Pose, axis: Axis, tangent: i32, spread: i32) -> Outcome {
        let row = &pose.axes.data.0[axis as usize];
        // Normal in Q10; how far beside the plane the estimate lies in Q30 m, modulo 4 m; depth in Q26 m.
        let mut beside = 0;
        let mut depth = 0;
        let [ahead, station, own] = [&pose.axes.data.0[2], &pose.position.data.0[0], &self.position];
        let nx = meet(row[0], ahead[0], station[0], own[0], tangent, &mut beside, &mut depth);
        let ny = meet(row[1], ahead[1], station[1], own[1], tangent, &mut beside, &mut depth);
        let nz = meet(row[2], ahead[2], station[2], own[2], tangent, &mut beside, &mut depth);
        let beside = beside >> 12;
        if beyond(beside, INNOVATION_BITS) || depth <= 0 {
            return Outcome::Refused;
        }

        // A plane at this depth moves by depth * (1 + x^2) per radian.
        let lever = (tangent.wrapping_mul(tangent) >> 18).wrapping_add(1 << 10);
        let reach = (depth >> 16).wrapping_mul(lever) >> 10;
        let sigma = reach.wrapping_mul(config.noise) >> 12;
        let noise = sigma.wrapping_mul(sigma);

        let [xx, xy, xz, yy, yz, zz] = &self.pp;
        let [[xu, xv, xw], [yu, yv, yw], [zu, zv, zw]] = &self.pv;
        // The velocity's variances are at most a few times these. Half of the scale:
        let size = (spread | noise).cast_unsigned() >> BITS;
        let half = match size {
            0..64 => half_width(size),
            _ => 3 + half_width(size >> 6),
        };
        let scale = 2 * half;

        // Q(32 - scale); 19 bits.
        let dot = |a: &i32, b: &i32, c: &i32| {
            let sum = (*a >> scale).wrapping_mul(nx);
            let sum = sum.wrapping_add((*b >> scale).wrapping_mul(ny));
            sum.wrapping_add((*c >> scale).wrapping_mul(nz)) >> 10
        };
        let x = dot(xx, xy, xz);
        let y = dot(xy, yy, yz);
        let z = dot(xz, yz, zz);
        let variance = ((noise >> scale) << 10)
            .wrapping_add(x.wrapping_mul(nx))
            .wrapping_add(y.wrapping_mul(ny))
            .wrapping_add(z.wrapping_mul(nz));
        let Root { mantissa, shift } = reciprocal_root(variance);

        // In standard deviations, Q13.
        let surprise = beside.wrapping_mul(mantissa) >> (2 + half + shift);
        if surprise.wrapping_add(config.gate).cast_unsigned() > config.gate.wrapping_mul(2).cast_unsigned() {
            return Outcome::Refused;
        }

        let told = Told { mantissa, down: 13 + shift - half, surprise };
        let [px, py, pz] = &mut self.position;
        let [pu, pv, pw] = &mut self.velocity;
        let [tx, ty, tz, tu, tv, tw] = &mut self.told;
        told.moves_position(x, tx, px);
        told.moves_position(y, ty, py);
        told.moves_position(z, tz, pz);
        told.moves_velocity(dot(xu, yu, zu), tu, pu);
        told.moves_velocity(dot(xv, yv, zv), tv, pv);
        told.moves_velocity(dot(xw, yw, zw), tw, pw);
        if beside.wrapping_add(LEAP).cast_unsigned() > 2 * LEAP.cast_unsigned() {
            return Outcome::Leapt;
        }
        Outcome::Believed
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
            let ahead = due(now).wrapping_sub(self.spread_at) / PER_HALF_TURN;
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

/// The whole half turn nearest to `now`.
#[inline(always)]
fn due(now: u32) -> u32 {
    now.wrapping_add(PER_HALF_TURN / 2) & !(PER_HALF_TURN - 1)
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

/// What a believed plane has to tell.
struct Told {
    /// Of the reciprocal of the innovation's standard deviation.
    mantissa: i32,
    /// From the product of a covariance with the mantissa to Q16.
    down: u32,
    /// The innovation in standard deviations, Q13.
    surprise: i32,
}

impl Told {
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

/// Whether `value` needs more than `bits` bits and a sign.
#[inline(always)]
fn beyond(value: i32, bits: u32) -> bool {
    (value >> bits).wrapping_add(1).cast_unsigned() > 1
}

/// Every value is in its place in memory here. Costs nothing, and saves the copies on the stack that the compiler would
/// keep of 27 numbers in seven registers: a quarter of the step.
#[inline(always)]
fn home() {
    compiler_fence(Ordering::SeqCst);
}

#[cfg(test)]
mod tests {
    use super::*;
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
            Estimate { position, velocity, told, at: now, spread_at: due(now), ..start }
        }
    }

    proptest! {
        #[test]
        fn a_look_ahead_is_where_the_estimate_will_be(estimate in estimates(), elapsed in 0u32..48 * PER_HALF_TURN) {
            let config = Config::HAND_HELD;
            let now = estimate.at.wrapping_add(elapsed);
            let (position, velocity, variances) = estimate.after(&config, now);
            let mut later = estimate;
            let spread = later.predict(&config, now);
            // Beyond that the track is over.
            prop_assume!(spread <= config.variance_limit);
            prop_assert_eq!(position, later.position.map(|axis| axis >> 8));
            prop_assert_eq!(velocity, later.velocity.map(|axis| (axis * 120) >> 6));
            let [xx, _, _, yy, _, zz] = later.pp;
            prop_assert_eq!(variances, [xx, yy, zz]);
        }
    }
}
