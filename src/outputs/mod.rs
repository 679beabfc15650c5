//! Answers for other programs, as they come: by HTTP POST to an address, and by MQTT. Both are off
//! unless the configuration names where to.
//!
//! Each output has a bounded queue and a thread of its own, so that nobody holds up the station.
//! What cannot be delivered is tried again, ever more slowly; where the queue is full, the newest
//! answers are dropped, with a warning. Answers carry an `id` that stays, by which a receiver knows
//! one that comes twice.

mod http;
mod mqtt;

pub use http::HttpOutput;
pub use mqtt::MqttOutput;

use std::time::Duration;

/// Answers that wait for one output.
const QUEUE: usize = 256;
/// How long the end of the program waits for answers under way.
const PATIENCE: Duration = Duration::from_secs(2);

/// The time before the next attempt: doubled after each that fails, up to a minute.
#[derive(Debug)]
struct BackOff(Duration);

impl BackOff {
    const FIRST: Duration = Duration::from_millis(500);
    const LONGEST: Duration = Duration::from_secs(60);

    fn new() -> Self {
        Self(Self::FIRST)
    }

    /// How long to wait now.
    fn next(&mut self) -> Duration {
        let now = self.0;
        self.0 = (now * 2).min(Self::LONGEST);
        now
    }

    /// It worked: the next failure is the first again.
    fn reset(&mut self) {
        self.0 = Self::FIRST;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn attempts_grow_rarer_up_to_one_a_minute() {
        let mut back_off = BackOff::new();
        let waits: Vec<u64> = (0..9).map(|_| back_off.next().as_millis() as u64).collect();
        assert_eq!(waits, [500, 1000, 2000, 4000, 8000, 16_000, 32_000, 60_000, 60_000]);
        back_off.reset();
        assert_eq!(back_off.next(), BackOff::FIRST);
    }
}
