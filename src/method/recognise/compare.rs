//! Compares two trials, source by source, and tests whether chance explains the difference.

use std::sync::Arc;

use super::error::Result;
use super::reference::{
    DomainSamples, PreparedTrial, SampledSource, aligned, log_score, score_samples, shared_sources,
};
use crate::kernel::{neighbours_alike, pair_test};
use crate::library::Entry;
use crate::scene::{Scene, SourceId, SourceSpec};
use crate::seed;
use crate::trial::{Signal, Trial};

/// One source of two trials, compared by the method `reference`.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct SourceComparison {
    pub source: SourceId,
    /// Number of samples drawn from each trial, n.
    pub n: usize,
    pub dims: usize,
    /// Mean of the length scale over repetitions.
    pub sigma: f64,
    /// Mean of MMD²_b over repetitions.
    pub mmd2: f64,
    /// n·MMD²_b, averaged over repetitions, plus the score offset of the source (1 for metal).
    pub score: f64,
    /// Threshold κ of MMD²_b, averaged over repetitions; found by swapping samples within pairs.
    pub kappa: f64,
    /// Twice the mean p-value of the repetitions, at most 1. This p-value is valid even if the
    /// repetitions depend on each other (Vovk & Wang 2020, "Combining p-values via averaging").
    pub p_value: f64,
    /// The correlation of neighbouring samples, if they are alike, so that the p-value is too small.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub neighbours: Option<f64>,
}

#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Comparison {
    pub sources: Vec<SourceComparison>,
    pub ds: f64,
}

#[derive(Clone, Copy, Debug)]
pub struct TestOptions {
    /// Number of samples drawn from each source of a trial, n.
    pub samples: usize,
    pub repetitions: usize,
    pub permutations: usize,
    pub alpha: f64,
    /// Seed of the sample positions and the permutations.
    pub seed: u64,
}

/// Compares a query `z` with a library trial `y`, and tests each source. Uses the method `reference`
/// with the same sample positions in both trials.
///
/// # Errors
/// If a trial does not fit the scene, the trials share no source, or their rates differ.
pub fn compare(z: &Trial, y: &Trial, scene: &Scene, options: &TestOptions) -> Result<Comparison> {
    let unsampled =
        |_: &SourceSpec, _: &Signal, _| SampledSource { sets: Vec::new(), domain: None };
    let prepared = |trial: &Trial| {
        PreparedTrial::new(&Entry::in_memory(trial.clone()), trial, scene, false, unsampled)
    };
    let mut sources = Vec::new();
    let mut log_ds = 0.0;
    for spec in shared_sources(scene, &prepared(z)?, &[Arc::new(prepared(y)?)])? {
        let (of_z, of_y) = (&z.signals[&spec.id], &y.signals[&spec.id]);
        let frames = of_z.frames().min(of_y.frames());
        let z = DomainSamples::new(spec, of_z, frames);
        let y = DomainSamples::new(spec, of_y, frames);
        let compared = compare_source(spec, &z, &y, options);
        log_ds += spec.weight * log_score(compared.score);
        sources.push(compared);
    }
    Ok(Comparison { sources, ds: log_ds.exp() })
}

fn compare_source(
    spec: &SourceSpec,
    z: &DomainSamples,
    y: &DomainSamples,
    options: &TestOptions,
) -> SourceComparison {
    let r = options.repetitions as f64;
    let (mut sum, mut n, mut dims, mut neighbours) = ([0.0; 5], 0, 0, None);
    for repetition in 0..options.repetitions {
        let TestOptions { samples, seed, .. } = *options;
        let at = z.positions(&spec.id, samples, seed, repetition, None);
        let (z, y) = (z.at(&at), y.at(&at));
        let alike = [&z, &y].into_iter().filter_map(|one| neighbours_alike(one.view()));
        neighbours = alike.reduce(f64::max);
        let result = score_samples(z.view(), y.view(), spec.align_mean, spec.sigma);
        let z = if spec.align_mean { aligned(z.view(), y.view()) } else { z };
        let key = [spec.id.as_str().as_bytes(), b"permute", &repetition.to_le_bytes()];
        let mut rng = seed::rng(seed, &key);
        let test = pair_test(
            y.view(),
            z.view(),
            result.sigma,
            options.permutations,
            options.alpha,
            &mut rng,
        );
        (n, dims) = (result.n, result.dims);
        let terms = [result.sigma, result.mmd2, result.score, test.kappa, test.p_value];
        sum.iter_mut().zip(terms).for_each(|(sum, term)| *sum += term / r);
    }
    let [sigma, mmd2, score, kappa, p_mean] = sum;
    SourceComparison {
        source: spec.id.clone(),
        n,
        dims,
        sigma,
        mmd2,
        score: score + spec.score_offset,
        kappa,
        p_value: (2.0 * p_mean).min(1.0),
        neighbours,
    }
}
