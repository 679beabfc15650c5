//! Writes a station's scans into a history, on separate threads, so that the station never waits.

use std::collections::{BTreeMap, BTreeSet};
use std::convert::Infallible;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, UNIX_EPOCH};

use crossbeam_channel::{Receiver, Sender, bounded};
use serde::Serialize;

use super::view::{TrialView, jpeg};
use super::{History, HistoryError, SCANS};
use crate::library::About;
use crate::record::{TrialOptions, utc, write_trial};
use crate::scene::Scene;
use crate::station::{AnsweredScan, End, Listener, StationEvent, Why};
use crate::trial::{Signal, Trial, TrialKey};

/// Most scans that wait to be written, and for their notes: some 50 MB for scans of ten seconds.
const QUEUE: usize = 16;

/// Keeps the scans of a station.
#[derive(Debug)]
pub struct Keeper {
    scans: Option<Sender<Arc<AnsweredScan>>>,
    history: Arc<History>,
    without_notes: WithoutNotes,
    end: End,
}

/// Ids of scans whose signals are written, but whose notes are not yet. The thread that removes an
/// id reports that scan as kept.
type WithoutNotes = Arc<Mutex<BTreeSet<String>>>;

/// Notes beside the signals of a scan.
#[derive(Serialize)]
struct Notes<'a> {
    why: Option<&'a Why>,
    scan: TrialView,
    nearest: Option<NearestView>,
}

/// The library's trial that is most similar to the scan.
#[derive(Serialize)]
struct NearestView {
    trial: TrialKey,
    #[serde(flatten)]
    view: TrialView,
}

/// A scan, and the folder of its signals.
type Written = (Arc<AnsweredScan>, PathBuf);

struct HistoryWriter {
    history: Arc<History>,
    scene: Scene,
    devices: BTreeMap<String, String>,
    /// To the thread that writes notes, which may take as long as naming a scan.
    notes: Sender<Written>,
    without_notes: WithoutNotes,
}

struct Annotator {
    history: Arc<History>,
    scene: Scene,
    without_notes: WithoutNotes,
    /// Dropped with the annotator: so [`End`] notices that its thread has ended.
    _working: Sender<Infallible>,
}

impl Keeper {
    /// Keeps scans of a scene's sources in a history on disk; `devices` says which device each
    /// source comes from.
    ///
    /// # Errors
    /// If the system gives no thread.
    pub fn start(
        history: Arc<History>,
        scene: Scene,
        devices: BTreeMap<String, String>,
    ) -> std::io::Result<Self> {
        let ((scans, to_keep), (notes, to_note)) = (bounded(QUEUE), bounded(QUEUE));
        let (working, ended) = bounded(0);
        let without_notes = WithoutNotes::default();
        let annotator = Annotator {
            history: history.clone(),
            scene: scene.clone(),
            without_notes: without_notes.clone(),
            _working: working,
        };
        let writer = HistoryWriter {
            history: history.clone(),
            scene,
            devices,
            notes,
            without_notes: without_notes.clone(),
        };
        let thread = |name: &str| std::thread::Builder::new().name(name.into());
        thread("history").spawn(move || writer.run(&to_keep))?;
        // Ends after the writer, which holds the sender of `to_note`.
        thread("history-notes").spawn(move || annotator.run(&to_note))?;
        Ok(Self { scans: Some(scans), history, without_notes, end: End::of(ended) })
    }
}

impl Listener for Keeper {
    fn on_event(&mut self, event: &StationEvent) {
        if self.end.is_here(event) {
            self.scans = None;
        }
        if let (StationEvent::Scan(scan), Some(scans)) = (event, &self.scans)
            && scans.try_send(scan.clone()).is_err()
        {
            tracing::warn!("scan {} is not in the history: the disk is too slow", scan.answer.scan);
        }
    }
}

impl Drop for Keeper {
    /// Waits until all scans and notes are written, or until the station must end; then
    /// reports scans without notes as kept.
    fn drop(&mut self) {
        self.scans = None;
        if !self.end.wait(Duration::MAX) {
            for id in std::mem::take(&mut *lock(&self.without_notes)) {
                kept(&self.history, &id);
            }
        }
    }
}

fn lock(without_notes: &WithoutNotes) -> MutexGuard<'_, BTreeSet<String>> {
    // Each change is one insertion or removal, so a panic leaves a usable set.
    without_notes.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Notes in the history that the signals of a scan are on disk.
fn kept(history: &History, id: &str) {
    say_problem(history, history.kept(id));
}

