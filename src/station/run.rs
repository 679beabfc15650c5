//! The loop of a station: session events, answers and commands in; station events out.

mod reading;

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, at, never, select};

use super::event::{Command, EnrolledOutcome, Enrolling, Listener, StationEvent};
use super::orders::{Keep, Orders};
use super::recogniser::{Load, Recogniser};
use super::store::{RecordingThread, Stored};
use super::trial_need::Purpose;
use super::worker::{Job, ScanAnswer, Work, Worker, WorkerEvent};
use crate::scan::{Event, Progress, Scan, ScanCommand, Session, SessionError, Totals};
use crate::scene::SourceId;

/// Scans that wait to be named, where their devices cannot wait: a quarter of an hour's.
const BACKLOG: usize = 64;
/// How long [`Command::Quit`] waits for answers. Devices have 2 s of it to stop.
const PATIENCE: Duration = Duration::from_secs(3);

/// What scans are named with.
enum Naming {
    /// The library is being read; scans wait.
    Loading,
    Ready(Arc<Recogniser>),
    /// They cannot be named: why.
    None(String),
}

type Loaded = Result<Arc<Recogniser>, String>;

/// What works for a station, once it is started.
pub(super) struct Parts {
    pub session: Session,
    pub worker: Worker,
    pub recording: Option<RecordingThread>,
    /// Sources of which a good trial holds enough independent samples.
    pub by_t_star: Vec<SourceId>,
    /// Whether all devices can wait.
    pub waits: bool,
    pub load: Option<Load>,
    /// The station's own order.
    pub keep: Option<Keep>,
}

/// A station at work.
pub(super) struct Run<'a> {
    session: Session,
    worker: Worker,
    recording: Option<RecordingThread>,
    by_t_star: Vec<SourceId>,
    waits: bool,
    load: Option<Load>,
    naming: Naming,
    loading: Option<Receiver<Loaded>>,
    /// The library is to be read once more: it may have changed since the reading began.
    load_again: bool,
    /// Work that the worker has not taken yet.
    pending: VecDeque<Job>,
    /// The number of the scan, for each job that the worker has; none for a scan in progress.
    in_hand: VecDeque<Option<u32>>,
    orders: Orders,
    /// What the next scan is to become, as last reported.
    enrolling: Option<Enrolling>,
    /// Until when answers are waited for; none before the end is ordered.
    deadline: Option<Instant>,
    listeners: Vec<Box<dyn Listener + 'a>>,
}

impl<'a> Run<'a> {
    /// A station that knows no library yet.
    pub fn new(parts: Parts, listeners: Vec<Box<dyn Listener + 'a>>) -> Self {
        let Parts { session, worker, recording, by_t_star, waits, load, keep } = parts;
        let mut orders = Orders::default();
        keep.into_iter().for_each(|keep| orders.set_own(keep));
        Self {
            session,
            worker,
            recording,
            by_t_star,
            waits,
            load,
            naming: Naming::None("no library was given".into()),
            loading: None,
            load_again: false,
            pending: VecDeque::new(),
            in_hand: VecDeque::new(),
            orders,
            enrolling: None,
            deadline: None,
            listeners,
        }
    }

    /// Reports what the streams carry, and what the first scan is to become.
    pub fn announce(&mut self) {
        self.emit(StationEvent::Streams(self.session.meters().to_vec()));
        self.report_order();
    }

    fn emit(&mut self, event: StationEvent) {
        self.listeners.iter_mut().for_each(|listener| listener.on_event(&event));
    }

    fn warn(&mut self, text: impl Into<String>) {
        self.emit(StationEvent::Warning(text.into()));
    }

