//! The method `embedding` (method §9): all sources of a trial in one vector, a shrinkage
//! discriminant on it.
//!
//! The vector holds kernel mean embeddings: Fourier features of log-band frames (`fourier`),
//! whose squared distance is an MMD², the moments and the lag covariance of each series
//! (`series`), and the same for neighbouring pixels (`picture`). A discriminant is trained when
//! the library is loaded, from whole trials and random excerpts (`training`), and kept beside the
//! library (`stored`). Probabilities, the
//! stop rule and the threshold of `unknown` come from leaving library trials out, by user where
//! there are several (`left_out`). Missing sources cost their own columns: a discriminant of
//! those that are there is made of the same sums.
//!
//! The score of a surface is 1/posterior, so that, as everywhere, smaller is more alike, and the
//! margin is the log of the odds.

pub mod calibrated_probability;
pub mod discriminant;
mod evidence_weights;
mod follower;
mod fourier;
mod joint;
mod labels;
mod left_out;
mod left_out_scans;
mod library_scale;
pub mod linear;
mod model;
mod picture;
mod pixel_pairs;
mod posterior;
mod scan;
mod scatter;
mod series;
mod stored;
mod training;
mod view_sums;

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, OnceLock};

use serde::{Deserialize, Serialize};

use self::follower::Follower;
use self::joint::JointEmbedder;
use self::labels::Labels;
use self::left_out::{LeftOut, WithoutGroups};
use self::left_out_scans::Unfollowed;
pub use self::model::EmbeddingModel;
use self::posterior::QueryVector;
use self::training::Training;
use super::checks::check_surfaces;
use super::decide::conformal::{Rejection, RejectionError};
use super::decide::scan_time::LeftOutAccuracy;
use super::error::RecogniseError;
use super::features::FrameFeatures;
use super::follow::{Follow, FollowOptions};
use super::method::{BySources, Evidence, Method, Model};
use super::prepared::Prepared;
use super::rank::Ranking;
use super::shape::LibraryShape;
use crate::library::Entry;
use crate::scene::{Scene, SourceId};
use crate::seed;
use crate::trial::{Trial, TrialKey};

/// The method's name.
const NAME: &str = "embedding";

/// Settings of the method; what is usual is left out where settings are written.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub struct EmbeddingOptions {
    /// Seed of the random excerpts.
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

/// The method `embedding`.
#[derive(Clone, Debug)]
pub struct Embedding {
    scene: Scene,
    options: EmbeddingOptions,
}

impl Embedding {
    /// The method for the sources of a scene.
    pub fn new(scene: Scene, options: EmbeddingOptions) -> Self {
        Self { scene, options }
    }

    /// Embeds a library and trains on it.
    ///
    /// # Errors
    /// As [`Method::fit`].
    pub fn train(
        &self,
        mut library: Vec<Arc<FrameFeatures>>,
        shape: &Arc<LibraryShape>,
    ) -> Result<EmbeddingModel, RecogniseError> {
        library.sort_by(|a, b| a.key.cmp(&b.key));
        check_surfaces(library.iter().map(|trial| &trial.key))?;
        let labels = Labels::new(&library.iter().map(|trial| &trial.key).collect::<Vec<_>>());
        let mut joint = JointEmbedder::new(&self.scene, &library);
        for trial in &library {
            joint.check(trial)?;
        }
        let mut training = Training::new(&mut joint, &library, &labels, self.options.seed);
        let without = WithoutGroups::new(&joint, &mut training, &labels);
        let left_out = LeftOut::new(&joint, &training, &labels, &library, &without);
        let keys: Vec<TrialKey> = library.iter().map(|trial| trial.key.clone()).collect();
        let remarks = remarks(&keys, &labels, &left_out);
        Ok(EmbeddingModel {
            scene: self.scene.clone(),
            shape: shape.clone(),
            keys,
            labels,
            joint,
            training,
            left_out,
            discriminants: Mutex::default(),
            unfollowed: Mutex::new(Some(Unfollowed { library, without })),
            followed: OnceLock::new(),
            settling: OnceLock::new(),
            remarks,
        })
    }
}

