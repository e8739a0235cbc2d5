//! What the core promises, one sentence a test.
//!
//! What can go wrong: these tests and the core are by the same hand. The judge in `tests/judge.rs` is not.

mod board;
mod calls;
mod exceptions;
mod faults;
mod flags;
mod instructions;
mod program;
mod semihosting;
mod system_control;
mod systick;
mod thumb;
mod timing;
