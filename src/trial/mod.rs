//! One recorded interaction with one surface, with all its sources as they came from the sensors.

#![allow(missing_docs)] // Names that say everything need no comment.

mod channel_flaws;
mod label;
mod signal;

pub use channel_flaws::{Flaw, SeriesFlaws, flaws};
pub(crate) use channel_flaws::{is_plain, worst_damage};
pub(crate) use label::{checked_label, normal};
pub use signal::{Image, Series, Signal, SignalError};

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::scene::SourceId;

#[derive(Clone, Debug, PartialEq)]
pub struct Trial {
    pub key: TrialKey,
    /// The recorded signals. Some may be missing, since a comparison uses only those of both trials.
    pub signals: BTreeMap<SourceId, Signal>,
}

impl Trial {
    /// This trial, with every series recorded during the drag cut to its first `seconds`.
    ///
    /// `is_drag` tells which sources are cut. A tap is a transient and stays whole.
    pub fn first_seconds(mut self, seconds: f64, is_drag: impl Fn(&SourceId) -> bool) -> Self {
        for (id, signal) in &mut self.signals {
            if let (Signal::Series(series), true) = (signal, is_drag(id)) {
                let frames = (seconds * series.rate_hz()).round() as usize;
                *series = series.crop(0, frames.min(series.frames()));
            }
        }
        self
    }

    /// Length in seconds of the longest series among the sources that `of` chooses; `None` without any.
    pub fn longest_s(&self, of: impl Fn(&SourceId) -> bool) -> Option<f64> {
        let lengths = self.signals.iter().filter_map(|(id, signal)| match signal {
            Signal::Series(series) if of(id) => Some(series.duration_s()),
            _ => None,
        });
        lengths.max_by(f64::total_cmp)
    }
}

/// The user of a trial if the recording names no user.
pub const EXPERT: &str = "expert";

/// The surface of a trial if its label is unknown.
pub const UNLABELLED: &str = "unlabelled";

/// Names one trial by its surface, its user and its repetition.
///
/// Keys are ordered by surface, then user, then number. Ties are broken in this order.
#[derive(Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub struct TrialKey {
    /// The surface's label, which recognition has to find.
    pub surface: String,
    /// The person who moved the stylus; [`EXPERT`] unless the recording says otherwise.
    pub user: String,
    /// Number of the repetition, counted from 1.
    pub number: u32,
}

impl TrialKey {
    pub fn new(surface: impl Into<String>, user: impl Into<String>, number: u32) -> Self {
        Self { surface: surface.into(), user: user.into(), number }
    }

    /// The surface; `None` if it is [`UNLABELLED`].
    pub fn label(&self) -> Option<&str> {
        (self.surface != UNLABELLED).then_some(self.surface.as_str())
    }
}

impl std::fmt::Display for TrialKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} · {} · trial {}", self.surface, self.user, self.number)
    }
}
