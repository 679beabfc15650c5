//! The camera's light: switches it, and tells which frames were taken with light.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

pub enum Flash {
    /// Switches a light that is not part of the camera, for example one of the stylus. An error
    /// says why the light may not have switched.
    Line(Box<dyn FnMut(bool) -> Result<(), String> + Send>),
    Control(FlashControl),
}

/// A control of a V4L2 camera (video for Linux) that switches the camera's light.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FlashControl {
    /// Number of the control, as shown by `v4l2-ctl --list-ctrls`.
    pub id: u32,
    /// Value of the control for a light that stays on; `off` is the value for no light.
    pub on: i64,
    pub off: i64,
}

impl FlashControl {
    /// The control V4L2_CID_FLASH_LED_MODE with its values for torch (2) and no light (0).
    pub const TORCH: Self = Self { id: 0x009c_0901, on: 2, off: 0 };
}

/// A button that requests pictures with flash. All clones belong to the same camera.
#[derive(Clone, Debug, Default)]
pub struct Shutter(Arc<AtomicBool>);

impl Shutter {
    /// Requests a picture with flash. Further requests before it is taken change nothing.
    pub fn flash(&self) {
        self.0.store(true, Ordering::Release);
    }

    pub(super) fn take(&self) -> bool {
        self.0.swap(false, Ordering::AcqRel)
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum FrameLight {
    Plain,
    Flash,
    /// A frame taken while the light was changing, which is useless.
    Between,
}

/// Follows the state of the light from frame to frame.
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
    /// A cycle with the light off. `settle` is the time after which all frames show a switch of the
    /// light: light and exposure control need time, and some frames are on their way.
    pub fn new(settle: Duration) -> Self {
        Self { settle, phase: FlashPhase::Off }
    }

    /// Judges the light of a frame that arrived at `now`. Also returns whether to switch the light
    /// on or off now (`None`: leave it). `wanted` tells whether a picture with flash is requested.
    pub fn judge(
        &mut self,
        now: Instant,
        wanted: impl FnOnce() -> bool,
    ) -> (FrameLight, Option<bool>) {
        let settled = |since: Instant| now.saturating_duration_since(since) >= self.settle;
        match self.phase {
            FlashPhase::Rising(since) if settled(since) => {
                self.phase = FlashPhase::Falling(now);
                (FrameLight::Flash, Some(false))
            }
            FlashPhase::Falling(since) if settled(since) => {
                self.phase = FlashPhase::Off;
                (FrameLight::Plain, None)
            }
            FlashPhase::Rising(_) | FlashPhase::Falling(_) => (FrameLight::Between, None),
            FlashPhase::Off if wanted() => {
                self.phase = FlashPhase::Rising(now);
                (FrameLight::Plain, Some(true))
            }
            FlashPhase::Off => (FrameLight::Plain, None),
        }
    }

    /// To be called if the light is off or failed: the next frames count as taken without light.
    pub fn cancel(&mut self) {
        self.phase = FlashPhase::Off;
    }

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
        let judge = |i: u64| cycle.judge(begin + Duration::from_millis(40 * i), || i == 2);
        let seen: Vec<_> = (0..12).map(judge).collect();
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
