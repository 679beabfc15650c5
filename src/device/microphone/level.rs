//! Detects a silent or clipped microphone within a second.

/// Rate of every microphone in Hz, the same as in the dataset LMT108.
pub const RATE_HZ: u32 = 44_100;

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SoundLevel {
    #[default]
    Normal,
    /// Pure silence, without the noise that every working microphone has.
    Silent,
    /// Sound that exceeds the converter's range.
    Clipped,
}

/// Samples in a window of 0.4 s. A change of level is reported at the end of a window.
const WINDOW: usize = RATE_HZ as usize * 2 / 5;
/// One step of a 16-bit converter with full scale ±1. Sound with no larger range is silence.
const LAST_BIT: f32 = 1.0 / 32_768.0;
/// Size from which on a sample is at a limit of the converter (127/128 for 8 bits).
const LIMIT: f32 = 0.99;
/// Number of consecutive samples at a limit from which on sound counts as clipped.
const RUN: usize = 3;

/// Watches the level of one channel with full scale ±1.
#[derive(Clone, Debug, Default)]
pub struct LevelWatch {
    /// Number of samples in the present window, and the lowest and highest of them.
    seen: usize,
    range: Option<(f32, f32)>,
    run: usize,
    clipped: bool,
    level: SoundLevel,
}

impl LevelWatch {
    /// Takes samples. Returns the level if it has changed.
    pub fn take(&mut self, samples: &[f32]) -> Option<SoundLevel> {
        let before = self.level;
        for &x in samples {
            let (low, high) = self.range.unwrap_or((x, x));
            self.range = Some((low.min(x), high.max(x)));
            self.run = if x.abs() >= LIMIT { self.run + 1 } else { 0 };
            self.clipped |= self.run >= RUN;
            self.seen += 1;
            if self.seen == WINDOW {
                self.level = match self.range.take() {
                    _ if std::mem::take(&mut self.clipped) => SoundLevel::Clipped,
                    Some((low, high)) if high - low <= LAST_BIT => SoundLevel::Silent,
                    _ => SoundLevel::Normal,
                };
                self.seen = 0;
            }
        }
        (self.level != before).then_some(self.level)
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

    /// Feeds sound in blocks of 10 ms. Returns each new level with its time in seconds.
    fn changes(watch: &mut LevelWatch, samples: &[f32]) -> Vec<(f64, SoundLevel)> {
        let blocks = samples.chunks(RATE / 100).enumerate();
        blocks.filter_map(|(i, block)| Some(((i + 1) as f64 * 0.01, watch.take(block)?))).collect()
    }

    #[test]
    fn a_dead_microphone_is_reported_once_and_within_a_second() {
        let mut watch = LevelWatch::default();
        assert_eq!(changes(&mut watch, &noise(3.0)), []);
        // Constant samples are silence, even if they are not 0.
        let changed = changes(&mut watch, &vec![0.25; 5 * RATE]);
        assert_eq!(changed.len(), 1);
        assert!(changed[0].0 <= 1.0 && changed[0].1 == SoundLevel::Silent, "{changed:?}");
        let changed = changes(&mut watch, &noise(3.0));
        assert_eq!((changed.len(), watch.level), (1, SoundLevel::Normal));
    }

    #[test]
    fn a_clipped_microphone_is_reported_once_and_within_a_second() {
        let mut watch = LevelWatch::default();
        let loud: Vec<_> =
            (0..2 * RATE).map(|i| (2.0 * (i as f32 * 0.02).sin()).clamp(-1.0, 1.0)).collect();
        let changed = changes(&mut watch, &loud);
        assert_eq!(changed.len(), 1);
        assert!(changed[0].0 <= 1.0 && changed[0].1 == SoundLevel::Clipped, "{changed:?}");
    }

    #[test]
    fn a_single_sample_at_the_limit_is_no_clipping() {
        let mut watch = LevelWatch::default();
        let mut samples = noise(2.0);
        samples.iter_mut().step_by(50).for_each(|x| *x = 1.0);
        assert_eq!(changes(&mut watch, &samples), []);
    }

    #[test]
    fn the_size_of_blocks_does_not_matter() {
        let samples = [noise(1.0), vec![0.0; RATE], noise(0.5)].concat();
        for size in [1, 7, 1000, 2 * RATE] {
            let mut watch = LevelWatch::default();
            samples.chunks(size).for_each(|block| {
                watch.take(block);
            });
            assert_eq!(watch.level, SoundLevel::Normal);
        }
    }
}
