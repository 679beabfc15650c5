//! Fourier features of pairs on a torus: what neighbouring pixels have in common.
//!
//! Both coordinates are angles, α and β. The means of e^{i(jα + kβ)} for small j and k keep which
//! values go together, not only how often each occurs.

use multiversion::multiversion;

use super::fourier::{FLUSH, LANES, multiply, sin_cos_pi};

/// Features of a group of pairs: real and imaginary parts of 12 products.
pub(super) const PAIR_FEATURES: usize = 24;

/// Pairs on the torus: both coordinates as u ∈ [−1, 1], and how much each pair weighs.
#[derive(Clone, Debug, Default)]
pub(super) struct Pairs {
    first: Vec<f32>,
    second: Vec<f32>,
    weights: Vec<f32>,
}

impl Pairs {
    /// Adds a pair.
    pub fn push(&mut self, first: f32, second: f32, weight: f32) {
        self.first.push(first.clamp(-1.0, 1.0));
        self.second.push(second.clamp(-1.0, 1.0));
        self.weights.push(weight);
    }

    /// Weighted mean features of the pairs: for the half plane of (j, k) ∈ {−2 … 2}²
    /// without (0, 0), e^{i(jα + kβ)}. Without pairs, or where none weighs anything, they
    /// weigh alike or the features are 0: those of pairs spread evenly, which say nothing.
    pub fn features(mut self) -> [f32; PAIR_FEATURES] {
        let total = |weights: &[f32]| weights.iter().map(|&w| f64::from(w)).sum::<f64>();
        let mut weight_sum = total(&self.weights);
        if weight_sum <= 1e-6 * self.weights.len() as f64 {
            self.weights.fill(1.0);
            weight_sum = total(&self.weights);
        }
        let filled = self.first.len().next_multiple_of(LANES);
        for values in [&mut self.first, &mut self.second, &mut self.weights] {
            values.resize(filled, 0.0);
        }
        let mut sums = [0f64; PAIR_FEATURES];
        sum_pairs(&self.first, &self.second, &self.weights, &mut sums);
        sums.map(|sum| (sum / weight_sum.max(1e-30)) as f32)
    }
}

#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn sum_pairs(first: &[f32], second: &[f32], weights: &[f32], sums: &mut [f64; PAIR_FEATURES]) {
    let flush = LANES * FLUSH;
    for ((first, second), weights) in
        first.chunks(flush).zip(second.chunks(flush)).zip(weights.chunks(flush))
    {
        let mut acc = [[[0f32; LANES]; 2]; PAIR_FEATURES / 2];
        for at in (0..first.len()).step_by(LANES) {
            let take = |from: &[f32]| {
                let mut lanes = [0f32; LANES];
                lanes.copy_from_slice(&from[at..at + LANES]);
                lanes
            };
            let (a, b, w) = (take(first), take(second), take(weights));
            let (a_sin, a_cos) = sin_cos_pi(&a);
            let (b_sin, b_cos) = sin_cos_pi(&b);
            let a1 = (a_cos, a_sin);
            let a2 = multiply((&a_cos, &a_sin), (&a_cos, &a_sin));
            let b1 = (b_cos, b_sin);
            let b2 = multiply((&b_cos, &b_sin), (&b_cos, &b_sin));
            let mut add = |index: usize, z: &([f32; LANES], [f32; LANES])| {
                for lane in 0..LANES {
                    acc[index][0][lane] += w[lane] * z.0[lane];
                    acc[index][1][lane] += w[lane] * z.1[lane];
                }
            };
            add(0, &b1);
            add(1, &b2);
            for (a, index) in [(&a1, 2), (&a2, 7)] {
                add(index, a);
                for (b, index) in [(&b1, index + 1), (&b2, index + 3)] {
                    add(index, &multiply((&a.0, &a.1), (&b.0, &b.1)));
                    let mut minus = b.1;
                    minus.iter_mut().for_each(|x| *x = -*x);
                    add(index + 1, &multiply((&a.0, &a.1), (&b.0, &minus)));
                }
            }
        }
        for (index, acc) in acc.iter().enumerate() {
            for (part, lanes) in acc.iter().enumerate() {
                sums[2 * index + part] += lanes.iter().map(|&x| f64::from(x)).sum::<f64>();
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    #[test]
    fn pairs_match_their_definition_and_no_pair_says_nothing() {
        let mut pairs = Pairs::default();
        let given: Vec<(f32, f32, f32)> =
            (0..21).map(|i| ((i as f32 * 0.37).sin(), (i as f32 * 0.11).cos(), i as f32)).collect();
        given.iter().for_each(|&(a, b, w)| pairs.push(a, b, w));
        let total: f64 = given.iter().map(|g| f64::from(g.2)).sum();
        // (j, k) = (2, −1) stands tenth.
        let of = |g: &(f32, f32, f32)| f64::from(g.2) * (PI * f64::from(2.0 * g.0 - g.1)).cos();
        let expected = given.iter().map(of).sum::<f64>() / total;
        assert!((f64::from(pairs.features()[18]) - expected).abs() < 1e-6);
        assert_eq!(Pairs::default().features(), [0.0; PAIR_FEATURES]);
    }
}
