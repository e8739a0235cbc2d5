//! What keeps a room from being calibrated, with the numbers that show it.
//!
//! What can go wrong: nothing more.

use std::fmt;

/// Station A or B.
fn name(station: usize) -> &'static str {
    ["A", "B"][station.min(1)]
}

fn rotor(axis: usize) -> &'static str {
    ["azimuth", "elevation"][axis.min(1)]
}

/// Why there is no solution. Displayed, each is a sentence for whoever holds the mote.
#[derive(Clone, Debug, PartialEq)]
pub enum Trouble {
    /// A number in the input is none.
    NotANumber {
        /// Which, as `sighting 12` or `truth sample 3`.
        what: String,
    },
    /// A station or rotor that no sighting is of.
    NeverSeen {
        /// 0 is A.
        station: usize,
        /// 0 is azimuth.
        axis: usize,
    },
    /// There are sightings of a rotor, but too few with truth at their time.
    TooFew {
        /// 0 is A.
        station: usize,
        /// 0 is azimuth.
        axis: usize,
        /// Sightings.
        seen: usize,
        /// Sightings with truth.
        paired: usize,
        /// As many are needed.
        needed: usize,
    },
    /// The clocks are to be brought together, and there is too little for chance to be ruled out.
    TooShort {
        /// From the first to the last sighting with truth, seconds.
        length_s: f64,
        /// As long it must be, seconds.
        needed_s: f64,
        /// Where the offset of the clocks was searched, seconds.
        searched: (f64, f64),
    },
    /// The clocks cannot be brought together by a mote that stands still.
    AtRest {
        /// Root mean square, m/s.
        speed_m_per_s: f64,
    },
    /// The offset of the clocks is not known well enough.
    OffsetUnknown {
        /// Standard deviation, seconds.
        sd_s: f64,
    },
    /// The best offset is where the search ended.
    OffsetAtEdge {
        /// Truth clock less mote clock, seconds.
        offset_s: f64,
        /// Where was searched, seconds.
        searched: (f64, f64),
    },
    /// Truth and light of one log are apart by more than any delay.
    TooLate {
        /// How late the truth would be, seconds.
        late_s: f64,
        /// As late it may be, seconds.
        latest_s: f64,
    },
    /// Places are so far apart that they cannot be metres.
    Units {
        /// Longest side of what holds nearly all places.
        extent: f64,
    },
    /// A station comes out too far away to have been seen.
    TooFar {
        /// 0 is A.
        station: usize,
        /// From the middle of the places, metres.
        distance_m: f64,
    },
    /// The places fill too little.
    TooSmall {
        /// Standard deviation along their longest direction, metres.
        extent_m: f64,
        /// As much is needed.
        needed_m: f64,
    },
    /// The places lie along one line.
    Collinear {
        /// Standard deviations along the three directions of the cloud, longest first, metres.
        extents_m: [f64; 3],
    },
    /// The places lie in one plane.
    Coplanar {
        /// Standard deviations along the three directions of the cloud, longest first, metres.
        extents_m: [f64; 3],
    },
    /// Where a station is remains open.
    Unsteady {
        /// 0 is A.
        station: usize,
        /// Standard deviation of its place, metres.
        sd_m: f64,
        /// From the middle of the places, metres.
        distance_m: f64,
        /// Standard deviations along the three directions of the cloud, longest first, metres.
        extents_m: [f64; 3],
    },
    /// The mirror image of the places explains the angles, the places do not.
    Mirrored {
        /// Median residual with the places as they are, degrees.
        median_deg: f64,
        /// With their mirror image.
        mirrored_deg: f64,
    },
    /// No poses explain the angles.
    Unexplained {
        /// Median residual, degrees.
        median_deg: f64,
        /// Share of the sightings that are within a degree, of the station that has fewer.
        share: f64,
    },
    /// A stands where B stood before, and B where A did.
    Swapped {
        /// Mean distance from the places before, metres.
        distance_m: f64,
        /// From the places before with A and B exchanged.
        exchanged_m: f64,
    },
}

