//! Measures the answers that are no plain names of whole scans: early answers, given by a stop rule, and
//! `unknown`, for queries of surfaces that the library lacks.

use std::collections::BTreeSet;

use serde::Serializer;

use super::evaluation::Run;
use super::outcome::value;
use super::{EvaluateError, FoldAccuracy, Interval, Over, Share, percentile};
use crate::recognise::{
    FollowOptions, Follower, FreshFrames, GuessSoFar, LOOK_S, RecogniseError, Rejection,
    RejectionError, Settling, if_enough,
};
use crate::scene::Scene;
use crate::system::processor_s;
use crate::trial::{Signal, Trial};

/// The answers of the stop rule, compared with the answers from whole scans. Shares are from 0 to 1.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct SettledOutcome {
    pub stated_loss: f64,
    /// How many of all queries the stop rule names correctly.
    #[serde(rename = "accuracy", serialize_with = "value")]
    pub share: Share,
    #[serde(flatten)]
    pub interval: Interval,
    /// Share of queries that the whole scan names correctly.
    pub accuracy_whole: f64,
    /// Number of queries that the whole scan names correctly and the stop rule does not.
    pub lost: usize,
    /// Number of queries that the stop rule names correctly and the whole scan does not.
    pub gained: usize,
    pub queries: usize,
    /// Number of queries that the stop rule named before the end of the scan.
    pub settled: usize,
    pub scan_s_mean: f64,
    pub scan_s_p50: f64,
    pub whole_s_mean: f64,
    /// Processor time for following whole scans with ten guesses a second, divided by the scans'
    /// duration: 1 is one core. `None` if the system does not measure processor time (Windows).
    pub core_share: Option<f64>,
    /// The stop rule of each fold, and its results on left-out library trials.
    pub rules: Vec<Settling>,
}

