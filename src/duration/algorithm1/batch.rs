//! HSIC tests eight at a time: one lane a test, so that every step is a plain loop over eight
//! numbers that the compiler turns into vector instructions.
//!
//! Algorithm 1 makes half a million tests of ten trials each. Laid out like this, distances,
//! medians (a sorting network), kernels, centring, permutations and moments all vectorise; up to
//! Q = 51 nothing is allocated. No multiply is fused into an add, so every machine gives the same bits. The plain
//! form is [`crate::kernel::test_independence`], and a test holds this one to it.
//!
//! The eight tests share their permutations. So that this does not tie their thresholds together,
//! the caller shuffles the trials of each test first ([`Batch::set`] with a permuted trial): the
//! same permutation then means another one for each.

use multiversion::multiversion;
use rand::Rng;
use rand::seq::SliceRandom;

use super::lanes::{F64Lanes, LANES, exp_of_nonpositive, map2, sort_lanes, sorting_network};
use crate::kernel::{CentredMoments, Pearson3, Threshold, permutation_moments, quantile_index};

/// Eight tests of independence of the same size, with room for all that lies between.
#[derive(Clone, Debug)]
pub struct Batch {
    n: usize,
    channels: usize,
    threshold: Threshold,
    /// Rank of κ among the permutations, from above: 1 is the largest.
    rank_from_above: usize,
    quantiles: Pearson3,
    network: Vec<(u32, u32)>,
    /// Samples of the two sides, at trial · channels + channel.
    samples: [Vec<F64Lanes>; 2],
    /// Kernel matrices, n × n.
    kernels: [Vec<F64Lanes>; 2],
    distances: Vec<F64Lanes>,
    sorted: Vec<F64Lanes>,
    row_means: Vec<F64Lanes>,
    order: Vec<usize>,
    /// Largest statistics under permutation, descending.
    top: Vec<F64Lanes>,
}

/// The results of eight tests.
#[derive(Clone, Copy, Debug)]
pub struct Tests {
    /// HSIC_b.
    pub hsic: F64Lanes,
    /// Threshold.
    pub kappa: F64Lanes,
}

impl Batch {
    /// The number of tests.
    pub const TESTS: usize = LANES;

    /// Room for tests of `n` pairs of samples with `channels` channels at level `alpha`.
    pub fn new(n: usize, channels: usize, alpha: f64, threshold: Threshold) -> Self {
        let pairs = n * (n - 1) / 2;
        let rank_from_above = match threshold {
            Threshold::Permutations(count) => count - quantile_index(count, alpha),
            Threshold::Gamma => 1,
        };
        let zero = [0.0; LANES];
        Self {
            n,
            channels,
            threshold,
            rank_from_above,
            quantiles: Pearson3::new(alpha),
            network: network_for(pairs),
            samples: [vec![zero; n * channels], vec![zero; n * channels]],
            kernels: [vec![zero; n * n], vec![zero; n * n]],
            distances: vec![zero; pairs],
            sorted: vec![zero; pairs],
            row_means: vec![zero; n],
            order: (0..n).collect(),
            top: vec![zero; rank_from_above],
        }
    }

    /// Sets the sample of one side (0 or 1), test and trial: one value a channel.
    #[inline]
    pub fn set(&mut self, side: usize, test: usize, trial: usize, sample: &[f32]) {
        let at = trial * self.channels;
        for (slot, &value) in self.samples[side][at..at + self.channels].iter_mut().zip(sample) {
            slot[test] = f64::from(value);
        }
    }

    /// Runs the eight tests.
    pub fn run(&mut self, rng: &mut impl Rng) -> Tests {
        prepare(self);
        let hsic = statistic(self);
        let kappa = match self.threshold {
            Threshold::Permutations(count) => {
                self.top.fill([f64::NEG_INFINITY; LANES]);
                self.order.iter_mut().enumerate().for_each(|(i, o)| *o = i);
                for _ in 0..count {
                    self.order.shuffle(rng);
                    permute_once(self);
                }
                self.top[self.rank_from_above - 1]
            }
            Threshold::Gamma => gamma_threshold(self),
        };
        let scale = 1.0 / (self.n * self.n) as f64;
        Tests { hsic: hsic.map(|x| (x * scale).max(0.0)), kappa: kappa.map(|x| x * scale) }
    }
}

