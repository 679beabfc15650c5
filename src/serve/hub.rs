//! The work of the server's thread: takes in the station's events, and publishes them.
//!
//! Nearly all of it runs on one thread, so threads rarely wait for the lock on the shared state; it is
//! there because handlers of requests must be `Send`.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use crossbeam_channel::{Sender, TrySendError};
use serde::Serialize;
use tokio::sync::{mpsc, watch};
use tokio::time::{Interval, MissedTickBehavior, interval};

use super::guard::Traffic;
use super::metrics::{Elsewhere, Metrics};
use super::settings::{Audit, LibraryFolder, Settings};
use super::state::State;
use super::subscribers::{EventFilter, EventKind, EventStream, Subscribers, encode};
use super::trace::{self, Tracer};
use crate::device::camera::{CameraView, Viewfinder};
use crate::evaluate::CheckReport;
use crate::history::{History, Precision};
use crate::outputs::{OutputHealth, OutputView};
use crate::ring::Counts;
use crate::scan::StreamMeter;
use crate::scene::{Phase, SourceId};
use crate::station::{Command, StationEvent};
use crate::trial::Image;

/// The interval between two publications of the counts of streams.
const STREAMS_EVERY: Duration = Duration::from_millis(500);
/// The interval between two publications of spectra.
const SPECTRA_EVERY: Duration = Duration::from_millis(200);
/// The interval between two signs of life on a silent connection.
const KEEP_ALIVE_EVERY: Duration = Duration::from_secs(10);

/// State shared by the handlers of requests.
#[derive(Debug)]
pub struct Hub {
    inner: Mutex<HubState>,
    orders: Sender<Command>,
    missed: Arc<AtomicU64>,
    most_subscribers: usize,
    /// Counts of requests.
    pub traffic: Arc<Traffic>,
    /// Past scans.
    pub history: Arc<History>,
    /// The library that may be edited.
    pub library: Option<LibraryFolder>,
    /// The audit of that library.
    pub checks: Checks,
}

/// The part of the hub behind its lock.
#[derive(Debug)]
pub struct HubState {
    pub state: State,
    pub metrics: Metrics,
    subscribers: Subscribers,
    tracer: Tracer,
    /// The latest picture of each camera stream.
    pub pictures: BTreeMap<SourceId, Arc<Image>>,
    meters: Vec<StreamMeter>,
    enrolls: bool,
    /// The view of the camera.
    pub viewfinder: Option<Viewfinder>,
    /// The state of the camera that was last published.
    camera: Option<CameraView>,
    /// The outputs that answers go to.
    outputs: Vec<OutputHealth>,
    /// The state of the outputs that was last published.
    output_views: Vec<OutputView>,
}

#[derive(Serialize)]
struct PhaseEvent {
    scan: u32,
    phase: Option<Phase>,
}

