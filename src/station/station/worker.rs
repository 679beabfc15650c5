//! The thread that follows and names scans, apart from the thread that reads events.

use std::panic::AssertUnwindSafe;
use std::sync::Arc;
use std::time::Instant;

use crossbeam_channel::{Receiver, Sender};

use super::answer::Answer;
use super::certainty::so_far;
use super::continuous::{Continuous, ContinuousNaming, Heard};
use super::event::{AnsweredScan, Guess, SurfaceProbability};
use super::recogniser::{FlawsBySource, Recogniser};
use super::trial_need::TrialNeed;
use crate::recognise::{Follower, FreshFrames, GuessSoFar, Ranking, RecogniseError};
use crate::scan::{Fresh, Progress, Scan};
use crate::scene::SourceId;
use crate::trial::Doubt;

pub(super) enum Job {
    Scan(Box<Scan>),
    Progress(Progress),
    /// A scan that was kept as a trial; the recogniser finds its nearest surface.
    Nearest(Box<Scan>, Arc<Recogniser>),
}

pub(super) struct Work {
    pub job: Job,
    /// The sources whose independent samples count, if the scan in progress is to be a trial.
    pub trial: Option<Vec<SourceId>>,
    pub by: Result<Arc<Recogniser>, String>,
}

pub(super) enum WorkerEvent {
    Scan(AnsweredScan),
    Progress(Box<Heard>),
    /// The library's answer to a scan that was kept; `None` if it could not be compared.
    Nearest(Option<Box<Answer>>),
}

pub(super) fn unnamed(scan: Box<Scan>, why: Doubt, from: Instant) -> AnsweredScan {
    let mut answer = Answer::of(&scan, since_ms(from));
    answer.doubts.push(why);
    AnsweredScan { scan, answer: Arc::new(answer), by: None }
}

fn since_ms(from: Instant) -> f64 {
    from.elapsed().as_secs_f64() * 1e3
}

/// The channels to and from the worker thread. It returns one event for each job, in order. After
/// `work` is dropped, the thread finishes its current job and ends; nothing waits for it.
pub(super) struct Worker {
    pub work: Sender<Work>,
    pub done: Receiver<WorkerEvent>,
}

impl Worker {
    /// Starts the thread. With `queues`, scans may wait for each other (a recording played as fast
    /// as possible), and this wait does not count as latency.
    /// With `continuous`, surfaces are named without begin and end, except in scans that are to be trials.
    pub(super) fn start(queues: bool, continuous: Option<Continuous>) -> std::io::Result<Self> {
        let (work, to_do) = crossbeam_channel::bounded::<Work>(1);
        let (send, done) = crossbeam_channel::unbounded();
        let run = move || {
            let mut free_since = Instant::now();
            let mut followed = Followed::default();
            let mut continuous = continuous.map(ContinuousNaming::new);
            for Work { job, trial, by } in to_do {
                let event = match job {
                    Job::Scan(scan) => {
                        let from =
                            if queues { scan.ended_at.max(free_since) } else { scan.ended_at };
                        let named = continuous.as_mut().filter(|all| all.has_named(scan.number));
                        // A scan in which no surface was found is named as a whole.
                        let last = named.and_then(ContinuousNaming::end);
                        let whole = || name(scan, by, &mut followed, from);
                        WorkerEvent::Scan(last.unwrap_or_else(whole))
                    }
                    Job::Progress(progress) => {
                        let by = by.as_ref().ok();
                        let heard = match (&mut continuous, &trial, by) {
                            (Some(all), None, Some(by)) => caught(|| all.hear(&progress, by)),
                            _ => None,
                        };
                        let heard = heard.unwrap_or_else(|| Heard {
                            guess: followed.guess(&progress, trial.as_deref(), by),
                            ..Heard::default()
                        });
                        WorkerEvent::Progress(Box::new(heard))
                    }
                    Job::Nearest(scan, by) => WorkerEvent::Nearest(nearest(&scan, &by)),
                };
                if send.send(event).is_err() {
                    return;
                }
                free_since = Instant::now();
            }
        };
        std::thread::Builder::new().name("recognise".into()).spawn(run)?;
        Ok(Self { work, done })
    }
}

