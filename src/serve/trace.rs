//! Makes streams small enough to draw: the extremes of short bins of time, and spectra.

use std::collections::{BTreeMap, VecDeque};

use serde::Serialize;

use crate::history::{Bands, bands, four_digits};
use crate::scan::{Fresh, Trace};
use crate::scene::SourceId;

/// Bins a second that a trace aims at.
const BINS_A_SECOND: f64 = 200.0;
/// Most bins of one stream in one event; of more, as in a fast replay, the newest are sent.
const MOST_BINS: usize = 400;
/// Frames of each stream that are kept for its spectrum.
pub const RECENT: usize = 4096;

/// New data of the streams, small enough to draw.
#[derive(Debug, PartialEq, Serialize)]
pub struct TraceEvent {
    pub streams: Vec<Bins>,
    /// Camera streams that have a new picture.
    pub pictures: Vec<SourceId>,
}

/// New bins of one stream.
#[derive(Debug, PartialEq, Serialize)]
pub struct Bins {
    /// The stream.
    pub source: SourceId,
    /// Seconds a bin.
    pub bin_s: f64,
    /// When the first bin begins, in seconds from the begin of the stream.
    pub start_s: f64,
    /// Least sample of each bin, one list for each channel.
    pub min: Vec<Vec<f32>>,
    /// Greatest sample of each bin, one list for each channel.
    pub max: Vec<Vec<f32>>,
    /// The bins, counted from 0, in which a channel rests at its limit.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub clipped: Vec<usize>,
}

/// Makes bins of all streams.
#[derive(Debug, Default)]
pub struct Tracer {
    streams: BTreeMap<SourceId, TracedStream>,
}

/// One stream: its unfinished bin, and its newest frames.
#[derive(Debug)]
pub struct TracedStream {
    /// Frames a second.
    pub rate_hz: f64,
    /// Samples a frame.
    pub channels: usize,
    /// The newest samples, interleaved; at most [`RECENT`] frames.
    pub recent: VecDeque<f32>,
    /// Frames a bin.
    width: usize,
    /// Index of the frame that is expected next.
    next: u64,
    /// Frames in the unfinished bin.
    filled: usize,
    /// Least and greatest sample in the unfinished bin, one pair for each channel.
    extremes: Vec<(f32, f32)>,
    /// The limits of each channel.
    limits: Vec<ChannelLimits>,
    /// Whether a channel rested at its limit in the unfinished bin.
    clipped: bool,
}

/// Finds where a channel runs into its limits: samples in a row at the highest or lowest value that
/// it has had.
#[derive(Clone, Debug)]
struct ChannelLimits {
    low: f32,
    high: f32,
    last: f32,
    /// Length of the run of samples that equal the last one.
    run: usize,
    /// Samples between the limits that differed from the one before; a switch has none.
    between: usize,
    /// Recent samples in runs of at least [`RUN`], at the limits and between them; coarse or
    /// repeated values rest at both.
    rested: [f32; 2],
}

/// This many samples in a row at a limit are clipped.
const RUN: usize = 3;
/// Share of `rested` that remains after one sample, so that it covers some thousand samples.
const MEMORY: f32 = 1.0 - 1.0 / 4096.0;
/// Limits must hold this many times as many resting samples as all other values.
const ABOVE_ELSEWHERE: f32 = 4.0;
/// Fewer resting samples at the limits may be the crest of a slow signal.
const FEWEST_AT_LIMITS: f32 = 16.0;
/// With fewer values between its limits, a channel is a switch or a coarse converter.
const FEWEST_BETWEEN: usize = 16;

impl ChannelLimits {
    const NEW: Self = Self {
        low: f32::INFINITY,
        high: f32::NEG_INFINITY,
        last: f32::NAN,
        run: 0,
        between: 0,
        rested: [0.0; 2],
    };

    /// Takes the next sample; true if it rests at a limit.
    fn add(&mut self, x: f32) -> bool {
        self.run = if x == self.last { self.run + 1 } else { 1 };
        self.last = x;
        let at_limit = x <= self.low || x >= self.high;
        if x < self.low || x > self.high {
            // A limit that the signal passes was none: its resting samples now count as between.
            self.rested = [0.0, self.rested[0] + self.rested[1]];
        }
        (self.low, self.high) = (self.low.min(x), self.high.max(x));
        self.between = self.between.saturating_add(usize::from(!at_limit && self.run == 1));
        let rests = self.run >= RUN;
        self.rested = self.rested.map(|rested| rested * MEMORY);
        self.rested[usize::from(!at_limit)] += f32::from(u8::from(rests));
        let [at_limits, elsewhere] = self.rested;
        let outstanding = at_limits > (ABOVE_ELSEWHERE * elsewhere).max(FEWEST_AT_LIMITS)
            && self.between >= FEWEST_BETWEEN;
        // At zero, the sensor is at rest.
        at_limit && x != 0.0 && rests && outstanding
    }
}

