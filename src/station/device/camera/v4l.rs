//! Opens and lists real cameras by V4L2 (video for Linux), with the crate nokhwa.

use std::collections::BTreeSet;
use std::path::Path;

use nokhwa::utils::{
    ApiBackend, CameraFormat, CameraIndex, ControlValueSetter, FrameFormat as Coding,
    KnownCameraControl, RequestedFormat, RequestedFormatType,
};
use nokhwa::{Camera as Nokhwa, NokhwaError};

use super::frame::FrameFormat;
use super::{Frame, Frames, Turn, Video};
use crate::device::OpenError;
use crate::device::list::{
    ListedDevice, camera_alias, camera_number, node_problem, permission_hint,
};
use crate::trial::Image;

const DEV: &str = "/dev";
/// The picture formats that can be decoded, best first.
const CODINGS: [Coding; 4] = [Coding::RAWRGB, Coding::RAWBGR, Coding::YUYV, Coding::MJPEG];
/// Preferred frames per second. Higher rates cost computing time and light.
const RATE_HZ: u32 = 30;
/// The control of a camera's own light, with its values for a light that stays on and for none.
const V4L2_CID_FLASH_LED_MODE: u128 = 0x009c_0901;
const TORCH: i64 = 2;
const NO_LIGHT: i64 = 0;

/// A camera. It is opened with the smallest picture size that covers the compared region, once `turn`
/// has made the picture upright.
#[derive(Clone, Debug)]
pub struct V4l {
    /// Its name from `surfaced devices`.
    pub(crate) id: String,
    pub(crate) turn: Turn,
}

impl Video for V4l {
    fn open(&self) -> Result<Box<dyn Frames>, OpenError> {
        let number = camera_number(Path::new(DEV), &self.id)?;
        let mut camera = open(number, &self.id)?;
        let said = |error| explain(number, &self.id, &error);
        let offers = camera.compatible_camera_formats().map_err(said)?;
        let format = choose(&offers, self.turn).unwrap_or_else(|| camera.camera_format());
        if format != camera.camera_format() {
            let exact = RequestedFormat::with_formats(RequestedFormatType::Exact(format), &CODINGS);
            camera.set_camera_requset(exact).map_err(said)?;
        }
        camera.open_stream().map_err(said)?;
        Ok(Box::new(Reader(camera)))
    }
}

struct Reader(Nokhwa);

impl Frames for Reader {
    fn next(&mut self) -> Result<Frame, String> {
        let format = self.0.camera_format();
        let bytes = self.0.frame_raw().map_err(|error| error.to_string())?.into_owned();
        Ok(Frame {
            format: match format.format() {
                Coding::MJPEG => FrameFormat::Mjpeg,
                Coding::YUYV => FrameFormat::Yuyv,
                Coding::RAWRGB => FrameFormat::Rgb,
                Coding::RAWBGR => FrameFormat::Bgr,
                other => return Err(format!("the camera has changed to {other} frames")),
            },
            width: format.width(),
            height: format.height(),
            bytes,
        })
    }

    fn torch(&mut self, on: bool) -> Result<(), String> {
        let mode = KnownCameraControl::Other(V4L2_CID_FLASH_LED_MODE);
        let value = ControlValueSetter::Integer(if on { TORCH } else { NO_LIGHT });
        self.0.set_camera_control(mode, value).map_err(|error| error.to_string())
    }
}

fn open(number: u32, id: &str) -> Result<Nokhwa, OpenError> {
    // Opens the camera with any format first: only an open camera lists its formats.
    let any = RequestedFormat::with_formats(RequestedFormatType::None, &CODINGS);
    Nokhwa::with_backend(CameraIndex::Index(number), any, ApiBackend::Video4Linux)
        .map_err(|error| explain(number, id, &error))
}

/// The smallest format that covers the region of 320 × 480 without enlarging it, or else the
/// largest format. Among equal sizes, the best coding counts, then the rate closest to 30 Hz.
fn choose(offers: &[CameraFormat], turn: Turn) -> Option<CameraFormat> {
    let cost = |offer: &&CameraFormat| {
        let (width, height) = (u64::from(offer.width()), u64::from(offer.height()));
        let lies = matches!(turn, Turn::Right | Turn::Left);
        let (w, h) = if lies { (height, width) } else { (width, height) };
        let whole = w >= Image::COLS as u64 && h >= Image::ROWS as u64;
        let area = width * height;
        let coding = CODINGS.iter().position(|known| *known == offer.format());
        (!whole, if whole { area } else { u64::MAX - area }, coding)
    };
    let understood = |offer: &&CameraFormat| CODINGS.contains(&offer.format());
    let rate = |offer: &&CameraFormat| offer.frame_rate().abs_diff(RATE_HZ);
    offers.iter().filter(understood).min_by_key(|offer| (cost(offer), rate(offer))).copied()
}

