//! Features of a picture: statistics of its colours and of its texture (grey-level co-occurrence).

use std::ops::Range;

use super::hsv;
use crate::trial::Image;

/// Distances in pixels at which grey levels are compared.
const STEPS: [usize; 4] = [1, 3, 9, 27];
const LEVELS: usize = 16;
/// Number of texture statistics for each of [`STEPS`].
const TEXTURES: usize = 5;

/// Colour statistics, then texture statistics for each of [`STEPS`]. Hue is an angle, so its cosine
/// and sine are used; both are weighted by saturation, since grey has no hue.
pub(crate) fn features(image: &Image) -> Vec<f64> {
    let mut grey = Vec::with_capacity(Image::ROWS * Image::COLS);
    let mut columns: [Vec<f64>; 5] = Default::default();
    for rgb in image.rgb().chunks_exact(3) {
        let [h, s, v] = hsv([rgb[0], rgb[1], rgb[2]]);
        let (sin, cos) = (std::f64::consts::TAU * h).sin_cos();
        let warmth = (f64::from(rgb[0]) - f64::from(rgb[2])) / 255.0;
        for (column, x) in columns.iter_mut().zip([s * cos, s * sin, s, v, warmth]) {
            column.push(x);
        }
        let level =
            0.299 * f64::from(rgb[0]) + 0.587 * f64::from(rgb[1]) + 0.114 * f64::from(rgb[2]);
        grey.push(level as f32);
    }
    let [cos, sin, saturation, value, warmth] = columns.map(|column| PixelMoments::new(&column));
    let mut features = vec![
        cos.mean,
        sin.mean,
        saturation.mean,
        saturation.deviation,
        value.mean,
        value.deviation,
        value.skewness,
        warmth.mean,
        warmth.deviation,
    ];
    let texture = Texture::new(grey);
    for step in STEPS {
        features.extend(texture.at(step));
    }
    features
}

struct PixelMoments {
    mean: f64,
    deviation: f64,
    skewness: f64,
}

impl PixelMoments {
    fn new(values: &[f64]) -> Self {
        let n = values.len() as f64;
        let mean = values.iter().sum::<f64>() / n;
        let deviation = (values.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n).sqrt();
        let third = values.iter().map(|x| (x - mean).powi(3)).sum::<f64>() / n;
        let skewness = if deviation > 0.0 { third / deviation.powi(3) } else { 0.0 };
        Self { mean, deviation, skewness }
    }
}

/// Grey values of a picture, and the same values as levels from 0 (darkest pixel) to 15 (brightest).
struct Texture {
    grey: Vec<f32>,
    level: Vec<u8>,
    variance: f64,
}

impl Texture {
    fn new(grey: Vec<f32>) -> Self {
        let (low, high) = grey.iter().fold((f32::MAX, f32::MIN), |(a, b), &x| (a.min(x), b.max(x)));
        let scale = LEVELS as f32 / (high - low).max(1.0);
        let level = |x: &f32| (((x - low) * scale) as usize).min(LEVELS - 1) as u8;
        let values: Vec<f64> = grey.iter().map(|&x| f64::from(x)).collect();
        let variance = PixelMoments::new(&values).deviation.powi(2);
        Self { level: grey.iter().map(level).collect(), grey, variance }
    }

    /// Ln contrast, homogeneity, ln energy, entropy and correlation of pixels `step` apart along rows
    /// and columns (Haralick et al. 1973, "Textural features for image classification"). Contrast and
    /// correlation use grey values, the others use levels.
    fn at(&self, step: usize) -> [f64; TEXTURES] {
        let mut counts = [[0u32; LEVELS]; LEVELS];
        let (mut contrast, mut pairs) = (0.0, 0);
        let mut add = |from: Range<usize>, by: usize| {
            let to = from.start + by..from.end + by;
            pairs += from.len();
            let values = self.grey[from.clone()].iter().zip(&self.grey[to.clone()]);
            contrast += values.map(|(a, b)| f64::from((a - b) * (a - b))).sum::<f64>();
            for (&a, &b) in self.level[from].iter().zip(&self.level[to]) {
                counts[usize::from(a)][usize::from(b)] += 1;
            }
        };
        for row in 0..Image::ROWS {
            let (start, end) = (row * Image::COLS, (row + 1) * Image::COLS);
            add(start..end - step, step);
            if row + step < Image::ROWS {
                add(start..end, step * Image::COLS);
            }
        }
        let pairs = pairs as f64;
        let contrast = contrast / pairs;
        let (mut homogeneity, mut energy, mut entropy) = (0.0, 0.0, 0.0);
        for (i, j) in (0..LEVELS).flat_map(|i| (0..LEVELS).map(move |j| (i, j))) {
            // Each pair of pixels counts in both directions.
            let count = counts[i][j] + counts[j][i];
            if count > 0 {
                let p = f64::from(count) / (2.0 * pairs);
                homogeneity += p / (1.0 + i.abs_diff(j) as f64);
                energy += p * p;
                entropy -= p * p.ln();
            }
        }
        let correlation =
            if self.variance > 0.0 { 1.0 - 0.5 * contrast / self.variance } else { 1.0 };
        [(contrast + 1.0).ln(), homogeneity, energy.ln(), entropy, correlation]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const COLOURS: usize = 9;

    fn picture(pixel: impl Fn(usize, usize) -> [u8; 3]) -> Vec<f64> {
        let at = |i: usize| pixel(i / Image::COLS, i % Image::COLS);
        let rgb = (0..Image::ROWS * Image::COLS).flat_map(at).collect();
        features(&Image::new(Image::COLS, Image::ROWS, rgb).unwrap())
    }

    #[test]
    fn a_plain_picture_has_a_colour_and_no_texture() {
        let plain = picture(|_, _| [200, 100, 50]);
        assert_eq!(plain.len(), COLOURS + STEPS.len() * TEXTURES);
        assert!((plain[4] - 200.0 / 255.0).abs() < 1e-9 && plain[5] < 1e-9);
        assert!(plain.iter().all(|x| x.is_finite()));
        assert_eq!(plain[COLOURS], 0.0, "no contrast");
    }

    #[test]
    fn stripes_have_contrast_at_steps_that_cross_them() {
        let stripes = picture(|_, col| [if col / 9 % 2 == 0 { 255 } else { 0 }; 3]);
        let contrast = |step: usize| stripes[COLOURS + step * TEXTURES];
        assert!(contrast(2) > contrast(0) + 1.0, "{} {}", contrast(2), contrast(0));
    }
}
