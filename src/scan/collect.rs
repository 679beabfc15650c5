//! The collector: one thread that empties the rings and cuts scans out of them at their marks.
//!
//! Each turn of its loop takes all that the rings hold, *then* reads the reports. A device reports
//! the begin of a source before it pushes the source's first frame, so the marks of all frames
//! taken are read in the same turn, before old frames are forgotten.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Select};

use super::event_queue::EventQueue;
use super::marked_scan::{Marked, cut};
use super::options::{Options, ScanCommand};
use super::progress::{self, SnapshotLengths};
use super::scan_detector::ScanDetector;
use super::stream::Stream;
use super::{Event, Totals};
use crate::device::{DeviceError, DeviceReport, DeviceReportKind, DeviceState, Mark};
use crate::ring::Stop;

/// The longest wait between two turns of the loop.
const TURN: Duration = Duration::from_millis(5);
/// Stands for the detector where a mark names the device that set it.
const DETECTOR: usize = usize::MAX;

pub(super) struct Collector {
    pub options: Options,
    pub streams: Vec<Stream>,
    pub reports: Receiver<DeviceReport>,
    pub woken: Receiver<()>,
    pub stop: Stop,
    pub event_queue: EventQueue,
    /// Names of the devices, and whether each has ended.
    pub devices: Vec<(String, bool)>,
    pub scans: VecDeque<Marked>,
    /// The number of scans that have begun, for other threads.
    pub begun: Arc<AtomicU32>,
    /// Sets marks if the devices set none.
    pub detector: Option<ScanDetector>,
    pub commands: Receiver<ScanCommand>,
}

impl Collector {
    pub fn run(mut self) -> Totals {
        let mut stop_seen: Option<Instant> = None;
        let mut next_trace = Instant::now();
        loop {
            // Read before the drain, which then takes all that the ended devices have pushed.
            let over = self.devices.iter().all(|(_, ended)| *ended);
            let looked = Instant::now();
            let mut moved = self.drain();
            while let Ok(report) = self.reports.try_recv() {
                moved = true;
                self.on_report(report);
            }
            self.detect(ScanDetector::update);
            while let Ok(command) = self.commands.try_recv() {
                self.command(command);
            }
            self.send_scans(looked, false);
            if let Some(every_s) = self.options.trace_every_s
                && looked >= next_trace
            {
                // Counted from when it was due, so that delays do not add up; a missed one is
                // skipped.
                let every = Duration::from_secs_f64(every_s.clamp(1e-3, 3600.0));
                next_trace = (next_trace + every).max(looked);
                self.send_trace();
            }
            self.forget();
            self.event_queue.flush();
            if over && self.reports.is_empty() {
                break;
            }
            if self.stop.requested() {
                let since = *stop_seen.get_or_insert_with(Instant::now);
                if since.elapsed() >= self.options.stop_limit {
                    break;
                }
            }
            if !moved {
                let mut select = Select::new();
                select.recv(&self.woken);
                select.recv(&self.reports);
                let _ = select.ready_timeout(TURN);
                let _ = self.woken.try_recv();
            }
        }
        self.finish()
    }

    fn drain(&mut self) -> bool {
        let longest_s = self.options.longest_scan_s + self.options.deliver_limit.as_secs_f64();
        let mut any = false;
        for stream in &mut self.streams {
            any |= stream.drain(longest_s);
        }
        any
    }

    fn on_report(&mut self, DeviceReport { device, kind }: DeviceReport) {
        let name = self.devices[device].0.clone();
        match kind {
            DeviceReportKind::Warning(text) => self.event_queue.warn(format!("{name}: {text}")),
            DeviceReportKind::State { state, detail } => {
                self.event_queue.push(Event::Device { device: name, state, detail });
            }
            DeviceReportKind::Rate(rate_hz) => {
                let own = self.streams.iter_mut().filter(|stream| stream.device == device);
                own.for_each(|stream| stream.set_rate_hz(rate_hz));
                if let Some(detector) = &mut self.detector {
                    detector.follow_rates(&self.streams, device);
                }
            }
            DeviceReportKind::Mark(mark) => self.mark(device, &name, mark),
            DeviceReportKind::Ended(result) => {
                self.devices[device].1 = true;
                self.abandon(|scan| scan.device == device, "its device ended");
                if let Err(DeviceError::Failed(problem)) = result {
                    self.event_queue.totals.failed.push((name.clone(), problem.clone()));
                    let state = DeviceState::Lost;
                    self.event_queue.push(Event::Device { device: name, state, detail: problem });
                }
            }
        }
    }

