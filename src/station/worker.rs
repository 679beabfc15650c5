//! The thread that follows and names scans, so that nothing holds up the reading of events.

use std::panic::AssertUnwindSafe;
use std::sync::Arc;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use crossbeam_channel::{Receiver, Sender};

use super::certainty::{Case, judge};
use super::event::{Answer, AnswerState, AnsweredScan, Guess};
use super::recogniser::{Recogniser, Verdict};
use crate::recognise::{Follow, FreshFrames, GuessSoFar, Ranking, RecogniseError};
use crate::record::utc;
use crate::scan::{Fresh, Progress, Scan};

/// What is to be recognised.
pub(super) enum Job {
    /// A scan to be named.
    Scan(Box<Scan>),
    /// What is new in the scan in progress.
    Progress(Progress),
}

/// What is to be recognised, and by what.
pub(super) struct Work {
    pub job: Job,
    pub by: Arc<Recogniser>,
}

/// What the thread has done.
pub(super) enum WorkerEvent {
    /// A scan's answer, or why there is none.
    Named(ScanAnswer),
    /// What the scan in progress looks like so far.
    Guess(Guess),
}

/// A scan with its answer, or why it has none.
pub(super) type ScanAnswer = Result<Arc<AnsweredScan>, String>;

/// The two ends of the thread, which gives an event for each piece of work, in their order. Once
/// the first is dropped, it ends with what it has in hand, and nobody waits for it.
pub(super) struct Worker {
    pub work: Sender<Work>,
    pub done: Receiver<WorkerEvent>,
}

