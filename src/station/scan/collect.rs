//! The collector is a thread that empties the rings and cuts scans out of the streams at their marks.
//!
//! Each turn of its loop first takes all frames from the rings and *then* reads the reports. A
//! device reports the begin of a source before it pushes the source's first frame. So the marks of
//! all frames taken are read in the same turn, before old frames are forgotten.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Select};

use super::event_queue::EventQueue;
use super::marked_scan::{Marked, cut, next_snapshot, trace};
use super::recent_frames::Stream;
use super::scan_detector::ScanDetector;
use super::{Event, Options, ScanCommand, Totals};
use crate::device::{
    DeviceError, DeviceReport, DeviceReportKind, DeviceState, Mark, Warning, WarningKind,
};
use crate::ring::Stop;

const TURN: Duration = Duration::from_millis(5);
/// Seconds of each stream that are kept, so that marks can refer to past frames.
const LOOKBACK_S: f64 = 5.0;
/// The device number of marks that the detector sets.
const DETECTOR: usize = usize::MAX;

pub(super) struct Collector {
    pub options: Options,
    pub streams: Vec<Stream>,
    pub reports: Receiver<DeviceReport>,
    pub woken: Receiver<()>,
    pub stop: Stop,
    pub event_queue: EventQueue,
    /// For each device, its name and whether the device has ended.
    pub devices: Vec<(String, bool)>,
    pub scans: VecDeque<Marked>,
    /// The number of scans that have begun, for other threads.
    pub begun: Arc<AtomicU32>,
    /// Sets the marks of scans; `None` if the devices set them.
    pub detector: Option<ScanDetector>,
    pub commands: Receiver<ScanCommand>,
}

impl Drop for Collector {
    /// Stops the devices however the collector ends, since devices would wait for it for ever.
    fn drop(&mut self) {
        self.stop.request();
    }
}

