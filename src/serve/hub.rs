//! The work of the server's thread: receives the station's events, and publishes them.
//!
//! Nearly everything runs on one thread, so the lock on the shared state is rarely contended. The lock
//! exists because handlers of requests must be `Send`.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use crossbeam_channel::{Sender, TrySendError};
use serde::Serialize;
use serde_json::json;
use tokio::sync::{mpsc, watch};

use super::guard::Traffic;
use super::request::{Problem, Reply};
use super::settings::Settings;
use super::state::{State, unix_ms};
use super::subscribers::{EventFilter, EventKind, EventStream, Subscribers, encode};
use super::trace::{self, Tracer};
use crate::device::camera::{CameraView, Viewfinder};
use crate::device::{Warning, WarningKind};
use crate::evaluate::CheckReport;
use crate::history::news;
use crate::outputs::{OutputHealth, OutputView, every, lock};
use crate::ring::Counts;
use crate::scan::StreamMeter;
use crate::scene::SourceId;
use crate::station::{Command, StationEvent};
use crate::trial::{Doubt, Image};

const STREAMS_EVERY: Duration = Duration::from_millis(500);
const SPECTRA_EVERY: Duration = Duration::from_millis(200);
/// Interval at which an empty comment is sent on every connection. It is the heartbeat of subscribers that
/// do not get `streams`, so it reveals a dead connection within seconds.
const KEEP_ALIVE_EVERY: Duration = Duration::from_secs(1);

const SCAN_BOUNDS_S: [f64; 8] = [0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 60.0];
const LATENCY_BOUNDS_S: [f64; 11] =
    [0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5];

#[derive(Debug, Default)]
pub(super) struct Histogram {
    pub bounds: &'static [f64],
    /// Number of values in each interval between bounds. The last number counts values above all bounds.
    pub counts: Vec<u64>,
    pub sum: f64,
}

impl Histogram {
    fn new(bounds: &'static [f64]) -> Self {
        Self { bounds, counts: vec![0; bounds.len() + 1], sum: 0.0 }
    }

    pub(super) fn observe(&mut self, value: f64) {
        let at = self.bounds.iter().position(|&bound| value <= bound);
        self.counts[at.unwrap_or(self.bounds.len())] += 1;
        self.sum += value;
    }
}

/// The hub, as axum passes it to the handlers of requests.
pub(super) type Shared = axum::extract::State<Arc<Hub>>;

pub(crate) struct Hub {
    inner: Mutex<HubState>,
    orders: Sender<Command>,
    missed: Arc<AtomicU64>,
    pub traffic: Arc<Traffic>,
    pub settings: Arc<Settings>,
}

#[derive(Default)]
pub(crate) struct HubState {
    pub state: State,
    pub(super) scan_s: Histogram,
    pub(super) latency_s: Histogram,
    pub(super) subscribers: Subscribers,
    tracer: Tracer,
    pub pictures: BTreeMap<SourceId, Arc<Image>>,
    pub(super) meters: Vec<StreamMeter>,
    settings: Arc<Settings>,
    published_camera: Option<CameraView>,
    published_outputs: Vec<OutputView>,
    drift: Vec<Doubt>,
    pub check: CheckView,
}

impl HubState {
    pub(super) fn new(settings: Arc<Settings>) -> Self {
        Self {
            state: State::new(),
            scan_s: Histogram::new(&SCAN_BOUNDS_S),
            latency_s: Histogram::new(&LATENCY_BOUNDS_S),
            settings,
            check: CheckView { state: "none", ..CheckView::default() },
            ..Self::default()
        }
    }

