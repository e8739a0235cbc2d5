//! Everything a person types, in parts that can be tested without typing.
//!
//! A run goes one way: [`recording`] reads what a real mote once saw, [`light`] rebuilds the edges
//! that the stations must have sent, the virtual mote answers with fixes, [`score`] holds them
//! against the truth and against [`mod@reference`], and [`output`] writes it all down, with the help
//! of [`svg`] and [`pcap`].
//!
//! [`flash`] is the other way out: from a build to a chip. [`listen`] is the way back in: from the air to the desk.

pub mod calib;
pub mod calibrate;
pub mod cycle;
pub mod flash;
pub mod light;
pub mod listen;
pub mod output;
pub mod pcap;
pub mod pulses;
pub mod quantile;
pub mod recording;
pub mod reference;
pub mod score;
pub mod svg;
pub mod swarm;
pub mod trust;
pub mod whole;
