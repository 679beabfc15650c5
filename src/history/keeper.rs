//! Writes a station's scans into a history, on a thread of its own: the station never waits.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, UNIX_EPOCH};

use crossbeam_channel::{Receiver, Sender};
use serde::Serialize;

use super::view::{View, jpeg};
use super::{History, HistoryError, SCANS};
use crate::library::About;
use crate::record::{TrialOptions, utc, write_trial};
use crate::scene::Scene;
use crate::station::{AnsweredScan, Listener, StationEvent, Why};
use crate::trial::{Signal, Trial, TrialKey};

/// Scans under way; of ten seconds each, some 50 MB.
const QUEUE: usize = 16;

/// Keeps the scans of a station.
#[derive(Debug)]
pub struct Keeper {
    scans: Option<Sender<Arc<AnsweredScan>>>,
    thread: Option<JoinHandle<()>>,
}

/// What is noted beside the signals of a scan.
#[derive(Serialize)]
struct Notes<'a> {
    why: Option<&'a Why>,
    scan: View,
    nearest: Option<NearestView>,
}

/// The nearest trial of the library, as it was then.
#[derive(Serialize)]
struct NearestView {
    trial: TrialKey,
    #[serde(flatten)]
    view: View,
}

struct Writer {
    history: Arc<History>,
    scene: Scene,
    devices: BTreeMap<String, String>,
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
        let (scans, to_keep) = crossbeam_channel::bounded(QUEUE);
        let writer = Writer { history, scene, devices };
        let run = move || writer.run(&to_keep);
        let thread = std::thread::Builder::new().name("history".into()).spawn(run)?;
        Ok(Self { scans: Some(scans), thread: Some(thread) })
    }
}

impl Listener for Keeper {
    fn on_event(&mut self, event: &StationEvent) {
        if let (StationEvent::Scan(scan), Some(scans)) = (event, &self.scans)
            && scans.try_send(scan.clone()).is_err()
        {
            tracing::warn!("scan {} is not in the history: the disk is too slow", scan.answer.scan);
        }
    }
}

impl Drop for Keeper {
    /// Waits until all scans are written.
    fn drop(&mut self) {
        self.scans.take();
        if let Some(thread) = self.thread.take() {
            // Had it panicked, the scans before are kept all the same.
            let _ = thread.join();
        }
    }
}

impl Writer {
    fn run(&self, scans: &Receiver<Arc<AnsweredScan>>) {
        for scan in scans {
            let kept = self.history.answered(&scan.answer).and_then(|()| self.keep(&scan));
            let problem = kept.err().map(|error| error.to_string());
            if self.history.set_problem(problem.clone())
                && let Some(problem) = problem
            {
                tracing::warn!("scans are not kept in the history: {problem}");
            }
        }
    }

    fn keep(&self, answered: &AnsweredScan) -> Result<(), HistoryError> {
        let AnsweredScan { scan, answer, .. } = answered;
        // One that could not be named may be empty.
        let root = self.history.root().filter(|_| !scan.trial.signals.is_empty());
        let Some(root) = root else { return Ok(()) };
        let began = Duration::from_millis(answer.unix_ms)
            .saturating_sub(Duration::from_secs_f64(scan.scan_s.max(0.0)));
        let about = About {
            started_at: Some(utc(UNIX_EPOCH + began)).filter(|_| began > Duration::ZERO),
            notes: (!scan.spoiled.is_empty()).then(|| scan.spoiled.join("\n")),
            synthetic: scan.synthetic,
            devices: self.devices.clone(),
            ..About::default()
        };
        // A day of scans is worth no waiting for the disk at each.
        let options = TrialOptions { about, durable: false };
        let user = answer.id.rsplit_once('-').map_or(answer.id.as_str(), |(moment, _)| moment);
        let key = TrialKey::new(SCANS, user, answer.scan);
        let trial = Trial { key, signals: scan.trial.signals.clone() };
        let folder = write_trial(&root, &trial, &self.scene, &options)?;
        self.note(answered, &folder)?;
        self.history.kept(&answer.id)
    }

    /// Writes why the scan was named as it was, and what is drawn of it and the nearest trial.
    fn note(&self, answered: &AnsweredScan, folder: &Path) -> Result<(), HistoryError> {
        let AnsweredScan { scan, by, .. } = answered;
        // One scan must not take the history with it.
        let explain = std::panic::AssertUnwindSafe(|| by.as_ref()?.explain(scan).ok());
        let why = std::panic::catch_unwind(explain).ok().flatten();
        let nearest = why.as_ref().and_then(|why| by.as_ref()?.trial(&why.nearest)?.load().ok());
        if let Some(nearest) = &nearest {
            write_pictures(nearest, folder)?;
        }
        let nearest = nearest.map(|nearest| NearestView {
            view: View::of(&nearest, &self.scene),
            trial: nearest.key,
        });
        let scan = View::of(&scan.trial, &self.scene);
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
