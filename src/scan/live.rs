//! Marks for streams that carry none: listens for taps and drags, and cuts all sources to one span.
//!
//! Streams of one device share one sample counter and form a [`Group`]; each group has a detector
//! of its own, on its own counter. The first group that is alive leads: what it finds makes the
//! marks. Its times become indexes of the other streams through their [`Clock`]s, and the constant
//! offset between two devices, which arrival times cannot show, through the tap that both felt.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use super::clock::Clock;
use super::detect::{Detector, Feel, Found, HOP_S, Level, Limits, onset_in};
use super::stream::{Intake, Stream};
use crate::device::{Begin, Mark, Open};
use crate::scene::{Phase, SourceId};

/// A stream that brought nothing for so long is not listened to, in seconds.
const SILENT_S: f64 = 0.5;
/// The largest offset between two devices that a tap can show, in seconds.
const LARGEST_OFFSET_S: f64 = 0.3;
/// A tap's source begins so long before its onset, in seconds, and lasts as in LMT108.
const BEFORE_TAP_S: f64 = 0.02;
const TAP_S: f64 = 10_501.0 / 44_100.0;
/// Levels that are kept: 10 s.
const KEPT_HOPS: usize = 2_000;

/// What to listen to, and what to cut.
#[derive(Clone, Debug, PartialEq)]
pub struct Detection {
    /// What is a tap, and what a drag.
    pub limits: Limits,
    /// Streams that show contact, by device: those of one group share one sample counter and one
    /// rate. The first group that is alive leads.
    pub groups: Vec<Vec<(SourceId, Feel)>>,
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

/// The streams of one device that show contact.
struct Group {
    /// Indexes of the streams, and their levels.
    ears: Vec<(usize, Level)>,
    rate_hz: f64,
    detector: Detector,
    /// Index of the first frame of hop 0, and of the next frame.
    base: u64,
    next: u64,
    /// Highest level of each hop, the latest ones; the first is hop `first`.
    levels: VecDeque<f64>,
    first: u64,
    /// Seconds by which its times are later than those of the leading group.
    offset_s: f64,
}

/// Follows the streams of a session.
pub(super) struct Live {
    plan: Detection,
    begin: Instant,
    clocks: Vec<Clock>,
    /// Index after the last frame of each stream, and when it came, in seconds.
    ends: Vec<(u64, f64)>,
    groups: Vec<Group>,
    /// The group whose drag goes on, and the sources that were opened for it.
    leading: Option<(usize, Vec<CutFrom>)>,
}

fn rate_hz(stream: &Stream) -> f64 {
    match stream.intake() {
        Intake::Series { rate_hz, .. } => *rate_hz,
        Intake::Images { .. } => 0.0,
    }
}

impl Live {
    pub fn new(plan: Detection, streams: &[Stream]) -> Self {
        let index = |id: &SourceId| streams.iter().position(|stream| stream.id() == id);
        let groups = plan.groups.iter().filter_map(|ears| {
            let found: Vec<(usize, Feel)> =
                ears.iter().filter_map(|(id, feel)| Some((index(id)?, *feel))).collect();
            let rate_hz = rate_hz(&streams[found.first()?.0]);
            let level = |&(at, feel): &(usize, Feel)| {
                (at, Level::new(feel, streams[at].channels(), rate_hz))
            };
            Some(Group {
                ears: found.iter().map(level).collect(),
                rate_hz,
                detector: Detector::new(plan.limits),
                base: 0,
                next: 0,
                levels: VecDeque::new(),
                first: 0,
                offset_s: 0.0,
            })
        });
        Self {
            groups: groups.collect(),
            begin: Instant::now(),
            clocks: streams.iter().map(|stream| Clock::new(rate_hz(stream))).collect(),
            ends: vec![(0, f64::NEG_INFINITY); streams.len()],
            plan,
            leading: None,
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
            if !self.groups[at].ears.iter().any(|(stream, _)| alive(*stream)) {
                found.extend(self.groups[at].detector.finish());
            }
            for found in found {
                self.heed(at, found, streams, now_s, &mut marks);
            }
        }
        marks
    }

