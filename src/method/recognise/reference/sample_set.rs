//! Samples drawn from one source of one trial, and everything that is computed from them once.

use ndarray::Array2;
use serde::{Deserialize, Serialize};

use crate::kernel::{Number, Points, SelfMean, length_scale};

/// If a set has at most this many distinct samples, its kernel sums run over the distinct samples.
const MOST_DISTINCT: usize = 8;

/// Allowed error of n·MMD² from rounding coordinates to f32; above it, sums are in f64.
const ROUNDING_ALLOWED: f64 = 3e-5;

/// Largest error of n·MMD² that a table of K(y, y) may cause; a less exact table is dropped.
const TABLE_ALLOWED: f64 = 3e-5;

/// At more than this many times its own length scale, a set counts as one tight cluster.
const AFAR: f64 = 8.0;

/// Samples drawn from one source. Given σ, comparisons do not depend on the order of the samples.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SampleSet {
    /// Channel after channel, in the order drawn; a single channel is in ascending order.
    pub(super) values: Values,
    pub(super) mean: Vec<f64>,
    /// Median of each channel. It is the origin of coordinates, since f32 is finest near 0.
    pub(super) centre: Vec<f64>,
    /// σ of these samples: by the median heuristic, or fixed.
    pub(super) sigma: f64,
    /// Error of n·MMD² from coordinates in f32, multiplied by σ.
    pub(super) coarseness: f64,
    /// Whether the distances between the samples take only a few values; see [`is_clustered`].
    pub(super) clustered: bool,
    /// Mean of K(y, y) as a function of σ, if tabulated.
    pub(super) table: Option<SelfMean>,
    /// Distinct samples and how often each occurs; `None` if they are many. Not stored.
    #[serde(skip)]
    distinct: Option<DistinctPoints>,
}

/// Numbers in the shortest form that is exact.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) enum Values {
    Single(Box<[f32]>),
    Double(Box<[f64]>),
}

impl Values {
    fn new(values: Vec<f64>) -> Self {
        if values.iter().all(|&x| f64::from(x as f32) == x) {
            Self::Single(values.iter().map(|&x| x as f32).collect())
        } else {
            Self::Double(values.into())
        }
    }

    fn len(&self) -> usize {
        match self {
            Self::Single(values) => values.len(),
            Self::Double(values) => values.len(),
        }
    }

    fn at(&self, i: usize) -> f64 {
        match self {
            Self::Single(values) => f64::from(values[i]),
            Self::Double(values) => values[i],
        }
    }
}

/// Distinct samples, each of `dims` numbers, and how often each occurs.
#[derive(Clone, Debug, PartialEq)]
struct DistinctPoints {
    points: Vec<f64>,
    counts: Vec<f64>,
}

/// Buffers of a comparison, kept to be reused by the next comparison.
#[derive(Clone, Debug, Default)]
pub struct Scratch {
    pub(super) in_f32: Points<f32>,
    pub(super) in_f64: Points<f64>,
}

impl SampleSet {
    /// Makes a set from samples of shape (n, channels); n and channels are at least 1. σ is found by
    /// the median heuristic unless `sigma` fixes it.
    pub fn new(samples: &Array2<f64>, sigma: Option<f64>) -> Self {
        let sigma = sigma.unwrap_or_else(|| length_scale(samples.view()));
        let n = samples.nrows();
        let mut values = Vec::with_capacity(samples.len());
        let (mut mean, mut centre) = (Vec::new(), Vec::new());
        for column in samples.columns() {
            let mut sorted = column.to_vec();
            sorted.sort_unstable_by(f64::total_cmp);
            centre.push(sorted[n / 2]);
            mean.push(column.sum() / n as f64);
            if samples.ncols() == 1 { values = sorted } else { values.extend(column) }
        }
        let distinct = DistinctPoints::find(|i| values[i], n, samples.ncols());
        let coarseness = coarseness(&values, n, &centre);
        let clustered = distinct.is_some() || is_clustered(&values, n, sigma);
        let values = Values::new(values);
        Self { values, mean, centre, sigma, coarseness, clustered, table: None, distinct }
    }

