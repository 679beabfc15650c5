//! The method `embedding` (`src/method/README.md` §4 and §5): puts all sources of a trial into one vector (`joint`),
//! and tells surfaces apart with many small shrinkage discriminants (`ensemble`).
//!
//! A trial comes as frames and sums, made by [`features`](crate::features). The vector holds Fourier
//! features of log-band frames (`view`): kernel mean embeddings, with MMD² as squared distance. It also
//! holds the moments, the quantiles and the lag covariance of each series (`series`). Pictures have the
//! same features, with tiles as frames (`picture`). Each feature occurs in *shape*, relative to the
//! recording's own level, and in *level*. The discriminants are trained on whole trials and on augmented
//! copies (`features::copies`). The gain of copies varies, so that they learn how much to trust level;
//! they are stored beside the library. The temperature of probabilities (`temperature`), the stopping rule
//! and the threshold of `unknown` come from leaving out library trials, by user or else by session if
//! there are several (`left_out`). If a source is missing, only its columns are left out.
//!
//! The score of a surface is 1/posterior, so that smaller means more alike, as in every method. The
//! margin is the log of the odds. Only the band of a source's configuration is used (`features::passed`).

pub(crate) mod discriminant;
mod eigen;
mod ensemble;
mod follower;
mod joint;
pub(super) mod labels;
mod left_out;
pub(crate) mod linear;
mod model;
mod picture;
mod places;
mod series;
mod stored;
mod temperature;
mod training;
mod view;

use std::sync::Arc;

use serde::{Deserialize, Serialize};

pub use self::follower::{Follower, FreshFrames, GuessSoFar};
pub use self::model::{EmbeddingModel, QueryVector};
use super::error::{Result, check_surfaces};
use super::method::{Method, Model};
use super::prepared::Prepared;
use crate::features::frames::TrialFrames;
use crate::library::Entry;
use crate::library::shape::LibraryShape;
use crate::scene::Scene;
use crate::seed;
use crate::trial::Trial;

const NAME: &str = "embedding";

/// Settings of the method `embedding`. Defaults are left out when settings are written.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub struct EmbeddingOptions {
    /// Seed of the augmented copies.
    #[serde(skip_serializing_if = "is_usual_seed")]
    pub seed: u64,
}

fn is_usual_seed(seed: &u64) -> bool {
    *seed == EmbeddingOptions::default().seed
}

impl Default for EmbeddingOptions {
    fn default() -> Self {
        Self { seed: 1 }
    }
}

#[derive(Clone, Debug)]
pub struct Embedding {
    scene: Scene,
    options: EmbeddingOptions,
}

impl Embedding {
    pub fn new(scene: Scene, options: EmbeddingOptions) -> Self {
        Self { scene, options }
    }

    /// Embeds a library and trains a model on it.
    ///
    /// # Errors
    /// The errors of [`Method::fit`].
    pub fn train(
        &self,
        mut library: Vec<Arc<TrialFrames>>,
        shape: &Arc<LibraryShape>,
    ) -> Result<EmbeddingModel> {
        // In an order that no name decides.
        library.sort_by(|a, b| a.digest.cmp(&b.digest).then_with(|| a.key.cmp(&b.key)));
        check_surfaces(library.iter().map(|trial| &trial.key))?;
        EmbeddingModel::train(&self.scene, shape, library, self.options.seed)
    }
}

impl Method for Embedding {
    fn name(&self) -> &'static str {
        NAME
    }

    fn settings_key(&self, shape: &LibraryShape) -> u64 {
        TrialFrames::framing_key(&self.scene, shape, self.options.seed)
    }

    fn prepare(&self, entry: &Entry, trial: &Trial, shape: &LibraryShape) -> Result<Prepared> {
        let seed = Some(self.options.seed);
        let frames = TrialFrames::new(&entry.key, trial, &self.scene, shape, seed)?;
        Ok(Prepared::Frames(Arc::new(frames)))
    }

    fn fit(&self, library: Vec<Prepared>, shape: &Arc<LibraryShape>) -> Result<Arc<dyn Model>> {
        let frames = library.iter().map(|trial| trial.frames(NAME).cloned());
        let frames = frames.collect::<Result<_, _>>()?;
        drop(library);
        Ok(Arc::new(self.train(frames, shape)?))
    }

    fn model_key(&self, shape: &LibraryShape) -> Option<u64> {
        let Self { scene, options } = self;
        let sources: Vec<_> = scene.sources().collect();
        let text = format!("{sources:?} {options:?} {}", shape.key());
        Some(seed::stable_hash(&[text.as_bytes()]))
    }

    fn restore(&self, bytes: &[u8], shape: &Arc<LibraryShape>) -> Option<Arc<dyn Model>> {
        Some(Arc::new(EmbeddingModel::from_bytes(bytes, &self.scene, shape)?))
    }
}
