//! Marks for streams that carry none: listens for taps and drags, and cuts all sources to one span.
//!
//! Streams of one device share one sample counter and form a [`Group`]; each group has a detector
//! of its own, on its own counter. The first group that is alive leads: what it finds makes the
//! marks. Its times become indexes of the other streams through their [`Clock`]s, and the constant
//! offset between two devices, which arrival times cannot show, through the tap that both felt.

use std::time::{Duration, Instant};

use super::clock::Clock;
use super::detect::{DetectorConfig, DetectorEvent, HOP_S, SensorKind, onset_in};
use super::group::Group;
use super::stream::{Stream, StreamBuffer};
use crate::device::{Begin, Mark, Open};
use crate::scene::{Phase, SourceId};

/// A stream that brought nothing for so long is not listened to, in seconds.
const SILENT_S: f64 = 0.5;
/// A drag of which nothing was heard for so long is over, in seconds: longer than any machine keeps
/// a driver waiting.
const GONE_S: f64 = 3.0;
/// The largest offset between two devices that a tap can show, in seconds.
const LARGEST_OFFSET_S: f64 = 0.3;
/// A tap's source begins so long before its onset, in seconds, and lasts as in LMT108.
const BEFORE_TAP_S: f64 = 0.02;
const TAP_S: f64 = 10_501.0 / 44_100.0;

/// What to listen to, and what to cut.
#[derive(Clone, Debug, PartialEq)]
pub struct Detection {
    /// What is a tap, and what a drag.
    pub limits: DetectorConfig,
    /// Streams that show contact, by device: those of one group share one sample counter and one
    /// rate. The first group that is alive leads.
    pub groups: Vec<Vec<(SourceId, SensorKind)>>,
    /// The sources of a scan.
    pub cuts: Vec<CutFrom>,
}

/// A source of a scan, and the stream that it is cut from.
#[derive(Clone, Debug, PartialEq)]
pub struct CutFrom {
    /// The source.
    pub source: SourceId,
    /// Its stream.
    pub stream: SourceId,
    /// The part of the scan.
    pub phase: Phase,
    /// How many of the stream's channels are the source's: the first ones.
    pub channels: usize,
}

/// A command of a person or a program, which a detector does not overrule.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ScanCommand {
    /// A drag begins now; if one goes on that was found, it ends by command alone.
    Begin,
    /// The scan that goes on ends now.
    End,
}

/// What a group found, in its hops.
struct Contact {
    lead: usize,
    tap: Option<(u64, u64)>,
    start: u64,
}

/// Follows the streams of a session.
pub(super) struct ScanDetector {
    plan: Detection,
    begin: Instant,
    clocks: Vec<Clock>,
    /// Index after the last frame of each stream, and when it came, in seconds.
    ends: Vec<(u64, f64)>,
    groups: Vec<Group>,
    /// The scan that goes on.
    scan: Option<Running>,
}

/// A scan that goes on.
struct Running {
    /// The group that found it; none if a command began it.
    lead: Option<usize>,
    /// The sources that were opened for its drag.
    opened: Vec<CutFrom>,
}

impl ScanDetector {
    pub fn new(plan: Detection, streams: &[Stream]) -> Self {
        let group = |channels: &Vec<_>| Group::new(channels, &plan, streams);
        let groups = plan.groups.iter().filter_map(group).collect();
        Self {
            groups,
            begin: Instant::now(),
            clocks: streams.iter().map(|stream| Clock::new(stream.rate_hz())).collect(),
            ends: vec![(0, f64::NEG_INFINITY); streams.len()],
            plan,
            scan: None,
        }
    }

    /// Listens to what has come out of the rings, and gives the marks that follow from it.
    pub fn listen(&mut self, streams: &[Stream]) -> Vec<Mark> {
        let now_s = self.begin.elapsed().as_secs_f64();
        for ((stream, clock), end) in streams.iter().zip(&mut self.clocks).zip(&mut self.ends) {
            if stream.end() > end.0 {
                *end = (stream.end(), now_s);
                clock.observe(stream.end(), now_s);
            }
        }
        let mut marks = Vec::new();
        for at in 0..self.groups.len() {
            let alive = |stream: usize| now_s - self.ends[stream].1 <= SILENT_S;
            let mut found = self.groups[at].listen(streams, alive);
            let gone = |stream: usize| now_s - self.ends[stream].1 > GONE_S;
            if self.groups[at].channels.iter().all(|(stream, _)| gone(*stream)) {
                let last = self.groups[at].detector.finish();
                if self.leads(at) && last.is_some_and(|last| self.groups[at].cut_off(last)) {
                    marks.push(Mark::Spoil { why: "its data stopped before it was over".into() });
                }
                found.extend(last);
            }
            for found in found {
                self.heed(at, found, streams, now_s, &mut marks);
            }
        }
        marks
    }

