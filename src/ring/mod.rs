//! One ring for each stream (one producer, one consumer): from a device's thread to the collector.
//!
//! A device holds the [`Sink`], and the collector the tap, out of which the data come. Frames are
//! counted from the start of the stream, **lost ones included**, so that an index always stands for
//! the same moment, whatever was lost before it. Each frame ends in exactly one of two ways: it
//! comes out of the tap, or the tap reports it as missing, at its place in the order.
//!
//! A producer pushes in one of two ways:
//! - `push` never blocks, for sensors that cannot wait: data that do not fit are lost, and counted;
//! - `push_waiting` waits for room, for sources that can wait: nothing is lost.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use crossbeam_channel::{Receiver, Sender};

mod images;
mod ledger;
mod series;

pub use images::ImageSink;
pub use ledger::Counts;
pub use series::SeriesSink;

#[doc(hidden)] // For the project's own tests and tools.
pub use series::{Piece, SeriesTap, series};

pub(crate) use images::{ImageTap, images};
pub(crate) use ledger::Meter;

/// The end of a ring into which a device puts the data of one stream.
pub enum Sink {
    /// Samples in time.
    Series(SeriesSink),
    /// Pictures.
    Images(ImageSink),
}

impl Sink {
    /// Index of the next frame or image.
    pub fn position(&self) -> u64 {
        match self {
            Self::Series(sink) => sink.position(),
            Self::Images(sink) => sink.position(),
        }
    }

    /// The sink of a series, if it is one.
    pub fn series(&mut self) -> Option<&mut SeriesSink> {
        match self {
            Self::Series(sink) => Some(sink),
            Self::Images(_) => None,
        }
    }

    /// The sink of images, if it is one.
    pub fn images(&mut self) -> Option<&mut ImageSink> {
        match self {
            Self::Images(sink) => Some(sink),
            Self::Series(_) => None,
        }
    }
}

/// A request that threads end; clones share it.
#[derive(Clone, Debug, Default)]
pub struct Stop(Arc<AtomicBool>);

impl Stop {
    /// Requests the end; there is no way back.
    pub fn request(&self) {
        self.0.store(true, Ordering::Release);
    }

    /// Whether the end was requested.
    pub(crate) fn requested(&self) -> bool {
        self.0.load(Ordering::Acquire)
    }
}

/// The wait ended because the end was requested.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("stopped")]
pub struct Stopped;

/// Wakes the thread that empties the rings; clones wake the same one.
#[derive(Clone, Debug)]
pub struct Waker(Sender<()>);

impl Waker {
    /// A waker, and the channel on which its thread waits.
    pub fn new() -> (Self, Receiver<()>) {
        let (sender, receiver) = crossbeam_channel::bounded(1);
        (Self(sender), receiver)
    }

    /// Wakes the thread, now or when it next waits. Never blocks.
    pub(crate) fn wake(&self) {
        // A full channel: the thread is about to wake; a disconnected one: it has ended.
        let _ = self.0.try_send(());
    }
}
