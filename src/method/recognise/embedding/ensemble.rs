//! Many small discriminants on random subspaces of the features (Ho 1998, "The random subspace method
//! for constructing decision forests"; for discriminants Wang and Tang 2004, "Random sampling LDA for
//! face recognition").
//!
//! A library of one session does not show how the next session moves the features. A discriminant in
//! thousands of dimensions whitens by it all the same, and is certain and wrong. Each member sees d
//! features, and they do not all err alike. As the library grows, d grows to all features, or to what
//! training can afford.

use ndarray::{Array1, Array2, ArrayView1, Axis};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::discriminant::{Discriminant, Rows};
use crate::seed;

const MEMBERS: usize = 50;

/// Features of a member: twice the number of trials, within these limits. More than the greatest would
/// cost time with its square.
const FEATURES: (usize, usize) = (20, 600);

/// Without a group, fewer members are trained: as many as together have this many features, and as make
/// this many products for an answer, over all groups. They would take most of the time and memory
/// otherwise.
const FEATURES_WITHOUT: usize = 12_000;
const PRODUCTS_WITHOUT: usize = 8_000_000;

/// Number of products that is worth its own thread.
const WORTH_A_THREAD: usize = 500_000;

#[derive(Clone, Debug, Serialize, Deserialize)]
struct Member {
    /// The columns of the vector that are the member's features.
    columns: Vec<usize>,
    discriminant: Discriminant,
}

/// Discriminants whose answers are averaged.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct Ensemble {
    members: Vec<Member>,
}

/// The answer of an ensemble to a vector.
#[derive(Clone, Debug)]
pub(crate) struct Answer {
    /// For each member, the squared distance to each class mean.
    pub(super) distances: Vec<Vec<f64>>,
    /// Number of features of a member.
    pub(super) features: usize,
}

impl Answer {
    /// ln of the probability of each class: of the mean over members of softmax(−distance/2τ).
    pub(crate) fn log_probabilities(&self, tau: f64) -> Vec<f64> {
        let log_softmax = |distances: &Vec<f64>| -> Vec<f64> {
            distances.iter().copied().map(log_share(distances, tau)).collect()
        };
        let of_members: Vec<_> = self.distances.iter().map(log_softmax).collect();
        let classes = of_members.first().map_or(0, Vec::len);
        (0..classes).map(|class| log_mean(of_members.iter().map(|of| of[class]))).collect()
    }

    /// ln of the probability of one class, as in [`Self::log_probabilities`].
    pub(super) fn log_probability(&self, class: usize, tau: f64) -> f64 {
        let of_member = |distances: &Vec<f64>| log_share(distances, tau)(distances[class]);
        let of_members: Vec<f64> = self.distances.iter().map(of_member).collect();
        log_mean(of_members.iter().copied())
    }

    /// Mean over members of the squared distance to the nearest class mean, divided by the number of
    /// features.
    pub(crate) fn strangeness(&self) -> f64 {
        let total: f64 = self.distances.iter().map(|distances| least(distances)).sum();
        total / (self.distances.len() * self.features).max(1) as f64
    }
}

impl Ensemble {
    /// Trains on the given columns of the training vectors, shape (N, D): on all rows, and without each
    /// group, then with fewer members ([`FEATURES_WITHOUT`]). An ensemble without a group is `None` if the
    /// remaining rows are too few or all alike. If not even all rows can train a member, the first
    /// ensemble tells nothing apart.
    pub(crate) fn train(
        vectors: &Array2<f32>,
        columns: &[usize],
        rows: &Rows,
        seed: u64,
    ) -> (Self, Vec<Option<Self>>) {
        let trials = rows.trials.iter().max().map_or(0, |last| last + 1);
        let size = (2 * trials).clamp(FEATURES.0, FEATURES.1).min(columns.len());
        let members = if size == columns.len() { 1 } else { MEMBERS };
        let products = (rows.group_count * (rows.classes.max(2) - 1) * size).max(1);
        let members_without = members
            .min(FEATURES_WITHOUT.div_ceil(size.max(1)))
            .min(PRODUCTS_WITHOUT.div_ceil(products));
        // Column by column, so that a member's columns are read in one piece each.
        let by_column = vectors.t().as_standard_layout().into_owned();
        let trained: Vec<_> = (0..members)
            .into_par_iter()
            .map(|number| {
                let columns = drawn(columns, size, seed, number);
                let groups = if number < members_without { rows.group_count } else { 0 };
                let own = by_column.select(Axis(0), &columns).t().as_standard_layout().into_owned();
                let (all, without) = Discriminant::train(own, rows, groups);
                let all = all.unwrap_or_else(|| Discriminant::indifferent(rows.classes, size));
                let member = |discriminant| Member { columns: columns.clone(), discriminant };
                (member(all), without.into_iter().map(|one| one.map(member)).collect::<Vec<_>>())
            })
            .collect();
        let (members, mut by_member): (_, Vec<Vec<Option<Member>>>) = trained.into_iter().unzip();
        by_member.truncate(members_without);
        let without = |group: usize| {
            let members = by_member.iter_mut().map(|of_member| of_member[group].take());
            Some(Self { members: members.collect::<Option<_>>()? })
        };
        let without = (0..rows.group_count).map(without).collect();
        (Self { members }, without)
    }

