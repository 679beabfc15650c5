//! Compares queries with a library, trial by trial and repetition by repetition.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry as Slot;
use std::ops::Range;
use std::sync::Arc;

use rayon::prelude::*;

use super::prepared_trial::{PreparedTrial, SampledSource, shared_sources};
use super::sample_set::{SampleSet, Scratch};
use super::sampling::{DomainExtent, DomainSamples, keyed_positions};
use super::score::{QuerySet, log_score};
use super::{NAME, PositionMode, Reference, ReferenceOptions, halving};
use crate::library::Entry;
use crate::recognise::embedding::labels::places;
use crate::recognise::error::RecogniseError;
use crate::recognise::method::{Evidence, Model, SourceEvidence};
use crate::recognise::prepared::Prepared;
use crate::recognise::rank::{Ranking, TrialScores, candidates, log_discrepancy, medians, rank};
use crate::scene::SourceSpec;
use crate::trial::{Signal, Trial};

/// A library prepared for comparison with queries.
pub struct ReferenceModel {
    pub(super) method: Reference,
    pub(super) library: Vec<Arc<PreparedTrial>>,
}

impl Model for ReferenceModel {
    fn prepare(&self, entry: &Entry, trial: &Trial) -> Result<Prepared, RecogniseError> {
        Ok(Prepared::Samples(Arc::new(self.method.sampled(entry, trial, false)?)))
    }

    fn rank(&self, query: &Prepared) -> Result<Ranking, RecogniseError> {
        let options = &self.method.options;
        let cuts = self.cuts(query)?;
        let comparison = QueryComparison::new(&self.method, &cuts);
        let weights = comparison.weights();
        let mut alive = self.unscored();
        let mut medians_of_all = Vec::new();
        let mut dropped = Vec::new();
        let mut done = 0;
        for stage in options.stages(self.library.len()) {
            alive = comparison.go_on(alive, done..stage.repetitions)?;
            done = stage.repetitions;
            alive.retain(|(_, sums)| sums.iter().any(Option::is_some));
            let scores = comparison.log_scores(&alive, done);
            if medians_of_all.is_empty() {
                // With halving, the medians are over all trials, after the first stage.
                medians_of_all = medians(weights.len(), &scores);
            }
            let keys = alive.iter().map(|(trial, _)| trial.key());
            let candidates = candidates(&weights, &scores, &medians_of_all, keys);
            if done == options.repetitions {
                let ids = cuts.sources.iter().map(|(spec, _)| spec.id.clone()).collect();
                // There is a candidate, since `cuts` checked that a library trial shares a source.
                let mut ranking =
                    rank(candidates, options.neighbours, ids).expect("at least one candidate");
                halving::append(&mut ranking, dropped);
                return Ok(ranking);
            }
            let all = candidates.into_iter().zip(alive).collect();
            let (stay, out) = halving::split(all, stage.keep);
            alive = stay;
            dropped.push(out);
        }
        unreachable!("the last stage has all repetitions")
    }

    fn explain(&self, query: &Prepared) -> Result<Option<Evidence>, RecogniseError> {
        let cuts = self.cuts(query)?;
        let scores = self.all_scores(&cuts)?;
        let (surfaces, class) =
            places(self.library.iter().map(|trial| trial.key().surface.as_str()));
        let mut sources: Vec<SourceEvidence> = (cuts.sources.iter())
            .map(|(spec, _)| SourceEvidence {
                source: spec.id.clone(),
                terms: vec![f64::INFINITY; surfaces.len()],
            })
            .collect();
        for (class, scores) in class.into_iter().zip(scores) {
            for ((evidence, score), (spec, _)) in sources.iter_mut().zip(scores).zip(&cuts.sources)
            {
                let term = score.map_or(f64::INFINITY, |score| spec.weight * score);
                evidence.terms[class] = evidence.terms[class].min(term);
            }
        }
        let surfaces = surfaces.into_iter().map(String::from).collect();
        Ok(Some(Evidence { surfaces, sources }))
    }
}

