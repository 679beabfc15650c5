//! The collector's end of one stream: its ring, and the recent frames that came out of it.

use std::collections::VecDeque;
use std::ops::Range;
use std::sync::Arc;

use crate::ring::{ImageTap, Meter, Piece, SeriesTap};
use crate::scene::SourceId;
use crate::trial::Image;

/// Pictures that are kept for later marks.
const RECENT_IMAGES: u64 = 8;
/// Pictures that are kept at most.
const MOST_IMAGES: usize = 64;

pub(super) struct Stream {
    id: SourceId,
    /// Number of its device: streams of one device and one rate share one sample counter.
    pub device: usize,
    buffer: StreamBuffer,
    /// Index after the last frame that was sent in a trace.
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

    /// Sets the rate of a series, in Hz, before its first frame.
    pub fn set_rate_hz(&mut self, new_hz: f64) {
        if let StreamBuffer::Series { rate_hz, .. } = &mut self.buffer {
            *rate_hz = new_hz;
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

    /// Index after the last frame that came out of the ring.
    pub fn end(&self) -> u64 {
        match &self.buffer {
            StreamBuffer::Series { history, .. } => history.end(),
            StreamBuffer::Images { history, .. } => history.end(),
        }
    }

    /// Index after the last frame that was put into the ring.
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

    /// Takes all that is in the ring, and returns whether there was anything. Gaps longer than
    /// `longest_s` seconds are not filled.
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

    /// Forgets frames older than `lookback_s`, except those from `needed` on (an index, and the
    /// rate in Hz of the scan that needs it), which are kept up to an age of `longest_s`.
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

/// The latest frames of a series. A gap is filled by repeating the frame before it, so that an
/// index always means the same moment; the gaps are remembered.
#[derive(Debug)]
pub struct SeriesHistory {
    channels: usize,
    /// Index of the first frame that is kept.
    base: u64,
    samples: Vec<f32>,
    /// The gaps, in order, not touching each other.
    missing: VecDeque<Range<u64>>,
}

impl SeriesHistory {
    /// An empty history of a stream of `channels` samples a frame.
    pub fn new(channels: usize) -> Self {
        Self { channels, base: 0, samples: Vec::new(), missing: VecDeque::new() }
    }

    pub fn channels(&self) -> usize {
        self.channels
    }

    /// Index of the first frame that is kept.
    pub fn start(&self) -> u64 {
        self.base
    }

    pub fn end(&self) -> u64 {
        self.base + (self.samples.len() / self.channels) as u64
    }

    /// The first index of `span` that is kept, and the interleaved samples from there on.
    pub fn frames(&self, span: Range<u64>) -> (u64, &[f32]) {
        let start = span.start.clamp(self.base, self.end());
        let end = span.end.clamp(start, self.end());
        let at = |index: u64| (index - self.base) as usize * self.channels;
        (start, &self.samples[at(start)..at(end)])
    }

    /// The gaps within `span`.
    pub fn missing_in(&self, span: Range<u64>) -> impl Iterator<Item = Range<u64>> + '_ {
        self.missing
            .iter()
            .map(move |gap| gap.start.max(span.start)..gap.end.min(span.end))
            .filter(|gap| gap.start < gap.end)
    }

    /// Adds frames or a gap that came out of the ring. A gap of more than `most` frames is not
    /// filled: the frames before it are forgotten instead.
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
        // Many gaps may come in one turn, before anything is forgotten.
        if self.samples.len() as u64 / self.channels as u64 > most.saturating_mul(2) {
            self.forget_before(self.end() - most);
        }
    }

    /// Forgets frames before `keep`; in large steps, so that it costs little.
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

#[derive(Debug, Default)]
pub struct ImageHistory {
    images: VecDeque<(u64, Arc<Image>)>,
    end: u64,
}

impl ImageHistory {
    pub fn end(&self) -> u64 {
        self.end
    }

    /// The picture with an index, unless it was lost or forgotten.
    pub fn get(&self, index: u64) -> Option<&Arc<Image>> {
        self.images.iter().find(|(at, _)| *at == index).map(|(_, image)| image)
    }

    pub fn latest(&self) -> Option<&(u64, Arc<Image>)> {
        self.images.back()
    }

    pub(super) fn push(&mut self, index: u64, image: Arc<Image>) {
        self.images.push_back((index, image));
    }

    pub(super) fn reach(&mut self, end: u64) {
        self.end = end;
    }

    /// Forgets pictures before index `keep`, and the oldest beyond `most`.
    pub(super) fn forget_before(&mut self, keep: u64, most: usize) {
        while self.images.front().is_some_and(|(at, _)| *at < keep) || self.images.len() > most {
            self.images.pop_front();
        }
    }
}

/// The first `channels` channels of frames that have `wide` channels.
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
        assert!(history.end() - history.start() <= 2000, "{}", history.start());
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
        assert_eq!((history.start(), history.frames(3..4)), (3, (3, &[3.0][..])));
    }
}
