//! The thread that names scans, so that reading events is never held up.

use std::panic::AssertUnwindSafe;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Instant;

use crossbeam_channel::{Receiver, Sender};

use super::notice::Answer;
use super::recogniser::{Recogniser, Verdict};
use crate::scan::Scan;

/// A scan to be named.
pub(super) struct Work {
    pub scan: Box<Scan>,
    pub by: Arc<dyn Recogniser>,
}

/// An answer, or why there is none.
pub(super) type Named = Result<Answer, String>;

/// The thread, and its two ends; it ends when the first is dropped.
pub(super) struct Worker {
    pub work: Sender<Work>,
    pub named: Receiver<Named>,
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
        let (tell, named) = crossbeam_channel::unbounded();
        let run = move || {
            let mut free_since = Instant::now();
            for Work { scan, by } in to_do {
                let from = if queues { scan.ended_at.max(free_since) } else { scan.ended_at };
                if tell.send(name(&scan, &*by, from)).is_err() {
                    return;
                }
                free_since = Instant::now();
            }
        };
        let thread = std::thread::Builder::new().name("recognise".into()).spawn(run)?;
        Ok(Self { work, named, thread })
    }

    /// Gives what is still to come.
    pub fn finish(self) -> impl Iterator<Item = Named> {
        drop(self.work);
        let _ = self.thread.join();
        self.named.into_iter()
    }
}

fn name(scan: &Scan, by: &dyn Recogniser, from: Instant) -> Named {
    // One scan that cannot be compared must not take the station with it.
    let verdict = std::panic::catch_unwind(AssertUnwindSafe(|| by.name(scan)))
        .map_err(|_| "the method panicked; please report this".to_string())
        .and_then(|verdict| verdict.map_err(|error| error.to_string()))
        .map_err(|problem| format!("scan {}: {problem}", scan.number))?;
    let latency_ms = from.elapsed().as_secs_f64() * 1e3;
    let Verdict { ranking, needed_s, remarks } = verdict;
    let truth = scan.truth.as_ref();
    Ok(Answer {
        scan: scan.number,
        surface: Some(ranking.surface().to_string()),
        truth: truth.map(|key| key.surface.clone()),
        user: truth.map(|key| key.user.clone()),
        trial: truth.map(|key| key.number),
        synthetic: scan.synthetic,
        margin: ranking.margin,
        confidence: None,
        fit: None,
        latency_ms,
        scan_s: scan.scan_s,
        settled_s: None,
        lost_samples: scan.lost_samples,
        sources: ranking.sources,
        spoiled: scan.spoiled.clone(),
        needed_s,
        remarks,
        ranked: ranking.ranked,
    })
}
