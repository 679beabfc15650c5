//! Both halves of the bookkeeping of a ring: which indices came through, and which are missing.
//!
//! Missing stretches travel beside the samples, in a small ring of their own. A stretch is entered
//! there before the first frame that follows it enters the ring of samples, so a consumer that
//! sees the frame sees the stretch. The last stretch, which nothing follows yet, is known from the
//! head that the meter shows.

use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use crossbeam_channel::{Receiver, Sender};
use ringbuf::traits::{Consumer, Observer, Producer, Split};
use ringbuf::{HeapCons, HeapProd, HeapRb};

use super::{Stop, Stopped, Waker};

/// The longest time for which a waiting producer relies on being woken.
const NAP: Duration = Duration::from_millis(2);
/// Stretches under way at once; when they are more, the latest one grows instead.
const STRETCHES: usize = 256;

/// The producer's half.
pub(super) struct Ledger {
    meter: Arc<Meter>,
    stretches: HeapProd<(u64, u64)>,
    /// The stretch that nothing follows yet.
    open: Option<Range<u64>>,
    head: u64,
    waker: Waker,
    room: Receiver<()>,
}

/// The consumer's half.
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

    /// Enters the open stretch; to be done before frames enter the ring. False if there is no
    /// room for it: then no frame may enter either.
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
        // A wake-up that got lost between the two costs one nap.
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

    /// To be read before the ring is looked at: all before this index is visible then.
    pub(super) fn head(&self) -> u64 {
        self.meter.head.load(Ordering::Acquire)
    }

    /// Whether the producer is gone and nothing is left to come.
    pub(super) fn exhausted(&self) -> bool {
        // `closed` is read first, so that all counts made before it was set are seen.
        self.meter.closed.load(Ordering::Acquire) && self.position >= self.head()
    }

    /// The frames missing right here, if any are known to be.
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

    /// The number of the `available` frames that follow each other without a gap.
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

    /// The number of frames missing up to `head`, once the ring was emptied of all before it.
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

/// Counts of one ring, readable from any thread while it works.
///
/// Counts are in frames (one sample of every channel) or images.
#[derive(Debug)]
pub struct Meter {
    pub(super) capacity: u64,
    /// Index of the next frame: all that were pushed or lost so far.
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
    /// Frames that never entered it: no room, or never arrived at the device.
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

    /// The figures now. While frames move, `fill` may be off by those in motion; once the stream
    /// is closed and emptied, `pushed = received + lost` exactly.
    pub fn counts(&self) -> Counts {
        let received = self.received.load(Ordering::Acquire);
        let lost = self.lost.load(Ordering::Acquire);
        let pushed = self.head.load(Ordering::Acquire);
        let fill = pushed.saturating_sub(lost + received).min(self.capacity);
        Counts { pushed, received, lost, fill, capacity: self.capacity }
    }
}
