//! Sets marks in streams that carry none, around taps and drags: one span of time in all sources.
//!
//! Streams of one device share one sample counter and form a [`Group`] with a detector of its own.
//! The first group whose data arrive leads: its detections make the marks. The [`Timeline`] turns
//! their times into indexes of the other streams. The constant offset between two devices, which
//! arrival times cannot show, is read off the tap that both sensed.

use super::detect::{DetectorEvent, HOP_S, onset_in};
use super::group::Group;
use super::options::{CutFrom, Detection, ScanCommand};
use super::stream::{Stream, StreamBuffer};
use super::timeline::Timeline;
use crate::device::{Begin, Mark, Open};
use crate::scene::Phase;

/// The largest offset between two devices that a tap can show, in seconds.
const LARGEST_OFFSET_S: f64 = 0.3;
/// A tap's source begins this long before its onset, in seconds, and lasts as in LMT108.
const BEFORE_TAP_S: f64 = 0.02;
const TAP_S: f64 = 10_501.0 / 44_100.0;

/// A detected drag, in hops of its group.
struct Contact {
    lead: usize,
    tap: Option<(u64, u64)>,
    start: u64,
}

/// A source, and the index of its stream.
struct PlacedCut {
    cut: CutFrom,
    stream: usize,
}

struct Running {
    /// The group that detected it; none if a command began it.
    lead: Option<usize>,
    begun_s: f64,
    /// The sources that were opened for its drag, as indexes into `cuts`.
    opened: Vec<usize>,
}

/// Detects scans in the streams of a session.
pub(super) struct ScanDetector {
    timeline: Timeline,
    groups: Vec<Group>,
    cuts: Vec<PlacedCut>,
    /// Level at which contact begins.
    onset: f64,
    longest_scan_s: f64,
    scan: Option<Running>,
    warnings: Vec<String>,
}

impl ScanDetector {
    /// A detector for these streams, by those parts of `detection` that concern them. No scan lasts
    /// longer than `longest_scan_s` seconds.
    pub fn new(detection: Detection, streams: &[Stream], longest_scan_s: f64) -> Self {
        let Detection { detector, groups, cuts } = detection;
        let place = |cut: CutFrom| {
            let stream = streams.iter().position(|stream| stream.id() == &cut.stream)?;
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
            warnings: Vec::new(),
        }
    }

    /// Takes over the rates of one device's streams, which have had no frame yet.
    pub fn follow_rates(&mut self, streams: &[Stream], device: usize) {
        self.timeline.follow_rates(streams, device);
        let of = |group: &&mut Group| streams[group.channels[0].0].device == device;
        self.groups.iter_mut().filter(of).for_each(|group| group.follow_rate(streams));
    }

    /// Looks at what has come out of the rings, and gives the marks that follow from it.
    pub fn update(&mut self, streams: &[Stream]) -> Vec<Mark> {
        let now_s = self.timeline.observe(streams);
        let mut marks = Vec::new();
        for at in 0..self.groups.len() {
            let (group, timeline) = (&mut self.groups[at], &self.timeline);
            let mut events = group.update(streams, |stream| timeline.alive(stream, now_s));
            if group.channels.iter().all(|(stream, _)| timeline.gone(*stream, now_s)) {
                let last = group.detector.finish();
                let cut_off = last.is_some_and(|last| group.cut_off(last));
                if cut_off && self.leads(at) {
                    marks.push(Mark::Spoil { why: "its data stopped before it was over".into() });
                }
                events.extend(last);
            }
            for event in events {
                self.on_detection(at, event, streams, now_s, &mut marks);
            }
        }
        if self.scan.as_ref().is_some_and(|scan| now_s - scan.begun_s >= self.longest_scan_s) {
            let longest_s = self.longest_scan_s;
            let text = format!("a scan was ended after {longest_s} s, the longest allowed");
            self.warnings.push(text);
            self.end_now(streams, now_s, &mut marks);
        }
        marks
    }

    /// Begins or ends a scan, regardless of the detectors.
    pub fn command(&mut self, command: ScanCommand, streams: &[Stream]) -> Vec<Mark> {
        let now_s = self.timeline.now_s();
        let mut marks = Vec::new();
        match (command, &mut self.scan) {
            (ScanCommand::Begin, Some(scan)) => scan.lead = None,
            (ScanCommand::Begin, None) => self.begin(None, streams, now_s, &mut marks),
            (ScanCommand::End, None) => {}
            (ScanCommand::End, Some(_)) => self.end_now(streams, now_s, &mut marks),
        }
        marks
    }

    /// Ends the scan in progress, since no more data will come.
    pub fn finish(&mut self, streams: &[Stream]) -> Vec<Mark> {
        let now_s = self.timeline.now_s();
        let mut marks = Vec::new();
        match self.scan.as_ref().map(|scan| scan.lead) {
            None => return marks,
            Some(None) => self.end_now(streams, now_s, &mut marks),
            Some(Some(at)) => {
                if let Some(event) = self.groups[at].detector.finish() {
                    self.on_detection(at, event, streams, now_s, &mut marks);
                }
            }
        }
        // No more data will come: frames that have not arrived were never sampled, so a cut ends
        // where its stream does, and they do not count as lost.
        for mark in &mut marks {
            let Mark::Close { source, end } = mark else { continue };
            let placed = self.cuts.iter().find(|placed| placed.cut.source == *source);
            *end = placed.map_or(*end, |placed| streams[placed.stream].end().min(*end));
        }
        marks
    }

