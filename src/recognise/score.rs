//! The score of one source: n·MMD²_b between samples of a query and of a library trial.

use ndarray::{Array2, ArrayView2, Axis};

use crate::kernel::{
    CrossSums, Lanes, kernel_sum, lane_scale, lane_sum, length_scale, mmd2_biased, mmd2_from_sums,
};

/// The least score that enters a product or a logarithm.
///
/// Identical trials score 0, which would turn the whole product of Eq. 9 into 0. Rounding in f64
/// leaves about 1e-13 of n·MMD² at n = 400, so nothing that differs is mistaken for identical.
pub const SCORE_FLOOR: f64 = 1e-10;

/// Below this score, sums in f32 cancel too much; f64 takes over.
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
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Precision {
    /// f32 over lanes, with f64 where the sums cancel.
    #[default]
    Fast,
    /// f64 throughout.
    Oracle,
}

/// Samples drawn from one source, with their mean taken out.
///
/// The kernel does not change with a shift, so centred samples serve every comparison: with the
/// shift of Eq. 8 they are compared as they are, without it the means' difference is put back.
/// Taking the mean out in f64 lets f32 hold the rest without loss.
#[derive(Clone, Debug)]
pub struct SampleSet {
    /// Mean of each channel.
    mean: Vec<f64>,
    /// Channel after channel.
    centred: Vec<f32>,
    /// σ by the median heuristic, of these samples.
    sigma: f64,
}

impl SampleSet {
    /// A set from samples of shape (n, channels), n at least 1.
    pub fn new(samples: &Array2<f64>) -> Self {
        let mean: Vec<f64> =
            samples.columns().into_iter().map(|c| c.sum() / c.len() as f64).collect();
        let columns = samples.columns().into_iter().zip(&mean);
        let centred = columns.flat_map(|(c, m)| c.into_iter().map(move |x| (x - m) as f32));
        Self { centred: centred.collect(), sigma: length_scale(samples.view()), mean }
    }

    /// Number of samples.
    pub fn n(&self) -> usize {
        self.centred.len() / self.dims()
    }

    /// Number of channels.
    pub fn dims(&self) -> usize {
        self.mean.len()
    }

    /// σ by the median heuristic (Eq. 6), of these samples in the order drawn.
    pub fn sigma(&self) -> f64 {
        self.sigma
    }

    fn points(&self, offset: &[f64]) -> Array2<f64> {
        let n = self.n();
        Array2::from_shape_fn((n, self.dims()), |(i, c)| {
            f64::from(self.centred[c * n + i]) + offset[c]
        })
    }

    fn fill(&self, lanes: &mut Lanes, scale: f64, offset: &[f64]) {
        let n = self.n();
        lanes.fill(n, self.dims(), |c, i| {
            ((f64::from(self.centred[c * n + i]) + offset[c]) * scale) as f32
        });
    }
}

/// A query's samples, ready to be compared with many library trials at one σ.
pub struct QuerySet<'a> {
    set: &'a SampleSet,
    sigma: f64,
    align_mean: bool,
    precision: Precision,
    lanes: Lanes,
    /// Σ k(zᵢ, zⱼ), which no library trial changes.
    zz: f64,
}

impl<'a> QuerySet<'a> {
    /// Sets a query up: σ by its own median heuristic unless `sigma` fixes it.
    pub fn new(
        set: &'a SampleSet,
        align_mean: bool,
        sigma: Option<f64>,
        precision: Precision,
    ) -> Self {
        let sigma = sigma.unwrap_or(set.sigma);
        let origin = vec![0.0; set.dims()];
        let mut lanes = Lanes::default();
        let zz = if fits_lanes(set.dims()) && precision == Precision::Fast {
            set.fill(&mut lanes, lane_scale(sigma), &origin);
            lane_sum(&lanes, &lanes, set.dims())
        } else {
            let points = set.points(&origin);
            kernel_sum(points.view(), points.view(), sigma)
        };
        Self { set, sigma, align_mean, precision, lanes, zz }
    }

    /// n·MMD²_b against samples of a library trial; never negative, never NaN.
    ///
    /// In [`Precision::Fast`] within 1e-4 of the oracle, relative or absolute.
    pub fn score(&self, y: &SampleSet, scratch: &mut Lanes) -> f64 {
        let n = self.set.n().min(y.n()) as f64;
        let offset: Vec<f64> = if self.align_mean {
            vec![0.0; y.dims()]
        } else {
            y.mean.iter().zip(&self.set.mean).map(|(of_y, of_z)| of_y - of_z).collect()
        };
        if self.precision == Precision::Fast && fits_lanes(y.dims()) {
            y.fill(scratch, lane_scale(self.sigma), &offset);
            let sums = CrossSums {
                yy: lane_sum(scratch, scratch, y.dims()),
                zz: self.zz,
                yz: lane_sum(scratch, &self.lanes, y.dims()),
            };
            let score = n * mmd2_from_sums(sums, y.n(), self.set.n());
            if score >= F64_BELOW {
                return score;
            }
        }
        let z_points = self.set.points(&vec![0.0; y.dims()]);
        n * mmd2_biased(y.points(&offset).view(), z_points.view(), self.sigma)
    }
}

fn fits_lanes(dims: usize) -> bool {
    (1..=4).contains(&dims)
}

/// n·MMD²_b between two prepared sets; [`score_samples`] is its oracle.
pub fn score_sets(
    z: &SampleSet,
    y: &SampleSet,
    align_mean: bool,
    sigma: Option<f64>,
    precision: Precision,
) -> f64 {
    QuerySet::new(z, align_mean, sigma, precision).score(y, &mut Lanes::default())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn samples(n: usize, dims: usize, values: &[f64]) -> Array2<f64> {
        Array2::from_shape_fn((n, dims), |(i, c)| values[(i * dims + c) % values.len()])
    }

    proptest! {
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
            let oracle = score_samples(z.view(), y.view(), align, None).score;
            let fast = score_sets(&SampleSet::new(&z), &SampleSet::new(&y), align, None, Precision::Fast);
            prop_assert!((fast - oracle).abs() <= 1e-4 * oracle.max(1.0), "{fast} vs {oracle}");
        }
    }

    #[test]
    fn identical_trials_score_zero_and_have_a_finite_logarithm() {
        let z = samples(400, 2, &[0.3, -0.1, 0.7, 0.2, 0.9]);
        let set = SampleSet::new(&z);
        let score = score_sets(&set, &set, true, None, Precision::Fast);
        assert!((0.0..1e-9).contains(&score), "{score}");
        assert_eq!(log_score(0.0), SCORE_FLOOR.ln());
    }

    #[test]
    fn constant_data_give_a_number() {
        let (z, y) = (Array2::from_elem((400, 1), 5.0), Array2::from_elem((400, 1), 7.0));
        for align in [false, true] {
            let score =
                score_sets(&SampleSet::new(&z), &SampleSet::new(&y), align, None, Precision::Fast);
            assert!(score.is_finite());
            assert_eq!(align, score < 1e-9);
        }
    }
}
