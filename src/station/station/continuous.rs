//! Names the surface while something moves, without begin and end: robots, rovers and conveyor belts do
//! not tap and lift.
//!
//! A window as long as the scan time that the library requires slides over the data, and is named like a
//! scan after every hop. A sticky hidden Markov model joins these answers. Its states are the surfaces of
//! the library and, where unknown surfaces are detected, one for all unknown surfaces.
//!
//! Windows overlap, so their answers are not independent: taken as such, each second of data would count
//! window/hop times, and certainty would be far too high. The likelihood of a window therefore has the share
//! of the window that no earlier window held as its exponent: 1 for the first, and hop/window for one that
//! follows another. So each second counts as often as in windows that do not overlap. A window that may hold
//! a change counts as a mixture. A window with a gap is no evidence, since the gap is filled with repeated
//! frames.
//!
//! A change is found only later: about a window and a half later, if surfaces are much alike. It tells when it
//! was found, and when the new surface began by the estimate of the model. A stretch, and so an answer, lasts from
//! one such begin to the next.
//!
//! A window that fits no surface by the rule for scans ([`Rejection`]) speaks for an unknown surface, any
//! other for a known one. For known surfaces the rule errs at its rate, which left-out trials show; for
//! unknown ones it is taken to err as rarely. Which surface comes closest says nothing about whether it is
//! this one, so for that an unknown surface is as likely as the closest one.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Instant, SystemTime};

use super::answer::{Answer, AnswerState};
use super::certainty::EVEN;
use super::event::{AnsweredScan, Change, FoundSurface, Guess, SurfaceProbability};
use super::recogniser::{FlawsBySource, Recogniser};
use crate::recognise::{RankedSurface, Ranking, Rejection, StickyFilter, stated_probabilities};
use crate::scan::{Fresh, Progress, Scan};
use crate::scene::SourceId;
use crate::trial::{Series, Signal, TrialKey, unix_ms};

/// How many surfaces a guess names, at most.
const NAMED: usize = 5;
/// Into how many steps the filter divides a window, at most: fewer than hops where these are short.
const STEPS: f64 = 50.0;

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Continuous {
    /// Time from one window to the next, in seconds.
    pub hop_s: f64,
    /// How long the surface stays the same on average, in seconds; above `hop_s`.
    pub expected_stay_s: f64,
}

/// The result of new data of a scan.
#[derive(Debug, Default)]
pub struct Heard {
    pub guess: Guess,
    pub change: Option<Change>,
    /// The stretch of one surface that has ended.
    pub ended: Option<AnsweredScan>,
}

/// Names the surfaces of one scan after another. A scan is the time in which something moves.
pub struct ContinuousNaming {
    how: Continuous,
    scan: Option<MovingScan>,
}

struct MovingScan {
    number: u32,
    by: Arc<Recogniser>,
    window_s: f64,
    recent: BTreeMap<SourceId, RecentFrames>,
    /// Scan time from which this library names it, in seconds.
    begin_s: f64,
    /// Scan time of the last snapshot, in seconds.
    heard_s: f64,
    /// Scan time at which the last gap ended, in seconds.
    whole_from_s: f64,
    /// Scan time up to which data have counted as evidence, in seconds.
    counted_s: f64,
    /// Numbers of lost frames, each with the scan time at which the loss was heard of.
    lost: Vec<(f64, u64)>,
    smoothed: Option<Smoothed>,
    stretch: Option<Stretch>,
}

/// The last frames of a source, at most as many as a window holds.
struct RecentFrames {
    rate_hz: f64,
    channels: usize,
    samples: Vec<f32>,
    /// Index after the last frame, counted from the start of the source.
    end: u64,
}

struct Smoothed {
    /// The surfaces in alphabetical order. An unknown surface is the state after the last of them.
    surfaces: Vec<String>,
    filter: StickyFilter,
    /// Seconds of a step of the filter.
    step_s: f64,
}

