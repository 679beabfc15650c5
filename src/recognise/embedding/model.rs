//! A library that the method `embedding` has been trained on.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use super::calibrated_probability::HeldOut;
use super::discriminant::Discriminant;
use super::joint::{Excerpt, JointEmbedder, Present};
use super::labels::Labels;
use super::left_out::LeftOut;
use super::left_out_scans::{FollowedTrial, Unfollowed};
use super::training::Training;
use crate::recognise::decide::settle::Settling;
use crate::recognise::error::RecogniseError;
use crate::recognise::features::FrameFeatures;
use crate::recognise::follow::FollowOptions;
use crate::recognise::shape::LibraryShape;
use crate::scene::Scene;
use crate::trial::TrialKey;

/// A library, embedded and trained.
pub struct EmbeddingModel {
    pub(super) scene: Scene,
    pub(super) shape: Arc<LibraryShape>,
    /// The library's trials, sorted.
    pub(super) keys: Vec<TrialKey>,
    pub(super) labels: Labels,
    pub(super) joint: JointEmbedder,
    pub(super) training: Training,
    pub(super) left_out: LeftOut,
    /// By the sources of the queries so far.
    pub(super) discriminants: Mutex<HashMap<Present, Arc<Discriminant>>>,
    /// What following left-out trials takes, until that is done.
    pub(super) unfollowed: Mutex<Option<Unfollowed>>,
    /// What it showed.
    pub(super) followed: OnceLock<Vec<FollowedTrial>>,
    /// The stop rule by the options that were wanted first: scans are followed by them again and
    /// again.
    pub(super) settling: OnceLock<(FollowOptions, Settling)>,
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
        self.joint.check(query)?;
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
