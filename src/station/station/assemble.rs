//! Creates the devices of a configuration, and lists those that are unavailable.

use std::collections::BTreeMap;

use super::config::{CameraConfig, MicrophoneConfig, StationConfig};
use super::event::{Listener, StationEvent};
use crate::device::camera::{Shutter, Viewfinder};
use crate::device::lines::Lines;
use crate::device::serial::{Light, Stylus};
use crate::device::{Device, OpenError};
use crate::scene::Phase;

#[derive(Default)]
pub struct Assembled {
    pub devices: Vec<Box<dyn Device>>,
    /// Devices that are configured but unavailable, and the reasons.
    pub left_out: Vec<String>,
    pub device_of: BTreeMap<String, String>,
    /// Requests a picture with flash during each drag; `None` without a flash.
    pub flasher: Option<Shutter>,
    pub viewfinder: Option<Viewfinder>,
}

/// Requests a picture with flash once a drag has begun; the picture becomes part of that scan.
impl Listener for Shutter {
    fn on_event(&mut self, event: &StationEvent) {
        if let StationEvent::Phase { phase: Some(Phase::Drag), .. } = event {
            self.flash();
        }
    }
}

/// Creates the devices of a configuration without opening them.
pub fn assemble(config: &StationConfig) -> Assembled {
    let mut all = Assembled::default();
    let stylus = config.stylus.clone().map(Stylus::new);
    let light = stylus.as_ref().map(|stylus| stylus.light.clone());
    stylus.into_iter().for_each(|stylus| all.add(Box::new(stylus)));
    for lines in config.lines.iter().cloned() {
        all.add(Box::new(Lines::new(lines)));
    }
    if let Some(microphone) = &config.microphone
        && let Err(why) = all.add_microphone(microphone)
    {
        all.left_out.push(format!("microphone {}: {why}", microphone.device));
    }
    if let Some(camera) = &config.camera
        && let Err(why) = all.add_camera(camera, light)
    {
        all.left_out.push(format!("camera {}: {why}", camera.device));
    }
    for cut in &config.detection.cuts {
        // Up to here, `device_of` lists streams only. The sources cut from these streams are added now.
        if let Some(device) = all.device_of.get(cut.stream.as_str()).cloned() {
            all.device_of.insert(cut.source.to_string(), device);
        }
    }
    all.device_of.retain(|id, _| config.scene.get(id).is_some());
    all
}

impl Assembled {
    fn add(&mut self, device: Box<dyn Device>) {
        let name = device.name().to_string();
        let streams = device.streams().into_iter().map(|spec| spec.id.to_string());
        self.device_of.extend(streams.map(|id| (id, name.clone())));
        self.devices.push(device);
    }

    #[cfg(feature = "microphone")]
    fn add_microphone(&mut self, config: &MicrophoneConfig) -> Result<(), OpenError> {
        use crate::device::microphone::{Alsa, Microphone};
        let MicrophoneConfig { device, pick, stream } = config;
        let alsa = Box::new(Alsa::new(device.clone())?);
        self.add(Box::new(Microphone::new(stream.clone(), device, *pick, alsa)));
        Ok(())
    }

    #[cfg(not(feature = "microphone"))]
    fn add_microphone(&mut self, _: &MicrophoneConfig) -> Result<(), OpenError> {
        Err(not_built("microphone"))
    }

    #[cfg(feature = "camera")]
    fn add_camera(&mut self, config: &CameraConfig, light: Option<Light>) -> Result<(), OpenError> {
        use std::sync::Arc;

        use crate::device::camera::{Camera, Flash, V4l};
        let CameraConfig { device, turn, every, source, .. } = config;
        let video = Arc::new(V4l { id: device.clone(), turn: *turn });
        let mut camera = Camera::new(source.clone(), device, video, *turn, *every);
        self.viewfinder = Some(camera.viewfinder.clone());
        let by_stylus = light.map(Flash::Stylus);
        if let Some(flash) = &config.flash
            && let Some(by) = if flash.by_camera { Some(Flash::Camera) } else { by_stylus }
        {
            camera = camera.flash(flash.source.clone(), by, flash.settle);
            self.flasher = Some(camera.shutter.clone());
        }
        self.add(Box::new(camera));
        Ok(())
    }

    #[cfg(not(feature = "camera"))]
    fn add_camera(&mut self, _: &CameraConfig, _: Option<Light>) -> Result<(), OpenError> {
        Err(not_built("camera"))
    }
}

#[cfg(not(all(feature = "microphone", feature = "camera")))]
fn not_built(feature: &str) -> OpenError {
    OpenError::Unfit(format!(
        "not part of this build; build with `--features live` or `--features {feature}`"
    ))
}
