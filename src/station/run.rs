//! The loop of a station: session events, answers and commands in; station events out.

use std::collections::VecDeque;
use std::sync::Arc;

use crossbeam_channel::{Receiver, never, select};

use super::enroll::{Enrolment, EnrolmentProgress};
use super::event::{Command, EnrolledOutcome, LibraryState, Listener, StationEvent};
use super::recogniser::{Load, Recogniser};
use super::store::{RecordingThread, Stored};
use super::worker::{Job, Purpose, Work, Worker, WorkerEvent};
use crate::scan::{Event, Progress, Scan, ScanCommand, Session, SessionError, Totals};
use crate::scene::SourceId;

/// Scans that wait to be named, where their devices cannot wait: a quarter of an hour's.
const BACKLOG: usize = 64;

/// What scans are named with.
enum Naming {
    /// The library is being read; scans wait.
    Loading,
    Ready(Arc<Recogniser>),
    /// They cannot be named: why.
    None(String),
}

impl Naming {
    /// Why scans cannot be named, if they cannot.
    fn problem(&self) -> &str {
        match self {
            Self::None(why) => why,
            Self::Loading | Self::Ready(_) => "",
        }
    }
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
    enrolment: Option<EnrolmentProgress>,
    /// Enrolments so far.
    enrolments: u64,
    /// Number of the next scan to begin.
    next_scan: u32,
    listeners: Vec<Box<dyn Listener + 'a>>,
}

