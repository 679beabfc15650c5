//! Draws the samples of a source (method §2, step 1; the paper's Fig. 4).

use rand::seq::index;
use rand::{Rng, RngExt};

use crate::scene::SourceId;
use crate::seed;
use crate::trial::Image;

/// Rows of the grid of pixels drawn from an image.
pub const IMAGE_ROWS: usize = 25;
/// Columns of that grid.
pub const IMAGE_COLS: usize = 16;
const IMAGE_ROW_STEP: usize = 17;
const IMAGE_COL_STEP: usize = 18;
/// Grid origins lie in the first 55 rows and 32 columns.
const IMAGE_ORIGINS: (usize, usize) = (55, 32);
/// Share of a time series in which the first sample lies.
const START_SHARE: f64 = 0.0115;

/// Positions of samples in their domain, counted from 0, in the order drawn.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Positions(pub Vec<usize>);

/// The extent from which positions are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DomainExtent {
    /// A time series of a number of frames.
    Time(usize),
    /// A spectrum of a number of bins.
    Spectrum(usize),
    /// An image; positions are row · [`Image::COLS`] + column.
    Image,
}

/// Draws the positions of `n` samples.
///
/// - Time: equidistant, T = ⌊(N − 0.0115 N)/n⌋ apart, from a start in the first 1.15 %. A series
///   too short for that gives all its samples.
/// - Spectrum: `n` distinct bins at random, in random order; all of them if there are fewer.
/// - Image: a grid of 25 × 16 pixels from a random origin, whatever `n` is.
pub fn draw_positions(extent: DomainExtent, n: usize, rng: &mut impl Rng) -> Positions {
    Positions(match extent {
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
            return image_grid(a0, b0);
        }
    })
}

/// Draws the positions of one repetition, seeded by the arguments: the same positions for every
/// trial of a library, or, where `pair` gives the content hashes of query and library trial, others
/// for each pair.
pub fn keyed_positions(
    source: &SourceId,
    extent: DomainExtent,
    n: usize,
    seed: u64,
    repetition: usize,
    pair: Option<(u64, u64)>,
) -> Positions {
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

/// The grid of pixels from origin row `a0` and column `b0`, both counted from 1 as the paper does.
/// Rows vary fastest; the order matters, since σ is taken from the first samples.
pub fn image_grid(a0: usize, b0: usize) -> Positions {
    let pixels = (0..IMAGE_COLS).flat_map(|col| {
        (0..IMAGE_ROWS).map(move |row| {
            (a0 - 1 + row * IMAGE_ROW_STEP) * Image::COLS + (b0 - 1 + col * IMAGE_COL_STEP)
        })
    });
    Positions(pixels.collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::seed::rng;

    #[test]
    fn time_samples_of_lmt108_are_118_apart() {
        for seed in 0..200 {
            let Positions(at) =
                draw_positions(DomainExtent::Time(48_000), 400, &mut rng(seed, &[]));
            assert_eq!(at.len(), 400);
            assert!(at[0] < 552 && at.windows(2).all(|w| w[1] - w[0] == 118));
        }
    }

    #[test]
    fn bins_are_distinct() {
        let Positions(mut at) = draw_positions(DomainExtent::Spectrum(500), 400, &mut rng(1, &[]));
        assert!(!at.is_sorted(), "the order is drawn, too");
        at.sort_unstable();
        at.dedup();
        assert_eq!(at.len(), 400);
    }

    #[test]
    fn a_short_extent_gives_all_it_has() {
        for extent in [DomainExtent::Time(90), DomainExtent::Spectrum(90)] {
            let Positions(at) = draw_positions(extent, 400, &mut rng(1, &[]));
            assert_eq!(at.len(), 90);
        }
    }

    #[test]
    fn the_last_grid_stays_within_the_image() {
        let Positions(at) = image_grid(IMAGE_ORIGINS.0, IMAGE_ORIGINS.1);
        assert_eq!(at.len(), 400);
        let (row, col) = (at[399] / Image::COLS, at[399] % Image::COLS);
        assert_eq!((row, col), (54 + 24 * 17, 31 + 15 * 18));
    }
}