    /// Begins or ends a scan, whatever the detectors say.
    pub fn command(&mut self, command: ScanCommand, streams: &[Stream]) -> Vec<Mark> {
        let now_s = self.begin.elapsed().as_secs_f64();
        let mut marks = Vec::new();
        match (command, &mut self.scan) {
            (ScanCommand::Begin, Some(scan)) => scan.lead = None,
            (ScanCommand::Begin, None) => {
                marks.push(Mark::Begin(Begin::default()));
                let opened = self.open(None, streams, now_s, &mut marks);
                self.scan = Some(Running { lead: None, opened });
            }
            (ScanCommand::End, None) => {}
            (ScanCommand::End, Some(_)) => self.end_now(streams, now_s, &mut marks),
        }
        marks
    }

    /// Ends the scan that goes on: nothing more will come.
    pub fn finish(&mut self, streams: &[Stream]) -> Vec<Mark> {
        let now_s = self.begin.elapsed().as_secs_f64();
        let mut marks = Vec::new();
        match self.scan.as_ref().map(|scan| scan.lead) {
            None => return marks,
            Some(None) => self.end_now(streams, now_s, &mut marks),
            Some(Some(at)) => {
                if let Some(found) = self.groups[at].detector.finish() {
                    self.heed(at, found, streams, now_s, &mut marks);
                }
            }
        }
        // What has not come by now is not lost, but was never taken.
        for mark in &mut marks {
            let Mark::Close { source, end } = mark else { continue };
            let cut = self.plan.cuts.iter().find(|cut| cut.source == *source);
            let stream = cut.and_then(|cut| streams.iter().find(|s| s.id() == &cut.stream));
            *end = stream.map_or(*end, |stream| stream.end().min(*end));
        }
        marks
    }

    fn leads(&self, group: usize) -> bool {
        self.scan.as_ref().is_some_and(|scan| scan.lead == Some(group))
    }

    /// Whether a stream brought something lately.
    fn alive(&self, stream: usize, now_s: f64) -> bool {
        now_s - self.ends[stream].1 <= SILENT_S
    }

    fn heed(
        &mut self,
        at: usize,
        found: DetectorEvent,
        streams: &[Stream],
        now_s: f64,
        marks: &mut Vec<Mark>,
    ) {
        match found {
            DetectorEvent::Drag { tap, start } => {
                let first = |group: &Group| {
                    group.channels.iter().any(|(stream, _)| self.alive(*stream, now_s))
                };
                if self.scan.is_some() || self.groups[..at].iter().any(first) {
                    return;
                }
                if let Some((onset, _)) = tap {
                    self.align(at, onset);
                }
                marks.push(Mark::Begin(Begin::default()));
                let contact = Contact { lead: at, tap, start };
                let opened = self.open(Some(&contact), streams, now_s, marks);
                self.scan = Some(Running { lead: Some(at), opened });
            }
            DetectorEvent::End { end } if self.leads(at) => {
                let opened = self.scan.take().map(|scan| scan.opened).unwrap_or_default();
                for cut in opened {
                    if let Some(end) = self.index(at, end, &cut.stream, streams) {
                        marks.push(Mark::Close { source: cut.source, end });
                    }
                }
                self.pictures(streams, marks);
                let ended_s = self.time_s(at, end).unwrap_or(now_s).clamp(0.0, now_s);
                marks.push(Mark::End { at: self.begin + Duration::from_secs_f64(ended_s) });
            }
            DetectorEvent::NoiseTimeout if self.leads(at) => {
                self.scan = None;
                let why = "what stirred for so long was the room, not a drag";
                marks.push(Mark::GiveUp { why: why.into() });
            }
            DetectorEvent::End { .. } | DetectorEvent::NoiseTimeout => {}
        }
    }

    /// Ends the scan that goes on at this moment.
    fn end_now(&mut self, streams: &[Stream], now_s: f64, marks: &mut Vec<Mark>) {
        let opened = self.scan.take().map(|scan| scan.opened).unwrap_or_default();
        for cut in opened {
            let Some(at) = streams.iter().position(|s| s.id() == &cut.stream) else { continue };
            marks.push(Mark::Close { source: cut.source, end: self.index_now(at, streams, now_s) });
        }
        self.pictures(streams, marks);
        marks.push(Mark::End { at: self.begin + Duration::from_secs_f64(now_s) });
    }

