//! Treats a picture as a series in two dimensions, with tiles as frames (README §4).
//!
//! The channels are brightness (R+G+B)/3, R − G and (R+G)/2 − B, for values from 0 to 1. Tiles are 64
//! × 64 pixels, half a tile apart. Each tile is windowed (two-dimensional Hann) and transformed, and its
//! power is averaged over eight rings by four directions. The mean of a tile is within 1.5 bins of
//! frequency 0, where no ring is. Each quarter has its own sums of pixels, which add up to those of the
//! whole.

use std::ops::Range;
use std::sync::{Arc, OnceLock};

use multiversion::multiversion;
use rayon::prelude::*;
use rustfft::num_complex::Complex;
use rustfft::{Fft, FftPlanner};
use serde::{Deserialize, Serialize};

use super::counts::Counts;
use super::packed::PackedFrames;
use super::pixels::{PixelStatistics, PixelSums, pixels_of};
use crate::trial::Image;

pub(crate) const CHANNELS: usize = 3;
const SIDE: usize = 64;
const HALF: usize = SIDE / 2;
const HOP: usize = SIDE / 2;
/// Number of tiles in a column of tiles, and in a row.
const TILES: [usize; 2] = [(Image::ROWS - SIDE) / HOP + 1, (Image::COLS - SIDE) / HOP + 1];
/// Number of rings of spatial frequency, equally wide in its logarithm.
const RINGS: usize = 8;
/// Radius of the innermost and outermost edge, in bins: from 1.5/64 to ½ cycles a pixel.
const RADII: (f64, f64) = (1.5, SIDE as f64 / 2.0);
/// Number of directions: 0, 45, 90 and 135°, each ± 22.5°.
const DIRECTIONS: usize = 4;
/// Keeps the logarithm of power finite.
const POWER_FLOOR: f32 = 1e-14;
/// A picture, reduced to its tiles and its statistics.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PictureTiles {
    /// ln power of each tile, row by row.
    tiles: PackedFrames,
    /// The mean of each channel, which is subtracted before anything is summed.
    reference: [f32; CHANNELS],
    quarters: Vec<PixelSums>,
}

impl PictureTiles {
    pub fn new(image: &Image) -> Self {
        let (pixels, _) = image.rgb().as_chunks();
        let reference = means(pixels);
        let mut planes = reference.map(|_| vec![0.0; pixels.len()]);
        fill_planes(pixels, reference, &mut planes);
        let quarters = (0..4).into_par_iter().map(|q| PixelSums::new(&planes, q)).collect();
        Self { tiles: PackedFrames::new(&tiles(&planes)), reference, quarters }
    }

    /// Number of values of one tile: the bands of all channels.
    pub fn width() -> usize {
        CHANNELS * rings().bands.len()
    }

    /// Histograms of ln power of all tiles, or of the tiles within one of the four quarters.
    pub(crate) fn counts(&self, quarter: Option<usize>) -> Counts {
        let part = quarter.map(pixels_of);
        let lies = |at: usize, within: &Range<usize>| within.start <= at && at + SIDE <= within.end;
        let mut counts = Counts::new(CHANNELS, Self::width());
        let mut tiles = Vec::new();
        for (tile, row) in self.tiles.values().chunks_exact(Self::width()).enumerate() {
            let (top, left) = (tile / TILES[1] * HOP, tile % TILES[1] * HOP);
            if part.as_ref().is_none_or(|(rows, columns)| lies(top, rows) && lies(left, columns)) {
                tiles.extend_from_slice(row);
            }
        }
        counts.add(&tiles);
        counts
    }

    /// Statistics of all pixels, or of those of a quarter. Pairs of pixels across the borders of
    /// quarters are left out.
    pub fn statistics(&self, quarter: Option<usize>) -> PixelStatistics {
        let mut sums = PixelSums::none();
        let wanted = |(i, _): &(usize, &PixelSums)| quarter.is_none_or(|quarter| quarter == *i);
        let parts = self.quarters.iter().enumerate().filter(wanted);
        parts.for_each(|(_, quarter)| sums.join(quarter));
        sums.statistics(&self.reference)
    }
}

/// Brightness, R − G and (R+G)/2 − B of a pixel.
#[inline(always)]
fn channels(r: f32, g: f32, b: f32) -> (f32, f32, f32) {
    ((r + g + b) * (1.0 / 3.0), r - g, (r + g) * 0.5 - b)
}

