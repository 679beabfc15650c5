//! The thread that follows and names scans, so that reading events is never held up.

use std::panic::AssertUnwindSafe;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Instant;

use crossbeam_channel::{Receiver, Sender};

use super::notice::{Answer, Guess};
use super::recogniser::{Recogniser, Verdict};
use crate::recognise::{Follow, FreshFrames, GuessSoFar, RecogniseError};
use crate::scan::{Fresh, Progress, Scan};

/// What is to be recognised.
pub(super) enum Job {
    /// A scan to be named.
    Scan(Box<Scan>),
    /// What is new in the scan that goes on.
    Progress(Progress),
}

/// What is to be recognised, and by what.
pub(super) struct Work {
    pub job: Job,
    pub by: Arc<dyn Recogniser>,
}

/// What the thread has found.
pub(super) enum Told {
    /// A scan's answer, or why there is none.
    Named(Named),
    /// How the scan looks that goes on.
    Guess(Guess),
}

/// An answer, or why there is none.
pub(super) type Named = Result<Arc<Answer>, String>;

/// The thread, and its two ends; it ends when the first is dropped.
pub(super) struct Worker {
    pub work: Sender<Work>,
    pub told: Receiver<Told>,
    thread: JoinHandle<()>,
}

impl Worker {
    /// Starts the thread. With `queues`, scans may wait for their turn behind others, as a
    /// recording's do that is played as fast as it is taken; that wait is no latency.
    ///
    /// # Errors
    /// If the system gives no thread.
    pub fn start(queues: bool) -> std::io::Result<Self> {
        let (work, to_do) = crossbeam_channel::bounded::<Work>(1);
        let (tell, told) = crossbeam_channel::unbounded();
        let run = move || {
            let mut free_since = Instant::now();
            let mut followed = Followed::default();
            for Work { job, by } in to_do {
                let told = match job {
                    Job::Scan(scan) => {
                        let from =
                            if queues { scan.ended_at.max(free_since) } else { scan.ended_at };
                        let settled_s = followed.settled_s(scan.number);
                        Told::Named(name(&scan, &*by, from, settled_s))
                    }
                    Job::Progress(progress) => Told::Guess(followed.guess(&progress, &*by)),
                };
                if tell.send(told).is_err() {
                    return;
                }
                free_since = Instant::now();
            }
        };
        let thread = std::thread::Builder::new().name("recognise".into()).spawn(run)?;
        Ok(Self { work, told, thread })
    }

    /// Gives what is still to come.
    pub fn finish(self) -> impl Iterator<Item = Told> {
        drop(self.work);
        let _ = self.thread.join();
        self.told.into_iter()
    }
}

/// The scan that goes on, as it is followed.
#[derive(Default)]
struct Followed {
    scan: u32,
    follower: Option<Box<dyn Follow>>,
    last: Option<GuessSoFar>,
}

impl Followed {
    /// Adds what is new, and says how the scan looks.
    fn guess(&mut self, progress: &Progress, by: &dyn Recogniser) -> Guess {
        if self.scan != progress.number {
            let follower = by.follow(progress.truth.as_ref());
            *self = Self { scan: progress.number, follower, last: None };
        }
        if let Some(follower) = &mut self.follower {
            // A scan that cannot be compared is not followed any more; its naming will say why.
            let looked =
                std::panic::catch_unwind(AssertUnwindSafe(|| look(&mut **follower, progress)));
            match looked {
                Ok(Ok(guess)) => self.last = guess.or(self.last.take()),
                Ok(Err(_)) | Err(_) => self.follower = None,
            }
        }
        let mut told = Guess::nothing(progress.number, progress.scan_s);
        if let Some(guess) = &self.last {
            let name = |(surface, probability): &(String, f64)| super::notice::Named {
                surface: surface.clone(),
                probability: *probability,
            };
            told.named = guess.named.iter().map(name).collect();
            told.settled = guess.settled.is_some();
            told.needed_s = guess.named.first().and_then(|(surface, _)| by.needed_s(surface));
        }
        told
    }

    /// When the answer of a scan was settled, in seconds of scan time.
    fn settled_s(&self, scan: u32) -> Option<f64> {
        let last = self.last.as_ref().filter(|_| self.scan == scan)?;
        last.settled.as_ref().map(|(_, at)| *at)
    }
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

fn name(scan: &Scan, by: &dyn Recogniser, from: Instant, settled_s: Option<f64>) -> Named {
    // One scan that cannot be compared must not take the station with it.
    let verdict = std::panic::catch_unwind(AssertUnwindSafe(|| by.name(scan)))
        .map_err(|_| "the method panicked; please report this".to_string())
        .and_then(|verdict| verdict.map_err(|error| error.to_string()))
        .map_err(|problem| format!("scan {}: {problem}", scan.number))?;
    let latency_ms = from.elapsed().as_secs_f64() * 1e3;
    let Verdict { ranking, unknown, needed_s, remarks } = verdict;
    let truth = scan.truth.as_ref();
    Ok(Arc::new(Answer {
        scan: scan.number,
        surface: (!unknown).then(|| ranking.surface().to_string()),
        truth: truth.map(|key| key.surface.clone()),
        user: truth.map(|key| key.user.clone()),
        trial: truth.map(|key| key.number),
        synthetic: scan.synthetic,
        margin: ranking.margin,
        confidence: ranking.confidence,
        fit: ranking.fit,
        latency_ms,
        scan_s: scan.scan_s,
        settled_s,
        lost_samples: scan.lost_samples,
        sources: ranking.sources,
        spoiled: scan.spoiled.clone(),
        needed_s,
        remarks,
        ranked: ranking.ranked,
    }))
}
