//! The calibration files and what becomes of them, read by the same code as the build.
//!
//! What can go wrong: see each part; every complaint names file, line, field and value.

#[path = "../../calib/firmware.rs"]
pub mod firmware;
#[path = "../../calib/key.rs"]
pub mod key;
#[path = "../../calib/quantise.rs"]
pub mod quantise;
#[path = "../../calib/schema.rs"]
pub mod schema;
#[path = "../../calib/volume.rs"]
pub mod volume;

pub use lighthouse_mote::fix as solver;
pub use schema::Calibration;

// The room's file is read where the library is not there yet.
const _: () = assert!(schema::SEALED_HALF_TURNS == lighthouse_mote::send::SEALING_HALF_TURNS as u16);
