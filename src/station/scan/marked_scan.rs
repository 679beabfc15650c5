//! A scan in progress. Marks say where its sources begin and end. Once all its data have come, the
//! scan is cut out of the streams; until then, snapshots show its progress, in steps of scan time.
//! Gaps in the data spoil a scan, unless they are so short that they are bridged.
//!
//! A snapshot carries only new data. If the reader is busy, a snapshot is not sent, and the next
//! one carries its data too. So a reader that joins all snapshots has the scan without a gap.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;
use std::time::Instant;

use super::Scan;
use super::recent_frames::{SeriesHistory, Stream, StreamBuffer, image, narrow};
use crate::device::{Begin, CutFrom, Mark, Open};
use crate::scene::{Phase, SourceId};
use crate::trial::{Doubt, Image, Series, Signal, Trial, TrialKey};

#[derive(Debug, Default)]
pub(super) struct Marked {
    pub number: u32,
    pub begin: Begin,
    /// The true labels that follow that of the begin, each with the scan time from which it holds.
    pub truths: Vec<(f64, TrialKey)>,
    pub device: usize,
    pub cuts: BTreeMap<SourceId, SourceSpan>,
    /// The times when the last sample was taken and when the end became known; `None` before the end.
    pub ended: Option<(Instant, Instant)>,
    /// Number of the last step of progress that was sent.
    pub steps: u64,
    /// Why the scan should not be trusted, apart from what is found in its data.
    pub spoiled: Vec<Doubt>,
    pub rest: BTreeMap<SourceId, Vec<f64>>,
    pub phase: Option<Phase>,
}

#[derive(Debug)]
pub(super) struct SourceSpan {
    pub stream: usize,
    pub start: u64,
    pub end: Option<u64>,
    pub phase: Phase,
    pub rate_hz: f64,
    pub channels: usize,
    /// Number of frames that were sent as progress.
    pub sent: u64,
}

impl SourceSpan {
    /// Index after the last frame of the source that has come out of the ring.
    pub(super) fn available(&self, streams: &[Stream]) -> u64 {
        let end = self.end.unwrap_or(u64::MAX);
        streams[self.stream].end().min(end).max(self.start)
    }

    /// Whether the source has ended and no more of its frames will come out of the ring.
    pub(super) fn delivered(&self, streams: &[Stream]) -> bool {
        let stream = &streams[self.stream];
        self.end.is_some_and(|end| stream.end() >= end || stream.exhausted())
    }

    fn off_pace(&self, source: &SourceId, streams: &[Stream]) -> Option<Doubt> {
        let (source, rate_hz) = (source.clone(), self.rate_hz);
        let seen_hz = streams[self.stream].off_pace_hz?;
        Some(Doubt::WrongRate { source, seen_hz, rate_hz })
    }

    /// Index after the last frame of the source's first `seconds`, rounded up.
    fn until(&self, seconds: f64) -> u64 {
        self.start + (seconds * self.rate_hz).ceil() as u64
    }
}

impl Marked {
    /// Applies a mark that belongs to the scan; returns an error if it contradicts earlier marks.
    pub(super) fn follow(&mut self, mark: Mark, streams: &[Stream]) -> Result<(), String> {
        match mark {
            // The collector applies these marks itself.
            Mark::Begin(_) | Mark::GiveUp { .. } => {}
            Mark::Spoil(doubt) => self.spoiled.push(doubt),
            Mark::Rest { source, levels_db } => {
                self.rest.insert(source, levels_db);
            }
            Mark::Truth { from_s, truth } => self.truths.push((from_s, truth)),
            Mark::Open(open) => self.open(open, streams)?,
            Mark::Close { source, end } => match self.cuts.get_mut(&source) {
                Some(cut) if end >= cut.start => cut.end = Some(end),
                Some(cut) => {
                    return Err(format!("{source} would end at {end}, before its {}", cut.start));
                }
                None => return Err(format!("{source} ends but was never begun")),
            },
            Mark::End { at } => {
                for cut in self.cuts.values_mut() {
                    let pushed = streams[cut.stream].meter().counts().pushed;
                    cut.end.get_or_insert(pushed.max(cut.start));
                }
                self.ended = Some((at, Instant::now()));
            }
        }
        Ok(())
    }

    /// The true label of the data just before this scan time.
    fn truth_at(&self, scan_s: f64) -> Option<&TrialKey> {
        let later = self.truths.iter().rev().find(|(from_s, _)| *from_s < scan_s);
        later.map(|(_, truth)| truth).or(self.begin.truth.as_ref())
    }

