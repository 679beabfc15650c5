//! The loop of a station: events, answers and orders in; notices out.

use std::collections::VecDeque;
use std::sync::Arc;

use crossbeam_channel::{Receiver, Sender, never, select};

use super::enroll::{Enrolling, Wish};
use super::keep::{Keep, Keeper};
use super::notice::{Enrolled, Guess, LibraryState, Listener, Notice, Order};
use super::recogniser::{Load, Recogniser};
use super::worker::{Job, Told, Work, Worker};
use crate::device::Device;
use crate::scan::{Cue, Event, Options, Scan, Session, SessionError, Totals};

/// Scans that wait to be named, where their devices cannot wait: a quarter of an hour of them.
const BACKLOG: usize = 64;

/// What a station is made of.
pub struct Station<'a> {
    devices: Vec<Box<dyn Device>>,
    options: Options,
    recogniser: Option<Arc<dyn Recogniser>>,
    load: Option<Load>,
    keep: Option<Keep>,
    listeners: Vec<Box<dyn Listener + 'a>>,
    orders: (Sender<Order>, Receiver<Order>),
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
    /// whenever [`Order::Reload`] says so.
    pub fn load(mut self, load: Load) -> Self {
        self.load = Some(load);
        self
    }

    /// Keeps the scans that are enrolled in this library.
    pub fn keep(mut self, keep: Keep) -> Self {
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
    pub fn tell(&mut self, notice: &Notice) {
        self.listeners.iter_mut().for_each(|listener| listener.notice(notice));
    }

    /// Where orders go, before it runs and while it does.
    pub fn orders(&self) -> Sender<Order> {
        self.orders.0.clone()
    }

    /// Runs until all devices have ended, or [`Order::Quit`].
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
            Some(keep) => Some(Keeper::start(keep).map_err(thread("recording"))?),
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
            load_again: false,
            pending: VecDeque::new(),
            enrolling: None,
            listeners: self.listeners,
        };
        run.tell(Notice::Streams(run.session.meters().to_vec()));
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
    keeper: Option<Keeper>,
    /// Whether all devices can wait.
    waits: bool,
    naming: Naming,
    load: Option<Load>,
    loading: Option<Receiver<Loaded>>,
    /// The library is to be read once more: it may have changed since the reading began.
    load_again: bool,
    /// What the worker has had no time for yet.
    pending: VecDeque<Job>,
    enrolling: Option<Enrolling>,
    listeners: Vec<Box<dyn Listener + 'a>>,
}

impl Run<'_> {
    fn tell(&mut self, notice: Notice) {
        self.listeners.iter_mut().for_each(|listener| listener.notice(&notice));
    }

    fn warn(&mut self, text: impl Into<String>) {
        self.tell(Notice::Warning(text.into()));
    }

    /// Serves until the session has ended and its scans are on their way.
    fn until_finished(&mut self, orders: &Receiver<Order>) {
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
                    if std::mem::take(&mut self.load_again) {
                        self.reload();
                    }
                }
                recv(orders) -> order => if let Ok(order) = order { self.order(order) },
            }
        }
    }

    /// Waits for what is under way, and tells the end.
    fn finish(self) -> Result<Totals, SessionError> {
        let Self { session, worker, keeper, mut listeners, mut enrolling, .. } = self;
        let mut tell = |notice: Notice| listeners.iter_mut().for_each(|one| one.notice(&notice));
        worker.finish().for_each(|told| tell(notice(told)));
        for kept in keeper.into_iter().flat_map(Keeper::finish) {
            tell(Notice::Enrolled(Enrolling::count(&mut enrolling, kept)));
        }
        let totals = session.wait()?;
        tell(Notice::Finished(Arc::new(totals.clone())));
        Ok(totals)
    }

    fn event(&mut self, event: Event) {
        match event {
            Event::Scan(scan) => self.scan(scan),
            Event::Phase { scan, phase } => self.tell(Notice::Phase { scan, phase }),
            Event::Progress(progress) => self.pending.push_back(Job::Progress(progress)),
            Event::Trace(trace) => self.tell(Notice::Trace(Arc::new(trace))),
            Event::Device { device, state, detail } => {
                self.tell(Notice::Device { device, state, detail });
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
                    self.tell(Notice::Guess(Guess::nothing(progress.number, progress.scan_s)));
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
        let enrolled = Enrolling::count(&mut self.enrolling, kept);
        self.tell(Notice::Enrolled(enrolled));
    }

    fn loaded(&mut self, loaded: Loaded) {
        match loaded {
            Ok(recogniser) => {
                self.tell(Notice::Library(recogniser.library()));
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
                self.tell(Notice::Library(state));
                self.warn(problem);
            }
        }
    }

    fn reload(&mut self) {
        let Some(load) = self.load.clone() else {
            return self.warn("there is no library that could be read anew");
        };
        // One at a time: each takes a thread and the memory of a library.
        if self.loading.is_some() {
            self.load_again = true;
            return;
        }
        if !matches!(self.naming, Naming::Ready(_)) {
            self.naming = Naming::Loading;
        }
        self.tell(Notice::Reading);
        let (tell, loaded) = crossbeam_channel::bounded(1);
        let work = move || {
            let _ = tell.send(load());
        };
        match std::thread::Builder::new().name("load-library".into()).spawn(work) {
            Ok(_) => self.loading = Some(loaded),
            Err(error) => self.loaded(Err(format!("no thread to read the library: {error}"))),
        }
    }

    fn enroll(&mut self, enrolling: Enrolling) {
        match &self.keeper {
            Some(_) => self.enrolling = Some(enrolling),
            None => self.warn("there is no library to keep scans in; name one with --library"),
        }
    }

    fn order(&mut self, order: Order) {
        match order {
            Order::Start => self.session.cue(Cue::Begin),
            Order::Stop => self.session.cue(Cue::End),
            Order::Enroll { surface, user, trials } => {
                self.enroll(Enrolling::new(Wish { surface, user, good_only: true }, trials));
            }
            Order::Record { surface, user } => {
                self.enroll(Enrolling::new(Wish { surface, user, good_only: false }, u32::MAX));
            }
            Order::EndEnroll => self.enrolling = None,
            Order::Ping => self.tell(Notice::Alive),
            Order::Reload => self.reload(),
            Order::Quit => self.session.request_stop(),
        }
    }
}

fn notice(told: Told) -> Notice {
    match told {
        Told::Named(Ok(answer)) => Notice::Answer(answer),
        Told::Named(Err(problem)) => Notice::Warning(problem),
        Told::Guess(guess) => Notice::Guess(guess),
    }
}
