//! The score of one source: n·MMD²_b between samples of a query and of a library trial.

use std::sync::OnceLock;

use ndarray::{Array2, ArrayView2, Axis};

use super::sample_set::{SampleSet, Scratch};
use crate::kernel::{
    CrossSums, F64Points, LineSum, PaddedPoints, Quality, f64_sum, lane_sum, length_scale,
    mmd2_biased, mmd2_from_sums,
};

/// The least score that enters a product or a logarithm.
///
/// Identical trials score 0, which would turn the whole product of Eq. 9 into 0. Rounding in f64
/// leaves about 1e-13 of n·MMD² at n = 400, so nothing that differs is mistaken for identical.
pub const SCORE_FLOOR: f64 = 1e-10;

/// Below this score, sums in f32 cancel too much for a ratio of scores; f64 takes over.
const F64_BELOW: f64 = 0.05;

/// ln of a score, floored at [`SCORE_FLOOR`].
pub fn log_score(score: f64) -> f64 {
    score.max(SCORE_FLOOR).ln()
}

/// Result of comparing two sets of samples.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct SampleScore {
    /// Number of samples a side.
    pub n: usize,
    /// Number of channels.
    pub dims: usize,
    /// Length scale of the kernel.
    pub sigma: f64,
    /// Biased estimate of the squared maximum mean discrepancy.
    pub mmd2: f64,
    /// n·MMD²_b.
    pub score: f64,
}

/// Compares samples of a query `z` with samples `y` of a library trial, shape (n, channels), in
/// f64 and without shortcuts: the oracle of [`score_sets`].
///
/// `align_mean` shifts z's mean to y's first (Eq. 8); σ is taken from the shifted z (Eq. 6) unless
/// `sigma` fixes it. Where the sides differ in length, n is that of the shorter.
pub fn score_samples(
    z: ArrayView2<'_, f64>,
    y: ArrayView2<'_, f64>,
    align_mean: bool,
    sigma: Option<f64>,
) -> SampleScore {
    let mut z = z.to_owned();
    if align_mean && let (Some(of_y), Some(of_z)) = (y.mean_axis(Axis(0)), z.mean_axis(Axis(0))) {
        z += &(of_y - of_z);
    }
    let sigma = sigma.unwrap_or_else(|| length_scale(z.view()));
    let mmd2 = mmd2_biased(y, z.view(), sigma);
    let n = y.nrows().min(z.nrows());
    SampleScore { n, dims: z.ncols(), sigma, mmd2, score: n as f64 * mmd2 }
}

/// How kernel sums are computed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Precision {
    /// The fastest sums whose error stays within 1e-4: f32 over lanes, expansions on a line, tables;
    /// f64 where samples or sums ask for it.
    #[default]
    Fast,
    /// f64 throughout.
    Oracle,
}

/// A query's samples, ready to be compared with many library trials.
pub struct QuerySet<'a> {
    set: &'a SampleSet,
    align_mean: bool,
    strategy: SumStrategy,
    /// Σ k(zᵢ, zⱼ), which no library trial changes.
    zz: f64,
    /// Points and their sum in f64, once some comparison asks for them.
    f64_points: OnceLock<(F64Points, f64)>,
}

/// How Σ k(yᵢ, zⱼ) is summed.
enum SumStrategy {
    /// One channel and many comparisons: expanded once.
    Line(LineSum),
    /// Up to four channels, in f32, unless both sides are clustered.
    Lanes {
        lanes: PaddedPoints,
        /// Whether f32 will do for the other side, too, whatever that is.
        compact: bool,
    },
    /// In f64, where f32 does not hold the samples well enough.
    InF64,
    /// By definition.
    ByDefinition,
}

impl<'a> QuerySet<'a> {
    /// Sets a query up, with the σ of its samples. `many` says that it will meet many trials, so
    /// that work done here pays.
    pub fn new(set: &'a SampleSet, align_mean: bool, precision: Precision, many: bool) -> Self {
        let sigma = set.sigma;
        let (strategy, zz) = if precision == Precision::Oracle {
            (SumStrategy::ByDefinition, 0.0)
        } else if set.dims() == 1 && many {
            let line = set.line(sigma);
            let zz = set.sum_on_line(&line, 0.0);
            (SumStrategy::Line(line), zz)
        } else {
            let zz = set.self_sum_at(sigma, &mut Scratch::default());
            if set.fits_lanes(sigma) {
                let mut lanes = PaddedPoints::default();
                set.fill_lanes(&mut lanes, sigma, &set.centre);
                (SumStrategy::Lanes { lanes, compact: set.is_compact(sigma) }, zz)
            } else {
                (SumStrategy::InF64, zz)
            }
        };
        Self { set, align_mean, strategy, zz, f64_points: OnceLock::new() }
    }

