//! Devices produce streams of samples. They are the stylus, lines of numbers, microphones, cameras,
//! and played recordings.
//!
//! A [`Device`] declares its streams, runs on its own thread, and pushes samples into one ring
//! buffer per stream. Through its [`DeviceLink`], it reports its state, and the marks where scans
//! begin and end. Nothing downstream can tell a recording from a sensor.

#![allow(missing_docs)] // Names that say everything need no comment.

#[doc(hidden)]
pub mod camera;
#[doc(hidden)]
pub mod lines;
mod link;
pub(crate) mod list;
#[doc(hidden)]
pub mod microphone;
mod replay;
#[doc(hidden)]
pub mod serial;

pub use link::{
    Begin, CutFrom, DeviceError, DeviceLink, DeviceReport, DeviceReportKind, DeviceState, Mark,
    Open, OpenError,
};
pub use replay::{Replay, Speed};

use crate::ring::Sink;
use crate::scene::SourceId;

/// A source of data streams, such as a sensor or a played recording.
pub trait Device: Send {
    fn name(&self) -> &str;

    /// The streams that the device will push, in the order of the sinks of [`Device::run`]. Called
    /// once, before `run`. Names are unique among all devices of a session.
    fn streams(&self) -> Vec<StreamSpec>;

    /// Whether the device can wait until its data are read. A device that cannot wait loses data
    /// that do not fit into a ring. If all devices can wait, the session loses and drops nothing.
    fn waits(&self) -> bool {
        false
    }

    /// Pushes data until there are none left, or until `link` asks to stop (check about every 50
    /// ms). `sinks` holds one sink per stream. A driver that loses its hardware reports this state
    /// and tries again; it does not return.
    /// # Errors
    /// If the device cannot continue at all.
    fn run(&mut self, sinks: &mut [Sink], link: &DeviceLink) -> Result<(), DeviceError>;
}

#[derive(Clone, Debug, PartialEq)]
pub struct StreamSpec {
    pub id: SourceId,
    pub kind: StreamKind,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub enum StreamKind {
    Series {
        /// number of samples per frame
        channels: usize,
        /// nominal rate in Hz, for the size of the ring; a scan's marks give its actual rate
        rate_hz: f64,
    },
    Images,
}

#[cfg(test)]
#[path = "../../tests/common/running.rs"]
mod running;