/// Kernel matrices of both sides, the first centred.
#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx2", "x86_64+avx2"))]
fn prepare(batch: &mut Batch) {
    for side in 0..2 {
        distances(&batch.samples[side], batch.n, batch.channels, &mut batch.distances);
        let medians = medians(&batch.distances, &batch.network, &mut batch.sorted);
        // −1/(2σ²) with σ² = median/2; σ = 1 where no distance is left.
        let gamma = medians.map(|m| if m.is_finite() { -1.0 / m } else { -0.5 });
        let (n, kernel) = (batch.n, &mut batch.kernels[side]);
        let mut pair = 0;
        for i in 0..n {
            kernel[i * n + i] = [1.0; LANES];
            for j in 0..i {
                let value = exp_of_nonpositive(map2(batch.distances[pair], gamma, |d, g| d * g));
                kernel[i * n + j] = value;
                kernel[j * n + i] = value;
                pair += 1;
            }
        }
    }
    centre(&mut batch.kernels[0], batch.n, &mut batch.row_means);
}

/// tr(KHLH) of the first side's centred kernels and the second side's.
#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx2", "x86_64+avx2"))]
fn statistic(batch: &Batch) -> F64Lanes {
    let mut sum = [0.0; LANES];
    for (k, l) in batch.kernels[0].iter().zip(&batch.kernels[1]) {
        sum = map2(sum, map2(*k, *l, |a, b| a * b), |s, x| s + x);
    }
    sum
}

/// The statistic with the second side in the batch's order, put among the largest so far.
#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx2", "x86_64+avx2"))]
fn permute_once(batch: &mut Batch) {
    let n = batch.n;
    let [k, l] = &batch.kernels;
    let (mut off, mut trace) = ([0.0; LANES], [0.0; LANES]);
    for i in 0..n {
        let (k_row, l_row) = (&k[i * n..][..n], &l[batch.order[i] * n..][..n]);
        for j in 0..i {
            let (a, b) = (&k_row[j], &l_row[batch.order[j]]);
            for lane in 0..LANES {
                off[lane] += a[lane] * b[lane];
            }
        }
        // The diagonal of L is one.
        trace = map2(trace, k_row[i], |t, x| t + x);
    }
    let mut value = map2(off, trace, |o, t| 2.0 * o + t);
    for slot in &mut batch.top {
        // No NaN can be here: sums of finite numbers.
        let larger = map2(*slot, value, |a, b| if a > b { a } else { b });
        value = map2(*slot, value, |a, b| if a > b { b } else { a });
        *slot = larger;
    }
}

/// n²·κ from the exact permutation moments.
#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx2", "x86_64+avx2"))]
fn gamma_threshold(batch: &mut Batch) -> F64Lanes {
    let n = batch.n;
    centre(&mut batch.kernels[1], n, &mut batch.row_means);
    let first = moments_of(&batch.kernels[0], n);
    let second = moments_of(&batch.kernels[1], n);
    std::array::from_fn(|lane| {
        let moments = permutation_moments(n, &first[lane], &second[lane]);
        batch.quantiles.quantile(&moments)
    })
}

#[inline(always)]
fn centre(kernel: &mut [F64Lanes], n: usize, row_means: &mut [F64Lanes]) {
    let scale = 1.0 / n as f64;
    let mut mean = [0.0; LANES];
    for (row, out) in kernel.chunks_exact(n).zip(row_means.iter_mut()) {
        let mut sum = [0.0; LANES];
        for value in row {
            sum = map2(sum, *value, |s, x| s + x);
        }
        *out = sum.map(|s| s * scale);
        mean = map2(mean, *out, |m, x| m + x * scale);
    }
    for i in 0..n {
        let level = map2(mean, row_means[i], |m, r| m - r);
        for j in 0..n {
            let value = &mut kernel[i * n + j];
            let column = row_means[j];
            for lane in 0..LANES {
                value[lane] += level[lane] - column[lane];
            }
        }
    }
}

