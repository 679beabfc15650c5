//! Both halves of a ring's bookkeeping: which indexes came through, and which are missing.
//!
//! Stretches of missing indexes travel beside the samples, in a small ring of their own. A stretch
//! is entered there before the first frame that follows it enters the ring of samples, so a
//! consumer that sees the frame sees the stretch. The last stretch, which no frame follows yet,
//! shows in the meter's `head`, the index of the next frame.

use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use crossbeam_channel::{Receiver, Sender};
use ringbuf::traits::{Consumer, Observer, Producer, Split};
use ringbuf::{HeapCons, HeapProd, HeapRb};

use super::{Stop, Stopped, Waker};

/// How long a waiting producer sleeps at most, in case that nobody wakes it.
const NAP: Duration = Duration::from_millis(2);
/// Most stretches under way at once; beyond that, frames are lost, so that the latest one grows.
const STRETCHES: usize = 256;

/// The producer's half of the bookkeeping.
pub(super) struct Ledger {
    meter: Arc<Meter>,
    stretches: HeapProd<(u64, u64)>,
    /// The stretch that no frame follows yet.
    open: Option<Range<u64>>,
    head: u64,
    waker: Waker,
    room: Receiver<()>,
}

/// The consumer's half of the bookkeeping.
pub(super) struct Reckoning {
    meter: Arc<Meter>,
    stretches: HeapCons<(u64, u64)>,
    position: u64,
    room: Sender<()>,
}

pub(super) fn pair(capacity: usize, waker: Waker) -> (Ledger, Reckoning) {
    let meter = Meter::new(capacity);
    let (enter, read) = HeapRb::new(STRETCHES).split();
    let (made, room) = crossbeam_channel::bounded(1);
    (
        Ledger { meter: meter.clone(), stretches: enter, open: None, head: 0, waker, room },
        Reckoning { meter, stretches: read, position: 0, room: made },
    )
}

impl Ledger {
    pub(super) fn head(&self) -> u64 {
        self.head
    }

    /// Enters the open stretch, which must be done before frames enter the ring. False if there is
    /// no room for it: then no frame may enter either.
    pub(super) fn settle(&mut self) -> bool {
        if let Some(open) = &self.open {
            if self.stretches.try_push((open.start, open.end)).is_err() {
                return false;
            }
            self.open = None;
        }
        true
    }

    pub(super) fn entered(&mut self, frames: u64) {
        self.head += frames;
        self.meter.head.store(self.head, Ordering::Release);
    }

    pub(super) fn lose(&mut self, frames: u64) {
        if frames == 0 {
            return;
        }
        let start = self.open.as_ref().map_or(self.head, |open| open.start);
        self.head += frames;
        self.open = Some(start..self.head);
        self.meter.lost.fetch_add(frames, Ordering::AcqRel);
        self.meter.head.store(self.head, Ordering::Release);
    }

    pub(super) fn wake_collector(&self) {
        self.waker.wake();
    }

    /// Waits until the consumer has made room, or for a short time.
    pub(super) fn wait_for_room(&self, stop: &Stop) -> Result<(), Stopped> {
        if stop.requested() {
            return Err(Stopped);
        }
        self.meter.waiting.store(true, Ordering::Release);
        self.waker.wake();
        // A wake-up that got lost before this line costs one nap.
        let _ = self.room.recv_timeout(NAP);
        self.meter.waiting.store(false, Ordering::Release);
        Ok(())
    }
}

impl Drop for Ledger {
    fn drop(&mut self) {
        self.meter.closed.store(true, Ordering::Release);
        self.waker.wake();
    }
}

impl Reckoning {
    pub(super) fn meter(&self) -> &Arc<Meter> {
        &self.meter
    }

    pub(super) fn position(&self) -> u64 {
        self.position
    }

    /// The index after all frames so far. Read before the ring, which then shows all of them.
    pub(super) fn head(&self) -> u64 {
        self.meter.head.load(Ordering::Acquire)
    }

    /// Whether the producer is gone and nothing is left to come.
    pub(super) fn exhausted(&self) -> bool {
        // `closed` is read first, so that all counts made before it was set are seen.
        self.meter.closed.load(Ordering::Acquire) && self.position >= self.head()
    }

    /// Skips the frames known to be missing at the position, and returns their number.
    pub(super) fn missing_here(&mut self) -> Option<u64> {
        while let Some(&(start, end)) = self.stretches.try_peek() {
            if start > self.position {
                return None;
            }
            self.stretches.try_pop();
            if end > self.position {
                let missing = end - self.position;
                self.position = end;
                return Some(missing);
            }
        }
        None
    }

    /// How many of the `available` frames follow each other without a gap.
    pub(super) fn contiguous(&self, available: usize) -> usize {
        match self.stretches.try_peek() {
            Some(&(start, _)) => {
                let until = start.saturating_sub(self.position);
                available.min(usize::try_from(until).unwrap_or(usize::MAX))
            }
            None => available,
        }
    }

    /// Counts frames that left the ring, and wakes a producer that waits for their room.
    pub(super) fn left(&mut self, frames: u64) {
        self.position += frames;
        self.meter.received.fetch_add(frames, Ordering::AcqRel);
        if self.meter.waiting.load(Ordering::Acquire) {
            let _ = self.room.try_send(());
        }
    }

    /// Skips the frames missing before `head`, once the ring is empty, and returns their number.
    pub(super) fn missing_before(&mut self, head: u64) -> Option<u64> {
        let missing = head.checked_sub(self.position).filter(|&frames| frames > 0)?;
        self.position = head;
        Some(missing)
    }
}

/// Whether a ring should be emptied soon.
pub(super) fn half_full<R: Observer>(ring: &R) -> bool {
    ring.occupied_len() * 2 >= ring.capacity().get()
}

/// Counts of one ring, readable from any thread while the ring is in use.
///
/// Counts are in frames (one sample of every channel) or images.
#[derive(Debug)]
pub struct Meter {
    pub(super) capacity: u64,
    /// Index of the next frame, which is the number of frames pushed or lost so far.
    pub(super) head: AtomicU64,
    pub(super) lost: AtomicU64,
    pub(super) received: AtomicU64,
    pub(super) closed: AtomicBool,
    pub(super) waiting: AtomicBool,
}

/// Counts of a ring at one moment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct Counts {
    /// Frames offered by the device: those in the ring, those that left it, and those lost.
    pub pushed: u64,
    /// Frames that came out of the ring.
    pub received: u64,
    /// Frames that never entered the ring: it was full, or they never arrived at the device.
    pub lost: u64,
    /// Frames in the ring now.
    pub fill: u64,
    /// Frames that the ring can hold.
    pub capacity: u64,
}

impl Meter {
    pub(super) fn new(capacity: usize) -> Arc<Self> {
        Arc::new(Self {
            capacity: capacity as u64,
            head: AtomicU64::new(0),
            lost: AtomicU64::new(0),
            received: AtomicU64::new(0),
            closed: AtomicBool::new(false),
            waiting: AtomicBool::new(false),
        })
    }

    /// The counts now. While frames enter and leave, `fill` may be off by these; once the stream is
    /// closed and emptied, `pushed = received + lost` exactly.
    pub fn counts(&self) -> Counts {
        let received = self.received.load(Ordering::Acquire);
        let lost = self.lost.load(Ordering::Acquire);
        let pushed = self.head.load(Ordering::Acquire);
        let fill = pushed.saturating_sub(lost + received).min(self.capacity);
        Counts { pushed, received, lost, fill, capacity: self.capacity }
    }
}
