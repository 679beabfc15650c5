//! Notices a microphone that is silent or clipped, within a second.

/// The level of a microphone.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SoundLevel {
    Normal,
    /// Nothing at all: not even the noise that every microphone has.
    Silent,
    /// Louder than the converter's range.
    Clipped,
}

/// Length of a window, in seconds. A level is reported after the first window that it fills.
const WINDOW_S: f64 = 0.4;
/// The last bit of a 16-bit converter, with full scale ±1. Anything smaller is silence.
const LAST_BIT: f32 = 1.0 / 32_768.0;
/// From here on a sample is at the limit, even of an 8-bit converter (127 / 128).
const LIMIT: f32 = 0.99;
/// This many samples in a row at a limit are clipped.
const RUN: usize = 3;

/// Watches the level of one channel.
#[derive(Clone, Debug)]
pub struct LevelWatch {
    window: usize,
    seen: usize,
    low: f32,
    high: f32,
    run: usize,
    clipped: bool,
    level: SoundLevel,
}

impl LevelWatch {
    /// A watch over a channel of `rate_hz` samples a second, in which full scale is ±1.
    pub fn new(rate_hz: f64) -> Self {
        Self {
            window: ((rate_hz * WINDOW_S) as usize).max(1),
            seen: 0,
            low: f32::INFINITY,
            high: f32::NEG_INFINITY,
            run: 0,
            clipped: false,
            level: SoundLevel::Normal,
        }
    }

    /// The level in the last window.
    #[cfg(test)]
    fn level(&self) -> SoundLevel {
        self.level
    }

    /// Takes samples, and returns the new level if it changed.
    pub fn take(&mut self, samples: &[f32]) -> Option<SoundLevel> {
        let before = self.level;
        for &x in samples {
            self.low = self.low.min(x);
            self.high = self.high.max(x);
            self.run = if x.abs() >= LIMIT { self.run + 1 } else { 0 };
            self.clipped |= self.run >= RUN;
            self.seen += 1;
            if self.seen == self.window {
                self.judge();
            }
        }
        (self.level != before).then_some(self.level)
    }

    fn judge(&mut self) {
        self.level = match () {
            () if self.clipped => SoundLevel::Clipped,
            () if self.high - self.low <= LAST_BIT => SoundLevel::Silent,
            () => SoundLevel::Normal,
        };
        (self.seen, self.clipped) = (0, false);
        (self.low, self.high) = (f32::INFINITY, f32::NEG_INFINITY);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RATE: usize = 44_100;

    fn noise(seconds: f64) -> Vec<f32> {
        (0..(seconds * RATE as f64) as usize)
            .map(|i| (i as f32 * 1.7).sin() * 3.0 * LAST_BIT)
            .collect()
    }

    /// The changes within some seconds of sound, each with its time, in blocks of 10 ms.
    fn changes(watch: &mut LevelWatch, samples: &[f32]) -> Vec<(f64, SoundLevel)> {
        let blocks = samples.chunks(RATE / 100).enumerate();
        blocks.filter_map(|(i, block)| Some(((i + 1) as f64 * 0.01, watch.take(block)?))).collect()
    }

    #[test]
    fn a_dead_microphone_is_reported_once_and_within_a_second() {
        let mut watch = LevelWatch::new(RATE as f64);
        assert_eq!(changes(&mut watch, &noise(3.0)), []);
        // A constant offset is no sound.
        let changed = changes(&mut watch, &vec![0.25; 5 * RATE]);
        assert_eq!(changed.len(), 1);
        assert!(changed[0].0 <= 1.0 && changed[0].1 == SoundLevel::Silent, "{changed:?}");
        let changed = changes(&mut watch, &noise(3.0));
        assert_eq!((changed.len(), watch.level()), (1, SoundLevel::Normal));
    }

    #[test]
    fn a_clipped_microphone_is_reported_once_and_within_a_second() {
        let mut watch = LevelWatch::new(RATE as f64);
        let loud: Vec<_> =
            (0..2 * RATE).map(|i| (2.0 * (i as f32 * 0.02).sin()).clamp(-1.0, 1.0)).collect();
        let changed = changes(&mut watch, &loud);
        assert_eq!(changed.len(), 1);
        assert!(changed[0].0 <= 1.0 && changed[0].1 == SoundLevel::Clipped, "{changed:?}");
    }

    #[test]
    fn a_single_sample_at_the_limit_is_no_clipping() {
        let mut watch = LevelWatch::new(RATE as f64);
        let mut samples = noise(2.0);
        samples.iter_mut().step_by(50).for_each(|x| *x = 1.0);
        assert_eq!(changes(&mut watch, &samples), []);
    }

    #[test]
    fn the_size_of_blocks_does_not_matter() {
        let samples = [noise(1.0), vec![0.0; RATE], noise(0.5)].concat();
        for size in [1, 7, 1000, 2 * RATE] {
            let mut watch = LevelWatch::new(RATE as f64);
            samples.chunks(size).for_each(|block| {
                watch.take(block);
            });
            assert_eq!(watch.level(), SoundLevel::Normal);
        }
    }
}
