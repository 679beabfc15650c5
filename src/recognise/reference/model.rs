//! Compares queries with a library, trial by trial and repetition by repetition.

use std::collections::btree_map::Entry as Slot;
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::sync::Arc;

use rayon::prelude::*;

use super::domain::DomainSamples;
use super::prepared_trial::{PreparedTrial, SampledSource, shared_sources};
use super::sample_set::{SampleSet, Scratch};
use super::sampling::{DomainExtent, Positions, keyed_positions};
use super::score::{QuerySet, log_score};
use super::{NAME, PositionMode, ReferenceOptions, halving};
use crate::library::Entry;
use crate::recognise::error::RecogniseError;
use crate::recognise::method::{Evidence, Model, SourceEvidence};
use crate::recognise::prepared::Prepared;
use crate::recognise::rank::{Ranking, TrialScores, candidates, log_discrepancy, medians, rank};
use crate::scene::{Scene, SourceSpec};
use crate::trial::{Signal, Trial};

/// A library, ready to be compared with.
pub struct ReferenceModel {
    pub(super) sampler: Sampler,
    pub(super) library: Vec<Arc<PreparedTrial>>,
}

impl Model for ReferenceModel {
    fn prepare(&self, entry: &Entry, trial: &Trial) -> Result<Prepared, RecogniseError> {
        Ok(Prepared::Samples(Arc::new(self.sampler.sampled(entry, trial, false)?)))
    }

    fn rank(&self, query: &Prepared) -> Result<Ranking, RecogniseError> {
        let options = &self.sampler.options;
        let query = self.query(query)?;
        let comparison = QueryComparison::new(&self.sampler, &query);
        let weights = comparison.weights();
        let mut alive = comparison.all(&self.library);
        let mut medians_of_all = Vec::new();
        let mut dropped = Vec::new();
        for stage in options.stages(self.library.len()) {
            alive = comparison.go_on(alive, stage.repetitions)?;
            alive.retain(|scored| scored.sums.iter().any(Option::is_some));
            let scores: Vec<TrialScores> =
                alive.iter().map(|scored| comparison.log_scores(scored)).collect();
            if medians_of_all.is_empty() {
                // With halving, the medians are those of the first stage.
                medians_of_all = medians(weights.len(), &scores);
            }
            let keys = alive.iter().map(|scored| scored.trial.key());
            let candidates = candidates(&weights, &scores, &medians_of_all, keys);
            if stage.repetitions == options.repetitions {
                let ids = query.sources.iter().map(|spec| spec.id.clone()).collect();
                // There is a candidate: some library trial shares a source, as `query` checked.
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
        let query = self.query(query)?;
        let comparison = QueryComparison::new(&self.sampler, &query);
        let repetitions = self.sampler.options.repetitions;
        let all = comparison.go_on(comparison.all(&self.library), repetitions)?;
        let surfaces: BTreeSet<&str> =
            self.library.iter().map(|trial| trial.key().surface.as_str()).collect();
        let surfaces: Vec<String> = surfaces.into_iter().map(String::from).collect();
        let mut terms = vec![vec![f64::INFINITY; surfaces.len()]; query.sources.len()];
        for scored in &all {
            // Found: the list was made of these trials' labels.
            let at = surfaces.partition_point(|surface| *surface < scored.trial.key().surface);
            let scores = comparison.log_scores(scored);
            for ((terms, score), spec) in terms.iter_mut().zip(scores).zip(&query.sources) {
                let term = score.map_or(f64::INFINITY, |score| spec.weight * score);
                terms[at] = terms[at].min(term);
            }
        }
        let evidence = |(spec, terms): (&&SourceSpec, Vec<f64>)| SourceEvidence {
            source: spec.id.clone(),
            terms,
        };
        let sources = query.sources.iter().zip(terms).map(evidence).collect();
        Ok(Some(Evidence { surfaces, sources }))
    }
}

impl ReferenceModel {
    /// ln of the discrepancy score of each of the library's trials, in the library's order, by all
    /// repetitions; `None` for a trial that shares no source with the query.
    ///
    /// # Errors
    /// As [`Model::rank`].
    pub fn log_scores(&self, query: &Prepared) -> Result<Vec<Option<f64>>, RecogniseError> {
        let query = self.query(query)?;
        let comparison = QueryComparison::new(&self.sampler, &query);
        let repetitions = self.sampler.options.repetitions;
        let all = comparison.go_on(comparison.all(&self.library), repetitions)?;
        let scores: Vec<TrialScores> =
            all.iter().map(|scored| comparison.log_scores(scored)).collect();
        let weights = comparison.weights();
        let medians = medians(weights.len(), &scores);
        Ok(scores.iter().map(|scores| log_discrepancy(&weights, scores, &medians)).collect())
    }

    /// A query, cut to every length at which it is compared with a library trial.
    fn query<'a>(&'a self, query: &'a Prepared) -> Result<ReferenceQuery<'a>, RecogniseError> {
        let query = query.samples(NAME)?;
        let sources = shared_sources(&self.sampler.scene, query, &self.library)?;
        // Nearly always a source has only one length.
        let mut cuts: Vec<BTreeMap<usize, Arc<SampledSource>>> = Vec::new();
        for spec in &sources {
            let mut of_source = BTreeMap::new();
            for frames in self.library.iter().filter_map(|y| query.common_frames(y, &spec.id)) {
                if let Slot::Vacant(slot) = of_source.entry(frames) {
                    slot.insert(self.sampler.cut_of(query, spec, frames)?);
                }
            }
            cuts.push(of_source);
        }
        Ok(ReferenceQuery { trial: query, sources, cuts })
    }
}

/// A query, and the sources it shares with a library, each at every length that is compared.
struct ReferenceQuery<'a> {
    trial: &'a PreparedTrial,
    sources: Vec<&'a SourceSpec>,
    cuts: Vec<BTreeMap<usize, Arc<SampledSource>>>,
}

/// A query's source at one length, set up for comparison.
struct QuerySource<'a> {
    cut: &'a SampledSource,
    sets: Vec<QuerySet<'a>>,
}

