//! How long the end of a station waits for what a listener still holds.

use std::convert::Infallible;
use std::time::{Duration, Instant};

use crossbeam_channel::Receiver;

use super::event::StationEvent;

/// The end of a listener's thread, which takes nothing more once the station has finished. However
/// many listeners there are, all of them together are waited for until one moment.
#[derive(Debug)]
pub struct End {
    ended: Receiver<Infallible>,
    until: Option<Instant>,
}

impl End {
    /// Of a thread that holds the other side of `ended` for as long as it works.
    pub(crate) fn of(ended: Receiver<Infallible>) -> Self {
        Self { ended, until: None }
    }

    /// Whether nothing follows this event, so that the thread is to end now.
    pub(crate) fn is_here(&mut self, event: &StationEvent) -> bool {
        if let StationEvent::Ending(until) = event {
            self.until = Some(*until);
        }
        matches!(event, StationEvent::Finished(_))
    }

    /// Waits for the thread, but no longer than `patience` or the end of the station may take; false
    /// if it still works.
    pub(crate) fn wait(&self, patience: Duration) -> bool {
        let patient = Instant::now().checked_add(patience);
        let until = self.until.into_iter().chain(patient).min();
        let ended = match until {
            Some(until) => self.ended.recv_deadline(until).map_err(|error| error.is_disconnected()),
            None => self.ended.recv().map_err(|_| true),
        };
        ended == Err(true)
    }
}
