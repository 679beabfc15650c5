//! Compares a stream with the clock: how many frames an interruption cost, which of them were only
//! late, and whether the stream runs at its rate at all.

/// The largest drift between two clocks; usually it is far less.
const DRIFT: f64 = 500e-6;
/// A difference smaller than this, in seconds, is a delay and not a loss.
const DELAY_S: f64 = 0.05;
/// The most sound that a stream may bring at once when it begins, in seconds.
const BURST_S: f64 = 4.0;
/// The time for which the pace of a new stream is watched, in seconds.
const TRIAL_S: f64 = 5.0;

/// Follows when frames arrive.
///
/// A frame can come late but not early. So the begin of the stream is estimated as the least
/// difference between a frame's arrival and its own time; a difference that is larger by more than
/// the usual delay means that frames are missing. After frames were counted as missing, a smaller
/// difference means that they were only late. The estimate must not follow such late sound, or it
/// would count the same time again at each interruption.
#[derive(Clone, Debug)]
pub struct Pace {
    rate_hz: f64,
    /// The estimated begin in seconds, and when it was last updated.
    begin: Option<(f64, f64)>,
    /// Moment and position of the first arrival.
    first: Option<(f64, u64)>,
    /// Frames that were counted as missing, and may yet turn out to be only late.
    skipped: u64,
}

impl Pace {
    /// The pace of a stream with `rate_hz` frames a second.
    pub fn new(rate_hz: f64) -> Self {
        Self { rate_hz, begin: None, first: None, skipped: 0 }
    }

    /// Notes that the stream was reopened: it may begin with old frames from a buffer.
    pub fn reopened(&mut self) {
        self.first = None;
    }

    /// Frames arrived at `now_s`, the last of which is number `position`, lost ones included.
    pub fn arrived(&mut self, now_s: f64, position: u64) {
        let seems = now_s - position as f64 / self.rate_hz;
        let begin = match self.begin {
            None => seems,
            Some((begin, at_s)) => {
                let drift = DRIFT * (now_s - at_s);
                let earliest = if self.skipped > 0 { begin - drift } else { f64::NEG_INFINITY };
                seems.min(begin + drift).max(earliest)
            }
        };
        self.begin = Some((begin, now_s));
        self.first.get_or_insert((now_s, position));
    }

    /// How many frames an interruption cost, when the first frames after it have arrived at `now_s`
    /// and `position` does not yet count any as lost. An estimate, off by the delay of that
    /// arrival: a few milliseconds.
    pub fn missing(&self, now_s: f64, position: u64) -> u64 {
        let Some((begin, at_s)) = self.begin else { return 0 };
        let late_s = now_s - position as f64 / self.rate_hz - begin - DRIFT * (now_s - at_s);
        (late_s * self.rate_hz).max(0.0) as u64
    }

    /// The same, or 0 if that may be a mere delay.
    pub fn missing_for_sure(&self, now_s: f64, position: u64) -> u64 {
        let missing = self.missing(now_s, position);
        if missing as f64 >= DELAY_S * self.rate_hz { missing } else { 0 }
    }

    /// Notes frames that were counted as missing by [`missing`](Self::missing).
    pub fn skipped(&mut self, frames: u64) {
        self.skipped += frames;
    }

    /// How many of the frames counted as missing were only late: as many as explain why frames up
    /// to number `position` arrive at `now_s`, before they can have been recorded.
    pub fn late(&self, now_s: f64, position: u64) -> u64 {
        let Some((begin, at_s)) = self.begin else { return 0 };
        let early_s = begin - (now_s - position as f64 / self.rate_hz) - DRIFT * (now_s - at_s);
        let early = if early_s >= DELAY_S { (early_s * self.rate_hz) as u64 } else { 0 };
        early.min(self.skipped)
    }

    /// Notes that late frames, which had been counted as missing, were dropped.
    pub fn came_late(&mut self, frames: u64) {
        self.skipped = self.skipped.saturating_sub(frames);
    }

    /// Whether frames come much faster than real time, as they do from ALSA's null device.
    pub fn unpaced(&self, now_s: f64, position: u64) -> bool {
        let Some((first_s, first)) = self.first else { return false };
        let (elapsed_s, frames) = (now_s - first_s, position.saturating_sub(first));
        elapsed_s < TRIAL_S && frames as f64 / self.rate_hz > elapsed_s + BURST_S
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RATE_HZ: f64 = 44_100.0;
    const BLOCK: u64 = 441;

    /// Runs for some seconds on a clock that is off by `drift`, and with a delay that changes.
    fn run(pace: &mut Pace, from: (f64, u64), seconds: f64, drift: f64) -> (f64, u64) {
        let (mut now_s, mut position) = from;
        for i in 0..(seconds * 100.0) as u64 {
            now_s += 0.01 * (1.0 + drift);
            position += BLOCK;
            pace.arrived(now_s + (i * 7 % 11) as f64 * 0.0005, position);
        }
        (now_s, position)
    }

    #[test]
    fn an_interruption_is_measured_to_within_ten_milliseconds() {
        for drift in [-100e-6, 0.0, 100e-6] {
            let mut pace = Pace::new(RATE_HZ);
            let (now_s, position) = run(&mut pace, (5.0, 0), 600.0, drift);
            assert_eq!(pace.missing(now_s + 0.01, position + BLOCK) / 441, 0);
            let missing = pace.missing(now_s + 2.01, position + BLOCK) as f64 / RATE_HZ;
            assert!((missing - 2.0).abs() < 0.01, "{missing}");
        }
    }

    #[test]
    fn after_the_loss_is_counted_nothing_is_missing_any_more() {
        let mut pace = Pace::new(RATE_HZ);
        let (now_s, position) = run(&mut pace, (0.0, 0), 10.0, 0.0);
        let position = position + BLOCK + pace.missing(now_s + 3.0, position + BLOCK);
        pace.arrived(now_s + 3.0, position);
        let (now_s, position) = run(&mut pace, (now_s + 3.0, position), 10.0, 0.0);
        assert!(pace.missing(now_s + 0.01, position + BLOCK) < 441);
    }

    #[test]
    fn a_stream_without_a_pace_is_distinguished_from_one_that_begins_with_a_full_buffer() {
        let mut pace = Pace::new(RATE_HZ);
        pace.arrived(0.0, 441);
        assert!(!pace.unpaced(0.1, 2 * 44_100));
        assert!(pace.unpaced(0.5, 10 * 44_100));
        let (now_s, position) = run(&mut pace, (0.0, 441), 4.0, 0.0);
        assert!(!pace.unpaced(now_s, position));
    }
}
