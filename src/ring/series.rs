//! The ring of a series: interleaved samples, moved in slices of whole frames.

use std::sync::Arc;

use ringbuf::traits::{Consumer, Observer, Producer, Split};
use ringbuf::{HeapCons, HeapProd, HeapRb};

use super::ledger::{Ledger, Reckoning, half_full, pair};
use super::{Meter, Stop, Stopped, Waker};

/// The device's end of a ring of samples.
pub struct SeriesSink {
    ring: HeapProd<f32>,
    channels: usize,
    ledger: Ledger,
}

/// The collector's end of a ring of samples.
pub struct SeriesTap {
    ring: HeapCons<f32>,
    channels: usize,
    reckoning: Reckoning,
}

/// Samples or a gap that come out of a ring; pieces come in order.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Piece<'a> {
    /// Interleaved samples, in whole frames.
    Samples(&'a [f32]),
    /// This many frames are missing here.
    Missing(u64),
}

/// A ring of `capacity` frames of `channels` samples each, where 0 counts as 1.
pub fn series(channels: usize, capacity: usize, waker: Waker) -> (SeriesSink, SeriesTap) {
    let (channels, capacity) = (channels.max(1), capacity.max(1));
    let (enter, leave) = HeapRb::new(channels * capacity).split();
    let (ledger, reckoning) = pair(capacity, waker);
    (SeriesSink { ring: enter, channels, ledger }, SeriesTap { ring: leave, channels, reckoning })
}

impl SeriesSink {
    /// Samples a frame.
    pub fn channels(&self) -> usize {
        self.channels
    }

    /// Index of the next frame; lost ones are counted too.
    pub fn position(&self) -> u64 {
        self.ledger.head()
    }

    /// Puts frames into the ring without ever blocking. Returns how many did not fit: these are
    /// lost, and counted.
    ///
    /// # Panics
    /// If `samples.len()` is not a multiple of the number of channels.
    pub fn push(&mut self, samples: &[f32]) -> u64 {
        let frames = self.whole_frames(samples);
        let entered = self.enter(samples);
        let lost = (frames - entered) as u64;
        self.ledger.lose(lost);
        if half_full(&self.ring) {
            self.ledger.wake_collector();
        }
        lost
    }

    /// Puts all frames into the ring, waiting for room as often as it takes.
    ///
    /// # Errors
    /// If a stop was requested; frames that had not entered by then were never counted.
    ///
    /// # Panics
    /// If `samples.len()` is not a multiple of the number of channels.
    pub fn push_waiting(&mut self, samples: &[f32], stop: &Stop) -> Result<(), Stopped> {
        self.whole_frames(samples);
        let mut rest = samples;
        loop {
            rest = &rest[self.enter(rest) * self.channels..];
            if rest.is_empty() {
                return Ok(());
            }
            self.ledger.wait_for_room(stop)?;
        }
    }

    /// Counts frames as lost that the sensor took but that never arrived here, as a gap in a
    /// device's own sample counter shows.
    pub fn skip(&mut self, frames: u64) {
        self.ledger.lose(frames);
    }

    fn whole_frames(&self, samples: &[f32]) -> usize {
        let (len, channels) = (samples.len(), self.channels);
        assert!(len.is_multiple_of(channels), "{len} samples are not whole frames of {channels}");
        len / channels
    }

    /// Puts in the frames that fit, and returns their number.
    fn enter(&mut self, samples: &[f32]) -> usize {
        // Only whole frames enter and leave, so the room is a whole number of frames too.
        let fits = self.ring.vacant_len().min(samples.len()) / self.channels * self.channels;
        if fits == 0 || !self.ledger.settle() {
            return 0;
        }
        let frames = self.ring.push_slice(&samples[..fits]) / self.channels;
        self.ledger.entered(frames as u64);
        frames
    }
}

impl SeriesTap {
    /// Samples a frame.
    pub fn channels(&self) -> usize {
        self.channels
    }

    /// Index of the next frame to come out; lost ones are counted too.
    pub(crate) fn position(&self) -> u64 {
        self.reckoning.position()
    }

    /// The meter of this ring.
    pub fn meter(&self) -> &Arc<Meter> {
        self.reckoning.meter()
    }

    /// Whether the device has ended and all its frames were taken.
    pub(crate) fn exhausted(&self) -> bool {
        self.reckoning.exhausted()
    }

