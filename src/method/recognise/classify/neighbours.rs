//! Nearest neighbours by Euclidean or Mahalanobis distance, weighted by 1/d².

use ndarray::{Array2, ArrayView1, Axis};

use super::super::embedding::linear::{cholesky, solve_lower};
use super::{Scorer, Scores, TrainingSet, squared_distance};

/// Values of k to try.
const NEIGHBOURS: [usize; 4] = [1, 3, 5, 7];
/// Weight of the identity in the covariance; needed since there may be more features than trials.
const SHRINKAGE: f64 = 0.1;
/// Least squared distance; keeps its logarithm and inverse finite.
const FLOOR: f64 = 1e-12;

/// k is chosen by naming each library trial by the others. Features are decorrelated first if
/// `decorrelates`.
pub(crate) fn learn(training: &TrainingSet, decorrelates: bool) -> Scorer {
    // Lower Cholesky factor of the covariance.
    let factor = decorrelates.then(|| cholesky(covariance(&training.features))).flatten();
    // Decorrelates columns, one for each trial, so that their distances are Euclidean.
    let decorrelated = move |mut columns: Array2<f64>| {
        factor.iter().for_each(|factor| solve_lower(&factor.view(), columns.view_mut()));
        columns
    };
    let features = decorrelated(training.features.t().to_owned()).reversed_axes();
    let k = best_k(&features, &training.class);
    Box::new(move |query: ArrayView1<'_, f64>| {
        let query = decorrelated(query.to_owned().insert_axis(Axis(1)));
        let log_score = |row| squared_distance(row, query.column(0)).max(FLOOR).ln();
        Scores::Trials { log_scores: features.rows().into_iter().map(log_score).collect(), k }
    })
}

/// Covariance of standardised features, shrunk towards the identity.
fn covariance(features: &Array2<f64>) -> Array2<f64> {
    let mut covariance = features.t().dot(features) / features.nrows() as f64;
    covariance *= 1.0 - SHRINKAGE;
    covariance.diag_mut().mapv_inplace(|x| x + SHRINKAGE);
    covariance
}

/// The k that names most library trials right by the other trials; the smallest k in a tie.
fn best_k(features: &Array2<f64>, class: &[usize]) -> usize {
    let classes = class.iter().max().map_or(0, |most| most + 1);
    let mut right = [0usize; NEIGHBOURS.len()];
    for (i, query) in features.rows().into_iter().enumerate() {
        let mut others: Vec<(f64, usize)> = (features.rows().into_iter().zip(class).enumerate())
            .filter(|(j, _)| *j != i)
            .map(|(_, (row, &class))| (squared_distance(row, query).max(FLOOR), class))
            .collect();
        others.sort_by(|a, b| a.0.total_cmp(&b.0));
        for (right, k) in right.iter_mut().zip(NEIGHBOURS) {
            let mut votes = vec![0.0; classes];
            others.iter().take(k).for_each(|(d2, class)| votes[*class] += 1.0 / d2);
            let winner = (0..classes).max_by(|&a, &b| votes[a].total_cmp(&votes[b]));
            *right += usize::from(winner == Some(class[i]));
        }
    }
    let best = (0..right.len()).rev().max_by_key(|&i| right[i]).unwrap_or(0);
    NEIGHBOURS[best]
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::array;

    #[test]
    fn noisy_labels_ask_for_more_neighbours() {
        let clean = array![[0.0], [0.1], [0.2], [0.3], [5.0], [5.1], [5.2], [5.3]];
        assert_eq!(best_k(&clean, &[0, 0, 0, 0, 1, 1, 1, 1]), 1);
        // In each surface, one trial carries the label of the other surface.
        let many = Array2::from_shape_fn(
            (20, 1),
            |(i, _)| if i < 10 { 0.0 } else { 5.0 } + 0.1 * i as f64,
        );
        let class: Vec<usize> = (0..20).map(|i| usize::from((i < 10) == (i % 10 == 4))).collect();
        assert!(best_k(&many, &class) > 1);
    }
}
