//! One recorded interaction with one surface: all its sources, as they came from the sensors.

mod channel_flaws;
mod signal;

pub(crate) use channel_flaws::is_plain;
pub use channel_flaws::{Flaw, SeriesFlaws, flaws};
pub use signal::{Image, Series, Signal, SignalError};

use std::collections::BTreeMap;

use crate::scene::SourceId;

/// One interaction with one surface, all its sources.
#[derive(Clone, Debug, PartialEq)]
pub struct Trial {
    /// Surface, person and number of the repetition.
    pub key: TrialKey,
    /// The recorded signals. Sources may be missing: a comparison uses those that both trials have.
    pub signals: BTreeMap<SourceId, Signal>,
}

impl Trial {
    /// This trial, with every series recorded during the drag cut to its first `seconds`.
    ///
    /// `is_drag` chooses the sources to cut: a tap is a transient, and an image has no duration.
    pub fn first_seconds(mut self, seconds: f64, is_drag: impl Fn(&SourceId) -> bool) -> Self {
        for (id, signal) in &mut self.signals {
            if let (Signal::Series(series), true) = (signal, is_drag(id)) {
                let frames = (seconds * series.rate_hz()).round() as usize;
                *series = series.crop(0, frames.min(series.frames()));
            }
        }
        self
    }

    /// Length in seconds of the longest series among the sources that `of` chooses, if there is one.
    pub fn longest_s(&self, of: impl Fn(&SourceId) -> bool) -> Option<f64> {
        let lengths = self.signals.iter().filter_map(|(id, signal)| match signal {
            Signal::Series(series) if of(id) => Some(series.duration_s()),
            _ => None,
        });
        lengths.max_by(f64::total_cmp)
    }
}

/// The user of a trial whose recording names none.
pub const EXPERT: &str = "expert";

/// The surface of a trial whose label nobody knows.
pub const UNLABELLED: &str = "unlabelled";

/// A label in Unicode's normal form C: an é is the same, however it was typed.
pub(crate) fn normal(label: &str) -> String {
    use unicode_normalization::UnicodeNormalization;
    label.nfc().collect()
}

/// Names one trial: which surface, whose hand, which repetition.
///
/// Ordered by surface, then user, then number, which is also the order in which ties are broken.
#[derive(
    Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, serde::Serialize, serde::Deserialize,
)]
pub struct TrialKey {
    /// The surface's label, which recognition answers with.
    pub surface: String,
    /// The person who moved the stylus; [`EXPERT`] unless the recording says otherwise.
    pub user: String,
    /// Number of the repetition, counted from 1.
    pub number: u32,
}

impl TrialKey {
    /// A key from its three parts.
    pub fn new(surface: impl Into<String>, user: impl Into<String>, number: u32) -> Self {
        Self { surface: surface.into(), user: user.into(), number }
    }

    /// The surface, if it is known.
    pub fn label(&self) -> Option<&str> {
        (self.surface != UNLABELLED).then_some(self.surface.as_str())
    }
}

impl std::fmt::Display for TrialKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} · {} · trial {}", self.surface, self.user, self.number)
    }
}
