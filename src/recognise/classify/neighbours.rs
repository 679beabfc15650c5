//! Nearest neighbours by Euclidean or Mahalanobis distance, weighted by 1/d².

use ndarray::{Array1, Array2, ArrayView1, Axis};

use super::super::embedding::linear::{cholesky, solve_lower};
use super::{Classifier, Scores, TrainingSet, squared_distance};

/// Values of k that are tried, by naming each library trial by the others.
const NEIGHBOURS: [usize; 4] = [1, 3, 5, 7];
/// Weight of the identity in the covariance: often there are more features than trials.
const SHRINKAGE: f64 = 0.1;
/// Keeps the logarithm of a distance finite.
const FLOOR: f64 = 1e-12;

/// How the distance between two trials is measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Distance {
    /// Between standardised features.
    Euclidean,
    /// Between features decorrelated by the library's covariance, which is shrunk towards the
    /// identity by a tenth.
    Mahalanobis,
}

/// k nearest neighbours; k is chosen by leaving trials of the library out.
#[derive(Clone, Copy, Debug)]
pub struct Neighbours {
    pub distance: Distance,
}

/// The features of a library in the space where distances are Euclidean.
pub struct NeighboursModel {
    features: Array2<f64>,
    /// Lower Cholesky factor of the covariance, if features are decorrelated.
    factor: Option<Array2<f64>>,
    k: usize,
}

impl Classifier for Neighbours {
    type Model = NeighboursModel;

    fn train(&self, training: &TrainingSet) -> NeighboursModel {
        let factor = match self.distance {
            Distance::Euclidean => None,
            Distance::Mahalanobis => cholesky(covariance(&training.features)),
        };
        let features = match &factor {
            Some(factor) => {
                let mut columns = training.features.t().to_owned();
                solve_lower(factor, &mut columns);
                columns.reversed_axes()
            }
            None => training.features.clone(),
        };
        let k = best_k(&features, &training.class);
        NeighboursModel { features, factor, k }
    }

    fn scores(
        &self,
        model: &NeighboursModel,
        _: &TrainingSet,
        query: ArrayView1<'_, f64>,
    ) -> Scores {
        let query: Array1<f64> = match &model.factor {
            Some(factor) => {
                let mut column = query.to_owned().insert_axis(Axis(1));
                solve_lower(factor, &mut column);
                column.column(0).to_owned()
            }
            None => query.to_owned(),
        };
        let log_score = |row| squared_distance(row, query.view()).max(FLOOR).ln();
        let log_scores = model.features.rows().into_iter().map(log_score).collect();
        Scores::Trials { log_scores, k: model.k }
    }
}

/// Shrunk covariance of standardised features.
fn covariance(features: &Array2<f64>) -> Array2<f64> {
    let mut covariance = features.t().dot(features) / features.nrows() as f64;
    covariance *= 1.0 - SHRINKAGE;
    covariance.diag_mut().mapv_inplace(|x| x + SHRINKAGE);
    covariance
}

/// The k with which most library trials are named right by the others; the smallest in a tie.
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
        // One trial of each surface carries the other's label.
        let many = Array2::from_shape_fn(
            (20, 1),
            |(i, _)| if i < 10 { 0.0 } else { 5.0 } + 0.1 * i as f64,
        );
        let class: Vec<usize> = (0..20).map(|i| usize::from((i < 10) == (i % 10 == 4))).collect();
        assert!(best_k(&many, &class) > 1);
    }
}
