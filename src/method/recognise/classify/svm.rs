//! Support vector machines with RBF kernel, one for each pair of surfaces.
//!
//! Each machine (C-SVC) is solved by sequential minimal optimisation with second-order working sets
//! (Fan, Chen & Lin 2005, "Working set selection using second order information"). C and the kernel
//! parameter γ are chosen by cross-validation within the library.

use std::sync::Arc;

use ndarray::{Array2, ArrayView1};
use rayon::prelude::*;

use super::{Scorer, Scores, TrainingSet, squared_distance};

/// Values of C to try.
const COSTS: [f64; 3] = [1.0, 10.0, 100.0];
/// Values of γ to try, before they are divided by the number of features.
const WIDTHS: [f64; 3] = [0.25, 1.0, 4.0];
/// Number of folds of the cross-validation.
const PARTS: usize = 3;
/// Tolerated violation of the optimality conditions, as in libsvm.
const TOLERANCE: f64 = 1e-3;

/// The machine that separates surface `a` (positive) from surface `b`.
struct Pair {
    a: usize,
    b: usize,
    /// For each support vector, the index of its trial and its signed multiplier.
    support: Vec<(usize, f64)>,
    bias: f64,
}

pub(crate) fn learn(training: &Arc<TrainingSet>) -> Scorer {
    let distances = distances(training);
    let (cost, gamma) = choose(training, &distances);
    let everyone: Vec<usize> = (0..training.class.len()).collect();
    let pairs = machines(training, &everyone, &distances, cost, gamma);
    let training = training.clone();
    Box::new(move |query: ArrayView1<'_, f64>| {
        let kernel: Vec<f64> = (training.features.rows().into_iter())
            .map(|row| (-gamma * squared_distance(row, query)).exp())
            .collect();
        let surfaces = training.surfaces.len();
        let most = (surfaces - 1) as f64;
        let score = |votes: f64| -((votes + 0.5) / (most + 1.0)).max(f64::MIN_POSITIVE).ln();
        let log_scores = votes(&pairs, surfaces, &kernel).into_iter().map(score).collect();
        Scores::Surfaces { log_scores, are_probabilities: false }
    })
}

/// Number of pairs that each surface wins. Decision values, scaled to below ⅓, settle ties. `kernel`
/// holds the kernel between the query and each trial.
fn votes(pairs: &[Pair], surfaces: usize, kernel: &[f64]) -> Vec<f64> {
    let (mut won, mut sure) = (vec![0.0; surfaces], vec![0.0; surfaces]);
    for pair in pairs {
        let weighted = pair.support.iter().map(|&(i, weight)| weight * kernel[i]);
        let decision = pair.bias + weighted.sum::<f64>();
        won[if decision > 0.0 { pair.a } else { pair.b }] += 1.0;
        sure[pair.a] += decision;
        sure[pair.b] -= decision;
    }
    won.iter().zip(sure).map(|(won, sure)| won + sure / (3.0 * (f64::abs(sure) + 1.0))).collect()
}

fn distances(training: &TrainingSet) -> Array2<f64> {
    let x = &training.features;
    let squares: Vec<f64> = x.rows().into_iter().map(|row| row.dot(&row)).collect();
    let mut d2 = x.dot(&x.t());
    for ((i, j), value) in d2.indexed_iter_mut() {
        *value = (squares[i] + squares[j] - 2.0 * *value).max(0.0);
    }
    d2
}

/// The C and γ that name most left-out trials right; the smallest values in a tie.
fn choose(training: &TrainingSet, distances: &Array2<f64>) -> (f64, f64) {
    let features = training.features.ncols().max(1) as f64;
    // The trials of every surface are dealt to the folds in turn.
    let mut seen = vec![0; training.surfaces.len()];
    let deal = |&class: &usize| {
        seen[class] += 1;
        (seen[class] - 1) % PARTS
    };
    let part_of: Vec<usize> = training.class.iter().map(deal).collect();
    let settings: Vec<(f64, f64)> =
        COSTS.iter().flat_map(|&c| WIDTHS.map(|width| (c, width / features))).collect();
    let right = |&(cost, gamma): &(f64, f64)| -> usize {
        let of_part = |part: usize| {
            let (held, rest): (Vec<usize>, Vec<usize>) =
                (0..part_of.len()).partition(|&i| part_of[i] == part);
            let pairs = machines(training, &rest, distances, cost, gamma);
            let named = |&i: &usize| {
                let kernel: Vec<f64> =
                    distances.row(i).iter().map(|d2| (-gamma * d2).exp()).collect();
                let votes = votes(&pairs, training.surfaces.len(), &kernel);
                let best = (0..votes.len()).max_by(|&a, &b| votes[a].total_cmp(&votes[b]));
                best == Some(training.class[i])
            };
            held.iter().filter(|i| named(i)).count()
        };
        (0..PARTS).map(of_part).sum()
    };
    let counts: Vec<usize> = settings.par_iter().map(right).collect();
    let best = (0..counts.len()).rev().max_by_key(|&i| counts[i]).unwrap_or(0);
    settings[best]
}

