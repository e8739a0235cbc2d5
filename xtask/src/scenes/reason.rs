//! Why no good fix comes, as the mote's health says it.
//!
//! Some reasons are said outright, some are what stood still or went up from one health frame to the next.
//!
//! What can go wrong: a disturbance shorter than the second between two frames passes unsaid.

use std::collections::BTreeSet;

use lighthouse_mote::frame::{Health, Lock};

/// Refusals within a second that are a reason and no accident: half of the 120 sweeps.
const MANY: u16 = 60;

/// A reason, in the order in which they are printed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Reason {
    /// No pulse at all.
    NoLight,
    /// Light, but not yet a cycle.
    Searching,
    /// The flashes of one station alone, without a name.
    OneStation,
    /// Flashes at the wrong distance.
    Spacing,
    /// Pulses too long for their distance.
    Widths,
    /// Pulses too short for flashes.
    V2,
    /// The cycle is known, no flash of A is.
    ADark,
    /// The same of B.
    BDark,
    /// Flashes, but no sweep of A.
    ANoSweeps,
    /// The same of B.
    BNoSweeps,
    /// A says that it is not who the room's file expects.
    AStranger,
    /// The same of B.
    BStranger,
    /// Angles whose rays miss each other.
    Mismatch,
    /// Angles whose rays meet nowhere in the room.
    Geometry,
    /// Angles that the tracker does not believe.
    Disbelieved,
}

impl std::fmt::Display for Reason {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::NoLight => "no light",
            Self::Searching => "searching",
            Self::OneStation => "one station",
            Self::Spacing => "spacing",
            Self::Widths => "widths",
            Self::V2 => "V2",
            Self::ADark => "A dark",
            Self::BDark => "B dark",
            Self::ANoSweeps => "no sweeps of A",
            Self::BNoSweeps => "no sweeps of B",
            Self::AStranger => "A is another",
            Self::BStranger => "B is another",
            Self::Mismatch => "mismatch",
            Self::Geometry => "geometry",
            Self::Disbelieved => "disbelieved",
        })
    }
}

/// All reasons that one mote gave, in the frames sent from `from_s` on.
pub(super) fn said(health: &[(f64, Health)], from_s: f64) -> BTreeSet<Reason> {
    let since: Vec<&Health> = health.iter().filter(|(sent_s, _)| *sent_s >= from_s).map(|(_, health)| health).collect();
    let mut said: BTreeSet<Reason> = since.iter().filter_map(|health| outright(health.lock)).collect();
    for (station, reason) in [(0, Reason::AStranger), (1, Reason::BStranger)] {
        if since.iter().any(|health| health.stations[station].is_stranger) {
            said.insert(reason);
        }
    }
    for pair in since.windows(2) {
        let [before, after] = pair else { continue };
        if before.lock == Lock::Locked && after.lock == Lock::Locked {
            said.extend(between(before, after));
        }
    }
    said
}

fn outright(lock: Lock) -> Option<Reason> {
    match lock {
        Lock::Locked => None,
        Lock::NoLight => Some(Reason::NoLight),
        Lock::Searching => Some(Reason::Searching),
        Lock::OneStation => Some(Reason::OneStation),
        Lock::Spacing => Some(Reason::Spacing),
        Lock::Widths => Some(Reason::Widths),
        Lock::V2 => Some(Reason::V2),
    }
}

fn between(before: &Health, after: &Health) -> Vec<Reason> {
    let stations = [(0, Reason::ADark, Reason::ANoSweeps), (1, Reason::BDark, Reason::BNoSweeps)];
    let silent = stations.into_iter().filter_map(|(station, dark, no_sweeps)| {
        if before.syncs[station] == after.syncs[station] {
            return Some(dark);
        }
        (before.sweeps[station] == after.sweeps[station]).then_some(no_sweeps)
    });
    let (was, is) = (&before.rejects, &after.rejects);
    let refused = [
        (is.mismatch.wrapping_sub(was.mismatch), Reason::Mismatch),
        (is.geometry.wrapping_sub(was.geometry), Reason::Geometry),
        (is.disbelieved.wrapping_sub(was.disbelieved), Reason::Disbelieved),
    ];
    silent.chain(refused.into_iter().filter_map(|(count, reason)| (count >= MANY).then_some(reason))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn locked(syncs: [u16; 2], sweeps: u16) -> Health {
        Health { lock: Lock::Locked, syncs, sweeps: [[sweeps; 2]; 2], ..Health::default() }
    }

    #[test]
    fn what_stands_still_from_frame_to_frame_is_a_reason() {
        let frames = [(1.0, locked([10, 10], 5)), (2.0, locked([130, 10], 9)), (3.0, locked([250, 130], 9))];
        let reasons: Vec<_> = said(&frames, 0.0).into_iter().collect();
        assert_eq!(reasons, [Reason::BDark, Reason::ANoSweeps, Reason::BNoSweeps]);
        assert!(said(&frames[..1], 0.0).is_empty());
    }

    #[test]
    fn a_search_is_said_outright_and_what_was_before_does_not_count() {
        let dark = |lock| Health { lock, ..Health::default() };
        let frames = [(1.0, dark(Lock::NoLight)), (2.0, dark(Lock::Widths)), (3.0, locked([0; 2], 0))];
        assert_eq!(said(&frames, 0.0).len(), 2);
        assert_eq!(said(&frames, 1.5).into_iter().collect::<Vec<_>>(), [Reason::Widths]);
    }

    #[test]
    fn a_stranger_is_named() {
        let mut health = locked([10, 10], 5);
        health.stations[1].is_stranger = true;
        assert_eq!(said(&[(1.0, health)], 0.0).into_iter().collect::<Vec<_>>(), [Reason::BStranger]);
    }

    #[test]
    fn few_refusals_are_no_reason_and_many_are_across_the_wrap_of_their_count() {
        let refused = |mismatch| {
            let mut health = locked([mismatch; 2], mismatch);
            health.rejects.mismatch = mismatch;
            health
        };
        assert!(said(&[(1.0, refused(0)), (2.0, refused(59))], 0.0).is_empty());
        let wrapped = [(1.0, refused(65_500)), (2.0, refused(64))];
        assert_eq!(said(&wrapped, 0.0).into_iter().collect::<Vec<_>>(), [Reason::Mismatch]);
    }
}
