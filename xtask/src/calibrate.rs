//! From sweeps and truth to a room.
//!
//! What can go wrong: see [`solve`]; each way has a name and the numbers that show it.

pub mod solve;
