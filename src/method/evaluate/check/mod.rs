//! Audits a library: tells which trials are named correctly when left out, which look mislabelled,
//! what is damaged, and what to record next.

mod finding;
mod inspect;
mod suspect;

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use serde::ser::{SerializeMap, Serializer};

use self::finding::FaultKind;
pub use self::finding::Finding;
use self::inspect::{Inspected, inspect};
use self::suspect::{Suspects, suspects};
use super::evaluation::{Evaluation, Measured, ProgressFn};
use super::fold::{Fold, Protocol, folds};
use super::leak::Leaks;
use super::outcome::{Confusion, FoldAccuracy, Interval, Over, Prediction, Share};
use super::paired::better_plain;
use super::still::still;
use crate::library::{Entry, Opened};
use crate::recognise::{Method, MethodName};
use crate::scene::{Scene, SourceId};
use crate::trial::{Doubt, TrialKey, lines};

/// Largest number of folds. A fold leaves out several trials of a surface that has more than this.
const MOST_FOLDS: usize = 10;
/// Number of trials that each surface should have.
const ENOUGH: usize = 5;
/// Fewest left-out trials with which unknown surfaces can be rejected at 1 % false rejections.
const FOR_UNKNOWN: usize = 99;

#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct CheckReport {
    pub trials: usize,
    /// How many of the left-out trials were named correctly, with the interval; `None` if no trial could
    /// be left out.
    #[serde(flatten, serialize_with = "left_out_share")]
    pub share: Option<(Share, Interval)>,
    pub left_out: String,
    /// How many trials of each surface the accuracy does not count, since no library without them has their
    /// surface.
    pub not_asked: BTreeMap<String, usize>,
    pub surfaces: Vec<SurfaceCheck>,
    /// Confusion matrix of the trials that the accuracy counts: truth against answer.
    pub confusion: Option<Confusion>,
    pub each: Vec<TrialCheck>,
    /// Accuracy, a fraction, without the damaged trials; `None` if there are none.
    pub accuracy_mended: Option<f64>,
    /// Things to fix, the worst first.
    pub findings: Vec<Finding>,
    /// The findings as text, one line for each.
    pub mend: Vec<String>,
    /// Advice, such as what to record next; one line for each piece of advice.
    pub advice: Vec<String>,
}

#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct SurfaceCheck {
    pub surface: String,
    pub trials: usize,
    pub users: usize,
    /// How many of its trials were named correctly, with the interval; `None` if too few people or sessions
    /// were left out.
    #[serde(flatten, serialize_with = "share_of_surface")]
    pub share: (Share, Option<Interval>),
    /// The wrong names of the surface's trials, and how often each occurred, the most frequent first.
    pub taken_for: Vec<(String, u32)>,
}

/// Whether a left-out trial was named correctly.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum TrialVerdict {
    Right,
    Wrong,
    /// The trial was not left out, for example because it is the only one of its surface.
    Untested,
}

#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct TrialCheck {
    #[serde(flatten)]
    pub key: TrialKey,
    pub verdict: TrialVerdict,
    /// The surface that the trial was named when it was left out, if any.
    pub named: Option<String>,
    /// ln of the ratio of the second-best surface's score to the answer's score.
    pub margin: Option<f64>,
    /// Whether the trial was named another surface so surely that its label looks wrong.
    pub mislabelled: bool,
    /// The faults of its sensors as lines, and as data.
    pub flaws: Vec<String>,
    pub doubts: Vec<Doubt>,
}

type Named = Option<(Share, Interval)>;

fn left_out_share<S: Serializer>(named: &Named, to: S) -> Result<S::Ok, S::Error> {
    let mut map = to.serialize_map(None)?;
    map.serialize_entry("accuracy", &named.map(|(share, _)| share.value()))?;
    map.serialize_entry("accuracy_low", &named.map(|(_, interval)| interval.low))?;
    map.serialize_entry("accuracy_high", &named.map(|(_, interval)| interval.high))?;
    map.serialize_entry("interval_over", &named.map(|(_, interval)| interval.over))?;
    map.end()
}

fn share_of_surface<S: Serializer>(
    (share, interval): &(Share, Option<Interval>),
    to: S,
) -> Result<S::Ok, S::Error> {
    let mut map = to.serialize_map(None)?;
    map.serialize_entry("queries", &share.of)?;
    map.serialize_entry("right", &share.right)?;
    map.serialize_entry("accuracy_low", &interval.map(|interval| interval.low))?;
    map.serialize_entry("accuracy_high", &interval.map(|interval| interval.high))?;
    map.end()
}

