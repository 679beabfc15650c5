//! Finds trials that share samples, such as excerpts of one recording that overlap, or one file under two
//! labels. If one of them is in the library, naming the other says nothing of new scans.
//!
//! Equal fingerprints ([`Fingerprints`]) lead to a comparison of the samples themselves. The work is linear
//! in the data.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use super::ProgressFn;
use super::fold::{Fold, enough, known_only};
use crate::library::Entry;
use crate::scene::SourceId;
use crate::trial::{Fingerprints, Series, Signal, TrialKey, WINDOW, tells};

/// Most fingerprints of a series: those with the smallest hashes.
const MOST_PRINTS: usize = 256;
/// Samples that two trials have in common: their longest run.
#[derive(Clone, Debug, PartialEq)]
pub struct Shared {
    pub source: SourceId,
    /// Indices of the two trials.
    pub trials: [usize; 2],
    /// Length of the run, in seconds; 0 for a picture.
    pub seconds: f64,
    /// The run as a fraction of the shorter series.
    pub share: f64,
    /// Whether both series are the same from begin to end.
    pub is_copy: bool,
}

/// Pairs of trials that share samples.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Leaks {
    /// The trials that share samples with a trial, by its index.
    partners: BTreeMap<usize, BTreeSet<usize>>,
    /// The longest run of each pair that was compared. Of many equal trials, each is compared with the
    /// first.
    pub shared: BTreeMap<[usize; 2], Shared>,
}

impl Leaks {
    /// Reads all recordings, and finds those that share samples. Recordings that cannot be read are
    /// left out.
    pub fn of(entries: &[Entry], progress: ProgressFn<'_>) -> Self {
        let sources: BTreeSet<&SourceId> = entries.iter().flat_map(|e| &e.sources).collect();
        let all = entries.iter().map(|entry| entry.sources.len()).sum();
        let done = AtomicUsize::new(0);
        let step = || {
            let done = done.fetch_add(1, Ordering::Relaxed) + 1;
            progress("looking for trials that share samples", done, all);
        };
        let mut leaks = Self::default();
        for source in sources {
            leaks.add(entries, source, &step);
        }
        leaks
    }

    fn add(&mut self, entries: &[Entry], source: &SourceId, step: &(dyn Fn() + Sync)) {
        let prints = |(trial, entry): (usize, &Entry)| {
            if !entry.sources.contains(source) {
                return Vec::new();
            }
            step();
            let prints = load(entry, source).map_or_else(Vec::new, |signal| fingerprints(&signal));
            prints.into_iter().map(|(hash, at)| (hash, trial, at)).collect()
        };
        let mut all: Vec<(u64, usize, usize)> =
            entries.par_iter().enumerate().flat_map_iter(prints).collect();
        all.sort_unstable();
        let groups: Vec<_> = all.chunk_by(|a, b| a.0 == b.0).filter(|g| g.len() > 1).collect();
        let (shared, sharing) = compared(entries, source, &groups);
        for group in sharing {
            for &trial in &group {
                let others = group.iter().copied().filter(|&other| other != trial);
                self.partners.entry(trial).or_default().extend(others);
            }
        }
        for one in shared {
            let known = self.shared.get(&one.trials);
            if known.is_none_or(|known| known.share < one.share) {
                self.shared.insert(one.trials, one);
            }
        }
    }

    /// Those of the trials `kept`, with their places there as indices.
    pub(crate) fn among(&self, kept: &[usize]) -> Self {
        let place: BTreeMap<_, _> = kept.iter().enumerate().map(|(at, &i)| (i, at)).collect();
        let of = |others: &BTreeSet<usize>| -> BTreeSet<usize> {
            others.iter().filter_map(|i| place.get(i).copied()).collect()
        };
        let partners = self.partners.iter().filter_map(|(i, o)| Some((*place.get(i)?, of(o))));
        let partners = partners.filter(|(_, others)| !others.is_empty()).collect();
        let moved = |one: &Shared| {
            let [a, b] = one.trials;
            let trials = [*place.get(&a)?, *place.get(&b)?];
            Some((trials, Shared { trials, ..one.clone() }))
        };
        Self { partners, shared: self.shared.values().filter_map(moved).collect() }
    }

