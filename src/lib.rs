//! Names the surface a sensorised stylus is dragged over, by the kernel two-sample test.
//!
//! This is the program: web page and API (`serve`), MQTT and HTTP (`outputs`), many stations on one page
//! (`fleet`) and the command line (`cli`). It stands on two packages, whose parts it exports again:
//!
//! ```text
//! surfaced           serve · outputs · fleet · cli
//!    │
//! surfaced-station   device ─► ring ─► scan ─► station ─► history
//!    │
//! surfaced-method    recognise · independence (T*) · evaluate, on features · kernel · library · dataset · record
//! ```
//!
//! No folder imports what stands above it. Whoever works with recordings alone needs only
//! [`surfaced_method`], whose first page has an example.
//!
//! | to | use |
//! |---|---|
//! | keep and read past scans | [`history`] |
//! | run a station with your own devices | [`device::Device`], [`station::Station`], [`station::Listener`] |
//! | all else | [`surfaced_method`] |
//!
//! The defaults of a station (detection, devices, history, enrolment) are in `configs/stylus.toml`, which
//! is embedded; the defaults of a method are in its options.
//!
//! # Stability
//! Before version 1.0, a minor version may change this interface, and `CHANGELOG.md` says so. The items
//! in the tables are meant to stay. [`ring`], [`scan`], [`serve`] and [`outputs`] are public for
//! programs that build their own station, and may change with it. Everything else is private or hidden
//! from these pages: the command line, the drivers, and the parts that only the project's tests and
//! tools use. In the recording format, and in JSON below `/api/v1`, fields are only ever added.

#![cfg_attr(not(test), warn(unreachable_pub))]

#[doc(hidden)]
pub mod cli;
mod fleet;
pub mod outputs;
pub mod serve;

pub use surfaced_method::{
    dataset, evaluate, independence, kernel, library, recognise, record, scene, trial,
};
use surfaced_method::{draw, jpeg, printable};
#[doc(hidden)] // For the project's own tests and tools.
pub use surfaced_method::{features, replication, seed, spectrum};
pub use surfaced_station::{device, history, ring, scan, station};
