//! A ring for each stream carries data from a device's thread to the collector.
//!
//! A device puts frames into the [`Sink`], and the collector takes them out of the tap. Frames are
//! counted from the start of the stream, **lost frames included**, so that an index always stands
//! for the same moment. Each frame ends in exactly one of two ways: it comes out of the tap, or the
//! tap reports it as missing, at its place in the order.
//!
//! A producer pushes in one of two ways:
//! - `push` never blocks, for sensors that cannot wait, so data that do not fit are lost and counted;
//! - `push_waiting` waits for room, for sources that can wait, so nothing is lost.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use crossbeam_channel::{Receiver, Sender};

mod ledger;
mod series;

pub use ledger::Counts;
pub use series::{ImageSink, RingSink, SeriesSink};

#[doc(hidden)] // For the project's own tests and tools.
pub use series::{Piece, SeriesTap, series};

pub(crate) use ledger::{Meter, Reckoning};
pub(crate) use series::{ImageTap, images};

/// The end of a ring into which a device puts the data of one stream.
pub enum Sink {
    Series(SeriesSink),
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

    pub fn series(&mut self) -> Option<&mut SeriesSink> {
        match self {
            Self::Series(sink) => Some(sink),
            Self::Images(_) => None,
        }
    }

    pub fn images(&mut self) -> Option<&mut ImageSink> {
        match self {
            Self::Images(sink) => Some(sink),
            Self::Series(_) => None,
        }
    }
}

/// Asks threads to end; all clones share the request.
#[derive(Clone, Debug, Default)]
pub struct Stop(Arc<AtomicBool>);

impl Stop {
    pub fn request(&self) {
        self.0.store(true, Ordering::Release);
    }

    pub(crate) fn requested(&self) -> bool {
        self.0.load(Ordering::Acquire)
    }
}

/// A wait ended because a stop was requested.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("stopped")]
pub struct Stopped;

/// Wakes the thread that empties the rings; all clones wake the same thread.
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
        // An error means that a wake-up waits already or that the thread has ended, so it is ignored.
        let _ = self.0.try_send(());
    }
}
