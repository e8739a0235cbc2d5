//! Lighthouse positioning on a mote: light edges in, XYZ radio frames out.
//!
//! One module a stage, in the order of the path, and [`chain`] over all of them: start there. Every stage is
//! `step(&config, &mut state, input) -> Option<output>`, and the page of each has an example that can be pasted.
#![cfg_attr(not(test), no_std)]
// The tests take the boards' queue along, which cannot do without.
#![cfg_attr(not(test), forbid(unsafe_code))]

pub mod time;

pub mod edge;

pub mod pulse;

pub mod sweep;

pub mod ootx;

pub mod angle;

pub mod fix;

pub mod track;

pub mod frame;

pub mod send;

pub mod identity;

pub mod chain;

#[cfg(test)]
extern crate self as lighthouse_mote;

/// The tests that also run on a Cortex-M0 in QEMU: one file, two harnesses.
#[cfg(test)]
#[path = "../tests"]
mod on_target {
    mod angle;
    mod chain;
    pub(crate) mod cycle;
    mod fix;
    mod frame;
    mod ootx;
    mod pulse;
    mod send;
    mod sweep;
}

/// The tests that need a host.
#[cfg(test)]
#[path = "../tests/host"]
mod on_host {
    mod chain;
    mod clock;
    mod direction;
    mod docs;
    mod mote;
    mod nrf52840;
    mod ootx;
    mod properties;
    mod recordings;
    mod ts4231;
}