    /// Ends a drag that goes on.
    pub fn finish(&mut self, streams: &[Stream]) -> Vec<Mark> {
        let now_s = self.begin.elapsed().as_secs_f64();
        let mut marks = Vec::new();
        if let Some((at, _)) = self.leading
            && let Some(found) = self.groups[at].detector.finish()
        {
            self.heed(at, found, streams, now_s, &mut marks);
        }
        marks
    }

    fn heed(
        &mut self,
        at: usize,
        found: Found,
        streams: &[Stream],
        now_s: f64,
        marks: &mut Vec<Mark>,
    ) {
        let leads = self.leading.as_ref().is_some_and(|(leader, _)| *leader == at);
        match found {
            Found::Drag { tap, start } => {
                let alive = |group: &Group| {
                    group.ears.iter().any(|(stream, _)| now_s - self.ends[*stream].1 <= SILENT_S)
                };
                if self.leading.is_some() || self.groups[..at].iter().any(alive) {
                    return;
                }
                if let Some((onset, _)) = tap {
                    self.align(at, onset);
                }
                let opened = self.open(at, tap, start, streams, now_s, marks);
                self.leading = Some((at, opened));
            }
            Found::End { end } if leads => {
                let (_, opened) = self.leading.take().unwrap_or_default();
                for cut in opened.iter().filter(|cut| cut.phase == Phase::Drag) {
                    if let Some(end) = self.index(at, end, &cut.stream, streams) {
                        marks.push(Mark::Close { source: cut.source.clone(), end });
                    }
                }
                let ended_s = self.time_s(at, end).unwrap_or(now_s).clamp(0.0, now_s);
                marks.push(Mark::End { at: self.begin + Duration::from_secs_f64(ended_s) });
            }
            Found::Room if leads => self.leading = None,
            Found::End { .. } | Found::Room => {}
        }
    }

    /// When a hop of a group began.
    fn time_s(&self, group: usize, hop: u64) -> Option<f64> {
        let group = &self.groups[group];
        self.clocks[group.ears[0].0].time_s(group.frame(hop))
    }

    /// Reads the other groups' offsets off the tap that began at hop `onset` of group `lead`.
    fn align(&mut self, lead: usize, onset: u64) {
        let Some(tap_s) = self.time_s(lead, onset) else { return };
        self.groups[lead].offset_s = 0.0;
        let reach = (LARGEST_OFFSET_S / HOP_S) as u64;
        for at in (0..self.groups.len()).filter(|at| *at != lead) {
            let group = &self.groups[at];
            let Some(frame) = self.clocks[group.ears[0].0].index_at(tap_s) else { continue };
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
        if group.ears.iter().any(|(ear, _)| *ear == at) {
            return Some(group.frame(hop));
        }
        let offset_s = (self.groups.iter())
            .find(|group| group.ears.iter().any(|(ear, _)| *ear == at))
            .map_or(0.0, |group| group.offset_s);
        self.clocks[at].index_at(self.time_s(lead, hop)? + offset_s)
    }

    fn open(
        &self,
        lead: usize,
        tap: Option<(u64, u64)>,
        start: u64,
        streams: &[Stream],
        now_s: f64,
        marks: &mut Vec<Mark>,
    ) -> Vec<CutFrom> {
        marks.push(Mark::Begin(Begin::default()));
        let mut opened = Vec::new();
        for cut in &self.plan.cuts {
            let Some(at) = streams.iter().position(|stream| stream.id() == &cut.stream) else {
                continue;
            };
            let stream = &streams[at];
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
            let rate_hz = match stream.intake() {
                // The latest picture, however long ago it was taken.
                Intake::Images { history, .. } => {
                    if let Some((latest, _)) = history.latest() {
                        marks.extend([open(*latest, 1.0), close(latest + 1)]);
                    }
                    continue;
                }
                Intake::Series { rate_hz, .. } => *rate_hz,
            };
            if now_s - self.ends[at].1 > SILENT_S {
                continue;
            }
            let frames = |seconds: f64| (seconds * rate_hz).round() as u64;
            match (cut.phase, tap) {
                (Phase::Tap, Some((onset, _))) => {
                    let begin = self.index(lead, onset, &cut.stream, streams);
                    let drag = self.index(lead, start, &cut.stream, streams);
                    if let (Some(begin), Some(drag)) = (begin, drag) {
                        let begin = begin.saturating_sub(frames(BEFORE_TAP_S));
                        let end = (begin + frames(TAP_S)).min(drag).max(begin);
                        marks.extend([open(begin, rate_hz), close(end)]);
                    }
                }
                (Phase::Drag, _) => {
                    if let Some(begin) = self.index(lead, start, &cut.stream, streams) {
                        marks.push(open(begin, rate_hz));
                        opened.push(cut.clone());
                    }
                }
                _ => {}
            }
        }
        opened
    }
}

impl Group {
    /// Index of the first frame of a hop.
    fn frame(&self, hop: u64) -> u64 {
        self.base + (hop as f64 * self.rate_hz * HOP_S).round() as u64
    }

