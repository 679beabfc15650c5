//! Scans on their way to a name: what waits, what the worker has in hand, and what comes of it.

use crossbeam_channel::never;

use super::{Naming, StationRun};
use crate::scan::{Progress, Scan};
use crate::station::event::{Enrolled, StationEvent};
use crate::station::orders::Enrolment;
use crate::station::trial_need::Purpose;
use crate::station::worker::{Job, ScanAnswer, Work, WorkerEvent};

/// Scans that wait to be named, where their devices cannot wait: a quarter of an hour's.
const BACKLOG: usize = 64;

/// What is known of a job without doing it.
pub(super) enum InHand {
    /// A scan of this number is to be named.
    Scan(u32),
    Progress,
    /// This is reported once it is known what surface the scan is most like, or without that.
    Kept(Box<(Enrolment, Enrolled)>),
}

impl InHand {
    fn of(job: &Job) -> Self {
        match job {
            Job::Scan(scan) => Self::Scan(scan.number),
            Job::Progress(_) => Self::Progress,
            Job::Kept(kept) => {
                Self::Kept(Box::new((kept.enrolment.clone(), kept.enrolled.clone())))
            }
        }
    }
}

impl StationRun<'_> {
    pub fn scan(&mut self, scan: Box<Scan>) {
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

    /// Lets the oldest scan go, and the progress before it, where too many wait.
    fn limit_backlog(&mut self) {
        let waiting = self.pending.iter().filter(|job| !matches!(job, Job::Progress(_))).count();
        if waiting <= BACKLOG || self.waits {
            return;
        }
        while let Some(job) = self.pending.pop_front() {
            match job {
                Job::Progress(_) => {}
                Job::Kept(kept) => return self.enrolled(&kept.enrolment, kept.enrolled),
                Job::Scan(scan) => return self.unnamed(scan, "too many wait for it"),
            }
        }
    }

    /// Adds news of a scan. What the worker has no time for becomes one piece of news.
    pub fn progress(&mut self, progress: Progress) {
        match self.pending.back_mut() {
            Some(Job::Progress(last)) if last.number == progress.number => last.append(progress),
            _ => self.pending.push_back(Job::Progress(progress)),
        }
    }

    /// Hands work to the worker, as far as it takes it.
    pub fn hand_on(&mut self) {
        while let Some(job) = self.pending.pop_front() {
            let by = match &self.naming {
                Naming::Loading => return self.pending.push_front(job),
                Naming::Ready(by) => Ok(by.clone()),
                Naming::None(why) => Err(why.clone()),
            };
            let in_hand = InHand::of(&job);
            let work = match (job, by) {
                (Job::Scan(scan), Ok(by)) => Work::Scan(scan, by),
                (Job::Scan(scan), Err(why)) => {
                    self.unnamed(scan, &why);
                    continue;
                }
                (Job::Progress(progress), by) => {
                    let purpose = self.purpose(progress.number);
                    Work::Progress(progress, purpose, by.ok())
                }
                (Job::Kept(kept), _) => Work::Kept(kept),
            };
            if let Err(back) = self.worker.work.try_send(work) {
                return self.pending.push_front(back.into_inner().into_job());
            }
            self.in_hand.push_back(in_hand);
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
    pub fn done(&mut self, done: WorkerEvent) {
        let job = self.in_hand.pop_front();
        match done {
            WorkerEvent::Answered(answered) => self.answered(answered),
            WorkerEvent::Guess(guess) => self.emit(StationEvent::Guess(guess)),
            WorkerEvent::Nearest(nearest) => {
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

    /// Reports that a scan was not named, and why.
    fn unnamed(&mut self, scan: Box<Scan>, why: &str) {
        let latency_ms = scan.ended_at.elapsed().as_secs_f64() * 1e3;
        self.answered(ScanAnswer::unnamed(scan, why, latency_ms, false));
    }

    /// Reports scans that will not be named, since the end does not wait for them any longer.
    pub fn give_up_naming(&mut self) {
        // What it has in hand comes too late from now on.
        self.worker.done = never();
        let pending: Vec<InHand> = self.pending.drain(..).map(|job| InHand::of(&job)).collect();
        let in_hand: Vec<InHand> = self.in_hand.drain(..).collect();
        let busy = match &self.naming {
            Naming::Loading => "the library was still being read",
            _ => "there was no time for it",
        };
        for job in in_hand.into_iter().chain(pending) {
            match job {
                InHand::Scan(number) => self.warn(format!(
                    "scan {number} was not named: {busy} when the station was ended"
                )),
                InHand::Kept(kept) => self.enrolled(&kept.0, kept.1),
                InHand::Progress => {}
            }
        }
    }
}
