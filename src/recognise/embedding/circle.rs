//! Fourier features on a circle: sums of c_j·e^{ijθ}, θ = πu, over samples.
//!
//! Values are divided by their scale and clipped to ±P scales, and the interval is closed to a
//! circle, u = v/P. The weights c_j = exp(−(jπ/P)²·w²/4), j = 1 … J, make the squared distance of
//! two mean features, up to one constant factor, the MMD² of a Gaussian of width w scales, wrapped
//! on that circle and truncated after J harmonics: Bochner's theorem with quadrature instead of
//! random frequencies. With P = 4, w = 1 the truncation error is 3e-4 of the kernel's peak at J = 4.
//! The kernel is of finite rank, hence not characteristic; +P and −P are one point.
//! One sine and cosine a sample, then complex powers by multiplication.

use multiversion::multiversion;

/// Half the circle, in scales.
pub const HALF_CIRCLE: f32 = 4.0;

/// Harmonics of a pair's coordinates.
pub const PAIR_HARMONICS: usize = 2;

/// Features of a group of pairs: real and imaginary parts of 12 products.
pub const PAIR_FEATURES: usize = 24;

const LANES: usize = 8;

/// Samples that are summed in f32 before the sum goes to f64.
const FLUSH: usize = 64;

/// c_j for width w = 1.
pub fn weight(harmonic: usize) -> f64 {
    let frequency = harmonic as f64 * std::f64::consts::PI / f64::from(HALF_CIRCLE);
    (-frequency * frequency / 4.0).exp()
}

/// Values to columns: frames of one view, and how they are brought onto the circle.
#[derive(Clone, Copy)]
pub struct Columns<'a> {
    /// Shape (frames, width).
    pub values: &'a [f32],
    /// Taken off each column.
    pub centre: &'a [f32],
    /// 1/(P·spread) of each column.
    pub per_half_circle: &'a [f32],
    /// Taken off all values.
    pub shift: f32,
}

/// Mean features of each column, shape (harmonics, 2, width), weighted by c_j, into `out`.
///
/// # Panics
/// If `harmonics` is not 1 to 4, or `out` has another length than 2·harmonics·width.
pub fn column_features(columns: Columns<'_>, harmonics: usize, out: &mut [f32]) {
    let width = columns.centre.len();
    assert_eq!(out.len(), 2 * harmonics * width, "one slot a feature");
    let frames = columns.values.len() / width;
    let mut sums = vec![0f64; out.len()];
    match harmonics {
        1 => sum_columns_1(columns, &mut sums),
        2 => sum_columns_2(columns, &mut sums),
        3 => sum_columns_3(columns, &mut sums),
        4 => sum_columns_4(columns, &mut sums),
        _ => panic!("features take 1 to 4 harmonics, not {harmonics}"),
    }
    for (j, (out, sums)) in out.chunks_mut(2 * width).zip(sums.chunks(2 * width)).enumerate() {
        let scale = weight(j + 1) / frames.max(1) as f64;
        out.iter_mut().zip(sums).for_each(|(slot, sum)| *slot = (sum * scale) as f32);
    }
}

macro_rules! dispatched_columns {
    ($name:ident, $harmonics:literal) => {
        #[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
        fn $name(columns: Columns<'_>, sums: &mut [f64]) {
            sum_columns::<$harmonics>(columns, sums)
        }
    };
}
dispatched_columns!(sum_columns_1, 1);
dispatched_columns!(sum_columns_2, 2);
dispatched_columns!(sum_columns_3, 3);
dispatched_columns!(sum_columns_4, 4);

#[inline(always)]
fn sum_columns<const J: usize>(columns: Columns<'_>, sums: &mut [f64]) {
    let width = columns.centre.len();
    let mut begin = 0;
    while begin < width {
        let used = LANES.min(width - begin);
        let (mut centre, mut factor) = ([0f32; LANES], [0f32; LANES]);
        centre[..used].copy_from_slice(&columns.centre[begin..begin + used]);
        factor[..used].copy_from_slice(&columns.per_half_circle[begin..begin + used]);
        for lane in &mut centre {
            *lane += columns.shift;
        }
        for rows in columns.values.chunks(width * FLUSH) {
            let mut acc = [[[0f32; LANES]; 2]; J];
            for row in rows.chunks_exact(width) {
                let mut u = [0f32; LANES];
                if used == LANES {
                    u.copy_from_slice(&row[begin..begin + LANES]);
                } else {
                    u[..used].copy_from_slice(&row[begin..begin + used]);
                }
                for lane in 0..LANES {
                    u[lane] = ((u[lane] - centre[lane]) * factor[lane]).clamp(-1.0, 1.0);
                }
                let (sin, cos) = sin_cos_pi(&u);
                let (mut re, mut im) = (cos, sin);
                for (j, acc) in acc.iter_mut().enumerate() {
                    if j > 0 {
                        (re, im) = multiply((&re, &im), (&cos, &sin));
                    }
                    for lane in 0..LANES {
                        acc[0][lane] += re[lane];
                        acc[1][lane] += im[lane];
                    }
                }
            }
            for (j, acc) in acc.iter().enumerate() {
                for (part, lanes) in acc.iter().enumerate() {
                    let at = (2 * j + part) * width + begin;
                    for (sum, &x) in sums[at..at + used].iter_mut().zip(lanes) {
                        *sum += f64::from(x);
                    }
                }
            }
        }
        begin += used;
    }
}

