//! Turns a picture upright, and cuts out the region of 320 × 480 pixels (wide × high) to compare.

use image::RgbImage;
use image::imageops::{rotate90, rotate180, rotate270, thumbnail};
use serde::Serialize;

use crate::trial::Image;

/// A part of a picture, as fractions (0 to 1) of the picture's width and height.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Region {
    pub left: f64,
    pub top: f64,
    pub width: f64,
    pub height: f64,
}

/// The clockwise turn that makes a camera's picture upright, by 0°, 90°, 180° or 270°.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Turn {
    None,
    Right,
    Over,
    Left,
}

impl Turn {
    /// The turn for 0, 90, 180 or 270 degrees clockwise; `None` for any other angle.
    pub fn from_degrees(degrees: u32) -> Option<Self> {
        Some(match degrees {
            0 => Self::None,
            90 => Self::Right,
            180 => Self::Over,
            270 => Self::Left,
            _ => return None,
        })
    }

    pub fn turn(self, picture: RgbImage) -> RgbImage {
        match self {
            Self::None => picture,
            Self::Right => rotate90(&picture),
            Self::Over => rotate180(&picture),
            Self::Left => rotate270(&picture),
        }
    }
}

const ASPECT: f64 = Image::COLS as f64 / Image::ROWS as f64;
/// Longest side, in pixels, of a picture that is shown to users.
const LONGEST: u32 = 480;

/// Cuts the largest region of 2:3 (wide : high) from the centre of an upright picture, and scales
/// it to 320 × 480 pixels. A new pixel is the mean of the area that it covers.
///
/// `None` if the picture is empty.
pub(super) fn compared(upright: &RgbImage) -> Option<Image> {
    if upright.is_empty() {
        return None;
    }
    let (left_across, top_down) = centre(upright);
    let across = pixel_shares(left_across, Image::COLS, upright.width());
    let down = pixel_shares(top_down, Image::ROWS, upright.height());
    Image::new(Image::COLS, Image::ROWS, scale(upright, &across, &down)).ok()
}

/// The region that [`compared`] cuts out of an upright picture.
pub(super) fn region(upright: &RgbImage) -> Region {
    let (width, height) = (f64::from(upright.width()), f64::from(upright.height()));
    let ((left, w), (top, h)) = centre(upright);
    Region { left: left / width, top: top / height, width: w / width, height: h / height }
}

/// Scales a picture down until no side is longer than `LONGEST` pixels.
pub(super) fn small(picture: &RgbImage) -> RgbImage {
    let longest = picture.width().max(picture.height()).max(1);
    let fit = |side: u32| (side * LONGEST.min(longest) / longest).max(1);
    thumbnail(picture, fit(picture.width()), fit(picture.height()))
}

/// Start and length, in x and in y, of the largest region of 2:3 in the centre of a picture.
fn centre(picture: &RgbImage) -> ((f64, f64), (f64, f64)) {
    let (width, height) = (f64::from(picture.width()), f64::from(picture.height()));
    let (w, h) = (width.min(height * ASPECT), height.min(width / ASPECT));
    (((width - w) / 2.0, w), ((height - h) / 2.0, h))
}

/// For a new pixel along a side: the first old pixel under it, and the weights of old pixels.
type PixelShares = (usize, Vec<f32>);

/// Divides `extent` old pixels (from `begin` on, of `of` in the side) among `pixels` new ones.
fn pixel_shares((begin, extent): (f64, f64), pixels: usize, of: u32) -> Vec<PixelShares> {
    let of = of as usize;
    let step = extent / pixels as f64;
    let cover = |i: usize| {
        let (from, to) = (begin + step * i as f64, begin + step * (i + 1) as f64);
        let first = (from as usize).min(of - 1);
        let last = (to.ceil() as usize).clamp(first + 1, of);
        let shares = (first..last).map(|at| {
            let (low, high) = (from.max(at as f64), to.min((at + 1) as f64));
            ((high - low).max(0.0) / step) as f32
        });
        let mut shares: Vec<f32> = shares.collect();
        // Divides the weights by their sum, so that rounding at the edges does not darken a pixel.
        let sum: f32 = shares.iter().sum();
        shares.iter_mut().for_each(|share| *share /= sum);
        (first, shares)
    };
    (0..pixels).map(cover).collect()
}

