//! The method `joint`: the kernel two-sample test on samples that keep where they came from.
//!
//! Samples are (frequency band, log-amplitude) for spectra, with log-amplitudes averaged over
//! blocks of about a quarter of a second; delay pairs for time series; neighbouring pixels for
//! images. The kernel is Gaussian in the value and compares samples of one band (of one channel
//! and lag, of one group of pixels) alone, δ_bb'·exp(−‖a − a'‖²/(2w²s²)), s the spread of the
//! library. MMD² is summed as 2·ḡ_yz − ḡ_yy − ḡ_zz with g = 1 − κ, which keeps its digits where
//! sums of κ would cancel. Nearest neighbour, ties as everywhere; w ∈ {1, 2, 4, 8} is the one that
//! names most left-out trials of the library.

use std::collections::BTreeMap;
use std::sync::Arc;

use rayon::prelude::*;

use super::framed::{
    Framed, FramedSource, FramedTrial, check_rates, nothing_in_common, sorted_library,
};
use super::grouped::{Grouped, WIDTHS, deficits};
use super::merge::{SourceScores, merge};
use super::rank::{Ranking, rank};
use super::scale::SourceScale;
use super::{Method, RecogniseError};
use crate::library::Entry;
use crate::scene::{Scene, SourceId, SourceSpec};
use crate::trial::Trial;

/// The least MMD² that enters a logarithm.
const FLOOR: f64 = 1e-9;

/// Index of the width that is used where the library has too few trials to choose: w = 4.
const DEFAULT_WIDTH: usize = 2;

/// Trials of every surface that a choice of the width takes.
const LEAST_TRIALS: usize = 3;

/// At most this many trials of a surface vote on the width.
const MOST_TRIALS: usize = 5;

/// The method `joint`.
#[derive(Clone, Debug)]
pub struct Joint {
    scene: Scene,
}

impl Joint {
    /// The method for the sources of a scene.
    pub fn new(scene: Scene) -> Self {
        Self { scene }
    }
}

/// A library, ready to be compared with.
pub struct JointModel {
    library: Vec<Arc<FramedTrial>>,
    sources: BTreeMap<SourceId, JointSource>,
}

struct JointSource {
    spec: SourceSpec,
    scale: SourceScale,
    trials: Vec<Option<Grouped>>,
    /// ḡ_yy of each trial, for each width.
    own: Vec<[f64; WIDTHS.len()]>,
    width: usize,
}

impl JointModel {
    /// The width w that was chosen for each source.
    pub fn widths(&self) -> impl Iterator<Item = (&SourceId, f64)> {
        self.sources.iter().map(|(id, source)| (id, WIDTHS[source.width]))
    }
}

impl JointSource {
    fn new(spec: &SourceSpec, library: &[Arc<FramedTrial>]) -> Option<Self> {
        let held: Vec<Option<&FramedSource>> =
            library.iter().map(|trial| trial.sources.get(&spec.id)).collect();
        let data: Vec<&Framed> = held.iter().flatten().map(|source| &source.data).collect();
        if data.is_empty() {
            return None;
        }
        let scale = Grouped::scale(&data, spec.align_mean);
        let group = |source: &Option<&FramedSource>| {
            source.map(|source| Grouped::new(&source.data, &scale, spec.align_mean))
        };
        let trials: Vec<Option<Grouped>> = held.par_iter().map(group).collect();
        let of_itself = |y: &Option<Grouped>| y.as_ref().map_or([0.0; 4], |y| deficits(y, y));
        let own = trials.par_iter().map(of_itself).collect();
        let mut source = Self { spec: spec.clone(), scale, trials, own, width: DEFAULT_WIDTH };
        source.width = source.best_width(library);
        Some(source)
    }

    /// MMD²_b against a library trial, for each width.
    fn mmd2(&self, z: &Grouped, own: &[f64; 4], trial: usize) -> Option<[f64; 4]> {
        let cross = deficits(z, self.trials[trial].as_ref()?);
        let of_width = |w: usize| (2.0 * cross[w] - own[w] - self.own[trial][w]).max(0.0);
        Some(std::array::from_fn(of_width))
    }

