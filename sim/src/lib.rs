//! The virtual SCuM-3C and the world of light around it.
pub mod bus;