    /// n·MMD²_b against samples of a library trial; never negative, never NaN.
    ///
    /// In [`Precision::Fast`] within 1e-4 of the oracle, relative or absolute.
    ///
    /// # Panics
    /// If the two differ in their number of channels.
    pub fn score(&self, y: &SampleSet, scratch: &mut Scratch) -> f64 {
        assert_eq!(self.set.dims(), y.dims(), "samples of equal channels");
        // y is moved by this, and is then seen from z's centre.
        let shift = |c: usize| if self.align_mean { self.set.mean[c] - y.mean[c] } else { 0.0 };
        let (n, m) = (y.n(), self.set.n());
        let score = |sums| n.min(m) as f64 * mmd2_from_sums(sums, n, m);
        if let SumStrategy::ByDefinition = self.strategy {
            return self.plain(y);
        }
        if let Some(sums) = self.distinct_sums(y, &shift) {
            return score(sums);
        }
        let fast = score(self.fast_sums(y, &shift, scratch));
        if fast >= F64_BELOW {
            return fast;
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

    fn fast_sums(
        &self,
        y: &SampleSet,
        shift: &dyn Fn(usize) -> f64,
        scratch: &mut Scratch,
    ) -> CrossSums {
        let sigma = self.set.sigma;
        let clusters = [self.set, y].map(|set| set.is_clustered_at(sigma));
        let yz = match &self.strategy {
            SumStrategy::Line(line) => y.sum_on_line(line, shift(0)),
            SumStrategy::Lanes { lanes: z_lanes, compact }
                if (*compact || y.fits_lanes(sigma)) && clusters != [true, true] =>
            {
                y.fill_lanes(&mut scratch.lanes, sigma, &self.origin(shift));
                let quality =
                    if clusters == [false, false] { Quality::Quick } else { Quality::Fine };
                lane_sum(&scratch.lanes, z_lanes, quality)
            }
            _ => {
                y.fill_f64(&mut scratch.in_f64, sigma, &self.origin(shift));
                f64_sum(&scratch.in_f64, &self.in_f64().0)
            }
        };
        CrossSums { yy: y.self_sum_at(sigma, scratch), zz: self.zz, yz }
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
        y.fill_f64(points, sigma, &self.origin(shift));
        let yz = f64_sum(points, z_points);
        y.fill_f64(points, sigma, &y.centre);
        CrossSums { yy: f64_sum(points, points), zz: *zz, yz }
    }

    /// z's centre, from where the shifted y is seen.
    fn origin(&self, shift: &dyn Fn(usize) -> f64) -> Vec<f64> {
        self.set.centre.iter().enumerate().map(|(c, x)| x - shift(c)).collect()
    }

    /// The points, and zz, in f64.
    fn in_f64(&self) -> &(F64Points, f64) {
        self.f64_points.get_or_init(|| {
            let mut points = F64Points::default();
            self.set.fill_f64(&mut points, self.set.sigma, &self.set.centre);
            // As y's own sum and the cross sum are formed, so that equal roundings cancel.
            let zz = f64_sum(&points, &points);
            (points, zz)
        })
    }

    /// By definition, for the oracle.
    fn plain(&self, y: &SampleSet) -> f64 {
        let array = |set: &SampleSet, origin: &[f64]| {
            let n = set.n();
            let all: Vec<Vec<f64>> = set.channels();
            Array2::from_shape_fn((n, set.dims()), |(i, c)| all[c][i] - origin[c])
        };
        let (of_z, of_y) = if self.align_mean {
            (&self.set.mean, &y.mean)
        } else {
            (&self.set.mean, &self.set.mean)
        };
        let (z_points, y_points) = (array(self.set, of_z), array(y, of_y));
        let n = y.n().min(self.set.n()) as f64;
        n * mmd2_biased(y_points.view(), z_points.view(), self.set.sigma)
    }
}

/// n·MMD²_b between two sets; [`score_samples`] is its oracle.
pub fn score_sets(z: &SampleSet, y: &SampleSet, align_mean: bool, precision: Precision) -> f64 {
    QuerySet::new(z, align_mean, precision, false).score(y, &mut Scratch::default())
}

#[cfg(test)]
#[path = "score_tests.rs"]
mod tests;
