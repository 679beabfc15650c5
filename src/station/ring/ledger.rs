//! The two halves of a ring's bookkeeping: which indexes came through, and which are missing.
//!
//! A stretch is a range of consecutive missing indexes. Stretches travel beside the samples, in a
//! small ring of their own. The producer enters a stretch before the frame that follows it, so a
//! consumer that sees the frame sees the stretch. No frame follows the last stretch yet, so the
//! consumer finds its end in the meter's `head`, which is the index of the next frame.

use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use crossbeam_channel::{Receiver, Sender};
use ringbuf::traits::{Consumer, Producer, Split};
use ringbuf::{HeapCons, HeapProd, HeapRb};

use super::{Stop, Stopped, Waker};

/// The longest sleep of a waiting producer, so that it goes on even if nothing wakes it.
const NAP: Duration = Duration::from_millis(2);
/// Most stretches that may wait for the consumer. If no more stretches fit, new frames are lost, too.
const STRETCHES: usize = 256;

pub(super) struct Ledger {
    meter: Arc<Meter>,
    stretches: HeapProd<(u64, u64)>,
    /// The last stretch until a frame follows it; `None` if a frame came last.
    open: Option<Range<u64>>,
    pub head: u64,
    pub waker: Waker,
    room: Receiver<()>,
}

pub(crate) struct Reckoning {
    pub meter: Arc<Meter>,
    stretches: HeapCons<(u64, u64)>,
    /// Index of the next frame to come out.
    pub position: u64,
    room: Sender<()>,
}

pub(super) fn pair(capacity: usize, waker: Waker) -> (Ledger, Reckoning) {
    let meter = Arc::new(Meter { capacity: capacity as u64, ..Meter::default() });
    let (enter, read) = HeapRb::new(STRETCHES).split();
    let (made, room) = crossbeam_channel::bounded(1);
    (
        Ledger { meter: meter.clone(), stretches: enter, open: None, head: 0, waker, room },
        Reckoning { meter, stretches: read, position: 0, room: made },
    )
}

impl Ledger {
    /// Enters the open stretch, if there is one. Must be called before frames enter the ring; if it
    /// returns false, there was no room for the stretch, and no frame may enter.
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

    /// Waits until the consumer has made room, but at most for [`NAP`].
    pub(super) fn wait_for_room(&self, stop: &Stop) -> Result<(), Stopped> {
        if stop.requested() {
            return Err(Stopped);
        }
        self.meter.waiting.store(true, Ordering::Release);
        self.waker.wake();
        // If room was made before `waiting` was set, no wake-up comes, and this costs one nap.
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
    /// The index after all frames so far. Read before the ring, so that the ring holds all of them.
    pub(super) fn head(&self) -> u64 {
        self.meter.head.load(Ordering::Acquire)
    }

    /// Whether the producer is gone and all its frames came out or were reported as missing.
    pub(crate) fn exhausted(&self) -> bool {
        // `closed` is read first, since `head` is final once `closed` is set.
        self.meter.closed.load(Ordering::Acquire) && self.position >= self.head()
    }

    /// Skips the frames missing at the position, and returns their number; `None` if there are none.
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

    /// How many of the `available` frames come before the next gap.
    pub(super) fn contiguous(&self, available: usize) -> usize {
        match self.stretches.try_peek() {
            Some(&(start, _)) => {
                let until = start.saturating_sub(self.position);
                available.min(usize::try_from(until).unwrap_or(usize::MAX))
            }
            None => available,
        }
    }

    /// Counts frames that left the ring, and wakes a producer that waits for room.
    pub(super) fn left(&mut self, frames: u64) {
        self.position += frames;
        self.meter.received.fetch_add(frames, Ordering::AcqRel);
        if self.meter.waiting.load(Ordering::Acquire) {
            let _ = self.room.try_send(());
        }
    }

    /// Skips the frames missing before `head`, and returns their number. Called when the ring is empty.
    pub(super) fn missing_before(&mut self, head: u64) -> Option<u64> {
        let missing = head.checked_sub(self.position).filter(|&frames| frames > 0)?;
        self.position = head;
        Some(missing)
    }
}

/// Counts of one ring, in frames (one sample of every channel) or images. Any thread may read them
/// while the ring is in use.
#[derive(Debug, Default)]
pub struct Meter {
    capacity: u64,
    /// Index of the next frame, which is the number of frames that entered or were lost so far.
    head: AtomicU64,
    lost: AtomicU64,
    received: AtomicU64,
    closed: AtomicBool,
    waiting: AtomicBool,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct Counts {
    /// Frames that the device offered, that is, the frames in the ring, received and lost.
    pub pushed: u64,
    pub received: u64,
    /// Frames that never entered the ring, since it was full or they never arrived at the device.
    pub lost: u64,
    pub fill: u64,
    /// Frames that the ring can hold.
    pub capacity: u64,
}

impl Meter {
    /// The present counts. While frames enter and leave, `fill` may be off by their number; once
    /// the stream is closed and empty, `pushed = received + lost` exactly.
    pub fn counts(&self) -> Counts {
        let received = self.received.load(Ordering::Acquire);
        let lost = self.lost.load(Ordering::Acquire);
        let pushed = self.head.load(Ordering::Acquire);
        let fill = pushed.saturating_sub(lost + received).min(self.capacity);
        Counts { pushed, received, lost, fill, capacity: self.capacity }
    }
}
