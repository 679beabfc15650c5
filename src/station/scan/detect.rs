//! Detects taps and drags in levels of force and vibration, by a state machine with a step per hop.
//!
//! Contact begins when any stream reaches [`DetectorConfig::onset`] and ends when all streams are
//! below [`DetectorConfig::quiet`]. These limits differ so that a level near one of them does not
//! begin and end contacts rapidly. A short contact is a tap. A longer contact is a drag, to which a
//! tap shortly before belongs, too. [`SensorKind`] defines the unit of a level.

use std::collections::VecDeque;
use std::ops::Range;

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
    /// Longest drag, in seconds; a longer contact is noise. Infinite where surfaces are named without begin
    /// and end: then no scan ends for its length.
    pub longest_drag_s: f64,
}

/// Events of the detector, in hops from its first. In (start, end), `end` is not included.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum DetectorEvent {
    /// A drag began at hop `start`; `tap` holds the begin and end of the tap before it, if any.
    Drag { tap: Option<(u64, u64)>, start: u64 },
    /// The drag is over; `end` is the first hop after it. `cut` says that a gap in the data hides
    /// what happened in it, or where it began or ended.
    End { end: u64, cut: bool },
    /// Contact lasted too long, or it began with noise, so it was no drag.
    NoiseTimeout,
}

#[derive(Clone, Copy, Debug)]
enum DetectorState {
    Quiet { tap: Option<(u64, u64)> },
    Contact(Contact),
}

#[derive(Clone, Copy, Debug)]
struct Contact {
    tap: Option<(u64, u64)>,
    start: u64,
    /// Number of hops with data since `start`. Hops in a gap do not hold a contact.
    hops: u64,
    /// If the last hop was quiet: where the quiet began, and its number of hops with data.
    quiet: Option<(u64, u64)>,
    is_drag: bool,
    cut: bool,
}

#[derive(Clone, Debug)]
pub(crate) struct Detector {
    pub config: DetectorConfig,
    state: DetectorState,
    hop_s: f64,
    hop: u64,
    /// Begin of the gap that the last hop was in; `None` if the last hop had data.
    gap_at: Option<u64>,
    /// End of the latest gap.
    gap_end: Option<u64>,
    /// The mean levels of the blocks of the contact so far, each with its first hop and its number of
    /// hops; empty where force holds the contact, and without a longest drag.
    blocks: Vec<(u64, f64, u64)>,
    /// Whether the last event came since the noise at rest has risen: the lowest level within the contact
    /// is then the new floor.
    pub rest_rose: bool,
}

impl Detector {
    pub(crate) fn new(config: DetectorConfig, hop_s: f64) -> Self {
        let state = DetectorState::Quiet { tap: None };
        let (blocks, rest_rose) = (Vec::new(), false);
        Self { config, state, hop_s, hop: 0, gap_at: None, gap_end: None, blocks, rest_rose }
    }

    /// Whether there is contact, during which noise floors are not learnt.
    pub(crate) fn in_contact(&self) -> bool {
        !matches!(self.state, DetectorState::Quiet { .. })
    }

    /// Whether the last hop with data was quiet, so that a contact in progress may have ended.
    pub(crate) fn is_quiet(&self) -> bool {
        !matches!(self.state, DetectorState::Contact(Contact { quiet: None, .. }))
    }