    /// Drops from the library of each fold what shares samples with a query of the fold, and then the
    /// queries of surfaces that the library lacks. `None` if no fold remains that can be asked.
    pub fn apart(&self, folds: &[Fold], keys: &[TrialKey]) -> Option<Vec<Fold>> {
        let apart = |fold: &Fold| {
            let of_queries = fold.queries.iter().filter_map(|i| self.partners.get(i));
            let partners: BTreeSet<usize> = of_queries.flatten().copied().collect();
            let mut fold = fold.clone();
            fold.library.retain(|i| !partners.contains(i));
            known_only(fold, keys).filter(|fold| enough(std::slice::from_ref(fold), keys))
        };
        let folds: Vec<Fold> = folds.iter().filter_map(apart).collect();
        (!folds.is_empty()).then_some(folds)
    }

    /// The shared samples in a line of text, with trials named by `name`; `None` if there are none.
    pub fn text(&self, keys: &[TrialKey], name: impl Fn(usize) -> String) -> Option<String> {
        let is_of_two = |one: &&Shared| keys[one.trials[0]].surface != keys[one.trials[1]].surface;
        let of_two = self.shared.values().find(is_of_two);
        let Shared { source, trials: [a, b], seconds, share, .. } =
            of_two.or_else(|| self.shared.values().max_by(|a, b| a.share.total_cmp(&b.share)))?;
        let what = match *seconds > 0.0 {
            true => format!("{seconds:.2} s, {:.0} %, of {source}", 100.0 * share),
            false => format!("the picture {source}"),
        };
        let labels = if of_two.is_some() { ", under two labels" } else { "" };
        let (count, all, a, b) = (self.partners.len(), keys.len(), name(*a), name(*b));
        Some(format!(
            "{count} of {all} trials share samples with others, such as {a} and {b} ({what}){labels}"
        ))
    }
}

fn load(entry: &Entry, source: &SourceId) -> Option<Signal> {
    entry.with_only(source).load().ok()?.signals.remove(source)
}

/// The fingerprints of a signal, with the frames where they begin.
fn fingerprints(signal: &Signal) -> Vec<(u64, usize)> {
    let Fingerprints { whole, windows } = Fingerprints::of(signal, MOST_PRINTS);
    whole.map(|hash| (hash, 0)).into_iter().chain(windows).collect()
}

/// A window of the first trial that has it, and the same window of another.
struct Candidate {
    trials: [usize; 2],
    at: [usize; 2],
    group: usize,
}

/// Compares, for each group of equal fingerprints, the samples of its first trial with those of the
/// others. Returns the longest run of each pair, and the groups of trials that do share samples.
fn compared(
    entries: &[Entry],
    source: &SourceId,
    groups: &[&[(u64, usize, usize)]],
) -> (Vec<Shared>, BTreeSet<Vec<usize>>) {
    let of_group = |(group, prints): (usize, &&[(u64, usize, usize)])| {
        let (_, first, start) = prints[0];
        let others = prints[1..].iter().map(move |&(_, other, at)| Candidate {
            trials: [first, other],
            at: [start, at],
            group,
        });
        others.collect::<Vec<_>>()
    };
    let mut candidates: Vec<Candidate> = groups.iter().enumerate().flat_map(of_group).collect();
    candidates.sort_by_key(|one| (one.trials, one.at));
    let of_first: Vec<_> = candidates.chunk_by(|a, b| a.trials[0] == b.trials[0]).collect();
    let pairs = |of_first: &[Candidate]| -> Vec<_> {
        let Some(first) = load(&entries[of_first[0].trials[0]], source) else { return Vec::new() };
        let of_pair = |pair: &[Candidate]| {
            let other = load(&entries[pair[0].trials[1]], source)?;
            Some(of_pair(source, [&first, &other], pair))
        };
        of_first.chunk_by(|a, b| a.trials == b.trials).filter_map(of_pair).collect()
    };
    let found: Vec<_> = of_first.into_par_iter().flat_map_iter(pairs).collect();
    let mut sharing: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for &(group, trial) in found.iter().flat_map(|(_, sharing)| sharing) {
        sharing.entry(group).or_insert_with(|| vec![groups[group][0].1]).push(trial);
    }
    (found.into_iter().filter_map(|(shared, _)| shared).collect(), sharing.into_values().collect())
}