struct QueryComparison<'a> {
    sampler: &'a Sampler,
    query: &'a ReferenceQuery<'a>,
    at_length: Vec<BTreeMap<usize, QuerySource<'a>>>,
}

impl<'a> QueryComparison<'a> {
    fn new(sampler: &'a Sampler, query: &'a ReferenceQuery<'a>) -> Self {
        let precision = sampler.options.precision;
        let of_cut = |spec: &SourceSpec, cut: &'a Arc<SampledSource>| {
            let set_up = |set| QuerySet::new(set, spec.align_mean, precision);
            QuerySource { cut, sets: cut.sets.par_iter().map(set_up).collect() }
        };
        let at_length = (query.sources.par_iter().zip(&query.cuts))
            .map(|(spec, cuts)| cuts.iter().map(|(&n, cut)| (n, of_cut(spec, cut))).collect())
            .collect();
        Self { sampler, query, at_length }
    }

    /// Sum of the scores of one source over some repetitions, between a query and a library trial.
    fn source_score(
        &self,
        spec: &SourceSpec,
        query: &QuerySource<'_>,
        y: &SampledSource,
        contents: (u64, u64),
        repetitions: Range<usize>,
    ) -> f64 {
        let mut scratch = Scratch::default();
        repetitions
            .map(|r| match (&query.cut.domain, &y.domain) {
                (Some(z_domain), Some(y_domain)) => {
                    let at = self.sampler.positions(spec, z_domain.extent(), r, Some(contents));
                    let z = SampleSet::new(&z_domain.at(&at), spec.sigma);
                    // The σ of y is never used.
                    let y = SampleSet::new(&y_domain.at(&at), Some(1.0));
                    QuerySet::new(&z, spec.align_mean, self.sampler.options.precision)
                        .score(&y, &mut scratch)
                }
                _ => query.sets[r].score(&y.sets[r], &mut scratch),
            })
            .sum()
    }

    /// Adds the scores of a library trial over more repetitions to `sums`, source by source; `None`
    /// for a source that the query or the trial lacks.
    fn add_scores(
        &self,
        trial: &PreparedTrial,
        sums: &[Option<f64>],
        repetitions: Range<usize>,
    ) -> Result<Vec<Option<f64>>, RecogniseError> {
        let ReferenceQuery { trial: query, sources, .. } = self.query;
        let contents = (query.content(), trial.content());
        let mut all = Vec::with_capacity(sources.len());
        for (s, (spec, lengths)) in sources.iter().zip(&self.at_length).enumerate() {
            let Some(frames) = query.common_frames(trial, &spec.id) else {
                all.push(None);
                continue;
            };
            let cut = self.sampler.cut_of(trial, spec, frames)?;
            let reps = repetitions.clone();
            let sum = self.source_score(spec, &lengths[&frames], &cut, contents, reps);
            all.push(Some(sum + sums.get(s).copied().flatten().unwrap_or(0.0)));
        }
        Ok(all)
    }

    fn weights(&self) -> Vec<f64> {
        self.query.sources.iter().map(|spec| spec.weight).collect()
    }

    /// The library's trials, without scores.
    fn all(&self, library: &[Arc<PreparedTrial>]) -> Vec<Scored> {
        let scored = |trial: &Arc<PreparedTrial>| Scored {
            trial: trial.clone(),
            sums: Vec::new(),
            repetitions: 0,
        };
        library.iter().map(scored).collect()
    }

    /// Adds the scores of `trials` up to `until` repetitions.
    fn go_on(&self, trials: Vec<Scored>, until: usize) -> Result<Vec<Scored>, RecogniseError> {
        let add = |Scored { trial, sums, repetitions }: Scored| {
            let sums = self.add_scores(&trial, &sums, repetitions..until)?;
            Ok(Scored { trial, sums, repetitions: until })
        };
        trials.into_par_iter().map(add).collect()
    }

    /// ln of each source's mean score so far.
    fn log_scores(&self, scored: &Scored) -> TrialScores {
        let mean = |(sum, spec): (&Option<f64>, &&SourceSpec)| {
            sum.map(|sum| log_score(sum / scored.repetitions as f64 + spec.score_offset))
        };
        scored.sums.iter().zip(&self.query.sources).map(mean).collect()
    }
}

/// A library trial, and the sums of its sources' scores over the repetitions so far.
struct Scored {
    trial: Arc<PreparedTrial>,
    sums: Vec<Option<f64>>,
    repetitions: usize,
}

/// A scene, and how its sources are sampled.
#[derive(Clone, Debug)]
pub struct Sampler {
    pub scene: Scene,
    pub options: ReferenceOptions,
}

impl Sampler {
    /// A trial, sampled; `tabulate` prepares it for many comparisons.
    pub fn sampled(
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

    /// A source of a trial, cut to `frames`.
    pub fn cut_of(
        &self,
        trial: &PreparedTrial,
        spec: &SourceSpec,
        frames: usize,
    ) -> Result<Arc<SampledSource>, RecogniseError> {
        trial.at_length(&spec.id, frames, |signal| self.cut(spec, signal, frames, false))
    }

    /// The positions of one repetition; `pair` as in [`keyed_positions`].
    pub fn positions(
        &self,
        spec: &SourceSpec,
        extent: DomainExtent,
        repetition: usize,
        pair: Option<(u64, u64)>,
    ) -> Positions {
        let ReferenceOptions { samples, seed, .. } = self.options;
        keyed_positions(&spec.id, extent, samples, seed, repetition, pair)
    }
}
