//! A group holds the streams of one device that show contact, which share a counter and a detector.

use std::collections::VecDeque;

use super::detect::{Detector, DetectorConfig, DetectorEvent, HOP_S, SensorKind, StreamLevel};
use super::stream::{Stream, StreamBuffer};
use crate::scene::SourceId;

/// Number of levels that are kept, which cover 10 s.
const KEPT_HOPS: usize = 2_000;

pub(super) struct Group {
    /// For each stream of the group, its index among all streams, and the meter of its level.
    pub channels: Vec<(usize, StreamLevel)>,
    pub rate_hz: f64,
    pub detector: Detector,
    /// `base` is the index of the first frame of hop 0; `next` is the index of the next frame to take.
    base: u64,
    next: u64,
    /// The highest level over all streams in each of the latest hops, from hop `first` on.
    pub levels: VecDeque<f64>,
    pub first: u64,
    /// Seconds by which this group's times are later than those of the leading group.
    pub offset_s: f64,
}

impl Group {
    /// A group of the `channels` that exist among the streams; `None` if none of them exists.
    pub fn new(
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

    /// Sets the group's rate to the rate of its streams. Called before their first frame.
    pub fn follow_rate(&mut self, streams: &[Stream]) {
        self.rate_hz = streams[self.channels[0].0].rate_hz;
        self.channels.iter_mut().for_each(|(_, level)| *level = level.at_rate(self.rate_hz));
    }

    /// Whether `last` ended a drag only because the data stopped.
    pub fn cut_off(&self, last: DetectorEvent) -> bool {
        last == DetectorEvent::End { end: self.first + self.levels.len() as u64 }
    }

    pub fn frame(&self, hop: u64) -> u64 {
        self.base + (hop as f64 * self.rate_hz * HOP_S).round() as u64
    }

    pub fn hop(&self, frame: u64) -> u64 {
        (frame.saturating_sub(self.base) as f64 / (self.rate_hz * HOP_S)).round() as u64
    }

    /// Takes the new frames that all `alive` streams have delivered; returns the events found in them.
    pub fn update(
        &mut self,
        streams: &[Stream],
        alive: impl Fn(usize) -> bool,
    ) -> Vec<DetectorEvent> {
        let kept = |at: usize| match &streams[at].buffer {
            StreamBuffer::Series { history, .. } => history.base,
            StreamBuffer::Images { .. } => 0,
        };
        let channels = || self.channels.iter().map(|(at, _)| *at).filter(|at| alive(*at));
        let from = channels().map(kept).max().unwrap_or(0);
        let Some(end) = channels().map(|at| streams[at].end()).min().filter(|end| *end > self.next)
        else {
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
            let StreamBuffer::Series { history, .. } = &streams[*at].buffer else { continue };
            if !alive(*at) {
                continue;
            }
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
