//! The virtual SCuM-3C and the world of light around it.
//!
//! [`world`] makes edges, [`mote`] takes them and gives frames; [`machine`] is the chip below it, for calling one function
//! and counting what it costs. Each has an example.
#![forbid(unsafe_code)]

pub mod bus;
pub mod core;
pub mod elf;
pub mod machine;
pub mod memory;
pub mod mote;
pub mod scum3c;
pub mod semihosting;
pub mod world;
