//! Measures naming without begin and end, on excerpts of a library that are joined at random:
//!
//!     cargo run --release --example continuous_bench -- LIBRARY [ACCURACY [SEED]]
//!
//! A window is as long as a scan must last to be named right with this accuracy, or else with that of whole
//! scans less one percentage point, as `--accuracy` says elsewhere.
//!
//! Leaves each person out in turn (or each session, where one person recorded all): the library is the
//! others' trials. The excerpts of the person are joined to ten stretches, each of 3 to 6 excerpts of one surface
//! that is not the one before, five times over. Sources are cut to the shortest of their excerpt. A window
//! ends at every hop of 0.1 s. Prints, with the stay that the configuration expects by default and with
//! that of the stretches as they were made:
//!
//! - the share of hops at which the surface is right, without the first window after each change: as recorded
//!   (each surface from its `since_s` to the next), at once (as listeners are told by then), and for windows
//!   that are named singly, by the same rule for unknown surfaces; an unknown surface is never right here;
//! - the median delay of a change, in windows; a change that is never found counts as longest;
//! - changes to a surface that is not there, in ten stretches;
//! - processor time, as a share of the time that the data span.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;

use rand::RngExt;
use rand::seq::{IndexedRandom, SliceRandom};
use rustix::time::{ClockId, clock_gettime};
use surfaced::dataset;
use surfaced::evaluate::{Fold, Protocol, folds};
use surfaced::library::{Entry, Library};
use surfaced::recognise::{MethodName, MethodSpec, Rejection, ready_model};
use surfaced::scan::{Fresh, Progress, Scan};
use surfaced::scene::{Scene, SourceId};
use surfaced::seed;
use surfaced::station::config::StationConfig;
use surfaced::station::{Continuous, ContinuousNaming, LibraryState, Recogniser};
use surfaced::trial::{Series, Signal, TrialKey};

const STRETCHES: usize = 10;
const JOURNEYS: usize = 5;
const EXCERPTS: std::ops::RangeInclusive<usize> = 3..=6;

type Problem = Box<dyn std::error::Error>;

fn main() -> Result<(), Problem> {
    let mut words = std::env::args().skip(1);
    let path = words.next().ok_or("usage: continuous_bench LIBRARY [ACCURACY [SEED]]")?;
    let accuracy = words.next().map(|word| word.parse()).transpose()?;
    let seed = words.next().map_or(Ok(1), |word| word.parse())?;
    let library = dataset::open(Path::new(&path), &Scene::lmt108())?;
    let keys: Vec<TrialKey> = library.entries.iter().map(|entry| entry.key.clone()).collect();
    let folds = folds(Protocol::AllVsOneUser, &keys)
        .or_else(|_| folds(Protocol::LeaveOneSessionOut, &keys))?;
    let by_default = StationConfig::embedded().sliding;
    let mut all = [Measured::default(), Measured::default()];
    for fold in &folds {
        let (by, rejection) = recogniser(&library, fold, accuracy)?;
        let mut rng = seed::rng(seed, &[b"continuous bench", fold.name.as_bytes()]);
        for _ in 0..JOURNEYS {
            let journey = Journey::new(&library, fold, &mut rng)?;
            let as_made = journey.duration_s() / STRETCHES as f64;
            let alone = journey.alone(&by, rejection.as_ref(), by_default.hop_s);
            for (measured, expected_stay_s) in
                all.iter_mut().zip([by_default.expected_stay_s, as_made])
            {
                let how = Continuous { expected_stay_s, ..by_default };
                journey.measure(&by, how, &alone, measured);
            }
        }
        println!("{}: windows of {:.1} s", fold.name, by.needed_s.unwrap_or(f64::NAN));
    }
    for (measured, stay) in all.iter_mut().zip(["by default", "as made"]) {
        println!("expected stay {stay}: {}", measured.text());
    }
    Ok(())
}

fn recogniser(
    library: &Library,
    fold: &Fold,
    accuracy: Option<f64>,
) -> Result<(Arc<Recogniser>, Option<Rejection>), Problem> {
    let method = MethodSpec::from(MethodName::Embedding).build(&library.scene);
    let of_fold: BTreeSet<usize> = fold.library.iter().copied().collect();
    let ready = ready_model(&*method, &library.entries, &of_fold, None, &|_, _| ())?;
    let compared: Vec<Entry> = fold.library.iter().map(|&i| library.entries[i].clone()).collect();
    let state = LibraryState::of(&library.name, &compared, library.synthetic);
    let mut by = Recogniser::new(ready.model.clone(), library.scene.clone(), state);
    by.needed_s = ready.model.scan_time(accuracy).and_then(|answer| answer.scan_s());
    let rejection = by.reject_unknown(None).ok().and_then(|mut all| all.pop());
    by.needed_s.ok_or("the scan time of this library is not known")?;
    Ok((Arc::new(by), rejection))
}

