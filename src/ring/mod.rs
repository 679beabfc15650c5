//! One single-producer, single-consumer ring a stream: from the thread of a device to the collector.
//!
//! A device holds the [`Sink`] and the collector the tap ([`SeriesTap`], [`ImageTap`]). Frames are counted from
//! the start of the stream, **lost ones included**, so that an index always stands for the same
//! moment, whatever was lost before it. Each frame ends in exactly one of two ways: it comes out
//! of the tap, or the tap says that it is missing, at its place and in its order.
//!
//! A producer pushes in one of two manners:
//! - `push` never blocks, for sensors that do not stop for anybody: what does not fit is
//!   lost, and counted;
//! - `push_waiting` waits for room, for what can wait: nothing is lost.

mod images;
mod ledger;
mod series;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use crossbeam_channel::{Receiver, Sender};

pub use images::{ImageSink, ImageTap, images};
pub use series::{Piece, SeriesSink, SeriesTap, series};

/// The longest time for which a waiting producer relies on being woken.
const NAP: Duration = Duration::from_millis(2);

/// A request that threads end; clones share it.
#[derive(Clone, Debug, Default)]
pub struct Stop(Arc<AtomicBool>);

impl Stop {
    /// Requests the end; there is no way back.
    pub fn request(&self) {
        self.0.store(true, Ordering::Release);
    }

    /// Whether the end was requested.
    pub fn requested(&self) -> bool {
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
    /// A waker, and what its thread waits on.
    pub fn new() -> (Self, Receiver<()>) {
        let (sender, receiver) = crossbeam_channel::bounded(1);
        (Self(sender), receiver)
    }

    /// Wakes the thread, now or when it next waits. Never blocks.
    pub fn wake(&self) {
        // Full means that it is about to wake; disconnected, that the thread has ended.
        let _ = self.0.try_send(());
    }
}

/// What one ring has carried, readable from any thread while it works.
///
/// Counts are in frames (one sample of every channel) or images.
#[derive(Debug)]
pub struct Meter {
    capacity: u64,
    /// Index of the next frame: all that were pushed or lost so far.
    head: AtomicU64,
    lost: AtomicU64,
    received: AtomicU64,
    closed: AtomicBool,
    waiting: AtomicBool,
}

/// The figures of a [`Meter`] at one moment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct Counts {
    /// Frames offered by the device: those in the ring, those that left it, and those lost.
    pub pushed: u64,
    /// Frames that came out of the ring.
    pub received: u64,
    /// Frames that never entered it: no room, or never arrived at the device.
    pub lost: u64,
    /// Frames in the ring now.
    pub fill: u64,
    /// Frames that the ring can hold.
    pub capacity: u64,
}

impl Meter {
    fn new(capacity: usize) -> Arc<Self> {
        Arc::new(Self {
            capacity: capacity as u64,
            head: AtomicU64::new(0),
            lost: AtomicU64::new(0),
            received: AtomicU64::new(0),
            closed: AtomicBool::new(false),
            waiting: AtomicBool::new(false),
        })
    }

    /// The figures now. While frames move, `fill` may be off by those in motion; once the stream
    /// is closed and emptied, `pushed = received + lost` exactly.
    pub fn counts(&self) -> Counts {
        let received = self.received.load(Ordering::Acquire);
        let lost = self.lost.load(Ordering::Acquire);
        let pushed = self.head.load(Ordering::Acquire);
        let fill = pushed.saturating_sub(lost + received).min(self.capacity);
        Counts { pushed, received, lost, fill, capacity: self.capacity }
    }
}

/// Where a device puts the data of one stream.
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
