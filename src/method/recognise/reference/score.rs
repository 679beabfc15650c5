//! The score of one source: n·MMD²_b between the samples of a query and of a library trial.

use std::ops::Deref;
use std::sync::OnceLock;

use ndarray::{Array2, ArrayView2, Axis};

use super::sample_set::{SampleSet, Scratch};
use crate::kernel::{CrossSums, LineSum, Points, length_scale, mmd2_biased, mmd2_from_sums};

/// The least score that enters a product or a logarithm.
///
/// Identical trials score 0, which would make the whole product of Eq. 9 zero. Rounding in f64 leaves
/// an error of about 1e-13 in n·MMD² at n = 400, far below this floor.
pub(super) const SCORE_FLOOR: f64 = 1e-10;

/// Scores below this are summed again in f64, since cancellation in f32 spoils their ratios.
const F64_BELOW: f64 = 0.05;

/// ln of a score, floored at [`SCORE_FLOOR`].
pub(crate) fn log_score(score: f64) -> f64 {
    score.max(SCORE_FLOOR).ln()
}

#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct SampleScore {
    pub n: usize,
    pub dims: usize,
    pub sigma: f64,
    pub mmd2: f64,
    /// n·MMD²_b.
    pub score: f64,
}

/// Compares samples of a query `z` with samples `y` of a library trial, both of shape (n, channels),
/// in f64 and without shortcuts. This is the oracle of [`QuerySet`].
///
/// `align_mean` first shifts z's mean to y's (Eq. 8). σ is computed from z (Eq. 6) unless `sigma` fixes
/// it; the shift changes no distance, but rounds them. If z and y differ in length, n is the shorter length.
pub fn score_samples(
    z: ArrayView2<'_, f64>,
    y: ArrayView2<'_, f64>,
    align_mean: bool,
    sigma: Option<f64>,
) -> SampleScore {
    let sigma = sigma.unwrap_or_else(|| length_scale(z));
    let z = if align_mean { aligned(z, y) } else { z.to_owned() };
    let mmd2 = mmd2_biased(y, z.view(), sigma);
    let n = y.nrows().min(z.nrows());
    SampleScore { n, dims: z.ncols(), sigma, mmd2, score: n as f64 * mmd2 }
}

/// z, shifted so that its mean is that of y (Eq. 8).
pub(crate) fn aligned(z: ArrayView2<'_, f64>, y: ArrayView2<'_, f64>) -> Array2<f64> {
    let mut z = z.to_owned();
    if let (Some(of_y), Some(of_z)) = (y.mean_axis(Axis(0)), z.mean_axis(Axis(0))) {
        z += &(of_y - of_z);
    }
    z
}

/// How precisely kernel sums are computed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SumPrecision {
    /// The fastest sums with an error of at most 1e-4; see [`QuerySet`].
    #[default]
    Fast,
    /// f64 throughout.
    Oracle,
}

/// The samples of a query, prepared for comparison with library trials.
///
/// **Which sum is used:** If both sets have at most 8 distinct samples, the sum is over these. One
/// channel is summed by an expansion on a line. Two to four channels are summed in lanes of f32,
/// unless a set has samples too far out for f32 or both sets are a few tight clusters. Everything else
/// is summed in f64, and so is every score that comes out below 0.05.
///
/// Each kind saves time: a query of eight sources takes four times as long without the sum over
/// distinct samples and 1.3 times without the line; lanes take a tenth of the time of f64. Measured by
/// `cargo bench --bench reference -- sums`.
pub struct QuerySet<S> {
    set: S,
    align_mean: bool,
    precision: SumPrecision,
    strategy: SumStrategy,
    /// z's points in f64 and Σ k(zᵢ, zⱼ), computed when a comparison first needs them.
    f64_points: OnceLock<(Points<f64>, f64)>,
}

/// How to sum Σ k(yᵢ, zⱼ). Holds Σ k(zᵢ, zⱼ), which is the same for all library trials.
enum SumStrategy {
    /// For one channel: its expansion.
    Line(LineSum, f64),
    /// For two to four channels: the points in f32.
    Lanes(Points<f32>, f64),
    InF64,
}

