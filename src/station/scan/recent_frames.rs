//! The collector's end of one stream: its ring, and the recent frames that came out of it.

use std::collections::VecDeque;
use std::ops::Range;
use std::sync::Arc;

use super::Options;
use super::clock::Clock;
use crate::device::{StreamKind, StreamSpec};
use crate::ring::{ImageTap, Meter, Piece, Reckoning, SeriesTap, Sink, Waker, images, series};
use crate::scene::SourceId;
use crate::trial::Image;

/// Number of latest pictures that are kept, so that later marks can refer to them.
const RECENT_IMAGES: u64 = 8;
/// Most pictures that are kept, even if a scan needs older ones.
const MOST_IMAGES: usize = 64;
/// A stream that has delivered nothing for this long takes no part in detection.
const SILENT_S: f64 = 0.5;
/// A drag is over if its streams have delivered nothing for this long. The time is longer than any
/// machine suspends a driver.
const GONE_S: f64 = 3.0;

pub(super) struct Stream {
    pub id: SourceId,
    /// Number of its device. Streams of the same device and rate share a sample counter.
    pub device: usize,
    /// Nominal rate in Hz; 0 for pictures.
    pub rate_hz: f64,
    /// Channels of a frame; 3 for pictures.
    pub channels: usize,
    pub buffer: StreamBuffer,
    /// The rate in Hz at which frames come, while that is known to be another than `rate_hz`.
    pub off_pace_hz: Option<f64>,
    /// Index after the last frame that was sent in a trace.
    pub traced: u64,
    /// Tells when each frame was sampled, on the time base of the scan detector.
    pub clock: Clock,
    /// Index after the last frame that the clock has observed, and the time when that frame arrived.
    pub observed: (u64, f64),
}

pub(super) enum StreamBuffer {
    Series { tap: SeriesTap, history: SeriesHistory },
    Images { tap: ImageTap, recent: RecentImages },
}

/// The latest pictures with their indexes; lost pictures are left out.
pub(super) type RecentImages = VecDeque<(u64, Arc<Image>)>;

impl Stream {
    /// Opens the ring of a stream of device number `device`; returns the device's end and the stream.
    pub(super) fn open(
        spec: &StreamSpec,
        device: usize,
        options: &Options,
        waker: Waker,
    ) -> (Sink, Self) {
        let (rate_hz, channels, sink, buffer) = match spec.kind {
            StreamKind::Series { channels, rate_hz } => {
                let capacity = (options.ring_s * rate_hz).ceil() as usize;
                let (sink, tap) = series(channels, capacity, waker);
                let channels = channels.max(1);
                let history = SeriesHistory::new(channels);
                (rate_hz, channels, Sink::Series(sink), StreamBuffer::Series { tap, history })
            }
            StreamKind::Images => {
                let (sink, tap) = images(options.ring_images, waker);
                let recent = RecentImages::new();
                (0.0, 3, Sink::Images(sink), StreamBuffer::Images { tap, recent })
            }
        };
        let (id, clock, observed) = (spec.id.clone(), Clock::new(rate_hz), (0, f64::NEG_INFINITY));
        let (off_pace_hz, traced) = (None, 0);
        let stream =
            Self { id, device, rate_hz, channels, buffer, off_pace_hz, traced, clock, observed };
        (sink, stream)
    }

    /// Takes over a rate that the device has measured, before its first frame.
    pub(super) fn set_rate(&mut self, rate_hz: f64) {
        self.rate_hz = rate_hz;
        self.clock = Clock::new(rate_hz);
    }

    /// Notes that the frames which have come out of the ring since the last call arrived at `now_s`.
    pub(super) fn observe(&mut self, now_s: f64) {
        let end = self.end();
        if end > self.observed.0 {
            self.observed = (end, now_s);
            self.clock.observe(end, now_s);
        }
    }

    pub(super) fn alive(&self, now_s: f64) -> bool {
        now_s - self.observed.1 <= SILENT_S
    }

    /// Whether the stream's data have been missing long enough to end its drag.
    pub(super) fn gone(&self, now_s: f64) -> bool {
        now_s - self.observed.1 > GONE_S
    }

