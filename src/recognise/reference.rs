//! The paper's method, exactly (method §2): raw samples, n·MMD²_b a source, product over sources,
//! nearest neighbour.

use std::collections::BTreeMap;
use std::sync::Arc;

use rayon::prelude::*;

use super::domain::DomainSamples;
use super::prepared::{Cut, PreparedTrial, shared_sources};
use super::rank::{Candidate, Ranking, rank};
use super::sampling::{Extent, Positions, keyed_positions};
use super::score::{Precision, QuerySet, SampleSet, log_score};
use super::{Method, RecogniseError};
use crate::kernel::Lanes;
use crate::library::Entry;
use crate::scene::{Scene, SourceSpec};
use crate::trial::{Signal, Trial};

/// Whether sample positions are drawn once for the whole library or anew for each pair of trials.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum PositionMode {
    /// Once a repetition, for every trial: far cheaper.
    #[default]
    Shared,
    /// Anew for every pair, as the authors' program does.
    PerPair,
}

/// Settings of the method; the defaults are the paper's.
#[derive(Clone, Debug)]
pub struct ReferenceOptions {
    /// Samples drawn from a source, n.
    pub samples: usize,
    /// Repetitions whose scores are averaged, R.
    pub repetitions: usize,
    /// Nearest neighbours, k.
    pub neighbours: usize,
    /// How positions are drawn.
    pub positions: PositionMode,
    /// Seed of all positions.
    pub seed: u64,
    /// How kernel sums are computed.
    pub precision: Precision,
}

impl Default for ReferenceOptions {
    fn default() -> Self {
        Self {
            samples: 400,
            repetitions: 10,
            neighbours: 1,
            positions: PositionMode::Shared,
            seed: 1,
            precision: Precision::Fast,
        }
    }
}

/// The method `reference`.
#[derive(Clone, Debug)]
pub struct Reference {
    scene: Scene,
    options: ReferenceOptions,
}

impl Reference {
    /// The method for the sources of a scene.
    pub fn new(scene: Scene, options: ReferenceOptions) -> Self {
        Self { scene, options }
    }

    fn cut(&self, spec: &SourceSpec, signal: &Signal, frames: usize) -> Cut {
        let domain = DomainSamples::new(spec, signal, frames);
        if self.options.positions == PositionMode::PerPair {
            return Cut { sets: Vec::new(), domain: Some(domain) };
        }
        let draw = |repetition| {
            SampleSet::new(&domain.at(&self.positions(spec, domain.extent(), repetition, None)))
        };
        Cut { sets: (0..self.options.repetitions).map(draw).collect(), domain: None }
    }

    fn cut_of(
        &self,
        trial: &PreparedTrial,
        spec: &SourceSpec,
        frames: usize,
    ) -> Result<Arc<Cut>, RecogniseError> {
        trial.at_length(&spec.id, frames, |signal| self.cut(spec, signal, frames))
    }

    fn positions(
        &self,
        spec: &SourceSpec,
        extent: Extent,
        repetition: usize,
        pair: Option<(u64, u64)>,
    ) -> Positions {
        let ReferenceOptions { samples, seed, .. } = self.options;
        keyed_positions(&spec.id, extent, samples, seed, repetition, pair)
    }

    fn query_source<'a>(&self, spec: &SourceSpec, cut: &'a Cut) -> QuerySource<'a> {
        let set_up = |set| QuerySet::new(set, spec.align_mean, spec.sigma, self.options.precision);
        QuerySource { cut, sets: cut.sets.iter().map(set_up).collect() }
    }

    /// Mean score over repetitions of one source, between a query and a library trial.
    fn source_score(
        &self,
        spec: &SourceSpec,
        query: &QuerySource<'_>,
        y: &Cut,
        contents: (u64, u64),
    ) -> f64 {
        let mut scratch = Lanes::default();
        let scores: f64 = (0..self.options.repetitions)
            .map(|r| match (&query.cut.domain, &y.domain) {
                (Some(z_domain), Some(y_domain)) => {
                    let at = self.positions(spec, z_domain.extent(), r, Some(contents));
                    let z = SampleSet::new(&z_domain.at(&at));
                    let y = SampleSet::new(&y_domain.at(&at));
                    QuerySet::new(&z, spec.align_mean, spec.sigma, self.options.precision)
                        .score(&y, &mut scratch)
                }
                _ => query.sets[r].score(&y.sets[r], &mut scratch),
            })
            .sum();
        scores / self.options.repetitions as f64 + spec.score_offset
    }

    /// ln of each source's score of a library trial; sources that only one side has are `None`.
    fn log_scores(
        &self,
        query: &PreparedTrial,
        sources: &[&SourceSpec],
        at_length: &[BTreeMap<usize, QuerySource<'_>>],
        trial: &PreparedTrial,
    ) -> Result<Vec<Option<f64>>, RecogniseError> {
        let contents = (query.content(), trial.content());
        let mut scores = Vec::with_capacity(sources.len());
        for (spec, lengths) in sources.iter().zip(at_length) {
            let Some(frames) = query.common_frames(trial, &spec.id) else {
                scores.push(None);
                continue;
            };
            let cut = self.cut_of(trial, spec, frames)?;
            scores.push(Some(log_score(self.source_score(
                spec,
                &lengths[&frames],
                &cut,
                contents,
            ))));
        }
        Ok(scores)
    }
}