    pub(crate) fn is_of(&self, classes: usize, dims: usize) -> bool {
        let is_sound = |member: &Member| {
            member.discriminant.is_of(classes, member.columns.len())
                && member.columns.iter().all(|&column| column < dims)
        };
        !self.members.is_empty() && self.members.iter().all(is_sound)
    }

    pub(crate) fn knows(&self, class: usize) -> bool {
        self.members.iter().all(|member| member.discriminant.knows(class))
    }

    /// The answers to vectors of D features.
    pub(crate) fn answers(&self, vectors: &[ArrayView1<'_, f32>]) -> Vec<Answer> {
        let of_member = |member: &Member| {
            let own = gathered(vectors, &member.columns);
            member.discriminant.distances(own.view())
        };
        // The threads of a small task cost more than they save.
        let work = vectors.len() * self.members.first().map_or(0, |m| m.discriminant.work());
        let fewest = (WORTH_A_THREAD / work.max(1)).max(1);
        let members = self.members.par_iter().with_min_len(fewest);
        let mut all: Vec<_> = members.map(|member| of_member(member).into_iter()).collect();
        let features = self.members.first().map_or(0, |member| member.columns.len());
        let answer = |_: &_| Answer {
            distances: all.iter_mut().filter_map(Iterator::next).collect(),
            features,
        };
        vectors.iter().map(answer).collect()
    }

    /// Mean over members of w_c, shape (C, D), and of b_c; see [`Discriminant::weights`].
    pub(crate) fn weights(&self, (classes, dims): (usize, usize)) -> (Array2<f32>, Array1<f64>) {
        let (mut all, mut sum) = (Array2::zeros((classes, dims)), Array1::zeros(classes));
        for member in &self.members {
            let (weights, offsets) = member.discriminant.weights();
            for (of_member, &column) in weights.columns().into_iter().zip(&member.columns) {
                all.column_mut(column).scaled_add(1.0, &of_member);
            }
            sum += &offsets;
        }
        let members = self.members.len().max(1);
        (all / members as f32, sum / members as f64)
    }
}

/// The given columns of some rows. Faster than `select`, which goes through a matrix column by column.
fn gathered(rows: &[ArrayView1<'_, f32>], columns: &[usize]) -> Array2<f32> {
    let mut own = Array2::zeros((rows.len(), columns.len()));
    for (mut own, row) in own.rows_mut().into_iter().zip(rows) {
        own.iter_mut().zip(columns).for_each(|(x, &column)| *x = row[column]);
    }
    own
}

/// `size` of the columns, drawn without replacement; in ascending order.
fn drawn(columns: &[usize], size: usize, seed: u64, number: usize) -> Vec<usize> {
    let mut rng = seed::rng(seed, &[b"member", &(number as u64).to_le_bytes()]);
    let mut columns = columns.to_vec();
    for i in 0..size {
        let left = (columns.len() - i) as f64;
        columns.swap(i, i + (seed::uniform(&mut rng) * left) as usize);
    }
    columns.truncate(size);
    columns.sort_unstable();
    columns
}

fn least(distances: &[f64]) -> f64 {
    distances.iter().copied().fold(f64::INFINITY, f64::min)
}

/// ln softmax(−d/2τ) of one of the distances; equal shares if all distances are infinite.
fn log_share(distances: &[f64], tau: f64) -> impl Fn(f64) -> f64 {
    let least = least(distances);
    let equal = (!least.is_finite()).then(|| -(distances.len() as f64).ln());
    let scale = 0.5 / tau;
    let total = match equal {
        Some(_) => 0.0,
        None => distances.iter().map(|d| share(scale * (least - d))).sum::<f64>().ln(),
    };
    move |d| equal.unwrap_or(scale * (least - d) - total)
}

/// ln of the mean of e^x. A mean too small for a number still has a logarithm.
fn log_mean(logs: impl Iterator<Item = f64> + Clone) -> f64 {
    let (most, n) = logs.clone().fold((f64::NEG_INFINITY, 0.0), |(m, n), x| (x.max(m), n + 1.0));
    if most == f64::NEG_INFINITY {
        return most;
    }
    most + (logs.map(|x| share(x - most)).sum::<f64>() / n).ln()
}

/// e^x of an x of at most 0; 0 if that is too little to change a sum that has 1 in it.
fn share(x: f64) -> f64 {
    if x < -40.0 { 0.0 } else { x.exp() }
}
