//! Samples in groups, and sums of 1 − κ within groups: what `joint` compares.

use multiversion::multiversion;

use super::framed::Framed;
use super::frames::ViewFrames;
use super::pixels::{Part, PixelGroup, pixel_pairs};
use super::scale::{SourceScale, ViewScale, group_means, mean, median};
use super::slow::SlowSeries;

/// Widths of the kernel, in spreads of the library.
pub const WIDTHS: [f64; 4] = [1.0, 2.0, 4.0, 8.0];

const LANES: usize = 8;

/// Duration of a block that log-amplitudes are averaged over.
const BLOCK_S: f64 = 0.255;

/// Samples of a group of pairs.
const ANCHORS: usize = 64;

/// Coordinates beyond this many spreads are clipped: an outlier is an outlier.
const CLIP: f32 = 4.0;

/// Samples of one source: each group has as many, of as many coordinates.
#[derive(Clone, Debug)]
pub(super) struct Grouped {
    groups: usize,
    coordinates: usize,
    /// Shape (samples a group, coordinates, groups filled up to whole lanes), in spreads. Groups
    /// that fill up lanes are 0 everywhere.
    values: Vec<f32>,
    /// Per coordinate and group: 1, or 0 for a group without samples.
    used: Vec<f32>,
}

impl Grouped {
    /// The scales of a source. A spectrum's is that of its block means in the view of long
    /// frames, one for all bands of a channel.
    pub fn scale(trials: &[&Framed], align: bool) -> SourceScale {
        let Framed::Bands(views) = trials[0] else { return SourceScale::new(trials, align) };
        let view = &views[0].view;
        let blocks: Vec<Vec<f32>> = trials
            .iter()
            .filter_map(|framed| match framed {
                Framed::Bands(views) => Some(block_means(&views[0], align)),
                _ => None,
            })
            .collect();
        let (width, bands) = (view.width(), view.bands());
        let mads: Vec<f32> = (0..width)
            .map(|column| {
                let of_column = blocks.iter().flat_map(|b| b[column..].iter().step_by(width));
                let mut values: Vec<f32> = of_column.copied().collect();
                let middle = median(&mut values);
                values.iter_mut().for_each(|x| *x = (*x - middle).abs());
                1.4826 * median(&mut values)
            })
            .collect();
        let of_channel = |mads: &[f32]| median(&mut mads.to_vec()).max(1e-3);
        let spread = mads.chunks(bands).map(of_channel).collect();
        SourceScale::Bands(vec![ViewScale { centre: Vec::new(), spread, power: Vec::new() }])
    }

    /// The samples of a source.
    pub fn new(framed: &Framed, scale: &SourceScale, align: bool) -> Self {
        match (framed, scale) {
            (Framed::Bands(views), SourceScale::Bands(scales)) => {
                let view = &views[0].view;
                let means = block_means(&views[0], align);
                let (width, bands) = (view.width(), view.bands());
                let samples = means.len() / width;
                Self::build(width, 1, samples, |sample, group, point| {
                    point[0] = means[sample * width + group] / scales[0].spread[group / bands];
                    true
                })
            }
            (Framed::Slow(series), SourceScale::Slow(scales)) => {
                Self::of_series(series, scales, align)
            }
            (Framed::Pixels(grid), SourceScale::Pixels(scales)) => {
                let cells = grid.cells(Part::Whole);
                let of_group = |(g, group): (usize, PixelGroup)| {
                    let (mut points, circular) = (Vec::new(), group.circular());
                    pixel_pairs(&cells, group, |a, b, saturation| {
                        let place = |x: f32, which: usize| {
                            if circular[which] {
                                // On the cone of colours: grey has no hue.
                                let (sin, cos) = (x * std::f32::consts::TAU).sin_cos();
                                [saturation * cos, saturation * sin].map(|x| x * CLIP / 2.0)
                            } else {
                                let s = scales[g][which];
                                [((x - s.centre) / s.spread).clamp(-CLIP, CLIP), 0.0]
                            }
                        };
                        points.push([place(a, 0), place(b, 1)].concat());
                    });
                    points
                };
                let points: Vec<_> =
                    PixelGroup::ALL.into_iter().enumerate().map(of_group).collect();
                Self::build(points.len(), 4, ANCHORS, |sample, group, point| {
                    let points = &points[group];
                    point.copy_from_slice(&points[sample * points.len() / ANCHORS]);
                    true
                })
            }
            // The checks of a trial against its scene give a source one kind of data.
            _ => Self::build(1, 1, 1, |_, _, _| false),
        }
    }

