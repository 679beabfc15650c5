//! The audit of a library: which trials are named right when they are left out, which look
//! mislabelled, what is damaged, and what to record next.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use rayon::prelude::*;
use serde::ser::{SerializeMap, Serializer};

use super::evaluation::{Evaluation, ProgressFn};
use super::fold::Fold;
use super::outcome::{Confusion, Outcome, Prediction};
use super::plain::better_plain;
use super::share::Share;
use crate::library::audit::{self, Unreadable};
use crate::library::{Entry, Opened};
use crate::recognise::{Method, MethodName};
use crate::scene::{Scene, SourceId};
use crate::trial::{Flaw, Signal, TrialKey, flaws, is_plain};

/// Most folds: more trials of a surface are left out several at a time.
const MOST_FOLDS: usize = 10;
/// Trials of a surface that are worth having.
const ENOUGH: usize = 5;
/// Left-out trials that it takes to reject unknown surfaces at 1 % false rejections.
const FOR_UNKNOWN: usize = 99;

/// The audit of a library.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct CheckReport {
    /// Trials that could be used.
    pub trials: usize,
    /// Trials that were left out, and those named right; `None` where none could be left out.
    #[serde(flatten, serialize_with = "left_out_share")]
    pub share: Option<Share>,
    /// Surface by surface, sorted.
    pub surfaces: Vec<SurfaceCheck>,
    /// Truth against answer.
    pub confusion: Option<Confusion>,
    /// Trial by trial, sorted.
    pub each: Vec<TrialCheck>,
    /// Things to fix, a line each.
    pub mend: Vec<String>,
    /// Things to record next, and other advice, a line each.
    pub advice: Vec<String>,
}

/// The audit of a surface.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct SurfaceCheck {
    /// The label.
    pub surface: String,
    /// Its trials.
    pub trials: usize,
    /// The people who dragged.
    pub users: usize,
    /// Those that were left out, and those named right.
    #[serde(flatten, serialize_with = "share_of_surface")]
    pub share: Share,
    /// The surfaces it was taken for, the most frequent first.
    pub taken_for: Vec<(String, u32)>,
}

/// The answer to a left-out trial.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum TrialVerdict {
    /// Its surface.
    Right,
    /// Another one.
    Wrong,
    /// It was not left out: it is the only trial of its surface.
    Untested,
}

/// The audit of a trial.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct TrialCheck {
    /// The trial.
    #[serde(flatten)]
    pub key: TrialKey,
    /// The answer when it was left out.
    pub verdict: TrialVerdict,
    /// The surface that it was named, if it was.
    pub named: Option<String>,
    /// ln of the ratio by which the answer was ahead of the next.
    pub margin: Option<f64>,
    /// It is named another surface more clearly than most trials are named theirs.
    pub mislabelled: bool,
    /// Flaws of its signals, a line each.
    pub flaws: Vec<String>,
}

// The signatures are serde's.
#[allow(clippy::ref_option)]
fn left_out_share<S: Serializer>(share: &Option<Share>, to: S) -> Result<S::Ok, S::Error> {
    Share::write(*share, None, "accuracy", to)
}

#[allow(clippy::trivially_copy_pass_by_ref)]
fn share_of_surface<S: Serializer>(share: &Share, to: S) -> Result<S::Ok, S::Error> {
    let (low, high) = share.interval();
    let mut map = to.serialize_map(None)?;
    map.serialize_entry("queries", &share.of)?;
    map.serialize_entry("right", &share.right)?;
    map.serialize_entry("accuracy_low", &low)?;
    map.serialize_entry("accuracy_high", &high)?;
    map.end()
}

