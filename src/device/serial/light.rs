//! The camera's light, which is switched by a line of the stylus.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use crate::device::camera::FlashLine;

/// How long the stylus may take to confirm.
const CONFIRM: Duration = Duration::from_millis(500);

/// Switches the camera's light on the stylus; clones switch the same one.
#[derive(Clone, Debug, Default)]
pub struct Light(Arc<[AtomicBool; 2]>);

impl Light {
    /// Requests the light on or off; the driver repeats the command until the stylus confirms it.
    pub fn set(&self, on: bool) {
        self.0[0].store(on, Ordering::Release);
    }

    /// Whether the stylus last said that the light is on.
    pub fn is_on(&self) -> bool {
        self.0[1].load(Ordering::Acquire)
    }

    pub(super) fn wanted(&self) -> bool {
        self.0[0].load(Ordering::Acquire)
    }

    /// Notes what the stylus says of it.
    pub(super) fn confirm(&self, on: bool) {
        self.0[1].store(on, Ordering::Release);
    }
}

impl FlashLine for Light {
    fn switch(&mut self, on: bool) -> Result<(), String> {
        self.set(on);
        let until = Instant::now() + CONFIRM;
        while self.is_on() != on {
            if Instant::now() >= until {
                self.set(false);
                return Err("the stylus, which switches the light, does not answer".into());
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        Ok(())
    }
}