    /// The width that names most left-out trials; the smaller one of equals.
    fn best_width(&self, library: &[Arc<FramedTrial>]) -> usize {
        let mut rank_in_surface = vec![0; library.len()];
        for i in 1..library.len() {
            if library[i].key.surface == library[i - 1].key.surface {
                rank_in_surface[i] = rank_in_surface[i - 1] + 1;
            }
        }
        let mut with_source: BTreeMap<&str, usize> = BTreeMap::new();
        for (trial, samples) in library.iter().zip(&self.trials) {
            *with_source.entry(&trial.key.surface).or_default() += usize::from(samples.is_some());
        }
        if with_source.values().any(|&trials| trials < LEAST_TRIALS) {
            return DEFAULT_WIDTH;
        }
        let right: [usize; 4] = (0..library.len())
            .into_par_iter()
            .filter(|&i| rank_in_surface[i] < MOST_TRIALS)
            .filter_map(|i| self.named_right(library, i))
            .map(|right| right.map(usize::from))
            .reduce(|| [0; 4], |a, b| std::array::from_fn(|w| a[w] + b[w]));
        (0..right.len()).rev().max_by_key(|&w| right[w]).unwrap_or(DEFAULT_WIDTH)
    }

    /// Whether each width names trial `i` right, by the trials of other sessions.
    fn named_right(&self, library: &[Arc<FramedTrial>], i: usize) -> Option<[bool; 4]> {
        let (key, z) = (&library[i].key, self.trials[i].as_ref()?);
        let mut best = [(f64::INFINITY, false); 4];
        for (j, other) in library.iter().enumerate() {
            if (&other.key.user, other.key.number) == (&key.user, key.number) {
                continue;
            }
            let Some(mmd2) = self.mmd2(z, &self.own[i], j) else { continue };
            for (best, mmd2) in best.iter_mut().zip(mmd2) {
                if mmd2 < best.0 {
                    *best = (mmd2, other.key.surface == key.surface);
                }
            }
        }
        Some(best.map(|(_, right)| right))
    }

    /// ln(n·MMD²_b) against each library trial.
    fn log_scores(&self, query: &FramedSource) -> SourceScores {
        let z = Grouped::new(&query.data, &self.scale, self.spec.align_mean);
        let own = deficits(&z, &z);
        let n = z.samples() as f64;
        let score = |trial: usize| {
            let mmd2 = self.mmd2(&z, &own, trial)?[self.width];
            Some((n * mmd2.max(FLOOR)).ln())
        };
        (0..self.trials.len()).into_par_iter().map(score).collect()
    }
}

impl Method for Joint {
    type Prepared = FramedTrial;
    type Model = JointModel;

    fn name(&self) -> &'static str {
        "joint"
    }

    fn prepare(&self, entry: &Entry, trial: &Trial) -> Result<FramedTrial, RecogniseError> {
        FramedTrial::new(&entry.key, trial, &self.scene)
    }

    fn fit(&self, library: Vec<Arc<FramedTrial>>) -> Result<JointModel, RecogniseError> {
        let library = sorted_library(library)?;
        let source = |spec: &SourceSpec| Some((spec.id.clone(), JointSource::new(spec, &library)?));
        let sources = self.scene.sources().filter_map(source).collect();
        Ok(JointModel { library, sources })
    }

    fn rank(&self, model: &JointModel, query: &FramedTrial) -> Result<Ranking, RecogniseError> {
        let shared: Vec<(&JointSource, &FramedSource)> = (query.sources.iter())
            .filter_map(|(id, source)| Some((model.sources.get(id)?, source)))
            .collect();
        if shared.is_empty() {
            return Err(nothing_in_common(query, model.sources.keys()));
        }
        for (joint, source) in &shared {
            let id = &joint.spec.id;
            let like = model.library.iter().find_map(|t| Some((t.sources.get(id)?, &t.key)));
            if let Some((like, key)) = like {
                check_rates(id, source, like, key)?;
            }
        }
        let scores: Vec<(f64, SourceScores)> = (shared.iter())
            .map(|(joint, source)| (joint.spec.weight, joint.log_scores(source)))
            .collect();
        let ids = shared.iter().map(|(joint, _)| joint.spec.id.clone()).collect();
        // There is a candidate: some library trial has each source of the model.
        Ok(rank(merge(&scores, &model.library), 1, ids).expect("at least one candidate"))
    }
}
