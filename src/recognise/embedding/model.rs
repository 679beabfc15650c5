//! A library that the method `embedding` has been trained on.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use super::calibrated_probability::HeldOut;
use super::discriminant::Discriminant;
use super::joint::{Excerpt, JointEmbedder, Present};
use super::labels::Labels;
use super::left_out::{Followed, LeftOut};
use super::training::Training;
use crate::recognise::error::RecogniseError;
use crate::recognise::features::FrameFeatures;
use crate::recognise::follow::FollowOptions;
use crate::recognise::shape::LibraryShape;
use crate::scene::Scene;

/// A library, embedded and trained.
pub struct EmbeddingModel {
    pub(super) scene: Scene,
    pub(super) shape: Arc<LibraryShape>,
    pub(super) library: Vec<Arc<FrameFeatures>>,
    pub(super) labels: Labels,
    pub(super) joint: JointEmbedder,
    pub(super) training: Training,
    pub(super) left_out: LeftOut,
    /// By the sources of the queries so far.
    pub(super) discriminants: Mutex<HashMap<Present, Arc<Discriminant>>>,
    /// What following left-out trials showed, by the options that were wanted first: scans are
    /// followed by them again and again.
    pub(super) followed: OnceLock<(FollowOptions, Followed)>,
    /// For people: what the library was too small for.
    pub(super) remarks: Vec<String>,
}

impl EmbeddingModel {
    /// Distances of left-out library trials under models trained without them, with the index of
    /// each trial's surface. Empty where there is nothing to leave out.
    pub fn held_out(&self) -> &[HeldOut] {
        &self.left_out.held_out
    }

    pub(super) fn scan_s(&self, query: &FrameFeatures) -> f64 {
        self.joint.drag_s(query).unwrap_or(f64::INFINITY)
    }

    pub(super) fn embed(
        &self,
        query: &FrameFeatures,
    ) -> Result<(Vec<f32>, Present), RecogniseError> {
        self.joint.check(query, &self.library)?;
        if !self.joint.says_something(query) {
            return Err(RecogniseError::TooLittle);
        }
        let (mut vectors, present) = self.joint.embed(query, &[Excerpt::WHOLE]);
        Ok((vectors.swap_remove(0), present))
    }

    /// The discriminant of some sources. Where the library cannot train one, classes are as far as
    /// their means.
    pub(super) fn discriminant(&self, present: &Present) -> Arc<Discriminant> {
        let lock = || self.discriminants.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(known) = lock().get(present) {
            return known.clone();
        }
        let trained = self.training.discriminant(&self.joint, present, None);
        let trained =
            Arc::new(trained.unwrap_or_else(|| self.training.untrained(&self.joint, present)));
        lock().insert(present.clone(), trained.clone());
        trained
    }
}
