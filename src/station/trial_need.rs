//! Decides whether a scan is good enough: whether one in progress may end, to be named or kept as a
//! trial, and whether one that has ended may be kept.

use std::collections::BTreeMap;

use super::answer::Damage;
use super::recogniser::Recogniser;
use crate::duration::{OnlineDuration, OnlineSettings, SAMPLES, ScanNeed};
use crate::recognise::LOOK_S;
use crate::scan::{Fresh, Progress, Scan};
use crate::scene::{Scene, SourceId};
use crate::station::event::Guess;
use crate::trial::{Series, Signal, flaws};

/// A source that has been at rest for this long, in seconds of drag, is not judged.
const RESTS_S: f64 = 1.0;

/// Least drag of a trial, in seconds: ten times the interval at which scans are followed.
const LEAST_S: f64 = 10.0 * LOOK_S;

/// The purpose of a scan in progress.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Purpose {
    /// To be named.
    Name,
    /// To be kept as a trial, which must hold enough independent samples of these sources.
    Keep(Vec<SourceId>),
}

/// How long the drag must be for the judged sources, by their T* as estimated so far.
#[derive(Default)]
pub(super) struct TrialNeed {
    of_source: BTreeMap<SourceId, SourceNeed>,
}

struct SourceNeed {
    online: OnlineDuration,
    first: Vec<f32>,
    moves: bool,
    /// Seconds of drag by the upper bound of T*; the finished trial is judged by T* itself.
    needed_s: Option<f64>,
}

impl TrialNeed {
    /// Sets in `news` the time needed for the purpose (it held the time needed to be named) and
    /// whether the drag may end. A settled answer may end it if its rule is `supported` by enough
    /// trials.
    pub fn judge(
        &mut self,
        news: &mut Guess,
        progress: &Progress,
        purpose: &Purpose,
        supported: bool,
    ) {
        let mut settled = news.settled && supported;
        if let Purpose::Keep(by_t_star) = purpose {
            let judged = |fresh: &&Fresh| by_t_star.contains(&fresh.source);
            progress.fresh.iter().filter(judged).for_each(|fresh| self.add(fresh));
            let least_s = Some(news.needed_s.unwrap_or(LEAST_S).max(LEAST_S));
            news.needed_s = self.needed_s(progress.scan_s, least_s);
            // A settled name does not make a good trial.
            settled = false;
        }
        news.enough = settled || news.needed_s.is_some_and(|s| progress.scan_s >= s - 1e-9);
    }

    /// Adds the next frames of a source.
    fn add(&mut self, fresh: &Fresh) {
        let begin = || SourceNeed {
            online: OnlineDuration::new(
                fresh.rate_hz,
                fresh.channels,
                OnlineSettings { window_s: f64::INFINITY, ..OnlineSettings::default() },
            ),
            first: fresh.samples.iter().take(fresh.channels).copied().collect(),
            moves: false,
            needed_s: None,
        };
        let source = self.of_source.entry(fresh.source.clone()).or_insert_with(begin);
        let frames = fresh.samples.chunks_exact(fresh.channels.max(1));
        source.moves |= frames.into_iter().any(|frame| frame != source.first);
        // Frames with samples that are not numbers do not count for T*; such a scan is refused as a
        // trial.
        if let Ok(Some(estimate)) = source.online.push(&fresh.samples) {
            let upper = estimate.t_star_upper_samples.map(|lag| lag as f64 / fresh.rate_hz);
            source.needed_s = upper.map(|t_star_s| ScanNeed::new(t_star_s, SAMPLES).scan_s());
        }
    }

    /// How long the drag must be, in seconds, at least `least_s`; `None` while it is not known.
    fn needed_s(&self, scan_s: f64, least_s: Option<f64>) -> Option<f64> {
        let mut needed_s = least_s;
        for source in self.of_source.values() {
            match source.needed_s {
                Some(its_s) => needed_s = Some(needed_s.unwrap_or(0.0).max(its_s)),
                None if !source.moves && scan_s >= RESTS_S => {}
                None => return None,
            }
        }
        needed_s
    }
}

