//! The loop of a station: events, answers and orders in; notices out.

use std::collections::VecDeque;
use std::sync::Arc;

use crossbeam_channel::{Receiver, Sender, never, select};

use super::enroll::{Enrolment, EnrolmentProgress};
use super::event::{Command, Enrolled, Guess, LibraryState, Listener, StationEvent};
use super::recogniser::{Load, Recogniser};
use super::store::{RecordingThread, ScanStore};
use super::worker::{Job, Work, Worker, WorkerEvent};
use crate::device::Device;
use crate::scan::{Event, Options, Scan, ScanCommand, Session, SessionError, Totals};

/// Scans that wait to be named, where their devices cannot wait: a quarter of an hour of them.
const BACKLOG: usize = 64;

/// What a station is made of.
pub struct Station<'a> {
    devices: Vec<Box<dyn Device>>,
    options: Options,
    recogniser: Option<Arc<dyn Recogniser>>,
    load: Option<Load>,
    keep: Option<ScanStore>,
    listeners: Vec<Box<dyn Listener + 'a>>,
    orders: (Sender<Command>, Receiver<Command>),
}

impl<'a> Station<'a> {
    /// A station that knows no library yet.
    pub fn new(devices: Vec<Box<dyn Device>>, options: Options) -> Self {
        Self {
            devices,
            options,
            recogniser: None,
            load: None,
            keep: None,
            listeners: Vec::new(),
            orders: crossbeam_channel::unbounded(),
        }
    }

    /// Names scans with this, from the begin on.
    pub fn recogniser(mut self, recogniser: Arc<dyn Recogniser>) -> Self {
        self.recogniser = Some(recogniser);
        self
    }

    /// Reads the library with this: at the begin, unless there is a recogniser already, and
    /// whenever [`Command::Reload`] says so.
    pub fn load(mut self, load: Load) -> Self {
        self.load = Some(load);
        self
    }

    /// Keeps the scans that are enrolled in this library.
    pub fn keep(mut self, keep: ScanStore) -> Self {
        self.keep = Some(keep);
        self
    }

    /// Adds someone who is told all.
    pub fn listener(mut self, listener: impl Listener + 'a) -> Self {
        self.listeners.push(Box::new(listener));
        self
    }

    /// Tells of scans how they go on, as often as this, in seconds of drag.
    pub fn progress_every(mut self, seconds: f64) -> Self {
        self.options.progress_every_s = Some(seconds);
        self
    }

    /// Tells all who listen so far, before it runs.
    pub fn tell(&mut self, notice: &StationEvent) {
        self.listeners.iter_mut().for_each(|listener| listener.on_event(notice));
    }

    /// Where orders go, before it runs and while it does.
    pub fn orders(&self) -> Sender<Command> {
        self.orders.0.clone()
    }

    /// Runs until all devices have ended, or [`Command::Quit`].
    ///
    /// # Errors
    /// If two streams have one name, an option is impossible, or there is no thread to be had. A
    /// device that fails is no error here: [`Totals`] names it.
    pub fn run(self) -> Result<Totals, SessionError> {
        let thread = |name: &str| {
            let name = name.to_string();
            move |error| SessionError::Thread { name, error }
        };
        let waits = self.devices.iter().all(|device| device.waits());
        let worker = Worker::start(waits).map_err(thread("recognition"))?;
        let keeper = match self.keep {
            Some(keep) => Some(RecordingThread::start(keep).map_err(thread("recording"))?),
            None => None,
        };
        let session = Session::start(self.devices, self.options)?;
        let mut run = Run {
            session,
            worker,
            keeper,
            waits,
            naming: Naming::None("no library was given".into()),
            load: self.load,
            loading: None,
            pending: VecDeque::new(),
            enrolling: None,
            listeners: self.listeners,
        };
        run.tell(StationEvent::Streams(run.session.meters().to_vec()));
        match self.recogniser {
            Some(recogniser) => run.loaded(Ok(recogniser)),
            None if run.load.is_some() => run.reload(),
            None => {}
        }
        // The sender beside it keeps the channel open, whoever else has gone.
        run.until_finished(&self.orders.1);
        run.finish()
    }
}

