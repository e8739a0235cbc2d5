//! What the fix is held against: the same four angles to the same position, the way it is usually written.
//!
//! In floating point, the tangents included, on a processor that has none. Each is the plain textbook form with no
//! tricks of ours, because it stands for what a reader would otherwise have used.
//!
//! What can go wrong: an unfair comparison. The projection matrices are made before, outside of what is counted.

use lighthouse_mote::track::Pose;
use nalgebra::{Matrix3, Matrix3x4, Matrix4, RealField, RowVector4, Vector3, convert};

/// Radians in a half turn, over its angle units.
const RAD_PER_UNIT: f64 = core::f64::consts::PI / (1u32 << 20) as f64;

/// The projection matrices `[R | -R t]` of both stations.
pub struct Room<T: RealField>([Matrix3x4<T>; 2]);

impl<T: RealField + Copy> Room<T> {
    /// From the poses as they are baked.
    pub fn new(stations: &[Pose; 2]) -> Self {
        Self(stations.each_ref().map(|pose| {
            let rotation = pose.axes.map(|entry| f64::from(entry) / f64::from(1 << 15)).transpose();
            let position = pose.position.map(|entry| f64::from(entry) / f64::from(1 << 24));
            let mut projection = Matrix3x4::zeros();
            projection.fixed_view_mut::<3, 3>(0, 0).copy_from(&rotation);
            projection.set_column(3, &-(rotation * position));
            projection.map(convert)
        }))
    }

    /// The four linear equations of the 2020 paper in homogeneous coordinates.
    #[inline(always)]
    fn equations(&self, angles: [i32; 4]) -> Matrix4<T> {
        let mut rows = Matrix4::zeros();
        for (n, units) in angles.into_iter().enumerate() {
            let tangent = convert::<f64, T>(RAD_PER_UNIT).tan_of(units);
            let station = &self.0[n / 2];
            let row: RowVector4<T> = station.row(2) * tangent - station.row(n % 2);
            rows.set_row(n, &row);
        }
        rows
    }

    /// The paper's method: the right singular vector of the smallest singular value.
    #[inline(always)]
    pub fn by_singular_values(&self, angles: [i32; 4]) -> Option<[T; 3]> {
        let vectors = self.equations(angles).svd(false, true).v_t?;
        let last = vectors.row(3);
        Some([last[0] / last[3], last[1] / last[3], last[2] / last[3]])
    }

    /// Least squares through the normal equations.
    #[inline(always)]
    pub fn by_normal_equations(&self, angles: [i32; 4]) -> Option<[T; 3]> {
        let rows = self.equations(angles);
        let known = rows.fixed_columns::<3>(0);
        let right = -rows.column(3);
        let normal: Matrix3<T> = known.transpose() * known;
        let solution: Vector3<T> = normal.cholesky()?.solve(&(known.transpose() * right));
        Some(solution.into())
    }
}

/// The tangent of whole angle units, in the precision of the unit.
trait TangentOf {
    fn tan_of(self, units: i32) -> Self;
}

impl<T: RealField> TangentOf for T {
    #[inline(always)]
    fn tan_of(self, units: i32) -> Self {
        (T::from_i32(units).unwrap_or_else(T::zero) * self).tan()
    }
}
