//! Snapshots of a scan in progress, in steps of scan time: each carries only the new data.
//!
//! A snapshot whose reader is busy is not sent: the next one carries its data too, so a reader that
//! joins the snapshots has the scan without a gap.

use std::sync::Arc;

use super::marked_scan::{Marked, SourceSpan};
use super::stream::{Stream, StreamBuffer, narrow};
use crate::scene::{Phase, SourceId};
use crate::trial::{Image, TrialKey};

/// New frames of one source, or of one stream.
#[derive(Clone, Debug, PartialEq)]
pub struct Fresh {
    /// The source, or the stream.
    pub source: SourceId,
    /// Frames a second.
    pub rate_hz: f64,
    /// Samples a frame.
    pub channels: usize,
    /// Index of the first frame, counted from the start of the source, or of the stream.
    pub start: u64,
    /// Interleaved samples.
    pub samples: Vec<f32>,
}

/// New data of the scan in progress.
#[derive(Clone, Debug)]
pub struct Progress {
    /// Number of the scan.
    pub number: u32,
    /// As [`super::Scan::truth`].
    pub truth: Option<TrialKey>,
    /// Seconds of drag that the snapshots hold so far.
    pub scan_s: f64,
    /// New frames, one item for each source.
    pub fresh: Vec<Fresh>,
    /// New pictures.
    pub images: Vec<(SourceId, Arc<Image>)>,
}

impl Progress {
    /// Appends the data of a `later` snapshot of the same scan.
    pub(crate) fn append(&mut self, later: Self) {
        self.scan_s = later.scan_s;
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

impl SourceSpan {
    /// Index after the frames of the source's first `seconds`, rounded up.
    fn until(&self, seconds: f64) -> u64 {
        self.start + (seconds * self.rate_hz).ceil() as u64
    }
}

/// The next snapshot of a scan, in steps of `every_s` seconds of drag, and the number of its step.
///
/// With `exact`, no step is skipped, and the snapshot waits until every source has delivered up to
/// its step, so that it does not depend on how the data arrive. Otherwise it is taken as soon as
/// one source has, at the latest step that any source has reached.
pub(super) fn next(
    marked: &Marked,
    streams: &[Stream],
    every_s: f64,
    exact: bool,
) -> Option<(u64, Progress)> {
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
    let (number, truth) = (marked.number, marked.begin.truth.clone());
    let mut progress = Progress { number, truth, scan_s, fresh: vec![], images: vec![] };
    for (source, cut) in &marked.cuts {
        match streams[cut.stream].buffer() {
            StreamBuffer::Series { history, .. } => {
                let until = match cut.phase {
                    Phase::Drag => cut.until(scan_s).min(cut.available(streams)),
                    _ => cut.available(streams),
                };
                let (_, samples) = history.frames(cut.start + cut.sent..until);
                if !samples.is_empty() {
                    progress.fresh.push(Fresh {
                        source: source.clone(),
                        rate_hz: cut.rate_hz,
                        channels: cut.channels,
                        start: cut.sent,
                        samples: narrow(samples, history.channels(), cut.channels),
                    });
                }
            }
            StreamBuffer::Images { history, .. } => {
                if let Some(image) = history.get(cut.start).filter(|_| cut.sent == 0) {
                    progress.images.push((source.clone(), image.clone()));
                }
            }
        }
    }
    Some((step, progress))
}

/// Notes that a snapshot was sent.
pub(super) fn sent(marked: &mut Marked, step: u64, lengths: &SnapshotLengths) {
    marked.steps = step;
    for (source, frames) in &lengths.0 {
        if let Some(cut) = marked.cuts.get_mut(source) {
            cut.sent += frames;
        }
    }
}

pub(super) struct SnapshotLengths(Vec<(SourceId, u64)>);

impl SnapshotLengths {
    pub fn of(progress: &Progress) -> Self {
        let series = progress
            .fresh
            .iter()
            .map(|fresh| (fresh.source.clone(), (fresh.samples.len() / fresh.channels) as u64));
        let images = progress.images.iter().map(|(source, _)| (source.clone(), 1));
        Self(series.chain(images).collect())
    }
}

/// The streams' data since each was last traced, and the index after these data in each stream.
pub(super) fn trace(streams: &[Stream]) -> (Vec<u64>, Trace) {
    let (mut fresh, mut images) = (Vec::new(), Vec::new());
    for stream in streams {
        match stream.buffer() {
            StreamBuffer::Series { history, rate_hz, .. } => {
                let (start, samples) = history.frames(stream.traced..u64::MAX);
                if !samples.is_empty() {
                    fresh.push(Fresh {
                        source: stream.id().clone(),
                        rate_hz: *rate_hz,
                        channels: history.channels(),
                        start,
                        samples: samples.to_vec(),
                    });
                }
            }
            StreamBuffer::Images { history, .. } => {
                let new = history.latest().filter(|(at, _)| *at >= stream.traced);
                images.extend(new.map(|(_, image)| (stream.id().clone(), image.clone())));
            }
        }
    }
    (streams.iter().map(Stream::end).collect(), Trace { fresh, images })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn progress(scan_s: f64, parts: &[(&str, u64, &[f32])]) -> Progress {
        let fresh = parts.iter().map(|(source, start, samples)| Fresh {
            source: SourceId::new(source).unwrap(),
            rate_hz: 10.0,
            channels: 1,
            start: *start,
            samples: samples.to_vec(),
        });
        Progress { number: 1, truth: None, scan_s, fresh: fresh.collect(), images: Vec::new() }
    }

    #[test]
    fn appended_snapshots_hold_what_each_of_them_held() {
        let mut all = progress(0.2, &[("ac", 0, &[1.0, 2.0])]);
        all.append(progress(0.4, &[("ac", 2, &[3.0]), ("ir", 0, &[9.0])]));
        let expected = progress(0.4, &[("ac", 0, &[1.0, 2.0, 3.0]), ("ir", 0, &[9.0])]);
        assert_eq!((all.scan_s, all.fresh), (expected.scan_s, expected.fresh));
    }
}