/// The longest run that two signals share, and the groups of fingerprints that lie in such runs, each
/// with the second trial.
fn of_pair(
    source: &SourceId,
    signals: [&Signal; 2],
    candidates: &[Candidate],
) -> (Option<Shared>, Vec<(usize, usize)>) {
    let (a, b) = match signals {
        [Signal::Series(a), Signal::Series(b)] if a.channels() == b.channels() => (a, b),
        [Signal::Image(a), Signal::Image(b)] if a.rgb() == b.rgb() => {
            let Candidate { trials, group, .. } = candidates[0];
            let source = source.clone();
            let shared = Shared { source, trials, seconds: 0.0, share: 1.0, is_copy: true };
            return (Some(shared), vec![(group, trials[1])]);
        }
        _ => return (None, Vec::new()),
    };
    // A run is named by its end in the first series and its offset; what lies in it is compared once.
    let mut runs: BTreeMap<isize, (usize, bool)> = BTreeMap::new();
    let (mut longest, mut sharing) = (0, Vec::new());
    for Candidate { trials, at, group } in candidates {
        let offset = at[0] as isize - at[1] as isize;
        let known = runs.get(&offset).copied().filter(|(end, _)| at[0] < *end);
        let (end, tells) = known.unwrap_or_else(|| {
            let (begin, frames) = run([a, b], *at);
            let tells = frames >= WINDOW.min(a.frames()) && tells(a, begin, frames);
            longest = longest.max(if tells { frames } else { 0 });
            (begin + frames, tells)
        });
        runs.insert(offset, (end, tells));
        if tells {
            sharing.push((*group, trials[1]));
        }
    }
    let shared = (longest > 0).then(|| Shared {
        source: source.clone(),
        trials: candidates[0].trials,
        seconds: longest as f64 / a.rate_hz(),
        share: longest as f64 / a.frames().min(b.frames()) as f64,
        is_copy: longest == a.frames() && longest == b.frames(),
    });
    (shared, sharing)
}

