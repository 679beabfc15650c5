//! Scores of two samples by the fast sums, to hold against the oracle.

use ndarray::Array2;
use surfaced::recognise::{QuerySet, SampleSet, Scratch, SumPrecision, score_samples};

pub fn wave(n: usize, dims: usize, value: impl Fn(f64) -> f64) -> Array2<f64> {
    Array2::from_shape_fn((n, dims), |(i, c)| value((i * dims + c) as f64))
}

/// The same score three times: fast, fast with a table, and in f64.
pub fn scores(z: &Array2<f64>, y: &Array2<f64>, align: bool) -> Vec<f64> {
    let (z, y) = (SampleSet::new(z, None), SampleSet::new(y, None));
    let mut tabulated = y.clone();
    tabulated.tabulate();
    let score =
        |precision, y| QuerySet::new(&z, align, precision).score(y, &mut Scratch::default());
    vec![
        score(SumPrecision::Fast, &y),
        score(SumPrecision::Fast, &tabulated),
        score(SumPrecision::Oracle, &y),
    ]
}

#[track_caller]
pub fn assert_within_1e_4(z: &Array2<f64>, y: &Array2<f64>, align: bool, what: &str) {
    let oracle = score_samples(z.view(), y.view(), align, None).score;
    let all = scores(z, y, align);
    for &fast in &all {
        let good = (fast - oracle).abs() <= 1e-4 * oracle.max(1.0);
        assert!(good && fast >= 0.0, "{what}, shift {align}: {fast} vs {oracle}, of {all:?}");
    }
}