/// Audits a library: its trials are left out and named by `method`, up to ten times. Files that
/// cannot be read are listed and do without. `cache` is the library's folder, if prepared trials are
/// kept there.
pub fn check(
    opened: Opened,
    scene: &Scene,
    method: &dyn Method,
    cache: Option<&Path>,
    progress: ProgressFn<'_>,
) -> CheckReport {
    let mut mend: Vec<String> = opened.bad.iter().map(ToString::to_string).collect();
    let entries: Vec<Entry> = opened.library.entries.into_iter().map(|e| e.within(scene)).collect();
    progress("reading all recordings", 0, 1);
    let unreadable = audit::unreadable(&entries);
    mend.extend(unreadable.iter().map(|Unreadable { error, .. }| error.to_string()));
    let entries = audit::without(entries, &unreadable);
    let inspected: Vec<Inspected> = entries.par_iter().map(|e| inspect(e, scene)).collect();
    let keys: Vec<TrialKey> = entries.iter().map(|entry| entry.key.clone()).collect();
    let mut advice = opened.library.remarks;
    let folds = left_out(&keys);
    let measured = measure(&entries, &folds, scene, method, cache, progress);
    let (predictions, outcome) = match measured {
        Ok((predictions, outcome, better)) => {
            advice.extend(better);
            (predictions, Some(outcome))
        }
        Err(why) => {
            advice.push(why);
            (Vec::new(), None)
        }
    };
    let each = trials(&keys, &predictions, &inspected);
    let surfaces = surfaces(&keys, &predictions);
    mend.extend(flawed(&each));
    mend.extend(duplicates(&keys, &inspected));
    mend.extend(each.iter().filter(|trial| trial.mislabelled).map(|trial| {
        let named = trial.named.as_deref().unwrap_or_default();
        format!("{} looks mislabelled: left out, it is clearly named {named}", trial.key)
    }));
    advice.extend(missing(&entries));
    advice.extend(next(&surfaces, &keys));
    CheckReport {
        trials: keys.len(),
        share: outcome.as_ref().map(|outcome| outcome.share),
        confusion: outcome.map(|outcome| outcome.confusion),
        surfaces,
        each,
        mend,
        advice,
    }
}

/// Fold k leaves out the k-th trial of every surface that has another one.
fn left_out(keys: &[TrialKey]) -> Vec<Fold> {
    let mut of_surface: BTreeMap<&str, Vec<usize>> = BTreeMap::new();
    for (i, key) in keys.iter().enumerate() {
        of_surface.entry(&key.surface).or_default().push(i);
    }
    let most = of_surface.values().map(Vec::len).max().unwrap_or(0).min(MOST_FOLDS);
    let fold = |k: usize| {
        let of = |trials: &Vec<usize>| match trials.len() {
            1 => Vec::new(),
            n => {
                // Never all trials of a surface at once.
                let folds = n.min(most);
                let at = |(i, &trial): (usize, &usize)| (i % folds == k).then_some(trial);
                trials.iter().enumerate().filter_map(at).collect::<Vec<_>>()
            }
        };
        let queries: Vec<usize> = of_surface.values().flat_map(of).collect();
        let library = (0..keys.len()).filter(|i| !queries.contains(i)).collect();
        Fold { name: format!("part {}", k + 1), library, queries }
    };
    (0..most).map(fold).filter(|fold| !fold.queries.is_empty()).collect()
}

fn measure(
    entries: &[Entry],
    folds: &[Fold],
    scene: &Scene,
    method: &dyn Method,
    cache: Option<&Path>,
    progress: ProgressFn<'_>,
) -> Result<(Vec<Prediction>, Outcome, Option<String>), String> {
    let surfaces: BTreeSet<&str> = entries.iter().map(|e| e.key.surface.as_str()).collect();
    if surfaces.len() < 2 || folds.is_empty() {
        return Err(
            "no trial can be left out and named: that takes two surfaces, and two trials of \
                    one of them"
                .into(),
        );
    }
    let evaluation = Evaluation { cache, progress, ..Evaluation::new(scene, entries, folds) };
    let run = evaluation.prepare(method).map_err(|error| error.to_string())?;
    let measured = run.measure().map_err(|error| error.to_string())?;
    let is_default = method.name() == MethodName::Embedding.as_str();
    let better = is_default.then(|| better_plain(evaluation, &measured.predictions)).flatten();
    Ok((measured.predictions, measured.outcome, better))
}

