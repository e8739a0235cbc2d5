//! What a mote meets, and when.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use sim::world::Scene;

use crate::scenes::list::Named;

/// Every scene once, and as much clear light as fills it, seconds.
pub(super) const ROUND_S: f64 = 1800.0;
/// The mote is left alone at first, and after each scene at least so long, seconds.
const SETTLE_S: f64 = 3.0;
/// The name of the light between.
pub(super) const CLEAR: &str = "clear";
/// Scenes that need another mote or another pair of stations, by how they begin.
const OTHERS: [&str; 6] = ["light", "clock-", "wrap", "cold-start", "gap-", "bias-drift"];

/// A stretch of light.
#[derive(Debug, Clone)]
pub(super) struct Meeting {
    pub(super) name: String,
    /// Its times count from `from_s`.
    pub(super) scene: Scene,
    /// True seconds.
    pub(super) from_s: f64,
    pub(super) to_s: f64,
    /// The last of its round.
    pub(super) ends_round: bool,
}

/// The order of things.
#[derive(Debug)]
pub(super) struct Plan {
    pub(super) meetings: Vec<Meeting>,
    pub(super) rounds: usize,
    pub(super) scenes_per_round: usize,
    /// The light of the whole life, before anything is met.
    pub(super) clear: Scene,
}

impl Plan {
    /// For `length_s` of mote time with these scenes in `clear` light. Less than a round has only as many scenes as fit.
    pub(super) fn new(length_s: f64, seed: u64, scenes: Vec<Named>, clear: &Scene) -> Self {
        let mut noise = ChaCha8Rng::seed_from_u64(seed);
        // Some more: the last frame is still to come when time is up.
        let whole = Scene { length_s: length_s + 1.0, ..clear.clone() };
        let clear = Scene { length_s, ..clear.clone() };
        let mut deck: Vec<(String, Scene)> = scenes
            .into_iter()
            .filter(|named| !OTHERS.iter().any(|other| named.name.starts_with(other)))
            .filter_map(|mut named| {
                let take = named.takes.drain(..).next()?;
                Some((named.name, take.scene))
            })
            .collect();
        let rounds = (length_s / ROUND_S).round().max(1.0) as usize;
        let round_s = length_s / rounds as f64;
        let mut meetings = Vec::new();
        let mut scenes_per_round = 0;
        for round in 0..rounds {
            shuffle(&mut deck, &mut noise);
            let mut left_s = round_s - SETTLE_S;
            let hand: Vec<_> = deck
                .iter()
                .filter(|(_, scene)| {
                    let fits = scene.length_s + SETTLE_S <= left_s;
                    left_s -= if fits { scene.length_s + SETTLE_S } else { 0.0 };
                    fits
                })
                .collect();
            scenes_per_round = hand.len();
            let clear_s = SETTLE_S + left_s / (hand.len() + 1) as f64;
            let mut at_s = round as f64 * round_s;
            let mut meet = |name: &str, scene: &Scene, length_s: f64| {
                let (from_s, to_s) = (at_s, at_s + length_s);
                meetings.push(Meeting {
                    name: name.to_string(),
                    scene: scene.clone(),
                    from_s,
                    to_s,
                    ends_round: false,
                });
                at_s = to_s;
            };
            meet(CLEAR, &clear, clear_s);
            for (name, scene) in hand {
                meet(name, scene, scene.length_s);
                meet(CLEAR, &clear, clear_s);
            }
            if let Some(last) = meetings.last_mut() {
                last.ends_round = true;
            }
        }
        Self { meetings, rounds, scenes_per_round, clear: whole }
    }

    pub(super) fn rounds_per_hour(&self) -> usize {
        (3600.0 / ROUND_S) as usize
    }
}

fn shuffle<T>(cards: &mut [T], noise: &mut impl Rng) {
    for n in (1..cards.len()).rev() {
        cards.swap(n, (noise.next_u64() % (n as u64 + 1)) as usize);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenes::list;
    use std::collections::BTreeSet;

    #[test]
    fn every_round_of_a_day_has_every_scene_and_no_moment_twice() {
        let plan = Plan::new(86_400.0, 7, list::all(), &Scene::default());
        assert_eq!(plan.rounds, 48);
        let rounds: Vec<&[Meeting]> = plan.meetings.split_inclusive(|meeting| meeting.ends_round).collect();
        let scenes = |round: &[Meeting]| round.iter().map(|meeting| meeting.name.clone()).collect::<BTreeSet<_>>();
        assert_eq!(rounds.len(), 48);
        assert!(rounds.iter().all(|round| scenes(round) == scenes(rounds[0])));
        assert!(scenes(rounds[0]).len() > 30);
        let order = |round: &[Meeting]| round.iter().map(|meeting| meeting.name.clone()).collect::<Vec<_>>();
        assert_ne!(order(rounds[0]), order(rounds[1]));
        assert!(plan.meetings.windows(2).all(|pair| (pair[0].to_s - pair[1].from_s).abs() < 1e-6));
        assert!((plan.meetings.last().map_or(0.0, |last| last.to_s) - 86_400.0).abs() < 1e-6);
    }

    #[test]
    fn half_a_minute_has_what_fits() {
        let plan = Plan::new(30.0, 1, list::all(), &Scene::default());
        assert_eq!(plan.rounds, 1);
        assert!(plan.scenes_per_round >= 1);
        assert!((plan.meetings.last().map_or(0.0, |last| last.to_s) - 30.0).abs() < 1e-6);
    }
}