    /// Index of the frame that is sampled now; if the stream is silent, the index of its next frame.
    pub(super) fn index_now(&self, now_s: f64) -> u64 {
        let by_clock = self.clock.index_at(now_s).filter(|_| self.alive(now_s));
        by_clock.unwrap_or(self.observed.0)
    }

    fn reckoning(&self) -> &Reckoning {
        match &self.buffer {
            StreamBuffer::Series { tap, .. } => tap.reckoning(),
            StreamBuffer::Images { tap, .. } => tap.reckoning(),
        }
    }

    pub(super) fn meter(&self) -> &Arc<Meter> {
        &self.reckoning().meter
    }

    /// Index after the last frame that came out of the ring.
    pub(super) fn end(&self) -> u64 {
        self.reckoning().position
    }

    pub(super) fn exhausted(&self) -> bool {
        self.reckoning().exhausted()
    }

    /// Empties the ring; returns whether it held anything. Leaves gaps above `longest_s` unfilled.
    pub(super) fn drain(&mut self, longest_s: f64) -> bool {
        match &mut self.buffer {
            StreamBuffer::Series { tap, history } => {
                let most = (longest_s * self.rate_hz) as u64;
                tap.drain(|piece| history.extend(piece, most))
            }
            StreamBuffer::Images { tap, recent } => {
                tap.drain_images(|index, image| recent.push_back((index, image.clone())))
            }
        }
    }

    /// Forgets frames older than `lookback_s` seconds. `needed` is the first index that a scan needs
    /// and the scan's rate in Hz; frames from there on are kept until they are `longest_s` seconds old.
    pub(super) fn forget(&mut self, needed: Option<(u64, f64)>, lookback_s: f64, longest_s: f64) {
        match &mut self.buffer {
            StreamBuffer::Series { history, .. } => {
                let own_hz = self.rate_hz;
                let back = |seconds: f64, rate_hz: f64| {
                    history.end().saturating_sub((seconds * rate_hz) as u64)
                };
                let lookback = back(lookback_s, own_hz);
                let keep = needed.map_or(lookback, |(index, scan_rate_hz)| {
                    index.min(lookback).max(back(longest_s, own_hz.max(scan_rate_hz)))
                });
                history.forget_before(keep);
            }
            StreamBuffer::Images { tap, recent } => {
                let lookback = tap.position().saturating_sub(RECENT_IMAGES);
                let keep = needed.map_or(lookback, |(index, _)| index.min(lookback));
                let is_old = |(at, _): &(u64, _)| *at < keep;
                while recent.front().is_some_and(is_old) || recent.len() > MOST_IMAGES {
                    recent.pop_front();
                }
            }
        }
    }
}

/// The latest frames of a series. The frame before a gap is repeated to fill the gap, so that an
/// index always means the same moment; the gaps are remembered.
#[derive(Debug)]
pub(super) struct SeriesHistory {
    pub channels: usize,
    pub base: u64,
    samples: Vec<f32>,
    /// The gaps as ranges of indexes, in order; no two of them touch.
    missing: VecDeque<Range<u64>>,
}

impl SeriesHistory {
    pub(super) fn new(channels: usize) -> Self {
        Self { channels, base: 0, samples: Vec::new(), missing: VecDeque::new() }
    }

    pub(super) fn end(&self) -> u64 {
        self.base + (self.samples.len() / self.channels) as u64
    }

    /// The first index of `span` that is kept, and the interleaved samples from there on.
    pub(super) fn frames(&self, span: Range<u64>) -> (u64, &[f32]) {
        let start = span.start.clamp(self.base, self.end());
        let end = span.end.clamp(start, self.end());
        let at = |index: u64| (index - self.base) as usize * self.channels;
        (start, &self.samples[at(start)..at(end)])
    }