pub struct Audited<'a> {
    pub root: &'a Path,
    /// Whether `surfaced library` can edit the library.
    pub editable: bool,
    pub scene: &'a Scene,
    pub method: &'a dyn Method,
    /// Folder of the library, whose cache of prepared trials is used; `None` for no cache.
    pub cache: Option<&'a Path>,
}

/// Audits a library: leaves out trials, and names them by the remaining ones. If there are several
/// people, all trials of a person are left out together. Files that cannot be read are listed and
/// skipped. Each recording is read once, as far as memory allows.
pub fn check(opened: Opened, audited: &Audited<'_>, progress: ProgressFn<'_>) -> CheckReport {
    let entries = opened.library.entries.into_iter().map(|entry| entry.within(audited.scene));
    let (inspected, unreadable) = inspect(entries.collect(), audited.scene, progress);
    let mut findings = finding::unreadable(&opened.bad, &unreadable, audited);
    let entries: Vec<Entry> = inspected.iter().map(|one| one.entry.clone()).collect();
    let keys: Vec<TrialKey> = entries.iter().map(|entry| entry.key.clone()).collect();
    let leaks = Leaks::of(&entries, progress);
    let still = still(&entries, audited.scene);
    findings.extend(finding::never_moving(&still, &inspected, audited));
    let (of_signals, of_sources) = finding::of_signals(&inspected, &leaks, &still, audited);
    findings.extend(of_signals);
    findings.extend(finding::shared(&leaks, &keys, &entries, audited));
    let mut advice = opened.library.remarks;
    advice.extend(of_sources);
    let measured = measure(&entries, &leaks, audited, progress, Some(&mut advice));
    let measured = measured.map_err(|why| advice.push(why)).ok();
    // A damaged trial in the library causes wrong names, so labels are judged without such trials.
    let damaged = findings.iter().filter(|finding| finding.kind < FaultKind::Mislabelled);
    let damaged: BTreeSet<String> = damaged.flat_map(|one| one.trials.clone()).collect();
    let is_sound = |&i: &usize| !damaged.contains(&entries[i].name_in(audited.root));
    let places: Vec<usize> = (0..entries.len()).filter(is_sound).collect();
    let sound: Vec<Entry> = places.iter().map(|&i| entries[i].clone()).collect();
    let among_sound = leaks.among(&places);
    let of_sound = || measure(&sound, &among_sound, audited, progress, None).ok();
    let of_sound = if sound.len() < entries.len() { of_sound() } else { None };
    let judged = of_sound.as_ref().or(measured.as_ref());
    let judged = judged.map_or(&[][..], |judged| &judged.predictions);
    let mut suspects = suspects(judged);
    let moved = suspect::moved(judged, &mut suspects);
    findings.extend(suspect::differing(&moved, &inspected, audited));
    let wrong = sound.iter().filter(|entry| suspects.contains_key(&entry.key));
    let named = |entry: &Entry| (entry.name_in(audited.root), suspects[&entry.key].to_string());
    let mut wrong: Vec<(String, String)> = wrong.map(named).collect();
    findings.extend(finding::copies_of_two_labels(&inspected, &leaks, &mut wrong, audited));
    findings.extend(finding::mislabelled(&wrong, audited));
    findings.sort_by_key(|finding| finding.kind);
    let accuracy_mended = of_sound.as_ref().map(|measured| measured.outcome.share.value());
    let predictions = measured.as_ref().map_or(&[][..], |measured| &measured.predictions);
    let each = trials(&keys, predictions, &inspected, &suspects);
    let outcome = measured.as_ref().map(|measured| &measured.outcome);
    // The trials that the accuracy counts come first.
    let counted = &predictions[..outcome.map_or(0, |outcome| outcome.queries)];
    let over = outcome.map_or(Over::Queries, |outcome| outcome.interval.over);
    let surfaces = surfaces(&keys, counted, over);
    let untested = |one: &SurfaceCheck| (one.surface.clone(), one.trials - one.share.0.of);
    let not_asked = surfaces.iter().map(untested).filter(|(_, count)| *count > 0).collect();
    advice.extend(missing(&entries));
    advice.extend(alike("people", keys.iter().map(|key| &*key.user)));
    advice.extend(alike("surfaces", keys.iter().map(|key| &*key.surface)));
    advice.extend(next(&surfaces, &keys));
    let line = |finding: &Finding| match &finding.command {
        Some(command) => format!("{}: {command}", finding.text),
        None => finding.text.clone(),
    };
    CheckReport {
        trials: keys.len(),
        share: outcome.map(|outcome| (outcome.share, outcome.interval)),
        left_out: hardest(&keys).1.into(),
        not_asked,
        confusion: outcome.map(|outcome| outcome.confusion.clone()),
        surfaces,
        each,
        accuracy_mended,
        mend: findings.iter().map(line).collect(),
        findings,
        advice,
    }
}