    /// Takes the level of the next hop, which is the highest level of all streams in this hop;
    /// `None` for a hop in a gap, which neither begins, holds nor ends a contact. `pressed`: a force
    /// shows contact in this hop.
    pub(crate) fn hop(&mut self, level: Option<f64>, pressed: bool) -> Option<DetectorEvent> {
        let at = self.hop;
        self.hop += 1;
        self.rest_rose = false;
        let (config, hop_s) = (self.config, self.hop_s);
        let lasted = |hops: u64, seconds: f64| hops as f64 * hop_s >= seconds - 1e-9;
        let Some(level) = level else {
            let gap_at = *self.gap_at.get_or_insert(at);
            let DetectorState::Contact(Contact { quiet, is_drag, .. }) = self.state else {
                return None;
            };
            if !lasted(self.hop - gap_at, LONGEST_GAP_S) {
                return None;
            }
            self.state = DetectorState::Quiet { tap: None };
            let end = quiet.map_or(gap_at, |(end, _)| end);
            return is_drag.then_some(DetectorEvent::End { end, cut: true });
        };
        let gap_at = self.gap_at.take();
        self.gap_end = gap_at.map(|_| at).or(self.gap_end);
        match &mut self.state {
            DetectorState::Quiet { tap } => {
                if tap.is_some_and(|(_, end)| lasted(at + 1 - end, config.longest_pause_s)) {
                    *tap = None;
                }
                // False for NaN, like `level < config.quiet`.
                if level >= config.onset {
                    // A contact this close to a gap may have begun within the gap.
                    let cut = self.gap_end.is_some_and(|end| !lasted(at - end, config.tap_hold_s));
                    let (tap, start, hops, quiet, is_drag) = (*tap, at, 1, None, false);
                    let contact = Contact { tap, start, hops, quiet, is_drag, cut };
                    self.state = DetectorState::Contact(contact);
                    self.blocks.clear();
                }
                None
            }
            DetectorState::Contact(contact) => {
                contact.hops += 1;
                match self.blocks.last_mut() {
                    // Without a longest drag, a contact may last for days.
                    _ if pressed || config.longest_drag_s.is_infinite() => self.blocks.clear(),
                    Some((_, mean, hops)) if (*hops as f64) < SMOOTH => {
                        *hops += 1;
                        *mean += (level - *mean) / *hops as f64;
                    }
                    _ => self.blocks.push((at, level, 1)),
                }
                contact.cut |= gap_at.is_some();
                contact.quiet = (level < config.quiet).then(|| match contact.quiet {
                    Some((end, hops)) => (end, hops + 1),
                    // If the contact ended within a gap, it was last seen before the gap.
                    None => (gap_at.unwrap_or(at), 1),
                });
                let Contact { tap, start, hops, quiet, is_drag, cut } = *contact;
                let hold_s = if is_drag { config.drag_hold_s } else { config.tap_hold_s };
                match quiet {
                    Some((end, quiet)) if lasted(quiet, hold_s) && quiet >= LEAST_HOLD => {
                        let tap = (!is_drag).then_some((start, end));
                        self.state = DetectorState::Quiet { tap };
                        tap.is_none().then_some(DetectorEvent::End { end, cut })
                    }
                    None if !is_drag
                        && lasted(hops, config.longest_tap_s)
                        && hops >= LEAST_DRAG =>
                    {
                        contact.is_drag = true;
                        Some(DetectorEvent::Drag { tap, start })
                    }
                    _ if is_drag => {
                        let is_noise = lasted(hops, config.longest_drag_s);
                        let noise = is_noise.then_some(DetectorEvent::NoiseTimeout);
                        let event = noise.or_else(|| self.risen_rest(cut))?;
                        self.state = DetectorState::Quiet { tap: None };
                        self.rest_rose = true;
                        Some(event)
                    }
                    _ => None,
                }
            }
        }
    }

    /// The end of a contact that does not fall below `quiet`, since the noise at rest has risen: its last
    /// second is far below what came before. Where it begins like that too, noise began it.
    fn risen_rest(&self, cut: bool) -> Option<DetectorEvent> {
        let (_, _, hops) = self.blocks.last()?;
        if (*hops as f64) < SMOOTH {
            return None;
        }
        let blocks = |seconds: f64| ((seconds / (SMOOTH * self.hop_s)).ceil() as usize).max(3);
        let lowest = self.blocks.iter().map(|(_, mean, _)| *mean).fold(f64::INFINITY, f64::min);
        let is_rest = |(_, mean, _): &&(u64, f64, u64)| *mean < self.config.quiet * lowest;
        let resting = self.blocks.iter().rev().take_while(is_rest).count();
        let loud = self.blocks.iter().filter(|(_, mean, _)| *mean >= self.config.onset * lowest);
        if resting < blocks(RISEN_REST_S) || loud.count() < blocks(RISEN_DRAG_S) {
            return None;
        }
        let before = self.blocks.iter().take_while(is_rest).count();
        let (first, ..) = self.blocks[self.blocks.len() - resting];
        let noise = before >= blocks(self.config.longest_tap_s);
        Some(if noise {
            DetectorEvent::NoiseTimeout
        } else {
            DetectorEvent::End { end: first, cut }
        })
    }

    /// Ends a drag in progress. Called when the streams have ended or stalled.
    pub(crate) fn finish(&mut self) -> Option<DetectorEvent> {
        let state = std::mem::replace(&mut self.state, DetectorState::Quiet { tap: None });
        match state {
            DetectorState::Contact(Contact { quiet, is_drag: true, cut, .. }) => {
                let end = quiet.map(|(end, _)| end).or(self.gap_at).unwrap_or(self.hop);
                Some(DetectorEvent::End { end, cut: cut || self.gap_at.is_some() })
            }
            _ => None,
        }
    }
}