    fn open(&mut self, open: Open, streams: &[Stream]) -> Result<(), String> {
        let Open { cut: CutFrom { source, stream, phase, channels }, start, rate_hz } = open;
        let Some(index) = streams.iter().position(|s| s.id == stream) else {
            return Err(format!("{source} would be cut from {stream}, which does not exist"));
        };
        if !(rate_hz.is_finite() && rate_hz > 0.0) {
            return Err(format!("{source} would have a rate of {rate_hz} Hz"));
        }
        let widest = streams[index].channels;
        if channels == 0 || channels > widest {
            return Err(format!("{source} would have {channels} of {widest} channels"));
        }
        let cut = SourceSpan { stream: index, start, end: None, phase, rate_hz, channels, sent: 0 };
        self.cuts.insert(source, cut);
        Ok(())
    }
}

/// The longest gap in seconds that does not spoil a scan, since repeating a frame bridges the gap.
const BRIDGED_S: f64 = 1e-3;

fn is_long(gap: &Range<u64>, rate_hz: f64) -> bool {
    (gap.end - gap.start) as f64 > BRIDGED_S * rate_hz
}

/// Cuts a scan out of the streams; `None` if the scan has not ended.
pub(super) fn cut(marked: Marked, streams: &[Stream]) -> Option<Scan> {
    let (ended_at, _) = marked.ended?;
    let (mut signals, mut lost_samples) = (BTreeMap::new(), 0);
    let mut spoiled = marked.spoiled;
    for (source, cut) in &marked.cuts {
        let (signal, lost, why) = match &streams[cut.stream].buffer {
            StreamBuffer::Series { history, .. } => cut_series(source, cut, history),
            StreamBuffer::Images { recent, .. } => match image(recent, cut.start) {
                Some(image) => (Some(Signal::Image(Image::clone(image))), 0, None),
                None => (None, 1, Some(Doubt::PictureLost { source: source.clone() })),
            },
        };
        lost_samples += lost;
        spoiled.extend(why);
        spoiled.extend(cut.off_pace(source, streams));
        signals.extend(signal.map(|signal| (source.clone(), signal)));
    }
    if signals.is_empty() {
        spoiled.push(Doubt::NoData);
    }
    let trial = Trial { key: TrialKey::new("", "", marked.number), signals };
    let drag_s = trial.longest_s(|id| marked.cuts[id].phase == Phase::Drag);
    let drag_s = drag_s.filter(|drag_s| *drag_s > 0.0);
    let scan_s = drag_s.or_else(|| trial.longest_s(|_| true)).unwrap_or(0.0);
    Some(Scan {
        number: marked.number,
        trial,
        truth: marked.begin.truth,
        synthetic: marked.begin.synthetic,
        scan_s,
        lost_samples,
        spoiled,
        rest: marked.rest,
        ended_at,
    })
}

/// The signal of one source, the number of its lost frames, and why the signal should not be trusted.
fn cut_series(
    source: &SourceId,
    cut: &SourceSpan,
    history: &SeriesHistory,
) -> (Option<Signal>, u64, Option<Doubt>) {
    let end = cut.end.unwrap_or(cut.start);
    let (seconds, of) = (|frames: u64| frames as f64 / cut.rate_hz, || source.clone());
    let expected_s = seconds(end - cut.start);
    let (first, samples) = history.frames(cut.start..end);
    let kept = (samples.len() / history.channels) as u64;
    let gaps: Vec<_> = history.missing_in(first..first + kept).collect();
    // Frames that were forgotten or never delivered are lost, too.
    let gone = (end - cut.start).saturating_sub(kept);
    let in_gaps: u64 = gaps.iter().map(|gap| gap.end - gap.start).sum();
    let lost = gone + in_gaps;
    let mut spoiled = None;
    if lost == end - cut.start {
        let doubt = Doubt::Missing { source: of(), missing_s: expected_s, expected_s };
        return (None, lost, Some(doubt));
    }
    let worst = gaps.iter().max_by_key(|gap| gap.end - gap.start);
    if gone > 0 {
        spoiled = Some(Doubt::Missing { source: of(), missing_s: seconds(gone), expected_s });
    } else if let Some(worst) = worst.filter(|worst| is_long(worst, cut.rate_hz)) {
        let gap_s = seconds(worst.end - worst.start);
        spoiled = Some(Doubt::Gap { source: of(), gap_s, bridged_s: BRIDGED_S });
    }
    let mut own = narrow(samples, history.channels, cut.channels);
    // At the very begin, no frame of this source precedes a gap, so the frame after it fills it.
    if let Some(gap) = gaps.into_iter().find(|gap| gap.start <= first && gap.end > first) {
        let at = (gap.end - first) as usize * cut.channels;
        if at < own.len() {
            let next = own[at..at + cut.channels].to_vec();
            own[..at].chunks_mut(cut.channels).for_each(|frame| frame.copy_from_slice(&next));
        }
    }
    match Series::new(cut.rate_hz, cut.channels, own) {
        Ok(series) => (Some(Signal::Series(series)), lost, spoiled),
        Err(error) => (None, lost, Some(Doubt::Unusable { source: of(), why: error.to_string() })),
    }
}

