//! A trial in the form that a method works with, and its encoding for the cache.

use std::sync::Arc;

use super::error::{RecogniseError, Result};
use super::reference::prepared_trial::PreparedTrial;
use crate::features::FeatureVector;
use crate::features::frames::TrialFrames;
use crate::library::Entry;
use crate::trial::TrialKey;

/// Version of the bytes of [`Prepared::encode`]. Raise it whenever their meaning changes.
pub(super) const FORMAT: u64 = 12;

/// A trial, prepared for comparison. A clone is cheap.
#[derive(Clone)]
pub enum Prepared {
    /// Samples, for `reference`.
    Samples(Arc<PreparedTrial>),
    /// Frames, for `embedding`.
    Frames(Arc<TrialFrames>),
    /// Features of each source, for the comparison classifiers. Feature tables hold only these.
    Features(Arc<FeatureVector>),
}

const SAMPLES: u8 = 0;
const FRAMES: u8 = 1;
const FEATURES: u8 = 2;

impl Prepared {
    pub fn key(&self) -> &TrialKey {
        match self {
            Self::Samples(trial) => trial.key(),
            Self::Frames(trial) => &trial.key,
            Self::Features(trial) => &trial.key,
        }
    }

    /// The samples; an error if the trial was not prepared for `method`.
    pub(crate) fn samples(&self, method: &'static str) -> Result<&Arc<PreparedTrial>> {
        if let Self::Samples(trial) = self { Ok(trial) } else { Err(self.is_not_for(method)) }
    }

    pub(crate) fn frames(&self, method: &'static str) -> Result<&Arc<TrialFrames>> {
        if let Self::Frames(trial) = self { Ok(trial) } else { Err(self.is_not_for(method)) }
    }

    pub(crate) fn features(&self, method: &'static str) -> Result<&Arc<FeatureVector>> {
        if let Self::Features(trial) = self { Ok(trial) } else { Err(self.is_not_for(method)) }
    }

    fn is_not_for(&self, method: &'static str) -> RecogniseError {
        let by = match self {
            Self::Features(_) => return RecogniseError::NeedsRecordings(method),
            Self::Samples(_) => "reference",
            Self::Frames(_) => "embedding",
        };
        RecogniseError::PreparedByAnother { method, by, trial: self.key().to_string() }
    }

    /// The trial as bytes; `None` if they would be as large as the recording.
    pub(super) fn encode(&self) -> Option<Vec<u8>> {
        let (kind, bytes) = match self {
            Self::Samples(trial) => (SAMPLES, trial.encode()),
            Self::Frames(trial) => {
                let TrialFrames { digest, is_followed, copies, prints, sources, .. } = &**trial;
                let all = (digest, is_followed, copies, prints, sources);
                (FRAMES, postcard::to_allocvec(&all).ok())
            }
            Self::Features(trial) => (FEATURES, postcard::to_allocvec(&trial.sources).ok()),
        };
        let mut bytes = bytes?;
        bytes.push(kind);
        Some(bytes)
    }

    /// Decodes the bytes of `encode` for the trial of an entry; `None` if they are not valid.
    pub(super) fn decode(entry: &Entry, bytes: &[u8]) -> Option<Self> {
        let key = entry.key.clone();
        Some(match bytes.split_last()? {
            (&SAMPLES, bytes) => Self::Samples(Arc::new(PreparedTrial::decode(entry, bytes)?)),
            (&FRAMES, bytes) => {
                let (digest, is_followed, copies, prints, sources) =
                    postcard::from_bytes(bytes).ok()?;
                let trial = TrialFrames { key, digest, is_followed, copies, prints, sources };
                Self::Frames(Arc::new(trial))
            }
            (&FEATURES, bytes) => {
                let sources = postcard::from_bytes(bytes).ok()?;
                Self::Features(Arc::new(FeatureVector { key, sources }))
            }
            _ => return None,
        })
    }
}
