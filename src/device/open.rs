//! Errors of opening hardware, each with a remedy, and repeated attempts.

use std::time::{Duration, Instant};

use super::{DeviceError, DeviceLink, DeviceState};

/// The time until a driver tries again.
pub(super) const RETRY: Duration = Duration::from_millis(300);

/// The longest wait between attempts that search all the hardware of one kind.
pub(super) const LONGEST_RETRY: Duration = Duration::from_secs(5);

/// Why hardware cannot be opened.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[allow(missing_docs)] // The messages say it.
pub enum OpenError {
    #[error("{0} is not there; plug it in, or look for its name with `surfaced devices`")]
    Absent(String),
    #[error("{0} is in use; end the program that has it")]
    Busy(String),
    #[error("permission denied on {device}; {hint}")]
    Denied { device: String, hint: String },
    /// The hardware is unsuitable, so trying again is useless.
    #[error("{0}")]
    Unfit(String),
    #[error("{0}")]
    Failed(String),
}

impl OpenError {
    /// Whether trying again may help.
    pub fn may_pass(&self) -> bool {
        !matches!(self, Self::Unfit(_))
    }
}

/// Repeats attempts to open hardware.
pub(super) struct Retry {
    /// The last failure, if there was one.
    reported: Option<OpenError>,
    wait: Duration,
    longest: Duration,
}

impl Retry {
    /// Waits [`RETRY`] at first, then twice as long each time, up to `longest`.
    pub fn new(longest: Duration) -> Self {
        Self { reported: None, wait: RETRY, longest }
    }

    /// Notes that the hardware could be opened.
    pub fn opened(&mut self) {
        *self = Self::new(self.longest);
    }

    /// Reports a failure to open, then waits. False if it is time to stop.
    ///
    /// # Errors
    /// If trying again is useless.
    pub fn failed(
        &mut self,
        error: OpenError,
        was_there: bool,
        link: &DeviceLink,
    ) -> Result<bool, DeviceError> {
        if !error.may_pass() {
            return Err(DeviceError::Failed(error.to_string()));
        }
        let state = if was_there { DeviceState::Lost } else { DeviceState::Absent };
        link.state(state, error.to_string());
        // The state is the same, but the reason has changed, such as busy instead of absent.
        if self.reported.as_ref().is_some_and(|before| *before != error) {
            link.warn(error.to_string());
        }
        self.reported = Some(error);
        let wait = self.wait;
        self.wait = (2 * wait).min(self.longest.max(RETRY));
        Ok(link.sleep_until(Instant::now() + wait))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ring::Stop;

    #[test]
    fn what_is_dear_to_open_is_tried_ever_more_rarely_until_it_could_be_opened() {
        let (send, reports) = crossbeam_channel::unbounded();
        // A stop was requested, so that no attempt waits.
        let stop = Stop::default();
        stop.request();
        let link = DeviceLink::new(0, stop, send);
        let waits = |retry: &mut Retry| -> Vec<u64> {
            let wait = |_| {
                let wait = retry.wait.as_millis() as u64;
                assert!(!retry.failed(OpenError::Absent("it".into()), false, &link).unwrap());
                wait
            };
            (0..6).map(wait).collect()
        };
        let mut dear = Retry::new(LONGEST_RETRY);
        assert_eq!(waits(&mut dear), [300, 600, 1200, 2400, 4800, 5000]);
        dear.opened();
        assert_eq!(dear.wait, RETRY);
        assert_eq!(waits(&mut Retry::new(RETRY)), [300; 6]);
        // One report for all failures.
        assert_eq!(reports.try_iter().count(), 1);
    }
}