    pub(crate) fn whole(&self) -> StateDocument<'_> {
        StateDocument {
            state: &self.state,
            enrolls: self.settings.enrolls,
            stale_after_s: self.settings.stale_after_s,
            now_unix_ms: unix_ms(),
            camera: self.camera(),
            streams: self.streams(),
            outputs: self.outputs(),
            drift: &self.drift,
        }
    }

    fn streams(&self) -> Vec<StreamView> {
        let view = |meter: &StreamMeter| StreamView {
            source: meter.id.clone(),
            device: meter.device.clone(),
            counts: meter.counts(),
        };
        self.meters.iter().map(view).collect()
    }

    fn camera(&self) -> Option<CameraView> {
        self.settings.viewfinder.as_ref().map(Viewfinder::view)
    }

    fn outputs(&self) -> Vec<OutputView> {
        self.settings.outputs.iter().map(OutputHealth::view).collect()
    }

    pub(crate) fn publish(&mut self, kind: EventKind, data: &impl Serialize) {
        if self.subscribers.wanted(kind) {
            let mut subscribers = std::mem::take(&mut self.subscribers);
            let whole = || encode(EventKind::State, &self.whole());
            subscribers.publish(kind, &encode(kind, data), &whole);
            self.subscribers = subscribers;
        }
    }

    fn publish_streams(&mut self) {
        let streams = self.streams();
        self.publish(EventKind::Streams, &json!({ "streams": streams }));
    }

    fn publish_warning(&mut self) {
        self.publish(EventKind::Warning, &self.state.warnings.front().cloned());
    }

    fn publish_camera(&mut self) {
        let view = self.camera();
        if view != self.published_camera {
            self.published_camera.clone_from(&view);
            self.publish(EventKind::Camera, &view);
        }
    }

    fn publish_outputs(&mut self) {
        let views = self.outputs();
        if views != self.published_outputs {
            self.publish(EventKind::Outputs, &views);
            self.published_outputs = views;
        }
    }

    /// Publishes the doubts that follow from reference scans, with a warning of each new one.
    fn publish_drift(&mut self, doubts: &[Doubt]) {
        let before = std::mem::replace(&mut self.drift, doubts.to_vec());
        for doubt in news(&before, doubts) {
            let warning = Warning::new(WarningKind::Drift, format!("drift: {doubt}"));
            self.state.take(&StationEvent::Warning(warning));
            self.publish_warning();
        }
        if news(&before, doubts).chain(news(doubts, &before)).next().is_some() {
            self.publish(EventKind::Drift, &doubts);
        }
    }

    fn take(&mut self, notice: &StationEvent) {
        let (advice, enrolling) = (self.state.advice.clone(), self.state.enrolling.clone());
        self.state.take(notice);
        match notice {
            StationEvent::Streams(meters) => {
                self.meters.clone_from(meters);
                self.publish_streams();
            }
            StationEvent::Device { device, .. } => {
                let mut devices = self.state.devices.iter();
                let view = devices.find(|view| view.device == *device).cloned();
                self.publish(EventKind::Device, &view);
            }
            StationEvent::Trace(trace) => {
                let event = self.tracer.add(trace);
                self.pictures.extend(trace.images.iter().cloned());
                if !(event.streams.is_empty() && event.pictures.is_empty()) {
                    self.publish(EventKind::Trace, &event);
                }
            }
            StationEvent::Phase { scan, phase } => {
                self.publish(EventKind::Phase, &json!({ "scan": scan, "phase": phase }));
            }
            // A guess that arrives after its scan has ended is not published.
            StationEvent::Guess(guess) if self.state.guess.as_ref() == Some(guess) => {
                self.publish(EventKind::Guess, guess);
            }
            StationEvent::Change(change) => self.publish(EventKind::Change, change),
            StationEvent::Answer(answer) => {
                self.scan_s.observe(answer.scan_s);
                self.latency_s.observe(answer.latency_ms / 1e3);
                self.publish(EventKind::Answer, answer);
            }
            StationEvent::Enrolled(enrolled) => self.publish(EventKind::Enrolled, enrolled),
            // The change of these events is published below, if there is one.
            StationEvent::Enrolling(_)
            | StationEvent::Guess(_)
            | StationEvent::Ending(_)
            | StationEvent::Alive
            | StationEvent::Scan(_) => {}
            StationEvent::Reading => self.publish(EventKind::Reading, &true),
            StationEvent::Library(library) => self.publish(EventKind::Library, library),
            StationEvent::Unnamed(answer) => {
                self.publish(EventKind::Unnamed, answer);
                self.publish_warning();
            }
            StationEvent::Warning(_) => self.publish_warning(),
            StationEvent::Finished(_) => {
                let counts = self.state.counts;
                self.publish(EventKind::Finished, &counts);
            }
        }
        if self.state.enrolling != enrolling {
            self.publish(EventKind::Enrolling, &self.state.enrolling.clone());
        }
        if self.state.advice != advice {
            self.publish(EventKind::Advice, &self.state.advice.clone());
        }
    }
}

impl Hub {
    /// Creates a hub. `missed` counts the events for which the reporter's queue had no room.
    pub(crate) fn new(
        settings: &Settings,
        orders: Sender<Command>,
        missed: Arc<AtomicU64>,
    ) -> Self {
        let settings = Arc::new(settings.clone());
        let inner = Mutex::new(HubState::new(settings.clone()));
        Self { inner, orders, missed, traffic: Arc::default(), settings }
    }