/// A time in which the surface stays the same.
struct Stretch {
    state: usize,
    begin_s: f64,
    looks: u32,
    /// Sum over looks of the probability of each surface, if it is one of the library's.
    sums: Vec<f64>,
    /// How often each label was the true one.
    truths: BTreeMap<String, u32>,
    /// The last window that says by itself what the stretch says; the first one if none does.
    window: Window,
}

/// A window, and the state that it speaks for by itself.
struct Window {
    scan: Scan,
    ranking: Ranking,
    says: usize,
}

impl ContinuousNaming {
    pub fn new(how: Continuous) -> Self {
        Self { how, scan: None }
    }

    /// Takes the next data of a scan, and names the window that ends with them.
    pub fn hear(&mut self, progress: &Progress, by: &Arc<Recogniser>) -> Heard {
        let from = Instant::now();
        let (number, mut ended) = (progress.number, None);
        let same = |scan: &&MovingScan| scan.number == number;
        let begin_s = self.scan.as_ref().filter(same).map_or(0.0, |scan| scan.heard_s);
        if !self.scan.as_ref().filter(same).is_some_and(|scan| Arc::ptr_eq(&scan.by, by)) {
            ended = self.end();
            self.scan = by.needed_s.map(|window_s| MovingScan::new(number, by, window_s, begin_s));
        }
        let mut guess = Guess { scan: number, scan_s: progress.scan_s, ..Guess::default() };
        let Some(scan) = &mut self.scan else { return Heard { guess, ended, change: None } };
        let mut change = None;
        if let Some(window) = scan.next_window(progress, self.how) {
            let (found, over) = scan.look(window, from);
            (change, ended) = (found, ended.or(over));
        }
        scan.tell(&mut guess, progress.truth.as_ref());
        Heard { guess, change, ended }
    }

    /// Ends the scan, and so its last stretch; `None` if no surface was found.
    pub fn end(&mut self) -> Option<AnsweredScan> {
        let mut scan = self.scan.take()?;
        let mut stretch = scan.stretch.take()?;
        stretch.window.scan.lost_samples = lost_before(&mut scan.lost, scan.heard_s);
        let smoothed = scan.smoothed.as_ref()?;
        Some(stretch.ended(scan.heard_s, smoothed, &scan.by, Instant::now()))
    }

    /// Whether a surface was found in the scan with this number.
    pub(super) fn has_named(&self, number: u32) -> bool {
        self.scan.as_ref().is_some_and(|scan| scan.number == number && scan.stretch.is_some())
    }
}

impl MovingScan {
    fn new(number: u32, by: &Arc<Recogniser>, window_s: f64, begin_s: f64) -> Self {
        Self {
            number,
            by: by.clone(),
            window_s,
            recent: BTreeMap::new(),
            begin_s,
            heard_s: begin_s,
            whole_from_s: begin_s,
            counted_s: begin_s,
            lost: Vec::new(),
            smoothed: None,
            stretch: None,
        }
    }

