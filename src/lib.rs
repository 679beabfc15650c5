//! Names the surface a sensorised stylus is dragged over, by the kernel two-sample test.
//!
//! Data flow; no folder imports against the arrow:
//!
//! ```text
//! device (serial · microphone · camera · replay) ─► ring ─► scan (clock, tap/drag) ─► recognise (sampling ─► kernel ─► score ─► rank)
//!                                                                  └► record ─► library ◄─ dataset (lmt108 · mat · synth)
//! duration (HSIC, T*) and evaluate (protocols, chart, stress, plan) stand on library + kernel; station joins
//! scan, recognise, duration and record; cli and serve stand on top of all.
//! ```
//!
//! [`scene`] says what the sources are, [`trial`] holds one recorded interaction, [`seed`] makes
//! every draw of randomness repeatable, [`draw`] makes pictures. Decoders, kernels and statistics are pure: no I/O, no
//! clock, no global state.

pub mod cli;
pub mod dataset;
pub mod device;
pub mod draw;
pub mod duration;
pub mod evaluate;
mod jpeg;
pub mod kernel;
pub mod library;
mod printable;
pub mod recognise;
pub mod record;
pub mod ring;
pub mod scan;
pub mod scene;
pub mod seed;
pub mod serve;
pub mod station;
pub mod trial;