fn name(
    scan: Box<Scan>,
    by: Result<Arc<Recogniser>, String>,
    followed: &mut Followed,
    from: Instant,
) -> AnsweredScan {
    let by = match by {
        Ok(by) => by,
        Err(why) => return unnamed(scan, Doubt::NotNamed { why }, from),
    };
    let ranked = followed.finish(&scan, &by);
    let settled_s = followed.settled_s(scan.number);
    let answer = caught(|| -> Result<_, RecogniseError> {
        let (ranking, flaws) = match ranked {
            Some(ranked) => ranked,
            None => (by.rank(&scan)?, FlawsBySource::new()),
        };
        Ok(by.answer(&scan, ranking, flaws, settled_s))
    });
    match answer {
        Some(Ok(answer)) => {
            let answer = Arc::new(Answer { latency_ms: since_ms(from), ..answer });
            AnsweredScan { scan, answer, by: Some(by) }
        }
        Some(Err(error)) => unnamed(scan, error.into(), from),
        None => {
            let why = "the method panicked; please report this".into();
            unnamed(scan, Doubt::NotNamed { why }, from)
        }
    }
}

fn nearest(scan: &Scan, by: &Recogniser) -> Option<Box<Answer>> {
    let answer = || Some(by.answer(scan, by.rank(scan).ok()?, FlawsBySource::new(), None));
    caught(answer)?.map(Box::new)
}

/// Faults of sensors are reported only after a drag of this many seconds.
const DAMAGE_AFTER_S: f64 = 0.5;

#[derive(Default)]
struct Followed {
    scan: u32,
    follower: Option<(Arc<Recogniser>, Follower)>,
    last: Option<GuessSoFar>,
    need: TrialNeed,
}

impl Followed {
    /// Adds new data. Returns the guess so far, and whether the scan may end.
    fn guess(
        &mut self,
        progress: &Progress,
        trial: Option<&[SourceId]>,
        by: Option<&Arc<Recogniser>>,
    ) -> Guess {
        let truth = progress.truth.as_ref();
        if self.scan != progress.number {
            let followed_by = |by: &Arc<Recogniser>| {
                let follower = caught(|| by.follow(truth)).flatten()?;
                Some((by.clone(), follower))
            };
            let follower = by.and_then(followed_by);
            *self = Self { scan: progress.number, follower, ..Self::default() };
        }
        if let Some((_, follower)) = &mut self.follower {
            // A scan that cannot be compared is no longer followed, and its answer will say why.
            match caught(|| look(follower, progress)) {
                Some(Ok(guess)) => self.last = guess.or(self.last.take()),
                Some(Err(_)) | None => self.follower = None,
            }
        }
        let (scan, scan_s) = (progress.number, progress.scan_s);
        let mut news = Guess { scan, scan_s, ..Guess::default() };
        if let Some(guess) = &self.last {
            let named = guess.named.iter().cloned();
            let name = |(surface, probability)| SurfaceProbability { surface, probability };
            news.named = named.map(name).collect();
            news.settled = guess.settled.is_some();
            news.state = by.zip(guess.named.first()).and_then(|(by, (_, probability))| {
                so_far(guess.p_value, by.rejection(truth), *probability)
            });
        }
        if let Some((by, follower)) = &self.follower
            && progress.scan_s >= DAMAGE_AFTER_S
        {
            news.doubts = by.flaws_so_far(follower);
        }
        news.doubts.extend(progress.off_pace.iter().cloned());
        news.needed_s = by.and_then(|by| by.needed_s);
        let supported = self.follower.as_ref().is_some_and(|(_, f)| f.settling().shown);
        self.need.judge(&mut news, progress, trial, supported);
        news
    }

