//! Sets marks around taps and drags in streams without marks, over one span of time in all sources.
//!
//! Streams of one device share one sample counter and form a [`Group`] with a detector of its own.
//! The first group with data leads, so only its detections make marks. The [`Timeline`] converts
//! the times of detections to indexes of the other streams. A tap that two devices sensed gives the
//! constant offset between them, since arrival times cannot show this offset.

use std::time::{Duration, Instant};

use super::clock::{Clock, ClockSecond};
use super::detect::{DetectorEvent, HOP_S, onset_in};
use super::group::Group;
use super::stream::{Stream, StreamBuffer};
use super::{CutFrom, Detection, ScanCommand};
use crate::device::{Begin, Mark, Open};
use crate::scene::Phase;

/// The largest offset between two devices that a tap may give, in seconds.
const LARGEST_OFFSET_S: f64 = 0.3;
/// In seconds, as in LMT108, a tap's source begins this long before the onset and lasts `TAP_S`.
const BEFORE_TAP_S: f64 = 0.02;
const TAP_S: f64 = 10_501.0 / 44_100.0;

/// A detected drag of group number `lead`; its times are hops of this group.
struct Contact {
    lead: usize,
    tap: Option<(u64, u64)>,
    start: u64,
}

struct PlacedCut {
    cut: CutFrom,
    stream: usize,
}

struct Running {
    /// The group that ends the scan when its drag ends; `None` if only a command ends the scan.
    lead: Option<usize>,
    begun_s: f64,
    /// The sources opened for the scan's drag, as indexes into `cuts`.
    opened: Vec<usize>,
}

pub(super) struct ScanDetector {
    timeline: Timeline,
    groups: Vec<Group>,
    cuts: Vec<PlacedCut>,
    onset: f64,
    longest_scan_s: f64,
    scan: Option<Running>,
    /// Marks and warnings that the collector has not taken yet.
    pub marks: Vec<Mark>,
    pub warnings: Vec<String>,
}

impl ScanDetector {
    /// A detector for these streams; it ignores parts of `detection` that name other streams. No
    /// scan lasts longer than `longest_scan_s` seconds.
    pub fn new(detection: Detection, streams: &[Stream], longest_scan_s: f64) -> Self {
        let Detection { detector, groups, cuts } = detection;
        let place = |cut: CutFrom| {
            let stream = streams.iter().position(|stream| stream.id == cut.stream)?;
            Some(PlacedCut { cut, stream })
        };
        let group = |channels: &Vec<_>| Group::new(channels, detector, streams);
        Self {
            timeline: Timeline::new(streams),
            groups: groups.iter().filter_map(group).collect(),
            cuts: cuts.into_iter().filter_map(place).collect(),
            onset: detector.onset,
            longest_scan_s,
            scan: None,
            marks: Vec::new(),
            warnings: Vec::new(),
        }
    }

    /// Takes over the new rates of a device's streams. Called before the first frame of these streams.
    pub fn follow_rates(&mut self, streams: &[Stream], device: usize) {
        self.timeline.follow_rates(streams, device);
        let of = |group: &&mut Group| streams[group.channels[0].0].device == device;
        self.groups.iter_mut().filter(of).for_each(|group| group.follow_rate(streams));
    }

    /// Detects taps and drags in the frames that have come out of the rings, and sets marks.
    pub fn update(&mut self, streams: &[Stream]) {
        let now_s = self.timeline.observe(streams);
        for at in 0..self.groups.len() {
            let (group, timeline) = (&mut self.groups[at], &self.timeline);
            let mut events = group.update(streams, |stream| timeline.alive(stream, now_s));
            if group.channels.iter().all(|(stream, _)| timeline.gone(*stream, now_s)) {
                let last = group.detector.finish();
                let cut_off = last.is_some_and(|last| group.cut_off(last));
                if cut_off && self.leads(at) {
                    let why = "its data stopped before it was over";
                    self.marks.push(Mark::Spoil { why: why.into() });
                }
                events.extend(last);
            }
            for event in events {
                self.on_detection(at, event, streams, now_s);
            }
        }
        if self.scan.as_ref().is_some_and(|scan| now_s - scan.begun_s >= self.longest_scan_s) {
            let longest_s = self.longest_scan_s;
            let text = format!("a scan was ended after {longest_s} s, the longest allowed");
            self.warnings.push(text);
            self.end_now(streams, now_s);
        }
    }

    pub fn command(&mut self, command: ScanCommand, streams: &[Stream]) {
        let now_s = self.timeline.now_s();
        match (command, &mut self.scan) {
            (ScanCommand::Begin, Some(scan)) => scan.lead = None,
            (ScanCommand::Begin, None) => self.begin(None, streams, now_s),
            (ScanCommand::End, None) => {}
            (ScanCommand::End, Some(_)) => self.end_now(streams, now_s),
        }
    }

