//! Shows the whole picture of a camera to several readers: the picture, the region of it that is
//! compared, and the light. It holds the newest; the page (`serve/page/camera.js`) asks for it at most
//! twice a second.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use serde::Serialize;

use super::Rgb;
use super::upright::{Region, Turn, region, small};
use crate::jpeg;
use crate::scene::SourceId;

/// The state of the light of a camera, as far as it is known.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum FlashState {
    None,
    Off,
    On,
    /// It could not be switched.
    Failed,
}

/// The view of a camera, without its picture.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CameraView {
    /// The stream of its pictures without flash.
    pub source: SourceId,
    /// The region that is compared, of the picture turned upright; `None` before the first picture.
    pub region: Option<Region>,
    pub flash: FlashState,
}

/// Shows the picture of a camera; clones show the same camera.
#[derive(Clone, Debug)]
pub struct Viewfinder {
    source: SourceId,
    sight: Arc<Mutex<Sight>>,
}

#[derive(Debug)]
struct Sight {
    picture: Option<(Arc<Rgb>, Turn)>,
    flash: FlashState,
}

impl Viewfinder {
    /// The viewfinder of a camera whose pictures without flash are the stream `source`.
    pub fn new(source: SourceId) -> Self {
        let sight = Sight { picture: None, flash: FlashState::None };
        Self { source, sight: Arc::new(Mutex::new(sight)) }
    }

    fn lock(&self) -> MutexGuard<'_, Sight> {
        // Each change is one assignment, so a panic leaves a usable state.
        self.sight.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Shows a picture as the camera gave it; `turn` makes it upright.
    pub fn show(&self, picture: Rgb, turn: Turn) {
        self.lock().picture = Some((Arc::new(picture), turn));
    }

    pub fn light(&self, flash: FlashState) {
        self.lock().flash = flash;
    }

    /// The stream of the camera's pictures without flash.
    pub fn source(&self) -> &SourceId {
        &self.source
    }

    pub fn view(&self) -> CameraView {
        let sight = self.lock();
        let region = sight.picture.as_ref().map(|(rgb, turn)| region(rgb, *turn));
        CameraView { source: self.source.clone(), region, flash: sight.flash }
    }

    /// The whole picture, upright, 480 pixels along its longer side, as a JPEG file; `None` before
    /// the first one, or without memory for it.
    pub fn jpeg(&self) -> Option<Vec<u8>> {
        let (picture, turn) = self.lock().picture.clone()?;
        let Rgb { width, height, bytes } = small(&picture, turn)?;
        jpeg::encode_rgb(&bytes, (width as u32, height as u32)).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_viewfinder_shows_the_whole_picture_upright_and_which_region_of_it_is_compared() {
        let finder = Viewfinder::new(SourceId::new("ca1").unwrap());
        assert_eq!((finder.view().region, finder.jpeg()), (None, None));
        let lying = || Rgb { width: 1280, height: 720, bytes: vec![90; 1280 * 720 * 3] };
        for (turn, wide, high, region) in [
            // 480 of the 1280 columns are compared, since 480:720 is 2:3.
            (Turn::None, 480, 270, (0.3125, 0.0, 0.375, 1.0)),
            // Upright it is 720 wide and 1280 high, of which 1080 rows are compared.
            (Turn::Right, 270, 480, (0.0, 0.078_125, 1.0, 0.843_75)),
        ] {
            finder.show(lying(), turn);
            let Region { left, top, width, height } = finder.view().region.unwrap();
            assert_eq!((left, top, width, height), region, "{turn:?}");
            let shown = image::load_from_memory(&finder.jpeg().unwrap()).unwrap();
            assert_eq!((shown.width(), shown.height()), (wide, high), "{turn:?}");
        }
        finder.light(FlashState::On);
        assert_eq!(finder.clone().view().flash, FlashState::On);
    }
}
