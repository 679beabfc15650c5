//! Lists the devices of this machine, with their permanent names and their problems.
//!
//! Serial ports are not opened for this, since opening a port resets some boards.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::{fs, io};

use serialport::SerialPortType;

#[cfg(any(feature = "camera", test))]
use super::OpenError;
use super::system::{device_holder, may_use};

#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct ListedDevice {
    /// The device's name in a configuration. It stays the same when other devices are plugged in,
    /// unless `problem` says otherwise.
    pub id: String,
    pub name: String,
    /// The path of the device's present node, such as `/dev/ttyUSB0`; `None` if there is none.
    pub node: Option<String>,
    /// The reason why the device cannot be used, and what to do; `None` if it can be used.
    pub problem: Option<String>,
}

pub fn serial_ports() -> Result<Vec<ListedDevice>, serialport::Error> {
    let mut ports: Vec<ListedDevice> = available_ports()?.iter().map(serial_port).collect();
    ports.sort_by(|a, b| a.id.cmp(&b.id));
    Ok(ports)
}

/// All serial ports; none if the folder `/sys/class/tty` is missing, as in a container.
pub(super) fn available_ports() -> Result<Vec<serialport::SerialPortInfo>, serialport::Error> {
    if cfg!(target_os = "linux") && !Path::new("/sys/class/tty").is_dir() {
        return Ok(Vec::new());
    }
    serialport::available_ports()
}

fn serial_port(port: &serialport::SerialPortInfo) -> ListedDevice {
    let node = Path::new(&port.port_name);
    let (id, name, stays) = match &port.port_type {
        SerialPortType::UsbPort(usb) => {
            let words = [&usb.manufacturer, &usb.product, &usb.serial_number];
            let words: Vec<_> = words.into_iter().flatten().map(String::as_str).collect();
            let name = format!("USB {:04x}:{:04x} {}", usb.vid, usb.pid, words.join(" "));
            let alias = alias(Path::new("/dev/serial/by-id"), node);
            // On Windows, a device keeps its port number, so the name is permanent.
            let stays = alias.is_some() || cfg!(windows);
            (alias.unwrap_or_else(|| node.into()), name, stays)
        }
        SerialPortType::PciPort => (node.into(), "PCI".to_string(), true),
        SerialPortType::BluetoothPort => (node.into(), "Bluetooth".to_string(), true),
        SerialPortType::Unknown => (node.into(), "on board".to_string(), true),
    };
    let text =
        "it has no permanent name (no udev?); its number may change when it is plugged in again";
    let unstable = || (!stays).then(|| text.to_string());
    ListedDevice {
        id: id.display().to_string(),
        name: name.trim_end().to_string(),
        problem: node_problem(node, "dialout").or_else(unstable),
        node: Some(port.port_name.clone()),
    }
}

/// The link in `folder` that leads to `node`; the first by name if there are several.
pub(super) fn alias(folder: &Path, node: &Path) -> Option<PathBuf> {
    let node = node.canonicalize().ok()?;
    let links = fs::read_dir(folder).ok()?.flatten().map(|entry| entry.path());
    links.filter(|link| link.canonicalize().is_ok_and(|target| target == node)).min()
}

/// Why the user cannot use a device node (gone, forbidden, in use); `None` if it can be used.
pub(super) fn node_problem(node: &Path, group: &str) -> Option<String> {
    match may_use(node) {
        Ok(()) => device_holder(node)
            .map(|holder| format!("in use by process {holder}; end it, or name another device")),
        Err(error) if error.kind() == io::ErrorKind::PermissionDenied => {
            Some(format!("permission denied; {}", permission_hint(node, group)))
        }
        Err(error) => Some(error.to_string()),
    }
}

/// Tells a user how to get access to a device node. `group` is the group that usually has access.
pub(crate) fn permission_hint(node: &Path, group: &str) -> String {
    let subsystem = if group == "video" { "video4linux" } else { "tty" };
    // The rule holds for the name of the node itself, which a link may lead to.
    let node = node.canonicalize().unwrap_or_else(|_| node.into());
    let name = node.file_name().and_then(OsStr::to_str).unwrap_or("ttyACM0");
    let kind = name.trim_end_matches(|c: char| c.is_ascii_digit());
    format!(
        "add yourself to the group that may (sudo usermod -aG {group} $USER, then log in again), \
         or write to /etc/udev/rules.d/60-stylus.rules: SUBSYSTEM==\"{subsystem}\", \
         KERNEL==\"{kind}[0-9]*\", TAG+=\"uaccess\" and run: sudo udevadm control --reload && \
         sudo udevadm trigger"
    )
}

/// Folders below `/dev` with udev's permanent links to cameras, by model and by USB socket.
#[cfg(any(feature = "camera", test))]
const CAMERA_FOLDERS: [&str; 2] = ["v4l/by-id", "v4l/by-path"];