    /// Recomputes the fields that are not stored; false if the stored fields contradict each other.
    pub(super) fn complete(&mut self) -> bool {
        let (dims, count) = (self.dims(), self.values.len());
        if count == 0 || dims == 0 || count % dims != 0 || self.centre.len() != dims {
            return false;
        }
        self.distinct = DistinctPoints::find(|i| self.values.at(i), count / dims, dims);
        true
    }

    pub(crate) fn n(&self) -> usize {
        self.values.len() / self.dims()
    }

    pub(crate) fn dims(&self) -> usize {
        self.mean.len()
    }

    /// Tabulates K(y, y) over length scales around the set's own, so that comparisons with this set
    /// need not sum it. The table is dropped if it is not exact enough.
    pub fn tabulate(&mut self) {
        if self.distinct.is_some() {
            return;
        }
        let (n, mut scratch) = (self.n() as f64, Scratch::default());
        let tolerance = TABLE_ALLOWED / n;
        self.table = SelfMean::new(self.sigma, tolerance, |sigma| {
            self.self_sum(sigma, &mut scratch) / (n * n)
        });
    }

    /// Σ k(yᵢ, yⱼ) at length scale `sigma`, from the table if there is one.
    pub(super) fn self_sum_at(&self, sigma: f64, scratch: &mut Scratch) -> f64 {
        match self.table.as_ref().and_then(|table| table.at(sigma)) {
            Some(mean) => mean * (self.n() as f64).powi(2),
            None => self.self_sum(sigma, scratch),
        }
    }

    fn self_sum(&self, sigma: f64, scratch: &mut Scratch) -> f64 {
        if let Some(sum) = self.distinct_sum(self, sigma, &vec![0.0; self.dims()]) {
            sum
        } else if self.fits_lanes(sigma) && !self.is_clustered_at(sigma) {
            self.fill(&mut scratch.in_f32, sigma, &self.centre);
            scratch.in_f32.self_sum()
        } else {
            self.fill(&mut scratch.in_f64, sigma, &self.centre);
            scratch.in_f64.self_sum()
        }
    }

    /// Whether f32 is exact enough for sums at this length scale; only for at most four channels.
    pub(super) fn fits_lanes(&self, sigma: f64) -> bool {
        self.dims() <= 4 && self.coarseness <= ROUNDING_ALLOWED * sigma
    }

    /// Whether the set has only a few different distances at this length scale. This is true of every
    /// set at a length scale far above its own.
    pub(super) fn is_clustered_at(&self, sigma: f64) -> bool {
        self.clustered || sigma > AFAR * self.sigma
    }

    pub(super) fn fill<T: Number>(&self, points: &mut Points<T>, sigma: f64, origin: &[f64]) {
        let n = self.n();
        points.fill(self.dims(), sigma, |c| {
            (c * n..(c + 1) * n).map(move |i| self.values.at(i) - origin[c])
        });
    }

    pub(super) fn first_channel(&self) -> impl Iterator<Item = f64> {
        (0..self.n()).map(|i| self.values.at(i))
    }

    /// Σ k(aᵢ, bⱼ) over distinct samples, b from `other` and moved by `shift`; `None` if many.
    pub(super) fn distinct_sum(&self, other: &Self, sigma: f64, shift: &[f64]) -> Option<f64> {
        let (a, b, dims) = (self.distinct.as_ref()?, other.distinct.as_ref()?, self.dims());
        let mut total = 0.0;
        for (x, of_x) in a.points.chunks(dims).zip(&a.counts) {
            for (y, of_y) in b.points.chunks(dims).zip(&b.counts) {
                let d2: f64 = (x.iter().zip(y).zip(shift))
                    .map(|((x, y), shift)| ((x - (y + shift)) / sigma).powi(2))
                    .sum();
                total += of_x * of_y * (-0.5 * d2).exp();
            }
        }
        Some(total)
    }
}

