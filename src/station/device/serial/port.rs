//! Finds and opens the stylus's serial port, and explains failures.

use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::Duration;

use serialport::{ErrorKind, SerialPort, SerialPortInfo, SerialPortType, UsbPortInfo};

use crate::device::OpenError;
use crate::device::list::{available_ports, permission_hint};

/// Rate of the stylus's serial line in baud; pseudo-terminals ignore it.
pub(super) const BAUD: u32 = 3_000_000;
/// Longest time that a read or a write on the line waits.
pub(in crate::device) const WAIT: Duration = Duration::from_millis(50);
/// USB vendor and product numbers of FTDI's serial chips, which can run at [`BAUD`].
const FTDI: u16 = 0x0403;
const FTDI_CHIPS: [u16; 5] = [0x6001, 0x6010, 0x6011, 0x6014, 0x6015];

#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Selector {
    /// The only FTDI chip that is connected; an error if there are several.
    #[default]
    Auto,
    /// The port with these USB numbers; `serial` selects one of several equal devices.
    Usb { vendor: u16, product: u16, serial: Option<String> },
    /// The path of a port: a permanent link (`/dev/serial/by-id/…`) or a pseudo-terminal.
    Path(PathBuf),
}

impl FromStr for Selector {
    type Err = String;

    /// Parses `auto`, `usb:VENDOR:PRODUCT[:SERIAL]` (numbers in hexadecimal), or a path.
    fn from_str(text: &str) -> Result<Self, String> {
        if text == "auto" {
            return Ok(Self::Auto);
        }
        let Some(usb) = text.strip_prefix("usb:") else {
            return match text {
                "" => Err("an empty name; expected `auto`, `usb:0403:6014` or a path".into()),
                path => Ok(Self::Path(path.into())),
            };
        };
        let mut parts = usb.splitn(3, ':');
        let mut number = || parts.next().and_then(|part| u16::from_str_radix(part, 16).ok());
        match (number(), number()) {
            (Some(vendor), Some(product)) => {
                let serial = parts.next().map(str::to_string);
                Ok(Self::Usb { vendor, product, serial })
            }
            _ => Err(format!("`{text}` is not a USB device; expected for example `usb:0403:6014`")),
        }
    }
}

/// An open line, whose reads time out after [`WAIT`], and the path of its port.
type OpenLine = (Box<dyn SerialPort>, String);

impl Selector {
    fn fits(&self, usb: &UsbPortInfo) -> bool {
        match self {
            Self::Auto => usb.vid == FTDI && FTDI_CHIPS.contains(&usb.pid),
            Self::Usb { vendor, product, serial } => {
                let right = |wanted: &String| usb.serial_number.as_ref() == Some(wanted);
                usb.vid == *vendor && usb.pid == *product && serial.as_ref().is_none_or(right)
            }
            Self::Path(_) => false,
        }
    }

    /// The path of the one matching port in `ports`; an error if there is none or more than one.
    fn choose(&self, ports: &[SerialPortInfo]) -> Result<String, OpenError> {
        let fits = |port: &&SerialPortInfo| match &port.port_type {
            SerialPortType::UsbPort(usb) => self.fits(usb),
            _ => false,
        };
        let mut found: Vec<&str> =
            ports.iter().filter(fits).map(|port| port.port_name.as_str()).collect();
        found.sort_unstable();
        match found[..] {
            [] => Err(OpenError::Absent(self.to_string())),
            [port] => Ok(port.to_string()),
            _ => Err(OpenError::Failed(format!(
                "it could be any of {}; name one in the configuration, port = \
                 \"/dev/serial/by-id/…\"",
                found.join(", ")
            ))),
        }
    }

    pub fn open(&self) -> Result<OpenLine, OpenError> {
        self.open_at(BAUD)
    }

