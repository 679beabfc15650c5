//! Draws the samples of a source (method §2, step 1; the paper's Fig. 4) in its domain: time, spectrum
//! or pixels.

use ndarray::Array2;
use rand::seq::index;
use rand::{Rng, RngExt};

use crate::recognise::features::hsv;
use crate::scene::{Colour, Domain, SourceId, SourceSpec};
use crate::seed;
use crate::spectrum::amplitude_spectrum;
use crate::trial::{Image, Signal};

/// Number of rows in the grid of pixels drawn from an image.
pub const IMAGE_ROWS: usize = 25;
pub const IMAGE_COLS: usize = 16;
const IMAGE_ROW_STEP: usize = 17;
const IMAGE_COL_STEP: usize = 18;
/// The origin of the grid lies in the first 55 rows and 32 columns.
const IMAGE_ORIGINS: (usize, usize) = (55, 32);
/// The first sample lies within this share of a time series, at its beginning.
const START_SHARE: f64 = 0.0115;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DomainExtent {
    /// A time series with this number of frames.
    Time(usize),
    /// A spectrum with this number of bins.
    Spectrum(usize),
    /// An image; positions are row · [`Image::COLS`] + column.
    Image,
}

/// Draws the positions of `n` samples in their domain. They count from 0 and keep the order drawn.
///
/// - Time: every T = ⌊(N − 0.0115 N)/n⌋ frames, from a start in the first 1.15 %. A series that is too
///   short for this (T = 0) gives all its samples.
/// - Spectrum: `n` distinct random bins in random order; all bins if there are fewer.
/// - Image: a grid of 25 × 16 pixels with a random origin; `n` is not used.
pub fn draw_positions(extent: DomainExtent, n: usize, rng: &mut impl Rng) -> Vec<usize> {
    match extent {
        DomainExtent::Time(frames) => {
            let start_span = frames as f64 * START_SHARE;
            let step = ((frames as f64 - start_span) / n as f64).floor() as usize;
            if step == 0 {
                (0..frames).collect()
            } else {
                let start = rng.random_range(0..(start_span as usize).max(1));
                (0..n).map(|i| start + i * step).collect()
            }
        }
        DomainExtent::Spectrum(bins) => index::sample(rng, bins, n.min(bins)).into_vec(),
        DomainExtent::Image => {
            let a0 = rng.random_range(1..=IMAGE_ORIGINS.0);
            let b0 = rng.random_range(1..=IMAGE_ORIGINS.1);
            image_grid(a0, b0)
        }
    }
}

/// Draws the positions of one repetition, seeded by the arguments. Without `pair`, all trials of a
/// library get the same positions. With `pair`, the content hashes of a query and a library trial,
/// each pair gets its own positions.
pub fn keyed_positions(
    source: &SourceId,
    extent: DomainExtent,
    n: usize,
    seed: u64,
    repetition: usize,
    pair: Option<(u64, u64)>,
) -> Vec<usize> {
    let size = match extent {
        DomainExtent::Time(size) | DomainExtent::Spectrum(size) => size as u64,
        DomainExtent::Image => 0,
    };
    let (z, y) = pair.unwrap_or_default();
    let numbers = [size, repetition as u64, z, y].map(u64::to_le_bytes);
    let mut key: Vec<&[u8]> = vec![source.as_str().as_bytes()];
    key.extend(numbers.iter().map(<[u8; 8]>::as_slice));
    draw_positions(extent, n, &mut seed::rng(seed, &key))
}

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

    pub(crate) fn extent(&self) -> DomainExtent {
        match self {
            Self::Time(rows) => DomainExtent::Time(rows.nrows()),
            Self::Spectrum(rows) => DomainExtent::Spectrum(rows.nrows()),
            Self::Pixels(..) => DomainExtent::Image,
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
    use crate::seed::rng;

    #[test]
    fn time_samples_of_lmt108_are_118_apart() {
        for seed in 0..200 {
            let at = draw_positions(DomainExtent::Time(48_000), 400, &mut rng(seed, &[]));
            assert_eq!(at.len(), 400);
            assert!(at[0] < 552 && at.windows(2).all(|w| w[1] - w[0] == 118));
        }
    }

    #[test]
    fn bins_are_distinct() {
        let mut at = draw_positions(DomainExtent::Spectrum(500), 400, &mut rng(1, &[]));
        assert!(!at.is_sorted(), "the order is drawn, too");
        at.sort_unstable();
        at.dedup();
        assert_eq!(at.len(), 400);
    }

    #[test]
    fn a_short_extent_gives_all_it_has() {
        for extent in [DomainExtent::Time(90), DomainExtent::Spectrum(90)] {
            let at = draw_positions(extent, 400, &mut rng(1, &[]));
            assert_eq!(at.len(), 90);
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
