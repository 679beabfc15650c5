//! Cameras by names that stay: V4L2 renumbers them at every plug.

use std::path::{Path, PathBuf};

use crate::device::list::alias;
use crate::device::open::OpenError;

/// Where udev keeps links that stay: by what the camera is, or by where it is plugged in.
const FOLDERS: [&str; 2] = ["v4l/by-id", "v4l/by-path"];

/// The number N of `/dev/videoN` that `id` means: a link in `/dev/v4l/by-id` or `by-path`, with or
/// without the folder, or a node itself. `dev` is `/dev`.
///
/// # Errors
/// If there is no such camera, or the name is that of something else.
pub fn resolve(dev: &Path, id: &str) -> Result<u32, OpenError> {
    let places = FOLDERS.map(|folder| dev.join(folder).join(id));
    // An absolute path replaces what it is joined to.
    let node = places.iter().chain([&dev.join(id)]).find_map(|path| path.canonicalize().ok());
    let Some(node) = node else { return Err(OpenError::Absent(format!("camera {id}"))) };
    number(&node).ok_or_else(|| {
        let node = node.display();
        OpenError::Unfit(format!("camera {id} leads to {node}; expected a node /dev/videoN"))
    })
}

/// The number N of a node `/dev/videoN`.
pub fn number(node: &Path) -> Option<u32> {
    node.file_name()?.to_str()?.strip_prefix("video")?.parse().ok()
}

/// The name that stays of a node, if it has one; by what it is rather than by where it is.
pub fn stable(dev: &Path, node: &Path) -> Option<PathBuf> {
    FOLDERS.iter().find_map(|folder| alias(&dev.join(folder), node))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;
    use std::os::unix::fs::symlink;

    #[test]
    fn a_camera_is_found_by_any_of_its_names() {
        let dir = tempfile::tempdir().unwrap();
        // As the system would report it.
        let dev = dir.path().canonicalize().unwrap();
        for folder in FOLDERS {
            fs::create_dir_all(dev.join(folder)).unwrap();
        }
        let node = dev.join("video12");
        fs::write(&node, "").unwrap();
        fs::write(dev.join("ttyACM0"), "").unwrap();
        symlink("../../video12", dev.join("v4l/by-path/pci-usb-0:2-video-index0")).unwrap();
        let by_path = dev.join("v4l/by-path/pci-usb-0:2-video-index0");
        assert_eq!(stable(&dev, &node), Some(by_path.clone()));
        symlink("../../video12", dev.join("v4l/by-id/usb-Eye-video-index0")).unwrap();
        let by_id = dev.join("v4l/by-id/usb-Eye-video-index0");
        assert_eq!(stable(&dev, &node), Some(by_id.clone()));

        let paths = [&node, &by_id, &by_path].map(|path| path.to_str().unwrap());
        let short = ["video12", "usb-Eye-video-index0", "pci-usb-0:2-video-index0"];
        for id in paths.into_iter().chain(short) {
            assert_eq!(resolve(&dev, id), Ok(12), "{id}");
        }
        assert!(matches!(resolve(&dev, "usb-Gone"), Err(OpenError::Absent(_))));
        let said = resolve(&dev, "ttyACM0").unwrap_err().to_string();
        assert!(said.contains("/dev/videoN"), "{said}");
    }
}
