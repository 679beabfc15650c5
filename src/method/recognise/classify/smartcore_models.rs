//! Classifiers built from parts of smartcore: Gaussian naive Bayes, a random forest and AdaBoost.

use ndarray::{ArrayView1, ArrayView2, Axis};
use rand::Rng;
use rayon::prelude::*;
use smartcore::api::Predictor;
use smartcore::ensemble::random_forest_classifier::{
    RandomForestClassifier, RandomForestClassifierParameters,
};
use smartcore::linalg::basic::matrix::DenseMatrix;
use smartcore::naive_bayes::gaussian::{GaussianNB, GaussianNBParameters};
use smartcore::tree::decision_tree_classifier::{
    DecisionTreeClassifier, DecisionTreeClassifierParameters,
};

use super::{Scorer, Scores, TrainingSet};
use crate::seed;

/// Added to every variance, in units of the library's variance. The 1e-9 of scikit-learn is too little
/// if a surface has only a few trials.
const SMOOTHING: f64 = 1e-2;
const TREES: u64 = 200;
const ROUNDS: u64 = 50;
/// Levels that a boosted tree may have beyond those needed for one leaf per surface.
const SPARE_LEVELS: u32 = 2;
/// Lower limit of a tree's weighted error, so that the weight of a perfect tree is finite.
const PERFECT: f64 = 1e-10;

type FeatureMatrix = DenseMatrix<f64>;

/// Converts trials to smartcore's form.
fn matrix(features: ArrayView2<'_, f64>) -> FeatureMatrix {
    let (rows, columns) = features.dim();
    let matrix = DenseMatrix::new(rows, columns, features.iter().copied().collect(), false);
    // Fails only if the number of values is not rows × columns.
    matrix.expect("as many values as places")
}

fn labels(class: impl Iterator<Item = usize>) -> Vec<u32> {
    class.map(|class| class as u32).collect()
}

/// A scorer by trees that vote with weights. Each score is −ln of the surface's share of the votes. One
/// extra vote, divided equally among the surfaces, keeps every share above 0.
fn by_votes<T>(trees: Vec<(f64, T)>, surfaces: usize, are_probabilities: bool) -> Scorer
where
    T: Predictor<FeatureMatrix, Vec<u32>> + Send + Sync + 'static,
{
    Box::new(move |query: ArrayView1<'_, f64>| {
        let query = matrix(query.insert_axis(Axis(0)));
        let mut votes = vec![0.0; surfaces];
        for (weight, tree) in &trees {
            if let Ok(class) = tree.predict(&query) {
                votes[class[0] as usize] += weight;
            }
        }
        let each = 1.0 / surfaces as f64;
        let total: f64 = votes.iter().sum::<f64>() + 1.0;
        let log_scores = votes.iter().map(|votes| -((votes + each) / total).ln()).collect();
        Scores::Surfaces { log_scores, are_probabilities }
    })
}

/// Each score is −ln of the surface's posterior probability.
pub(crate) fn naive_bayes(training: &TrainingSet) -> Scorer {
    let (x, y) = (matrix(training.features.view()), labels(training.class.iter().copied()));
    // Fails only for an empty library or a class without trials; a library has neither.
    let fitted = GaussianNB::fit(&x, &y, GaussianNBParameters::default())
        .expect("a row for every class and a class for every row");
    // Mean and variance of each feature, for each surface.
    let (means, variances) = (fitted.theta().clone(), fitted.var().clone());
    Box::new(move |query: ArrayView1<'_, f64>| {
        let log_likelihood = |(mean, variance): (&Vec<f64>, &Vec<f64>)| -> f64 {
            let terms = query.iter().zip(mean).zip(variance).map(|((x, mean), variance)| {
                let variance = variance + SMOOTHING;
                -0.5 * ((x - mean).powi(2) / variance + variance.ln())
            });
            terms.sum()
        };
        let logits: Vec<f64> = means.iter().zip(&variances).map(log_likelihood).collect();
        // −ln softmax.
        let most = logits.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let sum = logits.iter().map(|x| (x - most).exp()).sum::<f64>().ln() + most;
        let log_scores = logits.iter().map(|x| sum - x).collect();
        Scores::Surfaces { log_scores, are_probabilities: true }
    })
}

