//! The loop of a station: session events, answers and commands in; station events out.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, at, never, select};

use super::event::{Command, Enrolled, EnrolledOutcome, Enrolling, Listener, StationEvent};
use super::orders::{Enrolment, Keep, Orders};
use super::recogniser::{LibraryState, Load, Recogniser};
use super::store::{RecordingThread, StoredScan};
use super::trial_need::Purpose;
use super::worker::{Job, JobOf, ScanAnswer, Work, Worker, WorkerEvent};
use crate::scan::{Event, Progress, Scan, ScanCommand, Session, SessionError, Totals};
use crate::scene::SourceId;

/// The time after [`Command::Quit`] for the last answers. Devices have 2 s of it to stop.
const NAMED: Duration = Duration::from_millis(2500);
/// The time after [`Command::Quit`] until which scans are written to disk.
const WRITTEN: Duration = Duration::from_millis(3200);
/// The time after [`Command::Quit`] until which listeners may work.
const PASSED_ON: Duration = Duration::from_millis(3900);

/// The recogniser of scans, if there is one.
enum Naming {
    /// The library is being read; scans wait.
    Loading,
    Ready(Arc<Recogniser>),
    /// Scans cannot be named: the reason.
    None(String),
}

type LoadedRecogniser = Result<Arc<Recogniser>, String>;

/// The running parts of a station.
pub(super) struct Parts {
    pub session: Session,
    pub worker: Worker,
    pub recording: Option<RecordingThread>,
    /// Sources of which a good trial must hold enough independent samples, by T*.
    pub by_t_star: Vec<SourceId>,
    /// Whether all devices can wait for the station, so that it may pause them.
    pub waits: bool,
    pub load: Option<Load>,
    /// The station's own order.
    pub keep: Option<Keep>,
}

/// A station at work.
pub(super) struct StationRun<'a> {
    session: Session,
    worker: Worker,
    recording: Option<RecordingThread>,
    by_t_star: Vec<SourceId>,
    waits: bool,
    load: Option<Load>,
    naming: Naming,
    loading: Option<Receiver<LoadedRecogniser>>,
    /// The library must be read again: it may have changed since the reading began.
    load_again: bool,
    /// Work that the worker has not taken yet.
    pending: VecDeque<Job>,
    /// The jobs that the worker has.
    in_hand: VecDeque<InHand>,
    orders: Orders,
    /// The order for the next scan, as last reported.
    enrolling: Option<Enrolling>,
    /// When [`Command::Quit`] was given.
    ordered: Option<Instant>,
    listeners: Vec<Box<dyn Listener + 'a>>,
}