    pub(super) fn missing_in(&self, span: Range<u64>) -> impl Iterator<Item = Range<u64>> + '_ {
        // The gaps are in order, and there may be many.
        let first = self.missing.partition_point(|gap| gap.end <= span.start);
        let end = span.end;
        self.missing
            .range(first..)
            .take_while(move |gap| gap.start < end)
            .map(move |gap| gap.start.max(span.start)..gap.end.min(span.end))
            .filter(|gap| gap.start < gap.end)
    }

    /// Adds frames or a gap from the ring. A gap of more than `most` frames is not filled; instead,
    /// all frames before it are forgotten.
    pub(super) fn extend(&mut self, piece: Piece<'_>, most: u64) {
        match piece {
            Piece::Samples(samples) => self.samples.extend_from_slice(samples),
            Piece::Missing(frames) => {
                let (start, end) = (self.end(), self.end() + frames);
                match self.missing.back_mut() {
                    Some(last) if last.end == start => last.end = end,
                    _ => self.missing.push_back(start..end),
                }
                if frames > most {
                    self.samples.clear();
                    self.base = end;
                    return;
                }
                let last = match self.samples.len() {
                    0 => vec![0.0; self.channels],
                    len => self.samples[len - self.channels..].to_vec(),
                };
                for _ in 0..frames {
                    self.samples.extend_from_slice(&last);
                }
            }
        }
        // Many gaps may come in one turn of the collector, so old frames are forgotten here, too.
        if self.samples.len() as u64 / self.channels as u64 > most.saturating_mul(2) {
            self.forget_before(self.end() - most);
        }
    }

    /// Forgets frames before `keep` once they are half of all frames, so that few copies are made.
    pub(super) fn forget_before(&mut self, keep: u64) {
        let old = keep.min(self.end()).saturating_sub(self.base) as usize;
        if old * 2 * self.channels < self.samples.len() || old == 0 {
            return;
        }
        self.samples.drain(..old * self.channels);
        // Gives memory back after a burst.
        if self.samples.capacity() > 8 * self.samples.len() {
            self.samples.shrink_to(2 * self.samples.len());
        }
        self.base += old as u64;
        while self.missing.front().is_some_and(|gap| gap.end <= self.base) {
            self.missing.pop_front();
        }
    }
}

pub(super) fn image(recent: &RecentImages, index: u64) -> Option<&Arc<Image>> {
    recent.iter().find(|(at, _)| *at == index).map(|(_, image)| image)
}

pub(super) fn narrow(samples: &[f32], wide: usize, channels: usize) -> Vec<f32> {
    if wide == channels {
        return samples.to_vec();
    }
    samples.chunks(wide).flat_map(|frame| &frame[..channels]).copied().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gap_keeps_its_length_in_time() {
        let mut history = SeriesHistory::new(2);
        history.extend(Piece::Samples(&[1.0, 2.0]), 100);
        history.extend(Piece::Missing(1), 100);
        history.extend(Piece::Missing(1), 100);
        history.extend(Piece::Samples(&[3.0, 4.0]), 100);
        assert_eq!(history.frames(0..9), (0, &[1.0, 2.0, 1.0, 2.0, 1.0, 2.0, 3.0, 4.0][..]));
        assert_eq!(history.missing_in(2..9).collect::<Vec<_>>(), vec![2..3]);
        assert_eq!(history.missing_in(0..9).collect::<Vec<_>>(), vec![1..3]);
    }

    #[test]
    fn gaps_that_come_all_at_once_fill_no_more_than_twice_the_longest_scan() {
        let mut history = SeriesHistory::new(7);
        for _ in 0..1000 {
            history.extend(Piece::Samples(&[1.0; 7]), 1000);
            history.extend(Piece::Missing(999), 1000);
        }
        assert_eq!(history.end(), 1_000_000);
        assert!(history.end() - history.base <= 2000, "{}", history.base);
        assert!(history.samples.capacity() <= 7 * 8000);
        assert!(history.missing.len() <= 3);
    }

    #[test]
    fn a_gap_that_is_too_long_is_not_filled() {
        let mut history = SeriesHistory::new(1);
        history.extend(Piece::Samples(&[1.0]), 10);
        history.extend(Piece::Missing(1_000_000_000_000), 10);
        history.extend(Piece::Samples(&[2.0]), 10);
        assert_eq!(history.frames(0..u64::MAX), (1_000_000_000_001, &[2.0][..]));
    }

    #[test]
    fn forgetting_leaves_indices_as_they_are() {
        let mut history = SeriesHistory::new(1);
        history.extend(Piece::Samples(&[0.0, 1.0, 2.0, 3.0]), 10);
        history.forget_before(3);
        assert_eq!((history.base, history.frames(3..4)), (3, (3, &[3.0][..])));
    }
}