    /// Works until the session has ended and its scans are named, or time is up.
    pub fn until_finished(&mut self, commands: &Receiver<Command>) {
        let mut finished = false;
        loop {
            self.hand_on();
            if self.deadline.is_some_and(|deadline| deadline <= Instant::now()) {
                self.give_up_naming();
            }
            if finished && self.pending.is_empty() && self.in_hand.is_empty() {
                return;
            }
            // A recording waits until its scans are named; nothing else may be kept waiting.
            let reads = !finished && (!self.waits || self.pending.is_empty());
            let events = if reads { self.session.events().clone() } else { never() };
            let done = self.worker.done.clone();
            let stored = self.recording.as_ref().map_or_else(never, |thread| thread.stored.clone());
            let loaded = self.loading.clone().unwrap_or_else(never);
            let waiting = !(self.pending.is_empty() && self.in_hand.is_empty());
            let deadline = self.deadline.filter(|_| waiting).map_or_else(never, at);
            select! {
                recv(events) -> event => match event {
                    // If the channel just closes, the collector has panicked; `finish` says so.
                    Ok(Event::Finished(_)) | Err(_) => finished = true,
                    Ok(event) => self.event(event),
                },
                recv(done) -> done => match done {
                    Ok(done) => self.done(done),
                    // It catches the panics of methods; one of its own is a defect.
                    Err(_) => return,
                },
                recv(stored) -> stored => if let Ok(stored) = stored { self.stored(stored) },
                recv(loaded) -> loaded => {
                    self.loading = None;
                    let gone = |_| Err("the thread that reads the library panicked".to_string());
                    self.loaded(loaded.unwrap_or_else(gone));
                    if std::mem::take(&mut self.load_again) {
                        self.reload();
                    }
                }
                recv(commands) -> command => if let Ok(command) = command { self.obey(command) },
                recv(deadline) -> _ => {}
            }
        }
    }

    /// Reports scans that will not be named, since the end does not wait for them any longer.
    fn give_up_naming(&mut self) {
        let pending = self.pending.drain(..).filter_map(|job| match job {
            Job::Scan(scan) => Some(scan.number),
            Job::Progress(_) => None,
        });
        let numbers: Vec<u32> = self.in_hand.drain(..).flatten().chain(pending).collect();
        let busy = match &self.naming {
            Naming::Loading => "the library was still being read",
            _ => "there was no time for it",
        };
        for number in numbers {
            self.warn(format!("scan {number} was not named: {busy} when the station was ended"));
        }
    }

    /// Waits for what is being written, and reports the end.
    pub fn finish(mut self) -> Result<Totals, SessionError> {
        let written = self.recording.take().into_iter().flat_map(RecordingThread::finish);
        written.for_each(|stored| self.stored(stored));
        let Self { session, mut listeners, .. } = self;
        let totals = session.wait()?;
        let event = StationEvent::Finished(Arc::new(totals.clone()));
        listeners.iter_mut().for_each(|listener| listener.on_event(&event));
        Ok(totals)
    }

    fn event(&mut self, event: Event) {
        match event {
            Event::Scan(scan) => self.scan(scan),
            Event::Phase { scan, phase } => self.emit(StationEvent::Phase { scan, phase }),
            Event::Progress(progress) => self.progress(progress),
            Event::Trace(trace) => self.emit(StationEvent::Trace(Arc::new(trace))),
            Event::Device { device, state, detail } => {
                self.emit(StationEvent::Device { device, state, detail });
            }
            Event::Warning(text) => self.warn(text),
            // Handled by the loop.
            Event::Finished(_) => {}
        }
    }

    fn scan(&mut self, scan: Box<Scan>) {
        if let Some(recording) = &self.recording
            && let Some(enrolment) = self.orders.claim(scan.number)
        {
            let by = match &self.naming {
                Naming::Ready(by) => Some(by.clone()),
                Naming::Loading | Naming::None(_) => None,
            };
            recording.store(scan, enrolment, by);
            return self.report_order();
        }
        self.pending.push_back(Job::Scan(scan));
        let waiting = self.pending.iter().filter(|job| matches!(job, Job::Scan(_))).count();
        if waiting <= BACKLOG || self.waits {
            return;
        }
        // The oldest scan goes, and the progress within it.
        while let Some(job) = self.pending.pop_front() {
            if let Job::Scan(scan) = job {
                return self.unnamed(scan, "too many wait for it");
            }
        }
    }

    /// Adds news of a scan. What the worker has no time for becomes one piece of news.
    fn progress(&mut self, progress: Progress) {
        match self.pending.back_mut() {
            Some(Job::Progress(last)) if last.number == progress.number => last.append(progress),
            _ => self.pending.push_back(Job::Progress(progress)),
        }
    }