    /// The ranking of a scan, computed from the sums of its follower, and the flaws of its sources.
    /// `None` if the scan was not followed, lost samples, or began with another library; then `rank`
    /// compares the whole scan.
    fn finish(&mut self, scan: &Scan, by: &Arc<Recogniser>) -> Option<(Ranking, FlawsBySource)> {
        let (followed_by, follower) =
            self.follower.as_mut().filter(|_| self.scan == scan.number)?;
        let whole = scan.lost_samples == 0 && scan.spoiled.is_empty();
        if !whole || !Arc::ptr_eq(followed_by, by) {
            return None;
        }
        let ranking = caught(|| follower.finish(&scan.trial)).flatten()?;
        let flaws_of = |id: &SourceId| Some((id.clone(), follower.doubts(id)?));
        Some((ranking, scan.trial.signals.keys().filter_map(flaws_of).collect()))
    }

    fn settled_s(&self, scan: u32) -> Option<f64> {
        let last = self.last.as_ref().filter(|_| self.scan == scan)?;
        last.settled.as_ref().map(|(_, at)| *at)
    }
}

/// The result of `work`; `None` if it panicked. A method that panics must not end the station.
fn caught<T>(work: impl FnOnce() -> T) -> Option<T> {
    std::panic::catch_unwind(AssertUnwindSafe(work)).ok()
}

fn look(
    follower: &mut Follower,
    progress: &Progress,
) -> Result<Option<GuessSoFar>, RecogniseError> {
    for Fresh { source, rate_hz, channels, samples, .. } in &progress.fresh {
        let (rate_hz, channels) = (*rate_hz, *channels);
        follower.add(FreshFrames { source, rate_hz, channels, samples })?;
    }
    for (source, picture) in &progress.images {
        follower.add_picture(source, picture);
    }
    follower.look(progress.scan_s)
}

#[cfg(test)]
#[path = "../../../tests/common/oak.rs"]
mod oak;

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::scene::Scene;
    use crate::station::{AnswerState, LibraryState};

    fn scan(number: u32) -> Scan {
        Scan { scan_s: 1.0, ..Scan::of_signals(number, BTreeMap::new()) }
    }

    #[test]
    fn a_method_that_panics_anywhere_takes_neither_the_thread_nor_the_next_scan_with_it() {
        for (part, names) in
            [("nothing", true), ("follow", true), ("prepare", false), ("rank", false)]
        {
            let worker = Worker::start(false, None).unwrap();
            let panics = move |reached: &str| assert_ne!(reached, part, "as the test demands");
            let model = Arc::new(oak::Oak(panics));
            let by = Arc::new(Recogniser::new(model, Scene::lmt108(), LibraryState::default()));
            for number in 1..=2 {
                let progress = Progress { number, scan_s: 0.5, ..Progress::default() };
                for job in [Job::Progress(progress), Job::Scan(Box::new(scan(number)))] {
                    let work = Work { job, trial: None, by: Ok(by.clone()) };
                    worker.work.send(work).unwrap();
                }
                let Ok(WorkerEvent::Progress(heard)) = worker.done.recv() else {
                    panic!("{part}: no guess")
                };
                let guess = heard.guess;
                assert_eq!((guess.scan, guess.scan_s), (number, 0.5), "{part}");
                assert!(guess.named.is_empty() && !guess.settled && !guess.enough, "{part}");
                let Ok(WorkerEvent::Scan(AnsweredScan { answer, .. })) = worker.done.recv() else {
                    panic!("{part}: no answer")
                };
                let is_named = answer.state != AnswerState::Unnamed;
                assert_eq!((answer.scan, is_named), (number, names), "{part}");
                let text = answer.not_named();
                assert_ne!(is_named, text.contains("panicked"), "{part}");
            }
            drop(worker.work);
            assert_eq!(worker.done.iter().count(), 0);
        }
    }
}
