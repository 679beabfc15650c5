//! What a ring has carried.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

/// What one ring has carried, readable from any thread while it works.
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

/// What a ring has carried, at one moment.
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