    /// Ends the scan in progress. Called when no more data will come.
    pub fn finish(&mut self, streams: &[Stream]) {
        let now_s = self.timeline.now_s();
        match self.scan.as_ref().map(|scan| scan.lead) {
            None => return,
            Some(None) => self.end_now(streams, now_s),
            Some(Some(at)) => {
                if let Some(event) = self.groups[at].detector.finish() {
                    self.on_detection(at, event, streams, now_s);
                }
            }
        }
        // No more data will come, so frames that have not arrived were never sampled. A cut
        // therefore ends where its stream ends, and frames after that do not count as lost.
        for mark in &mut self.marks {
            let Mark::Close { source, end } = mark else { continue };
            let placed = self.cuts.iter().find(|placed| placed.cut.source == *source);
            *end = placed.map_or(*end, |placed| streams[placed.stream].end().min(*end));
        }
    }

    fn leads(&self, group: usize) -> bool {
        self.scan.as_ref().is_some_and(|scan| scan.lead == Some(group))
    }

    fn on_detection(&mut self, at: usize, event: DetectorEvent, streams: &[Stream], now_s: f64) {
        match event {
            DetectorEvent::Drag { tap, start } => {
                let alive = |group: &Group| {
                    group.channels.iter().any(|(stream, _)| self.timeline.alive(*stream, now_s))
                };
                if self.scan.is_some() || self.groups[..at].iter().any(alive) {
                    return;
                }
                if let Some((onset, _)) = tap {
                    self.align(at, onset);
                }
                self.begin(Some(Contact { lead: at, tap, start }), streams, now_s);
            }
            DetectorEvent::End { end } if self.leads(at) => {
                let ended_s = self.time_s(at, end).unwrap_or(now_s).clamp(0.0, now_s);
                self.end(streams, ended_s, |this, stream| this.index(at, end, stream, streams));
            }
            DetectorEvent::NoiseTimeout if self.leads(at) => {
                self.scan = None;
                let why = "contact never ended, so it was noise and not a drag";
                self.marks.push(Mark::GiveUp { why: why.into() });
            }
            DetectorEvent::End { .. } | DetectorEvent::NoiseTimeout => {}
        }
    }

    /// Begins the scan of a detected `contact`; if it is `None`, a scan whose drag begins now.
    fn begin(&mut self, contact: Option<Contact>, streams: &[Stream], now_s: f64) {
        self.marks.push(Mark::Begin(Begin::default()));
        self.mark_images(streams);
        let (mut opened, mut marks) = (Vec::new(), Vec::new());
        for (number, placed) in self.cuts.iter().enumerate() {
            let at = placed.stream;
            if !self.timeline.alive(at, now_s) {
                continue;
            }
            let rate_hz = streams[at].rate_hz;
            let index = |contact: &Contact, hop| self.index(contact.lead, hop, at, streams);
            match (placed.cut.phase, &contact) {
                (Phase::Tap, Some(contact @ Contact { tap: Some((onset, _)), start, .. })) => {
                    if let (Some(begin), Some(drag)) =
                        (index(contact, *onset), index(contact, *start))
                    {
                        let frames = |seconds: f64| (seconds * rate_hz).round() as u64;
                        let begin = begin.saturating_sub(frames(BEFORE_TAP_S));
                        let end = (begin + frames(TAP_S)).min(drag).max(begin);
                        marks.push(placed.open(begin, rate_hz));
                        marks.push(Mark::Close { source: placed.cut.source.clone(), end });
                    }
                }
                (Phase::Drag, Some(contact)) => {
                    if let Some(begin) = index(contact, contact.start) {
                        marks.push(placed.open(begin, rate_hz));
                        opened.push(number);
                    }
                }
                (Phase::Drag, None) => {
                    marks.push(placed.open(self.timeline.index_now(at, now_s), rate_hz));
                    opened.push(number);
                }
                _ => {}
            }
        }
        self.marks.extend(marks);
        let lead = contact.map(|contact| contact.lead);
        self.scan = Some(Running { lead, begun_s: now_s, opened });
    }

    fn end_now(&mut self, streams: &[Stream], now_s: f64) {
        self.end(streams, now_s, |this, stream| Some(this.timeline.index_now(stream, now_s)));
    }

    /// Ends the scan in progress; `end_of` gives the index of this end in a stream.
    fn end(
        &mut self,
        streams: &[Stream],
        ended_s: f64,
        end_of: impl Fn(&Self, usize) -> Option<u64>,
    ) {
        let opened = self.scan.take().map(|scan| scan.opened).unwrap_or_default();
        for placed in opened.into_iter().map(|cut| &self.cuts[cut]) {
            let source = placed.cut.source.clone();
            let end = end_of(self, placed.stream);
            self.marks.extend(end.map(|end| Mark::Close { source, end }));
        }
        self.mark_images(streams);
        self.marks.push(Mark::End { at: self.timeline.instant(ended_s) });
    }

    /// Marks the latest picture of each camera, however old. Called when a scan begins and again
    /// when it ends, since pictures with flash are taken during the drag.
    fn mark_images(&mut self, streams: &[Stream]) {
        for placed in &self.cuts {
            if let StreamBuffer::Images { recent, .. } = &streams[placed.stream].buffer
                && let Some((latest, _)) = recent.back()
            {
                let source = placed.cut.source.clone();
                self.marks.push(placed.open(*latest, 1.0));
                self.marks.push(Mark::Close { source, end: latest + 1 });
            }
        }
    }

