//! Detects taps and drags in levels of force and vibration: a state machine fed once a hop (5 ms).
//!
//! Contact begins where any stream reaches [`DetectorConfig::onset`] and ends once all are below
//! [`DetectorConfig::quiet`]; the two differ so that a level near one of them does not begin and
//! end contacts rapidly. A short contact is a tap. A longer one is a drag, which includes the tap
//! before it, if any. All limits of level are multiples of each stream's own noise floor.

use std::collections::VecDeque;

/// Thresholds of taps and drags.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DetectorConfig {
    /// Level at which contact begins, in multiples of the noise floor.
    pub onset: f64,
    /// Level below which there is no contact, in the same unit.
    pub quiet: f64,
    /// A tap is over after this much quiet, in seconds.
    pub tap_hold_s: f64,
    /// Longest tap, in seconds; a longer contact is a drag.
    pub longest_tap_s: f64,
    /// A drag begins at most this long after its tap, in seconds.
    pub longest_pause_s: f64,
    /// A drag is over after this much quiet, in seconds; its end is where the quiet began.
    pub drag_hold_s: f64,
    /// Longest drag, in seconds; a longer contact is noise.
    pub longest_drag_s: f64,
}

/// For tests. A station's are from `[detection]` in `configs/stylus.toml`, which a test holds equal.
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

/// Events of the detector; hops are counted from the start of the streams, spans are half-open.
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
    /// Contact lasted too long: it was noise, and the noise floor must be learnt again.
    NoiseTimeout,
}

#[derive(Clone, Copy, Debug)]
enum DetectorState {
    Quiet { tap: Option<(u64, u64)> },
    Contact { tap: Option<(u64, u64)>, start: u64, quiet_at: Option<u64> },
    Drag { start: u64, quiet_at: Option<u64> },
}

#[derive(Clone, Debug)]
pub(crate) struct Detector {
    config: DetectorConfig,
    state: DetectorState,
    hop: u64,
}

impl Detector {
    pub fn new(config: DetectorConfig) -> Self {
        Self { config, state: DetectorState::Quiet { tap: None }, hop: 0 }
    }

    pub fn config(&self) -> DetectorConfig {
        self.config
    }

    /// Whether there is contact, during which noise floors must not rise.
    pub fn in_contact(&self) -> bool {
        !matches!(self.state, DetectorState::Quiet { .. })
    }

    /// Takes the level of the next hop, the highest among the streams.
    pub fn hop(&mut self, level: f64) -> Option<DetectorEvent> {
        let at = self.hop;
        self.hop += 1;
        let config = self.config;
        let lasted = |since: u64, seconds: f64| (at + 1 - since) as f64 * HOP_S >= seconds - 1e-9;
        // NaN counts as neither quiet nor the begin of contact.
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

    /// Ends a drag in progress, since the streams have ended or stalled.
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

/// Finds where a tap begins in another stream: the first hop in `window` that reaches `onset` after
/// a hop below it. `levels` holds the level of each hop, from hop `first` on.
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

/// Length of a hop in seconds: the resolution of every onset and end.
pub const HOP_S: f64 = 0.005;
/// Hops (0.3 s) before the noise floor is first used; until then, the level is 0.
const LEARN: u64 = 60;
/// Hops over which the floor is smoothed (0.1 s), so that one quiet hop does not lower it.
const SMOOTH: f64 = 20.0;
/// Hops of a block (0.5 s), and number of blocks (10 s) whose minimum is the floor.
const BLOCK: u64 = 100;
const BLOCKS: usize = 20;
/// Vibration below this share of full scale is noise of the converter: about 6 steps of 16 bits.
const LEAST_VIBRATION: f64 = 2e-4;
/// Force of level 1, as a share of full scale.
const FORCE: f64 = 5e-3;
/// Vibration lies above this frequency in Hz; tilt and movements of the hand lie below.
const HIGH_PASS_HZ: f64 = 20.0;

/// The kind of sensor behind a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SensorKind {
    /// Level 1 is 0.5 % of full scale above the floor, which is the lowest recent force.
    Force,
    /// Level 1 is the noise floor, which is the lowest recent RMS (minimum statistics: R. Martin,
    /// *Noise power spectral density estimation*, IEEE Trans. Speech and Audio Processing 9, 2001).
    Vibration,
}

/// The level of one stream.
#[derive(Debug)]
pub struct StreamLevel {
    kind: SensorKind,
    channels: usize,
    hop: f64,
    /// Share of the running mean that remains after one frame.
    keep: f64,
    /// The last finite sample of each channel.
    last: Vec<f64>,
    slow: Vec<f64>,
    sum: f64,
    frames: u64,
    hops: u64,
    smooth: f64,
    blocks: VecDeque<f64>,
    lowest: f64,
}

impl StreamLevel {
    /// The level of a stream of `channels` samples a frame, at this rate in Hz.
    pub fn new(kind: SensorKind, channels: usize, rate_hz: f64) -> Self {
        Self {
            kind,
            channels: channels.max(1),
            hop: (rate_hz * HOP_S).max(1.0),
            keep: (-std::f64::consts::TAU * HIGH_PASS_HZ / rate_hz).exp(),
            last: Vec::new(),
            slow: Vec::new(),
            sum: 0.0,
            frames: 0,
            hops: 0,
            smooth: 0.0,
            blocks: VecDeque::new(),
            lowest: f64::INFINITY,
        }
    }

