//! From the air to the desk: one mote or a swarm.
//!
//! Receivers hand over frames, [`model`] makes of them what is known of every mote, and views show that.

pub mod model;
