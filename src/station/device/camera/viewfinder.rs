//! Shows a camera's whole picture, the compared region and the light to any number of readers.
//! Holds only the newest picture; the page (`serve/page/camera.js`) asks twice a second at most.

use std::sync::{Arc, Mutex};

use image::RgbImage;
use serde::Serialize;

use super::compared_region::{Region, region, small};
use crate::jpeg;
use crate::scene::SourceId;
use crate::system::lock;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum FlashState {
    None,
    Off,
    On,
    Failed,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CameraView {
    /// The stream of the camera's pictures taken without flash.
    pub source: SourceId,
    /// The compared region of the upright picture; `None` before the first picture.
    pub region: Option<Region>,
    pub flash: FlashState,
}

/// Holds a camera's newest picture for readers. All clones share it.
#[derive(Clone, Debug)]
pub struct Viewfinder(Arc<Mutex<(CameraView, Option<Arc<RgbImage>>)>>);

impl Viewfinder {
    pub fn new(source: SourceId) -> Self {
        let view = CameraView { source, region: None, flash: FlashState::None };
        Self(Arc::new(Mutex::new((view, None))))
    }

    /// Sets the picture to show: a whole picture, already upright.
    pub fn show(&self, picture: RgbImage) {
        let mut seen = lock(&self.0);
        seen.0.region = Some(region(&picture));
        seen.1 = Some(Arc::new(picture));
    }

    pub fn light(&self, flash: FlashState) {
        lock(&self.0).0.flash = flash;
    }

    pub fn view(&self) -> CameraView {
        lock(&self.0).0.clone()
    }

    /// The whole picture as a JPEG file of at most 480 × 480 pixels; `None` before the first.
    pub fn jpeg(&self) -> Option<Vec<u8>> {
        let picture = lock(&self.0).1.clone()?;
        let shown = small(&picture);
        jpeg::encode_rgb(shown.as_raw(), shown.dimensions()).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::camera::Turn;

    #[test]
    fn a_viewfinder_shows_the_whole_picture_upright_and_which_region_of_it_is_compared() {
        let finder = Viewfinder::new(SourceId::new("ca1").unwrap());
        assert_eq!((finder.view().region, finder.jpeg()), (None, None));
        let lying = || RgbImage::from_pixel(1280, 720, image::Rgb([90; 3]));
        for (turn, wide, high, region) in [
            // The compared region has 480 of the 1280 columns, since 480:720 is 2:3.
            (Turn::None, 480, 270, (0.3125, 0.0, 0.375, 1.0)),
            // Upright, the picture is 720 wide and 1280 high; the compared region has 1080 rows.
            (Turn::Right, 270, 480, (0.0, 0.078_125, 1.0, 0.843_75)),
        ] {
            finder.show(turn.turn(lying()));
            let Region { left, top, width, height } = finder.view().region.unwrap();
            assert_eq!((left, top, width, height), region, "{turn:?}");
            let shown = image::load_from_memory(&finder.jpeg().unwrap()).unwrap();
            assert_eq!((shown.width(), shown.height()), (wide, high), "{turn:?}");
        }
        finder.light(FlashState::On);
        assert_eq!(finder.clone().view().flash, FlashState::On);
    }
}
