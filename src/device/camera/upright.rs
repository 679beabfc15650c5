//! The upright region of 320 × 480 pixels (wide × high) that is compared, out of any picture.

use serde::Serialize;

use super::Rgb;
use crate::trial::Image;

/// A part of a picture, in shares of its width and its height, from 0 to 1.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Region {
    /// Distance from the left edge.
    pub left: f64,
    /// Distance from the upper edge.
    pub top: f64,
    pub width: f64,
    pub height: f64,
}

/// By how much a camera's picture is turned clockwise to stand upright.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Turn {
    /// Not at all.
    #[default]
    None,
    /// By 90° clockwise: the camera lies on its left side.
    Right,
    /// By 180°.
    Over,
    /// By 270° clockwise.
    Left,
}

impl Turn {
    /// From degrees clockwise: 0, 90, 180 or 270.
    pub fn from_degrees(degrees: u32) -> Option<Self> {
        Some(match degrees {
            0 => Self::None,
            90 => Self::Right,
            180 => Self::Over,
            270 => Self::Left,
            _ => return None,
        })
    }

    /// Whether the turn swaps width and height.
    pub fn swaps(self) -> bool {
        matches!(self, Self::Right | Self::Left)
    }

    /// Width and height of a picture once it is turned.
    fn upright_size(self, picture: &Rgb) -> (usize, usize) {
        match self.swaps() {
            true => (picture.height, picture.width),
            false => (picture.width, picture.height),
        }
    }
}

/// Width of the region that is compared, divided by its height.
const ASPECT: f64 = Image::COLS as f64 / Image::ROWS as f64;
/// Longer side of a picture that is shown to people only, in pixels.
const LONGEST: usize = 480;

/// Turns a picture, cuts the largest region of 2:3 (wide : high) out of its centre, and scales it
/// to 320 × 480 pixels, each of which is the mean of the area that it covers.
///
/// None if the picture is empty.
pub fn upright(picture: &Rgb, turn: Turn) -> Option<Image> {
    if picture.width == 0 || picture.height == 0 {
        return None;
    }
    let aspect = match turn.swaps() {
        true => ASPECT.recip(),
        false => ASPECT,
    };
    let part = centre(picture.width as f64, picture.height as f64, aspect);
    let rgb = cut(picture, part, (Image::COLS, Image::ROWS), turn);
    Image::new(Image::COLS, Image::ROWS, rgb).ok()
}

/// The region that [`upright`] cuts out, in the picture turned upright.
pub fn region(picture: &Rgb, turn: Turn) -> Region {
    let (width, height) = turn.upright_size(picture);
    let (width, height) = (width as f64, height as f64);
    let ((left, w), (top, h)) = centre(width, height, ASPECT);
    Region { left: left / width, top: top / height, width: w / width, height: h / height }
}

/// Turns a whole picture, and scales it down until its longer side has no more than `LONGEST`
/// pixels.
///
/// None if the picture is empty.
pub fn small(picture: &Rgb, turn: Turn) -> Option<Rgb> {
    if picture.width == 0 || picture.height == 0 {
        return None;
    }
    let (width, height) = turn.upright_size(picture);
    let longest = width.max(height);
    let fit = |side: usize| (side * LONGEST.min(longest) / longest).max(1);
    let (width, height) = (fit(width), fit(height));
    let whole = ((0.0, picture.width as f64), (0.0, picture.height as f64));
    Some(Rgb { width, height, bytes: cut(picture, whole, (width, height), turn) })
}

/// Scales a part (begin and extent, in x and in y) of a picture before its turn, then turns it: the
/// result is `width` × `height` upright.
fn cut(
    picture: &Rgb,
    ((left, across), (top, down)): ((f64, f64), (f64, f64)),
    (width, height): (usize, usize),
    turn: Turn,
) -> Vec<u8> {
    // The size before the turn, which may swap width and height.
    let (cols, rows) = if turn.swaps() { (height, width) } else { (width, height) };
    let across = PixelShares::new(left, across, cols, picture.width);
    let down = PixelShares::new(top, down, rows, picture.height);
    let lying = scale(picture, &across, &down);
    let at = |row: usize, col: usize| match turn {
        Turn::None => (row, col),
        Turn::Right => (rows - 1 - col, row),
        Turn::Over => (rows - 1 - row, cols - 1 - col),
        Turn::Left => (col, cols - 1 - row),
    };
    let mut rgb = Vec::with_capacity(width * height * 3);
    for row in 0..height {
        for col in 0..width {
            let (row, col) = at(row, col);
            let start = (row * cols + col) * 3;
            rgb.extend_from_slice(&lying[start..start + 3]);
        }
    }
    rgb
}

/// Begin and extent, in x and in y, of the largest region of this aspect (width / height) that
/// lies in the centre.
fn centre(width: f64, height: f64, aspect: f64) -> ((f64, f64), (f64, f64)) {
    let (w, h) = (width.min(height * aspect), height.min(width / aspect));
    (((width - w) / 2.0, w), ((height - h) / 2.0, h))
}