    /// Adds new data, and names the window that ends with them; `None` if there is no whole window, it has
    /// a gap, or it cannot be named.
    fn next_window(&mut self, progress: &Progress, how: Continuous) -> Option<Window> {
        let Progress { scan_s, truth, fresh, gap, lost, .. } = progress;
        let dragged = fresh.iter().filter(|fresh| self.by.scene.is_dragged(&fresh.source));
        for fresh in dragged {
            let recent = self.recent.entry(fresh.source.clone());
            let Fresh { rate_hz, channels, .. } = *fresh;
            let new = || RecentFrames { rate_hz, channels, samples: Vec::new(), end: 0 };
            recent.or_insert_with(new).add(fresh, self.window_s);
        }
        if let Some(Smoothed { filter, step_s, .. }) = &mut self.smoothed {
            let step = |seconds: f64| (seconds / *step_s).round();
            filter.pass((step(*scan_s) - step(self.heard_s)) as u32);
        }
        self.heard_s = *scan_s;
        if *lost > 0 {
            self.lost.push((*scan_s, *lost));
        }
        if *gap {
            self.whole_from_s = *scan_s;
        }
        if scan_s - self.whole_from_s < self.window_s - 1e-9 {
            return None;
        }
        let whole = self
            .recent
            .iter()
            .filter_map(|(id, recent)| Some((id.clone(), recent.window(*scan_s, self.window_s)?)));
        let scan = Scan {
            truth: truth.clone(),
            synthetic: self.by.library.synthetic,
            scan_s: self.window_s,
            spoiled: progress.off_pace.clone(),
            ..Scan::of_signals(self.number, whole.collect())
        };
        let ranking = self.by.rank(&scan).ok()?;
        let rejection = self.by.rejection(truth.as_ref());
        let shares = stated_probabilities(
            &ranking.ranked.iter().map(|ranked| ranked.score).collect::<Vec<_>>(),
            ranking.confidence,
        );
        if shares.is_empty() {
            return None;
        }
        let smoothed = self
            .smoothed
            .get_or_insert_with(|| Smoothed::new(&ranking, rejection, how, self.window_s));
        let weight = ((scan_s - self.counted_s) / self.window_s).min(1.0);
        smoothed.filter.observe(&smoothed.log_likelihood(&ranking, &shares, rejection), weight);
        self.counted_s = *scan_s;
        let says = smoothed.state_of(&ranking, rejection);
        Some(Window { scan, ranking, says })
    }

    /// Finds the surface after a window. Returns its change, and the stretch that ends with it.
    fn look(&mut self, window: Window, from: Instant) -> (Option<Change>, Option<AnsweredScan>) {
        let Some(smoothed) = &self.smoothed else { return (None, None) };
        let truth = window.scan.truth.clone();
        let (belief, at_s) = (smoothed.filter.belief(), self.heard_s);
        let state = most_probable(&belief);
        let is_found = belief[state] > EVEN;
        let (mut change, mut ended) = (None, None);
        match &mut self.stretch {
            Some(stretch) if stretch.state == state || !is_found => {
                // Doubts about a part of the stretch hold for its answer.
                let mut spoiled = std::mem::take(&mut stretch.window.scan.spoiled);
                for doubt in &window.scan.spoiled {
                    if !spoiled.iter().any(|other| other.source() == doubt.source()) {
                        spoiled.push(doubt.clone());
                    }
                }
                if window.says == stretch.state {
                    stretch.window = window;
                }
                stretch.window.scan.spoiled = spoiled;
            }
            None if !is_found => return (None, None),
            _ => {
                let found = |state| smoothed.found(state, self.by.rejection(truth.as_ref()));
                let before = self.stretch.take();
                let ago_s = smoothed.filter.age(state).map(|steps| steps as f64 * smoothed.step_s);
                let begin_s = match (&before, ago_s) {
                    (Some(before), Some(ago_s)) => (at_s - ago_s).max(before.begin_s),
                    (Some(before), None) => before.begin_s,
                    (None, _) => self.begin_s,
                };
                change = Some(Change {
                    unix_ms: unix_ms(SystemTime::now()),
                    scan: self.number,
                    at_s,
                    since_s: begin_s,
                    from: before.as_ref().map(|stretch| found(stretch.state)),
                    to: found(state),
                    confidence: smoothed.shares().get(state).copied(),
                });
                ended = before.filter(|stretch| stretch.begin_s < begin_s).map(|mut stretch| {
                    stretch.window.scan.lost_samples = lost_before(&mut self.lost, begin_s);
                    stretch.ended(begin_s, smoothed, &self.by, from)
                });
                let (sums, truths) = (vec![0.0; smoothed.surfaces.len()], BTreeMap::new());
                self.stretch = Some(Stretch { state, begin_s, looks: 0, sums, truths, window });
            }
        }
        if let Some(stretch) = &mut self.stretch {
            stretch.count(smoothed, truth.as_ref());
        }
        (change, ended)
    }