/// A random forest (Breiman 2001) on bootstrapped trials. Each split tries √(number of features)
/// features. The seed determines the bootstraps and the features tried.
pub(crate) fn forest(training: &TrainingSet, seed: u64) -> Scorer {
    let (x, y) = (matrix(training.features.view()), labels(training.class.iter().copied()));
    let tree = |number: u64| {
        let key: [&[u8]; 3] = [b"tree", &seed.to_le_bytes(), &number.to_le_bytes()];
        let parameters = RandomForestClassifierParameters::default()
            .with_n_trees(1)
            .with_seed(seed::stable_hash(&key));
        // No tree grows if a bootstrap holds only one surface.
        RandomForestClassifier::fit(&x, &y, parameters).ok().map(|tree| (1.0, tree))
    };
    // A forest of one tree each. Smartcore gives the winner of a forest, but not how many trees chose it.
    let trees: Vec<_> = (0..TREES).into_par_iter().filter_map(tree).collect();
    by_votes(trees, training.surfaces.len(), true)
}

/// AdaBoost for many classes (SAMME, Zhu et al. 2009, "Multi-class AdaBoost"). Each tree is trained on
/// trials drawn by weight.
pub(crate) fn boosted(training: &TrainingSet, seed: u64) -> Scorer {
    let TrainingSet { features, class, surfaces, .. } = training;
    let (n, surfaces) = (class.len(), surfaces.len());
    let x = matrix(features.view());
    let levels = surfaces.next_power_of_two().ilog2() + SPARE_LEVELS;
    let mut weights = vec![1.0 / n as f64; n];
    let mut trees = Vec::new();
    for round in 0..ROUNDS {
        let mut rng = seed::rng(seed, &[b"adaboost", &round.to_le_bytes()]);
        let drawn = draw(&weights, &mut rng);
        let drawn_x = matrix(features.select(Axis(0), &drawn).view());
        let drawn_y = labels(drawn.iter().map(|&i| class[i]));
        let parameters = DecisionTreeClassifierParameters::default().with_max_depth(levels as u16);
        // No tree grows if the drawn trials are all of one surface.
        let Ok(tree) = DecisionTreeClassifier::fit(&drawn_x, &drawn_y, parameters) else {
            continue;
        };
        let Ok(named) = tree.predict(&x) else { continue };
        let wrong = |i: usize| named[i] as usize != class[i];
        let error: f64 = (0..n).filter(|&i| wrong(i)).map(|i| weights[i]).sum();
        if error >= 1.0 - 1.0 / surfaces as f64 {
            continue;
        }
        let error = error.max(PERFECT);
        let alpha = ((1.0 - error) / error).ln() + (surfaces as f64 - 1.0).ln();
        (0..n).filter(|&i| wrong(i)).for_each(|i| weights[i] *= alpha.exp());
        let total: f64 = weights.iter().sum();
        weights.iter_mut().for_each(|weight| *weight /= total);
        trees.push((alpha, tree));
    }
    by_votes(trees, surfaces, false)
}

/// Draws indices in proportion to `weights`, as many as there are weights.
fn draw(weights: &[f64], rng: &mut impl Rng) -> Vec<usize> {
    let mut sum = 0.0;
    let add = |weight: &f64| {
        sum += weight;
        sum
    };
    let cumulative: Vec<f64> = weights.iter().map(add).collect();
    let last = weights.len() - 1;
    let one = |_| {
        let at = seed::uniform(rng) * cumulative[last];
        cumulative.partition_point(|&c| c <= at).min(last)
    };
    (0..weights.len()).map(one).collect()
}