#[inline(always)]
fn moments_of(w: &[F64Lanes], n: usize) -> [CentredMoments; LANES] {
    let mut sums = [[0.0; LANES]; 8];
    let add = |sum: &mut F64Lanes, term: F64Lanes| *sum = map2(*sum, term, |s, x| s + x);
    for i in 0..n {
        let row = &w[i * n..][..n];
        let diagonal = row[i];
        for j in 0..=i {
            let other = &w[j * n..][..n];
            let mut square = [0.0; LANES];
            for (a, b) in row.iter().zip(other) {
                for lane in 0..LANES {
                    square[lane] += a[lane] * b[lane];
                }
            }
            let times = if i == j { 1.0 } else { 2.0 };
            let value = row[j];
            add(&mut sums[2], map2(value, square, |v, s| times * v * s));
            add(&mut sums[5], value.map(|v| times * v * v * v));
            let ends = map2(diagonal, other[j], |a, b| a * b);
            add(&mut sums[7], map2(ends, value, |e, v| times * e * v));
            if i == j {
                add(&mut sums[1], square);
                add(&mut sums[6], map2(diagonal, square, |d, s| d * s));
            }
        }
        add(&mut sums[0], diagonal);
        add(&mut sums[3], diagonal.map(|d| d * d));
        add(&mut sums[4], diagonal.map(|d| d * d * d));
    }
    let [t, t2, t3, s2, s3, u, r, b] = sums;
    std::array::from_fn(|l| CentredMoments {
        t: t[l],
        t2: t2[l],
        t3: t3[l],
        s2: s2[l],
        s3: s3[l],
        u: u[l],
        r: r[l],
        b: b[l],
    })
}

/// Largest number of distances that a sorting network is built for; more are gone through lane by
/// lane.
const LARGEST_NETWORK: usize = 1300;

/// The network that [`medians`] sorts `pairs` distances by; empty where there are too many.
fn network_for(pairs: usize) -> Vec<(u32, u32)> {
    if pairs <= LARGEST_NETWORK { sorting_network(pairs) } else { Vec::new() }
}

/// Squared distances of all pairs of samples, each pair once.
#[inline(always)]
fn distances(samples: &[F64Lanes], n: usize, channels: usize, out: &mut [F64Lanes]) {
    let mut pair = 0;
    for i in 0..n {
        for j in 0..i {
            let mut sum = [0.0; LANES];
            for c in 0..channels {
                let (a, b) = (&samples[i * channels + c], &samples[j * channels + c]);
                for lane in 0..LANES {
                    let d = a[lane] - b[lane];
                    sum[lane] += d * d;
                }
            }
            out[pair] = sum;
            pair += 1;
        }
    }
}

/// Median of the distances that are not zero, for each lane; infinite where none is left.
#[inline(always)]
fn medians(distances: &[F64Lanes], network: &[(u32, u32)], sorted: &mut [F64Lanes]) -> F64Lanes {
    let mut counts = [0usize; LANES];
    for (slot, d) in sorted.iter_mut().zip(distances) {
        for lane in 0..LANES {
            slot[lane] = if d[lane] > 0.0 { d[lane] } else { f64::INFINITY };
            counts[lane] += usize::from(d[lane] > 0.0);
        }
    }
    if network.is_empty() && distances.len() > 1 {
        return std::array::from_fn(|lane| median_by_selection(sorted, lane, counts[lane]));
    }
    sort_lanes(sorted, network);
    std::array::from_fn(|lane| {
        let count = counts[lane];
        let upper = sorted[count / 2][lane];
        match count {
            0 => f64::INFINITY,
            count if count % 2 == 1 => upper,
            count => 0.5 * (sorted[count / 2 - 1][lane] + upper),
        }
    })
}