fn explain(number: u32, id: &str, error: &NokhwaError) -> OpenError {
    let camera = format!("camera {id}");
    // The number of the system's error stands only in the text of nokhwa's error.
    let text = error.to_string();
    let has = |code: &str| text.contains(&format!("(os error {code})"));
    match () {
        () if has("13") || has("1") => OpenError::Denied {
            device: camera,
            hint: permission_hint(Path::new(&format!("{DEV}/video{number}")), "video"),
        },
        () if has("16") => OpenError::Busy(camera),
        () if has("2") || has("19") => OpenError::Absent(camera),
        () if text.contains("Failed to Fufill") => OpenError::Unfit(format!(
            "{camera} has no format that is understood (MJPEG, YUYV, RGB, BGR); choose another one"
        )),
        () => OpenError::Failed(format!("{camera}: {text}")),
    }
}

/// Lists the cameras of this machine, with their permanent names and their problems.
pub fn cameras() -> Result<Vec<ListedDevice>, OpenError> {
    let found = nokhwa::query(ApiBackend::Video4Linux)
        .map_err(|error| OpenError::Failed(error.to_string()))?;
    let numbers: BTreeSet<(u32, String)> = found
        .iter()
        .filter_map(|camera| Some((camera.index().as_index().ok()?, camera.human_name())))
        .collect();
    Ok(numbers.into_iter().filter_map(|(number, name)| listed(number, name)).collect())
}

/// A camera of the list; `None` for a node without pictures, as most cameras have for metadata.
fn listed(number: u32, name: String) -> Option<ListedDevice> {
    let node = Path::new(DEV).join(format!("video{number}"));
    let stable = camera_alias(Path::new(DEV), &node);
    let id = stable.as_ref().unwrap_or(&node).display().to_string();
    let index = std::fs::read_to_string(format!("/sys/class/video4linux/video{number}/index"));
    let is_first = index.map_or(true, |index| index.trim() == "0");
    let problem = match node_problem(&node, "video") {
        Some(problem) => Some(problem),
        None => match open(number, &id) {
            Ok(_) => None,
            Err(OpenError::Unfit(_)) if !is_first => return None,
            Err(error) => Some(error.to_string()),
        },
    };
    let unstable = "it has no permanent name; its number may change when it is plugged in again";
    let problem = problem.or_else(|| stable.is_none().then(|| unstable.to_string()));
    Some(ListedDevice { id, name, node: Some(node.display().to_string()), problem })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn offer(width: u32, height: u32, coding: Coding, rate: u32) -> CameraFormat {
        CameraFormat::new_from(width, height, coding, rate)
    }

    #[test]
    fn the_smallest_size_that_shows_the_whole_region_is_chosen() {
        let offers = [
            offer(1920, 1080, Coding::MJPEG, 30),
            offer(640, 480, Coding::MJPEG, 30),
            offer(640, 480, Coding::YUYV, 15),
            offer(640, 480, Coding::YUYV, 30),
            offer(640, 480, Coding::GRAY, 30),
            offer(640, 360, Coding::YUYV, 30),
            offer(320, 240, Coding::YUYV, 30),
        ];
        assert_eq!(choose(&offers, Turn::None), Some(offers[3]));
        // A camera that lies on its side needs 480 × 320 pixels, and 640 × 360 covers them.
        assert_eq!(choose(&offers, Turn::Right), Some(offers[5]));
        assert_eq!(choose(&offers[5..], Turn::None), Some(offers[5]));
        assert_eq!(choose(&offers[4..5], Turn::None), None);
    }

    #[test]
    fn errors_of_the_system_are_distinguished() {
        let said = |code| {
            let text = format!("V4L2 Error: it failed (os error {code})");
            explain(3, "eye", &NokhwaError::OpenDeviceError("3".into(), text))
        };
        assert_eq!(said(16), OpenError::Busy("camera eye".into()));
        assert_eq!(said(19), OpenError::Absent("camera eye".into()));
        assert!(said(13).to_string().contains("usermod -aG video"));
        assert!(matches!(said(22), OpenError::Failed(_)));
    }
}
