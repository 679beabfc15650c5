//! The collector's end of one stream: its ring, and what is kept of what came out of it.

use std::sync::Arc;

use super::history::{ImageHistory, SeriesHistory};
use crate::ring::{ImageTap, Meter, SeriesTap};
use crate::scene::SourceId;

/// Pictures that are kept for marks to come.
const RECENT_IMAGES: u64 = 8;
/// Pictures that are kept at most.
const MOST_IMAGES: usize = 64;

/// One stream.
pub(super) struct Stream {
    id: SourceId,
    /// Number of its device: streams of one device and one rate share one sample counter.
    pub device: usize,
    buffer: StreamBuffer,
    /// Index after what was sent as traces.
    pub traced: u64,
}

pub(super) enum StreamBuffer {
    Series { tap: SeriesTap, history: SeriesHistory, rate_hz: f64 },
    Images { tap: ImageTap, history: ImageHistory },
}

impl Stream {
    pub fn series(id: SourceId, device: usize, tap: SeriesTap, rate_hz: f64) -> Self {
        let history = SeriesHistory::new(tap.channels());
        Self { id, device, buffer: StreamBuffer::Series { tap, history, rate_hz }, traced: 0 }
    }

    pub fn images(id: SourceId, device: usize, tap: ImageTap) -> Self {
        let history = ImageHistory::default();
        Self { id, device, buffer: StreamBuffer::Images { tap, history }, traced: 0 }
    }

    pub fn id(&self) -> &SourceId {
        &self.id
    }

    pub fn buffer(&self) -> &StreamBuffer {
        &self.buffer
    }

    /// Nominal rate in Hz; of pictures, 0.
    pub fn rate_hz(&self) -> f64 {
        match &self.buffer {
            StreamBuffer::Series { rate_hz, .. } => *rate_hz,
            StreamBuffer::Images { .. } => 0.0,
        }
    }

    pub fn meter(&self) -> &Arc<Meter> {
        match &self.buffer {
            StreamBuffer::Series { tap, .. } => tap.meter(),
            StreamBuffer::Images { tap, .. } => tap.meter(),
        }
    }

    /// Channels of a frame; of a picture, 3.
    pub fn channels(&self) -> usize {
        match &self.buffer {
            StreamBuffer::Series { tap, .. } => tap.channels(),
            StreamBuffer::Images { .. } => 3,
        }
    }

    /// Index after what has come out of the ring.
    pub fn end(&self) -> u64 {
        match &self.buffer {
            StreamBuffer::Series { history, .. } => history.end(),
            StreamBuffer::Images { history, .. } => history.end(),
        }
    }

    /// Index after what was put into the ring.
    pub fn pushed(&self) -> u64 {
        self.meter().counts().pushed
    }

    /// Whether nothing more will come.
    pub fn exhausted(&self) -> bool {
        match &self.buffer {
            StreamBuffer::Series { tap, .. } => tap.exhausted(),
            StreamBuffer::Images { tap, .. } => tap.exhausted(),
        }
    }

    /// Takes all that is in the ring; whether there was anything. A gap that is longer than
    /// `longest_s` seconds is not filled.
    pub fn drain(&mut self, longest_s: f64) -> bool {
        match &mut self.buffer {
            StreamBuffer::Series { tap, history, rate_hz } => {
                let most = (longest_s * *rate_hz) as u64;
                tap.drain(|piece| history.extend(piece, most))
            }
            StreamBuffer::Images { tap, history } => {
                let any = tap.drain(|index, image| history.push(index, image));
                history.reach(tap.position());
                any
            }
        }
    }

    /// Forgets what no scan needs: `needed` is the first index that one does, `rate_hz` that
    /// scan's rate.
    pub fn forget(&mut self, needed: Option<(u64, f64)>, lookback_s: f64, longest_s: f64) {
        match &mut self.buffer {
            StreamBuffer::Series { history, rate_hz, .. } => {
                let back = |seconds: f64, rate_hz: f64| {
                    history.end().saturating_sub((seconds * rate_hz) as u64)
                };
                let lookback = back(lookback_s, *rate_hz);
                let keep = needed.map_or(lookback, |(index, scan_rate_hz)| {
                    index.min(lookback).max(back(longest_s, rate_hz.max(scan_rate_hz)))
                });
                history.forget_before(keep);
            }
            StreamBuffer::Images { history, .. } => {
                let recent = history.end().saturating_sub(RECENT_IMAGES);
                let keep = needed.map_or(recent, |(index, _)| index.min(recent));
                history.forget_before(keep, MOST_IMAGES);
            }
        }
    }
}
