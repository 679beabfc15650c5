//! A group holds the streams of one device that show contact, which share a counter and a detector.
//! A tap that two devices sensed gives the constant offset between the times of their groups.

use std::collections::VecDeque;

use super::detect::{
    Detector, DetectorConfig, DetectorEvent, HOP_S, SensorKind, StreamLevel, onset_in,
};
use super::recent_frames::{Stream, StreamBuffer};
use crate::scene::SourceId;

/// Number of levels that are kept, which cover 10 s.
const KEPT_HOPS: usize = 2_000;
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
    /// The highest level over all streams in each of the latest hops, from hop `first` on.
    levels: VecDeque<f64>,
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
            detector: Detector::new(config),
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
        last == DetectorEvent::End { end: self.first + self.levels.len() as u64 }
    }

    pub(super) fn frame(&self, hop: u64) -> u64 {
        self.base + (hop as f64 * self.rate_hz * HOP_S).round() as u64
    }

    fn hop(&self, frame: u64) -> u64 {
        (frame.saturating_sub(self.base) as f64 / (self.rate_hz * HOP_S)).round() as u64
    }

    /// Measures the group's offset by a tap that another device sensed at index `frame`, by the clock
    /// of this group's first stream. `onset` is the level at which a tap begins.
    pub(super) fn align(&mut self, frame: u64, onset: f64) {
        let hop = self.hop(frame);
        let reach = (LARGEST_OFFSET_S / HOP_S) as u64;
        let window = hop.saturating_sub(reach)..hop + reach;
        if let Some(seen) = onset_in(self.levels.make_contiguous(), self.first, window, onset) {
            self.offset_s = (seen as f64 - hop as f64) * HOP_S;
        }
    }

    /// Takes new frames up to the end of the slowest stream that is not silent; returns events.
    pub(super) fn update(&mut self, streams: &[Stream], now_s: f64) -> Vec<DetectorEvent> {
        let rate_hz = self.leader(streams).rate_hz;
        if rate_hz != self.rate_hz {
            // The device has measured its rate, before its first frame.
            self.rate_hz = rate_hz;
            self.channels.iter_mut().for_each(|(_, level)| *level = level.at_rate(rate_hz));
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
        let held = self.detector.in_contact();
        let mut fresh: Vec<f64> = Vec::new();
        for (at, level) in &mut self.channels {
            let Some(StreamBuffer::Series { history, .. }) = alive(*at).map(|s| &s.buffer) else {
                continue;
            };
            let (_, samples) = history.frames(self.next..end);
            let mut hop = 0;
            level.feed(samples, held, |x| {
                match fresh.get_mut(hop) {
                    Some(highest) => *highest = highest.max(x),
                    None => fresh.push(x),
                }
                hop += 1;
            });
        }
        self.next = end;
        // A stream that was silent for a while may complete more or fewer hops than the others. So
        // the sample counter determines the number of hops.
        let count = ((end - self.base) as f64 / (self.rate_hz * HOP_S)) as u64;
        let so_far = self.first + self.levels.len() as u64;
        fresh.resize(count.saturating_sub(so_far) as usize, 0.0);
        let mut events = Vec::new();
        for level in fresh {
            self.levels.push_back(level);
            if self.levels.len() > KEPT_HOPS {
                self.levels.pop_front();
                self.first += 1;
            }
            events.extend(self.detector.hop(level));
        }
        if events.contains(&DetectorEvent::NoiseTimeout) {
            self.channels.iter_mut().for_each(|(_, level)| level.relearn());
        }
        events
    }

    /// Makes frame `base` the begin of hop 0; forgets levels and noise floors.
    fn restart(&mut self, base: u64) {
        (self.base, self.next, self.first) = (base, base, 0);
        self.levels.clear();
        self.detector = Detector::new(self.detector.config);
        self.channels.iter_mut().for_each(|(_, level)| level.relearn());
    }
}