    pub fn take_warnings(&mut self) -> Vec<String> {
        std::mem::take(&mut self.warnings)
    }

    fn leads(&self, group: usize) -> bool {
        self.scan.as_ref().is_some_and(|scan| scan.lead == Some(group))
    }

    fn on_detection(
        &mut self,
        at: usize,
        event: DetectorEvent,
        streams: &[Stream],
        now_s: f64,
        marks: &mut Vec<Mark>,
    ) {
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
                self.begin(Some(Contact { lead: at, tap, start }), streams, now_s, marks);
            }
            DetectorEvent::End { end } if self.leads(at) => {
                let opened = self.scan.take().map(|scan| scan.opened).unwrap_or_default();
                for placed in opened.into_iter().map(|cut| &self.cuts[cut]) {
                    if let Some(end) = self.index(at, end, placed.stream, streams) {
                        marks.push(Mark::Close { source: placed.cut.source.clone(), end });
                    }
                }
                self.mark_images(streams, marks);
                let ended_s = self.time_s(at, end).unwrap_or(now_s).clamp(0.0, now_s);
                marks.push(Mark::End { at: self.timeline.instant(ended_s) });
            }
            DetectorEvent::NoiseTimeout if self.leads(at) => {
                self.scan = None;
                let why = "contact never ended, so it was noise and not a drag";
                marks.push(Mark::GiveUp { why: why.into() });
            }
            DetectorEvent::End { .. } | DetectorEvent::NoiseTimeout => {}
        }
    }

    /// Begins the scan of `contact`; without one, a scan whose drag begins now.
    fn begin(
        &mut self,
        contact: Option<Contact>,
        streams: &[Stream],
        now_s: f64,
        marks: &mut Vec<Mark>,
    ) {
        marks.push(Mark::Begin(Begin::default()));
        self.mark_images(streams, marks);
        let mut opened = Vec::new();
        for (number, placed) in self.cuts.iter().enumerate() {
            let at = placed.stream;
            if !self.timeline.alive(at, now_s) {
                continue;
            }
            let rate_hz = streams[at].rate_hz();
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
        let lead = contact.map(|contact| contact.lead);
        self.scan = Some(Running { lead, begun_s: now_s, opened });
    }

    /// Ends the scan in progress at this moment.
    fn end_now(&mut self, streams: &[Stream], now_s: f64, marks: &mut Vec<Mark>) {
        let opened = self.scan.take().map(|scan| scan.opened).unwrap_or_default();
        for placed in opened.into_iter().map(|cut| &self.cuts[cut]) {
            let end = self.timeline.index_now(placed.stream, now_s);
            marks.push(Mark::Close { source: placed.cut.source.clone(), end });
        }
        self.mark_images(streams, marks);
        marks.push(Mark::End { at: self.timeline.instant(now_s) });
    }

    /// Marks the latest pictures, however old. Called when a scan begins, and again when it ends,
    /// since pictures with flash are taken during the drag.
    fn mark_images(&self, streams: &[Stream], marks: &mut Vec<Mark>) {
        for placed in &self.cuts {
            if let StreamBuffer::Images { history, .. } = streams[placed.stream].buffer()
                && let Some((latest, _)) = history.latest()
            {
                marks.push(placed.open(*latest, 1.0));
                marks.push(Mark::Close { source: placed.cut.source.clone(), end: latest + 1 });
            }
        }
    }

    /// The time at which a hop of a group began.
    fn time_s(&self, group: usize, hop: u64) -> Option<f64> {
        let group = &self.groups[group];
        self.timeline.time_s(group.channels[0].0, group.frame(hop))
    }

    /// Reads the other groups' offsets off the tap that began at hop `onset` of group `lead`.
    fn align(&mut self, lead: usize, onset: u64) {
        let Some(tap_s) = self.time_s(lead, onset) else { return };
        self.groups[lead].offset_s = 0.0;
        let reach = (LARGEST_OFFSET_S / HOP_S) as u64;
        for at in (0..self.groups.len()).filter(|at| *at != lead) {
            let group = &mut self.groups[at];
            let Some(frame) = self.timeline.index_at(group.channels[0].0, tap_s) else { continue };
            let hop = group.hop(frame);
            let window = hop.saturating_sub(reach)..hop + reach;
            let levels = group.levels.make_contiguous();
            if let Some(seen) = onset_in(levels, group.first, window, self.onset) {
                group.offset_s = (seen as f64 - hop as f64) * HOP_S;
            }
        }
    }

    /// Index of the frame of stream number `at` sampled when hop `hop` of group `lead` began.
    fn index(&self, lead: usize, hop: u64, at: usize, streams: &[Stream]) -> Option<u64> {
        let group = &self.groups[lead];
        let leading = &streams[group.channels[0].0];
        if streams[at].device == leading.device && streams[at].rate_hz() == leading.rate_hz() {
            return Some(group.frame(hop));
        }
        let offset_s = (self.groups.iter())
            .find(|group| group.channels.iter().any(|(stream, _)| *stream == at))
            .map_or(0.0, |group| group.offset_s);
        self.timeline.index_at(at, self.time_s(lead, hop)? + offset_s)
    }
}

impl PlacedCut {
    /// The mark that opens the source at frame `start`.
    fn open(&self, start: u64, rate_hz: f64) -> Mark {
        let CutFrom { source, stream, phase, channels } = &self.cut;
        Mark::Open(Open {
            source: source.clone(),
            stream: stream.clone(),
            start,
            phase: *phase,
            rate_hz,
            channels: *channels,
        })
    }
}
