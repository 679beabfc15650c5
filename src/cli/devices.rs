//! `surfaced devices`: lists devices with permanent names, and the problems of each.

use super::{Done, Failure, show};
use crate::device::list::{self, ListedDevice};

/// List serial ports, microphones and cameras with stable ids, and the problems of each
#[derive(clap::Args)]
#[command(
    after_help = "Examples:\n  surfaced devices\n  surfaced devices --json\n\nTime: a second"
)]
pub struct Args {
    /// Print one JSON document on stdout
    #[arg(long)]
    json: bool,
}

#[derive(serde::Serialize)]
struct Inventory {
    serial_ports: DeviceClass,
    microphones: DeviceClass,
    cameras: DeviceClass,
}

/// The devices of one class.
#[derive(serde::Serialize)]
struct DeviceClass {
    /// Whether this build has the drivers for them.
    built: bool,
    devices: Vec<ListedDevice>,
    /// The reason why the list is empty although there may be devices, and what to do.
    problem: Option<String>,
}

impl DeviceClass {
    fn of<E: std::fmt::Display>(listed: Result<Vec<ListedDevice>, E>) -> Self {
        match listed {
            Ok(devices) => Self { built: true, devices, problem: None },
            Err(error) => {
                Self { built: true, devices: Vec::new(), problem: Some(error.to_string()) }
            }
        }
    }

    #[cfg(not(all(feature = "microphone", feature = "camera")))]
    fn left_out(feature: &str) -> Self {
        let problem = format!(
            "this build has no {feature}s; build with `--features live`, or `--features {feature}` \
             (on Debian, first: apt-get install pkg-config libasound2-dev libclang-dev)"
        );
        Self { built: false, devices: Vec::new(), problem: Some(problem) }
    }
}

#[cfg(feature = "microphone")]
fn microphones() -> DeviceClass {
    let _hushed = HushedStderr::new();
    DeviceClass::of(crate::device::microphone::microphones())
}

/// Keeps libraries from writing to stderr until it is dropped: those behind ALSA's plugins, such as
/// JACK's, report a missing server there, which the list shows as that device's problem. For this
/// command alone, in which no other thread writes to stderr.
#[cfg(feature = "microphone")]
struct HushedStderr(Option<std::os::fd::OwnedFd>);

#[cfg(feature = "microphone")]
impl HushedStderr {
    /// If stderr cannot be kept for later, it stays as it is.
    fn new() -> Self {
        let kept = rustix::io::fcntl_dupfd_cloexec(std::io::stderr(), 3).ok();
        let null = std::fs::OpenOptions::new().write(true).open("/dev/null").ok();
        let hushed = kept.zip(null).filter(|(_, null)| rustix::stdio::dup2_stderr(null).is_ok());
        Self(hushed.map(|(kept, _)| kept))
    }
}

#[cfg(feature = "microphone")]
impl Drop for HushedStderr {
    fn drop(&mut self) {
        if let Some(kept) = &self.0 {
            // If stderr cannot be restored, there is nowhere to report it.
            let _ = rustix::stdio::dup2_stderr(kept);
        }
    }
}

#[cfg(not(feature = "microphone"))]
fn microphones() -> DeviceClass {
    DeviceClass::left_out("microphone")
}

#[cfg(feature = "camera")]
fn cameras() -> DeviceClass {
    DeviceClass::of(crate::device::camera::cameras())
}

#[cfg(not(feature = "camera"))]
fn cameras() -> DeviceClass {
    DeviceClass::left_out("camera")
}

pub fn run(args: &Args) -> Done {
    let inventory = Inventory {
        serial_ports: DeviceClass::of(list::serial_ports()),
        microphones: microphones(),
        cameras: cameras(),
    };
    let classes = [
        ("serial ports", &inventory.serial_ports),
        ("microphones", &inventory.microphones),
        ("cameras", &inventory.cameras),
    ];
    match args.json {
        true => show::json(&inventory),
        false => {
            classes.into_iter().for_each(|(name, class)| show_class(name, class));
            show::next("surfaced enroll LABEL --library my-library");
        }
    }
    let unlisted: Vec<_> = classes
        .into_iter()
        .filter(|(_, class)| class.built)
        .filter_map(|(name, class)| Some(format!("{name}: {}", class.problem.as_ref()?)))
        .collect();
    if unlisted.is_empty() { Ok(()) } else { Err(Failure::Failed(unlisted.join("; "))) }
}

fn show_class(name: &str, class: &DeviceClass) {
    result!("{name}:");
    match &class.problem {
        Some(problem) => result!("  {problem}"),
        None if class.devices.is_empty() => result!("  none"),
        None => {}
    }
    for device in &class.devices {
        let ListedDevice { id, name, node, problem } = device;
        let node = match node {
            Some(node) if node != id => format!(" (now {node})"),
            _ => String::new(),
        };
        result!("  {id}{node}: {}", name.replace('\n', ", "));
        if let Some(problem) = problem {
            result!("    ! {problem}");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_class_that_cannot_be_listed_says_why() {
        let class = DeviceClass::of(Err("no sound system"));
        assert!(class.built && class.problem.as_deref() == Some("no sound system"));
    }

    #[cfg(not(feature = "live"))]
    #[test]
    fn a_build_without_live_devices_says_how_to_get_them() {
        assert!(cameras().problem.unwrap().contains("--features live"));
        assert!(microphones().problem.unwrap().contains("libasound2-dev"));
    }
}
