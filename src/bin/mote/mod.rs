//! What every board's app is made of, above its registers: the two computing stages, the queues between the tasks, the
//! room, and what is left of a crash. `fault.rs` is for boards that have nothing of their own to do as they go down.
//!
//! Not in the library: a queue between two priorities takes `unsafe`. Each board's binary takes this folder in by path,
//! and so do the host's tests.
//!
//! What can go wrong: each module says its own.
#![allow(dead_code, reason = "no board uses all of it")]

pub mod bytes;
pub mod crumb;
pub mod edges;
pub mod queue;
pub mod room;
#[cfg(feature = "security")]
pub mod seal;
pub mod stages;