impl Worker {
    /// Starts the thread. With `queues`, scans may wait for their turn behind others, as those of a
    /// recording do that is played as fast as possible; that wait is not counted as latency.
    ///
    /// # Errors
    /// If the system gives no thread.
    pub fn start(queues: bool) -> std::io::Result<Self> {
        let (work, to_do) = crossbeam_channel::bounded::<Work>(1);
        let (send, done) = crossbeam_channel::unbounded();
        let run = move || {
            let mut free_since = Instant::now();
            let mut followed = Followed::default();
            for Work { job, by } in to_do {
                let event = match job {
                    Job::Scan(scan) => {
                        let from =
                            if queues { scan.ended_at.max(free_since) } else { scan.ended_at };
                        let settled_s = followed.settled_s(scan.number);
                        let ranking = followed.finish(&scan, &by);
                        WorkerEvent::Named(name(scan, by, ranking, from, settled_s))
                    }
                    Job::Progress(progress) => WorkerEvent::Guess(followed.guess(&progress, &by)),
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

/// The scan in progress, as far as it was followed.
#[derive(Default)]
struct Followed {
    scan: u32,
    /// With what it is followed by.
    follower: Option<(Arc<Recogniser>, Box<dyn Follow>)>,
    last: Option<GuessSoFar>,
}

impl Followed {
    /// Adds what is new, and gives the scan's first answers.
    fn guess(&mut self, progress: &Progress, by: &Arc<Recogniser>) -> Guess {
        if self.scan != progress.number {
            let follower = caught(|| by.follow(progress.truth.as_ref())).flatten();
            let follower = follower.map(|follower| (by.clone(), follower));
            *self = Self { scan: progress.number, follower, last: None };
        }
        if let Some((_, follower)) = &mut self.follower {
            // A scan that cannot be compared is followed no longer; its answer will say why.
            match caught(|| look(&mut **follower, progress)) {
                Some(Ok(guess)) => self.last = guess.or(self.last.take()),
                Some(Err(_)) | None => self.follower = None,
            }
        }
        let mut news = Guess::nothing(progress.number, progress.scan_s);
        if let Some(guess) = &self.last {
            let name = |(surface, probability): &(String, f64)| super::event::SurfaceProbability {
                surface: surface.clone(),
                probability: *probability,
            };
            news.named = guess.named.iter().map(name).collect();
            news.settled = guess.settled.is_some();
            let first = guess.named.first();
            news.needed_s =
                first.and_then(|(surface, _)| caught(|| by.needed_s(surface)).flatten());
        }
        news
    }

    /// The ranking of a scan that was followed, from what was summed up meanwhile. `None` where the
    /// scan must be gone through from its beginning: it was not followed, or has lost samples, or
    /// another library was read since it began.
    fn finish(&mut self, scan: &Scan, by: &Arc<Recogniser>) -> Option<Ranking> {
        let (followed_by, follower) =
            self.follower.as_mut().filter(|_| self.scan == scan.number)?;
        let whole = scan.lost_samples == 0 && scan.spoiled.is_empty();
        if !whole || !Arc::ptr_eq(followed_by, by) {
            return None;
        }
        caught(|| follower.finish(&scan.trial)).flatten()
    }

    /// When the answer of a scan was settled, in seconds of scan time.
    fn settled_s(&self, scan: u32) -> Option<f64> {
        let last = self.last.as_ref().filter(|_| self.scan == scan)?;
        last.settled.as_ref().map(|(_, at)| *at)
    }
}

/// What `work` gives; `None` if it panicked. One scan must not take the station with it.
fn caught<T>(work: impl FnOnce() -> T) -> Option<T> {
    std::panic::catch_unwind(AssertUnwindSafe(work)).ok()
}

fn look(
    follower: &mut dyn Follow,
    progress: &Progress,
) -> Result<Option<GuessSoFar>, RecogniseError> {
    for Fresh { source, rate_hz, channels, samples, .. } in &progress.fresh {
        let (rate_hz, channels) = (*rate_hz, *channels);
        follower.add(FreshFrames { source, rate_hz, channels, samples })?;
    }
    for (source, picture) in &progress.images {
        follower.add_picture(source, picture)?;
    }
    follower.look(progress.scan_s)
}

fn name(
    scan: Box<Scan>,
    by: Arc<Recogniser>,
    ranking: Option<Ranking>,
    from: Instant,
    settled_s: Option<f64>,
) -> ScanAnswer {
    let ranked = || ranking.map_or_else(|| by.rank(&scan), Ok);
    let verdict = caught(|| ranked().map(|ranking| by.verdict(&scan, ranking)))
        .ok_or_else(|| "the method panicked; please report this".to_string())
        .and_then(|verdict| verdict.map_err(|error| error.to_string()))
        .map_err(|problem| format!("scan {}: {problem}", scan.number))?;
    let latency_ms = from.elapsed().as_secs_f64() * 1e3;
    let (state, reasons) = judge(&Case { verdict: &verdict, scan: &scan, settled_s });
    let Verdict { ranking, needed_s, remarks, .. } = verdict;
    let truth = scan.truth.as_ref();
    let (id, unix_ms) = stamp(SystemTime::now(), scan.number);
    let answer = Answer {
        link: format!("/#scan={id}"),
        id,
        unix_ms,
        scan: scan.number,
        surface: (state != AnswerState::Unknown).then(|| ranking.surface().to_string()),
        state,
        reasons,
        truth: truth.and_then(|key| key.label().map(String::from)),
        user: truth.map(|key| key.user.clone()),
        trial: truth.map(|key| key.number),
        synthetic: scan.synthetic,
        margin: ranking.margin,
        confidence: ranking.confidence,
        fit: ranking.p_value,
        latency_ms,
        scan_s: scan.scan_s,
        settled_s,
        lost_samples: scan.lost_samples,
        sources: ranking.sources,
        spoiled: scan.spoiled.clone(),
        needed_s,
        remarks,
        ranked: ranking.ranked,
    };
    Ok(Arc::new(AnsweredScan { scan, answer: Arc::new(answer), by }))
}

/// What names an answer for good, such as `20260921-143000.123-7`, and its time in milliseconds
/// since 1970.
fn stamp(now: SystemTime, scan: u32) -> (String, u64) {
    let unix_ms = now.duration_since(UNIX_EPOCH).map_or(0, |since| since.as_millis() as u64);
    let date = utc(now).replace(['-', ':', 'Z'], "").replace('T', "-");
    (format!("{date}.{:03}-{scan:02}", unix_ms % 1000), unix_ms)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::library::Entry;
    use crate::recognise::features::FeatureVector;
    use crate::recognise::{FollowOptions, Model, Prepared, RankedSurface, Ranking, Settling};
    use crate::scene::{Scene, SourceId};
    use crate::station::{DurationRequirements, LibraryState};
    use crate::trial::{Image, Trial, TrialKey};

    /// Finds that everything is oak, but panics in one of its parts.
    #[derive(Clone, Copy)]
    struct PanicsIn(&'static str);

    impl PanicsIn {
        fn reach(self, part: &str) {
            assert_ne!(self.0, part, "as the test demands");
        }
    }

    impl Model for PanicsIn {
        fn prepare(&self, entry: &Entry, _: &Trial) -> Result<Prepared, RecogniseError> {
            self.reach("prepare");
            let (key, sources) = (entry.key.clone(), BTreeMap::new());
            Ok(Prepared::Features(Arc::new(FeatureVector { key, sources })))
        }

        fn rank(&self, _: &Prepared) -> Result<Ranking, RecogniseError> {
            self.reach("rank");
            Ok(Ranking {
                ranked: vec![RankedSurface { surface: "oak".into(), score: 1.0 }],
                margin: 0.0,
                sources: Vec::new(),
                nearest: TrialKey::new("oak", "", 1),
                confidence: None,
                p_value: None,
            })
        }

        fn follow(self: Arc<Self>, _: &FollowOptions) -> Option<Box<dyn Follow>> {
            self.reach("follow");
            Some(Box::new(Follower { by: *self, settling: Settling::choose(&[], 0.01) }))
        }
    }

    struct Follower {
        by: PanicsIn,
        settling: Settling,
    }

    impl Follow for Follower {
        fn begin(&mut self) {}

        fn add(&mut self, _: FreshFrames<'_>) -> Result<(), RecogniseError> {
            Ok(())
        }

        fn add_picture(&mut self, _: &SourceId, _: &Image) -> Result<(), RecogniseError> {
            Ok(())
        }

        fn look(&mut self, scan_s: f64) -> Result<Option<GuessSoFar>, RecogniseError> {
            self.by.reach("look");
            let named = vec![("oak".into(), 1.0)];
            Ok(Some(GuessSoFar { scan_s, named, p_value: None, settled: None }))
        }

        fn finish(&mut self, _: &Trial) -> Option<Ranking> {
            None
        }

        fn settling(&self) -> &Settling {
            &self.settling
        }
    }

    fn scan(number: u32) -> Scan {
        Scan {
            number,
            trial: Trial { key: TrialKey::new("", "", number), signals: BTreeMap::new() },
            truth: None,
            synthetic: false,
            scan_s: 1.0,
            lost_samples: 0,
            lost_by_source: BTreeMap::new(),
            spoiled: Vec::new(),
            ended_at: Instant::now(),
        }
    }

    #[test]
    fn an_answer_is_named_by_its_moment_and_scan() {
        let moment = UNIX_EPOCH + std::time::Duration::from_millis(1_790_001_000_123);
        let stamped = ("20260921-131000.123-07".to_string(), 1_790_001_000_123);
        assert_eq!(stamp(moment, 7), stamped);
    }

    #[test]
    fn a_method_that_panics_anywhere_takes_neither_the_thread_nor_the_next_scan_with_it() {
        for (part, guesses, names) in [
            ("nothing", true, true),
            ("follow", false, true),
            ("look", false, true),
            ("prepare", true, false),
            ("rank", true, false),
        ] {
            let worker = Worker::start(false).unwrap();
            let needs = DurationRequirements::of(&Scene::lmt108(), Vec::new(), false);
            let model = Arc::new(PanicsIn(part));
            let by = Arc::new(Recogniser::new(model, needs, LibraryState::default()));
            for number in 1..=2 {
                let progress = Progress {
                    number,
                    truth: None,
                    scan_s: 0.5,
                    fresh: Vec::new(),
                    images: Vec::new(),
                };
                for job in [Job::Progress(progress), Job::Scan(Box::new(scan(number)))] {
                    worker.work.send(Work { job, by: by.clone() }).unwrap();
                }
                let Ok(WorkerEvent::Guess(guess)) = worker.done.recv() else {
                    panic!("{part}: no guess")
                };
                assert_eq!((guess.scan, guess.scan_s), (number, 0.5), "{part}");
                assert_eq!(!guess.named.is_empty(), guesses, "{part}");
                let Ok(WorkerEvent::Named(named)) = worker.done.recv() else {
                    panic!("{part}: no name")
                };
                match named {
                    Ok(named) => assert!(names && named.answer.scan == number, "{part}"),
                    Err(problem) => {
                        assert!(!names && problem.contains("panicked"), "{part}: {problem}");
                    }
                }
            }
            drop(worker.work);
            assert_eq!(worker.done.iter().count(), 0);
        }
    }
}
