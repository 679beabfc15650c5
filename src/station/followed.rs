//! The scan in progress, followed as its samples come.

use std::panic::AssertUnwindSafe;
use std::sync::Arc;

use super::event::{Guess, SurfaceProbability};
use super::recogniser::{Ranked, Recogniser};
use super::trial_need::{Purpose, TrialNeed};
use crate::recognise::{Follower, FreshFrames, GuessSoFar, RecogniseError};
use crate::scan::{Fresh, Progress, Scan};
use crate::scene::SourceId;

/// Drag after which damage is visible, in seconds.
const DAMAGE_AFTER_S: f64 = 0.5;

/// The scan in progress, as far as it was followed.
#[derive(Default)]
pub(super) struct Followed {
    scan: u32,
    /// The follower, with its recogniser.
    follower: Option<(Arc<Recogniser>, Follower)>,
    last: Option<GuessSoFar>,
    trial: TrialNeed,
}

impl Followed {
    /// Adds new data, and gives the scan's first answers and whether it may end.
    pub fn guess(
        &mut self,
        progress: &Progress,
        purpose: &Purpose,
        by: Option<&Arc<Recogniser>>,
    ) -> Guess {
        let truth = progress.truth.as_ref();
        if self.scan != progress.number {
            let followed_by = |by: &Arc<Recogniser>| {
                let follower = caught(|| by.follow(truth)).flatten()?;
                Some((by.clone(), follower))
            };
            let follower = by.and_then(followed_by);
            *self = Self { scan: progress.number, follower, ..Self::default() };
        }
        if let Some((_, follower)) = &mut self.follower {
            // A scan that cannot be compared is followed no longer; its answer will say why.
            match caught(|| look(follower, progress)) {
                Some(Ok(guess)) => self.last = guess.or(self.last.take()),
                Some(Err(_)) | None => self.follower = None,
            }
        }
        let mut news = Guess::nothing(progress.number, progress.scan_s);
        if let Some(guess) = &self.last {
            let named = guess.named.iter().cloned();
            let name = |(surface, probability)| SurfaceProbability { surface, probability };
            news.named = named.map(name).collect();
            news.settled = guess.settled.is_some();
            news.state = by.and_then(|by| by.state_so_far(truth, guess));
        }
        if let Some((by, follower)) = &self.follower
            && progress.scan_s >= DAMAGE_AFTER_S
        {
            news.damage = by.damage_so_far(truth, follower);
        }
        news.needed_s = by.and_then(|by| by.needed_s());
        let supported = self.follower.as_ref().is_some_and(|(_, f)| f.settling().shown);
        self.trial.judge(&mut news, progress, purpose, supported);
        news
    }

    /// The ranking of a scan that was followed, from the sums so far. `None` if it must be computed
    /// from the whole scan, which was not followed, lost samples, or began with another library.
    pub fn finish(&mut self, scan: &Scan, by: &Arc<Recogniser>) -> Option<Ranked> {
        let (followed_by, follower) =
            self.follower.as_mut().filter(|_| self.scan == scan.number)?;
        let whole = scan.lost_samples == 0 && scan.spoiled.is_empty();
        if !whole || !Arc::ptr_eq(followed_by, by) {
            return None;
        }
        let ranking = caught(|| follower.finish(&scan.trial)).flatten()?;
        let flaws_of = |id: &SourceId| Some((id.clone(), follower.flaws(id)?));
        let flaws = scan.trial.signals.keys().filter_map(flaws_of).collect();
        Some(Ranked { ranking, flaws })
    }

    /// The scan time, in seconds, at which the answer of a scan was settled.
    pub fn settled_s(&self, scan: u32) -> Option<f64> {
        let last = self.last.as_ref().filter(|_| self.scan == scan)?;
        last.settled.as_ref().map(|(_, at)| *at)
    }
}

/// The result of `work`; `None` if it panicked. A panic on one scan must not end the station.
pub(super) fn caught<T>(work: impl FnOnce() -> T) -> Option<T> {
    std::panic::catch_unwind(AssertUnwindSafe(work)).ok()
}

fn look(
    follower: &mut Follower,
    progress: &Progress,
) -> Result<Option<GuessSoFar>, RecogniseError> {
    for Fresh { source, rate_hz, channels, samples, .. } in &progress.fresh {
        let (rate_hz, channels) = (*rate_hz, *channels);
        follower.add(FreshFrames { source, rate_hz, channels, samples })?;
    }
    for (source, picture) in &progress.images {
        follower.add_picture(source, picture);
    }
    follower.look(progress.scan_s)
}
