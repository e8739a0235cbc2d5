//! One channel that many transmit on: which frames come through.
//!
//! IEEE 802.15.4 at 2.4 GHz: 250 kbit/s, 32 us a byte, four bytes of preamble, one of delimiter and one of length before
//! a frame (IEEE 802.15.4-2006, 6.3). Everybody hears everybody, and of frames that overlap none is received: no capture,
//! which real receivers have and which would only help.
//!
//! What can go wrong: nothing; but a radio that hears another too faintly to hold back (a hidden one) is not in here.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap, VecDeque};

use super::csma::Csma;

/// Times, ns.
pub type Nanos = u64;

/// 8 bits at 250 kbit/s.
const BYTE: Nanos = 32_000;
/// Preamble, delimiter and length (IEEE 802.15.4-2006, 6.3).
const BEFORE_FRAME: u64 = 6;
/// Clear channel assessment: 8 symbols of 16 us (6.9.9).
const ASSESSMENT: Nanos = 128_000;
/// From receiving to sending: aTurnaroundTime, 12 symbols (6.4.1).
const TURNAROUND: Nanos = 192_000;

/// How long a frame of `len` bytes, its check sequence included, is on the air.
#[must_use]
pub const fn air_time(len: usize) -> Nanos {
    (BEFORE_FRAME + len as u64) * BYTE
}

/// A frame that a mote wants to send.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Wish {
    /// When it is ready.
    pub at: Nanos,
    /// Whose it is.
    pub mote: u32,
    /// How long it is on the air.
    pub lasts: Nanos,
    /// The fix it belongs to, counted over all motes; none for a frame that is of no fix.
    pub fix: Option<u32>,
}

/// What became of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sent {
    /// The frame.
    pub wish: Wish,
    /// When it was on the air; none if the channel was never free.
    pub from: Option<Nanos>,
    /// Nothing else was.
    pub received: bool,
}

/// Frames that go out as soon as they are ready: a mote without a receiver. Each mote sends one after another.
#[must_use]
pub fn unheard(mut wishes: Vec<Wish>) -> Vec<Sent> {
    wishes.sort_unstable();
    let mut free: BTreeMap<u32, Nanos> = BTreeMap::new();
    let mut sent: Vec<Sent> = wishes
        .into_iter()
        .map(|wish| {
            let free = free.entry(wish.mote).or_default();
            let from = wish.at.max(*free);
            *free = from + wish.lasts;
            Sent { wish, from: Some(from), received: true }
        })
        .collect();
    collide(&mut sent);
    sent
}

/// Frames of motes that listen first: the unslotted CSMA-CA that the nRF52840's firmware runs.
#[must_use]
pub fn listening(mut wishes: Vec<Wish>) -> Vec<Sent> {
    /// A mote that has frames to send.
    struct Mote {
        csma: Csma,
        waiting: VecDeque<usize>,
    }
    wishes.sort_unstable();
    let mut sent: Vec<Sent> = wishes.iter().map(|wish| Sent { wish: *wish, from: None, received: true }).collect();
    let mut motes: BTreeMap<u32, Mote> = BTreeMap::new();
    // Ends of assessments: when, which frame.
    let mut events: BinaryHeap<Reverse<(Nanos, usize)>> = BinaryHeap::new();
    let wait = |us: u32| Nanos::from(us) * 1000 + ASSESSMENT;
    let mut next_wish = 0;
    // The latest end of what was begun to be sent, and beginnings that are still to come.
    let mut busy_until: Nanos = 0;
    let mut begun: VecDeque<(Nanos, Nanos)> = VecDeque::new();
    loop {
        let event = events.peek().map(|Reverse((at, _))| *at);
        if let Some(wish) = wishes.get(next_wish)
            && event.is_none_or(|event| wish.at <= event)
        {
            let mote = motes
                .entry(wish.mote)
                .or_insert_with(|| Mote { csma: Csma::new(wish.mote + 1), waiting: VecDeque::new() });
            mote.waiting.push_back(next_wish);
            if mote.waiting.len() == 1 {
                events.push(Reverse((wish.at + wait(mote.csma.begin()), next_wish)));
            }
            next_wish += 1;
            continue;
        }
        let Some(Reverse((now, index))) = events.pop() else { break };
        while let Some((_, end)) = begun.pop_front_if(|(from, _)| *from <= now) {
            busy_until = busy_until.max(end);
        }
        let Wish { mote, lasts, .. } = wishes[index];
        let Some(mote) = motes.get_mut(&mote) else { continue };
        let over = if busy_until > now - ASSESSMENT {
            // Somebody was on the air during the assessment.
            match mote.csma.again() {
                Some(us) => {
                    events.push(Reverse((now + wait(us), index)));
                    continue;
                }
                None => now,
            }
        } else {
            let from = now + TURNAROUND;
            sent[index].from = Some(from);
            // Events come in the order of time, so these do.
            begun.push_back((from, from + lasts));
            from + lasts
        };
        mote.waiting.pop_front();
        if let Some(&next) = mote.waiting.front() {
            events.push(Reverse((over.max(wishes[next].at) + wait(mote.csma.begin()), next)));
        }
    }
    collide(&mut sent);
    sent
}

