//! The thread that follows and names scans, so that nothing holds up the reading of events.

use std::sync::Arc;
use std::time::Instant;

use crossbeam_channel::{Receiver, Sender};

use super::answer::{Answer, AnswerState, AnsweredScan, Unnamed};
use super::certainty::{NamedScan, judge, unknown_share};
use super::event::Guess;
use super::followed::{Followed, caught};
use super::recogniser::{Ranked, Recogniser, Verdict};
use super::store::StoredScan;
use super::trial_need::Purpose;
use crate::recognise::RecogniseError;
use crate::scan::{Progress, Scan};

/// The kinds of job of the worker, each with its own type of data.
pub(super) enum JobOf<S, P, K> {
    /// A scan to be named.
    Scan(S),
    /// New data of the scan in progress.
    Progress(P),
    /// A scan that was kept as a trial, for which the nearest surface is sought.
    Kept(K),
}

/// A job without the recogniser for it.
pub(super) type Job = JobOf<Box<Scan>, Progress, Box<StoredScan>>;

/// A job with all that the worker needs for it. Progress comes with its purpose, and with a
/// recogniser if there is one.
pub(super) type Work = JobOf<
    (Box<Scan>, Arc<Recogniser>),
    (Progress, Purpose, Option<Arc<Recogniser>>),
    Box<StoredScan>,
>;

/// The result of a job: the answer, the guess, or the nearest surface if there is one.
pub(super) type WorkerEvent = JobOf<ScanAnswer, Guess, Option<String>>;

impl Work {
    /// The job, without its recogniser and purpose.
    pub fn into_job(self) -> Job {
        match self {
            Self::Scan((scan, _)) => Job::Scan(scan),
            Self::Progress((progress, ..)) => Job::Progress(progress),
            Self::Kept(stored) => Job::Kept(stored),
        }
    }
}

pub(super) enum ScanAnswer {
    Named(Arc<AnsweredScan>),
    /// A scan that could not be named.
    Unnamed(Arc<AnsweredScan>, Unnamed),
}

impl ScanAnswer {
    /// The answer for a scan that could not be named, with the reason.
    pub fn unnamed(scan: Box<Scan>, why: &str, latency_ms: f64, too_little: bool) -> Self {
        let answer =
            Arc::new(Answer { reasons: vec![why.into()], ..Answer::of(&scan, latency_ms) });
        let text = format!("scan {} was not named: {why}", scan.number);
        let unnamed = Unnamed { answer: answer.clone(), text, too_little };
        Self::Unnamed(Arc::new(AnsweredScan { scan, answer, by: None }), unnamed)
    }
}

/// The channels to and from the thread, which returns one event for each piece of work, in order.
/// Once `work` is dropped, the thread ends after its current job; nobody waits for it.
pub(super) struct Worker {
    pub work: Sender<Work>,
    pub done: Receiver<WorkerEvent>,
}