fn scale(picture: &RgbImage, across: &[PixelShares], down: &[PixelShares]) -> Vec<u8> {
    let stride = picture.width() as usize * 3;
    let mut out = Vec::with_capacity(across.len() * down.len() * 3);
    let mut sums = vec![0.0_f32; stride];
    for (first, shares) in down {
        sums.fill(0.0);
        for (i, share) in shares.iter().enumerate() {
            let start = (first + i) * stride;
            for (sum, &byte) in sums.iter_mut().zip(&picture.as_raw()[start..start + stride]) {
                *sum += share * f32::from(byte);
            }
        }
        for (first, shares) in across {
            let mut pixel = [0.5_f32; 3];
            for (share, part) in shares.iter().zip(sums[first * 3..].chunks_exact(3)) {
                for (to, from) in pixel.iter_mut().zip(part) {
                    *to += share * from;
                }
            }
            // The cast rounds, since the sums began at one half, and limits values to 0 and 255.
            out.extend(pixel.map(|value| value as u8));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture(width: u32, height: u32, of: impl Fn(u32, u32) -> [u8; 3]) -> RgbImage {
        RgbImage::from_fn(width, height, |x, y| image::Rgb(of(x, y)))
    }

    #[test]
    fn a_landscape_picture_gives_its_centre() {
        let wide = picture(640, 480, |x, y| [(x / 4) as u8, y as u8, 0]);
        let image = compared(&wide).unwrap();
        assert_eq!(image.pixel(0, 0), [40, 0, 0]);
        assert_eq!(image.pixel(479, 319), [119, 479_usize as u8, 0]);
    }

    #[test]
    fn each_turn_brings_the_corner_to_its_place() {
        // A picture with a bright top left corner, and the corner's place after each turn.
        let corner = |w: u32, h: u32| {
            picture(w, h, |x, y| [if x < w / 4 && y < h / 4 { 255 } else { 0 }; 3])
        };
        let red = |image: &Image, row, col| image.pixel(row, col)[0] > 200;
        for (turn, (row, col)) in [
            (Turn::None, (0, 0)),
            (Turn::Over, (479, 319)),
            (Turn::Right, (0, 319)),
            (Turn::Left, (479, 0)),
        ] {
            let lies = matches!(turn, Turn::Right | Turn::Left);
            let (width, height) = if lies { (480, 320) } else { (320, 480) };
            let image = compared(&turn.turn(corner(width, height))).unwrap();
            assert!(red(&image, row, col), "{turn:?}");
            assert!(!red(&image, 479 - row, 319 - col));
        }
    }

    #[test]
    fn a_turn_by_90_degrees_is_that_of_recordings() {
        let lying = picture(480, 320, |x, y| [x as u8, y as u8, (x / 2) as u8]);
        let recorded = Image::new(480, 320, lying.as_raw().clone()).unwrap();
        assert_eq!(compared(&Turn::Right.turn(lying)), Some(recorded));
    }

    #[test]
    fn scaling_takes_the_mean_of_the_area() {
        // A checkerboard of single pixels, at twice the final size, averages to grey.
        let checkers = picture(640, 960, |x, y| [if (x + y) % 2 == 0 { 200 } else { 100 }; 3]);
        let image = compared(&checkers).unwrap();
        assert!(image.rgb().iter().all(|&byte| byte == 150));
    }

    #[test]
    fn the_mean_colour_and_a_constant_survive_any_size() {
        for (width, height) in [(1, 1), (7, 3), (333, 517), (1280, 720), (1921, 1079)] {
            for turn in [Turn::None, Turn::Right, Turn::Over, Turn::Left] {
                let plain = picture(width, height, |_, _| [255, 7, 130]);
                let image = compared(&turn.turn(plain)).unwrap();
                assert!(image.rgb().chunks(3).all(|pixel| pixel == [255, 7, 130]));
            }
        }
        assert_eq!(compared(&RgbImage::new(0, 0)), None);
    }
}