    fn of_series(series: &SlowSeries, scales: &[[super::scale::Spread; 2]], align: bool) -> Self {
        let all = 0..series.len();
        let groups = SlowSeries::groups(series.channels.len());
        let of_group = |(group, scale): (_, &[super::scale::Spread; 2])| {
            let means = group_means(series, group, all.clone(), align);
            let mut points: Vec<[f32; 2]> = Vec::with_capacity(ANCHORS);
            series.pairs(group, all.clone(), ANCHORS, |a, b| {
                let place = |x: f32, i: usize| {
                    ((x - means[i] - scale[i].centre) / scale[i].spread).clamp(-CLIP, CLIP)
                };
                points.push([place(a, 0), place(b, 1)]);
            });
            points
        };
        let points: Vec<_> = groups.into_iter().zip(scales).map(of_group).collect();
        Self::build(points.len(), 2, ANCHORS, |sample, group, point| {
            let points = &points[group];
            if points.is_empty() {
                return false;
            }
            point.copy_from_slice(&points[sample * points.len() / ANCHORS]);
            true
        })
    }

    fn build(
        groups: usize,
        coordinates: usize,
        samples: usize,
        mut point: impl FnMut(usize, usize, &mut [f32]) -> bool,
    ) -> Self {
        let padded = groups.next_multiple_of(LANES);
        let mut values = vec![0.0; samples * coordinates * padded];
        let mut used = vec![0.0; padded];
        let mut at = vec![0.0; coordinates];
        for sample in 0..samples {
            for group in 0..groups {
                if point(sample, group, &mut at) {
                    used[group] = 1.0;
                    for (c, &x) in at.iter().enumerate() {
                        values[(sample * coordinates + c) * padded + group] = x;
                    }
                }
            }
        }
        Self { groups, coordinates, values, used }
    }

    /// Number of samples, over all groups.
    pub fn samples(&self) -> usize {
        self.groups * self.values.len() / (self.used.len() * self.coordinates)
    }
}

/// Log-amplitudes averaged over blocks, shape (blocks, width); the overall mean taken off where
/// `align` says so.
fn block_means(frames: &ViewFrames, align: bool) -> Vec<f32> {
    let view = &frames.view;
    let (width, count) = (view.width(), frames.frames());
    let in_block = ((BLOCK_S * view.rate_hz / view.hop() as f64).round() as usize).max(1);
    let blocks = (count / in_block).max(1);
    let mut means = Vec::with_capacity(blocks * width);
    for block in 0..blocks {
        let used = block * count / blocks..(block + 1) * count / blocks;
        let rows = frames.rows(used.clone());
        means.extend((0..width).map(|column| {
            let sum: f64 = rows[column..].iter().step_by(width).map(|&x| f64::from(x)).sum();
            (sum / used.len() as f64) as f32
        }));
    }
    if align {
        let gain = mean(&means);
        means.iter_mut().for_each(|x| *x -= gain);
    }
    means
}

/// Mean of 1 − κ over all pairs of samples of one group, averaged over groups, for each of
/// [`WIDTHS`]. Groups that one side has no samples of are left out.
pub(super) fn deficits(z: &Grouped, y: &Grouped) -> [f64; 4] {
    if z.used.len() != y.used.len() || z.coordinates != y.coordinates {
        return [0.0; 4];
    }
    let used: Vec<f32> = z.used.iter().zip(&y.used).map(|(a, b)| a * b).collect();
    let mut sums = [0.0; 4];
    sum_deficits(&z.values, &y.values, &used, z.coordinates, &mut sums);
    let row = z.used.len() * z.coordinates;
    let pairs = (z.values.len() / row) as f64 * (y.values.len() / row) as f64;
    let groups = used.iter().map(|&x| f64::from(x)).sum::<f64>().max(1.0);
    sums.map(|sum| sum / (pairs * groups))
}