impl Collector {
    pub(super) fn run(mut self) -> Totals {
        let mut stop_seen: Option<Instant> = None;
        let mut next_trace = Instant::now();
        loop {
            // Checked before `drain`, so that `drain` takes all data of devices that have ended by now.
            let over = self.devices.iter().all(|(_, ended)| *ended);
            let looked = Instant::now();
            let mut moved = self.drain();
            while let Ok(report) = self.reports.try_recv() {
                moved = true;
                self.on_report(report);
            }
            self.detect("the detector", ScanDetector::update);
            while let Ok(command) = self.commands.try_recv() {
                self.command(command);
            }
            self.send_scans(looked, false);
            if let Some(every_s) = self.options.trace_every_s
                && looked >= next_trace
            {
                // The next trace is due one period after this one was due, so that delays do not
                // add up. Missed traces are skipped.
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
            DeviceReportKind::Warning(Warning { kind, text }) => {
                self.event_queue.warn(kind, format!("{name}: {text}"));
            }
            DeviceReportKind::State { state, detail } => {
                self.event_queue.push(Event::Device { device: name, state, detail });
            }
            DeviceReportKind::Rate(rate_hz) => {
                let own = self.streams.iter_mut().filter(|stream| stream.device == device);
                let series = own.filter(|stream| stream.rate_hz > 0.0);
                series.for_each(|stream| stream.set_rate(rate_hz));
            }
            DeviceReportKind::OffPace(seen_hz) => {
                let own = self.streams.iter_mut().filter(|stream| stream.device == device);
                own.for_each(|stream| stream.off_pace_hz = seen_hz);
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

    /// Applies a mark that device number `device` has set; warnings call the device `name`.
    fn mark(&mut self, device: usize, name: &str, mark: Mark) {
        match mark {
            Mark::Begin(begin) => {
                self.abandon(|_| true, "another scan began before it ended");
                let number = self.begun.fetch_add(1, Ordering::AcqRel) + 1;
                let scan = Marked { number, device, begin, ..Marked::default() };
                return self.scans.push_back(scan);
            }
            Mark::GiveUp { why } => return self.abandon(|_| true, &why),
            _ => {}
        }
        let Some(scan) = self.scans.back_mut().filter(|scan| scan.ended.is_none()) else {
            let text = format!("{name}: a mark outside of any scan");
            return self.event_queue.warn(WarningKind::ScanMark, text);
        };
        let number = scan.number;
        let part = match &mark {
            Mark::Open(open) => Some(open.cut.phase).filter(|phase| scan.phase < Some(*phase)),
            _ => None,
        };
        let over = matches!(mark, Mark::End { .. });
        if let Err(problem) = scan.follow(mark, &self.streams) {
            let text = format!("{name}: scan {number}: {problem}");
            return self.event_queue.warn(WarningKind::ScanMark, text);
        }
        if over || part.is_some() {
            scan.phase = part.or(scan.phase);
            self.event_queue.push(Event::Phase { scan: number, phase: part });
        }
    }

    fn command(&mut self, command: ScanCommand) {
        if self.detector.is_none() {
            let why = "the command was ignored: a recording sets the begin and end of its scans";
            self.event_queue.warn(WarningKind::Ignored, why);
        }
        self.detect("the command", |detector, streams| detector.command(command, streams));
    }

    /// Runs one `step` of the detector, if there is one; applies its marks and passes on its
    /// warnings. Warnings about a mark say that it was set by `who`.
    fn detect(&mut self, who: &str, step: impl Fn(&mut ScanDetector, &mut [Stream])) {
        let Some(detector) = &mut self.detector else { return };
        step(detector, &mut self.streams);
        let marks = std::mem::take(&mut detector.marks);
        let warnings = std::mem::take(&mut detector.warnings);
        marks.into_iter().for_each(|mark| self.mark(DETECTOR, who, mark));
        warnings.into_iter().for_each(|warning| self.event_queue.push(Event::Warning(warning)));
    }

    /// Gives up the scan in progress if `of` is true for it.
    fn abandon(&mut self, of: impl Fn(&Marked) -> bool, why: &str) {
        if let Some(scan) = self.scans.back().filter(|scan| scan.ended.is_none() && of(scan)) {
            let number = scan.number;
            self.scans.pop_back();
            let text = format!("scan {number} was cut off: {why}");
            self.event_queue.warn(WarningKind::ScanCut, text);
            self.event_queue.push(Event::Phase { scan: number, phase: None });
        }
    }

    /// Sends the progress of the first scan. Once that scan is complete, sends it and turns to the
    /// next.
    ///
    /// A scan with missing data is sent as it is if the session is `over`, or if its end had been
    /// known for longer than the limit when this turn began, at `looked`. The limit is checked
    /// against the begin of the turn, since sending may wait for a slow reader.
    fn send_scans(&mut self, looked: Instant, over: bool) {
        while let Some(mut scan) = self.scans.pop_front() {
            self.send_progress(&mut scan);
            let is_due = |(_, learnt): (Instant, Instant)| {
                let is_late = looked.saturating_duration_since(learnt) > self.options.deliver_limit;
                over || is_late || scan.cuts.values().all(|cut| cut.delivered(&self.streams))
            };
            if !scan.ended.is_some_and(is_due) {
                return self.scans.push_front(scan);
            }
            if let Some(scan) = cut(scan, &self.streams) {
                self.event_queue.push(Event::Scan(Box::new(scan)));
            }
        }
    }

    fn send_progress(&mut self, scan: &mut Marked) {
        let Some(every_s) = self.options.progress_every_s else { return };
        if scan.ended.is_none() && self.detector.as_ref().is_some_and(ScanDetector::may_rest) {
            return;
        }
        let exact = self.event_queue.waits;
        while let Some((step, sent, snapshot)) = next_snapshot(scan, &self.streams, every_s, exact)
        {
            if !self.event_queue.offer(Event::Progress(Box::new(snapshot))) {
                return;
            }
            scan.steps = step;
            scan.cuts.values_mut().zip(sent).for_each(|(cut, sent)| cut.sent = sent);
        }
    }

    fn send_trace(&mut self) {
        let trace = trace(&self.streams);
        let anything = !(trace.fresh.is_empty() && trace.images.is_empty());
        if anything && self.event_queue.offer(Event::Trace(trace)) {
            self.streams.iter_mut().for_each(|stream| stream.traced = stream.end());
        }
    }

    fn forget(&mut self) {
        // Data are kept so long that the longest scan is still whole when its last data arrive.
        let kept_s = self.options.longest_scan_s + self.options.deliver_limit.as_secs_f64();
        for (index, stream) in self.streams.iter_mut().enumerate() {
            let cuts = self.scans.iter().flat_map(|scan| scan.cuts.values());
            let needed = cuts
                .filter(|cut| cut.stream == index)
                .map(|cut| (cut.start, cut.rate_hz))
                .min_by_key(|(start, _)| *start);
            stream.forget(needed, LOOKBACK_S, kept_s);
        }
    }

    fn finish(mut self) -> Totals {
        self.drain();
        self.detect("the detector", ScanDetector::update);
        let stopped = self.stop.requested();
        self.detect("the detector", |detector, streams| detector.finish(streams, stopped));
        self.abandon(|_| true, "the session ended");
        // Sends incomplete scans as they are, since a device that hangs never delivers the rest.
        self.drain();
        self.send_scans(Instant::now(), true);
        for (name, ended) in self.devices.clone() {
            if !ended {
                let text = format!("{name} did not stop in time and was abandoned");
                self.event_queue.warn(WarningKind::Abandoned, text);
                self.event_queue.totals.abandoned.push(name);
            }
        }
        let counts = |stream: &Stream| (stream.id.clone(), stream.meter().counts());
        self.event_queue.totals.streams = self.streams.iter().map(counts).collect();
        self.event_queue.finish()
    }
}