/// New frames of one source (in a [`Progress`]) or of one stream (in a [`Trace`]).
#[derive(Clone, Debug, PartialEq)]
pub struct Fresh {
    pub source: SourceId,
    pub rate_hz: f64,
    pub channels: usize,
    /// Index of the first frame, counted from the start of the source or stream.
    pub start: u64,
    pub samples: Vec<f32>,
}

#[derive(Clone, Debug, Default)]
pub struct Progress {
    pub number: u32,
    pub truth: Option<TrialKey>,
    /// Seconds of drag that this snapshot and all earlier ones hold together.
    pub scan_s: f64,
    /// New frames, one item for each source.
    pub fresh: Vec<Fresh>,
    pub images: Vec<(SourceId, Arc<Image>)>,
    /// Whether new frames are missing for longer than can be bridged, so that repeated ones fill a gap.
    pub gap: bool,
    /// Number of new frames that are missing, over all sources.
    pub lost: u64,
    /// The sources whose rate is known to be wrong now.
    pub off_pace: Vec<Doubt>,
}

impl Progress {
    pub(crate) fn append(&mut self, later: Self) {
        (self.scan_s, self.truth) = (later.scan_s, later.truth);
        self.gap |= later.gap;
        self.lost += later.lost;
        self.off_pace = later.off_pace;
        for fresh in later.fresh {
            match self.fresh.iter_mut().find(|own| own.source == fresh.source) {
                Some(own) => own.samples.extend(fresh.samples),
                None => self.fresh.push(fresh),
            }
        }
        self.images.extend(later.images);
    }
}

/// New data of the streams, during scans and between them.
#[derive(Clone, Debug)]
pub struct Trace {
    /// New frames, one item for each stream.
    pub fresh: Vec<Fresh>,
    /// The latest picture of each camera stream that has a new one.
    pub images: Vec<(SourceId, Arc<Image>)>,
}

/// Makes the next snapshot of a scan. Returns the number of its step (of `every_s` seconds of drag),
/// the number of frames of each source sent so far, and the snapshot; `None` if no new step is reached.
///
/// With `exact`, no step is skipped, and the snapshot waits until every source has reached its
/// step, so that the snapshot does not depend on how data arrive. Without `exact`, the snapshot
/// covers the latest step that any source has reached.
pub(super) fn next_snapshot(
    marked: &Marked,
    streams: &[Stream],
    every_s: f64,
    exact: bool,
) -> Option<(u64, Vec<u64>, Progress)> {
    let drags = || marked.cuts.values().filter(|cut| cut.phase == Phase::Drag);
    let reached = |step: u64| {
        let seconds = step as f64 * every_s;
        drags().any(|cut| cut.available(streams) >= cut.until(seconds))
    };
    let mut step = marked.steps + 1;
    if !reached(step) {
        return None;
    }
    if exact {
        let there = |cut: &SourceSpan| {
            let seconds = step as f64 * every_s;
            let far = cut.phase == Phase::Drag && cut.available(streams) >= cut.until(seconds);
            far || cut.delivered(streams)
        };
        if !marked.cuts.values().all(there) {
            return None;
        }
    } else {
        while reached(step + 1) {
            step += 1;
        }
    }
    let scan_s = step as f64 * every_s;
    let (number, truth) = (marked.number, marked.truth_at(scan_s).cloned());
    let mut progress = Progress { number, truth, scan_s, ..Progress::default() };
    let mut sent: Vec<u64> = marked.cuts.values().map(|cut| cut.sent).collect();
    for ((source, cut), sent) in marked.cuts.iter().zip(&mut sent) {
        progress.off_pace.extend(cut.off_pace(source, streams));
        match &streams[cut.stream].buffer {
            StreamBuffer::Series { history, .. } => {
                let until = match cut.phase {
                    Phase::Drag => cut.until(scan_s).min(cut.available(streams)),
                    _ => cut.available(streams),
                };
                let (first, samples) = history.frames(cut.start + cut.sent..until);
                for gap in history.missing_in(first..until) {
                    progress.gap |= is_long(&gap, cut.rate_hz);
                    progress.lost += gap.end - gap.start;
                }
                if !samples.is_empty() {
                    *sent += (samples.len() / history.channels) as u64;
                    progress.fresh.push(Fresh {
                        source: source.clone(),
                        rate_hz: cut.rate_hz,
                        channels: cut.channels,
                        start: cut.sent,
                        samples: narrow(samples, history.channels, cut.channels),
                    });
                }
            }
            StreamBuffer::Images { recent, .. } => {
                if let Some(image) = image(recent, cut.start).filter(|_| cut.sent == 0) {
                    *sent = 1;
                    progress.images.push((source.clone(), image.clone()));
                }
            }
        }
    }
    Some((step, sent, progress))
}

