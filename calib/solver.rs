//! The library's solver, for build.rs, which cannot depend on the library it builds.
//!
//! The same files, compiled a second time. Whoever can depend on the library says `use lighthouse_mote::fix as solver`
//! instead.

#![allow(dead_code, unreachable_pub, reason = "each includer uses a part of it")]

#[path = "../src/fix/fast.rs"]
mod fast;
#[path = "../src/fix/general.rs"]
mod general;
#[path = "../src/fix/layout.rs"]
mod layout;
#[path = "../src/fix/reciprocal.rs"]
mod reciprocal;
#[path = "../src/fix/solve.rs"]
mod solve;
#[path = "../src/fix/tan.rs"]
mod tan;
#[path = "../src/fix/walk.rs"]
mod walk;

pub use layout::*;
pub use solve::solve;

/// An ideal rotor angle: 2^20 units per half turn.
pub struct Angle(pub i32);