    /// Takes the latest pictures, however long ago they were taken: when a scan begins, and once
    /// more when it ends, since one with flash is taken during the drag.
    fn pictures(&self, streams: &[Stream], marks: &mut Vec<Mark>) {
        for cut in &self.plan.cuts {
            let Some(stream) = streams.iter().find(|stream| stream.id() == &cut.stream) else {
                continue;
            };
            if let StreamBuffer::Images { history, .. } = stream.buffer()
                && let Some((latest, _)) = history.latest()
            {
                marks.push(Mark::Open(Open {
                    source: cut.source.clone(),
                    stream: cut.stream.clone(),
                    start: *latest,
                    phase: cut.phase,
                    rate_hz: 1.0,
                    channels: cut.channels,
                }));
                marks.push(Mark::Close { source: cut.source.clone(), end: latest + 1 });
            }
        }
    }

    /// Index in stream number `at` of the frame that is taken now.
    fn index_now(&self, at: usize, streams: &[Stream], now_s: f64) -> u64 {
        let by_clock = self.clocks[at].index_at(now_s).filter(|_| self.alive(at, now_s));
        by_clock.unwrap_or_else(|| streams[at].end())
    }

    /// When a hop of a group began.
    fn time_s(&self, group: usize, hop: u64) -> Option<f64> {
        let group = &self.groups[group];
        self.clocks[group.channels[0].0].time_s(group.frame(hop))
    }

    /// Reads the other groups' offsets off the tap that began at hop `onset` of group `lead`.
    fn align(&mut self, lead: usize, onset: u64) {
        let Some(tap_s) = self.time_s(lead, onset) else { return };
        self.groups[lead].offset_s = 0.0;
        let reach = (LARGEST_OFFSET_S / HOP_S) as u64;
        for at in (0..self.groups.len()).filter(|at| *at != lead) {
            let group = &self.groups[at];
            let Some(frame) = self.clocks[group.channels[0].0].index_at(tap_s) else { continue };
            let hop = group.hop(frame);
            let levels: Vec<f64> = group.levels.iter().copied().collect();
            let window = hop.saturating_sub(reach)..hop + reach;
            if let Some(seen) = onset_in(&levels, group.first, window, self.plan.limits.onset) {
                self.groups[at].offset_s = (seen as f64 - hop as f64) * HOP_S;
            }
        }
    }

    /// Index in `stream` of the moment at which a hop of group `lead` began.
    fn index(&self, lead: usize, hop: u64, stream: &SourceId, streams: &[Stream]) -> Option<u64> {
        let at = streams.iter().position(|other| other.id() == stream)?;
        let group = &self.groups[lead];
        let heard = &streams[group.channels[0].0];
        if streams[at].device == heard.device && streams[at].rate_hz() == heard.rate_hz() {
            return Some(group.frame(hop));
        }
        let offset_s = (self.groups.iter())
            .find(|group| group.channels.iter().any(|(ear, _)| *ear == at))
            .map_or(0.0, |group| group.offset_s);
        self.clocks[at].index_at(self.time_s(lead, hop)? + offset_s)
    }

    /// Opens the sources of a scan: those of `contact`, or without it a drag that begins now.
    fn open(
        &self,
        contact: Option<&Contact>,
        streams: &[Stream],
        now_s: f64,
        marks: &mut Vec<Mark>,
    ) -> Vec<CutFrom> {
        self.pictures(streams, marks);
        let mut opened = Vec::new();
        for cut in &self.plan.cuts {
            let Some(at) = streams.iter().position(|stream| stream.id() == &cut.stream) else {
                continue;
            };
            let stream = &streams[at];
            let rate_hz = stream.rate_hz();
            let open = |start: u64, rate_hz: f64| {
                Mark::Open(Open {
                    source: cut.source.clone(),
                    stream: cut.stream.clone(),
                    start,
                    phase: cut.phase,
                    rate_hz,
                    channels: cut.channels,
                })
            };
            let close = |end| Mark::Close { source: cut.source.clone(), end };
            if !self.alive(at, now_s) {
                continue;
            }
            let index = |lead, hop| self.index(lead, hop, &cut.stream, streams);
            match (cut.phase, contact) {
                (Phase::Tap, Some(Contact { lead, tap: Some((onset, _)), start })) => {
                    if let (Some(begin), Some(drag)) = (index(*lead, *onset), index(*lead, *start))
                    {
                        let frames = |seconds: f64| (seconds * rate_hz).round() as u64;
                        let begin = begin.saturating_sub(frames(BEFORE_TAP_S));
                        let end = (begin + frames(TAP_S)).min(drag).max(begin);
                        marks.extend([open(begin, rate_hz), close(end)]);
                    }
                }
                (Phase::Drag, Some(Contact { lead, start, .. })) => {
                    if let Some(begin) = index(*lead, *start) {
                        marks.push(open(begin, rate_hz));
                        opened.push(cut.clone());
                    }
                }
                (Phase::Drag, None) => {
                    marks.push(open(self.index_now(at, streams, now_s), rate_hz));
                    opened.push(cut.clone());
                }
                _ => {}
            }
        }
        opened
    }
}
