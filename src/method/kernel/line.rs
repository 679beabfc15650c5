//! Gaussian kernel sums over fixed points of one channel, fast for many queries at one length scale.
//!
//! G(x) = Σⱼ exp(−(x − uⱼ)²/2) is smooth. Space near the points is divided into cells of width ½, and
//! G is expanded once about the middle of each cell, up to the eleventh derivative. A kernel sum over
//! n further points then takes n short polynomials instead of n² exponentials. The expansion changes a
//! kernel value by at most 10395/12!·4⁻¹² = 1.3e-12 (10395 bounds the twelfth derivative). Each point
//! beyond [`REACH`] of the cell's middle is ignored, which costs at most exp(−6.75²/2) = 1.3e-10.

use multiversion::multiversion;

use super::sums::exp2_of_minus;

/// Half the width of a cell, the interval of one Taylor expansion, in length scales.
const HALF: f64 = 0.25;
const TERMS: usize = 12;
/// A cell ignores points beyond this distance, in length scales: exp(−7²/2) is 2e-11.
const REACH: f64 = 7.0;
/// Coordinates are clamped to this distance from the centre, in length scales.
const FARTHEST: f64 = 1e12;
const LANES: usize = 8;

/// The sum of unit Gaussians at fixed points, as a function of one variable.
#[derive(Clone, Debug)]
pub(crate) struct LineSum {
    centre: f64,
    scale: f64,
    groups: Vec<PointGroup>,
}

/// Cells (intervals with Taylor terms of the sum) around points that lie close together.
#[derive(Clone, Debug)]
struct PointGroup {
    start: f64,
    cells: Vec<[f64; TERMS]>,
}

impl LineSum {
    /// `points` rise. Coordinates are relative to `centre`, since rounding costs least near 0.
    pub(crate) fn new(points: impl Iterator<Item = f64>, centre: f64, sigma: f64) -> Self {
        let scale = 1.0 / sigma;
        let place = |x: f64| ((x - centre) * scale).clamp(-FARTHEST, FARTHEST);
        let points: Vec<f64> = points.map(place).collect();
        debug_assert!(points.is_sorted());
        let groups = points.chunk_by(|a, b| b - a < 2.0 * REACH).map(PointGroup::new).collect();
        Self { centre, scale, groups }
    }

    /// Σᵢ G(xᵢ + shift) over points xᵢ in ascending order, where G is this sum of Gaussians.
    pub(crate) fn sum(&self, points: impl Iterator<Item = f64>, shift: f64) -> f64 {
        let mut groups = self.groups.iter().peekable();
        let mut total = 0.0;
        for point in points {
            let x = ((point - (self.centre - shift)) * self.scale).clamp(-FARTHEST, FARTHEST);
            while groups.next_if(|group| group.end() <= x).is_some() {}
            let Some(group) = groups.peek() else { break };
            let at = (x - group.start) * (0.5 / HALF);
            if at >= 0.0 {
                // `at` is less than the number of cells, since x lies before the group's end.
                let cell = (at as usize).min(group.cells.len() - 1);
                let t = x - group.middle(cell);
                // Even and odd powers are summed apart, so that the processor can do both at once.
                let pairs = group.cells[cell].as_chunks::<2>().0.iter().rev();
                let (even, odd) = pairs.fold((0.0, 0.0), |(even, odd), &[of_even, of_odd]| {
                    (even * (t * t) + of_even, odd * (t * t) + of_odd)
                });
                total += even + t * odd;
            }
        }
        total
    }
}

impl PointGroup {
    /// Expands the sum over `points`, which must be ascending and not empty.
    fn new(points: &[f64]) -> Self {
        let (first, last) = (points[0], points[points.len() - 1]);
        let start = first - REACH;
        let count = ((last + REACH - start) / (2.0 * HALF)).ceil() as usize;
        let mut group = Self { start, cells: vec![[0.0; TERMS]; count] };
        let (mut low, mut high) = (0, 0);
        for cell in 0..count {
            let middle = group.middle(cell);
            while low < points.len() && points[low] < middle - REACH {
                low += 1;
            }
            while high < points.len() && points[high] <= middle + REACH {
                high += 1;
            }
            group.cells[cell] = expansion(&points[low..high.max(low)], middle);
        }
        group
    }