/// The run of equal frames around a frame of each series: its begin in the first, and its length.
fn run([a, b]: [&Series; 2], at: [usize; 2]) -> (usize, usize) {
    let channels = a.channels();
    let (a, b) = (a.samples(), b.samples());
    let [at, other] = at.map(|at| at * channels);
    let same = |(x, y): &(&f32, &f32)| x.to_bits() == y.to_bits();
    let before = a[..at].iter().rev().zip(b[..other].iter().rev()).take_while(same).count();
    let after = a[at..].iter().zip(&b[other..]).take_while(same).count();
    let (before, after) = (before / channels, after / channels);
    (at / channels - before, before + after)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluate::{Evaluation, Protocol, folds};
    use crate::recognise::{MethodName, MethodSpec};
    use crate::scene::Scene;
    use crate::seed;
    use crate::trial::{EXPERT, Trial};

    const RATE_HZ: f64 = 10_000.0;

    fn noise(name: &str, frames: usize) -> Vec<f32> {
        let mut rng = seed::rng(1, &[name.as_bytes()]);
        (0..frames).map(|_| seed::normal(&mut rng) as f32).collect()
    }

    fn entry(surface: &str, number: usize, samples: &[f32]) -> Entry {
        entry_of(surface, number, samples, 1)
    }

    fn entry_of(surface: &str, number: usize, samples: &[f32], channels: usize) -> Entry {
        let series = Series::new(RATE_HZ, channels, samples.to_vec()).unwrap();
        let key = TrialKey::new(surface, EXPERT, number as u32);
        Entry::in_memory(Trial::of_series(key, SourceId::new("mi2").unwrap(), series))
    }

    /// Twelve trials of 0.2 s of each of three recordings, each beginning `hop` frames after the last.
    fn cut(hop: usize) -> Vec<Entry> {
        let of = |surface: &'static str| {
            let all = noise(surface, 2_000 + 11 * hop);
            (0..12).map(move |n| entry(surface, n + 1, &all[n * hop..n * hop + 2_000]))
        };
        ["a", "b", "c"].into_iter().flat_map(of).collect()
    }

    fn keys(entries: &[Entry]) -> Vec<TrialKey> {
        entries.iter().map(|entry| entry.key.clone()).collect()
    }

    fn leaks(entries: &[Entry]) -> Leaks {
        Leaks::of(entries, &|_, _, _| ())
    }

    fn accuracy(entries: &[Entry], folds: &[Fold]) -> f64 {
        let scene = Scene::lmt108();
        let method = MethodSpec::from(MethodName::Embedding).build(&scene);
        let run = Evaluation::new(&scene, entries, folds).prepare(&*method).unwrap();
        run.measure().unwrap().outcome.share.value()
    }

    #[test]
    fn excerpts_of_noise_that_overlap_by_half_are_named_by_chance_once_they_are_kept_apart() {
        let entries = cut(1_000);
        let keys = keys(&entries);
        let leaks = leaks(&entries);
        assert_eq!((leaks.partners.len(), leaks.shared.len()), (36, 33));
        assert_eq!(leaks.partners[&1], [0, 2].into());
        assert!(leaks.shared.values().all(|one| (one.share - 0.5).abs() < 1e-9 && !one.is_copy));
        let before = folds(Protocol::LeaveOneTrialOut, &keys).unwrap();
        let after = leaks.apart(&before, &keys).unwrap();
        let queries = |folds: &[Fold]| folds.iter().map(|f| f.queries.len()).sum::<usize>();
        assert_eq!(queries(&before), queries(&after));
        let (leaked, kept) = (accuracy(&entries, &before), accuracy(&entries, &after));
        assert!(leaked > 0.7 && kept < 0.6, "{leaked} {kept}");
    }

    #[test]
    fn distinct_noise_and_excerpts_without_overlap_share_nothing() {
        assert_eq!(leaks(&cut(2_000)), Leaks::default());
    }

    #[test]
    fn silence_ramps_and_sensors_at_rest_share_nothing() {
        let at_rest = |n: usize| -> Vec<f32> {
            let noise = noise(&format!("rest {n}"), 5_000);
            noise.iter().map(|x| (0.8 * x).round().clamp(-2.0, 2.0)).collect()
        };
        let mut entries: Vec<Entry> = (1..=20).map(|n| entry("rest", n, &at_rest(n))).collect();
        for n in 1..=3 {
            entries.push(entry("silence", n, &[0.0; 2_000]));
            entries.push(entry("ramp", n, &(n * 9..2_000).map(|i| i as f32).collect::<Vec<_>>()));
            entries.push(entry("toggle", n, &[0.0, 1.0].repeat(1_000)));
        }
        assert_eq!(leaks(&entries), Leaks::default());
    }

    #[test]
    fn one_recording_under_two_labels_is_a_copy_and_is_said() {
        let one = noise("one", 2_000);
        let entries =
            [entry("a", 1, &one), entry("b", 1, &one), entry("b", 2, &noise("two", 2_000))];
        let leaks = leaks(&entries);
        assert!(leaks.shared[&[0, 1]].is_copy);
        let text = leaks.text(&keys(&entries), |trial| format!("trial {trial}")).unwrap();
        assert!(text.starts_with("2 of 3 trials") && text.ends_with("under two labels"), "{text}");
        let fold = Fold { name: "f".into(), library: vec![1, 2], queries: vec![0] };
        assert_eq!(leaks.apart(&[fold], &keys(&entries)), None, "a has no other trial");
    }

    #[test]
    fn copies_of_short_series_are_found_by_all_their_channels() {
        for (frames, channels) in [(12, 20), (20, 20), (26, 6), (20, 1)] {
            let of = |name: &str, number| {
                let samples = noise(&format!("{name} {frames}"), frames * channels);
                entry_of("a", number, &samples, channels)
            };
            let leaks = leaks(&[of("x", 1), of("x", 2), of("y", 3)]);
            assert_eq!(leaks.partners, [(0, [1].into()), (1, [0].into())].into());
            assert!(leaks.shared[&[0, 1]].is_copy);
        }
    }

    #[test]
    fn a_short_part_and_many_copies_are_found() {
        let shared = noise("shared", 60);
        let mixed = |name: &str| {
            [noise(name, 70), shared.clone(), noise(&format!("{name} end"), 90)].concat()
        };
        let mut entries = vec![entry("a", 1, &mixed("x")), entry("b", 1, &mixed("y"))];
        let copied = noise("copied", 4_000);
        entries.extend((1..=20).map(|n| entry("c", n, &copied)));
        let leaks = leaks(&entries);
        assert_eq!(leaks.partners[&0], [1].into());
        assert!((2..22).all(|i| leaks.partners[&i].len() == 19), "every copy knows all others");
        assert_eq!(leaks.shared.len(), 1 + 19);
    }
}