    /// Hands work to the worker, as far as it takes it.
    fn hand_on(&mut self) {
        while let Some(job) = self.pending.pop_front() {
            let by = match &self.naming {
                Naming::Loading => return self.pending.push_front(job),
                Naming::Ready(by) => Ok(by.clone()),
                Naming::None(why) => Err(why.clone()),
            };
            let (work, number) = match (job, by) {
                (Job::Scan(scan), Ok(by)) => {
                    let number = scan.number;
                    (Work::Scan(scan, by), Some(number))
                }
                (Job::Scan(scan), Err(why)) => {
                    self.unnamed(scan, &why);
                    continue;
                }
                (Job::Progress(progress), by) => {
                    let purpose = self.purpose(progress.number);
                    (Work::Progress(progress, purpose, by.ok()), None)
                }
            };
            if let Err(back) = self.worker.work.try_send(work) {
                return self.pending.push_front(back.into_inner().into_job());
            }
            self.in_hand.push_back(number);
        }
    }

    /// What a scan in progress is for.
    fn purpose(&self, number: u32) -> Purpose {
        match self.orders.covering(number) {
            Some(enrolment) if enrolment.good_only => Purpose::Keep(self.by_t_star.clone()),
            Some(_) => Purpose::Keep(Vec::new()),
            None => Purpose::Name,
        }
    }

    /// Reports what the worker has done.
    fn done(&mut self, done: WorkerEvent) {
        self.in_hand.pop_front();
        match done {
            WorkerEvent::Answered(answered) => self.answered(answered),
            WorkerEvent::Guess(guess) => self.emit(StationEvent::Guess(guess)),
        }
    }

    /// Reports a scan with its answer.
    fn answered(&mut self, answered: ScanAnswer) {
        let (event, scan) = match answered {
            ScanAnswer::Named(scan) => (StationEvent::Answer(scan.answer.clone()), scan),
            ScanAnswer::Unnamed(scan, unnamed) => (StationEvent::Unnamed(unnamed), scan),
        };
        self.emit(event);
        self.emit(StationEvent::Scan(scan));
    }

    /// Reports that a scan was not named, and why.
    fn unnamed(&mut self, scan: Box<Scan>, why: &str) {
        let latency_ms = scan.ended_at.elapsed().as_secs_f64() * 1e3;
        self.answered(ScanAnswer::unnamed(scan, why, latency_ms, false));
    }

    /// Reports what became of a scan that was to be kept.
    fn stored(&mut self, (enrolment, enrolled): Stored) {
        let enrolled = self.orders.count(&enrolment, enrolled);
        let why = enrolled.remarks.last().map_or("", String::as_str);
        let what = match enrolled.outcome {
            EnrolledOutcome::Waiting => Some("could not be written, and will be tried again"),
            EnrolledOutcome::Lost => Some("could not be written, and is lost"),
            EnrolledOutcome::Kept | EnrolledOutcome::Refused => None,
        };
        let text = what.map(|what| format!("scan {} {what}: {why}", enrolled.scan));
        self.emit(StationEvent::Enrolled(enrolled));
        text.into_iter().for_each(|text| self.warn(text));
        self.report_order();
    }

    /// Reports what the next scan is to become, if that has changed.
    fn report_order(&mut self) {
        let now = self.orders.in_force();
        if now != self.enrolling {
            self.enrolling.clone_from(&now);
            self.emit(StationEvent::Enrolling(now));
        }
    }

    /// Keeps the scans that begin from now on.
    fn enroll(&mut self, keep: Keep) {
        if self.recording.is_none() {
            return self.warn("there is no library to keep scans in");
        }
        self.orders.give(keep, self.session.next_scan());
        self.report_order();
    }

    fn obey(&mut self, command: Command) {
        match command {
            Command::Start => self.session.command(ScanCommand::Begin),
            Command::Stop => self.session.command(ScanCommand::End),
            Command::Enroll { surface, user, trials } => {
                self.enroll(Keep { surface, user, trials: Some(trials), good_only: true });
            }
            Command::EndEnroll => {
                self.orders.end(self.session.next_scan());
                self.report_order();
            }
            Command::Ping => self.emit(StationEvent::Alive),
            Command::Reload => self.reload(),
            Command::Quit => {
                self.deadline.get_or_insert_with(|| Instant::now() + PATIENCE);
                self.session.request_stop();
            }
        }
    }
}