/// The hardest protocol that the keys allow, if it leaves out people or sessions, and which trials are
/// left out.
fn hardest(keys: &[TrialKey]) -> (Option<Protocol>, &'static str) {
    let fitting = Protocol::fitting(keys).filter(|protocol| protocol.over() != Over::Queries);
    (fitting, fitting.unwrap_or(Protocol::LeaveOneTrialOut).left_out())
}

/// Makes the folds that the accuracy counts: those of the [`hardest`] protocol, or else [`by_parts`]. Then
/// those by parts that leave out the remaining trials, for example of a surface that only one person
/// recorded: only the search for wrong labels uses these. Also tells what an interval is over.
fn left_out(keys: &[TrialKey]) -> (Vec<Fold>, Vec<Fold>, Over) {
    // A protocol that fits has folds.
    let Some((over, folds)) =
        hardest(keys).0.and_then(|one| Some((one.over(), folds(one, keys).ok()?)))
    else {
        return (by_parts(keys), Vec::new(), Over::Queries);
    };
    let done: BTreeSet<usize> = folds.iter().flat_map(|fold| fold.queries.clone()).collect();
    let rest = by_parts(keys).into_iter().map(|fold| {
        let queries = fold.queries.iter().copied().filter(|i| !done.contains(i)).collect();
        Fold { queries, ..fold }
    });
    let rest = rest.filter(|fold| !fold.queries.is_empty()).collect();
    (folds, rest, over)
}

/// Makes folds: fold k leaves out the k-th trial of every surface with several trials.
fn by_parts(keys: &[TrialKey]) -> Vec<Fold> {
    let mut of_surface: BTreeMap<&str, Vec<usize>> = BTreeMap::new();
    for (i, key) in keys.iter().enumerate() {
        of_surface.entry(&key.surface).or_default().push(i);
    }
    let most = of_surface.values().map(Vec::len).max().unwrap_or(0).min(MOST_FOLDS);
    let fold = |k: usize| {
        let several = of_surface.values().filter(|trials| trials.len() > 1);
        // Never all trials of a surface: if they are fewer than the folds, each is in one fold.
        let of = |trials: &Vec<usize>| {
            (k..trials.len()).step_by(trials.len().min(most)).map(|i| trials[i]).collect::<Vec<_>>()
        };
        let queries: Vec<usize> = several.flat_map(of).collect();
        let library = (0..keys.len()).filter(|i| !queries.contains(i)).collect();
        Fold { name: format!("part {}", k + 1), library, queries }
    };
    (0..most).map(fold).filter(|fold| !fold.queries.is_empty()).collect()
}

/// Names each trial when left out, never by trials that share its samples if others are left. The outcome
/// is of the first predictions, those that the accuracy counts. Adds to `advice`, if given, that `svm` is
/// better than the default.
fn measure(
    entries: &[Entry],
    leaks: &Leaks,
    audited: &Audited<'_>,
    progress: ProgressFn<'_>,
    advice: Option<&mut Vec<String>>,
) -> Result<Measured, String> {
    let Audited { scene, method, cache, .. } = *audited;
    let keys: Vec<TrialKey> = entries.iter().map(|entry| entry.key.clone()).collect();
    let (counted, rest, over) = left_out(&keys);
    let apart = |folds: Vec<Fold>| leaks.apart(&folds, &keys).unwrap_or(folds);
    let (counted, rest) = (apart(counted), apart(rest));
    let folds = [&counted[..], &rest].concat();
    let surfaces: BTreeSet<&str> = keys.iter().map(|key| key.surface.as_str()).collect();
    if surfaces.len() < 2 || folds.is_empty() {
        let needed = "two surfaces, and two trials of one of them";
        return Err(format!("no trial can be left out and named: that takes {needed}"));
    }
    let evaluation = Evaluation { cache, progress, ..Evaluation::new(scene, entries, &folds) };
    let run = evaluation.prepare(method).map_err(|error| error.to_string())?;
    let mut measured = run.measure().map_err(|error| error.to_string())?;
    let of_counted = measured.predictions.partition_point(|p| p.fold < counted.len());
    measured.outcome = run.sum_up(&counted, &measured.predictions[..of_counted]).over(over);
    if let Some(advice) = advice
        && method.name() == MethodName::Embedding.as_str()
    {
        let evaluation = Evaluation { folds: &counted, ..evaluation };
        advice.extend(better_plain(evaluation, &measured.predictions[..of_counted], over));
    }
    Ok(measured)
}

