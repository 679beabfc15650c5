//! Decides whether a drag may end (to be named or to be kept as a trial), and whether a finished
//! scan may be kept.

use std::collections::BTreeMap;

use super::certainty::{lost_in, too_short};
use super::recogniser::Recogniser;
use crate::independence::{OnlineDuration, SAMPLES, of_recording, scan_s};
use crate::recognise::LOOK_S;
use crate::scan::{Fresh, Progress, Scan};
use crate::scene::{Scene, SourceId};
use crate::station::event::Guess;
use crate::trial::{Doubt, Series, SeriesFlaws, Signal};

/// A source is not judged if it has not changed after this many seconds of drag.
const RESTS_S: f64 = 1.0;

/// The shortest drag of a trial, in seconds: ten times the interval of looks.
const LEAST_S: f64 = 10.0 * LOOK_S;

/// How long a drag must last, by the current estimate of T* for each judged source.
#[derive(Default)]
pub(super) struct TrialNeed {
    of_source: BTreeMap<SourceId, SourceNeed>,
}

struct SourceNeed {
    online: OnlineDuration,
    first: Vec<f32>,
    moves: bool,
    /// Seconds of drag needed by the upper bound of T*, once known. (A finished trial uses T* itself.)
    needed_s: Option<f64>,
}

impl TrialNeed {
    /// Sets in `news` the drag that is needed, and whether the drag may end. On entry, `news` holds
    /// the drag needed for a name. A scan that is to be a trial needs enough independent samples of
    /// the sources in `trial`. A settled answer may end the drag only if its rule is `supported` by
    /// enough trials.
    pub(super) fn judge(
        &mut self,
        news: &mut Guess,
        progress: &Progress,
        trial: Option<&[SourceId]>,
        supported: bool,
    ) {
        let mut settled = news.settled && supported;
        if let Some(by_t_star) = trial {
            let judged = |fresh: &&Fresh| by_t_star.contains(&fresh.source);
            progress.fresh.iter().filter(judged).for_each(|fresh| self.add(fresh));
            let least_s = news.needed_s.unwrap_or(LEAST_S).max(LEAST_S);
            news.needed_s = self.needed_s(progress.scan_s, least_s);
            // A settled name alone does not make a good trial, so only the needed time counts.
            settled = false;
        }
        news.enough = settled || news.needed_s.is_some_and(|s| progress.scan_s >= s - 1e-9);
    }

    fn add(&mut self, fresh: &Fresh) {
        let begin = || SourceNeed {
            online: OnlineDuration::new(fresh.rate_hz, fresh.channels),
            first: fresh.samples.iter().take(fresh.channels).copied().collect(),
            moves: false,
            needed_s: None,
        };
        let source = self.of_source.entry(fresh.source.clone()).or_insert_with(begin);
        let frames = fresh.samples.chunks_exact(fresh.channels.max(1));
        source.moves |= frames.into_iter().any(|frame| frame != source.first);
        // Frames with NaN or infinite samples do not count for T*; `faults` refuses the scan anyway.
        if let Ok(Some(estimate)) = source.online.push(&fresh.samples) {
            let upper = estimate.upper_samples().map(|lag| lag as f64 / fresh.rate_hz);
            source.needed_s = upper.map(|t_star_s| scan_s(t_star_s, SAMPLES));
        }
    }

    /// How long the drag must last, in seconds, at least `least_s`; `None` if that is not known yet.
    fn needed_s(&self, scan_s: f64, least_s: f64) -> Option<f64> {
        let mut needed_s = least_s;
        for source in self.of_source.values() {
            match source.needed_s {
                Some(its_s) => needed_s = needed_s.max(its_s),
                None if !source.moves && scan_s >= RESTS_S => {}
                None => return None,
            }
        }
        Some(needed_s)
    }
}

/// Why a scan is not a good trial. A good trial is undamaged, lasts at least `LEAST_S` and the scan
/// time of the library of `by`, and holds enough independent samples of the sources `by_t_star`.
pub(super) fn faults(
    scan: &Scan,
    scene: &Scene,
    by_t_star: &[SourceId],
    by: Option<&Recogniser>,
) -> Vec<Doubt> {
    let mut faults = lost_in(scan);
    let needed_s = by.and_then(|by| by.needed_s).unwrap_or(LEAST_S).max(LEAST_S);
    faults.extend(too_short(scan.scan_s, needed_s, false));
    for (id, signal) in &scan.trial.signals {
        let Signal::Series(series) = signal else { continue };
        // A switch may rest, so it is not judged.
        if scene.get(id.as_str()).is_some_and(|spec| !spec.is_switch()) {
            faults.extend(match by {
                Some(by) => by.flaws_of(scan.truth.as_ref(), id, signal),
                // Without a library, any channel may rest, but none may be clipped.
                None => {
                    let mut found = SeriesFlaws::of(series).doubts(id, &[]);
                    found.retain(|doubt| matches!(doubt, Doubt::Clipped { .. }));
                    found
                }
            });
        }
        if by_t_star.contains(id) {
            faults.extend(few_independent(id, series));
        }
    }
    faults
}

/// A doubt if a recording holds too few independent samples, judged by its own T*.
fn few_independent(id: &SourceId, series: &Series) -> Option<Doubt> {
    let held_s = series.duration_s();
    let t_star = of_recording(series).and_then(|estimate| estimate.t_star_samples());
    let needed_s = match t_star {
        Some(t_star) => Some(scan_s(t_star as f64 / series.rate_hz(), SAMPLES)),
        // A constant source stays constant, so a longer drag does not help.
        _ if series.is_constant() => return None,
        _ => None,
    };
    let is_enough = needed_s.is_some_and(|needed_s| held_s >= needed_s);
    let (source, samples) = (id.clone(), SAMPLES);
    (!is_enough).then_some(Doubt::FewIndependent { source, held_s, needed_s, samples })
}

#[cfg(test)]
#[path = "../../../tests/common/simulate.rs"]
mod simulate;

#[cfg(test)]
mod tests {
    use super::*;

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
            assert_eq!(need.needed_s(0.9, 0.5), None);
            need.add(&fresh(simulate::ar1(11_000, tau, &mut rng)));
            need.needed_s(2.0, 0.5).unwrap()
        };
        let (fast, slow) = (after_2_s(2.0), after_2_s(20.0));
        assert!((0.5..1.0).contains(&fast) && slow > 3.0 * fast, "{fast} {slow}");
    }

    #[test]
    fn a_source_that_rests_asks_for_nothing_and_without_sources_the_least_is_enough() {
        let mut need = TrialNeed::default();
        assert_eq!(need.needed_s(0.1, 0.7), Some(0.7));
        need.add(&fresh(vec![0.5; 12_000]));
        assert_eq!((need.needed_s(0.5, 0.7), need.needed_s(1.2, 0.7)), (None, Some(0.7)));
    }
}
