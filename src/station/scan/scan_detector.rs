//! Sets marks around taps and drags in streams without marks, over one span of time in all sources.
//!
//! Streams of one device share one sample counter and form a [`DeviceGroup`] with a detector of its
//! own. The first group with data leads, so only its detections make marks. The clock of each stream
//! converts the times of detections to indexes of the stream.

use std::ops::Range;
use std::time::{Duration, Instant};

use super::detect::DetectorEvent;
use super::device_group::DeviceGroup;
use super::recent_frames::{Stream, StreamBuffer, narrow};
use super::{CutFrom, Detection, ScanCommand};
use crate::device::{Begin, Mark, Open, Warning, WarningKind};
use crate::scene::Phase;
use crate::trial::{Doubt, channel_levels_db};

/// In seconds, as in LMT108, a tap's source begins this long before the onset and lasts `TAP_S`.
const BEFORE_TAP_S: f64 = 0.02;
const TAP_S: f64 = 10_501.0 / 44_100.0;
/// In seconds, the noise of a channel is measured over `REST_S`, until `BEFORE_CONTACT_S` before contact.
const REST_S: f64 = 0.5;
const BEFORE_CONTACT_S: f64 = 0.05;

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
    /// The moment at which the times of all streams begin.
    begin: Instant,
    groups: Vec<DeviceGroup>,
    cuts: Vec<PlacedCut>,
    onset: f64,
    longest_scan_s: f64,
    scan: Option<Running>,
    /// Marks and warnings that the collector has not taken yet.
    pub marks: Vec<Mark>,
    pub warnings: Vec<Warning>,
}

impl ScanDetector {
    /// A detector for these streams; it ignores parts of `detection` that name other streams.
    pub(super) fn new(detection: Detection, streams: &[Stream], longest_scan_s: f64) -> Self {
        let Detection { detector, groups, cuts } = detection;
        let ends = detector.longest_drag_s.is_finite();
        let longest_scan_s = if ends { longest_scan_s } else { f64::INFINITY };
        let place = |cut: CutFrom| {
            let stream = streams.iter().position(|stream| stream.id == cut.stream)?;
            Some(PlacedCut { cut, stream })
        };
        let group = |channels: &Vec<_>| DeviceGroup::new(channels, detector, streams);
        Self {
            begin: Instant::now(),
            groups: groups.iter().filter_map(group).collect(),
            cuts: cuts.into_iter().filter_map(place).collect(),
            onset: detector.onset,
            longest_scan_s,
            scan: None,
            marks: Vec::new(),
            warnings: Vec::new(),
        }
    }

    /// Detects taps and drags in the frames that have come out of the rings, and sets marks.
    pub(super) fn update(&mut self, streams: &mut [Stream]) {
        self.update_at(self.now_s(), streams);
    }

