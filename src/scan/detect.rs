//! Detects taps and drags in levels of force and vibration: pure, a state machine fed hop by hop.
//!
//! Contact begins where any stream reaches [`DetectorConfig::onset`] and ends once all are below
//! [`DetectorConfig::quiet`]; the two differ so that a level near one of them does not flutter. A short
//! contact is a tap; one that lasts is a drag, and has the tap before it, if there was one. All
//! limits of level are multiples of each stream's own noise floor.

mod hop_level;

pub use hop_level::SensorKind;
pub(crate) use hop_level::{HOP_S, StreamLevel};

/// What is a tap, and what a drag.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DetectorConfig {
    /// Level at which contact begins, in multiples of the noise floor.
    pub onset: f64,
    /// Level below which it is quiet, in the same.
    pub quiet: f64,
    /// A tap is over once it is quiet for this long, in seconds.
    pub tap_hold_s: f64,
    /// A longer contact is a drag and no tap, in seconds.
    pub longest_tap_s: f64,
    /// A drag begins at most this long after its tap, in seconds.
    pub longest_pause_s: f64,
    /// A drag is over once it is quiet for this long, in seconds; it ended when it became quiet.
    pub drag_hold_s: f64,
    /// A longer contact is noise and no drag, in seconds.
    pub longest_drag_s: f64,
}

impl Default for DetectorConfig {
    fn default() -> Self {
        Self {
            onset: 6.0,
            quiet: 3.0,
            tap_hold_s: 0.05,
            longest_tap_s: 0.3,
            longest_pause_s: 3.0,
            drag_hold_s: 0.3,
            longest_drag_s: 60.0,
        }
    }
}

/// What was detected; hops are counted from the start of the streams, spans are half-open.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum DetectorEvent {
    /// A drag is in progress.
    Drag {
        /// the tap before it
        tap: Option<(u64, u64)>,
        /// its first hop
        start: u64,
    },
    /// The drag has ended.
    End {
        /// the first hop after it
        end: u64,
    },
    /// The contact did not end: it was noise, and the floor is to be learnt again.
    NoiseTimeout,
}

#[derive(Clone, Copy, Debug)]
enum DetectorState {
    Quiet { tap: Option<(u64, u64)> },
    Contact { tap: Option<(u64, u64)>, start: u64, quiet_at: Option<u64> },
    Drag { start: u64, quiet_at: Option<u64> },
}

/// The state machine.
#[derive(Clone, Debug)]
pub(crate) struct Detector {
    config: DetectorConfig,
    state: DetectorState,
    hop: u64,
}

impl Detector {
    /// Nothing detected yet.
    pub fn new(config: DetectorConfig) -> Self {
        Self { config, state: DetectorState::Quiet { tap: None }, hop: 0 }
    }

    /// Its settings.
    pub fn config(&self) -> DetectorConfig {
        self.config
    }

    /// Whether there is contact, during which noise floors are held.
    pub fn in_contact(&self) -> bool {
        !matches!(self.state, DetectorState::Quiet { .. })
    }

    /// Takes the next hop: the highest level among the streams.
    pub fn hop(&mut self, level: f64) -> Option<DetectorEvent> {
        let at = self.hop;
        self.hop += 1;
        let config = self.config;
        let lasted = |since: u64, seconds: f64| (at + 1 - since) as f64 * HOP_S >= seconds - 1e-9;
        // A level that is not a number is not quiet, and begins nothing either.
        let is_quiet = level < config.quiet;
        match &mut self.state {
            DetectorState::Quiet { tap } => {
                if tap.is_some_and(|(_, end)| lasted(end, config.longest_pause_s)) {
                    *tap = None;
                }
                if level >= config.onset {
                    self.state = DetectorState::Contact { tap: *tap, start: at, quiet_at: None };
                }
                None
            }
            DetectorState::Contact { tap, start, quiet_at } => {
                *quiet_at = if is_quiet { Some(quiet_at.unwrap_or(at)) } else { None };
                match *quiet_at {
                    Some(end) if lasted(end, config.tap_hold_s) => {
                        self.state = DetectorState::Quiet { tap: Some((*start, end)) };
                        None
                    }
                    None if lasted(*start, config.longest_tap_s) => {
                        let event = DetectorEvent::Drag { tap: *tap, start: *start };
                        self.state = DetectorState::Drag { start: *start, quiet_at: None };
                        Some(event)
                    }
                    _ => None,
                }
            }
            DetectorState::Drag { start, quiet_at } => {
                *quiet_at = if is_quiet { Some(quiet_at.unwrap_or(at)) } else { None };
                match *quiet_at {
                    Some(end) if lasted(end, config.drag_hold_s) => {
                        self.state = DetectorState::Quiet { tap: None };
                        Some(DetectorEvent::End { end })
                    }
                    _ if lasted(*start, config.longest_drag_s) => {
                        self.state = DetectorState::Quiet { tap: None };
                        Some(DetectorEvent::NoiseTimeout)
                    }
                    _ => None,
                }
            }
        }
    }

    /// The streams have ended or stalled: a drag in progress ends here.
    pub fn finish(&mut self) -> Option<DetectorEvent> {
        let state = std::mem::replace(&mut self.state, DetectorState::Quiet { tap: None });
        match state {
            DetectorState::Drag { quiet_at, .. } => {
                Some(DetectorEvent::End { end: quiet_at.unwrap_or(self.hop) })
            }
            _ => None,
        }
    }
}

/// The first hop in `window` at which `levels` (hop by hop, the first one being hop `first`)
/// reaches `onset` after a hop below it: where a tap begins in another stream.
pub(crate) fn onset_in(
    levels: &[f64],
    first: u64,
    window: std::ops::Range<u64>,
    onset: f64,
) -> Option<u64> {
    let at = |hop: u64| levels.get(usize::try_from(hop.checked_sub(first)?).ok()?).copied();
    window.skip_while(|hop| at(*hop).is_none_or(|x| x >= onset)).find(|hop| at(*hop) >= Some(onset))
}

#[cfg(test)]
mod tests;
