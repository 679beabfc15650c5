//! Reduces streams to an amount that can be drawn, by the extremes of short time bins and by spectra.

use std::collections::{BTreeMap, VecDeque};

use serde::Serialize;

use crate::history::{Bands, WINDOW, bands, four_digits};
use crate::scan::{Fresh, Trace};
use crate::scene::SourceId;

const BINS_A_SECOND: f64 = 200.0;
/// How many bins of one stream an event may hold. If there are more, only the newest are sent.
const MOST_BINS: usize = 400;

#[derive(Debug, PartialEq, Serialize)]
pub(super) struct TraceEvent {
    pub streams: Vec<Bins>,
    /// Camera streams with a new picture.
    pub pictures: Vec<SourceId>,
}

#[derive(Debug, PartialEq, Serialize)]
pub(super) struct Bins {
    pub source: SourceId,
    pub bin_s: f64,
    /// The start of the first bin, in seconds since the start of the stream.
    pub start_s: f64,
    /// The smallest sample of each bin, in one list for each channel.
    pub min: Vec<Vec<f32>>,
    pub max: Vec<Vec<f32>>,
    /// Indexes of the bins in which a channel is clipped.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub clipped: Vec<usize>,
}

#[derive(Debug, Default)]
pub(super) struct Tracer {
    streams: BTreeMap<SourceId, TracedStream>,
}

/// A stream that is drawn, with the bin being filled and the newest frames.
#[derive(Debug)]
pub(super) struct TracedStream {
    pub rate_hz: f64,
    pub channels: usize,
    /// The newest samples, interleaved; at most [`WINDOW`] frames.
    pub recent: VecDeque<f32>,
    bin_frames: usize,
    /// Index of the next expected frame.
    next: u64,
    /// Number of frames in the bin being filled.
    filled: usize,
    /// Smallest and largest sample of the bin being filled, one pair for each channel.
    extremes: Vec<(f32, f32)>,
    limits: Vec<ChannelLimits>,
    /// Whether a channel was clipped in the bin being filled.
    clipped: bool,
}

/// Detects clipping: several successive samples equal the highest or lowest value so far.
#[derive(Clone, Debug)]
struct ChannelLimits {
    low: f32,
    high: f32,
    last: f32,
    /// Number of successive samples, up to the last one, with the same value.
    run: usize,
    /// Number of samples between the limits that differ from the previous sample; 0 for a switch.
    between: usize,
    /// Decaying counts of samples in runs of at least [`RUN`], first at the limits, then between the
    /// limits. Coarse or repeated values raise both counts, but clipping raises only the first.
    rested: [f32; 2],
}

/// This many successive samples at a limit count as clipped.
const RUN: usize = 3;
/// Factor by which `rested` decays with each sample, so that it covers the last few thousand.
const MEMORY: f32 = 1.0 - 1.0 / 4096.0;
/// A sample is clipped only if runs at the limits are this many times as frequent as runs between.
const ABOVE_ELSEWHERE: f32 = 4.0;
/// Resting samples at the limits must be this many, since fewer may be the crest of a slow signal.
const FEWEST_AT_LIMITS: f32 = 16.0;
/// A channel with fewer values between its limits is a switch or a coarse converter.
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

    /// Adds the next sample; true if it is clipped.
    fn add(&mut self, x: f32) -> bool {
        self.run = if x == self.last { self.run + 1 } else { 1 };
        self.last = x;
        let at_limit = x <= self.low || x >= self.high;
        if x < self.low || x > self.high {
            // The signal exceeds the limit, so the resting samples there now count as in between.
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
        // A channel that stays at zero is at rest, not clipped.
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
            bin_frames: (fresh.rate_hz / BINS_A_SECOND).round().max(1.0) as usize,
            next: fresh.start,
            filled: 0,
            extremes: vec![NONE_YET; fresh.channels],
            limits: vec![ChannelLimits::NEW; fresh.channels],
            clipped: false,
        }
    }

    /// Adds new frames, and returns the bins that are now full.
    fn add(&mut self, fresh: &Fresh) -> Bins {
        let mut bins = Bins {
            source: fresh.source.clone(),
            bin_s: self.bin_frames as f64 / self.rate_hz,
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
            if self.filled == self.bin_frames {
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
        bins.drop_old();
        bins
    }

    fn remember(&mut self, samples: &[f32]) {
        let most = WINDOW * self.channels;
        let samples = &samples[samples.len().saturating_sub(most)..];
        let over = (self.recent.len() + samples.len()).saturating_sub(most);
        self.recent.drain(..over);
        self.recent.extend(samples);
    }
}

impl Bins {
    fn drop_old(&mut self) {
        let over = self.len().saturating_sub(MOST_BINS);
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
    /// Returns the bins and pictures to draw. After a gap or a change of rate, a stream starts again.
    pub(super) fn add(&mut self, trace: &Trace) -> TraceEvent {
        let mut streams = Vec::new();
        for fresh in trace.fresh.iter().filter(|fresh| fresh.channels > 0) {
            let stream = self.streams.entry(fresh.source.clone());
            let stream = stream.or_insert_with(|| TracedStream::new(fresh));
            let expected = (stream.next, stream.channels, stream.rate_hz);
            if expected != (fresh.start, fresh.channels, fresh.rate_hz) {
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
}

#[derive(Debug, Serialize)]
pub(super) struct StreamBands {
    pub source: SourceId,
    #[serde(flatten)]
    pub bands: Bands,
}

/// The spectrum of the newest frames of each stream that has enough frames.
pub(super) fn spectra(tracer: &Tracer) -> Vec<StreamBands> {
    let of = |(source, stream): (&SourceId, &TracedStream)| {
        let TracedStream { rate_hz, channels, recent, .. } = stream;
        let full = recent.len() >= WINDOW * channels;
        let samples: Vec<f32> = recent.iter().copied().collect();
        let bands = full.then(|| bands(&samples, *channels, *rate_hz))??;
        Some(StreamBands { source: source.clone(), bands })
    };
    tracer.streams.iter().filter_map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

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
        let clipped = |frames, sample: &dyn Fn(usize) -> f32| {
            let event = Tracer::default().add(&fresh(0, (0..frames).map(sample).collect()));
            event.streams[0].clipped.len()
        };
        let sine = |i: usize| (i as f32 * 0.1).sin();
        assert!(clipped(1000, &|i| sine(i).clamp(-0.7, 0.7)) > 20);
        assert_eq!(clipped(1000, &sine), 0);
        let coarse = |i: usize| ((i as f32 * 12.9898).sin() * 43_758.547).fract() * 3.0;
        assert_eq!(clipped(9000, &|i| coarse(i / 2).round()), 0);
        assert_eq!(clipped(1000, &|i| f32::from(u8::from(i % 100 > 50))), 0, "a switch");
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
        let event = tracer.add(&fresh(0, (0..1_000_000).map(|i| i as f32).collect()));
        assert_eq!(event.streams[0].len(), MOST_BINS);
        assert!((event.streams[0].start_s - 998.0).abs() < 1e-9);
        let (_, stream) = tracer.streams.first_key_value().unwrap();
        assert_eq!(stream.recent.len(), WINDOW);
        assert_eq!(stream.recent.back(), Some(&999_999.0));
    }

    #[test]
    fn a_stream_has_a_spectrum_once_it_has_enough_frames() {
        for (frames, spectra_of) in [(WINDOW - 1, 0), (WINDOW, 1)] {
            let mut tracer = Tracer::default();
            tracer.add(&fresh(0, vec![0.0; frames]));
            assert_eq!(spectra(&tracer).len(), spectra_of);
        }
    }
}
