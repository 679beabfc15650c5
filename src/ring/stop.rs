//! How threads end, and how the one that empties the rings is woken.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use crossbeam_channel::{Receiver, Sender};

/// A request that threads end; clones share it.
#[derive(Clone, Debug, Default)]
pub struct Stop(Arc<AtomicBool>);

impl Stop {
    /// Requests the end; there is no way back.
    pub fn request(&self) {
        self.0.store(true, Ordering::Release);
    }

    /// Whether the end was requested.
    pub(crate) fn requested(&self) -> bool {
        self.0.load(Ordering::Acquire)
    }
}

/// The wait ended because the end was requested.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("stopped")]
pub struct Stopped;

/// Wakes the thread that empties the rings; clones wake the same one.
#[derive(Clone, Debug)]
pub struct Waker(Sender<()>);

impl Waker {
    /// A waker, and what its thread waits on.
    pub fn new() -> (Self, Receiver<()>) {
        let (sender, receiver) = crossbeam_channel::bounded(1);
        (Self(sender), receiver)
    }

    /// Wakes the thread, now or when it next waits. Never blocks.
    pub(crate) fn wake(&self) {
        // Full means that it is about to wake; disconnected, that the thread has ended.
        let _ = self.0.try_send(());
    }
}