impl HubState {
    /// All that is known now, as one document.
    pub fn whole(&self) -> StateDocument<'_> {
        let outputs = self.outputs.iter().map(OutputHealth::view).collect();
        StateDocument::of(&self.state, self.enrolls, &self.viewfinder, &self.meters, outputs)
    }

    /// All figures.
    pub fn metrics(
        &self,
        missed_notices: u64,
        precision: &[Precision],
        traffic: &Traffic,
    ) -> String {
        self.metrics.text(&Elsewhere {
            precision,
            traffic,
            outputs: &self.outputs.iter().map(OutputHealth::view).collect::<Vec<_>>(),
            state: &self.state,
            meters: &self.meters,
            subscribers: self.subscribers.count(),
            dropped_events: self.subscribers.dropped,
            missed_notices,
        })
    }

    fn publish(&mut self, kind: EventKind, data: &impl Serialize) {
        if self.subscribers.wanted(kind) {
            let event = encode(kind, data);
            let Self { state, meters, enrolls, viewfinder, subscribers, outputs, .. } = self;
            let views = || outputs.iter().map(OutputHealth::view).collect();
            let whole = || StateDocument::of(state, *enrolls, viewfinder, meters, views());
            subscribers.publish(kind, &event, &mut || encode(EventKind::State, &whole()));
        }
    }

    fn publish_streams(&mut self) {
        let event = StreamsEvent::of(&self.meters);
        self.publish(EventKind::Streams, &event);
    }

    fn publish_warning(&mut self) {
        let warning = self.state.warnings.front().cloned();
        self.publish(EventKind::Warning, &warning);
    }

    /// Publishes the view of the camera, if it has changed.
    fn publish_camera(&mut self) {
        let view = self.viewfinder.as_ref().map(Viewfinder::view);
        if view != self.camera {
            self.camera.clone_from(&view);
            self.publish(EventKind::Camera, &view);
        }
    }

    /// Publishes the state of the outputs, if it has changed.
    fn publish_outputs(&mut self) {
        let views: Vec<OutputView> = self.outputs.iter().map(OutputHealth::view).collect();
        if views != self.output_views {
            self.publish(EventKind::Outputs, &views);
            self.output_views = views;
        }
    }

    /// Changes the state, and publishes the parts that changed with it.
    fn change(&mut self, change: impl FnOnce(&mut Self)) {
        let (advice, enrolling) = (self.state.advice.clone(), self.state.enrolling.clone());
        change(self);
        if self.state.enrolling != enrolling {
            let enrolling = self.state.enrolling.clone();
            self.publish(EventKind::Enrolling, &enrolling);
        }
        if self.state.advice != advice {
            let advice = self.state.advice.clone();
            self.publish(EventKind::Advice, &advice);
        }
    }

    fn take(&mut self, notice: &StationEvent) {
        self.state.take(notice);
        match notice {
            StationEvent::Streams(meters) => {
                self.meters.clone_from(meters);
                self.publish_streams();
            }
            StationEvent::Device { device, .. } => {
                let view = self.state.devices.iter().find(|view| view.device == *device).cloned();
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
                self.publish(EventKind::Phase, &PhaseEvent { scan: *scan, phase: *phase });
            }
            // A guess that comes after the end of its scan is not published.
            StationEvent::Guess(guess) if self.state.guess.as_ref() == Some(guess) => {
                self.publish(EventKind::Guess, guess);
            }
            StationEvent::Guess(_) => {}
            StationEvent::Answer(answer) => {
                self.metrics.scan(answer.scan_s, answer.latency_ms / 1e3);
                let answer = self.state.answer.clone();
                self.publish(EventKind::Answer, &answer);
            }
            StationEvent::Enrolled(enrolled) => self.publish(EventKind::Enrolled, enrolled),
            // Published by `change`, as far as they change the state.
            StationEvent::Enrolling(_)
            | StationEvent::Ending(_)
            | StationEvent::Alive
            | StationEvent::Scan(_) => {}
            StationEvent::Reading => self.publish(EventKind::Reading, &true),
            StationEvent::Library(_) => {
                let library = self.state.library.clone();
                self.publish(EventKind::Library, &library);
            }
            StationEvent::Unnamed(unnamed) => {
                self.publish(EventKind::Unnamed, &unnamed.answer);
                self.publish_warning();
            }
            StationEvent::Warning(_) => self.publish_warning(),
            StationEvent::Finished(_) => {
                let counts = self.state.counts;
                self.publish(EventKind::Finished, &counts);
            }
        }
    }
}

/// Reasons why a command does not reach the station.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Undelivered {
    /// The station keeps no scans.
    NoLibrary,
    /// The station has ended.
    Ended,
    /// The station has not taken earlier commands yet.
    Busy,
}

impl Hub {
    /// A hub before the first event; the reporter counts events without room in `missed`.
    pub fn new(settings: &Settings, orders: Sender<Command>, missed: Arc<AtomicU64>) -> Self {
        let inner = HubState {
            state: State::new(),
            metrics: Metrics::default(),
            subscribers: Subscribers::default(),
            tracer: Tracer::default(),
            pictures: BTreeMap::new(),
            meters: Vec::new(),
            enrolls: settings.enrolls,
            viewfinder: settings.viewfinder.clone(),
            camera: None,
            outputs: settings.outputs.clone(),
            output_views: Vec::new(),
        };
        let (most_subscribers, history) = (settings.limits.readers, settings.history.clone());
        let library = settings.library.clone();
        let checks = Checks::new(settings.check.clone());
        Self {
            inner: Mutex::new(inner),
            orders,
            missed,
            most_subscribers,
            traffic: Arc::default(),
            history,
            library,
            checks,
        }
    }

    /// The part behind the lock.
    pub fn lock(&self) -> MutexGuard<'_, HubState> {
        // Even after a panic, each of these values can be used.
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The text of all metrics.
    pub fn metrics(&self) -> String {
        let precision = self.history.precision();
        self.lock().metrics(self.missed.load(Ordering::Relaxed), &precision, &self.traffic)
    }

    /// Takes in an event. Once all trials of an enrolment are kept, the library is read again.
    fn take(&self, notice: &StationEvent) {
        let answer = match notice {
            StationEvent::Answer(answer) => Some(answer),
            StationEvent::Unnamed(unnamed) => Some(&unnamed.answer),
            _ => None,
        };
        if let Some(answer) = answer.filter(|_| !self.history.is_on_disk()) {
            // In memory alone this cannot fail.
            let _ = self.history.answered(answer);
        }
        let inner = &mut *self.lock();
        inner.change(|inner| inner.take(notice));
        if let StationEvent::Enrolled(enrolled) = notice
            && enrolled.wanted == 0
            && inner.state.library.is_some()
        {
            // If the station is too busy, the operator can reload later.
            let _ = self.orders.try_send(Command::Reload);
        }
    }

