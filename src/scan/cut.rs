//! Cuts a scan out of the histories, and says what was lost in it.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::Scan;
use super::history::{SeriesHistory, narrow};
use super::mark::{Marked, SourceSpan};
use super::stream::{Stream, StreamBuffer};
use crate::scene::{Phase, SourceId};
use crate::trial::{Series, Signal, Trial, TrialKey};

/// The longest gap that is bridged, in seconds.
const BRIDGED_S: f64 = 1e-3;

/// What was cut for one source.
struct CutPiece {
    signal: Option<Signal>,
    lost: u64,
    spoiled: Option<String>,
}

/// Makes the scan of marks whose data have been delivered, as far as they ever will be.
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
    // What was forgotten or never delivered is missing as well.
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
        spoiled =
            Some(format!("{source}: {:.1} ms of it were not kept or never arrived", ms(gone)));
    } else if worst as f64 > BRIDGED_S * cut.rate_hz {
        spoiled = Some(format!(
            "{source}: a gap of {:.1} ms, longer than the {:.0} ms that can be bridged",
            ms(worst),
            BRIDGED_S * 1e3
        ));
    }
    let mut own = narrow(samples, history.channels(), cut.channels);
    // A gap at the very begin has no frame of this source before it: take the one after it.
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