    pub(crate) fn lock(&self) -> MutexGuard<'_, HubState> {
        lock(&self.inner)
    }

    pub(crate) fn metrics(&self) -> String {
        let history = &self.settings.history;
        let (precision, drift) = (history.precision(), history.drift());
        let (inner, missed) = (&*self.lock(), self.missed.load(Ordering::Relaxed));
        inner.metrics(&inner.outputs(), (&precision, &drift), &self.traffic, missed)
    }

    /// Handles an event. When all trials of an enrolment are kept, the library is read again.
    fn take(&self, notice: &StationEvent) {
        let history = &self.settings.history;
        if let StationEvent::Answer(answer) | StationEvent::Unnamed(answer) = notice
            && history.root().is_none()
        {
            // Without a disk, adding an answer cannot fail.
            let _ = history.answered(answer);
        }
        if let StationEvent::Library(library) = notice {
            history.refer(&library.reference);
        }
        let inner = &mut *self.lock();
        inner.take(notice);
        if let StationEvent::Enrolled(enrolled) = notice
            && enrolled.wanted == Some(0)
            && inner.state.library.is_some()
        {
            // If the station is too busy to take this command, the operator can reload later.
            let _ = self.orders.try_send(Command::Reload);
        }
    }

    pub(crate) fn subscribe(&self, filter: EventFilter) -> Option<EventStream> {
        let inner = &mut *self.lock();
        if inner.subscribers.count() >= self.settings.limits.readers {
            return None;
        }
        let first = encode(EventKind::State, &inner.whole());
        Some(inner.subscribers.subscribe(filter, first))
    }

    /// Sends a command without waiting for the station.
    pub(crate) fn order(&self, order: Command) -> Reply<()> {
        let enrolls =
            matches!(order, Command::Enroll { .. } | Command::KeepRefused(_) | Command::EndEnroll);
        let inner = self.lock();
        if inner.state.finished {
            return Err(Problem::Ended);
        }
        let reloads = matches!(order, Command::Reload);
        if enrolls && !self.settings.enrolls || reloads && !self.settings.reloads {
            return Err(Problem::NoLibrary);
        }
        self.orders.try_send(order).map_err(|error| match error {
            TrySendError::Full(_) => Problem::Busy,
            TrySendError::Disconnected(_) => Problem::Ended,
        })
    }
}

/// Handles events and publishes at intervals, until the station and the server have ended.
pub(super) async fn run(
    hub: Arc<Hub>,
    mut notices: mpsc::Receiver<StationEvent>,
    mut stop: watch::Receiver<bool>,
) {
    let mut streams = every(STREAMS_EVERY);
    let mut spectra = every(SPECTRA_EVERY);
    let mut keep_alive = every(KEEP_ALIVE_EVERY);
    let mut listening = true;
    loop {
        tokio::select! {
            notice = notices.recv(), if listening => match notice {
                Some(notice) => hub.take(&notice),
                None => listening = false,
            },
            _ = streams.tick() => {
                let drift = hub.settings.history.drift();
                let inner = &mut *hub.lock();
                inner.publish_streams();
                inner.publish_outputs();
                inner.publish_drift(&drift.doubts);
            }
            _ = spectra.tick() => {
                let inner = &mut *hub.lock();
                inner.publish_camera();
                if inner.subscribers.wanted(EventKind::Spectrum) {
                    let streams = trace::spectra(&inner.tracer);
                    inner.publish(EventKind::Spectrum, &json!({ "streams": streams }));
                }
            }
            _ = keep_alive.tick() => hub.lock().subscribers.keep_alive(),
            _ = stop.wait_for(|stop| *stop) => break,
        }
    }
    while let Ok(notice) = notices.try_recv() {
        hub.take(&notice);
    }
    hub.lock().subscribers.close();
}

#[derive(Serialize)]
pub(crate) struct StateDocument<'a> {
    #[serde(flatten)]
    state: &'a State,
    enrolls: bool,
    stale_after_s: f64,
    /// The time of this clock, by which a page corrects its own.
    now_unix_ms: u64,
    camera: Option<CameraView>,
    streams: Vec<StreamView>,
    outputs: Vec<OutputView>,
    drift: &'a [Doubt],
}

#[derive(Debug, Serialize)]
struct StreamView {
    source: SourceId,
    device: String,
    #[serde(flatten)]
    counts: Counts,
}

#[derive(Clone, Debug, Default, Serialize)]
pub(crate) struct CheckView {
    /// `none`, `running`, `done` or `failed`.
    pub state: &'static str,
    /// When this state began, in milliseconds since 1970.
    pub unix_ms: u64,
    pub problem: Option<String>,
    pub report: Option<Arc<CheckReport>>,
}