    /// Publishes that an audit has begun or ended.
    pub fn checked(&self, check: &CheckView) {
        self.lock().publish(EventKind::Check, check);
    }

    /// Publishes that a scan was corrected, or became a trial.
    pub fn corrected(&self, scan: &serde_json::Value) {
        self.lock().publish(EventKind::Correction, scan);
    }

    /// Adds a subscriber, unless there are too many.
    pub fn subscribe(&self, filter: EventFilter) -> Option<EventStream> {
        let inner = &mut *self.lock();
        if inner.subscribers.count() >= self.most_subscribers {
            return None;
        }
        let first = encode(EventKind::State, &inner.whole());
        Some(inner.subscribers.subscribe(filter, first))
    }

    /// Sends a command, without waiting for the station.
    ///
    /// # Errors
    /// If the station has ended, is busy with earlier commands, or keeps no scans.
    pub fn order(&self, order: Command) -> Result<(), Undelivered> {
        let enrolls =
            matches!(order, Command::Enroll { .. } | Command::KeepRefused(_) | Command::EndEnroll);
        let inner = self.lock();
        if inner.state.finished {
            return Err(Undelivered::Ended);
        }
        if enrolls && !inner.enrolls {
            return Err(Undelivered::NoLibrary);
        }
        self.orders.try_send(order).map_err(|error| match error {
            TrySendError::Full(_) => Undelivered::Busy,
            TrySendError::Disconnected(_) => Undelivered::Ended,
        })
    }
}

/// Takes in events and publishes what is due, until the station and the server have ended.
pub async fn run(
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
                let inner = &mut *hub.lock();
                inner.publish_streams();
                inner.publish_outputs();
            }
            _ = spectra.tick() => {
                let inner = &mut *hub.lock();
                inner.publish_camera();
                if inner.subscribers.wanted(EventKind::Spectrum) {
                    let event = trace::spectra(&inner.tracer);
                    inner.publish(EventKind::Spectrum, &event);
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

fn every(period: Duration) -> Interval {
    let mut interval = interval(period);
    interval.set_missed_tick_behavior(MissedTickBehavior::Delay);
    interval
}

/// The document that holds all that is known now.
#[derive(Serialize)]
pub struct StateDocument<'a> {
    #[serde(flatten)]
    state: &'a State,
    /// Whether the station keeps scans for a library.
    enrolls: bool,
    /// The camera, if there is one.
    camera: Option<CameraView>,
    streams: Vec<StreamView>,
    /// The state of the outputs that answers go to.
    outputs: Vec<OutputView>,
}

impl<'a> StateDocument<'a> {
    /// Collects what is known now.
    pub fn of(
        state: &'a State,
        enrolls: bool,
        viewfinder: &Option<Viewfinder>,
        meters: &[StreamMeter],
        outputs: Vec<OutputView>,
    ) -> Self {
        let camera = viewfinder.as_ref().map(Viewfinder::view);
        Self { state, enrolls, camera, streams: views(meters), outputs }
    }
}

/// The counts of one stream.
#[derive(Debug, Serialize)]
struct StreamView {
    source: SourceId,
    device: String,
    #[serde(flatten)]
    counts: Counts,
}

/// The counts of all streams.
#[derive(Serialize)]
pub struct StreamsEvent {
    streams: Vec<StreamView>,
}

impl StreamsEvent {
    /// Reads the meters now.
    pub fn of(meters: &[StreamMeter]) -> Self {
        Self { streams: views(meters) }
    }
}

fn views(meters: &[StreamMeter]) -> Vec<StreamView> {
    let view = |meter: &StreamMeter| StreamView {
        source: meter.id.clone(),
        device: meter.device.clone(),
        counts: meter.counts(),
    };
    meters.iter().map(view).collect()
}

/// The state of the audit.
#[derive(Clone, Debug, Serialize)]
pub struct CheckView {
    /// `none`, `running`, `done` or `failed`.
    pub state: &'static str,
    /// When this state began, in milliseconds since 1970.
    pub unix_ms: u64,
    /// The reason why it failed.
    pub problem: Option<String>,
    /// The last report.
    pub report: Option<Arc<CheckReport>>,
}

/// Audits of the library, one at a time.
#[derive(Debug)]
pub struct Checks {
    /// Runs an audit.
    pub audit: Option<Audit>,
    view: Mutex<CheckView>,
}

impl Checks {
    /// The state before the first audit.
    pub fn new(audit: Option<Audit>) -> Self {
        let view = CheckView { state: "none", unix_ms: 0, problem: None, report: None };
        Self { audit, view: Mutex::new(view) }
    }

    /// The state of the last audit.
    pub fn lock(&self) -> MutexGuard<'_, CheckView> {
        // Each change is one assignment.
        self.view.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
