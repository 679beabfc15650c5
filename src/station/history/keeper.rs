//! Writes a station's scans into a history, on separate threads, so that the station never waits.

use std::collections::{BTreeMap, BTreeSet};
use std::convert::Infallible;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::{Duration, UNIX_EPOCH};

use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, bounded};
use serde::Serialize;

use super::view::TrialView;
use super::{History, HistoryError, SCANS};
use crate::jpeg;
use crate::library::About;
use crate::printable::json_text;
use crate::record::{TrialOptions, write_trial};
use crate::scene::Scene;
use crate::station::{AnsweredScan, End, Listener, StationEvent, Why};
use crate::system::lock;
use crate::trial::{Signal, Trial, TrialKey, lines, utc};

/// How many scans may wait in the queue of each thread. Scans of ten seconds then take some 50 MB.
const QUEUE: usize = 16;
/// Time after which changes that could not be written are tried again.
const RETRY: Duration = Duration::from_secs(2);

#[derive(Debug)]
pub struct Keeper {
    scans: Option<Sender<Arc<AnsweredScan>>>,
    /// The scans that no thread has taken yet.
    waiting: Receiver<Arc<AnsweredScan>>,
    work: Arc<Work>,
    end: End,
}

/// The state that the two threads share.
#[derive(Debug)]
struct Work {
    history: Arc<History>,
    scene: Scene,
    devices: BTreeMap<String, String>,
    /// The session of the scans, which trials made of them get.
    session: Option<String>,
    /// Ids of scans that have their signals on disk, but not their notes yet. The thread that removes
    /// an id reports that scan as kept.
    without_notes: Mutex<BTreeSet<String>>,
}

const NO_TRIALS: &str = "the model holds no trials, so the nearest one is not shown; name scans by its library to see it";

/// The content of `.why.json`, beside the signals of a scan.
#[derive(Serialize)]
struct Notes<'a> {
    why: Option<&'a Why>,
    scan: TrialView,
    nearest: Option<NearestView>,
    /// Why the nearest trial is not shown, if there is no library.
    no_nearest: Option<&'static str>,
}

#[derive(Serialize)]
struct NearestView {
    trial: TrialKey,
    #[serde(flatten)]
    view: TrialView,
}

/// A scan, and the folder of its signals.
type Written = (Arc<AnsweredScan>, PathBuf);

impl Keeper {
    /// Starts the threads that write scans into a history. `scene` describes the sources, `devices`
    /// names the device of each source, and `session` is the session of all scans.
    ///
    /// # Errors
    /// If a thread cannot be started.
    pub fn start(
        history: Arc<History>,
        scene: Scene,
        devices: BTreeMap<String, String>,
        session: Option<String>,
    ) -> std::io::Result<Self> {
        let ((scans, to_keep), (notes, to_note)) = (bounded(QUEUE), bounded(QUEUE));
        let (working, ended) = bounded::<Infallible>(0);
        let without_notes = Mutex::default();
        let work = Arc::new(Work { history, scene, devices, session, without_notes });
        let (writer, annotator, waiting) = (work.clone(), work.clone(), to_keep.clone());
        let thread = |name: &str| std::thread::Builder::new().name(name.into());
        thread("history").spawn(move || writer.write_all(&to_keep, &notes))?;
        // Notes may take as long as naming a scan, so a second thread writes them. It ends after the
        // writer drops `notes`. Then `_working` is dropped, by which [`End`] notices the end.
        thread("history-notes").spawn(move || {
            let _working = working;
            annotator.note_all(&to_note);
        })?;
        Ok(Self { scans: Some(scans), waiting, work, end: End::of(ended) })
    }
}

impl Listener for Keeper {
    fn on_event(&mut self, event: &StationEvent) {
        if self.end.is_here(event) {
            self.scans = None;
        }
        if let StationEvent::Library(library) = event {
            self.work.history.refer(&library.reference);
        }
        if let (StationEvent::Scan(scan), Some(scans)) = (event, &self.scans)
            && scans.try_send(scan.clone()).is_err()
        {
            tell_lost(scan);
        }
    }
}

impl Drop for Keeper {
    /// Waits until all is written or the station must end. Reports scans without notes as kept, and
    /// those that still wait as lost.
    fn drop(&mut self) {
        self.scans = None;
        if !self.end.wait(Duration::MAX) {
            self.waiting.try_iter().for_each(|scan| tell_lost(&scan));
            let Work { history, without_notes, .. } = &*self.work;
            for id in std::mem::take(&mut *lock(without_notes)) {
                history.note(history.kept(&id));
            }
        }
    }
}

