//! Neighbouring pixels: what is kept of a picture.
//!
//! A grid of 40 × 40 pixels, each with its neighbours 1, 4 and 16 pixels to the right and below,
//! in HSV. A sample is a pair (value, neighbour − value) of one channel at one distance, right and
//! down pooled; three further groups pair two channels of one pixel.

use super::colour::hsv;
use crate::trial::Image;

/// Pixels along a side of the grid.
const GRID: usize = 40;

/// Distances to neighbours, in pixels.
const OFFSETS: [usize; 3] = [1, 4, 16];

/// A pixel of the grid: itself, its right neighbours, its lower ones; bytes of red, green, blue.
type PixelNeighbours = [[u8; 3]; 1 + 2 * OFFSETS.len()];

/// The same in hue, saturation, value.
pub type HsvCell = [[f32; 3]; 1 + 2 * OFFSETS.len()];

/// A part of a picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// All of it.
    Whole,
    /// One quarter: lower half, right half.
    Quarter(bool, bool),
}

/// The quarters, which divide the whole.
pub const QUARTERS: [Part; 4] = [
    Part::Quarter(false, false),
    Part::Quarter(false, true),
    Part::Quarter(true, false),
    Part::Quarter(true, true),
];

/// The grid of a picture.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct PixelGrid {
    /// Row by row.
    cells: Vec<PixelNeighbours>,
}

/// Two coordinates that are compared together.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PixelGroup {
    /// Channel (0 hue, 1 saturation, 2 value) and index of the distance.
    Neighbour(usize, usize),
    /// Two channels of one pixel.
    Cross(usize, usize),
}

impl PixelGroup {
    /// All groups, in order.
    pub const ALL: [Self; 12] = [
        Self::Neighbour(0, 0),
        Self::Neighbour(0, 1),
        Self::Neighbour(0, 2),
        Self::Neighbour(1, 0),
        Self::Neighbour(1, 1),
        Self::Neighbour(1, 2),
        Self::Neighbour(2, 0),
        Self::Neighbour(2, 1),
        Self::Neighbour(2, 2),
        Self::Cross(0, 1),
        Self::Cross(1, 2),
        Self::Cross(0, 2),
    ];

    /// Which coordinates are hues, or differences of hues, in turns.
    pub fn circular(self) -> [bool; 2] {
        match self {
            Self::Neighbour(0, _) => [true, true],
            Self::Cross(0, _) => [true, false],
            _ => [false, false],
        }
    }

    /// Whether samples weigh by the pixel's saturation: grey has no hue.
    pub fn by_saturation(self) -> bool {
        self.circular()[0]
    }
}

impl PixelGrid {
    /// The grid of a picture.
    pub fn new(image: &Image) -> Self {
        let reach = OFFSETS[OFFSETS.len() - 1];
        let at = |i: usize, size: usize| (2 * i + 1) * (size - reach) / (2 * GRID);
        let cells = (0..GRID * GRID).map(|i| {
            let (row, col) = (at(i / GRID, Image::ROWS), at(i % GRID, Image::COLS));
            let mut cell = [image.pixel(row, col); 1 + 2 * OFFSETS.len()];
            for (o, offset) in OFFSETS.into_iter().enumerate() {
                cell[1 + o] = image.pixel(row, col + offset);
                cell[1 + OFFSETS.len() + o] = image.pixel(row + offset, col);
            }
            cell
        });
        Self { cells: cells.collect() }
    }

    /// The cells of a part, in HSV.
    pub fn cells(&self, part: Part) -> Vec<HsvCell> {
        let half = GRID / 2;
        let is_in = |i: usize| match part {
            Part::Whole => true,
            Part::Quarter(lower, right) => {
                (i / GRID >= half) == lower && (i % GRID >= half) == right
            }
        };
        let kept = self.cells.iter().enumerate().filter(|(i, _)| is_in(*i));
        kept.map(|(_, cell)| cell.map(|rgb| hsv(rgb).map(|x| x as f32))).collect()
    }
}

/// The samples of a group: `each` gets first and second coordinate, and saturation.
pub fn pixel_pairs(cells: &[HsvCell], group: PixelGroup, mut each: impl FnMut(f32, f32, f32)) {
    for cell in cells {
        let pixel = cell[0];
        match group {
            PixelGroup::Cross(a, b) => each(pixel[a], pixel[b], pixel[1]),
            PixelGroup::Neighbour(c, o) => {
                for neighbour in [cell[1 + o], cell[1 + OFFSETS.len() + o]] {
                    each(pixel[c], neighbour[c] - pixel[c], pixel[1].min(neighbour[1]));
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quarters_divide_the_whole_and_neighbours_lie_where_they_should() {
        let mut rgb = vec![0; Image::ROWS * Image::COLS * 3];
        for (i, pixel) in rgb.chunks_exact_mut(3).enumerate() {
            pixel.fill((i % Image::COLS / 2) as u8);
        }
        let grid = PixelGrid::new(&Image::new(Image::COLS, Image::ROWS, rgb).unwrap());
        assert_eq!(grid.cells(Part::Whole).len(), 1600);
        let quarter = grid.cells(Part::Quarter(true, false));
        assert_eq!(quarter.len(), 400);
        let mut sum = 0.0;
        pixel_pairs(&quarter, PixelGroup::Neighbour(2, 2), |_, d, _| sum += d * 255.0);
        // 16 pixels to the right the value is 8 higher; below it is the same.
        assert!((sum / 800.0 - 4.0).abs() < 1e-3, "{sum}");
    }
}