/// Trains one machine for each pair of the surfaces that have trials among `rows`.
fn machines(
    training: &TrainingSet,
    rows: &[usize],
    distances: &Array2<f64>,
    cost: f64,
    gamma: f64,
) -> Vec<Pair> {
    let mut members = vec![Vec::new(); training.surfaces.len()];
    rows.iter().for_each(|&i| members[training.class[i]].push(i));
    let here: Vec<usize> = (0..members.len()).filter(|&c| !members[c].is_empty()).collect();
    let pairs: Vec<(usize, usize)> = (here.iter().enumerate())
        .flat_map(|(at, &a)| here[at + 1..].iter().map(move |&b| (a, b)))
        .collect();
    let machine = |&(a, b): &(usize, usize)| {
        let both: Vec<usize> = members[a].iter().chain(&members[b]).copied().collect();
        let sign = |at: usize| if at < members[a].len() { 1.0 } else { -1.0 };
        let signs: Vec<f64> = (0..both.len()).map(sign).collect();
        let kernel = |i: usize, j: usize| (-gamma * distances[[both[i], both[j]]]).exp();
        let q = Array2::from_shape_fn((both.len(), both.len()), |(i, j)| kernel(i, j));
        let (alpha, bias) = solve(&q, &signs, cost);
        let support = (both.iter().zip(alpha).zip(&signs))
            .filter(|((_, alpha), _)| *alpha > 0.0)
            .map(|((&i, alpha), sign)| (i, alpha * sign))
            .collect();
        Pair { a, b, support, bias }
    };
    pairs.par_iter().map(machine).collect()
}

/// Multipliers α and bias of one machine: α maximises Σαᵢ − ½ Σ αᵢαⱼyᵢyⱼKᵢⱼ under 0 ≤ α ≤ C and Σαᵢyᵢ
/// = 0.
fn solve(kernel: &Array2<f64>, signs: &[f64], cost: f64) -> (Vec<f64>, f64) {
    let n = signs.len();
    let mut alpha = vec![0.0; n];
    // Gradient of the negated objective.
    let mut gradient = vec![-1.0; n];
    // Every step improves the objective. The limit ends the loop if rounding spoils the kernel.
    for _ in 0..1000 * n {
        let up = |t: usize| if signs[t] > 0.0 { alpha[t] < cost } else { alpha[t] > 0.0 };
        let down = |t: usize| if signs[t] > 0.0 { alpha[t] > 0.0 } else { alpha[t] < cost };
        let violation = |t: usize| -signs[t] * gradient[t];
        let Some(i) =
            (0..n).filter(|&t| up(t)).max_by(|&a, &b| violation(a).total_cmp(&violation(b)))
        else {
            break;
        };
        let curvature =
            |t: usize| (kernel[[i, i]] + kernel[[t, t]] - 2.0 * kernel[[i, t]]).max(1e-12);
        let gain = |t: usize| (violation(i) - violation(t)).powi(2) / curvature(t);
        let below = (0..n).filter(|&t| down(t) && violation(t) < violation(i) - TOLERANCE);
        let Some(j) = below.max_by(|&a, &b| gain(a).total_cmp(&gain(b))) else { break };
        // A step that keeps yᵢαᵢ + yⱼαⱼ constant.
        let room = |t: usize, rises: bool| if rises { cost - alpha[t] } else { alpha[t] };
        let step = ((violation(i) - violation(j)) / curvature(j))
            .min(room(i, signs[i] > 0.0))
            .min(room(j, signs[j] < 0.0));
        alpha[i] = (alpha[i] + signs[i] * step).clamp(0.0, cost);
        alpha[j] = (alpha[j] - signs[j] * step).clamp(0.0, cost);
        for (t, slope) in gradient.iter_mut().enumerate() {
            *slope += signs[t] * step * (kernel[[t, i]] - kernel[[t, j]]);
        }
    }
    (alpha.clone(), bias(&alpha, &gradient, signs, cost))
}

/// Mean over free support vectors (0 < α < C); if there are none, the middle of the allowed range.
fn bias(alpha: &[f64], gradient: &[f64], signs: &[f64], cost: f64) -> f64 {
    let (mut low, mut high) = (f64::NEG_INFINITY, f64::INFINITY);
    let (mut sum, mut free) = (0.0, 0.0);
    for ((&a, &g), &y) in alpha.iter().zip(gradient).zip(signs) {
        let value = -y * g;
        if a > 0.0 && a < cost {
            sum += value;
            free += 1.0;
        } else if (y > 0.0) == (a == 0.0) {
            low = low.max(value);
        } else {
            high = high.min(value);
        }
    }
    if free > 0.0 { sum / free } else { 0.5 * (low + high) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_points_share_one_margin() {
        let kernel = ndarray::array![[1.0, 0.5], [0.5, 1.0]];
        let (alpha, bias) = solve(&kernel, &[1.0, -1.0], 100.0);
        // ‖w‖² = 2α²(1 − k); the margin of 1 gives α = 1/(1 − k).
        assert!((alpha[0] - 2.0).abs() < 1e-3 && (alpha[1] - 2.0).abs() < 1e-3, "{alpha:?}");
        assert!(bias.abs() < 1e-9);
    }

    #[test]
    fn the_solution_satisfies_the_optimality_conditions() {
        let x: Vec<f64> = (0..24).map(|i| f64::from(i * i % 17)).collect();
        let signs: Vec<f64> = (0..24).map(|i| if i % 3 == 0 { 1.0 } else { -1.0 }).collect();
        let kernel =
            Array2::from_shape_fn((24, 24), |(i, j)| (-0.05 * (x[i] - x[j]).powi(2)).exp());
        for cost in [0.1, 1.0, 50.0] {
            let (alpha, bias) = solve(&kernel, &signs, cost);
            let balance: f64 = alpha.iter().zip(&signs).map(|(a, y)| a * y).sum();
            assert!(balance.abs() < 1e-9);
            for (i, &a) in alpha.iter().enumerate() {
                let f: f64 =
                    bias + (0..24).map(|j| alpha[j] * signs[j] * kernel[[i, j]]).sum::<f64>();
                let margin = signs[i] * f;
                assert!(a > 0.0 || margin > 1.0 - 3e-3, "{i}: {margin}");
                assert!(a < cost || margin < 1.0 + 3e-3, "{i}: {margin}");
            }
        }
    }
}