    fn middle(&self, cell: usize) -> f64 {
        self.start + (2 * cell + 1) as f64 * HALF
    }

    fn end(&self) -> f64 {
        self.start + self.cells.len() as f64 * 2.0 * HALF
    }
}

/// Taylor terms of Σⱼ exp(−(x − uⱼ)²/2) about `middle`. The k-th term is (−1)ᵏ/k! Σⱼ Heₖ(tⱼ)
/// exp(−tⱼ²/2), t = middle − u. Hermite polynomials: Heₖ₊₁(t) = t Heₖ(t) − k Heₖ₋₁(t).
#[multiversion(targets(
    "x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
fn expansion(points: &[f64], middle: f64) -> [f64; TERMS] {
    let mut sums = [[0f64; LANES]; TERMS];
    for chunk in points.chunks(LANES) {
        let mut t = [1e6; LANES];
        for lane in 0..chunk.len() {
            t[lane] = middle - chunk[lane];
        }
        let mut previous = [0f64; LANES];
        let mut term = [0f64; LANES];
        for lane in 0..LANES {
            // For the padding, t = 1e6, the result is the smallest value possible: about 1e-301.
            term[lane] = exp2_of_minus::<false>(0.5 * std::f64::consts::LOG2_E * t[lane] * t[lane]);
        }
        // aₖ = (−1)ᵏ/k! Heₖ has the recurrence aₖ₊₁ = −(t aₖ + aₖ₋₁)/(k + 1).
        for (k, sum) in sums.iter_mut().enumerate() {
            let over = -1.0 / (k + 1) as f64;
            for lane in 0..LANES {
                sum[lane] += term[lane];
                let next = over * (t[lane] * term[lane] + previous[lane]);
                previous[lane] = term[lane];
                term[lane] = next;
            }
        }
    }
    let mut totals = [0.0; TERMS];
    for k in 0..TERMS {
        for lane in &sums[k] {
            totals[k] += lane;
        }
    }
    totals
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plain(points: &[f64], others: &[f64], shift: f64, sigma: f64) -> f64 {
        let kernel = |u: f64, x: f64| (-0.5 * ((x + shift - u) / sigma).powi(2)).exp();
        points.iter().flat_map(|&u| others.iter().map(move |&x| kernel(u, x))).sum()
    }

    fn sorted(mut values: Vec<f64>) -> Vec<f64> {
        values.sort_by(f64::total_cmp);
        values
    }

    #[test]
    fn each_kernel_value_is_good_to_3e_11() {
        let line = LineSum::new([0.3].into_iter(), 0.0, 2.0);
        for i in -30_000..30_000 {
            let x = f64::from(i) * 1e-3;
            let error = line.sum([x].into_iter(), 0.1) - plain(&[0.3], &[x], 0.1, 2.0);
            assert!(error.abs() < 3e-11, "{x}: {error:e}");
        }
    }

    #[test]
    fn sums_agree_on_clusters_tails_and_outliers() {
        let tails = |n: usize, by: f64| {
            let tail = |i: usize| ((i as f64 + 0.5) / n as f64 - 0.5) * std::f64::consts::PI;
            sorted((0..n).map(|i| tail(i).tan() * by).collect())
        };
        let cases = [
            (tails(400, 1.0), tails(399, 1.1), 1.0),
            (tails(50, 1e-30), tails(400, 2e-30), 1e-30),
            (tails(400, 1e30), tails(400, 2e30), 3e29),
            (vec![0.0; 400], vec![0.0, 0.1, 1e300], 1.0),
            (vec![-1e300, 0.0, 17.0, 34.0, 1e300], vec![8.5, 8.6, 40.0], 1.0),
        ];
        for (points, others, sigma) in cases {
            let line = LineSum::new(points.iter().copied(), 0.0, sigma);
            for shift in [0.0, 0.37 * sigma, -5.0 * sigma] {
                let exact = plain(&points, &others, shift, sigma);
                let error = line.sum(others.iter().copied(), shift) - exact;
                let values = (points.len() * others.len()) as f64;
                assert!(error.abs() < 3e-11 * values, "{shift}: {error:e} of {exact}");
            }
        }
    }
}
