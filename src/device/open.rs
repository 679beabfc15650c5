//! Why hardware cannot be opened, and what to do about it.

use std::time::Duration;

use super::{Control, DeviceError, DeviceState};

/// How long a driver waits before it tries again.
pub(super) const RETRY: Duration = Duration::from_millis(300);

/// Why hardware cannot be opened.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum OpenError {
    /// it is not plugged in, or has another name
    #[error("{0} is not there; plug it in, or look for its name with `surfaced devices`")]
    Absent(String),
    /// another program has it
    #[error("{0} is in use; end the program that has it")]
    Busy(String),
    /// the user may not use it
    #[error("permission denied on {device}; {hint}")]
    Denied {
        /// what may not be used
        device: String,
        /// what to do
        hint: String,
    },
    /// it can never do what is needed, so trying again is useless
    #[error("{0}")]
    Unfit(String),
    /// anything else that the system said
    #[error("{0}")]
    Failed(String),
}

impl OpenError {
    /// Whether trying again may help.
    pub fn may_pass(&self) -> bool {
        !matches!(self, Self::Unfit(_))
    }
}

/// Reports a failure to open, then waits. False if it is time to stop.
///
/// # Errors
/// If trying again is of no use.
pub(super) fn failed(
    error: OpenError,
    was_there: bool,
    reported: &mut Option<OpenError>,
    control: &Control,
) -> Result<bool, DeviceError> {
    if !error.may_pass() {
        return Err(DeviceError::Failed(error.to_string()));
    }
    let state = if was_there { DeviceState::Lost } else { DeviceState::Absent };
    control.state(state, error.to_string());
    // The state stays, but the reason is another one: busy instead of absent, say.
    if reported.as_ref().is_some_and(|before| *before != error) {
        control.warn(error.to_string());
    }
    *reported = Some(error);
    Ok(control.sleep_until(std::time::Instant::now() + RETRY))
}
