//! The times at which the frames of each stream were sampled, on the one time base of a session.

use std::time::{Duration, Instant};

use super::clock::{Clock, ClockSecond};
use super::stream::Stream;

/// A stream that has delivered nothing for this long takes no part in detection.
const SILENT_S: ClockSecond = 0.5;
/// A drag whose streams have delivered nothing for this long is over: longer than any machine
/// suspends a driver.
const GONE_S: ClockSecond = 3.0;

/// The clocks of all streams, in the streams' order.
pub(super) struct Timeline {
    begin: Instant,
    streams: Vec<Arrivals>,
}

/// Arrivals of one stream.
struct Arrivals {
    clock: Clock,
    /// Index after its last frame, and when that arrived.
    end: u64,
    at_s: ClockSecond,
}

impl Timeline {
    pub fn new(streams: &[Stream]) -> Self {
        let arrivals = |stream: &Stream| Arrivals {
            clock: Clock::new(stream.rate_hz()),
            end: 0,
            at_s: f64::NEG_INFINITY,
        };
        Self { begin: Instant::now(), streams: streams.iter().map(arrivals).collect() }
    }

    /// Notes which frames have arrived, and returns the time.
    pub fn observe(&mut self, streams: &[Stream]) -> ClockSecond {
        let now_s = self.now_s();
        for (stream, known) in streams.iter().zip(&mut self.streams) {
            if stream.end() > known.end {
                (known.end, known.at_s) = (stream.end(), now_s);
                known.clock.observe(stream.end(), now_s);
            }
        }
        now_s
    }

    /// Takes over the rates of one device's streams, which have had no frame yet.
    pub fn follow_rates(&mut self, streams: &[Stream], device: usize) {
        let pairs = streams.iter().zip(&mut self.streams);
        for (stream, known) in pairs.filter(|(stream, _)| stream.device == device) {
            known.clock = Clock::new(stream.rate_hz());
        }
    }

    pub fn now_s(&self) -> ClockSecond {
        self.begin.elapsed().as_secs_f64()
    }

    pub fn instant(&self, at_s: ClockSecond) -> Instant {
        self.begin + Duration::from_secs_f64(at_s)
    }

    pub fn alive(&self, stream: usize, now_s: ClockSecond) -> bool {
        now_s - self.streams[stream].at_s <= SILENT_S
    }

    /// Whether a stream's data have been missing long enough to end its drag.
    pub fn gone(&self, stream: usize, now_s: ClockSecond) -> bool {
        now_s - self.streams[stream].at_s > GONE_S
    }

    /// The time at which a frame was sampled; `None` before the stream's first arrival.
    pub fn time_s(&self, stream: usize, frame: u64) -> Option<ClockSecond> {
        self.streams[stream].clock.time_s(frame)
    }

    /// Index of the frame that was sampled at a time; `None` before the stream's first arrival.
    pub fn index_at(&self, stream: usize, time_s: ClockSecond) -> Option<u64> {
        self.streams[stream].clock.index_at(time_s)
    }

    /// Index of the frame that is sampled now; if the stream is silent, of its next frame.
    pub fn index_now(&self, stream: usize, now_s: ClockSecond) -> u64 {
        let by_clock = self.index_at(stream, now_s).filter(|_| self.alive(stream, now_s));
        by_clock.unwrap_or(self.streams[stream].end)
    }
}