/// What scans are named with.
enum Naming {
    /// The library is being read; scans wait.
    Loading,
    Ready(Arc<dyn Recogniser>),
    /// They cannot be named: why.
    None(String),
}

type Loaded = Result<Arc<dyn Recogniser>, String>;

/// A station at work.
struct Run<'a> {
    session: Session,
    worker: Worker,
    keeper: Option<RecordingThread>,
    /// Whether all devices can wait.
    waits: bool,
    naming: Naming,
    load: Option<Load>,
    loading: Option<Receiver<Loaded>>,
    /// What the worker has had no time for yet.
    pending: VecDeque<Job>,
    enrolling: Option<EnrolmentProgress>,
    listeners: Vec<Box<dyn Listener + 'a>>,
}

impl Run<'_> {
    fn tell(&mut self, notice: StationEvent) {
        self.listeners.iter_mut().for_each(|listener| listener.on_event(&notice));
    }

    fn warn(&mut self, text: impl Into<String>) {
        self.tell(StationEvent::Warning(text.into()));
    }

    /// Serves until the session has ended and its scans are on their way.
    fn until_finished(&mut self, orders: &Receiver<Command>) {
        let mut finished = false;
        loop {
            self.hand_on();
            if finished && self.pending.is_empty() {
                return;
            }
            // A recording waits until its scans are named; nothing else may be kept waiting.
            let reads = !finished && (!self.waits || self.pending.is_empty());
            let events = if reads { self.session.events().clone() } else { never() };
            let told = self.worker.told.clone();
            let kept = self.keeper.as_ref().map_or_else(never, |keeper| keeper.kept.clone());
            let loaded = self.loading.clone().unwrap_or_else(never);
            select! {
                recv(events) -> event => match event {
                    // Without a word, the collector has panicked: its end will be told below.
                    Ok(Event::Finished(_)) | Err(_) => finished = true,
                    Ok(event) => self.event(event),
                },
                recv(told) -> told => if let Ok(told) = told { self.tell(notice(told)) },
                recv(kept) -> kept => if let Ok(kept) = kept { self.kept(kept) },
                recv(loaded) -> loaded => {
                    self.loading = None;
                    let gone = |_| Err("the thread that reads the library panicked".to_string());
                    self.loaded(loaded.unwrap_or_else(gone));
                }
                recv(orders) -> order => if let Ok(order) = order { self.order(order) },
            }
        }
    }

    /// Waits for what is under way, and tells the end.
    fn finish(self) -> Result<Totals, SessionError> {
        let Self { session, worker, keeper, mut listeners, mut enrolling, .. } = self;
        let mut tell =
            |notice: StationEvent| listeners.iter_mut().for_each(|one| one.on_event(&notice));
        worker.finish().for_each(|told| tell(notice(told)));
        for kept in keeper.into_iter().flat_map(RecordingThread::finish) {
            tell(StationEvent::Enrolled(EnrolmentProgress::count(&mut enrolling, kept)));
        }
        let totals = session.wait()?;
        tell(StationEvent::Finished(Arc::new(totals.clone())));
        Ok(totals)
    }

    fn event(&mut self, event: Event) {
        match event {
            Event::Scan(scan) => self.scan(scan),
            Event::Phase { scan, phase } => self.tell(StationEvent::Phase { scan, phase }),
            Event::Progress(progress) => self.pending.push_back(Job::Progress(progress)),
            Event::Trace(trace) => self.tell(StationEvent::Trace(Arc::new(trace))),
            Event::Device { device, state, detail } => {
                self.tell(StationEvent::Device { device, state, detail });
            }
            Event::Warning(text) => self.warn(text),
            // The loop sees to it.
            Event::Finished(_) => {}
        }
    }

    fn scan(&mut self, scan: Box<Scan>) {
        if let (Some(enrolling), Some(keeper)) = (&mut self.enrolling, &self.keeper)
            && let Some(wish) = enrolling.wish()
        {
            return keeper.keep(scan, wish);
        }
        self.pending.push_back(Job::Scan(scan));
        let waiting = self.pending.iter().filter(|job| matches!(job, Job::Scan(_))).count();
        if waiting <= BACKLOG || self.waits {
            return;
        }
        // The oldest scan goes, and all that was to be said before its end.
        while let Some(job) = self.pending.pop_front() {
            if let Job::Scan(scan) = job {
                self.warn(format!("scan {} was not named: too many wait for it", scan.number));
                return;
            }
        }
    }

    /// Hands on to the worker, as far as it takes it.
    fn hand_on(&mut self) {
        while let Some(job) = self.pending.pop_front() {
            match (&self.naming, job) {
                (Naming::Loading, job) => return self.pending.push_front(job),
                (Naming::None(why), Job::Scan(scan)) => {
                    let text = format!("scan {} was not named: {why}", scan.number);
                    self.warn(text);
                }
                (Naming::None(_), Job::Progress(progress)) => {
                    self.tell(StationEvent::Guess(Guess::nothing(
                        progress.number,
                        progress.scan_s,
                    )));
                }
                (Naming::Ready(by), job) => {
                    let work = Work { job, by: by.clone() };
                    if let Err(back) = self.worker.work.try_send(work) {
                        return self.pending.push_front(back.into_inner().job);
                    }
                }
            }
        }
    }

    fn kept(&mut self, kept: Enrolled) {
        let enrolled = EnrolmentProgress::count(&mut self.enrolling, kept);
        self.tell(StationEvent::Enrolled(enrolled));
    }

    fn loaded(&mut self, loaded: Loaded) {
        match loaded {
            Ok(recogniser) => {
                self.tell(StationEvent::Library(recogniser.library()));
                self.naming = Naming::Ready(recogniser);
            }
            Err(problem) => {
                // A library that was read before still serves.
                let mut state = match &self.naming {
                    Naming::Ready(recogniser) => recogniser.library(),
                    _ => {
                        self.naming = Naming::None(problem.clone());
                        LibraryState::default()
                    }
                };
                state.problem = Some(problem.clone());
                self.tell(StationEvent::Library(state));
                self.warn(problem);
            }
        }
    }

    fn reload(&mut self) {
        let Some(load) = self.load.clone() else {
            return self.warn("there is no library that could be read anew");
        };
        if !matches!(self.naming, Naming::Ready(_)) {
            self.naming = Naming::Loading;
        }
        self.tell(StationEvent::Reading);
        let (tell, loaded) = crossbeam_channel::bounded(1);
        let work = move || {
            let _ = tell.send(load());
        };
        // One that still reads is left to end by itself: the library has changed since.
        match std::thread::Builder::new().name("load-library".into()).spawn(work) {
            Ok(_) => self.loading = Some(loaded),
            Err(error) => self.loaded(Err(format!("no thread to read the library: {error}"))),
        }
    }

    fn enroll(&mut self, enrolling: EnrolmentProgress) {
        match &self.keeper {
            Some(_) => self.enrolling = Some(enrolling),
            None => self.warn("there is no library to keep scans in; name one with --library"),
        }
    }

    fn order(&mut self, order: Command) {
        match order {
            Command::Start => self.session.command(ScanCommand::Begin),
            Command::Stop => self.session.command(ScanCommand::End),
            Command::Enroll { surface, user, trials } => {
                self.enroll(EnrolmentProgress::new(
                    Enrolment { surface, user, good_only: true },
                    trials,
                ));
            }
            Command::Record { surface, user } => {
                self.enroll(EnrolmentProgress::new(
                    Enrolment { surface, user, good_only: false },
                    u32::MAX,
                ));
            }
            Command::EndEnroll => self.enrolling = None,
            Command::Ping => self.tell(StationEvent::Alive),
            Command::Reload => self.reload(),
            Command::Quit => self.session.request_stop(),
        }
    }
}

fn notice(told: WorkerEvent) -> StationEvent {
    match told {
        WorkerEvent::Named(Ok(answer)) => StationEvent::Answer(answer),
        WorkerEvent::Named(Err(problem)) => StationEvent::Warning(problem),
        WorkerEvent::Guess(guess) => StationEvent::Guess(guess),
    }
}