impl DistinctPoints {
    /// `value` gives values channel after channel; `None` if more than [`MOST_DISTINCT`] are distinct.
    fn find(value: impl Fn(usize) -> f64, n: usize, dims: usize) -> Option<Self> {
        let mut found = Self { points: Vec::new(), counts: Vec::new() };
        let mut point = vec![0.0; dims];
        for i in 0..n {
            point.iter_mut().enumerate().for_each(|(c, x)| *x = value(c * n + i));
            match found.points.chunks(dims).position(|known| known == point) {
                Some(at) => found.counts[at] += 1.0,
                None if found.counts.len() == MOST_DISTINCT => return None,
                None => {
                    found.points.extend(&point);
                    found.counts.push(1.0);
                }
            }
        }
        Some(found)
    }
}

/// Whether a set has only a few different distances, so that its sums need f64.
///
/// A kernel value is 2^(−q/16). The error of computing it in f32, and of adding it to a sum, changes
/// sign with the fraction of q. The errors average out over spread-out samples. Samples in a few tight
/// clusters have only a few distances and so a few fractions, and their errors add up. A subset of
/// pairs shows which case holds. A clustered set against a spread-out set is safe: the pair has as
/// many distances as the spread-out set has samples.
fn is_clustered(values: &[f64], n: usize, sigma: f64) -> bool {
    const SUBSET: usize = 32;
    const BINS: usize = 8;
    let step = n.div_ceil(SUBSET).max(1);
    let scale = (8.0 * std::f64::consts::LOG2_E).sqrt() / sigma;
    let mut weights = [0.0; BINS];
    for i in (0..n).step_by(step) {
        for j in (0..i).step_by(step) {
            let q: f64 =
                values.chunks(n).map(|channel| ((channel[i] - channel[j]) * scale).powi(2)).sum();
            let bin = (q.fract() * BINS as f64) as usize;
            weights[bin.min(BINS - 1)] += (-q / 16.0).exp2();
        }
    }
    let (sum, most) = weights.iter().fold((0.0, 0.0), |(s, m), &w| (s + w, f64::max(m, w)));
    most * BINS as f64 > 2.0 * sum
}

/// Estimated error of n·MMD² from rounding centred coordinates to f32, multiplied by σ.
///
/// Rounding moves point i by δᵢ = 2⁻²⁴|xᵢ|/σ. This changes its kernel value with each point in reach
/// by at most 0.61 δᵢ. Only mᵢ points, those at least half as far from the centre, are in reach of
/// point i. Errors of different points have different signs. So the error of 2/n Σᵢⱼ k is about 2/n ·
/// 0.61 · (Σᵢ (δᵢ mᵢ)²)^½.
fn coarseness(values: &[f64], n: usize, centre: &[f64]) -> f64 {
    let distances = distances(values, n, centre);
    let mut nearer = 0;
    let mut sum = 0.0;
    for &d in &distances {
        while distances[nearer] < 0.5 * d {
            nearer += 1;
        }
        sum += (d * (n - nearer) as f64).powi(2);
    }
    // If squares overflow or vanish here, they would in f32 too; the error is then infinite.
    let error = ROUNDING / n as f64 * sum.sqrt();
    if error.is_normal() || distances[n - 1] == 0.0 { error } else { f64::INFINITY }
}

/// 2 · 0.61 · 2⁻²⁴: see [`coarseness`].
const ROUNDING: f64 = 1.22 * 0.5 * f32::EPSILON as f64;

fn distances(values: &[f64], n: usize, centre: &[f64]) -> Vec<f64> {
    let distance = |i: usize| {
        let d2 = centre.iter().enumerate().map(|(c, m)| (values[c * n + i] - m).powi(2));
        d2.sum::<f64>().sqrt()
    };
    let mut distances: Vec<f64> = (0..n).map(distance).collect();
    distances.sort_unstable_by(f64::total_cmp);
    distances
}