/// Finds the hop at which a tap begins in a stream other than the one that detected it: the first hop in
/// `window` that reaches `onset` after a hop below it. `levels` holds a level per hop, from `first` on;
/// `None` for a hop in a gap.
pub(crate) fn onset_in(
    levels: &[Option<f64>],
    first: u64,
    window: Range<u64>,
    onset: f64,
) -> Option<u64> {
    let at = |hop: u64| *levels.get(usize::try_from(hop.checked_sub(first)?).ok()?)?;
    window.skip_while(|hop| at(*hop).is_none_or(|x| x >= onset)).find(|hop| at(*hop) >= Some(onset))
}

/// Length of a hop in seconds, which is the resolution of every onset and end; a stream below 200 Hz
/// has hops of one frame.
const HOP_S: f64 = 0.005;
/// Seconds before the noise floor is first used; until then, every level is 0.
const LEARN_S: f64 = 0.3;
/// Number of hops over which the floor is smoothed, so that one quiet hop does not lower it.
const SMOOTH: f64 = 20.0;
/// The floor is the minimum over the last [`BLOCKS`] blocks of [`BLOCK_S`] seconds each, without contact.
const BLOCK_S: f64 = 0.5;
const BLOCKS: usize = 20;
/// A floor is forgotten in a gap that is longer than all its blocks, in seconds.
const MEMORY_S: f64 = BLOCK_S * BLOCKS as f64;
/// Fewest quiet hops that end a contact, since a single frame of any vibration may be near 0.
const LEAST_HOLD: u64 = 4;
/// Fewest hops with data in a drag, so that few frames of a slow stream make none.
const LEAST_DRAG: u64 = 10;
/// Fewest values from which a vibration's level is taken. Where a hop has fewer, it is taken from
/// several hops, since a single value of any vibration may be near 0 or far from it.
const LEAST_VALUES: f64 = 4.0;
/// A gap in a drag that is longer than this ends it, in seconds.
const LONGEST_GAP_S: f64 = 3.0;
/// Vibration below this share of full scale (about 6 steps of 16 bits) is noise of the converter.
const LEAST_VIBRATION: f64 = 2e-4;
/// Force above the floor at level 1, as a share of full scale.
const FORCE: f64 = 5e-3;
/// Seconds of a level far below the contact's own that are rest, and seconds of a drag before them, where
/// the noise floor may have risen.
const RISEN_REST_S: f64 = 1.0;
const RISEN_DRAG_S: f64 = 0.5;
/// Cut-off frequency in Hz, but at most a quarter of the rate. Vibration lies above it; tilt and
/// movements of the hand lie below it.
const HIGH_PASS_HZ: f64 = 20.0;

pub(super) fn hop_frames(rate_hz: f64) -> f64 {
    (rate_hz * HOP_S).max(1.0)
}

pub(super) fn hop_s(rate_hz: f64) -> f64 {
    hop_frames(rate_hz) / rate_hz
}

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
pub(super) struct StreamLevel {
    pub kind: SensorKind,
    channels: usize,
    hop_s: f64,
    /// Factor by which the mean `slow` shrinks at each frame, as in a low-pass at the cut-off.
    keep: f64,
    /// Longest gap, in frames, across which `slow` still holds.
    held_frames: u64,
    /// The last finite sample of each channel.
    last: Vec<f64>,
    slow: Vec<f64>,
    /// Number of frames missing since the last frame, and of hops without a level since the last level.
    missing: u64,
    silent: u64,
    /// Mean squares of the latest hops, and the largest number of them.
    recent: VecDeque<f64>,
    most_recent: usize,
    /// From its hops the floor is learnt: without contact, in this block.
    rest: Lowest,
    /// The lowest levels of the blocks before this one.
    blocks: VecDeque<f64>,
    /// Of the contact in progress.
    held: Option<Lowest>,
}

/// The lowest smoothed mean square.
#[derive(Clone, Copy, Debug)]
struct Lowest {
    hops: u64,
    smooth: f64,
    lowest: f64,
}

impl Lowest {
    const NONE: Self = Self { hops: 0, smooth: 0.0, lowest: f64::INFINITY };

    fn add(&mut self, mean: f64) {
        self.hops += 1;
        // Begins with a plain mean, so that the first hop weighs no more than any other.
        self.smooth += (mean - self.smooth) / SMOOTH.min(self.hops as f64);
        if self.hops as f64 >= SMOOTH {
            self.lowest = self.lowest.min(self.smooth);
        }
    }
}

impl StreamLevel {
    pub(super) fn new(kind: SensorKind, channels: usize, rate_hz: f64) -> Self {
        let turn = std::f64::consts::TAU * HIGH_PASS_HZ.min(rate_hz / 4.0) / rate_hz;
        Self {
            kind,
            channels: channels.max(1),
            hop_s: hop_s(rate_hz),
            keep: (-turn).exp(),
            held_frames: (1.0 / turn).max(2.0) as u64,
            last: Vec::new(),
            slow: Vec::new(),
            missing: 0,
            silent: 0,
            recent: VecDeque::new(),
            most_recent: match kind {
                SensorKind::Force => 1,
                SensorKind::Vibration => {
                    (LEAST_VALUES / (hop_frames(rate_hz) * channels.max(1) as f64)).ceil() as usize
                }
            },
            rest: Lowest::NONE,
            blocks: VecDeque::new(),
            held: None,
        }
    }