impl ReferenceModel {
    /// ln of the discrepancy score of each library trial after all repetitions, in the library's
    /// order; `None` for a trial that shares no source with the query.
    ///
    /// # Errors
    /// The errors of [`Model::rank`].
    pub fn log_scores(&self, query: &Prepared) -> Result<Vec<Option<f64>>, RecogniseError> {
        let cuts = self.cuts(query)?;
        let scores = self.all_scores(&cuts)?;
        let weights: Vec<f64> = cuts.sources.iter().map(|(spec, _)| spec.weight).collect();
        let medians = medians(weights.len(), &scores);
        Ok(scores.iter().map(|scores| log_discrepancy(&weights, scores, &medians)).collect())
    }

    /// ln of the scores of each library trial by each source, after all repetitions.
    fn all_scores(&self, cuts: &QueryCuts<'_>) -> Result<Vec<TrialScores>, RecogniseError> {
        let comparison = QueryComparison::new(&self.method, cuts);
        let repetitions = self.method.options.repetitions;
        let all = comparison.go_on(self.unscored(), 0..repetitions)?;
        Ok(comparison.log_scores(&all, repetitions))
    }

    /// Cuts a query to each length at which it is compared with a library trial.
    fn cuts<'a>(&'a self, query: &'a Prepared) -> Result<QueryCuts<'a>, RecogniseError> {
        let trial = query.samples(NAME)?;
        // Nearly always, all comparisons of a source are at the same length.
        let mut sources = Vec::new();
        for spec in shared_sources(&self.method.scene, trial, &self.library)? {
            let mut of_source = BTreeMap::new();
            for frames in self.library.iter().filter_map(|y| trial.common_frames(y, &spec.id)) {
                if let Slot::Vacant(slot) = of_source.entry(frames) {
                    slot.insert(self.method.cut_of(trial, spec, frames)?);
                }
            }
            sources.push((spec, of_source));
        }
        Ok(QueryCuts { trial, sources })
    }

    fn unscored(&self) -> Vec<Scored> {
        self.library.iter().map(|trial| (trial.clone(), Vec::new())).collect()
    }
}

/// A query, and the sources that it shares with a library, each cut to all lengths needed.
struct QueryCuts<'a> {
    trial: &'a PreparedTrial,
    sources: Vec<(&'a SourceSpec, BTreeMap<usize, Arc<SampledSource>>)>,
}

/// One source of a query, cut to one length and prepared for comparison.
type QuerySource<'a> = (&'a SampledSource, Vec<QuerySet<'a>>);

/// A library trial, and for each source the sum of its scores over the repetitions so far; `None` for
/// a source that the query or the trial lacks.
type Scored = (Arc<PreparedTrial>, Vec<Option<f64>>);

struct QueryComparison<'a> {
    method: &'a Reference,
    query: &'a PreparedTrial,
    sources: Vec<(&'a SourceSpec, BTreeMap<usize, QuerySource<'a>>)>,
}

impl<'a> QueryComparison<'a> {
    fn new(method: &'a Reference, query: &'a QueryCuts<'a>) -> Self {
        let of_cut = |spec: &SourceSpec, cut: &'a SampledSource| -> QuerySource<'a> {
            let set_up = |set| QuerySet::new(set, spec.align_mean, method.options.precision);
            (cut, cut.sets.par_iter().map(set_up).collect())
        };
        let sources = (query.sources.par_iter())
            .map(|(spec, cuts)| {
                (*spec, cuts.iter().map(|(&n, cut)| (n, of_cut(spec, cut))).collect())
            })
            .collect();
        Self { method, query: query.trial, sources }
    }