/// The mean of each channel of some pixels.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn means(pixels: &[[u8; 3]]) -> [f32; CHANNELS] {
    let mut sums = [0u64; 3];
    // So few that their sum fits into 32 bits.
    for chunk in pixels.chunks(4096) {
        let (mut r, mut g, mut b) = (0u32, 0u32, 0u32);
        for pixel in chunk {
            r += u32::from(pixel[0]);
            g += u32::from(pixel[1]);
            b += u32::from(pixel[2]);
        }
        sums[0] += u64::from(r);
        sums[1] += u64::from(g);
        sums[2] += u64::from(b);
    }
    let [r, g, b] = sums.map(|sum| (sum as f64 / (255.0 * pixels.len() as f64)) as f32);
    channels(r, g, b).into()
}

/// Writes the channels of some pixels minus `reference`, each in a list of its own.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn fill_planes(pixels: &[[u8; 3]], reference: [f32; CHANNELS], planes: &mut [Vec<f32>; CHANNELS]) {
    const UNIT: f32 = 1.0 / 255.0;
    let [first, second, third] = planes;
    let (first, second) = (&mut first[..pixels.len()], &mut second[..pixels.len()]);
    let third = &mut third[..pixels.len()];
    for i in 0..pixels.len() {
        let [r, g, b] = pixels[i];
        let (r, g, b) = (f32::from(r) * UNIT, f32::from(g) * UNIT, f32::from(b) * UNIT);
        let (x, y, z) = channels(r, g, b);
        first[i] = x - reference[0];
        second[i] = y - reference[1];
        third[i] = z - reference[2];
    }
}

/// The bands of a transformed tile.
struct Rings {
    /// For each band with at least one bin, the places of its bins in [`pair_powers`].
    bands: Vec<Vec<usize>>,
    window: Vec<f32>,
    /// Factor from |X|² to power: 2/(N·Σw²).
    scale: f32,
    plan: Arc<dyn Fft<f32>>,
}

fn rings() -> &'static Rings {
    static RINGS_OF_A_TILE: OnceLock<Rings> = OnceLock::new();
    RINGS_OF_A_TILE.get_or_init(Rings::new)
}

impl Rings {
    fn new() -> Self {
        let half = SIDE as i32 / 2;
        let (from, to) = RADII;
        let mut bands = vec![Vec::new(); RINGS * DIRECTIONS];
        for fy in 0..half {
            for fx in 1 - half..half {
                let radius = f64::from(fx * fx + fy * fy).sqrt();
                if (fy == 0 && fx <= 0) || radius < from || radius >= to {
                    continue;
                }
                let ring = ((radius / from).ln() / (to / from).ln() * RINGS as f64) as usize;
                let angle = f64::from(fy).atan2(f64::from(fx)) / std::f64::consts::PI;
                let direction = (angle * DIRECTIONS as f64).round() as usize % DIRECTIONS;
                let row = fx.rem_euclid(SIDE as i32) as usize;
                bands[ring * DIRECTIONS + direction].push(row * HALF + fy as usize);
            }
        }
        bands.retain(|bins| !bins.is_empty());
        let hann = |n: usize| 0.5 - 0.5 * (std::f64::consts::TAU * n as f64 / SIDE as f64).cos();
        let power: f64 = (0..SIDE).map(|n| hann(n).powi(2)).sum();
        Self {
            bands,
            window: (0..SIDE).map(|n| hann(n) as f32).collect(),
            scale: (2.0 / ((SIDE * SIDE) as f64 * power * power)) as f32,
            plan: FftPlanner::new().plan_fft_forward(SIDE),
        }
    }

    /// The ln power of the bands of two columns of tiles, one pair of tiles after the other. A column
    /// begins at the first of the pixels that are given, and the rows of the picture follow each other.
    fn ln_powers(&self, columns: [&[f32]; 2]) -> Vec<[Vec<f32>; 2]> {
        let mut scratch = vec![Complex::default(); self.plan.get_inplace_scratch_len()];
        let mut rows = vec![Complex::default(); Image::ROWS * SIDE];
        fill(columns, &self.window, &mut rows);
        // A row lies in two tiles, but is transformed once.
        self.plan.process_with_scratch(&mut rows, &mut scratch);
        let mut pair = vec![Complex::default(); SIDE * SIDE];
        let mut of_pair = |tile: usize| {
            turn(&rows[tile * HOP * SIDE..], &self.window, &mut pair);
            self.plan.process_with_scratch(&mut pair, &mut scratch);
            pair_powers(&pair).map(|powers| {
                let ln_power = |bins: &Vec<usize>| {
                    (sum_of(&powers, bins) * self.scale / bins.len() as f32 + POWER_FLOOR).ln()
                };
                self.bands.iter().map(ln_power).collect()
            })
        };
        (0..TILES[0]).map(&mut of_pair).collect()
    }
}

