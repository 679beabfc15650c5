//! A picture as a vector: neighbouring pixels, group by group.

use serde::{Deserialize, Serialize};

use super::pixel_pairs::{PAIR_FEATURES, PairSums, Pairs, features};
use crate::recognise::features::image_features::{
    HsvCell, Part, PixelGrid, PixelGroup, QUARTERS, pixel_pairs,
};

/// Half the circle, in spreads of the library.
const HALF_CIRCLE: f32 = 4.0;

/// Spread of values per median of absolute deviations, for normal ones.
const PER_MAD: f32 = 1.4826;

/// Pictures that spreads are taken of, at most (about).
const ENOUGH: usize = 32;

/// Centre and spread of one coordinate.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct Spread {
    /// Median.
    centre: f32,
    /// Robust standard deviation; never 0.
    spread: f32,
}

/// How pictures of one source become vectors.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct PictureEmbedder {
    /// For each group of [`PixelGroup::ALL`], both coordinates.
    scales: Vec<[Spread; 2]>,
}

impl PictureEmbedder {
    /// In units of some pictures.
    pub fn new(pictures: &[&PixelGrid]) -> Self {
        let every = pictures.len().div_ceil(ENOUGH).max(1);
        let cells: Vec<_> =
            pictures.iter().step_by(every).map(|grid| grid.cells(Part::Whole)).collect();
        let of = |group: PixelGroup| {
            let (mut first, mut second) = (Vec::new(), Vec::new());
            for cells in &cells {
                pixel_pairs(cells, group, |a, b, _| {
                    first.push(a);
                    second.push(b);
                });
            }
            [Spread::of(first), Spread::of(second)]
        };
        Self { scales: PixelGroup::ALL.into_iter().map(of).collect() }
    }

    /// Length of a vector.
    pub fn dims(&self) -> usize {
        PAIR_FEATURES * self.scales.len()
    }

    /// The vectors of some parts of a picture. Each quarter is worked on once, however many parts
    /// hold it.
    pub fn embed(&self, grid: &PixelGrid, parts: &[Part]) -> Vec<Vec<f32>> {
        let quarters = QUARTERS.map(|quarter| {
            let is_wanted = parts.iter().any(|part| [quarter, Part::Whole].contains(part));
            is_wanted.then(|| self.pair_sums(&grid.cells(quarter)))
        });
        let of_part = |part: &Part| {
            let is_in = |quarter: &Part| [quarter, &Part::Whole].contains(&part);
            let held = QUARTERS.iter().zip(&quarters).filter(|(quarter, _)| is_in(quarter));
            let held: Vec<&Vec<PairSums>> = held.filter_map(|(_, sums)| sums.as_ref()).collect();
            let of_group =
                |group: usize| features(&held.iter().map(|sums| &sums[group]).collect::<Vec<_>>());
            (0..self.scales.len()).flat_map(of_group).collect()
        };
        parts.iter().map(of_part).collect()
    }

    /// What the pairs of each group add up to.
    fn pair_sums(&self, cells: &[HsvCell]) -> Vec<PairSums> {
        let of_group = |(group, scale): (PixelGroup, &[Spread; 2])| {
            let circular = group.circular();
            let place = |x: f32, which: usize| {
                if circular[which] {
                    2.0 * (x - x.round())
                } else {
                    (x - scale[which].centre) / (HALF_CIRCLE * scale[which].spread)
                }
            };
            let mut pairs = Pairs::default();
            pixel_pairs(cells, group, |a, b, saturation| {
                let weight = if group.by_saturation() { saturation } else { 1.0 };
                pairs.push(place(a, 0), place(b, 1), weight);
            });
            pairs.into()
        };
        PixelGroup::ALL.into_iter().zip(&self.scales).map(of_group).collect()
    }
}

impl Spread {
    /// Median and robust standard deviation; where more than half the values are equal, the plain
    /// standard deviation; where all are, 1.
    fn of(mut values: Vec<f32>) -> Self {
        let centre = median(&mut values);
        values.iter_mut().for_each(|x| *x -= centre);
        let square = |x: &f32| f64::from(*x).powi(2);
        let squares: f64 = values.iter().map(square).sum::<f64>() / values.len().max(1) as f64;
        values.iter_mut().for_each(|x| *x = x.abs());
        let spread = match (PER_MAD * median(&mut values), squares.sqrt() as f32) {
            (mad, _) if mad > 0.0 => mad,
            (_, deviation) if deviation > 0.0 => deviation,
            _ => 1.0,
        };
        Self { centre, spread }
    }
}

/// The median of some values (the upper one of an even number); 0 without any. Reorders them.
fn median(values: &mut [f32]) -> f32 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f32::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_spread_is_never_zero() {
        assert_eq!(Spread::of(vec![3.0; 9]), Spread { centre: 3.0, spread: 1.0 });
        assert_eq!(Spread::of(Vec::new()).spread, 1.0);
        let switch: Vec<f32> = (0..100).map(|i| if i < 80 { 0.0 } else { 1.0 }).collect();
        assert!((Spread::of(switch).spread - 0.2f32.sqrt()).abs() < 1e-6);
        let ramp = Spread::of((0..1001).map(|i| i as f32).collect());
        assert!((ramp.spread - 370.65).abs() < 0.1);
    }
}
