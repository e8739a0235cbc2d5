//! The volume that both stations light, for rooms that declare none.
//!
//! What can go wrong: stations that look away from each other share no view; such a room is refused.

use super::schema::{RoomBox, Station};

/// Tangent of the 60 degrees that a rotor lights to either side.
const VIEW_TANGENT: f64 = 1.732;
/// Nearest distance in front of a station, metres.
const NEAR_M: f64 = 0.3;
/// Farthest: the paper found light up to about 6 m (its figure 10).
const FAR_M: f64 = 6.0;
/// A narrow baseline measures depth badly: no farther than this many baselines and 1.5 m.
const FAR_BASELINES: f64 = 2.0;
/// Steps of the search grid over view and depth.
const STEPS: u32 = 24;

/// The box around all points that both stations light; `None` if there are none.
#[must_use]
pub fn shared_view(stations: &[Station; 2]) -> Option<RoomBox> {
    let [a, b] = stations;
    let baseline = (0..3).map(|k| (a.position[k] - b.position[k]).powi(2)).sum::<f64>().sqrt();
    let far = (1.5 + FAR_BASELINES * baseline).min(FAR_M);
    let mut found: Option<RoomBox> = None;
    let step = |index: u32, from: f64, to: f64| from + (to - from) * f64::from(index) / f64::from(STEPS);
    for i in 0..=STEPS {
        for j in 0..=STEPS {
            for k in 0..=STEPS {
                let depth = step(k, NEAR_M, far);
                let c =
                    [step(i, -VIEW_TANGENT, VIEW_TANGENT) * depth, step(j, -VIEW_TANGENT, VIEW_TANGENT) * depth, depth];
                let point: [f64; 3] = core::array::from_fn(|axis| {
                    a.position[axis] + (0..3).map(|r| a.rotation[r][axis] * c[r]).sum::<f64>()
                });
                if !lights(b, &point, far) {
                    continue;
                }
                let seen = found.get_or_insert(RoomBox { min: point, max: point });
                for axis in 0..3 {
                    seen.min[axis] = seen.min[axis].min(point[axis]);
                    seen.max[axis] = seen.max[axis].max(point[axis]);
                }
            }
        }
    }
    found
}

fn lights(station: &Station, point: &[f64; 3], far: f64) -> bool {
    let c: [f64; 3] =
        station.rotation.map(|row| (0..3).map(|axis| row[axis] * (point[axis] - station.position[axis])).sum());
    (NEAR_M..=far).contains(&c[2]) && c[0].abs() <= VIEW_TANGENT * c[2] && c[1].abs() <= VIEW_TANGENT * c[2]
}