    /// Puts what is known so far into a guess.
    fn tell(&self, guess: &mut Guess, truth: Option<&TrialKey>) {
        // As long as no surface is found, the guess counts down to the first window.
        guess.needed_s = Some(self.window_s).filter(|_| self.stretch.is_none());
        guess.since_s = self.stretch.as_ref().map(|stretch| stretch.begin_s);
        let Some(smoothed) = &self.smoothed else { return };
        let belief = smoothed.filter.belief();
        let best = most_probable(&belief);
        let ranked = smoothed.ranked(&smoothed.shares());
        let named = ranked.into_iter().take(NAMED);
        guess.named = named
            .map(|(surface, probability)| SurfaceProbability { surface, probability })
            .collect();
        guess.state = Some(match smoothed.found(best, self.by.rejection(truth)).state {
            AnswerState::Unknown => AnswerState::Unknown,
            _ if belief[best] < EVEN => AnswerState::Unsure,
            state => state,
        });
    }
}

impl RecentFrames {
    fn add(&mut self, fresh: &Fresh, window_s: f64) {
        self.samples.extend_from_slice(&fresh.samples);
        self.end = fresh.start + (fresh.samples.len() / self.channels) as u64;
        let old = self.samples.len().saturating_sub(self.most(window_s));
        self.samples.drain(..old);
    }

    /// The number of samples of a whole window.
    fn most(&self, window_s: f64) -> usize {
        (window_s * self.rate_hz).round() as usize * self.channels
    }

    /// The signal of the window that ends at `scan_s`; `None` if it is not whole, or its newest frame is
    /// older than half of the window, as with a device that is gone.
    fn window(&self, scan_s: f64, window_s: f64) -> Option<Signal> {
        let lag_s = scan_s - self.end as f64 / self.rate_hz;
        let is_whole = self.samples.len() == self.most(window_s) && lag_s <= 0.5 * window_s;
        let series =
            is_whole.then(|| Series::new(self.rate_hz, self.channels, self.samples.clone()));
        series?.ok().map(Signal::Series)
    }
}

/// Takes out the losses up to a scan time, and returns their sum.
fn lost_before(lost: &mut Vec<(f64, u64)>, scan_s: f64) -> u64 {
    lost.extract_if(.., |(heard_s, _)| *heard_s <= scan_s).map(|(_, frames)| frames).sum()
}

/// The first of the most probable states.
fn most_probable(belief: &[f64]) -> usize {
    (0..belief.len()).rev().max_by(|&a, &b| belief[a].total_cmp(&belief[b])).unwrap_or(0)
}

/// Whether a ranking is of an unknown surface; `None` if nothing says so or not.
fn rejected(ranking: &Ranking, rejection: Option<&Rejection>) -> Option<bool> {
    ranking.p_value.zip(rejection).map(|(p_value, rejection)| rejection.rejects(p_value))
}

impl Smoothed {
    fn new(
        ranking: &Ranking,
        rejection: Option<&Rejection>,
        how: Continuous,
        window_s: f64,
    ) -> Self {
        let mut surfaces: Vec<String> =
            ranking.ranked.iter().map(|ranked| ranked.surface.clone()).collect();
        surfaces.sort();
        let states = surfaces.len() + usize::from(rejection.is_some());
        let step_s = how.hop_s.max(window_s / STEPS);
        let stay = (-step_s / how.expected_stay_s).exp();
        let window = (window_s / step_s).round().max(1.0) as usize;
        Self { filter: StickyFilter::new(states, stay, window), step_s, surfaces }
    }

    /// ln of the likelihood of a window in each state, given the probabilities of its ranking.
    fn log_likelihood(
        &self,
        ranking: &Ranking,
        shares: &[f64],
        rejection: Option<&Rejection>,
    ) -> Vec<f64> {
        let share = |surface: &String| {
            let mut ranked = ranking.ranked.iter().zip(shares);
            let found = ranked.find(|(ranked, _)| ranked.surface == *surface);
            found.map_or(0.0, |(_, share)| *share).max(f64::MIN_POSITIVE).ln()
        };
        let mut logs: Vec<f64> = self.surfaces.iter().map(share).collect();
        if let Some(rejection) = rejection {
            let best = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            let odds = ((1.0 - rejection.rate) / rejection.rate).ln();
            logs.push(match rejected(ranking, Some(rejection)) {
                Some(true) => best + odds,
                Some(false) => best - odds,
                None => best,
            });
        }
        logs
    }