/// The number N in `/dev/videoN`, for the camera `id`: a link in `/dev/v4l/by-id` or `by-path`
/// (with or without its folder), or the node itself. `dev` is `/dev`, except in tests.
#[cfg(any(feature = "camera", test))]
pub(super) fn camera_number(dev: &Path, id: &str) -> Result<u32, OpenError> {
    let places = CAMERA_FOLDERS.map(|folder| dev.join(folder).join(id));
    // `id` may be a whole path, too, since `join` returns an absolute path unchanged.
    let node = places.iter().chain([&dev.join(id)]).find_map(|path| path.canonicalize().ok());
    let Some(node) = node else { return Err(OpenError::Absent(format!("camera {id}"))) };
    let name = node.file_name().and_then(OsStr::to_str);
    let number = name.and_then(|name| name.strip_prefix("video")?.parse().ok());
    number.ok_or_else(|| {
        let node = node.display();
        OpenError::Unfit(format!("camera {id} leads to {node}; expected a node /dev/videoN"))
    })
}

/// The permanent link to a camera's node, by model or else by USB socket; `None` without links.
#[cfg(any(feature = "camera", test))]
pub(super) fn camera_alias(dev: &Path, node: &Path) -> Option<PathBuf> {
    CAMERA_FOLDERS.iter().find_map(|folder| alias(&dev.join(folder), node))
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    #[test]
    fn a_node_is_named_by_the_link_that_stays() {
        let dir = tempfile::tempdir().unwrap();
        let node = dir.path().join("ttyACM0");
        let links = dir.path().join("by-id");
        fs::create_dir(&links).unwrap();
        fs::write(&node, "").unwrap();
        assert_eq!(alias(&links, &node), None);
        for (name, to) in [("usb-b", "../ttyACM0"), ("usb-a", "../ttyACM0"), ("other", "../gone")] {
            symlink(to, links.join(name)).unwrap();
        }
        assert_eq!(alias(&links, &node), Some(links.join("usb-a")));
        assert_eq!(alias(&dir.path().join("none"), &node), None);
    }

    #[test]
    fn a_missing_permission_comes_with_the_udev_rule() {
        let hint = permission_hint(Path::new("/dev/ttyACM3"), "dialout");
        assert!(hint.contains("usermod -aG dialout") && hint.contains("KERNEL==\"ttyACM[0-9]*\""));
        let dir = tempfile::tempdir().unwrap();
        fs::write(dir.path().join("ttyUSB0"), "").unwrap();
        symlink("ttyUSB0", dir.path().join("usb-FTDI-if00")).unwrap();
        let hint = permission_hint(&dir.path().join("usb-FTDI-if00"), "dialout");
        assert!(hint.contains("KERNEL==\"ttyUSB[0-9]*\""), "{hint}");
        let hint = permission_hint(Path::new("/dev/video10"), "video");
        assert!(hint.contains("video4linux") && hint.contains("KERNEL==\"video[0-9]*\""), "{hint}");
    }

    #[test]
    fn a_node_that_is_gone_is_a_problem() {
        let said = node_problem(Path::new("/dev/no-such-port"), "dialout").unwrap();
        assert!(said.contains("No such file"), "{said}");
    }

    #[test]
    fn a_camera_is_found_by_any_of_its_names() {
        let dir = tempfile::tempdir().unwrap();
        // Resolves links in the path, like `canonicalize` in the code under test.
        let dev = dir.path().canonicalize().unwrap();
        for folder in CAMERA_FOLDERS {
            fs::create_dir_all(dev.join(folder)).unwrap();
        }
        let node = dev.join("video12");
        fs::write(&node, "").unwrap();
        fs::write(dev.join("ttyACM0"), "").unwrap();
        symlink("../../video12", dev.join("v4l/by-path/pci-usb-0:2-video-index0")).unwrap();
        let by_path = dev.join("v4l/by-path/pci-usb-0:2-video-index0");
        assert_eq!(camera_alias(&dev, &node), Some(by_path.clone()));
        symlink("../../video12", dev.join("v4l/by-id/usb-Eye-video-index0")).unwrap();
        let by_id = dev.join("v4l/by-id/usb-Eye-video-index0");
        assert_eq!(camera_alias(&dev, &node), Some(by_id.clone()));

        let paths = [&node, &by_id, &by_path].map(|path| path.to_str().unwrap());
        let short = ["video12", "usb-Eye-video-index0", "pci-usb-0:2-video-index0"];
        for id in paths.into_iter().chain(short) {
            assert_eq!(camera_number(&dev, id), Ok(12), "{id}");
        }
        assert!(matches!(camera_number(&dev, "usb-Gone"), Err(OpenError::Absent(_))));
        let said = camera_number(&dev, "ttyACM0").unwrap_err().to_string();
        assert!(said.contains("/dev/videoN"), "{said}");
    }
}
