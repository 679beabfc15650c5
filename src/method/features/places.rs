//! The places of a short series: equal parts of the library's median trial, which say where in it something
//! happens.

use serde::{Deserialize, Serialize};

/// Most places of a series.
const MOST_PLACES: usize = 32;

/// Places exist only if the library's median trial has at most this many samples. Longer trials
/// have frames enough, and to a library of one person, another hand would look like an unknown surface
/// more often: it moves the level at all places.
const MOST_SAMPLES: usize = 128;

/// How a series is cut into places.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Places {
    pub count: usize,
    /// Number of samples in a place; not whole if the series has another rate than the library.
    samples: f64,
}

impl Places {
    /// The places of a recording at `rate_hz`, in a library with trials of `median` samples at
    /// `library_hz`; none if they are long.
    pub(super) fn new(median: usize, library_hz: f64, rate_hz: f64) -> Option<Self> {
        if !(2..=MOST_SAMPLES).contains(&median) {
            return None;
        }
        let samples = median.div_ceil(MOST_PLACES);
        let scaled = samples as f64 * rate_hz / library_hz;
        Some(Self { count: median.div_ceil(samples), samples: scaled })
    }

    /// The place of a sample.
    fn of(&self, sample: usize) -> usize {
        ((sample as f64 + 0.5) / self.samples) as usize
    }
}

/// The sums of the places of a series as it grows.
#[derive(Clone, Debug)]
pub(super) struct GrowingPlaces {
    places: Places,
    /// Number of samples so far.
    samples: usize,
    /// For each place that was reached, the number of its samples, and their sum in each channel.
    sums: Vec<(f32, Vec<f32>)>,
}

impl GrowingPlaces {
    pub(super) fn new(places: Places) -> Self {
        Self { places, samples: 0, sums: Vec::new() }
    }

    /// Adds interleaved samples.
    pub(super) fn extend(&mut self, samples: &[f32], channels: usize) {
        for frame in samples.chunks_exact(channels) {
            let place = self.places.of(self.samples);
            self.samples += 1;
            if place >= self.places.count {
                continue;
            }
            if place >= self.sums.len() {
                self.sums.resize(place + 1, (0.0, vec![0.0; channels]));
            }
            let (count, sums) = &mut self.sums[place];
            *count += 1.0;
            sums.iter_mut().zip(frame).for_each(|(sum, x)| *sum += x);
        }
    }

    /// The mean of each place that was reached, shape (places, channels).
    pub(super) fn means(&self) -> Vec<f32> {
        let mean = |(count, sums): &(f32, Vec<f32>)| {
            let count = count.max(1.0);
            sums.iter().map(move |sum| sum / count).collect::<Vec<_>>()
        };
        self.sums.iter().flat_map(mean).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn placed(samples: &[f32], places: Places) -> Vec<f32> {
        let mut growing = GrowingPlaces::new(places);
        samples.chunks(3).for_each(|some| growing.extend(some, 1));
        growing.means()
    }

    #[test]
    fn places_are_parts_of_the_librarys_trial_at_any_rate() {
        let samples: Vec<f32> = (0..100).map(|i| i as f32).collect();
        let places = Places::new(100, 10.0, 10.0).unwrap();
        let means = placed(&samples, places);
        assert_eq!((places.count, means.len()), (25, 25));
        assert_eq!(means[..2], [1.5, 5.5]);
        let twice: Vec<f32> = (0..200).map(|i| (i / 2) as f32).collect();
        assert_eq!(placed(&twice, Places::new(100, 10.0, 20.0).unwrap()), means);
        assert_eq!(placed(&samples[..5], places), [1.5, 4.0], "as far as it goes");
        assert_eq!(placed(&twice, places).len(), 25, "what is after the last place does not count");
        assert_eq!(Places::new(MOST_SAMPLES + 1, 10.0, 10.0), None);
    }
}
