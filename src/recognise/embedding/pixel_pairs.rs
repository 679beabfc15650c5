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

    fn add_up(&self) -> Sums {
        let mut sums = Sums::default();
        sum_pairs(&self.first, &self.second, &self.weights, &mut sums.features);
        sums.weight = self.weights.iter().map(|&w| f64::from(w)).sum();
        sums
    }

    /// What they add up to where all weigh alike.
    fn add_up_evenly(&self) -> Sums {
        Self { weights: vec![1.0; self.weights.len()], ..self.clone() }.add_up()
    }
}

/// Weighted sums over pairs.
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    weight: f64,
    features: [f64; PAIR_FEATURES],
}

/// Pairs, and what they add up to.
#[derive(Clone, Debug)]
pub(super) struct PairSums {
    pairs: Pairs,
    sums: Sums,
}

impl From<Pairs> for PairSums {
    fn from(pairs: Pairs) -> Self {
        Self { sums: pairs.add_up(), pairs }
    }
}

/// Weighted mean features of pairs, part by part: for the half plane of (j, k) ∈ {−2 … 2}² without
/// (0, 0), e^{i(jα + kβ)}. Without pairs, or where none weighs anything, they weigh alike or the
/// features are 0: those of pairs spread evenly, which say nothing.
pub(super) fn features(parts: &[&PairSums]) -> [f32; PAIR_FEATURES] {
    let weight: f64 = parts.iter().map(|part| part.sums.weight).sum();
    let pairs: usize = parts.iter().map(|part| part.pairs.weights.len()).sum();
    let none_weighs = weight <= 1e-6 * pairs as f64;
    let mut total = Sums::default();
    for part in parts {
        let sums = if none_weighs { part.pairs.add_up_evenly() } else { part.sums };
        total.weight += sums.weight;
        total.features.iter_mut().zip(sums.features).for_each(|(sum, x)| *sum += x);
    }
    total.features.map(|sum| (sum / total.weight.max(1e-30)) as f32)
}

#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn sum_pairs(first: &[f32], second: &[f32], weights: &[f32], sums: &mut [f64; PAIR_FEATURES]) {
    let flush = LANES * FLUSH;
    for ((first, second), weights) in
        first.chunks(flush).zip(second.chunks(flush)).zip(weights.chunks(flush))
    {
        let mut acc = [[[0f32; LANES]; 2]; PAIR_FEATURES / 2];
        for at in (0..first.len()).step_by(LANES) {
            // What is lacking to a whole register weighs nothing.
            let (a, b, w) = (lanes(first, at), lanes(second, at), lanes(weights, at));
            let (a_sin, a_cos) = sin_cos_pi(&a);
            let (b_sin, b_cos) = sin_cos_pi(&b);
            let a1 = (a_cos, a_sin);
            let a2 = multiply((&a_cos, &a_sin), (&a_cos, &a_sin));
            let b1 = (b_cos, b_sin);
            let b2 = multiply((&b_cos, &b_sin), (&b_cos, &b_sin));
            add(&mut acc[0], &w, &b1);
            add(&mut acc[1], &w, &b2);
            for (a, index) in [(&a1, 2), (&a2, 7)] {
                add(&mut acc[index], &w, a);
                for (b, index) in [(&b1, index + 1), (&b2, index + 3)] {
                    add(&mut acc[index], &w, &multiply((&a.0, &a.1), (&b.0, &b.1)));
                    let mut minus = b.1;
                    minus.iter_mut().for_each(|x| *x = -*x);
                    add(&mut acc[index + 1], &w, &multiply((&a.0, &a.1), (&b.0, &minus)));
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

#[inline(always)]
fn lanes(from: &[f32], at: usize) -> [f32; LANES] {
    let mut lanes = [0f32; LANES];
    match from.get(at..at + LANES) {
        Some(full) => lanes.copy_from_slice(full),
        None => lanes[..from.len() - at].copy_from_slice(&from[at..]),
    }
    lanes
}

/// Adds complex numbers, (re, im) each, times their weights.
#[inline(always)]
fn add(sum: &mut [[f32; LANES]; 2], weights: &[f32; LANES], z: &([f32; LANES], [f32; LANES])) {
    for lane in 0..LANES {
        sum[0][lane] += weights[lane] * z.0[lane];
        sum[1][lane] += weights[lane] * z.1[lane];
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
        let all = PairSums::from(pairs);
        assert!((f64::from(features(&[&all])[18]) - expected).abs() < 1e-6);
        assert_eq!(features(&[&Pairs::default().into()]), [0.0; PAIR_FEATURES]);
    }

    #[test]
    fn parts_together_are_the_whole_and_weigh_alike_where_none_weighs() {
        let made = |range: std::ops::Range<i32>, weight: fn(i32) -> f32| {
            let mut pairs = Pairs::default();
            range.for_each(|i| pairs.push((i as f32).sin(), (i as f32 * 0.3).cos(), weight(i)));
            PairSums::from(pairs)
        };
        for weight in [|i| i as f32, |i: i32| if i < 13 { 0.0 } else { 1.0 }, |_| 0.0] {
            let whole = features(&[&made(0..30, weight)]);
            let parts = features(&[&made(0..13, weight), &made(13..30, weight)]);
            assert!(whole.iter().zip(parts).all(|(a, b)| (a - b).abs() < 1e-6));
        }
        let weightless = features(&[&made(0..30, |_| 0.0)]);
        assert_eq!(weightless, features(&[&made(0..30, |_| 1.0)]));
    }
}
