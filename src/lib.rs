//! Lighthouse positioning on a mote: light edges in, XYZ radio frames out.
#![cfg_attr(not(test), no_std)]
#![forbid(unsafe_code)]

pub mod time;

pub mod edge;

pub mod pulse;

pub mod sweep;

pub mod angle;

pub mod fix;

pub mod frame;

pub mod chain;
