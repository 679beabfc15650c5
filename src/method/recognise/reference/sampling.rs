//! Draws the samples of a source (README §2, step 1; the paper's Fig. 4) in its domain: time, spectrum
//! or pixels.

use ndarray::Array2;
use rand::RngExt;
use rand::seq::index;

use crate::features::hsv;
use crate::scene::{Colour, Domain, SourceId, SourceSpec};
use crate::seed;
use crate::spectrum::amplitude_spectrum;
use crate::trial::{Image, Signal};

/// Number of rows in the grid of pixels drawn from an image.
const IMAGE_ROWS: usize = 25;
const IMAGE_COLS: usize = 16;
const IMAGE_ROW_STEP: usize = 17;
const IMAGE_COL_STEP: usize = 18;
/// The origin of the grid lies in the first 55 rows and 32 columns.
const IMAGE_ORIGINS: (usize, usize) = (55, 32);
/// The first sample lies within this share of a time series, at its beginning.
const START_SHARE: f64 = 0.0115;

/// The grid of pixels from origin row `a0` and column `b0`, both counted from 1 as in the paper. Rows
/// vary fastest. The order matters, since σ is computed from the first samples.
pub fn image_grid(a0: usize, b0: usize) -> Vec<usize> {
    let pixels = (0..IMAGE_COLS).flat_map(|col| {
        (0..IMAGE_ROWS).map(move |row| {
            (a0 - 1 + row * IMAGE_ROW_STEP) * Image::COLS + (b0 - 1 + col * IMAGE_COL_STEP)
        })
    });
    pixels.collect()
}

/// All samples of one source in its domain, to draw from.
#[derive(Clone, Debug)]
pub enum DomainSamples {
    /// Shape (frames, channels).
    Time(Array2<f32>),
    /// Amplitudes, shape (bins, channels).
    Spectrum(Array2<f32>),
    /// Pixels; drawn pixels are converted to the colour channels to compare.
    Pixels(Image, Colour),
}

impl DomainSamples {
    /// The first `frames` frames of a signal, in the domain that the source's description asks for.
    pub fn new(spec: &SourceSpec, signal: &Signal, frames: usize) -> Self {
        let series = match signal {
            Signal::Image(image) => return Self::Pixels(image.clone(), spec.colour),
            Signal::Series(series) => series.crop(0, frames),
        };
        let Domain::Spectrum { band_hz } = spec.domain else {
            return Self::Time(series.view().to_owned());
        };
        let spectrum = |c| amplitude_spectrum(series.channel(c), series.rate_hz(), band_hz);
        let spectra: Vec<_> = (0..series.channels()).map(spectrum).collect();
        let shape = (spectra[0].len(), spectra.len());
        Self::Spectrum(Array2::from_shape_fn(shape, |(bin, c)| spectra[c][bin] as f32))
    }

    /// Draws the positions of `n` samples for one repetition, seeded by the arguments. They count from 0
    /// and keep the order drawn.
    ///
    /// - Time: every T = ⌊(N − 0.0115 N)/n⌋ frames, from a start in the first 1.15 %. A series that is
    ///   too short for this (T = 0) gives all its samples.
    /// - Spectrum: `n` distinct random bins in random order; all bins if there are fewer.
    /// - Pixels: a grid of 25 × 16 with a random origin; `n` is not used. A position is row ·
    ///   [`Image::COLS`] + column.
    ///
    /// Without `pair`, all trials of a library get the same positions. With `pair`, the content hashes of
    /// a query and a library trial, each pair gets its own positions.
    pub(crate) fn positions(
        &self,
        source: &SourceId,
        n: usize,
        seed: u64,
        repetition: usize,
        pair: Option<(u64, u64)>,
    ) -> Vec<usize> {
        let size = match self {
            Self::Time(rows) | Self::Spectrum(rows) => rows.nrows(),
            Self::Pixels(..) => 0,
        };
        let (z, y) = pair.unwrap_or_default();
        let [size_bytes, repetition, z, y] =
            [size as u64, repetition as u64, z, y].map(u64::to_le_bytes);
        let key = [source.as_str().as_bytes(), &size_bytes, &repetition, &z, &y];
        let rng = &mut seed::rng(seed, &key);
        match self {
            Self::Time(_) => {
                let start_span = size as f64 * START_SHARE;
                let step = ((size as f64 - start_span) / n as f64).floor() as usize;
                if step == 0 {
                    return (0..size).collect();
                }
                let start = rng.random_range(0..(start_span as usize).max(1));
                (0..n).map(|i| start + i * step).collect()
            }
            Self::Spectrum(_) => index::sample(rng, size, n.min(size)).into_vec(),
            Self::Pixels(..) => {
                let a0 = rng.random_range(1..=IMAGE_ORIGINS.0);
                let b0 = rng.random_range(1..=IMAGE_ORIGINS.1);
                image_grid(a0, b0)
            }
        }
    }

    /// The samples at `positions`, shape (positions, channels).
    pub fn at(&self, positions: &[usize]) -> Array2<f64> {
        match self {
            Self::Time(rows) | Self::Spectrum(rows) => {
                Array2::from_shape_fn((positions.len(), rows.ncols()), |(i, channel)| {
                    f64::from(rows[[positions[i], channel]])
                })
            }
            Self::Pixels(image, colour) => {
                let channels = match colour {
                    Colour::Hsv | Colour::Rgb => 0..3,
                    Colour::Hue => 0..1,
                    Colour::Saturation => 1..2,
                    Colour::Value => 2..3,
                };
                let mut samples = Array2::zeros((positions.len(), channels.len()));
                for (mut sample, &at) in samples.rows_mut().into_iter().zip(positions) {
                    let rgb = image.pixel(at / Image::COLS, at % Image::COLS);
                    let all = match colour {
                        Colour::Rgb => rgb.map(|x| f64::from(x) / 255.0),
                        _ => hsv(rgb),
                    };
                    sample.iter_mut().zip(&all[channels.clone()]).for_each(|(slot, x)| *slot = *x);
                }
                samples
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn drawn(domain: &DomainSamples, seed: u64) -> Vec<usize> {
        domain.positions(&SourceId::new("x").unwrap(), 400, seed, 0, None)
    }

    #[test]
    fn time_samples_of_lmt108_are_118_apart() {
        let series = DomainSamples::Time(Array2::zeros((48_000, 1)));
        for seed in 0..200 {
            let at = drawn(&series, seed);
            assert_eq!(at.len(), 400);
            assert!(at[0] < 552 && at.windows(2).all(|w| w[1] - w[0] == 118));
        }
    }

    #[test]
    fn bins_are_distinct() {
        let mut at = drawn(&DomainSamples::Spectrum(Array2::zeros((500, 1))), 1);
        assert!(!at.is_sorted(), "the order is drawn, too");
        at.sort_unstable();
        at.dedup();
        assert_eq!(at.len(), 400);
    }

    #[test]
    fn a_short_extent_gives_all_it_has() {
        let rows = Array2::zeros((90, 1));
        for domain in [DomainSamples::Time(rows.clone()), DomainSamples::Spectrum(rows)] {
            assert_eq!(drawn(&domain, 1).len(), 90);
        }
    }

    #[test]
    fn the_last_grid_stays_within_the_image() {
        let at = image_grid(IMAGE_ORIGINS.0, IMAGE_ORIGINS.1);
        assert_eq!(at.len(), 400);
        let (row, col) = (at[399] / Image::COLS, at[399] % Image::COLS);
        assert_eq!((row, col), (54 + 24 * 17, 31 + 15 * 18));
    }
}