/// Finds the frames that overlap another.
fn collide(sent: &mut [Sent]) {
    let mut order: Vec<usize> = (0..sent.len()).collect();
    order.sort_unstable_by_key(|&index| sent[index].from);
    // Of all before: the latest end, and whose.
    let mut latest: Option<(Nanos, usize)> = None;
    for index in order {
        let Some(from) = sent[index].from else {
            sent[index].received = false;
            continue;
        };
        let end = from + sent[index].wish.lasts;
        if let Some((before, other)) = latest
            && from < before
        {
            sent[index].received = false;
            sent[other].received = false;
        }
        if latest.is_none_or(|(before, _)| end > before) {
            latest = Some((end, index));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FRAME: Nanos = 2_304_000;

    fn wish(at: Nanos, mote: u32) -> Wish {
        Wish { at, mote, lasts: FRAME, fix: None }
    }

    fn received(sent: &[Sent]) -> usize {
        sent.iter().filter(|sent| sent.received).count()
    }

    /// Arrivals of a Poisson process: `frames` of them, `load` in the time of one frame.
    fn poisson(frames: u32, load: f64, seed: u64) -> Vec<Wish> {
        let mut dice = fastrand::Rng::with_seed(seed);
        let mut at = 0.0;
        (0..frames)
            .map(|mote| {
                at -= (1.0 - dice.f64()).ln() / load * FRAME as f64;
                wish(at as Nanos, mote)
            })
            .collect()
    }

    /// Six standard deviations of a share of `count`, but collisions come in pairs and more: twice that.
    fn allowance(share: f64, count: u32) -> f64 {
        12.0 * (share * (1.0 - share) / f64::from(count)).sqrt()
    }

    #[test]
    fn a_fix_is_on_the_air_for_its_bytes_and_six_more() {
        assert_eq!(air_time(66), 72 * 8 * 1_000_000_000 / 250_000);
    }

    #[test]
    fn pure_aloha_carries_what_abramson_says() {
        // Of a load G a share e^-2G comes through (Abramson 1970).
        for (seed, load) in [0.05, 0.2, 0.5, 1.0, 2.0].into_iter().enumerate() {
            let share = received(&unheard(poisson(100_000, load, seed as u64))) as f64 / 1e5;
            let theory = (-2.0 * load).exp();
            assert!((share - theory).abs() < allowance(theory, 100_000), "G {load}: {share}, not {theory}");
        }
    }

    #[test]
    fn slotted_aloha_carries_what_roberts_says() {
        // Beginnings in whole slots: e^-G (Roberts 1975).
        for (seed, load) in [0.05, 0.2, 0.5, 1.0, 2.0].into_iter().enumerate() {
            let slot = |wish: Wish| Wish { at: wish.at.next_multiple_of(FRAME), ..wish };
            let wishes = poisson(100_000, load, 100 + seed as u64).into_iter().map(slot).collect();
            let share = received(&unheard(wishes)) as f64 / 1e5;
            let theory = f64::exp(-load);
            assert!((share - theory).abs() < allowance(theory, 100_000), "G {load}: {share}, not {theory}");
        }
    }

    #[test]
    fn frames_that_touch_do_not_overlap() {
        assert_eq!(received(&unheard(vec![wish(0, 1), wish(FRAME, 2)])), 2);
        assert_eq!(received(&unheard(vec![wish(0, 1), wish(FRAME - 1, 2)])), 0);
        // A long one over two short ones.
        let long = Wish { lasts: 3 * FRAME, ..wish(0, 1) };
        assert_eq!(received(&unheard(vec![long, wish(10, 2), wish(10 + FRAME, 3), wish(5 * FRAME, 4)])), 1);
    }

    #[test]
    fn a_mote_is_never_in_its_own_way() {
        for send in [unheard, listening] {
            assert_eq!(received(&send(vec![wish(0, 1), wish(1, 1), wish(2, 1)])), 3);
        }
    }

    #[test]
    fn two_that_listen_collide_where_their_dice_agree() {
        // Ready at the same moment, each waits 0 to 7 periods of 320 us. Assessment and turnaround are one period
        // together: another period later the first is heard, so an eighth of the pairs collide and no others.
        let pairs = 20_000u32;
        let wishes = (0..pairs).flat_map(|pair| {
            let at = Nanos::from(pair) * 100_000_000;
            [wish(at, 0), wish(at, 1)]
        });
        let lost = 2 * pairs as usize - received(&listening(wishes.collect()));
        let share = lost as f64 / f64::from(2 * pairs);
        assert!((share - 0.125).abs() < allowance(0.125, pairs), "{share}");
    }

    #[test]
    fn who_listens_loses_less_and_gives_up_where_there_is_no_room() {
        let wishes: Vec<Wish> = (0..50)
            .flat_map(|mote| (0..200).map(move |n| wish(n * 100_000_000 + u64::from(mote) * 1_234_567, mote)))
            .collect();
        let (deaf, hearing) = (unheard(wishes.clone()), listening(wishes));
        assert!(received(&hearing) > received(&deaf), "{} and {}", received(&hearing), received(&deaf));
        assert!(hearing.iter().any(|sent| sent.from.is_none()));
    }
}
