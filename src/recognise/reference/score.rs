//! The score of one source: n·MMD²_b between samples of a query and of a library trial.

use std::sync::OnceLock;

use ndarray::{Array2, ArrayView2, Axis};

use super::sample_set::{SampleSet, Scratch};
use crate::kernel::{CrossSums, LineSum, Points, length_scale, mmd2_biased, mmd2_from_sums};

/// The least score that enters a product or a logarithm.
///
/// Identical trials score 0, which would turn the whole product of Eq. 9 into 0. Rounding in f64
/// leaves an error of about 1e-13 in n·MMD² at n = 400, far below this floor.
pub const SCORE_FLOOR: f64 = 1e-10;

/// Below this score, cancellation in f32 sums spoils the ratio of scores, so sums are in f64.
const F64_BELOW: f64 = 0.05;

/// ln of a score, floored at [`SCORE_FLOOR`].
pub fn log_score(score: f64) -> f64 {
    score.max(SCORE_FLOOR).ln()
}

/// Result of comparing two sets of samples.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct SampleScore {
    pub n: usize,
    pub dims: usize,
    /// Length scale of the kernel.
    pub sigma: f64,
    /// Biased estimate of the squared maximum mean discrepancy.
    pub mmd2: f64,
    /// n·MMD²_b.
    pub score: f64,
}

/// Compares samples of a query `z` with samples `y` of a library trial, shape (n, channels), in
/// f64 and without shortcuts: the oracle of [`QuerySet`].
///
/// `align_mean` shifts z's mean to y's first (Eq. 8); σ is taken from the shifted z (Eq. 6) unless
/// `sigma` fixes it. If z and y differ in length, n is the length of the shorter.
pub fn score_samples(
    z: ArrayView2<'_, f64>,
    y: ArrayView2<'_, f64>,
    align_mean: bool,
    sigma: Option<f64>,
) -> SampleScore {
    let z = if align_mean { aligned(z, y) } else { z.to_owned() };
    let sigma = sigma.unwrap_or_else(|| length_scale(z.view()));
    let mmd2 = mmd2_biased(y, z.view(), sigma);
    let n = y.nrows().min(z.nrows());
    SampleScore { n, dims: z.ncols(), sigma, mmd2, score: n as f64 * mmd2 }
}

/// z shifted to the mean of y (Eq. 8).
pub fn aligned(z: ArrayView2<'_, f64>, y: ArrayView2<'_, f64>) -> Array2<f64> {
    let mut z = z.to_owned();
    if let (Some(of_y), Some(of_z)) = (y.mean_axis(Axis(0)), z.mean_axis(Axis(0))) {
        z += &(of_y - of_z);
    }
    z
}

/// The precision of kernel sums.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SumPrecision {
    /// The fastest sums whose error stays within 1e-4: see [`QuerySet`].
    #[default]
    Fast,
    /// f64 throughout.
    Oracle,
}

/// A query's samples, ready to be compared with library trials.
///
/// **Which sum is used:** over distinct samples, if both sets have at most 8 of them; an expansion
/// on a line for one channel; lanes in f32 for two to four channels, unless a set has samples too
/// far out for f32 or both sets are a few tight clusters; f64 for all else, and for every score
/// that comes out below 0.05.
///
/// Each pays: without the sum over distinct samples a query of eight sources takes four times as
/// long, without the line 1.3 times, and lanes take a tenth of the time of f64. `cargo bench
/// --bench reference -- sums` times each of them.
pub struct QuerySet<'a> {
    set: &'a SampleSet,
    align_mean: bool,
    precision: SumPrecision,
    strategy: SumStrategy,
    /// Points in f64 and Σ k(zᵢ, zⱼ), once a comparison needs them.
    f64_points: OnceLock<(Points<f64>, f64)>,
}

/// How to sum Σ k(yᵢ, zⱼ); holds Σ k(zᵢ, zⱼ), which is the same for all library trials.
enum SumStrategy {
    /// One channel, expanded once.
    Line(LineSum, f64),
    /// Two to four channels, in f32.
    Lanes(Points<f32>, f64),
    InF64,
}

