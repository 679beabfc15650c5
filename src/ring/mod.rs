//! One single-producer, single-consumer ring a stream: from the thread of a device to the collector.
//!
//! A device holds the [`Sink`] and the collector the tap. Frames are counted from
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
mod meter;
mod series;
mod stop;

pub use images::ImageSink;
pub use meter::Counts;
pub use series::SeriesSink;

#[doc(hidden)] // For the project's own tests and tools.
pub use series::{Piece, SeriesTap, series};
#[doc(hidden)]
pub use stop::{Stop, Waker};

pub(crate) use images::{ImageTap, images};
pub(crate) use meter::Meter;
pub(crate) use stop::Stopped;

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
