//! The ring of a camera: a few whole pictures, each with its index in the stream.

use std::sync::Arc;

use ringbuf::traits::{Consumer, Observer, Producer, Split};
use ringbuf::{HeapCons, HeapProd, HeapRb};

use super::ledger::{Ledger, Reckoning, half_full, pair};
use super::{Meter, Stop, Stopped, Waker};
use crate::trial::Image;

/// The device's end of a ring of images.
pub struct ImageSink {
    ring: HeapProd<Arc<Image>>,
    ledger: Ledger,
}

/// The collector's end of a ring of images.
pub struct ImageTap {
    ring: HeapCons<Arc<Image>>,
    reckoning: Reckoning,
}

/// A ring of `capacity` images, where 0 counts as 1.
pub fn images(capacity: usize, waker: Waker) -> (ImageSink, ImageTap) {
    let capacity = capacity.max(1);
    let (enter, leave) = HeapRb::new(capacity).split();
    let (ledger, reckoning) = pair(capacity, waker);
    (ImageSink { ring: enter, ledger }, ImageTap { ring: leave, reckoning })
}

impl ImageSink {
    /// Index of the next image; lost ones are counted too.
    pub fn position(&self) -> u64 {
        self.ledger.head()
    }

    /// Puts an image into the ring without ever blocking. False if there was no room: the image is
    /// lost, and counted.
    pub fn push(&mut self, image: Arc<Image>) -> bool {
        let entered = self.enter(image).is_ok();
        if !entered {
            self.ledger.lose(1);
        }
        if half_full(&self.ring) {
            self.ledger.wake_collector();
        }
        entered
    }

    /// Puts an image into the ring, waiting for room.
    ///
    /// # Errors
    /// If a stop was requested; the image is not counted then.
    pub fn push_waiting(&mut self, mut image: Arc<Image>, stop: &Stop) -> Result<(), Stopped> {
        while let Err(back) = self.enter(image) {
            image = back;
            self.ledger.wait_for_room(stop)?;
        }
        Ok(())
    }

    fn enter(&mut self, image: Arc<Image>) -> Result<(), Arc<Image>> {
        if self.ring.is_full() || !self.ledger.settle() {
            return Err(image);
        }
        self.ring.try_push(image)?;
        self.ledger.entered(1);
        Ok(())
    }
}

impl ImageTap {
    /// Index of the next image to come out; lost ones are counted too.
    pub fn position(&self) -> u64 {
        self.reckoning.position()
    }

    pub fn meter(&self) -> &Arc<Meter> {
        self.reckoning.meter()
    }

    /// Whether the device has ended and all its images were taken.
    pub fn exhausted(&self) -> bool {
        self.reckoning.exhausted()
    }

    /// Takes all that the ring holds now, and calls `on` with each image and its index; images of
    /// skipped indexes were lost. Returns whether there was anything.
    pub fn drain(&mut self, mut on: impl FnMut(u64, Arc<Image>)) -> bool {
        let before = self.position();
        let head = self.reckoning.head();
        for _ in 0..self.ring.occupied_len() {
            while self.reckoning.missing_here().is_some() {}
            if let Some(image) = self.ring.try_pop() {
                on(self.reckoning.position(), image);
                self.reckoning.left(1);
            }
        }
        self.reckoning.missing_before(head);
        self.position() > before
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture(value: u8) -> Arc<Image> {
        let rgb = vec![value; Image::ROWS * Image::COLS * 3];
        Arc::new(Image::new(Image::COLS, Image::ROWS, rgb).unwrap())
    }

    #[test]
    fn a_picture_that_does_not_fit_leaves_its_index_empty() {
        let (mut sink, mut tap) = images(1, Waker::new().0);
        assert!(sink.push(picture(0)));
        assert!(!sink.push(picture(1)));
        let mut seen = Vec::new();
        tap.drain(|index, image| seen.push((index, image.pixel(0, 0)[0])));
        assert!(sink.push(picture(2)));
        tap.drain(|index, image| seen.push((index, image.pixel(0, 0)[0])));
        assert_eq!(seen, [(0, 0), (2, 2)]);
        assert_eq!(tap.meter().counts().lost, 1);
    }
}
