//! Scans that were begun: their marks so far, until all their data have come out of the rings.

use std::collections::BTreeMap;
use std::time::Instant;

use super::stream::Stream;
use crate::device::{Begin, Mark, Open};
use crate::scene::{Phase, SourceId};

/// A scan that was begun.
#[derive(Debug)]
pub(super) struct Marked {
    pub number: u32,
    pub begin: Begin,
    /// The device that began it.
    pub device: usize,
    pub cuts: BTreeMap<SourceId, SourceSpan>,
    /// When its last sample was taken, and when its end became known.
    pub ended: Option<(Instant, Instant)>,
    /// How many steps of progress were sent.
    pub steps: u64,
    /// For people: what spoils it, besides what its data show.
    pub spoiled: Vec<String>,
    /// The part that it has come to.
    pub phase: Option<Phase>,
}

/// The span of one source in its stream.
#[derive(Debug)]
pub(super) struct SourceSpan {
    /// Index of its stream.
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
    /// Index after the last frame that is the source's and has come out of its ring.
    pub fn available(&self, streams: &[Stream]) -> u64 {
        let end = self.end.unwrap_or(u64::MAX);
        streams[self.stream].end().min(end).max(self.start)
    }

    /// Whether all that belongs to the source has come out of its ring, or never will.
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

    /// Whether every ring has delivered up to the marks.
    pub fn complete(&self, streams: &[Stream]) -> bool {
        self.ended.is_some() && self.cuts.values().all(|cut| cut.delivered(streams))
    }

    /// Follows a mark other than a begin.
    ///
    /// # Errors
    /// With what does not fit together, for people.
    pub fn follow(&mut self, mark: Mark, streams: &[Stream]) -> Result<(), String> {
        match mark {
            // These make and unmake a scan, and never reach one.
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
            return Err(format!("{source} would be cut from {stream}, which is no stream"));
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