    /// Takes all that the ring holds now, and calls `on` with samples and gaps in order. Returns
    /// whether there was anything.
    pub fn drain(&mut self, mut on: impl FnMut(Piece<'_>)) -> bool {
        let before = self.position();
        let head = self.reckoning.head();
        let mut available = self.ring.occupied_len() / self.channels;
        while available > 0 {
            while let Some(missing) = self.reckoning.missing_here() {
                on(Piece::Missing(missing));
            }
            let frames = self.reckoning.contiguous(available);
            let (first, second) = self.ring.as_slices();
            let samples = frames * self.channels;
            let wrap = samples.min(first.len());
            for part in [&first[..wrap], &second[..samples - wrap]] {
                if !part.is_empty() {
                    on(Piece::Samples(part));
                }
            }
            self.ring.skip(samples);
            self.reckoning.left(frames as u64);
            available -= frames;
        }
        if let Some(missing) = self.reckoning.missing_before(head) {
            on(Piece::Missing(missing));
        }
        self.position() > before
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn ring(channels: usize, capacity: usize) -> (SeriesSink, SeriesTap) {
        series(channels, capacity, Waker::new().0)
    }

    /// All that comes out; missing frames as NaN.
    fn take(tap: &mut SeriesTap) -> Vec<f32> {
        let (mut out, channels) = (Vec::new(), tap.channels());
        tap.drain(|piece| match piece {
            Piece::Samples(samples) => out.extend_from_slice(samples),
            Piece::Missing(n) => out.extend(std::iter::repeat_n(f32::NAN, n as usize * channels)),
        });
        out
    }

    #[test]
    fn what_does_not_fit_is_missing_at_its_place() {
        let (mut sink, mut tap) = ring(2, 2);
        assert_eq!(sink.push(&[1.0, 1.0, 2.0, 2.0, 3.0, 3.0]), 1);
        let out = take(&mut tap);
        assert_eq!(out[..4], [1.0, 1.0, 2.0, 2.0]);
        assert!(out[4..].iter().all(|x| x.is_nan()) && out.len() == 6);
        assert_eq!(sink.push(&[4.0, 4.0]), 0);
        assert_eq!(take(&mut tap), [4.0, 4.0]);
        let counts = tap.meter().counts();
        assert_eq!((counts.pushed, counts.received, counts.lost, counts.fill), (4, 3, 1, 0));
    }

    #[test]
    fn frames_that_never_arrived_are_missing_too() {
        let (mut sink, mut tap) = ring(1, 8);
        sink.push(&[1.0]);
        sink.skip(3);
        sink.push(&[2.0]);
        let out = take(&mut tap);
        assert_eq!((out.len(), out[0], out[4]), (5, 1.0, 2.0));
        assert_eq!(tap.meter().counts().lost, 3);
    }

    #[test]
    fn more_gaps_than_can_be_noted_lose_frames_but_no_index() {
        let (mut sink, mut tap) = ring(1, 4096);
        for i in 0..1000 {
            sink.push(&[(2 * i) as f32]);
            sink.skip(1);
        }
        let mut out = take(&mut tap);
        sink.push(&[2000.0]);
        out.extend(take(&mut tap));
        assert_eq!(out.len(), 2001);
        assert!(out.iter().enumerate().all(|(i, x)| x.is_nan() || *x == i as f32));
        let counts = tap.meter().counts();
        assert_eq!(counts.pushed, counts.received + counts.lost);
    }

    #[test]
    fn a_producer_that_waits_ends_at_a_stop() {
        let (mut sink, _tap) = ring(1, 1);
        let stop = Stop::default();
        let waiting = std::thread::spawn({
            let stop = stop.clone();
            move || sink.push_waiting(&[1.0, 2.0], &stop)
        });
        stop.request();
        assert_eq!(waiting.join().unwrap(), Err(Stopped));
    }

    proptest! {
        #[test]
        fn waiting_carries_everything(
            channels in 1usize..4, capacity in 1usize..50, chunk in 1usize..80, frames in 0usize..500,
        ) {
            let sent: Vec<f32> = (0..frames * channels).map(|i| i as f32).collect();
            let (mut sink, mut tap) = ring(channels, capacity);
            let input = sent.clone();
            let producer = std::thread::spawn(move || {
                for part in input.chunks(chunk * channels) {
                    sink.push_waiting(part, &Stop::default()).unwrap();
                }
            });
            let mut got = Vec::new();
            while !tap.exhausted() {
                got.extend(take(&mut tap));
                std::thread::yield_now();
            }
            producer.join().unwrap();
            prop_assert_eq!(got, sent);
            prop_assert_eq!(tap.meter().counts().lost, 0);
        }

        #[test]
        fn without_waiting_every_frame_comes_or_is_said_to_be_missing(
            capacity in 1usize..20, pushes in prop::collection::vec((1usize..30, any::<bool>()), 1..60),
        ) {
            let (mut sink, mut tap) = ring(1, capacity);
            let (mut next, mut lost, mut out) = (0, 0, Vec::new());
            for (frames, drain) in pushes {
                let part: Vec<f32> = (next..next + frames).map(|i| i as f32).collect();
                lost += sink.push(&part);
                next += frames;
                if drain {
                    out.extend(take(&mut tap));
                }
            }
            drop(sink);
            out.extend(take(&mut tap));
            prop_assert!(tap.exhausted());
            prop_assert_eq!(out.len(), next);
            prop_assert!(out.iter().enumerate().all(|(i, x)| x.is_nan() || *x == i as f32));
            let counts = tap.meter().counts();
            prop_assert_eq!(counts.lost, lost);
            prop_assert_eq!(counts.received + counts.lost, counts.pushed);
        }
    }
}