impl fmt::Display for Trouble {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let cm = |extents: &[f64; 3]| {
            let [a, b, c] = extents.map(|m| 100.0 * m);
            format!("{a:.1}, {b:.1} and {c:.1} cm (standard deviations)")
        };
        match self {
            Trouble::NotANumber { what } => write!(f, "{what} is not a finite number"),
            Trouble::NeverSeen { station, axis } => write!(
                f,
                "not one sweep of station {}'s {} was seen: is it running, in its own mode (b and c, or A and b with a \
                 cable), and in view?",
                name(*station),
                rotor(*axis)
            ),
            Trouble::TooFew { station, axis, seen, paired, needed } => write!(
                f,
                "station {}'s {} was seen {seen} times, {paired} of them with truth at that time; {needed} are needed: \
                 carry the mote for longer, and check that both recordings cover the same time and, with --truth, that their \
                 clocks are no farther apart than --offset allows",
                name(*station),
                rotor(*axis)
            ),
            Trouble::TooShort { length_s, needed_s, searched: (low, high) } => write!(
                f,
                "only {length_s:.1} s have both light and truth, with their clocks taken to be {low} to {high} s apart, and \
                 where so little belongs in the truth's time can be chance; {needed_s:.0} s are needed: carry the mote for \
                 longer, or, if the clocks are farther apart, search further with --offset"
            ),
            Trouble::AtRest { speed_m_per_s } => write!(
                f,
                "the clocks of truth and mote cannot be brought together because the mote hardly moved ({:.1} cm/s): \
                 carry it about, and check that the truth's units are metres",
                100.0 * speed_m_per_s
            ),
            Trouble::OffsetUnknown { sd_s } => {
                write!(f, "the offset of the clocks is only known to {:.1} ms: move the mote faster", 1000.0 * sd_s)
            }
            Trouble::OffsetAtEdge { offset_s, searched: (low, high) } => write!(
                f,
                "the best offset of the clocks, {offset_s:.2} s, is where the search from {low} to {high} s ended: \
                 search further with --offset"
            ),
            Trouble::TooLate { late_s, latest_s } => write!(
                f,
                "the truth that was recorded with the sweeps fits them best {:.0} ms later, which no motion capture \
                 delays it by ({:.0} ms at most): if it has a clock of its own, give it as --truth",
                1000.0 * late_s,
                1000.0 * latest_s
            ),
            Trouble::Units { extent } => write!(
                f,
                "the truth extends over {extent:.0} m, which no two stations light: are its positions millimetres?"
            ),
            Trouble::TooFar { station, distance_m } => write!(
                f,
                "station {} comes out {distance_m:.1} m from the mote, farther than its light reaches: are the truth's \
                 units metres?",
                name(*station)
            ),
            Trouble::TooSmall { extent_m, needed_m } => write!(
                f,
                "the mote's places spread by {:.2} cm only (standard deviation); {:.0} cm are needed: carry it through \
                 more of the room, and check that the truth's units are metres",
                100.0 * extent_m,
                100.0 * needed_m
            ),
            Trouble::Collinear { extents_m } => write!(
                f,
                "the mote's places lie along one line, spread by {}, and leave open how the stations are turned about \
                 it: move the mote in all directions",
                cm(extents_m)
            ),
            Trouble::Coplanar { extents_m } => write!(
                f,
                "the mote's places lie in one plane, spread by {}: how the rotors err cannot be told from how the \
                 stations stand, and above that plane the room would be wrong: carry the mote up and down as well as to \
                 and fro",
                cm(extents_m)
            ),
            Trouble::Unsteady { station, sd_m, distance_m, extents_m } => write!(
                f,
                "where station {} is remains open by {:.0} cm at {distance_m:.1} m, for the mote's places spread by {} \
                 only: carry it up and down as well as to and fro",
                name(*station),
                100.0 * sd_m,
                cm(extents_m)
            ),
            Trouble::Mirrored { median_deg, mirrored_deg } => write!(
                f,
                "the truth is a mirror image: as it is it misses the angles by {median_deg:.2} deg (median), mirrored \
                 by {mirrored_deg:.2}: its axes are left-handed, or two of them exchanged"
            ),
            Trouble::Unexplained { median_deg, share } => write!(
                f,
                "no two stations explain the angles: the best miss them by {median_deg:.1} deg (median), and {:.0} % of \
                 the sweeps are within 1 deg: is the truth from another take, or of another body?",
                100.0 * share
            ),
            Trouble::Swapped { distance_m, exchanged_m } => write!(
                f,
                "the stations are exchanged: they come out {distance_m:.2} m from where they stood before, but \
                 {exchanged_m:.2} m with A and B exchanged: their modes (b and c, or A and b) were swapped; set them as \
                 before, or take them as they are with --force"
            ),
        }
    }
}

impl std::error::Error for Trouble {}
