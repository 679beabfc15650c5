//! The station's end: enters notices into a bounded queue, and never waits.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use tokio::sync::mpsc::{Receiver, Sender, channel};

use crate::station::{Listener, StationEvent};

/// Notices under way.
const QUEUE: usize = 1024;
/// Traces leave this much room for what matters more.
const KEPT_FREE: usize = 768;

/// Passes the notices of the station on to the server.
#[derive(Debug)]
pub struct Reporter {
    queue: Sender<StationEvent>,
    missed: Arc<AtomicU64>,
}

/// A reporter, and the notices that it passes on.
pub(super) fn pair() -> (Reporter, Receiver<StationEvent>) {
    let (queue, notices) = channel(QUEUE);
    (Reporter { queue, missed: Arc::default() }, notices)
}

impl Reporter {
    /// Notices that found no room.
    pub(super) fn missed(&self) -> Arc<AtomicU64> {
        self.missed.clone()
    }
}

impl Listener for Reporter {
    fn on_event(&mut self, event: &StationEvent) {
        // Whole scans are the keeper's.
        if matches!(event, StationEvent::Alive | StationEvent::Scan(_)) {
            return;
        }
        let room = self.queue.capacity();
        let fits = !matches!(event, StationEvent::Trace(_)) || room > KEPT_FREE;
        if !fits || self.queue.try_send(event.clone()).is_err() {
            self.missed.fetch_add(1, Ordering::Relaxed);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scan::Trace;

    #[test]
    fn a_server_that_does_not_read_holds_up_nothing_and_keeps_room_for_what_matters() {
        let (mut reporter, mut notices) = pair();
        let trace = StationEvent::Trace(Arc::new(Trace { fresh: vec![], images: vec![] }));
        (0..10 * QUEUE).for_each(|_| reporter.on_event(&trace));
        (0..10).for_each(|n| reporter.on_event(&StationEvent::Warning(n.to_string())));
        let mut warnings = 0;
        while let Ok(event) = notices.try_recv() {
            warnings += usize::from(matches!(event, StationEvent::Warning(_)));
        }
        assert_eq!(warnings, 10);
        let kept = (QUEUE - KEPT_FREE) as u64;
        assert_eq!(reporter.missed().load(Ordering::Relaxed), 10 * QUEUE as u64 - kept);
    }
}