/// Excerpts joined without a pause.
struct Journey {
    series: BTreeMap<SourceId, Series>,
    /// The surface of each stretch, and when it ends, in seconds.
    stretches: Vec<(String, f64)>,
}

impl Journey {
    fn new(library: &Library, fold: &Fold, rng: &mut impl RngExt) -> Result<Self, Problem> {
        let mut of_surface: BTreeMap<&str, Vec<usize>> = BTreeMap::new();
        for &query in &fold.queries {
            of_surface.entry(&library.entries[query].key.surface).or_default().push(query);
        }
        let surfaces: Vec<&str> = of_surface.keys().copied().collect();
        let mut joined: BTreeMap<SourceId, (f64, usize, Vec<f32>)> = BTreeMap::new();
        let (mut stretches, mut end_s): (Vec<(String, f64)>, f64) = (Vec::new(), 0.0);
        while stretches.len() < STRETCHES {
            let before = stretches.last().map(|(surface, _)| surface.as_str());
            let others: Vec<&str> =
                surfaces.iter().copied().filter(|surface| Some(*surface) != before).collect();
            let surface = *others.choose(rng).ok_or("at least two surfaces are needed")?;
            let mut excerpts = of_surface[surface].clone();
            excerpts.shuffle(rng);
            for excerpt in excerpts.iter().cycle().take(rng.random_range(EXCERPTS)) {
                let trial = library.entries[*excerpt].load()?;
                let series = |(id, signal)| match signal {
                    Signal::Series(series) if library.scene.is_dragged(&id) => Some((id, series)),
                    _ => None,
                };
                let series: Vec<(SourceId, Series)> =
                    trial.signals.into_iter().filter_map(series).collect();
                let shortest_s =
                    series.iter().map(|(_, s)| s.duration_s()).fold(f64::INFINITY, f64::min);
                for (id, series) in series {
                    let (rate_hz, channels) = (series.rate_hz(), series.channels());
                    let at = |seconds: f64| (seconds * rate_hz).round() as usize;
                    let frames = (at(end_s + shortest_s) - at(end_s)).min(series.frames());
                    let all = joined.entry(id).or_insert((rate_hz, channels, Vec::new()));
                    all.2.extend_from_slice(&series.samples()[..frames * channels]);
                }
                end_s += shortest_s;
            }
            stretches.push((surface.into(), end_s));
        }
        let series =
            |(id, (rate_hz, channels, samples))| Ok((id, Series::new(rate_hz, channels, samples)?));
        let series = joined.into_iter().map(series).collect::<Result<_, Problem>>()?;
        Ok(Self { series, stretches })
    }

    fn duration_s(&self) -> f64 {
        self.stretches.last().map_or(0.0, |(_, end_s)| *end_s)
    }

    /// The end of each hop, in seconds.
    fn hops(&self, hop_s: f64) -> impl Iterator<Item = f64> {
        (1..=(self.duration_s() / hop_s) as u32).map(move |hop| f64::from(hop) * hop_s)
    }

    /// The samples of each source between two moments.
    fn part(
        &self,
        from_s: f64,
        until_s: f64,
    ) -> impl Iterator<Item = (&SourceId, &Series, usize, &[f32])> {
        self.series.iter().map(move |(id, series)| {
            let at =
                |seconds: f64| ((seconds * series.rate_hz()).round() as usize).min(series.frames());
            let channels = series.channels();
            let samples = &series.samples()[at(from_s) * channels..at(until_s) * channels];
            (id, series, at(from_s), samples)
        })
    }

    /// The surface of each window, named by itself; `None` where there is no whole window, or it is
    /// unknown.
    fn alone(
        &self,
        by: &Recogniser,
        rejection: Option<&Rejection>,
        hop_s: f64,
    ) -> Vec<Option<String>> {
        let window_s = by.needed_s.unwrap_or(0.0);
        let name = |until_s: f64| {
            let from_s = until_s - window_s;
            if from_s < -1e-9 {
                return None;
            }
            let signal = |(id, series, _, samples): (&SourceId, &Series, usize, &[f32])| {
                let cut =
                    Series::new(series.rate_hz(), series.channels(), samples.to_vec()).ok()?;
                Some((id.clone(), Signal::Series(cut)))
            };
            let signals = self.part(from_s.max(0.0), until_s).filter_map(signal).collect();
            let ranking = by.rank(&Scan::of_signals(1, signals)).ok()?;
            let rejected = ranking.p_value.zip(rejection).is_some_and(|(p, rule)| rule.rejects(p));
            (!rejected).then(|| ranking.surface().to_string())
        };
        self.hops(hop_s).map(name).collect()
    }

