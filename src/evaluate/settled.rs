//! Measures accuracy and scan time if a stop rule ends each scan as soon as its answer is clear.

use super::evaluation::Run;
use super::{EvaluateError, Share, percentile};
use crate::recognise::{
    FollowOptions, Follower, FreshFrames, GuessSoFar, LOOK_S, RecogniseError, Settling,
};
use crate::scene::{Scene, SourceId};
use crate::system::processor_s;
use crate::trial::{Series, Signal, Trial};

/// The answers of the stop rule, compared with the answers from whole scans. Shares are from 0 to 1.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct SettledOutcome {
    pub stated_loss: f64,
    /// How many of all queries the stop rule names correctly.
    #[serde(flatten)]
    pub share: Share,
    /// Share of queries that the whole scan names correctly.
    pub accuracy_whole: f64,
    /// Number of queries that the whole scan names correctly and the stop rule does not.
    pub lost: usize,
    /// Number of queries that the stop rule names correctly and the whole scan does not.
    pub gained: usize,
    pub queries: usize,
    /// Number of queries that the stop rule named before the end of the scan.
    pub settled: usize,
    /// Mean scan time used, in seconds.
    pub scan_s_mean: f64,
    /// Median scan time used, in seconds.
    pub scan_s_p50: f64,
    /// Mean length of the whole scans, in seconds.
    pub whole_s_mean: f64,
    /// Processor time for following whole scans with ten guesses a second, divided by the scans'
    /// duration: 1 is one core. `None` if the system does not measure processor time (Windows).
    pub core_share: Option<f64>,
    /// The stop rule of each fold, and its results on left-out library trials.
    pub rules: Vec<Settling>,
}

impl SettledOutcome {
    /// Follows every query, with a stop rule that may lose a share `loss` of accuracy. As in a live
    /// scan, frames arrive in blocks of `LOOK_S` = 0.1 s, each followed by a guess.
    ///
    /// # Errors
    /// If a trial cannot be read or compared, or if the method cannot follow scans.
    pub fn of(run: &Run<'_, '_>, loss: f64) -> Result<Self, EvaluateError> {
        let (scene, folds) = (run.on.scene, run.on.folds);
        let total: usize = folds.iter().map(|fold| fold.queries.len()).sum();
        let (mut by_rule, mut by_whole) = (Share::default(), Share::default());
        let (mut lost, mut gained, mut settled) = (0, 0, 0);
        let (mut used_s, mut whole_s) = (Vec::with_capacity(total), 0.0);
        let (mut rules, mut busy_s) = (Vec::new(), Some(0.0));
        for fold in folds {
            let model = run.fit(&fold.library)?;
            let embedding = (model.clone().embedding())
                .ok_or(EvaluateError::Follow { method: run.method.name() })?;
            let mut follower = embedding.follow(&FollowOptions { loss, rejection: None });
            rules.push(follower.settling().clone());
            for &query in &fold.queries {
                let trial = run.recording(query)?;
                let truth = &run.on.trials.key(query).surface;
                let scan_s = trial.longest_s(|id| scene.is_dragged(id)).unwrap_or(0.0);
                let start_s = processor_s();
                let guess = follow(&mut follower, &trial, scene, scan_s)?;
                let spent_s = processor_s().zip(start_s).map(|(end_s, start_s)| end_s - start_s);
                busy_s = busy_s.zip(spent_s).map(|(busy_s, spent_s)| busy_s + spent_s);
                let whole = model.rank(&run.query_of(&model, trial, None)?.prepared)?;
                let whole_is_right = whole.surface() == truth;
                // The whole scan names the query if the stop rule never settles.
                let (is_right, at_s) = match guess.and_then(|guess| guess.settled) {
                    Some((label, at_s)) => {
                        settled += 1;
                        (label == *truth, at_s)
                    }
                    None => (whole_is_right, scan_s),
                };
                by_rule.add(is_right);
                by_whole.add(whole_is_right);
                lost += usize::from(whole_is_right && !is_right);
                gained += usize::from(is_right && !whole_is_right);
                used_s.push(at_s);
                whole_s += scan_s;
                (run.on.progress)("following queries", used_s.len(), total);
            }
        }
        let n = used_s.len().max(1) as f64;
        Ok(Self {
            stated_loss: loss,
            share: by_rule,
            accuracy_whole: by_whole.value(),
            lost,
            gained,
            queries: total,
            settled,
            scan_s_mean: used_s.iter().sum::<f64>() / n,
            scan_s_p50: percentile(used_s, 0.5),
            whole_s_mean: whole_s / n,
            core_share: busy_s.map(|busy_s| busy_s / whole_s.max(LOOK_S)),
            rules,
        })
    }
}

/// Follows a recorded trial to its end, block by block; returns the last guess.
pub fn follow(
    follower: &mut Follower,
    trial: &Trial,
    scene: &Scene,
    scan_s: f64,
) -> Result<Option<GuessSoFar>, RecogniseError> {
    follower.begin();
    for (id, signal) in &trial.signals {
        match signal {
            Signal::Image(picture) => follower.add_picture(id, picture),
            Signal::Series(series) if !scene.is_dragged(id) => {
                add(follower, id, series, 0, series.frames())?;
            }
            Signal::Series(_) => {}
        }
    }
    let mut last = None;
    let steps = (scan_s / LOOK_S + 1e-9).floor() as usize;
    for step in 1..=steps {
        for (id, signal) in &trial.signals {
            if let (Signal::Series(series), true) = (signal, scene.is_dragged(id)) {
                let until = |step: usize| {
                    let frames = (step as f64 * LOOK_S * series.rate_hz()).ceil() as usize;
                    frames.min(series.frames())
                };
                add(follower, id, series, until(step - 1), until(step))?;
            }
        }
        last = follower.look(step as f64 * LOOK_S)?.or(last);
    }
    Ok(last)
}

fn add(
    follower: &mut Follower,
    source: &SourceId,
    series: &Series,
    from: usize,
    to: usize,
) -> Result<(), RecogniseError> {
    let channels = series.channels();
    let samples = &series.samples()[from * channels..to * channels];
    follower.add(FreshFrames { source, rate_hz: series.rate_hz(), channels, samples })
}
