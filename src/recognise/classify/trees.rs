//! Ensembles of decision trees: a random forest and AdaBoost.

use ndarray::{ArrayView1, Axis};
use rand::Rng;
use rayon::prelude::*;
use smartcore::ensemble::random_forest_classifier::{
    RandomForestClassifier, RandomForestClassifierParameters,
};
use smartcore::linalg::basic::matrix::DenseMatrix;
use smartcore::tree::decision_tree_classifier::{
    DecisionTreeClassifier, DecisionTreeClassifierParameters,
};

use super::naive_bayes::matrix;
use super::{Classifier, Scores, TrainingSet};
use crate::seed;

const TREES: u64 = 200;
const ROUNDS: u64 = 50;
/// Levels of a boosted tree beyond those needed for one leaf per surface.
const SPARE_LEVELS: u32 = 2;
/// Weighted error below which a tree counts as perfect.
const PERFECT: f64 = 1e-10;

type FeatureMatrix = DenseMatrix<f64>;
/// A forest of one tree: smartcore gives the winner of a forest, but not how many trees chose it.
type RandomTree = RandomForestClassifier<f64, u32, FeatureMatrix, Vec<u32>>;
type Tree = DecisionTreeClassifier<f64, u32, FeatureMatrix, Vec<u32>>;

/// A random forest (Breiman 2001): 200 trees on bootstrapped trials; each split tries the square
/// root of the number of features. The inverse of a score is the surface's share of the trees.
#[derive(Clone, Copy, Debug)]
pub struct RandomForest {
    /// Seed of the bootstraps and of the features that are tried.
    pub seed: u64,
}

/// AdaBoost for many classes (SAMME, Zhu et al. 2009, "Multi-class AdaBoost"), 50 trees, each
/// trained on trials drawn by weight and little deeper than one leaf per surface needs.
#[derive(Clone, Copy, Debug)]
pub struct AdaBoost {
    pub seed: u64,
}

/// A query in smartcore's form.
fn row(query: ArrayView1<'_, f64>) -> FeatureMatrix {
    let values = query.to_vec();
    // Fails only if the number of values is not rows × columns.
    DenseMatrix::new(1, values.len(), values, false).expect("one row")
}

/// Shares of votes as scores. Each of n surfaces gets 1/n of an extra vote, so that none has 0.
fn shares(votes: &[f64]) -> Scores {
    let each = 1.0 / votes.len() as f64;
    let total: f64 = votes.iter().sum::<f64>() + 1.0;
    Scores::Surfaces(votes.iter().map(|votes| -((votes + each) / total).ln()).collect())
}

impl Classifier for RandomForest {
    type Model = Vec<RandomTree>;

    fn train(&self, training: &TrainingSet) -> Vec<RandomTree> {
        let (x, y) = matrix(training);
        let tree = |number: u64| {
            let parameters = RandomForestClassifierParameters::default().with_n_trees(1).with_seed(
                seed::stable_hash(&[b"tree", &self.seed.to_le_bytes(), &number.to_le_bytes()]),
            );
            // A bootstrap that holds only one surface grows no tree.
            RandomForestClassifier::fit(&x, &y, parameters).ok()
        };
        (0..TREES).into_par_iter().filter_map(tree).collect()
    }

    fn scores(
        &self,
        model: &Vec<RandomTree>,
        training: &TrainingSet,
        query: ArrayView1<'_, f64>,
    ) -> Scores {
        let query = row(query);
        let mut votes = vec![0.0; training.surfaces.len()];
        for class in model.iter().filter_map(|tree| tree.predict(&query).ok()) {
            votes[class[0] as usize] += 1.0;
        }
        shares(&votes)
    }

    fn states_probabilities(&self) -> bool {
        true
    }
}

impl Classifier for AdaBoost {
    type Model = Vec<(f64, Tree)>;

    fn train(&self, training: &TrainingSet) -> Vec<(f64, Tree)> {
        let (x, _) = matrix(training);
        let n = training.class.len();
        let surfaces = training.surfaces.len();
        let levels = surfaces.next_power_of_two().ilog2() + SPARE_LEVELS;
        let mut weights = vec![1.0 / n as f64; n];
        let mut trees = Vec::new();
        for round in 0..ROUNDS {
            let mut rng = seed::rng(self.seed, &[b"adaboost", &round.to_le_bytes()]);
            let drawn = draw(&weights, &mut rng);
            let of_round = TrainingSet {
                features: training.features.select(Axis(0), &drawn),
                class: drawn.iter().map(|&i| training.class[i]).collect(),
                surfaces: training.surfaces.clone(),
                keys: Vec::new(),
            };
            let (drawn_x, drawn_y) = matrix(&of_round);
            let parameters =
                DecisionTreeClassifierParameters::default().with_max_depth(levels as u16);
            // A draw that holds only one surface grows no tree.
            let Ok(tree) = DecisionTreeClassifier::fit(&drawn_x, &drawn_y, parameters) else {
                continue;
            };
            let Ok(named) = tree.predict(&x) else { continue };
            let wrong = |i: usize| named[i] as usize != training.class[i];
            let error: f64 = (0..n).filter(|&i| wrong(i)).map(|i| weights[i]).sum();
            if error >= 1.0 - 1.0 / surfaces as f64 {
                continue;
            }
            let error = error.max(PERFECT);
            let alpha = ((1.0 - error) / error).ln() + (surfaces as f64 - 1.0).ln();
            for (i, weight) in weights.iter_mut().enumerate() {
                if wrong(i) {
                    *weight *= alpha.exp();
                }
            }
            let total: f64 = weights.iter().sum();
            weights.iter_mut().for_each(|weight| *weight /= total);
            trees.push((alpha, tree));
        }
        trees
    }

    fn scores(
        &self,
        model: &Vec<(f64, Tree)>,
        training: &TrainingSet,
        query: ArrayView1<'_, f64>,
    ) -> Scores {
        let query = row(query);
        let mut votes = vec![0.0; training.surfaces.len()];
        for (alpha, tree) in model {
            if let Ok(class) = tree.predict(&query) {
                votes[class[0] as usize] += alpha;
            }
        }
        shares(&votes)
    }
}

/// As many indices as there are weights, drawn in proportion to these.
fn draw(weights: &[f64], rng: &mut impl Rng) -> Vec<usize> {
    let mut sum = 0.0;
    let cumulative: Vec<f64> = weights
        .iter()
        .map(|weight| {
            sum += weight;
            sum
        })
        .collect();
    (0..weights.len())
        .map(|_| {
            let at = seed::uniform(rng) * sum;
            cumulative.partition_point(|&c| c <= at).min(weights.len() - 1)
        })
        .collect()
}