impl<'a> QuerySet<'a> {
    /// Prepares the samples of a query; their σ is the length scale.
    pub fn new(set: &'a SampleSet, align_mean: bool, precision: SumPrecision) -> Self {
        let sigma = set.sigma;
        let strategy = if precision == SumPrecision::Oracle {
            SumStrategy::InF64
        } else if set.dims() == 1 {
            let line = set.line(sigma);
            let zz = set.sum_on_line(&line, 0.0);
            SumStrategy::Line(line, zz)
        } else if set.fits_lanes(sigma) {
            let zz = set.self_sum_at(sigma, &mut Scratch::default());
            let mut lanes = Points::default();
            set.fill(&mut lanes, sigma, &set.centre);
            SumStrategy::Lanes(lanes, zz)
        } else {
            SumStrategy::InF64
        };
        Self { set, align_mean, precision, strategy, f64_points: OnceLock::new() }
    }

    /// n·MMD²_b against samples of a library trial; never negative, never NaN.
    ///
    /// With [`SumPrecision::Fast`], within 1e-4 of the oracle (relative for scores above 1).
    ///
    /// # Panics
    /// If the two differ in their number of channels.
    pub fn score(&self, y: &SampleSet, scratch: &mut Scratch) -> f64 {
        assert_eq!(self.set.dims(), y.dims(), "samples of equal channels");
        // y moves by this; then z's centre is the origin of both.
        let shift = |c: usize| if self.align_mean { self.set.mean[c] - y.mean[c] } else { 0.0 };
        let (n, m) = (y.n(), self.set.n());
        let score = |sums| n.min(m) as f64 * mmd2_from_sums(sums, n, m);
        if self.precision == SumPrecision::Fast {
            if let Some(sums) = self.distinct_sums(y, &shift) {
                return score(sums);
            }
            if let Some(fast) = self.fast_sums(y, &shift, scratch).map(score)
                && fast >= F64_BELOW
            {
                return fast;
            }
        }
        score(self.f64_sums(y, &shift, scratch))
    }

    fn distinct_sums(&self, y: &SampleSet, shift: &dyn Fn(usize) -> f64) -> Option<CrossSums> {
        let sigma = self.set.sigma;
        let none = vec![0.0; y.dims()];
        let shift: Vec<f64> = (0..y.dims()).map(shift).collect();
        let yz = self.set.distinct_sum(y, sigma, &shift)?;
        let [yy, zz] = [y, self.set].map(|set| set.distinct_sum(set, sigma, &none));
        Some(CrossSums { yz, yy: yy?, zz: zz? })
    }

    /// Sums on a line or over lanes; `None` where they would not be exact enough.
    fn fast_sums(
        &self,
        y: &SampleSet,
        shift: &dyn Fn(usize) -> f64,
        scratch: &mut Scratch,
    ) -> Option<CrossSums> {
        let sigma = self.set.sigma;
        let clustered = [self.set, y].iter().all(|set| set.is_clustered_at(sigma));
        let (yz, zz) = match &self.strategy {
            SumStrategy::Line(line, zz) => (y.sum_on_line(line, shift(0)), *zz),
            SumStrategy::Lanes(z_lanes, zz) if y.fits_lanes(sigma) && !clustered => {
                y.fill(&mut scratch.in_f32, sigma, &self.origin(shift));
                (scratch.in_f32.sum(z_lanes), *zz)
            }
            SumStrategy::Lanes(..) | SumStrategy::InF64 => return None,
        };
        Some(CrossSums { yy: y.self_sum_at(sigma, scratch), zz, yz })
    }

    fn f64_sums(
        &self,
        y: &SampleSet,
        shift: &dyn Fn(usize) -> f64,
        scratch: &mut Scratch,
    ) -> CrossSums {
        let sigma = self.set.sigma;
        let (z_points, zz) = self.in_f64();
        let points = &mut scratch.in_f64;
        y.fill(points, sigma, &self.origin(shift));
        let yz = points.sum(z_points);
        y.fill(points, sigma, &y.centre);
        CrossSums { yy: points.sum(points), zz: *zz, yz }
    }

    /// The origin for y's coordinates: the point that the shift of y moves to z's centre.
    fn origin(&self, shift: &dyn Fn(usize) -> f64) -> Vec<f64> {
        self.set.centre.iter().enumerate().map(|(c, x)| x - shift(c)).collect()
    }