impl Worker {
    /// Starts the thread. With `queues`, scans may wait behind others, as in a recording that is
    /// played as fast as possible; that wait is not counted as latency.
    ///
    /// # Errors
    /// If the system gives no thread.
    pub fn start(queues: bool) -> std::io::Result<Self> {
        let (work, to_do) = crossbeam_channel::bounded::<Work>(1);
        let (send, done) = crossbeam_channel::unbounded();
        let run = move || {
            let mut free_since = Instant::now();
            let mut followed = Followed::default();
            for work in to_do {
                let event = match work {
                    Work::Scan((scan, by)) => {
                        let from =
                            if queues { scan.ended_at.max(free_since) } else { scan.ended_at };
                        let settled_s = followed.settled_s(scan.number);
                        let ranked = followed.finish(&scan, &by);
                        WorkerEvent::Scan(name(scan, by, ranked, from, settled_s))
                    }
                    Work::Progress((progress, purpose, by)) => {
                        WorkerEvent::Progress(followed.guess(&progress, &purpose, by.as_ref()))
                    }
                    Work::Kept(stored) => WorkerEvent::Kept(nearest(&stored)),
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
    by: Arc<Recogniser>,
    ranked: Option<Ranked>,
    from: Instant,
    settled_s: Option<f64>,
) -> ScanAnswer {
    let ranked = || ranked.map_or_else(|| by.rank(&scan), Ok);
    let verdict = caught(|| ranked().map(|ranked| by.verdict(&scan, ranked)));
    let latency_ms = from.elapsed().as_secs_f64() * 1e3;
    let (why, too_little) = match verdict {
        Some(Ok(verdict)) => return named(scan, by, verdict, latency_ms, settled_s),
        Some(Err(error)) => (error.to_string(), matches!(error, RecogniseError::TooLittle)),
        None => ("the method panicked; please report this".into(), false),
    };
    ScanAnswer::unnamed(scan, &why, latency_ms, too_little)
}

fn named(
    scan: Box<Scan>,
    by: Arc<Recogniser>,
    verdict: Verdict,
    latency_ms: f64,
    settled_s: Option<f64>,
) -> ScanAnswer {
    let (state, reasons) = judge(&NamedScan { verdict: &verdict, scan: &scan, settled_s });
    let unknown = unknown_share(&verdict);
    let Verdict { ranking, needed_s, remarks, damage, .. } = verdict;
    let alone = Answer::of(&scan, latency_ms);
    let answer = Answer {
        surface: (state != AnswerState::Unknown).then(|| ranking.surface().to_string()),
        state,
        reasons,
        margin: ranking.margin,
        confidence: ranking.confidence,
        fit: ranking.p_value,
        unknown,
        settled_s,
        sources: ranking.sources,
        needed_s,
        remarks,
        ranked: ranking.ranked,
        damage: alone.damage.iter().cloned().chain(damage).collect(),
        ..alone
    };
    ScanAnswer::Named(Arc::new(AnsweredScan { scan, answer: Arc::new(answer), by: Some(by) }))
}

/// The surface that the recogniser names for a scan that was kept as a trial.
fn nearest(stored: &StoredScan) -> Option<String> {
    let (scan, by) = stored.kept.as_ref()?;
    let verdict = caught(|| Some(by.verdict(scan, by.rank(scan).ok()?)))??;
    (!verdict.is_unknown()).then(|| verdict.ranking.surface().to_string())
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::library::Entry;
    use crate::recognise::features::FeatureVector;
    use crate::recognise::{
        EmbeddingModel, Model, Prepared, RankedSurface, Ranking, RecogniseError,
    };
    use crate::scene::Scene;
    use crate::station::LibraryState;
    use crate::trial::{Trial, TrialKey};

    /// A method that names everything oak, but panics in one of its functions.
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

        fn embedding(self: Arc<Self>) -> Option<Arc<EmbeddingModel>> {
            self.reach("follow");
            None
        }
    }

    fn scan(number: u32) -> Scan {
        Scan { scan_s: 1.0, ..Scan::of_signals(number, BTreeMap::new()) }
    }

    #[test]
    fn a_method_that_panics_anywhere_takes_neither_the_thread_nor_the_next_scan_with_it() {
        for (part, names) in
            [("nothing", true), ("follow", true), ("prepare", false), ("rank", false)]
        {
            let worker = Worker::start(false).unwrap();
            let model = Arc::new(PanicsIn(part));
            let by = Arc::new(Recogniser::new(model, Scene::lmt108(), LibraryState::default()));
            for number in 1..=2 {
                let progress = Progress {
                    number,
                    truth: None,
                    scan_s: 0.5,
                    fresh: Vec::new(),
                    images: Vec::new(),
                };
                let progress = Work::Progress((progress, Purpose::Name, Some(by.clone())));
                for work in [progress, Work::Scan((Box::new(scan(number)), by.clone()))] {
                    worker.work.send(work).unwrap();
                }
                let Ok(WorkerEvent::Progress(guess)) = worker.done.recv() else {
                    panic!("{part}: no guess")
                };
                assert_eq!((guess.scan, guess.scan_s), (number, 0.5), "{part}");
                assert!(guess.named.is_empty() && !guess.settled && !guess.enough, "{part}");
                let Ok(WorkerEvent::Scan(answered)) = worker.done.recv() else {
                    panic!("{part}: no answer")
                };
                match answered {
                    ScanAnswer::Named(named) => {
                        assert!(names && named.answer.scan == number, "{part}");
                    }
                    ScanAnswer::Unnamed(whole, Unnamed { answer, text, too_little }) => {
                        assert!(
                            !names && !too_little && text.contains("panicked"),
                            "{part}: {text}"
                        );
                        assert_eq!(answer.state, AnswerState::Unnamed, "{part}");
                        assert!(answer.scan == number && whole.answer.id == answer.id, "{part}");
                    }
                }
            }
            drop(worker.work);
            assert_eq!(worker.done.iter().count(), 0);
        }
    }
}