fn trials(
    keys: &[TrialKey],
    predictions: &[Prediction],
    inspected: &[Inspected],
    suspects: &Suspects<'_>,
) -> Vec<TrialCheck> {
    let by_key: BTreeMap<&TrialKey, &Prediction> =
        predictions.iter().map(|prediction| (&prediction.key, prediction)).collect();
    let one = |(key, inspected): (&TrialKey, &Inspected)| {
        let prediction = by_key.get(key).copied();
        let is_right = prediction.map(Prediction::is_correct);
        TrialCheck {
            key: key.clone(),
            verdict: match is_right {
                None => TrialVerdict::Untested,
                Some(true) => TrialVerdict::Right,
                Some(false) => TrialVerdict::Wrong,
            },
            named: prediction.map(|p| p.surface.clone()).filter(|named| !named.is_empty()),
            margin: prediction.map(|p| p.margin),
            mislabelled: suspects.contains_key(key),
            flaws: lines(&inspected.doubts),
            doubts: inspected.doubts.clone(),
        }
    };
    keys.iter().zip(inspected).map(one).collect()
}

fn surfaces(keys: &[TrialKey], predictions: &[Prediction], over: Over) -> Vec<SurfaceCheck> {
    let labels: BTreeSet<&str> = keys.iter().map(|key| key.surface.as_str()).collect();
    let of = |label: &str| {
        let own = || keys.iter().filter(|key| key.surface == label);
        let queries: Vec<_> = predictions.iter().filter(|p| p.key.surface == label).collect();
        let share = Share::count(queries.iter().map(|p| p.is_correct()));
        let mut folds: BTreeMap<usize, Share> = BTreeMap::new();
        queries.iter().for_each(|p| folds.entry(p.fold).or_default().add(p.is_correct()));
        let folds = folds.into_values().map(|share| FoldAccuracy { name: String::new(), share });
        let interval = Interval::of(&folds.collect::<Vec<_>>(), over);
        let interval = Some(interval).filter(|one| share.of > 0 && one.over == over);
        let mut taken: BTreeMap<&str, u32> = BTreeMap::new();
        let named = |p: &&&Prediction| !p.is_correct() && !p.surface.is_empty();
        queries.iter().filter(named).for_each(|p| {
            *taken.entry(p.surface.as_str()).or_default() += 1;
        });
        let mut taken_for: Vec<_> = taken.into_iter().map(|(s, n)| (s.to_string(), n)).collect();
        taken_for.sort_by_key(|(_, count)| std::cmp::Reverse(*count));
        SurfaceCheck {
            surface: label.into(),
            trials: own().count(),
            users: own().map(|key| &key.user).collect::<BTreeSet<_>>().len(),
            share: (share, interval),
            taken_for,
        }
    };
    labels.into_iter().map(of).collect()
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
        Some(format!("{id} is missing in {}{more}; compared without it", first.key))
    };
    all.into_iter().filter_map(of).collect()
}

/// Names of different people or surfaces that only capitals tell apart.
fn alike<'a>(what: &str, names: impl Iterator<Item = &'a str>) -> Vec<String> {
    let mut spelt: BTreeMap<String, BTreeSet<&str>> = BTreeMap::new();
    for name in names {
        spelt.entry(name.to_lowercase()).or_default().insert(name);
    }
    let several = spelt.into_values().filter(|names| names.len() > 1);
    let all = several.map(|names| Vec::from_iter(names).join("`, `"));
    all.map(|all| format!("`{all}` count as different {what}; spell them alike")).collect()
}

