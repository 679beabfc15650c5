//! A station and its loop, which takes session events, answers and commands, and emits station events.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender, at, never, select};

use super::answer::AnswerState;
use super::continuous::{Continuous, Heard};
use super::event::{
    AnsweredScan, Command, Enrolled, EnrolledOutcome, Enrolling, Listener, StationEvent,
};
use super::orders::{Enrolment, Keep, Orders};
use super::recogniser::{LibraryState, Load, Recogniser};
use super::store::{RecordingThread, ScanStore, StoredScan};
use super::worker::{Job, Work, Worker, WorkerEvent, unnamed};
use crate::device::{Device, Warning, WarningKind};
use crate::scan::{Event, Options, Progress, Scan, ScanCommand, Session, SessionError, Totals};
use crate::scene::SourceId;
use crate::trial::Doubt;

/// Time after [`Command::Quit`] for naming the last scans. Devices have 2 s of this time to stop.
const NAMED: Duration = Duration::from_millis(2500);
/// Time after [`Command::Quit`] for writing scans to disk.
const WRITTEN: Duration = Duration::from_millis(3200);
/// Time after [`Command::Quit`] for listeners to finish.
const PASSED_ON: Duration = Duration::from_millis(3900);
/// How many scans may wait to be named if devices cannot be paused; they span some 15 minutes.
const BACKLOG: usize = 64;

/// A recogniser, or the reason why scans cannot be named.
type LoadedRecogniser = Result<Arc<Recogniser>, String>;

pub struct Station<'a> {
    pub devices: Vec<Box<dyn Device>>,
    pub options: Options,
    pub recogniser: Option<Arc<Recogniser>>,
    /// Reads the library, at each [`Command::Reload`], and at the start unless there is a recogniser.
    pub load: Option<Load>,
    pub store: Option<ScanStore>,
    /// Keeps every scan as a trial in `store` while no [`Command::Enroll`] is in force.
    pub keep: Option<Keep>,
    /// Names surfaces without begin and end; by default, each scan is named as a whole.
    pub continuous: Option<Continuous>,
    pub listeners: Vec<Box<dyn Listener + 'a>>,
    commands: (Sender<Command>, Receiver<Command>),
}

struct StationRun<'a> {
    session: Session,
    worker: Worker,
    recording: Option<RecordingThread>,
    by_t_star: Vec<SourceId>,
    /// Whether the station may pause all devices; true for recordings.
    waits: bool,
    load: Option<Load>,
    naming: LoadedRecogniser,
    /// The library that is being read. Scans wait for it if there is no recogniser yet.
    loading: Option<Receiver<LoadedRecogniser>>,
    /// Whether to read the library once more, since it may have changed after `loading` began.
    load_again: bool,
    to_do: VecDeque<Job>,
    /// Numbers of the scans that the worker is to name.
    in_hand: VecDeque<u32>,
    /// Trials that the worker is to find the nearest surface of, in the order of their jobs.
    kept: VecDeque<(Enrolment, Enrolled)>,
    orders: Orders,
    lost_trials: u32,
    /// The order for the next scan, as it was last reported.
    enrolling: Option<Enrolling>,
    quit_at: Option<Instant>,
    listeners: Vec<Box<dyn Listener + 'a>>,
}

impl<'a> Station<'a> {
    pub fn new(devices: Vec<Box<dyn Device>>, options: Options) -> Self {
        Self {
            devices,
            options,
            recogniser: None,
            load: None,
            store: None,
            keep: None,
            continuous: None,
            listeners: Vec::new(),
            commands: crossbeam_channel::unbounded(),
        }
    }

    pub fn listener(mut self, listener: impl Listener + 'a) -> Self {
        self.listeners.push(Box::new(listener));
        self
    }

    pub fn emit(&mut self, event: &StationEvent) {
        self.listeners.iter_mut().for_each(|listener| listener.on_event(event));
    }

    pub fn commands(&self) -> Sender<Command> {
        self.commands.0.clone()
    }

    /// Runs until all devices have ended, or until [`Command::Quit`].
    ///
    /// # Errors
    /// If two streams share a name, an option is invalid, or a thread cannot be started. A device
    /// that fails is not an error; [`Totals`] names it.
    pub fn run(self) -> Result<Totals, SessionError> {
        // This sender keeps the channel open, even if no other sender is left.
        let (_sender, commands) = self.commands.clone();
        let mut run = StationRun::start(self)?;
        run.until_finished(&commands);
        run.finish()
    }
}

