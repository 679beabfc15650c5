//! What it costs to hold samples in f32: which sets need more.

/// Whether a set's distances are but a few.
///
/// The error of a kernel value in f32, and of adding it to a sum, changes sign with the fraction of
/// q, where the value is 2^(−q/16). Over spread-out samples it averages out; samples in a few tight
/// clusters have but a few distances, hence a few fractions, and their errors add up. A subset of
/// pairs shows which it is. Between a set in clusters and one that is spread out there are as many
/// distances as the latter has samples.
pub(super) fn is_clustered(values: &[f64], n: usize, sigma: f64) -> bool {
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

/// Error of n·MMD² times σ that rounding centred coordinates to f32 may cause.
///
/// Rounding moves point i by δᵢ = 2⁻²⁴|xᵢ|/σ, which changes each of its kernel values by at most
/// 0.61 δᵢ, but only those of points in reach. A point far from the centre meets no more than those
/// at least half as far out, mᵢ of them; errors of different points have different signs. So the
/// error of 2/n Σᵢⱼ k is about 2/n · 0.61 · (Σᵢ (δᵢ mᵢ)²)^½.
pub(super) fn coarseness(values: &[f64], n: usize, centre: &[f64]) -> f64 {
    let distances = distances(values, n, centre);
    let mut nearer = 0;
    let mut sum = 0.0;
    for &d in &distances {
        while distances[nearer] < 0.5 * d {
            nearer += 1;
        }
        sum += (d * (n - nearer) as f64).powi(2);
    }
    // Where squares are too large or too small for a number, f32 is as well.
    let error = ROUNDING / n as f64 * sum.sqrt();
    if error.is_normal() || distances[n - 1] == 0.0 { error } else { f64::INFINITY }
}

/// 2 · 0.61 · 2⁻²⁴: see [`coarseness`].
const ROUNDING: f64 = 1.22 * 0.5 * f32::EPSILON as f64;

/// Distances of samples from the centre, ascending.
fn distances(values: &[f64], n: usize, centre: &[f64]) -> Vec<f64> {
    let distance = |i: usize| {
        let d2 = centre.iter().enumerate().map(|(c, m)| (values[c * n + i] - m).powi(2));
        d2.sum::<f64>().sqrt()
    };
    let mut distances: Vec<f64> = (0..n).map(distance).collect();
    distances.sort_unstable_by(f64::total_cmp);
    distances
}