/// The sum of the values at some places, by four sums, so that no addition waits for the one before.
fn sum_of(values: &[f32], places: &[usize]) -> f32 {
    let (chunks, rest) = places.as_chunks::<4>();
    let mut lanes = [0f32; 4];
    for chunk in chunks {
        for lane in 0..4 {
            lanes[lane] += values[chunk[lane]];
        }
    }
    lanes.iter().sum::<f32>() + rest.iter().map(|place| values[*place]).sum::<f32>()
}

/// |X|² of the bins of two real tiles that were transformed as the real and imaginary parts of `pair`, whose
/// rows and columns are swapped: rows of [`HALF`] bins with vertical frequencies from 0.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn pair_powers(pair: &[Complex<f32>]) -> [Vec<f32>; 2] {
    let [mut first, mut second] = [vec![0f32; SIDE * HALF], vec![0f32; SIDE * HALF]];
    let (first_rows, _) = first.as_chunks_mut::<HALF>();
    let (second_rows, _) = second.as_chunks_mut::<HALF>();
    let (rows, _) = pair.as_chunks::<SIDE>();
    for row in 0..SIDE {
        let (here, mirrored) = (&rows[row], &rows[(SIDE - row) % SIDE]);
        let mut there = [mirrored[0]; HALF];
        for i in 1..HALF {
            there[i] = mirrored[SIDE - i];
        }
        for i in 0..HALF {
            let (a, b) = (here[i].re + there[i].re, here[i].im - there[i].im);
            let (c, d) = (here[i].re - there[i].re, here[i].im + there[i].im);
            first_rows[row][i] = 0.25 * (a * a + b * b);
            second_rows[row][i] = 0.25 * (c * c + d * d);
        }
    }
    [first, second]
}

/// Writes the rows of two columns of tiles, windowed, as real and imaginary parts.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn fill(columns: [&[f32]; 2], window: &[f32], rows: &mut [Complex<f32>]) {
    let window = &window[..SIDE];
    for row in 0..Image::ROWS {
        let (a, b) =
            (&columns[0][row * Image::COLS..][..SIDE], &columns[1][row * Image::COLS..][..SIDE]);
        let out = &mut rows[row * SIDE..][..SIDE];
        for i in 0..SIDE {
            out[i].re = a[i] * window[i];
            out[i].im = b[i] * window[i];
        }
    }
}

/// Windows the rows of a pair of tiles, and makes columns of them.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn turn(rows: &[Complex<f32>], window: &[f32], pair: &mut [Complex<f32>]) {
    let (rows, _) = rows.as_chunks::<SIDE>();
    let (columns, _) = pair.as_chunks_mut::<SIDE>();
    for row in 0..SIDE {
        for column in 0..SIDE {
            columns[column][row].re = rows[row][column].re * window[row];
            columns[column][row].im = rows[row][column].im * window[row];
        }
    }
}