    /// Takes the interleaved frames of the next hop, and returns the hop's level; `None` if more than
    /// half of its frames are `missing` (ranges in order, counted from the hop's first frame), or if
    /// there are none. Missing frames count for nothing. The noise floor is learnt unless `held` (during
    /// contact). A sample that is not finite is replaced by the last finite one.
    pub(super) fn hop(
        &mut self,
        samples: &[f32],
        missing: impl IntoIterator<Item = Range<u64>>,
        held: bool,
    ) -> Option<f64> {
        let (mut sum, mut real, mut frames) = (0.0, 0_u64, 0_u64);
        let mut missing = missing.into_iter().peekable();
        for frame in samples.chunks_exact(self.channels) {
            let at = frames;
            frames += 1;
            while missing.next_if(|gap| gap.end <= at).is_some() {}
            if missing.peek().is_some_and(|gap| gap.start <= at) {
                self.missing += 1;
                continue;
            }
            self.last.resize(self.channels, 0.0);
            for (last, x) in self.last.iter_mut().zip(frame).filter(|(_, x)| x.is_finite()) {
                *last = f64::from(*x);
            }
            if std::mem::take(&mut self.missing) > self.held_frames {
                self.slow.clear();
            }
            match self.kind {
                SensorKind::Force => sum += self.last.iter().sum::<f64>(),
                // The first frame shows no vibration yet.
                SensorKind::Vibration if self.slow.is_empty() => {
                    self.slow.clone_from(&self.last);
                    continue;
                }
                SensorKind::Vibration => {
                    for (slow, &x) in self.slow.iter_mut().zip(&self.last) {
                        *slow = self.keep * *slow + (1.0 - self.keep) * x;
                        sum += (x - *slow).powi(2);
                    }
                }
            }
            real += 1;
        }
        if frames == 0 {
            self.missing = self.held_frames + 1;
        }
        if real == 0 || 2 * real < frames {
            self.silent += 1;
            if self.silent as f64 * self.hop_s > MEMORY_S {
                self.relearn();
            }
            return None;
        }
        if std::mem::take(&mut self.silent) > 0 {
            self.recent.clear();
        }
        if self.recent.len() == self.most_recent {
            self.recent.pop_front();
        }
        let mean = sum / real as f64;
        self.recent.push_back(mean);
        let of_recent = self.recent.iter().sum::<f64>() / self.recent.len() as f64;
        self.learn(of_recent, held);
        // A contact begins once several hops are loud, and ends with the first of several quiet ones.
        Some(self.level(mean.min(of_recent)))
    }

    pub(super) fn relearn(&mut self) {
        self.rest = Lowest::NONE;
        self.blocks.clear();
    }

    /// Makes the lowest level of the contact that just ended the floor.
    pub(super) fn adopt_lowest(&mut self) {
        match self.held.take().filter(|held| held.lowest.is_finite()) {
            Some(Lowest { lowest, .. }) => {
                self.blocks.clear();
                (self.rest.smooth, self.rest.lowest) = (lowest, lowest);
            }
            None => self.relearn(),
        }
    }

    fn hops_in(&self, seconds: f64) -> f64 {
        (seconds / self.hop_s).round()
    }

    fn learn(&mut self, mean: f64, held: bool) {
        if held {
            return self.held.get_or_insert(Lowest::NONE).add(mean);
        }
        self.held = None;
        self.rest.add(mean);
        let block = self.hops_in(BLOCK_S).max(1.0) as u64;
        if self.rest.hops.is_multiple_of(block) && self.rest.lowest.is_finite() {
            self.blocks.push_back(self.rest.lowest);
            self.rest.lowest = self.rest.smooth;
            if self.blocks.len() > BLOCKS {
                self.blocks.pop_front();
            }
        }
    }

    fn level(&self, mean: f64) -> f64 {
        if (self.rest.hops as f64) < self.hops_in(LEARN_S).max(SMOOTH) {
            return 0.0;
        }
        let floor = self.blocks.iter().copied().fold(self.rest.lowest, f64::min);
        match self.kind {
            SensorKind::Force => (mean - floor) / FORCE,
            SensorKind::Vibration => mean.sqrt() / floor.sqrt().max(LEAST_VIBRATION),
        }
    }
}

#[cfg(test)]
mod tests;
