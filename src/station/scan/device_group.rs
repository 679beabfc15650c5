//! A group holds the streams of one device that show contact, which share a counter and a detector.
//! A tap that two devices sensed gives the constant offset between the times of their groups.

use std::collections::VecDeque;
use std::ops::Range;

use super::detect::{
    Detector, DetectorConfig, DetectorEvent, SensorKind, StreamLevel, hop_frames, hop_s, onset_in,
};
use super::recent_frames::{Stream, StreamBuffer};
use crate::scene::SourceId;

/// Seconds of levels that are kept.
const KEPT_S: f64 = 10.0;
/// The largest offset between two devices that a tap may give, in seconds.
const LARGEST_OFFSET_S: f64 = 0.3;

pub(super) struct DeviceGroup {
    /// For each stream of the group, its index among all streams, and the meter of its level.
    pub channels: Vec<(usize, StreamLevel)>,
    rate_hz: f64,
    pub detector: Detector,
    /// `base` is the index of the first frame of hop 0; `next` is the index of the next frame to take.
    base: u64,
    next: u64,
    /// The highest level over all streams in each of the latest hops, from hop `first` on; `None` for a
    /// hop in a gap.
    levels: VecDeque<Option<f64>>,
    first: u64,
    /// Seconds by which this group's times are later than those of the leading group.
    pub offset_s: f64,
}

impl DeviceGroup {
    /// A group of the `channels` that exist among the streams; `None` if none of them exists.
    pub(super) fn new(
        channels: &[(SourceId, SensorKind)],
        config: DetectorConfig,
        streams: &[Stream],
    ) -> Option<Self> {
        let index = |id: &SourceId| streams.iter().position(|stream| stream.id == *id);
        let found: Vec<(usize, SensorKind)> =
            channels.iter().filter_map(|(id, feel)| Some((index(id)?, *feel))).collect();
        let rate_hz = streams[found.first()?.0].rate_hz;
        let level = |&(at, feel): &(usize, SensorKind)| {
            (at, StreamLevel::new(feel, streams[at].channels, rate_hz))
        };
        Some(Self {
            channels: found.iter().map(level).collect(),
            rate_hz,
            detector: Detector::new(config, hop_s(rate_hz)),
            base: 0,
            next: 0,
            levels: VecDeque::new(),
            first: 0,
            offset_s: 0.0,
        })
    }

    pub(super) fn leader<'a>(&self, streams: &'a [Stream]) -> &'a Stream {
        &streams[self.channels[0].0]
    }

    /// Whether `last` ended a drag only because the data stopped.
    pub(super) fn cut_off(&self, last: DetectorEvent) -> bool {
        let so_far = self.first + self.levels.len() as u64;
        matches!(last, DetectorEvent::End { end, .. } if end == so_far)
    }

    pub(super) fn frame(&self, hop: u64) -> u64 {
        self.base + (hop as f64 * hop_frames(self.rate_hz)).round() as u64
    }

    fn hop(&self, frame: u64) -> u64 {
        (frame.saturating_sub(self.base) as f64 / hop_frames(self.rate_hz)).round() as u64
    }

    pub(super) fn hop_s(&self) -> f64 {
        hop_s(self.rate_hz)
    }

    /// Whether all streams were at rest in each of these hops.
    pub(super) fn was_quiet_in(&self, mut hops: Range<u64>) -> bool {
        hops.all(|hop| {
            let at = hop.checked_sub(self.first).and_then(|at| self.levels.get(at as usize));
            at.copied().flatten().is_some_and(|level| level < self.detector.config.quiet)
        })
    }

    /// Measures the group's offset by a tap that another device sensed at index `frame`, by the clock
    /// of this group's first stream. `onset` is the level at which a tap begins.
    pub(super) fn align(&mut self, frame: u64, onset: f64) {
        let (hop, hop_s) = (self.hop(frame), self.hop_s());
        let reach = (LARGEST_OFFSET_S / hop_s) as u64;
        let window = hop.saturating_sub(reach)..hop + reach;
        if let Some(seen) = onset_in(self.levels.make_contiguous(), self.first, window, onset) {
            self.offset_s = (seen as f64 - hop as f64) * hop_s;
        }
    }

    /// Takes new frames up to the end of the slowest stream that is not silent; returns events.
    pub(super) fn update(&mut self, streams: &[Stream], now_s: f64) -> Vec<DetectorEvent> {
        let rate_hz = self.leader(streams).rate_hz;
        if rate_hz != self.rate_hz {
            // The device has measured its rate, before its first frame.
            self.rate_hz = rate_hz;
            for (at, level) in &mut self.channels {
                *level = StreamLevel::new(level.kind, streams[*at].channels, rate_hz);
            }
            self.detector = Detector::new(self.detector.config, self.hop_s());
        }
        let kept = |stream: &Stream| match &stream.buffer {
            StreamBuffer::Series { history, .. } => history.base,
            StreamBuffer::Images { .. } => 0,
        };
        let alive = |at: usize| Some(&streams[at]).filter(|stream| stream.alive(now_s));
        let channels = || self.channels.iter().filter_map(|(at, _)| alive(*at));
        let from = channels().map(kept).max().unwrap_or(0);
        let Some(end) = channels().map(Stream::end).min().filter(|end| *end > self.next) else {
            return Vec::new();
        };
        if from > self.next {
            // The gap is longer than any scan, so this ends a drag, or restarts after the gap.
            let found = self.detector.finish();
            if found.is_none() {
                self.restart(from);
            }
            return found.into_iter().collect();
        }
        let mut events = Vec::new();
        loop {
            let hop = self.first + self.levels.len() as u64;
            let span = self.frame(hop)..self.frame(hop + 1);
            if span.end > end {
                break;
            }
            let held = self.detector.in_contact();
            let (mut highest, mut pressed) = (None::<f64>, false);
            for (at, level) in &mut self.channels {
                let new = match alive(*at).map(|stream| &stream.buffer) {
                    Some(StreamBuffer::Series { history, .. }) => {
                        let (start, samples) = history.frames(span.clone());
                        let gaps = history.missing_in(span.clone());
                        level.hop(samples, gaps.map(|gap| gap.start - start..gap.end - start), held)
                    }
                    _ => level.hop(&[], [], held),
                };
                highest = highest.into_iter().chain(new).reduce(f64::max);
                let quiet = self.detector.config.quiet;
                pressed |= level.kind == SensorKind::Force && new.is_some_and(|x| x >= quiet);
            }
            self.next = span.end;
            self.levels.push_back(highest);
            if self.levels.len() as f64 * self.hop_s() > KEPT_S {
                self.levels.pop_front();
                self.first += 1;
            }
            let event = self.detector.hop(highest, pressed);
            if self.detector.rest_rose {
                self.channels.iter_mut().for_each(|(_, level)| level.adopt_lowest());
            }
            events.extend(event);
        }
        events
    }

    /// Makes frame `base` the begin of hop 0; forgets levels and noise floors.
    fn restart(&mut self, base: u64) {
        (self.base, self.next, self.first) = (base, base, 0);
        self.levels.clear();
        self.detector = Detector::new(self.detector.config, self.hop_s());
        self.channels.iter_mut().for_each(|(_, level)| level.relearn());
    }
}