const NONE_YET: (f32, f32) = (f32::INFINITY, f32::NEG_INFINITY);

impl TracedStream {
    fn new(fresh: &Fresh) -> Self {
        Self {
            rate_hz: fresh.rate_hz,
            channels: fresh.channels,
            recent: VecDeque::new(),
            width: (fresh.rate_hz / BINS_A_SECOND).round().max(1.0) as usize,
            next: fresh.start,
            filled: 0,
            extremes: vec![NONE_YET; fresh.channels],
            limits: vec![ChannelLimits::NEW; fresh.channels],
            clipped: false,
        }
    }

    /// Whether frames follow the last ones without a gap, in the same format.
    fn continues(&self, fresh: &Fresh) -> bool {
        (self.next, self.channels, self.rate_hz) == (fresh.start, fresh.channels, fresh.rate_hz)
    }

    /// Takes new frames, and returns the bins that they fill.
    fn add(&mut self, fresh: &Fresh) -> Bins {
        let mut bins = Bins {
            source: fresh.source.clone(),
            bin_s: self.width as f64 / self.rate_hz,
            start_s: (self.next - self.filled as u64) as f64 / self.rate_hz,
            min: vec![Vec::new(); self.channels],
            max: vec![Vec::new(); self.channels],
            clipped: Vec::new(),
        };
        for frame in fresh.samples.chunks_exact(self.channels) {
            let channels = self.extremes.iter_mut().zip(&mut self.limits);
            for (((low, high), limits), &sample) in channels.zip(frame) {
                *low = low.min(sample);
                *high = high.max(sample);
                self.clipped |= limits.add(sample);
            }
            self.filled += 1;
            if self.filled == self.width {
                self.filled = 0;
                if std::mem::take(&mut self.clipped) {
                    bins.clipped.push(bins.len());
                }
                for (channel, extremes) in self.extremes.iter_mut().enumerate() {
                    bins.min[channel].push(four_digits(extremes.0));
                    bins.max[channel].push(four_digits(extremes.1));
                    *extremes = NONE_YET;
                }
            }
        }
        self.next += (fresh.samples.len() / self.channels) as u64;
        self.remember(&fresh.samples);
        bins.newest(MOST_BINS);
        bins
    }

    fn remember(&mut self, samples: &[f32]) {
        let most = RECENT * self.channels;
        let samples = &samples[samples.len().saturating_sub(most)..];
        let over = (self.recent.len() + samples.len()).saturating_sub(most);
        self.recent.drain(..over);
        self.recent.extend(samples);
    }
}

impl Bins {
    /// Forgets all but the newest `most`.
    fn newest(&mut self, most: usize) {
        let over = self.len().saturating_sub(most);
        self.start_s += over as f64 * self.bin_s;
        self.min.iter_mut().chain(&mut self.max).for_each(|values| drop(values.drain(..over)));
        self.clipped.retain(|bin| *bin >= over);
        self.clipped.iter_mut().for_each(|bin| *bin -= over);
    }

    fn len(&self) -> usize {
        self.min.first().map_or(0, Vec::len)
    }
}

impl Tracer {
    /// Takes new data, and returns the bins and pictures to draw. After a gap, or at another rate,
    /// a stream begins anew.
    pub fn add(&mut self, trace: &Trace) -> TraceEvent {
        let mut streams = Vec::new();
        for fresh in trace.fresh.iter().filter(|fresh| fresh.channels > 0) {
            let stream = self
                .streams
                .entry(fresh.source.clone())
                .or_insert_with(|| TracedStream::new(fresh));
            if !stream.continues(fresh) {
                *stream = TracedStream::new(fresh);
            }
            let bins = stream.add(fresh);
            if bins.len() > 0 {
                streams.push(bins);
            }
        }
        let pictures = trace.images.iter().map(|(source, _)| source.clone()).collect();
        TraceEvent { streams, pictures }
    }

    /// The streams, by name.
    pub fn streams(&self) -> impl Iterator<Item = (&SourceId, &TracedStream)> {
        self.streams.iter()
    }
}

/// The spectra of all streams.
#[derive(Debug, Serialize)]
pub struct SpectrumEvent {
    pub streams: Vec<StreamBands>,
}

/// The spectrum of one stream.
#[derive(Debug, Serialize)]
pub struct StreamBands {
    /// The stream.
    pub source: SourceId,
    /// Its spectrum.
    #[serde(flatten)]
    pub bands: Bands,
}

