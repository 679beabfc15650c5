//! Gaussian naive Bayes: given the surface, features are independent and normally distributed.

use ndarray::ArrayView1;
use smartcore::linalg::basic::matrix::DenseMatrix;
use smartcore::naive_bayes::gaussian::{GaussianNB, GaussianNBParameters};

use super::{Classifier, Scores, TrainingSet, negative_log_softmax};

/// Added to every variance, in units of the library's variance. scikit-learn adds 1e-9, too little
/// where a surface has only a handful of trials.
const SMOOTHING: f64 = 1e-2;

/// Gaussian naive Bayes with equal priors. The inverse of a score is the posterior probability.
#[derive(Clone, Copy, Debug, Default)]
pub struct NaiveBayes;

/// Mean and variance of each feature, surface by surface.
pub struct ClassMoments {
    mean: Vec<Vec<f64>>,
    variance: Vec<Vec<f64>>,
}

/// A library in smartcore's form.
pub(super) fn matrix(training: &TrainingSet) -> (DenseMatrix<f64>, Vec<u32>) {
    let (rows, columns) = training.features.dim();
    let values = training.features.iter().copied().collect();
    let matrix = DenseMatrix::new(rows, columns, values, false);
    let classes = training.class.iter().map(|&class| class as u32).collect();
    // Fails only if the number of values is not rows × columns.
    (matrix.expect("as many values as places"), classes)
}

impl Classifier for NaiveBayes {
    type Model = ClassMoments;

    fn train(&self, training: &TrainingSet) -> ClassMoments {
        let (x, y) = matrix(training);
        // Fails only for an empty library or rows without a class; a library has two surfaces.
        let fitted = GaussianNB::fit(&x, &y, GaussianNBParameters::default())
            .expect("a row for every class and a class for every row");
        ClassMoments { mean: fitted.theta().clone(), variance: fitted.var().clone() }
    }

    fn scores(&self, model: &ClassMoments, _: &TrainingSet, query: ArrayView1<'_, f64>) -> Scores {
        let log_likelihood = |(mean, variance): (&Vec<f64>, &Vec<f64>)| -> f64 {
            let terms = query.iter().zip(mean).zip(variance).map(|((x, mean), variance)| {
                let variance = variance + SMOOTHING;
                -0.5 * ((x - mean).powi(2) / variance + variance.ln())
            });
            terms.sum()
        };
        let logits: Vec<f64> = model.mean.iter().zip(&model.variance).map(log_likelihood).collect();
        Scores::Surfaces(negative_log_softmax(&logits))
    }

    fn states_probabilities(&self) -> bool {
        true
    }
}
