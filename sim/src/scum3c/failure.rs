//! What may fail on a chip while the rest of it works.
//!
//! What can go wrong: silicon fails in more ways. These are the ones that a program can still notice.

/// A part that no longer does what it should.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Failure {
    /// The radio timer stands still, whatever it is told.
    Timer,
    /// The radio never says that it is done.
    Radio,
    /// These interrupt lines are active, bit n for line n.
    Lines(u32),
}

impl Failure {
    /// The lines that it holds active.
    pub(super) fn lines(self) -> u32 {
        match self {
            Self::Lines(lines) => lines,
            Self::Timer | Self::Radio => 0,
        }
    }
}
