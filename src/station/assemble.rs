//! Makes the devices of a configuration, and names those that this build lacks.

use std::collections::BTreeMap;

use super::config::{CameraConfig, LinesConfig, MicrophoneConfig, StationConfig, StylusConfig};
use super::event::{Listener, StationEvent};
use crate::device::camera::{Shutter, Viewfinder};
use crate::device::lines::Lines;
use crate::device::serial::{Light, Stylus};
use crate::device::{Device, OpenError};
use crate::scene::Phase;

/// Devices, ready to run.
#[derive(Default)]
pub struct Assembled {
    /// The devices.
    pub devices: Vec<Box<dyn Device>>,
    /// Devices that are configured but unavailable, and the reasons.
    pub left_out: Vec<String>,
    /// The device of each source.
    pub device_of: BTreeMap<String, String>,
    /// Requests a picture with flash during each drag, if there is a flash.
    pub flasher: Option<Flasher>,
    /// Shows what the camera sees, if there is one.
    pub viewfinder: Option<Viewfinder>,
}

/// Requests a picture with flash once a drag has begun; the picture becomes part of that scan.
#[derive(Clone, Debug)]
pub struct Flasher(Shutter);

impl Listener for Flasher {
    fn on_event(&mut self, event: &StationEvent) {
        if let StationEvent::Phase { phase: Some(Phase::Drag), .. } = event {
            self.0.flash();
        }
    }
}

/// Makes the devices of a configuration. None is opened yet.
pub fn assemble(config: &StationConfig) -> Assembled {
    let mut all = Assembled::default();
    let light = config.stylus.as_ref().map(|stylus| all.stylus(stylus));
    for LinesConfig { address, rate_hz, count, streams } in config.lines.iter().cloned() {
        all.add(Box::new(Lines::new(address, streams, count, rate_hz)));
    }
    if let Some(microphone) = &config.microphone {
        match sound(microphone) {
            Ok(device) => all.add(device),
            Err(why) => all.left_out.push(format!("microphone {}: {why}", microphone.device)),
        }
    }
    if let Some(camera) = &config.camera {
        match video(camera, light) {
            Ok(StationCamera { device, flasher, viewfinder }) => {
                all.add(device);
                (all.flasher, all.viewfinder) = (flasher, Some(viewfinder));
            }
            Err(why) => all.left_out.push(format!("camera {}: {why}", camera.device)),
        }
    }
    for cut in &config.detection.cuts {
        // So far `device_of` lists streams; several sources may be cut from one.
        if let Some(device) = all.device_of.get(cut.stream.as_str()) {
            let device = device.clone();
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

    fn stylus(&mut self, config: &StylusConfig) -> Light {
        let stylus = Stylus::new(config.port.clone())
            .rate_hz(config.rate_hz)
            .streams_of(config.streams.clone());
        let light = stylus.light();
        self.add(Box::new(stylus));
        light
    }
}

#[cfg(not(all(feature = "microphone", feature = "camera")))]
fn not_built(feature: &str) -> OpenError {
    OpenError::Unfit(format!(
        "not part of this build; build with `--features live` or `--features {feature}`"
    ))
}

#[cfg(feature = "microphone")]
fn sound(config: &MicrophoneConfig) -> Result<Box<dyn Device>, OpenError> {
    use crate::device::microphone::{Alsa, Microphone};
    let alsa = Alsa::new(config.device.clone())?;
    Ok(Box::new(Microphone::new(config.stream.clone(), Box::new(alsa)).pick(config.pick)))
}

#[cfg(not(feature = "microphone"))]
fn sound(_: &MicrophoneConfig) -> Result<Box<dyn Device>, OpenError> {
    Err(not_built("microphone"))
}

/// A camera with its flash and viewfinder.
struct StationCamera {
    device: Box<dyn Device>,
    flasher: Option<Flasher>,
    viewfinder: Viewfinder,
}

#[cfg(feature = "camera")]
fn video(config: &CameraConfig, light: Option<Light>) -> Result<StationCamera, OpenError> {
    use std::sync::Arc;

    use crate::device::camera::{Camera, Flash, V4l};
    let video = Arc::new(V4l::new(config.device.clone(), config.turn));
    let mut camera =
        Camera::new(config.source.clone(), video).turn(config.turn).every(config.every);
    let viewfinder = camera.viewfinder();
    let mut flasher = None;
    if let Some(flash) = &config.flash {
        let by = match (flash.control, light) {
            (Some(control), _) => Some(Flash::Control(control)),
            (None, Some(light)) => Some(Flash::Line(Box::new(light))),
            (None, None) => None,
        };
        if let Some(by) = by {
            camera = camera.flash(flash.source.clone(), by, flash.settle);
            flasher = Some(Flasher(camera.shutter()));
        }
    }
    Ok(StationCamera { device: Box::new(camera), flasher, viewfinder })
}

#[cfg(not(feature = "camera"))]
fn video(_: &CameraConfig, _: Option<Light>) -> Result<StationCamera, OpenError> {
    Err(not_built("camera"))
}