/// Pairs on the torus: both coordinates as u ∈ [−1, 1], and how much each pair weighs.
#[derive(Clone, Debug, Default)]
pub struct Pairs {
    first: Vec<f32>,
    second: Vec<f32>,
    weights: Vec<f32>,
}

impl Pairs {
    /// Forgets all pairs.
    pub fn clear(&mut self) {
        self.first.clear();
        self.second.clear();
        self.weights.clear();
    }

    /// Adds a pair.
    pub fn push(&mut self, first: f32, second: f32, weight: f32) {
        self.first.push(first.clamp(-1.0, 1.0));
        self.second.push(second.clamp(-1.0, 1.0));
        self.weights.push(weight);
    }

    /// Weighted mean features of the pairs into `out`: for the half plane of (j, k) ∈ {−2 … 2}²
    /// without (0, 0), c_j·c_k·e^{i(jα + kβ)}. Without pairs, or where none weighs anything, they
    /// weigh alike or the features are 0: those of pairs spread evenly, which say nothing.
    ///
    /// # Panics
    /// If `out` has not [`PAIR_FEATURES`] slots.
    pub fn features(&mut self, out: &mut [f32]) {
        assert_eq!(out.len(), PAIR_FEATURES, "one slot a feature");
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
        for (i, (slot, sum)) in out.iter_mut().zip(sums).enumerate() {
            let (j, k) = PRODUCTS[i / 2];
            let scale =
                (if j == 0 { 1.0 } else { weight(j) }) * (if k == 0 { 1.0 } else { weight(k) });
            *slot = (sum * scale / weight_sum.max(1e-30)) as f32;
        }
    }
}

/// |j| and |k| of the products, in order.
const PRODUCTS: [(usize, usize); PAIR_FEATURES / 2] = [
    (0, 1),
    (0, 2),
    (1, 0),
    (1, 1),
    (1, 1),
    (1, 2),
    (1, 2),
    (2, 0),
    (2, 1),
    (2, 1),
    (2, 2),
    (2, 2),
];

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

/// Product of complex numbers, (re, im) each.
#[inline(always)]
fn multiply(
    a: (&[f32; LANES], &[f32; LANES]),
    b: (&[f32; LANES], &[f32; LANES]),
) -> ([f32; LANES], [f32; LANES]) {
    let (mut re, mut im) = ([0f32; LANES], [0f32; LANES]);
    for lane in 0..LANES {
        re[lane] = a.0[lane] * b.0[lane] - a.1[lane] * b.1[lane];
        im[lane] = a.0[lane] * b.1[lane] + a.1[lane] * b.0[lane];
    }
    (re, im)
}

