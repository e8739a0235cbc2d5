//! The volume that both stations light, for rooms that declare none.
//!
//! What can go wrong: stations that look away from each other share no view; such a room is refused.

use super::schema::{RoomBox, Station};

/// Tangent of 45 degrees to either side. The rotors light 60, but towards the edge of their light a narrow baseline
/// leaves little parallax, and whoever needs it can declare it.
const VIEW_TANGENT: f64 = 1.0;
/// Nearest distance in front of a station, metres.
const NEAR_M: f64 = 0.3;
/// Farthest: the paper found light up to about 6 m (its figure 10).
const FAR_M: f64 = 6.0;
/// A narrow baseline measures depth badly: no farther than this many baselines and 1 m.
const FAR_BASELINES: f64 = 2.0;
/// Steps of the search grid over view and depth.
const STEPS: u32 = 24;

/// How far a mote is served in a room that declares no volume, metres.
#[must_use]
pub fn reach(stations: &[Station; 2]) -> f64 {
    let [a, b] = stations;
    let baseline = (0..3).map(|k| (a.position[k] - b.position[k]).powi(2)).sum::<f64>().sqrt();
    (1.0 + FAR_BASELINES * baseline).min(FAR_M)
}

/// The box around all points that both stations light within `far` metres; `None` if there are none.
#[must_use]
pub fn shared_view(stations: &[Station; 2], far: f64) -> Option<RoomBox> {
    let [a, b] = stations;
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
                for (axis, at) in point.into_iter().enumerate() {
                    seen.min[axis] = seen.min[axis].min(at);
                    seen.max[axis] = seen.max[axis].max(at);
                }
            }
        }
    }
    found.map(|seen| stations.iter().fold(seen, without))
}

/// The box without the station: cut across the axis where that costs the smallest part.
fn without(seen: RoomBox, station: &Station) -> RoomBox {
    let RoomBox { min, max } = seen;
    let at = station.position;
    if (0..3).any(|axis| at[axis] < min[axis] - NEAR_M || at[axis] > max[axis] + NEAR_M) {
        return seen;
    }
    let cuts = (0..3).flat_map(|axis| {
        let below = (at[axis] - NEAR_M - min[axis]) / (max[axis] - min[axis]);
        let above = (max[axis] - at[axis] - NEAR_M) / (max[axis] - min[axis]);
        [(axis, false, below), (axis, true, above)]
    });
    let best = cuts.max_by(|a, b| a.2.total_cmp(&b.2));
    let mut kept = seen;
    match best {
        Some((axis, false, _)) => kept.max[axis] = at[axis] - NEAR_M,
        Some((axis, true, _)) => kept.min[axis] = at[axis] + NEAR_M,
        None => {}
    }
    kept
}

fn lights(station: &Station, point: &[f64; 3], far: f64) -> bool {
    let c: [f64; 3] =
        station.rotation.map(|row| (0..3).map(|axis| row[axis] * (point[axis] - station.position[axis])).sum());
    (NEAR_M..=far).contains(&c[2]) && c[0].abs() <= VIEW_TANGENT * c[2] && c[1].abs() <= VIEW_TANGENT * c[2]
}
