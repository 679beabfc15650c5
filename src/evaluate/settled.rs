//! Measures the accuracy and the scan time of answers given as soon as the stop rule settles.

use super::evaluation::Run;
use super::{EvaluateError, Share};
use crate::recognise::{
    FollowOptions, Follower, FreshFrames, GuessSoFar, LOOK_S, RecogniseError, Settling,
};
use crate::scene::{Scene, SourceId};
use crate::system::processor_s;
use crate::trial::{Series, Signal, Trial};

/// Answers by the stop rule, compared with those by the whole scan. Shares are from 0 to 1.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct SettledOutcome {
    /// Permitted loss of accuracy.
    pub stated_loss: f64,
    /// All queries, and how many of them the rule names correctly.
    #[serde(flatten)]
    pub share: Share,
    /// Share of queries that the whole scan names correctly.
    pub accuracy_whole: f64,
    /// Number of queries that the whole scan names correctly and the rule does not.
    pub lost: usize,
    /// Number of queries that the rule names correctly and the whole scan does not.
    pub gained: usize,
    /// Number of queries.
    pub queries: usize,
    /// Number of queries that settled before the scan's end.
    pub settled: usize,
    /// Mean scan time used, in seconds.
    pub scan_s_mean: f64,
    /// Median scan time used, in seconds.
    pub scan_s_p50: f64,
    /// Mean length of the whole scans, in seconds.
    pub whole_s_mean: f64,
    /// Processor time of following a scan to its end, ten looks a second, over scan time: 1 is
    /// one core; `None` where the system does not tell (Windows).
    pub core_share: Option<f64>,
    /// The rule of each fold, and what it promised.
    pub rules: Vec<Settling>,
}

/// One query: the truth, the answers by the whole scan and by the rule, and when the rule stopped.
struct StoppedQuery {
    truth: String,
    whole: String,
    settled: Option<(String, f64)>,
    scan_s: f64,
}

impl SettledOutcome {
    /// Follows every query of every fold, for a permitted loss of accuracy. Frames arrive in blocks
    /// of `LOOK_S` = 0.1 s, each followed by a guess, as in a live scan.
    ///
    /// # Errors
    /// If a trial cannot be read or compared, or if the method cannot follow scans.
    pub fn of(run: &Run<'_, '_>, loss: f64) -> Result<Self, EvaluateError> {
        let (scene, folds) = (run.on().scene, run.on().folds);
        let total: usize = folds.iter().map(|fold| fold.queries.len()).sum();
        let (mut all, mut rules, mut busy_s) = (Vec::with_capacity(total), Vec::new(), Some(0.0));
        for fold in folds {
            let model = run.fit(&fold.library)?;
            let embedding = (model.clone().embedding())
                .ok_or(EvaluateError::Follow { method: run.method().name() })?;
            let mut follower = embedding.follow(&FollowOptions { loss, rejection: None });
            rules.push(follower.settling().clone());
            for &query in &fold.queries {
                let trial = run.recording(query)?;
                let truth = run.on().trials.key(query).surface.clone();
                let scan_s = trial.longest_s(|id| scene.is_dragged(id)).unwrap_or(0.0);
                let start_s = processor_s();
                let settled = follow(&mut follower, &trial, scene, scan_s)?;
                let spent_s = processor_s().zip(start_s).map(|(end_s, start_s)| end_s - start_s);
                busy_s = busy_s.zip(spent_s).map(|(busy_s, spent_s)| busy_s + spent_s);
                let whole = model.rank(&run.query_of(&model, trial, None)?.prepared)?;
                all.push(StoppedQuery {
                    truth,
                    whole: whole.surface().into(),
                    settled: settled.and_then(|guess| guess.settled),
                    scan_s,
                });
                (run.on().progress)("following queries", all.len(), total);
            }
        }
        Ok(sum_up(&all, rules, busy_s, loss))
    }
}

fn sum_up(
    all: &[StoppedQuery],
    rules: Vec<Settling>,
    busy_s: Option<f64>,
    loss: f64,
) -> SettledOutcome {
    let by_rule = |s: &StoppedQuery| match &s.settled {
        Some((label, _)) => *label == s.truth,
        None => s.whole == s.truth,
    };
    let count = |of: &dyn Fn(&StoppedQuery) -> bool| all.iter().filter(|s| of(s)).count();
    let queries = all.len();
    let mut times: Vec<f64> =
        all.iter().map(|s| s.settled.as_ref().map_or(s.scan_s, |(_, at)| *at)).collect();
    times.sort_by(f64::total_cmp);
    let n = queries.max(1) as f64;
    let whole_s: f64 = all.iter().map(|s| s.scan_s).sum();
    SettledOutcome {
        stated_loss: loss,
        share: Share { right: count(&by_rule), of: queries },
        accuracy_whole: count(&|s| s.whole == s.truth) as f64 / n,
        lost: count(&|s| s.whole == s.truth && !by_rule(s)),
        gained: count(&|s| s.whole != s.truth && by_rule(s)),
        queries,
        settled: count(&|s| s.settled.is_some()),
        scan_s_mean: times.iter().sum::<f64>() / n,
        scan_s_p50: times.get(times.len() / 2).copied().unwrap_or(0.0),
        whole_s_mean: whole_s / n,
        core_share: busy_s.map(|busy_s| busy_s / whole_s.max(LOOK_S)),
        rules,
    }
}

/// Follows a recorded trial to its end, block by block; returns the last guess.
///
/// # Errors
/// If the trial cannot be compared.
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