/// sin(πu) and cos(πu) for |u| ≤ 1, to within 5e-7: Taylor series of half the angle, at most π/2,
/// and the formulas of the double angle.
#[inline(always)]
fn sin_cos_pi(u: &[f32; LANES]) -> ([f32; LANES], [f32; LANES]) {
    const HALF_PI: f32 = std::f32::consts::FRAC_PI_2;
    let (mut sin, mut cos) = ([0f32; LANES], [0f32; LANES]);
    for lane in 0..LANES {
        let x = u[lane] * HALF_PI;
        let x2 = x * x;
        let s = x
            * (1.0
                + x2 * (-1.0 / 6.0
                    + x2 * (1.0 / 120.0
                        + x2 * (-1.0 / 5040.0 + x2 * (1.0 / 362_880.0 - x2 / 39_916_800.0)))));
        let c = 1.0
            + x2 * (-0.5
                + x2 * (1.0 / 24.0
                    + x2 * (-1.0 / 720.0
                        + x2 * (1.0 / 40_320.0 + x2 * (-1.0 / 3_628_800.0 + x2 / 479_001_600.0)))));
        sin[lane] = 2.0 * s * c;
        cos[lane] = 1.0 - 2.0 * s * s;
    }
    (sin, cos)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::f64::consts::PI;

    fn features(values: &[f32], harmonics: usize) -> Vec<f32> {
        let mut out = vec![0.0; 2 * harmonics];
        let columns =
            Columns { values, centre: &[0.0], per_half_circle: &[1.0 / HALF_CIRCLE], shift: 0.0 };
        column_features(columns, harmonics, &mut out);
        out
    }

    fn distance(a: &[f32], b: &[f32]) -> f64 {
        a.iter().zip(b).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum()
    }

    #[test]
    fn sine_and_cosine_are_good_to_5e_7() {
        for i in -1000..=1000 {
            let u = i as f32 / 1000.0;
            let (sin, cos) = sin_cos_pi(&[u; LANES]);
            let exact = PI * f64::from(u);
            assert!((f64::from(sin[0]) - exact.sin()).abs() < 5e-7, "{u}");
            assert!((f64::from(cos[0]) - exact.cos()).abs() < 5e-7, "{u}");
        }
    }

    /// MMD² of the untruncated Gaussian wrapped on the circle, as an exact double sum.
    fn wrapped_mmd2(a: &[f32], b: &[f32]) -> f64 {
        let clip = |x: f32| f64::from(x.clamp(-HALF_CIRCLE, HALF_CIRCLE));
        let kernel = |x: f64, y: f64| -> f64 {
            (-3..=3).map(|turn| (-(x - y + 8.0 * f64::from(turn)).powi(2) / 2.0).exp()).sum()
        };
        let mean = |p: &[f32], q: &[f32]| -> f64 {
            let sum: f64 =
                p.iter().map(|&x| q.iter().map(|&y| kernel(clip(x), clip(y))).sum::<f64>()).sum();
            sum / (p.len() * q.len()) as f64
        };
        mean(a, a) + mean(b, b) - 2.0 * mean(a, b)
    }

    proptest! {
        /// k(d) = c₀ + Σ_j 2·a_j·cos(jπd/P) with a_j = (w·√(2π)/2P)·c_j², so that MMD² is
        /// 2·w·√(2π)/(2P) times the squared distance of the features.
        #[test]
        fn distances_are_mmd_of_the_wrapped_gaussian_within_its_truncation(
            a in prop::collection::vec(-6f32..6.0, 1..80),
            b in prop::collection::vec(-6f32..6.0, 1..80),
        ) {
            let factor = (2.0 * PI).sqrt() / f64::from(HALF_CIRCLE);
            let exact = wrapped_mmd2(&a, &b);
            let four = factor * distance(&features(&a, 4), &features(&b, 4));
            // Each of the three sums errs by at most 2·Σ_{j>4} a_j ≈ 3.0e-4.
            prop_assert!((four - exact).abs() < 1.3e-3, "{four} vs {exact}");
            let two = factor * distance(&features(&a, 2), &features(&b, 2));
            prop_assert!(two <= exact + 1e-5, "harmonics only add: {two} vs {exact}");
        }
    }

    #[test]
    fn columns_do_not_mix() {
        let values: Vec<f32> =
            (0..13 * 70).map(|i| ((i * 7919) % 1000) as f32 / 200.0 - 2.5).collect();
        let (centre, scale) = (vec![0.1; 13], vec![0.25; 13]);
        let mut out = vec![0.0; 13 * 8];
        let columns =
            Columns { values: &values, centre: &centre, per_half_circle: &scale, shift: 0.2 };
        column_features(columns, 4, &mut out);
        let alone: Vec<f32> = values[12..].iter().step_by(13).map(|x| x - 0.3).collect();
        let expected = features(&alone, 4);
        for (j, part) in (0..4).flat_map(|j| [(j, 0), (j, 1)]) {
            let (got, want) = (out[(2 * j + part) * 13 + 12], expected[2 * j + part]);
            assert!((got - want).abs() < 1e-6);
        }
    }

    #[test]
    fn pairs_match_their_definition_and_no_pair_says_nothing() {
        let mut pairs = Pairs::default();
        let given: Vec<(f32, f32, f32)> =
            (0..21).map(|i| ((i as f32 * 0.37).sin(), (i as f32 * 0.11).cos(), i as f32)).collect();
        given.iter().for_each(|&(a, b, w)| pairs.push(a, b, w));
        let mut out = [0.0; PAIR_FEATURES];
        pairs.features(&mut out);
        let total: f64 = given.iter().map(|g| f64::from(g.2)).sum();
        // (j, k) = (2, −1) stands tenth.
        let of = |g: &(f32, f32, f32)| f64::from(g.2) * (PI * f64::from(2.0 * g.0 - g.1)).cos();
        let expected = weight(2) * weight(1) * given.iter().map(of).sum::<f64>() / total;
        assert!((f64::from(out[18]) - expected).abs() < 1e-6);
        pairs.clear();
        pairs.features(&mut out);
        assert_eq!(out, [0.0; PAIR_FEATURES]);
    }
}