/// 1 − e^(−x) at the smallest argument by its series, and from there by doubling,
/// g(2x) = g(x)·(2 − g(x)), which keeps the relative error: each width's argument is four times
/// that of the next. Below 4e-6 relative (tested).
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn sum_deficits(z: &[f32], y: &[f32], used: &[f32], coordinates: usize, sums: &mut [f64; 4]) {
    let padded = used.len();
    let row = padded * coordinates;
    // x at w = 8, over 16 for the series.
    const SMALLEST: f32 = 1.0 / (2.0 * 64.0 * 16.0);
    for z in z.chunks_exact(row) {
        let mut acc = [[0f32; LANES]; 4];
        for y in y.chunks_exact(row) {
            for begin in (0..padded).step_by(LANES) {
                let mut x = [0f32; LANES];
                for c in 0..coordinates {
                    let at = c * padded + begin;
                    let (z, y) = (&z[at..at + LANES], &y[at..at + LANES]);
                    for lane in 0..LANES {
                        let d = z[lane] - y[lane];
                        x[lane] += d * d;
                    }
                }
                let mut g = [0f32; LANES];
                for lane in 0..LANES {
                    let x = (x[lane] * SMALLEST).min(0.5);
                    g[lane] = x
                        * (1.0
                            - x * (0.5
                                - x * (1.0 / 6.0
                                    - x * (1.0 / 24.0
                                        - x * (1.0 / 120.0 - x * (1.0 / 720.0 - x / 5040.0))))));
                    for _ in 0..4 {
                        g[lane] *= 2.0 - g[lane];
                    }
                }
                let used = &used[begin..begin + LANES];
                for width in (0..4).rev() {
                    for lane in 0..LANES {
                        acc[width][lane] += used[lane] * g[lane];
                        if width > 0 {
                            let twice = g[lane] * (2.0 - g[lane]);
                            g[lane] = twice * (2.0 - twice);
                        }
                    }
                }
            }
        }
        for (sum, lanes) in sums.iter_mut().zip(acc) {
            *sum += lanes.iter().map(|&x| f64::from(x)).sum::<f64>();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn grouped(values: &[f32], groups: usize, coordinates: usize) -> Grouped {
        let samples = values.len() / (groups * coordinates);
        Grouped::build(groups, coordinates, samples, |s, g, point| {
            for (c, x) in point.iter_mut().enumerate() {
                *x = values[(s * groups + g) * coordinates + c];
            }
            true
        })
    }

    /// The same in f64, straight from the definition.
    fn oracle(z: &[f32], y: &[f32], groups: usize, coordinates: usize, w: f64) -> f64 {
        let row = groups * coordinates;
        let (mut sum, mut pairs) = (0.0, 0.0);
        for z in z.chunks_exact(row) {
            for y in y.chunks_exact(row) {
                for (z, y) in z.chunks(coordinates).zip(y.chunks(coordinates)) {
                    let d2: f64 = z.iter().zip(y).map(|(a, b)| f64::from(a - b).powi(2)).sum();
                    sum -= (-d2 / (2.0 * w * w)).exp_m1();
                    pairs += 1.0;
                }
            }
        }
        sum / pairs
    }

    proptest! {
        #[test]
        fn sums_are_those_of_the_definition(
            groups in 1usize..20,
            coordinates in 1usize..=4,
            size in -3i32..2,
            values in prop::collection::vec(-3f32..3.0, 160..400),
            others in prop::collection::vec(-3f32..3.0, 160..400),
        ) {
            let size = 10f32.powi(size);
            let z: Vec<f32> = values.iter().map(|x| x * size).collect();
            let y: Vec<f32> = others.iter().map(|x| x * size).collect();
            let fast = deficits(&grouped(&z, groups, coordinates), &grouped(&y, groups, coordinates));
            for (fast, w) in fast.into_iter().zip(WIDTHS) {
                let exact = oracle(&z, &y, groups, coordinates, w);
                prop_assert!((fast - exact).abs() <= 4e-6 * exact, "{fast} vs {exact} at {w}");
            }
        }
    }

    #[test]
    fn a_group_that_one_side_lacks_is_left_out() {
        let full = Grouped::build(2, 1, 3, |s, g, point| {
            point[0] = (s + 5 * g) as f32;
            true
        });
        let lacking = Grouped::build(2, 1, 3, |s, g, point| {
            point[0] = s as f32;
            g == 0
        });
        let alone = Grouped::build(1, 1, 3, |s, _, point| {
            point[0] = s as f32;
            true
        });
        assert_eq!(deficits(&full, &lacking), deficits(&alone, &alone));
    }
}