    fn time_s(&self, group: usize, hop: u64) -> Option<f64> {
        let group = &self.groups[group];
        self.timeline.clock(group.channels[0].0).time_s(group.frame(hop))
    }

    /// Measures the offsets of the other groups by the tap that began at hop `onset` of group `lead`.
    fn align(&mut self, lead: usize, onset: u64) {
        let Some(tap_s) = self.time_s(lead, onset) else { return };
        self.groups[lead].offset_s = 0.0;
        let reach = (LARGEST_OFFSET_S / HOP_S) as u64;
        for at in (0..self.groups.len()).filter(|at| *at != lead) {
            let group = &mut self.groups[at];
            let clock = self.timeline.clock(group.channels[0].0);
            let Some(frame) = clock.index_at(tap_s) else { continue };
            let hop = group.hop(frame);
            let window = hop.saturating_sub(reach)..hop + reach;
            let levels = group.levels.make_contiguous();
            if let Some(seen) = onset_in(levels, group.first, window, self.onset) {
                group.offset_s = (seen as f64 - hop as f64) * HOP_S;
            }
        }
    }

    /// Index of the frame in stream number `at` that was sampled when hop `hop` of group `lead` began.
    fn index(&self, lead: usize, hop: u64, at: usize, streams: &[Stream]) -> Option<u64> {
        let group = &self.groups[lead];
        let leading = &streams[group.channels[0].0];
        if streams[at].device == leading.device && streams[at].rate_hz == leading.rate_hz {
            return Some(group.frame(hop));
        }
        let offset_s = (self.groups.iter())
            .find(|group| group.channels.iter().any(|(stream, _)| *stream == at))
            .map_or(0.0, |group| group.offset_s);
        self.timeline.clock(at).index_at(self.time_s(lead, hop)? + offset_s)
    }
}

impl PlacedCut {
    fn open(&self, start: u64, rate_hz: f64) -> Mark {
        Mark::Open(Open { cut: self.cut.clone(), start, rate_hz })
    }
}

/// A stream that has delivered nothing for this long takes no part in detection.
const SILENT_S: ClockSecond = 0.5;
/// A drag is over if its streams have delivered nothing for this long. The time is longer than any
/// machine suspends a driver.
const GONE_S: ClockSecond = 3.0;

/// Times at which the frames of all streams were sampled, on the one time base of a session. Each
/// stream has one clock, in the order of the streams.
struct Timeline {
    begin: Instant,
    streams: Vec<Arrivals>,
}

struct Arrivals {
    clock: Clock,
    /// `end` is the index after the last frame; `at_s` is the time when that frame arrived.
    end: u64,
    at_s: ClockSecond,
}

impl Timeline {
    fn new(streams: &[Stream]) -> Self {
        let arrivals = |stream: &Stream| Arrivals {
            clock: Clock::new(stream.rate_hz),
            end: 0,
            at_s: f64::NEG_INFINITY,
        };
        Self { begin: Instant::now(), streams: streams.iter().map(arrivals).collect() }
    }

    /// Notes which frames have arrived, and returns the present time.
    fn observe(&mut self, streams: &[Stream]) -> ClockSecond {
        let now_s = self.now_s();
        for (stream, known) in streams.iter().zip(&mut self.streams) {
            if stream.end() > known.end {
                (known.end, known.at_s) = (stream.end(), now_s);
                known.clock.observe(stream.end(), now_s);
            }
        }
        now_s
    }

    /// Takes over the new rates of a device's streams. Called before the first frame of these streams.
    fn follow_rates(&mut self, streams: &[Stream], device: usize) {
        let pairs = streams.iter().zip(&mut self.streams);
        for (stream, known) in pairs.filter(|(stream, _)| stream.device == device) {
            known.clock = Clock::new(stream.rate_hz);
        }
    }

    fn now_s(&self) -> ClockSecond {
        self.begin.elapsed().as_secs_f64()
    }

    fn instant(&self, at_s: ClockSecond) -> Instant {
        self.begin + Duration::from_secs_f64(at_s)
    }

    fn alive(&self, stream: usize, now_s: ClockSecond) -> bool {
        now_s - self.streams[stream].at_s <= SILENT_S
    }

    /// Whether a stream's data have been missing long enough to end its drag.
    fn gone(&self, stream: usize, now_s: ClockSecond) -> bool {
        now_s - self.streams[stream].at_s > GONE_S
    }

    fn clock(&self, stream: usize) -> &Clock {
        &self.streams[stream].clock
    }

    /// Index of the frame that is sampled now; if the stream is silent, the index of its next frame.
    fn index_now(&self, stream: usize, now_s: ClockSecond) -> u64 {
        let by_clock = self.clock(stream).index_at(now_s).filter(|_| self.alive(stream, now_s));
        by_clock.unwrap_or(self.streams[stream].end)
    }
}
