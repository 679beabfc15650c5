//! A trained model as bytes, for the cache beside its library.

use std::sync::{Arc, Mutex, OnceLock};

use ndarray::Array2;
use serde::Deserialize;

use super::discriminant::Discriminant;
use super::joint::{JointEmbedder, Present, StoredJoint};
use super::labels::Labels;
use super::left_out::LeftOut;
use super::left_out_scans::FollowedTrial;
use super::model::EmbeddingModel;
use super::remarks;
use super::training::Training;
use crate::recognise::shape::LibraryShape;
use crate::scene::Scene;
use crate::trial::TrialKey;

/// What is stored of a model: all that does not follow from its scene and its trials' names.
#[derive(Deserialize)]
struct Stored {
    keys: Vec<TrialKey>,
    joint: StoredJoint,
    training: (Array2<f32>, Vec<Present>, f64),
    left_out: LeftOut,
    followed: Vec<FollowedTrial>,
    /// Of all sources, which most queries have.
    discriminant: Discriminant,
}

impl EmbeddingModel {
    /// The model as bytes. Following left-out trials takes a while, unless that has been done.
    pub(super) fn to_bytes(&self) -> Option<Vec<u8>> {
        let discriminant = self.discriminant(&vec![true; self.joint.stretches.len()]);
        // In the order of `Stored`.
        let stored = (
            &self.keys,
            self.joint.to_stored(),
            self.training.to_stored(),
            &self.left_out,
            self.followed(),
            &*discriminant,
        );
        postcard::to_allocvec(&stored).ok()
    }

    /// The model of such bytes; `None` if they are of something else.
    pub(super) fn from_bytes(
        bytes: &[u8],
        scene: &Scene,
        shape: &Arc<LibraryShape>,
    ) -> Option<Self> {
        let stored: Stored = postcard::from_bytes(bytes).ok()?;
        let labels = Labels::new(&stored.keys.iter().collect::<Vec<_>>());
        let joint = JointEmbedder::from_stored(scene, stored.joint)?;
        let training = Training::from_stored(stored.training, &labels, joint.dims())?;
        let sound = stored.discriminant.is_of(labels.classes, joint.dims())
            && stored.followed.iter().all(|trial| trial.is_sound(labels.classes));
        if !sound {
            return None;
        }
        let all = vec![true; joint.stretches.len()];
        let remarks = remarks(&stored.keys, &labels, &stored.left_out);
        Some(Self {
            scene: scene.clone(),
            shape: shape.clone(),
            keys: stored.keys,
            labels,
            joint,
            training,
            left_out: stored.left_out,
            discriminants: Mutex::new([(all, Arc::new(stored.discriminant))].into()),
            unfollowed: Mutex::new(None),
            followed: OnceLock::from(stored.followed),
            settling: OnceLock::new(),
            remarks,
        })
    }
}