    /// Sum of the scores between a query and a library trial over some repetitions, for one source.
    fn source_score(
        &self,
        spec: &SourceSpec,
        (query, sets): &QuerySource<'_>,
        y: &SampledSource,
        contents: (u64, u64),
        repetitions: Range<usize>,
    ) -> f64 {
        let mut scratch = Scratch::default();
        repetitions
            .map(|r| match (&query.domain, &y.domain) {
                (Some(z_domain), Some(y_domain)) => {
                    let at = self.method.positions(spec, z_domain.extent(), r, Some(contents));
                    let z = SampleSet::new(&z_domain.at(&at), spec.sigma);
                    // The σ of y is never used, so it need not be computed.
                    let y = SampleSet::new(&y_domain.at(&at), Some(1.0));
                    QuerySet::new(&z, spec.align_mean, self.method.options.precision)
                        .score(&y, &mut scratch)
                }
                _ => sets[r].score(&y.sets[r], &mut scratch),
            })
            .sum()
    }

    fn go_on(
        &self,
        trials: Vec<Scored>,
        repetitions: Range<usize>,
    ) -> Result<Vec<Scored>, RecogniseError> {
        let add = |(trial, sums): Scored| {
            let contents = (self.query.content(), trial.content());
            let mut all = Vec::with_capacity(self.sources.len());
            for (s, (spec, lengths)) in self.sources.iter().enumerate() {
                let Some(frames) = self.query.common_frames(&trial, &spec.id) else {
                    all.push(None);
                    continue;
                };
                let cut = self.method.cut_of(&trial, spec, frames)?;
                let of_query = &lengths[&frames];
                let sum = self.source_score(spec, of_query, &cut, contents, repetitions.clone());
                all.push(Some(sum + sums.get(s).copied().flatten().unwrap_or(0.0)));
            }
            Ok((trial, all))
        };
        trials.into_par_iter().map(add).collect()
    }

    fn weights(&self) -> Vec<f64> {
        self.sources.iter().map(|(spec, _)| spec.weight).collect()
    }

    /// ln of the mean score over the repetitions so far, for each trial and source.
    fn log_scores(&self, scored: &[Scored], repetitions: usize) -> Vec<TrialScores> {
        let mean = |(sum, (spec, _)): (&Option<f64>, &(&SourceSpec, _))| {
            sum.map(|sum| log_score(sum / repetitions as f64 + spec.score_offset))
        };
        scored.iter().map(|(_, sums)| sums.iter().zip(&self.sources).map(mean).collect()).collect()
    }
}

impl Reference {
    /// Samples a trial; with `tabulate`, prepares it for many comparisons.
    pub(super) fn sampled(
        &self,
        entry: &Entry,
        trial: &Trial,
        tabulate: bool,
    ) -> Result<PreparedTrial, RecogniseError> {
        let per_pair = self.options.positions == PositionMode::PerPair;
        PreparedTrial::new(entry, trial, &self.scene, per_pair, |spec, signal, frames| {
            self.cut(spec, signal, frames, tabulate)
        })
    }

    fn cut(
        &self,
        spec: &SourceSpec,
        signal: &Signal,
        frames: usize,
        tabulate: bool,
    ) -> SampledSource {
        let domain = DomainSamples::new(spec, signal, frames);
        if self.options.positions == PositionMode::PerPair {
            return SampledSource { sets: Vec::new(), domain: Some(domain) };
        }
        let draw = |repetition| {
            let at = self.positions(spec, domain.extent(), repetition, None);
            let mut set = SampleSet::new(&domain.at(&at), spec.sigma);
            if tabulate {
                set.tabulate();
            }
            set
        };
        let sets = (0..self.options.repetitions).into_par_iter().map(draw).collect();
        SampledSource { sets, domain: None }
    }

    fn cut_of(
        &self,
        trial: &PreparedTrial,
        spec: &SourceSpec,
        frames: usize,
    ) -> Result<Arc<SampledSource>, RecogniseError> {
        trial.at_length(&spec.id, frames, |signal| self.cut(spec, signal, frames, false))
    }

    /// The positions of one repetition; see [`keyed_positions`] for `pair`.
    fn positions(
        &self,
        spec: &SourceSpec,
        extent: DomainExtent,
        repetition: usize,
        pair: Option<(u64, u64)>,
    ) -> Vec<usize> {
        let ReferenceOptions { samples, seed, .. } = self.options;
        keyed_positions(&spec.id, extent, samples, seed, repetition, pair)
    }
}