/// Reasons why a scan is not a good trial, a line each: it is spoiled or damaged, or shorter than
/// `LEAST_S` or than the scan time of the library that `by` compares with, or holds too few
/// independent samples of the sources `by_t_star`.
pub(super) fn faults(
    scan: &Scan,
    scene: &Scene,
    by_t_star: &[SourceId],
    by: Option<&Recogniser>,
) -> Vec<String> {
    let mut faults = scan.spoiled.clone();
    if scan.lost_samples > 0 && faults.is_empty() {
        faults.push(format!("{} samples were lost in it", scan.lost_samples));
    }
    let needed_s = by.and_then(|by| by.needed_s()).unwrap_or(LEAST_S).max(LEAST_S);
    if scan.scan_s < needed_s - 0.5 * LOOK_S {
        faults.push(format!("{:.1} s is too short, drag for {needed_s:.1} s", scan.scan_s));
    }
    for (id, signal) in &scan.trial.signals {
        let Signal::Series(series) = signal else { continue };
        // A source with a fixed length scale is a switch, which has two values and rests.
        if scene.get(id.as_str()).is_some_and(|spec| spec.sigma.is_none()) {
            // As long as there is no library, any channel may rest.
            let moves =
                |channel: usize| by.is_some_and(|by| by.moves(scan.truth.as_ref(), id, channel));
            let damage = Damage::of_source(id, &flaws(series), moves);
            faults.extend(damage.map(|damage| format!("{id}: {}", damage.text)));
        }
        if by_t_star.contains(id) {
            faults.extend(too_short(id, series));
        }
    }
    faults
}

/// A message if a recording holds too few independent samples, by its own T*.
fn too_short(id: &SourceId, series: &Series) -> Option<String> {
    let held_s = series.duration_s();
    let settings =
        OnlineSettings { window_s: held_s, every_s: f64::INFINITY, ..OnlineSettings::default() };
    let mut online = OnlineDuration::new(series.rate_hz(), series.channels(), settings);
    online.push(series.samples()).ok()?;
    let estimate = online.estimate();
    let needed_s = match estimate.map(|estimate| estimate.t_star_s) {
        Some(Some(t_star_s)) => ScanNeed::new(t_star_s, SAMPLES).scan_s(),
        // A constant source stays constant however long the drag is.
        _ if series.is_constant() => return None,
        _ => f64::INFINITY,
    };
    if held_s >= needed_s {
        return None;
    }
    let take = match needed_s.is_finite() {
        true => format!("{SAMPLES} independent samples take {needed_s:.1} s here"),
        false => "no two samples in it are known to be independent".into(),
    };
    Some(format!("{id}: {held_s:.1} s is too short: {take}; drag longer, or move faster"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::duration::simulate;

    fn fresh(samples: Vec<f32>) -> Fresh {
        let source = SourceId::new("ir").unwrap();
        Fresh { source, rate_hz: 1e4, channels: 1, start: 0, samples }
    }

    #[test]
    fn what_is_needed_is_known_after_a_second_and_is_more_for_a_slower_source() {
        let after_2_s = |tau: f64| {
            let mut rng = crate::seed::rng(1, &[b"need"]);
            let mut need = TrialNeed::default();
            need.add(&fresh(simulate::ar1(9_000, tau, &mut rng)));
            assert_eq!(need.needed_s(0.9, Some(0.5)), None);
            need.add(&fresh(simulate::ar1(11_000, tau, &mut rng)));
            need.needed_s(2.0, Some(0.5)).unwrap()
        };
        let (fast, slow) = (after_2_s(2.0), after_2_s(20.0));
        assert!((0.5..1.0).contains(&fast) && slow > 3.0 * fast, "{fast} {slow}");
    }

    #[test]
    fn a_source_that_rests_asks_for_nothing_and_without_sources_the_least_is_enough() {
        let mut need = TrialNeed::default();
        assert_eq!((need.needed_s(0.1, Some(0.7)), need.needed_s(0.1, None)), (Some(0.7), None));
        need.add(&fresh(vec![0.5; 12_000]));
        assert_eq!(
            (need.needed_s(0.5, Some(0.7)), need.needed_s(1.2, Some(0.7))),
            (None, Some(0.7))
        );
    }
}