    /// The hop that holds a frame.
    fn hop(&self, frame: u64) -> u64 {
        (frame.saturating_sub(self.base) as f64 / (self.rate_hz * HOP_S)).round() as u64
    }

    /// Takes what all the streams that are `alive` have.
    fn listen(&mut self, streams: &[Stream], alive: impl Fn(usize) -> bool) -> Vec<Found> {
        let kept = |at: usize| match streams[at].intake() {
            Intake::Series { history, .. } => history.start(),
            Intake::Images { .. } => 0,
        };
        let ears = || self.ears.iter().map(|(at, _)| *at).filter(|at| alive(*at));
        let from = ears().map(kept).max().unwrap_or(0);
        let Some(end) = ears().map(|at| streams[at].end()).min().filter(|end| *end > self.next)
        else {
            return Vec::new();
        };
        if from > self.next {
            // A gap longer than any scan: what goes on ends, and the next turn begins behind it.
            let found = self.detector.finish();
            if found.is_none() {
                self.start_anew(from);
            }
            return found.into_iter().collect();
        }
        let held = self.detector.in_contact();
        let mut fresh: Vec<f64> = Vec::new();
        for (at, level) in &mut self.ears {
            let Intake::Series { history, .. } = streams[*at].intake() else { continue };
            if !alive(*at) {
                continue;
            }
            let (_, samples) = history.frames(self.next..end);
            let mut hop = 0;
            level.feed(samples, held, |x| {
                match fresh.get_mut(hop) {
                    Some(highest) => *highest = highest.max(x),
                    None => fresh.push(x),
                }
                hop += 1;
            });
        }
        self.next = end;
        // A stream that was away for a while may finish its hops a little off the others: how
        // many there are is for the counter to say.
        let count = ((end - self.base) as f64 / (self.rate_hz * HOP_S)) as u64;
        let so_far = self.first + self.levels.len() as u64;
        fresh.resize(count.saturating_sub(so_far) as usize, 0.0);
        let mut found = Vec::new();
        for level in fresh {
            self.levels.push_back(level);
            if self.levels.len() > KEPT_HOPS {
                self.levels.pop_front();
                self.first += 1;
            }
            found.extend(self.detector.hop(level));
        }
        if found.contains(&Found::Room) {
            self.ears.iter_mut().for_each(|(_, level)| level.relearn());
        }
        found
    }

    /// Begins to count at frame `base`.
    fn start_anew(&mut self, base: u64) {
        (self.base, self.next, self.first) = (base, base, 0);
        self.levels.clear();
        self.detector = Detector::new(self.detector.limits());
        self.ears.iter_mut().for_each(|(_, level)| level.relearn());
    }
}