impl<'a> StationRun<'a> {
    fn start(station: Station<'a>) -> Result<Self, SessionError> {
        let Station { devices, mut options, recogniser, load, store, keep, .. } = station;
        let (continuous, listeners) = (station.continuous, station.listeners);
        if let Some(Continuous { hop_s, .. }) = continuous {
            options.progress_every_s = Some(hop_s);
            if let Some(detection) = &mut options.detection {
                detection.detector.longest_drag_s = f64::INFINITY;
            }
        }
        let thread = |name: &str| {
            let name = name.to_string();
            move |error| SessionError::Thread { name, error }
        };
        let waits = devices.iter().all(|device| device.waits());
        let worker = Worker::start(waits, continuous).map_err(thread("recognition"))?;
        let by_t_star = store.as_ref().map_or_else(Vec::new, |store| store.by_t_star.clone());
        let recording = store.map(RecordingThread::start).transpose();
        let recording = recording.map_err(thread("recording"))?;
        let mut run = Self {
            session: Session::start(devices, options)?,
            worker,
            recording,
            by_t_star,
            waits,
            load,
            naming: Err("no library is set".into()),
            loading: None,
            load_again: false,
            to_do: VecDeque::new(),
            in_hand: VecDeque::new(),
            kept: VecDeque::new(),
            orders: Orders::default(),
            lost_trials: 0,
            enrolling: None,
            quit_at: None,
            listeners,
        };
        keep.into_iter().for_each(|keep| run.orders.set_own(keep));
        run.emit(StationEvent::Streams(run.session.meters.to_vec()));
        run.report_order();
        match recogniser {
            Some(recogniser) => run.loaded(Ok(recogniser)),
            None if run.load.is_some() => run.reload(),
            None => {}
        }
        Ok(run)
    }

    fn emit(&mut self, event: StationEvent) {
        self.listeners.iter_mut().for_each(|listener| listener.on_event(&event));
    }

    fn warn(&mut self, kind: WarningKind, text: impl Into<String>) {
        self.emit(StationEvent::Warning(Warning::new(kind, text)));
    }

