//! The streams of one device that show contact: they share a sample counter and a detector.

use std::collections::VecDeque;

use super::detect::{Detector, DetectorConfig, DetectorEvent, HOP_S, SensorKind, StreamLevel};
use super::stream::{Stream, StreamBuffer};
use crate::scene::SourceId;

/// Levels that are kept: 10 s.
const KEPT_HOPS: usize = 2_000;

/// The streams of one device that show contact.
pub(super) struct Group {
    /// Index and level of each stream.
    pub channels: Vec<(usize, StreamLevel)>,
    pub rate_hz: f64,
    pub detector: Detector,
    /// Index of the first frame of hop 0, and of the next frame to take.
    base: u64,
    next: u64,
    /// The highest level over all streams in each of the latest hops, from hop `first` on.
    pub levels: VecDeque<f64>,
    pub first: u64,
    /// Seconds by which this group's times are later than those of the leading group.
    pub offset_s: f64,
}

impl Group {
    /// The group of those of `channels` that are among the streams; `None` if there are none.
    pub fn new(
        channels: &[(SourceId, SensorKind)],
        config: DetectorConfig,
        streams: &[Stream],
    ) -> Option<Self> {
        let index = |id: &SourceId| streams.iter().position(|stream| stream.id() == id);
        let found: Vec<(usize, SensorKind)> =
            channels.iter().filter_map(|(id, feel)| Some((index(id)?, *feel))).collect();
        let rate_hz = streams[found.first()?.0].rate_hz();
        let level = |&(at, feel): &(usize, SensorKind)| {
            (at, StreamLevel::new(feel, streams[at].channels(), rate_hz))
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

    /// Sets the group's rate to that of its streams, before any of them has had a frame.
    pub fn follow_rate(&mut self, streams: &[Stream]) {
        self.rate_hz = streams[self.channels[0].0].rate_hz();
        self.channels.iter_mut().for_each(|(_, level)| *level = level.at_rate(self.rate_hz));
    }

    /// Whether a drag ended only because its data stopped.
    pub fn cut_off(&self, last: DetectorEvent) -> bool {
        last == DetectorEvent::End { end: self.first + self.levels.len() as u64 }
    }

    /// Index of the first frame of a hop.
    pub fn frame(&self, hop: u64) -> u64 {
        self.base + (hop as f64 * self.rate_hz * HOP_S).round() as u64
    }

    pub fn hop(&self, frame: u64) -> u64 {
        (frame.saturating_sub(self.base) as f64 / (self.rate_hz * HOP_S)).round() as u64
    }

    /// Takes the new frames that all `alive` streams have delivered.
    pub fn update(
        &mut self,
        streams: &[Stream],
        alive: impl Fn(usize) -> bool,
    ) -> Vec<DetectorEvent> {
        let kept = |at: usize| match streams[at].buffer() {
            StreamBuffer::Series { history, .. } => history.start(),
            StreamBuffer::Images { .. } => 0,
        };
        let channels = || self.channels.iter().map(|(at, _)| *at).filter(|at| alive(*at));
        let from = channels().map(kept).max().unwrap_or(0);
        let Some(end) = channels().map(|at| streams[at].end()).min().filter(|end| *end > self.next)
        else {
            return Vec::new();
        };
        if from > self.next {
            // The gap exceeds any scan: a drag ends here, and the next call begins behind the gap.
            let found = self.detector.finish();
            if found.is_none() {
                self.restart(from);
            }
            return found.into_iter().collect();
        }
        let held = self.detector.in_contact();
        let mut fresh: Vec<f64> = Vec::new();
        for (at, level) in &mut self.channels {
            let StreamBuffer::Series { history, .. } = streams[*at].buffer() else { continue };
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
        // A stream that was silent for a while may finish more or fewer hops than the others, so
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

    /// Counts hops from frame `base` on, and forgets levels and noise floors.
    fn restart(&mut self, base: u64) {
        (self.base, self.next, self.first) = (base, base, 0);
        self.levels.clear();
        self.detector = Detector::new(self.detector.config());
        self.channels.iter_mut().for_each(|(_, level)| level.relearn());
    }
}