pub(super) fn trace(streams: &[Stream]) -> Trace {
    let (mut fresh, mut images) = (Vec::new(), Vec::new());
    for stream in streams {
        match &stream.buffer {
            StreamBuffer::Series { history, .. } => {
                let (start, samples) = history.frames(stream.traced..u64::MAX);
                if !samples.is_empty() {
                    fresh.push(Fresh {
                        source: stream.id.clone(),
                        rate_hz: stream.rate_hz,
                        channels: history.channels,
                        start,
                        samples: samples.to_vec(),
                    });
                }
            }
            StreamBuffer::Images { recent, .. } => {
                let new = recent.back().filter(|(at, _)| *at >= stream.traced);
                images.extend(new.map(|(_, image)| (stream.id.clone(), image.clone())));
            }
        }
    }
    Trace { fresh, images }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::StreamSpec;
    use crate::ring::Waker;
    use crate::scan::Options;

    fn progress(scan_s: f64, parts: &[(&str, u64, &[f32])]) -> Progress {
        let fresh = parts.iter().map(|(source, start, samples)| Fresh {
            source: SourceId::new(source).unwrap(),
            rate_hz: 10.0,
            channels: 1,
            start: *start,
            samples: samples.to_vec(),
        });
        Progress { number: 1, scan_s, fresh: fresh.collect(), ..Progress::default() }
    }

    #[test]
    fn appended_snapshots_hold_what_each_of_them_held() {
        let mut all = progress(0.2, &[("ac", 0, &[1.0, 2.0])]);
        all.append(progress(0.4, &[("ac", 2, &[3.0]), ("ir", 0, &[9.0])]));
        let expected = progress(0.4, &[("ac", 0, &[1.0, 2.0, 3.0]), ("ir", 0, &[9.0])]);
        assert_eq!((all.scan_s, all.fresh), (expected.scan_s, expected.fresh));
    }

    #[test]
    fn a_snapshot_says_whether_frames_of_its_own_fill_a_gap() {
        let id = SourceId::new("ac").unwrap();
        let (rate_hz, channels) = (100.0, 1);
        let spec = StreamSpec::series(&id, channels, rate_hz);
        let (mut sink, stream) = Stream::open(&spec, 0, &Options::default(), Waker::new().0);
        let (sink, mut streams) = (sink.series().unwrap(), [stream]);
        sink.push(&[0.5; 12]);
        sink.skip(5);
        sink.push(&[0.5; 14]);
        streams[0].drain(10.0);
        let mut marked = Marked::default();
        let cut = CutFrom { source: id.clone(), stream: id, phase: Phase::Drag, channels };
        marked.follow(Mark::Open(Open { cut, start: 0, rate_hz }), &streams).unwrap();
        let mut gaps = Vec::new();
        while let Some((step, sent, snapshot)) = next_snapshot(&marked, &streams, 0.1, true) {
            gaps.push((snapshot.gap, snapshot.lost));
            marked.steps = step;
            marked.cuts.values_mut().zip(sent).for_each(|(cut, sent)| cut.sent = sent);
        }
        assert_eq!(gaps, [(false, 0), (true, 5), (false, 0)]);
        streams[0].off_pace_hz = Some(112.0);
        marked.ended = Some((Instant::now(), Instant::now()));
        let scan = super::cut(marked, &streams).unwrap();
        let source = SourceId::new("ac").unwrap();
        let off_pace = Doubt::WrongRate { source, seen_hz: 112.0, rate_hz };
        assert!(off_pace.spoils() && scan.spoiled.contains(&off_pace), "{:?}", scan.spoiled);
    }
}
