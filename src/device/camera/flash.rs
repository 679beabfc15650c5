//! The light of the camera, and the frames that were taken with it.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Switches the light of the camera, for example by a command to the stylus.
pub trait FlashLine: Send {
    /// Switches it on or off.
    ///
    /// # Errors
    /// With a message, if it is not known whether this has worked.
    fn switch(&mut self, on: bool) -> Result<(), String>;
}

/// The switch of the light.
pub enum Flash {
    /// A line outside the camera.
    Line(Box<dyn FlashLine>),
    /// A control of the camera itself.
    Control(FlashControl),
}

/// A control of a V4L2 camera that switches its light.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FlashControl {
    /// Number of the control, as `v4l2-ctl --list-ctrls` shows it.
    pub id: u32,
    /// Its value for a light that stays on.
    pub on: i64,
    /// Its value for no light.
    pub off: i64,
}

impl FlashControl {
    /// V4L2_CID_FLASH_LED_MODE with a torch (2) and without light (0).
    pub const TORCH: Self = Self { id: 0x009c_0901, on: 2, off: 0 };
}

/// Requests pictures with flash; clones use the same camera.
#[derive(Clone, Debug, Default)]
pub struct Shutter(Arc<AtomicBool>);

impl Shutter {
    /// Requests one picture with flash. A second request before it is taken changes nothing.
    pub fn flash(&self) {
        self.0.store(true, Ordering::Release);
    }

    pub(super) fn take(&self) -> bool {
        self.0.swap(false, Ordering::AcqRel)
    }
}

/// The light in which a frame was taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum FrameLight {
    Plain,
    Flash,
    /// Taken while the light changed: useless.
    Between,
}

/// The judgement of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct FlashVerdict {
    pub light: FrameLight,
    /// Whether to switch the light on or off now; `None` to leave it.
    pub switch: Option<bool>,
}

/// Follows the light from frame to frame.
#[derive(Clone, Copy, Debug)]
pub(super) struct Cycle {
    settle: Duration,
    phase: FlashPhase,
}

#[derive(Clone, Copy, Debug)]
enum FlashPhase {
    Off,
    Rising(Instant),
    Falling(Instant),
}

impl Cycle {
    /// A light that needs `settle` until frames show a change: its own time, that of the camera's
    /// exposure control, and the frames under way in between.
    pub fn new(settle: Duration) -> Self {
        Self { settle, phase: FlashPhase::Off }
    }

    /// Judges a frame that arrived at `now`; `wanted` says whether a picture with flash is wanted.
    pub fn judge(&mut self, now: Instant, wanted: impl FnOnce() -> bool) -> FlashVerdict {
        let settled = |since: Instant| now.saturating_duration_since(since) >= self.settle;
        match self.phase {
            FlashPhase::Rising(since) if settled(since) => {
                self.phase = FlashPhase::Falling(now);
                FlashVerdict { light: FrameLight::Flash, switch: Some(false) }
            }
            FlashPhase::Falling(since) if settled(since) => {
                self.phase = FlashPhase::Off;
                FlashVerdict { light: FrameLight::Plain, switch: None }
            }
            FlashPhase::Rising(_) | FlashPhase::Falling(_) => {
                FlashVerdict { light: FrameLight::Between, switch: None }
            }
            FlashPhase::Off if wanted() => {
                self.phase = FlashPhase::Rising(now);
                FlashVerdict { light: FrameLight::Plain, switch: Some(true) }
            }
            FlashPhase::Off => FlashVerdict { light: FrameLight::Plain, switch: None },
        }
    }

    /// Notes that the light is off, or could not be switched on: no frame will show it.
    pub fn cancel(&mut self) {
        self.phase = FlashPhase::Off;
    }

    /// Whether the light is on, as far as is known.
    pub fn lit(&self) -> bool {
        matches!(self.phase, FlashPhase::Rising(_))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_with_flash_is_one_taken_after_the_light_has_settled() {
        let mut cycle = Cycle::new(Duration::from_millis(100));
        let begin = Instant::now();
        let mut seen = Vec::new();
        for i in 0..12 {
            let now = begin + Duration::from_millis(40 * i);
            let verdict = cycle.judge(now, || i == 2);
            seen.push((verdict.light, verdict.switch));
        }
        let plain = (FrameLight::Plain, None);
        let between = (FrameLight::Between, None);
        let (on, flash) = ((FrameLight::Plain, Some(true)), (FrameLight::Flash, Some(false)));
        let expected = [plain, plain, on, between, between, flash, between, between, plain];
        assert_eq!(seen[..9], expected);
        assert!(seen[9..].iter().all(|frame| *frame == plain));
    }

    #[test]
    fn a_shutter_is_released_once() {
        let shutter = Shutter::default();
        assert!(!shutter.take());
        shutter.clone().flash();
        shutter.flash();
        assert!(shutter.take() && !shutter.take());
    }
}