/// Median of the `count` finite values of one lane.
fn median_by_selection(values: &[F64Lanes], lane: usize, count: usize) -> f64 {
    if count == 0 {
        return f64::INFINITY;
    }
    let mut one: Vec<f64> = values.iter().map(|v| v[lane]).collect();
    let (below, &mut upper, _) = one.select_nth_unstable_by(count / 2, f64::total_cmp);
    match below.iter().copied().max_by(f64::total_cmp) {
        Some(lower) if count.is_multiple_of(2) => 0.5 * (lower + upper),
        _ => upper,
    }
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;

    use super::*;
    use crate::kernel::test_independence;

    fn random(rng: &mut impl Rng) -> f32 {
        (rng.next_u32() % 2000) as f32 / 500.0
    }

    fn agrees_with_the_plain_form(n: usize, channels: usize, ties: bool) {
        let mut rng = crate::seed::rng(n as u64, &[b"batch"]);
        let mut batch = Batch::new(n, channels, 0.05, Threshold::Gamma);
        let mut sides: Vec<[Array2<f64>; 2]> = Vec::new();
        for test in 0..Batch::TESTS {
            let mut pair = [(); 2].map(|()| Array2::zeros((n, channels)));
            for (side, matrix) in pair.iter_mut().enumerate() {
                for trial in 0..n {
                    let mut sample: Vec<f32> = (0..channels).map(|_| random(&mut rng)).collect();
                    if ties {
                        sample.iter_mut().for_each(|x| *x = x.round());
                    }
                    batch.set(side, test, trial, &sample);
                    for (c, &x) in sample.iter().enumerate() {
                        matrix[[trial, c]] = f64::from(x);
                    }
                }
            }
            sides.push(pair);
        }
        let got = batch.run(&mut rng);
        for (test, [x, y]) in sides.iter().enumerate() {
            let want =
                test_independence(x.view(), y.view(), 0.05, Threshold::Gamma, &mut rng).unwrap();
            assert!((got.hsic[test] - want.hsic).abs() < 1e-12, "{n} {test}");
            assert!((got.kappa[test] / want.kappa - 1.0).abs() < 1e-5, "{n} {test}");
        }
    }

    #[test]
    fn eight_tests_at_once_agree_with_one_at_a_time() {
        for n in [5, 6, 10, 11, 20, 50, 60] {
            agrees_with_the_plain_form(n, 1, false);
        }
        agrees_with_the_plain_form(10, 3, false);
        agrees_with_the_plain_form(10, 1, true);
    }

    #[test]
    fn permutations_in_lanes_find_the_same_threshold() {
        let (n, count) = (10, 20_000);
        let mut rng = crate::seed::rng(4, &[b"batch"]);
        let mut batch = Batch::new(n, 1, 0.05, Threshold::Permutations(count));
        let (mut x, mut y) = (Array2::zeros((n, 1)), Array2::zeros((n, 1)));
        for trial in 0..n {
            let (a, b) = (random(&mut rng), random(&mut rng));
            (x[[trial, 0]], y[[trial, 0]]) = (f64::from(a), f64::from(b));
            for test in 0..Batch::TESTS {
                batch.set(0, test, trial, &[a]);
                batch.set(1, test, trial, &[b]);
            }
        }
        let got = batch.run(&mut rng).kappa[0];
        let threshold = Threshold::Permutations(count);
        let want = test_independence(x.view(), y.view(), 0.05, threshold, &mut rng).unwrap().kappa;
        assert!((got / want - 1.0).abs() < 0.02, "{got} {want}");
    }

    #[test]
    fn a_constant_side_has_neither_dependence_nor_threshold() {
        let mut rng = crate::seed::rng(5, &[b"batch"]);
        let mut batch = Batch::new(10, 1, 0.05, Threshold::Gamma);
        for trial in 0..10 {
            batch.set(1, 0, trial, &[trial as f32]);
        }
        let got = batch.run(&mut rng);
        assert_eq!((got.hsic[0], got.kappa[0]), (0.0, 0.0));
    }
}