/// A query's source at one length, set up for comparison.
struct QuerySource<'a> {
    cut: &'a Cut,
    sets: Vec<QuerySet<'a>>,
}

impl Method for Reference {
    type Prepared = PreparedTrial;
    type Model = Vec<Arc<PreparedTrial>>;

    fn name(&self) -> &'static str {
        "reference"
    }

    fn prepare(&self, entry: &Entry, trial: &Trial) -> Result<PreparedTrial, RecogniseError> {
        PreparedTrial::new(entry, trial, &self.scene, |spec, signal, frames| {
            self.cut(spec, signal, frames)
        })
    }

    fn fit(&self, library: Vec<Arc<PreparedTrial>>) -> Result<Self::Model, RecogniseError> {
        let surfaces: std::collections::BTreeSet<_> =
            library.iter().map(|trial| &trial.key().surface).collect();
        if surfaces.len() < 2 {
            let (surfaces, trials) = (surfaces.len(), library.len());
            return Err(RecogniseError::TooFewSurfaces { surfaces, trials });
        }
        Ok(library)
    }

    fn rank(&self, model: &Self::Model, query: &PreparedTrial) -> Result<Ranking, RecogniseError> {
        let sources = shared_sources(&self.scene, query, model)?;

        // The query at every length that some library trial asks for; nearly always one a source.
        let mut cuts: Vec<BTreeMap<usize, Arc<Cut>>> = Vec::new();
        for spec in &sources {
            let mut of_source = BTreeMap::new();
            for frames in model.iter().filter_map(|y| query.common_frames(y, &spec.id)) {
                if let std::collections::btree_map::Entry::Vacant(slot) = of_source.entry(frames) {
                    slot.insert(self.cut_of(query, spec, frames)?);
                }
            }
            cuts.push(of_source);
        }
        let at_length: Vec<BTreeMap<usize, QuerySource<'_>>> = (sources.iter().zip(&cuts))
            .map(|(spec, cuts)| {
                let ready =
                    cuts.iter().map(|(&frames, cut)| (frames, self.query_source(spec, cut)));
                ready.collect()
            })
            .collect();

        let scores: Vec<Vec<Option<f64>>> = model
            .par_iter()
            .map(|trial| self.log_scores(query, &sources, &at_length, trial))
            .collect::<Result<_, _>>()?;
        let candidates = combine(&sources, &scores, model);
        let ids = sources.iter().map(|spec| spec.id.clone()).collect();
        // There is a candidate: some library trial shares a source, as checked above.
        Ok(rank(candidates, self.options.neighbours, ids).expect("at least one candidate"))
    }
}

/// Eq. 9 in log space. A source that a library trial lacks counts as the median of the others, so
/// that lacking one is neither an advantage nor a disadvantage; trials without any are left out.
fn combine(
    sources: &[&SourceSpec],
    scores: &[Vec<Option<f64>>],
    model: &[Arc<PreparedTrial>],
) -> Vec<Candidate> {
    let medians: Vec<f64> = (0..sources.len())
        .map(|s| {
            let mut known: Vec<f64> = scores.iter().filter_map(|of_trial| of_trial[s]).collect();
            known.sort_by(f64::total_cmp);
            known.get(known.len() / 2).copied().unwrap_or(0.0)
        })
        .collect();
    (scores.iter().zip(model))
        .filter(|(of_trial, _)| of_trial.iter().any(Option::is_some))
        .map(|(of_trial, trial)| {
            let terms = of_trial.iter().zip(&medians).zip(sources);
            let log_ds =
                terms.map(|((score, median), spec)| spec.weight * score.unwrap_or(*median));
            Candidate { key: trial.key().clone(), log_ds: log_ds.sum() }
        })
        .collect()
}