impl SettledOutcome {
    /// Follows every query, with a stop rule that may lose a share `loss` of accuracy; the interval is
    /// `over` what the folds leave out. As in a live scan, frames arrive in blocks of `LOOK_S` = 0.1 s, each followed by a guess.
    ///
    /// # Errors
    /// If a trial cannot be read or compared, or if the method cannot follow scans.
    pub fn of(run: &Run<'_, '_>, loss: f64, over: Over) -> Result<Self, EvaluateError> {
        let (scene, folds) = (run.on.scene, run.on.folds);
        let total: usize = folds.iter().map(|fold| fold.queries.len()).sum();
        let (mut by_rule, mut by_whole) = (Share::default(), Share::default());
        let mut of_folds = Vec::new();
        let (mut lost, mut gained, mut settled) = (0, 0, 0);
        let (mut used_s, mut whole_s) = (Vec::with_capacity(total), 0.0);
        let (mut rules, mut busy_s) = (Vec::new(), Some(0.0));
        for fold in folds {
            let model = run.fit(&fold.library)?;
            let embedding = (model.clone().embedding())
                .ok_or(EvaluateError::Follow { method: run.method.name() })?;
            let mut follower = embedding.follow(&FollowOptions { loss, rejection: None });
            rules.push(follower.settling().clone());
            let mut of_fold = Share::default();
            for &query in &fold.queries {
                let trial = run.recording(query)?;
                let truth = &run.on.trials.key(query).surface;
                let scan_s = trial.longest_s(|id| scene.is_dragged(id)).unwrap_or(0.0);
                let start_s = processor_s();
                let guess = follow(&mut follower, &trial, scene, scan_s)?;
                let spent_s = processor_s().zip(start_s).map(|(end_s, start_s)| end_s - start_s);
                busy_s = busy_s.zip(spent_s).map(|(busy_s, spent_s)| busy_s + spent_s);
                let whole = if_enough(model.rank(&run.query_of(&model, trial)?.prepared))?;
                let whole_is_right = whole.is_some_and(|whole| whole.surface() == truth);
                // The whole scan names the query if the stop rule never settles.
                let (is_right, at_s) = match guess.and_then(|guess| guess.settled) {
                    Some((label, at_s)) => {
                        settled += 1;
                        (label == *truth, at_s)
                    }
                    None => (whole_is_right, scan_s),
                };
                of_fold.add(is_right);
                by_whole.add(whole_is_right);
                lost += usize::from(whole_is_right && !is_right);
                gained += usize::from(is_right && !whole_is_right);
                used_s.push(at_s);
                whole_s += scan_s;
                (run.on.progress)("following queries", used_s.len(), total);
            }
            by_rule.join(of_fold);
            of_folds.push(FoldAccuracy { name: fold.name.clone(), share: of_fold });
        }
        let n = used_s.len().max(1) as f64;
        Ok(Self {
            stated_loss: loss,
            share: by_rule,
            interval: Interval::of(&of_folds, over),
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
fn follow(
    follower: &mut Follower,
    trial: &Trial,
    scene: &Scene,
    scan_s: f64,
) -> Result<Option<GuessSoFar>, RecogniseError> {
    follower.begin();
    for (id, signal) in &trial.signals {
        if let Signal::Image(picture) = signal {
            follower.add_picture(id, picture);
        }
    }
    let mut last = None;
    let steps = (scan_s / LOOK_S + 1e-9).floor() as usize;
    for step in 1..=steps {
        for (source, signal) in &trial.signals {
            let Signal::Series(series) = signal else { continue };
            let (rate_hz, channels) = (series.rate_hz(), series.channels());
            let until = |step: usize| match scene.is_dragged(source) {
                true => series.frames().min((step as f64 * LOOK_S * rate_hz).ceil() as usize),
                // A tap is over before the drag, so all its frames come in the first block.
                false => series.frames() * step.min(1),
            };
            let samples = &series.samples()[until(step - 1) * channels..until(step) * channels];
            follower.add(FreshFrames { source, rate_hz, channels, samples })?;
        }
        last = follower.look(step as f64 * LOOK_S)?.or(last);
    }
    Ok(last)
}

/// How many queries were called unknown, for surfaces left out of the library and for those in it.
/// Shares are fractions from 0 to 1, with 95 % Wilson intervals over queries.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct UnknownOutcome {
    /// The stated rate of known surfaces called unknown, and its interval for the smallest library.
    pub stated: Rejection,
    /// Number of groups of surfaces that were left out in turn.
    pub groups: usize,
    /// How many queries of left-out surfaces were called unknown.
    #[serde(flatten, serialize_with = "caught")]
    pub unknown: Share,
    /// How many queries of surfaces in the library were called unknown.
    #[serde(flatten, serialize_with = "rejected")]
    pub known: Share,
    pub folds: usize,
    /// Number of folds in which the share of false rejections lies in the interval stated for the fold;
    /// `None` if none is stated.
    pub folds_as_stated: Option<usize>,
    /// The units that the intervals of the shares are over.
    pub interval_over: Over,
}

fn caught<S: Serializer>(share: &Share, to: S) -> Result<S::Ok, S::Error> {
    share.write(Some("unknown_queries"), "unknown_caught", to)
}

fn rejected<S: Serializer>(share: &Share, to: S) -> Result<S::Ok, S::Error> {
    share.write(Some("known_queries"), "false_rejections", to)
}

impl UnknownOutcome {
    /// Leaves each group of surfaces out of a fold's library in turn, and names all queries of the
    /// fold at a stated `rate` of false rejections. Surface k, in alphabetical order, is in group
    /// k mod `groups`. So surfaces with similar names, which may be similar, are in different groups.
    ///
    /// # Errors
    /// If a trial cannot be compared, or if the method or a library cannot recognise unknown
    /// surfaces at this rate.
    pub fn of(run: &Run<'_, '_>, groups: usize, rate: Option<f64>) -> Result<Self, EvaluateError> {
        let folds = run.on.folds;
        let surface = |i: usize| run.on.trials.key(i).surface.as_str();
        let surfaces: BTreeSet<&str> =
            folds.iter().flat_map(|fold| &fold.library).map(|&i| surface(i)).collect();
        let surfaces: Vec<&str> = surfaces.into_iter().collect();
        let groups = groups.min(surfaces.len());
        // The search finds every surface, since the surfaces of queries are also in a library.
        let group = |i: usize| surfaces.binary_search(&surface(i)).unwrap_or(0) % groups.max(1);
        let (mut unknown, mut known) = (Share::default(), Share::default());
        let mut as_stated = Some(0);
        let mut stated: Option<Rejection> = None;
        for (index, fold) in folds.iter().enumerate() {
            let mut queries = Vec::new();
            let (mut of_fold, mut in_fold) = (Share::default(), None);
            for left_out in 0..groups {
                let model = run.fit(fold.library.iter().filter(|&&i| group(i) != left_out))?;
                let embedding = model.clone().embedding().ok_or(RejectionError::NoPValue)?;
                let rejection = embedding.rejection(rate)?;
                if queries.is_empty() {
                    // All models expect the same rates and channels, so one preparation fits all.
                    let query =
                        |&i: &usize| Ok((i, run.query(&model, i, run.on.query_seconds)?.prepared));
                    queries =
                        fold.queries.iter().map(query).collect::<Result<_, RecogniseError>>()?;
                }
                for (i, query) in &queries {
                    // A query that says nothing is neither known nor unknown.
                    let Some(ranking) = if_enough(model.rank(query))? else { continue };
                    let p_value = ranking.p_value;
                    let count = if group(*i) == left_out { &mut unknown } else { &mut of_fold };
                    count.add(p_value.is_some_and(|p| rejection.rejects(p)));
                }
                in_fold = in_fold.or(rejection.rate_low.zip(rejection.rate_high));
                if stated.as_ref().is_none_or(|stated| rejection.trials < stated.trials) {
                    stated = Some(rejection);
                }
                let done = index * groups + left_out + 1;
                (run.on.progress)("leaving surfaces out", done, folds.len() * groups);
            }
            known.join(of_fold);
            let is_in = |(low, high)| (low..=high).contains(&of_fold.value());
            as_stated =
                as_stated.zip(in_fold).map(|(count, ends)| count + usize::from(is_in(ends)));
        }
        // At least one fold has at least two surfaces, so there is a model.
        let stated = stated.expect("at least one model");
        let folds = folds.len();
        let (folds_as_stated, interval_over) = (as_stated, Over::Queries);
        Ok(Self { stated, groups, unknown, known, folds, folds_as_stated, interval_over })
    }
}