    /// The state that a ranking speaks for by itself.
    fn state_of(&self, ranking: &Ranking, rejection: Option<&Rejection>) -> usize {
        let known = self.surfaces.iter().position(|surface| surface == ranking.surface());
        known.filter(|_| rejected(ranking, rejection) != Some(true)).unwrap_or(self.surfaces.len())
    }

    fn found(&self, state: usize, rejection: Option<&Rejection>) -> FoundSurface {
        let surface = self.surfaces.get(state).cloned();
        let state = match (&surface, rejection) {
            (None, _) => AnswerState::Unknown,
            (Some(_), Some(_)) => AnswerState::Named,
            (Some(_), None) => AnswerState::Nearest,
        };
        FoundSurface { state, surface }
    }

    /// The probability of each surface, if it is one of the library's.
    fn shares(&self) -> Vec<f64> {
        let belief = self.filter.belief();
        let known = &belief[..self.surfaces.len()];
        let sum = known.iter().sum::<f64>().max(f64::MIN_POSITIVE);
        known.iter().map(|p| p / sum).collect()
    }

    /// The surfaces with their shares, the most probable first; ties are in alphabetical order.
    fn ranked(&self, shares: &[f64]) -> Vec<(String, f64)> {
        let mut ranked: Vec<_> =
            self.surfaces.iter().cloned().zip(shares.iter().copied()).collect();
        ranked.sort_by(|a, b| b.1.total_cmp(&a.1));
        ranked
    }
}

impl Stretch {
    fn count(&mut self, smoothed: &Smoothed, truth: Option<&TrialKey>) {
        self.looks += 1;
        self.sums.iter_mut().zip(smoothed.shares()).for_each(|(sum, share)| *sum += share);
        if let Some(label) = truth.and_then(TrialKey::label) {
            *self.truths.entry(label.into()).or_default() += 1;
        }
    }

    /// The answer to the stretch. Its confidence is the mean probability of its surface over all looks; its
    /// signals are those of its window. The p-value is left out where it contradicts the stretch.
    fn ended(
        self,
        end_s: f64,
        smoothed: &Smoothed,
        by: &Arc<Recogniser>,
        from: Instant,
    ) -> AnsweredScan {
        let Self { state, begin_s, looks, sums, truths, window } = self;
        let Window { scan, ranking, says } = window;
        let shares: Vec<f64> = sums.iter().map(|sum| sum / f64::from(looks.max(1))).collect();
        let ranked = smoothed.ranked(&shares);
        let score = |share: f64| share.recip().min(f64::MAX);
        let ranking = Ranking {
            margin: ranked.get(1).map_or(0.0, |second| (ranked[0].1 / second.1).ln()),
            confidence: Some(ranked[0].1),
            p_value: ranking.p_value.filter(|_| says == state),
            ranked: (ranked.into_iter())
                .map(|(surface, share)| RankedSurface { surface, score: score(share) })
                .collect(),
            ..ranking
        };
        let answer = by.answer(&scan, ranking, FlawsBySource::new(), None);
        let truth = truths.into_iter().max_by_key(|(_, looks)| *looks).map(|(label, _)| label);
        let answer = Answer {
            truth,
            user: None,
            session: None,
            trial: None,
            begin_s: Some(begin_s),
            scan_s: end_s - begin_s,
            latency_ms: from.elapsed().as_secs_f64() * 1e3,
            ..answer
        };
        AnsweredScan { scan: Box::new(scan), answer: Arc::new(answer), by: Some(by.clone()) }
    }
}
