//! A scan that has begun: marks say where its sources begin and end, and once all its data have
//! come, it is cut out of the streams.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use super::Scan;
use super::stream::{SeriesHistory, Stream, StreamBuffer, narrow};
use crate::device::{Begin, Mark, Open};
use crate::scene::{Phase, SourceId};
use crate::trial::{Series, Signal, Trial, TrialKey};

/// A scan that has begun and is not sent yet.
#[derive(Debug)]
pub(super) struct Marked {
    pub number: u32,
    pub begin: Begin,
    /// The device that began it.
    pub device: usize,
    pub cuts: BTreeMap<SourceId, SourceSpan>,
    /// The time of its last sample, and the time when its end became known.
    pub ended: Option<(Instant, Instant)>,
    /// Number of the last step of progress that was sent.
    pub steps: u64,
    /// Reasons why the scan should not be trusted, besides those found in its data.
    pub spoiled: Vec<String>,
    /// The part that it has reached.
    pub phase: Option<Phase>,
}

/// The span of one source in its stream.
#[derive(Debug)]
pub(super) struct SourceSpan {
    pub stream: usize,
    pub start: u64,
    pub end: Option<u64>,
    pub phase: Phase,
    pub rate_hz: f64,
    pub channels: usize,
    /// Frames that were sent as progress.
    pub sent: u64,
}

impl SourceSpan {
    /// Index after the last frame of the source that has come out of the ring.
    pub fn available(&self, streams: &[Stream]) -> u64 {
        let end = self.end.unwrap_or(u64::MAX);
        streams[self.stream].end().min(end).max(self.start)
    }

    /// Whether all frames of the source have come out of the ring, or never will.
    pub fn delivered(&self, streams: &[Stream]) -> bool {
        let stream = &streams[self.stream];
        self.end.is_some_and(|end| stream.end() >= end || stream.exhausted())
    }
}

impl Marked {
    pub fn new(number: u32, device: usize, begin: Begin) -> Self {
        Self {
            number,
            begin,
            device,
            cuts: BTreeMap::new(),
            ended: None,
            steps: 0,
            spoiled: Vec::new(),
            phase: None,
        }
    }

    /// Whether the scan has ended and the rings have delivered all of its frames.
    pub fn complete(&self, streams: &[Stream]) -> bool {
        self.ended.is_some() && self.cuts.values().all(|cut| cut.delivered(streams))
    }

    /// Applies a mark other than a begin.
    ///
    /// # Errors
    /// With a message, if the marks contradict each other.
    pub fn follow(&mut self, mark: Mark, streams: &[Stream]) -> Result<(), String> {
        match mark {
            // The collector applies these itself.
            Mark::Begin(_) | Mark::GiveUp { .. } => {}
            Mark::Spoil { why } => self.spoiled.push(why),
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
                    let pushed = streams[cut.stream].pushed();
                    cut.end.get_or_insert(pushed.max(cut.start));
                }
                self.ended = Some((at, Instant::now()));
            }
        }
        Ok(())
    }

    fn open(&mut self, open: Open, streams: &[Stream]) -> Result<(), String> {
        let Open { source, stream, start, phase, rate_hz, channels } = open;
        let Some(index) = streams.iter().position(|s| s.id() == &stream) else {
            return Err(format!("{source} would be cut from {stream}, which does not exist"));
        };
        if !(rate_hz.is_finite() && rate_hz > 0.0) {
            return Err(format!("{source} would have a rate of {rate_hz} Hz"));
        }
        let widest = streams[index].channels();
        if channels == 0 || channels > widest {
            return Err(format!("{source} would have {channels} of {widest} channels"));
        }
        let cut = SourceSpan { stream: index, start, end: None, phase, rate_hz, channels, sent: 0 };
        self.cuts.insert(source, cut);
        Ok(())
    }
}

/// The longest gap that is bridged, in seconds.
const BRIDGED_S: f64 = 1e-3;