    /// Applies a mark that the device number `device` has set; `name` is its name in warnings.
    fn mark(&mut self, device: usize, name: &str, mark: Mark) {
        match mark {
            Mark::Begin(begin) => {
                self.abandon(|_| true, "another scan began before it ended");
                let number = self.begun.fetch_add(1, Ordering::AcqRel) + 1;
                return self.scans.push_back(Marked::new(number, device, begin));
            }
            Mark::GiveUp { why } => return self.abandon(|_| true, &why),
            _ => {}
        }
        let Some(scan) = self.scans.back_mut().filter(|scan| scan.ended.is_none()) else {
            return self.event_queue.warn(format!("{name}: a mark outside of any scan"));
        };
        let number = scan.number;
        let part = match &mark {
            Mark::Open(open) => Some(open.phase).filter(|phase| scan.phase < Some(*phase)),
            _ => None,
        };
        let over = matches!(mark, Mark::End { .. });
        if let Err(problem) = scan.follow(mark, &self.streams) {
            return self.event_queue.warn(format!("{name}: scan {number}: {problem}"));
        }
        if over || part.is_some() {
            scan.phase = part.or(scan.phase);
            self.event_queue.push(Event::Phase { scan: number, phase: part });
        }
    }

    fn command(&mut self, command: ScanCommand) {
        match &mut self.detector {
            Some(detector) => {
                let marks = detector.command(command, &self.streams);
                marks.into_iter().for_each(|mark| self.mark(DETECTOR, "the command", mark));
            }
            None => self.event_queue.warn(
                "the command was ignored: a recording sets the begin and end of its scans".into(),
            ),
        }
    }

    /// Applies the marks, and passes on the warnings, of one `step` of the detector, if any.
    fn detect(&mut self, step: impl Fn(&mut ScanDetector, &[Stream]) -> Vec<Mark>) {
        let Some(detector) = &mut self.detector else { return };
        let (marks, warnings) = (step(detector, &self.streams), detector.take_warnings());
        marks.into_iter().for_each(|mark| self.mark(DETECTOR, "the detector", mark));
        warnings.into_iter().for_each(|text| self.event_queue.warn(text));
    }

    /// Gives up the scan in progress, if `of` holds for it.
    fn abandon(&mut self, of: impl Fn(&Marked) -> bool, why: &str) {
        if let Some(scan) = self.scans.back().filter(|scan| scan.ended.is_none() && of(scan)) {
            let number = scan.number;
            self.scans.pop_back();
            self.event_queue.warn(format!("scan {number} was cut off: {why}"));
            self.event_queue.push(Event::Phase { scan: number, phase: None });
        }
    }

    /// Sends the first scan's progress and, once it is complete, the scan; then the next one.
    ///
    /// A scan with missing data is sent without them if the turn began, at `looked`, too long after
    /// the scan's end became known (its begin counts, since sending may wait for a slow reader), or
    /// if the session is `over`.
    fn send_scans(&mut self, looked: Instant, over: bool) {
        while let Some(mut scan) = self.scans.pop_front() {
            self.send_progress(&mut scan);
            let overdue = |(_, learnt): (Instant, Instant)| {
                over || looked.saturating_duration_since(learnt) > self.options.deliver_limit
            };
            if !(scan.complete(&self.streams) || scan.ended.is_some_and(overdue)) {
                return self.scans.push_front(scan);
            }
            if let Some(scan) = cut(scan, &self.streams) {
                self.event_queue.push(Event::Scan(Box::new(scan)));
            }
        }
    }

    fn send_progress(&mut self, scan: &mut Marked) {
        let Some(every_s) = self.options.progress_every_s else { return };
        let exact = self.event_queue.waits;
        while let Some((step, snapshot)) = progress::next(scan, &self.streams, every_s, exact) {
            let lengths = SnapshotLengths::of(&snapshot);
            if !self.event_queue.offer(Event::Progress(snapshot)) {
                return;
            }
            progress::sent(scan, step, &lengths);
        }
    }

    fn send_trace(&mut self) {
        let (ends, trace) = progress::trace(&self.streams);
        let anything = !(trace.fresh.is_empty() && trace.images.is_empty());
        if anything && self.event_queue.offer(Event::Trace(trace)) {
            for (stream, end) in self.streams.iter_mut().zip(ends) {
                stream.traced = end;
            }
        }
    }

    fn forget(&mut self) {
        // So that a scan of the longest duration is still whole when its last data arrive.
        let kept_s = self.options.longest_scan_s + self.options.deliver_limit.as_secs_f64();
        for (index, stream) in self.streams.iter_mut().enumerate() {
            let cuts = self.scans.iter().flat_map(|scan| scan.cuts.values());
            let needed = cuts
                .filter(|cut| cut.stream == index)
                .map(|cut| (cut.start, cut.rate_hz))
                .min_by_key(|(start, _)| *start);
            stream.forget(needed, self.options.lookback_s, kept_s);
        }
    }

    fn finish(mut self) -> Totals {
        self.drain();
        self.detect(ScanDetector::update);
        self.detect(ScanDetector::finish);
        self.abandon(|_| true, "the session ended");
        // Does not wait for the rest, which a device that hangs never delivers.
        self.drain();
        self.send_scans(Instant::now(), true);
        for (name, ended) in self.devices.clone() {
            if !ended {
                self.event_queue.warn(format!("{name} did not stop in time and was abandoned"));
                self.event_queue.totals.abandoned.push(name);
            }
        }
        let counts = |stream: &Stream| (stream.id().clone(), stream.meter().counts());
        self.event_queue.totals.streams = self.streams.iter().map(counts).collect();
        self.event_queue.finish()
    }
}