    /// The level of the same stream at another rate in Hz, without what it has learnt.
    pub(crate) fn at_rate(&self, rate_hz: f64) -> Self {
        Self::new(self.kind, self.channels, rate_hz)
    }

    /// Takes interleaved frames and passes `on` the level of every hop that they complete. While
    /// `held`, as during a drag, the floor may sink but not rise. A sample that is not a finite
    /// number counts as the one before it.
    pub fn feed(&mut self, samples: &[f32], held: bool, mut on: impl FnMut(f64)) {
        for frame in samples.chunks_exact(self.channels) {
            self.last.resize(self.channels, 0.0);
            for (last, x) in self.last.iter_mut().zip(frame).filter(|(_, x)| x.is_finite()) {
                *last = f64::from(*x);
            }
            if self.slow.is_empty() {
                self.slow.clone_from(&self.last);
            }
            match self.kind {
                SensorKind::Force => self.sum += self.last.iter().sum::<f64>(),
                SensorKind::Vibration => {
                    for (slow, &x) in self.slow.iter_mut().zip(&self.last) {
                        *slow = self.keep * *slow + (1.0 - self.keep) * x;
                        self.sum += (x - *slow).powi(2);
                    }
                }
            }
            self.frames += 1;
            if self.frames as f64 >= (self.hops + 1) as f64 * self.hop {
                on(self.finish_hop(held));
            }
        }
    }

    /// Forgets the noise floor, so that it is learnt again.
    pub fn relearn(&mut self) {
        self.blocks.clear();
        self.lowest = f64::INFINITY;
    }

    fn finish_hop(&mut self, held: bool) -> f64 {
        let mean = std::mem::take(&mut self.sum) / self.hop;
        self.hops += 1;
        // A plain mean to begin with, so that the first hop weighs no more than any other.
        self.smooth += (mean - self.smooth) / SMOOTH.min(self.hops as f64);
        if self.hops as f64 >= SMOOTH {
            self.lowest = self.lowest.min(self.smooth);
        }
        if self.hops.is_multiple_of(BLOCK) && !held && self.lowest.is_finite() {
            self.blocks.push_back(self.lowest);
            self.lowest = self.smooth;
            if self.blocks.len() > BLOCKS {
                self.blocks.pop_front();
            }
        }
        if self.hops < LEARN {
            return 0.0;
        }
        let floor = self.blocks.iter().copied().fold(self.lowest, f64::min);
        match self.kind {
            SensorKind::Force => (mean - floor) / FORCE,
            SensorKind::Vibration => mean.sqrt() / floor.sqrt().max(LEAST_VIBRATION),
        }
    }
}
