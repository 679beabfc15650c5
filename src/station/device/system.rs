//! Questions of drivers to the operating system. Errors are its own.

#[cfg(unix)]
use std::fs;
use std::fs::File;
use std::io;
use std::net::UdpSocket;
#[cfg(unix)]
use std::os::unix::fs::{FileTypeExt, MetadataExt};
use std::path::Path;

#[cfg(unix)]
use rustix::fs::{Access, access};

#[cfg(unix)]
pub(in crate::device) fn may_use(node: &Path) -> io::Result<()> {
    Ok(access(node, Access::READ_OK | Access::WRITE_OK)?)
}

/// Number and name of another process that has a device open, as far as this user may see it.
#[cfg(unix)]
pub(in crate::device) fn device_holder(node: &Path) -> Option<String> {
    let device = fs::metadata(node).ok().filter(|node| node.file_type().is_char_device())?.rdev();
    let has = |process: &Path| {
        let Ok(open) = fs::read_dir(process.join("fd")) else { return false };
        open.flatten().any(|entry| {
            // Looks at the link's text first, since following a link to a dead network may take long.
            let link = fs::read_link(entry.path()).unwrap_or_default();
            link.starts_with("/dev")
                && fs::metadata(entry.path())
                    .is_ok_and(|m| m.file_type().is_char_device() && m.rdev() == device)
        })
    };
    let own = std::process::id();
    fs::read_dir("/proc").ok()?.flatten().find_map(|entry| {
        let number: u32 = entry.file_name().to_str()?.parse().ok()?;
        let name = || fs::read_to_string(entry.path().join("comm")).unwrap_or_default();
        (number != own && has(&entry.path())).then(|| format!("{number} ({})", name().trim()))
    })
}

/// Always succeeds, since opening a device shows whether it can be used.
#[cfg(windows)]
pub(in crate::device) fn may_use(_: &Path) -> io::Result<()> {
    Ok(())
}

/// Always `None`, since Windows does not tell which process has a device open.
#[cfg(windows)]
pub(in crate::device) fn device_holder(_: &Path) -> Option<String> {
    None
}

/// Whether standard input is a file, which waits until it is read; a pipe may come from a live sensor.
pub(in crate::device) fn stdin_is_a_file() -> bool {
    #[cfg(unix)]
    let own = std::os::fd::AsFd::as_fd(&io::stdin()).try_clone_to_owned();
    #[cfg(windows)]
    let own = std::os::windows::io::AsHandle::as_handle(&io::stdin()).try_clone_to_owned();
    own.and_then(|own| File::from(own).metadata()).is_ok_and(|about| about.is_file())
}

/// The number of datagrams that the system has dropped at a socket so far, since its buffer was full;
/// `None` except on Linux.
pub(in crate::device) fn datagrams_dropped(socket: &UdpSocket) -> Option<u64> {
    #[cfg(target_os = "linux")]
    {
        // The tenth field of a line is the socket's inode, and the last is the number.
        let inode = rustix::fs::fstat(socket).ok()?.st_ino.to_string();
        let tables = ["/proc/thread-self/net/udp", "/proc/thread-self/net/udp6"];
        let tables = tables.iter().filter_map(|table| fs::read_to_string(table).ok());
        tables.into_iter().find_map(|table| {
            let of = |line: &&str| line.split_ascii_whitespace().nth(9) == Some(inode.as_str());
            table.lines().find(of)?.split_ascii_whitespace().last()?.parse().ok()
        })
    }
    #[cfg(not(target_os = "linux"))]
    {
        let _ = socket;
        None
    }
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    #[test]
    fn the_process_that_has_a_node_is_named() {
        let mut child = std::process::Command::new("sleep")
            .arg("60")
            .stdin(fs::File::open("/dev/full").unwrap())
            .spawn()
            .unwrap();
        let mut found = None;
        for _ in 0..100 {
            found = device_holder(Path::new("/dev/full"));
            if found.as_deref().is_some_and(|text| text.contains("(sleep)")) {
                break;
            }
            std::thread::sleep(std::time::Duration::from_millis(10));
        }
        child.kill().unwrap();
        child.wait().unwrap();
        assert_eq!(found, Some(format!("{} (sleep)", child.id())));
    }
}
