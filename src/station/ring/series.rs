//! The ring itself, which holds interleaved samples and moves them in slices of whole frames. In
//! the ring of a camera, a picture is a frame of one sample.

use std::sync::Arc;

use ringbuf::traits::{Consumer, Observer, Producer, Split};
use ringbuf::{HeapCons, HeapProd, HeapRb};

use super::ledger::{Ledger, Reckoning, pair};
use super::{Meter, Stop, Stopped, Waker};
use crate::trial::Image;

/// The device's end of a ring.
pub struct RingSink<T> {
    ring: HeapProd<T>,
    channels: usize,
    ledger: Ledger,
}

pub type SeriesSink = RingSink<f32>;
pub type ImageSink = RingSink<Arc<Image>>;

pub struct RingTap<T> {
    ring: HeapCons<T>,
    channels: usize,
    reckoning: Reckoning,
}

pub type SeriesTap = RingTap<f32>;
pub(crate) type ImageTap = RingTap<Arc<Image>>;

/// A piece of what comes out of a ring in order, either samples or a gap.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Piece<'a, T = f32> {
    Samples(&'a [T]),
    Missing(u64),
}

/// A ring of `capacity` frames of `channels` samples each; a 0 counts as 1.
pub fn series(channels: usize, capacity: usize, waker: Waker) -> (SeriesSink, SeriesTap) {
    ring(channels, capacity, waker)
}

/// A ring of `capacity` pictures; a 0 counts as 1.
pub(crate) fn images(capacity: usize, waker: Waker) -> (ImageSink, ImageTap) {
    ring(1, capacity, waker)
}

fn ring<T>(channels: usize, capacity: usize, waker: Waker) -> (RingSink<T>, RingTap<T>) {
    let (channels, capacity) = (channels.max(1), capacity.max(1));
    let (enter, leave) = HeapRb::new(channels * capacity).split();
    let (ledger, reckoning) = pair(capacity, waker);
    (RingSink { ring: enter, channels, ledger }, RingTap { ring: leave, channels, reckoning })
}

impl<T: Clone> RingSink<T> {
    pub fn channels(&self) -> usize {
        self.channels
    }

    /// Index of the next frame; lost frames are counted too.
    pub fn position(&self) -> u64 {
        self.ledger.head
    }

    /// Puts frames into the ring without ever blocking. Frames that do not fit are lost and counted
    /// as lost; their number is returned.
    ///
    /// # Panics
    /// If `samples.len()` is not a multiple of the number of channels.
    pub fn push(&mut self, samples: &[T]) -> u64 {
        let frames = self.whole_frames(samples);
        let entered = self.enter(samples);
        let lost = (frames - entered) as u64;
        self.ledger.lose(lost);
        if self.ring.occupied_len() * 2 >= self.ring.capacity().get() {
            self.ledger.waker.wake();
        }
        lost
    }

    /// Puts all frames into the ring; waits for room as often as needed.
    ///
    /// # Errors
    /// If a stop was requested. Frames that had not entered by then are not counted.
    ///
    /// # Panics
    /// If `samples.len()` is not a multiple of the number of channels.
    pub fn push_waiting(&mut self, samples: &[T], stop: &Stop) -> Result<(), Stopped> {
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

    /// Counts frames as lost that the sensor took but that never arrived here. A gap in the
    /// device's own sample counter gives their number.
    pub fn skip(&mut self, frames: u64) {
        self.ledger.lose(frames);
    }

    fn whole_frames(&self, samples: &[T]) -> usize {
        let (len, channels) = (samples.len(), self.channels);
        assert!(len.is_multiple_of(channels), "{len} samples are not whole frames of {channels}");
        len / channels
    }

    fn enter(&mut self, samples: &[T]) -> usize {
        // Rounds down to whole frames, so that a frame is never split between two calls.
        let fits = self.ring.vacant_len().min(samples.len()) / self.channels * self.channels;
        if fits == 0 || !self.ledger.settle() {
            return 0;
        }
        let frames = self.ring.push_iter(samples[..fits].iter().cloned()) / self.channels;
        self.ledger.entered(frames as u64);
        frames
    }
}

impl<T> RingTap<T> {
    pub fn channels(&self) -> usize {
        self.channels
    }

    /// Index of the next frame to come out; lost frames are counted too.
    pub(crate) fn position(&self) -> u64 {
        self.reckoning.position
    }

    pub fn meter(&self) -> &Arc<Meter> {
        &self.reckoning.meter
    }

    pub(crate) fn reckoning(&self) -> &Reckoning {
        &self.reckoning
    }

    /// Takes all that the ring holds now, and calls `on` with samples and gaps in order. Returns
    /// whether there was anything.
    pub fn drain(&mut self, mut on: impl FnMut(Piece<'_, T>)) -> bool {
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

impl ImageTap {
    /// Takes all pictures that the ring holds now, and calls `on` with each picture and its index.
    /// A skipped index is a lost picture. Returns whether there was anything.
    pub(crate) fn drain_images(&mut self, mut on: impl FnMut(u64, &Arc<Image>)) -> bool {
        let mut index = self.position();
        self.drain(|piece| match piece {
            Piece::Missing(lost) => index += lost,
            Piece::Samples(pictures) => {
                (index..).zip(pictures).for_each(|(index, picture)| on(index, picture));
                index += pictures.len() as u64;
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn ring(channels: usize, capacity: usize) -> (SeriesSink, SeriesTap) {
        series(channels, capacity, Waker::new().0)
    }

    /// All samples that come out, with NaN for missing frames.
    fn take(tap: &mut SeriesTap) -> Vec<f32> {
        let (mut out, channels) = (Vec::new(), tap.channels);
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

    #[test]
    fn a_picture_that_does_not_fit_leaves_its_index_empty() {
        let picture = |value: u8| {
            let rgb = vec![value; Image::ROWS * Image::COLS * 3];
            [Arc::new(Image::new(Image::COLS, Image::ROWS, rgb).unwrap())]
        };
        let (mut sink, mut tap) = images(1, Waker::new().0);
        assert_eq!((sink.push(&picture(0)), sink.push(&picture(1))), (0, 1));
        let mut seen = Vec::new();
        tap.drain_images(|index, image| seen.push((index, image.pixel(0, 0)[0])));
        assert_eq!(sink.push(&picture(2)), 0);
        tap.drain_images(|index, image| seen.push((index, image.pixel(0, 0)[0])));
        assert_eq!(seen, [(0, 0), (2, 2)]);
        assert_eq!(tap.meter().counts().lost, 1);
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
            while !tap.reckoning.exhausted() {
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
            prop_assert!(tap.reckoning.exhausted());
            prop_assert_eq!(out.len(), next);
            prop_assert!(out.iter().enumerate().all(|(i, x)| x.is_nan() || *x == i as f32));
            let counts = tap.meter().counts();
            prop_assert_eq!(counts.lost, lost);
            prop_assert_eq!(counts.received + counts.lost, counts.pushed);
        }
    }
}
