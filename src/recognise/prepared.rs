//! A trial in the form that each method works with, and how it is stored in a cache.

use std::sync::Arc;

use super::embedding::TrialFrames;
use super::error::RecogniseError;
use super::features::FeatureVector;
use super::reference::prepared_trial::PreparedTrial;
use crate::library::Entry;
use crate::trial::TrialKey;

/// Version of the bytes of [`Prepared::encode`]: raise it whenever their meaning changes.
pub(super) const FORMAT: u64 = 2;

/// A trial, ready to be compared. A copy is cheap.
#[derive(Clone)]
pub enum Prepared {
    /// Samples, for `reference`.
    Samples(Arc<PreparedTrial>),
    /// Frames, for `embedding`.
    Frames(Arc<TrialFrames>),
    /// Numbers for each source, for the comparison classifiers; all that feature tables hold.
    Features(Arc<FeatureVector>),
}

const SAMPLES: u8 = 0;
const FRAMES: u8 = 1;
const FEATURES: u8 = 2;

impl Prepared {
    /// The trial's key.
    pub fn key(&self) -> &TrialKey {
        match self {
            Self::Samples(trial) => trial.key(),
            Self::Frames(trial) => &trial.key,
            Self::Features(trial) => &trial.key,
        }
    }

    /// The samples.
    ///
    /// # Errors
    /// If the trial was not prepared for `method`.
    pub(crate) fn samples(
        &self,
        method: &'static str,
    ) -> Result<&Arc<PreparedTrial>, RecogniseError> {
        match self {
            Self::Samples(trial) => Ok(trial),
            other => Err(other.is_not_for(method)),
        }
    }

    /// The frames.
    ///
    /// # Errors
    /// If the trial was not prepared for `method`.
    pub(crate) fn frames(&self, method: &'static str) -> Result<&Arc<TrialFrames>, RecogniseError> {
        match self {
            Self::Frames(trial) => Ok(trial),
            other => Err(other.is_not_for(method)),
        }
    }

    /// The features.
    ///
    /// # Errors
    /// If the trial was not prepared for `method`.
    pub(crate) fn features(
        &self,
        method: &'static str,
    ) -> Result<&Arc<FeatureVector>, RecogniseError> {
        match self {
            Self::Features(trial) => Ok(trial),
            other => Err(other.is_not_for(method)),
        }
    }

    fn is_not_for(&self, method: &'static str) -> RecogniseError {
        let by = match self {
            Self::Features(_) => return RecogniseError::NeedsRecordings(method),
            Self::Samples(_) => "reference",
            Self::Frames(_) => "embedding",
        };
        RecogniseError::PreparedByAnother { method, by, trial: self.key().to_string() }
    }

    /// The trial as bytes; `None` if that would be as large as the recording.
    pub(super) fn encode(&self) -> Option<Vec<u8>> {
        let (kind, bytes) = match self {
            Self::Samples(trial) => (SAMPLES, trial.encode()),
            Self::Frames(trial) => (FRAMES, postcard::to_allocvec(&trial.sources).ok()),
            Self::Features(trial) => (FEATURES, postcard::to_allocvec(&trial.sources).ok()),
        };
        let mut bytes = bytes?;
        bytes.push(kind);
        Some(bytes)
    }

    /// The trial of an entry from the bytes of `encode`; `None` if they are not valid.
    pub(super) fn decode(entry: &Entry, bytes: &[u8]) -> Option<Self> {
        let key = entry.key.clone();
        Some(match bytes.split_last()? {
            (&SAMPLES, bytes) => Self::Samples(Arc::new(PreparedTrial::decode(entry, bytes)?)),
            (&FRAMES, bytes) => {
                let sources = postcard::from_bytes(bytes).ok()?;
                Self::Frames(Arc::new(TrialFrames { key, sources }))
            }
            (&FEATURES, bytes) => {
                let sources = postcard::from_bytes(bytes).ok()?;
                Self::Features(Arc::new(FeatureVector { key, sources }))
            }
            _ => return None,
        })
    }
}