    /// Like [`Self::update`], at a time of the time base of all streams.
    fn update_at(&mut self, now_s: f64, streams: &mut [Stream]) {
        streams.iter_mut().for_each(|stream| stream.observe(now_s));
        for at in 0..self.groups.len() {
            let group = &mut self.groups[at];
            let mut events = group.update(streams, now_s);
            if group.channels.iter().all(|(stream, _)| streams[*stream].gone(now_s)) {
                let last = group.detector.finish();
                let cut_off = last.is_some_and(|last| group.cut_off(last));
                if cut_off && self.leads(at) {
                    self.marks.push(Mark::Spoil(Doubt::EndedEarly));
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
            self.warnings.push(Warning::new(WarningKind::LongestScan, text));
            self.end_now(streams, now_s);
        }
    }

    /// Whether a scan that has no longest time may have ended already, so that its newest data may be rest.
    pub(super) fn may_rest(&self) -> bool {
        let lead = self.scan.as_ref().and_then(|scan| scan.lead);
        let is_quiet = lead.is_some_and(|at| self.groups[at].detector.is_quiet());
        is_quiet && self.longest_scan_s.is_infinite()
    }

    pub(super) fn command(&mut self, command: ScanCommand, streams: &[Stream]) {
        let now_s = self.now_s();
        match (command, &mut self.scan) {
            (ScanCommand::Begin, Some(scan)) => scan.lead = None,
            (ScanCommand::Begin, None) => self.begin(None, streams, now_s),
            (ScanCommand::End, None) => {}
            (ScanCommand::End, Some(_)) => self.end_now(streams, now_s),
        }
    }

    /// Ends the scan in progress. Called when no more data will come: since the station was `stopped`,
    /// or all devices have ended.
    pub(super) fn finish(&mut self, streams: &[Stream], stopped: bool) {
        let now_s = self.now_s();
        match self.scan.as_ref().map(|scan| scan.lead) {
            None => return,
            Some(None) => self.end_now(streams, now_s),
            Some(Some(at)) => {
                if let Some(event) = self.groups[at].detector.finish() {
                    if !stopped && self.groups[at].cut_off(event) {
                        self.marks.push(Mark::Spoil(Doubt::EndedEarly));
                    }
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

    fn now_s(&self) -> f64 {
        self.begin.elapsed().as_secs_f64()
    }

    fn leads(&self, group: usize) -> bool {
        self.scan.as_ref().is_some_and(|scan| scan.lead == Some(group))
    }

    fn on_detection(&mut self, at: usize, event: DetectorEvent, streams: &[Stream], now_s: f64) {
        match event {
            DetectorEvent::Drag { tap, start } => {
                let alive = |group: &DeviceGroup| {
                    group.channels.iter().any(|(stream, _)| streams[*stream].alive(now_s))
                };
                if self.scan.is_some() || self.groups[..at].iter().any(alive) {
                    return;
                }
                if let Some((onset, _)) = tap {
                    self.align(at, onset, streams);
                }
                self.begin(Some(Contact { lead: at, tap, start }), streams, now_s);
            }
            DetectorEvent::End { end, cut } if self.leads(at) => {
                if cut {
                    self.marks.push(Mark::Spoil(Doubt::Cut));
                }
                let ended_s = self.time_s(at, end, streams).unwrap_or(now_s).clamp(0.0, now_s);
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
        let rest = contact.as_ref().and_then(|contact| self.rest(contact));
        for (number, placed) in self.cuts.iter().enumerate() {
            let at = placed.stream;
            let stream = &streams[at];
            if !stream.alive(now_s) {
                continue;
            }
            let rate_hz = stream.rate_hz;
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
                    let span = rest.as_ref().and_then(|rest| {
                        Some(index(contact, rest.start)?..index(contact, rest.end)?)
                    });
                    marks.extend(span.and_then(|span| placed.rest(span, stream)));
                }
                (Phase::Drag, None) => {
                    marks.push(placed.open(stream.index_now(now_s), rate_hz));
                    opened.push(number);
                }
                _ => {}
            }
        }
        self.marks.extend(marks);
        let lead = contact.map(|contact| contact.lead);
        self.scan = Some(Running { lead, begun_s: now_s, opened });
    }

    /// The hops just before a contact in which its group was at rest; `None` if it was not.
    fn rest(&self, contact: &Contact) -> Option<Range<u64>> {
        let group = &self.groups[contact.lead];
        let hops = |seconds: f64| (seconds / group.hop_s()).round() as u64;
        let begin = contact.tap.map_or(contact.start, |(onset, _)| onset);
        let end = begin.checked_sub(hops(BEFORE_CONTACT_S))?;
        let rest = end.checked_sub(hops(REST_S))?..end;
        group.was_quiet_in(rest.clone()).then_some(rest)
    }

    fn end_now(&mut self, streams: &[Stream], now_s: f64) {
        self.end(streams, now_s, |_, stream| Some(streams[stream].index_now(now_s)));
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
        self.marks.push(Mark::End { at: self.begin + Duration::from_secs_f64(ended_s) });
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

    fn time_s(&self, group: usize, hop: u64, streams: &[Stream]) -> Option<f64> {
        let group = &self.groups[group];
        group.leader(streams).clock.time_s(group.frame(hop))
    }

    /// Measures the offsets of the other groups by the tap that began at hop `onset` of group `lead`.
    fn align(&mut self, lead: usize, onset: u64, streams: &[Stream]) {
        let Some(tap_s) = self.time_s(lead, onset, streams) else { return };
        self.groups[lead].offset_s = 0.0;
        let others = self.groups.iter_mut().enumerate().filter(|(at, _)| *at != lead);
        for (_, group) in others {
            if let Some(frame) = group.leader(streams).clock.index_at(tap_s) {
                group.align(frame, self.onset);
            }
        }
    }

    /// Index of the frame in stream number `at` that was sampled when hop `hop` of group `lead` began.
    fn index(&self, lead: usize, hop: u64, at: usize, streams: &[Stream]) -> Option<u64> {
        let group = &self.groups[lead];
        let (stream, leader) = (&streams[at], group.leader(streams));
        if stream.device == leader.device && stream.rate_hz == leader.rate_hz {
            return Some(group.frame(hop));
        }
        let offset_s = (self.groups.iter())
            .find(|group| group.channels.iter().any(|(stream, _)| *stream == at))
            .map_or(0.0, |group| group.offset_s);
        stream.clock.index_at(self.time_s(lead, hop, streams)? + offset_s)
    }
}

impl PlacedCut {
    fn open(&self, start: u64, rate_hz: f64) -> Mark {
        Mark::Open(Open { cut: self.cut.clone(), start, rate_hz })
    }

    /// The level of the source in these frames at rest; `None` if one of them is missing.
    fn rest(&self, span: Range<u64>, stream: &Stream) -> Option<Mark> {
        let StreamBuffer::Series { history, .. } = &stream.buffer else { return None };
        let (start, samples) = history.frames(span.clone());
        let frames = (samples.len() / history.channels) as u64;
        if start != span.start
            || frames != span.end.saturating_sub(span.start)
            || history.missing_in(span).next().is_some()
        {
            return None;
        }
        let own = narrow(samples, history.channels, self.cut.channels);
        let levels_db = channel_levels_db(&own, self.cut.channels);
        Some(Mark::Rest { source: self.cut.source.clone(), levels_db })
    }
}

#[cfg(test)]
mod tests;