/// The spectra of the newest frames, of every stream that has enough of them.
pub fn spectra(tracer: &Tracer) -> SpectrumEvent {
    let of = |(source, stream): (&SourceId, &TracedStream)| {
        let TracedStream { rate_hz, channels, recent, .. } = stream;
        let full = recent.len() >= RECENT * channels;
        let samples: Vec<f32> = recent.iter().copied().collect();
        let bands = full.then(|| bands(&samples, *channels, *rate_hz, RECENT))??;
        Some(StreamBands { source: source.clone(), bands })
    };
    SpectrumEvent { streams: tracer.streams().filter_map(of).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scan::{Fresh, Trace};

    fn fresh(start: u64, samples: Vec<f32>) -> Trace {
        let source = SourceId::new("ir").unwrap();
        let fresh = vec![Fresh { source, rate_hz: 1000.0, channels: 1, start, samples }];
        Trace { fresh, images: Vec::new() }
    }

    #[test]
    fn bins_hold_the_extremes_and_wait_until_they_are_full() {
        let mut tracer = Tracer::default();
        let first = tracer.add(&fresh(0, vec![1.0, -2.0, 3.0, 0.0, 0.5, 9.0, 8.0]));
        let bins = &first.streams[0];
        assert_eq!((bins.start_s, bins.bin_s), (0.0, 0.005));
        assert_eq!((&bins.min[0], &bins.max[0]), (&vec![-2.0], &vec![3.0]));
        let second = tracer.add(&fresh(7, vec![-7.0, 1.0, 1.0]));
        let bins = &second.streams[0];
        assert_eq!(bins.start_s, 0.005, "the second bin began with the first frames");
        assert_eq!((&bins.min[0], &bins.max[0]), (&vec![-7.0], &vec![9.0]));
    }

    #[test]
    fn a_channel_that_rests_at_its_limit_is_marked_and_a_switch_is_not() {
        let mut tracer = Tracer::default();
        let sine = |i: usize| (i as f32 * 0.1).sin();
        let clipped = tracer.add(&fresh(0, (0..1000).map(|i| sine(i).clamp(-0.7, 0.7)).collect()));
        assert!(clipped.streams[0].clipped.len() > 20);
        let mut tracer = Tracer::default();
        assert!(tracer.add(&fresh(0, (0..1000).map(sine).collect())).streams[0].clipped.is_empty());
        let coarse = |i: usize| ((i as f32 * 12.9898).sin() * 43_758.547).fract() * 3.0;
        let mut tracer = Tracer::default();
        let noise = tracer.add(&fresh(0, (0..9000).map(|i| coarse(i / 2).round()).collect()));
        assert!(noise.streams[0].clipped.is_empty(), "{:?}", noise.streams[0].clipped);
        let mut tracer = Tracer::default();
        let switch = (0..1000).map(|i| f32::from(u8::from(i % 100 > 50))).collect();
        assert!(tracer.add(&fresh(0, switch)).streams[0].clipped.is_empty());
    }

    #[test]
    fn after_a_gap_a_stream_begins_anew_at_its_place() {
        let mut tracer = Tracer::default();
        tracer.add(&fresh(0, vec![5.0; 3]));
        let after = tracer.add(&fresh(1000, vec![1.0; 5]));
        assert_eq!((after.streams[0].start_s, &after.streams[0].max[0]), (1.0, &vec![1.0]));
    }

    #[test]
    fn only_the_newest_bins_of_a_long_stretch_are_sent_and_memory_is_bounded() {
        let mut tracer = Tracer::default();
        let samples = (0..1_000_000).map(|i| i as f32).collect();
        let event = tracer.add(&fresh(0, samples));
        assert_eq!(event.streams[0].len(), MOST_BINS);
        assert!((event.streams[0].start_s - 998.0).abs() < 1e-9);
        let (_, stream) = tracer.streams().next().unwrap();
        assert_eq!(stream.recent.len(), RECENT);
        assert_eq!(stream.recent.back(), Some(&999_999.0));
    }

    #[test]
    fn a_stream_has_a_spectrum_once_it_has_enough_frames() {
        for (frames, spectra_of) in [(RECENT - 1, 0), (RECENT, 1)] {
            let mut tracer = Tracer::default();
            let source = SourceId::new("ac").unwrap();
            let samples = vec![0.0; frames];
            let fresh = Fresh { source, rate_hz: 10_000.0, channels: 1, start: 0, samples };
            tracer.add(&Trace { fresh: vec![fresh], images: Vec::new() });
            assert_eq!(spectra(&tracer).streams.len(), spectra_of);
        }
    }
}