fn next(surfaces: &[SurfaceCheck], keys: &[TrialKey]) -> Vec<String> {
    let mut advice = Vec::new();
    let most = surfaces.iter().map(|surface| surface.trials).max().unwrap_or(0).min(2 * ENOUGH);
    let wanted = most.max(ENOUGH);
    for surface in surfaces {
        let SurfaceCheck { surface: name, trials, share, taken_for, .. } = surface;
        let Share { right, of: queries } = share.0;
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recognise::MethodSpec;
    use crate::trial::{Series, Trial};

    fn left(folds: &[Fold]) -> Vec<usize> {
        let mut left: Vec<usize> = folds.iter().flat_map(|fold| fold.queries.clone()).collect();
        left.sort_unstable();
        left
    }

    #[test]
    fn a_fold_never_leaves_out_all_trials_of_a_surface() {
        let mut keys: Vec<TrialKey> = (1..=23).map(|n| TrialKey::new("a", "x", n)).collect();
        keys.extend((1..=3).map(|n| TrialKey::new("b", "x", n)));
        keys.push(TrialKey::new("c", "x", 1));
        let (folds, rest, _) = left_out(&keys);
        assert_eq!((folds.len(), rest), (MOST_FOLDS, vec![]));
        assert!(left(&folds).into_iter().eq(0..26), "each once, except the only one of c");
        for surface in ["a", "b", "c"] {
            let holds = |fold: &Fold| fold.library.iter().any(|&i| keys[i].surface == surface);
            assert!(folds.iter().all(holds), "{surface}");
        }
    }

    #[test]
    fn every_person_is_left_out_where_there_are_several() {
        let of = |user| ["a", "b"].map(|surface| TrialKey::new(surface, user, 1));
        let mut keys = ["anna", "ben"].map(of).concat();
        // Only anna has trials of c.
        keys.extend((1..=2).map(|n| TrialKey::new("c", "anna", n)));
        let (folds, rest, over) = left_out(&keys);
        assert_eq!(over, Over::People);
        let of = |names: [&str; 2]| names.map(String::from).to_vec();
        let names = |folds: &[Fold]| folds.iter().map(|f| f.name.clone()).collect::<Vec<_>>();
        assert_eq!((names(&folds), names(&rest)), (of(["anna", "ben"]), of(["part 1", "part 2"])));
        assert!(folds[0].queries == [0, 1] && folds[0].library == [2, 3]);
        assert!(left(&[folds, rest].concat()).into_iter().eq(0..6));
    }

    /// Eight trials of each of two surfaces by each of three people, and of a third by one of them alone.
    #[test]
    fn an_accuracy_for_other_people_counts_no_trial_that_is_named_by_the_same_person_s() {
        let scene = Scene::lmt108();
        let entry = |surface: &str, user: &str, n: u32| {
            let pitch = 0.2 + 0.1 * surface.len() as f32;
            let value = |i: usize| (i as f32 * pitch + n as f32).sin();
            let series = Series::new(100.0, 1, (0..200).map(value).collect()).unwrap();
            let (key, id) = (TrialKey::new(surface, user, n), SourceId::new("ir").unwrap());
            Entry::in_memory(Trial::of_series(key, id, series))
        };
        let shared = ["anna", "ben", "cleo"].into_iter().flat_map(|user| {
            ["a", "bb"].into_iter().flat_map(move |s| (1..=4).map(move |n| (s, user, n)))
        });
        let own = (1..=8).map(|n| ("cccc", "anna", n));
        let entries: Vec<Entry> = shared.chain(own).map(|(s, user, n)| entry(s, user, n)).collect();
        let method = &*MethodSpec::from(MethodName::Knn).build(&scene);
        let root = Path::new("lib");
        let audited = Audited { root, editable: true, scene: &scene, method, cache: None };
        let measured = measure(&entries, &Leaks::default(), &audited, &|_, _, _| (), None).unwrap();
        let Measured { outcome, predictions, .. } = measured;
        assert_eq!((outcome.share.of, outcome.interval.over), (24, Over::People));
        assert_eq!(predictions.len(), 32, "all are searched for wrong labels");
        let keys: Vec<TrialKey> = entries.iter().map(|entry| entry.key.clone()).collect();
        let rows = surfaces(&keys, &predictions[..24], Over::People);
        let tested = rows.iter().map(|row| (row.share.0.of, row.share.1.map(|one| one.over)));
        let of_people = Some(Over::People);
        assert!(tested.eq([(12, of_people), (12, of_people), (0, None)]), "{rows:?}");
    }
}