    pub(in crate::device) fn open_at(&self, baud: u32) -> Result<OpenLine, OpenError> {
        let path = match self {
            Self::Path(path) => path.display().to_string(),
            _ => {
                let ports = available_ports()
                    .map_err(|error| failed("the list of serial ports", &error))?;
                self.choose(&ports)?
            }
        };
        let opened = serialport::new(&path, baud).timeout(WAIT).open();
        opened.map_err(|error| failed(&path, &error)).map(|port| (port, path))
    }
}

impl std::fmt::Display for Selector {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Auto => f.write_str("a USB serial adapter by FTDI"),
            Self::Usb { vendor, product, serial } => {
                write!(f, "usb:{vendor:04x}:{product:04x}")?;
                serial.iter().try_for_each(|serial| write!(f, ":{serial}"))
            }
            Self::Path(path) => write!(f, "{}", path.display()),
        }
    }
}

/// The system's error for a file that cannot have a rate in baud.
const NO_TERMINAL: &str = "Not a typewriter";

/// Explains an error of `serialport`, which reports a locked port as `NoDevice`.
fn failed(path: &str, error: &serialport::Error) -> OpenError {
    let node = Path::new(path);
    let device = path.to_string();
    match error.kind() {
        ErrorKind::Io(std::io::ErrorKind::PermissionDenied) => {
            OpenError::Denied { device, hint: permission_hint(node, "dialout") }
        }
        // Also searches the list of ports, since a port on Windows has a name, but no node.
        ErrorKind::NoDevice
            if node.exists()
                || available_ports()
                    .is_ok_and(|ports| ports.iter().any(|port| port.port_name == path)) =>
        {
            OpenError::Busy(device)
        }
        ErrorKind::NoDevice | ErrorKind::Io(std::io::ErrorKind::NotFound) => {
            OpenError::Absent(device)
        }
        _ if error.description == NO_TERMINAL => OpenError::Unfit(format!(
            "{path} is no serial port; for lines from a file or a pipe, name `-` and give it as standard \
             input (`< {path}`)"
        )),
        _ => OpenError::Failed(format!("{path}: {error}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn port(name: &str, vid: u16, pid: u16, serial: &str) -> SerialPortInfo {
        let serial_number = Some(serial.to_string());
        let usb = UsbPortInfo { vid, pid, serial_number, manufacturer: None, product: None };
        SerialPortInfo { port_name: name.into(), port_type: SerialPortType::UsbPort(usb) }
    }

    #[test]
    fn a_stylus_is_found_by_chip_by_device_and_by_serial_number() {
        let ports = [
            port("/dev/ttyACM0", 0x2341, 0x43, "x"),
            port("/dev/ttyUSB0", 0x0403, 0x6014, "A1"),
            port("/dev/ttyUSB1", 0x1a86, 0x7523, "B"),
        ];
        let choose = |text: &str, ports: &[_]| text.parse::<Selector>().unwrap().choose(ports);
        assert_eq!(choose("auto", &ports), Ok("/dev/ttyUSB0".into()));
        assert_eq!(choose("usb:1a86:7523", &ports), Ok("/dev/ttyUSB1".into()));
        assert!(matches!(choose("usb:0403:6001", &ports), Err(OpenError::Absent(_))));
        let two = [ports[1].clone(), port("/dev/ttyUSB5", 0x0403, 0x6014, "A2")];
        assert!(matches!(choose("auto", &two), Err(OpenError::Failed(_))));
        assert_eq!(choose("usb:0403:6014:A2", &two), Ok("/dev/ttyUSB5".into()));
    }

    #[test]
    fn denied_busy_and_absent_are_distinguished() {
        let of = |kind, path: &str| failed(path, &serialport::Error::new(kind, ""));
        let denied = of(ErrorKind::Io(std::io::ErrorKind::PermissionDenied), "/dev/null");
        assert!(denied.to_string().contains("usermod -aG dialout"), "{denied}");
        assert!(matches!(of(ErrorKind::NoDevice, "/dev/null"), OpenError::Busy(_)));
        assert!(matches!(of(ErrorKind::NoDevice, "/dev/none/x"), OpenError::Absent(_)));
    }
}