impl Method for Embedding {
    fn name(&self) -> &'static str {
        NAME
    }

    fn settings_key(&self, shape: &LibraryShape) -> u64 {
        FrameFeatures::framing_key(&self.scene, shape)
    }

    fn prepare(
        &self,
        entry: &Entry,
        trial: &Trial,
        shape: &LibraryShape,
    ) -> Result<Prepared, RecogniseError> {
        let frames = FrameFeatures::new(&entry.key, trial, &self.scene, shape)?;
        Ok(Prepared::Frames(Arc::new(frames)))
    }

    fn fit(
        &self,
        library: Vec<Prepared>,
        shape: &Arc<LibraryShape>,
    ) -> Result<Arc<dyn Model>, RecogniseError> {
        let frames = library.iter().map(|trial| trial.frames(NAME).cloned());
        Ok(Arc::new(self.train(frames.collect::<Result<_, _>>()?, shape)?))
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

impl Model for EmbeddingModel {
    fn prepare(&self, entry: &Entry, trial: &Trial) -> Result<Prepared, RecogniseError> {
        let frames = FrameFeatures::new(&entry.key, trial, &self.scene, &self.shape)?;
        Ok(Prepared::Frames(Arc::new(frames)))
    }

    fn rank(&self, query: &Prepared) -> Result<Ranking, RecogniseError> {
        let query = query.frames(NAME)?;
        let (vector, present) = self.embed(query)?;
        Ok(self.ranking(&vector, &present, self.scan_s(query)))
    }

    fn moves(&self, source: &SourceId, channel: usize) -> bool {
        self.joint.moves(source, channel)
    }

    fn explain(&self, query: &Prepared) -> Result<Option<Evidence>, RecogniseError> {
        let query = query.frames(NAME)?;
        let (vector, present) = self.embed(query)?;
        Ok(Some(self.evidence(&vector, &present, self.scan_s(query))))
    }

    fn by_sources(
        self: Arc<Self>,
        query: &Prepared,
    ) -> Result<Option<Box<dyn BySources>>, RecogniseError> {
        let (vector, present) = self.embed(query.frames(NAME)?)?;
        Ok(Some(Box::new(QueryVector { model: self, vector, present })))
    }

    fn follow(self: Arc<Self>, options: &FollowOptions) -> Option<Box<dyn Follow>> {
        Some(Box::new(Follower::new(&self, options)))
    }

    fn left_out_accuracy(&self) -> Option<LeftOutAccuracy> {
        Some(self.accuracy_by_time())
    }

    fn rejection(&self, rate: Option<f64>) -> Result<Rejection, RejectionError> {
        let trials = self.left_out.conformity.trials();
        rate.map_or_else(|| Rejection::usual(trials), |rate| Rejection::new(trials, rate))
    }

    fn remarks(&self) -> &[String] {
        &self.remarks
    }

    fn store(&self) -> Option<Vec<u8>> {
        self.to_bytes()
    }
}

/// For people: what a library is too small for.
fn remarks(keys: &[TrialKey], labels: &Labels, left_out: &LeftOut) -> Vec<String> {
    let mut remarks = Vec::new();
    let mut users: BTreeMap<&str, usize> = BTreeMap::new();
    keys.iter().for_each(|key| *users.entry(&key.user).or_default() += 1);
    match left_out.held_out.len() {
        0 => remarks.push(
            "probabilities are not calibrated: that takes two trials of each of two surfaces"
                .to_string(),
        ),
        trials if !labels.across_users => {
            let person = match users.first_key_value() {
                Some((user, _)) if users.len() == 1 => format!("scans by `{user}`"),
                _ => "scans by the people in the library".to_string(),
            };
            remarks.push(format!(
                "probabilities rest on {trials} left-out trials, and hold for {person}"
            ));
        }
        trials => remarks.push(format!(
            "probabilities rest on {trials} trials by {} people, each left out in turn",
            users.len()
        )),
    }
    remarks
}
