//! The paper's method, exactly (method §2): raw samples, n·MMD²_b a source, product over sources,
//! nearest neighbour.
//!
//! [`ReferenceOptions`] has the shortcuts that do not change it, or do so within a stated bound:
//! positions shared over the library, sums K(z, z) once a query and K(y, y) from a table, both
//! within 1e-4 of a score ([`Precision`]), and, where asked for, successive halving. Results depend
//! neither on the number of threads nor on the library's order.

mod domain;
mod halving;
mod prepared_trial;
mod sample_set;
mod sampling;
mod score;
mod storage;

pub use domain::DomainSamples;
pub use halving::{STAGES, Stage};
pub use prepared_trial::PreparedTrial;
pub(super) use prepared_trial::{Cut, shared_sources};
pub use sample_set::{SampleSet, Scratch};
pub(super) use sampling::keyed_positions;
pub use sampling::{Extent, IMAGE_COLS, IMAGE_ROWS, Positions, draw_positions, image_grid};
pub use score::{
    Precision, QuerySet, SCORE_FLOOR, SampleScore, log_score, score_samples, score_sets,
};

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

use rayon::prelude::*;

use self::storage::VERSION;
use super::checks::check_surfaces;
use super::error::RecogniseError;
use super::method::Method;
use super::rank::{Candidate, Ranking, rank};
use crate::kernel::{FOLD, NODES};
use crate::library::Entry;
use crate::scene::{Scene, SourceSpec};
use crate::seed;
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
    /// Tabulate K(y, y) of library trials over σ: dearer to prepare, cheaper to compare with.
    pub tabulate: bool,
    /// Stages of successive halving, in order; none compares every trial by all repetitions.
    pub halving: Vec<Stage>,
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
            tabulate: true,
            halving: Vec::new(),
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

    fn prepared(
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

    fn cut(&self, spec: &SourceSpec, signal: &Signal, frames: usize, tabulate: bool) -> Cut {
        let domain = DomainSamples::new(spec, signal, frames);
        if self.options.positions == PositionMode::PerPair {
            return Cut { sets: Vec::new(), domain: Some(domain) };
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
        Cut { sets, domain: None }
    }

    fn cut_of(
        &self,
        trial: &PreparedTrial,
        spec: &SourceSpec,
        frames: usize,
    ) -> Result<Arc<Cut>, RecogniseError> {
        trial.at_length(&spec.id, frames, |signal| self.cut(spec, signal, frames, false))
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
        let precision = self.options.precision;
        let set_up = |set| QuerySet::new(set, spec.align_mean, precision, true);
        QuerySource { cut, sets: cut.sets.par_iter().map(set_up).collect() }
    }

    /// Sum of the scores of one source over some repetitions, between a query and a library trial.
    fn source_score(
        &self,
        spec: &SourceSpec,
        query: &QuerySource<'_>,
        y: &Cut,
        contents: (u64, u64),
        repetitions: Range<usize>,
    ) -> f64 {
        let mut scratch = Scratch::default();
        repetitions
            .map(|r| match (&query.cut.domain, &y.domain) {
                (Some(z_domain), Some(y_domain)) => {
                    let at = self.positions(spec, z_domain.extent(), r, Some(contents));
                    let z = SampleSet::new(&z_domain.at(&at), spec.sigma);
                    // The σ of y is asked for nowhere.
                    let y = SampleSet::new(&y_domain.at(&at), Some(1.0));
                    QuerySet::new(&z, spec.align_mean, self.options.precision, false)
                        .score(&y, &mut scratch)
                }
                _ => query.sets[r].score(&y.sets[r], &mut scratch),
            })
            .sum()
    }

    /// Adds each source's scores of a library trial over some repetitions; sources that only one
    /// side has are `None`.
    fn add_scores(
        &self,
        comparison: &Comparing<'_>,
        trial: &PreparedTrial,
        sums: &[Option<f64>],
        repetitions: Range<usize>,
    ) -> Result<Vec<Option<f64>>, RecogniseError> {
        let Comparing { query, sources, at_length } = comparison;
        let contents = (query.content(), trial.content());
        let mut all = Vec::with_capacity(sources.len());
        for (s, (spec, lengths)) in sources.iter().zip(at_length).enumerate() {
            let Some(frames) = query.common_frames(trial, &spec.id) else {
                all.push(None);
                continue;
            };
            let cut = self.cut_of(trial, spec, frames)?;
            let reps = repetitions.clone();
            let sum = self.source_score(spec, &lengths[&frames], &cut, contents, reps);
            all.push(Some(sum + sums.get(s).copied().flatten().unwrap_or(0.0)));
        }
        Ok(all)
    }

    /// The stages to go through; the last one keeps what it has.
    fn stages(&self, trials: usize) -> Vec<Stage> {
        let ReferenceOptions { repetitions, neighbours, halving, .. } = &self.options;
        let mut stages: Vec<Stage> = Vec::new();
        for stage in halving {
            let so_far = stages.last().map_or((0, trials), |s| (s.repetitions, s.keep));
            let keep = stage.keep.max(*neighbours).max(2);
            if so_far.0 < stage.repetitions && stage.repetitions < *repetitions && keep < so_far.1 {
                stages.push(Stage { repetitions: stage.repetitions, keep });
            }
        }
        stages.push(Stage { repetitions: *repetitions, keep: trials });
        stages
    }
}

/// A query's source at one length, set up for comparison.
struct QuerySource<'a> {
    cut: &'a Cut,
    sets: Vec<QuerySet<'a>>,
}

