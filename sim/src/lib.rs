//! The virtual SCuM-3C and the world of light around it.
pub mod bus;
pub mod scum3c;