impl<'a> Run<'a> {
    /// A station that knows no library yet.
    pub fn new(parts: Parts, listeners: Vec<Box<dyn Listener + 'a>>) -> Self {
        let Parts { session, worker, recording, by_t_star, waits, load } = parts;
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
            enrolment: None,
            enrolments: 0,
            next_scan: 1,
            listeners,
        }
    }

    /// Reports what the streams carry.
    pub fn announce_streams(&mut self) {
        self.emit(StationEvent::Streams(self.session.meters().to_vec()));
    }

    /// Whether there is a library to read.
    pub fn can_load(&self) -> bool {
        self.load.is_some()
    }

    fn emit(&mut self, event: StationEvent) {
        self.listeners.iter_mut().for_each(|listener| listener.on_event(&event));
    }

    fn warn(&mut self, text: impl Into<String>) {
        self.emit(StationEvent::Warning(text.into()));
    }

    /// Works until the session has ended and its scans are handed on.
    pub fn until_finished(&mut self, commands: &Receiver<Command>) {
        let mut finished = false;
        loop {
            self.hand_on();
            if finished && self.pending.is_empty() {
                return;
            }
            // A recording waits until its scans are named; nothing else may be kept waiting.
            let reads = !finished && (!self.waits || self.pending.is_empty());
            let events = if reads { self.session.events().clone() } else { never() };
            let done = self.worker.done.clone();
            let stored = self.recording.as_ref().map_or_else(never, |thread| thread.stored.clone());
            let loaded = self.loading.clone().unwrap_or_else(never);
            select! {
                recv(events) -> event => match event {
                    // If the channel just closes, the collector has panicked; `finish` says so.
                    Ok(Event::Finished(_)) | Err(_) => finished = true,
                    Ok(event) => self.event(event),
                },
                recv(done) -> done => if let Ok(done) = done { self.emit(station_event(done)) },
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
            }
        }
    }

    /// Waits for what is under way, and reports the end.
    pub fn finish(self) -> Result<Totals, SessionError> {
        let Self { session, worker, recording, mut listeners, mut enrolment, .. } = self;
        let mut emit =
            |event: StationEvent| listeners.iter_mut().for_each(|one| one.on_event(&event));
        worker.finish().for_each(|done| emit(station_event(done)));
        for stored in recording.into_iter().flat_map(RecordingThread::finish) {
            enrolled(&mut enrolment, stored).into_iter().for_each(&mut emit);
        }
        let totals = session.wait()?;
        emit(StationEvent::Finished(Arc::new(totals.clone())));
        Ok(totals)
    }

    fn event(&mut self, event: Event) {
        match event {
            Event::Scan(scan) => self.scan(scan),
            Event::Phase { scan, phase } => {
                self.next_scan = self.next_scan.max(scan.saturating_add(1));
                self.emit(StationEvent::Phase { scan, phase });
            }
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
        if let (Some(progress), Some(recording)) = (&mut self.enrolment, &self.recording)
            && let Some(enrolment) = progress.claim(scan.number)
        {
            return recording.store(scan, enrolment);
        }
        self.pending.push_back(Job::Scan(scan));
        let waiting = self.pending.iter().filter(|job| matches!(job, Job::Scan(_))).count();
        if waiting <= BACKLOG || self.waits {
            return;
        }
        // The oldest scan goes, and the progress within it.
        while let Some(job) = self.pending.pop_front() {
            if let Job::Scan(scan) = job {
                self.warn(format!("scan {} was not named: too many wait for it", scan.number));
                return;
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
                Naming::None(_) => None,
                Naming::Ready(by) => Some(by.clone()),
            };
            let work = match (job, by) {
                (Job::Scan(scan), Some(by)) => Work::Scan(scan, by),
                (Job::Scan(scan), None) => {
                    let why = self.naming.problem();
                    self.warn(format!("scan {} was not named: {why}", scan.number));
                    continue;
                }
                (Job::Progress(progress), by) => {
                    let purpose = self.purpose(progress.number);
                    Work::Progress(progress, purpose, by)
                }
            };
            if let Err(back) = self.worker.work.try_send(work) {
                return self.pending.push_front(back.into_inner().into_job());
            }
        }
    }

    /// What a scan in progress is for.
    fn purpose(&self, number: u32) -> Purpose {
        let wanted = self.enrolment.as_ref().filter(|progress| progress.wants(number));
        match wanted {
            Some(progress) if progress.good_only() => Purpose::Keep(self.by_t_star.clone()),
            Some(_) => Purpose::Keep(Vec::new()),
            None => Purpose::Name,
        }
    }

    fn stored(&mut self, stored: Stored) {
        for event in enrolled(&mut self.enrolment, stored) {
            self.emit(event);
        }
    }

    /// Names scans with what was read from now on, if it could be read.
    pub fn loaded(&mut self, loaded: Loaded) {
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

    /// Reads the library; meanwhile the one before stays in use, or scans wait.
    pub fn reload(&mut self) {
        let Some(load) = self.load.clone() else {
            return self.warn("there is no library to read again");
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
            Err(error) => self.loaded(Err(format!("no thread to read the library: {error}"))),
        }
    }

    /// Keeps scans from the next one on: a scan in progress belongs to what was before.
    fn enroll(&mut self, surface: String, user: String, good_only: bool, trials: u32) {
        if self.recording.is_none() {
            return self.warn("there is no library to keep scans in");
        }
        self.enrolments += 1;
        let enrolment = Enrolment { id: self.enrolments, surface, user, good_only };
        self.enrolment = Some(EnrolmentProgress::new(enrolment, trials, self.next_scan));
    }

    fn obey(&mut self, command: Command) {
        match command {
            Command::Start => self.session.command(ScanCommand::Begin),
            Command::Stop => self.session.command(ScanCommand::End),
            Command::Enroll { surface, user, trials } => self.enroll(surface, user, true, trials),
            Command::Record { surface, user } => self.enroll(surface, user, false, u32::MAX),
            Command::EndEnroll => self.enrolment = None,
            Command::Ping => self.emit(StationEvent::Alive),
            Command::Reload => self.reload(),
            Command::Quit => self.session.request_stop(),
        }
    }
}

/// What the worker has done, as an event.
fn station_event(done: WorkerEvent) -> StationEvent {
    match done {
        WorkerEvent::Named(Ok(answer)) => StationEvent::Answer(answer),
        WorkerEvent::Named(Err(problem)) => StationEvent::Warning(problem),
        WorkerEvent::Guess(guess) => StationEvent::Guess(guess),
    }
}

/// What became of a scan that was to be kept, and a warning if it was not written.
fn enrolled(progress: &mut Option<EnrolmentProgress>, stored: Stored) -> Vec<StationEvent> {
    let enrolled = EnrolmentProgress::count(progress, stored);
    let why = enrolled.remarks.last().map_or("", String::as_str);
    let what = match enrolled.outcome {
        EnrolledOutcome::Waiting => Some("could not be written, and will be tried again"),
        EnrolledOutcome::Lost => Some("could not be written, and is lost"),
        EnrolledOutcome::Kept | EnrolledOutcome::Refused => None,
    };
    let text = what.map(|what| format!("scan {} {what}: {why}", enrolled.scan));
    let warning = text.map(StationEvent::Warning);
    [Some(StationEvent::Enrolled(enrolled)), warning].into_iter().flatten().collect()
}