fn tell_lost(scan: &AnsweredScan) {
    tracing::warn!("scan {} is not in the history: the disk is too slow", scan.answer.scan);
}

impl Work {
    fn write_all(&self, scans: &Receiver<Arc<AnsweredScan>>, notes: &Sender<Written>) {
        loop {
            let scan = match scans.recv_timeout(RETRY) {
                Ok(scan) => scan,
                Err(ended) => {
                    self.history.write_waiting_changes();
                    match ended {
                        RecvTimeoutError::Timeout => continue,
                        RecvTimeoutError::Disconnected => return,
                    }
                }
            };
            let written = self.history.answered(&scan.answer).and_then(|()| self.write(&scan));
            let Ok(Some(folder)) = written else {
                self.history.note(written.map(drop));
                continue;
            };
            let id = scan.answer.id.clone();
            lock(&self.without_notes).insert(id.clone());
            let too_many_wait = notes.try_send((scan, folder)).is_err();
            if too_many_wait && lock(&self.without_notes).remove(&id) {
                self.history.note(self.history.kept(&id));
            }
        }
    }

    /// Writes the signals of a scan, and returns their folder; `None` without signals or a disk.
    fn write(&self, answered: &AnsweredScan) -> Result<Option<PathBuf>, HistoryError> {
        let AnsweredScan { scan, answer, .. } = answered;
        // A scan that could not be named may have no signals.
        let root = self.history.root().filter(|_| !scan.trial.signals.is_empty());
        let Some(root) = root else { return Ok(None) };
        let began = Duration::from_millis(answer.unix_ms)
            .saturating_sub(Duration::from_secs_f64(scan.scan_s.max(0.0)));
        let about = About {
            started_at: Some(utc(UNIX_EPOCH + began)).filter(|_| began > Duration::ZERO),
            notes: (!scan.spoiled.is_empty()).then(|| lines(&scan.spoiled).join("\n")),
            synthetic: scan.synthetic,
            devices: self.devices.clone(),
            ..About::default()
        };
        // The trial is not `durable`, since waiting for the disk takes long and power failures are rare.
        let options = TrialOptions { about, durable: false };
        let user = answer.id.rsplit_once('-').map_or(answer.id.as_str(), |(moment, _)| moment);
        let key = TrialKey::new(SCANS, user, answer.scan).with_session(self.session.clone());
        let trial = Trial { key, signals: scan.trial.signals.clone() };
        Ok(Some(write_trial(&root, &trial, &self.scene, &options)?))
    }

    fn note_all(&self, written: &Receiver<Written>) {
        for (scan, folder) in written {
            let noted = self.note(&scan, &folder);
            let id = &scan.answer.id;
            if lock(&self.without_notes).remove(id) {
                let kept = self.history.kept(id);
                self.history.note(noted.and(kept));
            }
        }
    }

    /// Writes why a scan got its name, and small views of the scan and of the nearest trial.
    fn note(&self, answered: &AnsweredScan, folder: &Path) -> Result<(), HistoryError> {
        let AnsweredScan { scan, by, .. } = answered;
        let why = caught(|| by.as_ref()?.explain(scan).ok());
        let nearest = caught(|| by.as_ref()?.trials.get(&why.as_ref()?.nearest)?.load().ok());
        if let Some(nearest) = &nearest {
            write_pictures(nearest, folder)?;
        }
        let nearest = nearest.map(|nearest| NearestView {
            view: TrialView::of(&nearest, &self.scene),
            trial: nearest.key,
        });
        let scan = TrialView::of(&scan.trial, &self.scene);
        let is_model = by.as_ref().is_some_and(|by| by.trials.is_empty());
        let no_nearest = is_model.then_some(NO_TRIALS);
        let notes = Notes { why: why.as_ref(), scan, nearest, no_nearest };
        let path = folder.join(super::NOTES);
        std::fs::write(&path, json_text(&notes)).map_err(HistoryError::io(&path))
    }
}

/// A method or a decoder that panics on one scan must not end the thread, so the panic is caught.
fn caught<T>(work: impl FnOnce() -> Option<T>) -> Option<T> {
    std::panic::catch_unwind(std::panic::AssertUnwindSafe(work)).ok().flatten()
}

fn write_pictures(trial: &Trial, folder: &Path) -> Result<(), HistoryError> {
    for (id, signal) in &trial.signals {
        let Signal::Image(image) = signal else { continue };
        let Ok(bytes) = jpeg::encode(image) else { continue };
        let path = folder.join(super::nearest_picture(id));
        std::fs::write(&path, bytes).map_err(HistoryError::io(&path))?;
    }
    Ok(())
}