/// A query, and the sources it shares with a library, each at every length that is asked for.
struct Comparing<'a> {
    query: &'a PreparedTrial,
    sources: Vec<&'a SourceSpec>,
    at_length: Vec<BTreeMap<usize, QuerySource<'a>>>,
}

impl Method for Reference {
    type Prepared = PreparedTrial;
    type Model = Vec<Arc<PreparedTrial>>;

    fn name(&self) -> &'static str {
        "reference"
    }

    fn prepare(&self, entry: &Entry, trial: &Trial) -> Result<PreparedTrial, RecogniseError> {
        self.prepared(entry, trial, false)
    }

    fn prepare_for_library(
        &self,
        entry: &Entry,
        trial: &Trial,
    ) -> Result<PreparedTrial, RecogniseError> {
        let ReferenceOptions { tabulate, precision, .. } = self.options;
        self.prepared(entry, trial, tabulate && precision == Precision::Fast)
    }

    fn storage_key(&self) -> Option<u64> {
        let ReferenceOptions { samples, repetitions, positions, seed, precision, tabulate, .. } =
            self.options;
        if positions == PositionMode::PerPair {
            // Prepared trials then are as large as the recordings.
            return None;
        }
        let sources: Vec<_> = self.scene.sources().collect();
        let said = format!(
            "{VERSION} {samples} {repetitions} {seed} {precision:?} {tabulate} {NODES} {FOLD} \
             {sources:?}"
        );
        Some(seed::stable_hash(&[self.name().as_bytes(), said.as_bytes()]))
    }

    fn store(&self, prepared: &PreparedTrial) -> Vec<u8> {
        storage::encode(prepared)
    }

    fn restore(&self, entry: &Entry, bytes: &[u8]) -> Option<PreparedTrial> {
        storage::decode(entry, bytes)
    }

    fn fit(&self, library: Vec<Arc<PreparedTrial>>) -> Result<Self::Model, RecogniseError> {
        check_surfaces(library.iter().map(|trial| trial.key()))?;
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
        let at_length = (sources.par_iter().zip(&cuts))
            .map(|(spec, cuts)| {
                let ready =
                    cuts.iter().map(|(&frames, cut)| (frames, self.query_source(spec, cut)));
                ready.collect()
            })
            .collect();
        let comparison = Comparing { query, sources, at_length };

        let mut alive: Vec<Scored> = (model.iter())
            .map(|trial| Scored { trial: Arc::clone(trial), sums: Vec::new() })
            .collect();
        let mut medians = Vec::new();
        let mut dropped = Vec::new();
        let mut done = 0;
        for stage in self.stages(model.len()) {
            alive = alive
                .into_par_iter()
                .map(|Scored { trial, sums }| {
                    let reps = done..stage.repetitions;
                    let sums = self.add_scores(&comparison, &trial, &sums, reps)?;
                    Ok::<_, RecogniseError>(Scored { trial, sums })
                })
                .collect::<Result<_, _>>()?;
            done = stage.repetitions;
            alive.retain(|scored| scored.sums.iter().any(Option::is_some));
            let scores: Vec<_> =
                alive.iter().map(|scored| scored.log_scores(&comparison.sources, done)).collect();
            if medians.is_empty() {
                medians = medians_of(comparison.sources.len(), &scores);
            }
            let candidates = combine(&comparison.sources, &scores, &medians, &alive);
            if stage.repetitions == self.options.repetitions {
                let ids = comparison.sources.iter().map(|spec| spec.id.clone()).collect();
                // There is a candidate: some library trial shares a source, as checked above.
                let mut ranking =
                    rank(candidates, self.options.neighbours, ids).expect("at least one candidate");
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
}

/// A library trial and the sums of its sources' scores so far.
struct Scored {
    trial: Arc<PreparedTrial>,
    sums: Vec<Option<f64>>,
}

impl Scored {
    /// ln of each source's mean score over so many repetitions.
    fn log_scores(&self, sources: &[&SourceSpec], repetitions: usize) -> Vec<Option<f64>> {
        let mean = |(sum, spec): (&Option<f64>, &&SourceSpec)| {
            sum.map(|sum| log_score(sum / repetitions as f64 + spec.score_offset))
        };
        self.sums.iter().zip(sources).map(mean).collect()
    }
}

/// The median over a library of each source's score.
fn medians_of(sources: usize, scores: &[Vec<Option<f64>>]) -> Vec<f64> {
    let median = |s: usize| {
        let mut known: Vec<f64> = scores.iter().filter_map(|of_trial| of_trial[s]).collect();
        known.sort_by(f64::total_cmp);
        known.get(known.len() / 2).copied().unwrap_or(0.0)
    };
    (0..sources).map(median).collect()
}

/// Eq. 9 in log space. A source that a library trial lacks counts as the median of the others
/// (with halving, of their first stage), so that lacking one is neither an advantage nor a
/// disadvantage.
fn combine(
    sources: &[&SourceSpec],
    scores: &[Vec<Option<f64>>],
    medians: &[f64],
    alive: &[Scored],
) -> Vec<Candidate> {
    (scores.iter().zip(alive))
        .map(|(of_trial, scored)| {
            let terms = of_trial.iter().zip(medians).zip(sources);
            let log_ds =
                terms.map(|((score, median), spec)| spec.weight * score.unwrap_or(*median));
            Candidate { key: scored.trial.key().clone(), log_ds: log_ds.sum() }
        })
        .collect()
}
