//! Sums over the pixels of a quarter of a picture, and over their products with pixels to the right and
//! below, which give moments and covariance (README §4).

use std::ops::Range;

use multiversion::multiversion;
use serde::{Deserialize, Serialize};

use super::counts::LANES;
use super::tiles::CHANNELS;
use crate::lanes::{chunks, total};
use crate::trial::Image;

/// Displacements, in rows and columns, of the pixels in the covariance.
const DISPLACED: [(usize, usize); 7] = [(0, 0), (0, 1), (1, 0), (0, 4), (4, 0), (0, 16), (16, 0)];
pub(super) const REACH: usize = 16;
/// Step between the rows of pixels that enter the covariance.
pub(super) const ROW_STEP: usize = 4;
/// Number of channels of all displaced pixels together.
pub(crate) const STACKED: usize = CHANNELS * DISPLACED.len();

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct PixelSums {
    pixels: f64,
    /// Σ x, Σ x², Σ x³, Σ x⁴ of each channel.
    powers: [[f64; 4]; CHANNELS],
    /// Number of pixels that enter the covariance.
    stacks: f64,
    /// Σ v_i, where v are the channels of all displaced pixels; [`STACKED`] values.
    sums: Vec<f64>,
    /// Σ v_i·v_j for j ≤ i, row by row.
    products: Vec<f64>,
}

pub struct PixelStatistics {
    /// Mean, standard deviation, skewness and kurtosis of each channel.
    pub moments: [[f64; 4]; CHANNELS],
    /// Covariance of the channels of displaced pixels, shape ([`STACKED`], [`STACKED`]).
    pub covariance: Vec<f64>,
}

/// Rows and columns of one of the four quarters.
pub(super) fn pixels_of(quarter: usize) -> (Range<usize>, Range<usize>) {
    let half = |size: usize, second: bool| {
        let from = usize::from(second) * (size / 2);
        from..from + size / 2
    };
    (half(Image::ROWS, quarter / 2 % 2 == 1), half(Image::COLS, quarter % 2 == 1))
}

impl PixelSums {
    pub(super) fn none() -> Self {
        Self {
            pixels: 0.0,
            powers: [[0.0; 4]; CHANNELS],
            stacks: 0.0,
            sums: vec![0.0; STACKED],
            products: vec![0.0; STACKED * (STACKED + 1) / 2],
        }
    }

    pub(super) fn new(planes: &[Vec<f32>; CHANNELS], quarter: usize) -> Self {
        let (rows, columns) = pixels_of(quarter);
        let mut sums = Self::none();
        let row = |row: usize, column: usize, channel: usize, length: usize| {
            &planes[channel][row * Image::COLS + column..][..length]
        };
        for (channel, sums) in sums.powers.iter_mut().enumerate() {
            let mut lanes = [[0.0; LANES]; 4];
            for r in rows.clone() {
                add_powers(row(r, columns.start, channel, columns.len()), &mut lanes);
            }
            *sums = lanes.each_ref().map(total);
        }
        sums.pixels = (rows.len() * columns.len()) as f64;
        let length = columns.len() - REACH;
        let mut lanes = Lanes::default();
        for r in (rows.start..rows.end - REACH).step_by(ROW_STEP) {
            let of =
                |(dr, dc)| (0..CHANNELS).map(move |c| row(r + dr, columns.start + dc, c, length));
            let stacked: Vec<&[f32]> = DISPLACED.into_iter().flat_map(of).collect();
            add_products(&stacked, &mut lanes);
            sums.stacks += length as f64;
        }
        sums.sums = lanes.sums.iter().map(total).collect();
        sums.products = lanes.products.iter().map(total).collect();
        sums
    }

    pub(super) fn join(&mut self, other: &Self) {
        self.pixels += other.pixels;
        self.stacks += other.stacks;
        let powers = self.powers.iter_mut().flatten().zip(other.powers.iter().flatten());
        let sums = self.sums.iter_mut().zip(&other.sums);
        let products = self.products.iter_mut().zip(&other.products);
        powers.chain(sums).chain(products).for_each(|(sum, x)| *sum += x);
    }

    pub(super) fn statistics(&self, reference: &[f32; CHANNELS]) -> PixelStatistics {
        let n = self.pixels.max(1.0);
        let mut moments = [[0.0; 4]; CHANNELS];
        for ((out, powers), reference) in moments.iter_mut().zip(&self.powers).zip(reference) {
            let [m, second, third, fourth] = powers.map(|sum| sum / n);
            let variance = (second - m * m).max(0.0);
            let deviation = variance.sqrt().max(1e-9);
            let skew = third - 3.0 * m * second + 2.0 * m.powi(3);
            let tail = fourth - 4.0 * m * third + 6.0 * m * m * second - 3.0 * m.powi(4);
            *out = [
                m + f64::from(*reference),
                deviation,
                skew / deviation.powi(3),
                tail / deviation.powi(4),
            ];
        }
        let n = self.stacks.max(1.0);
        let mut covariance = vec![0.0; STACKED * STACKED];
        let mut products = self.products.iter();
        for i in 0..STACKED {
            for j in 0..=i {
                let product = products.next().copied().unwrap_or(0.0);
                let value = product / n - self.sums[i] * self.sums[j] / (n * n);
                covariance[i * STACKED + j] = value;
                covariance[j * STACKED + i] = value;
            }
        }
        PixelStatistics { moments, covariance }
    }
}

/// Σ v_i and, for j ≤ i, Σ v_i·v_j, in lanes that are added up once for all rows of a quarter.
struct Lanes {
    sums: Vec<[f32; LANES]>,
    products: Vec<[f32; LANES]>,
}

impl Default for Lanes {
    fn default() -> Self {
        let lanes = |count| vec![[0.0; LANES]; count];
        Self { sums: lanes(STACKED), products: lanes(STACKED * (STACKED + 1) / 2) }
    }
}

/// Adds x, x², x³ and x⁴ to the lanes.
#[multiversion(targets(
    "x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
fn add_powers(row: &[f32], lanes: &mut [[f32; LANES]; 4]) {
    let (whole, last) = chunks::<LANES>(row, 0.0);
    let mut sums = *lanes;
    for i in 0..=whole.len() {
        let x = if i < whole.len() { &whole[i] } else { &last };
        for lane in 0..LANES {
            let square = x[lane] * x[lane];
            sums[0][lane] += x[lane];
            sums[1][lane] += square;
            sums[2][lane] += square * x[lane];
            sums[3][lane] += square * square;
        }
    }
    *lanes = sums;
}

/// Adds equally long rows to the lanes.
#[multiversion(targets(
    "x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
fn add_products(rows: &[&[f32]], lanes: &mut Lanes) {
    let mut products = lanes.products.iter_mut();
    for (i, a) in rows.iter().enumerate() {
        let (a, last_a) = chunks::<LANES>(a, 0.0);
        let sums = &mut lanes.sums[i];
        for lane in 0..LANES {
            sums[lane] += last_a[lane];
        }
        for chunk in a {
            for lane in 0..LANES {
                sums[lane] += chunk[lane];
            }
        }
        for (b, product) in rows[..=i].iter().zip(&mut products) {
            let (b, last_b) = chunks::<LANES>(b, 0.0);
            let mut sums = *product;
            for lane in 0..LANES {
                sums[lane] += last_a[lane] * last_b[lane];
            }
            for i in 0..a.len().min(b.len()) {
                for lane in 0..LANES {
                    sums[lane] += a[i][lane] * b[i][lane];
                }
            }
            *product = sums;
        }
    }
}
