//! Frames as receivers and captures hand them over: bytes in, frames out, and what is none by its cause.
//!
//! Nothing here opens a port or a file or keeps what it has heard, so any bytes can be tried; `fuzz/` does.
//!
//! What can go wrong: see each part. No bytes end a program, and none that should have been a frame goes uncounted.

#![forbid(unsafe_code)]

pub mod capture;
pub mod hdlc;
pub mod receiver;