    /// Works until the session has ended and its scans are named, or until time is up.
    fn until_finished(&mut self, commands: &Receiver<Command>) {
        let mut finished = false;
        loop {
            let deadline = self.quit_at.map(|quit_at| quit_at + NAMED);
            match deadline.is_some_and(|deadline| deadline <= Instant::now()) {
                true => self.give_up_naming(),
                false => self.hand_on(),
            }
            let is_idle = self.to_do.is_empty() && self.in_hand.is_empty() && self.kept.is_empty();
            if finished && is_idle {
                return;
            }
            // A recording is paused until its scans are named; live devices cannot be paused.
            let reads = !finished && (!self.waits || self.to_do.is_empty());
            let events = if reads { self.session.events.clone() } else { never() };
            let done = self.worker.done.clone();
            let stored = self.recording.as_ref().map_or_else(never, |thread| thread.stored.clone());
            let loaded = self.loading.clone().unwrap_or_else(never);
            let deadline = deadline.filter(|_| !is_idle).map_or_else(never, at);
            select! {
                recv(events) -> event => match event {
                    // A channel closed without this event means a panic; `finish` reports it.
                    Ok(Event::Finished(_)) | Err(_) => finished = true,
                    Ok(event) => self.event(event),
                },
                recv(done) -> done => match done {
                    Ok(done) => self.done(done),
                    // Panics of methods are caught, so only a bug of the worker can close this channel.
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

    /// Waits until scans are written to disk, and reports the end.
    fn finish(mut self) -> Result<Totals, SessionError> {
        let until = self.quit_at.map(|quit_at| quit_at + WRITTEN);
        let written = self.recording.take().into_iter().flat_map(|thread| thread.finish(until));
        written.for_each(|stored| self.enrolled(&stored.enrolment, stored.enrolled));
        let Self { session, mut listeners, lost_trials, .. } = self;
        let totals = Totals { lost_trials, ..session.wait()? };
        let event = StationEvent::Finished(Arc::new(totals.clone()));
        listeners.iter_mut().for_each(|listener| listener.on_event(&event));
        Ok(totals)
    }

    fn event(&mut self, event: Event) {
        match event {
            Event::Scan(scan) => self.scan(scan),
            Event::Phase { scan, phase } => self.emit(StationEvent::Phase { scan, phase }),
            Event::Progress(progress) => self.progress(*progress),
            Event::Trace(trace) => self.emit(StationEvent::Trace(Arc::new(trace))),
            Event::Device { device, state, detail } => {
                self.emit(StationEvent::Device { device, state, detail });
            }
            Event::Warning(warning) => self.emit(StationEvent::Warning(warning)),
            // `until_finished` handles this event, so it does not come here.
            Event::Finished(_) => {}
        }
    }

    /// Reports whether a scan became a trial; of a kept one, once its nearest surface is known.
    fn stored(&mut self, stored: StoredScan) {
        if let Some(recording) = &mut self.recording {
            recording.settle(&stored.enrolled);
        }
        let StoredScan { enrolment, mut enrolled, kept } = stored;
        // If too many scans wait, the trial is reported without its nearest surface.
        match kept.filter(|_| self.waits || self.kept.len() < BACKLOG) {
            Some((scan, by)) => {
                enrolled.known = Some(by.library.trials_of(&enrolled.surface));
                self.to_do.push_back(Job::Nearest(scan, by));
                self.kept.push_back((enrolment, enrolled));
            }
            None => self.enrolled(&enrolment, enrolled),
        }
    }

    fn enrolled(&mut self, enrolment: &Enrolment, enrolled: Enrolled) {
        let enrolled = self.orders.count(enrolment, enrolled);
        let why = enrolled.doubts.last().map_or_else(String::new, Doubt::text);
        let what = match enrolled.outcome {
            EnrolledOutcome::Waiting => Some("could not be written and will be tried again"),
            EnrolledOutcome::Lost => Some("could not be written and is lost"),
            EnrolledOutcome::Kept | EnrolledOutcome::Refused => None,
        };
        self.lost_trials += u32::from(enrolled.outcome == EnrolledOutcome::Lost);
        let text = what.map(|what| format!("scan {} {what}: {why}", enrolled.scan));
        self.emit(StationEvent::Enrolled(enrolled));
        text.into_iter().for_each(|text| self.warn(WarningKind::TrialUnwritten, text));
        self.report_order();
    }

    fn report_order(&mut self) {
        let now = self.orders.in_force();
        if now != self.enrolling {
            self.enrolling.clone_from(&now);
            self.emit(StationEvent::Enrolling(now));
        }
    }

    fn obey(&mut self, command: Command) {
        match command {
            Command::Start => self.session.command(ScanCommand::Begin),
            Command::Stop => self.session.command(ScanCommand::End),
            Command::Enroll { .. } if self.recording.is_none() => {
                let text = "this scan cannot be kept: this station has no library; start it with --library LIB";
                self.warn(WarningKind::Ignored, text);
            }
            Command::Enroll { surface, user, trials, ordered_by } => {
                let trials = Some(trials);
                let keep = Keep { surface, user, trials, good_only: true, ordered_by };
                self.orders.give(keep, self.session.next_scan());
                self.report_order();
            }
            Command::KeepRefused(scan) => {
                match (self.orders.keep_refused(scan), &mut self.recording) {
                    (Some(enrolment), Some(recording)) => recording.keep_refused(scan, enrolment),
                    _ => {
                        let text = format!(
                            "scan {scan} was not kept: only the scan that was refused last can be; \
                             repeat it"
                        );
                        self.warn(WarningKind::Ignored, text);
                    }
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
                if self.quit_at.is_none() {
                    let now = Instant::now();
                    self.quit_at = Some(now);
                    self.emit(StationEvent::Ending(now + PASSED_ON));
                }
            }
        }
    }

    /// Uses the new library from now on, if it could be read.
    fn loaded(&mut self, loaded: LoadedRecogniser) {
        match loaded {
            Ok(recogniser) => {
                self.emit(StationEvent::Library(recogniser.library.clone()));
                self.naming = Ok(recogniser);
            }
            Err(problem) => {
                // The previous library stays in use, so the event names that library and the problem.
                let by = self.naming.as_ref().ok();
                let mut state = by.map_or_else(LibraryState::default, |by| by.library.clone());
                state.problem = Some(problem.clone());
                if let Err(why) = &mut self.naming {
                    why.clone_from(&problem);
                }
                self.emit(StationEvent::Library(state));
                self.warn(WarningKind::LibraryUnread, problem);
            }
        }
    }

    /// Whether the first library is still being read, so that scans wait to be named.
    fn awaits_library(&self) -> bool {
        self.naming.is_err() && self.loading.is_some()
    }

    /// Starts to read the library. Until it is read, the old one stays in use, or scans wait.
    fn reload(&mut self) {
        let Some(load) = self.load.clone() else {
            let text =
                "nothing was reloaded: this station has no library; start it with --library LIB";
            return self.warn(WarningKind::Ignored, text);
        };
        // Only one thread reads at a time, since each would need the memory of a whole library.
        if self.loading.is_some() {
            self.load_again = true;
            return;
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

    fn scan(&mut self, scan: Box<Scan>) {
        if let Some(recording) = &mut self.recording
            && let Some(enrolment) = self.orders.claim(scan.number)
        {
            recording.store(scan, enrolment, self.naming.clone().ok());
            return self.report_order();
        }
        self.to_do.push_back(Job::Scan(scan));
        self.limit_backlog();
    }

    /// Drops the oldest scan, and the progress before it, if too many scans wait.
    fn limit_backlog(&mut self) {
        let waiting = self.to_do.iter().filter(|job| matches!(job, Job::Scan(_))).count();
        if waiting <= BACKLOG || self.waits {
            return;
        }
        if let Some(at) = self.to_do.iter().position(|job| matches!(job, Job::Scan(_)))
            && let Some(Job::Scan(scan)) = self.to_do.remove(at)
        {
            self.to_do.retain(
                |job| !matches!(job, Job::Progress(progress) if progress.number == scan.number),
            );
            let from = scan.ended_at;
            let why = "too many scans were waiting".into();
            self.answered(unnamed(scan, Doubt::NotNamed { why }, from));
        }
    }

    /// Queues progress of a scan. It is joined to the newest job if that job is progress of this scan.
    fn progress(&mut self, progress: Progress) {
        match self.to_do.back_mut() {
            Some(Job::Progress(last)) if last.number == progress.number => last.append(progress),
            _ => self.to_do.push_back(Job::Progress(progress)),
        }
    }

    fn hand_on(&mut self) {
        while let Some(job) = self.to_do.pop_front() {
            if self.awaits_library() {
                return self.to_do.push_front(job);
            }
            let (trial, number) = match &job {
                Job::Progress(progress) => (self.sources_of_trial(progress.number), None),
                Job::Scan(scan) => (None, Some(scan.number)),
                Job::Nearest(..) => (None, None),
            };
            let work = Work { job, trial, by: self.naming.clone() };
            if let Err(back) = self.worker.work.try_send(work) {
                return self.to_do.push_front(back.into_inner().job);
            }
            self.in_hand.extend(number);
        }
    }

    /// The sources judged by T* if the scan with this number is to be a trial.
    fn sources_of_trial(&self, number: u32) -> Option<Vec<SourceId>> {
        let good_only = self.orders.covering(number)?.keep.good_only;
        Some(if good_only { self.by_t_star.clone() } else { Vec::new() })
    }

    fn done(&mut self, done: WorkerEvent) {
        match done {
            WorkerEvent::Scan(answered) => {
                self.in_hand.pop_front();
                self.answered(answered);
            }
            WorkerEvent::Progress(heard) => {
                let Heard { guess, change, ended } = *heard;
                ended.into_iter().for_each(|stretch| self.answered(stretch));
                change.into_iter().for_each(|one| self.emit(StationEvent::Change(one.into())));
                self.emit(StationEvent::Guess(guess));
            }
            WorkerEvent::Nearest(answer) => {
                if let Some((enrolment, mut enrolled)) = self.kept.pop_front() {
                    enrolled.known = enrolled.known.filter(|_| answer.is_some());
                    let (nearest, probability) =
                        answer.map_or((None, None), |answer| (answer.surface, answer.confidence));
                    let other = nearest.clone().filter(|nearest| *nearest != enrolled.surface);
                    enrolled.doubts.extend(other.map(|surface| Doubt::NearSurface { surface }));
                    self.enrolled(&enrolment, Enrolled { nearest, probability, ..enrolled });
                }
            }
        }
    }

    fn answered(&mut self, scan: AnsweredScan) {
        let answer = scan.answer.clone();
        self.emit(match answer.state {
            AnswerState::Unnamed => StationEvent::Unnamed(answer),
            _ => StationEvent::Answer(answer),
        });
        self.emit(StationEvent::Scan(Arc::new(scan)));
    }

    /// Reports all scans that are still unnamed when the time after [`Command::Quit`] is over.
    fn give_up_naming(&mut self) {
        // From now on, no results come from the worker, since all these scans are reported here.
        self.worker.done = never();
        let mut unnamed = std::mem::take(&mut self.in_hand);
        for job in self.to_do.drain(..) {
            if let Job::Scan(scan) = job {
                unnamed.push_back(scan.number);
            }
        }
        let busy = match self.awaits_library() {
            true => "the library was still being read",
            false => "time had run out",
        };
        for number in unnamed {
            let text = format!("scan {number} was not named: {busy} when the station was ended");
            self.warn(WarningKind::Unnamed, text);
        }
        for (enrolment, enrolled) in std::mem::take(&mut self.kept) {
            self.enrolled(&enrolment, enrolled);
        }
    }
}