/// For each pixel along one side of the result: the first input pixel that it covers, and the
/// weights of this and of the following ones, which add up to 1.
struct PixelShares(Vec<(usize, Vec<f32>)>);

impl PixelShares {
    /// Divides `extent` input pixels from `begin` on, of a side of `of`, into `pixels` equal parts.
    fn new(begin: f64, extent: f64, pixels: usize, of: usize) -> Self {
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
            // Rounding at the edges must not darken a pixel.
            let sum: f32 = shares.iter().sum();
            shares.iter_mut().for_each(|share| *share /= sum);
            (first, shares)
        };
        Self((0..pixels).map(cover).collect())
    }
}

fn scale(picture: &Rgb, across: &PixelShares, down: &PixelShares) -> Vec<u8> {
    let cols = across.0.len();
    let stride = picture.width * 3;
    let mut out = Vec::with_capacity(cols * down.0.len() * 3);
    let mut sums = vec![0.0_f32; stride];
    for (first, shares) in &down.0 {
        sums.fill(0.0);
        for (i, share) in shares.iter().enumerate() {
            let start = (first + i) * stride;
            for (sum, &byte) in sums.iter_mut().zip(&picture.bytes[start..start + stride]) {
                *sum += share * f32::from(byte);
            }
        }
        for (first, shares) in &across.0 {
            let mut pixel = [0.5_f32; 3];
            for (share, part) in shares.iter().zip(sums[first * 3..].chunks_exact(3)) {
                for (to, from) in pixel.iter_mut().zip(part) {
                    *to += share * from;
                }
            }
            // Half was added to round; `as` saturates.
            out.extend(pixel.map(|value| value as u8));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture(width: usize, height: usize, of: impl Fn(usize, usize) -> [u8; 3]) -> Rgb {
        let bytes = (0..width * height).flat_map(|at| of(at % width, at / width)).collect();
        Rgb { width, height, bytes }
    }

    #[test]
    fn a_picture_of_the_right_size_is_left_as_it_is() {
        let exact = picture(320, 480, |x, y| [x as u8, y as u8, (x * y) as u8]);
        assert_eq!(upright(&exact, Turn::None).unwrap().rgb(), exact.bytes);
    }

    #[test]
    fn a_landscape_picture_gives_its_centre() {
        let wide = picture(640, 480, |x, y| [(x / 4) as u8, y as u8, 0]);
        let image = upright(&wide, Turn::None).unwrap();
        assert_eq!(image.pixel(0, 0), [40, 0, 0]);
        assert_eq!(image.pixel(479, 319), [119, 479_usize as u8, 0]);
    }

    #[test]
    fn each_turn_brings_the_corner_to_its_place() {
        // A bright top left corner, and where it must be after each turn.
        let corner = |w, h| picture(w, h, |x, y| [if x < w / 4 && y < h / 4 { 255 } else { 0 }; 3]);
        let red = |image: &Image, row, col| image.pixel(row, col)[0] > 200;
        let places = [(Turn::None, (0, 0)), (Turn::Over, (479, 319))];
        for (turn, (row, col)) in places {
            let image = upright(&corner(320, 480), turn).unwrap();
            assert!(red(&image, row, col), "{turn:?}");
            assert!(!red(&image, 479 - row, 319 - col));
        }
        for (turn, (row, col)) in [(Turn::Right, (0, 319)), (Turn::Left, (479, 0))] {
            let image = upright(&corner(480, 320), turn).unwrap();
            assert!(red(&image, row, col), "{turn:?}");
            assert!(!red(&image, 479 - row, 319 - col));
        }
    }

    #[test]
    fn a_turn_by_90_degrees_is_that_of_recordings() {
        let lying = picture(480, 320, |x, y| [x as u8, y as u8, (x / 2) as u8]);
        let recorded = Image::new(480, 320, lying.bytes.clone()).unwrap();
        assert_eq!(upright(&lying, Turn::Right), Some(recorded));
    }

    #[test]
    fn scaling_takes_the_mean_of_the_area() {
        // Checkers of one pixel at twice the size average to one grey.
        let checkers = picture(640, 960, |x, y| [if (x + y) % 2 == 0 { 200 } else { 100 }; 3]);
        let image = upright(&checkers, Turn::None).unwrap();
        assert!(image.rgb().iter().all(|&byte| byte == 150));
    }

    #[test]
    fn the_mean_colour_and_a_constant_survive_any_size() {
        for (width, height) in [(1, 1), (7, 3), (333, 517), (1280, 720), (1921, 1079)] {
            for turn in [Turn::None, Turn::Right, Turn::Over, Turn::Left] {
                let plain = picture(width, height, |_, _| [255, 7, 130]);
                let image = upright(&plain, turn).unwrap();
                assert!(image.rgb().chunks(3).all(|pixel| pixel == [255, 7, 130]));
            }
        }
        assert_eq!(upright(&picture(0, 0, |_, _| [0; 3]), Turn::None), None);
    }
}
