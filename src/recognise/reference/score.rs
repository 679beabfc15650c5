//! The score of one source: n·MMD²_b between samples of a query and of a library trial.

use std::sync::OnceLock;

use ndarray::{ArrayView2, Axis};

use super::sample_set::{SampleSet, Scratch};
use crate::kernel::{
    CrossSums, F64Points, LineSum, PaddedPoints, f64_sum, lane_sum, length_scale, mmd2_biased,
    mmd2_from_sums,
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
/// f64 and without shortcuts: the oracle of [`QuerySet`].
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
pub enum SumPrecision {
    /// The fastest sums whose error stays within 1e-4: see [`QuerySet`].
    #[default]
    Fast,
    /// f64 throughout.
    Oracle,
}

/// A query's samples, ready to be compared with library trials.
///
/// **Which sum runs when:** two sets of at most 8 distinct samples each are summed over these; one
/// channel by an expansion on a line; two to four channels over lanes in f32, unless samples of one
/// lie too far out for it or both lie in a few tight clusters; and all else in f64, as is every
/// score that comes out below 0.05.
///
/// Each pays: without the counts a query of eight sources takes four times as long, without the line
/// 1.3 times, and a sum over lanes takes a tenth of one in f64. `cargo bench --bench reference --
/// sums` times a score by each of them, beside f64.
pub struct QuerySet<'a> {
    set: &'a SampleSet,
    align_mean: bool,
    precision: SumPrecision,
    strategy: SumStrategy,
    /// Points in f64 and Σ k(zᵢ, zⱼ), once some comparison asks for them.
    f64_points: OnceLock<(F64Points, f64)>,
}

/// How Σ k(yᵢ, zⱼ) is summed, with Σ k(zᵢ, zⱼ), which no library trial changes.
enum SumStrategy {
    /// One channel, expanded once.
    Line(LineSum, f64),
    /// Two to four channels, in f32.
    Lanes(PaddedPoints, f64),
    /// In f64.
    InF64,
}

impl<'a> QuerySet<'a> {
    /// Sets a query up, with the σ of its samples.
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
            let mut lanes = PaddedPoints::default();
            set.fill_lanes(&mut lanes, sigma, &set.centre);
            SumStrategy::Lanes(lanes, zz)
        } else {
            SumStrategy::InF64
        };
        Self { set, align_mean, precision, strategy, f64_points: OnceLock::new() }
    }

    /// n·MMD²_b against samples of a library trial; never negative, never NaN.
    ///
    /// In [`SumPrecision::Fast`] within 1e-4 of the oracle, relative or absolute.
    ///
    /// # Panics
    /// If the two differ in their number of channels.
    pub fn score(&self, y: &SampleSet, scratch: &mut Scratch) -> f64 {
        assert_eq!(self.set.dims(), y.dims(), "samples of equal channels");
        // y is moved by this, and is then seen from z's centre.
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

    /// On a line or over lanes; nothing where that would not be exact enough.
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
                y.fill_lanes(&mut scratch.lanes, sigma, &self.origin(shift));
                (lane_sum(&scratch.lanes, z_lanes), *zz)
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
}

#[cfg(test)]
#[path = "score_tests.rs"]
mod tests;