impl<S: Deref<Target = SampleSet>> QuerySet<S> {
    /// Prepares the samples of a query. Their σ is the length scale of all comparisons.
    pub fn new(set: S, align_mean: bool, precision: SumPrecision) -> Self {
        let sigma = set.sigma;
        let strategy = if precision == SumPrecision::Oracle {
            SumStrategy::InF64
        } else if set.dims() == 1 {
            let line = LineSum::new(set.first_channel(), set.centre[0], sigma);
            let zz = line.sum(set.first_channel(), 0.0);
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

    /// n·MMD²_b between the query and the samples `y` of a library trial; never negative, never NaN.
    ///
    /// With [`SumPrecision::Fast`], within 1e-4 of the oracle (relative to scores above 1).
    ///
    /// # Panics
    /// If the query and `y` have different numbers of channels.
    pub fn score(&self, y: &SampleSet, scratch: &mut Scratch) -> f64 {
        assert_eq!(self.set.dims(), y.dims(), "samples of equal channels");
        // y moves by this shift; z's centre is then the origin of both.
        let moved = |(z, y): (&f64, &f64)| if self.align_mean { z - y } else { 0.0 };
        let shift: Vec<f64> = self.set.mean.iter().zip(&y.mean).map(moved).collect();
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

    fn distinct_sums(&self, y: &SampleSet, shift: &[f64]) -> Option<CrossSums> {
        let sigma = self.set.sigma;
        let none = vec![0.0; y.dims()];
        let yz = self.set.distinct_sum(y, sigma, shift)?;
        let [yy, zz] = [y, &*self.set].map(|set| set.distinct_sum(set, sigma, &none));
        Some(CrossSums { yz, yy: yy?, zz: zz? })
    }

    /// Sums on a line or in lanes; `None` if they would not be exact enough.
    fn fast_sums(&self, y: &SampleSet, shift: &[f64], scratch: &mut Scratch) -> Option<CrossSums> {
        let sigma = self.set.sigma;
        let clustered = [&*self.set, y].iter().all(|set| set.is_clustered_at(sigma));
        let (yz, zz) = match &self.strategy {
            SumStrategy::Line(line, zz) => (line.sum(y.first_channel(), shift[0]), *zz),
            SumStrategy::Lanes(z_lanes, zz) if y.fits_lanes(sigma) && !clustered => {
                y.fill(&mut scratch.in_f32, sigma, &self.origin(shift));
                (scratch.in_f32.sum(z_lanes), *zz)
            }
            SumStrategy::Lanes(..) | SumStrategy::InF64 => return None,
        };
        Some(CrossSums { yy: y.self_sum_at(sigma, scratch), zz, yz })
    }

    fn f64_sums(&self, y: &SampleSet, shift: &[f64], scratch: &mut Scratch) -> CrossSums {
        let sigma = self.set.sigma;
        let (z_points, zz) = self.f64_points.get_or_init(|| {
            let mut points = Points::default();
            self.set.fill(&mut points, sigma, &self.set.centre);
            // The same order as in y's own sum and the cross sum, so that equal roundings cancel.
            let zz = points.sum(&points);
            (points, zz)
        });
        let points = &mut scratch.in_f64;
        y.fill(points, sigma, &self.origin(shift));
        let yz = points.sum(z_points);
        y.fill(points, sigma, &y.centre);
        CrossSums { yy: points.sum(points), zz: *zz, yz }
    }

    /// The origin of y's coordinates: the point that the shift moves to z's centre.
    fn origin(&self, shift: &[f64]) -> Vec<f64> {
        self.set.centre.iter().zip(shift).map(|(x, shift)| x - shift).collect()
    }
}

#[cfg(test)]
#[path = "../../../../tests/common/scores.rs"]
mod scores;

#[cfg(test)]
mod tests {
    use super::scores::{assert_within_1e_4, scores, wave};
    use super::*;

    #[test]
    fn identical_trials_score_zero_and_have_a_finite_logarithm() {
        let z = wave(400, 2, f64::sin);
        for score in scores(&z, &z, true) {
            assert!((0.0..1e-9).contains(&score), "{score}");
        }
        assert_eq!(log_score(0.0), SCORE_FLOOR.ln());
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
            let spread = wave(400, dims, |i| 2.0 * i.sin());
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
}