    /// z's points in f64, and Σ k(zᵢ, zⱼ).
    fn in_f64(&self) -> &(Points<f64>, f64) {
        self.f64_points.get_or_init(|| {
            let mut points = Points::default();
            self.set.fill(&mut points, self.set.sigma, &self.set.centre);
            // In the same order as y's own sum and the cross sum, so that equal roundings cancel.
            let zz = points.sum(&points);
            (points, zz)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn samples(n: usize, dims: usize, values: &[f64]) -> Array2<f64> {
        Array2::from_shape_fn((n, dims), |(i, c)| values[(i * dims + c) % values.len()])
    }

    /// The same score three times: fast, fast with a table, and in f64 throughout.
    fn scores(z: &Array2<f64>, y: &Array2<f64>, align: bool) -> Vec<f64> {
        let (z, y) = (SampleSet::new(z, None), SampleSet::new(y, None));
        let mut tabulated = y.clone();
        tabulated.tabulate();
        let score =
            |precision, y| QuerySet::new(&z, align, precision).score(y, &mut Scratch::default());
        vec![
            score(SumPrecision::Fast, &y),
            score(SumPrecision::Fast, &tabulated),
            score(SumPrecision::Oracle, &y),
        ]
    }

    #[track_caller]
    fn assert_within_1e_4(z: &Array2<f64>, y: &Array2<f64>, align: bool, what: &str) {
        let oracle = score_samples(z.view(), y.view(), align, None).score;
        let all = scores(z, y, align);
        for &fast in &all {
            let good = (fast - oracle).abs() <= 1e-4 * oracle.max(1.0);
            assert!(good && fast >= 0.0, "{what}, shift {align}: {fast} vs {oracle}, of {all:?}");
        }
    }

    /// Makes samples of a difficult kind from raw numbers in −1..1.
    fn ugly(kind: usize, x: f64, at: usize) -> f64 {
        match kind {
            0 => x,
            1 => 1e30 * x,
            2 => 1e-30 * x,
            3 => (1.55 * x).tan(),
            4 => (20.0 * x).exp(),
            5 => (4.0 * x).round(),
            6 => (30.0 * x).round(),
            7 => 7.0 + 1e-6 * x,
            8 => {
                if at == 5 {
                    1e8
                } else {
                    x
                }
            }
            9 => x.signum() * 1e4 + x,
            10 => f64::from(at < 7),
            // Two groups, the smaller one at the edge of what counts as near.
            12 => x + if at.is_multiple_of(5) { 3.5 } else { 0.0 },
            _ => 3.0 + f64::from((at.is_multiple_of(50)) as u8) * 1e-7,
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(300))]

        #[test]
        fn the_fast_score_is_within_1e_4_of_the_oracle(
            dims in 1usize..=5,
            align in any::<bool>(),
            scale in -6i32..6,
            offset in -100f64..100.0,
            values in prop::collection::vec(-1f64..1.0, 150..600),
            others in prop::collection::vec(-1f64..1.0, 150..600),
        ) {
            let scale = 10f64.powi(scale);
            let z = samples(values.len() / dims, dims, &values).mapv(|x| (x + offset) * scale);
            let y = samples(values.len() / dims, dims, &others).mapv(|x| (x * 1.1 + offset) * scale);
            assert_within_1e_4(&z, &y, align, "even");
        }

        #[test]
        fn the_fast_score_is_within_1e_4_of_the_oracle_on_ugly_samples(
            dims in 1usize..=4,
            align in any::<bool>(),
            (of_z, of_y) in (0usize..13, 0usize..13),
            seed in any::<u64>(),
        ) {
            use rand::RngExt;
            let mut rng = crate::seed::rng(seed, &[]);
            let mut draw = |kind| Array2::from_shape_fn((400, dims), |(i, _)| {
                ugly(kind, rng.random_range(-1.0..1.0), i)
            });
            // Eq. 8 adds y's mean to z, which at 1e30 leaves nothing of z: such pairs have no score
            // to compare with. So only kinds of like size are paired with the shift.
            let alike = [0, 3, 5, 6, 7, 9, 10, 11, 12];
            let of_y = if align && !(alike.contains(&of_z) && alike.contains(&of_y)) { of_z } else { of_y };
            let (z, y) = (draw(of_z), draw(of_y));
            assert_within_1e_4(&z, &y, align, &format!("{of_z} and {of_y}"));
            let (y, again) = (draw(of_z), draw(of_z));
            assert_within_1e_4(&again, &y, align, &format!("two of {of_z}"));
        }
    }

    #[test]
    fn samples_of_few_distances_in_one_channel_are_summed_finely_enough() {
        // Whole numbers, moved by the shift, have 61 distances, and nearly all their errors in f32
        // have one sign. A sum in f32 was 1.03e-4 off here.
        use rand::RngExt;
        let mut rng = crate::seed::rng(6_123_383_263_347_031_830, &[]);
        let mut draw = |kind| {
            Array2::from_shape_fn((400, 1), |(i, _)| ugly(kind, rng.random_range(-1.0..1.0), i))
        };
        let [_, _, y, z] = [6, 0, 6, 6].map(&mut draw);
        assert_within_1e_4(&z, &y, true, "two of 6");
    }

    #[test]
    fn the_smallest_scores_keep_their_ratios() {
        // One sample in 400 moved a little: scores from 1e-2 down to 1e-9.
        for dims in 1..=4 {
            let z = samples(400, dims, &(0..1601).map(|i| f64::from(i).sin()).collect::<Vec<_>>());
            for power in 1..=4 {
                let mut y = z.clone();
                y[[17, 0]] += 10f64.powi(-power);
                let oracle = score_samples(z.view(), y.view(), false, None).score;
                for fast in scores(&z, &y, false) {
                    assert!((fast / oracle - 1.0).abs() < 1e-2, "{fast:e} vs {oracle:e}");
                }
            }
        }
    }

    #[test]
    fn identical_trials_score_zero_and_have_a_finite_logarithm() {
        let z = samples(400, 2, &(0..801).map(|i| f64::from(i).sin()).collect::<Vec<_>>());
        for score in scores(&z, &z, true) {
            assert!((0.0..1e-9).contains(&score), "{score}");
        }
        assert_eq!(log_score(0.0), SCORE_FLOOR.ln());
    }

    #[test]
    fn constant_data_give_a_number() {
        let (z, y) = (Array2::from_elem((400, 1), 5.0), Array2::from_elem((400, 1), 7.0));
        for align in [false, true] {
            for score in scores(&z, &y, align) {
                assert!(score.is_finite());
                assert_eq!(align, score < 1e-9);
            }
        }
    }

    #[test]
    fn a_few_distinct_samples_are_summed_exactly() {
        let z = Array2::from_shape_fn((400, 1), |(i, _)| f64::from(u8::from(i % 3 == 0)));
        let y = Array2::from_shape_fn((399, 1), |(i, _)| f64::from(u8::from(i % 5 == 0)));
        for align in [false, true] {
            let oracle = score_samples(z.view(), y.view(), align, None).score;
            for fast in scores(&z, &y, align) {
                assert!((fast - oracle).abs() < 1e-10, "{fast} vs {oracle}");
            }
        }
    }

    #[test]
    fn tight_clusters_agree_with_the_oracle_whatever_they_meet() {
        let clusters = |dims: usize, width: f64| {
            Array2::from_shape_fn((400, dims), |(i, c)| {
                let centre = ((i % 3) as f64 - 1.0) * (1.0 + c as f64);
                centre + width * ((i * dims + c) as f64).sin()
            })
        };
        for dims in 1..=4 {
            let spread = samples(
                400,
                dims,
                &(0..1601).map(|i| 2.0 * f64::from(i).sin()).collect::<Vec<_>>(),
            );
            for width in [1e-2, 1e-4, 1e-7] {
                let tight = clusters(dims, width);
                assert!(
                    SampleSet::new(&tight, None).clustered
                        && !SampleSet::new(&spread, None).clustered
                );
                for (z, y) in
                    [(&tight, &spread), (&spread, &tight), (&tight, &clusters(dims, 2.0 * width))]
                {
                    for align in [false, true] {
                        assert_within_1e_4(z, y, align, &format!("{dims} × {width}"));
                    }
                }
            }
        }
    }

    #[test]
    fn sets_of_unequal_sizes_agree_with_the_oracle() {
        let z = samples(90, 3, &(0..271).map(|i| f64::from(i).sin()).collect::<Vec<_>>());
        let y = samples(61, 3, &(0..277).map(|i| f64::from(i).cos() + 0.1).collect::<Vec<_>>());
        assert_within_1e_4(&z, &y, false, "unequal");
    }
}
