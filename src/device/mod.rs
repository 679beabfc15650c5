//! Devices, which produce streams: the stylus, lines of numbers, a microphone, a camera, or a
//! recording that is played.
//!
//! Each is a [`Device`]: it declares its streams, then runs on its own thread, pushes into one ring
//! per stream, and reports its state, and the marks where scans begin and end, through its
//! [`DeviceLink`]. Nothing downstream can distinguish a recording from a sensor.

#[doc(hidden)]
pub mod camera;
#[doc(hidden)]
pub mod lines;
mod link;
pub(crate) mod list;
#[doc(hidden)]
pub mod microphone;
mod open;
mod replay;
#[doc(hidden)]
pub mod serial;

pub use link::{
    Begin, DeviceError, DeviceLink, DeviceReport, DeviceReportKind, DeviceState, Mark, Open,
};
pub use open::OpenError;
pub use replay::{Replay, Speed};

use crate::ring::Sink;
use crate::scene::SourceId;

/// A source of streams.
pub trait Device: Send {
    /// The name of the device, for messages.
    fn name(&self) -> &str;

    /// The streams that it will push, in the order of the sinks that [`Device::run`] gets. Called
    /// once, before it runs; names are unique in a session.
    fn streams(&self) -> Vec<StreamSpec>;

    /// Whether it can wait for its reader. A device that cannot loses data that do not fit; when
    /// all can, nothing in the session is lost or dropped anywhere.
    fn waits(&self) -> bool {
        false
    }

    /// Pushes data until there are no more, or `link` says stop, which it must check every 50 ms or
    /// so. `sinks` holds one sink per stream. Losing the hardware is no reason to return: a driver
    /// reports its state and tries again.
    ///
    /// # Errors
    /// If it cannot continue at all.
    fn run(&mut self, sinks: &mut [Sink], link: &DeviceLink) -> Result<(), DeviceError>;
}

/// One stream of a device.
#[derive(Clone, Debug, PartialEq)]
pub struct StreamSpec {
    /// Its name.
    pub id: SourceId,
    /// The kind of data.
    pub kind: StreamKind,
}

/// The kind of data of a stream.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum StreamKind {
    /// Samples in time.
    Series {
        /// samples per frame
        channels: usize,
        /// nominal rate in Hz, which sizes the ring; the marks of each scan give the actual one
        rate_hz: f64,
    },
    /// Pictures.
    Images,
}