/// ln power of all tiles, row by row; each tile has all its channels.
fn tiles(planes: &[Vec<f32>; CHANNELS]) -> Vec<f32> {
    let columns: Vec<&[f32]> = (0..TILES[1])
        .flat_map(|column| planes.iter().map(move |plane| &plane[column * HOP..]))
        .collect();
    // The second column may be missing; the first stands for it, and its powers are left out.
    let of_two = |two: &[&[f32]]| rings().ln_powers([two[0], two[two.len() - 1]]);
    let powers: Vec<_> = columns.par_chunks(2).map(of_two).collect();
    let bands = rings().bands.len();
    let mut all = Vec::with_capacity(TILES[0] * columns.len() * bands);
    for row in 0..TILES[0] {
        all.extend(powers.iter().flat_map(|of_two| &of_two[row]).take(columns.len()).flatten());
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::features::pixels::{REACH, ROW_STEP};

    fn picture(pixel: impl Fn(usize, usize) -> [u8; 3]) -> PictureTiles {
        let at = |i: usize| pixel(i / Image::COLS, i % Image::COLS);
        let rgb = (0..Image::ROWS * Image::COLS).flat_map(at).collect();
        PictureTiles::new(&Image::new(Image::COLS, Image::ROWS, rgb).unwrap())
    }

    fn texture(row: usize, column: usize) -> [u8; 3] {
        let value = (row * 31 + column * 17 + row * column % 23) % 199;
        [value as u8, (value / 2 + 40) as u8, (200 - value) as u8]
    }

    #[test]
    fn stripes_stand_in_the_ring_and_direction_of_their_frequency() {
        // Eight pixels a period from left to right: radius 8 of 64, direction 0°.
        let stripes = picture(|_, column| {
            let phase = std::f64::consts::TAU * column as f64 / 8.0;
            [(128.0 + 60.0 * phase.sin()).round() as u8; 3]
        });
        let values = stripes.tiles.part(PictureTiles::width(), 0..1);
        let bands = &rings().bands;
        let brightest = (0..bands.len()).max_by(|&a, &b| values[a].total_cmp(&values[b]));
        let band = bands.iter().position(|bins| bins.contains(&(8 * HALF)));
        assert_eq!(brightest, band);
        assert!(values[bands.len()..].iter().all(|x| *x < -20.0), "grey has no colour");
    }

    #[test]
    fn a_pair_of_tiles_has_the_powers_of_each_alone() {
        let pixel =
            |k: usize| move |i: usize| ((i * 7919 + k * 104_729) % 1000) as f32 / 500.0 - 1.0;
        let plane = |k| (0..Image::ROWS * Image::COLS).map(pixel(k)).collect::<Vec<_>>();
        let (a, b) = (plane(1), plane(2));
        let of = |a: &[f32], b: &[f32]| rings().ln_powers([&a[HOP..], b]);
        let (both, zero) = (of(&a, &b), vec![0.0; a.len()]);
        for (alone, at) in [(of(&a, &zero), 0), (of(&zero, &b), 1)] {
            for (alone, both) in alone.iter().zip(&both) {
                assert!(alone[at].iter().zip(&both[at]).all(|(x, y)| (x - y).abs() < 1e-3));
            }
        }
    }

    #[test]
    fn statistics_are_those_of_their_definitions() {
        let tiles = picture(texture);
        let stats = tiles.statistics(Some(0));
        let (rows, columns) = pixels_of(0);
        let pixels = || rows.clone().flat_map(|r| columns.clone().map(move |c| (r, c)));
        let brightness = |(r, c): (usize, usize)| {
            texture(r, c).iter().map(|&x| f64::from(x)).sum::<f64>() / 765.0
        };
        let n = (rows.len() * columns.len()) as f64;
        let mean = pixels().map(brightness).sum::<f64>() / n;
        let deviation = (pixels().map(|p| (brightness(p) - mean).powi(2)).sum::<f64>() / n).sqrt();
        assert!((stats.moments[0][0] - mean).abs() < 1e-5);
        assert!((stats.moments[0][1] - deviation).abs() < 1e-5);
        // Brightness here and 4 columns to the right: indices 0 and 9.
        let pairs: Vec<(f64, f64)> = (rows.start..rows.end - REACH)
            .step_by(ROW_STEP)
            .flat_map(|r| (columns.start..columns.end - REACH).map(move |c| (r, c)))
            .map(|(r, c)| (brightness((r, c)), brightness((r, c + 4))))
            .collect();
        let n = pairs.len() as f64;
        let (a, b) = (
            pairs.iter().map(|p| p.0).sum::<f64>() / n,
            pairs.iter().map(|p| p.1).sum::<f64>() / n,
        );
        let expected = pairs.iter().map(|p| (p.0 - a) * (p.1 - b)).sum::<f64>() / n;
        assert!(
            (stats.covariance[9] - expected).abs() < 1e-6,
            "{} {expected}",
            stats.covariance[9]
        );
    }

    #[test]
    fn quarters_make_the_whole_and_a_plain_picture_is_finite() {
        let tiles = picture(texture);
        let of = |quarter| tiles.statistics(quarter).moments[1][0];
        let mean = (0..4).map(|q| of(Some(q))).sum::<f64>() / 4.0;
        assert!((of(None) - mean).abs() < 1e-9);
        let plain = picture(|_, _| [9; 3]);
        let stats = plain.statistics(None);
        assert!(
            stats.covariance.iter().chain(stats.moments.iter().flatten()).all(|x| x.is_finite())
        );
        assert!(plain.counts(Some(3)).ln_mean_power().iter().all(|x| x.is_finite()));
    }
}
