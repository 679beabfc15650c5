//! Detects taps and drags in levels of force and vibration, by a state machine with a step per hop.
//!
//! Contact begins when any stream reaches [`DetectorConfig::onset`] and ends when all streams are
//! below [`DetectorConfig::quiet`]. These limits differ so that a level near one of them does not
//! begin and end contacts rapidly. A short contact is a tap. A longer contact is a drag, to which a
//! tap shortly before belongs, too. [`SensorKind`] defines the unit of a level.

use std::collections::VecDeque;

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DetectorConfig {
    /// Level at which contact begins; [`SensorKind`] defines its unit.
    pub onset: f64,
    /// Level below which there is no contact, in the same unit as `onset`.
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

/// Events of the detector, in hops from its first. In (start, end), `end` is not included.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum DetectorEvent {
    /// A drag began at hop `start`; `tap` holds the begin and end of the tap before it, if any.
    Drag { tap: Option<(u64, u64)>, start: u64 },
    /// The drag is over; `end` is the first hop after it.
    End { end: u64 },
    /// Contact lasted too long, so it was noise, and the noise floor must be learnt again.
    NoiseTimeout,
}

#[derive(Clone, Copy, Debug)]
enum DetectorState {
    Quiet { tap: Option<(u64, u64)> },
    Contact { tap: Option<(u64, u64)>, start: u64, quiet_at: Option<u64>, is_drag: bool },
}

#[derive(Clone, Debug)]
pub(crate) struct Detector {
    pub config: DetectorConfig,
    state: DetectorState,
    hop: u64,
}

impl Detector {
    pub(crate) fn new(config: DetectorConfig) -> Self {
        Self { config, state: DetectorState::Quiet { tap: None }, hop: 0 }
    }

    /// Whether there is contact, during which noise floors must not rise.
    pub(crate) fn in_contact(&self) -> bool {
        !matches!(self.state, DetectorState::Quiet { .. })
    }

    /// Takes the level of the next hop, which is the highest level of all streams in this hop.
    pub(crate) fn hop(&mut self, level: f64) -> Option<DetectorEvent> {
        let at = self.hop;
        self.hop += 1;
        let config = self.config;
        let lasted = |since: u64, seconds: f64| (at + 1 - since) as f64 * HOP_S >= seconds - 1e-9;
        // Both comparisons are false for NaN, so NaN is neither quiet nor the begin of contact.
        let is_quiet = level < config.quiet;
        match &mut self.state {
            DetectorState::Quiet { tap } => {
                if tap.is_some_and(|(_, end)| lasted(end, config.longest_pause_s)) {
                    *tap = None;
                }
                if level >= config.onset {
                    let (tap, start, quiet_at, is_drag) = (*tap, at, None, false);
                    self.state = DetectorState::Contact { tap, start, quiet_at, is_drag };
                }
                None
            }
            DetectorState::Contact { tap, start, quiet_at, is_drag } => {
                *quiet_at = if is_quiet { Some(quiet_at.unwrap_or(at)) } else { None };
                let hold_s = if *is_drag { config.drag_hold_s } else { config.tap_hold_s };
                match *quiet_at {
                    Some(end) if lasted(end, hold_s) => {
                        let tap = (!*is_drag).then_some((*start, end));
                        self.state = DetectorState::Quiet { tap };
                        tap.is_none().then_some(DetectorEvent::End { end })
                    }
                    None if !*is_drag && lasted(*start, config.longest_tap_s) => {
                        *is_drag = true;
                        Some(DetectorEvent::Drag { tap: *tap, start: *start })
                    }
                    _ if *is_drag && lasted(*start, config.longest_drag_s) => {
                        self.state = DetectorState::Quiet { tap: None };
                        Some(DetectorEvent::NoiseTimeout)
                    }
                    _ => None,
                }
            }
        }
    }

    /// Ends a drag in progress. Called when the streams have ended or stalled.
    pub(crate) fn finish(&mut self) -> Option<DetectorEvent> {
        let state = std::mem::replace(&mut self.state, DetectorState::Quiet { tap: None });
        match state {
            DetectorState::Contact { quiet_at, is_drag: true, .. } => {
                Some(DetectorEvent::End { end: quiet_at.unwrap_or(self.hop) })
            }
            _ => None,
        }
    }
}

/// Finds the hop at which a tap begins in a stream other than the one that detected it: the first hop in
/// `window` that reaches `onset` after a hop below it. `levels` holds a level per hop, from `first` on.
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

/// Length of a hop in seconds, which is the resolution of every onset and end.
pub const HOP_S: f64 = 0.005;
/// Number of hops (0.3 s) before the noise floor is first used; until then, every level is 0.
const LEARN: u64 = 60;
/// Number of hops (0.1 s) over which the floor is smoothed, so that one quiet hop does not lower it.
const SMOOTH: f64 = 20.0;
/// The floor is the minimum over the last [`BLOCKS`] blocks (10 s) of [`BLOCK`] hops (0.5 s) each.
const BLOCK: u64 = 100;
const BLOCKS: usize = 20;
/// Vibration below this share of full scale (about 6 steps of 16 bits) is noise of the converter.
const LEAST_VIBRATION: f64 = 2e-4;
/// Force above the floor at level 1, as a share of full scale.
const FORCE: f64 = 5e-3;
/// Cut-off frequency in Hz. Vibration lies above it; tilt and movements of the hand lie below it.
const HIGH_PASS_HZ: f64 = 20.0;

#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SensorKind {
    /// Level 1 is 0.5 % of full scale above the floor, which is the lowest recent force.
    Force,
    /// Level 1 is the noise floor, which is the lowest recent RMS (minimum statistics: R. Martin,
    /// *Noise power spectral density estimation*, IEEE Trans. Speech and Audio Processing 9, 2001).
    Vibration,
}

#[derive(Debug)]
pub struct StreamLevel {
    kind: SensorKind,
    channels: usize,
    hop: f64,
    /// Factor by which the mean `slow` shrinks at each frame, as in a low-pass at [`HIGH_PASS_HZ`].
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
    /// Measures the level of a stream of this many channels, at this rate in Hz.
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

    /// A new meter of the same stream at another rate in Hz; it has learnt nothing yet.
    pub(crate) fn at_rate(&self, rate_hz: f64) -> Self {
        Self::new(self.kind, self.channels, rate_hz)
    }

    /// Takes interleaved frames and passes the level of each completed hop to `on`. While `held`
    /// (during contact), the noise floor may fall but not rise. A sample that is not finite is
    /// replaced by the last finite one.
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

    pub fn relearn(&mut self) {
        self.blocks.clear();
        self.lowest = f64::INFINITY;
    }

    fn finish_hop(&mut self, held: bool) -> f64 {
        let mean = std::mem::take(&mut self.sum) / self.hop;
        self.hops += 1;
        // Begins with a plain mean, so that the first hop weighs no more than any other.
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
