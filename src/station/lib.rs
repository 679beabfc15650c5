//! A station: it streams a stylus, a microphone and a camera, cuts their streams into scans, names
//! each scan's surface by a library, and keeps what it said.
//!
//! ```text
//! device (serial · lines · microphone · camera · replay) ─► ring ─► scan (clock, tap/drag) ─► station
//! ```
//!
//! [`station::Station`] joins scan, recogniser and record, and tells each [`station::Listener`]; it reads
//! its configuration in [`station::config`]. [`history`] keeps past scans. Recordings and methods are those
//! of `surfaced-method`.

#![cfg_attr(not(test), warn(unreachable_pub))]

// Lets helpers in tests/common, which unit tests include too, name this crate as the program does.
#[cfg(test)]
extern crate self as surfaced;

#[cfg(test)]
use surfaced_method::{dataset, features, seed};
use surfaced_method::{
    evaluate, independence, jpeg, library, printable, recognise, record, scene, spectrum, system,
    trial,
};

pub mod device;
pub mod history;
pub mod ring;
pub mod scan;
pub mod station;
