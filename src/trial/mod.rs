//! One recorded interaction with one surface: all its sources, as they came from the sensors.

mod channel_flaws;
mod label;
mod signal;

pub(crate) use channel_flaws::is_plain;
pub use channel_flaws::{Flaw, SeriesFlaws, flaws};
pub(crate) use label::normal;
pub use label::{EXPERT, TrialKey, UNLABELLED};
pub use signal::{Image, Series, Signal, SignalError};

use std::collections::BTreeMap;

use crate::scene::SourceId;

/// One interaction with one surface, all its sources.
#[derive(Clone, Debug, PartialEq)]
pub struct Trial {
    /// Which surface, whose hand, which repetition.
    pub key: TrialKey,
    /// What was recorded. Sources may be missing: a comparison uses those that both trials have.
    pub signals: BTreeMap<SourceId, Signal>,
}

impl Trial {
    /// This trial with each of its series that follows a drag cut to the first `seconds`.
    ///
    /// Taps are transients and images have no duration; `is_drag` chooses the sources to cut.
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