fn trials(
    keys: &[TrialKey],
    predictions: &[Prediction],
    inspected: &[Inspected],
) -> Vec<TrialCheck> {
    let by_key: BTreeMap<&TrialKey, &Prediction> =
        predictions.iter().map(|prediction| (&prediction.key, prediction)).collect();
    let mut right: Vec<f64> =
        predictions.iter().filter(|p| p.is_correct()).map(|p| p.margin).collect();
    right.sort_by(f64::total_cmp);
    // If most are wrong, nothing is clear.
    let clear = match right.len() * 2 > predictions.len() {
        true => right[right.len() / 2],
        false => f64::INFINITY,
    };
    let usual = resting(inspected);
    let one = |(key, inspected): (&TrialKey, &Inspected)| {
        let prediction = by_key.get(key).copied();
        let is_right = prediction.map(Prediction::is_correct);
        let flaws = inspected.flaws.iter().filter(|(id, flaw)| match flaw {
            Flaw::Constant { channel, .. } => !usual.contains(&(id, *channel)),
            Flaw::Stuck { .. } | Flaw::Saturated { .. } => true,
        });
        let flaws = flaws.map(|(id, flaw)| format!("{id}: {flaw}"));
        let plain = inspected.plain.iter().map(|id| format!("{id}: the picture is of one colour"));
        TrialCheck {
            key: key.clone(),
            verdict: match is_right {
                None => TrialVerdict::Untested,
                Some(true) => TrialVerdict::Right,
                Some(false) => TrialVerdict::Wrong,
            },
            named: prediction.map(|p| p.surface.clone()).filter(|named| !named.is_empty()),
            margin: prediction.map(|p| p.margin),
            mislabelled: is_right == Some(false) && prediction.is_some_and(|p| p.margin >= clear),
            flaws: flaws.chain(plain).collect(),
        }
    };
    keys.iter().zip(inspected).map(one).collect()
}

fn surfaces(keys: &[TrialKey], predictions: &[Prediction]) -> Vec<SurfaceCheck> {
    let labels: BTreeSet<&str> = keys.iter().map(|key| key.surface.as_str()).collect();
    let of = |label: &str| {
        let own = || keys.iter().filter(|key| key.surface == label);
        let queries: Vec<_> = predictions.iter().filter(|p| p.key.surface == label).collect();
        let share = Share::count(queries.iter().map(|p| p.is_correct()));
        let mut taken: BTreeMap<&str, u32> = BTreeMap::new();
        queries.iter().filter(|p| !p.is_correct()).for_each(|p| {
            *taken.entry(p.surface.as_str()).or_default() += 1;
        });
        let mut taken_for: Vec<_> = taken.into_iter().map(|(s, n)| (s.to_string(), n)).collect();
        taken_for.sort_by_key(|(_, count)| std::cmp::Reverse(*count));
        SurfaceCheck {
            surface: label.into(),
            trials: own().count(),
            users: own().map(|key| &key.user).collect::<BTreeSet<_>>().len(),
            share,
            taken_for,
        }
    };
    labels.into_iter().map(of).collect()
}

/// Flaws, the same of many trials as one line.
fn flawed(each: &[TrialCheck]) -> Vec<String> {
    let lines = each.iter().flat_map(|trial| trial.flaws.iter().map(move |f| (f, &trial.key)));
    lines.map(|(flaw, key)| format!("{key}: {flaw}")).collect()
}

fn missing(entries: &[Entry]) -> Vec<String> {
    let all: BTreeSet<&SourceId> = entries.iter().flat_map(|entry| &entry.sources).collect();
    let of = |id: &SourceId| {
        let mut without = entries.iter().filter(|entry| !entry.sources.contains(id));
        let first = without.next()?;
        let more = match without.count() {
            0 => String::new(),
            n => format!(" and {n} more"),
        };
        Some(format!("{id} is missing in {}{more}; it counts less for that", first.key))
    };
    all.into_iter().filter_map(of).collect()
}

