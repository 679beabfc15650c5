//! Pictures of a surface, without flash (ca1) and with flash (ca2).
//!
//! A picture mixes two colours in a pattern of a few waves, adds grain, and applies the light.

use std::f64::consts::TAU;

use rand::Rng;

use super::parameters::{Draws, logistic};
use crate::seed::uniform;
use crate::trial::Image;

const WAVES: usize = 5;
/// Width in pixels of the flash's reflection: on a mirror, and on a matt surface.
const REFLECTION_PIXELS: (f64, f64) = (40.0, 160.0);
/// Factor by which the flash reduces the contrast, since it also lights crevices.
const FLASH_CONTRAST: f64 = 0.6;

/// The RGB bytes of a picture, row by row.
pub(super) fn picture(draws: &Draws<'_>, flash: bool) -> Vec<u8> {
    let rng = &mut draws.noise(if flash { "picture with flash" } else { "picture" });
    let flatter = if flash { FLASH_CONTRAST } else { 1.0 };
    let contrast = flatter * draws.value("contrast").exp();
    let hue = draws.value("hue");
    let saturation = logistic(draws.value("saturation"));
    let value = 0.9 * logistic(draws.value("value"));
    let accent = draws.value("accent");
    let light = illumination(draws, flash);

    // `middle` is the mean colour; `swing` is the change of colour for one unit of texture.
    let bright = from_hsv(hue, saturation, value * (1.0 + contrast));
    let dark = from_hsv(hue + accent, saturation, value * (1.0 - contrast).max(0.0));
    let to_bytes = |x: f64, channel: usize| (255.0 * light[channel] * x) as f32;
    let middle: [f32; 3] = std::array::from_fn(|c| to_bytes(0.5 * (bright[c] + dark[c]), c));
    let swing: [f32; 3] = std::array::from_fn(|c| to_bytes(0.5 * (bright[c] - dark[c]), c));
    let grain = (255.0 * value * draws.value("grain").exp()) as f32;
    let reflection = flash.then(|| Reflection::draw(draws, rng));

    let texture = WaveTexture::draw(draws, rng);
    let mut rgb = Vec::with_capacity(Image::ROWS * Image::COLS * 3);
    let mut line = [0f32; Image::COLS];
    let mut bytes = [0u8; 2 * Image::COLS];
    for row in 0..Image::ROWS {
        texture.row(row, &mut line);
        rng.fill_bytes(&mut bytes);
        for (col, (&t, noise)) in line.iter().zip(bytes.chunks_exact(2)).enumerate() {
            // The sum of two uniform bytes has mean 255 and standard deviation 104.5.
            let grain = grain * (f32::from(noise[0]) + f32::from(noise[1]) - 255.0) / 104.5;
            let shine = reflection.as_ref().map_or(0.0, |r| r.rows[row] * r.cols[col]);
            let t = t.clamp(-1.5, 1.5);
            for c in 0..3 {
                // The cast to u8 limits values to 0 and 255, like a camera.
                rgb.push((middle[c] + swing[c] * t + grain + shine + 0.5) as u8);
            }
        }
    }
    rgb
}

/// Brightness of the light in red, green and blue, relative to the expert's room.
fn illumination(draws: &Draws<'_>, flash: bool) -> [f64; 3] {
    let (light, warmth) = if flash {
        (draws.value("flash"), 0.0)
    } else {
        (draws.value("light"), draws.value("warmth"))
    };
    let light = light.exp();
    [light * (0.5 * warmth).exp(), light, light * (-0.5 * warmth).exp()]
}

/// The flash's reflection, a white spot: its brightness is `rows[y]` times `cols[x]`.
struct Reflection {
    rows: Vec<f32>,
    cols: Vec<f32>,
}

impl Reflection {
    fn draw(draws: &Draws<'_>, rng: &mut impl Rng) -> Self {
        let gloss = logistic(draws.value("gloss"));
        let (mirror, matt) = REFLECTION_PIXELS;
        let width = matt + gloss * (mirror - matt);
        let mut spot = |len: usize, strength: f64| {
            let centre = len as f64 * (0.4 + 0.2 * uniform(rng));
            let at = |i: usize| (-0.5 * ((i as f64 - centre) / width).powi(2)).exp();
            (0..len).map(|i| (strength * at(i)) as f32).collect()
        };
        Self { rows: spot(Image::ROWS, 255.0 * gloss), cols: spot(Image::COLS, 1.0) }
    }
}

/// A texture: a sum of plane waves, with standard deviation 1/√2.
struct WaveTexture {
    /// for each wave and column: strength times cos and sin of the phase
    cols: [Vec<(f32, f32)>; WAVES],
    /// for each wave: the change of phase from row to row
    per_row: [f64; WAVES],
}

impl WaveTexture {
    fn draw(draws: &Draws<'_>, rng: &mut impl Rng) -> Self {
        let wavelength = draws.value("wavelength").exp().max(2.0);
        // All waves turn by a random angle; the angles between waves belong to the surface.
        let turned = uniform(rng);
        let mut per_row = [0.0; WAVES];
        let cols = std::array::from_fn(|wave| {
            let angle = TAU * (turned + draws.surface_uniform("wave angle", wave as u32));
            let stretch = 0.5 + 1.5 * draws.surface_uniform("wave stretch", wave as u32);
            let (along_rows, along_cols) = angle.sin_cos();
            let turn = TAU / (wavelength * stretch);
            per_row[wave] = turn * along_rows;
            let start = TAU * uniform(rng);
            let strength = (1.0 / WAVES as f64).sqrt();
            (0..Image::COLS)
                .map(|col| {
                    let (sin, cos) = (start + turn * along_cols * col as f64).sin_cos();
                    ((strength * cos) as f32, (strength * sin) as f32)
                })
                .collect()
        });
        Self { cols, per_row }
    }

    fn row(&self, row: usize, line: &mut [f32; Image::COLS]) {
        line.fill(0.0);
        for (cols, per_row) in self.cols.iter().zip(self.per_row) {
            let (sin, cos) = (per_row * row as f64).sin_cos();
            let (sin, cos) = (sin as f32, cos as f32);
            for (x, (col_cos, col_sin)) in line.iter_mut().zip(cols) {
                *x += cos * col_cos - sin * col_sin;
            }
        }
    }
}

/// Red, green and blue from hue in turns, saturation and value.
fn from_hsv(hue: f64, saturation: f64, value: f64) -> [f64; 3] {
    std::array::from_fn(|channel| {
        let k = ([5.0, 3.0, 1.0][channel] + 6.0 * hue).rem_euclid(6.0);
        value * (1.0 - saturation * k.min(4.0 - k).clamp(0.0, 1.0))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hues_are_where_they_belong() {
        assert_eq!(from_hsv(0.0, 1.0, 1.0), [1.0, 0.0, 0.0]);
        assert_eq!(from_hsv(0.5, 0.5, 0.8), [0.4, 0.8, 0.8]);
        assert_eq!(from_hsv(-1.0 / 3.0, 1.0, 1.0).map(f64::round), [0.0, 0.0, 1.0]);
    }
}
