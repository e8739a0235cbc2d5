//! Which pulse of a slot is the sweep.
//!
//! The first that is like one is given away at once where it is about where its rotor's last one was; any other waits for
//! the end of the slot, and the best of them is taken then.
//!
//! What can go wrong: a reflection is where the laser was expected, and is given away. Where a clearly longer pulse follows it
//! in its slot, the next cycle compares.

use super::{Lock, Phase, turn};
use crate::pulse::Pulse;
use crate::sweep::width::{SWEEP_STEPS, Units};
use crate::sweep::{Cause, Closed, Config, Rejects, Stamp, Sweep};
use crate::time::{Span, Ticks};

/// A sweep this near to where its rotor's last one was need not be compared: half turn >> this, 2.8 degrees.
const NEAR_SHIFT: u32 = 6;

/// What the slot that ended last has left to be asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) enum Rest {
    #[default]
    Nothing,
    Dark,
    Sweep,
}

/// The sweeps of one slot of the cycle, which are those of one rotor.
#[derive(Debug, Clone, Copy, Default)]
#[repr(C)]
pub(super) struct Rotor {
    /// Where the last one was, after its flash; 0 where that is not known.
    pub(super) after: u32,
    /// Its width.
    width: u32,
    /// 1 where the last cycle had none.
    missed: u32,
    /// Sweeps understood.
    pub(super) sweeps: u32,
}

impl Lock {
    /// A pulse between the flashes.
    #[inline]
    pub(in crate::sweep) fn laser(&mut self, config: &Config, counts: &mut Rejects, pulse: Pulse) -> Option<Sweep> {
        let width = pulse.width.0;
        let (station, axis) = turn(self.slot);
        let at = match config.stamp {
            Stamp::Middle => pulse.start.after(Span(width / 2)),
            Stamp::Rise => pulse.start,
        };
        let after = at.since(self.trains[station as usize].next).0;
        self.is_sweep(config, counts, at, after, width).then_some(Sweep {
            station,
            axis,
            at,
            since_sync: Span(after),
            half_turn: self.half_turn,
        })
    }

    /// Whether that is where this slot's sweep is expected; if so it is taken.
    #[inline]
    fn is_sweep(&mut self, config: &Config, counts: &mut Rejects, at: Ticks, after: u32, width: u32) -> bool {
        let Units { half_turn, step, .. } = self.units;
        let cause = if self.phase != Phase::Locked {
            Cause::Stray
        } else if width > SWEEP_STEPS * step as u32 {
            Cause::Long
        } else if width < (half_turn * config.shortest_sweep) >> 13 {
            Cause::Short
        } else if after.wrapping_sub((half_turn >> 5) * 5) > (half_turn >> 5) * 22 {
            // The rotor lights 30 to 150 degrees. Two degrees more to either side leave room for its factory phase: the
            // angle stage knows that and draws the exact line.
            Cause::Stray
        } else {
            if self.chosen | self.held != 0 && !self.is_better(counts, at, after, width) {
                return false;
            }
            let rotor = &mut self.rotors[self.slot as usize & 3];
            let far = after.abs_diff(rotor.after);
            if far > half_turn >> NEAR_SHIFT {
                self.hold(counts, at, after, width);
                return false;
            }
            if 2 * width < rotor.width {
                self.hold(counts, at, after, width);
                return false;
            }
            rotor.choose(after, width);
            rotor.sweeps += 1;
            self.chosen = width;
            if self.held != 0 {
                // It waited in vain, and must not wait in the next slot.
                self.held = 0;
                counts.turn_away(Cause::Second);
            }
            // Nobody asked for what the slot before has left; now it would come too late.
            self.rest = Rest::Nothing;
            return true;
        };
        counts.turn_away(cause);
        false
    }

    /// Whether a pulse like a sweep may be it where there was one already.
    #[cold]
    #[inline(never)]
    fn is_better(&mut self, counts: &mut Rejects, at: Ticks, after: u32, width: u32) -> bool {
        if self.chosen == 0 {
            if self.held <= width {
                return true;
            }
            self.hold(counts, at, after, width);
            return false;
        }
        // The wrong one was given away: compare the next time.
        if width > self.chosen + self.chosen / 2 {
            self.rotors[self.slot as usize & 3].after = 0;
        }
        counts.turn_away(Cause::Second);
        false
    }

    /// Keeps the better of two until the slot ends: the clearly longer one, else the one nearer to the expected, or, where
    /// nothing is expected, the longer one.
    #[cold]
    #[inline(never)]
    fn hold(&mut self, counts: &mut Rejects, at: Ticks, after: u32, width: u32) {
        if self.held != 0 {
            counts.turn_away(Cause::Second);
            let expected = self.rotors[self.slot as usize & 3].after;
            let is_alike = expected != 0 && width.abs_diff(self.held) <= self.held / 4;
            let is_better = if is_alike {
                after.abs_diff(expected) < self.held_after.abs_diff(expected)
            } else {
                width > self.held
            };
            if !is_better {
                return;
            }
        }
        (self.held, self.held_after, self.held_at) = (width, after, at);
    }

    /// The slot ends without a sweep: what waited is chosen, and where nothing came, soon nothing is expected.
    #[cold]
    #[inline(never)]
    pub(super) fn close_unchosen(&mut self) {
        let rotor = &mut self.rotors[self.slot as usize & 3];
        if self.held == 0 {
            self.rest = Rest::Dark;
            if rotor.missed != 0 {
                rotor.after = 0;
            }
            rotor.missed = 1;
            return;
        }
        self.rest = Rest::Sweep;
        rotor.choose(self.held_after, core::mem::take(&mut self.held));
        (self.late_slot, self.late_after, self.late_at) = (self.slot, self.held_after, self.held_at);
    }

    #[inline(always)]
    pub(in crate::sweep) fn has_closed(&self) -> bool {
        self.rest != Rest::Nothing
    }

    /// What the slot that ended last has left; said once.
    #[inline]
    pub(in crate::sweep) fn take_closed(&mut self) -> Option<Closed> {
        if self.rest == Rest::Nothing {
            return None;
        }
        match core::mem::take(&mut self.rest) {
            Rest::Nothing => None,
            Rest::Dark => Some(Closed::Dark(self.half_turn)),
            Rest::Sweep => {
                let slot = self.late_slot;
                self.rotors[slot as usize & 3].sweeps += 1;
                let (station, axis) = turn(slot);
                let since_sync = Span(self.late_after);
                Some(Closed::Sweep(Sweep { station, axis, at: self.late_at, since_sync, half_turn: self.half_turn }))
            }
        }
    }
}

impl Rotor {
    fn choose(&mut self, after: u32, width: u32) {
        (self.after, self.width, self.missed) = (after, width, 0);
    }
}