/// Advice on what to record next.
fn next(surfaces: &[SurfaceCheck], keys: &[TrialKey]) -> Vec<String> {
    let mut advice = Vec::new();
    let most = surfaces.iter().map(|surface| surface.trials).max().unwrap_or(0).min(2 * ENOUGH);
    let wanted = most.max(ENOUGH);
    for surface in surfaces {
        let SurfaceCheck { surface: name, trials, share, taken_for, .. } = surface;
        let Share { right, of: queries } = *share;
        if *trials < ENOUGH || trials * 2 < most {
            advice.push(format!("record {} more of {name}: it has {trials}", wanted - trials));
        } else if let Some((other, count)) = taken_for.first()
            && (queries - right) * 5 >= queries
        {
            advice.push(format!(
                "record more of {name} and {other}: {count} of {queries} trials of {name} are taken \
                 for {other}"
            ));
        }
    }
    let users: BTreeSet<&str> = keys.iter().map(|key| key.user.as_str()).collect();
    if let (Some(user), 1) = (users.first(), users.len()) {
        advice.push(format!("all trials are by `{user}`: for other people's scans, record theirs"));
    }
    if keys.len() < FOR_UNKNOWN {
        let n = FOR_UNKNOWN - keys.len();
        advice
            .push(format!("record {n} more trials to detect unknown surfaces at 1 % false alarms"));
    }
    advice
}

/// The flaws of one trial's signals.
struct Inspected {
    flaws: Vec<(SourceId, Flaw)>,
    plain: Vec<SourceId>,
    /// A number for each series that changes.
    hashes: Vec<(SourceId, u64)>,
}

/// Reads a trial.
fn inspect(entry: &Entry, scene: &Scene) -> Inspected {
    let mut found = Inspected { flaws: Vec::new(), plain: Vec::new(), hashes: Vec::new() };
    // All of it could be read a moment ago.
    let Ok(trial) = entry.load() else { return found };
    for (id, signal) in &trial.signals {
        let is_switch = scene.get(id.as_str()).is_some_and(|spec| spec.sigma.is_some());
        match signal {
            Signal::Image(image) if is_plain(image) => found.plain.push(id.clone()),
            Signal::Series(series) if !is_switch => {
                found.flaws.extend(flaws(series).into_iter().map(|flaw| (id.clone(), flaw)));
                if !series.is_constant() {
                    found.hashes.push((id.clone(), signal.content_hash()));
                }
            }
            Signal::Image(_) | Signal::Series(_) => {}
        }
    }
    found
}

/// Channels that rest in half of the trials or more: that is how they are.
fn resting(inspected: &[Inspected]) -> BTreeSet<(&SourceId, usize)> {
    let mut counts: BTreeMap<(&SourceId, usize), usize> = BTreeMap::new();
    for (id, flaw) in inspected.iter().flat_map(|inspected| &inspected.flaws) {
        if let Flaw::Constant { channel, .. } = flaw {
            *counts.entry((id, *channel)).or_default() += 1;
        }
    }
    counts.retain(|_, count| *count * 2 >= inspected.len());
    counts.into_keys().collect()
}

/// Trials with a series that another one has.
fn duplicates(keys: &[TrialKey], inspected: &[Inspected]) -> Vec<String> {
    let mut seen: BTreeMap<(&SourceId, u64), &TrialKey> = BTreeMap::new();
    let mut twice: BTreeMap<(&TrialKey, &TrialKey), Vec<&str>> = BTreeMap::new();
    for (key, inspected) in keys.iter().zip(inspected) {
        for (id, hash) in &inspected.hashes {
            match seen.get(&(id, *hash)) {
                Some(first) => twice.entry((first, key)).or_default().push(id.as_str()),
                None => drop(seen.insert((id, *hash), key)),
            }
        }
    }
    let say = |((first, second), sources): ((&TrialKey, &TrialKey), Vec<&str>)| {
        format!("{second} is a copy of {first} ({}); remove one", sources.join(", "))
    };
    twice.into_iter().map(say).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fold_never_leaves_out_all_trials_of_a_surface() {
        let mut keys: Vec<TrialKey> = (1..=23).map(|n| TrialKey::new("a", "x", n)).collect();
        keys.extend((1..=3).map(|n| TrialKey::new("b", "x", n)));
        keys.push(TrialKey::new("c", "x", 1));
        let folds = left_out(&keys);
        assert_eq!(folds.len(), MOST_FOLDS);
        let mut left: Vec<usize> = folds.iter().flat_map(|fold| fold.queries.clone()).collect();
        left.sort_unstable();
        assert_eq!(left, (0..26).collect::<Vec<_>>(), "each once, except the only one of c");
        for fold in &folds {
            for surface in ["a", "b", "c"] {
                assert!(fold.library.iter().any(|&i| keys[i].surface == surface));
            }
        }
    }
}