    fn measure(
        &self,
        by: &Arc<Recogniser>,
        how: Continuous,
        alone: &[Option<String>],
        measured: &mut Measured,
    ) {
        let window_s = by.needed_s.unwrap_or(0.0);
        let mut naming = ContinuousNaming::new(how);
        let (mut told, mut at, mut begin_s, mut heard_s): (Option<String>, _, _, _) =
            (None, 0, 0.0, 0.0);
        let mut found = false;
        let (mut counted, mut changes) = (Vec::new(), Vec::new());
        for (until_s, alone) in self.hops(how.hop_s).zip(alone) {
            while until_s > self.stretches[at].1 + 1e-9 {
                measured.end(found, f64::INFINITY);
                (begin_s, at, found) = (self.stretches[at].1, at + 1, false);
            }
            let truth = &self.stretches[at].0;
            let fresh = |(id, series, start, samples): (&SourceId, &Series, usize, &[f32])| Fresh {
                source: id.clone(),
                rate_hz: series.rate_hz(),
                channels: series.channels(),
                start: start as u64,
                samples: samples.to_vec(),
            };
            let fresh = self.part(heard_s, until_s).map(fresh).collect();
            let (number, scan_s) = (1, until_s);
            let progress = Progress { number, scan_s, fresh, ..Progress::default() };
            let before = processor_s();
            let heard = naming.hear(&progress, by);
            measured.processor_s += processor_s() - before;
            heard_s = until_s;
            if let Some(change) = heard.change {
                changes.push((change.since_s, change.to.surface.clone()));
                told = change.to.surface;
                measured.false_changes += usize::from(told.as_ref() != Some(truth));
            }
            let is_right = told.as_ref() == Some(truth);
            if is_right && !found {
                found = true;
                measured.end(true, (until_s - begin_s) / window_s);
            }
            if until_s - begin_s >= window_s - 1e-9 {
                measured.hops += 1;
                measured.right_at_once += usize::from(is_right);
                counted.push((until_s, truth));
                measured.right_alone += usize::from(alone.as_ref() == Some(truth));
            }
        }
        measured.end(found, f64::INFINITY);
        for (until_s, truth) in counted {
            let recorded = changes.iter().rev().find(|(since_s, _)| *since_s < until_s - 1e-9);
            let is_right = recorded.is_some_and(|(_, surface)| surface.as_ref() == Some(truth));
            measured.right += usize::from(is_right);
        }
        measured.stretches += self.stretches.len();
        measured.seconds += self.duration_s();
    }
}

#[derive(Default)]
struct Measured {
    hops: usize,
    right: usize,
    right_at_once: usize,
    right_alone: usize,
    /// In windows, for each stretch.
    delays: Vec<f64>,
    false_changes: usize,
    stretches: usize,
    processor_s: f64,
    seconds: f64,
}

impl Measured {
    /// Notes the delay of a stretch: when it was `found`, or at its end if it never was.
    fn end(&mut self, found: bool, delay: f64) {
        if found == delay.is_finite() {
            self.delays.push(delay);
        }
    }

    fn text(&mut self) -> String {
        self.delays.sort_by(f64::total_cmp);
        let percent = |count: usize| 100.0 * count as f64 / self.hops as f64;
        format!(
            "{:.1} % of hops right as recorded, {:.1} % at once (windows singly {:.1} %), median delay {:.2} windows, {} of {} changes \
             never found, {:.2} false changes in ten stretches, {:.1} % of a core; {} stretches, {:.0} s",
            percent(self.right),
            percent(self.right_at_once),
            percent(self.right_alone),
            self.delays[self.delays.len() / 2],
            self.delays.iter().filter(|delay| delay.is_infinite()).count(),
            self.delays.len(),
            10.0 * self.false_changes as f64 / self.stretches as f64,
            100.0 * self.processor_s / self.seconds,
            self.stretches,
            self.seconds,
        )
    }
}

/// Processor time of all threads so far, in seconds.
fn processor_s() -> f64 {
    let now = clock_gettime(ClockId::ProcessCPUTime);
    now.tv_sec as f64 + 1e-9 * now.tv_nsec as f64
}