impl<'a> StationRun<'a> {
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
            naming: Naming::None("no library is set".into()),
            loading: None,
            load_again: false,
            pending: VecDeque::new(),
            in_hand: VecDeque::new(),
            orders,
            enrolling: None,
            ordered: None,
            listeners,
        }
    }

    /// Reports the meters of the streams, and the order for the first scan.
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
            let deadline = self.ordered.map(|ordered| ordered + NAMED);
            match deadline.is_some_and(|deadline| deadline <= Instant::now()) {
                true => self.give_up_naming(),
                false => self.hand_on(),
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
            let deadline = deadline.filter(|_| waiting).map_or_else(never, at);
            select! {
                recv(events) -> event => match event {
                    // If the channel just closes, the collector has panicked; `finish` says so.
                    Ok(Event::Finished(_)) | Err(_) => finished = true,
                    Ok(event) => self.event(event),
                },
                recv(done) -> done => match done {
                    Ok(done) => self.done(done),
                    // The worker catches the panics of methods; a panic of the worker itself is a
                    // defect.
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

    /// Waits for scans that are being written, and reports the end.
    pub fn finish(mut self) -> Result<Totals, SessionError> {
        let until = self.ordered.map(|ordered| ordered + WRITTEN);
        let written = self.recording.take().into_iter().flat_map(|thread| thread.finish(until));
        written.for_each(|stored| self.enrolled(&stored.enrolment, stored.enrolled));
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

    /// Takes the outcome of a scan that was to be kept; if it was kept, the outcome is reported
    /// once the nearest surface is known.
    fn stored(&mut self, stored: StoredScan) {
        if let Some(recording) = &mut self.recording {
            recording.settle(&stored.enrolled);
        }
        match stored.kept {
            Some(_) => self.pending.push_back(Job::Kept(Box::new(stored))),
            None => self.enrolled(&stored.enrolment, stored.enrolled),
        }
    }

    /// Reports the outcome of a scan that was to be kept.
    fn enrolled(&mut self, enrolment: &Enrolment, enrolled: Enrolled) {
        let enrolled = self.orders.count(enrolment, enrolled);
        let why = enrolled.remarks.last().map_or("", String::as_str);
        let what = match enrolled.outcome {
            EnrolledOutcome::Waiting => Some("could not be written and will be tried again"),
            EnrolledOutcome::Lost => Some("could not be written and is lost"),
            EnrolledOutcome::Kept | EnrolledOutcome::Refused => None,
        };
        let text = what.map(|what| format!("scan {} {what}: {why}", enrolled.scan));
        self.emit(StationEvent::Enrolled(enrolled));
        text.into_iter().for_each(|text| self.warn(text));
        self.report_order();
    }

    /// Reports the order for the next scan, if it has changed.
    fn report_order(&mut self) {
        let now = self.orders.in_force();
        if now != self.enrolling {
            self.enrolling.clone_from(&now);
            self.emit(StationEvent::Enrolling(now));
        }
    }

    /// Keeps the scans that begin from now on as trials.
    fn enroll(&mut self, keep: Keep) {
        if self.recording.is_none() {
            return self.warn("this scan cannot be kept: no library is set");
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
            Command::KeepRefused(scan) => {
                match (self.orders.keep_refused(scan), &mut self.recording) {
                    (Some(enrolment), Some(recording)) => recording.keep_refused(scan, enrolment),
                    _ => self.warn(format!(
                        "scan {scan} was not kept: only the scan that was refused last can be; \
                         repeat it"
                    )),
                }
                self.report_order();
            }
            Command::EndEnroll => {
                self.orders.end(self.session.next_scan());
                self.report_order();
            }
            Command::Ping => self.emit(StationEvent::Alive),
            Command::Reload => self.reload(),
            Command::Quit => {
                self.session.request_stop();
                if self.ordered.is_none() {
                    let now = Instant::now();
                    self.ordered = Some(now);
                    self.emit(StationEvent::Ending(now + PASSED_ON));
                }
            }
        }
    }
}

impl StationRun<'_> {
    /// Whether there is a library to read.
    pub fn can_load(&self) -> bool {
        self.load.is_some()
    }

    /// Names scans with the new library from now on, if it could be read.
    pub fn loaded(&mut self, loaded: LoadedRecogniser) {
        match loaded {
            Ok(recogniser) => {
                self.emit(StationEvent::Library(recogniser.library()));
                self.naming = Naming::Ready(recogniser);
            }
            Err(problem) => {
                // The library that was read before stays in use.
                let mut state = match &self.naming {
                    Naming::Ready(recogniser) => recogniser.library(),
                    _ => {
                        self.naming = Naming::None(problem.clone());
                        LibraryState::default()
                    }
                };
                state.problem = Some(problem.clone());
                self.emit(StationEvent::Library(state));
                self.warn(problem);
            }
        }
    }

    /// Reads the library; meanwhile the old one stays in use, or scans wait if there is none.
    pub fn reload(&mut self) {
        let Some(load) = self.load.clone() else {
            return self.warn("nothing was reloaded: no library is set");
        };
        // One at a time: each takes a thread and the memory of a library.
        if self.loading.is_some() {
            self.load_again = true;
            return;
        }
        if !matches!(self.naming, Naming::Ready(_)) {
            self.naming = Naming::Loading;
        }
        self.emit(StationEvent::Reading);
        let (send, loaded) = crossbeam_channel::bounded(1);
        let work = move || {
            let _ = send.send(load());
        };
        match std::thread::Builder::new().name("load-library".into()).spawn(work) {
            Ok(_) => self.loading = Some(loaded),
            Err(error) => {
                self.loaded(Err(format!("cannot start a thread to read the library: {error}")))
            }
        }
    }
}

/// Most scans that wait to be named where devices cannot wait: those of a quarter of an hour.
const BACKLOG: usize = 64;

/// A job that the worker has: the number of the scan, or the report to be completed.
type InHand = JobOf<u32, (), Box<(Enrolment, Enrolled)>>;

impl InHand {
    fn of(job: &Job) -> Self {
        match job {
            Job::Scan(scan) => Self::Scan(scan.number),
            Job::Progress(_) => Self::Progress(()),
            Job::Kept(kept) => {
                Self::Kept(Box::new((kept.enrolment.clone(), kept.enrolled.clone())))
            }
        }
    }
}

impl StationRun<'_> {
    fn scan(&mut self, scan: Box<Scan>) {
        if let Some(recording) = &mut self.recording
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
        self.limit_backlog();
    }

    /// Drops the oldest scan and the progress before it, if too many wait.
    fn limit_backlog(&mut self) {
        let waiting = self.pending.iter().filter(|job| !matches!(job, Job::Progress(_))).count();
        if waiting <= BACKLOG || self.waits {
            return;
        }
        while let Some(job) = self.pending.pop_front() {
            match job {
                Job::Progress(_) => {}
                Job::Kept(kept) => return self.enrolled(&kept.enrolment, kept.enrolled),
                Job::Scan(scan) => return self.unnamed(scan, "too many scans were waiting"),
            }
        }
    }

    /// Adds progress of a scan, joined to progress of the same scan that still waits.
    fn progress(&mut self, progress: Progress) {
        match self.pending.back_mut() {
            Some(Job::Progress(last)) if last.number == progress.number => last.append(progress),
            _ => self.pending.push_back(Job::Progress(progress)),
        }
    }

    /// Hands jobs to the worker, as long as it takes them.
    fn hand_on(&mut self) {
        while let Some(job) = self.pending.pop_front() {
            let by = match &self.naming {
                Naming::Loading => return self.pending.push_front(job),
                Naming::Ready(by) => Ok(by.clone()),
                Naming::None(why) => Err(why.clone()),
            };
            let in_hand = InHand::of(&job);
            let work = match (job, by) {
                (Job::Scan(scan), Ok(by)) => Work::Scan((scan, by)),
                (Job::Scan(scan), Err(why)) => {
                    self.unnamed(scan, &why);
                    continue;
                }
                (Job::Progress(progress), by) => {
                    let purpose = self.purpose(progress.number);
                    Work::Progress((progress, purpose, by.ok()))
                }
                (Job::Kept(kept), _) => Work::Kept(kept),
            };
            if let Err(back) = self.worker.work.try_send(work) {
                return self.pending.push_front(back.into_inner().into_job());
            }
            self.in_hand.push_back(in_hand);
        }
    }

    /// The purpose of a scan in progress.
    fn purpose(&self, number: u32) -> Purpose {
        match self.orders.covering(number) {
            Some(enrolment) if enrolment.good_only => Purpose::Keep(self.by_t_star.clone()),
            Some(_) => Purpose::Keep(Vec::new()),
            None => Purpose::Name,
        }
    }

    /// Reports the result of a job.
    fn done(&mut self, done: WorkerEvent) {
        let job = self.in_hand.pop_front();
        match done {
            WorkerEvent::Scan(answered) => self.answered(answered),
            WorkerEvent::Progress(guess) => self.emit(StationEvent::Guess(guess)),
            WorkerEvent::Kept(nearest) => {
                if let Some(InHand::Kept(kept)) = job {
                    self.enrolled(&kept.0, Enrolled { nearest, ..kept.1 });
                }
            }
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

    /// Reports a scan that was not named, with the reason.
    fn unnamed(&mut self, scan: Box<Scan>, why: &str) {
        let latency_ms = scan.ended_at.elapsed().as_secs_f64() * 1e3;
        self.answered(ScanAnswer::unnamed(scan, why, latency_ms, false));
    }

    /// Reports the scans left unnamed because the time for that after [`Command::Quit`] is over.
    fn give_up_naming(&mut self) {
        // From now on, results of the worker come too late.
        self.worker.done = never();
        let pending: Vec<InHand> = self.pending.drain(..).map(|job| InHand::of(&job)).collect();
        let in_hand: Vec<InHand> = self.in_hand.drain(..).collect();
        let busy = match &self.naming {
            Naming::Loading => "the library was still being read",
            _ => "time had run out",
        };
        for job in in_hand.into_iter().chain(pending) {
            match job {
                InHand::Scan(number) => self.warn(format!(
                    "scan {number} was not named: {busy} when the station was ended"
                )),
                InHand::Kept(kept) => self.enrolled(&kept.0, kept.1),
                InHand::Progress(()) => {}
            }
        }
    }
}
