//! The trained model as bytes.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, OnceLock};

use serde::Deserialize;

use super::joint::{JointEmbedder, Present};
use super::labels::Labels;
use super::left_out::{LeftOut, Measured, Trained};
use super::model::EmbeddingModel;
use super::training::Training;
use crate::library::shape::LibraryShape;
use crate::recognise::decide::settle::FollowedTrial;
use crate::scene::Scene;
use crate::trial::TrialKey;

/// The stored part of a model: everything that does not follow from the scene.
#[derive(Deserialize)]
struct Stored {
    keys: Vec<TrialKey>,
    together: Vec<usize>,
    joint: JointEmbedder,
    training: Training,
    left_out: LeftOut,
    followed: Vec<FollowedTrial>,
    begun: BTreeMap<Present, Measured>,
}

impl EmbeddingModel {
    /// The model as bytes for [`Method::restore`](crate::recognise::Method::restore), if possible.
    pub(crate) fn store(&self) -> Option<Vec<u8>> {
        // In the order of `Stored`. Following left-out trials takes a while, unless already done.
        let (keys, together) = (&self.keys, &self.labels.together);
        let (followed, begun) = (self.followed(), self.begun());
        let stored = (keys, together, &self.joint, &self.training, &self.left_out, followed, begun);
        postcard::to_allocvec(&stored).ok()
    }

    /// Restores the model from the bytes of [`EmbeddingModel::store`]; `None` if they are not valid.
    pub(super) fn from_bytes(
        bytes: &[u8],
        scene: &Scene,
        shape: &Arc<LibraryShape>,
    ) -> Option<Self> {
        let stored: Stored = postcard::from_bytes(bytes).ok()?;
        let trials = stored.keys.len();
        let is_sound = |(trial, first): (usize, &usize)| *first <= trial;
        if stored.together.len() != trials || !stored.together.iter().enumerate().all(is_sound) {
            return None;
        }
        let labels = Labels::new(&stored.keys.iter().collect::<Vec<_>>(), stored.together);
        let joint = stored.joint;
        let training = stored.training.restored(&labels, joint.dims())?;
        let fits = |trained: &Arc<Trained>| {
            let mut all = std::iter::once(&trained.all).chain(trained.without.iter().flatten());
            trained.without.len() == labels.groups
                && all.all(|ensemble| ensemble.is_of(labels.classes, joint.dims()))
        };
        let sound = joint.is_of(scene)
            && stored.left_out.trained.values().all(fits)
            && training.present.iter().all(|has| stored.left_out.trained.contains_key(has))
            && stored.followed.iter().all(|trial| trial.is_sound(labels.classes));
        sound.then(|| Self {
            scene: scene.clone(),
            shape: shape.clone(),
            keys: stored.keys,
            labels,
            joint,
            training,
            left_out: stored.left_out,
            trained: Mutex::default(),
            unfollowed: Mutex::default(),
            begun: stored.begun.into(),
            followed: stored.followed.into(),
            settling: OnceLock::new(),
        })
    }
}