/// Notes in the history whether scans can be kept, and warns of the first problem in a row.
fn say_problem(history: &History, done: Result<(), HistoryError>) {
    let problem = done.err().map(|error| error.to_string());
    if history.set_problem(problem.clone())
        && let Some(problem) = problem
    {
        tracing::warn!("scans are not kept in the history: {problem}");
    }
}

impl HistoryWriter {
    fn run(&self, scans: &Receiver<Arc<AnsweredScan>>) {
        for scan in scans {
            let written = self.history.answered(&scan.answer).and_then(|()| self.write(&scan));
            match written {
                Ok(Some(folder)) => self.hand_on(scan, folder),
                Ok(None) => say_problem(&self.history, Ok(())),
                Err(error) => say_problem(&self.history, Err(error)),
            }
        }
    }

    /// Passes a scan on to have its notes written, unless too many scans wait for theirs.
    fn hand_on(&self, scan: Arc<AnsweredScan>, folder: PathBuf) {
        let id = scan.answer.id.clone();
        lock(&self.without_notes).insert(id.clone());
        let full = self.notes.try_send((scan, folder)).is_err();
        if full && lock(&self.without_notes).remove(&id) {
            kept(&self.history, &id);
        }
    }

    /// Writes the signals of a scan; gives their folder, unless the history is in memory.
    fn write(&self, answered: &AnsweredScan) -> Result<Option<PathBuf>, HistoryError> {
        let AnsweredScan { scan, answer, .. } = answered;
        // A scan that could not be named may be empty.
        let root = self.history.root().filter(|_| !scan.trial.signals.is_empty());
        let Some(root) = root else { return Ok(None) };
        let began = Duration::from_millis(answer.unix_ms)
            .saturating_sub(Duration::from_secs_f64(scan.scan_s.max(0.0)));
        let about = About {
            started_at: Some(utc(UNIX_EPOCH + began)).filter(|_| began > Duration::ZERO),
            notes: (!scan.spoiled.is_empty()).then(|| scan.spoiled.join("\n")),
            synthetic: scan.synthetic,
            devices: self.devices.clone(),
            ..About::default()
        };
        // Without waiting for the disk: scans that a power cut may lose are not worth the time.
        let options = TrialOptions { about, durable: false };
        let user = answer.id.rsplit_once('-').map_or(answer.id.as_str(), |(moment, _)| moment);
        let key = TrialKey::new(SCANS, user, answer.scan);
        let trial = Trial { key, signals: scan.trial.signals.clone() };
        Ok(Some(write_trial(&root, &trial, &self.scene, &options)?))
    }
}

impl Annotator {
    fn run(&self, written: &Receiver<Written>) {
        for (scan, folder) in written {
            let noted = self.note(&scan, &folder);
            let id = &scan.answer.id;
            if lock(&self.without_notes).remove(id) {
                let kept = self.history.kept(id);
                say_problem(&self.history, noted.and(kept));
            }
        }
    }

    /// Writes the reasons for a scan's name, and the outlines of the scan and the nearest trial.
    fn note(&self, answered: &AnsweredScan, folder: &Path) -> Result<(), HistoryError> {
        let AnsweredScan { scan, by, .. } = answered;
        // A method that panics on one scan must not end the history.
        let explain = std::panic::AssertUnwindSafe(|| by.as_ref()?.explain(scan).ok());
        let why = std::panic::catch_unwind(explain).ok().flatten();
        let nearest = why.as_ref().and_then(|why| by.as_ref()?.trial(&why.nearest)?.load().ok());
        if let Some(nearest) = &nearest {
            write_pictures(nearest, folder)?;
        }
        let nearest = nearest.map(|nearest| NearestView {
            view: TrialView::of(&nearest, &self.scene),
            trial: nearest.key,
        });
        let scan = TrialView::of(&scan.trial, &self.scene);
        let notes = Notes { why: why.as_ref(), scan, nearest };
        // Plain structs, numbers and text: nothing here that JSON cannot express.
        let text = serde_json::to_string(&notes).unwrap_or_default();
        let path = folder.join(super::NOTES);
        std::fs::write(&path, text).map_err(HistoryError::io(&path))
    }
}

fn write_pictures(trial: &Trial, folder: &Path) -> Result<(), HistoryError> {
    for (id, signal) in &trial.signals {
        let Signal::Image(image) = signal else { continue };
        let Some(bytes) = jpeg(image) else { continue };
        let path = folder.join(super::nearest_picture(id));
        std::fs::write(&path, bytes).map_err(HistoryError::io(&path))?;
    }
    Ok(())
}