/// The signal cut for one source.
struct CutPiece {
    signal: Option<Signal>,
    lost: u64,
    spoiled: Option<String>,
}

/// Cuts a scan out of the streams once its data have come; `None` if it has not ended.
pub(super) fn cut(marked: Marked, streams: &[Stream]) -> Option<Scan> {
    let (ended_at, _) = marked.ended?;
    let mut signals = BTreeMap::new();
    let mut lost_by_source = BTreeMap::new();
    let mut spoiled = marked.spoiled;
    for (source, cut) in &marked.cuts {
        let piece = cut_source(source, cut, &streams[cut.stream]);
        lost_by_source.insert(source.clone(), piece.lost);
        spoiled.extend(piece.spoiled);
        if let Some(signal) = piece.signal {
            signals.insert(source.clone(), signal);
        }
    }
    if signals.is_empty() {
        spoiled.push("no source of the scene has any data in this scan".into());
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
        lost_samples: lost_by_source.values().sum(),
        lost_by_source,
        spoiled,
        ended_at,
    })
}

fn cut_source(source: &SourceId, cut: &SourceSpan, stream: &Stream) -> CutPiece {
    let end = cut.end.unwrap_or(cut.start);
    match stream.buffer() {
        StreamBuffer::Series { history, .. } => cut_series(source, cut, end, history),
        StreamBuffer::Images { history, .. } => match history.get(cut.start) {
            Some(image) => {
                let image = Arc::unwrap_or_clone(image.clone());
                CutPiece { signal: Some(Signal::Image(image)), lost: 0, spoiled: None }
            }
            None => CutPiece {
                signal: None,
                lost: 1,
                spoiled: Some(format!("{source}: the picture was lost")),
            },
        },
    }
}

fn cut_series(source: &SourceId, cut: &SourceSpan, end: u64, history: &SeriesHistory) -> CutPiece {
    let span = cut.start..end;
    let ms = |frames: u64| frames as f64 / cut.rate_hz * 1e3;
    let (first, samples) = history.frames(span.clone());
    let kept = (samples.len() / history.channels()) as u64;
    let mut gaps: Vec<_> = history.missing_in(first..first + kept).collect();
    // Forgotten and undelivered frames are missing as well.
    let gone = (end - cut.start).saturating_sub(kept);
    let in_gaps: u64 = gaps.iter().map(|gap| gap.end - gap.start).sum();
    let lost = gone + in_gaps;
    let mut spoiled = None;
    if lost == end - cut.start {
        let spoiled = format!("{source}: none of its {:.1} ms arrived", ms(lost));
        return CutPiece { signal: None, lost, spoiled: Some(spoiled) };
    }
    let worst = gaps.iter().map(|gap| gap.end - gap.start).max().unwrap_or(0);
    if gone > 0 {
        spoiled = Some(format!("{source}: {:.1} ms of it are missing", ms(gone)));
    } else if worst as f64 > BRIDGED_S * cut.rate_hz {
        spoiled = Some(format!(
            "{source}: a gap of {:.1} ms, longer than the {:.0} ms that can be bridged",
            ms(worst),
            BRIDGED_S * 1e3
        ));
    }
    let mut own = narrow(samples, history.channels(), cut.channels);
    // A gap at the very begin has no frame of this source before it: repeat the one after it.
    if let Some(gap) = gaps.drain(..).find(|gap| gap.start <= first && gap.end > first) {
        let at = (gap.end - first) as usize * cut.channels;
        if at < own.len() {
            let next = own[at..at + cut.channels].to_vec();
            own[..at].chunks_mut(cut.channels).for_each(|frame| frame.copy_from_slice(&next));
        }
    }
    match Series::new(cut.rate_hz, cut.channels, own) {
        Ok(series) => CutPiece { signal: Some(Signal::Series(series)), lost, spoiled },
        Err(error) => {
            let spoiled = Some(format!("{source} is left out: {error}"));
            CutPiece { signal: None, lost, spoiled }
        }
    }
}
